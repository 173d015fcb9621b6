"""Will the loop be stable? Answered before flight, from the log that the gains were tuned on.

The measured frequency response decides by Nyquist's count: det(n (I + L)) must not go round 0, for the rate loop
alone and for the whole cascade cut at u, n = 1 - m cancelling the integrators at z = 1. Other plants that the
experiment allows are drawn from its error; what happens to any of them counts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from tuning.closed_loop import (
    DRAWS,
    MIN_FREQUENCIES,
    CascadeLoop,
    PlantResponse,
    cascade_loop,
    inner_controllers,
    singular_values,
)
from tuning.gain_stack import GainStack
from tuning.gains import Gains
from tuning.reference import ReferenceModel

#: Above the band the rate loop's gain may be at most this, if the plant falls like an integrator from its end on.
HIGH_FREQUENCY_LOOP = 0.5
#: Where the band begins the sensitivity may at most be this: the loop must be in charge of what nobody measured below.
LOW_FREQUENCY_SENSITIVITY = 0.5
#: Neighbouring frequencies differ by this share at most: a loop at the limit has a peak that is narrower than the
#: response's own grid.
DENSE = 0.05

CERTIFIED = "certified"
THIN = "stable, thin margin"
NOT_CERTIFIED = "not certified"
UNSTABLE = "unstable"

Complex = NDArray[np.complex128]
Signal = NDArray[np.float64]


@dataclass(frozen=True)
class Thresholds:
    """What makes a margin thin.

    Attributes
    ----------
    Ms : float
        Largest peak of the sensitivity.
    phase_deg : float, deg
        Smallest phase margin.
    """

    Ms: float = 2.5
    phase_deg: float = 25.0


@dataclass(frozen=True)
class Certificate:
    """What the log says of a gain set.

    Attributes
    ----------
    verdict : str
        ``certified``, ``stable, thin margin``, ``not certified`` or ``unstable``.
    reason : str
        Why, and the assumptions made outside of the band.
    figures : mapping
        ``Ms``, ``Ms_error`` (two standard errors), ``delta``, ``delta_error``, ``distance`` of the determinant to
        0, ``disk_margin``, and by axis ``gain_margin_db``, ``phase_margin_deg``, ``delay_margin_ms``;
        ``simultaneous_gain_db`` and ``simultaneous_phase_deg`` for all axes at once.
    band : tuple of 2 float, rad/s
        Where the response is known.
    log_sha256, matrices_sha256 : str
        What it was made from, and for which matrices: an edited matrix voids it.
    """

    verdict: str
    reason: str
    figures: Mapping[str, Any]
    band: tuple[float, float]
    log_sha256: str
    matrices_sha256: str

    def as_table(self) -> dict[str, Any]:
        """Plain values, for the gains file and JSON."""
        table = asdict(self)
        table["band"] = list(self.band)
        return table


def certify(
    gains: Gains,
    plant: PlantResponse,
    inner: Sequence[ReferenceModel],
    outer: Sequence[ReferenceModel],
    log_sha256: str = "",
    thresholds: Thresholds | None = None,
) -> Certificate:
    """Verdict on a gain set.

    Parameters
    ----------
    gains : Gains
        The set.
    plant : PlantResponse
        Measured response, from `tuning.closed_loop.plant_response`.
    inner, outer : sequence of 2 ReferenceModel
        Of the rate and the attitude loop, roll and pitch; they only normalise the determinants.
    log_sha256 : str
        Of the log that the response comes from.
    thresholds : Thresholds, optional
        What is thin.
    """
    thresholds = thresholds or Thresholds()

    def verdict(text: str, reason: str, figures: Mapping[str, Any], band: tuple[float, float]) -> Certificate:
        return Certificate(text, reason, figures, band, log_sha256, gains.matrices_sha256())

    plant, above = _certified_band(gains, plant)
    if len(plant.omega) < MIN_FREQUENCIES:
        return verdict(NOT_CERTIFIED, "the excitation reaches fewer than 8 frequencies", {}, (0.0, 0.0))
    band = (float(plant.omega[0]), float(plant.omega[-1]))
    dense, nominal, draws = _loops(gains, plant)
    normal = _Normaliser(inner, outer, dense.omega)
    windings = [normal.windings(loop) for loop in draws]
    figures = _figures(above, dense, nominal, draws, inner)
    beyond = _beyond_the_band(gains, plant, above)
    if beyond:
        return verdict(NOT_CERTIFIED, beyond, figures, band)
    doubtful = sum(any(w) for w in windings)
    if any(normal.windings(nominal)) and doubtful > DRAWS / 2:
        where = "the rate loop alone" if normal.windings(nominal)[0] else "the whole cascade"
        return verdict(UNSTABLE, f"the determinant goes round 0: {where} is unstable", {}, band)
    if doubtful:
        reason = f"too close to the limit to tell: {doubtful} of {DRAWS} plants that the log allows are unstable"
        return verdict(NOT_CERTIFIED, reason, figures, band)
    assumed = (
        f"assumed: above {band[1]:.0f} rad/s the plant falls at least like an integrator; "
        f"below {band[0]:.1f} rad/s the integral term acts as there"
    )
    thin = []
    if figures["Ms"] + figures["Ms_error"] > thresholds.Ms:
        thin.append(f"Ms {figures['Ms']:.2f} + {figures['Ms_error']:.2f} is above {thresholds.Ms:g}")
    phase = min(figures["phase_margin_deg"].values())
    if phase < thresholds.phase_deg:
        thin.append(f"phase margin {phase:.0f} degrees is below {thresholds.phase_deg:g}")
    return verdict(THIN if thin else CERTIFIED, "; ".join([*thin, assumed]), figures, band)


def sensitivity_peak(gains: Gains, plant: PlantResponse) -> tuple[float, float]:
    """Peak of the sensitivity at u and two standard errors of it: the certificate's ``Ms`` and ``Ms_error``.

    Parameters
    ----------
    gains : Gains
    plant : PlantResponse
        With at least 8 coherent frequencies in a row.
    """
    return _sensitivity_peak(*_loops(gains, _certified_band(gains, plant)[0])[1:])


def _sensitivity_peak(nominal: CascadeLoop, draws: list[CascadeLoop]) -> tuple[float, float]:
    def peak(loop: CascadeLoop) -> float:
        return float(np.linalg.norm(np.linalg.inv(np.eye(2) + loop.L_u), ord=2, axis=(1, 2)).max())

    return peak(nominal), 2 * float(np.std([peak(loop) for loop in draws]))


def _certified_band(gains: Gains, plant: PlantResponse) -> tuple[PlantResponse, float]:
    """The longest coherent stretch, up to where the loop is small for good: nothing more has to be known above, and
    the noisy end of the band is left out. With it what the loop's gain may still reach above.
    """
    plant = plant.at(plant.coherent_run())
    if len(plant.omega) < MIN_FREQUENCIES:
        return plant, np.inf
    above = loop_above(gains, plant)
    small = above <= HIGH_FREQUENCY_LOOP
    settled = len(small) - int(np.argmin(small[::-1])) if not small.all() else 1
    last = min(max(settled + 1, MIN_FREQUENCIES), len(small)) - 1
    return plant.at(np.arange(last + 1)), float(above[last])


def _loops(gains: Gains, plant: PlantResponse) -> tuple[PlantResponse, CascadeLoop, list[CascadeLoop]]:
    """The plant on a grid that shows narrow peaks, the loop around it, and around others that the experiment allows."""
    generator, dense = np.random.default_rng(0), plant.interpolated(DENSE)
    others = (plant.draw(generator).interpolated(DENSE) for _ in range(DRAWS))
    return dense, cascade_loop(gains, dense), [cascade_loop(gains, other) for other in others]


class _Normaliser:
    """det(n (I + L)) along the band and how often it goes round 0."""

    def __init__(
        self,
        inner: Sequence[ReferenceModel],
        outer: Sequence[ReferenceModel],
        omega: Signal,
    ) -> None:
        # n is a product of scalars 1 - m: its phase is followed on a fine grid from 0 to Nyquist, once.
        fine = np.linspace(omega[0], np.pi / inner[0].Ts, 4000)

        def ones_minus(models: Sequence[ReferenceModel], at: Signal) -> Complex:
            return np.stack([1 - model.frequency_response(at) for model in models], axis=1)

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


def _beyond_the_band(gains: Gains, plant: PlantResponse, loop: float) -> str:
    """Why nothing can be said outside of the band, where the rate loop's gain may still reach `loop`; empty when the
    assumptions hold.
    """
    if loop > HIGH_FREQUENCY_LOOP:
        return (
            f"excitation ends at {plant.omega[-1]:.0f} rad/s, where the loop's gain may still reach {loop:.2f} "
            f"(at most {HIGH_FREQUENCY_LOOP:g}): excite a wider band"
        )
    if loop + _outer_loop_above(gains, plant) >= 1:
        return (
            f"excitation ends at {plant.omega[-1]:.0f} rad/s, where the whole cascade's gain may still reach 1: "
            "excite a wider band"
        )
    S = np.linalg.inv(np.eye(2) + cascade_loop(gains, plant.at(np.array([0]))).L_u[0])
    remaining = float(np.linalg.norm(S, ord=2))
    if remaining > LOW_FREQUENCY_SENSITIVITY:
        return (
            f"excitation begins at {plant.omega[0]:.1f} rad/s, where the sensitivity is still {remaining:.2f} (at most "
            f"{LOW_FREQUENCY_SENSITIVITY:g}), and nothing is known of the loop below: excite lower frequencies, or ask "
            "for a faster attitude loop"
        )
    if np.any(gains.Ki_i) and integral_action(gains.Ki_i, plant) <= 0:
        return (
            f"excitation begins at {plant.omega[0]:.1f} rad/s, where the loop's integral term is not positive: "
            "excite lower frequencies, or record longer"
        )
    if np.linalg.eigvalsh(gains.Kp_o + gains.Kp_o.T)[0] <= 0:
        return f"below {plant.omega[0]:.1f} rad/s the attitude loop's gain is not positive in every direction"
    return ""


def loop_above(gains: Gains | GainStack, plant: PlantResponse) -> Signal:
    """What the rate loop's gain may still reach above each frequency of the plant, (K,); of a stack (sets, K).

    The supremum over w > w_k of sigma_max(G(w_k)) (w_k / w) sigma_max(C_e + C_d)(w). A rate is the integral of the
    moment over the inertia, behind motors and filters, so |G| falls at least like 1/w; that it does not grow would be
    weaker, but then a filtered D counts with its gain at the Nyquist frequency, where no vehicle answers. That w |G|
    does not rise is also what takes the noise off: from its highest value on it is fitted by such a sequence.
    """
    grid = np.concatenate([plant.omega, np.linspace(plant.omega[-1], np.pi / gains.Ts, 200)[1:]])
    C_e, C_d = inner_controllers(gains, grid)
    falling = singular_values(C_e + C_d)[0] / grid
    highest = np.maximum.accumulate(falling[..., ::-1], axis=-1)[..., ::-1][..., : len(plant.omega)]
    gain: Signal = singular_values(plant.G_i)[0] * plant.omega
    top = int(np.argmax(gain))
    gain[top:] = isotonic_regression(gain[top:], increasing=False).x
    reached: Signal = gain * highest
    return reached


def integral_action(Ki_i: Signal, plant: PlantResponse) -> Signal:
    """The least that integral terms do in any direction where the response begins: Ki_i G_i, its smallest eigenvalue.

    Parameters
    ----------
    Ki_i : (..., 2, 2) array, 1/rad
    plant : PlantResponse

    Returns
    -------
    (...) array, 1/s
    """
    # The plant there is a real matrix times a scalar between a gain and an integrator: take that phase off.
    turned = plant.G_i[0] * np.exp(-1j * np.angle(np.trace(plant.G_i[0])))
    action = Ki_i @ turned.real
    least: Signal = np.linalg.eigvalsh((action + np.swapaxes(action, -1, -2)) / 2)[..., 0]
    return least


def _outer_loop_above(gains: Gains, plant: PlantResponse) -> float:
    """What the attitude path (C_e + Kff) Kp_o G_o may still add to the loop's gain above the plant's band.

    G_o falls at least like 1/w^2 there, see `loop_above`.
    """
    grid = np.linspace(plant.omega[-1], np.pi / gains.Ts, 200)
    C_e, _ = inner_controllers(gains, grid)
    path = np.linalg.norm((C_e + gains.Kff_i) @ gains.Kp_o, ord=2, axis=(1, 2)) * (plant.omega[-1] / grid) ** 2
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

    S = np.linalg.inv(identity + nominal.L_u)
    disk = 1 / float(np.linalg.norm(S - identity / 2, ord=2, axis=(1, 2)).max())
    ratio = (2 + disk) / (2 - disk) if disk < 2 else np.inf
    by_axis = {
        axis: _axis_margins((1 / S[:, i, i] - 1).astype(np.complex128), plant.omega)
        for i, axis in enumerate(("roll", "pitch"))
    }
    # Above the band the loop is at most this large: no gain margin is claimed beyond what that leaves.
    ceiling = -20 * float(np.log10(above)) if above > 0 else np.inf
    distance = np.abs(np.linalg.det(identity + nominal.L_u)).min()
    Ms, Ms_error = _sensitivity_peak(nominal, draws)
    return {
        "Ms": Ms,
        "Ms_error": Ms_error,
        "delta": delta(nominal),
        "delta_error": 2 * float(np.std([delta(loop) for loop in draws])),
        "distance": float(distance),
        "disk_margin": disk,
        "simultaneous_gain_db": float(20 * np.log10(ratio)),
        "simultaneous_phase_deg": float(2 * np.degrees(np.arctan(disk / 2))),
        "gain_margin_db": {axis: min(margins[0], ceiling) for axis, margins in by_axis.items()},
        "phase_margin_deg": {axis: margins[1] for axis, margins in by_axis.items()},
        "delay_margin_ms": {axis: margins[2] for axis, margins in by_axis.items()},
    }


def _axis_margins(loop: Complex, omega: Signal) -> tuple[float, float, float]:
    """Smallest gain (dB, up or down), phase (deg) and delay (ms) margin of one loop, the other axis closed."""
    from control import stability_margins  # takes longer to import than all of the rest

    data = (np.abs(loop), np.degrees(np.unwrap(np.angle(loop))), omega)
    gains, phases, _, _, crossings, _ = (np.atleast_1d(part) for part in stability_margins(data, returnall=True))
    delays = np.radians(phases % 360.0) / crossings * 1e3
    decibels = np.abs(20 * np.log10(gains[gains > 0]))

    def smallest(values: Signal) -> float:
        return float(np.min(values, initial=np.inf))

    return smallest(decibels), smallest(np.abs(phases)), smallest(delays)
