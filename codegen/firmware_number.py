"""Numbers that tell emitted code apart: of its C interface, and of the gains that are compiled in."""

from __future__ import annotations

import hashlib

import numpy as np

from mimopilot.codegen.layout import to_array
from mimopilot.codegen.targets import TEMPLATES
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.parameters import LARGEST_NUMBER, ROWS

#: These and the parameter table define the C interface.
INTERFACE = ("core/mimo_pid.hpp", "native/mimo_pid_native.h")


def _members() -> bytes:
    """The members of the gains in C++, in their order in memory."""
    return "".join(f"{row.member}{row.dimensions};" for row in ROWS).encode()


def interface_hash() -> int:
    """First 32 bits of the SHA-256 of the C interface: two headers and the members of the gains."""
    digest = hashlib.sha256(b"".join((TEMPLATES / name).read_bytes() for name in INTERFACE) + _members())
    return int.from_bytes(digest.digest()[:4], "big")


def firmware_number(gains: Gains) -> int:
    """Number of a firmware with these gains compiled in, 1 to `tuning.parameters.LARGEST_NUMBER`.

    Parameters that a vehicle has stored fly only in the firmware that they were written for. One with other gains may
    be for another vehicle, period or unit of torque, and autopilots do not store what equals a value compiled in.
    Hashed are the parameters' names, the values in single precision, and the unit of torque.

    Parameters
    ----------
    gains : Gains
    """
    scale = np.array(gains.moment_scale or (), np.float32)
    digest = hashlib.sha256(_members() + np.asarray(to_array(gains), np.float32).tobytes() + scale.tobytes())
    return 1 + int.from_bytes(digest.digest()[:8], "big") % LARGEST_NUMBER
