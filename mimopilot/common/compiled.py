"""The decorator for functions that numba compiles, and where their machine code is kept."""

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
    """Compile a function at its first call, or take its machine code from the cache."""
    dispatcher = numba.njit(error_model="numpy")(function)
    dispatcher._cache = _Cache(function)
    return dispatcher


@lru_cache
def _folder(package: Path) -> Path:
    """One for each state of a package: numba does not notice that a *called* function changed."""
    digest = hashlib.sha256(numba.__version__.encode())
    for path in sorted(package.glob("*.py")):
        digest.update(path.read_bytes())
    return cache_folder() / f"numba-{digest.hexdigest()[:16]}"


class _Cache(FunctionCache):  # type: ignore[misc]
    """numba's cache of a function, on files that are checked before they are used.

    numba's own files are unpickled and run whatever stands in them: a damaged one ends in any exception or a signal.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        config.CACHE_DIR = str(_folder(Path(function.__code__.co_filename).parent))
        super().__init__(function)
        self._cache_file = _Files(Path(self._cache_path), self._impl.filename_base)


class _Files:
    """One sealed file for each signature of a function; what is missing or damaged is compiled again.

    Parameters
    ----------
    folder : Path
        Where they lie.
    name : str
        Of the function, as it can stand in a file's name.
    """

    def __init__(self, folder: Path, name: str) -> None:
        self.folder, self.name = folder, name

    def _path(self, key: Any) -> Path:
        return self.folder / f"{self.name}-{sha256(repr(key))[:16]}.nbc"

    def load(self, key: Any) -> Any:
        """What was saved under a key; None when there is nothing, or it is not whole."""
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
        """Keep machine code; without room for it the next run compiles again."""
        path = self._path(key)
        with suppress(OSError):
            write_atomically(path, seal(dumps((key, data)), path.name))
