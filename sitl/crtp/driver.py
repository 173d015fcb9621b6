"""The drivers of cflib for Crazyradio and USB, as a carrier of packets."""

from __future__ import annotations

from mimopilot.common.extras import CRAZYFLIE
from mimopilot.sitl.crtp.packets import Packet
from mimopilot.sitl.errors import SitlError

#: s of waiting in which a link is noticed to have closed; chosen.
SLICE_S = 0.1
FORMS = "expected radio://0/80/2M (dongle, channel, rate; /E7E7E7E7E7, the address) or usb://0"


class CrtpDriver:
    """A link to a Crazyflie by one of cflib's drivers.

    Parameters
    ----------
    uri : str
        As cflib writes it: ``radio://0/80/2M``, ``radio://0/80/2M/E7E7E7E7E7``, ``usb://0``.

    Attributes
    ----------
    closed : bool
        The driver lost its link.

    Raises
    ------
    Error
        When cflib is not installed.
    SitlError
        When the link cannot be opened.
    """

    def __init__(self, uri: str) -> None:
        CRAZYFLIE.need()
        import cflib.crtp as crtp
        from cflib.crtp.crtpstack import CRTPPacket

        self.closed, self._packet = False, CRTPPacket
        if not crtp.CLASSES:
            crtp.init_drivers()
        try:
            self._driver = crtp.get_link_driver(uri, None, self._lost)
        except Exception as error:  # its drivers raise plain exceptions, and those of USB
            reason = str(error) or type(error).__name__
            raise SitlError(
                f"--connect {uri}: cannot be opened: {reason}; is the dongle or the USB cable connected, and may you "
                "use it (docs/crazyflie.md)?",
                exit_code=1,
            ) from error
        if self._driver is None:
            raise SitlError(f"--connect {uri}: {FORMS}")

    def _lost(self, message: str) -> None:
        """Called by the driver, from its own thread."""
        self.closed = True

    def send(self, packet: Packet) -> None:
        """Send a packet; it may be lost."""
        if self.closed:
            return
        made = self._packet()
        made.set_header(packet.port, packet.channel)
        made.data = packet.data
        try:
            self._driver.send_packet(made)
        except Exception:  # whatever USB raises when the cable is out
            self.closed = True

    def receive(self, wait: float) -> Packet | None:
        """A received packet; waits for one so long (s), at most `SLICE_S`. None: there is none."""
        if self.closed:
            return None
        made = self._driver.receive_packet(min(max(wait, 0.0), SLICE_S))
        return None if made is None else Packet(made.port, made.channel, bytes(made.data))

    def close(self) -> None:
        """Close the link."""
        self._driver.close()
