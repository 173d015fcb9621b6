"""The vehicle type of a log. Only multirotors can be tuned, and VTOLs while they hover."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.logs.flight_phase import intersection, intervals
from mimopilot.tuning.logs.resample import Interval

#: MAV_TYPE (MAVLink, common.xml) of vehicles that are not multirotors.
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
VTOLS = range(19, 26)  # MAV_TYPE of VTOLs
#: vehicle_status.vehicle_type since PX4 1.10 (VehicleStatus.msg); 0 is unknown, 1 a rotary wing.
PX4_OTHERS = {2: "a fixed wing", 3: "a rover or boat", 4: "an airship"}
ROTARY_WING = 1

#: Name of ArduPilot's firmware in message MSG or VER.
_FIRMWARE = re.compile(r"(?:APM:|Ardu|Antenna)?(Copter|Plane|Rover|Boat|Sub|Tracker|Blimp|Heli)\w*[ -]*[Vv]?\d")
#: Firmware -> vehicle.
ARDUPILOT_OTHERS = {
    "Plane": "a fixed wing",
    "Rover": "a rover",
    "Boat": "a boat",
    "Sub": "a submarine",
    "Tracker": "an antenna tracker",
    "Blimp": "a blimp",
    "Heli": "a helicopter",
}
#: FRAME_CLASS of ArduCopter: helicopter, dual helicopter, quad helicopter; of Rover: boat.
HELICOPTERS, BOAT = (6, 11, 13), 2
#: ArduPlane modes (mode.h) in which a QuadPlane flies as a multirotor: QSTABILIZE to QACRO.
HOVER_MODES = range(17, 24)


@dataclass(frozen=True)
class VehicleType:
    """Whether the vehicle of a log can be tuned.

    Attributes
    ----------
    fault : str
        Why it is not a multirotor, with the evidence; empty when it may be one.
    hovering : tuple of (begin, end) or None, s
        When a VTOL flew as a multirotor. None: not a VTOL.
    """

    fault: str = ""
    hovering: tuple[Interval, ...] | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings for a log that can be used."""
        return () if self.hovering is None else ("a VTOL: only the time in hover is used",)

    def airborne(self, airborne: tuple[Interval, ...] | None) -> tuple[Interval, ...] | None:
        """Time in flight as a multirotor (s), from the time in flight."""
        if self.hovering is None:
            return airborne
        return self.hovering if airborne is None else intersection(airborne, self.hovering)


def px4_vehicle(status: Mapping[str, NDArray[Any]], parameters: Mapping[str, float]) -> VehicleType:
    """The vehicle of a PX4 log.

    Parameters
    ----------
    status : mapping
        Field of vehicle_status -> (N,) array; empty when not logged.
    parameters : mapping
        By name. MAV_TYPE is used if vehicle_status has no type.
    """
    system = _last(status.get("system_type"))
    kinds = status.get("vehicle_type")  # until 1.9 there was is_rotary_wing
    rotary = status.get("is_rotary_wing") if kinds is None else kinds <= ROTARY_WING
    kind = _last(kinds)
    if system is None and rotary is None:
        system = int(parameters.get("MAV_TYPE", 0))
        evidence = f"parameter MAV_TYPE is {system}"
    else:
        known = {"system_type": system, "vehicle_type": kind, "is_rotary_wing": _last(status.get("is_rotary_wing"))}
        evidence = (
            f"vehicle_status: {', '.join(f'{name} {value}' for name, value in known.items() if value is not None)}"
        )
    changing = kinds is not None and bool(np.isin(kinds, ROTARY_WING).any() and np.isin(kinds, 2).any())
    if changing or bool(np.any(status.get("is_vtol", 0))) or system in VTOLS:
        if rotary is None:
            return VehicleType(f"a VTOL, and vehicle_status does not tell when it hovered ({evidence})")
        hover = (np.asarray(rotary) != 0) & (status.get("in_transition_mode", np.zeros(len(rotary))) == 0)
        hovering = intervals(status["timestamp"] * 1e-6, hover)
        return VehicleType("" if hovering else f"a VTOL in forward flight throughout ({evidence})", hovering)
    name = OTHERS.get(system or 0) or PX4_OTHERS.get(kind or 0)
    if name is None and not system and kinds is None and rotary is not None and not np.any(rotary):
        name = "no rotary wing"
    return VehicleType(f"{name} ({evidence})" if name else "")


def ardupilot_vehicle(
    texts: Sequence[str],
    parameters: Mapping[str, float],
    modes: tuple[NDArray[np.float64], NDArray[Any]] | None,
) -> VehicleType:
    """The vehicle of an ArduPilot log.

    Parameters
    ----------
    texts : sequence of str
        Texts of messages MSG and VER.
    parameters : mapping
        By name: FRAME_CLASS, Q_ENABLE.
    modes : tuple of (N,) arrays (time s, number) or None
        Flight modes, at the time each was entered.
    """
    found = next(((m[1], text) for text in texts if (m := _FIRMWARE.match(text))), None)
    firmware, evidence = found or ("", "")
    frame = int(parameters.get("FRAME_CLASS", 0))
    if firmware == "Plane" and parameters.get("Q_ENABLE", 0) > 0:
        hovering = intervals(modes[0], np.isin(modes[1], list(HOVER_MODES))) if modes is not None else ()
        return VehicleType("" if hovering else f"a VTOL that never hovered ({evidence}, no Q mode)", hovering)
    if firmware == "Rover" and frame == BOAT:
        return VehicleType(f"a boat ({evidence}, FRAME_CLASS {frame})")
    if firmware in ARDUPILOT_OTHERS:
        return VehicleType(f"{ARDUPILOT_OTHERS[firmware]} ({evidence})")
    if frame in HELICOPTERS or any(text.startswith("Frame: HELI") for text in texts):
        return VehicleType(f"a helicopter ({evidence}, FRAME_CLASS {frame})")
    return VehicleType()


def _last(values: NDArray[Any] | None) -> int | None:
    return None if values is None or not len(values) else int(values[-1])
