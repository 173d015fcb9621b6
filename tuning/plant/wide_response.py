"""The measured response, continued below its band and up to the Nyquist frequency, with its error and the noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.plant.frequency_response import GROWTH, MIN_FREQUENCIES, SMOOTH, PlantResponse
from mimopilot.tuning.plant.local_polynomial import FREEDOM
from mimopilot.tuning.plant.noise_spectrum import noise_root
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.plant.response_shape import SHAPE_ERROR, ResponseShape, fit_shape, shape_response
from mimopilot.tuning.plant.rigid_body_fit import DEVIATION, RigidBody, continued_below

#: Largest relative step between neighbouring frequencies.
STEP = 0.05
#: Frequencies at the end of the band whose mean ratio to the fitted shape is continued.
END_ABOVE = 5
#: Natural logarithm of the ratio of frequencies whose errors are independent: the range of one smoothed value.
ALIKE = 2 * SMOOTH
#: Share of the Nyquist frequency at which the grid ends: the integrator's response is real there.
TOP = 0.999

Complex = NDArray[np.complex128]
Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class WideResponse:
    """Response of a plant from `LOWEST` to the Nyquist frequency.

    Attributes
    ----------
    omega : (K,) array, rad/s
    G_i, G_o : (K, n, n) arrays, rad/s and rad per unit of u
    band : slice
        Frequencies at which it was measured. Below, the fitted rigid body behind rotors and a delay continues it, and
        above, its shape.
    error_i, error_o : (K, n, 3n) arrays
        With X (3n, n) of unit complex normals, error_i X reach is as likely as the error of G_i; zero above the band.
    reach : (K, n, n) array
    noise : (K, 2n, 2n) array
        Square root of the spectrum of the noise of rates and angles, see `tuning.plant.noise_spectrum`.
    noise_deviation : (K,) array
        Relative standard deviation of the noise's size.
    body : RigidBody
    response : PlantResponse
        Everything that was measured, also outside the band.
    shape : ResponseShape
        Delay (s), rotor lag (s) and damping (1/s) of the fitted shape.
    Ts : float, s
    """

    omega: Signal
    G_i: Complex
    G_o: Complex
    band: slice
    error_i: Complex
    error_o: Complex
    reach: Complex
    noise: Complex
    noise_deviation: Signal
    body: RigidBody
    response: PlantResponse
    shape: ResponseShape
    Ts: float

    @property
    def axes(self) -> int:
        """Number n of axes."""
        return int(self.G_i.shape[1])

    @property
    def noise_weight(self) -> Signal:
        """Weights of the sum over frequency that is a variance, (K,)."""
        weight: Signal = _trapezoid(self.omega) * self.Ts / np.pi
        return weight

    def draw(self, generator: np.random.Generator) -> WideResponse:
        """A plant drawn from the errors of the response, of the fitted body below its band, and of the noise."""
        X = self._alike_at_neighbours(generator, (3 * self.axes, self.axes))
        change = self.body.deviation * generator.spawn(1)[0].standard_normal(self.body.B.shape)
        factor = np.tile(np.eye(self.axes), (len(self.omega), 1, 1))
        factor[: self.band.start] += np.linalg.solve(self.body.B, change)
        return replace(
            self,
            G_i=self.G_i @ factor + self.error_i @ X @ self.reach,
            G_o=self.G_o @ factor + self.error_o @ X @ self.reach,
            noise=self.noise * _column(1 + self.noise_deviation * generator.standard_normal(len(self.omega))),
        )

    def _alike_at_neighbours(self, generator: np.random.Generator, shape: tuple[int, int]) -> Complex:
        """Unit complex normals, (K, *shape), that are alike within `ALIKE` and interpolated in between.

        Estimates at neighbouring frequencies come from the same windows, and are smoothed over the same range.
        """
        place = (np.log(self.omega) - np.log(self.omega[0])) / ALIKE
        knots = (int(place[-1]) + 2, *shape)
        X = (generator.standard_normal(knots) + 1j * generator.standard_normal(knots)) / np.sqrt(2)
        low, part = place.astype(int), _column(place % 1)
        found: Complex = ((1 - part) * X[low] + part * X[low + 1]) / np.hypot(part, 1 - part)
        return found


def wide_response(measured: PlantEstimates) -> WideResponse:
    """The response of an experiment, continued on both sides.

    Raises
    ------
    TuningError
        When the response is known at too few frequencies.
    """
    plant, body = measured.response, measured.body
    run = plant.known_run()
    if len(run) < MIN_FREQUENCIES:
        raise TuningError(
            f"{measured.experiment.source}: the excitation reaches fewer than {MIN_FREQUENCIES} frequencies in a row; "
            "record a longer or stronger excitation"
        )
    known = plant.at(run)
    lower = continued_below(known, body)
    dense = lower.interpolated(STEP)
    high = _spaced(dense.omega[-1], TOP * np.pi / plant.Ts, STEP)[1:]
    size = np.linalg.norm(known.G_i, axis=(1, 2))[:, None, None]
    shape, _, _, _ = fit_shape(known.omega, known.G_i, 1 / (known.deviation() ** 2 + (SHAPE_ERROR * size) ** 2))
    end = slice(-END_ABOVE, None)
    ratio = np.mean(dense.G_i[end] / _column(shape_response(dense.omega[end], shape)), axis=0)
    above = ratio * _column(shape_response(high, shape))
    omega = np.concatenate([dense.omega, high])
    first = known.omega[known.rate_error() < DEVIATION][:1]
    band = slice(int(np.searchsorted(omega, first[0] if len(first) else known.omega[0])), len(dense.omega))
    n = plant.axes
    error_i = np.zeros((len(omega), n, 3 * n), complex)
    error_o, reach = np.zeros_like(error_i), np.zeros((len(omega), n, n), complex)
    error_i[: band.stop] = dense.rate_residual()
    error_o[: band.stop] = dense.angle_residual()
    reach[: band.stop] = dense.reach
    return WideResponse(
        omega=omega,
        G_i=np.concatenate([dense.G_i, above]),
        G_o=np.concatenate([dense.G_o, above / _column(1j * high)]),
        band=band,
        error_i=error_i,
        error_o=error_o,
        reach=reach,
        noise=noise_root(measured.experiment, plant, omega),
        noise_deviation=_noise_deviation(omega, measured.experiment.seconds),
        body=body,
        response=plant,
        shape=shape,
        Ts=plant.Ts,
    )


def hat_weights(omega: Signal, fine: Signal, values: NDArray[Any]) -> NDArray[Any]:
    """Weights w with sum(w f(omega)) the integral of values f over `fine`, for f linear between the frequencies omega.

    A spectrum with many lobes, such as a doublet's, is then integrated on a coarse grid.

    Parameters
    ----------
    omega : (K,) array, rad/s
    fine : (F,) array, rad/s
        Grid on which `values` is resolved.
    values : (F,) or (F, n) array

    Returns
    -------
    (K,) or (K, n) array
    """
    cell = np.clip(np.searchsorted(omega, fine) - 1, 0, len(omega) - 2)
    part = np.clip((fine - omega[cell]) / (omega[cell + 1] - omega[cell]), 0.0, 1.0)
    places, shares = np.concatenate([cell, cell + 1]), np.concatenate([1 - part, part])
    order = np.argsort(places, kind="stable")
    ends = np.concatenate([[0], np.cumsum(np.bincount(places, minlength=len(omega)))])
    hats = csr_array((shares[order], order % len(fine), ends), shape=(len(omega), len(fine)))
    weights: NDArray[Any] = hats @ (values.T * _trapezoid(fine)).T
    return weights


def _noise_deviation(omega: Signal, seconds: float) -> Signal:
    """Relative standard deviation of the size of a noise whose spectrum is a mean over windows of the DFT's bins.

    The power of a mean over m bins deviates by 1 / sqrt(m), its square root by half of that. A window is `GROWTH` of
    its frequency wide on both sides, or holds the least number of bins.
    """
    bins = np.maximum(FREEDOM, 2 * GROWTH * omega * seconds / (2 * np.pi))
    return np.asarray(0.5 / np.sqrt(bins))


def _trapezoid(omega: Signal) -> Signal:
    """Weights of the trapezoidal rule."""
    steps = np.diff(omega)
    weights: Signal = (np.append(steps, 0.0) + np.append(0.0, steps)) / 2
    return weights


def _spaced(first: float, last: float, step: float) -> Signal:
    """Frequencies from first to last, whose neighbours differ by at most `step` of themselves."""
    return np.geomspace(first, last, int(np.ceil(np.log(last / first) / np.log1p(step))) + 1)


def _column(values: NDArray[Any]) -> NDArray[Any]:
    return values[:, None, None]
