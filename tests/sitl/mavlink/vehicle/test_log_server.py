"""The vehicle's log server request by request, and its streams among a station's other messages."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.mavlink.vehicle.log_server import BURST_PIECES, LogServer
from mimopilot.sitl.mavlink.vehicle.stations import Station, Stations, TcpStation
from mimopilot.sitl.mavlink.wire.codec import Codec
from mimopilot.sitl.mavlink.wire.ftp import FtpPacket, Nak, Opcode, crc32
from tests.sitl.mavlink.log_transfer.logging_vehicle import OwnVehicle, content

SIZES = (1000, 239 * BURST_PIECES + 500, 0)


class Peer:
    """A ground station that sends single requests."""

    def __init__(self, vehicle):
        self.vehicle, self.station, self.sequence = vehicle, Station(Codec()), 100

    def ask(self, opcode, path="", **fields):
        self.sequence += 7
        return self.send(FtpPacket(self.sequence, 0, opcode, data=path.encode(), **fields))

    def send(self, packet):
        message = mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, packet.pack())
        (received,) = Codec().parse(Codec(255, 190).pack(message))
        answers = self.vehicle.server.handlers["FILE_TRANSFER_PROTOCOL"](received, self.station)
        answers += list(iter(self.station.take, None))
        assert all((a.target_system, a.target_component) == (255, 190) for a in answers)
        return [FtpPacket.unpack(bytes(a.payload)) for a in answers]


@pytest.fixture
def vehicle(tmp_path):
    return OwnVehicle(tmp_path, *SIZES)


@pytest.fixture
def peer(vehicle):
    return Peer(vehicle)


def test_only_its_own_logs_are_listed_and_opened(peer, tmp_path):
    (tmp_path / "secret.ulg").write_bytes(b"not a log of this vehicle")
    (listing,) = peer.ask(Opcode.LIST, "/log")
    assert listing.data == b"Fflight-1.ulg\t1000\0Fflight-2.ulg\t36350\0Fflight-3.ulg\t0\0"
    assert peer.ask(Opcode.LIST, "@MAV_LOG", offset=2)[0].data == b"Fflight-3.ulg\t0\0"
    assert peer.ask(Opcode.LIST, "/log", offset=3)[0].code == Nak.END
    assert peer.ask(Opcode.LIST, "/")[0].data == b"Dlog\0"
    for path in ("/log/secret.ulg", "/log/../secret.ulg", str(tmp_path / "secret.ulg"), "flight-1.ulg", ""):
        for opcode in (Opcode.OPEN, Opcode.CRC):
            assert peer.ask(opcode, path)[0].code == Nak.NOT_FOUND, path
    for opcode in (6, 7, 8, 9, 10, 11, 12, 13, 200):  # whatever writes
        assert peer.ask(opcode, "/log/flight-1.ulg")[0].code == Nak.UNKNOWN_COMMAND
    assert peer.ask(Opcode.READ, size=10)[0].code == Nak.SESSION
    assert peer.ask(Opcode.BURST, size=10)[0].code == Nak.SESSION


def test_a_burst_has_the_files_bytes_and_says_where_it_ends(peer):
    (opened,) = peer.ask(Opcode.OPEN, "/log/flight-2.ulg")
    assert int.from_bytes(opened.data, "little") == SIZES[1]
    first = peer.ask(Opcode.BURST, size=239)
    assert (len(first), [p.complete for p in first]) == (BURST_PIECES, [False] * (BURST_PIECES - 1) + [True])
    assert [p.sequence for p in first] == list(range(peer.sequence + 1, peer.sequence + 1 + BURST_PIECES))
    rest = peer.ask(Opcode.BURST, size=239, offset=239 * BURST_PIECES)
    assert rest.pop().code == Nak.END
    assert b"".join(p.data for p in first + rest) == content(SIZES[1], 1)
    assert peer.ask(Opcode.READ, offset=36_300, size=239)[0].data == content(SIZES[1], 1)[36_300:]
    assert peer.ask(Opcode.READ, offset=SIZES[1], size=1)[0].code == Nak.END
    (checksum,) = peer.ask(Opcode.CRC, "log/flight-2.ulg")
    assert int.from_bytes(checksum.data, "little") == crc32(content(SIZES[1], 1))


def test_a_repeated_request_gets_its_first_reply_and_one_file_is_open_at_a_time(peer):
    packet = FtpPacket(5, 0, Opcode.OPEN, data=b"/log/flight-1.ulg")
    assert peer.send(packet) == peer.send(packet)
    assert peer.ask(Opcode.OPEN, "/log/flight-1.ulg")[0].code == Nak.NO_SESSIONS
    assert not peer.ask(Opcode.RESET)[0].code
    assert not peer.ask(Opcode.OPEN, "/log/flight-2.ulg")[0].code
    other = Peer(peer.vehicle)  # each station has its own file
    assert not other.ask(Opcode.OPEN, "/log/flight-1.ulg")[0].code


def test_a_log_that_has_gone_from_the_disk_is_said(peer, tmp_path):
    (tmp_path / "flight-1.ulg").unlink()
    assert peer.ask(Opcode.OPEN, "/log/flight-1.ulg")[0].code == Nak.NOT_FOUND
    (tmp_path / "flight-1.ulg").mkdir()
    (refusal,) = peer.ask(Opcode.OPEN, "/log/flight-1.ulg")
    assert refusal.reason == "error 21 (Is a directory)"
    request = mavlink.MAVLink_log_request_data_message(1, 1, 0, 90, 90)
    peer.vehicle.server.handlers["LOG_REQUEST_DATA"](request, peer.station)
    data = peer.station.take()
    assert (data.ofs, data.count) == (90, 0)


@given(st.binary(min_size=251, max_size=251))
def test_no_payload_breaks_the_server(payload):
    station = Station(Codec())
    message = mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, payload)
    (received,) = Codec().parse(Codec(255, 190).pack(message))
    (answer,) = LogServer([]).handlers["FILE_TRANSFER_PROTOCOL"](received, station)
    assert bytes(answer.payload)[3] in (Opcode.ACK, Opcode.NAK)


def test_a_stream_waits_for_answers_and_for_a_slow_reader(monkeypatch):
    monkeypatch.setattr("mimopilot.sitl.mavlink.vehicle.stations.BUDGET_S", 60.0)  # what is tested is the count
    stations = Stations(9, 0)
    try:
        (station,) = stations._all
        sent = []
        station.send = sent.append
        station.stream = iter(range(20))
        station.answers.extend("ab")
        stations.deliver()
        assert sent == ["a", "b", 0, 1, 2, 3, 4, 5]
        stations.deliver()
        stations.deliver()
        assert sent[8:] == list(range(6, 20))
        assert station.stream is None
    finally:
        stations.close()


def test_a_full_tcp_connection_pauses_its_stream():
    class Full:
        def setblocking(self, on):
            pass

        def setsockopt(self, *option):
            pass

        def send(self, data):
            if self.full:
                raise BlockingIOError
            return len(data)

    link = Full()
    station = TcpStation(Codec(), link)
    link.full = True
    station.transmit(b"1234")
    station.stream = iter(range(5))
    assert station.take() is None
    link.full = False
    assert station.take() == 0
    assert station.unsent == b""
