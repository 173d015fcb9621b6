"""MAVLink 2 signing (mavlink.io/en/guide/message_signing.html): rejects frames without the key, and replayed ones.

The signature is the first 48 bits of SHA-256 over the key and the frame, including link number and timestamp. The
timestamp counts units of 10 us since 2015-01-01. It must increase on every stream (link, system, component).
"""

from __future__ import annotations

import hashlib
import hmac
import time
from collections.abc import Callable
from pathlib import Path

from mimopilot.common.files import read_bytes
from mimopilot.sitl.errors import SitlError

KEY_BYTES = 32
EPOCH_S, UNITS_PER_S = 1420070400, 100_000  # 2015-01-01
#: How far the first timestamp of a stream may lag our clock: one minute, from the MAVLink guide.
NEW_STREAM_UNITS = 60 * UNITS_PER_S
#: Most streams remembered, chosen to bound memory; only a holder of the key can open one.
MAX_STREAMS = 1000
STAMP_BYTES, TAIL_BYTES, SIGNATURE_BYTES = 6, 6, 13


def read_key(path: Path) -> bytes:
    """Read a signing key from a file: 32 bytes, or 64 hexadecimal digits.

    Raises
    ------
    InputFileError
        When the file cannot be read.
    SitlError
        When it holds no key.
    """
    content = read_bytes(path, "signing key")
    if len(content) == KEY_BYTES:
        return content
    try:
        key = bytes.fromhex(content.decode())
    except ValueError:
        key = b""
    if len(key) != KEY_BYTES:
        raise SitlError(f"{path}: not a signing key: expected {KEY_BYTES} bytes or {2 * KEY_BYTES} hexadecimal digits")
    return key


class Signer:
    """Signs outgoing frames and checks incoming ones; one instance for all links of a vehicle or ground station.

    Parameters
    ----------
    key : bytes
        The 32 bytes that both ends share.
    clock : callable
        Seconds since 1970.

    Attributes
    ----------
    behind : float, s
        How far the last correctly signed frame that was too old to open a stream lags our clock; 0: none yet.
    """

    def __init__(self, key: bytes, clock: Callable[[], float] = time.time) -> None:
        self.key, self.clock = key, clock
        self.stamp = 0
        self.behind = 0.0
        self.heard: dict[tuple[int, int, int], int] = {}

    def _tail(self, signed: bytes) -> bytes:
        return hashlib.sha256(self.key + signed).digest()[:TAIL_BYTES]

    def _advance_clock(self) -> int:
        """Advance the signing clock to now; it never falls behind a timestamp received or sent."""
        self.stamp = max(self.stamp, int((self.clock() - EPOCH_S) * UNITS_PER_S))
        return self.stamp

    def sign(self, frame: bytes, link: int = 0) -> bytes:
        """Append link number, timestamp and signature to a frame whose signed flag is set already."""
        self.stamp = self._advance_clock() + 1
        signed = frame + bytes([link]) + self.stamp.to_bytes(STAMP_BYTES, "little")
        return signed + self._tail(signed)

    def accept(self, frame: bytes, system: int, component: int) -> bool:
        """Take a signed frame if its signature is right and it is newer than the last of its stream.

        The signature is checked first, so that a forged timestamp cannot block the stream that it names.

        Returns
        -------
        bool
            Whether the frame was accepted.
        """
        if not hmac.compare_digest(self._tail(frame[:-TAIL_BYTES]), frame[-TAIL_BYTES:]):
            return False
        stream = frame[-SIGNATURE_BYTES], system, component
        stamp = int.from_bytes(frame[-SIGNATURE_BYTES + 1 : -TAIL_BYTES], "little")
        now = self._advance_clock()
        last = self.heard.get(stream, now - NEW_STREAM_UNITS)
        if stamp <= last and stream not in self.heard:
            self.behind = (now - stamp) / UNITS_PER_S
        if stamp <= last or (stream not in self.heard and len(self.heard) >= MAX_STREAMS):
            return False
        self.heard[stream] = stamp
        self.stamp = max(self.stamp, stamp)
        return True
