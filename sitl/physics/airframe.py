"""Airframes: one TOML file each, in which every physical constant is a line that a user can replace."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from mimopilot.common.files import read_text
from mimopilot.common.toml import checked, parse_toml
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.physics.mixer import Allocation, make_allocation, moment_scale
from mimopilot.sitl.physics.rigid_body import GRAVITY, PlantParameters, checked_inertia
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.gains_file import load_gains, set_name

MAX_HOVER = 0.9  # weight over largest thrust; chosen: with less than 10 % to spare no torque can be given
FOLDER = Path(__file__).resolve().parent / "airframes"

Finite = Annotated[float, Field(ge=-1e6, le=1e6)]
Vector = tuple[Finite, Finite, Finite]
Positive = Annotated[float, Field(gt=0, le=1e9, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class _AirframeTable(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Rotor(_AirframeTable):
    """One rotor: position (m, FRD, from the reference point) and direction of rotation seen from above."""

    position: Vector
    direction: Literal["cw", "ccw"]


class MotorConstants(_AirframeTable):
    """Constants of all motors; units as in `sitl.physics.rigid_body.PlantParameters`."""

    thrust_max: Positive
    time_constant: Positive
    thrust_coefficient: Positive
    torque_ratio: Positive


class PointMass(_AirframeTable):
    """An attached load: mass (kg) and position (m, FRD, from the reference point)."""

    mass: Positive
    position: Vector


class Noise(_AirframeTable):
    """Standard deviation of the state estimate: angle (rad) and body rate (rad/s)."""

    angle: NotNegative
    rate: NotNegative


class Frame(_AirframeTable):
    """A frame that bends on roll and pitch, see `sitl.physics.state_estimate.frame_mode`.

    Frequency (Hz), damping ratio, and modal gain relative to the rigid body; negative where the sensors move against
    the rotors.
    """

    frequency_hz: Annotated[float, Field(gt=0, le=500)]
    damping: Annotated[float, Field(gt=0, le=1)]
    gain: Annotated[float, Field(ge=-2, le=2)]


class Airframe(_AirframeTable):
    """A vehicle as described by its TOML file.

    Attributes
    ----------
    name, description : str
    mass : float, kg
        Without the point masses.
    inertia : 3x3, kg m^2
        Tensor about the reference point, which is the centre of gravity without the point masses.
    rate_damping : float, 1/s
        Damping moment is this times the diagonal of the inertia times the rate.
    drag : float, N s/m
    airmode : bool
        See `sitl.physics.mixer`.
    computing_delay : int, samples
        Whole control periods between a measurement and the motor command computed from it.
    gyro_cutoff_hz : float, Hz
        Cutoff of the second-order low-pass filter on the measured rates; 0: no filter.
    gains : str
        Its default gains file, beside the TOML file.
    motors, rotors, noise, point_masses, frame
        See their classes.
    """

    name: Annotated[str, Field(min_length=1, max_length=40)]
    description: Annotated[str, Field(max_length=400)] = ""
    mass: Positive
    inertia: tuple[Vector, Vector, Vector]
    rate_damping: NotNegative
    drag: NotNegative
    airmode: bool
    computing_delay: Annotated[int, Field(ge=0, le=50)]
    gyro_cutoff_hz: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    gains: str
    motors: MotorConstants
    rotors: Annotated[tuple[Rotor, ...], Field(min_length=4, max_length=16)]
    noise: Noise
    point_masses: tuple[PointMass, ...] = ()
    frame: Frame | None = None

    def geometry(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Rotor positions (n, 3), m, from the reference point, and spin (n,)."""
        spin = np.array([1.0 if rotor.direction == "ccw" else -1.0 for rotor in self.rotors])
        return np.array([rotor.position for rotor in self.rotors]), spin

    def moment_scale(self) -> Vector:
        """Torque (N m) that u = 1 stands for on roll, pitch and yaw, with the allocation of this vehicle."""
        rotors, spin = self.geometry()
        roll, pitch, yaw = moment_scale(rotors, spin, self.motors.thrust_max, self.motors.torque_ratio)
        return float(roll), float(pitch), float(yaw)

    def allocation(self) -> Allocation:
        """Mixer of the autopilot host, made from the rotor geometry without the point masses."""
        rotors, spin = self.geometry()
        return make_allocation(rotors, spin, self.motors.thrust_max, self.motors.torque_ratio, self.airmode)

    def plant(self) -> PlantParameters:
        """Physical constants about the true centre of gravity, with the point masses."""
        rotors, spin = self.geometry()
        mass, centre, inertia = combine_masses(self.mass, np.array(self.inertia), self.point_masses)
        return PlantParameters(
            mass=mass,
            inertia=inertia,
            inertia_inverse=np.linalg.inv(inertia).astype(np.float64),
            rotors=np.ascontiguousarray(rotors - centre),
            spin=spin,
            thrust_max=self.motors.thrust_max,
            thrust_coefficient=self.motors.thrust_coefficient,
            torque_ratio=self.motors.torque_ratio,
            motor_time_constant=self.motors.time_constant,
            rate_damping=self.rate_damping * np.diag(np.array(self.inertia)).copy(),
            drag=self.drag,
            wind=np.zeros(3),
            effectiveness=np.ones(len(rotors)),
        )


def combine_masses(
    mass: float, inertia: NDArray[np.float64], added: tuple[PointMass, ...]
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """Combine a body and point masses into one body (parallel-axis theorem).

    Parameters
    ----------
    mass : float, kg
        Of the body, whose centre of gravity is the reference point.
    inertia : (3, 3) array, kg m^2
        Of the body, about the reference point.
    added : tuple of PointMass
        The attached loads.

    Returns
    -------
    mass : float, kg
    centre : (3,) array, m
        New centre of gravity, from the reference point.
    inertia : (3, 3) array, kg m^2
        About the new centre of gravity.
    """
    masses = np.array([mass, *(item.mass for item in added)])
    places = np.array([(0.0, 0.0, 0.0), *(item.position for item in added)])
    centre = masses @ places / masses.sum()
    total = np.array(inertia, dtype=np.float64)
    for m, r in zip(masses, places - centre, strict=True):
        total = total + m * (r @ r * np.eye(3) - np.outer(r, r))
    return float(masses.sum()), centre, total


def _check_flies(airframe: Airframe) -> None:
    """Refuse a vehicle whose thrust is too small for its weight."""
    weight, thrust = airframe.plant().mass * GRAVITY, len(airframe.rotors) * airframe.motors.thrust_max
    if weight > MAX_HOVER * thrust:
        raise SitlError(
            f"mass, motors.thrust_max: a weight of {weight:.4g} N against {thrust:.4g} N of thrust does not fly; "
            f"expected at most {MAX_HOVER:.0%} of the thrust"
        )


@dataclass(frozen=True, eq=False)
class AirframeFile:
    """An airframe with the path and the text of its file."""

    airframe: Airframe
    path: Path
    text: str

    def default_gains(self) -> Gains:
        """Load the gains that the airframe names: a file beside its own, else one that comes with mimopilot."""
        beside, shipped = self.path.parent / self.airframe.gains, FOLDER / self.airframe.gains
        return load_gains(shipped if shipped.is_file() and not beside.is_file() else beside)

    def gain_sets(self, files: Sequence[Path]) -> dict[str, Gains]:
        """Load gains files, keyed by their names without the ending; `default_gains` when there are none.

        Raises
        ------
        SitlError
            When two files have the same name.
        """
        names = [set_name(path) for path in files]
        if len(set(names)) < len(names):
            raise SitlError(f"--gains: two files have the same name ({', '.join(names)}); rename one")
        return dict(zip(names, map(load_gains, files), strict=True)) or {"default": self.default_gains()}


def known_airframes() -> list[str]:
    """Names of the airframes that come with mimopilot."""
    return sorted(path.stem for path in FOLDER.glob("*.toml") if not path.name.endswith(".gains.toml"))


def load_airframe(name_or_path: str) -> AirframeFile:
    """Load an airframe by name, or by the path of a TOML file.

    Raises
    ------
    SitlError
        When the name is unknown (listing the known ones) or the vehicle cannot fly.
    InputFileError
        When the file cannot be read, is not TOML, or an entry is unknown or impossible.
    """
    path = FOLDER / f"{name_or_path}.toml"
    if name_or_path not in known_airframes():
        path = Path(name_or_path)
        if not os.path.lexists(path):
            raise SitlError(
                f"unknown airframe {name_or_path!r}: expected a file or one of {', '.join(known_airframes())}"
            )
    text = read_text(path, "airframe file")
    return AirframeFile(airframe_from_toml(text, str(path)), path, text)


def airframe_from_toml(text: str, where: str) -> Airframe:
    """Parse the text of an airframe file; `where` names it in messages. Raises as `load_airframe`."""
    table = parse_toml(text, where, "airframe", f"give that first, then --gains {where}")
    airframe = checked(Airframe, table, where)
    try:
        checked_inertia(airframe.inertia)
        airframe.allocation()
        _check_flies(airframe)
    except SitlError as error:
        raise SitlError(f"{where}: {error}") from error
    return airframe
