"""Exceptions that the command line reports as one message, and the checks of options that several commands share."""

from __future__ import annotations

from collections.abc import Iterable


class Error(Exception):
    """Base of every error that a user can correct: the message says what, where and what to do next.

    Parameters
    ----------
    message : str
        What went wrong.
    exit_code : int
        Of the command line: 2 for bad input or a missing tool, 1 if a tool, a run or a link failed.
    """

    def __init__(self, message: str, exit_code: int = 2) -> None:
        super().__init__(message)
        self.exit_code = exit_code


class InputFileError(Error, ValueError):
    """A file cannot be read, or its content is not as expected."""


def check_choice(name: str, value: object, known: Iterable[str], error: type[Error] = Error) -> None:
    """Refuse a value that is none of the known ones.

    Parameters
    ----------
    name : str
        What was chosen, for the message: ``--profile``.
    value : object
        As given.
    known : iterable of str
        All that it may be.
    error : type
        Raised, of the package that asks.

    Raises
    ------
    Error
        With all that are known.
    """
    choices = list(known)
    if value not in choices:
        raise error(f"{name}: got {value!r}, expected one of {', '.join(choices)}")


def check_not_given(reason: str, **options: object) -> None:
    """Refuse options that do not apply to this mode.

    Parameters
    ----------
    reason : str
        Where they belong, for the message.
    **options
        By the name of their parameter; None: not given.

    Raises
    ------
    Error
        Naming those that were given.
    """
    given = [f"--{name.replace('_', '-')}" for name, value in options.items() if value is not None]
    if given:
        raise Error(f"{', '.join(given)}: {reason}")
