"""Doublets simulated around a linear plant and its motors, compiled: a refinement needs thousands."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mimopilot.common.compiled import compiled
from mimopilot.tuning import law

Signal = NDArray[np.float64]

#: Smallest cosine of the tilt that the collective compensates: twice the weight, as the simulated autopilot does.
MIN_TILT_COSINE = 0.5
#: Numbers of the signals that a term acts on.
ERROR, RATE, SETPOINT = range(3)
_SIGNALS = {law.ERROR: ERROR, law.RATE: RATE, law.SETPOINT: SETPOINT}


def law_terms(filters: law.Filters) -> Signal:
    """Terms of the law as numbers, (4, 5): signal, sign, direct gain, zero and pole of the filter."""
    numbers = []
    for term in law.LOOP_TERMS.values():
        shape = term.filter(filters)
        response = (1.0, 0.0, 0.0) if shape is None else (shape.direct, shape.zero, shape.pole)
        numbers.append([float(_SIGNALS[term.signal]), float(term.sign), *response])
    return np.array(numbers)


@compiled
def allocate_commands(part, rest, commands):  # type: ignore[no-untyped-def]
    """Fill `commands` (n,) with `rest` + share `part` within 0 to 1, and return the largest share possible.

    The collective is lowered, never raised, where a command would exceed 1. A share above 1 is applied as 1.
    """
    share = np.inf
    for i in range(len(part)):
        if part[i] < 0.0:
            share = min(share, rest[i] / -part[i])
        for j in range(len(part)):
            if part[i] > part[j]:
                share = min(share, (1.0 + rest[j] - rest[i]) / (part[i] - part[j]))
    above, given = 0.0, min(max(share, 0.0), 1.0)
    for i in range(len(part)):
        commands[i] = rest[i] + given * part[i]
        above = max(above, commands[i] - 1.0)
    for i in range(len(part)):
        commands[i] = min(max(commands[i] - above, 0.0), 1.0)
    return share


@compiled
def anti_windup_share(margin, soft):  # type: ignore[no-untyped-def]
    """Share of the integral's growth that anti-windup allows, `margin` before the limit: 1 or 0, or in between."""
    if soft > 0.0:
        return min(max(0.5 + margin / soft, 0.0), 1.0)
    return 1.0 if margin >= 0.0 else 0.0


@compiled
def simulate_doublets(A, B, C, trim, motors, setpoint, gains, terms, limits, Ts, soft, angles, moments):  # type: ignore[no-untyped-def]
    """Simulate the law of `tuning.law` with its limits, axis by axis and gain set by gain set, without noise.

    The plant is linear around hover and includes the rotors' lag. The rotors' speed lags behind the commands, which
    are thrust fractions f = w^2, so large commands produce another torque than a linear lag. The plant's input is the
    torque command that gives the same torque behind a linear lag.

    Parameters
    ----------
    A, B, C : arrays
        Plant from torque to body rates.
    trim : (2,) array
        Torque that holds the vehicle level.
    motors : tuple
        mixer (n, 2), its inverse (2, n), hover (n,) and exp(-Ts / lag) of the rotors; n = 0: linear motors.
    setpoint : (N,) array, rad
        Of the moving axis.
    gains : (K, 5, 2, 2) array
        Kp_o, then the matrices of `terms`, of every set.
    terms : (4, 5) array
        See `law_terms`.
    limits : (3, 2) array
        Of rates, torque and integral.
    Ts : float, s
    soft : float
        Torque over which anti-windup switches gradually. As flown it is 0: angles then jump at tiny changes of the
        gains, which stops an optimisation.
    angles, moments : (2, K, N, 2) arrays
        Filled; first index: the moving axis.
    """
    mixer, inverse, hover, decay = motors
    n, weight = len(hover), hover.sum() / max(len(hover), 1)
    level = hover - mixer @ trim
    for moving in range(2):
        for k in range(len(gains)):
            Kp_o = gains[k, 0]
            state, ahead = np.zeros(len(A)), np.zeros(len(A))
            angle, rate, now = np.zeros(2), np.zeros(2), np.zeros(2)
            integral, wanted, moment = np.zeros(2), np.zeros(2), np.zeros(2)
            filtered, before, signals = np.zeros((len(terms), 2)), np.zeros((len(terms), 2)), np.zeros((3, 2))
            part, rest, commands = np.zeros(n), np.zeros(n), np.zeros(n)
            speed, acting, equivalent, margin = np.sqrt(hover), np.zeros(2), np.zeros(2), np.inf
            for t in range(len(setpoint)):
                for i in range(2):
                    now[i] = 0.0
                    for j in range(len(A)):
                        now[i] += C[i, j] * state[j]
                    angle[i] += Ts / 2 * (now[i] + rate[i])
                for i in range(2):
                    demand = Kp_o[i, moving] * setpoint[t] - Kp_o[i, 0] * angle[0] - Kp_o[i, 1] * angle[1]
                    wanted[i] = min(max(demand, -limits[0, i]), limits[0, i])
                for j in range(2):
                    signals[ERROR, j], signals[RATE, j], signals[SETPOINT, j] = wanted[j] - now[j], now[j], wanted[j]
                for q in range(len(terms)):
                    source, size, zero, pole = int(terms[q, 0]), terms[q, 2], terms[q, 3], terms[q, 4]
                    for j in range(2):
                        step = signals[source, j] - zero * before[q, j]
                        before[q, j] = signals[source, j]
                        # Of an integrator only its growth is kept: `integral` is the sum, after anti-windup.
                        filtered[q, j] = step if pole == 1.0 else pole * filtered[q, j] + size * step
                for i in range(2):
                    direct, growth = 0.0, 0.0
                    for j in range(2):
                        added = 0.0
                        for q in range(len(terms)):
                            if terms[q, 4] == 1.0:
                                growth += terms[q, 1] * terms[q, 2] * gains[k, 1 + q, i, j] * filtered[q, j]
                            else:
                                added += terms[q, 1] * gains[k, 1 + q, i, j] * filtered[q, j]
                        direct += added
                    # Torques are relative to the trim, which the flown integral holds.
                    lowest, highest = -limits[1, i] - trim[i], limits[1, i] - trim[i]
                    tried = direct + integral[i] + growth
                    growth *= anti_windup_share(highest - tried if growth > 0 else tried - lowest, soft)
                    if growth * (moment[i] + trim[i]) > 0:  # last period's torque, before the motors
                        growth *= anti_windup_share(margin, soft)
                    grown = integral[i] + growth
                    integral[i] = min(max(grown, -limits[2, i] - trim[i]), limits[2, i] - trim[i])
                    moment[i] = min(max(direct + integral[i], lowest), highest)
                    angles[moving, k, t, i], moments[moving, k, t, i] = angle[i], moment[i] + trim[i]
                    equivalent[i] = moment[i]
                if n:
                    # The collective carries the weight at any tilt.
                    extra = weight / min(max(np.cos(angle[0]) * np.cos(angle[1]), MIN_TILT_COSINE), 1.0) - weight
                    for m in range(n):
                        part[m] = mixer[m, 0] * (moment[0] + trim[0]) + mixer[m, 1] * (moment[1] + trim[1])
                        rest[m] = level[m] + extra
                    margin = allocate_commands(part, rest, commands) - 1.0
                    for i in range(2):
                        equivalent[i] = -decay * acting[i]
                        acting[i] = 0.0
                    for m in range(n):
                        settled = np.sqrt(commands[m])
                        speed[m] = settled + decay * (speed[m] - settled)
                        for i in range(2):
                            acting[i] += inverse[i, m] * (speed[m] ** 2 - hover[m])
                    for i in range(2):
                        equivalent[i] = (equivalent[i] + acting[i]) / (1 - decay)
                for i in range(len(A)):
                    ahead[i] = B[i, 0] * equivalent[0] + B[i, 1] * equivalent[1]
                    for j in range(len(A)):
                        ahead[i] += A[i, j] * state[j]
                state[:] = ahead
                rate[:] = now
