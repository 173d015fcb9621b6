"""PX4's flight mode numbers (px4_custom_mode.h): MAVSDK uses them for every autopilot but ArduPilot."""

from __future__ import annotations

from mimopilot.sitl.autopilot.flight_modes import Denied, Mode

#: Mode -> main and sub mode.
NUMBERS = {
    Mode.ALTITUDE: (2, 0),
    Mode.TAKEOFF: (4, 2),
    Mode.HOLD: (4, 3),
    Mode.LAND: (4, 6),
    Mode.OFFBOARD: (6, 0),
}
#: The inverse; main mode AUTO without a sub mode is HOLD.
MODES = {numbers: mode for mode, numbers in NUMBERS.items()} | {(4, 0): Mode.HOLD}

#: Mode -> PX4's nav_state (vehicle_status.msg), the value of MIMO_EX_MODE.
NAV_STATES = {Mode.ALTITUDE: 1, Mode.HOLD: 4, Mode.OFFBOARD: 14, Mode.TAKEOFF: 17, Mode.LAND: 18}
#: PX4 mode in which excitation is allowed -> its nav_state, main mode and sub mode.
EXCITED_MODES = {"altitude": (1, 2, 0), "position": (2, 3, 0), "hold": (4, 4, 3), "offboard": (14, 6, 0)}


def custom_mode(mode: Mode) -> int:
    """HEARTBEAT.custom_mode."""
    main, sub = NUMBERS[mode]
    return main << 16 | sub << 24


def mode_of(custom: int) -> Mode:
    """Mode of a custom_mode.

    Raises
    ------
    Denied
        When there is no such mode.
    """
    return mode_of_pair(custom >> 16 & 0xFF, custom >> 24 & 0xFF)


def mode_of_pair(main: int, sub: int) -> Mode:
    """Mode of a main and a sub mode; raises as `mode_of`."""
    found = MODES.get((main, sub))
    if found is None:
        known = ", ".join(f"{mode.value} {custom_mode(mode)}" for mode in NUMBERS if mode is not Mode.TAKEOFF)
        raise Denied(f"no mode {main}/{sub}; use one of {known}")
    return found


def nav_state(custom: int) -> int:
    """PX4's nav_state of a custom_mode in which excitation is allowed; -1 for any other."""
    pair = custom >> 16 & 0xFF, custom >> 24 & 0xFF
    return next((state for state, *numbers in EXCITED_MODES.values() if tuple(numbers) == pair), -1)
