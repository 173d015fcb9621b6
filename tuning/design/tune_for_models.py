"""Gains for given reference models of both loops, as in the thesis: VRFT, quality checks, refined attitude gains."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.design.cascade_estimate import CascadeEstimate, estimate
from mimopilot.tuning.design.quality_checks import check_band, check_estimates
from mimopilot.tuning.design.refine_attitude import refine_attitude
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.experiment import Experiment
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.provenance import Provenance
from mimopilot.tuning.spec import TuningSpec


def tune_for_models(measured: PlantEstimates, spec: TuningSpec, repeat: Experiment | None = None) -> Gains:
    """Gains whose loops come closest to the reference models of a specification.

    Parameters
    ----------
    measured : PlantEstimates
        Of the experiment.
    spec : TuningSpec
    repeat : Experiment, optional
        See `tuning.design.cascade_estimate.estimate`.

    Returns
    -------
    Gains
        Without a certificate.

    Raises
    ------
    TuningError
        As `estimate`, or when the gains would be unusable.
    """
    experiment, plant = measured.experiment, measured.response
    found = estimate(experiment, spec, repeat, measured.body)
    warnings = [
        *found.warnings,
        *check_estimates(experiment.source, found.stretches, found.inner, experiment.Ts),
        *check_band(experiment.source, plant, [model.bandwidth for model in spec.continuous("inner")]),
    ]
    gains, deviations = found.gains, found.inner_deviations()
    if spec.refine:
        try:
            outer, full = spec.models("outer", experiment.Ts), spec.method == "mimo"
            gains, deviations["Kp_o"] = refine_attitude(gains, plant, outer, full, found.draw_inner)
        except TuningError as error:
            warnings.append(f"the attitude gains are not refined: {error}")
    if "Kp_o" not in deviations:
        deviations["Kp_o"] = found.outer_deviation()
    return replace(gains, provenance=_provenance(spec, found, deviations, warnings))


def _provenance(
    spec: TuningSpec, found: CascadeEstimate, deviations: dict[str, NDArray[np.float64]], warnings: list[str]
) -> Provenance:
    """Origin of the gains: options, fit and standard deviations."""
    return Provenance(
        method=spec.method,
        inner_model=spec.continuous("inner"),
        outer_model=spec.continuous("outer"),
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
            "window": [found.inner[0].window, found.outer[0].window],
            "samples": [found.inner[0].samples, found.outer[0].samples],
        },
    )
