"""The gains that a design may change, as a vector of numbers of about the size 1."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.axes import Law
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.law_terms import ATTITUDE, ATTITUDE_FEEDFORWARD, LOOP_TERMS, TERMS
from mimopilot.tuning.parameter_row import Shape
from mimopilot.tuning.parameters import rows
from mimopilot.tuning.plant.rigid_body_fit import RigidBody

#: Typical bandwidths of the attitude and of the rate loop, rad/s, and ratios Ki over Kp (1/s) and Kd over Kp (s) of
#: multirotors of 0.3 to 5 kg: the units of the search.
ATTITUDE_BANDWIDTH, RATE_BANDWIDTH, INTEGRAL, DERIVATIVE = 5.0, 20.0, 2.0, 0.02
#: Matrices that act on angles or on the attitude model's rate: a decoupled one is diagonal. The others become so behind
#: the control effectiveness.
ATTITUDE_MATRICES = (ATTITUDE.matrix, ATTITUDE_FEEDFORWARD.matrix)
#: The feed-forward from the attitude model's acceleration.
ACCELERATION = TERMS["A"]

Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FreeGains:
    """Elements of the gain matrices that may change.

    Attributes
    ----------
    base : Law
        Everything else, without a certificate. Matrices that are neither free nor in the structure are zero.
    units : mapping
        Name of a free matrix -> size of 1 in the vector, in the order of the vector.
    where : (n, n) bool array
        Elements that may change: all, or the diagonal (SISO).
    """

    base: Law
    units: Mapping[str, float]
    where: NDArray[np.bool_]

    @property
    def size(self) -> Signal:
        """Size of 1 of every element of the vector, (n,)."""
        return np.repeat(list(self.units.values()), int(self.where.sum()))

    def places(self) -> Iterator[tuple[str, int, int]]:
        """Matrix, row and column of every element."""
        for name in self.units:
            for row, column in np.argwhere(self.where):
                yield name, int(row), int(column)

    def vector(self, gains: Law) -> Signal:
        """The free elements of a set."""
        return np.concatenate([getattr(gains, name)[self.where] / unit for name, unit in self.units.items()])

    def gains(self, vector: Signal) -> Law:
        """The set with these free elements."""
        parts: dict[str, Signal] = {}
        for name, values in zip(self.units, np.split(vector * self.size, len(self.units)), strict=True):
            matrix = np.zeros(self.where.shape)
            matrix[self.where] = values
            parts[name] = matrix
        return replace(self.base, **parts)  # type: ignore[arg-type]

    def coupling(self, B: Signal) -> Signal:
        """Coupling that gains of roll and pitch add through a plant, as a matrix (2 m, n) to multiply the vector with.

        The off-diagonal elements of B times each rate gain, and of the attitude gain, in units of the diagonal: zero
        when the gains decouple the rigid body.
        """
        if len(B) == 1:
            return np.zeros((0, len(self.size)))
        found = np.zeros((2 * len(self.units), len(self.size)))
        names = list(self.units)
        for place, (name, row, column) in enumerate(self.places()):
            effect = np.eye(2)[:, row] if name in ATTITUDE_MATRICES else B[:, row] / np.abs(B).max()
            found[2 * names.index(name) + column, place] = effect[1 - column]
        return found


def free_gains(base: Law, body: RigidBody, structure: str = "".join(LOOP_TERMS), full: bool = True) -> FreeGains:
    """The attitude gain, the terms of a structure and, where `base` follows a model, its feed-forward.

    Parameters
    ----------
    base : Law
        Filters, attitude model, and what else is not tuned.
    body : RigidBody
        Its control effectiveness gives the units.
    structure : str
        Letters of `tuning.law.LOOP_TERMS`.
    full : bool
        False: the diagonals only.
    """
    acceleration = 1 / float(np.abs(body.B).max())
    proportional = RATE_BANDWIDTH * acceleration
    ratio = {"P": 1.0, "I": INTEGRAL, "D": DERIVATIVE, "F": 1.0}
    units = {ATTITUDE.matrix: ATTITUDE_BANDWIDTH}
    units |= {TERMS[letter].matrix: proportional * ratio[letter] for letter in structure}
    if base.filters.followed is not None:
        units |= {ATTITUDE_FEEDFORWARD.matrix: 1.0, ACCELERATION.matrix: acceleration}
    zero = {row.key: np.zeros(body.B.shape) for row in rows(Shape.MATRIX) if row.key not in units}
    where = np.ones(body.B.shape, bool) if full else np.eye(len(body.B), dtype=bool)
    uncertified = base.with_certificate(None) if isinstance(base, Gains) else base
    return FreeGains(replace(uncertified, **zero), units, where)  # type: ignore[arg-type]
