"""A flight as the report needs it: what its log holds, its phases, its plant, and the gain sets around it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mimopilot.common.charts import INJECTED, IS_FLOWN, IS_NEW, IS_SISO, LIMIT, looks
from mimopilot.common.figures import MOST_SAMPLES, thinned
from mimopilot.sitl.field.report.analysis.further_signals import FurtherSignals, further_signals
from mimopilot.tuning.analysis.certify import reason_unknown
from mimopilot.tuning.design.cascade import certify_around
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.logs.columns import Columns
from mimopilot.tuning.logs.flight_phase import TUMBLE, bridged, intersection, intervals
from mimopilot.tuning.logs.flown_gains import flown_gains
from mimopilot.tuning.logs.inspection import Inspection, inspect_log
from mimopilot.tuning.logs.recording import Recording
from mimopilot.tuning.logs.resample import MAX_GAP, Interval, Series, sampling_period
from mimopilot.tuning.motors import END
from mimopilot.tuning.parameters import MATRICES
from mimopilot.tuning.plant.frequency_response import PlantResponse
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.plant.wide_response import WideResponse, wide_response
from mimopilot.tuning.spec import TuningSpec

#: Share of the largest torque from which on it is saturated.
AT_LIMIT = 0.999
#: Parameters of the control rate, Hz, and the period (s) if none is logged: that of this project's controllers.
RATES, USUAL_PERIOD = ("SCHED_LOOP_RATE", "IMU_GYRO_RATEMAX"), 0.004
#: Shortest time on the ground that is shown, s: one sample is none.
SHORTEST = 0.1
#: Relative error of a gain that a vehicle stores and logs in single precision.
STORED = 1e-5
#: Pauses in saturation or excitation that do not end a phase, s.
BRIDGE = 0.5

#: Phase -> its colour, from top to bottom of the timeline; of P. Tol's palette, apart from the colours of gain sets.
PHASES = {
    "ground": "#bbbbbb",
    "air": "#88CCEE",
    "excitation": INJECTED,
    "used": "#44AA99",
    "saturated": "#DDCC77",
    "crash": LIMIT,
    "gaps": "#1a1a1a",
}

Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ReportedFlight:
    """One log of a report.

    Attributes
    ----------
    label : str
        Name of the log in legends.
    found : Inspection
    further : FurtherSignals
    colour, dash : str
        Of its curves.
    samples : int
        Most samples of a line over its time.
    """

    label: str
    found: Inspection
    further: FurtherSignals
    colour: str
    dash: str
    samples: int = MOST_SAMPLES

    @property
    def recording(self) -> Recording:
        """The log as read."""
        return self.found.recording

    @cached_property
    def span(self) -> Interval:
        """First and last time of the log's signals, s."""
        series = [*self.recording.signals.values(), *(one for one in vars(self.further).values() if one is not None)]
        first, last = self.recording.span or (0.0, 0.0)
        begin = min((float(one.time[0]) for one in self.recording.signals.values()), default=first)
        end = max((float(one.time[-1]) for one in self.recording.signals.values()), default=last)
        if not self.recording.signals and series:
            begin, end = min(float(one.time[0]) for one in series), max(float(one.time[-1]) for one in series)
        return begin, end

    def signal(self, name: str) -> Series | None:
        """A signal with its time from the beginning of the log, s."""
        found = self.recording.signals.get(name)
        return None if found is None else self.since_begin(found)

    def since_begin(self, series: Series) -> Series:
        """A series with its time from the beginning of the log, s."""
        return Series(series.time - self.span[0], series.values, series.topic)

    def drawn(self, time: Signal, values: Signal, share: float = 1.0) -> tuple[Signal, Signal]:
        """A signal (N,) as a line of at most a share of `samples`, interrupted where the log has a gap."""
        if len(time) < 3:
            return time, values
        after = np.flatnonzero(np.diff(time) > MAX_GAP * sampling_period(time)) + 1
        x, y = np.insert(time, after, time[after]), np.insert(np.asarray(values, np.float64), after, np.nan)
        return thinned(x, y, int(share * self.samples))

    @cached_property
    def airborne(self) -> tuple[Interval, ...]:
        """When it flew, s from the beginning: as logged, else the used parts, else the whole log."""
        begin, end = self.span
        whole = ((0.0, end - begin),)
        if self.recording.airborne is not None:
            return intersection(tuple((a - begin, b - begin) for a, b in self.recording.airborne), whole)
        return self.found.parts or whole

    @cached_property
    def tumbles(self) -> tuple[Interval, ...]:
        """When it was tilted beyond what a multirotor flies at, s from the beginning."""
        angles = self.signal("y_o")
        if angles is None:
            return ()
        tilt = np.arccos(np.clip(np.cos(angles.values[:, 0]) * np.cos(angles.values[:, 1]), -1.0, 1.0))
        return bridged(intervals(angles.time, tilt > TUMBLE), BRIDGE)

    @cached_property
    def phases(self) -> dict[str, tuple[Interval, ...]]:
        """Phase -> when, s from the beginning; phases that did not occur or are not known are empty."""
        length = self.span[1] - self.span[0]
        logged = self.recording.airborne is not None
        edges = [0.0, *(edge for part in self.airborne for edge in part), length]
        pauses = zip(edges[::2], edges[1::2], strict=True)
        ground = tuple((a, b) for a, b in pauses if b - a >= SHORTEST) if logged else ()
        return {
            "ground": ground,
            "air": self.airborne if logged else (),
            "excitation": self._excited((self.recording.signals, self.recording.yaw)),
            "used": self._used(),
            "saturated": self._saturated(),
            "crash": self._crashed(),
            "gaps": self._gaps(),
        }

    def _crashed(self) -> tuple[Interval, ...]:
        """Tumbles in the air; one with which the log ends is shown as `SHORTEST`."""
        last = self.span[1] - self.span[0] - SHORTEST
        shown = self._inside(tuple((min(a, last), b) for a, b in self.tumbles))
        return intersection(shown, self.airborne) if self.recording.airborne is not None else shown

    def _used(self) -> tuple[Interval, ...]:
        """What gains are tuned from, those of yaw, too; nothing in a log that they cannot be tuned from."""
        if self.found.experiment is None or self.found.reason:
            return ()
        yaw = self._excited((self.recording.yaw,)) if self.yaw_response is not None else ()
        used = bridged(tuple(sorted((*self.found.parts, *intersection(yaw, self.airborne)))), BRIDGE)
        edges = [0.0, *(edge for gap in self._gaps() for edge in gap), self.span[1] - self.span[0]]
        return intersection(used, tuple(zip(edges[::2], edges[1::2], strict=True)))

    def _excited(self, sources: Sequence[Mapping[str, Series]]) -> tuple[Interval, ...]:
        parts: tuple[Interval, ...] = ()
        for signals in sources:
            for name in ("u_bar", "r_bar"):
                if name in signals:
                    series = self.since_begin(signals[name])
                    parts += intervals(series.time, np.any(series.values != 0, axis=1))
        return self._inside(bridged(tuple(sorted(parts)), BRIDGE))

    def _saturated(self) -> tuple[Interval, ...]:
        parts: tuple[Interval, ...] = ()
        torque, flown, motors = self.signal("u"), self.flown, self.further.motors
        if torque is not None and flown is not None:
            limit = np.array(flown.limits.moment_max[:2])
            parts += intervals(torque.time, np.any(np.abs(torque.values) >= AT_LIMIT * limit, axis=1))
        if motors is not None:
            motors = self.since_begin(motors)
            at_end = (motors.values >= 1 - END) | (motors.values <= END)
            parts += intervals(motors.time, np.any(at_end, axis=1))
        return intersection(self._inside(bridged(tuple(sorted(parts)), BRIDGE)), self.airborne)

    def _gaps(self) -> tuple[Interval, ...]:
        parts: list[Interval] = []
        for name in ("u", "y_i", "y_o"):
            series = self.signal(name)
            if series is not None and len(series.time) > 2:
                pauses, period = np.diff(series.time), sampling_period(series.time)
                parts += [
                    (float(series.time[k]), float(series.time[k + 1]))
                    for k in np.flatnonzero(pauses > MAX_GAP * period * 1.001)
                ]
        return bridged(tuple(sorted(parts)), 0.0)

    def _inside(self, parts: tuple[Interval, ...]) -> tuple[Interval, ...]:
        return intersection(parts, ((0.0, self.span[1] - self.span[0]),))

    @cached_property
    def measured(self) -> PlantEstimates | None:
        """Plant estimates; None if gains cannot be tuned from the log."""
        return PlantEstimates(self.found.experiment) if self.found.experiment and not self.found.reason else None

    @cached_property
    def yaw_response(self) -> PlantResponse | None:
        """Response of yaw; None where the log does not excite it."""
        try:
            return self.measured.yaw.response if self.measured else None
        except TuningError:
            return None

    @cached_property
    def wide(self) -> WideResponse | None:
        """The response continued to all frequencies; None if too few are known."""
        try:
            return wide_response(self.measured) if self.measured else None
        except TuningError:
            return None

    @cached_property
    def wide_yaw(self) -> WideResponse | None:
        """The same of yaw alone; None where the log does not excite it enough."""
        try:
            return wide_response(self.measured.yaw) if self.measured else None
        except TuningError:
            return None

    @property
    def why_not(self) -> str:
        """Why there is no frequency response; the whole reason is the page's conclusion."""
        return "gains cannot be tuned from the log, see the top" if self.found.reason else ""

    @cached_property
    def flown(self) -> Gains | None:
        """The gains that flew, also of a log that gains cannot be tuned from; None: not logged."""
        if self.found.flown is not None or not self.recording.parameters:
            return self.found.flown
        begin = self.span[0] + (self.airborne[0][0] if self.airborne else 0.0)
        parameters, _ = self.recording.parameters_during(begin, begin)
        hertz = next((parameters[name] for name in RATES if parameters.get(name, 0) > 0), 0.0)
        return flown_gains(parameters, parameters.get("MIMO_TS", 1 / hertz if hertz else 0.0) or USUAL_PERIOD)


@dataclass(frozen=True, eq=False)
class GainCase:
    """A gain set around the plant of a flight, with its certificate from that flight.

    Attributes
    ----------
    label : str
    colour, dash : str
    gains : Gains
        With the certificate, where it could be made.
    flight : ReportedFlight
    flown : bool
        Whether it flew in that flight.
    problem : str
        Why there is no certificate from the flight; empty: there is one.
    """

    label: str
    colour: str
    dash: str
    gains: Gains
    flight: ReportedFlight
    flown: bool
    problem: str = ""

    @property
    def look(self) -> dict[str, str]:
        """Label, colour and line style of its curves."""
        return {"label": self.label, "colour": self.colour, "dash": self.dash}

    @cached_property
    def unknown(self) -> str:
        """Why the flight does not show the whole loop of roll and pitch; empty: it does, or there is no certificate.

        Then the figures of the certificate are those of the known band alone: bounds, not margins.
        """
        if self.problem or self.flight.measured is None:
            return ""
        return reason_unknown(self.gains, self.flight.measured.response.at_period(self.gains.Ts))


def read_flights(logs: Sequence[Path], columns: Columns | None) -> list[ReportedFlight]:
    """The logs of a report; names that repeat get the name of their folder, or else a number.

    Raises
    ------
    TuningError
        When a file is no flight log, is damaged, or is given twice.
    """
    files = [path.resolve() for path in logs]
    twice = next((path for path, file in zip(logs, files, strict=True) if files.count(file) > 1), None)
    if twice is not None:
        raise TuningError(f"{twice}: given twice: a log compared with itself shows no difference; give it once")
    labels = _labels(files)
    flights = []
    for path, label, (colour, dash) in zip(logs, labels, looks(_kinds(len(logs))), strict=True):
        found = inspect_log(path, columns)
        samples = MOST_SAMPLES // len(logs)
        flights.append(ReportedFlight(label, found, further_signals(found.recording), colour, dash, samples))
    return flights


def _labels(files: Sequence[Path]) -> list[str]:
    """Names of logs, all different, as short as that allows."""
    names = [path.name for path in files]
    named = [str(Path(path.parent.name) / path.name) if names.count(path.name) > 1 else path.name for path in files]
    counts = [named[: place + 1].count(name) for place, name in enumerate(named)]
    return [f"{name} ({count})" if named.count(name) > 1 else name for name, count in zip(named, counts, strict=True)]


def _kinds(flights: int) -> list[str]:
    """What the flights are: the first one is that before, the others fly something new."""
    return [IS_FLOWN] + [IS_NEW] * (flights - 1)


def _alike(one: Gains, other: Gains) -> bool:
    """Whether two sets are the same one, of which a vehicle stores single precision."""
    return all(np.allclose(getattr(one, name), getattr(other, name), rtol=STORED) for name in MATRICES)


def gain_cases(
    flights: Sequence[ReportedFlight], sets: Sequence[tuple[str, Gains]], spec: TuningSpec
) -> list[GainCase]:
    """The flown gains of every flight, then given sets around the first flight that gains can be tuned from.

    Parameters
    ----------
    flights : sequence of ReportedFlight
    sets : sequence of (name, Gains)
    spec : TuningSpec
        Its margins are those that the certificates need.
    """
    cases = []
    for flight in flights:
        flown = flight.flown
        if flown is not None:
            label = "flown" if len(flights) == 1 else f"flown in {flight.label}"
            cases.append(GainCase(label, flight.colour, flight.dash, flown, flight, True))
    tunable = next((flight for flight in flights if flight.measured), flights[0])
    # A set that is none of a flight has no flight's colour; one set beside one flight is the new one.
    kinds = [gains.provenance.kind if gains.provenance.kind == IS_SISO else IS_NEW for _, gains in sets]
    free = looks([*_kinds(len(flights)), *kinds])[len(flights) :]
    for (name, gains), look in zip(sets, free, strict=True):
        same = next((case for case in cases if case.flown and _alike(case.gains, gains)), None)
        colour, dash = (same.colour, same.dash) if same else look
        cases.append(GainCase(name, colour, dash, gains, tunable, False))
    return [_examined(case, spec) for case in cases]


def _examined(case: GainCase, spec: TuningSpec) -> GainCase:
    if case.flight.measured is None:
        return replace(case, problem=case.flight.why_not)
    try:
        return replace(case, gains=certify_around(case.flight.measured, case.gains, spec))
    except TuningError as error:
        return replace(case, problem=str(error))
