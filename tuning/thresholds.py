"""How much margin a verdict needs."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator


class Thresholds(BaseModel):
    """Margins that a verdict needs, of the loop including its error.

    Attributes
    ----------
    Ms, phase_deg : float, -, deg
        Largest peak of the sensitivity and smallest phase margin of ``certified``. With Ms of 1.8 no loop has less than
        32 degrees and 7 dB; the position loop around it takes its share of the rest.
    thin_Ms, thin_phase_deg : float, -, deg
        Of ``stable, thin margin``; anything thinner is ``not certified``: a loop at 10 degrees rolled by 25 degrees in
        a genuine PX4.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    Ms: Annotated[float, Field(gt=1, allow_inf_nan=False)] = 1.8
    phase_deg: Annotated[float, Field(gt=0, lt=90)] = 40.0
    thin_Ms: Annotated[float, Field(gt=1, allow_inf_nan=False)] = 2.5
    thin_phase_deg: Annotated[float, Field(gt=0, lt=90)] = 25.0

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.thin_Ms < self.Ms or self.thin_phase_deg > self.phase_deg:
            raise ValueError("thin_Ms must be at least Ms, and thin_phase_deg at most phase_deg")
        return self


DEFAULT_THRESHOLDS = Thresholds()
