"""The experiment on a stock PX4: its own autotune moves the rate setpoint of roll, pitch and yaw, and applies nothing.

What this relies on, of PX4 1.14 to 1.17 (mc_autotune_attitude_control, mavlink_receiver, parameters):

- The module is started at boot when MC_AT_EN is above 0. A parameter that only it uses has the index 65535 until then.
- MAV_CMD_DO_AUTOTUNE_ENABLE sets MC_AT_START to 1 when the module is idle, with or without a module, whatever its
  parameters; it is acknowledged as in progress. Sent again, it reports the axis as its progress: 20 roll, 40 pitch,
  60 yaw. The module sets MC_AT_START to 0 two seconds after its end.
- Nothing sent ends a run but an amplitude of 0 (MC_AT_SYSID_AMP, read at once), after which it ends by itself. A roll
  or pitch stick ends it. The newest firmware has no MC_AT_START, ends a run when the mode changes, and starts one only
  when param1 is 1.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

from pymavlink.dialects.v20 import common as mavlink

from mimopilot.common.errors import check_choice
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import (
    UNKNOWN_INDEX,
    CommandAck,
    Exchange,
    Outgoing,
    ParameterValue,
    ReadParameter,
    SendCommand,
)
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
    FLIGHT_STREAMS,
    check_hover,
    stop_reason,
)
from mimopilot.sitl.mavlink.ground_station.experiments.px4_autotune_run import Px4AutotuneRun
from mimopilot.sitl.mavlink.ground_station.experiments.vehicle_setup import (
    identify,
    on_the_ground,
    read_known,
    reboot,
    set_values,
    values_of,
    write_back,
)
from mimopilot.sitl.mavlink.ground_station.flight_monitor import POLL_S, FlightMonitor
from mimopilot.sitl.mavlink.ground_station.parameter_protocol import Answer, ParameterClient
from mimopilot.sitl.mavlink.wire.float32 import shortest, single
from mimopilot.sitl.mavlink.wire.px4_modes import EXCITED_MODES, nav_state
from mimopilot.tuning.px4_names import (
    AUTOTUNE_AMPLITUDE,
    AUTOTUNE_APPLY,
    AUTOTUNE_ENABLE,
    AUTOTUNE_START,
    DEFAULT_TOPICS,
    HIGH_RATE,
    LOG_PROFILE,
)

NEEDED = DEFAULT_TOPICS | HIGH_RATE  # of the log's profile
NAMES = (AUTOTUNE_ENABLE, AUTOTUNE_APPLY, AUTOTUNE_AMPLITUDE, LOG_PROFILE)
COMMAND: int = mavlink.MAV_CMD_DO_AUTOTUNE_ENABLE
#: rad/s; twice PX4's default, as in the flight of docs/logs.md that gave gains: tilt stayed below 13 degrees.
DEFAULT_AMPLITUDE, AMPLITUDES = 1.5, (0.1, 6.0)  # the range is that of MC_AT_SYSID_AMP
DEFAULT_RUNS = 4  # one run is too short for a certificate; four gave one up to 50 rad/s
# Chosen:
POLL_RUN_S = 0.25  # between two requests for the progress
START_TIMEOUT_S = 15.0  # from the command to the first axis; PX4 measures 1000 samples of its rate first
RUN_TIMEOUT_S = 90.0  # of a run: three axes of 20 s and their pauses
SETTLE_S = 3.0  # between two runs


class Px4Autotune(ExperimentProfile):
    """The experiment on a stock PX4."""

    name: ClassVar[str] = "px4-stock"
    integers: ClassVar[frozenset[str]] = frozenset({AUTOTUNE_ENABLE, AUTOTUNE_APPLY, AUTOTUNE_START, LOG_PROFILE})

    def __init__(self, options: ExcitationOptions, save: SaveValues) -> None:
        super().__init__(options, save)
        amplitude = DEFAULT_AMPLITUDE if options.amplitude is None else options.amplitude
        if not AMPLITUDES[0] <= amplitude <= AMPLITUDES[1]:
            raise SitlError(
                f"--amplitude: got {amplitude:g}, expected {AMPLITUDES[0]:g} to {AMPLITUDES[1]:g} rad/s, of the rate "
                "setpoint"
            )
        check_choice("--mode", options.mode, EXCITED_MODES, SitlError)
        if options.axis not in (None, "all"):
            raise SitlError("--axis: PX4's autotune excites roll, pitch and yaw, one after the other; leave it out")
        self.runs = DEFAULT_RUNS if options.runs is None else options.runs
        self.amplitude = single(amplitude)
        self.tilt = math.radians(options.tilt_deg)
        self.has_start = True

    def prepare(self, session: VehicleSession) -> Preparation:
        """Set the autotune's and the log's parameters, reboot when one needs it, and see that the module runs."""
        monitor = on_the_ground(session, self.name)
        answers = self._read(session)
        old = values_of(answers)
        new = {
            AUTOTUNE_ENABLE: max(old[AUTOTUNE_ENABLE], 1.0),
            AUTOTUNE_APPLY: 0.0,
            AUTOTUNE_AMPLITUDE: self.amplitude,
            LOG_PROFILE: float(round(old[LOG_PROFILE]) | NEEDED),
        }
        at_boot = [name for name in (AUTOTUNE_ENABLE, LOG_PROFILE) if new[name] != old[name]]
        self.remember(old)
        session.run(set_values(session.client, new, old, store=True))
        needed = bool(at_boot) or answers[AUTOTUNE_AMPLITUDE].place == UNKNOWN_INDEX
        if needed:
            reboot(session, monitor)
            self._check_prepared(self._read(session))
        changed = {name: value for name, value in new.items() if value != old[name]}
        return Preparation(changed, needed)

    def _read(self, session: VehicleSession) -> dict[str, Answer]:
        answers = session.run(read_known(session.client, NAMES, (AUTOTUNE_START,)))
        self.has_start = AUTOTUNE_START in answers
        return answers

    @staticmethod
    def _check_prepared(answers: Mapping[str, Answer]) -> None:
        """Check what acts at boot only.

        Raises
        ------
        SitlError
            Naming all that is missing.
        """
        values, missing = values_of(answers), []
        if values[AUTOTUNE_ENABLE] <= 0:
            missing.append(f"{AUTOTUNE_ENABLE} is 0")
        elif answers[AUTOTUNE_AMPLITUDE].place == UNKNOWN_INDEX:
            missing.append(f"{AUTOTUNE_ENABLE} is {values[AUTOTUNE_ENABLE]:g} but the autotune was not started at boot")
        profile = round(values[LOG_PROFILE])
        if profile & NEEDED != NEEDED:
            missing.append(f"{LOG_PROFILE} is {profile}, too slow a log; {NEEDED} is needed")
        if missing:
            raise SitlError(
                f"{' and '.join(missing)}; land, disarm, and run this again: it sets them and reboots the vehicle; if "
                "it has just done so, this firmware does not start mc_autotune_attitude_control",
                exit_code=1,
            )

    def check(self, session: VehicleSession) -> FlightMonitor:
        """Check that the vehicle hovers in its mode in calm air, and that the autotune runs and the log is fast."""
        wrong_mode = ""
        if nav_state(identify(session, self.name).mode) != EXCITED_MODES[self.options.mode][0]:
            wrong_mode = (
                f"the vehicle is not in the mode {self.options.mode}: change to it, or name its mode with --mode"
            )
        monitor = session.run(check_hover(session.client, FLIGHT_STREAMS, wrong_mode, self.tilt))
        self._check_prepared(self._read(session))
        return monitor

    @property
    def settings(self) -> dict[str, float]:
        """The autotune's parameters."""
        return {AUTOTUNE_AMPLITUDE: self.amplitude, AUTOTUNE_APPLY: 0.0}

    def describe(self) -> list[list[str]]:
        """The autotune's parameters and runs."""
        return [
            [AUTOTUNE_AMPLITUDE, shortest(self.amplitude), "rad/s", "autotune: amplitude added to the rate setpoint"],
            [AUTOTUNE_APPLY, "0", "", "autotune: apply no gains"],
            ["--runs", str(self.runs), "", "runs of roll, pitch and yaw, each about 40 s"],
        ]

    def excite(self, session: VehicleSession, monitor: FlightMonitor) -> ExperimentResult:
        """Run the autotune `runs` times."""
        return session.run(self._excite(session.client, monitor))

    def _excite(self, client: ParameterClient, monitor: FlightMonitor) -> Exchange[ExperimentResult]:
        assert client.vehicle is not None
        names = [AUTOTUNE_APPLY, AUTOTUNE_AMPLITUDE, *([AUTOTUNE_START] if self.has_start else [])]
        old = values_of((yield from read_known(client, names)))
        self.remember(old)
        idle = {
            AUTOTUNE_APPLY: 0.0,
            AUTOTUNE_AMPLITUDE: self.amplitude,
            **({AUTOTUNE_START: 0.0} if self.has_start else {}),
        }
        yield from set_values(client, idle, old, store=False)
        mode, seconds, reason = client.vehicle.mode, 0.0, ""
        for number in range(self.runs):
            run = Px4AutotuneRun()
            reason = yield from self._run(client, monitor, mode, run, f"run {number + 1} of {self.runs}")
            seconds += run.excited
            if reason:
                reason = f"run {number + 1}: {reason}"
                break
        stopped = not reason or (yield from self._stop(client, monitor))
        return ExperimentResult(not reason, reason, seconds, stopped, True)

    def _run(
        self, client: ParameterClient, monitor: FlightMonitor, mode: int, run: Px4AutotuneRun, phase: str
    ) -> Exchange[str]:
        """One run and the pause after it; returns why the experiment must end, empty: it may go on."""
        begin, due, settled = client.now, client.now, math.inf
        while client.now < settled:
            send: list[Outgoing] = []
            if client.now >= due and not run.ended:
                due = client.now + POLL_RUN_S
                send = [self._request(client, run)]
            yield from self._exchange(client, monitor, run, send)
            client.progress(phase, round(client.now - begin), round(RUN_TIMEOUT_S))
            reason = stop_reason(client, monitor, mode, self.tilt) or self._run_problem(client, monitor, run, begin)
            if reason:
                return reason
            if run.ended and settled == math.inf:
                settled = client.now + SETTLE_S
        return ""

    @staticmethod
    def _run_problem(client: ParameterClient, monitor: FlightMonitor, run: Px4AutotuneRun, begin: float) -> str:
        """Why a run, requested at a time `begin` (s), is no experiment; empty: it is, or may become one."""
        if run.ended:
            return run.problem(monitor.text)
        if run.result not in (None, mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_FAILED):
            return f"the vehicle refuses its autotune (MAV_RESULT {run.result}): {monitor.text}"
        if not run.begun and client.now > begin + START_TIMEOUT_S:
            return f"the autotune did not begin within {START_TIMEOUT_S:g} s: {monitor.text}"
        return f"the autotune did not end within {RUN_TIMEOUT_S:g} s" if client.now > begin + RUN_TIMEOUT_S else ""

    def _request(self, client: ParameterClient, run: Px4AutotuneRun) -> Outgoing:
        """The command that starts the autotune; once requested, what asks for its state and starts no other run."""
        assert client.vehicle is not None
        target = client.vehicle.system, client.vehicle.component
        if self.has_start and run.requested:
            return ReadParameter(*target, AUTOTUNE_START)
        return SendCommand(*target, COMMAND, (0.0 if run.requested else 1.0,))

    def _exchange(
        self, client: ParameterClient, monitor: FlightMonitor, run: Px4AutotuneRun, send: list[Outgoing]
    ) -> Exchange[None]:
        """Send, wait for `POLL_S`, and record what is heard of the run."""
        assert client.vehicle is not None
        end = client.now + POLL_S
        while (send or client.now < end) and not client.closed:
            answers = yield from client.send_and_wait(send, end)
            send = []
            for answer in answers:
                if isinstance(answer, CommandAck) and answer.command == COMMAND:
                    run.note(answer, monitor.clock)
                    # Without MC_AT_START the end is the first idle state after the axes.
                    idle = answer.result == mavlink.MAV_RESULT_IN_PROGRESS and answer.progress == 0
                    run.ended |= not self.has_start and idle and run.over
                elif isinstance(answer, ParameterValue) and answer.name == AUTOTUNE_START and run.requested:
                    run.pass_time(monitor.clock)
                    run.ended |= answer.value == 0
                    if answer.value and not run.over:  # while it runs, the command reports the axis and starts nothing
                        send.append(SendCommand(client.vehicle.system, client.vehicle.component, COMMAND, (1.0,)))

    def _stop(self, client: ParameterClient, monitor: FlightMonitor) -> Exchange[bool]:
        """Take the amplitude away and wait until the run has ended; returns whether nothing is injected any more."""
        yield from client.write({AUTOTUNE_AMPLITUDE: 0.0}, "stopping", keep_going=True)
        yield from client.wait_until_quiet()
        if (yield from client.read([AUTOTUNE_AMPLITUDE], "stopping", keep_going=True))[AUTOTUNE_AMPLITUDE].value != 0.0:
            return False
        # The old amplitude goes back after the end of the run only: it would be injected.
        run, begin, due = Px4AutotuneRun(requested=True), client.now, client.now
        while not run.ended and client.now < begin + (RUN_TIMEOUT_S if run.begun else START_TIMEOUT_S):
            client.progress("excitation stopped; waiting for the end of the autotune", 0, 1)
            send: list[Outgoing] = []
            if client.now >= due:
                due = client.now + POLL_RUN_S
                send = [self._request(client, run)]
            yield from self._exchange(client, monitor, run, send)
            if client.lost:
                return False
        return True

    def restore(self, session: VehicleSession) -> Restoration:
        """Write all old values back; those that act at boot, too: they change nothing until then."""
        if not self.old:
            return Restoration()
        left = session.run(write_back(session.client, self.old))
        at_boot = [name for name in (AUTOTUNE_ENABLE, LOG_PROFILE) if name in self.old and name not in left]
        note = f"{' and '.join(at_boot)} act again as before from the next reboot on"
        return Restoration(left, (note,) if at_boot else ())
