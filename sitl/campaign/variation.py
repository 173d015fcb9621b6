"""What varies from run to run: distributions of the vehicle, its sensors, the weather, the start and the faults.

A specification is TOML. Each entry is a distribution, ``{ uniform = [low, high] }``, ``{ normal = [mean, deviation] }``
or ``{ loguniform = [low, high] }``, in SI units; with ``relative = true`` it is a factor on the airframe's own value.
Whole numbers of samples are rounded, so that ``delay = { uniform = [0.5, 3.5] }`` draws 1, 2 and 3 alike.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from sitl.airframe import MAX_HOVER, Airframe, Vector
from sitl.errors import SitlError
from sitl.faults import Fault, complaint, make_fault
from sitl.injection import check_fault
from sitl.plant import GRAVITY, PlantParameters, checked_inertia, hover_state
from sitl.recorder import quaternions
from sitl.scenario import MAX_ANGLE, Scenario

ATTEMPTS = 1000  # draws for one run before the specification is refused
MAX_DELAY = 100  # samples
DRAWN = ("at", "duration", "size", "motor")  # of a fault
Finite = Annotated[float, Field(allow_inf_nan=False)]
Pair = tuple[Finite, Finite]


class ImpossibleError(Exception):
    """A draw that no vehicle has, or that cannot hover: another is drawn."""


class Distribution(BaseModel):
    """One quantity: exactly one of the three kinds."""

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
            raise ValueError("normal: expected [mean, deviation], the deviation not negative")
        if kinds != ["normal"] and not first <= second:
            raise ValueError(f"{kinds[0]}: expected [low, high] in this order")
        if kinds == ["loguniform"] and first <= 0:
            raise ValueError("loguniform: expected bounds above 0")
        return self

    def draw(self, generator: np.random.Generator, own: float = 0.0) -> float:
        """A number; `own` is the airframe's value, for relative ones."""
        if self.normal is not None:
            value = generator.normal(*self.normal)
        elif self.uniform is not None:
            value = generator.uniform(*self.uniform)
        else:
            assert self.loguniform is not None
            low, high = self.loguniform
            value = math.exp(generator.uniform(math.log(low), math.log(high)))
        return float(value * own if self.relative else value)


Number = Finite | Distribution


def _absolute(value: Distribution) -> Distribution:
    if value.relative:
        raise ValueError("the airframe has no value of its own that this could be relative to")
    return value


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    def entries(self) -> Iterator[tuple[str, Distribution]]:
        """Names and distributions of what varies."""
        return ((name, value) for name in type(self).model_fields if (value := getattr(self, name)) is not None)


class InertiaVariation(_Table):
    """Moments of inertia, kg m^2: each axis is scaled, the share of coupling (product over their root) stays."""

    xx: Distribution | None = None
    yy: Distribution | None = None
    zz: Distribution | None = None


class ProductVariation(_Table):
    """Off-diagonal elements of the tensor, kg m^2 (minus the products of inertia), in place of the airframe's."""

    xy: Distribution | None = None
    xz: Distribution | None = None
    yz: Distribution | None = None


class MotorVariation(_Table):
    """Constants of all motors, as in the airframe's file; `effectiveness` (share of thrust) is drawn for each motor."""

    thrust_max: Distribution | None = None
    time_constant: Distribution | None = None
    torque_ratio: Distribution | None = None
    effectiveness: Distribution | None = None


class NoiseVariation(_Table):
    """Standard deviation of the state estimate: angle (rad), rate (rad/s)."""

    angle: Distribution | None = None
    rate: Distribution | None = None


class _AbsoluteTable(_Table):
    @model_validator(mode="after")
    def _is_absolute(self) -> Any:
        for _, value in self.entries():
            _absolute(value)
        return self


class WindVariation(_AbsoluteTable):
    """Constant wind, m/s: velocity of the air."""

    north: Distribution | None = None
    east: Distribution | None = None
    down: Distribution | None = None


class AngleVariation(_AbsoluteTable):
    """Three angles or body rates at the start."""

    roll: Distribution | None = None
    pitch: Distribution | None = None
    yaw: Distribution | None = None


class FaultVariation(_Table):
    """A fault, see `sitl.faults.Fault`, whose numbers may be distributions; a drawn motor is a whole number."""

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
        for name in DRAWN:
            if isinstance(value := getattr(self, name), Distribution):
                _absolute(value)
        return self


class Variation(_Table):
    """A specification; what is not named stays as the airframe has it.

    Attributes
    ----------
    mass : kg
        Of the whole vehicle.
    inertia, products, motors, noise, wind
        See their classes.
    attitude_deg, rates_deg_s : degrees, deg/s
        At the start.
    rate_damping : 1/s
    drag : N s/m
    delay : samples
        Whole control periods between a measurement and the motor command made from it.
    amplitude_deg : degrees
        Largest angle of the set-points.
    fault
        What goes wrong, beside the faults of the scenario.
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


def variation_from_toml(text: str, where: str) -> Variation:
    """Parse a specification; `where` names it in messages.

    Raises
    ------
    SitlError
        When it is not TOML, or an entry is unknown or impossible.
    """
    try:
        return Variation.model_validate(tomllib.loads(text))
    except tomllib.TOMLDecodeError as error:
        raise SitlError(f"{where}: not a TOML file: {error}") from error
    except ValidationError as error:
        raise SitlError(f"{where}: {complaint(error)}") from error


@dataclass(frozen=True, eq=False)
class Draw:
    """What one run flies.

    Attributes
    ----------
    run : int
    values : dict
        Column -> what was drawn, in the specification's unit.
    plant : PlantParameters
    state : (13 + n,) array
        At the start, see `sitl.plant`.
    delay : int, samples
    angle_deviation, rate_deviation : float, rad, rad/s
        Of the noise.
    factor : float
        On the set-points.
    faults : tuple of Fault
        Of the scenario and those drawn.
    rejected : int
        Impossible draws before this one.
    """

    run: int
    values: dict[str, float]
    plant: PlantParameters
    state: NDArray[np.float64]
    delay: int
    angle_deviation: float
    rate_deviation: float
    factor: float
    faults: tuple[Fault, ...]
    rejected: int


class Variator:
    """Draws runs of one airframe; run k depends on the seed and k alone.

    Parameters
    ----------
    airframe : Airframe
        What is varied.
    variation : Variation
        How.
    scenario : Scenario
        What is flown; its axis does not matter.

    Raises
    ------
    SitlError
        When the amplitude is to vary and there is none, or a fault of the scenario is not possible.
    """

    def __init__(self, airframe: Airframe, variation: Variation, scenario: Scenario) -> None:
        self.airframe, self.variation, self.scenario = airframe, variation, scenario
        self.amplitude = float(np.abs(scenario.setpoint).max())
        self.seconds = len(scenario.setpoint) * scenario.Ts
        if variation.amplitude_deg is not None and self.amplitude == 0:
            raise SitlError("amplitude_deg: this scenario has no angle that could vary")
        for fault in scenario.faults:
            check_fault(fault, airframe, scenario.Ts, self.seconds)
        self.base = airframe.plant()

    def draw(self, seed: int, run: int) -> Draw:
        """The vehicle of a run: the first possible one of a stream of draws.

        Raises
        ------
        SitlError
            When a thousand in a row are impossible: with the reason.
        """
        generator = np.random.default_rng([seed, run, 0])
        for attempt in range(ATTEMPTS):
            try:
                return self._draw(generator, run, attempt)
            except ImpossibleError as reason:
                last = reason
        raise SitlError(f"run {run}: {ATTEMPTS} draws in a row are of no vehicle that flies, the last because {last}")

    def _draw(self, generator: np.random.Generator, run: int, attempt: int) -> Draw:
        values: dict[str, float] = {}

        def drawn(name: str, distribution: Distribution | None, own: float = 0.0) -> float:
            if distribution is None:
                return own
            values[name] = distribution.draw(generator, own)
            return values[name]

        v, base, motors = self.variation, self.base, self.variation.motors
        mass = drawn("mass", v.mass, base.mass)
        inertia = self._inertia(drawn)
        n, own_damping = len(base.rotors), self.airframe.rate_damping
        effectiveness = np.array([drawn(f"motors.effectiveness.{i + 1}", motors.effectiveness, 1.0) for i in range(n)])
        plant = base._replace(
            mass=mass,
            inertia=inertia,
            inertia_inverse=np.linalg.inv(inertia).astype(np.float64),
            thrust_max=drawn("motors.thrust_max", motors.thrust_max, base.thrust_max),
            torque_ratio=drawn("motors.torque_ratio", motors.torque_ratio, base.torque_ratio),
            motor_time_constant=drawn("motors.time_constant", motors.time_constant, base.motor_time_constant),
            rate_damping=drawn("rate_damping", v.rate_damping, own_damping) * np.diag(np.array(self.airframe.inertia)),
            drag=drawn("drag", v.drag, base.drag),
            wind=np.array([drawn(f"wind.{name}", getattr(v.wind, name)) for name in ("north", "east", "down")]),
            effectiveness=effectiveness,
        )
        _check_flies(plant)
        delay = round(drawn("delay", v.delay, self.airframe.computing_delay))
        if not 0 <= delay <= MAX_DELAY:
            raise ImpossibleError(f"the delay is {delay} samples, expected 0 to {MAX_DELAY}")
        if v.delay is not None:
            values["delay"] = float(delay)
        noise = self.airframe.noise
        deviations = drawn("noise.angle", v.noise.angle, noise.angle), drawn("noise.rate", v.noise.rate, noise.rate)
        if min(deviations) < 0:
            raise ImpossibleError("a standard deviation of the noise is negative")
        state = hover_state(plant)
        names = ("roll", "pitch", "yaw")
        angles = [drawn(f"attitude_deg.{name}", getattr(v.attitude_deg, name)) for name in names]
        rates = [drawn(f"rates_deg_s.{name}", getattr(v.rates_deg_s, name)) for name in names]
        if any(angles):
            quaternion = quaternions(np.radians([angles]))[0].astype(np.float64)
            state[6:10] = quaternion / np.linalg.norm(quaternion)
        state[10:13] = np.radians(rates)
        amplitude = math.degrees(self.amplitude)
        factor = drawn("amplitude_deg", v.amplitude_deg, amplitude) / amplitude if v.amplitude_deg is not None else 1.0
        if not 0 <= factor * self.amplitude <= MAX_ANGLE:
            raise ImpossibleError(f"the amplitude is {factor * amplitude:.4g} degrees, expected 0 to 60")
        faults = tuple(self._fault(f"fault.{i + 1}", fault, drawn) for i, fault in enumerate(v.fault))
        return Draw(run, values, plant, state, delay, *deviations, factor, (*self.scenario.faults, *faults), attempt)

    def _fault(self, name: str, fault: FaultVariation, drawn: Any) -> Fault:
        table = fault.model_dump(exclude_none=True)
        for field in DRAWN:
            if isinstance(value := getattr(fault, field), Distribution):
                table[field] = drawn(f"{name}.{field}", value)
        if "motor" in table:
            table["motor"] = round(table["motor"])
        try:
            made = make_fault(table, name)
            check_fault(made, self.airframe, self.scenario.Ts, self.seconds)
        except SitlError as error:
            raise ImpossibleError(str(error)) from error
        return made

    def _inertia(self, drawn: Any) -> NDArray[np.float64]:
        v, own = self.variation, self.base.inertia
        scaled = {name for name, _ in v.inertia.entries()}
        inertia = own.copy()
        if scaled:
            diagonal = np.array(
                [drawn(f"inertia.{a}{a}", getattr(v.inertia, a + a), own[i, i]) for i, a in enumerate("xyz")]
            )
            if diagonal.min() <= 0:
                raise ImpossibleError("a moment of inertia is not positive")
            root = np.sqrt(diagonal / np.diag(own))
            inertia = own * np.outer(root, root)
        for name, _ in v.products.entries():
            i, j = "xyz".index(name[0]), "xyz".index(name[1])
            inertia[i, j] = inertia[j, i] = drawn(f"products.{name}", getattr(v.products, name), own[i, j])
        if scaled or any(True for _ in v.products.entries()):
            try:
                checked_inertia(inertia)
            except SitlError as error:
                raise ImpossibleError(str(error)) from error
        return inertia


def _check_flies(plant: PlantParameters) -> None:
    for name in ("mass", "thrust_max", "torque_ratio", "motor_time_constant"):
        if getattr(plant, name) <= 0:
            raise ImpossibleError(f"{name} is not positive")
    if plant.drag < 0 or plant.rate_damping.min() < 0:
        raise ImpossibleError("drag or rate damping is negative")
    if plant.effectiveness.min() < 0:
        raise ImpossibleError("a motor's effectiveness is negative")
    thrust = plant.thrust_max * float(plant.effectiveness.sum())
    if plant.mass * GRAVITY > MAX_HOVER * thrust:
        raise ImpossibleError(f"a weight of {plant.mass * GRAVITY:.4g} N against {thrust:.4g} N of thrust cannot hover")
