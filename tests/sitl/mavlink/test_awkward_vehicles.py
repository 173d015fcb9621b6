"""What a vehicle may do after it has answered for every write, in simulated time; and who else may be on the link."""

import pytest
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import (
    Attitude,
    Heard,
    Heartbeat,
    Read,
    RequestOnce,
    Store,
    Value,
    Write,
    drive,
)
from mimopilot.sitl.mavlink.ground_station.parameter_protocol import Conversation
from mimopilot.sitl.mavlink.ground_station.upload import apply, read
from mimopilot.sitl.mavlink.wire.float32 import single

from tests.sitl.mavlink.scripted_vehicle import ScriptedVehicle, SimulatedLink

NAMES = [f"MIMO_X_{i:02d}" for i in range(20)]
FIXED = {"MIMO_TS": single(0.004), "MIMO_SCALE_R": single(2.5)}
NEW = {name: single(0.3 * (i + 1)) for i, name in enumerate(NAMES)}
OLD = {name: single(0.1 * (i + 1)) for i, name in enumerate(NAMES)} | FIXED
VICTIM = NAMES[7]
THERE = ("10.0.0.2", 14550)


class LateVehicle(ScriptedVehicle):
    """Something happens to it so many seconds after it was told to store; `happens` returns what it says then."""

    def __init__(self, happens, seconds):
        super().__init__(OLD)
        self.happens, self.seconds, self.due = happens, seconds, None

    def tell(self, now):
        if self.stored and self.due is None:
            self.due = now + self.seconds
        if self.happens is None or self.due is None or now < self.due:
            return []
        happens, self.happens = self.happens, None
        return happens(self) or []


def restarts(vehicle):
    """It has not stored anything."""
    vehicle.values = dict(OLD)


def clamps(vehicle):
    vehicle.values[VICTIM] = single(0.5)


def is_written(vehicle):
    """By another station."""
    vehicle.values[VICTIM] = single(0.5)
    return [Value(1, 1, VICTIM, vehicle.values[VICTIM])]


def is_written_and_written_back(vehicle):
    return [Value(1, 1, VICTIM, single(0.5)), Value(1, 1, VICTIM, NEW[VICTIM])]


def arms(vehicle):
    vehicle.armed = True
    return vehicle.heartbeat()


def arms_and_disarms(vehicle):
    return [Heartbeat(1, 1, 12, True, 0, 2)]


def upload(link, new=NEW, **keywords):
    talk = Conversation(link.now(), **keywords)
    drive(talk.meet(), link)
    held = drive(read(talk, list(OLD)), link)
    return drive(apply(talk, new, held), link)


@pytest.mark.parametrize("seconds", [0.0, 0.5, 1.5, 2.3])
@pytest.mark.parametrize(
    ("happens", "words"),
    [
        (restarts, f"{NAMES[0]}: reads back as 0.1, expected 0.3"),
        (clamps, f"{VICTIM}: reads back as 0.5, expected 2.4"),
        (is_written, f"{VICTIM}: 0.5, after the vehicle said 2.4"),
        (is_written_and_written_back, f"{VICTIM}: 0.5, after the vehicle said 2.4"),
        (arms, "the vehicle was armed before the last reading"),
        (arms_and_disarms, "the vehicle was armed before the last reading"),
    ],
)
def test_what_happens_after_storing_is_no_success_and_is_undone(happens, words, seconds):
    vehicle = LateVehicle(happens, seconds)
    outcome = upload(SimulatedLink(vehicle))
    assert (outcome.state, outcome.reason) == ("rolled back", words)
    assert vehicle.values == OLD
    assert outcome.armed == happens.__name__.startswith("arms")


def test_a_fixed_value_that_changes_is_noticed_and_is_not_written():
    vehicle = LateVehicle(lambda v: v.values.update(MIMO_TS=0.002), 1.0)
    link = Witness(vehicle)
    outcome = upload(link)
    assert (outcome.state, outcome.held["MIMO_TS"]) == ("mixed", (0.002,))
    assert outcome.reason == "MIMO_TS: reads back as 0.002, expected 0.004"
    assert link.now() - link.sent(Write)[-1] > 2.3
    assert all(m.name not in FIXED for _, m in link.log if isinstance(m, Write))
    assert {name: vehicle.values[name] for name in NEW} == {name: OLD[name] for name in NEW}


def test_a_vehicle_that_was_forced_may_be_armed():
    vehicle = LateVehicle(arms, 1.0)
    outcome = upload(SimulatedLink(vehicle), force_armed=True)
    assert (outcome.state, outcome.armed) == ("verified", True)


class Witness(SimulatedLink):
    """Remembers when HEARTBEATs were heard."""

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
def test_the_last_reading_outlasts_what_a_vehicle_saves_by_itself(answers):
    link = Witness(ScriptedVehicle(OLD, storage=answers))
    assert upload(link).state == "verified"
    last = link.sent(Read)[-len(OLD) :]
    changed = max(link.sent(Write) + link.sent(Store))
    assert last[0] - changed >= 2.3
    assert any(changed + 2.3 <= beat <= last[0] for beat in link.beats)


@pytest.mark.parametrize("seed", range(20))
def test_no_heartbeat_is_older_than_the_help_says_when_something_is_written(seed):
    link = Witness(ScriptedVehicle(OLD), seed=seed, loss=0.4, latency=0.1)
    assert upload(link).state == "verified"
    for at in link.sent(Write):
        assert at - max(beat for beat in link.beats if beat <= at) < 1.5


class Terse(ScriptedVehicle):
    """Sends its HEARTBEAT once, then only when asked, or never again; ATTITUDE all the time."""

    def __init__(self, answers):
        super().__init__(OLD)
        self.answers, self.beats = answers, 0

    def heartbeat(self):
        self.beats += 1
        return super().heartbeat() if self.beats == 1 else []

    def answer(self, order):
        if isinstance(order, RequestOnce):
            return super().heartbeat() if self.answers else []
        return super().answer(order)

    def tell(self, now):
        return [Attitude(1, 1, 0.0, 0.0)]


def test_a_heartbeat_that_is_late_is_asked_for():
    link = Witness(Terse(answers=True))
    assert upload(link).state == "verified"
    for at in link.sent(Write):
        assert at - max(beat for beat in link.beats if beat <= at) < 1.5


def test_a_vehicle_whose_heartbeat_ends_is_not_written():
    vehicle = Terse(answers=False)
    outcome = upload(Witness(vehicle))
    assert (outcome.state, vehicle.writes) == ("untouched", 0)
    assert "no HEARTBEAT in 13.5 s" in outcome.reason


def test_two_vehicles_of_one_number_are_refused_and_neither_is_written():
    first, second = ScriptedVehicle(OLD), ScriptedVehicle(OLD)
    link = SimulatedLink(first)
    link.join(1.3, THERE, second)
    with pytest.raises(SitlError, match=r"system 1 is heard from two addresses, :0 and 10\.0\.0\.2:14550") as refused:
        upload(link)
    assert refused.value.exit_code == 2
    assert (first.writes, second.writes) == (0, 0)


@pytest.mark.parametrize("at", [2.7, 2.9, 3.1, 3.5, 4.5, 5.4])
def test_a_second_vehicle_that_appears_in_the_middle_is_never_written(at):
    first, second = ScriptedVehicle(OLD), ScriptedVehicle(NEW | FIXED)
    link = SimulatedLink(first)
    link.join(at, THERE, second)
    outcome = upload(link)
    assert outcome.state == "rolled back"
    assert "system 1 is heard from two addresses, :0 and 10.0.0.2:14550" in outcome.reason
    assert (second.reads, second.writes, second.stored) == (0, 0, 0)
    assert first.values == OLD


def test_what_another_address_says_does_not_pass_for_what_the_vehicle_holds():
    vehicle = ScriptedVehicle(OLD, "deaf to one", victim=VICTIM)
    link = SimulatedLink(vehicle)
    talk = Conversation(link.now())
    drive(talk.meet(), link)
    for i in range(200):
        link.schedule(link.time + 0.1 * i, "to ground", Heard(THERE, Value(1, 1, VICTIM, NEW[VICTIM])))
    answers = drive(talk.tell({VICTIM: NEW[VICTIM]}, "writing", keep_going=True), link)
    assert answers[VICTIM].value is None
    assert "no answer" in answers[VICTIM].problem
