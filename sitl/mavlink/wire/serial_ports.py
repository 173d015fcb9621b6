"""Serial ports, with an error that says what is wrong with the port and what to do."""

from __future__ import annotations

import errno
from typing import Any

from mimopilot.sitl.errors import SitlError

#: Error of the system -> what it means for a serial port, and what to do.
REASONS = {
    errno.ENOENT: "there is no such device; is the cable plugged in? mimopilot doctor lists the serial ports",
    errno.EACCES: "this user may not open it; mimopilot doctor says what to do",
    errno.EBUSY: "another program uses it; end that one",
    errno.EAGAIN: "another program uses it; end that one",
    errno.ENOTTY: "it is no serial port",
}


def open_serial(option: str, url: str, device: str, baud: int, write_timeout: float, exclusive: bool = False) -> Any:
    """Open a serial port that is read without waiting.

    Parameters
    ----------
    option, url : str
        Where the user named it, and as it was given, for the message.
    device : str
        Path of the port.
    baud : int
        Bits per second.
    write_timeout : float, s
        Longest wait of a write.
    exclusive : bool
        Refuse a port that another program locked.

    Returns
    -------
    serial.Serial

    Raises
    ------
    SitlError
        When it cannot be opened.
    """
    import serial

    try:
        return serial.Serial(device, baud, timeout=0, write_timeout=write_timeout, exclusive=exclusive or None)
    except (OSError, ValueError) as error:  # a SerialException is an OSError, without a number when termios refused
        codes = (getattr(error, "errno", None), *getattr(error.__context__, "args", ()))
        reason = next((REASONS[code] for code in codes if code in REASONS), str(error))
        raise SitlError(f"{option} {url}: cannot be opened: {reason}", exit_code=1) from error
