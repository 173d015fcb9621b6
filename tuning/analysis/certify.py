"""The stability verdict on a gain set, made before flight from the log of an experiment.

The measured frequency response decides by Nyquist's count: det(n (I + L)) must not encircle 0, for the rate loop alone
and for the whole cascade cut at u. Other plants are drawn from the response's error; one that is unstable is enough to
withhold the certificate. So is a loop gain that rises again at a measured frequency above the crossover: a structural
mode.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from mimopilot.tuning.analysis.beyond_band import (
    MAX_GAIN_ABOVE_BAND,
    attitude_gain_above,
    find_structural_mode,
    loop_gain_above,
    reason_beyond_band,
    sensitivity_at_band_start,
    sensitivity_peak_above,
)
from mimopilot.tuning.analysis.closed_loop import model_spectral_radius, slow_growth
from mimopilot.tuning.analysis.nyquist import NyquistCount
from mimopilot.tuning.analysis.stability_figures import nominal_and_drawn_loops, stability_figures
from mimopilot.tuning.axes import Law
from mimopilot.tuning.certificate import DEFAULT_THRESHOLDS, Certificate, Thresholds, Verdict
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.plant.frequency_response import DRAWS, LATE, MIN_FREQUENCIES, PlantResponse
from mimopilot.tuning.plant.rigid_body_fit import RigidBody, continued_below, rigid_body
from mimopilot.tuning.reference_model import ReferenceModel
from mimopilot.tuning.statespace import StateSpace

#: Spectral radius above which the identified model calls a loop unstable: a mode that grows by e in 8 s at 250 Hz.
UNSTABLE_RADIUS = 1.0005


def certify(
    gains: Law,
    plant: PlantResponse,
    inner: Sequence[ReferenceModel],
    outer: Sequence[ReferenceModel],
    log_sha256: str = "",
    thresholds: Thresholds = DEFAULT_THRESHOLDS,
    model: Callable[[], StateSpace | None] = lambda: None,
) -> Certificate:
    """Verdict on a gain set.

    Parameters
    ----------
    gains : Law
    plant : PlantResponse
        Measured response, from `tuning.plant.frequency_response.plant_response`. If its period is not that of the
        gains, it is carried to theirs, see `PlantResponse.at_period`.
    inner, outer : sequence of n ReferenceModel
        Of the rate and the attitude loop, one for each axis; they only normalise the determinants.
    log_sha256 : str
        Hash of the log that the response comes from.
    thresholds : Thresholds
        Margins that the verdict needs.
    model : callable, optional
        Returns the plant from torque to body rates, identified from the same log, or None. It cannot certify. Where
        the response leaves the verdict open and the loop around the model is unstable, the verdict is ``unstable``.
        Not used for another period than that of the response.
    """
    measured, plant = plant, plant.at_period(gains.Ts)
    carried = _carried(measured, gains.Ts) if plant is not measured else ""

    def verdict(text: Verdict, reason: str, figures: Mapping[str, Any], band: tuple[float, float]) -> Certificate:
        identified = model() if text == Verdict.NOT_CERTIFIED and plant is measured else None
        if identified is not None:
            radius = model_spectral_radius(gains, identified)
            if radius > UNSTABLE_RADIUS:
                text = Verdict.UNSTABLE
                reason = f"around the model identified from the log the spectral radius is {radius:.4f}; {reason}"
        return Certificate(text, reason + carried, figures, band, thresholds.model_dump(), log_sha256)

    try:
        body, known = _known(plant)
    except TuningError as error:
        return verdict(Verdict.NOT_CERTIFIED, str(error), {}, (0.0, 0.0))
    band = (float(known.omega[0]), float(known.omega[-1]))
    gain_above = float(loop_gain_above(gains, known)[-1])
    dense, nominal, draws = nominal_and_drawn_loops(gains, continued_below(known, body))
    count = NyquistCount(inner, outer, dense.omega, gains.Ki_i)
    unstable = [any(count.encirclements(loop)) for loop in draws].count(True)
    figures = stability_figures(gain_above, dense, nominal, draws, inner)
    figures["Ms"] = max(figures["Ms"], sensitivity_peak_above(gains, plant, band[1]))
    beyond = reason_beyond_band(gains, known, gain_above)
    # The count holds where the loop is below 1 above the band and its amplification is measured.
    countable = gain_above + attitude_gain_above(gains, known) < 1 and sensitivity_at_band_start(gains, known) < 1
    if beyond and not countable:
        return verdict(Verdict.NOT_CERTIFIED, beyond, figures, band)
    rate_loop, cascade = count.encirclements(nominal)
    if (rate_loop or cascade) and unstable > DRAWS / 2:
        where = "the rate loop alone" if rate_loop else "the whole cascade"
        reason = f"the determinant encircles 0: {where} is unstable"
        if carried and gains.Ts < measured.Ts:
            return verdict(Verdict.NOT_CERTIFIED, f"{reason} with the delay of the log's slower rate", {}, band)
        return verdict(Verdict.UNSTABLE, reason, {}, band)
    if beyond:
        return verdict(Verdict.NOT_CERTIFIED, beyond, figures, band)
    doubt = _reason_for_doubt(gains, plant, known, body)
    if doubt:
        return verdict(Verdict.NOT_CERTIFIED, doubt, figures, band)
    if unstable:
        reason = f"too close to instability: {unstable} of {DRAWS} plants within the log's error are unstable"
        return verdict(Verdict.NOT_CERTIFIED, reason, figures, band)
    assumed = (
        f"assumed: above {band[1]:.0f} rad/s the plant falls at least like an integrator; "
        f"below {band[0]:.1f} rad/s it is the fitted rigid body"
    )
    short = missed_thresholds(figures, thresholds.Ms, thresholds.phase_deg)
    if not short:
        return verdict(Verdict.CERTIFIED, assumed, figures, band)
    too_short = missed_thresholds(figures, thresholds.thin_Ms, thresholds.thin_phase_deg)
    if too_short:
        return verdict(Verdict.NOT_CERTIFIED, "; ".join(["the margin is too thin", *too_short]), figures, band)
    return verdict(Verdict.THIN, "; ".join([*short, assumed]), figures, band)


def _known(plant: PlantResponse) -> tuple[RigidBody, PlantResponse]:
    """The fitted rigid body, and the response where it is known.

    Raises
    ------
    TuningError
        When it is known at too few frequencies.
    """
    body, known = rigid_body(plant), plant.at(plant.known_run())
    if len(known.omega) < MIN_FREQUENCIES:
        raise TuningError(f"the excitation reaches fewer than {MIN_FREQUENCIES} frequencies in a row")
    return body, known


def reason_unknown(gains: Law, plant: PlantResponse) -> str:
    """Why a response does not show the loop of a law; empty: it does.

    Parameters
    ----------
    gains : Law
    plant : PlantResponse
        With the period of the law.
    """
    try:
        _, known = _known(plant)
    except TuningError as error:
        return str(error)
    return reason_beyond_band(gains, known, float(loop_gain_above(gains, known)[-1]))


def _carried(measured: PlantResponse, Ts: float) -> str:
    """What is assumed of a vehicle whose response was measured at another period."""
    rates = f"; carried from {1 / measured.Ts:.0f} to {1 / Ts:.0f} Hz: the torque is taken"
    if Ts < measured.Ts:
        return f"{rates} as late as in the log, though it is sooner"
    return f"{rates} {LATE * (Ts - measured.Ts) * 1e3:.1f} ms later, as after one period of computing"


def missed_thresholds(figures: Mapping[str, Any], Ms: float, phase_deg: float) -> list[str]:
    """One text for each margin that misses its threshold, error included."""
    missed = []
    if figures["Ms"] + figures["Ms_error"] > Ms:
        missed.append(f"Ms {figures['Ms']:.2f} + {figures['Ms_error']:.2f} is above {Ms:g}")
    for axis, phase in figures["phase_margin_deg"].items():
        error = figures["phase_margin_error_deg"][axis]
        if phase - error < phase_deg:
            missed.append(f"the phase margin of {axis}, {phase:.0f} - {error:.0f} degrees, is below {phase_deg:g}")
    return missed


def _reason_for_doubt(gains: Law, plant: PlantResponse, known: PlantResponse, body: RigidBody) -> str:
    """Why a loop may be unstable although Nyquist's count finds it stable; empty when nothing suggests it."""
    mode = find_structural_mode(gains, plant)
    if mode is not None:
        omega, gain = mode
        return (
            f"at {omega:.0f} rad/s ({omega / (2 * np.pi):.0f} Hz) the loop's gain may reach {gain:.2f} again (at most "
            f"{MAX_GAIN_ABOVE_BAND:g}): a mode of the frame, or a derivative that grows faster than the vehicle's "
            "response falls; stiffen the frame, filter the rates (notch, lower cut-off), or lower the derivative's "
            "filter or gain"
        )
    if np.any(gains.Ki_i) and body.least(gains.Ki_i) <= 0:
        return (
            "Ki_i through the measured plant is not positive in every direction (at least "
            f"{body.least(gains.Ki_i):.3g} rad/s^2 per rad): the integral terms diverge below the excitation; "
            "raise the diagonal of Ki_i, or leave the integral out"
        )
    if not np.any(gains.Ki_i) and body.least(gains.Kp_i + gains.Kff_i) <= 0:
        return (
            "there is no integral, and Kp_i through the measured plant is not positive in every direction (at least "
            f"{body.least(gains.Kp_i + gains.Kff_i):.3g} rad/s^2 per rad/s); raise the diagonal of Kp_i"
        )
    # Nyquist's count closes the curve below the band by the shortest way, which skewed integral gains do not go.
    slow = slow_growth(gains, body.model(gains.Ts), float(known.omega[0]))
    if slow is not None:
        return (
            f"below the excitation, at {slow:.2g} rad/s, the loop around the fitted rigid body is unstable: the "
            "integral gains of roll and pitch work against each other; raise the diagonals of Ki_i and Kp_o"
        )
    if np.linalg.eigvalsh(gains.Kp_o + gains.Kp_o.T)[0] <= 0:
        return (
            f"below {known.omega[0]:.1f} rad/s the attitude loop's gain is not positive in every direction; raise the "
            "diagonal of Kp_o"
        )
    return ""
