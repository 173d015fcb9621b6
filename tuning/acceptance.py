"""Checks before a gain set is generated or uploaded: its ranges and its certificate."""

from __future__ import annotations

from mimopilot.tuning.certificate import ACCEPTED, DEFAULT_THRESHOLDS, Verdict
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.parameters import PARAMETERS


def check_ranges(gains: Gains) -> None:
    """Refuse gains outside the ranges that a vehicle accepts.

    Raises
    ------
    TuningError
        With the first parameter out of its range, its value and the range.
    """
    values = gains.elements()
    for parameter in PARAMETERS:
        value = values[parameter.code]
        if not parameter.minimum <= value <= parameter.maximum:
            raise TuningError(
                f"{parameter.name}: got {value:.6g} {parameter.unit}".rstrip()
                + f", expected {parameter.minimum:g} to {parameter.maximum:g} ({parameter.description})"
            )


def check_verdict(gains: Gains, allow: bool) -> str:
    """Refuse gains whose loop is unstable, too close to it, or was never examined.

    Parameters
    ----------
    gains : Gains
    allow : bool
        Accept them with a warning instead.

    Returns
    -------
    str
        A warning; empty when the set is certified.

    Raises
    ------
    TuningError
        When the verdict is neither ``certified`` nor ``stable, thin margin``, and `allow` is False.
    """
    verdict, reason = gains.verdict()
    loose = _loose_thresholds(gains) if verdict in ACCEPTED else ""
    if verdict == Verdict.CERTIFIED:
        return loose
    if verdict not in ACCEPTED and not allow:
        name = "no certificate" if verdict == Verdict.NONE else verdict
        raise TuningError(f"{name}: {reason}; tune or certify again, or give --uncertified to accept the gains")
    return f"certificate: {verdict}: {reason}{'; ' if loose else ''}{loose}"


def _loose_thresholds(gains: Gains) -> str:
    """Warning if a certificate needed less margin than the default; else empty."""
    given = gains.certificate.thresholds if gains.certificate else {}
    used, usual = {**DEFAULT_THRESHOLDS.model_dump(), **given}, DEFAULT_THRESHOLDS
    peaks = used["Ms"] <= usual.Ms and used["thin_Ms"] <= usual.thin_Ms
    if peaks and used["phase_deg"] >= usual.phase_deg and used["thin_phase_deg"] >= usual.thin_phase_deg:
        return ""
    return (
        f"the certificate needed less margin than the default: Ms {used['Ms']:g} and {used['phase_deg']:g} degrees "
        f"(thin: {used['thin_Ms']:g} and {used['thin_phase_deg']:g})"
    )
