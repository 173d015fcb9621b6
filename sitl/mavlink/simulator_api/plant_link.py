"""The autopilot's TCP link to a plant: connects, and reconnects when the plant is lost, without blocking."""

from __future__ import annotations

import errno
import select
import socket
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.simulator_api.plant_process import PlantProcess
from mimopilot.sitl.mavlink.wire.codec import COMPONENT, SYSTEM
from mimopilot.sitl.mavlink.wire.fast_codec import ACTUATORS, ARMED, LOCKSTEP, READ_BYTES, FastCodec, Message
from mimopilot.sitl.mavlink.wire.sockets import LOOPBACK

RETRY_S = 0.2  # s between attempts to connect; chosen
RESTART_S = 1.0  # s between attempts to start the plant process; chosen


class PlantState(NamedTuple):
    """HIL_STATE_QUATERNION: time us, rates rad/s, position 1e-7 deg and mm, velocity cm/s, acceleration mG."""

    stamp: int
    qw: float
    qx: float
    qy: float
    qz: float
    p: float
    q: float
    r: float
    lat: int
    lon: int
    alt: int
    vx: int
    vy: int
    vz: int
    indicated_airspeed: int
    true_airspeed: int
    ax: int
    ay: int
    az: int

    def measure(self, out: NDArray[np.float64]) -> None:
        """Fill a measurement, (9,), laid out as in `sitl.physics.state_estimate`."""
        out[:7] = self[1:8]
        out[7], out[8] = self.alt, -self.vz


def actuator_controls(codec: FastCodec, stamp: int, commands: NDArray[np.float32], armed: bool) -> bytes:
    """HIL_ACTUATOR_CONTROLS in answer to the frame of time `stamp`, us: motor commands, (16,) thrust fractions."""
    return codec.pack(ACTUATORS, stamp, LOCKSTEP, *commands.tolist(), ARMED if armed else 0)


class PlantLink:
    """One autopilot's link to one plant.

    Parameters
    ----------
    plant : PlantProcess or (host, port)
        Our own process, started when it does not run; or the address of a plant started elsewhere.

    Attributes
    ----------
    socket : socket or None
        The connection; None while there is none.
    """

    def __init__(self, plant: PlantProcess | tuple[str, int]) -> None:
        self.child = plant if isinstance(plant, PlantProcess) else None
        self.address = None if isinstance(plant, PlantProcess) else plant
        self.socket: socket.socket | None = None
        self.codec = FastCodec(SYSTEM, COMPONENT)
        self._connecting: socket.socket | None = None
        self._next = 0.0

    @property
    def place(self) -> str:
        """Address of the plant, for messages."""
        host, port = self.address or (LOOPBACK, self.child.poll_port() if self.child else None)
        return f"TCP {host}:{port}"

    def connect(self, now: float) -> bool:
        """Continue connecting; True once connected. `now` is a monotonic time in s.

        Raises
        ------
        SitlError
            When our plant process ended instead of listening; the next call restarts it.
        """
        if self.socket is not None:
            return True
        if self._connecting is not None:
            return self._finish(now)
        if now < self._next:
            return False
        address = self.address
        if self.child is not None:
            port = self._child_port(now)
            address = None if port is None else (LOOPBACK, port)
        if address is not None:
            self._begin(address, now)
        return False

    def _child_port(self, now: float) -> int | None:
        assert self.child is not None
        if self.child.child is None:
            self.child.start()
        try:
            return self.child.poll_port()
        except SitlError:
            self.child.end()
            self._next = now + RESTART_S
            raise

    def _begin(self, address: tuple[str, int], now: float) -> None:
        try:
            link = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
            link.setblocking(False)
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if link.connect_ex(address) in (0, errno.EINPROGRESS):
                self._connecting = link
                return
            link.close()
        except OSError as error:
            raise SitlError(
                f"no plant at {address[0]}:{address[1]}: {error.strerror or error}; correct --plant"
            ) from error
        self._next = now + RETRY_S

    def _finish(self, now: float) -> bool:
        assert self._connecting is not None
        if not select.select([], [self._connecting], [], 0)[1]:
            return False
        link, self._connecting = self._connecting, None
        if link.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) != 0:
            link.close()
            self._next = now + RETRY_S
            if self.child is not None and not self.child.alive:
                self.child.end()  # so that the next call restarts it
            return False
        self.codec = FastCodec(SYSTEM, COMPONENT)
        self.socket = link
        return True

    def receive(self) -> list[Message]:
        """Read the messages that have arrived.

        Raises
        ------
        ConnectionError
            When the plant disconnected; `connect` then reconnects.
        """
        assert self.socket is not None
        try:
            data = self.socket.recv(READ_BYTES)
        except BlockingIOError:
            return []
        except OSError as error:
            self.drop()
            raise ConnectionError(str(error)) from error
        if not data:
            self.drop()
            raise ConnectionError("it closed the connection")
        return self.codec.parse(data)

    def answer(self, stamp: int, commands: NDArray[np.float32], armed: bool) -> None:
        """Send motor commands for the frame of time `stamp`, us; `receive` notices a plant that disconnected."""
        if self.socket is None:
            return
        try:
            self.socket.sendall(actuator_controls(self.codec, stamp, commands, armed))
        except OSError:
            return

    def drop(self) -> None:
        """Close the connection."""
        if self.socket is not None:
            self.socket.close()
            self.socket = None

    def close(self) -> None:
        """Disconnect, and end our plant process."""
        self.drop()
        if self._connecting is not None:
            self._connecting.close()
        if self.child is not None:
            self.child.end()
