"""TCP and UDP sockets with an error that names the port and the option to change."""

from __future__ import annotations

import socket

from mimopilot.sitl.errors import SitlError

#: Default address: reachable from this machine only.
LOOPBACK = "127.0.0.1"


def listen(host: str, port: int, backlog: int = 1, option: str = "--port") -> socket.socket:
    """Open a listening TCP socket.

    Raises
    ------
    SitlError
        When the port cannot be bound.
    """
    server = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        server.bind((host, port))
        server.listen(backlog)
    except OSError as error:
        server.close()
        raise SitlError(
            f"TCP port {port} on {host} cannot be used: {error.strerror or error}; is another simulator "
            f"running? Choose another port with {option}"
        ) from error
    return server


def udp_socket(
    host: str, port: int, advice: str = "is another vehicle running? Choose another port with --vehicle-port"
) -> socket.socket:
    """Open a non-blocking UDP socket on a local port.

    Raises
    ------
    SitlError
        When the port cannot be bound.
    """
    link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        link.bind((host, port))
    except OSError as error:
        link.close()
        raise SitlError(f"UDP port {port} on {host} cannot be used: {error.strerror or error}; {advice}") from error
    link.setblocking(False)
    return link
