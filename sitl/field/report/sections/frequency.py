"""Measured frequency response of the plant: magnitude, phase, coherence."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mimopilot.common.charts import LIMIT
from mimopilot.common.figures import Chart, LimitLine, Line, Panel, SpanMark, Spread
from mimopilot.common.html_report import Section
from mimopilot.sitl.field.report.analysis.flight_data import GainCase, ReportedFlight
from mimopilot.tuning.axes import axis_names
from mimopilot.tuning.plant.frequency_response import COHERENT, GROWTH, PlantResponse
from mimopilot.tuning.plant.local_polynomial import FREEDOM

Signal = NDArray[np.float64]
#: Flights with the response that is drawn; a band of frequencies (rad/s), None: not known.
Measured = Sequence[tuple[ReportedFlight, PlantResponse]]
Band = tuple[float, float] | None

HEADING = "Frequency response of the vehicle"
#: Relative error above which an element is not drawn: its phase is anything.
SHOWN = 1.0


def frequency_section(flights: Sequence[ReportedFlight], cases: Sequence[GainCase]) -> Section:
    """From torque to body rates, of all flights on the same axes."""
    shown = [flight for flight in flights if flight.measured is not None]
    responses = [(flight, flight.measured.response) for flight in shown if flight.measured is not None]
    reasons = [f"{flight.label}: not shown: {flight.why_not}." for flight in flights if flight.measured is None]
    if not shown:
        return Section(HEADING, "Not shown: it needs an excited flight that gains can be tuned from.", points=reasons)
    band = next((c.gains.certificate.band for c in cases if c.gains.certificate and c.gains.certificate.band[1]), None)
    caption = (
        "From torque (normalised) to body rate, measured from what moves the vehicle from outside (injected torque or "
        "rate, else the setpoint), which is consistent in closed loop. Bands: two standard deviations. Solid: by the "
        "torque of the same axis; dashed: by that of the other one, the coupling. Shaded: the band in which the "
        "response is known, on which certificates rest."
    )
    panels = [_magnitude(responses, axis, band) for axis in range(2)]
    panels += [_phase(responses, axis, band) for axis in range(2)]
    panels += [_coherence(responses, axis, band) for axis in range(2)]
    charts = [Chart("frequency-response", caption, panels)]
    yaws = [(flight, response) for flight in shown if (response := flight.yaw_response) is not None]
    if yaws:
        band = yaw_band(cases)
        panels = [_magnitude(yaws, 0, band), _phase(yaws, 0, band), _coherence(yaws, 0, band)]
        charts.append(Chart("frequency-response-yaw", "The same of yaw.", panels, columns=3))
    return Section(HEADING, charts=charts, points=reasons)


def yaw_band(cases: Sequence[GainCase]) -> tuple[float, float] | None:
    """Band in which the response of yaw is known."""
    for case in cases:
        band = (case.gains.certificate.figures.get("yaw", {}) if case.gains.certificate else {}).get("band")
        if band and band[1]:
            return float(band[0]), float(band[1])
    return None


def coherence_band(coherence: Signal, omega: Signal, seconds: float) -> tuple[Signal, Signal]:
    """95 % interval of a coherence (K,), by Fisher's transformation of its root.

    Its deviation is 1 / sqrt(2 n - 2) for n averaged bins (J. Bendat, A. Piersol, "Random Data", 2010, section 9.2.3);
    a window of the estimate holds `GROWTH` of its frequency on both sides, or the least number of bins.
    """
    bins = np.maximum(FREEDOM, 2 * GROWTH * omega * seconds / (2 * np.pi))
    middle, half = np.arctanh(np.sqrt(np.minimum(coherence, 1 - 1e-9))), 1.96 / np.sqrt(2 * bins - 2)
    return np.tanh(np.maximum(middle - half, 0.0)) ** 2, np.tanh(middle + half) ** 2


def _name(flights: Measured, axis: int) -> str:
    return axis_names(flights[0][1].axes)[axis]


def _seconds(flight: ReportedFlight) -> float:
    return flight.measured.experiment.seconds if flight.measured else 0.0


def _span(flights: Measured) -> tuple[float, float]:
    """Frequencies (rad/s) of all flights: panels above one another have the same axis."""
    return min(float(plant.omega[0]) for _, plant in flights), max(float(plant.omega[-1]) for _, plant in flights)


def _panel(
    title: str, unit: str, lines: list[Line | Spread], band: tuple[float, float] | None, **options: object
) -> Panel:
    hertz = f"frequency [rad/s]{'; shaded: known' if band else ''}"
    marks: list[SpanMark | LimitLine] = [SpanMark(*band)] if band else []
    marks += options.pop("marks", [])  # type: ignore[arg-type]
    return Panel(title, hertz, unit, lines, marks, log_x=True, **options)  # type: ignore[arg-type]


def _element(plant: PlantResponse, i: int, j: int) -> tuple[NDArray[np.complex128], Signal, NDArray[np.bool_]]:
    """Element of G_i, its deviation, and where it is known well enough to be drawn."""
    G, deviation = plant.G_i[:, i, j], plant.deviation()[:, i, j]
    return G, deviation, deviation < SHOWN * np.abs(G)


def _magnitude(flights: Measured, axis: int, band: Band) -> Panel:
    lines: list[Line | Spread] = []
    for flight, plant in flights:
        for column, dash in ((axis, "-"), (1 - axis, "--"))[: plant.axes]:
            G, deviation, good = _element(plant, axis, column)
            size = np.where(good, np.abs(G), np.nan)
            low = np.maximum(size - 2 * deviation, 0.1 * size)
            label = f"by {axis_names(plant.axes)[column]} torque{f', {flight.label}' if len(flights) > 1 else ''}"
            lines.append(Spread(plant.omega, low, size + 2 * deviation, colour=flight.colour))
            lines.append(Line(plant.omega, size, label, flight.colour, dash))
    return _panel(
        f"{_name(flights, axis)} rate: magnitude", "[rad/s per unit]", lines, band, log_y=True, x_range=_span(flights)
    )


def _phase(flights: Measured, axis: int, band: Band) -> Panel:
    lines: list[Line | Spread] = []
    for flight, plant in flights:
        G, deviation, good = _element(plant, axis, axis)
        if not good.any():
            continue
        # Across a gap the turn of the phase is not known: the widest stretch without one, in octaves, is drawn.
        parts = np.split(np.flatnonzero(good), np.flatnonzero(np.diff(np.flatnonzero(good)) > 1) + 1)
        good = np.isin(np.arange(len(G)), max(parts, key=lambda part: plant.omega[part[-1]] / plant.omega[part[0]]))
        phase = np.full(len(G), np.nan)
        phase[good] = np.degrees(np.unwrap(np.angle(G[good])))
        # A vehicle's response begins between -90 and 0 degrees: the turn in which its phase is counted.
        phase -= 360.0 * round((float(phase[good][0]) + 90.0) / 360.0)
        error = 2 * np.degrees(np.arcsin(np.minimum(deviation / np.abs(G), 0.99)))
        label = flight.label if len(flights) > 1 else f"by {axis_names(plant.axes)[axis]} torque"
        lines.append(Spread(plant.omega, phase - error, phase + error, colour=flight.colour))
        lines.append(Line(plant.omega, phase, label, flight.colour))
    marks = [LimitLine(-180.0, colour="#888888", dash=":")]
    return _panel(f"{_name(flights, axis)} rate: phase", "[deg]", lines, band, marks=marks, x_range=_span(flights))


def _coherence(flights: Measured, axis: int, band: Band) -> Panel:
    lines: list[Line | Spread] = []
    for flight, plant in flights:
        label = flight.label if len(flights) > 1 else "with the excitation"
        value = np.clip(plant.coherence[:, axis], 0.0, 1.0)
        low, high = coherence_band(value, plant.omega, _seconds(flight))
        lines.append(Spread(plant.omega, low, high, colour=flight.colour))
        lines.append(Line(plant.omega, value, label, flight.colour))
    marks = [LimitLine(COHERENT, f"coherent above {COHERENT:g}", LIMIT)]
    return _panel(
        f"{_name(flights, axis)} rate: coherence",
        "",
        lines,
        band,
        marks=marks,
        y_range=(0.0, 1.05),
        x_range=_span(flights),
    )
