"""The first-order filters that control laws are made of."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Signal = NDArray[np.float64]
Response = NDArray[np.complex128]
#: One value for all axes, or one for each.
Values = float | Signal


@dataclass(frozen=True, eq=False)
class Filter:
    """H(z) = gain (z - zero) / (divisor (z - pole)), zero = 1 for a difference and 0 otherwise.

    With a state x: y(k) = h s(k) + x(k), x(k+1) = pole x(k) + h (pole - zero) s(k), h = gain / divisor.
    `delayed`: one period later, y(k) = x(k), x(k+1) = pole x(k) + gain s(k), without a difference.
    `gain` and `pole` are one value for all axes or (n,) arrays.
    """

    gain: Values
    pole: Values
    difference: bool = False
    divisor: float = 1.0
    delayed: bool = False

    @property
    def zero(self) -> float:
        """Zero of H."""
        return float(self.difference)

    @property
    def direct(self) -> Values:
        """H at infinity: direct gain from input to output."""
        return 0.0 if self.delayed else self.gain / self.divisor

    @property
    def memory(self) -> Values:
        """Gain from input to state."""
        return self.gain / self.divisor if self.delayed else self.direct * (self.pole - self.zero)

    def run(self, signal: Signal) -> Signal:
        """Filter every column of `signal` (N, n), from rest; a difference begins with 0."""
        if np.ndim(self.pole):
            columns = np.split(signal, signal.shape[1], axis=1)
            return np.hstack([self.of_axis(axis).run(column) for axis, column in enumerate(columns)])
        moved = np.diff(signal, axis=0, prepend=signal[:1]) if self.difference else signal
        if self.delayed:
            moved = np.vstack([np.zeros((1, signal.shape[1])), moved[:-1]])
        moved = moved / self.divisor
        if self.pole == 1:
            return np.asarray(self.gain * np.cumsum(moved, axis=0), dtype=np.float64)
        from scipy.signal import lfilter  # takes a second to import, which most commands do not need

        return np.asarray(lfilter([self.gain], [1, -self.pole], moved, axis=0), dtype=np.float64)

    def of_axis(self, axis: int) -> Filter:
        """The filter of one axis."""
        gain, pole = (float(np.ravel(value)[axis if np.ndim(value) else 0]) for value in (self.gain, self.pole))
        return replace(self, gain=gain, pole=pole)

    def times(self, matrix: Signal | Response, z: Response) -> Response:
        """``matrix`` H(z)."""
        zero = z - self.zero if not self.delayed else np.ones_like(z)
        product: Response = matrix * self.gain * zero / (self.divisor * (z - self.pole))
        return product


#: Filters one after the other, the first one first.
Chain = tuple[Filter, ...]
