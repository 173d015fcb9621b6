"""Uploads that a link loss, Ctrl-C or an arming vehicle interrupts, in simulated time."""

import pytest

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.events import SOLE_PEER, SetParameter, run_exchange
from mimopilot.sitl.mavlink.ground_station.parameter_protocol import ParameterClient
from mimopilot.sitl.mavlink.ground_station.upload import read_values, write_and_verify
from tests.sitl.mavlink.ground_station.test_parameter_protocol import NAMES, NEW, OLD, upload
from tests.sitl.mavlink.scripted_vehicle import ScriptedVehicle, SimulatedLink


@pytest.mark.parametrize("after", range(len(NAMES) + 1))
def test_a_link_loss_after_any_write_reports_every_changed_parameter(after):
    vehicle = ScriptedVehicle(OLD, "disconnects", after=after)
    outcome = upload(SimulatedLink(vehicle))
    if after == len(NAMES):
        assert outcome.state == "verified"
        return
    assert outcome.state == "mixed"
    assert sum(value != OLD[name] for name, value in vehicle.values.items()) == after
    reported = {name for name, values in outcome.held.items() if values != (OLD[name],)}
    for name, value in vehicle.values.items():
        assert value in outcome.held[name]
        assert value == OLD[name] or name in reported


def test_a_link_loss_at_any_message_reports_every_changed_parameter():
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


def test_a_link_restored_in_time_ends_with_the_old_values():
    vehicle = ScriptedVehicle(OLD)
    link = SimulatedLink(vehicle)
    write = vehicle.write

    def write_with_link_loss(name, value):
        if vehicle.writes == 5 and link.up:
            link.up = False
            link.schedule(link.time + 15.0, "back", None)
        return write(name, value)

    vehicle.write = write_with_link_loss
    receive = link.receive

    def receive_after_return(until):
        if not link.up and any(kind == "back" and at <= until for at, _, kind, _ in link.queue):
            link.up = True
        return [heard for heard in receive(until) if heard is not None]

    link.receive = receive_after_return
    outcome = upload(link)
    assert outcome.state == "rolled back", outcome
    assert vehicle.values == OLD


def test_ctrl_c_between_any_two_writes_ends_with_the_old_values():
    for count in range(1, 20):
        vehicle = ScriptedVehicle(OLD)
        link = SimulatedLink(vehicle, latency=0.05)
        client = ParameterClient(link.now())
        run_exchange(client.await_heartbeat(), link)
        held = run_exchange(read_values(client, NAMES), link)
        answer = vehicle.answer

        def interrupted(order, client=client, vehicle=vehicle, answer=answer, count=count):
            client.interrupted = vehicle.writes >= count
            return answer(order)

        vehicle.answer = interrupted
        outcome = run_exchange(write_and_verify(client, NEW, held), link)
        assert (outcome.state, vehicle.values) == ("rolled back", OLD)
        assert "interrupted" in outcome.reason


@pytest.mark.parametrize("stored", [0.0, 7.0])
def test_the_number_of_the_firmware_never_stands_beside_a_part_of_a_set(stored):
    """With any other number a vehicle does not fly its stored values: 7 is its own."""
    old, new = OLD | {"LOCK": stored}, NEW | {"LOCK": 7.0}
    states = set()
    for count in (1, 4, len(NEW), len(NEW) + 1, 99):
        for fault in ("", "disconnects"):
            vehicle = ScriptedVehicle(old, fault, after=count)
            link = SimulatedLink(vehicle, latency=0.05)
            client = ParameterClient(link.now())
            run_exchange(client.await_heartbeat(), link)
            held = run_exchange(read_values(client, list(new)), link)
            write, seen = vehicle.write, []

            def noting(name, value, vehicle=vehicle, write=write, seen=seen, client=client, count=count, fault=fault):
                answer = write(name, value)
                client.interrupted = not fault and vehicle.writes >= count
                seen.append(dict(vehicle.values))
                return answer

            vehicle.write = noting
            outcome = run_exchange(write_and_verify(client, new, held, lock="LOCK"), link)
            states.add(outcome.state)
            assert all(values in (old, new) or {**values, "LOCK": 7.0} == new for values in seen if values["LOCK"] == 7)
            assert all(value in outcome.held[name] for name, value in vehicle.values.items())
            assert vehicle.values == {"verified": new, "rolled back": old}.get(outcome.state, vehicle.values)
    assert states == {"verified", "rolled back", "mixed"}


def test_no_new_value_is_written_after_the_vehicle_arms():
    vehicle = ScriptedVehicle(OLD, "arms", after=3)
    link = SimulatedLink(vehicle, latency=0.2)
    beats = []
    heartbeat = vehicle.heartbeat
    vehicle.heartbeat = lambda: beats.append((link.time, vehicle.armed)) or heartbeat()
    outcome = upload(link)
    assert outcome.state == "rolled back"
    heard = next(at for at, armed in beats if armed) + link.latency
    late = [m for at, m in link.log if at > heard and isinstance(m, SetParameter)]
    assert late
    assert all(m.value == OLD[m.name] for m in late)


def test_an_armed_vehicle_is_written_only_if_forced():
    for forced, state in ((False, "untouched"), (True, "verified")):
        vehicle = ScriptedVehicle(OLD)
        vehicle.armed = True
        link = SimulatedLink(vehicle)
        outcome = upload(link, force_armed=forced)
        assert outcome.state == state
        assert any(isinstance(m, SetParameter) for _, m in link.log) == forced


def test_writing_waits_for_a_heartbeat_if_the_last_one_is_old():
    vehicle = ScriptedVehicle(OLD)
    link = SimulatedLink(vehicle)
    client = ParameterClient(link.now())
    run_exchange(client.await_heartbeat(), link)
    held = run_exchange(read_values(client, NAMES), link)
    link.time += 60.0  # the user reads the table; meanwhile the vehicle arms
    link.queue.clear()
    vehicle.armed = True
    link.schedule(link.time + 0.7, "beat", SOLE_PEER)
    client.resume(link.now())
    outcome = run_exchange(write_and_verify(client, NEW, held), link)
    assert (outcome.state, vehicle.writes) == ("untouched", 0)
