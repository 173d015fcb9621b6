"""Performance figures of a flight, (6.1)-(6.4) of the thesis and what it describes in words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sitl.loop import Flight
from tuning.reference import ReferenceModel


@dataclass(frozen=True)
class Performance:
    """How one axis followed, over the manoeuvre's window.

    Attributes
    ----------
    J_M_o, J_M_i : float, rad^2, rad^2/s^2
        Mean squared distance of the measured angle (rate) to the reference model driven by its set-point.
    J_r_o, J_r_i : float, rad^2, rad^2/s^2
        The same to the set-point itself.
    offaxis_peak_deg, offaxis_rms_deg : float, deg
        True angle of the other axis: the estimate's noise would hide it.
    effort_rms : float
        RMS of the roll and pitch moments together, dimensionless.
    """

    J_M_o: float
    J_M_i: float
    J_r_o: float
    J_r_i: float
    offaxis_peak_deg: float
    offaxis_rms_deg: float
    effort_rms: float


def reference_responses(
    flight: Flight, inner: ReferenceModel, outer: ReferenceModel
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What the reference models make of the flown set-points of the manoeuvre's axis.

    Returns
    -------
    angle, rate : (N,) arrays, rad, rad/s
    """
    axis, record = flight.scenario.axis, flight.record
    return (
        outer.response(record["setpoint"][:, axis].astype(np.float64)),
        inner.response(record["rates_setpoint"][:, axis].astype(np.float64)),
    )


def performance(flight: Flight, inner: ReferenceModel, outer: ReferenceModel) -> Performance:
    """Figures of a flight against the reference models of the axis that was moved.

    Parameters
    ----------
    flight : Flight
        A doublet, step or hover.
    inner, outer : ReferenceModel
        Of the rate and the attitude loop.
    """
    axis, window, record = flight.scenario.axis, slice(*flight.scenario.window), flight.record
    angle_model, rate_model = reference_responses(flight, inner, outer)
    angle, rate = record["attitude"][:, axis].astype(np.float64), record["rates"][:, axis].astype(np.float64)

    def mean_square(difference: NDArray[np.float64]) -> float:
        return float(np.mean(difference[window] ** 2))

    off_axis = np.degrees(flight.truth["attitude"][window, 1 - axis])
    moments = record["moment"][window, :2].astype(np.float64)
    return Performance(
        J_M_o=mean_square(angle - angle_model),
        J_M_i=mean_square(rate - rate_model),
        J_r_o=mean_square(angle - record["setpoint"][:, axis]),
        J_r_i=mean_square(rate - record["rates_setpoint"][:, axis]),
        offaxis_peak_deg=float(np.max(np.abs(off_axis))),
        offaxis_rms_deg=float(np.sqrt(np.mean(off_axis**2))),
        effort_rms=float(np.sqrt(np.mean(np.sum(moments**2, axis=1)))),
    )
