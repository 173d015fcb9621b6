"""Tuning the attitude cascade from flights: the one way from logs to certified gains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mimopilot.tuning.acceptance import check_unit
from mimopilot.tuning.analysis.certify_axes import certify_axes
from mimopilot.tuning.certificate import Certificate, Verdict
from mimopilot.tuning.design.quality_checks import check_saturation
from mimopilot.tuning.design.stock_profile import check_profile
from mimopilot.tuning.design.tune_by_design import tune_by_design
from mimopilot.tuning.design.tune_for_models import tune_for_models
from mimopilot.tuning.design.yaw_design import tune_yaw, with_yaw
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.estimation.instrumental_variables import excited_stretches
from mimopilot.tuning.experiment import Experiment, external_signal
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.plant.frequency_response import SAME_PERIOD
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.spec import TuningSpec

#: Details of a gain set's origin that hold for the control rate of its log only.
OF_ONE_RATE = ("predicted", "better_than_flown", "keep_flown", "limited_by")


def tune(
    experiments: Experiment | Sequence[Experiment],
    spec: TuningSpec | None = None,
    measured: PlantEstimates | None = None,
    repeat: Experiment | None = None,
) -> Gains:
    """Gains of the whole cascade, certified.

    Without reference models they are designed on the measured response; with them, VRFT finds those whose loops come
    closest to the models, as in the thesis.

    Parameters
    ----------
    experiments : Experiment or sequence of Experiment
        One flight with excitation, or several of one vehicle.
    spec : TuningSpec, optional
        Method, reference models and limits.
    measured : PlantEstimates, optional
        Response and models of a single experiment, if they were computed before.
    repeat : Experiment, optional
        See `tuning.design.cascade_estimate.estimate`.

    Returns
    -------
    Gains
        With their certificate; method, reference models, logs and standard deviations are in the provenance.

    Raises
    ------
    TuningError
        When a log has no external signal, is too short or not excited, or when the gains would be unusable or unstable.
    """
    spec = spec or TuningSpec()
    flights = [experiments] if isinstance(experiments, Experiment) else list(experiments)
    for one in flights:
        check_profile(one, spec)
    estimates = [measured] if measured is not None else [PlantEstimates(one) for one in flights]
    doubts = [_doubts(one, spec) for one in flights]
    if not spec.for_models:
        _check_one_vehicle(flights)
        return _with_origin(tune_by_design(estimates, spec), flights, doubts)
    if len(flights) > 1:
        raise TuningError(f"{len(flights)} logs: reference models are for one; leave out --inner and --outer")
    tuned = _with_origin(tune_for_models(estimates[0], spec, repeat), flights, doubts)
    fastest = min(model.bandwidth for model in spec.continuous("outer"))
    yaw = tune_yaw(estimates, spec, tuned, fastest)
    tuned, yaw, certificate = with_yaw(tuned, yaw, lambda gains: _certificate(gains, estimates[0], spec))
    tuned = replace(tuned, provenance=yaw.provenance(tuned.provenance)).with_certificate(certificate)
    verdict, reason = tuned.verdict()
    if verdict == Verdict.UNSTABLE:
        raise TuningError(
            f"{flights[0].source}: the gains from this log for these models are unstable, nothing is written: "
            f"{reason}; record a longer or stronger excitation, or ask for a slower rate loop"
        )
    return tuned


def _doubts(experiment: Experiment, spec: TuningSpec) -> list[str]:
    """Warnings about a log; refuses one that is not excited or is saturated."""
    excited_stretches(experiment, external_signal(experiment)[0], spec.method)
    return [*experiment.warnings, *check_saturation(experiment)]


def _with_origin(gains: Gains, flights: Sequence[Experiment], doubts: Sequence[Sequence[str]]) -> Gains:
    """The set with the logs that it comes from, and the warnings about them."""
    warnings = [warning for some in doubts for warning in some]
    names, hashes = (", ".join(getattr(one, name) for one in flights) for name in ("source", "sha256"))
    provenance = replace(
        gains.provenance,
        log=names,
        log_sha256=hashes,
        warnings=tuple(dict.fromkeys([*warnings, *gains.provenance.warnings])),
    )
    return replace(gains, provenance=provenance)


def _check_one_vehicle(flights: Sequence[Experiment]) -> None:
    """Refuse logs that cannot be of one vehicle: another period or unit of torque."""
    first = flights[0]
    for index, other in enumerate(flights[1:], 1):
        if other.sha256 and other.sha256 in (one.sha256 for one in flights[:index]):
            raise TuningError(f"{other.source}: is given twice; errors of its noise would count as confirmed")
        if abs(other.Ts / first.Ts - 1) > SAME_PERIOD:
            raise TuningError(f"{other.source}: sampled every {other.Ts:g} s, {first.source} every {first.Ts:g} s")
        ours, theirs = (one.flown.moment_scale if one.flown else None for one in (first, other))
        check_unit(other.source, theirs, ours, f"that is {first.source}'s unit: not the same allocator")


def _certificate(gains: Gains, measured: PlantEstimates, spec: TuningSpec) -> Certificate:
    """The certificate of a set, for the reference models of a specification."""
    inner, outer = spec.models("inner", gains.Ts), spec.models("outer", gains.Ts)
    return certify_axes(gains, measured, inner, outer, spec.certificate)


def at_rate(gains: Gains, hertz: float) -> Gains:
    """The gains for another control rate, without a certificate.

    The law's continuous-time gains and cut-offs stay. What was predicted for the old rate is left out.

    Raises
    ------
    TuningError
        When the law cannot run at this rate, such as an attitude model that is too fast for it.
    """
    if not 0 < hertz < np.inf:
        raise TuningError(f"rate: got {hertz:g} Hz, expected more than 0")
    details = {name: value for name, value in gains.provenance.details.items() if name not in OF_ONE_RATE}
    if "yaw" in details:
        details["yaw"] = {name: value for name, value in details["yaw"].items() if name not in OF_ONE_RATE}
    return replace(
        gains,
        filters=replace(gains.filters, Ts=1 / hertz),
        certificate=None,
        provenance=replace(gains.provenance, details={**details, "carried_from_Ts": gains.Ts}),
    )


def certify_from_log(experiment: Experiment, gains: Gains, spec: TuningSpec | None = None) -> Gains:
    """The gains with a certificate made from a flight of the vehicle, whatever their origin and control rate.

    Parameters
    ----------
    experiment : Experiment
    gains : Gains
    spec : TuningSpec, optional
        Specification with the thresholds.

    Raises
    ------
    TuningError
        When the log has no external signal, is too short or not excited, or when its unit of torque differs from that
        of the gains.
    """
    return certify_around(PlantEstimates(experiment), gains, spec)


def certify_around(measured: PlantEstimates, gains: Gains, spec: TuningSpec | None = None) -> Gains:
    """`certify_from_log` of a log whose plant estimates are there already: several sets take them once."""
    experiment = measured.experiment
    check_unit(
        experiment.source,
        experiment.flown.moment_scale if experiment.flown else None,
        gains.moment_scale,
        "convert the gains (mimopilot convert), or certify them with a log of their own allocator",
    )
    return gains.with_certificate(_certificate(gains, measured, spec or TuningSpec()))
