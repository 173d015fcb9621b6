"""Doublets predicted from a log: the flown difference equation around the plant and motors identified from it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.gain_stack import GainStack
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.motors import Motors, rotor_lag
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.spec import Manoeuvre
from mimopilot.tuning.statespace import StateSpace

Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class DoubletModel:
    """A doublet around an identified plant.

    Attributes
    ----------
    plant : StateSpace
        From torque to body rates.
    trim : (2,) array
        Torque (normalised) that holds the vehicle level.
    setpoint : (N,) array, rad
        Of the moving axis; the other's is zero.
    motors : Motors or None
        Motors that produce the torque; None: any torque is produced.
    """

    plant: StateSpace
    trim: Signal
    setpoint: Signal
    motors: Motors | None = None

    def simulate(self, stack: GainStack, soft: float = 0.0) -> tuple[Signal, Signal]:
        """Doublets on roll and on pitch with each of several gain sets, without noise.

        Parameters
        ----------
        stack : GainStack
        soft : float
            Torque over which anti-windup switches gradually: the angles are then continuous in the gains.

        Returns
        -------
        angles, moments : (2, sets, N, 2) arrays, rad, torque (normalised)
            First index: the moving axis.
        """
        from mimopilot.tuning.analysis.compiled_doublet import (  # numba: slower to import than all other modules
            law_terms,
            simulate_doublets,
        )

        gains, plant = stack.stacked(), self.plant
        angles, moments = (np.empty((2, len(gains), len(self.setpoint), 2)) for _ in range(2))
        matrices = (np.ascontiguousarray(matrix) for matrix in (plant.A, plant.B, plant.C))
        terms = law_terms(stack.filters)
        simulate_doublets(
            *matrices,
            self.trim,
            self._motors,
            self.setpoint,
            gains,
            terms,
            stack.limits,
            stack.filters.Ts,
            soft,
            angles,
            moments,
        )
        return angles, moments

    @cached_property
    def _motors(self) -> tuple[Signal, Signal, Signal, float]:
        """Motors as `simulate_doublets` takes them."""
        if self.motors is None:
            return np.empty((0, 2)), np.empty((2, 0)), np.empty(0), 0.0
        lag = rotor_lag(self.plant)
        inverse = np.ascontiguousarray(np.linalg.pinv(self.motors.mixer))
        return self.motors.mixer, inverse, self.motors.hover, float(np.exp(-self.plant.Ts / lag)) if lag else 0.0


def doublet_model(measured: PlantEstimates, manoeuvre: Manoeuvre) -> DoubletModel:
    """The manoeuvre around the plant identified from an experiment.

    Parameters
    ----------
    measured : PlantEstimates
    manoeuvre : Manoeuvre

    Raises
    ------
    TuningError
        When no model is close to the measured response.
    """
    experiment, plant = measured.experiment, measured.identified.model.plant
    half = round(manoeuvre.period_s / 2 / experiment.Ts)
    height = np.radians(manoeuvre.amplitude_deg) * np.ones(half)
    u = np.concatenate([experiment.u[start:stop] for start, stop in experiment.segments])
    return DoubletModel(plant, np.median(u, axis=0), np.concatenate([height, -height]), experiment.motors)


def doublet_effort(gains: Gains, model: DoubletModel) -> tuple[float, float]:
    """Predicted RMS of both torques together over the roll and over the pitch doublet."""
    roll, pitch = moment_rms(model.simulate(GainStack.of(gains))[1])[:, 0]
    return float(roll), float(pitch)


def moment_rms(moments: Signal) -> Signal:
    """RMS of both torques (..., N, 2) together over the N samples, (...)."""
    power: Signal = np.sqrt(np.mean(np.sum(moments**2, axis=-1), axis=-1))
    return power
