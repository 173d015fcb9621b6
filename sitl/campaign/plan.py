"""What a campaign flies, as the text files that runner beside its results: the same texts, the same results."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import pyarrow as pa
from mimopilot.codegen.render import generator_version
from mimopilot.sitl.campaign.variation import Variation
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.faults.kinds import parse_fault
from mimopilot.sitl.flight.scenario import Scenario, make_scenario
from mimopilot.sitl.physics.airframe import Airframe, Vehicle, airframe_from_toml
from mimopilot.tuning.gains import Gains, gains_from_toml, gains_to_toml
from pydantic import BaseModel, ConfigDict, Field

from mimopilot.common.files import inside, read_text, sha256, write_atomically
from mimopilot.common.toml import checked, parse_toml, shown, toml_entries

SPEC, AIRFRAME = "spec.toml", "airframe.toml"
RESULTS, PARTS, LOCK = "results.parquet", "parts", "campaign.lock"
SUMMARY, REPORT = "summary.json", "report.html"
HEAD = "# A campaign of mimopilot. Run k is drawn from the seed and k alone; every gain set flies the same runs."
MAX_RUNS = 100_000_000


class CampaignSpec(BaseModel):
    """The campaign's own file, `spec.toml`.

    Attributes
    ----------
    mimopilot : str
        Version that flies it.
    runs, seed : int
    gains : tuple of str
        Names of the gain sets; each has a file.
    manoeuvre : str
        See `sitl.flight.scenario.make_scenario`.
    axes : tuple of str
        Each run flies the manoeuvre on each.
    amplitude_deg, period_s, tail_s : float
        Of the manoeuvre.
    faults : tuple of str
        Of every flight, as `sitl.faults.kinds.parse_fault` reads them.
    vary : Variation
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    mimopilot: str
    runs: Annotated[int, Field(ge=1, le=MAX_RUNS)]
    seed: Annotated[int, Field(ge=0)]
    gains: Annotated[tuple[str, ...], Field(min_length=1)]
    manoeuvre: str
    axes: Annotated[tuple[str, ...], Field(min_length=1)]
    amplitude_deg: float
    period_s: float
    tail_s: float
    faults: tuple[str, ...] = ()
    vary: Variation = Variation()


@dataclass(frozen=True, eq=False)
class CampaignPlan:
    """A campaign.

    Attributes
    ----------
    files : dict
        Name -> text: what `plan_from_files` makes the same plan of, on this machine or another.
    description : CampaignSpec
    airframe : Airframe
    gains : dict of Gains
        By name, in order.
    scenarios : list of Scenario
        One an axis.
    """

    files: dict[str, str]
    description: CampaignSpec
    airframe: Airframe
    gains: dict[str, Gains]
    scenarios: list[Scenario]

    @cached_property
    def digest(self) -> str:
        """Hash of all that decides what the flights are."""
        return sha256(json.dumps(self.files, sort_keys=True))


def make_plan(vehicle: Vehicle, gains: dict[str, Gains], **entries: Any) -> CampaignPlan:
    """A plan from its parts.

    Parameters
    ----------
    vehicle : Vehicle
        What flies.
    gains : dict of Gains
        By name.
    **entries
        The rest of `CampaignSpec`; `vary` as a mapping.

    Raises
    ------
    SitlError
        When an entry is impossible.
    """
    entries = {"mimopilot": generator_version(), **entries, "gains": list(gains)}
    vary = entries.pop("vary", {})
    lines = [HEAD, *toml_entries(entries), "", "[vary]", *toml_entries(vary)]
    files = {SPEC: "\n".join(lines) + "\n", AIRFRAME: vehicle.text}
    return plan_from_files(files | {gains_file(name): gains_to_toml(one) for name, one in gains.items()})


def gains_file(name: str) -> str:
    """Where the gain set of a name lies in a campaign's folder."""
    return f"gains/{name}.gains.toml"


def plan_from_files(files: dict[str, str], where: str = "campaign") -> CampaignPlan:
    """The plan that a campaign's files describe.

    Raises
    ------
    SitlError
        When a file is missing, or what it says cannot be flown.
    TuningError
        When a file is not TOML, or an entry is unknown or impossible.
    """
    try:
        description = checked(CampaignSpec, parse_toml(files[SPEC], f"{where}/{SPEC}"), f"{where}/{SPEC}")
        airframe = airframe_from_toml(files[AIRFRAME], f"{where}/{AIRFRAME}")
        names = description.gains
        gains = {name: gains_from_toml(files[gains_file(name)], f"{where}/{gains_file(name)}") for name in names}
    except KeyError as error:
        raise SitlError(f"{where}: {error.args[0]} is missing") from error
    periods = {one.Ts for one in gains.values()}
    if len(periods) > 1:
        raise SitlError(f"gains: the sets are for different control periods, {sorted(periods)} s; fly each by itself")
    d, (Ts,) = description, periods
    faults = tuple(map(parse_fault, d.faults))
    made = (make_scenario(d.manoeuvre, axis, d.amplitude_deg, d.period_s, Ts, d.tail_s) for axis in d.axes)
    scenarios = [replace(scenario, faults=faults) for scenario in made]
    return CampaignPlan(files, description, airframe, gains, scenarios)


def read_files(folder: Path) -> dict[str, str]:
    """Texts of the campaign in a folder, by name; empty when there is none."""
    if not (folder / SPEC).is_file():
        return {}
    texts = {SPEC: read_text(folder / SPEC, "campaign's specification")}
    listed = parse_toml(texts[SPEC], str(folder / SPEC)).get("gains")
    names = [name for name in listed if isinstance(name, str)] if isinstance(listed, list) else []
    for name in (AIRFRAME, *map(gains_file, names)):
        if (folder / name).exists():
            texts[name] = read_text(folder / name, "campaign's file")
    return texts


def write_plan_files(plan: CampaignPlan, folder: Path) -> None:
    """Put the plan's files into a folder.

    Raises
    ------
    SitlError
        When the folder holds another campaign: names the first difference; or results of an unknown one.
    TuningError
        When a file of the campaign that it holds cannot be read.
    OSError
        When a link lies on the way to one of the files, or one cannot be written.
    """
    there = read_files(folder)
    if not there and ((folder / RESULTS).exists() or (folder / PARTS).exists()):
        raise SitlError(f"{folder}: holds results, but no {SPEC} that says of what; give another --out")
    if there and there != plan.files:
        raise SitlError(
            f"{folder}: holds another campaign ({_difference(there, plan.files)}); give another --out, or the same "
            "arguments to go on with it"
        )
    for name, text in sorted(plan.files.items(), key=lambda item: item[0] == SPEC):  # the spec last: it counts
        write_atomically(inside(folder, name), text)


def _difference(there: dict[str, str], here: dict[str, str]) -> str:
    old, new = parse_toml(there[SPEC], SPEC), parse_toml(here[SPEC], SPEC)
    for name in [*new, *old]:
        if old.get(name) != new.get(name):
            return f"{name}: {shown(old.get(name))} there, {shown(new.get(name))} here"
    names = [name for name in [*here, *there] if here.get(name) != there.get(name)]
    return f"{names[0]} differs"


@contextmanager
def damage_explained(results: Path) -> Iterator[None]:
    """A table of results that is damaged is told in one line."""
    try:
        yield
    except (pa.ArrowException, ValueError, OSError) as error:
        if isinstance(error, OSError) and error.errno:  # of the system: not the fault of what is in the file
            raise
        raise SitlError(f"{results}: damaged; remove it and give the campaign's command again") from error
