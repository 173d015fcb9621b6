"""The rate controller in state space, from the law's table of terms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mimopilot.tuning.control_laws import control_law
from mimopilot.tuning.first_order_filter import Chain, Signal
from mimopilot.tuning.law_filters import Filters
from mimopilot.tuning.law_terms import ERROR, RATE, SETPOINT


@dataclass(frozen=True, eq=False)
class StateSpaceLaw:
    """The rate controller as w(k+1) = A w + B_e e + B_y y + B_r r, u = C w + D_e e + D_y y + D_r r.

    Each filter has a state for each of its n inputs.

    Attributes
    ----------
    A, C : (m, m) and (n_u, m) arrays
    B, D : dict
        Signal -> (m, n) and (n_u, n) arrays.
    """

    A: Signal
    B: dict[str, Signal]
    C: Signal
    D: dict[str, Signal]


def state_space(matrices: Mapping[str, Signal], filters: Filters) -> StateSpaceLaw:
    """The rate controller in state space.

    Parameters
    ----------
    matrices : mapping
        Letter of the law's terms -> (n_u, n) matrix.
    filters : Filters
    """
    n_u, n = np.shape(next(iter(matrices.values())))
    filters = filters.on(slice(0, n))
    law = control_law(filters)
    terms = [
        (term, term.filter(filters), term.sign * np.asarray(matrices[letter], float))
        for letter, term in law.terms.items()
        if letter in matrices
    ]
    before = law.setpoint(filters)
    m = n * (len(before) + sum(len(chain) for _, chain, _ in terms))
    # Every signal as rows of its dependence on the states, then on e, y and r.
    unit = np.eye(m + 3 * n)
    error, rate, setpoint = (unit[m + i * n : m + (i + 1) * n] for i in range(3))
    ahead: list[Signal] = []

    def filtered(signal: Signal, chain: Chain) -> Signal:
        for one in chain:
            state = unit[n * len(ahead) : n * (len(ahead) + 1)]
            direct, memory, pole = (np.broadcast_to(v, n)[:, None] for v in (one.direct, one.memory, one.pole))
            ahead.append(pole * state + memory * signal)
            signal = direct * signal + state
        return signal

    reached = filtered(setpoint, before)
    signals = {ERROR: error + (reached - setpoint), RATE: rate, SETPOINT: reached}
    u = sum(
        (matrix @ filtered(signals[term.signal], chain) for term, chain, matrix in terms), np.zeros((n_u, m + 3 * n))
    )
    step = np.vstack([np.zeros((0, m + 3 * n)), *ahead])
    columns = {name: slice(m + i * n, m + (i + 1) * n) for i, name in enumerate((ERROR, RATE, SETPOINT))}
    B, D = ({name: part[:, where] for name, where in columns.items()} for part in (step, u))
    return StateSpaceLaw(step[:, :m], B, u[:, :m], D)
