"""Tuning the cascade from one experiment: the rate loop, then the attitude loop around it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from mimopilot.tuning.analysis.certificate import certify
from mimopilot.tuning.analysis.closed_loop import refine_outer
from mimopilot.tuning.analysis.doublet_prediction import doublet_model
from mimopilot.tuning.certificate import Verdict
from mimopilot.tuning.design.estimate_checks import examine_band, examine_estimates, examine_saturation
from mimopilot.tuning.design.positive_integral import with_positive_integral
from mimopilot.tuning.design.refine_manoeuvre import refine_cascade
from mimopilot.tuning.errors import NotMinimumPhaseError, TuningError
from mimopilot.tuning.estimation.instrumental_variables import (
    Instruments,
    Stretches,
    align,
    excited_stretches,
    instruments,
)
from mimopilot.tuning.estimation.siso import siso_vrft
from mimopilot.tuning.estimation.vrft import LoopEstimate, vrft
from mimopilot.tuning.experiment import Experiment, external_signal
from mimopilot.tuning.gains import Gains, Limits, YawGains
from mimopilot.tuning.law import Filters, rebuild_rate_setpoint
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.plant.rigid_body_fit import RigidBody
from mimopilot.tuning.provenance import Provenance
from mimopilot.tuning.reference_model import ReferenceModel
from mimopilot.tuning.spec import TuningSpec
from numpy.typing import NDArray

#: Periods of a log and of a gain set may differ by this share.
PERIOD_TOLERANCE = 0.02
#: Share of the longest stretch that may be spent until a rate controller that is run backwards has forgotten its start.
FORGOTTEN = 0.25
NO_MOTORS = (
    "the log does not say how the motors are moved (PX4: actuator_motors, with THR_MDL_FAC set): where the doublet "
    "drives them to their limits the refined gains are not the best"
)
TERMS = {"P": "Kp_i", "I": "Ki_i", "D": "Kd_i", "F": "Kff_i"}


@dataclass(frozen=True, eq=False)
class CascadeEstimate:
    """What VRFT says of both loops.

    Attributes
    ----------
    gains : Gains
        The whole set, neither refined nor certified.
    stretches : list of (axes, segments)
        Which axes were tuned together, and on which samples; `inner` and `outer` have one entry each.
    inner, outer : list of LoopEstimate
        Rate loop and attitude loop.
    instruments : Instruments
        What the instruments were made of.
    warnings : tuple of str
        What had to be done otherwise than asked.
    """

    gains: Gains
    stretches: Stretches
    inner: list[LoopEstimate]
    outer: list[LoopEstimate]
    instruments: Instruments
    warnings: tuple[str, ...]

    def deviations(self) -> dict[str, NDArray[np.float64]]:
        """Matrix -> (2, 2) standard deviations, in the unit of the matrix, of those that were estimated."""
        return {**self.inner_deviations(), "Kp_o": self.outer_deviation()}

    def inner_deviations(self) -> dict[str, NDArray[np.float64]]:
        """`deviations` of the rate loop alone."""
        return {TERMS[term]: self._assembled(self.inner, term) for term in self.inner[0].gains}

    def draw_inner(self, gains: Gains, generator: np.random.Generator) -> Gains:
        """The set with rate gains that are as likely as its own, from their covariance."""
        moved = {TERMS[term]: getattr(gains, TERMS[term]).copy() for term in self.inner[0].gains}
        for (axes, _), loop in zip(self.stretches, self.inner, strict=True):
            rows = np.array([generator.multivariate_normal(np.zeros(len(C)), C) for C in loop.solution.covariance])
            for term, part in zip(loop.gains, np.split(rows, len(loop.gains), axis=1), strict=True):
                moved[TERMS[term]][axes, axes] += part
        return replace(gains, **moved)  # type: ignore[arg-type]

    def outer_deviation(self) -> NDArray[np.float64]:
        """That of Kp_o: costs as much as all others, and is not needed where a refinement brings its own."""
        return self._assembled(self.outer, "P")

    def _assembled(self, loops: list[LoopEstimate], term: str) -> NDArray[np.float64]:
        return _assemble([loop.deviations[term] for loop in loops], self.stretches)


def estimate(
    experiment: Experiment, spec: TuningSpec, repeat: Experiment | None = None, body: RigidBody | None = None
) -> CascadeEstimate:
    """VRFT with extended instrumental variables of both loops, (3.26)-(3.34), and nothing else.

    Parameters
    ----------
    experiment : Experiment
        One flight with excitation.
    spec : TuningSpec
        Method and reference models.
    repeat : Experiment, optional
        A second flight of the same experiment, for the instrument ``repeated``.
    body : RigidBody, optional
        Through which the integral gains are kept positive; None: they are left as they come.

    Raises
    ------
    TuningError
        When the log has no external signal, is too short or not excited, or lacks what the controller needs
        beside roll and pitch.
    """
    if repeat is not None:
        experiment, repeat = align(experiment, repeat)
    chosen = instruments(experiment, spec.instrument, repeat)
    stretches = excited_stretches(experiment, chosen.external, spec.method)
    base = _base(experiment, spec)
    models = spec.models("inner", experiment.Ts)
    inner = [
        _loop(
            spec,
            spec.structure,
            axes,
            segments,
            (experiment.u, experiment.y_i, chosen.y_i),
            chosen,
            models,
            filters=base.filters,
            weight=spec.weight,
            prior=_prior(experiment, spec, axes),
            pull=spec.pull,
        )
        for axes, segments in stretches
    ]
    kept: list[str] = []
    if body is not None:
        inner, kept = with_positive_integral(inner, stretches, body)
    found: dict[str, Any] = {
        TERMS[term]: _assemble([loop.gains[term] for loop in inner], stretches) for term in spec.structure
    }
    gains = replace(base, **found)

    outer_models = spec.models("outer", experiment.Ts)
    r_i, inverse, settling, warnings = _rate_setpoint(experiment, gains, models, outer_models)
    outer = [
        _loop(
            spec,
            "P",
            axes,
            segments,
            (r_i, experiment.y_o, chosen.y_o),
            chosen,
            outer_models,
            inverse=inverse[axes],
            settling=settling,
            weight="identity",  # the residual is what a P controller cannot do, not noise
        )
        for axes, segments in stretches
    ]
    gains = replace(gains, Kp_o=_assemble([loop.gains["P"] for loop in outer], stretches))
    return CascadeEstimate(gains, stretches, inner, outer, chosen, (*kept, *warnings))


def _loop(
    spec: TuningSpec,
    terms: str,
    axes: slice,
    segments: list[tuple[int, int]],
    signals: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64] | None],
    chosen: Instruments,
    models: list[ReferenceModel],
    **options: Any,
) -> LoopEstimate:
    """One loop on some axes: `signals` are u, y and, where there is one, y with other noise."""
    u, y, repeated = (None if signal is None else signal[:, axes] for signal in signals)
    assert u is not None and y is not None
    common: dict[str, Any] = {
        "segments": segments,
        "window": spec.window,
        "trim": spec.trim,
        "repeated": repeated,
        "external": None if chosen.lagged is chosen.external else chosen.external[:, axes],
        **options,
    }
    if spec.method == "siso":
        return siso_vrft(u, y, chosen.lagged[:, axes], models[axes][0], terms, **common)
    return vrft(u, y, chosen.lagged[:, axes], models[axes], terms, **common)


def _rate_setpoint(
    experiment: Experiment, gains: Gains, inner: list[ReferenceModel], outer: list[ReferenceModel]
) -> tuple[NDArray[np.float64], list[ReferenceModel], int, tuple[str, ...]]:
    """What the attitude loop's virtual controller makes: C_i^-1 u, (3.32)-(3.34), else M_i^-1 y_i.

    Returns
    -------
    signal : (N, 2) array, rad/s
    inverse : list of ReferenceModel
        M_i where the signal is y_i and M_i^-1 is still to be applied, together with the outer filter; else none.
    settling : int, samples
    warnings : tuple of str
    """
    r_i, settling = np.zeros_like(experiment.y_i), 0
    longest = max(stop - start for start, stop in experiment.segments)
    try:
        for start, stop in experiment.segments:
            u, y_i = experiment.u[start:stop], experiment.y_i[start:stop]
            r_i[start:stop], settling = rebuild_rate_setpoint(gains, u, y_i)
        if settling > FORGOTTEN * longest:
            raise NotMinimumPhaseError(
                f"run backwards the rate controller needs {settling * experiment.Ts:.0f} s to forget where it began, "
                f"and the longest stretch is {longest * experiment.Ts:.0f} s"
            )
    except NotMinimumPhaseError as error:
        quotients = [m_o.over(m_i) for m_o in outer for m_i in inner]
        warning = (
            f"{error}; the attitude gains are found as if the rate loop were its reference model (r_i = M_i^-1 y_i): "
            "record a longer or stronger excitation, leave the integral out (--structure PD), or ask for another "
            "rate-loop model"
        )
        return experiment.y_i, inner, max(quotient.settling_samples() for quotient in quotients), (warning,)
    return r_i, [], settling, ()


def tune(
    experiment: Experiment,
    spec: TuningSpec | None = None,
    measured: PlantEstimates | None = None,
    repeat: Experiment | None = None,
) -> Gains:
    """Gains of the whole cascade: VRFT of both loops, quality gates, refinement, certificate.

    Parameters
    ----------
    experiment : Experiment
        One flight with excitation.
    spec : TuningSpec, optional
        Method and reference models.
    measured : PlantEstimates, optional
        What the experiment says of the vehicle, when it is at hand already.
    repeat : Experiment, optional
        See `estimate`.

    Returns
    -------
    Gains
        With method, reference models, log and standard deviations in its provenance, and certified.

    Raises
    ------
    TuningError
        As `estimate`, or when the gains would be nonsense, or unstable.
    """
    spec = spec or TuningSpec()
    measured = measured or PlantEstimates(experiment)
    excited_stretches(experiment, external_signal(experiment)[0], spec.method)
    found = estimate(experiment, spec, repeat, measured.body)
    plant = measured.response
    warnings = [
        *experiment.warnings,
        *found.warnings,
        *examine_saturation(experiment),
        *examine_estimates(experiment.source, found.stretches, found.inner, experiment.Ts),
        *examine_band(experiment.source, plant, [model.bandwidth for model in spec.inner]),
    ]
    gains, deviations = found.gains, found.inner_deviations()
    outer_models = spec.models("outer", experiment.Ts)
    if spec.refine:
        try:
            full = spec.method == "mimo"
            gains, deviations["Kp_o"] = refine_outer(
                gains, plant, outer_models, full, spec.doublet_s, found.draw_inner
            )
        except TuningError as error:
            warnings.append(f"the attitude gains are left as VRFT gives them: {error}")
    if spec.manoeuvre:
        if experiment.motors is None:
            warnings.append(NO_MOTORS)
        try:
            gains = refine_cascade(
                gains,
                doublet_model(measured, spec.manoeuvre),
                plant,
                outer_models,
                terms=[*(TERMS[term] for term in spec.structure), "Kp_o"],
                full=spec.method == "mimo",
                limit=spec.manoeuvre.effort,
            )
            deviations = {}
        except TuningError as error:
            warnings.append(f"the gains are not refined for the manoeuvre: {error}")
    if deviations and "Kp_o" not in deviations:
        deviations["Kp_o"] = found.outer_deviation()
    provenance = Provenance(
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
    tuned = _certified(replace(gains, provenance=provenance), measured, spec)
    verdict, reason = tuned.verdict()
    if verdict == Verdict.UNSTABLE:
        raise TuningError(
            f"{experiment.source}: the gains that this log gives for these models are unstable, nothing is written: "
            f"{reason}; record a longer or stronger excitation, or ask for a slower rate loop"
        )
    return tuned


def _certified(gains: Gains, measured: PlantEstimates, spec: TuningSpec) -> Gains:
    """The gains with their certificate."""
    inner, outer = spec.models("inner", gains.Ts), spec.models("outer", gains.Ts)
    sha256, thresholds = measured.experiment.sha256, spec.certificate
    found = certify(gains, measured.response, inner, outer, sha256, thresholds, lambda: measured.model)
    return gains.with_certificate(found)


def certify_from_log(experiment: Experiment, gains: Gains, spec: TuningSpec | None = None) -> Gains:
    """The gains with a certificate made from a flight of the vehicle, whatever they come from.

    Parameters
    ----------
    experiment : Experiment
    gains : Gains
    spec : TuningSpec, optional
        Whose thresholds count.

    Raises
    ------
    TuningError
        When the log has no external signal, is too short or not excited, or has another period or another unit of
        moment than the gains.
    """
    if abs(experiment.Ts / gains.Ts - 1) > PERIOD_TOLERANCE:
        raise TuningError(
            f"{experiment.source}: sampled every {experiment.Ts:g} s, the gains are for {gains.Ts:g} s; certify them "
            "with a log of the same control rate"
        )
    flown = experiment.flown.moment_scale if experiment.flown else None
    if flown and gains.moment_scale and not np.allclose(flown[:2], gains.moment_scale[:2], rtol=0.01, atol=0):
        theirs, ours = (", ".join(f"{v:.4g}" for v in scale[:2]) for scale in (flown, gains.moment_scale))
        raise TuningError(
            f"{experiment.source}: one unit of moment stands for {theirs} N m (roll, pitch), in the gains for {ours}; "
            "convert the gains (mimopilot convert), or certify them with a log of their own allocator"
        )
    return _certified(gains, PlantEstimates(experiment), spec or TuningSpec())


def _base(experiment: Experiment, spec: TuningSpec) -> Gains:
    """Everything that is not tuned: yaw, limits, filter and unit, from the specification or as flown."""
    flown = experiment.flown
    asked = {
        "which yaw gains flew ([yaw]: Kp_o, Kp_i, Ki_i, Kd_i)": spec.yaw,
        "which derivative filter flew (derivative_cutoff_hz, Hz, 0 for none)": spec.derivative_cutoff_hz,
    }
    missing = [name for name, value in asked.items() if value is None]
    if flown is None and missing:
        raise TuningError(
            f"{experiment.source}: the log does not say {' and '.join(missing)}; give it in a --spec file"
        )
    zero = np.zeros((2, 2))
    cutoff = spec.derivative_cutoff_hz
    yaw = YawGains(**spec.yaw.model_dump()) if spec.yaw else flown.yaw  # type: ignore[union-attr]
    limits = Limits(**spec.limits.model_dump()) if spec.limits else flown.limits if flown else Limits()
    return Gains(
        Kp_o=zero,
        Kp_i=zero,
        Ki_i=zero,
        Kd_i=zero,
        Kff_i=zero,
        yaw=yaw,
        filters=Filters(experiment.Ts, flown.derivative_cutoff_hz if cutoff is None and flown else cutoff or 0.0),
        limits=limits,
        moment_scale=spec.moment_scale or (flown.moment_scale if flown else None),
    )


def _prior(experiment: Experiment, spec: TuningSpec, axes: slice) -> dict[str, NDArray[np.float64]] | None:
    """The flying rate gains by term, when the estimate is to be pulled towards them."""
    if spec.pull == 0:
        return None
    flown = experiment.flown
    if flown is None:
        raise TuningError(f"{experiment.source}: pull: the log does not say which gains flew; leave it at 0")
    return {term: getattr(flown, TERMS[term])[axes, axes] for term in spec.structure}


def _assemble(parts: list[NDArray[np.float64]], stretches: Stretches) -> NDArray[np.float64]:
    matrix = np.zeros((2, 2))
    for part, (axes, _) in zip(parts, stretches, strict=True):
        matrix[axes, axes] = part
    return matrix
