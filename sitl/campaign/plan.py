"""The plan of a campaign, stored as text files beside its results; the same files give the same results."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import pyarrow as pa
from pydantic import BaseModel, ConfigDict, Field

from mimopilot.codegen.render import generator_version
from mimopilot.common.files import inside, read_text, sha256, write_atomically
from mimopilot.common.toml import checked, parse_toml, shown, toml_entries
from mimopilot.sitl.campaign.variation import Variation
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.faults.kinds import parse_fault
from mimopilot.sitl.flight.scenario import Scenario, make_scenario
from mimopilot.sitl.physics.airframe import Airframe, AirframeFile, airframe_from_toml
from mimopilot.tuning.gains import Gains, gains_to_toml
from mimopilot.tuning.gains_file import gains_from_toml

SPEC, AIRFRAME = "spec.toml", "airframe.toml"
RESULTS, PARTS, LOCK = "results.parquet", "parts", "campaign.lock"
SUMMARY, REPORT = "summary.json", "report.html"
HEAD = "# A campaign of mimopilot. Run k is drawn from the seed and k alone; every gain set flies the same runs."
MAX_RUNS = 100_000_000  # the number of a part file has seven digits


class CampaignSpec(BaseModel):
    """The campaign's specification file, `spec.toml`.

    Attributes
    ----------
    mimopilot : str
        Version that flies the campaign.
    runs, seed : int
    gains : tuple of str
        Names of the gain sets; one file each.
    manoeuvre : str
        See `sitl.flight.scenario.make_scenario`.
    axes : tuple of str
        Each run flies the manoeuvre on every axis.
    amplitude_deg, period_s, tail_s : float, deg, s, s
        Amplitude and length of the manoeuvre, and level flight after it.
    faults : tuple of str
        Faults of every flight, in the notation of `sitl.faults.kinds.parse_fault`.
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
        Name -> text, from which `plan_from_files` restores the plan on any machine.
    description : CampaignSpec
    airframe : Airframe
    gains : dict of Gains
        Name -> gains, in order.
    scenarios : list of Scenario
        One per axis.
    """

    files: dict[str, str]
    description: CampaignSpec
    airframe: Airframe
    gains: dict[str, Gains]
    scenarios: list[Scenario]

    @cached_property
    def digest(self) -> str:
        """Hash of everything that determines the flights."""
        return sha256(json.dumps(self.files, sort_keys=True))


def make_plan(vehicle: AirframeFile, gains: dict[str, Gains], **entries: Any) -> CampaignPlan:
    """A plan from its parts.

    Parameters
    ----------
    vehicle : AirframeFile
        The vehicle.
    gains : dict of Gains
        Name -> gains.
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
    """Path of a gain set in the campaign's folder."""
    return f"gains/{name}.gains.toml"


def plan_from_files(files: dict[str, str], where: str = "campaign") -> CampaignPlan:
    """The plan described by a campaign's files.

    Raises
    ------
    SitlError
        When a file is missing, or the scenario is impossible.
    InputFileError
        When a file is not TOML, or an entry is unknown or impossible.
    """
    try:
        description = checked(CampaignSpec, parse_toml(files[SPEC], f"{where}/{SPEC}"), f"{where}/{SPEC}")
        airframe = airframe_from_toml(files[AIRFRAME], f"{where}/{AIRFRAME}")
        names = description.gains
        gains = {name: gains_from_toml(files[gains_file(name)], f"{where}/{gains_file(name)}") for name in names}
    except KeyError as error:
        raise SitlError(f"{where}: {error.args[0]} is missing; start the campaign again in another folder") from error
    periods = {one.Ts for one in gains.values()}
    if len(periods) > 1:
        raise SitlError(
            f"gains: the sets have different control periods, {sorted(periods)} s; fly one campaign for each"
        )
    d, (Ts,) = description, periods
    faults = tuple(map(parse_fault, d.faults))
    made = (make_scenario(d.manoeuvre, axis, d.amplitude_deg, d.period_s, Ts, d.tail_s) for axis in d.axes)
    scenarios = [replace(scenario, faults=faults) for scenario in made]
    return CampaignPlan(files, description, airframe, gains, scenarios)


def read_files(folder: Path) -> dict[str, str]:
    """Files of the campaign in a folder, name -> text; empty when there is no campaign."""
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
    """Write the plan's files into a folder.

    Raises
    ------
    SitlError
        When the folder holds another campaign (names the first difference), or results without a specification.
    InputFileError
        When a file of the campaign in the folder cannot be read.
    OSError
        When a file would be written through a symbolic link, or cannot be written.
    """
    there = read_files(folder)
    if not there and ((folder / RESULTS).exists() or (folder / PARTS).exists()):
        raise SitlError(f"{folder}: holds results but no {SPEC}; give another --out")
    if there and there != plan.files:
        raise SitlError(
            f"{folder}: holds another campaign ({_difference(there, plan.files)}); give another --out, or the same "
            "arguments to resume it"
        )
    # The specification is last: with it the folder counts as a campaign.
    for name, text in sorted(plan.files.items(), key=lambda item: item[0] == SPEC):
        write_atomically(inside(folder, name), text)


def _difference(there: dict[str, str], here: dict[str, str]) -> str:
    old, new = parse_toml(there[SPEC], SPEC), parse_toml(here[SPEC], SPEC)
    for name in [*new, *old]:
        if old.get(name) != new.get(name):
            return f"{name}: {shown(old.get(name))} in the folder, {shown(new.get(name))} now"
    names = [name for name in [*here, *there] if here.get(name) != there.get(name)]
    return f"{names[0]} differs"


@contextmanager
def reading_results(results: Path) -> Iterator[None]:
    """Turn read errors of a damaged results file into one message."""
    try:
        yield
    except (pa.ArrowException, ValueError, OSError) as error:
        if isinstance(error, OSError) and error.errno:  # an error of the operating system, not of the contents
            raise
        raise SitlError(f"{results}: damaged; remove it and give the campaign command again") from error
