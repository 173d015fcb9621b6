"""Specification of what varies between runs: vehicle, sensors, wind, initial state and faults.

A specification is TOML. Each entry is a distribution in SI units: ``{ uniform = [low, high] }``,
``{ normal = [mean, deviation] }`` or ``{ loguniform = [low, high] }``. With ``relative = true`` it is a factor on the
airframe's value. Numbers of samples are rounded: ``delay = { uniform = [0.5, 3.5] }`` draws 1, 2 and 3 equally often.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from mimopilot.common.toml import checked, read_toml
from mimopilot.sitl.physics.airframe import Vector

Finite = Annotated[float, Field(allow_inf_nan=False)]
Pair = tuple[Finite, Finite]


class Distribution(BaseModel):
    """Distribution of one quantity: exactly one of the three kinds."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    uniform: Pair | None = None
    normal: Pair | None = None
    loguniform: Pair | None = None
    relative: bool = False

    @model_validator(mode="after")
    def _is_one_distribution(self) -> Distribution:
        kinds = [name for name in ("uniform", "normal", "loguniform") if getattr(self, name) is not None]
        if len(kinds) != 1:
            raise ValueError("expected exactly one of uniform, normal and loguniform")
        first, second = getattr(self, kinds[0])
        if kinds == ["normal"] and second < 0:
            raise ValueError("normal: expected [mean, deviation] with a deviation of 0 or more")
        if kinds != ["normal"] and not first <= second:
            raise ValueError(f"{kinds[0]}: expected [low, high] in this order")
        if kinds == ["loguniform"] and first <= 0:
            raise ValueError("loguniform: expected bounds above 0")
        return self

    def draw(self, generator: np.random.Generator, own: float = 0.0) -> float:
        """Draw a number; `own` is the airframe's value, the unit of a relative distribution."""
        if self.normal is not None:
            mean, deviation = self.normal
            value = mean + deviation * generator.standard_normal()
        elif self.uniform is not None:
            low, high = self.uniform
            value = low + (high - low) * generator.random()
        else:
            assert self.loguniform is not None
            low, high = self.loguniform
            value = low * (high / low) ** generator.random()
        return value * own if self.relative else value


Number = Finite | Distribution


def _absolute(value: Distribution) -> Distribution:
    if value.relative:
        raise ValueError("the airframe has no value of its own; remove relative = true")
    return value


class _VariationTable(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    def entries(self) -> Iterator[tuple[str, Distribution]]:
        """Names and distributions of the varied quantities."""
        for name in type(self).model_fields:
            if isinstance(value := getattr(self, name), Distribution):
                yield name, value


class InertiaVariation(_VariationTable):
    """Moments of inertia, kg m^2. Products scale along, so that product / sqrt(moment * moment) stays."""

    xx: Distribution | None = None
    yy: Distribution | None = None
    zz: Distribution | None = None


class ProductVariation(_VariationTable):
    """Off-diagonal elements of the tensor, kg m^2 (minus the products of inertia); they replace the airframe's."""

    xy: Distribution | None = None
    xz: Distribution | None = None
    yz: Distribution | None = None


class MotorVariation(_VariationTable):
    """Motor constants as in the airframe file; `effectiveness` (fraction of thrust) is drawn for each motor."""

    thrust_max: Distribution | None = None
    time_constant: Distribution | None = None
    torque_ratio: Distribution | None = None
    effectiveness: Distribution | None = None


class NoiseVariation(_VariationTable):
    """Standard deviation of the state estimate: angle (rad), rate (rad/s)."""

    angle: Distribution | None = None
    rate: Distribution | None = None


class _AbsoluteVariationTable(_VariationTable):
    @model_validator(mode="after")
    def _is_absolute(self) -> Any:
        for _, value in self.entries():
            _absolute(value)
        return self


class WindVariation(_AbsoluteVariationTable):
    """Velocity of the air, constant, m/s."""

    north: Distribution | None = None
    east: Distribution | None = None
    down: Distribution | None = None


class AngleVariation(_AbsoluteVariationTable):
    """Initial attitude or body rates."""

    roll: Distribution | None = None
    pitch: Distribution | None = None
    yaw: Distribution | None = None


class FaultVariation(_VariationTable):
    """A fault (`sitl.faults.kinds.Fault`) whose numbers may be distributions; a drawn motor is rounded."""

    kind: str
    at: Number
    duration: Number | None = None
    size: Number | None = None
    motor: Number | None = None
    axis: str | None = None
    position: Vector | None = None
    matrix: str | None = None

    @model_validator(mode="after")
    def _is_absolute(self) -> Any:
        for _, value in self.entries():
            _absolute(value)
        return self


class Variation(_VariationTable):
    """The whole specification; quantities without an entry keep the airframe's value.

    Attributes
    ----------
    mass : kg
        Mass of the whole vehicle.
    inertia, products, motors, noise, wind
        See their classes.
    attitude_deg, rates_deg_s : degrees, deg/s
        Initial attitude and body rates.
    rate_damping : 1/s
    drag : N s/m
    delay : samples
        Control periods from a measurement to its motor command.
    amplitude_deg : degrees
        Amplitude of the setpoints.
    fault
        Faults in addition to those of the scenario.
    """

    mass: Distribution | None = None
    inertia: InertiaVariation = InertiaVariation()
    products: ProductVariation = ProductVariation()
    motors: MotorVariation = MotorVariation()
    rate_damping: Distribution | None = None
    drag: Distribution | None = None
    delay: Distribution | None = None
    noise: NoiseVariation = NoiseVariation()
    wind: WindVariation = WindVariation()
    attitude_deg: AngleVariation = AngleVariation()
    rates_deg_s: AngleVariation = AngleVariation()
    amplitude_deg: Distribution | None = None
    fault: tuple[FaultVariation, ...] = ()


def read_variation(path: Path) -> dict[str, Any]:
    """Read a specification file, and check it; returns its table.

    Raises
    ------
    InputFileError
        When it is not TOML, or an entry is unknown or impossible.
    """
    table = read_toml(path, "specification of what varies", "give that with --gains")
    checked(Variation, table, str(path))
    return table


#: Prefix of a varied quantity's name -> its unit.
VARIED_UNITS = {
    "mass": "kg",
    "inertia": "kg m^2",
    "products": "kg m^2",
    "motors.thrust_max": "N",
    "motors.time_constant": "s",
    "motors.torque_ratio": "m",
    "motors.effectiveness": "-",
    "rate_damping": "1/s",
    "drag": "N s/m",
    "delay": "samples",
    "noise.angle": "rad",
    "noise.rate": "rad/s",
    "wind": "m/s",
    "attitude_deg": "deg",
    "rates_deg_s": "deg/s",
    "amplitude_deg": "deg",
}
