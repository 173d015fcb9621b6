"""What a gain set will do on the vehicle of a log: the figures that sets are compared by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mimopilot.tuning.analysis.manoeuvres import AMPLITUDE, Manoeuvres, manoeuvres
from mimopilot.tuning.axes import Law, axis_names
from mimopilot.tuning.design.disturbance_limit import ROOM
from mimopilot.tuning.design.free_gains import free_gains
from mimopilot.tuning.design.loop_gradient import LoopGradient
from mimopilot.tuning.plant.wide_response import WideResponse
from mimopilot.tuning.reference_model import second_order
from mimopilot.tuning.small_matrices import singular_values
from mimopilot.tuning.spec import DesignLimits

#: Time after a doublet that its RMS counts, s.
TAIL = 1.0
#: Off-axis RMS of a 10 degree doublet below which sets count as equally decoupled, deg: no pilot sees it.
DECOUPLED = 0.1

#: Least bandwidth over that of flown gains which keep the limit of Ms: nobody wants a slower vehicle.
SLOWEST = 1.0
#: rad/s. Noise above it is that of sensors and vibration: gusts are slower.
FAST = 30.0
#: Plants drawn for the error of a prediction.
DRAWS = 12
#: Share of a limit within which a design keeps it.
ROUNDING = 0.01

#: One number for each axis.
ByAxis = tuple[float, ...]


@dataclass(frozen=True)
class Prediction:
    """Figures of a gain set, predicted from the measured response; one number for each axis.

    Attributes
    ----------
    follow_deg, offaxis_deg : tuple of n float, deg
        RMS over the doublets of 10 degrees and 1 s after: error to the attitude model; angles of the other axes.
    disturbance_deg : tuple of n float, deg
        RMS of the angles over 1 s after the step of torque: 1.5 rad/s^2, on yaw 0.5 rad/s^2.
    noise : tuple of n float
        RMS of the torque (normalised) at hover that the log's noise causes.
    fast_noise : tuple of n float
        Its part above 30 rad/s, from sensors and vibration: gusts cause the rest.
    Ms : float
        Largest singular value of the sensitivity, cut at the torques.
    """

    follow_deg: ByAxis
    offaxis_deg: ByAxis
    disturbance_deg: ByAxis
    noise: ByAxis
    fast_noise: ByAxis
    Ms: float


def predict(gains: Law, plant: WideResponse, task: Manoeuvres) -> Prediction:
    """Figures of a gain set around a plant.

    Parameters
    ----------
    gains : Law
    plant : WideResponse
    task : Manoeuvres
        On the plant's frequencies.
    """
    free = free_gains(gains, plant.body)
    loop = LoopGradient(plant, free, free.vector(gains))
    power, eye = np.abs(loop.T) ** 2, np.eye(plant.axes, dtype=bool)
    follow = [_rms(np.abs(loop.T[:, i, i] - task.target) ** 2, task) for i in range(plant.axes)]
    offaxis = [_rms(power[:, ~eye[i], i].sum(axis=1), task) for i in range(plant.axes)]
    noise, fast = loop.noise_rms(), loop.noise_rms(FAST)
    disturbance = np.degrees(np.sqrt(np.einsum("ki,kji->i", task.step, np.abs(loop.D) ** 2) / TAIL))
    return Prediction(
        follow_deg=tuple(follow),
        offaxis_deg=tuple(offaxis),
        disturbance_deg=tuple(disturbance.tolist()),
        noise=tuple(noise.tolist()),
        fast_noise=tuple(fast.tolist()),
        Ms=_peak(loop),
    )


def sensitivity_peak(gains: Law, plant: WideResponse) -> float:
    """Ms of a set: largest singular value of the sensitivity, cut at the torques."""
    free = free_gains(gains, plant.body)
    return _peak(LoopGradient(plant, free, free.vector(gains)))


def _peak(loop: LoopGradient) -> float:
    return float(1 / singular_values(np.eye(loop.plant.axes) + loop.L_u[: loop.plant.band.stop])[1].min())


def _rms(power: np.ndarray, task: Manoeuvres) -> float:  # type: ignore[type-arg]
    """RMS over all doublets, deg, of a response whose squared size is `power`."""
    energy = task.doublets @ power
    return float(np.degrees(AMPLITUDE) * np.sqrt(np.mean(energy / (np.array(task.family.periods) + TAIL))))


def bandwidth(gains: Law, plant: WideResponse, candidates: Sequence[float], damping: float) -> float:
    """Bandwidth (rad/s) of the attitude model that a set follows best, of some candidates."""
    free = free_gains(gains, plant.body)
    T = LoopGradient(plant, free, free.vector(gains)).T
    task = manoeuvres(plant, second_order(candidates[0], damping, 0, plant.Ts), gains.filters)

    def error(omega: float) -> float:
        asked = replace(task, model=second_order(omega, damping, 0, plant.Ts))
        return float(asked.following @ sum(np.abs(T[:, i, i] - asked.target) ** 2 for i in range(plant.axes)))

    return min(candidates, key=error)


def offaxis_doubt(new: Law, flown: Law, plant: WideResponse, task: Manoeuvres) -> float:
    """Standard deviation (deg) of the difference of both sets' off-axis motion, from the error of the response."""
    generator, found = np.random.default_rng(0), []
    for _ in range(DRAWS):
        drawn = plant.draw(generator)
        ours, theirs = (np.linalg.norm(predict(gains, drawn, task).offaxis_deg) for gains in (new, flown))
        found.append(ours - theirs)
    return float(np.std(found))


def giving_way(new: ByAxis, flown: ByAxis) -> str:
    """Where a step of torque moves the vehicle farther than with flown gains, beyond `ROOM`; empty: on no axis."""
    names = axis_names(len(new))
    found = [
        f"{name} {ours:.2f} degrees, flown {theirs:.2f}"
        for name, ours, theirs in zip(names, new, flown, strict=True)
        if ours > theirs * ROOM * (1 + ROUNDING)
    ]
    return "; ".join(found)


def reasons_to_keep(
    new: Sequence[Prediction],
    flown: Sequence[Prediction],
    limits: DesignLimits,
    slower: float,
    doubts: Sequence[float] = (),
) -> list[str]:
    """Why a set is not better than the flown one on the same logs; empty: it is better.

    Parameters
    ----------
    new, flown : sequence of Prediction
        One for each log.
    limits : DesignLimits
    slower : float
        Bandwidth of its attitude model over that of the flown gains.
    doubts : sequence of float, deg, optional
        See `offaxis_doubt`, one for each log; none: the predictions are exact.
    """
    Ms, noise = limits.Ms, limits.noise
    reasons = []
    if slower < SLOWEST and all(one.Ms <= Ms for one in flown):
        reasons.append(f"its attitude is slower: {slower:.0%} of the flown bandwidth")
    for ours, theirs, doubt in zip(new, flown, doubts or [0.0] * len(new), strict=True):
        follow, before = (float(np.linalg.norm(one.follow_deg)) for one in (ours, theirs))
        if follow >= before:
            reasons.append(f"it follows its attitude model no better ({follow:.2f} degrees, flown {before:.2f})")
        offaxis, before = (float(np.linalg.norm(one.offaxis_deg)) for one in (ours, theirs))
        if offaxis > max(before, DECOUPLED):
            reasons.append(f"it moves the other axis more ({offaxis:.2f} degrees, flown {before:.2f})")
        elif offaxis > DECOUPLED and offaxis + doubt > before:
            reasons.append(
                f"the log cannot tell whether it moves the other axis less ({offaxis:.2f} degrees, flown {before:.2f}, "
                f"error of the difference {doubt:.2f}): record longer, excite more strongly, or in less wind"
            )
        gives = giving_way(ours.disturbance_deg, theirs.disturbance_deg)
        if gives and theirs.Ms <= Ms:
            reasons.append(f"a step of torque moves it farther ({gives})")
        if ours.Ms > max(Ms, theirs.Ms) * (1 + ROUNDING):
            reasons.append(f"its margin is thinner (Ms {ours.Ms:.2f}, flown {theirs.Ms:.2f})")
        pairs = [*zip(ours.noise, theirs.noise, strict=True), *zip(ours.fast_noise, theirs.fast_noise, strict=True)]
        ratio = max(a / b for a, b in pairs)
        if ratio > noise * (1 + ROUNDING):
            reasons.append(f"it drives the motors with {ratio:.2f} times the noise of the flown gains")
    return list(dict.fromkeys(reasons))
