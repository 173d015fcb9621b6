"""TCP and UDP sockets with an error that names the port and the option to change."""

from __future__ import annotations

import errno
import socket

from mimopilot.sitl.errors import SitlError

#: Default address: reachable from this machine only.
LOOPBACK = "127.0.0.1"
#: Linux lets only root bind lower ports.
PRIVILEGED = 1024


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
        advice = f"is another simulator running? Choose another port with {option}"
        raise _refused("TCP", host, port, error, advice) from error
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
        raise _refused("UDP", host, port, error, advice) from error
    link.setblocking(False)
    return link


def _refused(protocol: str, host: str, port: int, error: OSError, advice: str) -> SitlError:
    if isinstance(error, PermissionError) and port < PRIVILEGED:
        advice = f"ports below {PRIVILEGED} are reserved for the system; choose one above"
    elif isinstance(error, socket.gaierror):
        advice = "give the name or address of this machine"
    elif error.errno == errno.EADDRNOTAVAIL:
        advice = f"this machine has no such address; give {LOOPBACK}, or 0.0.0.0 for all that it has"
    return SitlError(f"{protocol} port {port} on {host} cannot be used: {error.strerror or error}; {advice}")
