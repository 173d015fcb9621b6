"""The upload over simulated links with loss, faults and interruptions, in simulated time."""

import math
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import (
    ARDUPILOT,
    SOLE_PEER,
    CommandAck,
    Heartbeat,
    ParameterRefusal,
    ParameterValue,
    Received,
    SetParameter,
    StoreParameters,
    run_exchange,
)
from mimopilot.sitl.mavlink.ground_station.parameter_protocol import AUTOSAVE_S, ParameterClient
from mimopilot.sitl.mavlink.ground_station.upload import read_values, write_and_verify
from mimopilot.sitl.mavlink.ground_station.vehicle_link_state import LISTEN_S
from mimopilot.sitl.mavlink.wire.float32 import single
from tests.sitl.mavlink.scripted_vehicle import FAILING, ScriptedVehicle, SimulatedLink

NAMES = [f"MIMO_X_{i:02d}" for i in range(20)]
OLD = {name: single(0.1 * (i + 1)) for i, name in enumerate(NAMES)}
NEW = {name: single(0.2 + 1.37 * value) for name, value in OLD.items()}
RADIO = {"loss": 0.3, "duplicate": 0.1, "reorder": 0.1}


def upload(link, new=NEW, **keywords):
    """Read, then write and verify; returns the outcome. Nothing is written if reading fails."""
    client = ParameterClient(link.now(), **keywords)
    run_exchange(client.await_heartbeat(), link)
    held = run_exchange(read_values(client, list(new)), link)
    return run_exchange(write_and_verify(client, new, held), link)


@pytest.mark.parametrize("seed", range(20))
def test_an_upload_over_a_lossy_radio_is_verified(seed):
    vehicle = ScriptedVehicle(OLD)
    link = SimulatedLink(vehicle, seed, **RADIO)
    outcome = upload(link)
    assert outcome.state == "verified", outcome.reason
    assert vehicle.values == NEW
    assert vehicle.stored >= 1


def test_the_simulated_radio_has_the_stated_loss_and_reordering():
    vehicle = ScriptedVehicle(OLD)
    link = SimulatedLink(vehicle, 0, **RADIO)
    arrived = []
    for i in range(20000):
        link.send([SetParameter(1, 1, NAMES[0], float(i))])
        link.time += 0.001
    vehicle.answer = lambda order: arrived.append(order.value) or []
    link.receive(1000.0)
    assert len(arrived) / 20000 == pytest.approx(0.7 * 1.1, abs=0.02)
    late = sum(b < a for a, b in pairwise(arrived))
    assert late / len(arrived) == pytest.approx(0.1, abs=0.02)


def test_a_faulty_vehicle_is_never_reported_as_verified():
    states = {}
    for seed in range(200):
        fault = FAILING[seed % len(FAILING)]
        vehicle = ScriptedVehicle(OLD, fault, faulty=NAMES[seed % 20], after=seed % 20)
        link = SimulatedLink(vehicle, seed, **RADIO)
        try:
            outcome = upload(link)
        except SitlError:
            assert fault == "integer"
            assert vehicle.values == OLD
            continue
        states.setdefault(fault, set()).add(outcome.state)
        if outcome.state == "verified":
            # Its arming was not received in time, or the wrong write was repeated later.
            assert fault in ("arms", "writes another")
            assert vehicle.values == NEW
        for name, value in vehicle.values.items():
            assert value in outcome.held[name], (seed, fault, name)
        if outcome.state in ("rolled back", "untouched"):
            assert vehicle.values == OLD, (seed, fault)
    assert states["disconnects"] == {"mixed"}
    for fault in ("echoes", "echoes one", "ignores", "clamps", "rounds", "out of range", "read only", "denies"):
        assert states[fault] <= {"rolled back", "untouched"}, fault


@pytest.mark.parametrize("fault", FAILING)
def test_each_fault_on_a_good_link_is_named_and_rolled_back(fault):
    vehicle = ScriptedVehicle(OLD, fault, faulty=NAMES[7], after=4)
    link = SimulatedLink(vehicle)
    if fault == "integer":
        with pytest.raises(SitlError, match=rf"{NAMES[7]}.*not a float.*nothing was written"):
            upload(link)
        return
    outcome = upload(link)
    reasons = {
        "echoes": "reads back as 0.1",
        "echoes one": f"{NAMES[7]}: reads back as",
        "ignores": f"{NAMES[7]}: stays",
        "clamps": f"{NAMES[7]}: stays 0.84",
        "rounds": f"{NAMES[7]}: stays",
        "out of range": f"{NAMES[7]}: refused: value out of its range",
        "read only": "refused: read only",
        "denies": "refused: permission denied",
        "ignores one": f"{NAMES[7]}: no answer in 12 s",
        "arms": "the vehicle was armed before the last reading",
        "disconnects": "no message from the vehicle for 12 s",
        "loses one": f"{NAMES[7]}: reads back as",
        "writes another": f"{NAMES[0]}: reads back as",
    }
    assert reasons[fault] in outcome.reason
    expected = {"disconnects": "mixed", "loses one": "mixed", "writes another": "mixed"}.get(fault, "rolled back")
    assert outcome.state == expected
    for name, value in vehicle.values.items():
        assert value in outcome.held[name]
    if expected == "rolled back":
        assert vehicle.values == OLD
        assert outcome.storage == "acknowledged"


def other_sender(system, component):
    """Noise: another sender repeats every answer of the vehicle, with another value."""

    def noise(message):
        changed = message._replace(system=system, component=component)
        return changed._replace(value=changed.value + 1.0) if isinstance(changed, ParameterValue) else changed

    return noise


@pytest.mark.parametrize("sender", [(7, 1), (1, 42), (255, 190)])
def test_the_answers_of_other_vehicles_and_components_are_ignored(sender):
    vehicle = ScriptedVehicle(OLD)
    link = SimulatedLink(vehicle, noise=[other_sender(*sender)])
    assert upload(link, system=1).state == "verified"
    assert vehicle.values == NEW
    deaf = ScriptedVehicle(OLD, "ignores one", faulty=NAMES[3])
    link = SimulatedLink(deaf, noise=[lambda m: ParameterValue(*sender, NAMES[3], NEW[NAMES[3]])])
    assert upload(link, system=1).state == "rolled back"


def test_an_old_value_read_by_another_ground_station_does_not_stop_a_write():
    vehicle = ScriptedVehicle(OLD)
    link = SimulatedLink(vehicle, latency=0.05)
    once = iter([ParameterValue(1, 1, NAMES[0], OLD[NAMES[0]])] * 3)
    answer = vehicle.answer
    vehicle.answer = lambda order: [
        *([m] if isinstance(order, SetParameter) and (m := next(once, None)) else []),
        *answer(order),
    ]
    assert upload(link).state == "verified"
    assert vehicle.values == NEW


def test_a_change_too_small_for_the_vehicle_is_reported_as_such():
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
    client = ParameterClient(link.now())
    run_exchange(client.await_heartbeat(), link)
    begin = link.now()
    assert run_exchange(client.store(), link) == expected
    assert link.now() - begin == pytest.approx(seconds)
    assert vehicle.stored == asked


def test_ardupilot_saves_each_parameter_by_itself_and_is_not_commanded_to():
    vehicle = ScriptedVehicle(OLD, storage=2)
    link = SimulatedLink(vehicle)
    client = ParameterClient(link.now())
    run_exchange(client.await_heartbeat(), link)
    assert client.vehicle is not None
    client.vehicle = client.vehicle._replace(autopilot=ARDUPILOT)
    assert run_exchange(client.store(), link) == "autosave"
    assert vehicle.stored == 0


def test_a_missing_parameter_stops_the_upload_before_writing():
    vehicle = ScriptedVehicle({name: value for name, value in OLD.items() if name != NAMES[5]})
    link = SimulatedLink(vehicle)
    with pytest.raises(SitlError, match=rf"{NAMES[5]}: no answer in 12 s.*nothing was written"):
        upload(link)
    assert vehicle.writes == 0


def test_an_absent_vehicle_is_waited_for_until_the_timeout():
    vehicle = ScriptedVehicle(OLD)
    vehicle.offline = True
    link = SimulatedLink(vehicle)
    with pytest.raises(SitlError, match="no HEARTBEAT of an autopilot in 3 s"):
        upload(link, tries=6)
    assert link.now() == pytest.approx(3.0)


@pytest.mark.parametrize("latency", [0.3, 0.6, 1.2])
def test_a_round_trip_longer_than_a_try_causes_neither_failure_nor_false_success(latency):
    vehicle = ScriptedVehicle(OLD)
    assert upload(SimulatedLink(vehicle, latency=latency, reorder=0.1)).state == "verified"
    assert vehicle.values == NEW
    for seed in range(60):
        fault = ("echoes", "echoes one", "clamps")[seed % 3]
        vehicle = ScriptedVehicle(OLD, fault, faulty=NAMES[seed % 20])
        assert upload(SimulatedLink(vehicle, seed, latency=latency, **RADIO)).state == "rolled back"
        assert vehicle.values == OLD


def test_values_of_a_vehicle_that_becomes_read_only_are_reported_exactly():
    vehicle = ScriptedVehicle(OLD)
    store = vehicle.store
    vehicle.store = lambda name, value: [ParameterRefusal(1, 1, name, 5)] if vehicle.writes > 6 else store(name, value)
    outcome = upload(SimulatedLink(vehicle))
    assert (outcome.state, outcome.storage) == ("mixed", "acknowledged")
    assert outcome.held == {name: (value,) for name, value in vehicle.values.items()}
    assert sum(values != (OLD[name],) for name, values in outcome.held.items()) == 6


def test_a_slow_link_carries_a_full_window_of_requests_and_no_more():
    vehicle = ScriptedVehicle(OLD)
    link = SimulatedLink(vehicle, latency=0.05)
    link.receive(1.1)  # the first HEARTBEAT is in transit
    begin = link.now()
    assert upload(link).state == "verified"
    # Up to 1 s until its HEARTBEAT, and the listening time; two windows each of reading, writing and verifying; two
    # waits of two round trips; the storage; then the wait for the autosave, a HEARTBEAT and two windows.
    assert link.now() - begin < 1.0 + LISTEN_S + 1.1 + AUTOSAVE_S + 0.4
    most = 0
    for at, _ in link.log:
        most = max(most, sum(at <= t < at + 0.099 for t, m in link.log if not isinstance(m, StoreParameters)))
    assert most <= 12  # ten and a HEARTBEAT or two


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e39, -3.5e38])
def test_a_value_that_is_not_finite_in_single_precision_is_refused(value):
    with pytest.raises(SitlError, match="finite in single precision"):
        single(value)


senders = st.sampled_from([(1, 1), (1, 2), (2, 1), (0, 0)])
floats32 = st.floats(width=32)
messages = st.one_of(
    st.builds(lambda s, a: Heartbeat(*s, 12, a), senders.filter(lambda s: s != (1, 1)), st.booleans()),
    st.builds(
        lambda s, n, v, k: ParameterValue(*s, n, v, k),
        senders,
        st.sampled_from([*NAMES, "", "OTHER"]),
        floats32,
        st.integers(0, 255),
    ),
    st.builds(lambda s, n, r: ParameterRefusal(*s, n, r), senders, st.sampled_from([*NAMES, ""]), st.integers(0, 255)),
    st.builds(lambda s, c, r: CommandAck(*s, c, r), senders, st.sampled_from([245, 400]), st.integers(0, 255)),
)


@given(st.lists(messages, max_size=60), st.integers(0, 1000), st.sampled_from(["", *FAILING]))
@settings(max_examples=150, deadline=None)
def test_verified_is_true_whatever_other_messages_are_on_the_link(noise, seed, fault):
    vehicle = ScriptedVehicle(OLD, fault, faulty=NAMES[seed % 20], after=seed % 20)
    link = SimulatedLink(vehicle, seed, latency=0.02)
    for i, message in enumerate(noise):
        # Except a stray value with exactly the expected bits: it cannot be distinguished from an answer.
        if not (isinstance(message, ParameterValue) and message.value == NEW.get(message.name)):
            link.schedule(0.05 * i, "to ground", Received(SOLE_PEER, message))
    try:
        outcome = upload(link, tries=6, system=1)
    except SitlError:
        assert vehicle.values == OLD
        return
    if outcome.state == "verified":
        assert vehicle.values == NEW
    if outcome.state in ("rolled back", "untouched"):
        assert vehicle.values == OLD
