"""The vehicle's parameters: the table of codegen, its values in the running controller."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from codegen.cortex_m4 import EmulatedController
from codegen.native import NativeController
from codegen.parameters import IDENTITY, PARAMETERS, Parameter, identity_parameters, to_array
from sitl.mavlink.words import REAL32
from tuning.gains import Gains

#: PARAM_ERROR (345) reasons; pymavlink's own enumeration ends before some of them.
DOES_NOT_EXIST, OUT_OF_RANGE, READ_ONLY, TYPE_MISMATCH = 1, 2, 5, 7


class ParameterServer:
    """Answers the parameter protocol; a change acts on the controller at once, bumpless.

    Parameters
    ----------
    controller : NativeController or EmulatedController
        The running controller.
    gains : Gains
        What it runs with.
    """

    def __init__(self, controller: NativeController | EmulatedController, gains: Gains) -> None:
        self.controller = controller
        self.values = to_array(gains)
        identity = identity_parameters(gains)
        self.table: tuple[Parameter, ...] = PARAMETERS + tuple(p for p in IDENTITY if p.name in identity)
        self.identity = identity
        self.index = {parameter.name: i for i, parameter in enumerate(self.table)}

    def value(self, index: int) -> float:
        """Held value of a parameter, exactly as single precision."""
        if index < len(PARAMETERS):
            return float(self.values[index])
        return float(np.float32(self.identity[self.table[index].name]))

    def message(self, index: int) -> Any:
        """PARAM_VALUE of one parameter."""
        name = self.table[index].name.encode()
        return mavlink.MAVLink_param_value_message(name, self.value(index), REAL32, len(self.table), index)

    def listing(self) -> Iterator[Any]:
        """PARAM_VALUE of each."""
        return (self.message(i) for i in range(len(self.table)))

    def read(self, name: str, index: int) -> list[Any]:
        """Answer to PARAM_REQUEST_READ: by index when that is not negative, else by name."""
        found = index if index >= 0 else self.index.get(name, -1)
        if not 0 <= found < len(self.table):
            return [self._error(name, index, DOES_NOT_EXIST)]
        return [self.message(found)]

    def write(self, name: str, value: float, kind: int) -> list[Any]:
        """Answer to PARAM_SET: the held value, with an error in front when the new one was refused."""
        index = self.index.get(name)
        if index is None:
            return [self._error(name, -1, DOES_NOT_EXIST)]
        parameter = self.table[index]
        refusal = None
        if not parameter.writable:
            refusal = READ_ONLY
        elif kind != REAL32:
            refusal = TYPE_MISMATCH
        elif not (math.isfinite(value) and parameter.minimum <= value <= parameter.maximum):
            refusal = OUT_OF_RANGE
        else:
            changed = self.values.copy()
            changed[index] = value
            if self.controller.set_gains(changed):
                self.values = changed
            else:
                refusal = OUT_OF_RANGE
        held = self.message(index)
        return [held] if refusal is None else [self._error(name, index, refusal), held]

    @staticmethod
    def _error(name: str, index: int, reason: int) -> Any:
        return mavlink.MAVLink_param_error_message(0, 0, name.encode()[:16], index, reason)
