"""Methods that VRFT is compared with: Correlation-based Tuning and Iterative Feedback Tuning of a PI.

Both call for experiments through one function, see `RunExperiment`, and count them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg import lstsq

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.estimation.correlations import cross_correlation
from mimopilot.tuning.law import regressors
from mimopilot.tuning.law_filters import Filters
from mimopilot.tuning.loop_controller import LoopController
from mimopilot.tuning.reference_model import ReferenceModel
from mimopilot.tuning.statespace import Signal

#: Structure of both controllers.
TERMS = "PI"
#: Step lengths that IFT tries in each iteration, each by experiments; 1: the whole Gauss-Newton step.
STEPS = (1.0, 0.5, 0.25)


class RunExperiment(Protocol):
    """Runs one experiment on the plant, from rest."""

    def __call__(self, controller: LoopController | None, r: Signal, u_bar: Signal) -> tuple[Signal, Signal]:
        """Plant input u and measured output y, (N, n_u) and (N, n_y).

        `controller` closes the loop (None: open loop), r (N, n_y) is its setpoint, u_bar (N, n_u) is added at the
        plant's input.
        """


@dataclass(frozen=True, eq=False)
class Comparison:
    """Result of a method that VRFT is compared with, and its number of experiments.

    Attributes
    ----------
    controller : LoopController
        The tuned PI.
    experiments : int
        Experiments that were run.
    costs : tuple of float
        IFT: measured cost (mean squared norm of y - M r) before the first iteration and after each; CbT: none.
    """

    controller: LoopController
    experiments: int
    costs: tuple[float, ...] = ()


def correlation_based_tuning(
    experiment: RunExperiment,
    models: Sequence[ReferenceModel],
    excitation: Signal,
    *,
    inputs: int = 2,
    repetitions: int = 4,
    lags: int = 30,
) -> Comparison:
    """Non-iterative Correlation-based Tuning of a PI for a stable plant.

    One input at a time is driven by the white signal w in open loop. With y^(i) = G e_i w + v the error
    eps_j = (1 - m)(m w e_j - (1 - m) sum over i of C_ij y^(i)) is linear in column j of the controller. Its
    correlation with w is minimised: least squares on the correlations at lags 0..l. (K. van Heusden,
    A. Karimi, D. Bonvin, "Data-driven model reference control with asymptotically guaranteed stability",
    Int. J. Adaptive Control and Signal Processing 25 (2011), eq. (10), their weight 1 - M; one model for
    all outputs, so that it commutes with the plant.)

    Parameters
    ----------
    experiment : RunExperiment
    models : sequence of n_y ReferenceModel
        All equal.
    excitation : (N,) array
        White w, in the unit of u.
    inputs : int
        n_u.
    repetitions : int
        Experiments for each input; their mean has less noise.
    lags : int, samples

    Returns
    -------
    Comparison
        With inputs times repetitions experiments.

    Raises
    ------
    TuningError
        When the models differ, or N is less than four times the lags.
    """
    model, N = models[0], len(excitation)
    if any(other != model for other in models):
        raise TuningError("Correlation-based Tuning: got different reference models; expected one for all outputs")
    if 4 * lags > N:
        raise TuningError(f"excitation: got {N} samples for {lags} lags, expected at least {4 * lags}")
    rest = np.zeros((N, len(models)))
    outputs = []
    for i in range(inputs):
        u_bar = np.zeros((N, inputs))
        u_bar[:, i] = excitation
        outputs.append(np.mean([experiment(None, rest, u_bar)[1] for _ in range(repetitions)], axis=0))

    def sensitivity(signal: Signal) -> Signal:
        return signal - model.response(signal)

    w = excitation[:, None]
    shaped = [sensitivity(sensitivity(y)) for y in outputs]
    # Regressors of a controller's column: P terms of all inputs, then I terms.
    filters = Filters(model.Ts)
    parts = [regressors(term, y, y, y, filters) for term in TERMS for y in shaped]
    # cross_correlation gives sums of w(k + tau) x(k): the response to the past of w is at -tau.
    S = np.stack([cross_correlation(w, part, lags)[lags::-1, 0] for part in parts], axis=-1)
    target = cross_correlation(w, sensitivity(model.response(w)), lags)[lags::-1, 0, 0]
    P, integral = np.zeros((inputs, len(models))), np.zeros((inputs, len(models)))
    for j in range(len(models)):
        wanted = np.zeros(S.shape[:2])
        wanted[:, j] = target
        column = lstsq(S.reshape(-1, S.shape[-1]), wanted.ravel())[0]
        P[:, j], integral[:, j] = column[:inputs], column[inputs:]
    return Comparison(LoopController({"P": P, "I": integral}, filters), inputs * repetitions)


def iterative_feedback_tuning(
    experiment: RunExperiment,
    start: LoopController,
    models: Sequence[ReferenceModel],
    reference: Signal,
    *,
    amplitude: float = 1.0,
    iterations: int = 6,
    repetitions: int = 7,
    most: int = 500,
) -> Comparison:
    """Iterative Feedback Tuning of a PI: Gauss-Newton steps on gradients measured in the loop.

    The cost is the mean squared norm of y - M r. Its gradient needs dy/dtheta = S G (dC/dtheta)(r - y): the loop's
    response, with r = 0, to the signal (dC/dtheta)(r - y) injected at the plant's input. That signal is recorded in
    the normal experiment and scaled to `amplitude`, since the loop is linear. Each gain has its own gradient
    experiment, repeated to reduce noise. (H. Hjalmarsson, "Efficient tuning of linear multivariable controllers using
    iterative feedback tuning", Int. J. Adaptive Control and Signal Processing 13 (1999).) Of the step lengths `STEPS`
    the one with the least measured cost is used.

    Parameters
    ----------
    experiment : RunExperiment
    start : LoopController
        PI of a stable loop.
    models : sequence of n_y ReferenceModel
    reference : (N, n_y) array
        Setpoint of the normal experiments.
    amplitude : float
        Peak of the signal injected in the gradient experiments, in the unit of u.
    iterations, repetitions : int
        Gauss-Newton steps, and experiments of each kind in a step.
    most : int
        Largest number of experiments.

    Returns
    -------
    Comparison

    Raises
    ------
    TuningError
        When `start` is not a PI, or `most` does not allow the first iteration.
    """
    if start.terms != TERMS:
        raise TuningError(f"Iterative Feedback Tuning: got structure {start.terms}, expected {TERMS}")
    still_u = np.zeros((len(reference), len(start.gain("P"))))
    wanted = np.column_stack([model.response(reference[:, j]) for j, model in enumerate(models)])
    each = repetitions * (start.matrix.size + len(STEPS))
    if most < each + repetitions:
        raise TuningError(
            f"Iterative Feedback Tuning: got at most {most} experiments, expected {each + repetitions} or more"
        )
    count = 0

    def averaged(controller: LoopController, r: Signal, u_bar: Signal) -> Signal:
        nonlocal count
        count += repetitions
        mean: Signal = np.mean([experiment(controller, r, u_bar)[1] for _ in range(repetitions)], axis=0)
        return mean

    def cost(y: Signal) -> float:
        value = float(np.mean(np.sum((y - wanted) ** 2, axis=1)))
        return value if np.isfinite(value) else float("inf")

    controller = start
    y = averaged(controller, reference, still_u)
    costs = [cost(y)]
    for _ in range(iterations):
        if count + each > most:
            break
        e = reference - y
        shapes = regressors(TERMS, e, e, e, controller.filters)
        gradient = []
        for i in range(still_u.shape[1]):
            for shape in shapes.T:
                u_bar, scale = still_u.copy(), amplitude / np.abs(shape).max()
                u_bar[:, i] = scale * shape
                gradient.append(averaged(controller, 0 * reference, u_bar).ravel() / scale)
        step = lstsq(np.column_stack(gradient), (wanted - y).ravel())[0].reshape(controller.matrix.shape)
        tried = [controller.with_matrix(controller.matrix + step * length) for length in STEPS]
        outputs = [averaged(candidate, reference, still_u) for candidate in tried]
        best = min(range(len(tried)), key=lambda i: cost(outputs[i]))
        if cost(outputs[best]) < costs[-1]:
            controller, y = tried[best], outputs[best]
        costs.append(cost(y))
    return Comparison(controller, count, tuple(costs))
