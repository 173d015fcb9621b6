"""PBSID: predictor-based subspace identification of a plant from closed-loop data.

The plant in innovation form is x(k+1) = A x + B u + K e, y = C x + D u + e. Its one-step predictor has the matrix
A - K C, which is stable even if the plant is not. A long VARX model (past window p) holds the predictor's Markov
parameters. Over a future window f they span the state's row space, and an SVD gives its order. A, B, C, D and K
follow by least squares. Past u and y are regressors, so feedback causes no bias: e(k) is uncorrelated with the past.
Source: A. Chiuso, "The role of vector autoregressive modeling in predictor-based subspace identification",
Automatica 43 (2007); section 3.2 of the thesis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lstsq, qr, svd

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.statespace import Signal, StateSpace

#: Largest order tried when none is given.
MAX_ORDER = 20
#: Default past window, samples.
PAST = 20


@dataclass(frozen=True, eq=False)
class IdentifiedModel:
    """A state space identified by PBSID.

    Attributes
    ----------
    plant : StateSpace
        A, B, C, D from u to y.
    K : (n, n_y) array
        Innovation gain.
    singular_values : (min(f n_y, p (n_u + n_y)),) array
        Singular values of the state's row space, in the unit of y times the root of the sample count.
    covariance : (n_y, n_y) array
        Covariance of the innovation e, squared unit of y.
    past, future : int, samples
        Windows p and f.
    samples : int
        Number of samples used.
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
        """Whether all eigenvalues of A - K C are inside the unit circle."""
        return bool(np.abs(np.linalg.eigvals(self.plant.A - self.K @ self.plant.C)).max() < 1)

    def predict(self, u: Signal, y: Signal) -> Signal:
        """One-step-ahead prediction of y from past u and y, and from u(k) if D is not zero; from rest.

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
        """Output of the plant alone, without noise, from rest.

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
        Input and output of the plant. The means are removed.
    Ts : float, s
        Sampling period.
    order : int, optional
        Number of states; by default at the largest drop of the singular values.
    past : int, samples
        Window p of the VARX model.
    future : int, samples, optional
        Window f <= p; p by default.
    external : (N, n_u) array, optional
        Instrument for D, for a plant whose output depends on the input of the same sample: in closed loop u(k)
        holds noise of the same sample. Without it D is zero: u(k) first moves y(k+1), as on a vehicle.
    segments : sequence of (start, stop), optional
        Segments without a gap; all of the data by default.

    Returns
    -------
    IdentifiedModel

    Raises
    ------
    TuningError
        When windows or order are impossible, the data are too short, or the input does not excite the plant.
    """
    states = state_sequence(u, y, Ts, past, future, external, segments)
    if order is not None and not 1 <= order <= states.most:
        raise TuningError(
            f"identification: got order {order}; expected 1..{states.most} for a future window of {states.future}"
        )
    return states.model(order or states.gap())


@dataclass(frozen=True, eq=False)
class StateSequence:
    """The state's row space of one experiment, from which a model of any order follows."""

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
        """The order at the largest drop of the singular values."""
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
            plant=plant,
            K=ABK[:, order + n_u :],
            singular_values=self.singular_values,
            covariance=covariance,
            past=self.past,
            future=self.future,
            samples=len(x),
        )


def state_sequence(
    u: Signal,
    y: Signal,
    Ts: float,
    past: int,
    future: int | None,
    external: Signal | None,
    segments: Sequence[tuple[int, int]] | None,
) -> StateSequence:
    """The part of `pbsid` that does not depend on the order."""
    f = past if future is None else future
    n_u, n_y = u.shape[1], y.shape[1]
    if not 1 <= f <= past:
        raise TuningError(f"identification: got past {past}, future {f}; expected 1 <= future <= past")
    parts = [(a, b) for a, b in segments or [(0, len(u))] if b - a > past + 1]
    direct = external is not None
    needed = past * (n_u + n_y) + n_u * direct
    count = sum(b - a - past for a, b in parts)
    if count < 4 * needed:
        raise TuningError(
            f"too short: {count} usable samples for {needed} unknowns per output; record longer, or give a "
            "smaller past window"
        )
    inside = np.concatenate([np.arange(a, b) for a, b in parts])
    u, y = u - u[inside].mean(axis=0), y - y[inside].mean(axis=0)
    Z = np.vstack([_past(u[a:b], y[a:b], past) for a, b in parts])
    now_u, now_y = (np.vstack([s[a + past : b] for a, b in parts]) for s in (u, y))
    w = np.vstack([external[a + past : b] for a, b in parts]) if external is not None else now_u[:, :0]
    if not direct:
        now_u = now_u[:, :0]

    markov = _instrumental(np.hstack([Z, now_u]), np.hstack([Z, w]), now_y)[: Z.shape[1]].T
    observability = np.zeros((f * n_y, Z.shape[1]))
    width = n_u + n_y
    for i in range(f):
        observability[i * n_y : (i + 1) * n_y, : (past - i) * width] = markov[:, i * width :]
    Q, R = qr(Z, mode="economic")
    U, s, _ = svd(R @ observability.T, full_matrices=False)
    # The last sample of a segment has no next state.
    ends = np.cumsum([b - a - past for a, b in parts]) - 1
    followed = np.setdiff1d(np.arange(count), ends)
    full_u = np.vstack([u[a + past : b] for a, b in parts])
    return StateSequence(
        Q=Q,
        U=U,
        singular_values=s,
        now_u=now_u,
        now_y=now_y,
        w=w,
        full_u=full_u,
        followed=followed,
        past=past,
        future=f,
        needed=needed,
        Ts=Ts,
    )


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
        raise TuningError("not excited: a signal is constant; excite both axes")
    scaled = moment / weight[:, None] / scale
    if np.linalg.cond(scaled) > 1e12:
        raise TuningError("not excited: the input does not excite every axis independently over the past window")
    solution: Signal = np.linalg.solve(scaled, instruments.T @ target / weight[:, None]) / scale[:, None]
    return solution
