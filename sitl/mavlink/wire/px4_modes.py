"""Flight modes by number, as PX4 numbers them: MAVSDK speaks these to every autopilot that is not ArduPilot."""

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
#: And back; a main mode alone is its plainest mode.
MODES = {numbers: mode for mode, numbers in NUMBERS.items()} | {(4, 0): Mode.HOLD}

#: Mode -> PX4's nav_state, which MIMO_EX_MODE names.
NAV_STATES = {Mode.ALTITUDE: 1, Mode.HOLD: 4, Mode.OFFBOARD: 14, Mode.TAKEOFF: 17, Mode.LAND: 18}
#: Mode of a PX4 in which something may be injected -> its nav_state, and its main and sub mode.
EXCITED_MODES = {"altitude": (1, 2, 0), "position": (2, 3, 0), "hold": (4, 4, 3), "offboard": (14, 6, 0)}


def custom_mode(mode: Mode) -> int:
    """HEARTBEAT.custom_mode."""
    main, sub = NUMBERS[mode]
    return main << 16 | sub << 24


def mode_of(custom: int) -> Mode:
    """The mode of a custom_mode.

    Raises
    ------
    Denied
        When there is no such mode.
    """
    return mode_of_pair(custom >> 16 & 0xFF, custom >> 24 & 0xFF)


def mode_of_pair(main: int, sub: int) -> Mode:
    """The mode of a main and a sub mode; raises as `mode_of`."""
    found = MODES.get((main, sub))
    if found is None:
        known = ", ".join(f"{mode.value} {custom_mode(mode)}" for mode in NUMBERS if mode is not Mode.TAKEOFF)
        raise Denied(f"no mode {main}/{sub}; there are {known}")
    return found


def nav_state(custom: int) -> int:
    """PX4's nav_state of a custom_mode, of the modes in which something may be injected; -1 of all others."""
    pair = custom >> 16 & 0xFF, custom >> 24 & 0xFF
    return next((state for state, *numbers in EXCITED_MODES.values() if tuple(numbers) == pair), -1)
