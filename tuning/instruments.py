"""Linear regression with extended instrumental variables: the estimator behind VRFT, (3.28)-(3.31).

u(k) = B x(k) + eps(k) is solved from the correlations of both sides with the instrument
zeta(k) = [w(k-l); ...; w(k+l)]; the thesis' Kronecker form splits into one small problem for each row of B.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, lstsq

from tuning.correlations import autocorrelation, cross_correlation
from tuning.errors import TuningError
from tuning.frequency import LocalResponse, local_response

#: Diagonal loading of the residual covariance: the instruments at neighbouring lags are almost the same.
LOADING = 1e-3
#: Share of the instrument's power below the highest frequency at which the noise is looked at.
POWER = 0.9999

Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Regression:
    """One regression problem; each list holds one array a segment.

    Attributes
    ----------
    x : list of (N_s, n_x) arrays
        Regressors.
    u : list of (N_s, n_u) arrays
        What they explain.
    w : list of (N_s, n_w) arrays
        External instrument.
    lags : int, samples
        l.
    memory : int, samples
        How long the residual may remember, for (3.30).
    """

    x: list[Signal]
    u: list[Signal]
    w: list[Signal]
    lags: int
    memory: int

    @property
    def samples(self) -> int:
        """Samples in all segments."""
        return sum(len(x) for x in self.x)


@dataclass(frozen=True, eq=False)
class Solution:
    """What a regression gives.

    Attributes
    ----------
    B : (n_u, n_x) array
        Coefficients.
    r_squared : (n_u,) array
        Share of each u's power that B x explains.
    least_squares : (n_u, n_x) array
        The same coefficients without instruments, biased by noise: a large difference is a warning.
    uncertainty : callable
        Computes `covariance` and `strength`, which cost more than B: only when they are asked for.
    """

    B: Signal
    r_squared: Signal
    least_squares: Signal
    uncertainty: Callable[[], tuple[Signal, Signal]]

    @cached_property
    def _certain(self) -> tuple[Signal, Signal]:
        return self.uncertainty()

    @property
    def covariance(self) -> Signal:
        """Of each row of B, (n_u, n_x, n_x), under repeated noise, the excitation being the same."""
        return self._certain[0]

    @property
    def strength(self) -> Signal:
        """Share of each regressor's power that the instrument explains, (n_x,)."""
        return self._certain[1]


def solve(problem: Regression, weight: str, prior: Signal | None = None, pull: float = 0.0) -> Solution:
    """Estimate B row by row.

    Parameters
    ----------
    problem : Regression
        The data.
    weight : str
        ``identity``: least squares on the correlations, (3.28). ``optimal``: (3.30), in two steps.
    prior : (n_u, n_x) array, optional
        Coefficients towards which the estimate is pulled.
    pull : float
        lambda of the pull, relative to the curvature of each coefficient; 0: none.

    Returns
    -------
    Solution

    Raises
    ------
    TuningError
        When a regressor is constant, or the instrument does not reach all of them.
    """
    samples = problem.samples
    scale = np.sqrt(sum((x**2).sum(axis=0) for x in problem.x) / samples)
    if not (scale > 0).all():
        raise TuningError("not excited: a measured signal is constant, so its gains cannot be found")
    x = [signal / scale for signal in problem.x]

    def correlate(signals: list[Signal]) -> Signal:
        terms = [cross_correlation(w, s, problem.lags) for w, s in zip(problem.w, signals, strict=True)]
        return np.reshape(np.sum(terms, axis=0), (-1, signals[0].shape[1])) / samples

    S, Q = correlate(x), correlate(problem.u)
    first, _, rank, _ = lstsq(S, Q)
    if rank < S.shape[1]:
        raise TuningError("not excited: the injected signal does not reach every axis, so some gains cannot be found")
    n_u, n_x = Q.shape[1], S.shape[1]
    B = np.empty((n_u, n_x))
    rows: list[tuple[Signal, Signal, Signal]] = []
    for row in range(n_u):
        if weight == "optimal":
            residual = [u[:, [row]] - xs @ first[:, [row]] for u, xs in zip(problem.u, x, strict=True)]
            factor = cho_factor(_residual_covariance(problem, residual))
            projected = cho_solve(factor, S)
        else:
            factor = None
            projected = S
        curvature = S.T @ projected
        load = pull * np.diag(np.diag(curvature))
        target = load @ (prior[row] * scale) if prior is not None else 0.0
        gain = np.linalg.inv(curvature + load)
        B[row] = gain @ (projected.T @ Q[:, row] + target)
        misfit = Q[:, row] - S @ B[row]
        weighted = cho_solve(factor, misfit) if factor is not None else misfit
        rows.append((gain, projected, weighted))
    power = sum((u**2).sum(axis=0) for u in problem.u)
    left = sum(((u - xs @ B.T) ** 2).sum(axis=0) for u, xs in zip(problem.u, x, strict=True))
    plain = lstsq(np.vstack(x), np.vstack(problem.u))[0].T

    def uncertainty() -> tuple[Signal, Signal]:
        noise = _noise(problem, x)
        covariance = np.empty((n_u, n_x, n_x))
        for row, (gain, projected, weighted) in enumerate(rows):
            covariance[row] = gain @ _score_covariance(problem, noise, projected, weighted, B[row], row) @ gain.T
        explained = noise.explained[:, n_u:]
        spectrum = np.real(np.diagonal(noise.noise, axis1=1, axis2=2))[:, n_u:] / (1 - explained + 1e-12)
        return covariance / np.outer(scale, scale), (explained * spectrum).sum(axis=0) / spectrum.sum(axis=0)

    return Solution(B / scale, 1 - left / power, plain / scale, uncertainty)


def _residual_covariance(problem: Regression, residual: list[Signal]) -> Signal:
    """Newey-West covariance of zeta(k) eps(k), Gamma of (3.30), for one row of the controller.

    The residual is independent of the external instrument, so the covariance at lag h is the product of
    their autocorrelations and Gamma is block Toeplitz: sum over h of R_eps(h) R_w(h + tau_1 - tau_2).
    """
    lags, memory, samples = problem.lags, problem.memory, problem.samples
    taper = 1 - np.abs(np.arange(-memory, memory + 1)) / (memory + 1)
    R_eps = np.sum([autocorrelation(e, memory) for e in residual], axis=0)[:, 0, 0] / samples * taper
    R_w: Signal = np.sum([autocorrelation(w, 2 * lags + memory) for w in problem.w], axis=0) / samples
    n_w = R_w.shape[1]
    blocks = np.empty((4 * lags + 1, n_w, n_w))
    for i in range(n_w):
        for j in range(n_w):
            blocks[:, i, j] = np.convolve(R_w[:, i, j], R_eps[::-1], "valid")
    difference = np.arange(2 * lags + 1)[:, None] - np.arange(2 * lags + 1)[None, :]
    gamma = blocks[difference + 2 * lags].transpose(0, 2, 1, 3).reshape((2 * lags + 1) * n_w, -1)
    gamma = (gamma + gamma.T) / 2
    loaded: Signal = gamma + LOADING * np.trace(gamma) / len(gamma) * np.eye(len(gamma))
    return loaded


def _noise(problem: Regression, x: list[Signal]) -> LocalResponse:
    """Spectrum of what the instrument does not explain of [u, x]; frequencies are in rad/sample."""
    lengths = np.cumsum([0, *(len(signal) for signal in x)])
    segments = [(int(a), int(b)) for a, b in itertools.pairwise(lengths)]
    w = np.vstack(problem.w)
    power = np.cumsum((np.abs(np.fft.rfft(w, axis=0)) ** 2).sum(axis=1))
    upper = np.pi * (np.searchsorted(power, POWER * power[-1]) + 1) / len(power)
    # Never so narrow that only a handful of frequencies are left.
    upper = min(np.pi, max(upper, 60 * np.pi / lengths[-1]))
    return local_response(w, np.hstack([np.vstack(problem.u), np.vstack(x)]), 1.0, segments, upper, centres=60)


def _score_covariance(
    problem: Regression, noise: LocalResponse, projected: Signal, weighted: Signal, b: Signal, row: int
) -> Signal:
    """Covariance of what noise adds to S' W^-1 (q - S b), (n_x, n_x).

    Noise enters as (1/N) sum of z(k) eps(k) + g(k) x_n(k): eps and x_n are the noise in the residual and in the
    regressors, z = S' W^-1 zeta and g = zeta' W^-1 (q - S b) filters of the external signal. By Parseval its
    covariance is a sum over frequency of their spectra.
    """
    n_x, n_u = len(b), problem.u[0].shape[1]
    taps = np.column_stack([projected, weighted]).reshape(2 * problem.lags + 1, -1, n_x + 1)
    # Noise of [eps, x] from that of [u, x].
    mix = np.zeros((1 + n_x, n_u + n_x))
    mix[0, row], mix[0, n_u:], mix[1:, n_u:] = 1.0, -b, np.eye(n_x)
    spectra = mix @ noise.noise @ mix.T
    total = np.zeros((n_x, n_x))
    for w in problem.w:
        size = len(w)
        frequencies = 2 * np.pi * np.arange(size // 2 + 1) / size
        W = np.fft.rfft(w, axis=0)
        edges = np.searchsorted(frequencies, (noise.omega[1:] + noise.omega[:-1]) / 2)
        groups = np.split(np.arange(len(frequencies)), edges)
        shift = np.exp(1j * np.outer(np.arange(-problem.lags, problem.lags + 1), noise.omega))
        response = np.einsum("taj,tk->kaj", taps, shift)  # of the filters, at the centres
        for k, group in enumerate(groups):
            C = W[group] @ response[k]  # (bins, n_x + 1): z, then g
            z, g = C[:, :n_x], C[:, n_x:]
            phi = spectra[k]
            cross = (z.T @ g.conj()) @ phi[0:1, 1:]
            block = (z.T @ z.conj()) * phi[0, 0] + cross + cross.conj().T + np.sum(np.abs(g) ** 2) * phi[1:, 1:]
            total += 2 * np.real(block) / size
    return total / problem.samples**2
