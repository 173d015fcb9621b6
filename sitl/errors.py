"""The one exception of this room."""


class SitlError(RuntimeError):
    """The bench cannot do what was asked: the message says what, where and what to do next.

    Parameters
    ----------
    message : str
        What went wrong.
    exit_code : int
        2 for bad input, 1 when a flight or a link failed.
    """

    def __init__(self, message: str, exit_code: int = 2) -> None:
        super().__init__(message)
        self.exit_code = exit_code
