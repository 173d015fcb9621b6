"""Hostile datagrams, a few tens of thousands; `python -m tests.sitl.mavlink.hostile` sends a million."""

import pytest
from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.mavlink.vehicle import stations
from mimopilot.sitl.mavlink.wire import codec
from tests.sitl.mavlink.hostile import KEY, VehicleUnderAttack, attack, drain

SEED = 7


@pytest.fixture
def target():
    vehicle = VehicleUnderAttack()
    yield vehicle
    vehicle.close()


@pytest.mark.parametrize("key", [None, KEY], ids=["unsigned", "signed"])
def test_no_hostile_datagram_changes_or_blocks_a_vehicle_in_the_air(key):
    vehicle = VehicleUnderAttack(key)
    try:
        sent = attack(vehicle, 10_000, SEED)
        assert min(sent.values()) > 400
        # It still accepts an authorised change.
        change = mavlink.MAVLink_param_set_message(1, 1, b"MIMO_RP_RR", 0.125, 9)
        assert "PARAM_VALUE" in vehicle.answers(change)
        assert vehicle.server.values["MIMO_RP_RR"] == 0.125
    finally:
        vehicle.close()


def test_a_vehicle_with_a_key_ignores_unsigned_messages():
    vehicle = VehicleUnderAttack(KEY)
    try:
        vehicle.friend.signer = None
        before = vehicle.snapshot()
        for message in (
            mavlink.MAVLink_param_set_message(1, 1, b"MIMO_RP_RR", 0.125, 9),
            mavlink.MAVLink_command_long_message(1, 1, mavlink.MAV_CMD_NAV_LAND, 0, *[0] * 7),
            mavlink.MAVLink_param_request_read_message(1, 1, b"MIMO_RP_RR", -1),
        ):
            assert not {"PARAM_VALUE", "COMMAND_ACK"} & set(vehicle.answers(message, wait=0.3))
        assert vehicle.snapshot() == before
        assert vehicle.stations.datagrams.refused == 3
    finally:
        vehicle.close()


def test_one_call_of_receive_stays_within_its_time_budget(target, monkeypatch):
    clock = iter(range(10**9))
    monkeypatch.setattr(stations.time, "perf_counter", lambda: next(clock) * stations.BUDGET_S / 10)
    question = target.friend.pack(mavlink.MAVLink_param_request_read_message(1, 1, b"MIMO_RP_RR", -1))
    for _ in range(5):
        target.attacker.sendto(question * 20, target.udp)
    heard = len(list(target.stations.receive()))
    assert 5 <= heard <= 11
    # The rest is received in the next calls, none twice.
    for _ in range(30):
        heard += len(list(target.stations.receive()))
    assert heard == 100


@pytest.mark.parametrize("piece", [b"\xfe", b"\xfe\xfe\0\0\0\x6e", b"\xfd\xff\0\0\0\0\0\x6e\0\0"])
def test_a_stream_of_false_frame_starts_stays_within_the_time_budget(target, monkeypatch, piece):
    clock, looked_at, is_intact = iter(range(10**9)), [], codec._is_intact
    monkeypatch.setattr(stations.time, "perf_counter", lambda: next(clock) * stations.BUDGET_S / 10)
    monkeypatch.setattr(codec, "_is_intact", lambda frame: looked_at.append(len(frame)) or is_intact(frame))
    target.tcp.sendall((piece * 2000)[:2000])
    deepest = turns = 0
    while sum(looked_at) < 20_000:
        before = len(looked_at)
        assert list(target.stations.receive()) == []
        deepest, turns = max(deepest, len(looked_at) - before), turns + 1
    assert deepest <= 11
    assert turns >= 5


def test_a_station_that_never_reads_does_not_block(target):
    question = target.friend.pack(mavlink.MAVLink_param_request_list_message(1, 1))
    for _ in range(3000):
        target.tcp.sendall(question)
        target.turn()
    (station,) = target.stations.connected or [None]
    assert station is None or len(station.unsent) <= stations.MAX_UNSENT
    assert len(target.stations.by_address[target.attacker.getsockname()].answers) == 0
    drain(target.attacker)
    assert "PARAM_VALUE" in target.answers(mavlink.MAVLink_param_request_read_message(1, 1, b"MIMO_RP_RR", -1))
