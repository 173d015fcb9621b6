"""What a campaign flies, as the text files that stand beside its results: the same texts, the same results."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import pyarrow as pa
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from codegen.render import generator_version
from sitl.airframe import Airframe, Vehicle, airframe_from_toml
from sitl.campaign.variation import Variation
from sitl.errors import SitlError
from sitl.faults import complaint, parse_fault
from sitl.scenario import Scenario, make_scenario
from tuning.files import write_atomically
from tuning.gains import Gains, gains_from_toml, gains_to_toml, toml_value

SPEC, AIRFRAME = "spec.toml", "airframe.toml"
RESULTS, PARTS = "results.parquet", "parts"
HEAD = "# A campaign of mimopilot. Run k is drawn from the seed and k alone; every gain set flies the same runs."
MAX_RUNS = 100_000_000


class Description(BaseModel):
    """The campaign's own file, `spec.toml`.

    Attributes
    ----------
    mimopilot : str
        Version that flies it.
    runs, seed : int
    gains : tuple of str
        Names of the gain sets; each has a file.
    manoeuvre : str
        See `sitl.scenario.make_scenario`.
    axes : tuple of str
        Each run flies the manoeuvre on each.
    amplitude_deg, period_s, tail_s : float
        Of the manoeuvre.
    faults : tuple of str
        Of every flight, as `sitl.faults.parse_fault` reads them.
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
class Plan:
    """A campaign.

    Attributes
    ----------
    files : dict
        Name -> text: what `plan_from_files` makes the same plan of, on this machine or another.
    description : Description
    airframe : Airframe
    gains : dict of Gains
        By name, in order.
    scenarios : list of Scenario
        One an axis.
    """

    files: dict[str, str]
    description: Description
    airframe: Airframe
    gains: dict[str, Gains]
    scenarios: list[Scenario]


def make_plan(vehicle: Vehicle, gains: dict[str, Gains], **entries: Any) -> Plan:
    """A plan from its parts.

    Parameters
    ----------
    vehicle : Vehicle
        What flies.
    gains : dict of Gains
        By name.
    **entries
        The rest of `Description`; `vary` as a mapping.

    Raises
    ------
    SitlError
        When an entry is impossible.
    """
    entries = {"mimopilot": generator_version(), **entries, "gains": list(gains)}
    vary = entries.pop("vary", {})
    lines = [HEAD, *(f"{name} = {toml_value(value)}" for name, value in entries.items())]
    lines += ["", "[vary]", *(f"{name} = {toml_value(value)}" for name, value in vary.items())]
    files = {SPEC: "\n".join(lines) + "\n", AIRFRAME: vehicle.path.read_text()}
    return plan_from_files(files | {gains_file(name): gains_to_toml(one) for name, one in gains.items()})


def gains_file(name: str) -> str:
    """Where the gain set of a name lies in a campaign's folder."""
    return f"gains/{name}.gains.toml"


def plan_from_files(files: dict[str, str], where: str = "campaign") -> Plan:
    """The plan that a campaign's files describe.

    Raises
    ------
    SitlError
        When a file is missing or wrong; TuningError for a gains file.
    """
    try:
        description = Description.model_validate(tomllib.loads(files[SPEC]))
        airframe = airframe_from_toml(files[AIRFRAME], f"{where}/{AIRFRAME}")
        names = description.gains
        gains = {name: gains_from_toml(files[gains_file(name)], f"{where}/{gains_file(name)}") for name in names}
    except KeyError as error:
        raise SitlError(f"{where}: {error.args[0]} is missing") from error
    except tomllib.TOMLDecodeError as error:
        raise SitlError(f"{where}/{SPEC}: not a TOML file: {error}") from error
    except ValidationError as error:
        raise SitlError(f"{where}/{SPEC}: {complaint(error)}") from error
    periods = {one.Ts for one in gains.values()}
    if len(periods) > 1:
        raise SitlError(f"gains: the sets are for different control periods, {sorted(periods)} s; fly each by itself")
    d, (Ts,) = description, periods
    faults = tuple(map(parse_fault, d.faults))
    made = (make_scenario(d.manoeuvre, axis, d.amplitude_deg, d.period_s, Ts, d.tail_s) for axis in d.axes)
    scenarios = [replace(scenario, faults=faults) for scenario in made]
    return Plan(files, description, airframe, gains, scenarios)


def read_files(folder: Path) -> dict[str, str]:
    """Texts of the campaign in a folder, by name; empty when there is none."""
    if not (folder / SPEC).is_file():
        return {}
    spec = (folder / SPEC).read_text()
    try:
        names = [str(name) for name in tomllib.loads(spec).get("gains", ())]
    except tomllib.TOMLDecodeError:
        names = []
    others = [AIRFRAME, *map(gains_file, names)]
    return {SPEC: spec, **{name: (folder / name).read_text() for name in others if (folder / name).is_file()}}


def settle(plan: Plan, folder: Path) -> None:
    """Put the plan's files into a folder.

    Raises
    ------
    SitlError
        When the folder holds another campaign: names the first difference; or results of an unknown one.
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
        write_atomically(folder / name, text)


def _difference(there: dict[str, str], here: dict[str, str]) -> str:
    try:
        old, new = tomllib.loads(there[SPEC]), tomllib.loads(here[SPEC])
    except tomllib.TOMLDecodeError:
        return f"its {SPEC} is not TOML"
    for name in [*new, *old]:
        if old.get(name) != new.get(name):
            return f"{name}: {old.get(name)!r} there, {new.get(name)!r} here"
    names = [name for name in [*here, *there] if here.get(name) != there.get(name)]
    return f"{names[0]} differs"


@contextmanager
def reading(results: Path) -> Iterator[None]:
    """A table of results that is damaged is told in one line."""
    try:
        yield
    except pa.ArrowInvalid as error:
        raise SitlError(f"{results}: damaged; remove it and give the campaign's command again") from error
