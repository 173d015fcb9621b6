"""A doublet around a linear plant behind its motors, compiled: a refinement flies thousands."""

from __future__ import annotations

import numpy as np
from mimopilot.tuning import law
from numpy.typing import NDArray

from mimopilot.common.compiled import compiled

Signal = NDArray[np.float64]


#: Numbers of the signals that a term acts on.
ERROR, RATE, SETPOINT = range(3)
_SIGNALS = {law.ERROR: ERROR, law.RATE: RATE, law.SETPOINT: SETPOINT}


def law_terms(filters: law.Filters) -> Signal:
    """The terms of the law as numbers, (4, 5): signal, sign, direct gain, zero and pole of the filter."""
    numbers = []
    for term in law.TERMS.values():
        shape = term.filter(filters)
        response = (1.0, 0.0, 0.0) if shape is None else (shape.direct, shape.zero, shape.pole)
        numbers.append([float(_SIGNALS[term.signal]), float(term.sign), *response])
    return np.array(numbers)


@compiled
def allocated(part, rest, commands):  # type: ignore[no-untyped-def]
    """Commands `rest` + share `part` within 0..1, the collective lowered where that makes room; fills `commands` (n,)
    and returns the largest share for which a collective that is not higher does it; up to 1 is given.
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
def kept(room, soft):  # type: ignore[no-untyped-def]
    """Share of the integral's growth that anti-windup lets pass, `room` before the limit: 1 or 0, or in between."""
    if soft > 0.0:
        return min(max(0.5 + room / soft, 0.0), 1.0)
    return 1.0 if room >= 0.0 else 0.0


@compiled
def fly(A, B, C, trim, motors, setpoint, gains, terms, limits, Ts, soft, angles, moments):  # type: ignore[no-untyped-def]
    """The law of `tuning.law` with its limits, axis by axis and gain set by gain set, without noise.

    The plant is the linear one around hover, which holds the rotors' lag. Rotors whose speed lags behind commands that
    are thrust fractions, f = w^2, make another moment where commands are large; what a linear lag would have to be
    given for the same moment is the plant's input.

    Parameters
    ----------
    A, B, C : arrays
        Of the plant from moment to body rates.
    trim : (2,) array
        Moment that holds the vehicle level.
    motors : tuple
        mixer (n, 2), its inverse (2, n), hover (n,) and exp(-Ts / lag) of the rotors; n = 0: as the plant says.
    setpoint : (N,) array, rad
        Of the axis that moves.
    gains : (K, 5, 2, 2) array
        Kp_o, then the matrices of `terms`, of every set.
    terms : (4, 5) array
        See `law_terms`.
    limits : (3, 2) array
        Of rates, moments and integral.
    Ts : float, s
    soft : float
        Moment over which the anti-windup's switch is drawn out: the flown one, 0, makes angles jump where gains change
        by nothing, and no descent gets past that.
    angles, moments : (2, K, N, 2) arrays
        Are filled; first index: the axis that moves.
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
            speed, acting, equivalent, room = np.sqrt(hover), np.zeros(2), np.zeros(2), np.inf
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
                        # Of an integrator only what it grows by is kept: its sum is `integral`, behind the anti-windup.
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
                    # Moments are counted from the trim, which the flown integral holds.
                    lowest, highest = -limits[1, i] - trim[i], limits[1, i] - trim[i]
                    tried = direct + integral[i] + growth
                    growth *= kept(highest - tried if growth > 0 else tried - lowest, soft)
                    if growth * (moment[i] + trim[i]) > 0:  # moment of the last period, which the motors were to make
                        growth *= kept(room, soft)
                    grown = integral[i] + growth
                    integral[i] = min(max(grown, -limits[2, i] - trim[i]), limits[2, i] - trim[i])
                    moment[i] = min(max(direct + integral[i], lowest), highest)
                    angles[moving, k, t, i], moments[moving, k, t, i] = angle[i], moment[i] + trim[i]
                    equivalent[i] = moment[i]
                if n:
                    # The collective carries the weight at any tilt.
                    lift = weight / min(max(np.cos(angle[0]) * np.cos(angle[1]), 0.5), 1.0) - weight
                    for m in range(n):
                        part[m] = mixer[m, 0] * (moment[0] + trim[0]) + mixer[m, 1] * (moment[1] + trim[1])
                        rest[m] = level[m] + lift
                    room = allocated(part, rest, commands) - 1.0
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
