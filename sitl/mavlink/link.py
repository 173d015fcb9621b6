"""MAVLink 2 over sockets: packing, parsing, and waiting for bytes."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from sitl.errors import SitlError

SYSTEM, COMPONENT = 1, 1
LOOPBACK = "127.0.0.1"


class Codec:
    """Packs and parses messages of one peer.

    Parameters
    ----------
    system, component : int
        Identity in outgoing messages.
    """

    def __init__(self, system: int = SYSTEM, component: int = COMPONENT) -> None:
        self.mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        self.mav.robust_parsing = True

    def pack(self, message: Any) -> bytes:
        """Bytes of one message, with this peer's sequence number."""
        packed: bytes = message.pack(self.mav)
        self.mav.seq = (self.mav.seq + 1) % 256
        return packed

    def parse(self, data: bytes) -> Iterator[Any]:
        """Whole messages in the stream so far; damaged ones are dropped."""
        for message in self.mav.parse_buffer(data) or []:
            if message.get_type() != "BAD_DATA":
                yield message


def listen(host: str, port: int, backlog: int = 1) -> socket.socket:
    """A listening TCP socket.

    Raises
    ------
    SitlError
        When the port is in use.
    """
    server = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        server.bind((host, port))
        server.listen(backlog)
    except OSError as error:
        server.close()
        raise SitlError(
            f"TCP port {port} on {host} cannot be used: {error.strerror}; is another simulator "
            "running? Choose another port with --port"
        ) from error
    return server


def udp_socket(
    host: str, port: int, advice: str = "is another vehicle running? Choose another port with --vehicle-port"
) -> socket.socket:
    """A non-blocking UDP socket bound to a local port.

    Raises
    ------
    SitlError
        When the port is in use.
    """
    link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        link.bind((host, port))
    except OSError as error:
        link.close()
        raise SitlError(f"UDP port {port} on {host} cannot be used: {error.strerror or error}; {advice}") from error
    link.setblocking(False)
    return link
