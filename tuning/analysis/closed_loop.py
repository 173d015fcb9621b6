"""The cascade around a measured frequency response: loop transfers and the closed loop.

The plant's responses G_i (rates) and G_o (angles) to the torque u are known at some frequencies; `tuning.law` gives
the controller's there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from mimopilot.tuning import law
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
    L_u : whole loop, cut at u: C_y G_i + C_r Kp_o G_o, with u = C_r r_i - C_y y_i.
    T_o : from attitude set-point to attitude.
    U_o : from attitude set-point to u.
    """

    L_i: Complex
    L_u: Complex
    T_o: Complex
    U_o: Complex


def whole_loop(gains: Gains | GainStack, plant: PlantResponse) -> tuple[Complex, Complex, Complex]:
    """L_i and L_u as in `CascadeLoop`, and the attitude path C_r Kp_o, (K, 2, 2) each; of a stack (sets, K, 2, 2)."""
    C_r, C_y = rate_controller(gains, plant.omega)
    forward = C_r @ gains.Kp_o
    L_i = C_y @ plant.G_i
    return L_i, L_i + forward @ plant.G_o, forward


def rate_controller(gains: Gains | GainStack, omega: Signal) -> tuple[Complex, Complex]:
    """C_r and C_y of u = C_r r - C_y y at frequencies omega (rad/s), (K, 2, 2) each; of a stack (sets, K, 2, 2)."""
    return law.rate_response(law.rate_matrices(gains), gains.filters, omega)


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
    flown = law.state_space(law.rate_matrices(gains), gains.filters)
    n, m = len(plant.A), len(flown.A)
    start = np.eye(n + m + 4)
    state, memory, rate, angle = np.split(start, [n, n + m, n + m + 2])
    now = plant.C @ state
    angle = angle + gains.Ts / 2 * (now + rate)
    radius = 0.0
    for setpoint in (np.zeros_like(now), -gains.Kp_o @ angle):
        signals = {law.ERROR: setpoint - now, law.RATE: now, law.SETPOINT: setpoint}
        torque = flown.C @ memory + sum(flown.D[signal] @ values for signal, values in signals.items())
        ahead = flown.A @ memory + sum(flown.B[signal] @ values for signal, values in signals.items())
        step = np.vstack([plant.A @ state + plant.B @ torque, ahead, now, angle])
        kept = np.ones(len(step), bool)
        if not setpoint.any():  # the rate loop alone: the angle is not fed back
            kept[-2:] = False
        # A filter whose output is not used, such as an integral without a gain, is no part of the loop.
        kept[n : n + m] = np.any(flown.C, axis=0)
        radius = max(radius, float(np.abs(np.linalg.eigvals(step[np.ix_(kept, kept)])).max()))
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
