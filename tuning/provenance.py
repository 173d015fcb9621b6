"""Origin of a gain set."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from mimopilot.common.charts import IS_FLOWN, IS_NEW, IS_SISO
from mimopilot.common.toml import shown
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.reference_model import ContinuousModel, model_from_table

Models = tuple[ContinuousModel, ContinuousModel]
#: Methods of sets that were not tuned.
UNTUNED = ("", "flown", "default")
MODELS = ("inner_model", "outer_model")


@dataclass(frozen=True)
class Provenance:
    """Method and data that a gain set was made from.

    Attributes
    ----------
    method : str
        ``mimo``, ``siso``, ``flown``, ``default``...; empty: not known.
    log, log_sha256 : str
        Name and hash of the log that it was tuned from.
    inner_model, outer_model : tuple of 2 ContinuousModel, or None
        Reference models of the rate and the attitude loop, roll then pitch.
    standard_deviation : mapping
        Matrix -> 2x2 list in its unit: the spread to expect if the flight were repeated with fresh noise. ``yaw``:
        gain -> number, where yaw was tuned.
    fit : tuple of float
        Share of the torque that each axis' rate regression explains, R^2.
    warnings : tuple of str
        Doubts about the log or the gains.
    details : mapping
        Further entries, as plain TOML values: options of the method, notes of the user.
    """

    method: str = ""
    log: str = ""
    log_sha256: str = ""
    inner_model: Models | None = None
    outer_model: Models | None = None
    standard_deviation: Mapping[str, Any] = field(default_factory=dict)
    fit: tuple[float, ...] = ()
    warnings: tuple[str, ...] = ()
    details: Mapping[str, Any] = field(default_factory=dict)

    @property
    def kind(self) -> str:
        """What reports tell sets apart by: flown or given, tuned axis by axis, or another new one."""
        return IS_FLOWN if self.method in UNTUNED else IS_SISO if self.method == "siso" else IS_NEW

    def as_table(self) -> dict[str, Any]:
        """All entries that are not empty, as plain TOML values."""
        table: dict[str, Any] = {"method": self.method, "log": self.log, "log_sha256": self.log_sha256}
        table |= self.details
        for name in MODELS:
            models = getattr(self, name)
            table[name] = [model.as_table() for model in models] if models else None
        table["fit"] = list(self.fit)
        table["warnings"] = list(self.warnings)
        table["standard_deviation"] = dict(self.standard_deviation)
        return {name: value for name, value in table.items() if value not in ("", None, [], {})}

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> Provenance:
        """Inverse of `as_table`.

        Raises
        ------
        TuningError
            When an entry is of the wrong kind; unknown ones become `details`.
        """
        values = dict(table)
        known: dict[str, Any] = {}
        for one in fields(cls):
            if one.name not in values or one.name == "details":
                continue
            value = values.pop(one.name)
            where = f"provenance.{one.name}"
            if one.name in MODELS:
                if not isinstance(value, list) or len(value) != 2:
                    raise TuningError(f"{where}: got {shown(value)}, expected two models: roll, pitch")
                known[one.name] = tuple(model_from_table(model, where) for model in value)
                continue
            kind = {"standard_deviation": dict, "fit": list, "warnings": list}.get(one.name, str)
            if not isinstance(value, kind):
                raise TuningError(f"{where}: got {shown(value)}, expected a {kind.__name__}")
            known[one.name] = tuple(value) if kind is list else value
        return cls(**known, details=values)
