"""The excitation experiment on a flying vehicle: sets, starts, monitors and stops its injector, restores the settings.

The vehicle stops by itself if it tilts too far, leaves its mode, or a stick moves. The ground station monitors tilt,
mode and link, and stops it too. See `sitl.mavlink.ground_station.events` for how an exchange is run.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from mimopilot.sitl.autopilot.excitation_injector import AXIS, PAUSE_S, PHASES
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import Exchange
from mimopilot.sitl.mavlink.ground_station.experiments.experiment_profile import ExperimentResult
from mimopilot.sitl.mavlink.ground_station.experiments.hover_checks import (
    FLIGHT_STREAMS,
    HOVER_TILT,
    not_hovering,
    stop_reason,
)
from mimopilot.sitl.mavlink.ground_station.flight_monitor import (
    POLL_S,
    FlightMonitor,
    request_streams,
)
from mimopilot.sitl.mavlink.ground_station.parameter_protocol import ParameterClient
from mimopilot.sitl.mavlink.ground_station.upload import read_values, write_and_verify
from mimopilot.sitl.mavlink.wire.px4_modes import nav_state
from mimopilot.tuning.parameters import EXCITATION

#: Message -> (number, interval in us) that the vehicle is requested to stream.
STREAMS = {"ATTITUDE": FLIGHT_STREAMS["ATTITUDE"], "DEBUG_VECT": (250, 100_000), **FLIGHT_STREAMS}
# Times and limits are chosen, unless a source is given.
PARAMETER_UPDATE_S = 1.5  # PX4 applies changed parameters once a second
START_TIMEOUT_S = 5.0  # from the write to the first pulse
END_MARGIN_S = 10.0  # after the planned end
COMPLETE_SHARE, CLOCK_MARGIN_S = 0.95, 0.5  # share of the planned time, less a margin, that counts as complete
#: Names of the injector's parameters, and of those that are INT32 on PX4.
NAMES = tuple(setting.name for setting in EXCITATION)
INTEGERS = frozenset(setting.name for setting in EXCITATION if setting.integer)


def check_settings(values: Mapping[str, float]) -> None:
    """Refuse settings out of the range of the vehicle's injector.

    Raises
    ------
    SitlError
        Naming the first one.
    """
    for setting in EXCITATION:
        value = values.get(setting.name, setting.default)
        if not setting.minimum <= value <= setting.maximum:
            expected = f"{setting.minimum:g} to {setting.maximum:g} {setting.unit}".rstrip()
            raise SitlError(f"{setting.name}: got {value:g}, expected {expected} ({setting.description})")


def start_monitor(client: ParameterClient, mode: int) -> Exchange[FlightMonitor]:
    """Request the vehicle's streams; check that it hovers in a mode (nav_state) under our controller.

    Raises
    ------
    SitlError
        If it does not.
    """
    assert client.vehicle is not None
    monitor = yield from request_streams(client, STREAMS)
    missing = monitor.overdue()
    reason = not_hovering(client, monitor)
    if "DEBUG_VECT" in missing and len(missing) == 1 and not client.interrupted:
        reason = "the vehicle does not send its injector's state (DEBUG_VECT MIMO_EXC): our controller does not fly it"
    elif reason:
        pass
    elif nav_state(client.vehicle.mode) != mode:
        reason = f"the vehicle is in another mode (nav_state {nav_state(client.vehicle.mode)}, MIMO_EX_MODE is {mode})"
    elif monitor.tilt > HOVER_TILT:
        reason = f"the vehicle tilts by {math.degrees(monitor.tilt):.0f} degrees: let it hover first"
    if reason:
        raise SitlError(f"{reason}; nothing was written", exit_code=1)
    return monitor


def excite(client: ParameterClient, monitor: FlightMonitor, wanted: Mapping[str, float]) -> Exchange[ExperimentResult]:
    """Run the experiment: write the settings, start, monitor, stop, restore the settings.

    Parameters
    ----------
    client : ParameterClient
        After `start_monitor`.
    monitor : FlightMonitor
        What `start_monitor` returned.
    wanted : mapping
        Name -> value in single precision, of all of `NAMES`.

    Raises
    ------
    SitlError
        If the vehicle lacks a parameter, or an excitation is running.
    """
    old = yield from read_values(client, NAMES)
    if monitor.phase >= 0:
        raise SitlError(f"an excitation is running: set {AXIS} to 0 first; nothing was written", exit_code=1)
    if old[AXIS] != 0:  # left from an earlier flight; restoring it would start another run
        yield from client.write({AXIS: 0.0}, "reading")
        applied = client.now + PARAMETER_UPDATE_S
        while client.now < applied:
            yield from client.send_and_wait([], applied)
        old = yield from read_values(client, NAMES)
        if old[AXIS] != 0:
            raise SitlError(f"{AXIS} cannot be set to 0; nothing else was written", exit_code=1)
    new = {**wanted, AXIS: old[AXIS]}
    outcome = yield from write_and_verify(client, new, old, store=False)
    if outcome.state != "verified":
        return ExperimentResult(False, outcome.reason, 0.0, True, outcome.state in ("untouched", "rolled back"))
    seconds = 0.0
    reason = (yield from client.write({AXIS: wanted[AXIS]}, "starting"))[AXIS].problem
    if not reason:
        reason, seconds = yield from _watch_flight(client, monitor, wanted)
    # In every case the injector is stopped first.
    yield from client.write({AXIS: 0.0}, "stopping", keep_going=True)
    yield from client.wait_until_quiet()
    answers = yield from client.read([AXIS], "stopping", keep_going=True)
    stopped = answers[AXIS].value == 0.0
    back = {name: value for name, value in old.items() if value != new[name]}
    yield from client.write(back, "restoring", keep_going=True)
    yield from client.wait_until_quiet()
    answers = yield from client.read(NAMES, "restoring", keep_going=True)
    restored = all(answers[name].value == value for name, value in old.items())
    return ExperimentResult(not reason, reason, seconds, stopped, restored)


def _watch_flight(
    client: ParameterClient, monitor: FlightMonitor, wanted: Mapping[str, float]
) -> Exchange[tuple[str, float]]:
    """Wait for the end; returns why it failed (empty: it did not), and the duration of the injection (s)."""
    assert client.vehicle is not None
    axes = len(PHASES[round(wanted[AXIS])])
    planned = axes * wanted["MIMO_EX_DUR"] + (axes - 1) * PAUSE_S
    mode, begin, seconds = client.vehicle.mode, client.now, 0.0
    first: int | None = None
    while True:
        yield from client.send_and_wait([], client.now + POLL_S)
        reason = stop_reason(client, monitor, mode, wanted["MIMO_EX_TILT"])
        if reason:
            return reason, seconds
        if monitor.phase >= 0:
            first = monitor.stamp if first is None else first
            seconds = 1e-6 * (monitor.stamp - first)
            client.progress("exciting", round(seconds), round(planned))
        elif first is not None:
            enough = seconds >= COMPLETE_SHARE * planned - CLOCK_MARGIN_S
            return "" if enough else f"the vehicle stopped after {seconds:.1f} s: {monitor.text}", seconds
        elif client.now > begin + START_TIMEOUT_S:
            return f"the vehicle did not start within {START_TIMEOUT_S:g} s: {monitor.text}", 0.0
        if client.now > begin + planned + END_MARGIN_S:
            return f"the injection did not end after {planned + END_MARGIN_S:.0f} s", seconds
