"""The certificate of a gain set for all its axes: roll and pitch, yaw where it is excited, and what couples them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from mimopilot.tuning.analysis.certify import certify, missed_thresholds, reason_unknown
from mimopilot.tuning.analysis.cross_terms import CrossTerms, examine_cross_terms
from mimopilot.tuning.axes import law_of
from mimopilot.tuning.certificate import Certificate, Thresholds, Verdict
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.parameter_row import AXES
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.reference_model import ReferenceModel

#: Verdicts on a loop, the best first: a set has the worst of its parts.
ORDER = (Verdict.CERTIFIED, Verdict.THIN, Verdict.NOT_CERTIFIED, Verdict.UNSTABLE)
#: Figures of a loop, and those of each axis, that the certificate holds of yaw by itself.
LOOP_FIGURES = ("Ms", "Ms_error")
AXIS_FIGURES = (
    "phase_margin_deg",
    "phase_margin_error_deg",
    "delay_margin_ms",
    "gain_margin_db",
    "gain_margin",
)
#: In place of a verdict on yaw.
NOT_EXAMINED = "not examined"


def certify_axes(
    gains: Gains,
    measured: PlantEstimates,
    inner: Sequence[ReferenceModel],
    outer: Sequence[ReferenceModel],
    thresholds: Thresholds,
) -> Certificate:
    """Verdict on a gain set from one log; the worst of roll and pitch, yaw, and all three with their cross terms.

    Parameters
    ----------
    gains : Gains
    measured : PlantEstimates
        Of the log. Where it does not excite yaw, or not enough to judge it, yaw is not examined: the figures say why.
    inner, outer : sequence of 2 ReferenceModel
        Of the rate and the attitude loop, see `tuning.analysis.certify.certify`; yaw's determinants are normalised by
        those of roll.
    thresholds : Thresholds
    """
    sha256 = measured.experiment.sha256
    found = certify(gains, measured.response, inner, outer, sha256, thresholds, lambda: measured.model)
    if not found.figures:  # roll and pitch themselves are not known, or unstable
        return found
    yaw, unknown = yaw_certificate(gains, measured, inner[:1], outer[:1], thresholds)
    if yaw is None:
        return replace(found, figures={**found.figures, "yaw": {"verdict": NOT_EXAMINED, "reason": unknown}})
    found = _worst(found, yaw.verdict, f"yaw: {yaw.reason}")
    found = replace(found, figures={**found.figures, "yaw": _yaw_table(yaw)})
    if not yaw.figures:  # unstable by itself
        return found
    try:
        plant = measured.all_axes.at_period(gains.Ts)
        cross = examine_cross_terms(law_of(gains, 3, measured.yaw_unit), plant, [*inner, inner[0]])
    except TuningError as error:
        return replace(found, figures={**found.figures, "cross_terms": {"reason": str(error)}})
    return _with_cross_terms(found, cross, thresholds)


def yaw_certificate(
    gains: Gains,
    measured: PlantEstimates,
    inner: Sequence[ReferenceModel],
    outer: Sequence[ReferenceModel],
    thresholds: Thresholds,
) -> tuple[Certificate | None, str]:
    """Verdict on yaw alone; None and the reason where the log does not show its loop."""
    law = law_of(gains, 1)
    try:
        plant = measured.yaw.response
        unknown = reason_unknown(law, plant.at_period(gains.Ts))
    except TuningError as error:
        unknown = str(error)
    if unknown:
        return None, unknown
    return certify(law, plant, inner, outer, measured.experiment.sha256, thresholds), ""


def _yaw_table(yaw: Certificate) -> dict[str, Any]:
    """Figures of yaw as plain values; the verdict first."""
    table: dict[str, Any] = {"verdict": str(yaw.verdict), "reason": yaw.reason, "band": list(yaw.band)}
    table |= {name: yaw.figures[name] for name in LOOP_FIGURES if name in yaw.figures}
    return table | {name: yaw.figures[name]["yaw"] for name in AXIS_FIGURES if name in yaw.figures}


def _worst(found: Certificate, verdict: Verdict, reason: str) -> Certificate:
    """The certificate with a further verdict, if that is worse."""
    if ORDER.index(verdict) <= ORDER.index(found.verdict):
        return found
    return replace(found, verdict=verdict, reason=reason)


def _with_cross_terms(found: Certificate, cross: CrossTerms, thresholds: Thresholds) -> Certificate:
    """The certificate with the cross terms and, where they matter, the thinnest margins with and without them."""
    figures = {**found.figures, "cross_terms": cross.as_table()}
    if cross.figures is None:
        return replace(found, figures=figures)
    figures |= _thinnest(found.figures, cross.figures)
    found = _worst(replace(found, figures=figures), cross.verdict, cross.reason)
    for limits, verdict in (
        ((thresholds.thin_Ms, thresholds.thin_phase_deg), Verdict.NOT_CERTIFIED),
        ((thresholds.Ms, thresholds.phase_deg), Verdict.THIN),
    ):
        missed = missed_thresholds(figures, *limits)
        if missed:
            return _worst(found, verdict, "; ".join(["with the cross terms of yaw", *missed]))
    return found


def _thinnest(alone: Mapping[str, Any], whole: Mapping[str, Any]) -> dict[str, Any]:
    """The thinner of each margin of the blocks by themselves and of all three axes.

    The blocks are known in wider bands, so a margin of theirs that is exact is not replaced by a bound.
    """
    thinner = max((alone, whole), key=lambda one: one["Ms"] + one["Ms_error"])
    smaller = min((alone, whole), key=lambda one: one["disk_margin"])
    found: dict[str, Any] = {name: thinner[name] for name in LOOP_FIGURES}
    found |= {name: smaller[name] for name in ("disk_margin", "simultaneous_gain_db", "simultaneous_phase_deg")}
    found |= {name: {} for name in AXIS_FIGURES}
    for axis in AXES:
        both = [
            {name: alone["yaw"][name] if axis == "yaw" else alone[name][axis] for name in AXIS_FIGURES},
            {name: whole[name][axis] for name in AXIS_FIGURES},
        ]
        phase = min(both, key=lambda one: one["phase_margin_deg"] - one["phase_margin_error_deg"])
        gain = min(both[: 2 if both[1]["gain_margin"] == "exact" else 1], key=lambda one: one["gain_margin_db"])
        for name in AXIS_FIGURES:
            found[name][axis] = (gain if name.startswith("gain") else phase)[name]
    return found
