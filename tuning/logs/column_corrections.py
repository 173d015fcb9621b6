"""How a log names its signals, and the column-file lines that correct them."""

from __future__ import annotations

from collections.abc import Sequence

from mimopilot.tuning.logs.columns import SIGNALS
from mimopilot.tuning.logs.recording import Recording


class SignalNames:
    """Names of the signals of one log, for messages; and their corrections.

    Parameters
    ----------
    recording : Recording
        The log.
    """

    def __init__(self, recording: Recording) -> None:
        self.path, self.recording = recording.path, recording

    def of(self, signal: str) -> str:
        """Topic, message or columns of a signal, both axes."""
        return self.recording.signals[signal].topic

    def all(self, signals: Sequence[str], axis: int | None = None) -> str:
        """Names of several signals, of both axes or of one."""
        columns = self.recording.columns
        if columns is None or axis is None:
            return " and ".join(self.of(signal) for signal in signals)
        return " and ".join(columns.name(SIGNALS[signal][axis]) for signal in signals)

    def lines(self, signals: Sequence[str], axes: Sequence[int], what: str) -> list[str]:
        """Column-file lines for some axes of signals: another ``sign`` or ``unit``, or the ``other`` axis' column.

        Empty when the log names its signals itself.
        """
        columns = self.recording.columns
        if columns is None:
            return []
        lines = []
        for signal in signals:
            for axis in axes:
                field, other = SIGNALS[signal][axis], SIGNALS[signal][1 - axis]
                lines.append(columns.line(field, other if what == "other" else field, what))
        return lines

    def instruction(self, lines: Sequence[str]) -> str:
        """The instruction to put lines into the column file; empty without lines."""
        return f"put into the --columns file: {', '.join(lines)}" if lines else ""

    def correction(self, signals: Sequence[str], axes: Sequence[int], what: str) -> str:
        """What to do about some axes of signals."""
        text = self.instruction(self.lines(signals, axes, what))
        return text or f"{self.all(signals)} in this log does not hold what its name says"
