"""The vehicle's parameters: the tables of codegen, their values in the running controller and injector."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from mimopilot.codegen.cortex_m4 import EmulatedController
from mimopilot.codegen.native import NativeController
from mimopilot.sitl.autopilot.excitation_injector import AXIS, Injector
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.vehicle.parameter_store import ParameterStore
from mimopilot.sitl.mavlink.wire.float32 import REAL32, shortest, single
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.parameters import EXCITATION, IDENTITY, PARAMETERS, identity_parameters, to_array
from pymavlink.dialects.v20 import common as mavlink

#: PARAM_ERROR (345) reasons; pymavlink's own enumeration ends before some of them.
DOES_NOT_EXIST, OUT_OF_RANGE, READ_ONLY, TYPE_MISMATCH = 1, 2, 5, 7
#: Names that are told at the start, at most.
TOLD = 5


@dataclass(frozen=True)
class ServedParameter:
    """One line of the vehicle's list; integers are published as floats, which every ground station understands."""

    name: str
    minimum: float
    maximum: float
    writable: bool = True
    integer: bool = False

    def accepts(self, value: float) -> bool:
        """Whether a value is one that the vehicle may hold."""
        return self.minimum <= value <= self.maximum and not (self.integer and value != round(value))

    @property
    def range(self) -> str:
        """For messages."""
        return f"expected {'a whole number from ' if self.integer else ''}{self.minimum:g} to {self.maximum:g}"


class ParameterServer:
    """Answers the parameter protocol; a change acts on the controller at once, bumpless.

    Parameters
    ----------
    controller : NativeController or EmulatedController
        The running controller.
    gains : Gains
        What it runs with.
    injector : Injector
        What its settings act on.
    store : ParameterStore, optional
        Where changes are kept; what it holds outranks the gains.

    Raises
    ------
    SitlError
        When the store holds what this vehicle cannot take.
    """

    def __init__(
        self,
        controller: NativeController | EmulatedController,
        gains: Gains,
        injector: Injector,
        store: ParameterStore | None = None,
    ) -> None:
        self.controller, self.injector, self.store = controller, injector, store
        identity = identity_parameters(gains)
        self.table: tuple[ServedParameter, ...] = (
            *(ServedParameter(p.name, p.minimum, p.maximum, p.writable) for p in PARAMETERS),
            *(ServedParameter(p.name, p.minimum, p.maximum, False) for p in IDENTITY if p.name in identity),
            *(ServedParameter(s.name, s.minimum, s.maximum, True, s.integer) for s in EXCITATION),
        )
        self.index = {entry.name: i for i, entry in enumerate(self.table)}
        settings = {setting.name: single(setting.default) for setting in EXCITATION}
        values = [*to_array(gains).tolist(), *map(single, identity.values()), *settings.values()]
        self.defaults: dict[str, float] = dict(zip(self.index, values, strict=True))
        self.values = dict(self.defaults)
        if store is not None:
            self._restore(store)
        self._configure()

    def _restore(self, store: ParameterStore) -> None:
        """Take over what was kept."""
        for name, value in store.held.items():
            if name not in self.index:
                raise SitlError(f"{store.path}: {name}: this vehicle has no such parameter; take the line out")
            entry = self.table[self.index[name]]
            if not entry.writable and value != self.values[name]:
                raise SitlError(
                    f"{store.path}: {name} is {shortest(value)}, the gains are for {shortest(self.values[name])}: "
                    "it was kept for another vehicle; name another file"
                )
            if not entry.accepts(value):
                raise SitlError(f"{store.path}: {name}: got {shortest(value)}, {entry.range}; correct the line")
            self.values[name] = value
        self.values[AXIS] = 0.0  # what was asked in an earlier flight
        if not self.controller.set_gains(self._gains(self.values)):
            raise SitlError(f"{store.path}: the controller refuses these gains; take its lines out")

    @property
    def summary(self) -> str:
        """What outranks the gains at the start; empty: nothing."""
        changed = self.changed
        if self.store is None or not changed:
            return ""
        told = [f"{name} {shortest(value)} (else {shortest(self.defaults[name])})" for name, value in changed.items()]
        more = f" and {len(told) - TOLD} more" if len(told) > TOLD else ""
        verb = "parameter outranks" if len(told) == 1 else "parameters outrank"
        return f"{self.store.path}: {len(told)} {verb} the gains: {', '.join(told[:TOLD])}{more}"

    @property
    def changed(self) -> dict[str, float]:
        """Name -> value of all that is not as the gains and the defaults have it."""
        return {name: value for name, value in self.values.items() if value != self.defaults[name] and name != AXIS}

    def message(self, index: int) -> Any:
        """PARAM_VALUE of one parameter."""
        name = self.table[index].name
        return mavlink.MAVLink_param_value_message(name.encode(), self.values[name], REAL32, len(self.table), index)

    def listing(self) -> list[Any]:
        """PARAM_VALUE of each."""
        return [self.message(i) for i in range(len(self.table))]

    def read(self, name: str, index: int) -> list[Any]:
        """Answer to PARAM_REQUEST_READ: by index when that is not negative, else by name."""
        found = index if index >= 0 else self.index.get(name, -1)
        if not 0 <= found < len(self.table):
            return [_error(name, index, DOES_NOT_EXIST)]
        return [self.message(found)]

    def write(self, name: str, value: float, kind: int) -> list[Any]:
        """Answer to PARAM_SET: the held value, with an error in front when the new one was refused."""
        index = self.index.get(name)
        if index is None:
            return [_error(name, -1, DOES_NOT_EXIST)]
        refusal = self._refusal(self.table[index], value + 0.0, kind)
        held = self.message(index)
        return [held] if refusal is None else [_error(name, index, refusal), held]

    def _refusal(self, entry: ServedParameter, value: float, kind: int) -> int | None:
        """Why a value is not taken; None: it was."""
        if not entry.writable:
            return READ_ONLY
        if kind != REAL32:
            return TYPE_MISMATCH
        if not (math.isfinite(value) and entry.accepts(value)):
            return OUT_OF_RANGE
        if value == self.values[entry.name]:
            return None
        wanted = self.values | {entry.name: value}
        if self.index[entry.name] < len(PARAMETERS):
            if not self.controller.set_gains(self._gains(wanted)):
                return OUT_OF_RANGE
            self.values = wanted
        else:
            self.values = wanted
            self._configure()
        if self.store is not None:
            self.store.keep(self.kept)
        return None

    def flush(self) -> bool:
        """Write what was not kept yet; False: it failed."""
        return self.store is None or self.store.flush()

    def complaint(self) -> str:
        """Why something could not be kept, told once; empty: all is well."""
        return self.store.complaint() if self.store else ""

    def close(self) -> None:
        """Keep what was not kept yet."""
        if self.store is not None:
            self.store.close()

    @property
    def kept(self) -> dict[str, float]:
        """What a file holds: whose parameters they are, and what was changed."""
        fixed = {entry.name: self.values[entry.name] for entry in self.table if not entry.writable}
        return fixed | self.changed

    @staticmethod
    def _gains(values: Mapping[str, float]) -> Any:
        return np.array([values[parameter.name] for parameter in PARAMETERS], np.float32)

    def _configure(self) -> None:
        self.injector.configure({setting.name: self.values[setting.name] for setting in EXCITATION})


def _error(name: str, index: int, reason: int) -> Any:
    return mavlink.MAVLink_param_error_message(0, 0, name.encode()[:16], index, reason)
