"""Our custom controller in an ArduPilot log: message MIMO, beside ArduPilot's own messages.

It has the time stamps of RATE. RATE's torque is then ours, but its rate setpoint is that of the main controller, which
runs idle.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.logs.dataflash_file import DataflashFile
from mimopilot.tuning.logs.resample import Series, sampling_period
from mimopilot.tuning.parameter_row import PREFIX
from mimopilot.tuning.parameters import ARDUPILOT_PREFIX

MESSAGE = "MIMO"
MICROSECOND = 1e-6  # s
_FIELDS = ("TimeUS", "RR", "RP", "RY", "XR", "XP", "XY")
CUSTOM_NOTE = (
    "our custom controller flew, in a part or all of the log (message MIMO): the flown gains are its own; its rate "
    "setpoint and injected torque are those of MIMO, where it flew"
)
#: System identification adds nothing to the torque of a custom controller.
IDLE_NOTE = (
    "our custom controller flew in a part of the log (message MIMO), but the excitation of system identification is "
    "the main controller's, and so are the flown gains"
)


@dataclass(frozen=True, eq=False)
class CustomFlight:
    """What our controller logged while it flew.

    Attributes
    ----------
    time : (N,) array, s
    rates_setpoint : (N, 3) array, rad/s
    excitation : (N, 3) array
        Torque of the injector, normalised.
    """

    time: NDArray[np.float64]
    rates_setpoint: NDArray[np.float64]
    excitation: NDArray[np.float64]

    def merged(self, main: Series | None, axes: slice) -> Series | None:
        """Rate setpoint that was flown: ours where our controller flew, else the main one's."""
        if main is None:
            return None
        values, near, rows = main.values.copy(), *self._rows(main.time)
        values[near] = self.rates_setpoint[rows, axes]
        return Series(main.time, values, f"{main.topic}, {MESSAGE}")

    def injected(self, torque: Series | None) -> dict[str, Series]:
        """Torque of the injector, roll, pitch, yaw, at the times of the torque; empty if there was none."""
        if torque is None or not self.excitation.any():
            return {}
        near, rows = self._rows(torque.time)
        values = np.zeros((len(torque.time), self.excitation.shape[1]))
        values[near] = self.excitation[rows]
        return {"u_bar": Series(torque.time, values, MESSAGE)}

    def _rows(self, time: NDArray[np.float64]) -> tuple[NDArray[np.bool_], NDArray[np.intp]]:
        """Which times have a row of ours, and which row."""
        after = np.clip(np.searchsorted(self.time, time), 1, len(self.time) - 1)
        nearest = after - (time - self.time[after - 1] < self.time[after] - time)
        near = np.abs(self.time[nearest] - time) < sampling_period(self.time) / 2
        return near, nearest[near]


def custom_flight(file: DataflashFile) -> CustomFlight | None:
    """Rows of our message in order of time; None when our controller has not flown."""
    columns = file.fields(MESSAGE, _FIELDS)
    if columns is None or len(columns[0]) < 3:
        return None
    with np.errstate(invalid="ignore"):  # a damaged float may be a signalling NaN
        time, *values = (column.astype(np.float64) for column in columns)
    order = np.argsort(time, kind="stable")
    table = np.column_stack(values)[order]
    return CustomFlight(time[order] * MICROSECOND, table[:, :3], np.nan_to_num(table[:, 3:]))


def our_name(name: str) -> str:
    """Our own name of a parameter of the custom controller; other names as they are."""
    return PREFIX + name.removeprefix(ARDUPILOT_PREFIX) if name.startswith(ARDUPILOT_PREFIX) else name


def our_parameters(
    parameters: Mapping[str, float], changes: list[tuple[float, str, float]]
) -> tuple[dict[str, float], list[tuple[float, str, float]]]:
    """Parameters and later changes, those of the custom controller under our own names: their gains have flown."""
    renamed = {our_name(name): value for name, value in parameters.items()}
    return renamed, [(time, our_name(name), value) for time, name, value in changes]
