"""A full reference model: the transfer matrix required of a closed loop, with off-diagonal entries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.reference_model import ReferenceModel

Signal = NDArray[np.float64]
Rows = tuple[tuple[ReferenceModel | None, ...], ...]


@dataclass(frozen=True)
class ReferenceMatrix:
    """Square matrix of reference models; entry (i, j) leads from setpoint j to output i.

    Attributes
    ----------
    elements : tuple of n tuples of n ReferenceModel or None
        Rows; None is zero.

    Raises
    ------
    TuningError
        When it is not square, the periods differ, or the matrix is singular.
    """

    elements: Rows

    def __post_init__(self) -> None:
        n = len(self.elements)
        periods = {model.Ts for row in self.elements for model in row if model}
        if n == 0 or any(len(row) != n for row in self.elements) or len(periods) != 1:
            raise TuningError(
                f"reference matrix: got rows of {', '.join(str(len(row)) for row in self.elements)} and "
                f"{len(periods)} sampling periods; expected a square matrix and one period"
            )
        if not any(self.determinant.num):
            raise TuningError("reference matrix: its determinant is zero; the outputs asked for depend on one another")

    def __len__(self) -> int:
        return len(self.elements)

    @property
    def Ts(self) -> float:  # noqa: N802
        """Sampling period, s."""
        return self._models()[0].Ts

    def _models(self) -> list[ReferenceModel]:
        return [model for row in self.elements for model in row if model]

    @cached_property
    def determinant(self) -> ReferenceModel:
        """Determinant of M, proper and stable if the elements are."""
        return _determinant(self.elements, self.Ts)

    @cached_property
    def adjugate(self) -> tuple[tuple[ReferenceModel, ...], ...]:
        """Adjugate of M, det(M) M^-1, proper and stable if the elements are."""
        n = range(len(self))

        def cofactor(i: int, j: int) -> ReferenceModel:
            others = (row for r, row in enumerate(self.elements) if r != i)
            minor = _determinant(tuple(row[:j] + row[j + 1 :] for row in others), self.Ts)
            return _model((-1.0) ** (i + j) * minor.taps, np.array(minor.den), self.Ts)

        return tuple(tuple(cofactor(j, i) for j in n) for i in n)

    def adjugate_response(self, signal: Signal) -> Signal:
        """adj(M) times a signal (N, n), from rest."""
        return np.column_stack(
            [np.sum([m.response(signal[:, j]) for j, m in enumerate(row)], axis=0) for row in self.adjugate]
        )

    def frequency_response(self, omega: Signal) -> NDArray[np.complex128]:
        """M at z = exp(j omega Ts), (K, n, n); omega in rad/s."""
        return _response(self.elements, omega)

    def settling_samples(self, fraction: float = 0.01) -> int:
        """Samples until the transients of all elements, of det M and of adj M are below `fraction` of their peaks."""
        every = [*self._models(), self.determinant, *(m for row in self.adjugate for m in row if any(m.num))]
        return max(model.settling_samples(fraction) for model in every)


#: What a closed loop can be asked for: a model for each output, or a full matrix.
Wanted = Sequence[ReferenceModel] | ReferenceMatrix


def wanted_response(models: Wanted, omega: Signal) -> NDArray[np.complex128]:
    """M at frequencies (K,) in rad/s, (K, n, n)."""
    if isinstance(models, ReferenceMatrix):
        return models.frequency_response(omega)
    rows = tuple(tuple(model if i == j else None for j in range(len(models))) for i, model in enumerate(models))
    return _response(rows, omega)


def _response(rows: Rows, omega: Signal) -> NDArray[np.complex128]:
    value = np.zeros((len(omega), len(rows), len(rows)), np.complex128)
    for i, row in enumerate(rows):
        for j, model in enumerate(row):
            if model:
                value[:, i, j] = model.frequency_response(omega)
    return value


def _model(taps: Signal, den: Signal, Ts: float) -> ReferenceModel:
    """The transfer function taps/den, both in powers of z^-1."""
    length = max(len(taps), len(den))
    taps, den = (np.concatenate([part, np.zeros(length - len(part))]) for part in (taps, den))
    first = int(np.argmax(taps != 0))
    return ReferenceModel(tuple(map(float, taps[first:])), tuple(map(float, den)), 0, Ts, "entry of a matrix")


def _determinant(rows: Rows, Ts: float) -> ReferenceModel:
    """Determinant by the first row; 1 for no rows."""
    if not rows:
        return _model(np.ones(1), np.ones(1), Ts)
    taps, den = np.zeros(1), np.ones(1)
    for j, model in enumerate(rows[0]):
        if model is None:
            continue
        minor = _determinant(tuple(row[:j] + row[j + 1 :] for row in rows[1:]), Ts)
        term_taps = (-1.0) ** j * np.convolve(model.taps, minor.taps)
        term_den = np.convolve(model.den, minor.den)
        if len(den) == len(term_den) and np.array_equal(den, term_den):
            length = max(len(taps), len(term_taps))
            taps = np.pad(taps, (0, length - len(taps))) + np.pad(term_taps, (0, length - len(term_taps)))
        else:
            left, right = np.convolve(taps, term_den), np.convolve(term_taps, den)
            length = max(len(left), len(right))
            taps = np.pad(left, (0, length - len(left))) + np.pad(right, (0, length - len(right)))
            den = np.convolve(den, term_den)
    return _model(taps, den, Ts)
