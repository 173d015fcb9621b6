"""The transaction over simulated links: thousands of bad days, in simulated time."""

import math
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import (
    THE_PEER,
    Ack,
    Heard,
    Heartbeat,
    Refusal,
    Store,
    Value,
    Write,
    drive,
)
from mimopilot.sitl.mavlink.ground_station.parameter_protocol import AUTOSAVE_S, Conversation
from mimopilot.sitl.mavlink.ground_station.upload import apply, read
from mimopilot.sitl.mavlink.ground_station.vehicle_contact import LISTEN_S
from mimopilot.sitl.mavlink.wire.float32 import single

from tests.sitl.mavlink.scripted_vehicle import FAILING, ScriptedVehicle, SimulatedLink

NAMES = [f"MIMO_X_{i:02d}" for i in range(20)]
OLD = {name: single(0.1 * (i + 1)) for i, name in enumerate(NAMES)}
NEW = {name: single(0.2 + 1.37 * value) for name, value in OLD.items()}
RADIO = {"loss": 0.3, "duplicate": 0.1, "reorder": 0.1}


def upload(link, new=NEW, **keywords):
    """Read, then apply; the outcome. A vehicle that cannot be read ends it before anything is written."""
    talk = Conversation(link.now(), **keywords)
    drive(talk.meet(), link)
    held = drive(read(talk, list(new)), link)
    return drive(apply(talk, new, held), link)


@pytest.mark.parametrize("seed", range(20))
def test_a_bad_radio_loses_nothing(seed):
    vehicle = ScriptedVehicle(OLD)
    link = SimulatedLink(vehicle, seed, **RADIO)
    outcome = upload(link)
    assert outcome.state == "verified", outcome.reason
    assert vehicle.values == NEW
    assert vehicle.stored >= 1


def test_the_radio_of_these_tests_is_as_bad_as_it_says():
    vehicle = ScriptedVehicle(OLD)
    link = SimulatedLink(vehicle, 0, **RADIO)
    arrived = []
    for i in range(20000):
        link.send([Write(1, 1, NAMES[0], float(i))])
        link.time += 0.001
    vehicle.answer = lambda order: arrived.append(order.value) or []
    link.receive(1000.0)
    assert len(arrived) / 20000 == pytest.approx(0.7 * 1.1, abs=0.02)
    late = sum(b < a for a, b in pairwise(arrived))
    assert late / len(arrived) == pytest.approx(0.1, abs=0.02)


def test_no_failing_vehicle_is_ever_reported_as_a_success():
    states = {}
    for seed in range(200):
        fault = FAILING[seed % len(FAILING)]
        vehicle = ScriptedVehicle(OLD, fault, victim=NAMES[seed % 20], after=seed % 20)
        link = SimulatedLink(vehicle, seed, **RADIO)
        try:
            outcome = upload(link)
        except SitlError:
            assert fault == "integer"
            assert vehicle.values == OLD
            continue
        states.setdefault(fault, set()).add(outcome.state)
        if outcome.state == "verified":
            # It armed and nobody heard of it in time, or the write that it spoiled was repeated later.
            assert fault in ("arms", "swaps")
            assert vehicle.values == NEW
        for name, value in vehicle.values.items():
            assert value in outcome.held[name], (seed, fault, name)
        if outcome.state in ("rolled back", "untouched"):
            assert vehicle.values == OLD, (seed, fault)
    assert states["dies"] == {"mixed"}
    for fault in ("echoes", "echoes one", "ignores", "clamps", "rounds", "out of range", "read only", "denies"):
        assert states[fault] <= {"rolled back", "untouched"}, fault


@pytest.mark.parametrize("fault", FAILING)
def test_each_fault_on_a_good_link_is_named_and_undone(fault):
    vehicle = ScriptedVehicle(OLD, fault, victim=NAMES[7], after=4)
    link = SimulatedLink(vehicle)
    if fault == "integer":
        with pytest.raises(SitlError, match=rf"{NAMES[7]}.*no float.*nothing was written"):
            upload(link)
        return
    outcome = upload(link)
    words = {
        "echoes": "reads back as 0.1",
        "echoes one": f"{NAMES[7]}: reads back as",
        "ignores": f"{NAMES[7]}: stays",
        "clamps": f"{NAMES[7]}: stays 0.84",
        "rounds": f"{NAMES[7]}: stays",
        "out of range": f"{NAMES[7]}: refused: value out of its range",
        "read only": "refused: read only",
        "denies": "refused: permission denied",
        "deaf to one": f"{NAMES[7]}: no answer in 12 s",
        "arms": "the vehicle was armed before the last reading",
        "dies": "nothing was heard from the vehicle for 12 s",
        "forgets": f"{NAMES[7]}: reads back as",
        "swaps": f"{NAMES[0]}: reads back as",
    }
    assert words[fault] in outcome.reason
    expected = {"dies": "mixed", "forgets": "mixed", "swaps": "mixed"}.get(fault, "rolled back")
    assert outcome.state == expected
    for name, value in vehicle.values.items():
        assert value in outcome.held[name]
    if expected == "rolled back":
        assert vehicle.values == OLD
        assert outcome.storage == "acknowledged"


@pytest.mark.parametrize("after", range(len(NAMES) + 1))
def test_a_link_cut_after_any_write_leaves_nothing_untold(after):
    vehicle = ScriptedVehicle(OLD, "dies", after=after)
    outcome = upload(SimulatedLink(vehicle))
    if after == len(NAMES):
        assert outcome.state == "verified"
        return
    assert outcome.state == "mixed"
    assert sum(value != OLD[name] for name, value in vehicle.values.items()) == after
    told = {name for name, values in outcome.held.items() if values != (OLD[name],)}
    for name, value in vehicle.values.items():
        assert value in outcome.held[name]
        assert value == OLD[name] or name in told


def test_a_link_cut_at_any_message_leaves_nothing_untold():
    states = set()
    for count in range(40, 480, 4):
        vehicle = ScriptedVehicle(OLD)
        link = SimulatedLink(vehicle)
        carry = link.carry

        def cut(kind, message, link=link, carry=carry, count=count):
            link.up = link.up and next(link.order) < count
            carry(kind, message)

        link.carry = cut
        try:
            outcome = upload(link, tries=4)
        except SitlError:
            assert vehicle.values == OLD
            continue
        states.add(outcome.state)
        assert outcome.state == "verified" or all(v in outcome.held[n] for n, v in vehicle.values.items())
        if outcome.state == "verified":
            assert vehicle.values == NEW
    assert states == {"verified", "mixed"}


def test_a_link_that_comes_back_in_time_ends_with_the_old_values():
    vehicle = ScriptedVehicle(OLD)
    link = SimulatedLink(vehicle)
    write = vehicle.write

    def stumble(name, value):
        if vehicle.writes == 5 and link.up:
            link.up = False
            link.schedule(link.time + 15.0, "back", None)
        return write(name, value)

    vehicle.write = stumble
    receive = link.receive

    def revive(until):
        if not link.up and any(kind == "back" and at <= until for at, _, kind, _ in link.queue):
            link.up = True
        return [heard for heard in receive(until) if heard is not None]

    link.receive = revive
    outcome = upload(link)
    assert outcome.state == "rolled back", outcome
    assert vehicle.values == OLD


def test_ctrl_c_between_any_two_writes_ends_with_the_old_values():
    for count in range(1, 20):
        vehicle = ScriptedVehicle(OLD)
        link = SimulatedLink(vehicle, latency=0.05)
        talk = Conversation(link.now())
        drive(talk.meet(), link)
        held = drive(read(talk, NAMES), link)
        answer = vehicle.answer

        def interrupted(order, talk=talk, vehicle=vehicle, answer=answer, count=count):
            talk.interrupted = vehicle.writes >= count
            return answer(order)

        vehicle.answer = interrupted
        outcome = drive(apply(talk, NEW, held), link)
        assert (outcome.state, vehicle.values) == ("rolled back", OLD)
        assert "interrupted" in outcome.reason


def test_nothing_new_is_written_to_a_vehicle_that_armed_half_way():
    vehicle = ScriptedVehicle(OLD, "arms", after=3)
    link = SimulatedLink(vehicle, latency=0.2)
    beats = []
    heartbeat = vehicle.heartbeat
    vehicle.heartbeat = lambda: beats.append((link.time, vehicle.armed)) or heartbeat()
    outcome = upload(link)
    assert outcome.state == "rolled back"
    heard = next(at for at, armed in beats if armed) + link.latency
    late = [m for at, m in link.log if at > heard and isinstance(m, Write)]
    assert late
    assert all(m.value == OLD[m.name] for m in late)


def test_an_armed_vehicle_is_written_when_forced_and_not_otherwise():
    for forced, state in ((False, "untouched"), (True, "verified")):
        vehicle = ScriptedVehicle(OLD)
        vehicle.armed = True
        link = SimulatedLink(vehicle)
        outcome = upload(link, force_armed=forced)
        assert outcome.state == state
        assert any(isinstance(m, Write) for _, m in link.log) == forced


def test_writing_waits_for_a_heartbeat_when_the_last_one_is_old():
    vehicle = ScriptedVehicle(OLD)
    link = SimulatedLink(vehicle)
    talk = Conversation(link.now())
    drive(talk.meet(), link)
    held = drive(read(talk, NAMES), link)
    link.time += 60.0  # somebody reads the table; meanwhile it arms
    link.queue.clear()
    vehicle.armed = True
    link.schedule(link.time + 0.7, "beat", THE_PEER)
    talk.resume(link.now())
    outcome = drive(apply(talk, NEW, held), link)
    assert (outcome.state, vehicle.writes) == ("untouched", 0)


def stranger(system, component):
    """Noise: every answer of the vehicle comes also from another speaker, with another value."""

    def noise(message):
        changed = message._replace(system=system, component=component)
        return changed._replace(value=changed.value + 1.0) if isinstance(changed, Value) else changed

    return noise


@pytest.mark.parametrize("speaker", [(7, 1), (1, 42), (255, 190)])
def test_the_answers_of_other_vehicles_and_components_are_ignored(speaker):
    vehicle = ScriptedVehicle(OLD)
    link = SimulatedLink(vehicle, noise=[stranger(*speaker)])
    assert upload(link, system=1).state == "verified"
    assert vehicle.values == NEW
    deaf = ScriptedVehicle(OLD, "deaf to one", victim=NAMES[3])
    link = SimulatedLink(deaf, noise=[lambda m: Value(*speaker, NAMES[3], NEW[NAMES[3]])])
    assert upload(link, system=1).state == "rolled back"


def test_another_stations_reading_of_an_old_value_does_not_stop_a_write():
    vehicle = ScriptedVehicle(OLD)
    link = SimulatedLink(vehicle, latency=0.05)
    once = iter([Value(1, 1, NAMES[0], OLD[NAMES[0]])] * 3)
    answer = vehicle.answer
    vehicle.answer = lambda order: [
        *([m] if isinstance(order, Write) and (m := next(once, None)) else []),
        *answer(order),
    ]
    assert upload(link).state == "verified"
    assert vehicle.values == NEW


def test_a_change_that_the_vehicle_cannot_keep_is_called_that():
    vehicle = ScriptedVehicle(OLD, "epsilon")
    new = NEW | {NAMES[2]: single(OLD[NAMES[2]] + 6e-8)}
    assert new[NAMES[2]] != OLD[NAMES[2]]
    outcome = upload(SimulatedLink(vehicle), new)
    assert outcome.state == "rolled back"
    assert f"{NAMES[2]}: stays" in outcome.reason
    assert "do not save a change below 1.2e-07" in outcome.reason


@pytest.mark.parametrize(
    ("storage", "expected", "seconds", "asked"),
    [
        (0, "acknowledged", 0.02, 1),
        (2, "denied", 0.02, 1),
        (3, "autosave", 0.02, 1),
        (4, "failed", 0.02, 1),
        (None, "autosave", 2.5, 5),
    ],
)
def test_storage_is_acknowledged_refused_or_left_to_the_vehicle(storage, expected, seconds, asked):
    vehicle = ScriptedVehicle(OLD, storage=storage)
    link = SimulatedLink(vehicle, latency=0.01)
    talk = Conversation(link.now())
    drive(talk.meet(), link)
    begin = link.now()
    assert drive(talk.store(), link) == expected
    assert link.now() - begin == pytest.approx(seconds)
    assert vehicle.stored == asked


def test_a_missing_parameter_stops_before_anything_is_written():
    vehicle = ScriptedVehicle({name: value for name, value in OLD.items() if name != NAMES[5]})
    link = SimulatedLink(vehicle)
    with pytest.raises(SitlError, match=rf"{NAMES[5]}: no answer in 12 s.*nothing was written"):
        upload(link)
    assert vehicle.writes == 0


def test_a_vehicle_that_is_not_there_is_waited_for_as_long_as_told():
    vehicle = ScriptedVehicle(OLD)
    vehicle.dead = True
    link = SimulatedLink(vehicle)
    with pytest.raises(SitlError, match="no HEARTBEAT of an autopilot in 3 s"):
        upload(link, tries=6)
    assert link.now() == pytest.approx(3.0)


@pytest.mark.parametrize("latency", [0.3, 0.6, 1.2])
def test_a_round_trip_longer_than_a_try_neither_fails_nor_deceives(latency):
    vehicle = ScriptedVehicle(OLD)
    assert upload(SimulatedLink(vehicle, latency=latency, reorder=0.1)).state == "verified"
    assert vehicle.values == NEW
    for seed in range(60):
        fault = ("echoes", "echoes one", "clamps")[seed % 3]
        vehicle = ScriptedVehicle(OLD, fault, victim=NAMES[seed % 20])
        assert upload(SimulatedLink(vehicle, seed, latency=latency, **RADIO)).state == "rolled back"
        assert vehicle.values == OLD


def test_a_vehicle_that_turns_read_only_half_way_is_read_and_told_exactly():
    vehicle = ScriptedVehicle(OLD)
    store = vehicle.store
    vehicle.store = lambda name, value: [Refusal(1, 1, name, 5)] if vehicle.writes > 6 else store(name, value)
    outcome = upload(SimulatedLink(vehicle))
    assert (outcome.state, outcome.storage) == ("mixed", "acknowledged")
    assert outcome.held == {name: (value,) for name, value in vehicle.values.items()}
    assert sum(values != (OLD[name],) for name, values in outcome.held.items()) == 6


def test_a_slow_link_is_used_to_its_window_and_no_further():
    vehicle = ScriptedVehicle(OLD)
    link = SimulatedLink(vehicle, latency=0.05)
    link.receive(1.1)  # its first HEARTBEAT is on the way
    begin = link.now()
    assert upload(link).state == "verified"
    # Up to a second until its HEARTBEAT, and who else is there; two windows each of reading, writing and verifying, two
    # settlings of two round trips, and the storage; then what outlasts its saving: a HEARTBEAT and two windows.
    assert link.now() - begin < 1.0 + LISTEN_S + 1.1 + AUTOSAVE_S + 0.4
    most = 0
    for at, _ in link.log:
        most = max(most, sum(at <= t < at + 0.099 for t, m in link.log if not isinstance(m, Store)))
    assert most <= 12  # ten and a HEARTBEAT or two


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e39, -3.5e38])
def test_what_is_not_finite_in_single_precision_never_becomes_a_value(value):
    with pytest.raises(SitlError, match="finite in single precision"):
        single(value)


speakers = st.sampled_from([(1, 1), (1, 2), (2, 1), (0, 0)])
floats32 = st.floats(width=32)
words = st.one_of(
    st.builds(lambda s, a: Heartbeat(*s, 12, a), speakers.filter(lambda s: s != (1, 1)), st.booleans()),
    st.builds(
        lambda s, n, v, k: Value(*s, n, v, k),
        speakers,
        st.sampled_from([*NAMES, "", "OTHER"]),
        floats32,
        st.integers(0, 255),
    ),
    st.builds(lambda s, n, r: Refusal(*s, n, r), speakers, st.sampled_from([*NAMES, ""]), st.integers(0, 255)),
    st.builds(lambda s, c, r: Ack(*s, c, r), speakers, st.sampled_from([245, 400]), st.integers(0, 255)),
)


@given(st.lists(words, max_size=60), st.integers(0, 1000), st.sampled_from(["", *FAILING]))
@settings(max_examples=150, deadline=None)
def test_whatever_else_is_said_on_the_link_a_success_is_true(noise, seed, fault):
    vehicle = ScriptedVehicle(OLD, fault, victim=NAMES[seed % 20], after=seed % 20)
    link = SimulatedLink(vehicle, seed, latency=0.02)
    for i, word in enumerate(noise):
        # Left out: a stray value with the very bits that are hoped for, which cannot be told from an answer.
        if not (isinstance(word, Value) and word.value == NEW.get(word.name)):
            link.schedule(0.05 * i, "to ground", Heard(THE_PEER, word))
    try:
        outcome = upload(link, tries=6, system=1)
    except SitlError:
        assert vehicle.values == OLD
        return
    if outcome.state == "verified":
        assert vehicle.values == NEW
    if outcome.state in ("rolled back", "untouched"):
        assert vehicle.values == OLD
