"""Tuning the cascade from one experiment: VRFT estimate, quality checks, refinement and certificate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.analysis.certify import certify
from mimopilot.tuning.analysis.doublet_prediction import doublet_model
from mimopilot.tuning.certificate import Verdict
from mimopilot.tuning.design.cascade_estimate import CascadeEstimate, estimate
from mimopilot.tuning.design.quality_checks import check_band, check_estimates, check_saturation
from mimopilot.tuning.design.refine_attitude import refine_attitude
from mimopilot.tuning.design.refine_for_manoeuvre import refine_for_manoeuvre
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.estimation.instrumental_variables import excited_stretches
from mimopilot.tuning.experiment import Experiment, external_signal
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.law import TERMS
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.provenance import Provenance
from mimopilot.tuning.spec import TuningSpec

#: Largest relative difference between the periods of a log and of a gain set: loggers' clocks differ by less.
PERIOD_TOLERANCE = 0.02
#: Largest relative difference between the units of torque of a log and of a gain set: rounding in files.
UNIT_TOLERANCE = 0.01
MOTORS_UNKNOWN = (
    "the log does not contain how the allocator drives the motors (PX4: actuator_motors, with THR_MDL_FAC set): if the "
    "doublet saturates motors, the refined gains are not optimal"
)


def tune(
    experiment: Experiment,
    spec: TuningSpec | None = None,
    measured: PlantEstimates | None = None,
    repeat: Experiment | None = None,
) -> Gains:
    """Gains of the whole cascade, certified.

    Parameters
    ----------
    experiment : Experiment
        One flight with excitation.
    spec : TuningSpec, optional
        Method and reference models.
    measured : PlantEstimates, optional
        Response and models of the experiment, if they were computed before.
    repeat : Experiment, optional
        See `tuning.design.cascade_estimate.estimate`.

    Returns
    -------
    Gains
        With their certificate; method, reference models, log and standard deviations are in the provenance.

    Raises
    ------
    TuningError
        As `estimate`, or when the gains would be unusable or unstable.
    """
    spec = spec or TuningSpec()
    measured = measured or PlantEstimates(experiment)
    excited_stretches(experiment, external_signal(experiment)[0], spec.method)
    found = estimate(experiment, spec, repeat, measured.body)
    plant = measured.response
    warnings = [
        *experiment.warnings,
        *found.warnings,
        *check_saturation(experiment),
        *check_estimates(experiment.source, found.stretches, found.inner, experiment.Ts),
        *check_band(experiment.source, plant, [model.bandwidth for model in spec.inner]),
    ]
    gains, deviations = found.gains, found.inner_deviations()
    outer_models = spec.models("outer", experiment.Ts)
    if spec.refine:
        try:
            full = spec.method == "mimo"
            gains, deviations["Kp_o"] = refine_attitude(
                gains, plant, outer_models, full, spec.doublet_s, found.draw_inner
            )
        except TuningError as error:
            warnings.append(f"the attitude gains are not refined: {error}")
    if spec.manoeuvre:
        if experiment.motors is None:
            warnings.append(MOTORS_UNKNOWN)
        try:
            gains = refine_for_manoeuvre(
                gains,
                doublet_model(measured, spec.manoeuvre),
                plant,
                outer_models,
                terms=[*(TERMS[term].matrix for term in spec.structure), "Kp_o"],
                full=spec.method == "mimo",
                limit=spec.manoeuvre.effort,
            )
            deviations = {}
        except TuningError as error:
            warnings.append(f"the gains are not refined for the manoeuvre: {error}")
    if deviations and "Kp_o" not in deviations:
        deviations["Kp_o"] = found.outer_deviation()
    provenance = _provenance(experiment, spec, found, deviations, warnings)
    tuned = _certified(replace(gains, provenance=provenance), measured, spec)
    verdict, reason = tuned.verdict()
    if verdict == Verdict.UNSTABLE:
        raise TuningError(
            f"{experiment.source}: the gains from this log for these models are unstable, nothing is written: "
            f"{reason}; record a longer or stronger excitation, or ask for a slower rate loop"
        )
    return tuned


def _provenance(
    experiment: Experiment,
    spec: TuningSpec,
    found: CascadeEstimate,
    deviations: dict[str, NDArray[np.float64]],
    warnings: list[str],
) -> Provenance:
    """Origin of the gains: log, method, options, fit and standard deviations."""
    return Provenance(
        method=spec.method,
        log=experiment.source,
        log_sha256=experiment.sha256,
        inner_model=spec.inner,
        outer_model=spec.outer,
        standard_deviation={matrix: value.tolist() for matrix, value in deviations.items()},
        fit=tuple(float(value) for loop in found.inner for value in loop.solution.r_squared),
        warnings=tuple(warnings),
        details={
            "structure": spec.structure,
            "instrument": found.instruments.name,
            "weight": spec.weight,
            "trim": spec.trim,
            "pull": spec.pull,
            "refined": spec.refine,
            **({"manoeuvre": spec.manoeuvre.model_dump(exclude_none=True)} if spec.manoeuvre else {}),
            "window": [found.inner[0].window, found.outer[0].window],
            "samples": [found.inner[0].samples, found.outer[0].samples],
        },
    )


def _certified(gains: Gains, measured: PlantEstimates, spec: TuningSpec) -> Gains:
    """The gains with their certificate."""
    inner, outer = spec.models("inner", gains.Ts), spec.models("outer", gains.Ts)
    sha256, thresholds = measured.experiment.sha256, spec.certificate
    found = certify(gains, measured.response, inner, outer, sha256, thresholds, lambda: measured.model)
    return gains.with_certificate(found)


def certify_from_log(experiment: Experiment, gains: Gains, spec: TuningSpec | None = None) -> Gains:
    """The gains with a certificate made from a flight of the vehicle, whatever their origin.

    Parameters
    ----------
    experiment : Experiment
    gains : Gains
    spec : TuningSpec, optional
        Specification with the thresholds.

    Raises
    ------
    TuningError
        When the log has no external signal, is too short or not excited, or when its period or its unit of torque
        differs from that of the gains.
    """
    if abs(experiment.Ts / gains.Ts - 1) > PERIOD_TOLERANCE:
        raise TuningError(
            f"{experiment.source}: sampled every {experiment.Ts:g} s, the gains are for {gains.Ts:g} s; certify them "
            "with a log of the same control rate"
        )
    flown = experiment.flown.moment_scale if experiment.flown else None
    if flown and gains.moment_scale and not np.allclose(flown[:2], gains.moment_scale[:2], rtol=UNIT_TOLERANCE, atol=0):
        theirs, ours = (", ".join(f"{v:.4g}" for v in scale[:2]) for scale in (flown, gains.moment_scale))
        raise TuningError(
            f"{experiment.source}: u = 1 stands for {theirs} N m (roll, pitch), in the gains for {ours}; convert the "
            "gains (mimopilot convert), or certify them with a log of their own allocator"
        )
    return _certified(gains, PlantEstimates(experiment), spec or TuningSpec())
