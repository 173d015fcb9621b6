"""The experiment on a stock ArduCopter: its mode SystemID adds chirps to the mixer's roll, pitch and yaw.

ArduCopter enters that mode on the mixer's axes only from a mode with manual throttle (mode_systemid.cpp), in which the
altitude is the pilot's. One entry excites the axis SID_AXIS once; the vehicle then stays in the mode, at rest.
"""

from __future__ import annotations

import math
from typing import ClassVar

from pymavlink.dialects.v20 import common as mavlink

from mimopilot.common.errors import check_choice
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.flight.excitation_flight import AMPLITUDE
from mimopilot.sitl.mavlink.ground_station.events import Exchange
from mimopilot.sitl.mavlink.ground_station.experiments.experiment_profile import (
    ExcitationOptions,
    ExperimentProfile,
    ExperimentResult,
    Preparation,
    Restoration,
    SaveValues,
    VehicleSession,
)
from mimopilot.sitl.mavlink.ground_station.experiments.hover_checks import (
    ALTITUDE_STREAM,
    FLIGHT_STREAMS,
    check_hover,
    stop_reason,
)
from mimopilot.sitl.mavlink.ground_station.experiments.vehicle_setup import (
    identify,
    on_the_ground,
    read_known,
    set_values,
    values_of,
    write_back,
)
from mimopilot.sitl.mavlink.ground_station.flight_monitor import POLL_S, FlightMonitor
from mimopilot.sitl.mavlink.ground_station.parameter_protocol import ParameterClient
from mimopilot.sitl.mavlink.wire.float32 import shortest, single

SID_AXIS, LOG_BITMASK = "SID_AXIS", "LOG_BITMASK"
FAST_LOG = 1 | 2  # fast and medium attitude: SystemID then logs every loop
#: --axis -> values of SID_AXIS: mixer roll, pitch, yaw.
AXES = {"roll": (10,), "pitch": (11,), "yaw": (12,), "both": (10, 11), "all": (10, 11, 12)}
STABILIZE, SYSTEM_ID = 0, 25  # ArduCopter's mode numbers
DELAY_S = 1.0  # s, from the mode change to the chirp (SYSTEM_ID_DELAY)
# Chosen:
START_HZ = 0.4  # two cycles of it begin the chirp; attitude loops are slower than their tuned crossover, 1 to 2 Hz
#: The chirp ends at this multiple of the bandwidth: it has no power beyond, unlike the PRBS of our injector.
STOP_BANDWIDTHS = 2.0
FADE_IN_S, FADE_OUT_S = 5.0, 1.0  # the two cycles at the start; a short end without a step
AFTER_S = 0.5  # s in the mode after the chirp, in which the response fades
ALTITUDE_BAND = 5.0  # m, above and below the start, that the pilot may drift before the experiment is stopped
MODE_TIMEOUT_S, SETTLE_S, END_MARGIN_S = (
    5.0,
    3.0,
    10.0,
)  # for a mode to be reported; between axes; after the planned end


class SystemIdentification(ExperimentProfile):
    """The experiment on a stock ArduCopter."""

    name: ClassVar[str] = "ardupilot-stock"
    integers: ClassVar[frozenset[str]] = frozenset({SID_AXIS, LOG_BITMASK})
    pilot: ClassVar[str] = (
        "ArduCopter enters SystemID on the mixer's axes only from Stabilize, in which a pilot holds the height; take "
        "off by hand, hover in Stabilize"
    )

    def __init__(self, options: ExcitationOptions, save: SaveValues) -> None:
        super().__init__(options, save)
        axis = options.axis or "all"
        check_choice("--axis", axis, AXES, SitlError)
        if options.runs is not None:
            raise SitlError("--runs: belongs to --profile px4-stock; give --seconds-per-axis for a longer chirp")
        self.axes, self.tilt = AXES[axis], math.radians(options.tilt_deg)
        amplitude = AMPLITUDE if options.amplitude is None else options.amplitude
        stop_hz = STOP_BANDWIDTHS * options.bandwidth / math.tau
        constant = 2 / START_HZ
        if not 0 < amplitude <= 0.5:
            raise SitlError(f"--amplitude: got {amplitude:g}, expected above 0, at most 0.5 of the torque")
        if not constant < options.seconds_per_axis <= 255:
            raise SitlError(f"--seconds-per-axis: got {options.seconds_per_axis:g}, expected {constant:g} to 255 s")
        if not START_HZ < stop_hz <= 100:
            raise SitlError(f"--bandwidth: got {options.bandwidth:g}, expected a chirp that ends at 0.4 to 100 Hz")
        values = {
            "SID_MAGNITUDE": amplitude,
            "SID_F_START_HZ": START_HZ,
            "SID_F_STOP_HZ": stop_hz,
            "SID_T_REC": options.seconds_per_axis,
            "SID_T_FADE_IN": min(FADE_IN_S, constant),
            "SID_T_FADE_OUT": FADE_OUT_S,
        }
        self.wanted = {SID_AXIS: float(self.axes[0])} | {name: single(value) for name, value in values.items()}
        #: s, from the mode change. ArduCopter reports the end later by the fades and the first two cycles, in which its
        #: log shows no injection any more.
        self.planned = DELAY_S + options.seconds_per_axis + AFTER_S

    def prepare(self, session: VehicleSession) -> Preparation:
        """Set the chirp's parameters and fast logging; ArduCopter needs no reboot for them."""
        on_the_ground(session, self.name)
        return Preparation(session.run(self._set(session.client, store=True)))

    def _set(self, client: ParameterClient, store: bool) -> Exchange[dict[str, float]]:
        """Set all parameters; returns those that were changed."""
        first = values_of((yield from read_known(client, [SID_AXIS, LOG_BITMASK])))
        new = {SID_AXIS: self.wanted[SID_AXIS], LOG_BITMASK: float(round(first[LOG_BITMASK]) | FAST_LOG)}
        self.remember(first)
        yield from set_values(client, new, first, store)
        # The others do not exist while SID_AXIS is 0.
        others = {name: value for name, value in self.wanted.items() if name != SID_AXIS}
        old = values_of((yield from read_known(client, list(others))))
        self.remember(old)
        yield from set_values(client, others, old, store)
        return {name: value for name, value in (new | others).items() if value != (first | old)[name]}

    def check(self, session: VehicleSession) -> FlightMonitor:
        """Check that the vehicle hovers in Stabilize in calm air."""
        wrong_mode, mode = "", identify(session, self.name).mode
        if mode != STABILIZE:
            wrong_mode = (
                f"the vehicle is in mode {mode}: change to Stabilize; ArduCopter enters SystemID on the mixer only "
                "from a mode with manual throttle, so the altitude is the pilot's"
            )
        return session.run(check_hover(session.client, {**FLIGHT_STREAMS, **ALTITUDE_STREAM}, wrong_mode, self.tilt))

    @property
    def settings(self) -> dict[str, float]:
        """The parameters of the chirps."""
        return self.wanted

    def describe(self) -> list[list[str]]:
        """The parameters of the chirps, and what the pilot must do."""
        text = {
            SID_AXIS: ("", f"mixer axes {', '.join(map(str, self.axes))}, one after the other"),
            "SID_MAGNITUDE": ("norm", "chirp: amplitude of the torque"),
            "SID_F_START_HZ": ("Hz", "chirp: first frequency"),
            "SID_F_STOP_HZ": ("Hz", "chirp: last frequency"),
            "SID_T_REC": ("s", "chirp: time on each axis"),
            "SID_T_FADE_IN": ("s", "chirp: fade in"),
            "SID_T_FADE_OUT": ("s", "chirp: fade out"),
        }
        rows = [[name, shortest(value), *text[name]] for name, value in self.wanted.items()]
        return [*rows, ["throttle", "", "", f"the pilot holds the altitude within {ALTITUDE_BAND:g} m all the time"]]

    def excite(self, session: VehicleSession, monitor: FlightMonitor) -> ExperimentResult:
        """Fly the chirp on each axis, from Stabilize and back to it."""
        return session.run(self._excite(session.client, monitor))

    def _excite(self, client: ParameterClient, monitor: FlightMonitor) -> Exchange[ExperimentResult]:
        assert client.vehicle is not None
        yield from self._set(client, store=False)
        home, altitude, seconds, reason, stopped = client.vehicle.mode, monitor.altitude, 0.0, "", True
        for axis in self.axes:
            answer = (yield from client.write({SID_AXIS: float(axis)}, "starting"))[SID_AXIS]
            reason = answer.problem or (yield from self._enter(client, monitor, SYSTEM_ID))
            if not reason:
                begin = monitor.clock
                reason = yield from self._watch(client, monitor, altitude, axis)
                seconds += min(max(monitor.clock - begin - DELAY_S, 0.0), self.options.seconds_per_axis)
            # Another mode now is the pilot's choice and stays.
            if client.vehicle.mode == SYSTEM_ID or reason:
                back = yield from self._leave(client, monitor, home)
                stopped, reason = not back, reason or back
            if reason:
                break
            reason = yield from self._settle(client, monitor, home, altitude)
            if reason:
                break
        return ExperimentResult(not reason, reason, seconds, stopped, True)

    def _enter(self, client: ParameterClient, monitor: FlightMonitor, mode: int) -> Exchange[str]:
        """Change the mode; returns why that failed, empty: the vehicle reports the mode."""
        assert client.vehicle is not None
        flag = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        ack = yield from client.command(mavlink.MAV_CMD_DO_SET_MODE, (flag, mode))
        if ack is not None and ack.result not in (mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_IN_PROGRESS):
            return f"the vehicle refuses mode {mode} (MAV_RESULT {ack.result}): {monitor.text}"
        end = client.now + MODE_TIMEOUT_S
        while client.vehicle.mode != mode and client.now < end and not client.closed:
            yield from client.send_and_wait(client.request_heartbeat(), client.now + POLL_S)
        return "" if client.vehicle.mode == mode else f"the vehicle does not report mode {mode}: {monitor.text}"

    def _leave(self, client: ParameterClient, monitor: FlightMonitor, home: int) -> Exchange[str]:
        """Go back to the mode of before, unless the pilot has chosen another; returns why that failed."""
        assert client.vehicle is not None
        if client.closed:
            return "the link was lost in mode SystemID: the vehicle ends its chirp by itself; change the mode by hand"
        yield from client.send_and_wait(client.request_heartbeat(), client.now + POLL_S)
        return "" if client.vehicle.mode != SYSTEM_ID else (yield from self._enter(client, monitor, home))

    def _watch(self, client: ParameterClient, monitor: FlightMonitor, altitude: float, axis: int) -> Exchange[str]:
        """Watch one chirp to its end; returns why it must be stopped, empty: it has ended."""
        begin, clock, monitor.text = client.now, monitor.clock, ""
        while monitor.clock < clock + self.planned and "SystemID Finished" not in monitor.text:
            yield from client.send_and_wait([], client.now + POLL_S)
            reason = stop_reason(client, monitor, SYSTEM_ID, self.tilt) or drifted(monitor, altitude)
            if reason:
                return reason
            if monitor.text.startswith(("SystemID Stopped", "SystemID Parameter")):
                return f"the vehicle stopped: {monitor.text}"
            if client.now > begin + self.planned + END_MARGIN_S:
                return f"the chirp did not end within {self.planned + END_MARGIN_S:.0f} s"
            client.progress(f"axis {axis}", round(monitor.clock - clock), round(self.planned))
        return ""

    def _settle(self, client: ParameterClient, monitor: FlightMonitor, home: int, altitude: float) -> Exchange[str]:
        """Hover between two axes; returns why the experiment must end."""
        end, reason = client.now + SETTLE_S, ""
        while client.now < end and not reason:
            yield from client.send_and_wait([], client.now + POLL_S)
            reason = stop_reason(client, monitor, home, self.tilt) or drifted(monitor, altitude)
        return reason

    def restore(self, session: VehicleSession) -> Restoration:
        """Write all old values back, SID_AXIS last: where it is 0, the others do not exist."""
        left: dict[str, float] = {}
        for names in (self.old.keys() - {SID_AXIS}, self.old.keys() & {SID_AXIS}):
            old = {name: self.old[name] for name in sorted(names)}
            left |= session.run(write_back(session.client, old)) if old else {}
        return Restoration(left)


def drifted(monitor: FlightMonitor, altitude: float) -> str:
    """Whether the altitude has left the band around that of the start (m), in words; empty: it has not."""
    drift = monitor.altitude - altitude
    return f"the altitude has changed by {drift:+.1f} m" if abs(drift) > ALTITUDE_BAND else ""
