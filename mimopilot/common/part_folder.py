"""Parts of long work in a folder: sealed when they are finished, checked when the work is resumed."""

from __future__ import annotations

import fcntl
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from mimopilot.common.errors import Error
from mimopilot.common.files import inside, unseal, write_atomically
from mimopilot.common.verbosity import warn

SHOWN = 3  # parts named in one message
RESUME = "give the same command again to resume"


class UnusablePartError(Error):
    """A part file cannot be used."""


@dataclass(frozen=True)
class PartFolder:
    """Finished parts of one piece of work, a file each.

    A part is sealed (`mimopilot.common.files.seal`) with a label: a digest of all that the work depends on, a space,
    and what the part is of. A part that is damaged, or has another label than expected, is computed again.

    Attributes
    ----------
    folder : Path
    whole : str
        What the parts are of, for messages: ``campaign``.
    """

    folder: Path
    whole: str

    def path(self, name: str) -> Path:
        """File of a part."""
        return inside(self.folder, f"{name}.part")

    def write(self, name: str, sealed: bytes) -> None:
        """Keep a finished part."""
        write_atomically(self.path(name), sealed)

    def read(self, name: str, label: str) -> bytes:
        """Content of a part.

        Raises
        ------
        UnusablePartError
            When the file is damaged or has another label.
        """
        path = self.path(name)
        found = unseal(path.read_bytes())
        if found is None:
            raise UnusablePartError(f"{path.name} is damaged")
        content, is_of = found
        if is_of != label:
            digest, _, what = is_of.partition(" ")
            whose = f"is of {what}" if label.partition(" ")[0] == digest else f"is of another {self.whole}"
            raise UnusablePartError(f"{path.name} {whose}")
        return content

    def missing(self, labels: Iterable[tuple[str, str]]) -> list[str]:
        """Names of the parts that must be computed; says on standard error which files are unusable.

        Parameters
        ----------
        labels : iterable of (str, str)
            Name and label of every part.
        """
        missing, unusable = [], []
        for name, label in labels:
            if not self.path(name).is_file():
                missing.append(name)
                continue
            try:
                self.read(name, label)
            except UnusablePartError as error:
                missing.append(name)
                unusable.append(str(error))
        if unusable:
            more = f" and {len(unusable) - SHOWN} more" if len(unusable) > SHOWN else ""
            named = "; ".join(unusable[:SHOWN])
            warn(self.folder, [f"unusable parts are computed again: {named}{more}"])
        return missing


@contextmanager
def folder_lock(folder: Path, name: str, whole: str) -> Iterator[None]:
    """Lock an output folder against other processes; the lock ends with this process.

    Parameters
    ----------
    folder : Path
        Created if it does not exist.
    name : str
        Of the lock file, which remains.
    whole : str
        What is written, for the message: ``campaign``.

    Raises
    ------
    Error
        When another process holds the lock.
    """
    path = inside(folder, name)
    folder.mkdir(parents=True, exist_ok=True)
    with path.open("ab") as stream:
        try:
            fcntl.lockf(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)  # forked workers do not inherit it
        except (BlockingIOError, PermissionError):
            raise Error(
                f"{folder}: another process writes a {whole} into this folder; wait for it, or give another --out"
            ) from None
        yield
