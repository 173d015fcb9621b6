"""The certificate of a gain set: the stability of its loop, as a log shows it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from enum import StrEnum
from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from mimopilot.common.toml import shown
from mimopilot.tuning.errors import TuningError


class Verdict(StrEnum):
    """Verdict on a loop's stability."""

    CERTIFIED = "certified"
    THIN = "stable, thin margin"
    NOT_CERTIFIED = "not certified"
    UNSTABLE = "unstable"
    #: The set has no certificate.
    NONE = "none"
    #: The certificate, or a gain, was edited after it was made.
    VOID = "void"


#: Verdicts that gains may be emitted and uploaded with, the best first.
ACCEPTED = (Verdict.CERTIFIED, Verdict.THIN)


class Thresholds(BaseModel):
    """Margins that a verdict needs, after subtracting their errors.

    Attributes
    ----------
    Ms, phase_deg : float, -, deg
        Largest peak of the sensitivity and smallest phase margin for ``certified``. Ms of 1.8 guarantees 32 degrees
        and 7 dB; the position loop around it uses part of that.
    thin_Ms, thin_phase_deg : float, -, deg
        The same for ``stable, thin margin``; less is ``not certified``: with 10 degrees a vehicle rolled by 25 degrees
        in PX4's own simulation.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    Ms: Annotated[float, Field(gt=1, allow_inf_nan=False)] = 1.8
    phase_deg: Annotated[float, Field(gt=0, lt=90)] = 40.0
    thin_Ms: Annotated[float, Field(gt=1, allow_inf_nan=False)] = 2.5
    thin_phase_deg: Annotated[float, Field(gt=0, lt=90)] = 25.0

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.thin_Ms < self.Ms or self.thin_phase_deg > self.phase_deg:
            raise ValueError("thin_Ms must be at least Ms, and thin_phase_deg at most phase_deg")
        return self


DEFAULT_THRESHOLDS = Thresholds()


@dataclass(frozen=True)
class Certificate:
    """Verdict on a gain set and the margins behind it, from one log.

    Attributes
    ----------
    verdict : Verdict
        ``certified``, ``stable, thin margin``, ``not certified`` or ``unstable``.
    reason : str
        Reason of the verdict, and the assumptions made outside the band.
    figures : mapping
        ``Ms``, ``Ms_error`` (two standard errors), ``delta``, ``delta_error``, ``distance`` of the determinant to
        0, ``disk_margin``, and by axis ``gain_margin_db``, ``gain_margin`` (``exact``, ``at least``, ``not known``),
        ``phase_margin_deg``, ``phase_margin_error_deg`` (two standard errors), ``delay_margin_ms``;
        ``simultaneous_gain_db`` and ``simultaneous_phase_deg`` for all axes at once. Empty if they were not computed.
        They are those of roll and pitch, or of all three axes where the cross terms of yaw matter. ``yaw``: verdict,
        reason, band and the same figures of yaw alone. ``cross_terms``: see `tuning.analysis.cross_terms.CrossTerms`.
    band : tuple of 2 float, rad/s
        Lowest and highest frequency at which the response is known.
    thresholds : mapping
        `Thresholds` of the verdict.
    log_sha256 : str
        Hash of the log that it was made from.
    further : tuple of mapping
        Certificates of the same gains from other logs, as tables; this one has the thinnest margin.
    seal : str
        Hash of the certificate and the gains, see `tuning.gains.Gains.with_certificate`; empty: not bound to gains.
    """

    verdict: Verdict
    reason: str
    figures: Mapping[str, Any] = field(default_factory=dict)
    band: tuple[float, float] = (0.0, 0.0)
    thresholds: Mapping[str, float] = field(default_factory=DEFAULT_THRESHOLDS.model_dump)
    log_sha256: str = ""
    further: tuple[Mapping[str, Any], ...] = ()
    seal: str = ""

    def as_table(self) -> dict[str, Any]:
        """The certificate as plain TOML and JSON values."""
        table = {**asdict(self), "verdict": str(self.verdict), "band": list(self.band), "further": list(self.further)}
        return table if self.further else {name: value for name, value in table.items() if name != "further"}

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> Certificate:
        """Inverse of `as_table`; a missing entry gets a default, which the seal then does not match.

        Raises
        ------
        TuningError
            When an entry is unknown or of the wrong kind, or the verdict is invalid.
        """
        known = {one.name for one in fields(cls)}
        unknown = sorted(set(table) - known)
        if unknown:
            raise TuningError(f"certificate.{unknown[0]}: unknown entry; known: {', '.join(sorted(known))}")
        values = dict(table)
        try:
            verdict = Verdict(values.pop("verdict", ""))
        except ValueError:
            given, valid = shown(table.get("verdict")), ", ".join(repr(str(one)) for one in Verdict)
            raise TuningError(f"certificate.verdict: got {given}, expected one of {valid}") from None
        for name, kind in (("figures", dict), ("thresholds", dict), ("band", list), ("reason", str), ("further", list)):
            if not isinstance(values.setdefault(name, kind()), kind):
                raise TuningError(f"certificate.{name}: got {shown(values[name])}, expected a {kind.__name__}")
        return cls(verdict, **{**values, "band": tuple(values["band"]), "further": tuple(values["further"])})
