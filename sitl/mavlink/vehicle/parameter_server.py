"""The vehicle's end of the parameter protocol (mavlink.io/en/services/parameter.html): tables, values, writes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from mimopilot.codegen.cortex_m4 import EmulatedController
from mimopilot.codegen.firmware_number import firmware_number
from mimopilot.codegen.layout import to_array
from mimopilot.codegen.native import NativeController
from mimopilot.sitl.autopilot.excitation_injector import AXIS, Injector
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.vehicle.parameter_store import KeptParameters, ParameterStore
from mimopilot.sitl.mavlink.wire.float32 import REAL32, shortest, single
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.parameters import EXCITATION, FIRMWARE_NUMBER, IDENTITY, PARAMETERS, SET_NUMBER

#: MAV_PARAM_ERROR, the reasons of PARAM_ERROR; pymavlink's enumeration ends before the last.
DOES_NOT_EXIST: int = mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST
OUT_OF_RANGE: int = mavlink.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE
READ_ONLY: int = mavlink.MAV_PARAM_ERROR_READ_ONLY
TYPE_MISMATCH = 7
#: Most names in the summary at the start; chosen.
SUMMARY_NAMES = 5


@dataclass(frozen=True)
class ServedParameter:
    """One parameter of the vehicle's list. Integers are sent as floats, which every ground station understands."""

    name: str
    minimum: float
    maximum: float
    writable: bool = True
    integer: bool = False

    def accepts(self, value: float) -> bool:
        """Whether a value is within the range, and whole for an integer."""
        return self.minimum <= value <= self.maximum and not (self.integer and value != round(value))

    @property
    def range(self) -> str:
        """Expected range, for messages."""
        return f"expected {'a whole number from ' if self.integer else ''}{self.minimum:g} to {self.maximum:g}"


class ParameterServer(KeptParameters):
    """Answers the parameter protocol; a write acts on the controller at once, bumpless.

    Parameters
    ----------
    controller : NativeController or EmulatedController
        The running controller.
    gains : Gains
        Its gains at the start.
    injector : Injector
        The excitation injector, configured by the MIMO_EX parameters.
    store : ParameterStore, optional
        Stores changes; its values override the gains.

    Raises
    ------
    SitlError
        When the store holds a value that this vehicle cannot accept.
    """

    def __init__(
        self,
        controller: NativeController | EmulatedController,
        gains: Gains,
        injector: Injector,
        store: ParameterStore | None = None,
    ) -> None:
        self.controller, self.injector, self.store = controller, injector, store
        identity = gains.identity()
        published = [*(p for p in IDENTITY if p.name in identity), FIRMWARE_NUMBER]
        others = [*EXCITATION, SET_NUMBER]
        self.table: tuple[ServedParameter, ...] = (
            *(ServedParameter(p.name, p.minimum, p.maximum, p.writable) for p in PARAMETERS),
            *(ServedParameter(p.name, p.minimum, p.maximum, False) for p in published),
            *(ServedParameter(s.name, s.minimum, s.maximum, True, s.integer) for s in others),
        )
        self.index = {served.name: i for i, served in enumerate(self.table)}
        settings = {setting.name: single(setting.default) for setting in others}
        number = float(firmware_number(gains))
        values = [*to_array(gains).tolist(), *map(single, identity.values()), number, *settings.values()]
        self.defaults: dict[str, float] = dict(zip(self.index, values, strict=True))
        self.values = dict(self.defaults)
        if store is not None:
            self._restore(store)
        self._configure()

    def _restore(self, store: ParameterStore) -> None:
        """Restore the stored values."""
        for name, value in store.held.items():
            if name not in self.index:
                raise SitlError(f"{store.path}: {name}: this vehicle has no such parameter; delete the line")
            served = self.table[self.index[name]]
            if not served.writable and value != self.values[name]:
                raise SitlError(
                    f"{store.path}: {name} is {shortest(value)}, the gains are for {shortest(self.values[name])}: "
                    "the file is of a vehicle with other gains in its firmware; name another file"
                )
            if not served.accepts(value):
                raise SitlError(f"{store.path}: {name}: got {shortest(value)}, {served.range}; correct the line")
            self.values[name] = value
        self.values[AXIS] = 0.0  # an excitation of an earlier flight must not start again
        if not self.controller.set_gains(self._gains(self.values)):
            raise SitlError(f"{store.path}: the controller rejects these gains; delete their lines")

    @property
    def summary(self) -> str:
        """Stored values that override the gains at the start; empty: none."""
        changed = self.changed
        if self.store is None or not changed:
            return ""
        names = [f"{name} {shortest(value)} (else {shortest(self.defaults[name])})" for name, value in changed.items()]
        more = f" and {len(names) - SUMMARY_NAMES} more" if len(names) > SUMMARY_NAMES else ""
        verb = "parameter overrides" if len(names) == 1 else "parameters override"
        return f"{self.store.path}: {len(names)} {verb} the gains: {', '.join(names[:SUMMARY_NAMES])}{more}"

    @property
    def changed(self) -> dict[str, float]:
        """Name -> value of all parameters that differ from the gains and the defaults."""
        return {name: value for name, value in self.values.items() if value != self.defaults[name] and name != AXIS}

    def message(self, index: int) -> Any:
        """PARAM_VALUE of one parameter."""
        name = self.table[index].name
        return mavlink.MAVLink_param_value_message(name.encode(), self.values[name], REAL32, len(self.table), index)

    def listing(self) -> list[Any]:
        """PARAM_VALUE of each."""
        return [self.message(i) for i in range(len(self.table))]

    def read(self, name: str, index: int) -> list[Any]:
        """Answer PARAM_REQUEST_READ: by index when it is not negative, else by name."""
        found = index if index >= 0 else self.index.get(name, -1)
        if not 0 <= found < len(self.table):
            return [_error(name, index, DOES_NOT_EXIST)]
        return [self.message(found)]

    def write(self, name: str, value: float, kind: int) -> list[Any]:
        """Execute PARAM_SET: return the current value, after a PARAM_ERROR when the new one was refused."""
        index = self.index.get(name)
        if index is None:
            return [_error(name, -1, DOES_NOT_EXIST)]
        refusal = self._try_set(self.table[index], value + 0.0, kind)
        held = self.message(index)
        return [held] if refusal is None else [_error(name, index, refusal), held]

    def _try_set(self, served: ServedParameter, value: float, kind: int) -> int | None:
        """Set a value; return the MAV_PARAM_ERROR when it was refused, else None."""
        if not served.writable:
            return READ_ONLY
        if kind != REAL32:
            return TYPE_MISMATCH
        if not (math.isfinite(value) and served.accepts(value)):
            return OUT_OF_RANGE
        if value == self.values[served.name]:
            return None
        wanted = self.values | {served.name: value}
        if self.index[served.name] < len(PARAMETERS):
            if not self.controller.set_gains(self._gains(wanted)):
                return OUT_OF_RANGE
            self.values = wanted
        else:
            self.values = wanted
            self._configure()
        if self.store is not None:
            self.store.keep(self.stored_values)
        return None

    @property
    def stored_values(self) -> dict[str, float]:
        """Content of the stored file: the read-only parameters, which identify the vehicle, and the changed ones."""
        fixed = {served.name: self.values[served.name] for served in self.table if not served.writable}
        return fixed | self.changed

    @staticmethod
    def _gains(values: Mapping[str, float]) -> Any:
        return np.array([values[parameter.name] for parameter in PARAMETERS], np.float32)

    def _configure(self) -> None:
        self.injector.configure({setting.name: self.values[setting.name] for setting in EXCITATION})


def _error(name: str, index: int, reason: int) -> Any:
    return mavlink.MAVLink_param_error_message(0, 0, name.encode()[:16], index, reason)
