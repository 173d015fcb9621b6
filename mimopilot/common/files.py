"""Files: bounded reading, atomic writing, never through a link inside an output folder, and seals."""

from __future__ import annotations

import errno
import hashlib
import os
import stat
import tempfile
from pathlib import Path

from mimopilot.common.errors import Error, InputFileError

#: Largest text file that a user may give, bytes. The largest expected one, a full parameter file, has some 60 kB.
MAX_TEXT_BYTES = 1 << 20
#: First bytes of files that are given by mistake where a text file is expected.
BINARIES = {
    b"ULog\x01\x12\x35": "a flight log (ULog)",
    b"\xa3\x95": "a flight log (dataflash)",
    b"MATLAB 5.0": "a MATLAB file",
}


def read_bytes(path: Path, what: str) -> bytes:
    """Content of a small file that a user names. A device, a pipe or a large file is refused.

    Parameters
    ----------
    path : Path
        The file, or a link to it.
    what : str
        Its kind, for messages: ``gains file``.

    Raises
    ------
    InputFileError
        If it is missing, not a regular file, larger than `MAX_TEXT_BYTES`, or cannot be read.
    """
    try:
        # Without O_NONBLOCK, opening a pipe waits for a writer.
        with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as stream:
            status = os.fstat(stream.fileno())
            if not stat.S_ISREG(status.st_mode):
                kind = "a pipe" if stat.S_ISFIFO(status.st_mode) else "a device"
                raise InputFileError(f"{path}: cannot read the {what}: it is {kind}; give a regular file")
            content = stream.read(MAX_TEXT_BYTES + 1)
    except OSError as error:
        reason = missing_target(path) or error.strerror or error
        raise InputFileError(f"{path}: cannot read the {what}: {reason}") from error
    for begin, kind in BINARIES.items():
        if content.startswith(begin):
            raise InputFileError(f"{path}: cannot read the {what}: it is {kind}, expected text")
    if len(content) > MAX_TEXT_BYTES:
        size = max(status.st_size, len(content))
        raise InputFileError(
            f"{path}: cannot read the {what}: it has {size} bytes, expected at most {MAX_TEXT_BYTES}; is it the right "
            "file?"
        )
    return content


def missing_target(path: Path) -> str:
    """What a link to nothing leads to, as the reason in a message; empty for anything else."""
    try:
        path.stat()
    except FileNotFoundError:
        if path.is_symlink():
            return f"it is a link to {path.readlink()}, which does not exist"
    except OSError:
        pass
    return ""


def check_file(path: Path, wanted: str, error: type[Error]) -> None:
    """Refuse what is no regular file, before it is opened.

    Parameters
    ----------
    path : Path
        Named by the user.
    wanted : str
        What to give, for the message.
    error : type
        Raised, of the package that asks.

    Raises
    ------
    Error
        With what it is instead.
    """
    if path.is_file():
        return
    reason = missing_target(path) or ("it is a folder" if path.is_dir() else "")
    if not reason:
        reason = "it is a device or a pipe" if path.exists() else "no such file"
    raise error(f"{path}: {reason}; give {wanted}")


def read_text(path: Path, what: str) -> str:
    """Text of a small UTF-8 file that a user names, with or without a byte order mark; see `read_bytes`.

    Raises
    ------
    InputFileError
        As `read_bytes`, and if it is not UTF-8.
    """
    try:
        return read_bytes(path, what).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputFileError(
            f"{path}: cannot read the {what}: byte {error.start} is not UTF-8 text; is it the right file?"
        ) from error


def inside(folder: Path, name: str) -> Path:
    """Path of a file in an output folder, without a link on its way: what is written there stays in the folder.

    Parameters
    ----------
    folder : Path
        The folder as the user named it; it may be a link itself.
    name : str
        Relative path, with ``/``.

    Raises
    ------
    OSError
        If `folder` exists and is not a folder, or `name` or a folder on its path is a link.
    """
    if os.path.lexists(folder) and not folder.is_dir():
        kind = "is a link that leads to no folder" if folder.is_symlink() else "is a file"
        raise NotADirectoryError(errno.ENOTDIR, f"{kind}; give --out a folder", str(folder))
    path = folder / name
    for step in (path, *path.parents):
        if step == folder:
            break
        if step.is_symlink():
            raise _link(step)
    return path


def _link(path: Path) -> OSError:
    return OSError(
        errno.ELOOP, "is a link, and nothing is written through it; remove it or give another --out", str(path)
    )


def write_atomically(path: Path, content: str | bytes) -> bool:
    """Write `content` to `path` in one step, only if it differs from the present content.

    Parameters
    ----------
    path : Path
        Destination; its folder is created. Text is written as UTF-8.
    content : str or bytes
        Of the whole file.

    Returns
    -------
    bool
        True if the file was written, False if it already held `content`.

    Raises
    ------
    OSError
        If the folder or file cannot be written, or `path` is a link, a device or a pipe; it is then unchanged.
    """
    data = content.encode() if isinstance(content, str) else content
    if path.is_symlink():
        raise _link(path)
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, "is a folder, expected a file", str(path))
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "is a device or a pipe, expected a file or nothing", str(path))
    if path.is_file() and path.stat().st_size == len(data) and path.read_bytes() == data:
        return False
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    except OSError as error:  # names the requested file, not the temporary one
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
    except OSError as error:  # for example a full disk; that error names no file
        Path(temporary).unlink(missing_ok=True)
        raise OSError(error.errno, f"cannot be written: {error.strerror}", str(path)) from error
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    return True


def seal(content: bytes, label: str) -> bytes:
    """`content`, a line with its label, and the SHA-256 of both in hexadecimal; see `unseal`."""
    body = content + f"\n{label}\n".encode()
    return body + sha256(body).encode()


def unseal(sealed: bytes) -> tuple[bytes, str] | None:
    """Content and label given to `seal`; None if any byte is changed or missing."""
    body, digest = sealed[:-64], sealed[-64:]
    parts = body.rsplit(b"\n", 2)
    if len(parts) < 3 or sha256(body).encode() != digest:
        return None
    return parts[0], parts[1].decode()


def sha256(content: bytes | str) -> str:
    """SHA-256 of bytes or of UTF-8 text, in hexadecimal."""
    return hashlib.sha256(content.encode() if isinstance(content, str) else content).hexdigest()
