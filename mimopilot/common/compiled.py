"""Decorator for functions that numba compiles, and the cache of their machine code."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

import numba
from numba.core import config
from numba.core.caching import FunctionCache
from numba.core.serialize import dumps

from mimopilot.common.cache import cache_folder
from mimopilot.common.files import seal, sha256, unseal, write_atomically


def compiled(function: Callable[..., Any]) -> Any:
    """Compile a function at its first call, or load its machine code from the cache."""
    dispatcher = numba.njit(error_model="numpy")(function)
    dispatcher._cache = _CheckedCache(function)
    return dispatcher


@lru_cache
def _folder(package: Path) -> Path:
    """Cache folder of a package's current sources: numba does not detect a change of a *called* function."""
    digest = hashlib.sha256(numba.__version__.encode())
    for path in sorted(package.glob("*.py")):
        digest.update(path.read_bytes())
    return cache_folder() / f"numba-{digest.hexdigest()[:16]}"


class _CheckedCache(FunctionCache):  # type: ignore[misc]
    """numba's cache of a function, in files that are checked before use.

    numba unpickles and runs its own files unchecked: a damaged one ends in any exception, or a signal.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        config.CACHE_DIR = str(_folder(Path(function.__code__.co_filename).parent))
        super().__init__(function)
        self._cache_file = _SealedFiles(Path(self._cache_path), self._impl.filename_base)


class _SealedFiles:
    """One sealed file for each signature of a function; if it is missing or damaged, it is compiled again.

    Parameters
    ----------
    folder : Path
        Of the files.
    name : str
        Of the function, in a form valid as a file name.
    """

    def __init__(self, folder: Path, name: str) -> None:
        self.folder, self.name = folder, name

    def _path(self, key: Any) -> Path:
        return self.folder / f"{self.name}-{sha256(repr(key))[:16]}.nbc"

    def load(self, key: Any) -> Any:
        """Machine code saved under a key; None if missing or damaged."""
        path = self._path(key)
        try:
            found = unseal(path.read_bytes())
        except OSError:
            return None
        if found is None or found[1] != path.name:
            return None
        saved_key, data = pickle.loads(found[0])
        return data if saved_key == key else None

    def save(self, key: Any, data: Any) -> None:
        """Save machine code. If that fails (disk full), the next run compiles again."""
        path = self._path(key)
        with suppress(OSError):
            write_atomically(path, seal(dumps((key, data)), path.name))
