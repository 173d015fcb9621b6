"""All plant estimates of one experiment, each computed on first use."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.experiment import Experiment
from mimopilot.tuning.plant.frequency_response import PlantResponse, measured_plant
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
