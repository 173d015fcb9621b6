"""All plant estimates of one experiment, each computed on first use."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mimopilot.tuning.axes import all_axes, excited_yaw
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.experiment import Experiment, external_signal
from mimopilot.tuning.plant.frequency_response import PlantResponse, measured_plant, plant_response
from mimopilot.tuning.plant.rates_model import RatesModel, identify_rates
from mimopilot.tuning.plant.rigid_body_fit import RigidBody, rigid_body
from mimopilot.tuning.statespace import StateSpace


@dataclass(frozen=True, eq=False)
class PlantEstimates:
    """Plant estimates of one experiment.

    Attributes
    ----------
    experiment : Experiment
    """

    experiment: Experiment

    @cached_property
    def response(self) -> PlantResponse:
        """Frequency response; see `tuning.plant.frequency_response.measured_plant`."""
        return measured_plant(self.experiment)

    @cached_property
    def body(self) -> RigidBody:
        """Rigid-body fit of the response; see `tuning.plant.rigid_body_fit.rigid_body`."""
        return rigid_body(self.response)

    @cached_property
    def yaw(self) -> PlantEstimates:
        """Estimates of the yaw axis alone, from the part of the flight that excites it.

        Raises
        ------
        TuningError
            When the log does not hold its signals, or they are not excited.
        """
        return PlantEstimates(excited_yaw(self.experiment)[0])

    @cached_property
    def yaw_unit(self) -> float:
        """Yaw torque (normalised) that accelerates yaw as u = 1 accelerates roll and pitch, in geometric mean."""
        return float(np.sqrt(abs(self.body.B[0, 0] * self.body.B[1, 1])) / abs(self.yaw.body.B[0, 0]))

    @cached_property
    def all_axes(self) -> PlantResponse:
        """Frequency response of all three axes, with the yaw torque in units of `yaw_unit`: all torques are alike.

        Raises
        ------
        TuningError
            As `yaw`, or when the three excitations are not independent.
        """
        _, yaw = excited_yaw(self.experiment)
        instrument = np.hstack([external_signal(self.experiment)[0], yaw])
        return plant_response(all_axes(self.experiment, self.yaw_unit), instrument)

    @cached_property
    def identified(self) -> RatesModel:
        """State space from torque to rates; see `tuning.plant.rates_model.identify_rates`."""
        return identify_rates(self.experiment, self.response)

    @cached_property
    def model(self) -> StateSpace | None:
        """The identified state space alone; None when no model fits the response."""
        try:
            return self.identified.model.plant
        except TuningError:
            return None
