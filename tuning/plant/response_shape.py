"""Low-order model of a vehicle's frequency response: a damped rigid body with delay and rotor lag."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

#: Grid of the fit: delays (s), rotor lags (s), rate damping (1/s). It covers vehicles from racers to heavy lifters.
DELAYS = (0.0, 0.005, 0.01, 0.015, 0.02, 0.03, 0.04, 0.06)
LAGS = (0.0, 0.015, 0.025, 0.035, 0.05, 0.07, 0.1)
DAMPINGS = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)

#: Delay (s), rotor lag (s), damping (1/s).
ResponseShape = tuple[float, float, float]
#: Relative error of a vehicle's response from every such shape.
SHAPE_ERROR = 0.03

Complex = NDArray[np.complex128]
Signal = NDArray[np.float64]

SHAPES: tuple[ResponseShape, ...] = tuple(itertools.product(DELAYS, LAGS, DAMPINGS))


def shape_response(omega: Signal, shape: ResponseShape) -> Complex:
    """exp(-j w delay) / ((1 + j w lag) (j w + damping)) at omega (K,), rad/s."""
    delay, lag, damping = shape
    s = 1j * omega
    response: Complex = np.exp(-s * delay) / ((1 + s * lag) * (s + damping))
    return response


def fit_shape(omega: Signal, G: Complex, weight: Signal) -> tuple[ResponseShape, Signal, Signal, float]:
    """Least-squares fit of G = B times a response shape, with a real B.

    Parameters
    ----------
    omega : (K,) array, rad/s
    G : (K, n, n) array
        Response from torque to rates.
    weight : (K, n, n) array
        Inverse variances.

    Returns
    -------
    shape : ResponseShape
        The best of `SHAPES`: delay and lag (s), damping (1/s).
    B : (n, n) array, rad/s^2
    power : (n, n) array
        Inverse variance of each element of B.
    misfit : float
        Weighted sum of squares of the residual.
    """
    shapes = np.array([shape_response(omega, shape) for shape in SHAPES])
    power = np.einsum("nk,kij->nij", np.abs(shapes) ** 2, weight)
    B = np.einsum("nk,kij->nij", shapes.conj(), weight * G).real / power
    misfit = np.sum(weight * np.abs(G) ** 2) - np.sum(power * B**2, axis=(1, 2))
    best = int(np.argmin(misfit))
    return SHAPES[best], B[best], power[best], float(misfit[best])
