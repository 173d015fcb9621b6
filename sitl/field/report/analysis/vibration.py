"""Spectra of a flight, and the vibration tones in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.logs.resample import MAX_GAP, Interval, Series, held_samples, sampling_period

#: Resolution of a spectrum, Hz, and of a spectrogram, s; chosen: two tones of motors differ by a few hertz.
RESOLUTION, SLICE = 0.5, 0.5
#: Fewest windows of a spectrum: with fewer, noise looks like tones.
FEWEST_WINDOWS = 4
#: A tone stands out of the median within this factor of its frequency, by this much (dB), and is above this frequency
#: (Hz): below it a vehicle is flown, and its loops resonate.
AROUND, STANDS_OUT, LOWEST_TONE = 1.35, 10.0, 12.0
#: Chance that noise alone shows a tone anywhere in a spectrum.
CHANCE = 1e-3
#: Largest number of tones named, strongest first.
MOST_TONES = 6
#: Maxima closer than this share of their frequency are one tone, such as that of a motor whose speed changes.
SAME_TONE = 0.06
#: Range of the thrust, share of the largest, below which it counts as constant.
STEADY = 0.05
#: Largest relative distance from a multiple that counts as a harmonic.
HARMONIC = 0.005
#: Rank correlation with the thrust above which a tone counts as moving with it, and fewest slices for it.
MOVES, FEWEST_SLICES = 0.5, 12
#: Share of its frequency within which a tone is followed from slice to slice.
FOLLOWED = 0.2
#: Cells of a spectrogram.
MOST_SLICES, MOST_BINS, THRUST_BINS = 160, 128, 16

Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class AirSpectrum:
    """Power spectral density of a signal in the air.

    Attributes
    ----------
    hertz : (F,) array, Hz
    density : (F, n) array
        Of each column, its unit squared per Hz.
    windows : int
        Windows that it is a mean of.
    rate : float, Hz
        Of the signal.
    """

    hertz: Signal
    density: Signal
    windows: int
    rate: float


@dataclass(frozen=True)
class Tone:
    """A vibration at one frequency.

    Attributes
    ----------
    hertz : float, Hz
    above_db : float, dB
        How far it stands out of its surroundings.
    axis : int
        Column in which it is strongest.
    harmonic_of : float, Hz
        The tone whose multiple it is; 0: none.
    follows_thrust : bool or None
        Whether its frequency moves with the thrust; None: not known.
    """

    hertz: float
    above_db: float
    axis: int
    harmonic_of: float = 0.0
    follows_thrust: bool | None = None


def air_pieces(series: Series, parts: Sequence[Interval]) -> tuple[float, list[Signal]]:
    """Period (s) of a signal and its uniform stretches without a gap in some intervals, (N, n) each."""
    period = sampling_period(series.time)
    pieces = []
    for begin, end in parts:
        inside = (series.time >= begin) & (series.time <= end)
        time, values = series.time[inside], series.values[inside]
        if len(time) < 2:
            continue
        for rows in np.split(np.arange(len(time)), np.flatnonzero(np.diff(time) > MAX_GAP * period) + 1):
            if len(rows) > 2:
                grid = np.arange(time[rows[0]], time[rows[-1]], period)
                pieces.append(np.column_stack([np.interp(grid, time[rows], column) for column in values[rows].T]))
    return period, pieces


def air_spectrum(series: Series, parts: Sequence[Interval]) -> AirSpectrum | None:
    """Spectrum of a signal in some intervals (s), by Welch's method; None if it is too short."""
    from scipy.signal import welch

    period, pieces = air_pieces(series, parts)
    longest = max((len(piece) for piece in pieces), default=0)
    length = min(round(1 / (RESOLUTION * period)), 2 * longest // (FEWEST_WINDOWS + 1))
    if length < 32 or held_samples(series.values) > 1:
        return None
    total, windows = 0.0, 0
    for piece in pieces:
        count = 2 * len(piece) // length - 1
        if count < 1:
            continue
        hertz, density = welch(piece, 1 / period, nperseg=length, axis=0)
        total, windows = total + density * count, windows + count
    if windows < FEWEST_WINDOWS:
        return None
    return AirSpectrum(hertz[1:], np.asarray(total)[1:] / windows, windows, 1 / period)


def find_tones(
    found: AirSpectrum, slices: tuple[Signal, Signal, Signal] | None = None, thrust: Signal | None = None
) -> list[Tone]:
    """Tones in a spectrum, the strongest first.

    A tone is a local maximum of the density, summed over the columns, that stands out of the median around it by
    `STANDS_OUT` and by more than noise does.

    Parameters
    ----------
    found : AirSpectrum
    slices : (time, hertz, density), optional
        Spectrogram of the same signal, see `spectrogram`.
    thrust : (T,) array, optional
        In each slice.
    """
    from scipy.stats import chi2

    power = found.density.sum(axis=1)
    background = _background(found.hertz, power)
    # Windows overlap by half under Hann's weight: 11/9 of half of them count as independent (P. Welch, 1967).
    freedom = 2 * max(1.0, found.windows * 11 / 18)
    by_chance = chi2.ppf(1 - CHANCE / len(power), freedom) / chi2.median(freedom)
    least = max(10 ** (STANDS_OUT / 10), by_chance)
    ratio = power / background
    peaks = np.flatnonzero((power[1:-1] >= power[:-2]) & (power[1:-1] > power[2:]) & (ratio[1:-1] > least)) + 1
    peaks = peaks[found.hertz[peaks] >= LOWEST_TONE]
    peaks = peaks[np.argsort(-ratio[peaks], kind="stable")]
    tones: list[Tone] = []
    for place in peaks:
        if any(abs(found.hertz[place] / tone.hertz - 1) < SAME_TONE for tone in tones):
            continue
        hertz = _refined(found.hertz, power, int(place))
        axis = int(np.argmax(found.density[place]))
        tones.append(
            Tone(hertz, float(10 * np.log10(ratio[place])), axis, follows_thrust=_follows(hertz, slices, thrust))
        )
    tones = tones[:MOST_TONES]
    bases = sorted(tone.hertz for tone in tones)
    return [Tone(t.hertz, t.above_db, t.axis, _base(t.hertz, bases), t.follows_thrust) for t in tones]


def spectrogram(series: Series, parts: Sequence[Interval]) -> tuple[Signal, Signal, Signal] | None:
    """Time (T,) s, frequency (F,) Hz and density (F, T), summed over the columns, in slices of `SLICE`."""
    from scipy.signal import spectrogram as transform

    period = sampling_period(series.time)
    length = round(2 * SLICE / period)
    if length < 16 or held_samples(series.values) > 1:
        return None
    times, columns = [], []
    for begin, end in parts:
        inside = (series.time >= begin) & (series.time <= end)
        if np.count_nonzero(inside) < 4 * length:
            continue
        first, last = series.time[inside][[0, -1]]
        grid = np.arange(first, last, period)
        values = np.column_stack([np.interp(grid, series.time, column) for column in series.values.T])
        hertz, time, density = transform(values, 1 / period, nperseg=length, axis=0)
        times.append(time + first)
        columns.append(density.sum(axis=1))
    if not times:
        return None
    return np.concatenate(times), hertz[1:], np.concatenate(columns, axis=1)[1:]


def coarse(
    time: Signal, hertz: Signal, density: Signal, slices: int = MOST_SLICES, bins: int = MOST_BINS
) -> tuple[Signal, Signal, Signal]:
    """A spectrogram with at most so many slices and bins: means over time, maxima over frequency so that tones stay."""
    per_slice, per_bin = -(-len(time) // slices), -(-len(hertz) // bins)
    across = len(time) // per_slice
    along = len(hertz) // per_bin
    cut = density[: along * per_bin, : across * per_slice].reshape(along, per_bin, across, per_slice)
    return (
        time[: across * per_slice].reshape(across, per_slice).mean(axis=1),
        hertz[: along * per_bin].reshape(along, per_bin).mean(axis=1),
        cut.mean(axis=3).max(axis=1),
    )


def over_thrust(density: Signal, thrust: Signal) -> tuple[Signal, Signal] | None:
    """Thrust (B,) and mean density (F, B) of the slices in each stretch of thrust; None if it hardly changes."""
    low, high = np.quantile(thrust, (0.01, 0.99))
    if high - low < STEADY:
        return None
    edges = np.linspace(low, high, THRUST_BINS + 1)
    of = np.clip(np.digitize(thrust, edges) - 1, 0, THRUST_BINS - 1)
    used = [b for b in range(THRUST_BINS) if np.any(of == b)]
    return (
        np.array([(edges[b] + edges[b + 1]) / 2 for b in used]),
        np.column_stack([density[:, of == b].mean(axis=1) for b in used]),
    )


def _background(hertz: Signal, power: Signal) -> Signal:
    """Median of the density within `AROUND` of each frequency."""
    low = np.searchsorted(hertz, hertz / AROUND)
    high = np.searchsorted(hertz, hertz * AROUND, side="right")
    width = np.maximum(high - low, 9)
    return np.array(
        [np.median(power[max(0, k - w // 2) : k + w // 2 + 1]) for k, w in zip(range(len(power)), width, strict=True)]
    )


def _refined(hertz: Signal, power: Signal, place: int) -> float:
    """Frequency of a peak between bins: the vertex of a parabola through the logarithms of three of them."""
    below, at, above = np.log(power[place - 1 : place + 2])
    bend = below - 2 * at + above
    shift = 0.5 * (below - above) / bend if bend < 0 else 0.0
    return float(hertz[place] + shift * (hertz[1] - hertz[0]))


def _base(hertz: float, bases: Sequence[float]) -> float:
    for base in bases:
        multiple = round(hertz / base)
        if multiple >= 2 and abs(hertz / base / multiple - 1) < HARMONIC:
            return base
    return 0.0


def _follows(hertz: float, slices: tuple[Signal, Signal, Signal] | None, thrust: Signal | None) -> bool | None:
    """Whether the maximum near a tone moves with the thrust, slice by slice."""
    from scipy.stats import spearmanr

    if slices is None or thrust is None or len(thrust) < FEWEST_SLICES:
        return None
    if np.diff(np.quantile(thrust, (0.01, 0.99)))[0] < STEADY:
        return None
    _, places, density = slices
    near = np.flatnonzero(np.abs(places / hertz - 1) < FOLLOWED)
    if len(near) < 3:
        return None
    peaks = places[near][density[near].argmax(axis=0)]
    if np.ptp(peaks) <= 2 * (places[1] - places[0]):
        return False
    return bool(spearmanr(peaks, thrust).statistic > MOVES)
