"""The payload of MAVLink FTP against the layout in its guide, and its checksum against one computed bit by bit."""

from hypothesis import given
from hypothesis import strategies as st

from mimopilot.sitl.mavlink.wire.ftp import DATA_BYTES, FtpPacket, Nak, Opcode, crc32

BYTE = st.integers(0, 255)


def bitwise(data):
    checksum = 0
    for byte in data:
        checksum ^= byte
        for _ in range(8):
            checksum = checksum >> 1 ^ (0xEDB88320 if checksum & 1 else 0)
    return checksum


@given(st.binary(max_size=300), st.integers(0, 300))
def test_the_checksum_has_no_inversions_and_can_be_continued(data, cut):
    assert crc32(data) == bitwise(data)
    assert crc32(data[cut:], crc32(data[:cut])) == bitwise(data)


def test_the_checksum_of_the_usual_text():
    assert crc32(b"123456789") == 0x2DFD2D88


def test_fields_are_where_the_guide_says():
    packet = FtpPacket(0x1234, 5, Opcode.ACK, Opcode.BURST, True, 0x01020304, b"abc")
    assert packet.pack()[:16] == bytes([0x34, 0x12, 5, 128, 3, 15, 1, 0, 4, 3, 2, 1]) + b"abc\0"
    assert len(packet.pack()) == 251
    assert DATA_BYTES == 239
    read = FtpPacket(1, 0, Opcode.READ, offset=7, size=239)
    assert read.pack()[4] == 239


@given(
    st.integers(0, 65535), BYTE, BYTE, BYTE, st.booleans(), st.integers(0, 2**32 - 1), st.binary(max_size=DATA_BYTES)
)
def test_a_packet_is_unpacked_as_it_was_packed(sequence, session, opcode, request, complete, offset, data):
    packet = FtpPacket(sequence, session, opcode, request, complete, offset, data, len(data))
    assert FtpPacket.unpack(packet.pack()) == packet


@given(st.binary(min_size=251, max_size=251))
def test_any_payload_can_be_read(payload):
    packet = FtpPacket.unpack(payload)
    assert isinstance(packet.path + packet.reason, str)
    assert packet.code in range(256)


def test_a_refusal_says_why():
    request = FtpPacket(65535, 2, Opcode.OPEN, data=b"/x\0")
    refusal = request.refuse(Nak.ERRNO, 5)
    assert (refusal.sequence, refusal.session, refusal.request, refusal.code) == (0, 2, Opcode.OPEN, 2)
    assert refusal.reason == "error 5 (Input/output error)"
    assert request.refuse(Nak.NOT_FOUND).reason == "not found"
    assert request.refuse(99).reason == "error code 99"
    assert request.path == "/x"
