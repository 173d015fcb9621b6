"""Will the loop be stable? Answered before flight, from the log that the gains were tuned on.

The measured frequency response decides by Nyquist's count: det(n (I + L)) must not go round 0, for the rate loop
alone and for the whole cascade cut at u, n = 1 - m cancelling the integrators at z = 1. Other plants that the
experiment allows are drawn from its error; what happens to any of them counts. Every frequency that the log knows
counts: once the loop has become small it must stay small, or a mode of the frame is in it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from mimopilot.tuning.analysis import margins
from mimopilot.tuning.analysis.closed_loop import (
    CascadeLoop,
    cascade_loop,
    model_spectral_radius,
    rate_controller,
    singular_values,
)
from mimopilot.tuning.certificate import DEFAULT_THRESHOLDS, Certificate, Thresholds, Verdict
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gain_stack import GainStack
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.plant.frequency_response import COHERENT, DRAWS, MIN_FREQUENCIES, PlantResponse
from mimopilot.tuning.plant.rigid_body_fit import RigidBody, rigid_body
from mimopilot.tuning.reference_model import ReferenceModel
from mimopilot.tuning.statespace import StateSpace
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

#: Above the band the rate loop's gain may be at most this, if the plant falls like an integrator from its end on.
HIGH_FREQUENCY_LOOP = 0.5
#: A loop that has become small once may be larger again up to this ratio of frequencies: noise about the limit.
ABOUT = 1.25
#: A gain whose error is below this share of it is not noise, whatever the coherence.
NOT_NOISE = 0.5
#: Where the band begins the sensitivity may at most be this: the loop must be in charge of what nobody measured below.
LOW_FREQUENCY_SENSITIVITY = 0.5
#: Neighbouring frequencies differ by this share at most: a loop at the limit has a peak that is narrower than the
#: response's own grid.
DENSE = 0.05
#: The identified model calls a loop unstable from this spectral radius on: a mode that grows by e in 8 s at 250 Hz.
GROWING = 1.0005

Complex = NDArray[np.complex128]
Signal = NDArray[np.float64]


def certify(
    gains: Gains,
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
    gains : Gains
        The set.
    plant : PlantResponse
        Measured response, from `tuning.plant.frequency_response.plant_response`.
    inner, outer : sequence of 2 ReferenceModel
        Of the rate and the attitude loop, roll and pitch; they only normalise the determinants.
    log_sha256 : str
        Of the log that the response comes from.
    thresholds : Thresholds
        Margins that the verdict needs.
    model : callable, optional
        Gives the plant from torque to body rates, identified from the same log, or None. It cannot certify; but where
        the response leaves a loop open that is unstable around it, the verdict is ``unstable``.
    """

    def verdict(text: Verdict, reason: str, figures: Mapping[str, Any], band: tuple[float, float]) -> Certificate:
        identified = model() if text == Verdict.NOT_CERTIFIED else None
        if identified is not None:
            radius = model_spectral_radius(gains, identified)
            if radius > GROWING:
                text = Verdict.UNSTABLE
                reason = f"around the model identified from the log the spectral radius is {radius:.4f}; {reason}"
        return Certificate(text, reason, figures, band, thresholds.model_dump(), log_sha256)

    try:
        body = rigid_body(plant)
    except TuningError as error:
        return verdict(Verdict.NOT_CERTIFIED, str(error), {}, (0.0, 0.0))
    known = plant.at(plant.known_run())
    if len(known.omega) < MIN_FREQUENCIES:
        reason = f"the excitation reaches fewer than {MIN_FREQUENCIES} frequencies in a row"
        return verdict(Verdict.NOT_CERTIFIED, reason, {}, (0.0, 0.0))
    band = (float(known.omega[0]), float(known.omega[-1]))
    above = float(loop_above(gains, known)[-1])
    dense, nominal, draws = _loops(gains, known)
    normal = _Normaliser(inner, outer, dense.omega, gains.Ki_i)
    windings = [normal.windings(loop) for loop in draws]
    figures = _figures(above, dense, nominal, draws, inner)
    figures["Ms"] = max(figures["Ms"], _peak_beyond(gains, plant, band[1]))
    doubtful = sum(any(w) for w in windings)
    beyond = _beyond_the_band(gains, known, above)
    # The count is one where the loop is below 1 at the band's end and in charge at its beginning: else it may turn on.
    closed = above + _outer_loop_above(gains, known) < 1 and _left_at_the_beginning(gains, known) < 1
    if beyond and not closed:
        return verdict(Verdict.NOT_CERTIFIED, beyond, figures, band)
    if any(normal.windings(nominal)) and doubtful > DRAWS / 2:
        where = "the rate loop alone" if normal.windings(nominal)[0] else "the whole cascade"
        return verdict(Verdict.UNSTABLE, f"the determinant goes round 0: {where} is unstable", {}, band)
    if beyond:
        return verdict(Verdict.NOT_CERTIFIED, beyond, figures, band)
    doubt = _doubt(gains, plant, known, body)
    if doubt:
        return verdict(Verdict.NOT_CERTIFIED, doubt, figures, band)
    if doubtful:
        reason = f"too close to the limit to tell: {doubtful} of {DRAWS} plants that the log allows are unstable"
        return verdict(Verdict.NOT_CERTIFIED, reason, figures, band)
    assumed = (
        f"assumed: above {band[1]:.0f} rad/s the plant falls at least like an integrator; "
        f"below {band[0]:.1f} rad/s the integral term acts as there"
    )
    short = _short_of(figures, thresholds.Ms, thresholds.phase_deg)
    if not short:
        return verdict(Verdict.CERTIFIED, assumed, figures, band)
    too_short = _short_of(figures, thresholds.thin_Ms, thresholds.thin_phase_deg)
    if too_short:
        return verdict(Verdict.NOT_CERTIFIED, "; ".join(["the margin is too thin", *too_short]), figures, band)
    return verdict(Verdict.THIN, "; ".join([*short, assumed]), figures, band)


def _short_of(figures: Mapping[str, Any], Ms: float, phase_deg: float) -> list[str]:
    """What of the margins, errors included, is missed."""
    missed = []
    if figures["Ms"] + figures["Ms_error"] > Ms:
        missed.append(f"Ms {figures['Ms']:.2f} + {figures['Ms_error']:.2f} is above {Ms:g}")
    for axis, phase in figures["phase_margin_deg"].items():
        error = figures["phase_margin_error_deg"][axis]
        if phase - error < phase_deg:
            missed.append(f"the phase margin of {axis}, {phase:.0f} - {error:.0f} degrees, is below {phase_deg:g}")
    return missed


def sensitivity_peak(gains: Gains, plant: PlantResponse) -> tuple[float, float]:
    """Peak of the sensitivity at u and two standard errors of it: the certificate's ``Ms`` and ``Ms_error``.

    Parameters
    ----------
    gains : Gains
    plant : PlantResponse
        With at least 8 known frequencies in a row.
    """
    _, nominal, draws = _loops(gains, plant.at(plant.known_run()))
    return _sensitivity_peak(nominal, draws)


def _sensitivity_peak(nominal: CascadeLoop, draws: list[CascadeLoop]) -> tuple[float, float]:
    peaks = [margins.peak(margins.sensitivity(loop)) for loop in (nominal, *draws)]
    return peaks[0], 2 * float(np.std(peaks[1:]))


def _loops(gains: Gains, plant: PlantResponse) -> tuple[PlantResponse, CascadeLoop, list[CascadeLoop]]:
    """The plant on a grid that shows narrow peaks, the loop around it, and around others that the experiment allows."""
    generator, dense = np.random.default_rng(0), plant.interpolated(DENSE)
    others = (plant.draw(generator).interpolated(DENSE) for _ in range(DRAWS))
    return dense, cascade_loop(gains, dense), [cascade_loop(gains, other) for other in others]


class _Normaliser:
    """det(n (I + L)) along the band and how often it goes round 0.

    n has a zero at z = 1 for each integrator of the loop: of the rate controller on axes that have an integral gain,
    and of the angles.
    """

    def __init__(
        self,
        inner: Sequence[ReferenceModel],
        outer: Sequence[ReferenceModel],
        omega: Signal,
        Ki_i: Signal,
    ) -> None:
        # n is a product of scalars 1 - m: its phase is followed on a fine grid from 0 to Nyquist, once.
        fine = np.linspace(omega[0], np.pi / inner[0].Ts, 4000)

        def ones_minus(models: Sequence[ReferenceModel], at: Signal) -> Complex:
            responses = [1 - model.frequency_response(at) for model in models]
            return np.stack([np.ones(len(at), complex), *responses], axis=1)

        inner = [model for model, row in zip(inner, Ki_i, strict=True) if np.any(row)]
        self.n_i = np.prod(ones_minus(inner, omega), axis=1)
        self.n_o = self.n_i * np.prod(ones_minus(outer, omega), axis=1)
        tail_i = np.prod(ones_minus(inner, fine), axis=1)
        tail_o = tail_i * np.prod(ones_minus(outer, fine), axis=1)
        last = np.searchsorted(fine, omega[-1])
        self.after = [float(_turn(tail[last:])) for tail in (tail_i, tail_o)]

    def windings(self, loop: CascadeLoop) -> tuple[int, int]:
        """Encirclements of 0: rate loop, whole cascade."""
        identity = np.eye(2)
        counts = []
        for n, L, after in ((self.n_i, loop.L_i, self.after[0]), (self.n_o, loop.L_u, self.after[1])):
            f = n * np.linalg.det(identity + L)
            # Below the band f goes to a positive number; above it I + L goes to I, by the nearest way.
            closing = -float(np.angle(np.linalg.det(identity + L[-1]))) + after
            total = float(np.angle(f[0])) + float(_turn(f)) + closing
            counts.append(round(total / np.pi))
        return counts[0], counts[1]


def _turn(f: Complex) -> float:
    """Change of phase along a curve, rad."""
    return float(np.sum(np.angle(f[1:] / f[:-1])))


def _beyond_the_band(gains: Gains, known: PlantResponse, loop: float) -> str:
    """Why nothing can be said outside of the band, where the rate loop's gain may still reach `loop`, and so not of the
    count within; empty when the assumptions hold.
    """
    if loop > HIGH_FREQUENCY_LOOP:
        return (
            f"excitation ends at {known.omega[-1]:.0f} rad/s, where the loop's gain may still reach {loop:.2f} "
            f"(at most {HIGH_FREQUENCY_LOOP:g}): excite a wider band"
        )
    if loop + _outer_loop_above(gains, known) >= 1:
        return (
            f"excitation ends at {known.omega[-1]:.0f} rad/s, where the whole cascade's gain may still reach 1: "
            "excite a wider band"
        )
    remaining = _left_at_the_beginning(gains, known)
    if remaining > LOW_FREQUENCY_SENSITIVITY:
        return (
            f"excitation begins at {known.omega[0]:.1f} rad/s, where the sensitivity is still {remaining:.2f} (at most "
            f"{LOW_FREQUENCY_SENSITIVITY:g}), and nothing is known of the loop below: excite lower frequencies, or ask "
            "for a faster attitude loop"
        )
    return ""


def _left_at_the_beginning(gains: Gains, known: PlantResponse) -> float:
    """The sensitivity where the band begins."""
    return margins.peak(margins.sensitivity(cascade_loop(gains, known.at(np.array([0])))))


def _doubt(gains: Gains, plant: PlantResponse, known: PlantResponse, body: RigidBody) -> str:
    """Why a loop whose count is right may be unstable all the same; empty when nothing speaks for it."""
    again = large_again(gains, plant)
    if again is not None:
        omega, gain = again
        return (
            f"at {omega:.0f} rad/s ({omega / (2 * np.pi):.0f} Hz) the loop's gain may reach {gain:.2f} again (at most "
            f"{HIGH_FREQUENCY_LOOP:g}): a mode of the frame, or a derivative that grows faster than the vehicle's "
            "answer falls; stiffen the frame, filter the rates (notch, lower cut-off), or lower the derivative's "
            "filter or gain"
        )
    if np.any(gains.Ki_i) and body.least(gains.Ki_i) <= 0:
        return (
            "Ki_i through the measured plant is not positive in every direction (at least "
            f"{body.least(gains.Ki_i):.3g} rad/s^2 per rad): the integral terms run away below the "
            "excitation; raise the diagonal of Ki_i, or leave the integral out"
        )
    if not np.any(gains.Ki_i) and body.least(gains.Kp_i + gains.Kff_i) <= 0:
        return (
            "there is no integral, and Kp_i through the measured plant is not positive in every direction (at least "
            f"{body.least(gains.Kp_i + gains.Kff_i):.3g} rad/s^2 per rad/s)"
        )
    if np.linalg.eigvalsh(gains.Kp_o + gains.Kp_o.T)[0] <= 0:
        return f"below {known.omega[0]:.1f} rad/s the attitude loop's gain is not positive in every direction"
    return ""


def loop_above(gains: Gains | GainStack, plant: PlantResponse) -> Signal:
    """What the rate loop's gain may still reach above each frequency of the plant, (K,); of a stack (sets, K).

    The supremum over w > w_k of sigma_max(G(w_k)) (w_k / w) sigma_max(C_y)(w). A rate is the integral of the
    moment over the inertia, behind motors and filters, so |G| falls at least like 1/w; that it does not grow would be
    weaker, but then a filtered D counts with its gain at the Nyquist frequency, where no vehicle answers. That w |G|
    does not rise is also what takes the noise off: from its highest value on it is fitted by such a sequence.
    """
    grid = np.concatenate([plant.omega, np.linspace(plant.omega[-1], np.pi / gains.Ts, 200)[1:]])
    falling = singular_values(rate_controller(gains, grid)[1])[0] / grid
    highest = np.maximum.accumulate(falling[..., ::-1], axis=-1)[..., ::-1][..., : len(plant.omega)]
    gain: Signal = singular_values(plant.G_i)[0] * plant.omega
    top = int(np.argmax(gain))
    gain[top:] = isotonic_regression(gain[top:], increasing=False).x
    reached: Signal = gain * highest
    return reached


def large_again(gains: Gains, plant: PlantResponse) -> tuple[float, float] | None:
    """Where the rate loop's gain, once small, is large again at a frequency that the log knows: a mode of the frame.

    Parameters
    ----------
    gains : Gains
    plant : PlantResponse
        The whole response, known or not.

    Returns
    -------
    tuple of 2 float or None
        Frequency (rad/s) where it is surest, and the gain with its error there; None: nowhere.
    """
    gain, error = _rate_loop_gain(gains, plant)
    known = np.flatnonzero(plant.known())
    small = known[gain[known] + error[known] <= HIGH_FREQUENCY_LOOP]
    small = small[small > known[np.argmax(gain[known])]] if len(small) else small
    if not len(small):
        return None
    upper = gain + error
    counts = _told(plant, gain, error) & (plant.omega > ABOUT * plant.omega[small[0]]) & (upper > HIGH_FREQUENCY_LOOP)
    if not counts.any():
        return None
    surest = int(np.argmax(np.where(counts, gain - error, -np.inf)))
    return float(plant.omega[surest]), float(upper[surest])


def _told(plant: PlantResponse, gain: Signal, error: Signal) -> NDArray[np.bool_]:
    """Where the log says something of a loop's gain: it knows the response, the excitation is seen on an axis, or the
    gain is not noise.
    """
    seen = np.any(plant.coherence > COHERENT, axis=1) | (error < NOT_NOISE * gain)
    # By chance a value may look like one; a mode is seen by its neighbours, too.
    beside = np.append(seen[1:], False) | np.append(False, seen[:-1])
    return np.asarray(plant.known() | (seen & beside))


def _peak_beyond(gains: Gains, plant: PlantResponse, end: float) -> float:
    """The largest that the sensitivity may be where the log says something above `end` (rad/s), error included."""
    gain, error = _rate_loop_gain(gains, plant)
    counts = _told(plant, gain, error) & (plant.omega > end)
    if not counts.any():
        return 0.0
    least = singular_values(np.eye(2) + cascade_loop(gains, plant.at(counts)).L_u)[1] - error[counts]
    return float(1 / max(least.min(), 1e-6))


def _rate_loop_gain(gains: Gains, plant: PlantResponse) -> tuple[Signal, Signal]:
    """sigma_max of the rate loop, (K,), and the RMS of the error's norm: two deviations of an element."""
    controller = rate_controller(gains, plant.omega)[1]
    gain = singular_values(controller @ plant.G_i)[0]
    # Independent errors of the elements: C E has the covariance sum |C_ij|^2 dev_jk^2.
    spread = np.sqrt(np.abs(controller) ** 2 @ plant.deviation() ** 2)
    return gain, np.linalg.norm(spread, axis=(1, 2))


def _outer_loop_above(gains: Gains, plant: PlantResponse) -> float:
    """What the attitude path C_r Kp_o G_o may still add to the loop's gain above the plant's band.

    G_o falls at least like 1/w^2 there, see `loop_above`.
    """
    grid = np.linspace(plant.omega[-1], np.pi / gains.Ts, 200)
    path = np.linalg.norm(rate_controller(gains, grid)[0] @ gains.Kp_o, ord=2, axis=(1, 2)) * (
        plant.omega[-1] / grid
    ) ** 2
    return float(np.linalg.norm(plant.G_o[-1], ord=2) * path.max())


def _figures(
    above: float,
    plant: PlantResponse,
    nominal: CascadeLoop,
    draws: list[CascadeLoop],
    inner: Sequence[ReferenceModel],
) -> dict[str, Any]:
    identity = np.eye(2)
    m = np.stack([model.frequency_response(plant.omega) for model in inner], axis=1)[:, :, None] * identity

    def delta(loop: CascadeLoop) -> float:
        # D_M = M - (I - M) G K; G K and K G have the same loop, here cut at u.
        return float(np.linalg.norm(m - (identity - m) @ loop.L_i, ord=2, axis=(1, 2)).max())

    S = margins.sensitivity(nominal)
    loops = margins.axis_loops(S)
    found = [margins.phase_margin(loop, plant.omega) for loop in loops]
    drawn = np.array(
        [
            [margins.phase_margin(loop, plant.omega)[0] for loop in margins.axis_loops(margins.sensitivity(draw))]
            for draw in draws
        ]
    )
    spread = [2 * float(np.std(phases)) if np.isfinite(phases).all() else 0.0 for phases in drawn.T]
    disk = margins.disk_margin(S)
    gain_db, phase_deg = margins.simultaneous(disk)
    Ms, Ms_error = _sensitivity_peak(nominal, draws)
    return {
        "Ms": Ms,
        "Ms_error": Ms_error,
        "delta": delta(nominal),
        "delta_error": 2 * float(np.std([delta(loop) for loop in draws])),
        "distance": float(np.abs(np.linalg.det(identity + nominal.L_u)).min()),
        "disk_margin": disk,
        "simultaneous_gain_db": gain_db,
        "simultaneous_phase_deg": phase_deg,
        **margins.gain_margins(loops, above),
        "phase_margin_deg": {axis: phase for axis, (phase, _) in zip(margins.AXES, found, strict=True)},
        "phase_margin_error_deg": dict(zip(margins.AXES, spread, strict=True)),
        "delay_margin_ms": {axis: delay for axis, (_, delay) in zip(margins.AXES, found, strict=True)},
    }
