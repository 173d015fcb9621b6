"""Random draw of the vehicle of each run: reproducible, and only physically possible vehicles."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mimopilot.sitl.autopilot.failure_detector import MAX_TILT
from mimopilot.sitl.campaign.variation import Distribution, FaultVariation, Variation
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.faults.inject_plant import check_fault
from mimopilot.sitl.faults.kinds import Fault, make_fault
from mimopilot.sitl.flight.flight_log import quaternions
from mimopilot.sitl.flight.scenario import Scenario
from mimopilot.sitl.physics.airframe import MAX_HOVER, Airframe
from mimopilot.sitl.physics.rigid_body import GRAVITY, PlantParameters, hover_state, is_physical_inertia

ATTEMPTS = 1000  # impossible draws for one run before the specification is refused
MAX_DELAY = 100  # samples: 0.4 s at 250 Hz, beyond any flyable delay
AXES = ("roll", "pitch", "yaw")
MOMENTS, PRODUCTS, WIND = ("xx", "yy", "zz"), ("xy", "xz", "yz"), ("north", "east", "down")
#: Drawn quantity -> field of `PlantParameters`.
PLANT = {
    "mass": "mass",
    "motors.thrust_max": "thrust_max",
    "motors.time_constant": "motor_time_constant",
    "motors.torque_ratio": "torque_ratio",
    "drag": "drag",
}


class ImpossibleDrawError(Exception):
    """A draw that no vehicle can have, or that cannot hover; it is repeated."""


class VariedQuantity(NamedTuple):
    """One drawn number: column, distribution, the airframe's own value, and whether it is rounded to an integer."""

    name: str
    distribution: Distribution
    own: float
    whole: bool


@dataclass(frozen=True, eq=False)
class Draw:
    """The vehicle and the conditions of one run.

    Attributes
    ----------
    run : int
    values : dict
        Column -> drawn value, in the unit of the specification.
    plant : PlantParameters
    state : (13 + n,) array
        Initial state, see `sitl.physics.rigid_body`.
    delay : int, samples
        From measurement to motor command.
    angle_deviation, rate_deviation : float, rad, rad/s
        Standard deviations of the state estimate.
    factor : float
        On the setpoints.
    faults : tuple of Fault
        Those of the scenario and the drawn ones.
    rejected : int
        Number of impossible draws before this one.
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


class RunSampler:
    """Draws the runs of one airframe; run k depends only on the seed and k.

    Parameters
    ----------
    airframe : Airframe
        The nominal vehicle.
    variation : Variation
        The distributions.
    scenario : Scenario
        The flight; its axis does not matter.

    Raises
    ------
    SitlError
        When the amplitude varies but the scenario has none, or a fault of the scenario is impossible.
    """

    def __init__(self, airframe: Airframe, variation: Variation, scenario: Scenario) -> None:
        self.airframe, self.variation, self.scenario = airframe, variation, scenario
        self.base = airframe.plant()
        self.amplitude_deg = math.degrees(float(np.abs(scenario.setpoint).max()))
        self.seconds = len(scenario.setpoint) * scenario.Ts
        self.quantities = list(self._quantities())
        if variation.amplitude_deg is not None and self.amplitude_deg == 0:
            raise SitlError("amplitude_deg: this scenario has no amplitude; remove the entry, or fly a doublet or step")
        for fault in scenario.faults:
            check_fault(fault, airframe, scenario.Ts, self.seconds)

    def draw(self, seed: int, run: int) -> Draw:
        """Draw the vehicle of a run: the first possible one of a stream of draws.

        Raises
        ------
        SitlError
            When `ATTEMPTS` draws in a row are impossible; gives the last reason.
        """
        generator = np.random.default_rng([seed, run, 0])
        for attempt in range(ATTEMPTS):
            values = {}
            for name, distribution, own, whole in self.quantities:
                value = distribution.draw(generator, own)
                values[name] = float(round(value)) if whole else value
            try:
                return self._run_of(run, values, attempt)
            except ImpossibleDrawError as reason:
                last = reason
        raise SitlError(
            f"run {run}: {ATTEMPTS} draws in a row are impossible, the last because {last}; narrow the distributions"
        )

    def _quantities(self) -> Iterator[VariedQuantity]:
        """All varied quantities, in the order in which they are drawn."""
        v, base, noise = self.variation, self.base, self.airframe.noise
        inertia = {name: float(base.inertia[_indices(name)]) for name in (*MOMENTS, *PRODUCTS)}
        motors = (base.thrust_max, base.motor_time_constant, base.torque_ratio)
        own = {
            "mass": base.mass,
            **{f"inertia.{name}": inertia[name] for name in MOMENTS},
            **{f"products.{name}": inertia[name] for name in PRODUCTS},
            **dict(zip(("motors.thrust_max", "motors.time_constant", "motors.torque_ratio"), motors, strict=True)),
            "rate_damping": self.airframe.rate_damping,
            "drag": base.drag,
            "delay": self.airframe.computing_delay,
            "noise.angle": noise.angle,
            "noise.rate": noise.rate,
            "amplitude_deg": self.amplitude_deg,
        }
        tables = ("inertia", "products", "motors", "noise", "wind", "attitude_deg", "rates_deg_s")
        named = [*v.entries(), *((f"{t}.{name}", d) for t in tables for name, d in getattr(v, t).entries())]
        named += [(f"fault.{i + 1}.{name}", d) for i, fault in enumerate(v.fault) for name, d in fault.entries()]
        for name, distribution in named:
            if name == "motors.effectiveness":
                for i in range(len(base.rotors)):
                    yield VariedQuantity(f"{name}.{i + 1}", distribution, 1.0, False)
            else:
                yield VariedQuantity(name, distribution, own.get(name, 0.0), name == "delay" or name.endswith(".motor"))

    def _run_of(self, run: int, values: dict[str, float], attempt: int) -> Draw:
        """The run with the drawn values; refuses an impossible vehicle."""
        plant = self._plant(values)
        delay = int(values.get("delay", self.airframe.computing_delay))
        if not 0 <= delay <= MAX_DELAY:
            raise ImpossibleDrawError(f"the delay is {delay} samples, expected 0 to {MAX_DELAY}")
        angle = values.get("noise.angle", self.airframe.noise.angle)
        rate = values.get("noise.rate", self.airframe.noise.rate)
        if angle < 0 or rate < 0:
            raise ImpossibleDrawError("a standard deviation of the noise is negative")
        factor = 1.0
        if "amplitude_deg" in values:
            amplitude = values["amplitude_deg"]
            if not 0 <= amplitude <= math.degrees(MAX_TILT):
                raise ImpossibleDrawError(f"the amplitude is {amplitude:.4g} degrees, expected 0 to 60")
            factor = amplitude / self.amplitude_deg
        drawn = (self._fault(i, fault, values) for i, fault in enumerate(self.variation.fault))
        faults = (*self.scenario.faults, *drawn)
        return Draw(
            run=run,
            values=values,
            plant=plant,
            state=_initial_state(plant, values),
            delay=delay,
            angle_deviation=angle,
            rate_deviation=rate,
            factor=factor,
            faults=faults,
            rejected=attempt,
        )

    def _plant(self, values: dict[str, float]) -> PlantParameters:
        changes: dict[str, Any] = {field: values[name] for name, field in PLANT.items() if name in values}
        for field, value in changes.items():
            if value < 0 or (value == 0 and field != "drag"):
                raise ImpossibleDrawError(f"{field} is {value:.4g}")
        if "rate_damping" in values:
            if values["rate_damping"] < 0:
                raise ImpossibleDrawError("the rate damping is negative")
            changes["rate_damping"] = values["rate_damping"] * np.diag(np.array(self.airframe.inertia))
        inertia = self._inertia(values)
        if inertia is not None:
            changes |= {"inertia": inertia, "inertia_inverse": np.linalg.inv(inertia)}
        effectiveness = [values.get(f"motors.effectiveness.{i + 1}", 1.0) for i in range(len(self.base.rotors))]
        wind = [values.get(f"wind.{name}", 0.0) for name in WIND]
        plant = self.base._replace(effectiveness=np.array(effectiveness), wind=np.array(wind), **changes)
        weight, thrust = plant.mass * GRAVITY, plant.thrust_max * sum(effectiveness)
        if min(effectiveness) < 0 or weight > MAX_HOVER * thrust:
            raise ImpossibleDrawError(f"a weight of {weight:.4g} N against {thrust:.4g} N of thrust cannot hover")
        return plant

    def _inertia(self, values: dict[str, float]) -> NDArray[np.float64] | None:
        """The drawn inertia tensor, kg m^2, (3, 3); None when it does not vary."""
        own = self.base.inertia
        moments = [values.get(f"inertia.{name}") for name in MOMENTS]
        products = {name: values[f"products.{name}"] for name in PRODUCTS if f"products.{name}" in values}
        if not products and moments == [None, None, None]:
            return None
        ratio = np.array([1.0 if m is None else m / own[i, i] for i, m in enumerate(moments)])
        if ratio.min() <= 0:
            raise ImpossibleDrawError("a moment of inertia is not positive")
        inertia: NDArray[np.float64] = own * np.sqrt(ratio[:, None] * ratio)
        for name, value in products.items():
            i, j = _indices(name)
            inertia[i, j] = inertia[j, i] = value
        if not is_physical_inertia(inertia):
            raise ImpossibleDrawError(f"no body has the inertia {inertia.tolist()} kg m^2")
        return inertia

    def _fault(self, i: int, fault: FaultVariation, values: dict[str, float]) -> Fault:
        name = f"fault.{i + 1}"
        table = fault.model_dump(exclude_none=True)
        table |= {field: values[f"{name}.{field}"] for field, _ in fault.entries()}
        if "motor" in table:
            table["motor"] = int(table["motor"])
        try:
            made = make_fault(table, name)
            check_fault(made, self.airframe, self.scenario.Ts, self.seconds)
        except SitlError as error:
            raise ImpossibleDrawError(str(error)) from error
        return made


def _indices(name: str) -> tuple[int, int]:
    """Row and column of a tensor element such as "xy"."""
    return "xyz".index(name[0]), "xyz".index(name[1])


def _initial_state(plant: PlantParameters, values: dict[str, float]) -> NDArray[np.float64]:
    """Initial state: hover with the drawn attitude and rates."""
    state = hover_state(plant)
    angles, rates = ([values.get(f"{table}.{axis}", 0.0) for axis in AXES] for table in ("attitude_deg", "rates_deg_s"))
    if any(angles):
        quaternion = quaternions(np.radians([angles]))[0].astype(np.float64)
        state[6:10] = quaternion / np.linalg.norm(quaternion)
    state[10:13] = np.radians(rates)
    return state
