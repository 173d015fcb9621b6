"""Results to the last bit on any number of cores: linear algebra on one thread."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import Any, ParamSpec, TypeVar

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


@lru_cache(maxsize=1)
def _libraries() -> Any:
    import numpy as np  # noqa: F401
    import scipy.linalg  # noqa: F401
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def reproducible(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """The function with BLAS on one thread, whatever the caller's process uses otherwise.

    The order in which a BLAS adds, and so the last bits of a result, depend on its number of threads.
    """

    @wraps(function)
    def run(*arguments: Parameters.args, **keywords: Parameters.kwargs) -> Result:
        with _libraries().limit(limits=1, user_api="blas"):
            return function(*arguments, **keywords)

    return run
