"""PBSID: predictor-based subspace identification of a plant from closed-loop data.

The plant in innovation form, x(k+1) = A x + B u + K e, y = C x + D u + e, is written with its one-step
predictor, whose A - K C is stable even where the plant is not. A long VARX model (past window p) has the
predictor's Markov parameters; over a future window f they make the state's row space, and an SVD gives its
order; A, B, C, D and K follow by least squares. Because past u and y are regressors, feedback does no harm:
e(k) is uncorrelated with the past whatever made u. Source: A. Chiuso, "The role of vector autoregressive
modeling in predictor-based subspace identification", Automatica 43 (2007); the thesis uses it in 3.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.experiment import Experiment
from mimopilot.tuning.plant.frequency_response import PlantResponse
from mimopilot.tuning.statespace import Response, Signal, StateSpace
from numpy.typing import NDArray
from scipy.linalg import lstsq, qr, svd

#: Orders that are tried when none is asked for.
MAX_ORDER = 20
#: Orders that are compared with a measured response, at most: a body, rotors, a filter and delays on two axes.
RESPONSE_ORDER = 12
PAST = 20
#: Order by response: the lowest whose weighted square error is within this factor of the least is taken; one that fits
#: by less, percent, is of no use.
NEARLY, POOR = 1.3, 50.0
#: Relative error that a response has besides its noise, and the one at which it counts half for a fit.
SHAPE, SURE = 0.01, 0.05


@dataclass(frozen=True, eq=False)
class IdentifiedModel:
    """What PBSID found.

    Attributes
    ----------
    plant : StateSpace
        A, B, C, D from u to y.
    K : (n, n_y) array
        Innovation gain.
    singular_values : (min(f n_y, p (n_u + n_y)),) array
        Of the state's row space, in the unit of y times the root of the sample count.
    covariance : (n_y, n_y) array
        Of the innovation e, squared unit of y.
    past, future : int, samples
        Windows p and f.
    samples : int
        Equations used.
    """

    plant: StateSpace
    K: Signal
    singular_values: Signal
    covariance: Signal
    past: int
    future: int
    samples: int

    @property
    def order(self) -> int:
        """Number of states."""
        return len(self.plant.A)

    @property
    def predictor_stable(self) -> bool:
        """Whether the one-step predictor forgets: A - K C has its eigenvalues inside the unit circle."""
        return bool(np.abs(np.linalg.eigvals(self.plant.A - self.K @ self.plant.C)).max() < 1)

    def predict(self, u: Signal, y: Signal) -> Signal:
        """One-step-ahead prediction of y from past u and y (and u(k), where D is not zero), from rest.

        Parameters
        ----------
        u, y : (N, n_u), (N, n_y) arrays

        Returns
        -------
        (N, n_y) array
        """
        p = self.plant
        A = p.A - self.K @ p.C
        B = np.hstack([p.B - self.K @ p.D, self.K])
        D = np.hstack([p.D, np.zeros((len(p.C), len(p.C)))])
        return StateSpace(A, B, p.C, D, p.Ts).simulate(np.hstack([u, y]))

    def simulate(self, u: Signal) -> Signal:
        """Output of the plant alone, without noise, from rest; a plant that is not stable is refused.

        Parameters
        ----------
        u : (N, n_u) array

        Returns
        -------
        (N, n_y) array

        Raises
        ------
        TuningError
            When a pole is outside the unit circle: the output would grow without bound.
        """
        if np.abs(self.plant.poles[0]) > 1:
            raise TuningError(
                f"the identified plant has a pole at modulus {abs(self.plant.poles[0]):.5g}: its output would grow "
                "without bound; simulate the closed loop instead"
            )
        return self.plant.simulate(u)


def pbsid(
    u: Signal,
    y: Signal,
    Ts: float,
    *,
    order: int | None = None,
    past: int = PAST,
    future: int | None = None,
    external: Signal | None = None,
    segments: Sequence[tuple[int, int]] | None = None,
) -> IdentifiedModel:
    """Identify a plant from an experiment in open or closed loop.

    Parameters
    ----------
    u, y : (N, n_u), (N, n_y) arrays
        Input and output of the plant. Their means are taken off.
    Ts : float, s
        Sampling period.
    order : int, optional
        Number of states; by default where the singular values fall most.
    past : int, samples
        Window p of the VARX model.
    future : int, samples, optional
        Window f <= p; p by default.
    external : (N, n_u) array, optional
        External signal of the same sample as u, for a plant whose output answers within the sample (D): in
        closed loop u(k) holds noise of the same sample, and this is the instrument in its place. Without
        it D is zero: u(k) moves y(k+1) first, as on a vehicle.
    segments : sequence of (start, stop), optional
        Stretches without a gap; all of the data by default.

    Returns
    -------
    IdentifiedModel

    Raises
    ------
    TuningError
        When the windows or the order do not fit, the data are too short, or the input does not excite.
    """
    states = _states(u, y, Ts, past, future, external, segments)
    if order is not None and not 1 <= order <= states.most:
        raise TuningError(
            f"identification: got order {order}; expected 1..{states.most} for a future window of {states.future}"
        )
    return states.model(order or states.gap())


def pbsid_by_response(
    u: Signal,
    y: Signal,
    Ts: float,
    omega: Signal,
    response: Response,
    deviation: Signal,
    *,
    past: int = PAST,
    future: int | None = None,
    segments: Sequence[tuple[int, int]] | None = None,
    least_fit: float = POOR,
) -> tuple[IdentifiedModel, float]:
    """`pbsid` with the order whose frequency response is nearest to the measured one.

    A gap in the singular values says little in closed loop: on logs of a genuine PX4 it asked for order 2, whose
    predictor diverged, where orders 4 to 8 fit.

    Parameters
    ----------
    omega : (K,) array, rad/s
    response : (K, n_y, n_u) array
        From u to y, measured there.
    deviation : (K, n_y, n_u) array
        Its standard deviation.
    u, y, Ts, past, future, segments
        See `pbsid`.
    least_fit : float, percent
        What fits by less is refused.

    Returns
    -------
    model : IdentifiedModel
        Of the lowest order that fits nearly best within the error of the response, with a stable predictor.
    fit : float, percent
        See `response_fit`.

    Raises
    ------
    TuningError
        As `pbsid`, or when no order has a stable predictor, or fits.
    """
    states = _states(u, y, Ts, past, future, None, segments)
    size = np.linalg.norm(response, axis=(1, 2))[:, None, None]
    weight = 1 / (deviation**2 + (SHAPE * size) ** 2)
    found = []
    for order in range(1, min(RESPONSE_ORDER, states.most, len(states.singular_values)) + 1):
        model = states.model(order)
        if model.predictor_stable:
            error = float(np.sum(weight * np.abs(model.plant.frequency_response(omega) - response) ** 2))
            found.append((error, model))
    if not found:
        raise TuningError("identification: no order has a stable predictor; record longer, or excite more strongly")
    least = min(error for error, _ in found)
    model = next(model for error, model in found if error <= NEARLY * least)
    fit = response_fit(model.plant, omega, response, deviation)
    if fit < least_fit:
        raise TuningError(
            f"identification: no model of order 1 to {RESPONSE_ORDER} is near the measured response (the best fits by "
            f"{fit:.0f} %, at least {least_fit:g} % are needed); record longer, or excite more strongly"
        )
    return model, fit


def response_fit(plant: StateSpace, omega: Signal, response: Response, deviation: Signal) -> float:
    """100 (1 - |G - model| / |G|), percent: each frequency weighed by itself, so that all octaves of an integrator
    count, and by how surely it is known.

    Parameters
    ----------
    plant : StateSpace
    omega : (K,) array, rad/s
    response, deviation : (K, n_y, n_u) arrays
        Measured, and its standard deviation.
    """
    size, spread = (np.linalg.norm(part, axis=(1, 2)) for part in (response, deviation))
    weight = (omega / (1 + (spread / (SURE * size)) ** 2))[:, None, None]
    off = np.linalg.norm(weight * (plant.frequency_response(omega) - response))
    return 100 * (1 - float(off / np.linalg.norm(weight * response)))


@dataclass(frozen=True, eq=False)
class _States:
    """The state's row space of one experiment: what models of any order are made from."""

    Q: Signal
    U: Signal
    singular_values: Signal
    now_u: Signal
    now_y: Signal
    w: Signal
    full_u: Signal
    followed: NDArray[np.intp]
    past: int
    future: int
    needed: int
    Ts: float

    @property
    def most(self) -> int:
        """Largest order that the windows allow."""
        return self.future * int(self.now_y.shape[1]) - 1

    def gap(self) -> int:
        """The order where the singular values fall most."""
        s = self.singular_values
        tried = min(MAX_ORDER, self.most, len(s) - 1)
        return int(np.argmax(s[:tried] / s[1 : tried + 1])) + 1

    def model(self, order: int) -> IdentifiedModel:
        """The model of one order."""
        n_u, n_y = self.full_u.shape[1], self.now_y.shape[1]
        x = self.Q @ (self.U[:, :order] * np.sqrt(self.singular_values[:order]))
        CD = _instrumental(np.hstack([x, self.now_u]), np.hstack([x, self.w]), self.now_y).T
        e = self.now_y - np.hstack([x, self.now_u]) @ CD.T
        known = np.hstack([x, self.full_u, e])[self.followed]
        ABK = lstsq(known, x[self.followed + 1], lapack_driver="gelsy")[0].T
        D = CD[:, order:] if self.w.shape[1] else np.zeros((n_y, n_u))
        plant = StateSpace(ABK[:, :order], ABK[:, order : order + n_u], CD[:, :order], D, self.Ts)
        covariance = e.T @ e / (len(x) - self.needed)
        return IdentifiedModel(
            plant, ABK[:, order + n_u :], self.singular_values, covariance, self.past, self.future, len(x)
        )


def _states(
    u: Signal,
    y: Signal,
    Ts: float,
    past: int,
    future: int | None,
    external: Signal | None,
    segments: Sequence[tuple[int, int]] | None,
) -> _States:
    """Everything of `pbsid` that does not depend on the order."""
    f = past if future is None else future
    n_u, n_y = u.shape[1], y.shape[1]
    if not 1 <= f <= past:
        raise TuningError(f"identification: got past {past}, future {f}; expected 1 <= future <= past")
    stretches = [(a, b) for a, b in segments or [(0, len(u))] if b - a > past + 1]
    direct = external is not None
    needed = past * (n_u + n_y) + n_u * direct
    count = sum(b - a - past for a, b in stretches)
    if count < 4 * needed:
        raise TuningError(
            f"too short: {count} usable samples for {needed} unknowns an output; record longer, or ask for a "
            "smaller past"
        )
    inside = np.concatenate([np.arange(a, b) for a, b in stretches])
    u, y = u - u[inside].mean(axis=0), y - y[inside].mean(axis=0)
    Z = np.vstack([_past(u[a:b], y[a:b], past) for a, b in stretches])
    now_u, now_y = (np.vstack([s[a + past : b] for a, b in stretches]) for s in (u, y))
    w = np.vstack([external[a + past : b] for a, b in stretches]) if external is not None else now_u[:, :0]
    if not direct:
        now_u = now_u[:, :0]

    markov = _instrumental(np.hstack([Z, now_u]), np.hstack([Z, w]), now_y)[: Z.shape[1]].T
    observability = np.zeros((f * n_y, Z.shape[1]))
    width = n_u + n_y
    for i in range(f):
        observability[i * n_y : (i + 1) * n_y, : (past - i) * width] = markov[:, i * width :]
    Q, R = qr(Z, mode="economic")
    U, s, _ = svd(R @ observability.T, full_matrices=False)
    # The next state of a stretch's last sample is in another stretch: leave it out.
    ends = np.cumsum([b - a - past for a, b in stretches]) - 1
    followed = np.setdiff1d(np.arange(count), ends)
    full_u = np.vstack([u[a + past : b] for a, b in stretches])
    return _States(Q, U, s, now_u, now_y, w, full_u, followed, past, f, needed, Ts)


@dataclass(frozen=True, eq=False)
class RatesModel:
    """A plant from torque to body rates, and how well it fits.

    Attributes
    ----------
    model : IdentifiedModel
    one_step_percent : (2,) array
        Fit of the prediction one sample ahead, roll and pitch rate.
    response_percent : float
        Fit of its frequency response to the measured one, see `pbsid_by_response`.
    """

    model: IdentifiedModel
    one_step_percent: Signal
    response_percent: float


def identify_rates(
    experiment: Experiment,
    plant: PlantResponse,
    *,
    order: int | None = None,
    past: int = PAST,
    future: int | None = None,
) -> RatesModel:
    """The plant from torque to body rates; see `pbsid`.

    Parameters
    ----------
    experiment : Experiment
    plant : PlantResponse
        Measured on it: the order is the one that fits it.
    order, past, future
        See `pbsid`.

    Raises
    ------
    TuningError
        As `pbsid_by_response`; or when the predictor of the order that was asked for is not stable.
    """
    u, y, segments = experiment.u, experiment.y_i, experiment.segments
    known = plant.at(plant.known_run())
    if not len(known.omega):
        raise TuningError(f"{experiment.source}: not excited: the response of the rates is known at no frequency")
    if order is None:
        model, response = pbsid_by_response(
            u, y, experiment.Ts, known.omega, known.G_i, known.deviation(), past=past, future=future, segments=segments
        )
    else:
        model = pbsid(u, y, experiment.Ts, order=order, past=past, future=future, segments=segments)
        if not model.predictor_stable:
            raise TuningError(
                f"identification: the predictor of order {order} is not stable, its predictions grow without bound; "
                "ask for another order, or leave it out"
            )
        response = response_fit(model.plant, known.omega, known.G_i, known.deviation())
    u, y = u - u.mean(axis=0), y - y.mean(axis=0)
    parts = [(y[a:b][past:], model.predict(u[a:b], y[a:b])[past:]) for a, b in segments]
    measured, predicted = (np.vstack(side) for side in zip(*parts, strict=True))
    return RatesModel(model, fit(measured, predicted), response)


def model_toml(model: IdentifiedModel, log_sha256: str) -> str:
    """The model as readable TOML text: Ts (s), A, B, C, D, K, windows, and the hash of the log."""
    rows = {name: getattr(model.plant, name).tolist() for name in "ABCD"} | {"K": model.K.tolist()}
    lines = [
        "# x(k+1) = A x + B u + K e, y = C x + D u + e; u dimensionless moment, y body rates in rad/s",
        "version = 1",
        f"Ts = {model.plant.Ts!r}",
        f"past = {model.past}",
        f"future = {model.future}",
        f'log_sha256 = "{log_sha256}"',
    ]
    for name, matrix in rows.items():
        lines += [f"{name} = [", *(f"  {row}," for row in matrix), "]"]
    return "\n".join(lines) + "\n"


def fit(measured: Signal, modelled: Signal) -> Signal:
    """Normalised root mean square fit in percent, one for each column; 100 is perfect, 0 no better than the mean."""
    error = np.sqrt(np.mean((measured - modelled) ** 2, axis=0))
    figure: Signal = 100 * (1 - error / np.std(measured, axis=0))
    return figure


def _past(u: Signal, y: Signal, past: int) -> Signal:
    """Rows [u(k-1), y(k-1), u(k-2), y(k-2), ...] for k = past..N-1."""
    z = np.hstack([u, y])
    return np.hstack([z[past - i : len(z) - i] for i in range(1, past + 1)])


def _instrumental(regressors: Signal, instruments: Signal, target: Signal) -> Signal:
    """Solve instruments' (target - regressors theta) = 0."""
    moment = instruments.T @ regressors
    scale = np.sqrt(np.einsum("ij,ij->j", regressors, regressors))
    weight = np.sqrt(np.einsum("ij,ij->j", instruments, instruments))
    if not (np.all(scale > 0) and np.all(weight > 0)):
        raise TuningError("not excited: a signal is constant, so the plant cannot be identified")
    scaled = moment / weight[:, None] / scale
    if np.linalg.cond(scaled) > 1e12:
        raise TuningError("not excited: the input does not move every axis independently over the past window")
    solution: Signal = np.linalg.solve(scaled, instruments.T @ target / weight[:, None]) / scale[:, None]
    return solution
