"""The exceptions that the command line reports as one message."""


class Error(Exception):
    """Base of every error that a user can correct or act on: the message says what, where and what to do next.

    Parameters
    ----------
    message : str
        What went wrong.
    exit_code : int
        Of the command line: 2 for bad input or a missing tool, 1 when a tool, a flight or a link failed.
    """

    def __init__(self, message: str, exit_code: int = 2) -> None:
        super().__init__(message)
        self.exit_code = exit_code


class InputFileError(Error, ValueError):
    """A file cannot be read, or does not hold what it should."""
