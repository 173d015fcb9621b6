"""What the torque of our PX4 module is made of, as it logs it fifty times a second."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

PARTS_TOPIC, PARTS_NAME = "debug_array", "MIMO_PID"
#: In the order of the module's ``struct Contributions``; each for roll, pitch and yaw.
PARTS = ("P", "I", "D", "feed-forward", "cross-axis")
AXES = ("roll", "pitch", "yaw")


@dataclass(frozen=True, eq=False)
class TorqueParts:
    """Parts of the controller output before its limit.

    Attributes
    ----------
    time : (N,) array, s
        When they were published.
    values : (N, 5, 3) array
        Normalised torque of each of `PARTS` on each of `AXES`; their sum is the torque without excitation.
    """

    time: NDArray[np.float64]
    values: NDArray[np.float64]

    def summary(self) -> str:
        """The root mean square of each part, in one line."""
        rms = np.sqrt(np.mean(self.values**2, axis=0))
        parts = ", ".join(f"{name} {' / '.join(f'{x:.2g}' for x in row)}" for name, row in zip(PARTS, rms, strict=True))
        return f"torque of {PARTS_NAME} by part, RMS {' / '.join(AXES)}: {parts}"


def torque_parts(fields: Mapping[str, NDArray[Any]]) -> TorqueParts | None:
    """The parts in the fields of PX4's topic debug_array; None when our module logged none.

    Parameters
    ----------
    fields : mapping
        Field -> values (N,): timestamp in us, name[i] and data[i].
    """
    count = len(PARTS) * len(AXES)
    names = [f"name[{i}]" for i in range(len(PARTS_NAME))]
    data = [f"data[{i}]" for i in range(count)]
    if not all(name in fields for name in ("timestamp", *names, *data)):
        return None
    wanted = np.frombuffer(PARTS_NAME.encode(), np.uint8)
    ours = (np.column_stack([fields[name] for name in names]).astype(np.int64) == wanted).all(axis=1)
    with np.errstate(invalid="ignore"):  # a damaged float may be a signalling NaN
        values = np.column_stack([fields[name] for name in data]).astype(np.float64)[ours]
    finite = np.isfinite(values).all(axis=1)
    if not finite.any():
        return None
    time = fields["timestamp"][ours][finite] * 1e-6
    return TorqueParts(time, values[finite].reshape(-1, len(PARTS), len(AXES)))
