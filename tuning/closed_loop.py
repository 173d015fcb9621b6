"""The cascade around a measured frequency response: loop transfers and the closed loop.

With the plant's responses G_i (rates) and G_o (angles) to the moment u known at some frequencies, everything
about the flown difference equation follows there: C_e = Kp + Ts Ki z/(z-1), C_d = Kd (1-a)(z-1)/(Ts (z-a)).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from tuning.errors import TuningError
from tuning.experiment import Experiment
from tuning.frequency import local_response
from tuning.gain_stack import GainStack
from tuning.gains import Gains
from tuning.reference import ReferenceModel

#: Frequencies count where the excitation explains more than this share of a rate's power.
COHERENT = 0.7
ACCURATE = 0.1
#: Windows of the response are at least this share of their frequency wide on each side: vehicles answer smoothly there.
GROWTH = 0.05
MIN_FREQUENCIES = 8
DRAWS = 64

Complex = NDArray[np.complex128]
Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PlantResponse:
    """What one experiment says of the plant, at K frequencies.

    Attributes
    ----------
    omega : (K,) array, rad/s
        Frequencies.
    G_i, G_o : (K, 2, 2) arrays, rad/s and rad per unit of u
        Responses of rates and angles to the moment.
    root : (K, 6, 6) array
        Square root of the noise spectrum of [u, y_i, y_o].
    reach : (K, 2, 2) array
        With X (6, 2) of unit complex normals and E = root X reach, G_i + E_i - G_i E_u and G_o + E_o - G_o E_u are
        as likely as G_i and G_o.
    coherence : (K, 2) array
        Multiple coherence of each rate with the excitation.
    Ts : float, s
        Sampling period.
    """

    omega: Signal
    G_i: Complex
    G_o: Complex
    root: Complex
    reach: Complex
    coherence: Signal
    Ts: float

    def coherent(self) -> NDArray[np.bool_]:
        """Where the excitation explains both rates, (K,)."""
        return np.asarray(np.all(self.coherence > COHERENT, axis=1))

    def coherent_run(self) -> NDArray[np.intp]:
        """The longest stretch of coherent frequencies, as indices."""
        return longest_run(np.flatnonzero(self.coherent()))

    def band(self, axis: int) -> tuple[float, float] | None:
        """Where the excitation explains an axis' rate, rad/s: the longest stretch; None: nowhere."""
        run = longest_run(np.flatnonzero(self.coherence[:, axis] > COHERENT))
        return (float(self.omega[run[0]]), float(self.omega[run[-1]])) if len(run) else None

    def relative_error(self) -> Signal:
        """Standard deviation of G_o over its size, (K,), Frobenius norms."""
        spread = (self.root[:, 4:] - self.G_o @ self.root[:, :2], self.reach, self.G_o)
        noise, reach, size = (np.linalg.norm(matrix, axis=(1, 2)) for matrix in spread)
        relative: Signal = noise * reach / size
        return relative

    def at(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> PlantResponse:
        """The response at some of the frequencies."""
        arrays = {name: value[which] for name, value in vars(self).items() if name != "Ts"}
        return PlantResponse(Ts=self.Ts, **arrays)

    def extended(self) -> PlantResponse:
        """The response with frequencies below its own added, where rates integrate the moment and angles the rates.

        Set-points have most of their power there, and there the closed loop hardly depends on the plant: so the shape
        of a rigid body, 1/w and 1/w^2 from the mean of the lowest frequencies on, is enough.
        """
        step = float(np.diff(self.omega).min())
        low = np.arange(self.omega[0] - step, step / 2, -step)[::-1]
        if not len(low):
            return self
        first, w = slice(0, 3), self.omega[:, None, None]
        below = low[:, None, None]
        down = (self.omega[0] / below) ** np.repeat([0, 1, 2], 2)[:, None]
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
        """The response with frequencies between its own, none further from the next than a share of itself.

        A damped body has G_i^-1 and G_o^-1 / w that are linear in w: they are interpolated. All else is the nearest's.
        """
        counts = np.ceil(np.diff(self.omega) / (share * self.omega[:-1])).astype(int)
        place = np.concatenate([*(k + np.arange(n) / n for k, n in enumerate(counts)), [len(counts)]])
        omega = np.interp(place, np.arange(len(self.omega)), self.omega)
        low = np.minimum(place.astype(int), len(counts) - 1)
        part, new, old = (place - low)[:, None, None], omega[:, None, None], self.omega[:, None, None]

        def between(G: Complex) -> Complex:
            inverse = np.linalg.inv(G)
            value: Complex = np.linalg.inv((1 - part) * inverse[low] + part * inverse[low + 1])
            return value

        dense = self.at(np.rint(place).astype(int))
        return replace(dense, omega=omega, G_i=between(self.G_i), G_o=between(old * self.G_o) / new)

    def draw(self, generator: np.random.Generator) -> PlantResponse:
        """Another plant that the experiment allows, from its error distribution."""
        shape = (len(self.omega), 6, 2)
        X = (generator.standard_normal(shape) + 1j * generator.standard_normal(shape)) / np.sqrt(2)
        E = self.root @ X @ self.reach
        E_u, E_i, E_o = E[:, :2], E[:, 2:4], E[:, 4:]
        return replace(self, G_i=self.G_i + E_i - self.G_i @ E_u, G_o=self.G_o + E_o - self.G_o @ E_u)


def plant_response(experiment: Experiment, instrument: Signal, upper: float) -> PlantResponse:
    """Joint input-output estimate G = T_yw T_uw^-1, consistent in closed loop.

    Parameters
    ----------
    experiment : Experiment
        One flight.
    instrument : (N, 2) array
        Its external signal w.
    upper : float, rad/s
        Largest frequency of interest.

    Raises
    ------
    TuningError
        When the flight is too short, or w does not reach both axes.
    """
    signals = np.hstack([experiment.u, experiment.y_i, experiment.y_o])
    upper = min(upper, 0.95 * np.pi / experiment.Ts)
    found = local_response(instrument, signals, experiment.Ts, experiment.segments, upper, GROWTH)
    T_u, T_i, T_o = found.response[:, :2], found.response[:, 2:4], found.response[:, 4:]
    if np.any(np.linalg.matrix_rank(T_u) < 2):
        raise TuningError("not excited: the external signal does not move both moments independently")
    for name, T in (("rates", T_i), ("angles", T_o)):
        if np.any(np.linalg.matrix_rank(T) < 2):
            raise TuningError(
                f"{experiment.source}: roll and pitch {name} are one signal; check what was logged as pitch"
            )
    inverse = np.linalg.inv(T_u)
    return PlantResponse(
        omega=found.omega,
        G_i=T_i @ inverse,
        G_o=T_o @ inverse,
        root=_root(found.noise),
        reach=_root(found.error).transpose(0, 2, 1) @ inverse,
        coherence=found.explained[:, 2:4],
        Ts=experiment.Ts,
    )


def singular_values(matrices: Complex) -> tuple[Signal, Signal]:
    """Largest and smallest singular value of 2x2 matrices (..., 2, 2), each (...), in closed form: half of a tuning's
    time would be spent in LAPACK's.
    """
    size = np.sum(np.abs(matrices) ** 2, axis=(-2, -1))
    determinant = np.abs(matrices[..., 0, 0] * matrices[..., 1, 1] - matrices[..., 0, 1] * matrices[..., 1, 0])
    largest = np.sqrt((size + np.sqrt(np.maximum(size**2 - 4 * determinant**2, 0.0))) / 2)
    return largest, determinant / np.where(largest > 0, largest, 1.0)


def longest_run(indices: NDArray[np.intp]) -> NDArray[np.intp]:
    """Longest stretch of neighbours, single holes forgiven."""
    if not len(indices):
        return indices
    runs = np.split(indices, np.flatnonzero(np.diff(indices) > 2) + 1)
    longest = max(runs, key=len)
    return np.arange(longest[0], longest[-1] + 1)


def _root(matrices: Complex) -> Complex:
    """R with R R^H = each of the positive semidefinite `matrices`."""
    values, vectors = np.linalg.eigh(matrices)
    root: Complex = vectors * np.sqrt(np.maximum(values, 0))[:, None, :]
    return root


@dataclass(frozen=True, eq=False)
class CascadeLoop:
    """Transfers of a gain set around a plant, (K, 2, 2) each.

    Attributes
    ----------
    L_i : rate loop alone, cut at u.
    L_u : whole loop, cut at u: (C_e + C_d) G_i + (C_e + Kff) Kp_o G_o.
    T_o : from attitude set-point to attitude.
    U_o : from attitude set-point to u.
    """

    L_i: Complex
    L_u: Complex
    T_o: Complex
    U_o: Complex


def inner_controllers(gains: Gains | GainStack, omega: Signal) -> tuple[Complex, Complex]:
    """C_e and C_d at frequencies omega (rad/s), (K, 2, 2) each; of a stack (sets, K, 2, 2)."""
    z = np.exp(1j * omega * gains.Ts)[:, None, None]
    a = gains.derivative_pole
    C_e = gains.Kp_i + gains.Ts * gains.Ki_i * z / (z - 1)
    C_d = gains.Kd_i * (1 - a) * (z - 1) / (gains.Ts * (z - a))
    return C_e, C_d


def whole_loop(gains: Gains | GainStack, plant: PlantResponse) -> tuple[Complex, Complex, Complex]:
    """L_i and L_u as in `CascadeLoop`, and the attitude path (C_e + Kff) Kp_o, (K, 2, 2) each; of a stack
    (sets, K, 2, 2).
    """
    C_e, C_d = inner_controllers(gains, plant.omega)
    forward = (C_e + gains.Kff_i) @ gains.Kp_o
    L_i = (C_e + C_d) @ plant.G_i
    return L_i, L_i + forward @ plant.G_o, forward


def cascade_loop(gains: Gains, plant: PlantResponse) -> CascadeLoop:
    """The transfers of `CascadeLoop` for a gain set on a measured plant."""
    L_i, L_u, forward = whole_loop(gains, plant)
    U_o: Complex = np.linalg.solve(np.eye(2) + L_u, forward).astype(np.complex128)
    return CascadeLoop(L_i, L_u, plant.G_o @ U_o, U_o)


def doublet_spectrum(omega: Signal, seconds: float) -> Complex:
    """Fourier transform of a doublet of height 1, +1 then -1 for half of its length each.

    Parameters
    ----------
    omega : (K,) array, rad/s
    seconds : float, s
        Its whole length.
    """
    s = 1j * omega
    spectrum: Complex = (1 - np.exp(-s * seconds / 2)) ** 2 / s
    return spectrum


def refine_outer(
    gains: Gains, plant: PlantResponse, models: Sequence[ReferenceModel], full: bool, doublet_s: float | None = None
) -> tuple[Gains, Signal]:
    """Kp_o that brings the measured closed loop closest to the outer reference model.

    VRFT weighs what a P controller cannot do by the experiment's spectrum; here the same measured data weigh it by
    that of set-points: |T_o - M_o|^2 / omega, between an impulse's (J_MR, (3.1)) and a step's, or the spectrum of a
    doublet. Gauss-Newton from the VRFT gains, four numbers at most; no model is fitted.

    Parameters
    ----------
    gains : Gains
        A complete set; its rate loop is kept.
    plant : PlantResponse
        From the same experiment.
    models : sequence of 2 ReferenceModel
        Of the attitude loop.
    full : bool
        False: the diagonal only (SISO).
    doublet_s : float, s, optional
        Length of the doublet whose spectrum weighs the error.

    Returns
    -------
    gains : Gains
        With the new Kp_o.
    deviations : (2, 2) array, 1/s
        Standard deviation of its elements, from the error of the measured response.

    Raises
    ------
    TuningError
        When the response is known well at too few frequencies.
    """
    use = plant.coherent() & (plant.relative_error() < ACCURATE)
    if use.sum() < MIN_FREQUENCIES:
        raise TuningError(f"only {use.sum()} frequencies of the measured response are known to 10 %")
    plant = plant.at(use).extended()
    target = np.stack([model.frequency_response(plant.omega) for model in models], axis=1)[:, :, None] * np.eye(2)
    where = np.ones((2, 2), bool) if full else np.eye(2, dtype=bool)
    spectrum = plant.omega**-0.5 if doublet_s is None else np.abs(doublet_spectrum(plant.omega, doublet_s))
    weight = where * spectrum[:, None, None]

    def placed(values: Signal) -> Gains:
        Kp_o = np.zeros((2, 2))
        Kp_o[where] = values
        return replace(gains, Kp_o=Kp_o)

    def distance(values: Signal, of: PlantResponse = plant) -> Signal:
        error = (cascade_loop(placed(values), of).T_o - target) * weight
        return np.concatenate([error.real.ravel(), error.imag.ravel()])

    found = least_squares(distance, gains.Kp_o[where], x_scale="jac")
    generator = np.random.default_rng(0)
    shifts = np.array([distance(found.x, plant.draw(generator)) - found.fun for _ in range(DRAWS)])
    deviations = np.zeros((2, 2))
    deviations[where] = np.std(shifts @ np.linalg.pinv(found.jac).T, axis=0)
    return placed(found.x), deviations
