"""The cascade around a measured frequency response: open and closed loop.

G_i (rates) and G_o (angles) are the plant's responses to the torque u at the measured frequencies; `tuning.law` gives
the controller's response there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning import law
from mimopilot.tuning.axes import Law
from mimopilot.tuning.control_laws import control_law
from mimopilot.tuning.law_state_space import state_space
from mimopilot.tuning.law_terms import ERROR, RATE, SETPOINT
from mimopilot.tuning.plant.frequency_response import PlantResponse
from mimopilot.tuning.plant.wide_response import WideResponse
from mimopilot.tuning.statespace import StateSpace

Complex = NDArray[np.complex128]
Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CascadeLoop:
    """Frequency responses of a gain set around a plant, (K, n, n) each.

    Attributes
    ----------
    L_i : rate loop alone, cut at u.
    L_u : whole loop, cut at u: C_y G_i + C_o G_o, with u = C_ref r_o - C_o y_o - C_y y_i.
    T_o : from attitude setpoint to attitude.
    U_o : from attitude setpoint to u.
    """

    L_i: Complex
    L_u: Complex
    T_o: Complex
    U_o: Complex


def whole_loop(gains: Law, plant: PlantResponse | WideResponse) -> tuple[Complex, Complex, Complex]:
    """L_i and L_u as in `CascadeLoop`, and the setpoint's path C_ref, (K, n, n) each."""
    C_ref, C_o, C_y = law.cascade_response(gains, plant.omega)
    L_i = C_y @ plant.G_i
    return L_i, L_i + C_o @ plant.G_o, C_ref


def cascade_loop(gains: Law, plant: PlantResponse | WideResponse) -> CascadeLoop:
    """Open and closed loop of a gain set around a measured plant."""
    L_i, L_u, forward = whole_loop(gains, plant)
    U_o: Complex = np.linalg.solve(np.eye(plant.axes) + L_u, forward).astype(np.complex128)
    return CascadeLoop(L_i, L_u, plant.G_o @ U_o, U_o)


def closed_loop_poles(gains: Law, plant: StateSpace) -> Complex:
    """Poles of the closed loop around a plant, without limits: those of the rate loop alone, then of the whole cascade.

    Parameters
    ----------
    gains : Law
    plant : StateSpace
        From torque to body rates; the angles are their integrals.
    """
    flown = state_space(law.rate_matrices(gains), gains.filters)
    n, m = len(plant.A), len(flown.A)
    axes = len(plant.C)
    start = np.eye(n + m + 2 * axes)
    state, memory, rate, angle = np.split(start, [n, n + m, n + m + axes])
    now = plant.C @ state
    before, angle = angle, angle + gains.Ts / 2 * (now + rate)
    poles = []
    # The attitude controller's setpoint is that of this period or, with a delay, of the one before.
    measured = before if control_law(gains.filters).delay else angle
    for setpoint in (np.zeros_like(now), -law.attitude_matrix(gains) @ measured):
        signals = {ERROR: setpoint - now, RATE: now, SETPOINT: setpoint}
        torque = flown.C @ memory + sum(flown.D[signal] @ values for signal, values in signals.items())
        ahead = flown.A @ memory + sum(flown.B[signal] @ values for signal, values in signals.items())
        step = np.vstack([plant.A @ state + plant.B @ torque, ahead, now, angle])
        kept = np.ones(len(step), bool)
        if not setpoint.any():  # the rate loop alone: the angle is not fed back
            kept[-axes:] = False
        # A filter whose output is not used, such as an integral with zero gain, is not part of the loop.
        kept[n : n + m] = np.any(flown.C, axis=0)
        poles.append(np.linalg.eigvals(step[np.ix_(kept, kept)]))
    found: Complex = np.concatenate(poles).astype(np.complex128)
    return found


def model_spectral_radius(gains: Law, plant: StateSpace) -> float:
    """Spectral radius of the closed loop around an identified plant; see `closed_loop_poles`."""
    return float(np.abs(closed_loop_poles(gains, plant)).max())


def slow_growth(gains: Law, plant: StateSpace, below: float) -> float | None:
    """Frequency (rad/s) of an unstable mode of the loop around a model, slower than `below`; None: there is none.

    Parameters
    ----------
    gains : Law
    plant : StateSpace
        From torque to body rates.
    below : float, rad/s
    """
    poles = closed_loop_poles(gains, plant)
    modes = np.log(poles[np.abs(poles) > 0]) / gains.Ts
    growing = np.abs(modes[(modes.real > 0) & (np.abs(modes) < below)])
    return float(growing.min()) if len(growing) else None


def doublet_spectrum(omega: Signal, seconds: float) -> Complex:
    """Fourier transform of a doublet: +1, then -1, each for half of its length.

    Parameters
    ----------
    omega : (K,) array, rad/s
    seconds : float, s
        Whole length.
    """
    s = 1j * omega
    spectrum: Complex = (1 - np.exp(-s * seconds / 2)) ** 2 / s
    return spectrum
