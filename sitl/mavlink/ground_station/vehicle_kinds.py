"""Vehicle types and autopilots, and the profiles that fit them."""

from __future__ import annotations

from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import CRAZYFLIE, GENERIC, Heartbeat

#: MAV_TYPE flown by a multirotor's rate controller; VTOLs in hover included.
MULTIROTORS = frozenset(
    {
        GENERIC,
        mavlink.MAV_TYPE_QUADROTOR,
        mavlink.MAV_TYPE_HEXAROTOR,
        mavlink.MAV_TYPE_OCTOROTOR,
        mavlink.MAV_TYPE_TRICOPTER,
        mavlink.MAV_TYPE_DODECAROTOR,
        mavlink.MAV_TYPE_DECAROTOR,
        mavlink.MAV_TYPE_GENERIC_MULTIROTOR,
        *range(19, 26),  # MAV_TYPE_VTOL_*; the names differ between versions of the dialect
    }
)
#: MAV_AUTOPILOT -> its name, and the profiles that fit; the first is that of its own controller.
AUTOPILOTS: dict[int, tuple[str, tuple[str, ...]]] = {
    mavlink.MAV_AUTOPILOT_GENERIC: ("generic autopilot", ("mimo",)),
    mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: ("ArduPilot", ("ardupilot-stock", "ardupilot-custom")),
    mavlink.MAV_AUTOPILOT_PX4: ("PX4", ("px4-stock", "mimo")),
    CRAZYFLIE: ("Crazyflie firmware", ("mimo",)),
}
#: MAV_AUTOPILOT that can run our module -> a parameter of its own controller, in every version.
STOCK_PARAMETERS = {mavlink.MAV_AUTOPILOT_PX4: "MC_ROLL_P", CRAZYFLIE: "stabilizer.controller"}
#: MAV_TYPE -> the usual name, where MAVLink's differs.
USUAL_NAMES = {
    mavlink.MAV_TYPE_GENERIC: "vehicle",
    mavlink.MAV_TYPE_FIXED_WING: "plane",
    mavlink.MAV_TYPE_GROUND_ROVER: "rover",
    mavlink.MAV_TYPE_SURFACE_BOAT: "boat",
}


def describe(vehicle: Heartbeat) -> str:
    """Type and autopilot, such as ``a quadrotor with PX4``."""
    number = f"MAV_AUTOPILOT {vehicle.autopilot}"
    kind, autopilot = mavlink.enums["MAV_TYPE"].get(vehicle.type), AUTOPILOTS.get(vehicle.autopilot, (number, ()))[0]
    name = USUAL_NAMES.get(vehicle.type) or (kind.name[len("MAV_TYPE_") :] if kind else f"MAV_TYPE {vehicle.type}")
    text = f"{name.lower().replace('_', ' ')} with {autopilot}"
    return f"{'an' if text[0] in 'aeiou' else 'a'} {text}"


def check_kind(vehicle: Heartbeat, profile: str) -> None:
    """Refuse a vehicle that does not fit a profile.

    Parameters
    ----------
    vehicle : Heartbeat
        Its HEARTBEAT.
    profile : str
        Key of `sitl.mavlink.ground_station.profiles.PROFILES`; empty: any vehicle.

    Raises
    ------
    SitlError
        If it does not fit; names the vehicle and the profile that fits.
    """
    if not profile:
        return
    if vehicle.type not in MULTIROTORS:
        raise SitlError(
            f"the vehicle is {describe(vehicle)} (system {vehicle.system}): the gains are for a multirotor, and no "
            "profile fits; nothing was written"
        )
    fitting = AUTOPILOTS.get(vehicle.autopilot, ("", (profile,)))[1]
    if profile not in fitting:
        raise SitlError(
            f"the vehicle is {describe(vehicle)} (system {vehicle.system}), which the profile {profile} does not "
            f"fit; the profile that fits is {' or '.join(fitting)}; nothing was written"
        )


def describe_missing_module(vehicle: Heartbeat) -> str:
    """Message for an autopilot that could run our module, but runs only its stock controllers."""
    fitting = [name for name in AUTOPILOTS[vehicle.autopilot][1] if name != "mimo"]
    other = f"the profile that fits is {' or '.join(fitting)}; " if fitting else ""
    return (
        f"the vehicle is {describe(vehicle)} and its stock controllers, and has none of our parameters; {other}for "
        "mimo, flash the firmware of `mimopilot generate`"
    )
