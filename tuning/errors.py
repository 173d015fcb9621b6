"""Exceptions of tuning."""

from mimopilot.common.errors import Error


class TuningError(Error, ValueError):
    """Invalid input to tuning."""


class NotMinimumPhaseError(TuningError):
    """A controller without a stable inverse."""
