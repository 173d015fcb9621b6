"""Attitude gains refined on the measured frequency response."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from mimopilot.tuning.analysis.closed_loop import cascade_loop
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.plant.frequency_response import DRAWS, MIN_FREQUENCIES, PlantResponse
from mimopilot.tuning.reference_model import ReferenceModel

#: Largest relative error of the measured response at the frequencies that are used.
ACCURATE = 0.1

Signal = NDArray[np.float64]


def refine_attitude(
    gains: Gains,
    plant: PlantResponse,
    models: Sequence[ReferenceModel],
    full: bool,
    draw_inner: Callable[[Gains, np.random.Generator], Gains] = lambda gains, generator: gains,
) -> tuple[Gains, Signal]:
    """Kp_o that brings the measured closed loop closest to the outer reference model.

    A P controller cannot reach the model exactly. VRFT weighs the remaining error by the experiment's spectrum; here
    the same data weigh it by that of setpoints. The weight is |T_o - M_o|^2 / omega, between an impulse's
    (J_MR, (3.1)) and a step's. Gauss-Newton from the VRFT gains, four numbers at most;
    no model is fitted.

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
    draw_inner : callable, optional
        Replaces the rate gains by others drawn from their error.

    Returns
    -------
    gains : Gains
        With the new Kp_o.
    deviations : (2, 2) array, 1/s
        Standard deviation of its elements, from the errors of the measured response and of the rate gains.

    Raises
    ------
    TuningError
        When the response is accurate at too few frequencies.
    """
    use = plant.known() & (plant.relative_error() < ACCURATE)
    if use.sum() < MIN_FREQUENCIES:
        raise TuningError(
            f"the measured response is known to {ACCURATE:.0%} at only {use.sum()} frequencies, {MIN_FREQUENCIES} are "
            "needed; record a longer or stronger excitation"
        )
    plant = plant.at(use).extended()
    target = np.stack([model.frequency_response(plant.omega) for model in models], axis=1)[:, :, None] * np.eye(2)
    where = np.ones((2, 2), bool) if full else np.eye(2, dtype=bool)
    # An integral over frequency: the measured frequencies are not equally spaced.
    spectrum = np.sqrt(np.gradient(plant.omega) / plant.omega)
    weight = where * spectrum[:, None, None]

    def placed(values: Signal, around: Gains = gains) -> Gains:
        Kp_o = np.zeros((2, 2))
        Kp_o[where] = values
        return replace(around, Kp_o=Kp_o)

    def distance(values: Signal, of: PlantResponse = plant, around: Gains = gains) -> Signal:
        error = (cascade_loop(placed(values, around), of).T_o - target) * weight
        return np.concatenate([error.real.ravel(), error.imag.ravel()])

    found = least_squares(distance, gains.Kp_o[where], x_scale="jac")
    generator = np.random.default_rng(0)
    shifts = np.array(
        [distance(found.x, plant.draw(generator), draw_inner(gains, generator)) - found.fun for _ in range(DRAWS)]
    )
    deviations = np.zeros((2, 2))
    deviations[where] = np.std(shifts @ np.linalg.pinv(found.jac).T, axis=0)
    return placed(found.x), deviations
