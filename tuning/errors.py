"""The exceptions of this room."""


class TuningError(ValueError):
    """Bad input to tuning: the message says what, where and what to do next."""

    exit_code = 2


class NotMinimumPhaseError(TuningError):
    """A controller that cannot be run backwards."""
