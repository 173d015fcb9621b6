"""VRFT estimate of the cascade from one experiment: the rate loop, then the attitude loop around it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.acceptance import check_unit
from mimopilot.tuning.design.positive_integral import with_positive_integral
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
from mimopilot.tuning.experiment import Experiment
from mimopilot.tuning.gains import Gains, Limits, YawGains
from mimopilot.tuning.law_filters import MIMO, Filters
from mimopilot.tuning.law_inverse import rebuild_rate_setpoint
from mimopilot.tuning.law_terms import TERMS
from mimopilot.tuning.plant.rigid_body_fit import RigidBody
from mimopilot.tuning.reference_model import ReferenceModel
from mimopilot.tuning.spec import TuningSpec

#: Share of the longest stretch that the inverse rate controller may take to settle; the samples are lost.
MAX_SETTLING_SHARE = 0.25


@dataclass(frozen=True, eq=False)
class CascadeEstimate:
    """VRFT's estimates of both loops.

    Attributes
    ----------
    gains : Gains
        The whole set, neither refined nor certified.
    stretches : list of (axes, segments)
        Axes that were tuned together, and their samples; `inner` and `outer` have one entry for each.
    inner, outer : list of LoopEstimate
        Rate loop and attitude loop.
    instruments : Instruments
        Signals that the instruments were made of.
    warnings : tuple of str
        Where the method had to differ from the specification.
    """

    gains: Gains
    stretches: Stretches
    inner: list[LoopEstimate]
    outer: list[LoopEstimate]
    instruments: Instruments
    warnings: tuple[str, ...]

    def deviations(self) -> dict[str, NDArray[np.float64]]:
        """Matrix -> (2, 2) standard deviations in its unit, for the matrices that were estimated."""
        return {**self.inner_deviations(), "Kp_o": self.outer_deviation()}

    def inner_deviations(self) -> dict[str, NDArray[np.float64]]:
        """`deviations` of the rate loop alone."""
        return {TERMS[term].matrix: self._deviation(self.inner, term) for term in self.inner[0].gains}

    def draw_inner(self, gains: Gains, generator: np.random.Generator) -> Gains:
        """The set with its rate gains replaced by others, drawn from their covariance."""
        moved = {TERMS[term].matrix: getattr(gains, TERMS[term].matrix).copy() for term in self.inner[0].gains}
        for (axes, _), loop in zip(self.stretches, self.inner, strict=True):
            rows = np.array([generator.multivariate_normal(np.zeros(len(C)), C) for C in loop.solution.covariance])
            for term, part in zip(loop.gains, np.split(rows, len(loop.gains), axis=1), strict=True):
                moved[TERMS[term].matrix][axes, axes] += part
        return replace(gains, **moved)  # type: ignore[arg-type]

    def outer_deviation(self) -> NDArray[np.float64]:
        """Standard deviation of Kp_o; as expensive as all others, and not needed after a refinement."""
        return self._deviation(self.outer, "P")

    def _deviation(self, loops: list[LoopEstimate], term: str) -> NDArray[np.float64]:
        return _assemble([loop.deviations[term] for loop in loops], self.stretches)


def estimate(
    experiment: Experiment, spec: TuningSpec, repeat: Experiment | None = None, body: RigidBody | None = None
) -> CascadeEstimate:
    """VRFT of both loops with extended instrumental variables, (3.26)-(3.34), and nothing else.

    Parameters
    ----------
    experiment : Experiment
        One flight with excitation.
    spec : TuningSpec
        Method and reference models.
    repeat : Experiment, optional
        A second flight of the same experiment, for the instrument ``repeated``.
    body : RigidBody, optional
        Plant through which the integral gains are kept positive; None: they stay as estimated.

    Raises
    ------
    TuningError
        When the log has no external signal, is too short or not excited, or lacks yaw gains or filter.
    """
    if repeat is not None:
        experiment, repeat = align(experiment, repeat)
    chosen = instruments(experiment, spec.instrument, repeat)
    stretches = excited_stretches(experiment, chosen.external, spec.method)
    base = starting_set(experiment, spec)
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
        TERMS[term].matrix: _assemble([loop.gains[term] for loop in inner], stretches) for term in spec.structure
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
            weight="identity",  # the residual is the P controller's error, not noise
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
    """VRFT of one loop on some axes; `signals` are u, y and, if there is one, y with independent noise."""
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
    """Rate setpoint of the attitude loop's virtual controller: C_i^-1 u, (3.32)-(3.34), else M_i^-1 y_i.

    Returns
    -------
    signal : (N, 2) array, rad/s
    inverse : list of ReferenceModel
        M_i if the signal is y_i: M_i^-1 is then applied together with the outer filter. Else empty.
    settling : int, samples
    warnings : tuple of str
    """
    r_i, settling = np.zeros_like(experiment.y_i), 0
    longest = max(stop - start for start, stop in experiment.segments)
    try:
        for start, stop in experiment.segments:
            u, y_i = experiment.u[start:stop], experiment.y_i[start:stop]
            r_i[start:stop], settling = rebuild_rate_setpoint(gains, u, y_i)
        if settling > MAX_SETTLING_SHARE * longest:
            raise NotMinimumPhaseError(
                f"the inverse rate controller takes {settling * experiment.Ts:.0f} s to settle, and the longest "
                f"stretch is {longest * experiment.Ts:.0f} s"
            )
    except NotMinimumPhaseError as error:
        quotients = [m_o.over(m_i) for m_o in outer for m_i in inner]
        warning = (
            f"{error}; the attitude gains are found with the rate loop's reference model instead (r_i = M_i^-1 y_i): "
            "record a longer or stronger excitation, leave the integral out (--structure PD), or ask for another "
            "rate-loop model"
        )
        return experiment.y_i, inner, max(quotient.settling_samples() for quotient in quotients), (warning,)
    return r_i, [], settling, ()


def starting_set(experiment: Experiment, spec: TuningSpec) -> Gains:
    """Gains with everything that is not tuned: yaw, limits, filter and unit, as specified or as flown.

    Raises
    ------
    TuningError
        When neither the log nor the specification says what the yaw gains or the derivative's filter are, or they
        say different units of torque.
    """
    flown = experiment.flown
    if flown is not None:
        check_unit(
            experiment.source, flown.moment_scale, spec.moment_scale, "leave moment_scale out of the --spec file"
        )
    if flown is not None and spec.profile == MIMO:
        flown = flown.for_our_law()
    required = {
        "which yaw gains flew ([yaw]: Kp_o, Kp_i, Ki_i, Kd_i)": spec.yaw,
        "which derivative filter flew (derivative_cutoff_hz, Hz, 0 for none)": spec.derivative_cutoff_hz,
    }
    missing = [name for name, value in required.items() if value is None]
    if flown is None and missing:
        raise TuningError(
            f"{experiment.source}: the log does not contain {' and '.join(missing)}; put it into a --spec file"
        )
    zero = np.zeros((2, 2))
    cutoff = spec.derivative_cutoff_hz
    filters = replace(flown.filters, Ts=experiment.Ts, model_omega=0.0) if flown else Filters(experiment.Ts)
    yaw = YawGains(**spec.yaw.model_dump()) if spec.yaw else flown.yaw  # type: ignore[union-attr]
    limits = Limits(**spec.limits.model_dump()) if spec.limits else flown.limits if flown else Limits()
    return Gains(
        Kp_o=zero,
        Kp_i=zero,
        Ki_i=zero,
        Kd_i=zero,
        Kff_i=zero,
        yaw=yaw,
        filters=filters if cutoff is None else replace(filters, derivative_cutoff_hz=cutoff),
        limits=limits,
        moment_scale=spec.moment_scale or (flown.moment_scale if flown else None),
    )


def _prior(experiment: Experiment, spec: TuningSpec, axes: slice) -> dict[str, NDArray[np.float64]] | None:
    """The flown rate gains by term, if the estimate is to be pulled towards them."""
    if spec.pull == 0:
        return None
    flown = experiment.flown
    if flown is None:
        raise TuningError(f"{experiment.source}: pull: the log does not contain which gains flew; set pull to 0")
    return {term: getattr(flown, TERMS[term].matrix)[axes, axes] for term in spec.structure}


def _assemble(parts: list[NDArray[np.float64]], stretches: Stretches) -> NDArray[np.float64]:
    """One (2, 2) matrix from the parts of the axes."""
    matrix = np.zeros((2, 2))
    for part, (axes, _) in zip(parts, stretches, strict=True):
        matrix[axes, axes] = part
    return matrix
