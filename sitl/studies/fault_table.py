"""The fault table: every standard fault with many seeds, several gain sets side by side."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from mimopilot.codegen.native import NativeController, NativeLibrary, load_native
from mimopilot.common.console import progress_console
from mimopilot.common.intervals import wilson
from mimopilot.common.parallel import processes, run_all
from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.faults.kinds import Fault
from mimopilot.sitl.flight.fault_recovery import Recovery, recovery
from mimopilot.sitl.flight.scenario import Scenario, make_scenario
from mimopilot.sitl.flight.simulator import Flight, fly
from mimopilot.sitl.physics.airframe import Airframe, load_airframe
from mimopilot.sitl.studies.standard_faults import standard_faults

TAIL_S = 5.0  # s of level flight after the manoeuvre: long enough to lose an unstable vehicle in the flight


@dataclass(frozen=True)
class FaultTableRequest:
    """What to fly: the complete input of a worker process.

    Attributes
    ----------
    airframe : str
        Name or path.
    gains : tuple of Path
        See `sitl.physics.airframe.AirframeFile.gain_sets`.
    axis : str
    amplitude_deg, period_s : float
        Amplitude (deg) and length (s) of the doublet.
    faults : tuple of Fault
        Flown one at a time; empty: `standard_faults`.
    """

    airframe: str
    gains: tuple[Path, ...]
    axis: str
    amplitude_deg: float
    period_s: float
    faults: tuple[Fault, ...] = ()


@dataclass(frozen=True)
class FaultTableRow:
    """One fault with one gain set over all seeds; medians unless stated otherwise.

    Attributes
    ----------
    fault, gains : str
    runs, survived : int
    survival_interval : (low, high)
        Wilson's, 95 %.
    peak_deg, worst_peak_deg, rms_deg : float, deg
        Deviation from the flight without faults, see `sitl.flight.fault_recovery.Recovery`; the worst peak is
        that of `worst_seed`.
    recovered : int
        Number of flights that recovered.
    recovery_s : float or None, s
        Of these.
    saturated : float
        Samples with saturation since the fault.
    detected : int
        Number of flights in which the fault was detected.
    detected_s : float or None, s
        Of these.
    detected_by : str
        Detectors, separated by commas.
    nonfinite : int
        Non-finite outputs of all seeds together.
    worst_seed : int
        Seed of the first lost flight, else of the largest peak.
    replay : str
        Command that repeats the worst flight.
    """

    fault: str
    gains: str
    runs: int
    survived: int
    survival_interval: tuple[float, float]
    peak_deg: float
    worst_peak_deg: float
    rms_deg: float
    recovered: int
    recovery_s: float | None
    saturated: float
    detected: int
    detected_s: float | None
    detected_by: str
    nonfinite: int
    worst_seed: int
    replay: str


@dataclass(frozen=True)
class FaultTable:
    """The result: one row per fault and gain set.

    Attributes
    ----------
    title : str
    rows : tuple of FaultTableRow
        By fault, then by gain set.
    lost_without, alarms_without : dict of int
        Gain set -> number of lost flights, and of false alarms, among the flights without faults.
    """

    title: str
    rows: tuple[FaultTableRow, ...]
    lost_without: dict[str, int]
    alarms_without: dict[str, int]

    def as_json(self) -> dict[str, Any]:
        """The object that ``--json`` prints."""
        return asdict(self)

    @property
    def nonfinite(self) -> int:
        """Number of non-finite outputs in all flights."""
        return sum(row.nonfinite for row in self.rows)


class FaultFlights:
    """Flies a vehicle with its gain sets and faults; made once per process."""

    def __init__(self, request: FaultTableRequest) -> None:
        vehicle = load_airframe(request.airframe)
        self.airframe: Airframe = vehicle.airframe
        self.gains = vehicle.gain_sets(request.gains)
        self.libraries: dict[str, NativeLibrary] = {name: load_native(gains) for name, gains in self.gains.items()}
        self.tasks: dict[str, Scenario] = {
            name: make_scenario("doublet", request.axis, request.amplitude_deg, request.period_s, gains.Ts, TAIL_S)
            for name, gains in self.gains.items()
        }
        self.faults = request.faults or standard_faults(self.airframe)

    def fly(self, name: str, faults: tuple[Fault, ...], seed: int) -> Flight:
        """One flight with a gain set."""
        gains = self.gains[name]
        autopilot = Autopilot(self.airframe, gains, NativeController(self.libraries[name], gains))
        return fly(self.airframe, autopilot, replace(self.tasks[name], faults=faults), seed)

    def fly_all(self, seed: int) -> dict[str, list[Recovery]]:
        """Gain set -> recovery in the flight without faults, then in one flight per fault."""
        found = {}
        for name in self.gains:
            sound = self.fly(name, (), seed)
            found[name] = [recovery(sound, sound)]
            found[name] += [recovery(self.fly(name, (fault,), seed), sound) for fault in self.faults]
        return found


@lru_cache(maxsize=1)
def _flights_of(request: FaultTableRequest) -> FaultFlights:
    return FaultFlights(request)


def _fly_all(request: FaultTableRequest, seed: int) -> dict[str, list[Recovery]]:
    return _flights_of(request).fly_all(seed)


def fault_table(request: FaultTableRequest, seeds: Sequence[int], workers: int) -> FaultTable:
    """Fly every fault with every seed and gain set.

    Parameters
    ----------
    request : FaultTableRequest
        Vehicle, gain sets, manoeuvre and faults.
    seeds : sequence of int
        Seeds of the measurement noise and of random faults.
    workers : int
        Number of processes; it does not change the table.

    Raises
    ------
    SitlError
        When a file, an option or a fault is wrong.
    """
    from rich.progress import Progress

    flown_by = _flights_of(request)
    # The first seed compiles and finds wrong input before processes are started.
    found: dict[int, dict[str, list[Recovery]]] = {seeds[0]: flown_by.fly_all(seeds[0])}
    with Progress(console=progress_console(), transient=True) as bar:
        task = bar.add_task("flying", total=len(seeds), completed=1)

        def keep(seed: int, flights: dict[str, list[Recovery]]) -> None:
            found[seed] = flights
            bar.advance(task)

        if workers == 1:
            for seed in seeds[1:]:
                keep(seed, flown_by.fly_all(seed))
        else:
            with processes(workers) as executor:
                run_all(executor, 2 * workers, partial(_fly_all, request), seeds[1:], keep)
    flown = {name: [found[seed][name] for seed in seeds] for name in flown_by.gains}
    paths = dict(zip(flown_by.gains, request.gains or (None,), strict=True))
    rows = tuple(
        _row(request, fault, name, paths[name], seeds, [flights[i + 1] for flights in flown[name]])
        for i, fault in enumerate(flown_by.faults)
        for name in flown_by.gains
    )
    doublet = f"doublet on {request.axis}, {request.amplitude_deg:g} deg, {request.period_s:g} s"
    title = f"{flown_by.airframe.name}, {doublet}"
    return FaultTable(
        f"{title}, {len(seeds)} seeds from {seeds[0]}",
        rows,
        {name: sum(flights[0].lost_at_s is not None for flights in flown[name]) for name in flown_by.gains},
        {name: sum(flights[0].detected_s is not None for flights in flown[name]) for name in flown_by.gains},
    )


def _row(
    request: FaultTableRequest, fault: Fault, name: str, path: Path | None, seeds: Sequence[int], found: list[Recovery]
) -> FaultTableRow:
    survived = sum(one.lost_at_s is None for one in found)
    worst = max(range(len(found)), key=lambda i: _badness(found[i]))
    return FaultTableRow(
        fault=str(fault),
        gains=name,
        runs=len(found),
        survived=survived,
        survival_interval=wilson(survived, len(found)),
        peak_deg=float(np.median([one.deviation_peak_deg for one in found])),
        worst_peak_deg=found[worst].deviation_peak_deg,
        rms_deg=float(np.median([one.deviation_rms_deg for one in found])),
        recovered=sum(one.recovery_s is not None for one in found),
        recovery_s=_median([one.recovery_s for one in found]),
        saturated=float(np.median([one.saturated_since for one in found])),
        detected=sum(one.detected_s is not None for one in found),
        detected_s=_median([one.detected_s for one in found]),
        detected_by=", ".join(sorted({one.detected_by for one in found} - {""})),
        nonfinite=sum(one.nonfinite for one in found),
        worst_seed=seeds[worst],
        replay=_replay(request, fault, path, seeds[worst]),
    )


def _badness(one: Recovery) -> tuple[float, float]:
    """Sort key: earlier loss is worse, then a larger peak."""
    return -np.inf if one.lost_at_s is None else -one.lost_at_s, one.deviation_peak_deg


def _median(values: list[float | None]) -> float | None:
    there = [value for value in values if value is not None]
    return float(np.median(there)) if there else None


def _replay(request: FaultTableRequest, fault: Fault, path: Path | None, seed: int) -> str:
    """The command that repeats one flight of the table."""
    words = ["mimopilot", "fly", request.airframe, *(() if path is None else ("--gains", str(path)))]
    words += ["--axis", request.axis, "--amplitude-deg", repr(request.amplitude_deg)]
    words += ["--period-s", repr(request.period_s), "--tail-s", repr(TAIL_S)]
    words += ["--fault", str(fault), "--seed", str(seed)]
    return shlex.join(words)
