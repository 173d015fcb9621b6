"""What one experiment says of its vehicle, each part found when it is first asked for."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.experiment import Experiment
from mimopilot.tuning.plant.frequency_response import PlantResponse, measured_plant
from mimopilot.tuning.plant.pbsid import RatesModel, identify_rates
from mimopilot.tuning.plant.rigid_body_fit import RigidBody, rigid_body
from mimopilot.tuning.statespace import StateSpace


@dataclass(frozen=True, eq=False)
class PlantEstimates:
    """The vehicle of an experiment.

    Attributes
    ----------
    experiment : Experiment
    """

    experiment: Experiment

    @cached_property
    def response(self) -> PlantResponse:
        """The frequency response; see `tuning.plant.frequency_response.measured_plant`."""
        return measured_plant(self.experiment)

    @cached_property
    def body(self) -> RigidBody:
        """The rigid body in it; see `tuning.plant.rigid_body_fit.rigid_body`."""
        return rigid_body(self.response)

    @cached_property
    def identified(self) -> RatesModel:
        """A model from torque to rates; see `tuning.plant.pbsid.identify_rates`."""
        return identify_rates(self.experiment, self.response)

    @cached_property
    def model(self) -> StateSpace | None:
        """The same without its fits; None where no model is near the response."""
        try:
            return self.identified.model.plant
        except TuningError:
            return None
