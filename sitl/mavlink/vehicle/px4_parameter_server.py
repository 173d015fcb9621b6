"""The parameter protocol as a stock PX4 answers it, up to v1.17.

It does not enforce ranges, is silent on unknown names and wrong types, sends the bits of an INT32, and lists only the
parameters that something uses: those of a module that was not started have no index.
"""

from __future__ import annotations

import math
import struct
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.autopilot.px4_parameters import OF_THE_AUTOTUNE
from mimopilot.sitl.autopilot.stock_autopilot import StockAutopilot
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.vehicle.parameter_store import KeptParameters, ParameterStore
from mimopilot.sitl.mavlink.wire.float32 import INT32, REAL32, shortest, single

NO_INDEX = 65535  # PARAM_VALUE.param_index of an unlisted parameter


class Px4ParameterServer(KeptParameters):
    """Answers the parameter protocol; a write acts on the controllers at once.

    Parameters
    ----------
    autopilot : StockAutopilot
    store : ParameterStore, optional
        Stores changes; its values override the defaults.

    Raises
    ------
    SitlError
        When the store holds a parameter that this vehicle lacks.
    """

    def __init__(self, autopilot: StockAutopilot, store: ParameterStore | None = None) -> None:
        self.autopilot, self.store = autopilot, store
        self.defaults = dict(autopilot.values)
        self.kinds = {p.name: INT32 if p.integer else REAL32 for p in autopilot.table}
        self.writable = {p.name for p in autopilot.table if p.writable}
        for name, value in store.held.items() if store is not None else ():
            if name not in self.writable:
                raise SitlError(f"{store.path}: {name}: this vehicle has no such parameter; delete the line")  # type: ignore[union-attr]
            autopilot.set_parameter(name, value)
        autopilot.boot()

    @property
    def summary(self) -> str:
        """Stored values that override the defaults at the start; empty: none."""
        changed = self.changed
        if self.store is None or not changed:
            return ""
        return f"{self.store.path}: {', '.join(f'{name} {shortest(value)}' for name, value in changed.items())}"

    @property
    def changed(self) -> dict[str, float]:
        """Name -> value of all parameters that differ from the defaults."""
        values = self.autopilot.values
        return {name: values[name] for name in sorted(self.writable) if values[name] != self.defaults[name]}

    def _listed(self) -> list[str]:
        hidden = OF_THE_AUTOTUNE if self.autopilot.module is None else ()
        return [name for name in self.kinds if name not in hidden]

    def message(self, name: str) -> Any:
        """PARAM_VALUE of one parameter."""
        value, kind, listed = self.autopilot.values[name], self.kinds[name], self._listed()
        coded = struct.unpack("<f", struct.pack("<i", int(value)))[0] if kind == INT32 else single(value)
        index = listed.index(name) if name in listed else NO_INDEX
        return mavlink.MAVLink_param_value_message(name.encode(), coded, kind, len(listed), index)

    def listing(self) -> list[Any]:
        """PARAM_VALUE of each that is in use."""
        return [self.message(name) for name in self._listed()]

    def read(self, name: str, index: int) -> list[Any]:
        """Answer PARAM_REQUEST_READ: by index when it is not negative, else by name."""
        listed = self._listed()
        if index >= 0:
            name = listed[index] if index < len(listed) else ""
        return [self.message(name)] if name in self.kinds else []

    def write(self, name: str, value: float, kind: int) -> list[Any]:
        """Execute PARAM_SET: return the current value."""
        if name not in self.kinds or kind != self.kinds[name]:
            return []
        wanted = float(struct.unpack("<i", struct.pack("<f", value))[0]) if kind == INT32 else value
        # PX4 would keep a value that is not finite; the law of the bench could not fly it.
        if name in self.writable and math.isfinite(wanted) and wanted != self.autopilot.values[name]:
            self.autopilot.set_parameter(name, wanted)
            if self.store is not None:
                self.store.keep(self.changed)
        return [self.message(name)]
