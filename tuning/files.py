"""Writing files so that nothing is ever half-written."""

from __future__ import annotations

import errno
import hashlib
import os
import tempfile
from pathlib import Path


def write_atomically(path: Path, content: str | bytes) -> bool:
    """Put `content` at `path` in one step, and only when it differs from what is there.

    Parameters
    ----------
    path : Path
        Destination; its folder is created. Text is written as UTF-8.
    content : str or bytes
        The whole file.

    Returns
    -------
    bool
        True when the file was written, False when it already held `content`.

    Raises
    ------
    OSError
        When the folder or file cannot be written; the old file, if any, is then untouched.
    """
    data = content.encode() if isinstance(content, str) else content
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, "is a folder, expected a file", str(path))
    if path.is_file() and path.read_bytes() == data:
        return False
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    except OSError as error:  # of the file that was asked for, not of the one in between
        raise OSError(error.errno, f"cannot be written: {error.strerror}", str(path)) from error
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        mask = os.umask(0)
        os.umask(mask)
        Path(temporary).chmod(0o666 & ~mask)
        Path(temporary).replace(path)
    except OSError as error:  # a full disk, say, which names no file
        Path(temporary).unlink(missing_ok=True)
        raise OSError(error.errno, f"cannot be written: {error.strerror}", str(path)) from error
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    return True


def sha256(content: bytes | str) -> str:
    """SHA-256 of bytes or of UTF-8 text, in hexadecimal."""
    return hashlib.sha256(content.encode() if isinstance(content, str) else content).hexdigest()
