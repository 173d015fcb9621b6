"""C++ literals that every compiler reads back to the same bits."""

from __future__ import annotations

import numpy as np

from mimopilot.codegen.errors import CodegenError


def float_literal(value: float) -> str:
    """Shortest C++ literal of type float that reads back to float32(value).

    Raises
    ------
    CodegenError
        If the value is not finite in single precision.

    Examples
    --------
    >>> float_literal(0.1), float_literal(-3.0), float_literal(1e-7)
    ('0.1F', '-3.0F', '1e-07F')
    """
    with np.errstate(over="ignore"):
        rounded = np.float32(value)
    if not np.isfinite(rounded):
        raise CodegenError(f"cannot emit {value} as a single-precision literal; correct the gains file")
    return f"{rounded!s}F"
