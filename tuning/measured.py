"""What one experiment says of its vehicle, each part found when it is first asked for."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from tuning.errors import TuningError
from tuning.experiment import Experiment
from tuning.identification import RatesModel, identify_rates
from tuning.plant_response import PlantResponse, measured_plant
from tuning.rigid_body import RigidBody, rigid_body
from tuning.statespace import StateSpace


@dataclass(frozen=True, eq=False)
class Measured:
    """The vehicle of an experiment.

    Attributes
    ----------
    experiment : Experiment
    """

    experiment: Experiment

    @cached_property
    def response(self) -> PlantResponse:
        """The frequency response; see `tuning.plant_response.measured_plant`."""
        return measured_plant(self.experiment)

    @cached_property
    def body(self) -> RigidBody:
        """The rigid body in it; see `tuning.rigid_body.rigid_body`."""
        return rigid_body(self.response)

    @cached_property
    def identified(self) -> RatesModel:
        """A model from torque to rates; see `tuning.identification.identify_rates`."""
        return identify_rates(self.experiment, self.response)

    @cached_property
    def model(self) -> StateSpace | None:
        """The same without its fits; None where no model is near the response."""
        try:
            return self.identified.model.plant
        except TuningError:
            return None
