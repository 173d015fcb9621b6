"""Packets of CRTP that an upload needs: parameters (second version of the protocol), supervisor, protocol version.

Described in crazyflie-firmware, docs/functional-areas/crtp/. No link and no clock.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import NamedTuple

from mimopilot.sitl.errors import SitlError

#: Ports.
PARAM, SUPERVISOR, PLATFORM = 0x02, 0x09, 0x0D
#: Channels of the parameters' port.
TOC, READ, WRITE, MISC = 0, 1, 2, 3
#: Channels of the other two ports.
INFO, VERSION = 0, 1
#: Commands of the table of contents, of MISC, of the supervisor and of the version; the supervisor's answer has
#: another bit.
ITEM, COUNT, UPDATED, STORE, STATE_BITS, PROTOCOL = 2, 3, 1, 3, 0x0C, 0
ANSWER = 0x80
#: First protocol version with the supervisor's port (crazyflie-firmware 2026.04).
SUPERVISOR_SINCE = 12
#: Bits of the supervisor's state.
ARMED, AUTO_ARMED, FLYING = 1 << 1, 1 << 2, 1 << 4
#: Error number of a parameter that does not exist (ENOENT).
NOT_FOUND = 2
#: Type of a parameter, without its flags -> format of `struct`, whether single precision holds every value exactly.
TYPES = {
    **{0x00: ("<b", True), 0x01: ("<h", True), 0x02: ("<i", False), 0x03: ("<q", False), 0x05: ("<e", True)},
    **{0x06: ("<f", True), 0x07: ("<d", False)},
    **{0x08: ("<B", True), 0x09: ("<H", True), 0x0A: ("<I", False), 0x0B: ("<Q", False)},
}
TYPE, READ_ONLY = 0x0F, 0x40


class Packet(NamedTuple):
    """One packet: port, channel, at most 30 bytes."""

    port: int
    channel: int
    data: bytes


@dataclass(frozen=True)
class TocEntry:
    """A parameter in the table of contents.

    Attributes
    ----------
    number : int
        Its number in the packets.
    name : str
        ``group.name``.
    format : str
        Of `struct`; empty: not known.
    exact : bool
        Whether single precision holds every value.
    read_only : bool
    """

    number: int
    name: str
    format: str
    exact: bool
    read_only: bool


def request_version() -> Packet:
    """Ask for the version of the protocol."""
    return Packet(PLATFORM, VERSION, bytes([PROTOCOL]))


def request_count() -> Packet:
    """Ask for the length of the table of contents."""
    return Packet(PARAM, TOC, bytes([COUNT]))


def request_item(number: int) -> Packet:
    """Ask for an entry of the table of contents."""
    return Packet(PARAM, TOC, struct.pack("<BH", ITEM, number))


def request_state() -> Packet:
    """Ask whether the vehicle is armed and flies."""
    return Packet(SUPERVISOR, INFO, bytes([STATE_BITS]))


def request_value(entry: TocEntry) -> Packet:
    """Ask for the value of a parameter."""
    return Packet(PARAM, READ, struct.pack("<H", entry.number))


def write_value(entry: TocEntry, value: float) -> Packet:
    """Set a parameter.

    Raises
    ------
    SitlError
        When its type cannot hold the value.
    """
    whole = entry.format[1:] not in "efd"
    try:
        data = struct.pack(entry.format, int(value) if whole and value == int(value) else value)
    except (struct.error, OverflowError, ValueError) as error:
        raise SitlError(f"{entry.name}: got {value:.6g}, which its type on the vehicle cannot hold") from error
    return Packet(PARAM, WRITE, struct.pack("<H", entry.number) + data)


def store_value(entry: TocEntry) -> Packet:
    """Store the present value of a parameter, so that the vehicle starts with it."""
    return Packet(PARAM, MISC, struct.pack("<BH", STORE, entry.number))


def parsed_entry(data: bytes) -> TocEntry | None:
    """Entry in the answer to `request_item`; None: the answer is none or damaged."""
    if len(data) < 5:
        return None
    _, number, kind = struct.unpack_from("<BHB", data)
    group, _, rest = data[4:].partition(b"\0")
    name = rest.split(b"\0")[0]
    try:
        full = f"{group.decode('ascii')}.{name.decode('ascii')}"
    except UnicodeDecodeError:
        return None
    form, exact = TYPES.get(kind & TYPE, ("", False))
    return TocEntry(number, full, form, exact, bool(kind & READ_ONLY))


def parsed_value(entry: TocEntry, data: bytes) -> float | None:
    """Value of a parameter in the bytes of its type; None: they are too few."""
    if not entry.format or len(data) < struct.calcsize(entry.format):
        return None
    return float(struct.unpack_from(entry.format, data)[0])
