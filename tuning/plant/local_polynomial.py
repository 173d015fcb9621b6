"""Local polynomial estimate of frequency responses and their covariance from one closed-loop experiment.

The response to the external excitation and the transient of each segment are smooth in frequency. Both are fitted
by a quadratic over a few DFT bins. The residual gives the noise spectrum and the covariance of the response. Leakage
causes no bias, so a PRBS needs no whole number of periods. Source: R. Pintelon, J. Schoukens, System Identification:
A Frequency Domain Approach, 2nd ed., section 7.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.errors import TuningError

ORDER = 2  # of the local polynomials
FREEDOM = 8  # least degrees of freedom of the noise estimate in a window
CENTRES = 1000  # largest number of frequencies
#: Share of a signal's power that a wide window may leave unexplained, whatever narrow ones leave: a narrow window
#: hardly tells a chirp near an end of the record from the record's transient.
NEGLIGIBLE = 3e-3
#: A window is too wide if its noise exceeds that of narrow windows by this many standard deviations of the ratio.
HIDDEN = 4.0

#: Relative error of a quotient that is a whole number but for rounding.
ROUNDING = 1e-9

Complex = NDArray[np.complex128]
Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LocalResponse:
    """Responses of n_v signals to n_w external ones at K frequencies.

    Attributes
    ----------
    omega : (K,) array, rad/s
        Frequencies.
    response : (K, n_v, n_w) array
        From w to v.
    noise : (K, n_v, n_v) array
        Spectrum of the part that w does not explain: E[V V^H] / N of the DFT over N samples.
    explained : (K, n_v) array
        Multiple coherence: fraction of each signal's power that w explains.
    error : (K, n_w, n_w) array
        The covariance of the response is noise (x) error (Kronecker product).
    """

    omega: Signal
    response: Complex
    noise: Complex
    explained: Signal
    error: Complex

    def deviation(self) -> Signal:
        """Standard deviation of each element of the response, (K, n_v, n_w)."""
        of_v = np.sqrt(np.maximum(np.real(np.diagonal(self.noise, axis1=1, axis2=2)), 0.0))
        of_w = np.sqrt(np.maximum(np.real(np.diagonal(self.error, axis1=1, axis2=2)), 0.0))
        deviation: Signal = of_v[:, :, None] * of_w[:, None, :]
        return deviation


def local_response(
    w: Signal,
    v: Signal,
    Ts: float,
    segments: Sequence[tuple[int, int]],
    upper: float | None = None,
    growth: float = 0.0,
) -> LocalResponse:
    """Responses of `v` to `w`, their errors, and the noise.

    Parameters
    ----------
    w : (N, n_w) array
        External signals: the injected excitation, or the setpoints.
    v : (N, n_v) array
        Signals of the loop.
    Ts : float, s
        Sampling period.
    segments : sequence of (start, stop)
        Segments without a gap.
    upper : float, optional, rad/s
        Largest frequency; the Nyquist frequency by default.
    growth : float
        Least half width of a window as a fraction of its frequency, except where the response changes faster: fewer
        values with less error at high frequencies. 0: all windows as narrow as the data allow.

    Returns
    -------
    LocalResponse

    Raises
    ------
    TuningError
        When the data are too short for any estimate.
    """
    n_w = w.shape[1]
    spectra = [_Spectrum(w[start:stop], v[start:stop], Ts) for start, stop in segments]
    upper = np.pi / Ts if upper is None else upper
    narrowest = max(_narrowest([s.step for s in spectra], n_w), upper / CENTRES)
    fits = _fits(spectra, n_w, narrowest, upper, growth)
    if not fits:
        raise TuningError(
            f"too short: {sum(b - a for a, b in segments) * Ts:.2f} s give no frequency response; record longer"
        )
    return LocalResponse(
        omega=np.array([fit.centre for fit in fits]),
        response=np.array([fit.response for fit in fits]),
        noise=np.array([fit.noise for fit in fits]),
        explained=np.array([fit.explained for fit in fits]),
        error=np.array([fit.error for fit in fits]),
    )


def _narrowest(steps: Sequence[float], n_w: int) -> float:
    """Half width (rad/s) of the narrowest window with enough bins of all segments together.

    A response has the same polynomials in all segments, a transient its own in each; a segment with too few bins for
    these adds nothing.

    Parameters
    ----------
    steps : sequence of float, rad/s
        Between two bins of a segment.
    n_w : int
        Number of external signals.
    """
    needed = (ORDER + 1) * n_w + FREEDOM
    apart = np.asarray(steps)
    # The longest segment alone has enough at last.
    widths = np.unique(np.outer(apart, np.arange(1, needed + ORDER + 2)))
    widths = widths[widths <= apart.min() * (needed + ORDER + 1) * (1 + ROUNDING)]
    bins = np.floor(widths[:, None] / apart * (1 + ROUNDING))
    enough = np.sum(np.maximum(bins - (ORDER + 1), 0), axis=1) >= needed
    return float(widths[np.argmax(enough)] / 2)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Fit of one window: fields as in `LocalResponse`, and the degrees of freedom of the noise."""

    centre: float
    response: Complex
    noise: Complex
    error: Complex
    explained: Signal
    freedom: int


def _fits(spectra: Sequence[_Spectrum], n_w: int, narrowest: float, upper: float, growth: float) -> list[_Fit]:
    """Fits of overlapping windows up to `upper`; a window that `_is_too_wide` is replaced by narrow ones."""
    found: list[_Fit] = []
    centre = narrowest
    while centre < upper:
        half = max(narrowest, growth * centre)
        wide = _fit(spectra, centre, half, n_w)
        if half > 2 * narrowest:
            parts = [
                _fit(spectra, middle, narrowest, n_w)
                for middle in np.arange(centre - half + narrowest, centre + half, 2 * narrowest)
            ]
            if _is_too_wide(wide, parts):
                begin = max(centre - half / 2, found[-1].centre + narrowest) if found else centre - half / 2
                middles = np.arange(begin, centre + half / 2, narrowest)
                found += [_fit(spectra, middle, narrowest, n_w) for middle in middles if middle < upper]
                centre += half
                continue
        found.append(wide)
        centre += half
    return found


def _is_too_wide(wide: _Fit, parts: Sequence[_Fit]) -> bool:
    """Whether narrow windows leave significantly less noise, as around a frame mode."""
    freedom = sum(part.freedom for part in parts)
    narrow = sum(part.freedom * np.real(np.diag(part.noise)) for part in parts) / freedom
    ratio = np.real(np.diag(wide.noise)) / np.maximum(narrow, 1e-300)
    matters = 1 - wide.explained > NEGLIGIBLE
    return bool(np.max(ratio[matters], initial=0.0) > 1 + HIDDEN * np.sqrt(1 / wide.freedom + 1 / freedom))


class _Spectrum:
    """Normalised DFT of one segment: W and V such that E[V V^H] is the spectrum."""

    def __init__(self, w: Signal, v: Signal, Ts: float) -> None:
        self.length = len(w)
        self.step = 2 * np.pi / (len(w) * Ts)
        scale = 1 / np.sqrt(len(w))
        self.W: Complex = np.fft.fft(w, axis=0) * scale
        self.V: Complex = np.fft.fft(v, axis=0) * scale

    def around(self, centre: float, half: float) -> tuple[Signal, Complex, Complex]:
        """Bins within `half` of `centre`: distance scaled to -1..1, W and V. Without bin 0, which holds the trim."""
        bins = np.arange(int(np.ceil((centre - half) / self.step)), int(np.floor((centre + half) / self.step)) + 1)
        bins = bins[bins % self.length != 0]
        return (bins * self.step - centre) / half, self.W[bins % self.length], self.V[bins % self.length]


def _fit(spectra: Sequence[_Spectrum], centre: float, half: float, n_w: int) -> _Fit:
    """Local least squares; the transient of each segment is projected out."""
    regressors, outputs = [], []
    lost = 0
    for spectrum in spectra:
        r, W, V = spectrum.around(centre, half)
        powers = r[:, None] ** np.arange(ORDER + 1)
        if len(r) <= ORDER + 1:
            continue
        basis, _ = np.linalg.qr(powers)
        K = (W[:, None, :] * powers[:, :, None]).reshape(len(r), -1)
        regressors.append(K - basis @ (basis.T @ K))
        outputs.append(V - basis @ (basis.T @ V))
        lost += ORDER + 1
    K, V = np.vstack(regressors), np.vstack(outputs)
    inverse = np.linalg.pinv(K)
    theta = inverse @ V
    residual = V - K @ theta
    freedom = max(1, len(K) - lost - K.shape[1])
    noise = residual.T @ residual.conj() / freedom
    covariance = inverse @ inverse.conj().T
    total = np.maximum(np.sum(np.abs(V) ** 2, axis=0), 1e-300)
    unexplained = np.real(np.diag(noise)) * (len(K) - lost) / total
    explained = 1 - np.minimum(unexplained, 1.0)
    return _Fit(centre, theta[:n_w].T, noise, covariance[:n_w, :n_w], explained, freedom)
