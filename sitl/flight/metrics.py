"""Performance figures of a flight: (6.1)-(6.4) of the thesis, and those that it describes without a formula."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mimopilot.sitl.flight.simulator import Flight
from mimopilot.sitl.physics.compiled_step import compiled
from mimopilot.tuning.reference_model import ReferenceModel

#: Figure of a flight -> its label: those of `Performance`, then of `sitl.flight.fault_recovery.Recovery`.
FIGURE_LABELS = {
    "J_M_o": "J_M,o [rad^2]",
    "J_M_i": "J_M,i [rad^2/s^2]",
    "J_r_o": "J_r,o [rad^2]",
    "J_r_i": "J_r,i [rad^2/s^2]",
    "peak_deg": "peak [deg]",
    "offaxis_peak_deg": "off-axis peak [deg]",
    "offaxis_rms_deg": "off-axis RMS [deg]",
    "effort_rms": "effort, RMS of u [-]",
    "saturated": "saturated samples",
    "crashed_at_s": "lost at [s]",
    "deviation_peak_deg": "peak, from the flight without faults [deg]",
    "deviation_rms_deg": "RMS, from the same [deg]",
    "saturated_since": "saturated samples since the fault",
    "recovery_s": "recovered after [s]",
    "detected_s": "detected after [s]",
    "detected_by": "detected by",
    "nonfinite": "non-finite outputs",
}


@dataclass(frozen=True)
class Performance:
    """Tracking performance of one axis over the window of the manoeuvre.

    Attributes
    ----------
    J_M_o, J_M_i : float, rad^2, rad^2/s^2
        Mean squared error of the measured angle (rate) from the response of the reference model to its setpoint.
    J_r_o, J_r_i : float, rad^2, rad^2/s^2
        The same from the setpoint itself.
    peak_deg : float, deg
        Largest true angle of the axis from the start of the manoeuvre to the end of the flight.
    offaxis_peak_deg, offaxis_rms_deg : float, deg
        True angle of the other axis, which is smaller than the noise of the estimate.
    effort_rms : float
        RMS of the roll and pitch torques (normalised) together.
    saturated : int
        Samples in which the roll or pitch torque is saturated.
    """

    J_M_o: float
    J_M_i: float
    J_r_o: float
    J_r_i: float
    peak_deg: float
    offaxis_peak_deg: float
    offaxis_rms_deg: float
    effort_rms: float
    saturated: int


def reference_responses(
    flight: Flight, inner: ReferenceModel, outer: ReferenceModel
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Responses of the reference models to the setpoints flown on the axis of the manoeuvre.

    Returns
    -------
    angle, rate : (N,) arrays, rad, rad/s
    """
    return _responses(flight, inner, outer, len(flight.record))


def _responses(
    flight: Flight, inner: ReferenceModel, outer: ReferenceModel, stop: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    axis, record = flight.scenario.axis, flight.record[:stop]
    return (
        outer.response(record["setpoint"][:, axis].astype(np.float64)),
        inner.response(record["rates_setpoint"][:, axis].astype(np.float64)),
    )


def performance(flight: Flight, inner: ReferenceModel, outer: ReferenceModel) -> Performance:
    """Performance of a flight against the reference models, on the axis of the manoeuvre.

    Parameters
    ----------
    flight : Flight
        A doublet, step or hover.
    inner, outer : ReferenceModel
        Of the rate loop and of the attitude loop.
    """
    axis, (start, stop), record = flight.scenario.axis, flight.scenario.window, flight.record
    models = _responses(flight, inner, outer, stop)
    names = ("attitude", "rates", "setpoint", "rates_setpoint", "moment", "unallocated")
    signals = tuple(record[name] for name in names)
    return Performance(*_figures(signals, models, flight.truth["attitude"], axis, start, stop))


@compiled
def _figures(signals, models, true_angles, axis, start, stop):  # type: ignore[no-untyped-def]
    """Compute the fields of `Performance` in one pass, because campaigns need thousands of them."""
    attitude, rates, setpoint, rates_setpoint, moment, unallocated = signals
    angle_model, rate_model = models
    J_M_o = J_M_i = J_r_o = J_r_i = off_axis = effort = peak = off_axis_peak = 0.0
    saturated = 0
    for k in range(start, stop):
        angle, rate = np.float64(attitude[k, axis]), np.float64(rates[k, axis])
        J_M_o += (angle - angle_model[k]) ** 2
        J_M_i += (rate - rate_model[k]) ** 2
        J_r_o += (angle - setpoint[k, axis]) ** 2
        J_r_i += (rate - rates_setpoint[k, axis]) ** 2
        off_axis += true_angles[k, 1 - axis] ** 2
        off_axis_peak = max(off_axis_peak, abs(true_angles[k, 1 - axis]))
        for i in range(2):
            effort += np.float64(moment[k, i]) ** 2
        if unallocated[k, 0] != 0.0 or unallocated[k, 1] != 0.0:
            saturated += 1
    for k in range(start, true_angles.shape[0]):
        peak = max(peak, abs(true_angles[k, axis]))
    n, degrees = stop - start, 180.0 / np.pi
    return (
        J_M_o / n,
        J_M_i / n,
        J_r_o / n,
        J_r_i / n,
        degrees * peak,
        degrees * off_axis_peak,
        degrees * np.sqrt(off_axis / n),
        np.sqrt(effort / n),
        saturated,
    )
