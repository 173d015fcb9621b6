"""The steps on the ground: check the vehicle, save its gains, fetch a log, tune, upload, judge, keep."""

from __future__ import annotations

import contextlib
import math
from typing import Any

from mimopilot.common.blas import reproducible
from mimopilot.common.files import sha256
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.field.autotune_report import write_autotune_report
from mimopilot.sitl.field.autotune_run import ANSWER_S, CHECK, FLIGHT, GAINS, SNAPSHOT, AutotuneRun, Decided
from mimopilot.sitl.field.check_flight import check_flight
from mimopilot.sitl.field.doublet_flight import doublet_plan
from mimopilot.sitl.field.flight_watch import start_watch
from mimopilot.sitl.field.vehicle_set import NEW, OLD, held_set, new_plan, old_plan, save_snapshot, write_set
from mimopilot.sitl.mavlink.ground_station.experiments.hover_checks import (
    FLIGHT_STREAMS,
    request_status,
    supplies_problem,
)
from mimopilot.sitl.mavlink.ground_station.experiments.module_profile import PX4
from mimopilot.sitl.mavlink.ground_station.flight_monitor import request_streams
from mimopilot.sitl.mavlink.ground_station.profiles import make_plan
from mimopilot.sitl.mavlink.ground_station.vehicle_kinds import check_kind
from mimopilot.sitl.mavlink.log_transfer.log_session import LogSession
from mimopilot.sitl.mavlink.log_transfer.vehicle_logs import VehicleLog
from mimopilot.sitl.physics.moment_scale import check_moment_scale
from mimopilot.tuning.acceptance import check_verdict
from mimopilot.tuning.design.cascade import tune
from mimopilot.tuning.design.yaw_design import yaw_model
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.experiment import Experiment
from mimopilot.tuning.gains_file import load_gains
from mimopilot.tuning.logs.inspection import inspect_log
from mimopilot.tuning.spec import load_spec

# All chosen:
#: Time (s) in which a vehicle closes its log after disarming, and the pause between two looks.
LOG_TIMEOUT_S, LOG_PAUSE_S = 30.0, 1.0
#: Relative difference of values that are the same but for rounding to single precision.
SAME = 1e-6
#: Folder of a download that is not finished.
DOWNLOADS = "download"

Found = dict[str, Any]


def check_vehicle(run: AutotuneRun) -> Found:
    """Check vehicle, battery, gains and logs before anything is flown."""
    options = run.options
    with run.vehicle() as session:
        check_kind(session.run(session.client.await_heartbeat()), options.profile)
        watch = session.run(start_watch(session.client))
        if not watch.flying and options.take_off is None:
            raise SitlError(
                "the vehicle does not hover: take off and hover first, or give --take-off METRES", exit_code=1
            )
        if options.take_off is not None and not (run.may_arm(session.vehicle) or run.dialogue.interactive):
            raise SitlError(
                "--take-off: nobody can be asked whether to arm the vehicle, and --yes is no answer to that unless the "
                "vehicle says that it is simulated: give --arm"
            )
        monitor = session.run(request_streams(session.client, FLIGHT_STREAMS))
        session.run(request_status(session.client, monitor))
        problem = supplies_problem(monitor)
        if problem:
            raise SitlError(problem, exit_code=1)
        if monitor.charge < 0:
            run.dialogue.tell("the vehicle does not report its battery's charge: watch it yourself")
        vehicle = session.vehicle
    list_logs(run)
    return {"system": vehicle.system, "autopilot": vehicle.autopilot, "simulated": vehicle.simulated}


def snapshot(run: AutotuneRun) -> Found:
    """Save the gains that the vehicle flies with."""
    held = save_snapshot(run)
    return {"file": SNAPSHOT, "parameters": len(held), "sha256": sha256(run.file(SNAPSHOT).read_bytes())}


def list_logs(run: AutotuneRun) -> list[list[Any]]:
    """Name, size and time of the logs on the vehicle.

    Raises
    ------
    SitlError
        If it does not list logs.
    """
    with run.vehicle_logs() as session:
        return [_identity(log) for log in session.run(session.logs.find())]


def fetch_flight(run: AutotuneRun) -> Found:
    """Fetch the log of the experiment."""
    return _fetch(run, FLIGHT, "experiment")


def fetch_check(run: AutotuneRun) -> Found:
    """Fetch the log of the check flight."""
    return _fetch(run, CHECK, "check flight")


def _fetch(run: AutotuneRun, name: str, flight: str) -> Found:
    """Fetch the one log that is new since a flight began, and give it its name; without one, fly again next time."""
    folder = run.file(DOWNLOADS)
    with run.vehicle_logs() as session:
        log, problem = _new_log(session, run.decisions.steps[flight]["logs_before"])
        if log is None:
            run.decisions.forget_from(flight)
            raise SitlError(problem, exit_code=1)
        done = session.run(session.logs.download(log, folder))
    target = run.file(name + done.path.suffix)
    done.path.replace(target)
    with contextlib.suppress(OSError):
        folder.rmdir()
    return {"file": target.name, "bytes": done.log.size, "verified": done.verified, "log": done.log.name}


def _new_log(session: LogSession, before: list[list[Any]]) -> tuple[VehicleLog | None, str]:
    """The new log of the vehicle, once it no longer grows, or why there is none."""
    begin, size = session.link.now(), -1
    while True:
        found = session.run(session.logs.find())
        new = [log for log in found if _identity(log) not in before]
        last = session.run(session.logs.choose(None)) if len(new) > 1 else None
        log = last if last in new else new[0] if len(new) == 1 else None
        if log is not None and log.size == size > 0:
            return log, ""
        size = -1 if log is None else log.size
        if session.link.now() > begin + LOG_TIMEOUT_S:
            if log is None:
                return None, "the vehicle has no log of this flight: is logging on, is its card full?"
            return None, f"{log.name}: the log of this flight has {log.size} bytes and is not closed: card full?"
        session.run(_pause(session))


def _pause(session: LogSession) -> Any:
    until = session.client.now + LOG_PAUSE_S
    while session.client.now < until:
        yield from session.client.receive([], until)


def _identity(log: VehicleLog) -> list[Any]:
    return [log.name, log.size, log.time]


def inspect_flight(run: AutotuneRun) -> Found:
    """Look whether gains can be tuned from the log; if not, the experiment is flown again next time."""
    path = run.log(FLIGHT)
    found = inspect_log(path)
    reason = found.reason
    if reason is None and not any(name.startswith(("u_bar", "r_bar")) for name in found.excitation):
        reason = "it does not contain the experiment: no injected torque or rate setpoint is logged"
    if reason is not None:
        run.decisions.forget_from("experiment")
        raise SitlError(f"{path}: {reason}", exit_code=1)
    for warning in found.warnings:
        run.dialogue.tell(f"{path.name}: {warning}")
    return {"seconds": found.seconds, "warnings": list(found.warnings)}


@reproducible
def tune_gains(run: AutotuneRun) -> Found:
    """Tune, certify, and compare with the gains that flew.

    Raises
    ------
    SitlError
        If no gains come out of the log; the experiment is flown again next time.
    Decided
        If the flown gains are better.
    """
    try:
        gains = tune([run.experiment(FLIGHT)], load_spec(profile=run.options.profile))
        warning = check_verdict(gains, allow=False)
    except TuningError as error:
        run.decisions.forget_from("experiment")
        raise SitlError(f"{error}", exit_code=1) from error
    if warning:
        run.dialogue.tell(warning)
    gains.save(run.file(GAINS))
    run.dialogue.show_gains(gains)
    reasons = gains.provenance.details.get("keep_flown", ())
    if reasons:
        raise Decided(f"the gains that flew are better: {'; '.join(reasons)}")
    return {"file": GAINS, "sha256": sha256(run.file(GAINS).read_bytes()), "verdict": str(gains.verdict()[0])}


def upload_gains(run: AutotuneRun) -> Found:
    """Ask, write the new gains to the disarmed vehicle, and verify them.

    Raises
    ------
    Decided
        If the answer is no.
    SitlError
        If they could not be written and verified; the old ones are back, or `begun` stays set.
    """
    gains, plan = load_gains(run.file(GAINS)), new_plan(run)
    if held_set(run) != OLD:
        raise SitlError("the vehicle's gains are no longer those of the snapshot: somebody changed them", exit_code=1)
    with run.vehicle() as session:
        session.run(session.client.await_heartbeat())
        # PX4 publishes no unit of torque; the gains are from the log of this vehicle, so they are in its own.
        scale = () if session.vehicle.autopilot == PX4 else plan.scale
        fixed = session.read([*plan.fixed, *scale], run.options.profile)
    if scale:
        check_moment_scale(gains, [fixed[name] for name in scale], "the vehicle")
    unknown = plan.values.keys() - old_plan(run).values.keys()
    if unknown:
        raise SitlError(f"{SNAPSHOT}: lacks {', '.join(sorted(unknown))}, which could not be taken back", exit_code=1)
    for name, value in plan.fixed.items():
        if fixed[name] != value:
            raise SitlError(f"{name}: the vehicle has {fixed[name]:.6g}, the gains are for {value:.6g}", exit_code=1)
    if not run.confirm("Upload the new gains, and try them in a check flight?"):
        raise Decided("the new gains were not wanted")
    run.decisions.begun = True
    run.decisions.save()
    write_set(run, plan)
    return {"parameters": len(plan.values)}


def judge(run: AutotuneRun) -> Found:
    """Compare the check flight with its prediction.

    Raises
    ------
    Decided
        If it is worse than predicted by more than a share.
    SitlError
        If the log does not tell.
    """
    flight, gains = run.experiment(CHECK), load_gains(run.file(GAINS))
    _check_flown(run, flight)
    if yaw_model(gains) is not None and flight.yaw is None:
        why = "; ".join(flight.warnings) or "it is not logged"
        run.dialogue.tell(f"yaw is not compared with its prediction: {why}")
    experiment = run.experiment(FLIGHT)
    plan = doublet_plan(experiment.amplitude, yaw_model(gains) is not None)
    result = check_flight(flight, experiment, gains, plan)
    run.dialogue.show_check(result)
    try:
        write_autotune_report(run, gains, result)
    except Exception as error:  # whatever fails in a page, also a mistake of ours: it decides nothing about the gains
        run.dialogue.tell(f"no report: {error or type(error).__name__}")
    if result.worse:
        raise Decided(f"the check flight is worse than predicted: {'; '.join(result.worse)}")
    return result.as_table()


def _check_flown(run: AutotuneRun, flight: Experiment) -> None:
    """Refuse a log of a flight with other gains than the new ones."""
    if flight.flown is None:
        raise SitlError(f"{flight.source}: does not say which gains flew", exit_code=1)
    flown, wanted = (
        make_plan(gains, run.options.profile).values for gains in (flight.flown, load_gains(run.file(GAINS)))
    )
    other = [name for name, value in wanted.items() if not math.isclose(flown[name], value, rel_tol=SAME)]
    if other:
        raise SitlError(f"{flight.source}: was flown with other gains ({', '.join(other[:3])}, ...)", exit_code=1)


def keep(run: AutotuneRun) -> Found:
    """Ask whether the new gains stay.

    Raises
    ------
    Decided
        If the answer is no, or there is none in time.
    SitlError
        If the vehicle does not hold them.
    """
    answer = run.confirm(f"Keep the new gains? Without an answer in {ANSWER_S:.0f} s the old ones go back", ANSWER_S)
    if answer is None:
        raise Decided(f"no answer in {ANSWER_S:.0f} s")
    if not answer:
        raise Decided("the new gains were not kept: the answer was no")
    if held_set(run) != NEW:
        raise SitlError("the vehicle does not hold the new gains any more", exit_code=1)
    return {}
