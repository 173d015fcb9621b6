"""The one exception of this room."""


class CodegenError(RuntimeError):
    """Code generation or compilation failed: the message says what, where and what to do next.

    Parameters
    ----------
    message : str
        What went wrong.
    exit_code : int
        2 for bad input or a missing tool, 1 when a tool ran and failed.
    """

    def __init__(self, message: str, exit_code: int = 2) -> None:
        super().__init__(message)
        self.exit_code = exit_code
