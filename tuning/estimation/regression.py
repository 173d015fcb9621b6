"""Linear regression with extended instrumental variables, (3.28)-(3.31): VRFT's estimator.

u(k) = B x(k) + eps(k) is solved from the correlations of both sides with the instrument
zeta(k) = [w(k-l); ...; w(k+l)]; the thesis' Kronecker form splits into one small problem for each row of B.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, lstsq

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.estimation.correlations import autocorrelation, cross_correlation
from mimopilot.tuning.plant.local_polynomial import LocalResponse, local_response

#: Diagonal loading of the residual covariance, relative: the instruments at neighbouring lags are almost equal.
LOADING = 1e-3
#: Width of the noise spectrum's windows over their frequency.
GROWTH = 0.1
#: Share of the instrument's power below the highest frequency of the noise spectrum.
POWER = 0.9999
#: Fewest frequencies of the noise spectrum, in units of the resolution pi / N.
MIN_BINS = 60

Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Regression:
    """One regression problem; each list has one array for each segment.

    Attributes
    ----------
    x : list of (N_s, n_x) arrays
        Regressors.
    u : list of (N_s, n_u) arrays
        Signals to be explained.
    w : list of (N_s, n_w) arrays
        Signals whose 2 l + 1 lags are the instruments.
    lags : int, samples
        l.
    memory : int, samples
        Longest lag of the residual's correlation, for (3.30).
    external : list of (N_s, n_e) arrays
        External signal: what it does not explain is noise. Equal to `w` if that is external.
    """

    x: list[Signal]
    u: list[Signal]
    w: list[Signal]
    lags: int
    memory: int
    external: list[Signal]

    @property
    def samples(self) -> int:
        """Samples in all segments."""
        return sum(len(x) for x in self.x)


@dataclass(frozen=True, eq=False)
class _RegressionRow:
    """Maps from the correlations to one row of B, for regressors scaled to unit RMS."""

    gain: Signal
    projected: Signal
    weighted: Signal


@dataclass(frozen=True, eq=False)
class Solution:
    """Result of a regression; everything but B is expensive and computed on demand.

    Attributes
    ----------
    B : (n_u, n_x) array
        Coefficients.
    condition : float
        Condition number for regressors of unit RMS: a large one means that gains are hardly distinguishable.
    problem : Regression
        The data.
    scale : (n_x,) array
        RMS of the regressors.
    """

    B: Signal
    condition: float
    problem: Regression
    scale: Signal
    rows: tuple[_RegressionRow, ...]

    @cached_property
    def r_squared(self) -> Signal:
        """Share of each u's power that B x explains, (n_u,)."""
        pairs = list(zip(self.problem.u, self.problem.x, strict=True))
        power = sum(_power(u) for u, _ in pairs)
        left = sum(_power(u - x @ self.B.T) for u, x in pairs)
        share: Signal = 1 - np.asarray(left) / np.asarray(power)
        return share

    @cached_property
    def least_squares(self) -> Signal:
        """Coefficients without instruments, (n_u, n_x), biased by noise: a large difference indicates a noisy log."""
        moment = sum(x.T @ x for x in self.problem.x)
        target = sum(x.T @ u for x, u in zip(self.problem.x, self.problem.u, strict=True))
        found: Signal = lstsq(moment / np.outer(self.scale, self.scale), target / self.scale[:, None])[0]
        return found.T / self.scale

    @cached_property
    def _noise(self) -> LocalResponse:
        """Spectrum of the part of [u, x] that the external signal does not explain; frequencies in rad/sample."""
        problem = self.problem
        lengths = np.cumsum([0, *(len(signal) for signal in problem.x)])
        segments = [(int(a), int(b)) for a, b in itertools.pairwise(lengths)]
        w = np.vstack(problem.external)
        power = np.cumsum((np.abs(np.fft.rfft(w, axis=0)) ** 2).sum(axis=1))
        upper = np.pi * (np.searchsorted(power, POWER * power[-1]) + 1) / len(power)
        upper = min(np.pi, max(upper, MIN_BINS * np.pi / lengths[-1]))
        signals = np.hstack([np.vstack(problem.u), np.vstack(problem.x) / self.scale])
        return local_response(w, signals, 1.0, segments, upper, growth=GROWTH)

    @cached_property
    def covariance(self) -> Signal:
        """Covariance of each row of B, (n_u, n_x, n_x), over repeated noise with the same excitation."""
        unit = self.B * self.scale
        covariance = np.empty((*self.B.shape, self.B.shape[1]))
        for i, row in enumerate(self.rows):
            covariance[i] = row.gain @ _score_covariance(self.problem, self._noise, row, unit[i], i) @ row.gain.T
        scaled: Signal = covariance / np.outer(self.scale, self.scale)
        return scaled

    @cached_property
    def strength(self) -> Signal:
        """Share of each regressor's power that the external signal explains, (n_x,)."""
        n_u = len(self.B)
        explained = self._noise.explained[:, n_u:]
        spectrum = np.real(np.diagonal(self._noise.noise, axis1=1, axis2=2))[:, n_u:] / (1 - explained + 1e-12)
        share: Signal = (explained * spectrum).sum(axis=0) / spectrum.sum(axis=0)
        return share


def solve(problem: Regression, weight: str, prior: Signal | None = None, pull: float = 0.0) -> Solution:
    """Estimate B row by row.

    Parameters
    ----------
    problem : Regression
        The data.
    weight : str
        ``identity``: least squares on the correlations, (3.28). ``optimal``: (3.30), in two steps.
    prior : (n_u, n_x) array, optional
        Coefficients that the estimate is pulled towards.
    pull : float
        lambda of the pull, relative to the curvature of each coefficient; 0: none.

    Returns
    -------
    Solution

    Raises
    ------
    TuningError
        When a regressor is constant, or the instrument does not excite all of them.
    """
    samples = problem.samples
    scale: Signal = np.sqrt(np.sum([_power(x) for x in problem.x], axis=0) / samples)
    if not (scale > 0).all():
        raise TuningError("not excited: a measured signal is constant; inject a torque on every axis, check the log")

    def correlate(signals: list[Signal]) -> Signal:
        terms = [cross_correlation(w, s, problem.lags) for w, s in zip(problem.w, signals, strict=True)]
        return np.reshape(np.sum(terms, axis=0), (-1, signals[0].shape[1])) / samples

    S, Q = correlate(problem.x) / scale, correlate(problem.u)
    first, _, rank, singular = lstsq(S, Q)
    if rank < S.shape[1]:
        raise TuningError("not excited: the injected signal does not excite every axis; inject a torque on each axis")
    B = np.empty((Q.shape[1], S.shape[1]))
    rows: list[_RegressionRow] = []
    for i in range(len(B)):
        if weight == "optimal":
            b = first[:, i] / scale
            residual = [u[:, [i]] - (x @ b)[:, None] for u, x in zip(problem.u, problem.x, strict=True)]
            factor = cho_factor(_residual_covariance(problem, residual))
            projected = cho_solve(factor, S)
        else:
            factor = None
            projected = S
        curvature = S.T @ projected
        load = pull * np.diag(np.diag(curvature))
        target = load @ (prior[i] * scale) if prior is not None else 0.0
        gain = np.linalg.inv(curvature + load)
        B[i] = gain @ (projected.T @ Q[:, i] + target)
        misfit = Q[:, i] - S @ B[i]
        rows.append(_RegressionRow(gain, projected, cho_solve(factor, misfit) if factor is not None else misfit))
    return Solution(B / scale, float(singular[0] / singular[-1]), problem, scale, tuple(rows))


def _power(signal: Signal) -> Signal:
    """Sum of squares of each column."""
    power: Signal = np.einsum("ij,ij->j", signal, signal)
    return power


def _residual_covariance(problem: Regression, residual: list[Signal]) -> Signal:
    """Newey-West covariance of zeta(k) eps(k), Gamma of (3.30), for one row of the controller.

    The residual is independent of the external instrument. So the covariance at lag h is the product of their
    autocorrelations, and Gamma is block Toeplitz: sum over h of R_eps(h) R_w(h + tau_1 - tau_2).
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


def _score_covariance(problem: Regression, noise: LocalResponse, row: _RegressionRow, b: Signal, i: int) -> Signal:
    """Covariance of the noise in S' W^-1 (q - S b), (n_x, n_x).

    Noise enters as (1/N) sum of z(k) eps(k) + g(k) x_n(k). Here eps and x_n are the noise in the residual and in the
    regressors; z = S' W^-1 zeta and g = zeta' W^-1 (q - S b) are the external signal, filtered. By Parseval the
    covariance is a sum of their spectra over frequency.
    """
    n_x, n_u = len(b), problem.u[0].shape[1]
    taps = np.column_stack([row.projected, row.weighted]).reshape(2 * problem.lags + 1, -1, n_x + 1)
    # Noise of [eps, x] from that of [u, x].
    mix = np.zeros((1 + n_x, n_u + n_x))
    mix[0, i], mix[0, n_u:], mix[1:, n_u:] = 1.0, -b, np.eye(n_x)
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
