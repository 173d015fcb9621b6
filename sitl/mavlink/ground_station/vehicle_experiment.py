"""The excitation experiment on a flying vehicle: sets, starts, monitors and stops its injector, restores the settings.

The vehicle stops by itself if it tilts too far, leaves its mode, or a stick moves. The ground station monitors tilt,
mode and link, and stops it too. See `sitl.mavlink.ground_station.events` for how an exchange is run.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from mimopilot.sitl.autopilot.excitation_injector import AXIS, PAUSE_S, PHASES
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import (
    AttitudeReport,
    Exchange,
    FlightReport,
    InjectorState,
    LandedState,
    SetMessageInterval,
    StatusText,
    TransferReport,
)
from mimopilot.sitl.mavlink.ground_station.parameter_protocol import ParameterClient
from mimopilot.sitl.mavlink.ground_station.upload import read_values, write_and_verify
from mimopilot.sitl.mavlink.wire.px4_modes import nav_state
from mimopilot.tuning.parameters import EXCITATION

IN_AIR = 2  # MAV_LANDED_STATE_IN_AIR
#: Message -> (number, interval in us) that the vehicle is requested to stream.
STREAMS = {"ATTITUDE": (30, 50_000), "DEBUG_VECT": (250, 100_000), "EXTENDED_SYS_STATE": (245, 200_000)}
# Times and limits are chosen, unless a source is given.
FIRST_STREAM_TIMEOUT_S, REPEAT_REQUEST_S = 5.0, 1.0  # until all streams arrive; between their requests
POLL_S = 0.1  # between two checks of the flight state
PARAMETER_UPDATE_S = 1.5  # PX4 applies changed parameters once a second
START_TIMEOUT_S = 5.0  # from the write to the first pulse
STREAM_TIMEOUT_S = 1.0  # without a message of a stream
HEARTBEAT_TIMEOUT_S = 5.0  # HEARTBEAT comes once a second and may be lost
END_MARGIN_S = 10.0  # after the planned end
HOVER_TILT = math.radians(15.0)  # rad; a hovering vehicle tilts less
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
        value = values[setting.name]
        if not setting.minimum <= value <= setting.maximum:
            expected = f"{setting.minimum:g} to {setting.maximum:g} {setting.unit}".rstrip()
            raise SitlError(f"{setting.name}: got {value:g}, expected {expected} ({setting.description})")


@dataclass
class FlightMonitor:
    """Latest flight state that the vehicle reported; times by our clock, s."""

    client: ParameterClient
    tilt: float = 0.0  # rad
    in_air: bool = False
    phase: int = -1
    stamp: int = 0  # us, by the vehicle's clock
    text: str = ""
    seen: dict[str, float] = field(default_factory=dict)

    def __call__(self, report: FlightReport | TransferReport) -> None:
        """Record a report."""
        if isinstance(report, AttitudeReport):
            self.tilt = max(abs(report.roll), abs(report.pitch))
            self.seen["ATTITUDE"] = self.client.now
        elif isinstance(report, LandedState):
            self.in_air = report.state == IN_AIR
            self.seen["EXTENDED_SYS_STATE"] = self.client.now
        elif isinstance(report, InjectorState):
            self.phase, self.stamp = report.phase, report.time
            self.seen["DEBUG_VECT"] = self.client.now
        elif isinstance(report, StatusText):
            self.text = report.text

    def overdue(self, seconds: float) -> list[str]:
        """Streams without a message for more than `seconds`."""
        return [kind for kind in STREAMS if self.client.now - self.seen.get(kind, -math.inf) > seconds]


@dataclass(frozen=True)
class ExperimentResult:
    """Result of an experiment.

    Attributes
    ----------
    complete : bool
        It ran to its planned end.
    reason : str
        Why it did not; empty if it did.
    seconds : float
        Duration of the injection, by the vehicle's clock.
    stopped : bool
        `AXIS` was read back as 0 at the end.
    restored : bool
        All settings were read back as before.
    """

    complete: bool
    reason: str
    seconds: float
    stopped: bool
    restored: bool


def start_monitor(client: ParameterClient, mode: int) -> Exchange[FlightMonitor]:
    """Request the vehicle's streams; check that it hovers in a mode (nav_state) under our controller.

    Raises
    ------
    SitlError
        If it does not.
    """
    assert client.vehicle is not None
    monitor = client.on_report = FlightMonitor(client)
    next_request, deadline = client.now, client.now + FIRST_STREAM_TIMEOUT_S
    while monitor.overdue(STREAM_TIMEOUT_S) and client.now < deadline and not (client.interrupted or client.closed):
        requests = []
        if client.now >= next_request:
            next_request = client.now + REPEAT_REQUEST_S
            requests = [
                SetMessageInterval(client.vehicle.system, client.vehicle.component, *STREAMS[kind])
                for kind in monitor.overdue(REPEAT_REQUEST_S)
            ]
        yield from client.send_and_wait(requests, client.now + POLL_S)
    missing = monitor.overdue(STREAM_TIMEOUT_S)
    reason = ""
    if client.interrupted:
        reason = "interrupted"
    elif "DEBUG_VECT" in missing and len(missing) == 1:
        reason = "the vehicle does not send its injector's state (DEBUG_VECT MIMO_EXC): our controller does not fly it"
    elif missing:
        reason = f"the vehicle does not send {', '.join(missing)}"
    elif not client.vehicle.armed:
        reason = "the vehicle is not armed: take off and hover first"
    elif not monitor.in_air:
        reason = "the vehicle is on the ground: take off and hover first"
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
        reason = _stop_reason(client, monitor, mode, wanted["MIMO_EX_TILT"])
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


def _stop_reason(client: ParameterClient, monitor: FlightMonitor, mode: int, largest_tilt: float) -> str:
    """Why it must be stopped now; empty: it may continue."""
    assert client.vehicle is not None
    if client.interrupted:
        return "interrupted"
    if client.closed:
        return "the link was lost"
    if client.failure:
        return client.failure
    if client.heartbeat_age > HEARTBEAT_TIMEOUT_S:
        return f"no HEARTBEAT for {HEARTBEAT_TIMEOUT_S:g} s"
    if not client.vehicle.armed:
        return "the vehicle was disarmed"
    if client.vehicle.mode != mode:
        return "the vehicle left its mode"
    if not monitor.tilt <= largest_tilt:
        return f"the vehicle tilts by {math.degrees(monitor.tilt):.0f} degrees"
    if not monitor.in_air:
        return "the vehicle is on the ground"
    missing = monitor.overdue(STREAM_TIMEOUT_S)
    return f"the vehicle no longer sends {', '.join(missing)}" if missing else ""
