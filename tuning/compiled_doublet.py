"""A doublet around a linear plant, compiled: a refinement flies thousands."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

Signal = NDArray[np.float64]


@numba.njit(cache=True, error_model="numpy")
def fly(A, B, C, trim, setpoint, gains, limits, Ts, pole, angles, moments):  # type: ignore[no-untyped-def]
    """The flown difference equation, axis by axis and gain set by gain set, without noise.

    Parameters
    ----------
    A, B, C : arrays
        Of the plant from moment to body rates.
    trim : (2,) array
        Moment that holds the vehicle level.
    setpoint : (N,) array, rad
        Of the axis that moves.
    gains : (K, 5, 2, 2) array
        Kp_o, Kp_i, Ki_i, Kd_i, Kff_i of every set.
    limits : (3, 2) array
        Of rates, moments and integral.
    Ts, pole : float
        Period (s) and derivative pole.
    angles, moments : (2, K, N, 2) arrays
        Are filled; first index: the axis that moves.
    """
    for moving in range(2):
        for k in range(len(gains)):
            Kp_o, Kp_i, Ki_i, Kd_i, Kff_i = gains[k]
            state, ahead = np.zeros(len(A)), np.zeros(len(A))
            angle, rate, now = np.zeros(2), np.zeros(2), np.zeros(2)
            integral, slope, wanted, moment = np.zeros(2), np.zeros(2), np.zeros(2), np.zeros(2)
            for n in range(len(setpoint)):
                for i in range(2):
                    now[i] = 0.0
                    for j in range(len(A)):
                        now[i] += C[i, j] * state[j]
                    angle[i] += Ts / 2 * (now[i] + rate[i])
                    slope[i] = pole * slope[i] + (1 - pole) / Ts * (now[i] - rate[i])
                for i in range(2):
                    demand = Kp_o[i, moving] * setpoint[n] - Kp_o[i, 0] * angle[0] - Kp_o[i, 1] * angle[1]
                    wanted[i] = min(max(demand, -limits[0, i]), limits[0, i])
                for i in range(2):
                    rest, growth = 0.0, 0.0
                    for j in range(2):
                        error = wanted[j] - now[j]
                        rest += Kp_i[i, j] * error - Kd_i[i, j] * slope[j] + Kff_i[i, j] * wanted[j]
                        growth += Ts * Ki_i[i, j] * error
                    # Moments are counted from the trim, which the flown integral holds.
                    lowest, highest = -limits[1, i] - trim[i], limits[1, i] - trim[i]
                    tried = rest + integral[i] + growth
                    if not ((tried > highest and growth > 0) or (tried < lowest and growth < 0)):
                        grown = integral[i] + growth
                        integral[i] = min(max(grown, -limits[2, i] - trim[i]), limits[2, i] - trim[i])
                    moment[i] = min(max(rest + integral[i], lowest), highest)
                    angles[moving, k, n, i], moments[moving, k, n, i] = angle[i], moment[i] + trim[i]
                for i in range(len(A)):
                    ahead[i] = B[i, 0] * moment[0] + B[i, 1] * moment[1]
                    for j in range(len(A)):
                        ahead[i] += A[i, j] * state[j]
                state[:] = ahead
                rate[:] = now
