"""The cache folder for machine code: only its owner can write to it."""

from __future__ import annotations

import os
import stat
import tempfile
from functools import lru_cache
from pathlib import Path


def cache_folder() -> Path:
    """$XDG_CACHE_HOME/mimopilot, else mimopilot-UID in the temporary folder, else a folder deleted at exit.

    Code is executed from it, so the first of them is used that nobody else can write to.
    """
    usual = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache")
    for folder in (usual / "mimopilot", Path(tempfile.gettempdir()) / f"mimopilot-{os.geteuid()}"):
        if found := _private_folder(folder):
            return found
    return Path(_temporary().name)


def is_temporary(folder: Path) -> bool:
    """Whether a cache folder is deleted at exit: no usual one is private."""
    return _temporary.cache_info().currsize > 0 and folder == Path(_temporary().name)


@lru_cache(maxsize=1)
def _temporary() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="mimopilot-")


def _private_folder(folder: Path) -> Path | None:
    """The resolved folder, created if missing; None if other users could change its content.

    They could if it, or a parent folder, is writable for others, or owned by a user other than this one and root. In
    a parent folder the sticky bit is sufficient: only owners can rename or remove entries there.
    """
    try:
        folder = folder.expanduser()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder = folder.resolve()
        for step in (folder, *folder.parents):
            status = step.stat()
            shared = status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
            sticky = step != folder and status.st_mode & stat.S_ISVTX
            if status.st_uid not in (0, os.geteuid()) or (shared and not sticky):
                return None
    except (OSError, RuntimeError):  # RuntimeError: a loop of links, or no home folder
        return None
    return folder if os.access(folder, os.R_OK | os.W_OK | os.X_OK) else None
