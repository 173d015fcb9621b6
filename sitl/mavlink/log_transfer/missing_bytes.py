"""The bytes of a file that have not arrived yet, as ranges."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable


class MissingBytes:
    """Disjoint ranges in ascending order.

    Parameters
    ----------
    ranges : iterable of (start, end)
        `end` is not included.
    """

    def __init__(self, ranges: Iterable[tuple[int, int]]) -> None:
        self._starts: list[int] = []
        self._ends: list[int] = []
        self.total = 0
        for start, end in sorted(ranges):
            if not 0 <= start < end or (self._ends and start < self._ends[-1]):
                raise ValueError(f"range {start} to {end}: expected ascending ranges that do not overlap")
            self.total += end - start
            if self._ends and start == self._ends[-1]:
                self._ends[-1] = end
            else:
                self._starts.append(start)
                self._ends.append(end)

    def __bool__(self) -> bool:
        return self.total > 0

    def ranges(self) -> list[tuple[int, int]]:
        """All ranges."""
        return list(zip(self._starts, self._ends, strict=True))

    def remove(self, start: int, end: int) -> int:
        """Remove the bytes from `start` to `end`; returns how many of them were missing."""
        if start >= end:
            return 0
        i = bisect_right(self._ends, start)
        removed = 0
        while i < len(self._starts) and self._starts[i] < end:
            low, high = self._starts[i], self._ends[i]
            left, right = (low, min(high, start)), (max(low, end), high)
            kept = [part for part in (left, right) if part[0] < part[1]]
            removed += high - low - sum(b - a for a, b in kept)
            self._starts[i : i + 1] = [a for a, _ in kept]
            self._ends[i : i + 1] = [b for _, b in kept]
            i += len(kept)
        self.total -= removed
        return removed

    def pieces(self, size: int, count: int) -> list[tuple[int, int]]:
        """The first missing bytes in pieces of at most `size`: at most `count` pairs of start and length."""
        found: list[tuple[int, int]] = []
        for start, end in zip(self._starts, self._ends, strict=True):
            for place in range(start, end, size):
                if len(found) == count:
                    return found
                found.append((place, min(size, end - place)))
        return found

    def span(self, merge: int, longest: int) -> tuple[int, int]:
        """Range to request next: from the first missing byte over received gaps of up to `merge`, at most `longest`."""
        start, end = self._starts[0], self._ends[0]
        for low, high in zip(self._starts[1:], self._ends[1:], strict=True):
            if low - end > merge or end - start >= longest:
                break
            end = high
        return start, min(end, start + longest)
