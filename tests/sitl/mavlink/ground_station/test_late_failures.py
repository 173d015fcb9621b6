"""Failures after every write was acknowledged, old HEARTBEATs, and other vehicles on the link, in simulated time."""

import pytest

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import (
    AttitudeReport,
    Heartbeat,
    ParameterValue,
    ReadParameter,
    Received,
    RequestMessage,
    SetParameter,
    StoreParameters,
    run_exchange,
)
from mimopilot.sitl.mavlink.ground_station.parameter_protocol import ParameterClient
from mimopilot.sitl.mavlink.ground_station.upload import read_values, write_and_verify
from mimopilot.sitl.mavlink.wire.float32 import single
from tests.sitl.mavlink.scripted_vehicle import ScriptedVehicle, SimulatedLink

NAMES = [f"MIMO_X_{i:02d}" for i in range(20)]
FIXED = {"MIMO_TS": single(0.004), "MIMO_SCALE_R": single(2.5)}
NEW = {name: single(0.3 * (i + 1)) for i, name in enumerate(NAMES)}
OLD = {name: single(0.1 * (i + 1)) for i, name in enumerate(NAMES)} | FIXED
FAULTY = NAMES[7]
OTHER_ADDRESS = ("10.0.0.2", 14550)


class LateVehicle(ScriptedVehicle):
    """`event` happens `seconds` after a storage command and returns the messages that the vehicle then sends."""

    def __init__(self, event, seconds):
        super().__init__(OLD)
        self.event, self.seconds, self.due = event, seconds, None

    def stream(self, now):
        if self.stored and self.due is None:
            self.due = now + self.seconds
        if self.event is None or self.due is None or now < self.due:
            return []
        event, self.event = self.event, None
        return event(self) or []


def restarts(vehicle):
    """It loses what it has not stored."""
    vehicle.values = dict(OLD)


def clamps(vehicle):
    vehicle.values[FAULTY] = single(0.5)


def is_written(vehicle):
    """By another ground station."""
    vehicle.values[FAULTY] = single(0.5)
    return [ParameterValue(1, 1, FAULTY, vehicle.values[FAULTY])]


def is_written_and_written_back(vehicle):
    return [ParameterValue(1, 1, FAULTY, single(0.5)), ParameterValue(1, 1, FAULTY, NEW[FAULTY])]


def arms(vehicle):
    vehicle.armed = True
    return vehicle.heartbeat()


def arms_and_disarms(vehicle):
    return [Heartbeat(1, 1, 12, True, 0, 2)]


def upload(link, new=NEW, **keywords):
    client = ParameterClient(link.now(), **keywords)
    run_exchange(client.await_heartbeat(), link)
    held = run_exchange(read_values(client, list(OLD)), link)
    return run_exchange(write_and_verify(client, new, held), link)


@pytest.mark.parametrize("seconds", [0.0, 0.5, 1.5, 2.3])
@pytest.mark.parametrize(
    ("event", "parts"),
    [
        (restarts, f"{NAMES[0]}: reads back as 0.1, expected 0.3"),
        (clamps, f"{FAULTY}: reads back as 0.5, expected 2.4"),
        (is_written, f"{FAULTY}: 0.5, after the vehicle reported 2.4"),
        (is_written_and_written_back, f"{FAULTY}: 0.5, after the vehicle reported 2.4"),
        (arms, "the vehicle was armed before the last reading"),
        (arms_and_disarms, "the vehicle was armed before the last reading"),
    ],
)
def test_an_event_after_storing_is_detected_and_rolled_back(event, parts, seconds):
    vehicle = LateVehicle(event, seconds)
    outcome = upload(SimulatedLink(vehicle))
    assert (outcome.state, outcome.reason) == ("rolled back", parts)
    assert vehicle.values == OLD
    assert outcome.armed == event.__name__.startswith("arms")


def test_a_change_of_a_fixed_value_is_reported_but_not_written_back():
    vehicle = LateVehicle(lambda v: v.values.update(MIMO_TS=0.002), 1.0)
    link = RecordingLink(vehicle)
    outcome = upload(link)
    assert (outcome.state, outcome.held["MIMO_TS"]) == ("mixed", (0.002,))
    assert outcome.reason == "MIMO_TS: reads back as 0.002, expected 0.004"
    assert link.now() - link.sent(SetParameter)[-1] > 2.3
    assert all(m.name not in FIXED for _, m in link.log if isinstance(m, SetParameter))
    assert {name: vehicle.values[name] for name in NEW} == {name: OLD[name] for name in NEW}


def test_a_vehicle_may_arm_during_a_forced_upload():
    vehicle = LateVehicle(arms, 1.0)
    outcome = upload(SimulatedLink(vehicle), force_armed=True)
    assert (outcome.state, outcome.armed) == ("verified", True)


class RecordingLink(SimulatedLink):
    """Records when HEARTBEATs are received."""

    def __init__(self, vehicle, **keywords):
        super().__init__(vehicle, **keywords)
        self.beats = []

    def receive(self, until):
        heard = super().receive(until)
        self.beats += [self.time for h in heard if isinstance(h.message, Heartbeat)]
        return heard

    def sent(self, kind):
        return [at for at, message in self.log if isinstance(message, kind)]


@pytest.mark.parametrize("answers", [0, None])
def test_the_last_reading_is_later_than_the_vehicles_own_saving(answers):
    link = RecordingLink(ScriptedVehicle(OLD, storage=answers))
    assert upload(link).state == "verified"
    last = link.sent(ReadParameter)[-len(OLD) :]
    changed = max(link.sent(SetParameter) + link.sent(StoreParameters))
    assert last[0] - changed >= 2.3
    assert any(changed + 2.3 <= beat <= last[0] for beat in link.beats)


@pytest.mark.parametrize("seed", range(20))
def test_every_write_follows_a_heartbeat_of_less_than_1_5_s_ago(seed):
    link = RecordingLink(ScriptedVehicle(OLD), seed=seed, loss=0.4, latency=0.1)
    assert upload(link).state == "verified"
    for at in link.sent(SetParameter):
        assert at - max(beat for beat in link.beats if beat <= at) < 1.5


class RareHeartbeatVehicle(ScriptedVehicle):
    """Sends HEARTBEAT once, then only on request, or never; streams ATTITUDE."""

    def __init__(self, answers):
        super().__init__(OLD)
        self.answers, self.beats = answers, 0

    def heartbeat(self):
        self.beats += 1
        return super().heartbeat() if self.beats == 1 else []

    def answer(self, order):
        if isinstance(order, RequestMessage):
            return super().heartbeat() if self.answers else []
        return super().answer(order)

    def stream(self, now):
        return [AttitudeReport(1, 1, 0.0, 0.0)]


def test_a_late_heartbeat_is_requested():
    link = RecordingLink(RareHeartbeatVehicle(answers=True))
    assert upload(link).state == "verified"
    for at in link.sent(SetParameter):
        assert at - max(beat for beat in link.beats if beat <= at) < 1.5


def test_a_vehicle_without_further_heartbeats_is_not_written():
    vehicle = RareHeartbeatVehicle(answers=False)
    outcome = upload(RecordingLink(vehicle))
    assert (outcome.state, vehicle.writes) == ("untouched", 0)
    assert "no HEARTBEAT in 13.5 s" in outcome.reason


def test_two_vehicles_with_one_system_number_are_refused_and_not_written():
    first, second = ScriptedVehicle(OLD), ScriptedVehicle(OLD)
    link = SimulatedLink(first)
    link.join(1.3, OTHER_ADDRESS, second)
    with pytest.raises(SitlError, match=r"system 1 is heard from two addresses, :0 and 10\.0\.0\.2:14550") as refused:
        upload(link)
    assert refused.value.exit_code == 2
    assert (first.writes, second.writes) == (0, 0)


@pytest.mark.parametrize("at", [2.7, 2.9, 3.1, 3.5, 4.5, 5.4])
def test_a_second_vehicle_that_appears_during_the_upload_is_never_written(at):
    first, second = ScriptedVehicle(OLD), ScriptedVehicle(NEW | FIXED)
    link = SimulatedLink(first)
    link.join(at, OTHER_ADDRESS, second)
    outcome = upload(link)
    assert outcome.state == "rolled back"
    assert "system 1 is heard from two addresses, :0 and 10.0.0.2:14550" in outcome.reason
    assert (second.reads, second.writes, second.stored) == (0, 0, 0)
    assert first.values == OLD


def test_an_answer_from_another_address_is_not_accepted():
    vehicle = ScriptedVehicle(OLD, "ignores one", faulty=FAULTY)
    link = SimulatedLink(vehicle)
    client = ParameterClient(link.now())
    run_exchange(client.await_heartbeat(), link)
    for i in range(200):
        link.schedule(
            link.time + 0.1 * i, "to ground", Received(OTHER_ADDRESS, ParameterValue(1, 1, FAULTY, NEW[FAULTY]))
        )
    answers = run_exchange(client.write({FAULTY: NEW[FAULTY]}, "writing", keep_going=True), link)
    assert answers[FAULTY].value is None
    assert "no answer" in answers[FAULTY].problem
