"""Stability of each gain set around the measured vehicle: Nyquist, sensitivity, margins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.common.charts import LIMIT
from mimopilot.common.figures import Chart, LimitLine, Line, Panel, SpanMark, Spread
from mimopilot.common.html_report import ReportTable, Section
from mimopilot.common.text_table import plus_minus
from mimopilot.sitl.field.report.analysis.flight_data import GainCase
from mimopilot.sitl.field.report.sections.frequency import yaw_band
from mimopilot.tuning.analysis import margins
from mimopilot.tuning.analysis.closed_loop import CascadeLoop
from mimopilot.tuning.analysis.stability_figures import nominal_and_drawn_loops
from mimopilot.tuning.axes import law_of
from mimopilot.tuning.certificate import Thresholds
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.logs.inspection import AXES
from mimopilot.tuning.plant.frequency_response import MIN_FREQUENCIES, PlantResponse
from mimopilot.tuning.plant.rigid_body_fit import continued_below, rigid_body
from mimopilot.tuning.small_matrices import singular_values

HEADING = "Stability and margins"
#: Half width of a Nyquist plot: the critical point and the unit circle, with some room.
NYQUIST = 3.0
#: Loops of drawn plants that are shown in the determinant's plot, of all sets together.
SHOWN_DRAWS = 8
#: Instead of a margin, for a loop whose gain is never 1.
NEVER = "no crossover"
#: Of a margin that the flight does not show.
UNKNOWN = "not known"
#: Points of a circle.
CIRCLE = 181

Signal = NDArray[np.float64]
Complex = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class CaseLoops:
    """The loop of a gain set on a dense grid, and those of drawn plants."""

    case: GainCase
    omega: Signal
    nominal: CascadeLoop
    draws: list[CascadeLoop]

    @property
    def axis_loops(self) -> Complex:
        """The loop of each axis with the other one closed, (2, K)."""
        return margins.axis_loops(margins.sensitivity(self.nominal))


def loops_of(case: GainCase) -> CaseLoops | None:
    """The loops that the certificate's figures are made of; None without a certificate of the flight."""
    if case.problem or case.flight.measured is None or not (case.gains.certificate and case.gains.certificate.figures):
        return None
    return _loops(case, case.flight.measured.response)


def yaw_loops_of(case: GainCase) -> CaseLoops | None:
    """The loop of yaw alone; None if the flight does not show it."""
    response = case.flight.yaw_response
    if response is None or case.problem or not (case.gains.certificate and "yaw" in case.gains.certificate.figures):
        return None
    try:
        return _loops(case, response)
    except TuningError:
        return None


def _loops(case: GainCase, response: PlantResponse) -> CaseLoops | None:
    plant = response.at_period(case.gains.Ts)
    known = plant.at(plant.known_run())
    if len(known.omega) < MIN_FREQUENCIES:
        return None
    law = law_of(case.gains, plant.axes)
    dense, nominal, draws = nominal_and_drawn_loops(law, continued_below(known, rigid_body(plant)))
    return CaseLoops(case, dense.omega, nominal, draws)


def crossover(loop: Complex, omega: Signal) -> float:
    """Highest frequency (rad/s) at which a loop's gain falls through 1; 0: it never does."""
    falling = np.flatnonzero((np.abs(loop[:-1]) >= 1) & (np.abs(loop[1:]) < 1))
    return float(omega[falling[-1]]) if len(falling) else 0.0


def stability_section(cases: Sequence[GainCase], thresholds: Thresholds) -> Section:
    """Figures and margins of all gain sets on the same axes."""
    reasons = [f"{case.label}: no certificate: {case.problem}." for case in cases if case.problem]
    reasons += [
        f"{case.label}: {case.gains.certificate.verdict}: {case.gains.certificate.reason}."
        for case in cases
        if not case.problem and case.gains.certificate and not case.gains.certificate.figures
    ]
    reasons += [
        f"{case.label}: yaw is {yaw['verdict']}: {yaw['reason']}."
        for case in cases
        if not case.problem and (yaw := _yaw_of(case)) and "Ms" not in yaw
    ]
    found = [loops for case in cases if (loops := loops_of(case))]
    if not found:
        text = "Not shown: " + ("no gains are known: give them with --gains." if not cases else "see below.")
        return Section(HEADING, text, points=reasons)
    charts = [
        Chart("sensitivity", _SENSITIVITY, [_sensitivity(found, thresholds, _band(found)), _bode(found)], linked=True),
        Chart(
            "nyquist",
            _NYQUIST,
            [*(_nyquist(found, axis, thresholds, f"{AXES[axis]} loop") for axis in range(2)), _determinant(found)],
            columns=3,
            linked=False,
        ),
    ]
    yaws = [loops for case in cases if (loops := yaw_loops_of(case))]
    if yaws:
        known = yaw_band([loops.case for loops in yaws])
        band = [SpanMark(*known)] if known else []
        panels = [_sensitivity(yaws, thresholds, band), _nyquist(yaws, 0, thresholds, "yaw loop")]
        charts.append(Chart("stability-yaw", "Sensitivity and loop of yaw.", panels, linked=False))
    if any(_counts_yaw(loops.case) for loops in found):
        reasons.append(
            "The curves of roll and pitch are those of both axes alone; the margins in the table also count their "
            "coupling to yaw, so they may be thinner."
        )
    reasons += [
        f"{loops.case.label}: the table holds bounds only: {loops.case.unknown}."
        for loops in found
        if loops.case.unknown
    ]
    return Section(HEADING, charts=charts, tables=[margin_table([one.case for one in found])], points=reasons)


_SENSITIVITY = (
    "Sensitivity: its largest singular value, cut at both torques; the peak is Ms. Below 1 the loop rejects "
    "disturbances, above 1 it amplifies them. Bands: two standard deviations. Loop gain: of each axis with the other "
    "one closed (solid: roll, dashed: pitch); dots and numbers: crossover and phase margin."
)
_NYQUIST = (
    "The loop of each axis with the other one closed: its distance from -1 is the margin. It must stay out of the "
    "circle about -1, whose radius is 1 over the limit of Ms. Dots: where its gain is 1 (phase margin); squares: where "
    "its phase is -180 degrees (gain margin). Last: the determinant det(I + L) - 1 of both axes at once, whose "
    "encirclements of -1 decide stability; thin: plants within the log's error."
)


def margin_table(cases: Sequence[GainCase]) -> ReportTable:
    """Margins as the certificates state them."""
    rows: list[list[str]] = []
    shown = [(case, case.gains.certificate) for case in cases if case.gains.certificate is not None]
    rows.append(["verdict", *(str(certificate.verdict) for _, certificate in shown)])
    rows.append(["Ms", *(_peak(case, certificate.figures) for case, certificate in shown)])
    for axis in AXES:
        rows.append([f"phase margin, {axis}", *(_phase_margin(case, c.figures, axis) for case, c in shown)])
    for axis in AXES:
        rows.append([f"gain margin, {axis}", *(_gain_margin(c.figures, axis) for _, c in shown)])
    for axis in AXES:
        rows.append([f"delay margin, {axis}", *(_delay_margin(case, c.figures, axis) for case, c in shown)])
    rows += _yaw_rows([c.figures.get("yaw", {}) for _, c in shown])
    rows.append(["disk margin", *(_at_most(case, f"{c.figures['disk_margin']:.2f}") for case, c in shown)])
    at_once = "{simultaneous_gain_db:.1f} dB, {simultaneous_phase_deg:.0f} deg"
    rows.append(["all axes at once", *(_at_most(case, at_once.format(**c.figures)) for case, c in shown)])
    rows.append(["known band", *(f"{c.band[0]:.1f} to {c.band[1]:.0f} rad/s" for _, c in shown)])
    return ReportTable("Margins by the certificate", ("", *(case.label for case, _ in shown)), rows)


def _counts_yaw(case: GainCase) -> bool:
    """Whether the certificate's margins are those of all three axes."""
    return bool(case.gains.certificate and case.gains.certificate.figures.get("cross_terms", {}).get("matters"))


def _yaw_of(case: GainCase) -> Mapping[str, Any]:
    """The certificate's figures of yaw; empty: it has none."""
    found: Mapping[str, Any] = case.gains.certificate.figures.get("yaw", {}) if case.gains.certificate else {}
    return found


def _yaw_rows(yaws: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Rows of yaw; none where no set's yaw was examined."""
    if not any("Ms" in yaw for yaw in yaws):
        return []

    def row(name: str, value: str, error: str, unit: str) -> list[str]:
        known = (
            plus_minus(yaw[value], yaw.get(error, np.nan), unit) if "Ms" in yaw else "not examined" for yaw in yaws
        )
        return [name, *known]

    return [
        row("Ms, yaw", "Ms", "Ms_error", ""),
        row("phase margin, yaw", "phase_margin_deg", "phase_margin_error_deg", " deg"),
        row("delay margin, yaw", "delay_margin_ms", "", " ms"),
    ]


def _peak(case: GainCase, figures: Mapping[str, Any]) -> str:
    """Ms; of a loop that is known in part, that of the part."""
    return f"{'at least ' if case.unknown else ''}{plus_minus(figures['Ms'], figures['Ms_error'])}"


def _at_most(case: GainCase, text: str) -> str:
    return f"at most {text}" if case.unknown else text


def _phase_margin(case: GainCase, figures: Mapping[str, Any], axis: str) -> str:
    if case.unknown:
        return UNKNOWN
    phase, error = (figures[name][axis] for name in ("phase_margin_deg", "phase_margin_error_deg"))
    return plus_minus(phase, error, " deg") if np.isfinite(phase) else NEVER


def _delay_margin(case: GainCase, figures: Mapping[str, Any], axis: str) -> str:
    if case.unknown:
        return UNKNOWN
    delay = figures["delay_margin_ms"][axis]
    return f"{delay:.1f} ms" if np.isfinite(delay) else NEVER


def _gain_margin(figures: Mapping[str, Any], axis: str) -> str:
    kind = figures["gain_margin"][axis]
    if kind == "not known":
        return UNKNOWN
    return f"{'at least ' if kind == 'at least' else ''}{figures['gain_margin_db'][axis]:.1f} dB"


def _sensitivity(found: Sequence[CaseLoops], thresholds: Thresholds, band: Sequence[SpanMark]) -> Panel:
    lines: list[Line | Spread] = []
    highest = thresholds.thin_Ms
    for loops in found:
        value = _peaks(loops.nominal)
        spread = 2 * np.std([_peaks(draw) for draw in loops.draws], axis=0)
        lines.append(Spread(loops.omega, np.maximum(value - spread, 0.02), value + spread, colour=loops.case.colour))
        lines.append(Line(loops.omega, value, width=2.0, **loops.case.look))  # type: ignore[arg-type]
        highest = max(highest, float(value.max()))
    marks: list[LimitLine | SpanMark] = [
        LimitLine(thresholds.Ms, f"certified: at most {thresholds.Ms:g}"),
        LimitLine(thresholds.thin_Ms, f"thin: at most {thresholds.thin_Ms:g}", dash=":"),
        *band,
    ]
    low = min(float(loops.omega[0]) for loops in found)
    top = max(float(loops.omega[-1]) for loops in found)
    return Panel(
        "Sensitivity",
        f"frequency [rad/s]{'; shaded: known' if band else ''}",
        "largest singular value",
        lines,
        marks,
        log_x=True,
        x_range=(low, top),
        y_range=(0.0, min(1.15 * highest, 6.0)),
        height=320,
    )


def _peaks(loop: CascadeLoop) -> Signal:
    return np.asarray(1 / np.maximum(singular_values(np.eye(loop.L_u.shape[-1]) + loop.L_u)[1], 1e-6))


def _band(found: Sequence[CaseLoops]) -> list[SpanMark]:
    certificate = found[0].case.gains.certificate
    return [SpanMark(*certificate.band)] if certificate else []


def _bode(found: Sequence[CaseLoops]) -> Panel:
    lines: list[Line | Spread] = []
    marks: list[LimitLine | SpanMark] = [LimitLine(1.0, colour="#888888"), *_band(found)]
    for loops in found:
        case, phases = loops.case, [margins.phase_margin(loop, loops.omega)[0] for loop in loops.axis_loops]
        told = ", ".join(f"{axis} {deg:.0f} deg" for axis, deg in zip(AXES, phases, strict=True) if np.isfinite(deg))
        # One entry of the legend for both axes: ten of them would leave no room for the curves.
        labels = (f"{case.label}: {told}" if told else case.label, "")
        for axis, loop in enumerate(loops.axis_loops):
            lines.append(Line(loops.omega, np.abs(loop), labels[axis], case.colour, ("-", "--")[axis]))
            if (at := crossover(loop, loops.omega)) > 0:
                text = [f"{case.label}, {AXES[axis]}: phase margin {phases[axis]:.0f} deg at {at:.0f} rad/s"]
                dot = np.array([at]), np.array([1.0])
                lines.append(Line(*dot, colour=case.colour, width=0, marker="o", text=text))
    return Panel(
        "Loop gain and crossover",
        "frequency [rad/s]; shaded: known",
        "gain",
        lines,
        marks,
        log_x=True,
        log_y=True,
        y_range=(0.02, 50.0),
        height=320,
    )


def _nyquist(found: Sequence[CaseLoops], axis: int, thresholds: Thresholds, name: str) -> Panel:
    turn = np.linspace(0, 2 * np.pi, CIRCLE)
    lines: list[Line | Spread] = [
        Line(np.cos(turn), np.sin(turn), colour="#aaaaaa", width=0.8),
        Line(
            -1 + np.cos(turn) / thresholds.Ms,
            np.sin(turn) / thresholds.Ms,
            f"Ms = {thresholds.Ms:g}",
            LIMIT,
            "--",
            width=1.2,
        ),
        Line(np.array([-1.0]), np.array([0.0]), colour=LIMIT, width=0, marker="x", text=["-1"]),
    ]
    for loops in found:
        loop = loops.axis_loops[axis]
        lines.append(_curve(loop, loops, width=2.0, label=loops.case.label))
        size = np.abs(loop)
        at = np.flatnonzero((size[:-1] - 1) * (size[1:] - 1) < 0)
        text = [f"{loops.case.label}: gain 1 at {loops.omega[k]:.0f} rad/s" for k in at]
        points = loop[at] / size[at]
        if len(at):
            lines.append(Line(points.real, points.imag, colour=loops.case.colour, width=0, marker="o", text=text))
        at = np.flatnonzero((loop.imag[:-1] * loop.imag[1:] < 0) & (loop.real[:-1] < 0))
        at = at[np.abs(loop.real[at]) < NYQUIST]
        if len(at):
            text = [f"{loops.case.label}: gain margin {abs(20 * np.log10(abs(loop[k]))):.0f} dB" for k in at]
            zero = np.zeros(len(at))
            lines.append(Line(loop.real[at], zero, colour=loops.case.colour, width=0, marker="s", text=text))
    return _plane(f"Nyquist: {name}", lines)


def _determinant(found: Sequence[CaseLoops]) -> Panel:
    lines: list[Line | Spread] = [
        Line(np.array([-1.0]), np.array([0.0]), colour=LIMIT, width=0, marker="x", text=["-1"])
    ]
    for loops in found:
        for draw in loops.draws[: max(2, SHOWN_DRAWS // len(found))]:
            lines.append(_curve(np.linalg.det(np.eye(2) + draw.L_u) - 1, loops, width=0.6, label="", opacity=0.5))
        value = np.linalg.det(np.eye(2) + loops.nominal.L_u) - 1
        lines.append(_curve(value, loops, width=2.0, label=loops.case.label))
    return _plane("Nyquist: determinant of both axes", lines)


def _curve(values: Complex, loops: CaseLoops, width: float, label: str, opacity: float = 1.0) -> Line:
    """A curve of the complex plane, cut off far outside of the plot."""
    inside = np.abs(values) < 4 * NYQUIST
    x, y = (np.where(inside, part, np.nan) for part in (values.real, values.imag))
    text = [f"{omega:.3g} rad/s" for omega in loops.omega] if label else ()
    return Line(x, y, label, loops.case.colour, loops.case.dash, width, text=text, opacity=opacity)


def _plane(title: str, lines: Sequence[Line | Spread]) -> Panel:
    span = (-NYQUIST, NYQUIST)
    return Panel(title, "real", "imaginary", lines, equal=True, x_range=span, y_range=span, height=380)
