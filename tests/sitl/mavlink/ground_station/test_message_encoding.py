"""Encoding and parsing of the ground station's messages: every field, every bit, and damaged bytes."""

import random
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.mavlink.ground_station.connection import from_mavlink, to_mavlink
from mimopilot.sitl.mavlink.ground_station.events import (
    GroundHeartbeat,
    Heartbeat,
    ParameterRefusal,
    ParameterValue,
    ReadParameter,
    SetParameter,
    StoreParameters,
)
from mimopilot.sitl.mavlink.wire.codec import Codec
from mimopilot.sitl.mavlink.wire.signing import Signer
from tests.sitl.mavlink.scripted_vehicle import encode, float32

KEY = bytes(range(32))


def frames():
    """One of each message that an exchange receives, as bytes."""
    codec = Codec()
    messages = [
        Heartbeat(1, 1, 12, False),
        ParameterValue(1, 1, "MIMO_RP_RR", 0.125),
        ParameterValue(1, 1, "SIXTEEN_LETTERS_", -1.5),
        ParameterRefusal(1, 1, "MIMO_RP_RR", 2),
    ]
    return [codec.pack(encode(message)) for message in messages]


FRAMES = frames()


def changed(frame, place, byte):
    place %= len(frame)
    return frame[:place] + bytes([byte]) + frame[place + 1 :]


damage = st.one_of(
    st.binary(max_size=40),
    st.sampled_from(FRAMES),
    st.builds(changed, st.sampled_from(FRAMES), st.integers(0, 99), st.integers(0, 255)),
    st.builds(lambda frame, place: frame[: place % len(frame)], st.sampled_from(FRAMES), st.integers(0, 99)),
)


@given(st.lists(damage, max_size=30), st.booleans())
@settings(max_examples=300, deadline=None)
def test_the_parser_survives_any_bytes_and_finds_the_next_whole_frame(chunks, signed):
    codec = Codec(255, 190)
    if signed:
        codec.signer = Signer(KEY)
    for chunk in chunks:
        for message in codec.parse(chunk):
            from_mavlink(message)
    codec.signer = None
    # A false frame start may consume as many bytes as the longest frame.
    heard = [from_mavlink(message) for _ in range(20) for message in codec.parse(FRAMES[2])]
    assert heard[-1] == ParameterValue(1, 1, "SIXTEEN_LETTERS_", -1.5)


def test_random_bytes_are_never_parsed_as_a_message():
    codec, noise = Codec(255, 190), random.Random(0)
    heard = [from_mavlink(m) for _ in range(300) for m in codec.parse(noise.randbytes(1000))]
    assert [message for message in heard if message is not None] == []


@pytest.mark.parametrize(
    "order",
    [
        GroundHeartbeat(),
        ReadParameter(1, 1, "SIXTEEN_LETTERS_"),
        SetParameter(1, 1, "MIMO_RP_RR", 0.1),
        StoreParameters(1, 1),
    ],
    ids=lambda order: type(order).__name__,
)
def test_encoded_messages_decode_to_the_same_fields(order):
    (message,) = Codec().parse(Codec(255, 190).pack(to_mavlink(order)))
    assert (message.get_srcSystem(), message.get_srcComponent()) == (255, 190)
    if isinstance(order, SetParameter):
        assert (message.param_id, message.param_value, message.param_type) == ("MIMO_RP_RR", float32(0.1), 9)
    elif isinstance(order, ReadParameter):
        assert (message.param_id, message.param_index) == ("SIXTEEN_LETTERS_", -1)
    elif isinstance(order, StoreParameters):
        assert (message.command, message.param1, message.target_system) == (245, 1.0, 1)
    else:
        assert (message.type, message.autopilot) == (6, 8)


@pytest.mark.parametrize("number", [0, 1, 60, 1000000, -1, -(2**31), 2**31 - 1])
def test_integers_keep_their_bits_in_mavlink_messages(number):
    codec = Codec()
    (sent,) = codec.parse(codec.pack(to_mavlink(SetParameter(1, 1, "MIMO_EX_HMIN", float(number), 6))))
    assert struct.pack("<f", sent.param_value) == struct.pack("<i", number)
    echo = mavlink.MAVLink_param_value_message(b"MIMO_EX_HMIN", sent.param_value, 6, 1, 0)
    (heard,) = codec.parse(codec.pack(echo))
    assert from_mavlink(heard) == ParameterValue(1, 1, "MIMO_EX_HMIN", number, 6, place=0)
