"""MAVLink 2 signing: compatible with pymavlink's, and safe against forged and replayed frames."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.mavlink.wire.codec import Codec
from mimopilot.sitl.mavlink.wire.signing import EPOCH_S, UNITS_PER_S, Signer

KEY = bytes(range(32))
NOW = 1.7e9
PING = mavlink.MAVLink_ping_message(1, 2, 1, 1)


def signer(key=KEY, now=NOW):
    return Signer(key, lambda: now)


def heard(codec, frame):
    return [message.get_type() for message in codec.parse_datagram(frame)]


def theirs(key=KEY, now=NOW):
    """pymavlink's end of a signed link."""
    mav = mavlink.MAVLink(None, 255, 190)
    mav.robust_parsing = True
    mav.signing.secret_key, mav.signing.sign_outgoing = key, True
    mav.signing.timestamp = int((now - EPOCH_S) * UNITS_PER_S)
    return mav


def test_pymavlink_accepts_our_signed_frames_and_we_accept_its():
    ours, mav = Codec(signer=signer()), theirs()
    for _ in range(3):
        (message,) = mav.parse_buffer(ours.pack(PING))
        assert (message.get_type(), message.get_signed()) == ("PING", True)
        assert heard(ours, PING.pack(mav)) == ["PING"]


@given(place=st.integers(0, 200), bit=st.integers(0, 7))
def test_a_signed_frame_with_one_bit_changed_is_dropped(place, bit):
    frame = bytearray(Codec(255, 190, signer()).pack(PING))
    frame[place % len(frame)] ^= 1 << bit
    assert heard(Codec(signer=signer()), bytes(frame)) == []


def test_unsigned_frames_and_those_of_another_key_are_dropped_and_counted():
    codec = Codec(signer=signer())
    assert heard(codec, Codec(255, 190).pack(PING)) == []
    assert heard(codec, Codec(255, 190, signer(KEY[::-1])).pack(PING)) == []
    assert heard(codec, PING.pack(mavlink.MAVLink(None, 255, 190), force_mavlink1=True)) == []
    assert codec.refused == 3


def test_a_replayed_frame_is_dropped_on_every_link_of_the_vehicle():
    shared = signer()
    over_udp, over_tcp = Codec(signer=shared), Codec(signer=shared)
    sender = Codec(255, 190, signer())
    first, second = sender.pack(PING), sender.pack(PING)
    assert heard(over_udp, second) == ["PING"]
    assert heard(over_udp, second) == []
    assert heard(over_tcp, second) == []
    assert heard(over_tcp, first) == []


def test_the_first_timestamp_of_a_stream_may_lag_by_at_most_a_minute():
    for late, taken in ((59.0, ["PING"]), (61.0, [])):
        assert heard(Codec(signer=signer()), Codec(255, 190, signer(now=NOW - late)).pack(PING)) == taken


def test_a_lagging_clock_is_distinguished_from_a_wrong_key():
    for key, late, behind in ((KEY, 3600.0, 3600.0), (KEY[::-1], 3600.0, 0.0), (KEY, 0.0, 0.0)):
        ours = signer()
        heard(Codec(signer=ours), Codec(255, 190, signer(key, NOW - late)).pack(PING))
        assert ours.behind == pytest.approx(behind, abs=0.1)


def test_a_forged_timestamp_does_not_block_the_stream_that_it_names():
    codec, sender = Codec(signer=signer()), Codec(255, 190, signer())
    forged = bytearray(sender.pack(PING))
    forged[-12:-6] = b"\xff" * 6
    assert heard(codec, bytes(forged)) == []
    assert heard(codec, sender.pack(PING)) == ["PING"]


def test_our_timestamps_increase_even_when_the_clock_goes_back():
    times = iter([NOW, NOW - 100, NOW - 100, NOW + 1])
    ours, mav = Codec(signer=Signer(KEY, lambda: next(times))), theirs()
    for _ in range(4):
        assert [m.get_type() for m in mav.parse_buffer(ours.pack(PING))] == ["PING"]
