"""The fast codec writes and reads the same bytes as pymavlink, and no noise blocks it."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.mavlink.wire.codec import Codec
from mimopilot.sitl.mavlink.wire.fast_codec import ACTUATORS, GPS, SENSOR, STATE, FastCodec

KINDS = [SENSOR, STATE, GPS, ACTUATORS, mavlink.MAVLink_heartbeat_message, mavlink.MAVLink_command_long_message]
BITS = {"B": 8, "H": 16, "h": 16, "I": 32, "i": 32, "Q": 64}


def field(letter):
    if letter == "f":
        return st.floats(width=32)
    bits, signed = BITS[letter], letter.islower()
    # Trailing zeros are cut off on the wire, so they must occur often.
    low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
    return st.one_of(st.just(0), st.integers(low, high))


def letters(kind):
    pairs = re.findall(r"(\d*)([a-zA-Z])", kind.unpacker.format)
    return [letter for count, letter in pairs for _ in range(int(count or 1))]


@st.composite
def messages(draw):
    kind = draw(st.sampled_from(KINDS))
    return kind, tuple(draw(field(letter)) for letter in letters(kind))


def pymavlink_message(kind, wire):
    """The same message as a pymavlink object."""
    wire, values = list(wire), {}
    for name, length in zip(kind.ordered_fieldnames, kind.array_lengths, strict=True):
        taken, wire = wire[: max(1, length)], wire[max(1, length) :]
        values[name] = taken if length else taken[0]
    return kind(**{name: values[name] for name in kind.fieldnames})


def bits(fields):
    return [np.float32(f).tobytes() if isinstance(f, float) else f for f in fields]


@given(st.lists(messages(), min_size=1, max_size=5))
def test_packed_bytes_equal_those_of_pymavlink_and_parse_to_the_same_fields(sent):
    fast, generic = FastCodec(1, 2), Codec(1, 2)
    packed = [fast.pack(kind, *fields) for kind, fields in sent]
    assert packed == [generic.pack(pymavlink_message(kind, fields)) for kind, fields in sent]
    received = FastCodec(9, 9).parse(b"".join(packed))
    assert [(kind, bits(fields)) for kind, fields in received] == [(kind, bits(fields)) for kind, fields in sent]


@given(st.lists(st.one_of(messages(), st.binary(min_size=1, max_size=40)), max_size=8), st.data())
def test_every_complete_message_is_found_in_noise_however_the_stream_is_split(parts, data):
    writer, reader = FastCodec(1, 1), FastCodec(1, 1)
    pieces = [part if isinstance(part, bytes) else writer.pack(part[0], *part[1]) for part in parts]
    stream, found = b"".join(pieces), []
    while stream:
        cut = data.draw(st.integers(1, len(stream)))
        found += reader.parse(stream[:cut])
        stream = stream[cut:]
    wanted = [(kind, bits(fields)) for kind, fields in (part for part in parts if not isinstance(part, bytes))]
    # Noise holds a complete message only if its checksum fits, which hypothesis does not find.
    assert [(kind, bits(fields)) for kind, fields in found] == wanted
    assert reader.skipped <= sum(len(part) for part in parts if isinstance(part, bytes))


@pytest.mark.parametrize("noise", [b"\xfd", b"\xfd\xff\x00", b"\xfd\xff" + bytes(7), bytes(300), b"\xfe" * 9])
def test_noise_that_looks_like_the_start_of_a_long_message_does_not_hold_back_the_next(noise):
    codec = FastCodec(1, 1)
    answer = codec.pack(ACTUATORS, 5, 1, *[0.5] * 16, 128)
    assert codec.parse(noise) == []
    assert [fields[0] for _, fields in codec.parse(answer)] == [5]
    assert codec.skipped == len(noise)


def test_a_message_with_one_bit_flipped_is_dropped():
    codec = FastCodec(1, 1)
    answer = codec.pack(ACTUATORS, 5, 1, *[0.5] * 16, 128)
    for bit in range(8 * len(answer)):
        damaged = bytearray(answer)
        damaged[bit // 8] ^= 1 << bit % 8
        assert FastCodec(1, 1).parse(bytes(damaged)) == []


def test_a_signed_message_is_parsed():
    signed = mavlink.MAVLink(None, 1, 1)
    signed.signing.secret_key, signed.signing.sign_outgoing = bytes(32), True
    data = mavlink.MAVLink_hil_actuator_controls_message(7, [0.25] * 16, 128, 1).pack(signed)
    assert len(data) > len(FastCodec(1, 1).pack(ACTUATORS, 7, 1, *[0.25] * 16, 128))
    codec = FastCodec(1, 1)
    assert codec.parse(data * 2) == [(ACTUATORS, (7, 1, *[0.25] * 16, 128))] * 2
    assert codec.skipped == 0
