"""Which vehicle a log is of: what is not a multirotor is named, and a VTOL counts while it hovers."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from mimopilot.tuning.logs.flight_phase import intersection, intervals
from mimopilot.tuning.logs.resample import Interval
from numpy.typing import NDArray

#: MAV_TYPE of MAVLink's common.xml that are no multirotors, and those of VTOLs.
OTHERS = {
    1: "a fixed wing",
    4: "a helicopter",
    5: "an antenna tracker",
    7: "an airship",
    8: "a balloon",
    9: "a rocket",
    10: "a rover",
    11: "a boat",
    12: "a submarine",
    16: "a flapping wing",
    17: "a kite",
    28: "a parafoil",
}
VTOLS = range(19, 26)
#: vehicle_status.vehicle_type since PX4 1.10 (VehicleStatus.msg): 0 is not known, 1 a rotary wing.
PX4_OTHERS = {2: "a fixed wing", 3: "a rover or boat", 4: "an airship"}
ROTARY_WING = 1

#: ArduPilot's firmware, as it introduces itself in MSG or VER -> the vehicle.
_FIRMWARE = re.compile(r"(?:APM:|Ardu|Antenna)?(Copter|Plane|Rover|Boat|Sub|Tracker|Blimp|Heli)\w*[ -]*[Vv]?\d")
ARDUPILOT_OTHERS = {
    "Plane": "a fixed wing",
    "Rover": "a rover",
    "Boat": "a boat",
    "Sub": "a submarine",
    "Tracker": "an antenna tracker",
    "Blimp": "a blimp",
    "Heli": "a helicopter",
}
#: FRAME_CLASS of ArduCopter: helicopter, dual and quad helicopter; and of a rover: boat.
HELICOPTERS, BOAT = (6, 11, 13), 2
#: Modes of ArduPlane (mode.h) in which a QuadPlane flies as a multirotor: QSTABILIZE to QACRO.
HOVER_MODES = range(17, 24)


@dataclass(frozen=True)
class VehicleType:
    """What the log says of its vehicle.

    Attributes
    ----------
    fault : str
        Why it is not a multirotor, and what says so; empty when nothing does.
    hovering : tuple of (begin, end) or None, s
        Of a VTOL: when it flew as a multirotor. None: it is no VTOL.
    """

    fault: str = ""
    hovering: tuple[Interval, ...] | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is to be told when the log can be used."""
        return () if self.hovering is None else ("a VTOL: only the time in which it hovers is used",)

    def airborne(self, airborne: tuple[Interval, ...] | None) -> tuple[Interval, ...] | None:
        """The time in the air (s) as a multirotor, from the time in the air."""
        if self.hovering is None:
            return airborne
        return self.hovering if airborne is None else intersection(airborne, self.hovering)


def px4_vehicle(status: Mapping[str, NDArray[Any]], parameters: Mapping[str, float]) -> VehicleType:
    """The vehicle of a PX4 log.

    Parameters
    ----------
    status : mapping
        Fields of vehicle_status, (N,) arrays; empty when it is not logged.
    parameters : mapping
        Their MAV_TYPE stands in where vehicle_status does not say the type.
    """
    system = _last(status.get("system_type"))
    kinds = status.get("vehicle_type")  # until 1.9 there was is_rotary_wing
    rotary = status.get("is_rotary_wing") if kinds is None else kinds <= ROTARY_WING
    kind = _last(kinds)
    if system is None and rotary is None:
        system = int(parameters.get("MAV_TYPE", 0))
        said = f"parameter MAV_TYPE is {system}"
    else:
        known = {"system_type": system, "vehicle_type": kind, "is_rotary_wing": _last(status.get("is_rotary_wing"))}
        said = f"vehicle_status: {', '.join(f'{name} {value}' for name, value in known.items() if value is not None)}"
    changing = kinds is not None and bool(np.isin(kinds, ROTARY_WING).any() and np.isin(kinds, 2).any())
    if changing or bool(np.any(status.get("is_vtol", 0))) or system in VTOLS:
        if rotary is None:
            return VehicleType(f"a VTOL, and vehicle_status does not say when it hovered ({said})")
        hover = (np.asarray(rotary) != 0) & (status.get("in_transition_mode", np.zeros(len(rotary))) == 0)
        hovering = intervals(status["timestamp"] * 1e-6, hover)
        return VehicleType("" if hovering else f"a VTOL in forward flight throughout ({said})", hovering)
    name = OTHERS.get(system or 0) or PX4_OTHERS.get(kind or 0)
    if name is None and not system and kinds is None and rotary is not None and not np.any(rotary):
        name = "no rotary wing"
    return VehicleType(f"{name} ({said})" if name else "")


def ardupilot_vehicle(
    texts: Sequence[str],
    parameters: Mapping[str, float],
    modes: tuple[NDArray[np.float64], NDArray[Any]] | None,
) -> VehicleType:
    """The vehicle of an ArduPilot log.

    Parameters
    ----------
    texts : sequence of str
        Of its messages MSG and VER.
    parameters : mapping
        By name: FRAME_CLASS, Q_ENABLE.
    modes : tuple of (N,) arrays (time s, number) or None
        The flight modes that were entered.
    """
    found = next(((m[1], text) for text in texts if (m := _FIRMWARE.match(text))), None)
    firmware, said = found or ("", "")
    frame = int(parameters.get("FRAME_CLASS", 0))
    if firmware == "Plane" and parameters.get("Q_ENABLE", 0) > 0:
        hovering = intervals(modes[0], np.isin(modes[1], list(HOVER_MODES))) if modes is not None else ()
        return VehicleType("" if hovering else f"a VTOL that never hovered ({said}, no Q mode)", hovering)
    if firmware == "Rover" and frame == BOAT:
        return VehicleType(f"a boat ({said}, FRAME_CLASS {frame})")
    if firmware in ARDUPILOT_OTHERS:
        return VehicleType(f"{ARDUPILOT_OTHERS[firmware]} ({said})")
    if frame in HELICOPTERS or any(text.startswith("Frame: HELI") for text in texts):
        return VehicleType(f"a helicopter ({said}, FRAME_CLASS {frame})")
    return VehicleType()


def _last(values: NDArray[Any] | None) -> int | None:
    return None if values is None or not len(values) else int(values[-1])
