"""Frequency response of the plant from one experiment, with its standard deviation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.axes import axis_names
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.experiment import Experiment, external_signal
from mimopilot.tuning.plant.local_polynomial import local_response
from mimopilot.tuning.plant.response_shape import SHAPE_ERROR, fit_shape, shape_response
from mimopilot.tuning.small_matrices import inverse

#: Least multiple coherence of a rate with the excitation at a coherent frequency.
COHERENT = 0.7
#: Least half width of a window, as a fraction of its frequency: within it a vehicle's response is smooth.
GROWTH = 0.08
#: Relative errors of G_i (Frobenius norms). Below the first a frequency is known at any coherence: many bins of low
#: coherence hold as much information as a few of high coherence. Above the second it is not known.
KNOWN, UNKNOWN = 0.3, 0.7
#: Largest ratio of neighbouring known frequencies in one band: in between, a damped body is interpolated.
HOLE = 1.25
#: Fraction of the excitation's power below the highest frequency of a response.
POWER = 0.9999
#: Smoothing over frequency: half width (natural logarithm of the ratio), least number of values, largest residual
#: mean square over their variance.
SMOOTH, ENOUGH, EXPLAINED = 0.3, 5, 1.5
#: Largest relative error of the angles where they are compared with the rates.
SURE = 0.1
#: s. Largest lag of rates behind angles, from filters of gyro and estimator.
LAG = 0.05
#: Known frequencies that smoothing and integration of the rates need.
MIN_FREQUENCIES = 8
#: Largest relative difference between two periods that count as the same: loggers' clocks differ by less.
SAME_PERIOD = 0.02
#: Periods that the torque is late by: one to compute and half of one in which it is held.
LATE = 1.5
#: Number of plants drawn from the error distribution of a response.
DRAWS = 64

Complex = NDArray[np.complex128]
Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PlantResponse:
    """Frequency response of the plant at K frequencies, for n axes: yaw, roll and pitch, or all; see `tuning.axes`.

    Attributes
    ----------
    omega : (K,) array, rad/s
        Frequencies.
    G_i, G_o : (K, n, n) arrays, rad/s and rad per unit of u
        Responses of rates and angles to the torque.
    root : (K, 3n, 3n) array
        Square root of the noise spectrum of [u, y_i, y_o].
    reach : (K, n, n) array
        With X (3n, n) of unit complex normals and E = root X reach, G_i + E_i - G_i E_u and G_o + E_o - G_o E_u are
        as likely as G_i and G_o.
    coherence : (K, n) array
        Multiple coherence of each rate with the excitation.
    Ts : float, s
        Sampling period.
    angle_noise : (K, n, 3n) array or None
        Rows of the noise's root for the angles as measured; None: those of `root`. They differ where G_o is the
        integrated rate response, whose error is not that of the angles.
    """

    omega: Signal
    G_i: Complex
    G_o: Complex
    root: Complex
    reach: Complex
    coherence: Signal
    Ts: float
    angle_noise: Complex | None = None

    @property
    def axes(self) -> int:
        """Number n of axes."""
        return int(self.G_i.shape[1])

    def rate_residual(self) -> Complex:
        """Root of the noise of y_i - G_i u, (K, n, 3n)."""
        n = self.axes
        return self.root[:, n : 2 * n] - self.G_i @ self.root[:, :n]

    def angle_residual(self) -> Complex:
        """Root of the noise of y_o - G_o u, (K, n, 3n)."""
        n = self.axes
        return self.root[:, 2 * n :] - self.G_o @ self.root[:, :n]

    def deviation(self) -> Signal:
        """Standard deviation of each element of G_i, (K, n, n)."""
        noise = np.linalg.norm(self.rate_residual(), axis=2)
        reach = np.linalg.norm(self.reach, axis=1)
        deviation: Signal = noise[:, :, None] * reach[:, None, :]
        return deviation

    def known(self) -> NDArray[np.bool_]:
        """Whether G_i is known: all rates are coherent, or the error is small, (K,)."""
        error = self.rate_error()
        return np.asarray(np.all(self.coherence > COHERENT, axis=1) & (error < UNKNOWN) | (error < KNOWN))

    def rate_error(self) -> Signal:
        """Standard deviation of G_i over its size, (K,), Frobenius norms."""
        error: Signal = np.linalg.norm(self.deviation(), axis=(1, 2)) / np.linalg.norm(self.G_i, axis=(1, 2))
        return error

    def known_run(self) -> NDArray[np.intp]:
        """Indices of the widest band, in octaves, of known frequencies; gaps up to `HOLE` do not end it.

        It begins where the error is small. Below, the closed loop rejects most of the excitation from the torque:
        the rates are still coherent, but nonlinear effects dominate.
        """
        sure = np.logical_or.accumulate(self.rate_error() < KNOWN)
        indices = np.flatnonzero(self.known() & sure)
        if not len(indices):
            return indices
        far = self.omega[indices[1:]] > HOLE * self.omega[indices[:-1]] + 2 * (self.omega[1] - self.omega[0])
        runs = np.split(indices, np.flatnonzero(far) + 1)
        return max(runs, key=lambda run: float(self.omega[run[-1]] / self.omega[run[0]]))

    def band(self, axis: int) -> tuple[float, float] | None:
        """First and last frequency (rad/s) with a coherent rate of an axis; None when there is none."""
        where = self.omega[self.coherence[:, axis] > COHERENT]
        return (float(where[0]), float(where[-1])) if len(where) else None

    def relative_error(self) -> Signal:
        """Standard deviation of G_o over its size, (K,), Frobenius norms."""
        spread = (self.angle_residual(), self.reach, self.G_o)
        noise, reach, size = (np.linalg.norm(matrix, axis=(1, 2)) for matrix in spread)
        relative: Signal = noise * reach / size
        return relative

    def at(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> PlantResponse:
        """The response at some of the frequencies."""
        arrays = {name: value[which] for name, value in vars(self).items() if name != "Ts" and value is not None}
        return PlantResponse(Ts=self.Ts, **arrays)

    def at_period(self, Ts: float) -> PlantResponse:
        """The response of the same vehicle under a controller with another period, s.

        A longer period delays the torque by `LATE` times the difference, which is exact where the vehicle computes for
        one period. For a shorter one the measured response stays as it is: its longer delay is on the safe side.
        Frequencies above half of the lower rate are dropped.
        """
        if abs(Ts / self.Ts - 1) <= SAME_PERIOD:
            return self
        plant = self.at(self.omega < np.pi / max(Ts, self.Ts))
        turn = np.exp(-1j * plant.omega * LATE * max(0.0, Ts - self.Ts))[:, None, None]
        outputs = np.concatenate([plant.root[:, : self.axes], turn * plant.root[:, self.axes :]], axis=1)
        angles = None if plant.angle_noise is None else turn * plant.angle_noise
        return replace(plant, G_i=turn * plant.G_i, G_o=turn * plant.G_o, root=outputs, angle_noise=angles, Ts=Ts)

    def extended(self) -> PlantResponse:
        """The response extended below its lowest frequency as a rigid body: 1/w for rates, 1/w^2 for angles.

        Setpoints have most of their power there. The closed loop hardly depends on the plant there, so scaling the
        mean of the lowest frequencies is enough.
        """
        step = float(np.diff(self.omega).min())
        low = np.arange(self.omega[0] - step, step / 2, -step)[::-1]
        if not len(low):
            return self
        first, w = slice(0, 3), self.omega[:, None, None]
        below = low[:, None, None]
        down = (self.omega[0] / below) ** np.repeat([0, 1, 2], self.axes)[:, None]
        return PlantResponse(
            omega=np.concatenate([low, self.omega]),
            G_i=np.concatenate([(w * self.G_i)[first].mean(axis=0) / below, self.G_i]),
            G_o=np.concatenate([(w**2 * self.G_o)[first].mean(axis=0) / below**2, self.G_o]),
            root=np.concatenate([down * self.root[0], self.root]),
            reach=np.concatenate([np.repeat(self.reach[:1], len(low), axis=0), self.reach]),
            coherence=np.concatenate([np.repeat(self.coherence[:1], len(low), axis=0), self.coherence]),
            Ts=self.Ts,
        )

    def interpolated(self, share: float) -> PlantResponse:
        """The response interpolated so that neighbouring frequencies differ by at most `share` of themselves.

        G_i^-1 and G_o^-1 / w of a damped body are linear in w, so these are interpolated. All other fields are those
        of the nearest frequency.
        """
        counts = np.ceil(np.diff(self.omega) / (share * self.omega[:-1])).astype(int)
        begin = np.repeat(np.cumsum(counts) - counts, counts)
        inner = np.repeat(np.arange(len(counts)), counts) + (np.arange(len(begin)) - begin) / np.repeat(counts, counts)
        place = np.append(inner, len(counts))
        omega = np.interp(place, np.arange(len(self.omega)), self.omega)
        low = np.minimum(place.astype(int), len(counts) - 1)
        part, new, old = (place - low)[:, None, None], omega[:, None, None], self.omega[:, None, None]

        def between(G: Complex) -> Complex:
            inverted = inverse(G)
            return inverse((1 - part) * inverted[low] + part * inverted[low + 1])

        dense = self.at(np.rint(place).astype(int))
        return replace(dense, omega=omega, G_i=between(self.G_i), G_o=between(old * self.G_o) / new)

    def draw(self, generator: np.random.Generator) -> PlantResponse:
        """A plant drawn from the error distribution of the response."""
        shape = (len(self.omega), 3 * self.axes, self.axes)
        X = (generator.standard_normal(shape) + 1j * generator.standard_normal(shape)) / np.sqrt(2)
        E = self.root @ X @ self.reach
        E_u, E_i, E_o = np.split(E, 3, axis=1)
        return replace(self, G_i=self.G_i + E_i - self.G_i @ E_u, G_o=self.G_o + E_o - self.G_o @ E_u)


def plant_response(experiment: Experiment, instrument: Signal, upper: float = np.inf) -> PlantResponse:
    """Joint input-output estimate G = T_yw T_uw^-1, consistent in closed loop.

    Parameters
    ----------
    experiment : Experiment
        One flight.
    instrument : (N, n) array
        Its external signal w.
    upper : float, rad/s
        Largest frequency of interest; by default the Nyquist frequency.

    Raises
    ------
    TuningError
        When the flight is too short, or w does not excite every axis.
    """
    signals = np.hstack([experiment.u, experiment.y_i, experiment.y_o])
    # The last window ends where the excitation does.
    upper = min(upper, 0.95 * np.pi / experiment.Ts, _reach(experiment, instrument) / (1 + GROWTH))
    found = local_response(instrument, signals, experiment.Ts, experiment.segments, upper, GROWTH)
    n = instrument.shape[1]
    T_u, T_i, T_o = np.split(found.response, 3, axis=1)
    if np.any(np.linalg.matrix_rank(T_u) < n):
        raise TuningError("not excited: the external signal does not move every torque independently; excite each axis")
    for name, T in (("rates", T_i), ("angles", T_o)):
        if np.any(np.linalg.matrix_rank(T) < n):
            raise TuningError(
                f"{experiment.source}: {' and '.join(axis_names(n))} {name} are the same signal, or constant; check "
                f"the source of {axis_names(n)[-1]}"
            )
    T_u_inverse = np.linalg.inv(T_u)
    plant = PlantResponse(
        omega=found.omega,
        G_i=T_i @ T_u_inverse,
        G_o=T_o @ T_u_inverse,
        root=hermitian_root(found.noise),
        reach=hermitian_root(found.error).transpose(0, 2, 1) @ T_u_inverse,
        coherence=found.explained[:, n : 2 * n],
        Ts=experiment.Ts,
    )
    return _angles_from_rates(_smoothed(plant))


@lru_cache(maxsize=2)  # the log checks and the tuning use the same response
def measured_plant(experiment: Experiment) -> PlantResponse:
    """The plant's frequency response from the experiment's external signal; see `plant_response`."""
    return plant_response(experiment, external_signal(experiment)[0])


def _reach(experiment: Experiment, instrument: Signal) -> float:
    """Highest excited frequency, rad/s. Above the end of a chirp the response is noise."""
    reached = 0.0
    for start, stop in experiment.segments:
        part = instrument[start:stop] - instrument[start:stop].mean(axis=0)
        power = np.cumsum(np.sum(np.abs(np.fft.rfft(part, axis=0)) ** 2, axis=1))
        if power[-1] > 0:
            bin_ = int(np.searchsorted(power, POWER * power[-1])) + 1
            reached = max(reached, 2 * np.pi * bin_ / (len(part) * experiment.Ts))
    return reached


def _smoothed(plant: PlantResponse) -> PlantResponse:
    """The rate response, smoothed over frequency relative to the fitted shape.

    Divided by the shape the response hardly changes with frequency, so each value is taken from a line fitted to the
    values within `SMOOTH` of it. If the line does not fit, as at a frame mode, the value is kept.
    """
    use = plant.known()
    if np.count_nonzero(use) < MIN_FREQUENCIES:
        return plant
    deviation = plant.deviation()
    size = np.linalg.norm(plant.G_i, axis=(1, 2))[:, None, None]
    weight = 1 / (deviation[use] ** 2 + (SHAPE_ERROR * size[use]) ** 2)
    shape = shape_response(plant.omega, fit_shape(plant.omega[use], plant.G_i[use], weight)[0])[:, None, None]
    ratio, spread = plant.G_i / shape, deviation / np.abs(shape)
    G_i, reach = plant.G_i.copy(), plant.reach.copy()
    places = np.log(plant.omega)
    for k, place in enumerate(places):
        near = np.flatnonzero(np.abs(places - place) <= SMOOTH)
        if len(near) < ENOUGH:
            continue
        line = np.column_stack([np.ones(len(near)), places[near] - place])
        certainty = 1 / np.mean(spread[near] ** 2, axis=(1, 2))
        covariance = np.linalg.inv(line.T @ (certainty[:, None] * line))
        values = ratio[near].reshape(len(near), -1)
        found = covariance @ (line.T @ (certainty[:, None] * values))
        # Windows overlap by half, so only half of them are independent.
        misfit = float(np.sum(certainty[:, None] * np.abs(values - line @ found) ** 2)) / (
            plant.axes**2 * (len(near) - 2)
        )
        share = np.sqrt(2 * covariance[0, 0] * max(1.0, misfit) * certainty[near == k][0])
        if misfit < EXPLAINED and share < 1:
            G_i[k] = shape[k] * found[0].reshape(plant.axes, plant.axes)
            reach[k] *= share
    return replace(plant, G_i=G_i, reach=reach)


def _angles_from_rates(plant: PlantResponse) -> PlantResponse:
    """The angle response, replaced by the integrated rate response where that has the smaller error.

    Noise of an angle does not fall with frequency. The gain and the delay between both, such as from the gyro's
    filter, are fitted where both are well known.
    """
    s = 1j * plant.omega
    integral = plant.G_i / s[:, None, None]
    spread = np.linalg.norm(plant.angle_residual(), axis=(1, 2))
    of_rates = np.linalg.norm(plant.rate_residual(), axis=(1, 2)) / plant.omega
    # Outside the band that is known, noise alone may look like a response.
    both = np.isin(np.arange(len(s)), plant.known_run()) & (plant.relative_error() < SURE)
    if np.count_nonzero(both) < MIN_FREQUENCIES:
        return plant
    quotient = np.einsum("kij,kij->k", plant.G_o, integral.conj()) / np.sum(np.abs(integral) ** 2, axis=(1, 2))
    omega, phase = plant.omega[both], np.unwrap(np.angle(quotient[both]))
    lead = float(np.clip(omega @ phase / (omega @ omega), -LAG, LAG))
    gain = float(np.median(np.abs(quotient[both])))
    better = of_rates < spread
    # At low frequencies the angles as measured, where they are well known, hold more than the integral of the rates.
    better[: np.flatnonzero(both)[-1] // 2] &= (plant.relative_error() >= SURE)[: np.flatnonzero(both)[-1] // 2]
    change = np.where(better, gain * np.exp(1j * plant.omega * lead) / s, 0)[:, None, None]
    _, rates, angles = np.split(plant.root, 3, axis=1)
    root = plant.root.copy()
    root[:, 2 * plant.axes :] = np.where(better[:, None, None], change * rates, angles)
    G_o = np.where(better[:, None, None], change * plant.G_i, plant.G_o)
    return replace(plant, G_o=G_o, root=root, angle_noise=plant.angle_residual())


def hermitian_root(matrices: Complex) -> Complex:
    """R with R R^H = each of the positive semidefinite `matrices`."""
    values, vectors = np.linalg.eigh(matrices)
    root: Complex = vectors * np.sqrt(np.maximum(values, 0))[:, None, :]
    return root
