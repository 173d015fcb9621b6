"""Step response of a flight whose setpoint moves, by regularised deconvolution.

The setpoint and the answer are cut into stretches that overlap by half. In each the answer is the setpoint convolved
with the impulse response h, plus a constant: all stretches together are one least squares problem for h. Its prior is
a zero-mean Gaussian whose variance decays with time and whose neighbours are alike (the tuned/correlated kernel of T.
Chen, H. Ohlsson, L. Ljung, "On the estimation of transfer functions, regularizations and Gaussian processes",
Automatica 48, 2012); its size and decay are those that make the record most likely. The band holds two parts: the
spread of the estimates without each stretch in turn (jackknife), and what the prior says about the frequencies at
which the setpoint does not move. The estimate also looks into the time before the step: an answer there means that the
setpoint follows the vehicle, as that of a position controller in a gust, and not the vehicle the setpoint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.logs.resample import Interval, Series, sampling_period

#: Length of the response, s: the time in which a multirotor's attitude settles.
LENGTH = 1.2
#: Time before the step that is estimated, too, s, and the largest answer in it, as a share of the step.
BEFORE, ACAUSAL = 0.1, 0.15
#: Highest rate of the samples that are used, Hz: 10 times the fastest attitude loop's bandwidth, and the problem stays
#: small.
RATE = 100.0
#: Stretches: length in lengths of the response, least movement of the setpoint in one (rad), fewest of them.
STRETCH, LEAST_MOVE, FEWEST = 3, float(np.radians(1.0)), 4
#: Decays of the prior that are tried: share of its variance left at the end of the response; its size relative to 1.
DECAYS, SIZES = (0.3, 0.1, 0.01, 1e-3, 1e-5), (0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0)
#: Signals with a shorter period than this share of the grid's are averaged over its periods.
AVERAGED = 0.75
#: Width of the band (two standard deviations on both sides, RMS over the response) over the size of the answer from
#: which on the estimate is refused.
WIDEST = 1.0

Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class StepEstimate:
    """An estimated step response.

    Attributes
    ----------
    time : (K,) array, s
        From the step on.
    step : (K,) array
        Answer to a setpoint that steps from 0 to 1.
    band : (K,) array
        Two standard deviations.
    stretches : int
        How many were used.
    explained : float
        Share of the answer's variance that the response explains.
    early : float
        Largest answer before the step, either sign.
    """

    time: Signal
    step: Signal
    band: Signal
    stretches: int
    explained: float
    early: float

    @property
    def width(self) -> float:
        """Width of the band over the size of the answer, RMS over the response."""
        return float(2 * np.sqrt(np.mean(self.band**2) / np.mean(self.step**2)))

    @property
    def refused(self) -> bool:
        """Whether the band is wider than the response."""
        return not self.width < WIDEST

    def rise(self) -> float:
        """Time from 10 to 90 % of the last value, s; NaN if it is not reached."""
        last = float(self.step[-max(1, len(self.step) // 5) :].mean())
        passed = [np.flatnonzero(self.step >= share * last) for share in (0.1, 0.9)]
        return float(self.time[passed[1][0]] - self.time[passed[0][0]]) if all(map(len, passed)) else np.nan

    def overshoot(self) -> float:
        """Largest value over the last one, minus 1."""
        last = float(self.step[-max(1, len(self.step) // 5) :].mean())
        return float(self.step.max() / last - 1) if last > 0 else np.nan


def estimate_step(
    setpoint: Series, answer: Series, parts: Sequence[Interval], axis: int
) -> tuple[StepEstimate | None, str]:
    """Step response from a setpoint to an answer on one axis.

    Parameters
    ----------
    setpoint, answer : Series
        Each with its own time stamps.
    parts : sequence of (begin, end), s
        Stretches of flight that may be used.
    axis : int
        Column of both.

    Returns
    -------
    StepEstimate or None
    str
        Why there is none; empty: there is one.
    """
    rate = min(RATE, 1 / sampling_period(answer.time), 1 / sampling_period(setpoint.time))
    Ts = 1 / rate
    length = max(round(LENGTH * rate), 8)
    pieces = []
    for begin, end in parts:
        begin, end = max(begin, setpoint.time[0], answer.time[0]), min(end, setpoint.time[-1], answer.time[-1])
        grid = np.arange(begin, end, Ts)
        if len(grid) < STRETCH * length:
            continue
        r = _averaged(setpoint, axis, grid, Ts, hold=True)
        y = _averaged(answer, axis, grid, Ts, hold=False)
        for start in range(0, len(grid) - STRETCH * length + 1, STRETCH * length // 2):
            stop = start + STRETCH * length
            if np.ptp(r[start:stop]) >= LEAST_MOVE:
                pieces.append((r[start:stop], y[start:stop]))
    if len(pieces) < FEWEST:
        return None, (
            f"the setpoint moves by {np.degrees(LEAST_MOVE):g} degree or more in {len(pieces)} stretches of "
            f"{STRETCH * LENGTH:g} s, {FEWEST} are needed: fly with moving sticks or setpoints"
        )
    # A setpoint that is averaged over each period steps half a period before the sample that it is first full in.
    early = Ts / 2 if sampling_period(setpoint.time) <= AVERAGED * Ts else 0.0
    found = _estimated(pieces, length, Ts, early)
    if found.refused:
        return None, (
            f"the band of its estimate from {found.stretches} stretches is {found.width:.1f} times as wide as the "
            "response: the setpoint moves too little or too slowly; fly sharper steps of the sticks"
        )
    if found.early > ACAUSAL:
        return None, (
            f"the response begins before the step ({found.early:.2f} of it): the setpoint follows the vehicle, as that "
            "of a position controller does; fly steps of the sticks"
        )
    return found, ""


def _averaged(series: Series, axis: int, grid: Signal, Ts: float, hold: bool) -> Signal:
    """A signal on a slower grid: the mean over each period, so that nothing is folded."""
    values, period = series.values[:, axis], sampling_period(series.time)
    if period > AVERAGED * Ts:
        if hold:
            return np.asarray(values[np.maximum(np.searchsorted(series.time, grid, side="right") - 1, 0)], np.float64)
        return np.asarray(np.interp(grid, series.time, values), np.float64)
    between = values[:-1] if hold else (values[1:] + values[:-1]) / 2
    area = np.concatenate([[0.0], np.cumsum(between * np.diff(series.time))])
    edges = np.interp(np.append(grid, grid[-1] + Ts) - Ts / 2, series.time, area)
    return np.asarray(np.diff(edges) / Ts, np.float64)


def _estimated(pieces: Sequence[tuple[Signal, Signal]], length: int, Ts: float, early: float) -> StepEstimate:
    from scipy.linalg import toeplitz

    ahead = round(BEFORE / Ts)
    length += ahead
    A, b, power, count = [], [], 0.0, 0
    for r, y in pieces:
        # Row k holds r(k), r(k-1)...: the answer `ahead` samples earlier has lags from -ahead on.
        # The first `length` answers also depend on the setpoint before the stretch: they are left out.
        X = toeplitz(r, np.zeros(length))[length:]
        late = y[length - ahead : len(y) - ahead]
        X, rest = X - X.mean(axis=0), late - late.mean()
        A.append(X.T @ X)
        b.append(X.T @ rest)
        power, count = power + float(rest @ rest), count + len(rest)
    total, right = np.sum(A, axis=0), np.sum(b, axis=0)
    # Stretches overlap by half: half of the samples are new.
    noise, prior = _most_likely(total, right, power, count, np.maximum(np.arange(length) - ahead, 0) + 1)
    solve = np.linalg.inv(total + noise * np.linalg.inv(prior))
    h = solve @ right
    certainty = noise * np.linalg.inv(prior)
    left_out = np.array(
        [np.linalg.solve(total - one + certainty, right - part) for one, part in zip(A, b, strict=True)]
    )
    steps = np.cumsum(left_out, axis=1)
    n = len(pieces)
    # Neighbouring stretches share half of their samples: the jackknife counts half of the stretches as independent.
    spread = 2 * (n - 1) / n * np.sum((steps - steps.mean(axis=0)) ** 2, axis=0)
    unseen = np.eye(length) - solve @ total
    summed = np.tril(np.ones((length, length)))
    doubt = np.einsum("ij,jk,ik->i", summed @ unseen, prior, summed @ unseen)
    left = power - 2 * h @ right + h @ total @ h
    step, band = np.cumsum(h), 2 * np.sqrt(spread + np.maximum(doubt, 0.0))
    return StepEstimate(
        time=np.asarray(np.arange(length - ahead) * Ts + early, np.float64),
        step=step[ahead:],
        band=band[ahead:],
        stretches=n,
        explained=float(1 - left / power),
        early=float(np.abs(step[:ahead]).max(initial=0.0)),
    )


def _most_likely(
    total: Signal, right: Signal, power: float, count: int, places: NDArray[np.intp]
) -> tuple[float, Signal]:
    """Variance of the noise, and the prior that makes the answers most likely, (length, length).

    `places` (length,) are the lags, of which those before the step count as the first.
    """
    length = len(places)
    least = np.linalg.lstsq(total + 1e-9 * np.trace(total) / length * np.eye(length), right, rcond=None)[0]
    noise = max((power - float(least @ right)) / max(count - length, 1), 1e-12 * power / count)
    best, chosen = np.inf, np.eye(length)
    for left in DECAYS:
        decay = left ** (np.maximum(places[:, None], places) / length)
        for size in SIZES:
            prior = size**2 / length * decay
            # Likelihood of y = X h + e with both Gaussian, by the matrix determinant lemma.
            root = np.linalg.cholesky(prior + 1e-12 * prior[0, 0] * np.eye(length))
            inner = np.eye(length) + root.T @ total @ root / noise
            fitted = root.T @ right
            value = float(np.linalg.slogdet(inner)[1] - fitted @ np.linalg.solve(inner, fitted) / noise**2)
            if value < best:
                best, chosen = value, prior + 1e-12 * prior[0, 0] * np.eye(length)
    return noise, chosen
