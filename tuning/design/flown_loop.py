"""What the flown gains do on the measured response: their loop, their noise and the size of their manoeuvres."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.analysis.manoeuvres import family_of
from mimopilot.tuning.axes import Law, flown_law
from mimopilot.tuning.design.free_gains import free_gains
from mimopilot.tuning.design.loop_gradient import LoopGradient
from mimopilot.tuning.design.prediction import FAST
from mimopilot.tuning.experiment import Experiment, manoeuvre_size
from mimopilot.tuning.plant.noise_spectrum import flown_torque_noise
from mimopilot.tuning.plant.wide_response import WideResponse

Signal = NDArray[np.float64]


def flown_loop(flown: Law, plant: WideResponse) -> LoopGradient:
    """The loop of flown gains, at the period of the log: a logger's clock differs a little from the controller's."""
    free = free_gains(replace(flown, filters=replace(flown.filters, Ts=plant.Ts)), plant.body)
    return LoopGradient(plant, free, free.vector(flown))


def flown_noise(experiment: Experiment, plant: WideResponse) -> Signal:
    """RMS of the torque at hover (normalised) under the flown gains, all of it and its part above `FAST`, (2, n).

    As recorded where the flown gains are not known.
    """
    flown = flown_law(experiment)
    if flown is None:
        return np.array([flown_torque_noise(experiment, plant.response, plant.omega, above) for above in (0.0, FAST)])
    loop = flown_loop(flown, plant)
    return np.array([loop.noise_rms(above) for above in (0.0, FAST)])


def flown_amplitude(experiment: Experiment) -> float:
    """Size of the flown manoeuvres, rad, within the range of their family."""
    size = experiment.amplitude
    if size is None:
        used = np.concatenate([experiment.y_o[start:stop] for start, stop in experiment.segments])
        size = manoeuvre_size(used)
    return float(np.clip(size, *family_of(experiment.u.shape[1]).amplitudes))
