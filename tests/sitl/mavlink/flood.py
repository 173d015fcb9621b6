"""Delay of the control loop when a ground station floods it: `python -m tests.sitl.mavlink.flood`.

The vehicle runs in real time, with its plant; this process floods it as fast as it can send.
"""

import os
import re
import signal
import socket
import time
from typing import NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from mimopilot.common.console import print_table
from mimopilot.sitl.mavlink.wire.codec import Codec
from tests.sitl.mavlink.running import running_sitl


class FloodResult(NamedTuple):
    """Control periods, the longest response (ms), responses longer than a millisecond, and datagrams sent."""

    periods: int
    worst_ms: float
    late: int
    sent: int


def datagrams(sort):
    """Datagrams of one sort of flood."""
    codec = Codec(255, 190)

    def pack(message):
        return codec.pack(message)

    if sort == "junk":
        return [os.urandom(300) for _ in range(50)]
    if sort == "list requests, 60 in a datagram":
        return [b"".join(pack(mavlink.MAVLink_param_request_list_message(1, 1)) for _ in range(60)) for _ in range(50)]
    if sort == "parameters set":
        values = (0.15 + 1e-5 * i for i in range(50))
        return [pack(mavlink.MAVLink_param_set_message(1, 1, b"MIMO_RP_RR", value, 9)) for value in values]
    raise ValueError(sort)


SORTS = ("junk", "list requests, 60 in a datagram", "parameters set")


def flood(port, sort, seconds):
    """Flood a port for a time, s; return the number of datagrams sent."""
    link, sent, end = socket.socket(socket.AF_INET, socket.SOCK_DGRAM), 0, time.monotonic() + seconds
    pieces = datagrams(sort)
    with link:
        while time.monotonic() < end:
            for piece in pieces:
                link.sendto(piece, ("127.0.0.1", port))
            sent += len(pieces)
    return sent


def measure(sort="", seconds=10.0):
    """Run a vehicle for a time, s, flooded or not."""
    with running_sitl() as sitl:
        sitl.until("plant connected")
        sent = flood(sitl.local, sort, seconds) if sort else time.sleep(seconds) or 0
        sitl.process.send_signal(signal.SIGINT)
        sitl.until("after more than")
    found = re.search(r"(\d+) periods, answered within ([\d.]+) ms, (\d+) of them", sitl.output)
    return FloodResult(int(found[1]), float(found[2]), int(found[3]), sent)


def rows():
    """One row without a flood, and one for each sort."""
    found = []
    for sort in ("", *SORTS):
        seen = measure(sort)
        load = f"{seen.sent / 10:.0f} datagrams/s of {sort}" if sort else "no flood"
        title = f"control loop, 10 s of real time, {load}"
        found.append([title, f"{seen.worst_ms:.1f} ms late at worst", f"{seen.late} of {seen.periods} above 1 ms"])
    return found


def main():
    print_table("Flood from a ground station", ["what", "figure", "beside"], rows())
    print(f"load of this machine, {os.cpu_count()} cores: {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    main()
