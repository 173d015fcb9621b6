"""Applies faults to the autopilot during a flight: corrupted gains, missing setpoints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.autopilot.px4_law import Px4Controller
from mimopilot.sitl.autopilot.setpoints import STALE_SECONDS
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.faults.kinds import Fault
from mimopilot.tuning.parameters import MATRICES, PARAMETERS


class AutopilotFaults:
    """The autopilot faults of one flight; other faults in the list are ignored.

    Parameters
    ----------
    faults : sequence of Fault
        They may overlap.
    Ts : float, s
        Control period.
    autopilot : Autopilot, optional
        The one whose gains are corrupted; None: the controller is not in this process.

    Attributes
    ----------
    changes : set of int
        Periods before which `apply` has something to do.

    Raises
    ------
    SitlError
        When a vehicle would refuse the corrupted gains, or there is no controller in this process.
    """

    def __init__(self, faults: Sequence[Fault], Ts: float, autopilot: Autopilot | None) -> None:
        self.Ts, self.autopilot = Ts, autopilot
        self._gains = [(fault, *fault.span(Ts)) for fault in faults if fault.kind == "gain"]
        self._stale = [fault.span(Ts) for fault in faults if fault.kind == "stale"]
        self._healthy: NDArray[np.float32] | None = None  # while corrupted ones are in the controller
        for fault, _, _ in self._gains:
            self._check(fault)
        self.changes = {k for _, *span in self._gains for k in span}

    def apply(self, k: int) -> None:
        """Write the gains of period `k` into the controller, as a parameter write does."""
        if self.autopilot is None or not self._gains:
            return
        controller = self.autopilot.controller
        assert not isinstance(controller, Px4Controller)  # refused at the start
        factors = np.ones(len(PARAMETERS), np.float32)
        for fault, begin, end in self._gains:
            if begin <= k < end:
                factors[_elements(fault)] *= fault.magnitude
        corrupted = bool((factors != 1).any())
        if self._healthy is None and corrupted:
            self._healthy = controller.state["gains"][0].copy()
        if self._healthy is not None:
            gains = self._healthy * factors
            if (gains != controller.state["gains"][0]).any():  # each write adapts the integrators
                controller.set_gains(gains)
            self._healthy = self._healthy if corrupted else None

    def stale(self, k: int) -> bool:
        """Whether no setpoint arrives in period `k`."""
        return any(begin <= k < end for begin, end in self._stale)

    def setpoints(self, setpoint: NDArray[Any]) -> NDArray[Any]:
        """Setpoints (N, 3), rad, that the autopilot flies when these are sent: level, heading kept, while stale.

        The rule is that of `sitl.autopilot.flight_modes`.
        """
        flown = setpoint.copy()
        for begin, end in self._stale:
            fresh = begin + round(STALE_SECONDS / self.Ts)
            flown[begin:end] = setpoint[max(begin - 1, 0)]
            flown[min(fresh, end) : end, :2] = 0
        return flown

    def _check(self, fault: Fault) -> None:
        """Refuse gains outside the ranges of the parameters."""
        if self.autopilot is None:
            raise SitlError(f"fault {str(fault)!r}: there is no controller in this process; give it to the autopilot")
        if isinstance(self.autopilot.controller, Px4Controller):
            raise SitlError(f"fault {str(fault)!r}: is for the generated controller; a stock PX4 has other gains")
        values = self.autopilot.controller.state["gains"][0] * np.float32(fault.magnitude)
        for i in _elements(fault):
            parameter = PARAMETERS[i]
            if not parameter.minimum <= values[i] <= parameter.maximum:
                raise SitlError(
                    f"fault {str(fault)!r}: {parameter.name} would be {values[i]:.4g}, expected "
                    f"{parameter.minimum:g} to {parameter.maximum:g}: a vehicle refuses that write"
                )


def _elements(fault: Fault) -> range:
    """Indices of the gains that a fault changes, in the order of the parameter table."""
    if fault.matrix is None:
        return range(4 * len(MATRICES))
    first = 4 * list(MATRICES).index(fault.matrix)
    return range(first, first + 4)
