"""The steps in the air: the experiment, the check flight, and the way down."""

from __future__ import annotations

import math
from typing import Any

from mimopilot.sitl.autopilot.flight_modes import Mode
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.field.autotune_run import FLIGHT, GAINS, AutotuneOptions, AutotuneRun, Decided
from mimopilot.sitl.field.doublet_flight import doublet_plan, fly_doublets
from mimopilot.sitl.field.flight_commands import land, send_command, take_off, wait_until_disarmed, wait_until_hovering
from mimopilot.sitl.field.flight_watch import not_followed, start_watch
from mimopilot.sitl.field.ground_steps import Found, list_logs
from mimopilot.sitl.field.vehicle_set import NEW, compare_set
from mimopilot.sitl.mavlink.ground_station.events import ARDUPILOT, Exchange
from mimopilot.sitl.mavlink.ground_station.experiments.experiment_profile import ExcitationOptions
from mimopilot.sitl.mavlink.ground_station.experiments.experiments_by_name import experiment_profile
from mimopilot.sitl.mavlink.ground_station.experiments.module_profile import PX4
from mimopilot.sitl.mavlink.ground_station.flight_monitor import POLL_S, FlightMonitor
from mimopilot.sitl.mavlink.ground_station.session import Session
from mimopilot.sitl.mavlink.wire.dialect import mavlink
from mimopilot.sitl.mavlink.wire.float32 import shortest
from mimopilot.sitl.mavlink.wire.px4_modes import custom_mode
from mimopilot.tuning.design.yaw_design import yaw_model
from mimopilot.tuning.gains_file import load_gains
from mimopilot.tuning.parameters import ENABLE

# All chosen:
#: Hover (s) that is watched for wind before the excitation, and the largest spread of roll and pitch in it (rad):
#: the excitation itself moves a vehicle by 2 to 4 degrees.
HOVER_S, WIND_TILT = 4.0, math.radians(2.5)
#: Of the excitation: the bandwidth (rad/s), its seed, and the tilt (deg) that stops it, as in `experiment`.
BANDWIDTH, SEED, TILT_DEG = 50.0, 0, 25.0


def fly_experiment(run: AutotuneRun) -> Found:
    """Fly the experiment, and land.

    Raises
    ------
    SitlError
        If it was not complete, or the vehicle did not land.
    """
    before = list_logs(run)
    saved: dict[str, float] = {}
    profile = experiment_profile(run.options.profile, excitation_of(run.options), saved.update)
    with run.vehicle(integers=profile.integers) as session:
        vehicle = session.run(session.client.await_heartbeat())
        try:
            if not vehicle.armed:
                done = profile.prepare(session)
                for note in done.notes:
                    run.dialogue.tell(note)
            watch = _hover(run, session, "experiment")
            session.run(_check_wind(watch))
            if not run.took_off and not run.confirm("Excite the vehicle?"):
                raise SitlError("the experiment was not wanted", exit_code=1)
            monitor = profile.check(session)
            result = profile.excite(session, monitor)
            problems = [] if result.complete else [result.reason]
            problems += [] if result.stopped else ["the excitation may still be running"]
            problems += [] if result.restored else ["not all parameters of the excitation were read back as before"]
            if problems:
                raise SitlError("; ".join(problems), exit_code=1)
            run.dialogue.tell(f"excited for {result.seconds:.1f} s")
            _come_down(run, session)
        finally:
            left = profile.restore(session).left
            if left:
                values = ", ".join(f"{name} {shortest(value)}" for name, value in left.items())
                run.dialogue.tell(f"not read back as before the experiment; set again: {values}")
    return {"logs_before": before, "seconds": result.seconds}


def excitation_of(options: AutotuneOptions) -> ExcitationOptions:
    """What the experiment excites, from the options."""
    return ExcitationOptions(
        axis="all" if options.profile == "mimo" else None,
        seconds_per_axis=options.seconds_per_axis,
        amplitude=options.amplitude,
        bandwidth=BANDWIDTH,
        seed=SEED,
        mode="hold",
        tilt_deg=TILT_DEG,
    )


def fly_check(run: AutotuneRun) -> Found:
    """Fly doublets with the new gains, and land.

    Raises
    ------
    Decided
        If the vehicle did something that these gains must not do.
    SitlError
        If the flight was ended for another reason.
    """
    before = list_logs(run)
    gains = load_gains(run.file(GAINS))
    plan = doublet_plan(run.experiment(FLIGHT).amplitude, yaw_model(gains) is not None)
    with run.vehicle(integers={ENABLE.name}) as session:
        if compare_set(run, session) != NEW:
            raise SitlError("the vehicle does not hold the new gains", exit_code=1)
        watch = _hover(run, session, "check flight")
        mode = session.vehicle.mode
        session.run(_settle(watch))
        reason, tripped = session.run(fly_doublets(watch, plan))
        if tripped:
            run.dialogue.tell(f"{reason}: landing")
            reason = f"the check flight was ended: {reason}"
            run.decisions.note(reason)
            ours = session.run(_hand_over(session))
            session.run(land(watch))
            run.took_off = False
            session.run(session.client.write(ours, "restoring", keep_going=True))
            raise Decided(reason)
        if reason and session.vehicle.mode == custom_mode(Mode.OFFBOARD) and not run.took_off:
            session.run(_enter_mode(session, mode))
        if reason:
            raise SitlError(f"the check flight was not complete: {reason}", exit_code=1)
        if not run.took_off:
            session.run(_enter_mode(session, mode))
        _come_down(run, session)
    return {"logs_before": before, "amplitude_deg": round(math.degrees(plan.amplitude), 3)}


def bring_down(run: AutotuneRun) -> None:
    """Land the vehicle that this program has started, over a new link.

    Raises
    ------
    SitlError
        If it cannot be reached, or does not land.
    """
    with run.vehicle() as session:
        session.run(session.client.await_heartbeat())
        if session.vehicle.armed:
            run.dialogue.tell("landing")
            session.run(land(session.run(start_watch(session.client))))
    run.took_off = False


def _hover(run: AutotuneRun, session: Session, flight: str) -> FlightMonitor:
    """The vehicle in hover: it already does, or takes off, or a pilot takes off."""
    session.run(session.client.await_heartbeat())
    watch = session.run(start_watch(session.client))
    height = run.options.take_off
    if height is None:
        if not watch.flying:
            run.dialogue.tell(f"{flight}: take off and hover")
            session.run(wait_until_hovering(watch))
        return watch
    if not watch.flying:
        run.confirm_arming(session.vehicle, height)
        session.link.discard()
        session.client.resume(session.link.now())
        watch = session.run(start_watch(session.client))
        run.dialogue.tell(f"{flight}: taking off to {height:g} m")
        run.took_off = True
        session.run(take_off(watch, height))
    run.took_off = True
    return watch


def _come_down(run: AutotuneRun, session: Session) -> None:
    """Land, or wait until a pilot has landed, and disarmed."""
    watch = session.run(start_watch(session.client))
    if run.took_off:
        session.run(land(watch))
        run.took_off = False
        return
    run.dialogue.tell("land and disarm the vehicle")
    session.run(wait_until_disarmed(watch, careful=True))


def _settle(watch: FlightMonitor) -> Exchange[float]:
    """Watch the hover; returns the larger spread of roll and pitch, rad."""
    client = watch.client
    end, seen = client.now + HOVER_S, [(watch.roll, watch.pitch)]
    while client.now < end:
        yield from client.send_and_wait([], client.now + POLL_S)
        reason = "interrupted" if client.interrupted else not_followed(watch)
        if reason:
            raise SitlError(reason, exit_code=1)
        seen.append((watch.roll, watch.pitch))
    spreads = []
    for angles in zip(*seen, strict=True):
        mean = sum(angles) / len(angles)
        spreads.append(math.sqrt(sum((angle - mean) ** 2 for angle in angles) / len(angles)))
    return max(spreads)


def _check_wind(watch: FlightMonitor) -> Exchange[None]:
    spread = yield from _settle(watch)
    if not spread <= WIND_TILT:
        raise SitlError(
            f"the wind is too strong for the excitation: in hover the vehicle moves by {math.degrees(spread):.1f} "
            f"degrees, expected {math.degrees(WIND_TILT):.1f} or less; wait for less wind",
            exit_code=1,
        )


def _hand_over(session: Session) -> Exchange[dict[str, float]]:
    """Hand over to PX4's own controllers by the one parameter of our module; other vehicles have no such switch.

    Returns
    -------
    dict
        The parameter and its value before; empty: nothing was switched.
    """
    client = session.client
    assert client.vehicle is not None
    if client.vehicle.autopilot != PX4:
        return {}
    answer = (yield from client.read([ENABLE.name], "reading", keep_going=True))[ENABLE.name]
    if not answer.value:
        return {}
    yield from client.write({ENABLE.name: 0.0}, "handing over", keep_going=True)
    return {ENABLE.name: answer.value}


def _enter_mode(session: Session, mode: int) -> Any:
    """Back to a mode (custom_mode): PX4's number holds main and sub mode."""
    plain = session.vehicle.autopilot == ARDUPILOT
    main, sub = (float(mode), 0.0) if plain else (float(mode >> 16 & 0xFF), float(mode >> 24 & 0xFF))
    return send_command(session.client, mavlink.MAV_CMD_DO_SET_MODE, (1.0, main, sub), "leave the mode of setpoints")
