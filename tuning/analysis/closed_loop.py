"""The cascade around a measured frequency response: loop transfers and the closed loop.

With the plant's responses G_i (rates) and G_o (angles) to the moment u known at some frequencies, everything
about the flown difference equation follows there: C_e = Kp + Ts Ki z/(z-1), C_d = Kd (1-a)(z-1)/(Ts (z-a)).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gain_stack import GainStack
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.plant.frequency_response import DRAWS, MIN_FREQUENCIES, PlantResponse
from mimopilot.tuning.reference_model import ReferenceModel
from mimopilot.tuning.statespace import StateSpace
from numpy.typing import NDArray
from scipy.optimize import least_squares

ACCURATE = 0.1

Complex = NDArray[np.complex128]
Signal = NDArray[np.float64]


def singular_values(matrices: Complex) -> tuple[Signal, Signal]:
    """Largest and smallest singular value of 2x2 matrices (..., 2, 2), each (...), in closed form: half of a tuning's
    time would be spent in LAPACK's.
    """
    size = np.sum(np.abs(matrices) ** 2, axis=(-2, -1))
    determinant = np.abs(matrices[..., 0, 0] * matrices[..., 1, 1] - matrices[..., 0, 1] * matrices[..., 1, 0])
    largest = np.sqrt((size + np.sqrt(np.maximum(size**2 - 4 * determinant**2, 0.0))) / 2)
    return largest, determinant / np.where(largest > 0, largest, 1.0)


@dataclass(frozen=True, eq=False)
class CascadeLoop:
    """Transfers of a gain set around a plant, (K, 2, 2) each.

    Attributes
    ----------
    L_i : rate loop alone, cut at u.
    L_u : whole loop, cut at u: (C_e + C_d) G_i + (C_e + Kff) Kp_o G_o.
    T_o : from attitude set-point to attitude.
    U_o : from attitude set-point to u.
    """

    L_i: Complex
    L_u: Complex
    T_o: Complex
    U_o: Complex


def inner_controllers(gains: Gains | GainStack, omega: Signal) -> tuple[Complex, Complex]:
    """C_e and C_d at frequencies omega (rad/s), (K, 2, 2) each; of a stack (sets, K, 2, 2)."""
    z = np.exp(1j * omega * gains.Ts)[:, None, None]
    a = gains.derivative_pole
    C_e = gains.Kp_i + gains.Ts * gains.Ki_i * z / (z - 1)
    C_d = gains.Kd_i * (1 - a) * (z - 1) / (gains.Ts * (z - a))
    return C_e, C_d


def whole_loop(gains: Gains | GainStack, plant: PlantResponse) -> tuple[Complex, Complex, Complex]:
    """L_i and L_u as in `CascadeLoop`, and the attitude path (C_e + Kff) Kp_o, (K, 2, 2) each; of a stack
    (sets, K, 2, 2).
    """
    C_e, C_d = inner_controllers(gains, plant.omega)
    forward = (C_e + gains.Kff_i) @ gains.Kp_o
    L_i = (C_e + C_d) @ plant.G_i
    return L_i, L_i + forward @ plant.G_o, forward


def cascade_loop(gains: Gains, plant: PlantResponse) -> CascadeLoop:
    """The transfers of `CascadeLoop` for a gain set on a measured plant."""
    L_i, L_u, forward = whole_loop(gains, plant)
    U_o: Complex = np.linalg.solve(np.eye(2) + L_u, forward).astype(np.complex128)
    return CascadeLoop(L_i, L_u, plant.G_o @ U_o, U_o)


def model_spectral_radius(gains: Gains, plant: StateSpace) -> float:
    """Of a gain set around an identified plant, without limits: the larger one of the rate loop and of the cascade.

    Parameters
    ----------
    gains : Gains
    plant : StateSpace
        From torque to body rates; the angles are their integrals.
    """
    n, Ts, a = len(plant.A), gains.Ts, gains.derivative_pole
    start = np.eye(n + 8)
    state, rate, slope, integral, angle = np.split(start, [n, n + 2, n + 4, n + 6])
    now = plant.C @ state
    angle = angle + Ts / 2 * (now + rate)
    slope = a * slope + (1 - a) / Ts * (now - rate)
    radius = 0.0
    for wanted in (np.zeros_like(now), -gains.Kp_o @ angle):
        summed = integral + Ts * gains.Ki_i @ (wanted - now)
        torque = gains.Kp_i @ (wanted - now) - gains.Kd_i @ slope + gains.Kff_i @ wanted + summed
        step = np.vstack([plant.A @ state + plant.B @ torque, now, slope, summed, angle])
        if not wanted.any():  # nobody looks at the angle
            step = step[:-2, :-2]
        if not np.any(gains.Ki_i):  # the integrals stand still
            moving = np.r_[0 : n + 4, n + 6 : len(step)]
            step = step[np.ix_(moving, moving)]
        radius = max(radius, float(np.abs(np.linalg.eigvals(step)).max()))
    return radius


def doublet_spectrum(omega: Signal, seconds: float) -> Complex:
    """Fourier transform of a doublet of height 1, +1 then -1 for half of its length each.

    Parameters
    ----------
    omega : (K,) array, rad/s
    seconds : float, s
        Its whole length.
    """
    s = 1j * omega
    spectrum: Complex = (1 - np.exp(-s * seconds / 2)) ** 2 / s
    return spectrum


def refine_outer(
    gains: Gains,
    plant: PlantResponse,
    models: Sequence[ReferenceModel],
    full: bool,
    doublet_s: float | None = None,
    draw_inner: Callable[[Gains, np.random.Generator], Gains] = lambda gains, generator: gains,
) -> tuple[Gains, Signal]:
    """Kp_o that brings the measured closed loop closest to the outer reference model.

    VRFT weighs what a P controller cannot do by the experiment's spectrum; here the same measured data weigh it by
    that of set-points: |T_o - M_o|^2 / omega, between an impulse's (J_MR, (3.1)) and a step's, or the spectrum of a
    doublet. Gauss-Newton from the VRFT gains, four numbers at most; no model is fitted.

    Parameters
    ----------
    gains : Gains
        A complete set; its rate loop is kept.
    plant : PlantResponse
        From the same experiment.
    models : sequence of 2 ReferenceModel
        Of the attitude loop.
    full : bool
        False: the diagonal only (SISO).
    doublet_s : float, s, optional
        Length of the doublet whose spectrum weighs the error.
    draw_inner : callable, optional
        Gives the set with rate gains that the log's noise could have given as well.

    Returns
    -------
    gains : Gains
        With the new Kp_o.
    deviations : (2, 2) array, 1/s
        Standard deviation of its elements, from the errors of the measured response and of the rate gains.

    Raises
    ------
    TuningError
        When the response is known well at too few frequencies.
    """
    use = plant.known() & (plant.relative_error() < ACCURATE)
    if use.sum() < MIN_FREQUENCIES:
        raise TuningError(f"only {use.sum()} frequencies of the measured response are known to 10 %")
    plant = plant.at(use).extended()
    target = np.stack([model.frequency_response(plant.omega) for model in models], axis=1)[:, :, None] * np.eye(2)
    where = np.ones((2, 2), bool) if full else np.eye(2, dtype=bool)
    spectrum = plant.omega**-0.5 if doublet_s is None else np.abs(doublet_spectrum(plant.omega, doublet_s))
    # An integral over frequency: where the response's windows are narrow its values are many.
    spectrum = spectrum * np.sqrt(np.gradient(plant.omega))
    weight = where * spectrum[:, None, None]

    def placed(values: Signal, around: Gains = gains) -> Gains:
        Kp_o = np.zeros((2, 2))
        Kp_o[where] = values
        return replace(around, Kp_o=Kp_o)

    def distance(values: Signal, of: PlantResponse = plant, around: Gains = gains) -> Signal:
        error = (cascade_loop(placed(values, around), of).T_o - target) * weight
        return np.concatenate([error.real.ravel(), error.imag.ravel()])

    found = least_squares(distance, gains.Kp_o[where], x_scale="jac")
    generator = np.random.default_rng(0)
    shifts = np.array(
        [distance(found.x, plant.draw(generator), draw_inner(gains, generator)) - found.fun for _ in range(DRAWS)]
    )
    deviations = np.zeros((2, 2))
    deviations[where] = np.std(shifts @ np.linalg.pinv(found.jac).T, axis=0)
    return placed(found.x), deviations
