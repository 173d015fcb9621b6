"""The numba decorators of the simulation, and calls of the generated C++ from compiled code."""

from __future__ import annotations

from typing import Any

import numba
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from mimopilot.common.compiled import compiled as compiled

#: For small functions in the innermost loops. LLVM does not inline all of them by itself, which costs a factor of 2.5.
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
