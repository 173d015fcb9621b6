"""Inverse and singular values of many small matrices; 2x2 in closed form: LAPACK takes half of a tuning's time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Complex = NDArray[np.complex128]
Signal = NDArray[np.float64]


def singular_values(matrices: Complex) -> tuple[Signal, Signal]:
    """Largest and smallest singular value of matrices (..., n, n), each (...)."""
    if matrices.shape[-1] == 1:
        only: Signal = np.abs(matrices[..., 0, 0])
        return only, only
    if matrices.shape[-1] > 2:
        values: Signal = np.linalg.svd(matrices, compute_uv=False).astype(np.float64)
        return values[..., 0], values[..., -1]
    size = np.sum(np.abs(matrices) ** 2, axis=(-2, -1))
    determinant = np.abs(matrices[..., 0, 0] * matrices[..., 1, 1] - matrices[..., 0, 1] * matrices[..., 1, 0])
    largest = np.sqrt((size + np.sqrt(np.maximum(size**2 - 4 * determinant**2, 0.0))) / 2)
    return largest, determinant / np.where(largest > 0, largest, 1.0)


def inverse(matrices: Complex) -> Complex:
    """Inverse of matrices (..., n, n).

    Raises
    ------
    numpy.linalg.LinAlgError
        When one of them is singular.
    """
    if matrices.shape[-1] != 2:
        return np.linalg.inv(matrices).astype(np.complex128)
    a, b, c, d = (matrices[..., row, column] for row in range(2) for column in range(2))
    determinant = a * d - b * c
    if not np.all(determinant):
        raise np.linalg.LinAlgError("Singular matrix")
    adjugate = np.stack([d, -b, -c, a], axis=-1) / determinant[..., None]
    found: Complex = adjugate.reshape(matrices.shape).astype(np.complex128)
    return found
