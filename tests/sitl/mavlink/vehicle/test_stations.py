"""Several ground stations at once over UDP and TCP: which messages each receives."""

import socket

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.vehicle import stations as module
from mimopilot.sitl.mavlink.vehicle.stations import MAX_STATIONS, Stations
from mimopilot.sitl.mavlink.wire.codec import Codec
from tests.sitl.mavlink.running import PATIENCE_S, wait_for

BEAT = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
PING = mavlink.MAVLink_ping_message(7, 8, 0, 0)


class Client:
    """A ground station."""

    def __init__(self, stations, tcp=False, port=0):
        self.codec, self.parser = Codec(255, 190), Codec()
        if tcp:
            self.link = socket.create_connection(stations.tcp.getsockname())
        else:
            self.link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self.link.bind(("127.0.0.1", port))
            self.link.connect(stations.udp.getsockname())
        self.link.settimeout(PATIENCE_S)

    def say(self, message):
        self.link.send(self.codec.pack(message))

    def hear(self):
        return [(m.get_type(), m.get_seq()) for m in self.parser.parse(self.link.recv(65536))]

    def silent(self):
        self.link.settimeout(0.05)
        with pytest.raises(TimeoutError):
            self.link.recv(1)
        return True


@pytest.fixture
def stations():
    opened = Stations(9, 0)
    opened.subscribe("HEARTBEAT", "PING")
    yield opened
    opened.close()


def take(stations):
    """Messages received in one call."""
    return [(message.get_type(), station) for message, station in stations.receive()]


def receive(stations, count):
    """Receive until this many messages have arrived."""
    heard = []
    wait_for(lambda: heard.extend(take(stations)) or len(heard) >= count)
    return heard


def receive_all(stations):
    """Receive all messages sent so far: loopback delivers at once, and each call takes some."""
    return [entry for _ in range(100) for entry in take(stations)]


def test_answers_go_to_the_requesting_station_and_telemetry_to_all(stations):
    clients = [Client(stations), Client(stations), Client(stations, tcp=True), Client(stations, tcp=True)]
    for client in clients:
        client.say(BEAT)
    assert len(receive(stations, 4)) == 4
    clients[2].say(PING)
    ((kind, station),) = receive(stations, 1)
    stations.post(mavlink.MAVLink_ping_message(7, 8, 255, 190), station)
    stations.deliver()
    assert clients[2].hear() == [("PING", 0)]
    stations.send(BEAT)
    # Each station has its own sequence numbers, so none sees gaps.
    assert [client.hear() for client in clients] == [[("HEARTBEAT", n)] for n in (0, 0, 1, 0)]
    assert kind == "PING"
    assert all(client.silent() for client in clients)


def test_the_configured_station_receives_messages_before_it_sends_any():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(PATIENCE_S)
        opened = Stations(listener.getsockname()[1], 0)
        opened.send(BEAT)
        assert [m.get_type() for m in Codec().parse(listener.recv(100))] == ["HEARTBEAT"]
        opened.close()


def test_a_sender_of_damaged_or_unsubscribed_frames_does_not_become_a_station(stations):
    stranger = Client(stations)
    stranger.link.send(b"\xfd\x09" + bytes(30))
    stranger.say(mavlink.MAVLink_attitude_message(0, 0, 0, 0, 0, 0, 0))  # intact, but not subscribed
    assert receive_all(stations) == []
    assert len(stations.by_address) == 1


def test_messages_to_other_vehicles_and_echoes_of_our_own_are_ignored(stations):
    client = Client(stations)
    client.say(mavlink.MAVLink_ping_message(1, 1, 7, 1))
    client.say(mavlink.MAVLink_ping_message(1, 1, 1, 50))
    client.link.send(Codec(1, 1).pack(PING))
    client.say(mavlink.MAVLink_ping_message(1, 1, 1, 1))
    assert [kind for kind, _ in receive_all(stations)] == ["PING"]


def test_a_new_station_beyond_the_limit_replaces_only_a_silent_one(stations, monkeypatch):
    clients = [Client(stations, tcp=kind) for kind in (True, False) for _ in range(MAX_STATIONS)]
    for client in clients:
        client.say(BEAT)
    assert len(receive(stations, len(clients))) == len(clients)
    late = [Client(stations), Client(stations, tcp=True)]
    late[0].say(BEAT)
    assert receive_all(stations) == []
    assert late[1].link.recv(1) == b""  # disconnected
    monkeypatch.setattr(module, "SILENCE_S", 0.0)
    late = [Client(stations), Client(stations, tcp=True)]
    for client in late:
        client.say(BEAT)
    assert len(receive(stations, 2)) == 2
    assert (len(stations.by_address), len(stations.connected)) == (MAX_STATIONS + 1, MAX_STATIONS)


def test_a_closed_connection_is_removed(stations):
    client = Client(stations, tcp=True)
    client.say(BEAT)
    assert len(receive(stations, 1)) == 1
    client.link.close()
    receive_all(stations)
    assert stations.connected == []
    stations.send(BEAT)


def test_a_foreign_bind_address_is_one_clear_error():
    with pytest.raises(SitlError, match=r"192\.0\.2\.1 cannot be used"):
        Stations(9, 0, bind="192.0.2.1")


FRAMES = [Codec(255, 190).pack(BEAT), Codec(255, 190).pack(PING)]


@given(st.lists(st.one_of(st.binary(max_size=60), st.sampled_from(FRAMES)), max_size=12), st.integers(1, 40))
@settings(max_examples=80, deadline=None)
def test_a_stream_parses_the_same_however_it_is_split(pieces, size):
    data = b"".join(pieces) + b"".join(FRAMES) * 20
    whole = [m.get_type() for m in Codec().parse(data)]
    codec = Codec()
    cut = [m.get_type() for start in range(0, len(data), size) for m in codec.parse(data[start : start + size])]
    assert cut == whole
    assert whole[-2:] == ["HEARTBEAT", "PING"]
    assert len(whole) >= sum(piece in FRAMES for piece in pieces)
