"""The yaw controller designed on the measured response, as roll and pitch are; else the flown one is kept.

Yaw is one axis of the same law, so the same design serves it: the best following of a second-order model of the
heading whose bandwidth is found, within the certificate's margins, the flown noise, and yaw's own torque and rate.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mimopilot.tuning.analysis.certify_axes import ORDER
from mimopilot.tuning.analysis.manoeuvres import manoeuvres
from mimopilot.tuning.axes import AxesLaw, Law, flown_law, law_of
from mimopilot.tuning.certificate import Certificate, Verdict
from mimopilot.tuning.design.certified_design import certified_design, rate_model, uncertified
from mimopilot.tuning.design.descent import INFEASIBLE
from mimopilot.tuning.design.design_spread import standard_deviations
from mimopilot.tuning.design.prediction import Prediction, predict, reasons_to_keep
from mimopilot.tuning.design.quality_checks import check_saturation
from mimopilot.tuning.design.response_design import BANDWIDTHS, Design, ResponseDesign
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.experiment import external_signal
from mimopilot.tuning.gains import Gains, YawGains
from mimopilot.tuning.parameters import YAW_GAINS
from mimopilot.tuning.plant.frequency_response import MIN_FREQUENCIES
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.provenance import Provenance
from mimopilot.tuning.reference_model import ReferenceModel, SecondOrder, model_from_table
from mimopilot.tuning.spec import TuningSpec

#: Bandwidths of the heading model, rad/s: those of the attitude and slower ones, at most that of roll and pitch. A
#: multirotor turns by the drag of its rotors, a small part of their lift.
YAW_BANDWIDTHS = (1.0, 1.12, 1.25, 1.4, 1.6, 1.8, 2.0, 2.24, 2.5, *BANDWIDTHS)
#: Share of the rate loop's bandwidth that a starting point's attitude gain has.
ATTITUDE_SHARE = 1 / 3


@dataclass(frozen=True, eq=False)
class YawTuning:
    """Yaw gains and where they come from.

    Attributes
    ----------
    gains : YawGains
    details : mapping
        Plain values for the provenance. ``kept``: why the gains are the flown ones, else missing. Where yaw is excited:
        ``excited_by`` and ``logs``; where it was designed: ``attitude_model``, ``limited_by``, ``predicted`` by log of
        the ``tuned`` and the ``flown`` gains, ``flown_bandwidth``, ``better_than_flown``.
    deviations : mapping
        Gain -> standard deviation in its unit; empty: kept.
    warnings : tuple of str
    """

    gains: YawGains
    details: dict[str, Any]
    deviations: dict[str, float] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    @property
    def tuned(self) -> bool:
        """Whether the gains are designed."""
        return "kept" not in self.details

    def provenance(self, origin: Provenance) -> Provenance:
        """The origin of a set with these yaw gains."""
        deviations = {**origin.standard_deviation, **({"yaw": self.deviations} if self.deviations else {})}
        warnings = tuple(dict.fromkeys([*origin.warnings, *self.warnings]))
        details = {**origin.details, "yaw": self.details}
        return replace(origin, standard_deviation=deviations, warnings=warnings, details=details)

    def keep(self, gains: YawGains, reason: str) -> YawTuning:
        """The gains that flew instead, and why."""
        details = {name: value for name, value in self.details.items() if name in ("excited_by", "logs", "predicted")}
        return YawTuning(gains, {"kept": reason, **details}, warnings=self.warnings)


def tune_yaw(measured: Sequence[PlantEstimates], spec: TuningSpec, base: Gains, fastest: float) -> YawTuning:
    """Yaw gains from all logs that excite yaw.

    Parameters
    ----------
    measured : sequence of PlantEstimates
        One for each flight.
    spec : TuningSpec
    base : Gains
        With the flown yaw gains, and the filters of the set that yaw belongs to.
    fastest : float, rad/s
        Largest bandwidth: that of roll and pitch.
    """
    excited, reasons = _excited(measured)
    if not excited:
        return YawTuning(base.yaw, {"kept": "; ".join(dict.fromkeys(reasons))})
    details: dict[str, Any] = {
        "excited_by": [external_signal(one.experiment)[1] for one in excited],
        "logs": [one.experiment.source for one in excited],
    }
    found = YawTuning(base.yaw, details)
    try:
        warnings = tuple(warning for one in excited for warning in check_saturation(one.experiment))
        bench = ResponseDesign.of(excited, spec.design, tuple(w for w in YAW_BANDWIDTHS if w <= fastest))
        inner = rate_model(bench)
        design, certificates = certified_design(bench, excited, spec, _starts(base, bench, inner), inner)
    except TuningError as error:
        return found.keep(base.yaw, str(error))
    found = replace(found, warnings=warnings)
    missing = uncertified(certificates)
    if missing:
        limits = f"; the design is limited by {', '.join(design.active)}" if design.active else ""
        return found.keep(base.yaw, f"no yaw gains of this structure are certified: {missing[0].reason}{limits}")
    figures, reasons = _comparison(design, excited, bench, spec)
    details |= {
        "attitude_model": design.model.as_table(),
        "limited_by": design.active,
        **figures,
    }
    deviations = {name: value.item() for name, value in standard_deviations(bench, design).items()}
    found = replace(found, gains=_yaw_gains(design), details=details, deviations=deviations)
    return found.keep(base.yaw, f"the design is not better: {'; '.join(reasons)}") if reasons else found


def _excited(measured: Sequence[PlantEstimates]) -> tuple[list[PlantEstimates], list[str]]:
    """The estimates of yaw from the logs that show its response, and why the others do not."""
    excited, reasons = [], []
    for one in measured:
        try:
            yaw = one.yaw
            if len(yaw.response.known_run()) < MIN_FREQUENCIES:
                name = external_signal(yaw.experiment)[1]
                raise TuningError(
                    f"yaw is moved by {name}, but its response is known at fewer than {MIN_FREQUENCIES} frequencies in "
                    "a row: excite yaw longer or more strongly"
                )
        except TuningError as error:
            reasons.append(str(error))
        else:
            excited.append(yaw)
    return excited, reasons


def _starts(base: Gains, bench: ResponseDesign, inner: SecondOrder) -> list[Law]:
    """The yaw gains of a set, and those of the fitted body."""
    law = law_of(base, 1)
    assert isinstance(law, AxesLaw)
    rate = inner.omega * np.asarray(np.linalg.inv(bench.plants[0].body.B), np.float64)
    return [law, replace(law, Kp_o=np.array([[ATTITUDE_SHARE * inner.omega]]), Kp_i=rate, Ki_i=rate)]


def _yaw_gains(design: Design) -> YawGains:
    """The scalars; a bound at 0 that the design keeps to its tolerance is kept exactly."""
    units, found = design.task.free.units, {}
    for name in YAW_GAINS:
        value = getattr(design.law, name).item()
        found[name] = 0.0 if abs(value) < INFEASIBLE * units.get(name, 0.0) else value
    return YawGains(**found)


def _comparison(
    design: Design, measured: Sequence[PlantEstimates], bench: ResponseDesign, spec: TuningSpec
) -> tuple[dict[str, Any], list[str]]:
    """Predicted figures of the design and of the flown gains as plain values, and why the flown ones are better."""
    tasks = [
        (plant, manoeuvres(plant, design.model.discretise(plant.Ts), design.law.filters)) for plant in bench.plants
    ]
    new = [predict(design.law, *task) for task in tasks]
    laws = [law for law in (flown_law(one.experiment) for one in measured) if law is not None]
    if len(laws) < len(tasks):
        return {"predicted": {"tuned": [_plain(one) for one in new]}}, []
    flown = [predict(law, *task) for law, task in zip(laws, tasks, strict=True)]
    fastest = bench.flown_bandwidth or design.model.omega
    keep = reasons_to_keep(new, flown, spec.design, design.model.omega / fastest)
    shown = {"tuned": [_plain(one) for one in new], "flown": [_plain(one) for one in flown]}
    return {"predicted": shown, "flown_bandwidth": fastest, "better_than_flown": not keep}, keep


def _plain(figures: Prediction) -> dict[str, float]:
    """A prediction of yaw as TOML and JSON values; there is no other axis."""
    by_axis = ("follow_deg", "disturbance_deg", "noise", "fast_noise")
    return {name: getattr(figures, name)[0] for name in by_axis} | {"Ms": figures.Ms}


def yaw_model(gains: Gains) -> ReferenceModel | None:
    """The model that the heading follows with a set; None: its yaw gains are not tuned."""
    found = gains.provenance.details.get("yaw", {}).get("attitude_model")
    return None if found is None else model_from_table(found, "yaw attitude model").discretise(gains.Ts)


def with_yaw(
    gains: Gains, yaw: YawTuning, certified: Callable[[Gains], Certificate]
) -> tuple[Gains, YawTuning, Certificate]:
    """A set of roll and pitch with tuned yaw gains and its certificate; with the flown ones if those are better.

    Parameters
    ----------
    gains : Gains
        With the flown yaw gains.
    yaw : YawTuning
    certified : callable
        Examines a set on all its axes.
    """
    found = replace(gains, yaw=yaw.gains)
    certificate = certified(found)
    if not yaw.tuned or certificate.verdict == Verdict.CERTIFIED:
        return found, yaw, certificate
    flown = certified(gains)
    if ORDER.index(certificate.verdict) <= ORDER.index(flown.verdict):
        return found, yaw, certificate
    reason = f"with roll and pitch, the tuned ones are {certificate.verdict}: {certificate.reason}"
    return gains, yaw.keep(gains.yaw, reason), flown
