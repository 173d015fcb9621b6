"""The decorator for functions that numba compiles, and where their machine code is kept."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numba
from llvmlite import ir
from numba.core import config, types
from numba.extending import intrinsic

from codegen.native import cache_folder


def _sources_hash() -> str:
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


# numba's own cache does not notice that a *called* function changed: keep one folder for each state of the room.
config.CACHE_DIR = str(cache_folder() / f"numba-{_sources_hash()}")

compiled = numba.njit(cache=True, error_model="numpy")

#: For small functions in the innermost loops: LLVM does not inline all of them by itself, which costs a factor of 2.5.
inlined = numba.njit(error_model="numpy", inline="always")


@intrinsic  # type: ignore[untyped-decorator]
def call_step(typing_context: Any, address: Any, state: Any, inputs: Any, outputs: Any) -> Any:
    """Call ``void f(uint8_t *, const uint8_t *, uint8_t *)`` at an address, from compiled code."""
    signature = types.void(types.intp, types.intp, types.intp, types.intp)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = ir.IntType(8).as_pointer()
        function = builder.inttoptr(arguments[0], ir.FunctionType(ir.VoidType(), [pointer] * 3).as_pointer())
        builder.call(function, [builder.inttoptr(argument, pointer) for argument in arguments[1:]])
        return context.get_dummy_value()

    return signature, generate
