"""How much designed gains depend on the noise of the flight that they were designed from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.design.constraints import NoiseLimit
from mimopilot.tuning.design.descent import LARGEST_RADIUS, DesignTask
from mimopilot.tuning.design.flown_loop import flown_noise
from mimopilot.tuning.design.response_design import Design, ResponseDesign
from mimopilot.tuning.design.vehicle_constraints import NOISE

#: Plants drawn from the error of the response for the standard deviations.
DRAWS = 12

Signal = NDArray[np.float64]


def standard_deviations(responses: ResponseDesign, design: Design) -> dict[str, Signal]:
    """Matrix -> (n, n) standard deviations in its unit: the spread to expect if the flight were repeated.

    Of the steps that plants drawn from the errors of the response ask for.
    """
    task, vector = design.task, design.vector
    generator = np.random.default_rng(0)
    around = task.step(vector, LARGEST_RADIUS)
    steps = [_drawn(responses, task, generator).step(vector, LARGEST_RADIUS) - around for _ in range(DRAWS)]
    found = {name: np.zeros(task.free.where.shape) for name in task.free.units}
    spread = np.sqrt(np.mean(np.square(steps), axis=0)) * task.free.size
    for (name, row, column), value in zip(task.free.places(), spread, strict=True):
        found[name][row, column] = value
    return found


def _drawn(responses: ResponseDesign, task: DesignTask, generator: np.random.Generator) -> DesignTask:
    """The task around plants drawn from the errors of the responses."""
    plants = []
    for one, vehicle in zip(task.plants, responses.vehicles, strict=True):
        plant = one.plant.draw(generator)
        parts = iter(NOISE * responses.limits.noise * flown_noise(vehicle.experiment, plant))
        limits = [
            replace(limit, limit=next(parts)) if isinstance(limit, NoiseLimit) else limit for limit in one.constraints
        ]
        plants.append(replace(one, plant=plant, constraints=limits))
    return replace(task, plants=plants)
