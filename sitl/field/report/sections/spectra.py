"""Spectra of gyro, torque and motors in the air, the vibration tones in them, and the filters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mimopilot.common.charts import AXIS_COLOURS
from mimopilot.common.figures import Chart, HeatMap, LimitLine, Line, Panel
from mimopilot.common.html_report import ReportTable, Section
from mimopilot.sitl.field.report.analysis.filters_advice import (
    NOISE_FROM,
    FilterChange,
    filter_changes,
    least_phase,
    of_both_axes,
)
from mimopilot.sitl.field.report.analysis.flight_data import GainCase, ReportedFlight
from mimopilot.sitl.field.report.analysis.loop_filters import LoopFilter, filters_of, moving_filters
from mimopilot.sitl.field.report.analysis.vibration import (
    AirSpectrum,
    Tone,
    air_spectrum,
    coarse,
    find_tones,
    over_thrust,
    spectrogram,
)
from mimopilot.sitl.field.report.sections.stability import crossover, loops_of
from mimopilot.sitl.field.report.sections.steps import usable
from mimopilot.tuning.certificate import Thresholds
from mimopilot.tuning.logs.resample import Series

AXIS_NAMES = ("roll", "pitch", "yaw")
#: Power of an axis over that of the loudest one below which it is not logged: a column of zeros.
QUIETEST = 1e-12
#: Of the mean of all motors: as in the timeline.
MOTORS = "#555555"
#: Hz. A signal logged more slowly says nothing about vibration.
SLOW = 50.0


@dataclass(frozen=True, eq=False)
class FlightSpectra:
    """Spectra of one flight; None: not logged, or too slowly. `own_torque` is without the injected part."""

    flight: ReportedFlight
    gyro: AirSpectrum | None
    torque: AirSpectrum | None
    own_torque: AirSpectrum | None
    motors: AirSpectrum | None
    slices: tuple[np.ndarray, np.ndarray, np.ndarray] | None  # type: ignore[type-arg]
    thrust: np.ndarray | None  # type: ignore[type-arg]
    tones: list[Tone]


def flight_spectra(flight: ReportedFlight) -> FlightSpectra:
    """All spectra of a flight in the air, before it tumbled."""
    parts = usable(flight)

    def spectrum(series: Series | None) -> AirSpectrum | None:
        return None if series is None else air_spectrum(series, parts)

    gyro = flight.since_begin(flight.further.gyro) if flight.further.gyro is not None else flight.signal("y_i")
    slices = spectrogram(gyro, parts) if gyro is not None else None
    thrust = None
    if slices is not None and flight.further.thrust is not None:
        logged = flight.since_begin(flight.further.thrust)
        thrust = np.interp(slices[0], logged.time, logged.values[:, 0])
    of_gyro = spectrum(gyro)
    motors = flight.since_begin(flight.further.motors) if flight.further.motors is not None else None
    tones = find_tones(of_gyro, slices, thrust) if of_gyro is not None and of_gyro.rate >= SLOW else []
    torque = flight.signal("u")
    return FlightSpectra(
        flight,
        of_gyro,
        spectrum(torque),
        spectrum(_without_excitation(flight)),
        spectrum(motors),
        slices,
        thrust,
        tones,
    )


def _without_excitation(flight: ReportedFlight) -> Series | None:
    """The torque of the controller alone: without what was injected."""
    torque, injected = flight.signal("u"), flight.signal("u_bar")
    if torque is None or injected is None:
        return torque
    last = np.searchsorted(injected.time, torque.time + 1e-6, side="right") - 1
    part = np.where((last >= 0)[:, None], injected.values[np.maximum(last, 0)], 0.0)
    return Series(torque.time, torque.values - part, torque.topic)


def spectra_section(found: Sequence[FlightSpectra]) -> Section:
    """Spectra and spectrograms of all flights, and the tones by name."""
    charts: list[Chart] = []
    points: list[str] = []
    for number, one in enumerate(found):
        label = f"{one.flight.label}: " if len(found) > 1 else ""
        panels = _panels(one)
        if panels:
            text = f"{label}Power spectral density in the air. Dotted: the tones that stand out of their surroundings."
            charts.append(Chart(f"spectra-{number + 1}", text, panels, columns=len(panels)))
        maps = _maps(one)
        if maps:
            text = (
                f"{label}The gyro's spectrum over time and over thrust: propellers move with the thrust, a frame does "
                "not."
            )
            charts.append(Chart(f"spectrogram-{number + 1}", text, maps, columns=len(maps), linked=False))
        points += [label + point for point in _in_words(one)]
    text = "" if charts else "Not shown: no gyro, torque or motor command is logged fast and long enough in the air."
    return Section("Spectra and vibration", text, charts=charts, points=points)


def filter_section(found: Sequence[FlightSpectra], cases: Sequence[GainCase], thresholds: Thresholds) -> Section:
    """Delay of each filter, and what other filters would cost or give by the certificate."""
    heading = "Filters"
    first = next((one for one in found if one.flight.measured is not None), found[0])
    mine = [case for case in cases if case.flight is first.flight and not case.problem]
    case = mine[-1] if mine else None
    filters = filters_of(first.flight.recording.parameters, case.gains if case else first.flight.flown)
    if not filters:
        return Section(heading, "The log names no filter of the rates: it holds no parameters, or they are all off.")
    loops = loops_of(case) if case else None
    at = max((crossover(loop, loops.omega) for loop in loops.axis_loops), default=0.0) if loops else 0.0
    rows = [_filter_row(one, at) for one in filters]
    columns = ["filter", "acts on", "kind", "set to", "delay of slow signals"]
    columns += [f"phase at the crossover ({at:.0f} rad/s)"] if at else []
    tables = [ReportTable("Filters in the path of the rates", columns, rows)]
    total = sum(one.delay() for one in filters if one.acts_on != "derivative term")
    points = moving_filters(first.flight.recording.parameters)
    points += [f"All filters of the rates together delay slow signals by {1e3 * total:.1f} ms."] if total else []
    examined = of_both_axes(case, thresholds) if case and loops else None
    if examined is None:
        why = case.unknown if case and case.unknown else "no gains have a certificate of this flight"
        points.append(f"What a change of a filter costs or gives is not said: {why}.")
        return Section(heading, "", tables=tables, points=points)
    changes = filter_changes(examined, filters, first.tones, first.own_torque, thresholds)
    tables.append(_change_table(changes, examined))
    points += advice(changes, first)
    text = (
        "A change of a filter is examined by the certificate of the same gains behind it, of roll and pitch without "
        "yaw. Advice needs all three: a tone in the gyro, the torque that it causes, and the margin left."
    )
    return Section(heading, text, tables=tables, points=points)


def advice(changes: Sequence[FilterChange], spectra: FlightSpectra) -> list[str]:
    """What to do with the filters, in plain words."""
    told = []
    for change in changes:
        if change.advised:
            verb = "gives" if change.margin_deg >= 0 else "costs"
            told.append(
                f"Advised: {change.text}: {change.why}; it {verb} {abs(change.margin_deg):.1f} degrees of phase margin "
                f"({change.certificate.verdict}, Ms {change.certificate.figures.get('Ms', float('nan')):.2f})."
            )
    if not told:
        told.append("Leave the filters as they are: no change is worth its cost in margin or noise.")
    if spectra.gyro is not None:
        told.append(
            f"The gyro is logged at {spectra.gyro.rate:.0f} Hz: vibration above {spectra.gyro.rate / 2:.0f} Hz is not "
            "visible here, or appears folded to a lower frequency."
        )
    return told


def _filter_row(one: LoopFilter, at: float) -> list[str]:
    row = [one.name, one.acts_on, one.kind, one.setting, f"{1e3 * one.delay():.2f} ms"]
    return [*row, f"{one.lag_deg(at):.1f} deg"] if at else row


def _change_table(changes: Sequence[FilterChange], case: GainCase) -> ReportTable:
    before = case.gains.certificate
    rows = [
        [
            "as it is",
            str(before.verdict) if before else "",
            f"{before.figures['Ms']:.2f}" if before else "",
            f"{least_phase(before):.1f}",
            "",
            "1",
            "",
        ]
    ]
    for change in changes:
        figures = change.certificate.figures if np.isfinite(change.margin_deg) else {}
        rows.append(
            [
                change.text,
                str(change.certificate.verdict),
                f"{figures['Ms']:.2f}" if figures else "-",
                f"{least_phase(change.certificate):.1f}" if figures else "-",
                f"{change.margin_deg:+.1f}" if figures else "-",
                f"{change.noise:.2f}" if change.noise == change.noise else "-",
                f"{'yes: ' if change.advised else 'no: '}{change.why}",
            ]
        )
    columns = (
        "change",
        "certificate",
        "Ms",
        "phase margin [deg]",
        "change [deg]",
        f"torque above {NOISE_FROM:g} Hz, times",
        "advised",
    )
    return ReportTable(f"Other filters under the gains '{case.label}'", columns, rows)


def _panels(one: FlightSpectra) -> list[Panel]:
    panels = []
    tones = [LimitLine(tone.hertz, f"{tone.hertz:.1f} Hz", "#555555", upright=True, dash=":") for tone in one.tones]
    for title, unit, found, factor in (
        ("gyro", "[(deg/s)^2/Hz]", one.gyro, (180 / np.pi) ** 2),
        ("torque", "[1/Hz]", one.torque, 1.0),
        ("motor commands", "[1/Hz]", one.motors, 1.0),
    ):
        if found is None:
            continue
        lines = []
        if title == "motor commands":
            lines.append(Line(found.hertz, _floored(found.density.mean(axis=1)), "mean of all", MOTORS, width=1.2))
        else:
            for axis in np.flatnonzero(found.density.max(axis=0) > QUIETEST * found.density.max()):
                density = _floored(factor * found.density[:, axis])
                lines.append(Line(found.hertz, density, AXIS_NAMES[axis], AXIS_COLOURS[axis], width=1.2))
        span = (max(float(found.hertz[0]), 0.5), float(found.hertz[-1]))
        marks = [mark for mark in tones if mark.at < span[1]]
        panels.append(
            Panel(title, "frequency [Hz]", unit, lines, marks, log_x=True, log_y=True, x_range=span, height=280)
        )
    return panels


def _floored(density: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
    """A density without zeros, which a logarithm does not show."""
    return np.asarray(np.maximum(density, 1e-12 * max(float(density.max()), 1e-30)))


def _maps(one: FlightSpectra) -> list[Panel]:
    if one.slices is None or one.gyro is None or one.gyro.rate < SLOW:
        return []
    time, hertz, density = one.slices
    to_db = (180 / np.pi) ** 2
    label = "dB of (deg/s)^2/Hz"
    t, f, cut = coarse(time, hertz, density)
    floor = 1e-9 * float(cut.max()) + 1e-30
    panels = [Panel("over time", "time [s]", "[Hz]", [HeatMap(t, f, _decibels(cut * to_db, floor), label)], height=300)]
    if one.thrust is not None and (binned := over_thrust(density, one.thrust)) is not None:
        thrust, mean = binned
        _, f, cut = coarse(thrust, hertz, mean)
        heat = HeatMap(thrust, f, _decibels(cut * to_db, floor), label)
        panels.append(Panel("over thrust", "thrust (share of the largest)", "[Hz]", [heat], height=300))
    return panels


def _decibels(power: np.ndarray, floor: float) -> np.ndarray:  # type: ignore[type-arg]
    return np.asarray(10 * np.log10(np.maximum(power, floor)))


def _in_words(one: FlightSpectra) -> list[str]:
    """The tones, named."""
    if one.gyro is None:
        return ["No spectrum of the gyro: the rates are not logged, not fast enough, or not long enough in the air."]
    if one.gyro.rate < SLOW:
        return [f"The rates are logged at {one.gyro.rate:.0f} Hz: too slow to show vibration."]
    if not one.tones:
        return [f"No vibration tone stands out up to {one.gyro.rate / 2:.0f} Hz."]
    told = []
    for tone in one.tones:
        harmonic = ""
        if tone.harmonic_of:
            harmonic = f", {round(tone.hertz / tone.harmonic_of)} times {tone.harmonic_of:.1f} Hz"
        moves = {
            True: ", moves with the thrust: motors or propellers",
            False: ", stays while the thrust changes: a mode of the frame, or a resonance",
            None: "",
        }[tone.follows_thrust]
        loud = f"{tone.above_db:.0f} dB above its surroundings, strongest on {AXIS_NAMES[tone.axis]}"
        told.append(f"Vibration at {tone.hertz:.1f} Hz{harmonic}: {loud}{moves}.")
    return told
