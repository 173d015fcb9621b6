"""The exceptions of tuning."""

from mimopilot.common.errors import Error


class TuningError(Error, ValueError):
    """Bad input to tuning."""


class NotMinimumPhaseError(TuningError):
    """A controller that cannot be inverted."""
