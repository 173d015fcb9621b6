"""MAVLink 2 signing: who holds the key may speak, and what was said once is not believed again.

A signature is the first 48 bits of SHA-256 over the key and the frame, link number and time stamp included. The time
stamp counts 10 us since 2015; on every stream (link, system, component) it must grow.
"""

from __future__ import annotations

import hashlib
import hmac
import time
from collections.abc import Callable
from pathlib import Path

from mimopilot.sitl.errors import SitlError

from mimopilot.common.files import read_bytes

KEY_BYTES = 32
EPOCH_S, UNITS_PER_S = 1420070400, 100_000  # 2015-01-01
#: A stream that was never heard may begin so long before our own time: clocks differ.
NEW_STREAM_UNITS = 60 * UNITS_PER_S
#: Streams that are remembered: only who holds the key makes one.
MAX_STREAMS = 1000
STAMP_BYTES, TAIL_BYTES, SIGNATURE_BYTES = 6, 6, 13


def read_key(path: Path) -> bytes:
    """Signing key from a file: 32 bytes, or 64 hexadecimal digits.

    Raises
    ------
    TuningError
        When it cannot be read.
    SitlError
        When it holds neither.
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
    """Signs frames and checks those of others; one for all links of a vehicle or ground station.

    Parameters
    ----------
    key : bytes
        The 32 bytes that both sides share.
    clock : callable
        Seconds since 1970.

    Attributes
    ----------
    behind : float, s
        How far the last message that was made with the key, and was too old to begin a stream, is behind our time; 0:
        there was none.
    """

    def __init__(self, key: bytes, clock: Callable[[], float] = time.time) -> None:
        self.key, self.clock = key, clock
        self.stamp = 0
        self.behind = 0.0
        self.heard: dict[tuple[int, int, int], int] = {}

    def _tail(self, signed: bytes) -> bytes:
        return hashlib.sha256(self.key + signed).digest()[:TAIL_BYTES]

    def _now(self) -> int:
        """Own time, never earlier than what was heard or sent."""
        self.stamp = max(self.stamp, int((self.clock() - EPOCH_S) * UNITS_PER_S))
        return self.stamp

    def sign(self, frame: bytes, link: int = 0) -> bytes:
        """The frame (its flag is set already) with link number, time stamp and signature."""
        self.stamp = self._now() + 1
        signed = frame + bytes([link]) + self.stamp.to_bytes(STAMP_BYTES, "little")
        return signed + self._tail(signed)

    def accepts(self, frame: bytes, system: int, component: int) -> bool:
        """Whether a signed frame was made with the key and is newer than the last of its stream.

        The signature is checked first: a forged time stamp must not shut out the one whose stream it names.
        """
        if not hmac.compare_digest(self._tail(frame[:-TAIL_BYTES]), frame[-TAIL_BYTES:]):
            return False
        stream = frame[-SIGNATURE_BYTES], system, component
        stamp = int.from_bytes(frame[-SIGNATURE_BYTES + 1 : -TAIL_BYTES], "little")
        last = self.heard.get(stream, self._now() - NEW_STREAM_UNITS)
        if stamp <= last and stream not in self.heard:
            self.behind = (self._now() - stamp) / UNITS_PER_S
        if stamp <= last or (stream not in self.heard and len(self.heard) >= MAX_STREAMS):
            return False
        self.heard[stream] = stamp
        self.stamp = max(self.stamp, stamp)
        return True
