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
from scipy.linalg import lstsq, qr, svd

from tuning.errors import TuningError
from tuning.experiment import Experiment
from tuning.statespace import Signal, StateSpace

#: Orders that are tried when none is asked for.
MAX_ORDER = 20
PAST = 20


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
    f = past if future is None else future
    n_u, n_y = u.shape[1], y.shape[1]
    if not 1 <= f <= past:
        raise TuningError(f"identification: got past {past}, future {f}; expected 1 <= future <= past")
    most = f * n_y - 1
    if order is not None and not 1 <= order <= most:
        raise TuningError(f"identification: got order {order}; expected 1..{most} for a future window of {f}")
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
    if order is None:
        tried = min(MAX_ORDER, most, len(s) - 1)
        order = int(np.argmax(s[:tried] / s[1 : tried + 1])) + 1
    x = Q @ (U[:, :order] * np.sqrt(s[:order]))

    CD = _instrumental(np.hstack([x, now_u]), np.hstack([x, w]), now_y).T
    e = now_y - np.hstack([x, now_u]) @ CD.T
    # The next state of a stretch's last sample is in another stretch: leave it out.
    ends = np.cumsum([b - a - past for a, b in stretches]) - 1
    followed = np.setdiff1d(np.arange(count), ends)
    full_u = np.vstack([u[a + past : b] for a, b in stretches])
    ABK = lstsq(np.hstack([x, full_u, e])[followed], x[followed + 1])[0].T
    D = CD[:, order:] if direct else np.zeros((n_y, n_u))
    plant = StateSpace(ABK[:, :order], ABK[:, order : order + n_u], CD[:, :order], D, Ts)
    return IdentifiedModel(plant, ABK[:, order + n_u :], s, e.T @ e / (count - needed), past, f, count)


def identify_rates(
    experiment: Experiment, *, order: int | None = None, past: int = PAST, future: int | None = None
) -> tuple[IdentifiedModel, Signal]:
    """The plant from control moment to body rates, and its one-step fit in percent; see `pbsid`.

    Parameters
    ----------
    experiment : Experiment
    order, past, future
        See `pbsid`.

    Returns
    -------
    model : IdentifiedModel
    fits : (2,) array
        Of roll and pitch rate, percent.
    """
    u, y = experiment.u, experiment.y_i
    model = pbsid(u, y, experiment.Ts, order=order, past=past, future=future, segments=experiment.segments)
    u, y = u - u.mean(axis=0), y - y.mean(axis=0)
    parts = [(y[a:b][past:], model.predict(u[a:b], y[a:b])[past:]) for a, b in experiment.segments]
    measured, predicted = (np.vstack(side) for side in zip(*parts, strict=True))
    return model, fit(measured, predicted)


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
