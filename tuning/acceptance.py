"""Checks before a gain set is generated or uploaded: its ranges and its certificate."""

from __future__ import annotations

import numpy as np

from mimopilot.tuning.certificate import ACCEPTED, DEFAULT_THRESHOLDS, Verdict
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains import Gains, Triple
from mimopilot.tuning.parameters import PARAMETERS

#: Largest relative difference between two statements of one unit of torque: rounding in files.
UNIT_TOLERANCE = 0.01


def check_unit(source: str, stated: Triple | None, other: Triple | None, advice: str) -> None:
    """Refuse two different units of torque (roll, pitch) of one vehicle.

    Parameters
    ----------
    source : str
        What states the first, for the message.
    stated, other : tuple of 3 float or None, N m
        Torque of u = 1; None: unknown.
    advice : str
        What to do.

    Raises
    ------
    TuningError
        With both.
    """
    if stated and other and not np.allclose(stated[:2], other[:2], rtol=UNIT_TOLERANCE, atol=0):
        first, second = (", ".join(f"{v:.4g}" for v in scale[:2]) for scale in (stated, other))
        raise TuningError(f"{source}: u = 1 stands for {first} N m (roll, pitch), not for {second}; {advice}")


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
