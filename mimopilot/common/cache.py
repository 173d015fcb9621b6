"""Where machine code is kept between runs: a folder that only its owner can write to."""

from __future__ import annotations

import os
import stat
import tempfile
from functools import lru_cache
from pathlib import Path


def cache_folder() -> Path:
    """$XDG_CACHE_HOME/mimopilot, else mimopilot-UID in the temporary folder, else one that ends with this process.

    Code is run from it: the first is taken that nobody else can write to.
    """
    usual = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache")
    for folder in (usual / "mimopilot", Path(tempfile.gettempdir()) / f"mimopilot-{os.geteuid()}"):
        if found := _own(folder):
            return found
    return Path(_temporary().name)


@lru_cache(maxsize=1)
def _temporary() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="mimopilot-")


def _own(folder: Path) -> Path | None:
    """The folder without links on its way, made when it is missing; None where others could change what is in it.

    That is so when it, or a folder above it, belongs to someone else than root, or is writable for others. Above it
    the sticky bit is enough: there only owners can rename or remove.
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
    except (OSError, RuntimeError):  # RuntimeError: links that form a loop, or no home
        return None
    return folder if os.access(folder, os.R_OK | os.W_OK | os.X_OK) else None
