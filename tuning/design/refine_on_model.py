"""One loop refined on an identified plant: from VRFT's gains to the minimum of the model-reference cost.

VRFT minimises the error of the controller's output over the recorded signals. If the structure cannot reach the
reference model, ||M - T||^2 is smallest elsewhere: on LV100 the minimum of VRFT without noise has J_MR 0.057, the best
2x2 PI 0.0515. Here a plant identified from the same experiment (PBSID) replaces the true one in (3.1), and a
Levenberg-Marquardt iteration goes from VRFT's gains to the minimum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.loop_controller import LoopController, closed_loop, complementary_sensitivity
from mimopilot.tuning.reference_matrix import ReferenceMatrix, Wanted, wanted_response
from mimopilot.tuning.reference_model import ReferenceModel
from mimopilot.tuning.statespace import Response, Signal, StateSpace

#: Frequencies of the mean over (0, pi/Ts) in (3.1).
FREQUENCIES = 500


@dataclass(frozen=True, eq=False)
class Refinement:
    """A refined controller, and (3.1) predicted by the identified plant before and after.

    Attributes
    ----------
    controller : LoopController
        The initial structure with new gains.
    before, after : float
        Predicted J_MR of the initial controller and of `controller`.
    """

    controller: LoopController
    before: float
    after: float


def frequency_grid(Ts: float, count: int) -> Signal:
    """`count` frequencies in the middle of equal parts of (0, pi/Ts), rad/s."""
    return np.asarray((np.arange(count) + 0.5) * (np.pi / Ts / count), dtype=np.float64)


def model_reference_cost(
    plant: StateSpace,
    controller: LoopController,
    models: Wanted,
    count: int = FREQUENCIES,
    emphasis: ReferenceModel | None = None,
) -> float:
    """J_MR (3.1): mean over (0, pi) of the squared Frobenius norm of W (M - T).

    Parameters
    ----------
    plant : StateSpace
    controller : LoopController
        Of a stable loop; the cost of an unstable one is meaningless.
    models : sequence of n_y ReferenceModel, or ReferenceMatrix
    count : int
        Number of frequencies.
    emphasis : ReferenceModel, optional
        W(z); 1 by default.
    """
    omega = frequency_grid(plant.Ts, count)
    T = complementary_sensitivity(plant.frequency_response(omega), controller, omega)
    error = np.sum(np.abs(wanted_response(models, omega) - T) ** 2, axis=(1, 2))
    return float(np.mean(error if emphasis is None else np.abs(emphasis.frequency_response(omega)) ** 2 * error))


def refine_on_model(
    controller: LoopController, plant: StateSpace, models: Wanted, emphasis: ReferenceModel | None = None
) -> Refinement:
    """Gains of the same structure that minimise J_MR (3.1) on an identified plant.

    Levenberg-Marquardt with the exact derivative: T = (I + G B Phi_y)^-1 G B Phi_r gives
    dT = S G dB (Phi_r - Phi_y T), S = (I + G B Phi_y)^-1. The cost is unbounded at the limit of stability,
    so the iteration stays on the stable side; the result is checked nevertheless.

    Parameters
    ----------
    controller : LoopController
        Initial controller, such as VRFT's; its loop must be stable.
    plant : StateSpace
        Identified plant, such as `tuning.plant.pbsid.pbsid` gives.
    models : sequence of n_y ReferenceModel, or ReferenceMatrix
        Wanted complementary sensitivity of each output, or the whole matrix.
    emphasis : ReferenceModel, optional
        W(z) of (3.1); 1 by default.

    Returns
    -------
    Refinement

    Raises
    ------
    TuningError
        When the loop around the identified plant is not stable, before or after.
    """
    periods = {models.Ts} if isinstance(models, ReferenceMatrix) else {model.Ts for model in models}
    if {controller.filters.Ts, *periods} != {plant.Ts} or len(models) != len(plant.C):
        raise TuningError(
            "refinement: expected one reference model for each output, and one period for plant, controller and models"
        )
    _check_stable(plant, controller, "the initial gains")
    omega = frequency_grid(plant.Ts, FREQUENCIES)
    G, M = plant.frequency_response(omega), wanted_response(models, omega)
    of_r, of_y = controller.shapes(omega)
    start = controller.matrix
    scale = np.where(start == 0, np.abs(start).max(), np.abs(start))
    eye = np.eye(len(models))
    W = np.ones(FREQUENCIES) if emphasis is None else np.abs(emphasis.frequency_response(omega))

    def closed(parameters: Signal) -> tuple[Response, Response]:
        open_loop = G @ (parameters.reshape(start.shape) * scale)
        S = np.linalg.inv(eye + open_loop @ of_y).astype(np.complex128)
        return S, S @ open_loop @ of_r

    def residual(parameters: Signal) -> Signal:
        return _real(W[:, None, None] * (M - closed(parameters)[1])).ravel()

    def derivative(parameters: Signal) -> Signal:
        S, T = closed(parameters)
        left, right = W[:, None, None] * (S @ G), of_r - of_y @ T
        columns = -np.einsum("fai,fjb->fabij", left, right) * scale
        return _real(columns).reshape(-1, start.size)

    found = least_squares(residual, (start / scale).ravel(), derivative, method="lm")
    refined = controller.with_matrix(found.x.reshape(start.shape) * scale)
    _check_stable(plant, refined, "the refined gains")
    costs = (model_reference_cost(plant, c, models, emphasis=emphasis) for c in (controller, refined))
    return Refinement(refined, *costs)


def _real(values: Response) -> Signal:
    """Real parts, then imaginary parts: the complex norm as a real one."""
    return np.stack([values.real, values.imag])


def _check_stable(plant: StateSpace, controller: LoopController, what: str) -> None:
    radius = float(np.abs(closed_loop(plant, controller).poles[0]))
    if radius >= 1:
        raise TuningError(
            f"refinement: with {what} the loop around the identified plant is not stable (spectral radius "
            f"{radius:.4f}); record a longer experiment, or ask for another reference model"
        )
