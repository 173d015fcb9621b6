"""Gains designed on the measured response of one or more flights, compared with those that flew."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from mimopilot.tuning.analysis.certify_axes import certify_axes
from mimopilot.tuning.analysis.manoeuvres import manoeuvres
from mimopilot.tuning.certificate import Certificate
from mimopilot.tuning.design.cascade_estimate import estimate, starting_set
from mimopilot.tuning.design.certified_design import certified_design, rate_model, uncertified, weakest
from mimopilot.tuning.design.design_spread import standard_deviations
from mimopilot.tuning.design.prediction import Prediction, offaxis_doubt, predict, reasons_to_keep
from mimopilot.tuning.design.response_design import BANDWIDTHS, FIRST_BANDWIDTH, Design, ResponseDesign, vehicle_damps
from mimopilot.tuning.design.stock_profile import WORTH, at_loop_rates, our_module, stock_starts, worth
from mimopilot.tuning.design.yaw_design import tune_yaw, with_yaw
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.law_filters import MIMO
from mimopilot.tuning.law_terms import ATTITUDE, LOOP_TERMS
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.provenance import Provenance
from mimopilot.tuning.reference_model import SecondOrder
from mimopilot.tuning.spec import TuningSpec

#: Matrices of the loop itself: without feed-forward from an attitude model.
LOOP_MATRICES = (ATTITUDE.matrix, *(term.matrix for term in LOOP_TERMS.values()))
MOTORS_UNKNOWN = (
    "the log does not contain the motors' commands (PX4: actuator_motors): their limits are taken as those of a "
    "quadrotor that hovers at half thrust"
)
VEHICLE_DAMPS = (
    "the attitude model asks for less damping than the vehicle has: Kd_i would be negative and is bounded at 0, which "
    "costs following"
)


def tune_by_design(measured: Sequence[PlantEstimates], spec: TuningSpec) -> Gains:
    """The best gains of the structure within the certificate's margins, for all logs of one vehicle.

    Parameters
    ----------
    measured : sequence of PlantEstimates
        One for each flight; the first says what is not tuned.
    spec : TuningSpec
        Method, structure, limits.

    Returns
    -------
    Gains
        With a certificate from each log. Its provenance holds the predicted figures of these and the flown gains, and
        why the flown ones are better, if they are.

    Raises
    ------
    TuningError
        When no gains of the structure are certified.
    """
    # A model that the vehicle itself follows is no faster.
    bench = ResponseDesign.of(measured, spec.design, BANDWIDTHS if spec.follow_model else ())
    inner = rate_model(bench)
    starts, origin = starting_points(measured, spec, inner, bench)
    found, certificates = certified_design(bench, measured, spec, starts, inner)
    missing = uncertified(certificates)
    if missing:
        limits = f"; the design is limited by {', '.join(found.active)}" if found.active else ""
        raise TuningError(
            f"{measured[0].experiment.source}: no gains of this structure are certified, nothing is written: "
            f"{missing[0].reason}{limits}"
        )
    yaw = tune_yaw(measured, spec, found.gains, found.model.omega)

    def certified(gains: Gains) -> Certificate:
        certificates = []
        for one in measured:
            for at_rate in at_loop_rates(gains, one.experiment):
                rate, attitude = ([model.discretise(at_rate.Ts)] * 2 for model in (inner, found.model))
                certificates.append(certify_axes(at_rate, one, rate, attitude, spec.certificate))
        return weakest(certificates)

    gains, yaw, final = with_yaw(found.gains, yaw, certified)
    warnings = [] if all(one.experiment.motors for one in measured) else [MOTORS_UNKNOWN]
    if vehicle_damps(found):
        warnings.append(VEHICLE_DAMPS)
    provenance = Provenance(
        method=spec.label,
        inner_model=(inner, inner),
        outer_model=(found.model, found.model),
        standard_deviation={name: value.tolist() for name, value in standard_deviations(bench, found).items()},
        warnings=tuple(warnings),
        details={
            "structure": spec.structure,
            "start": origin,
            "limited_by": found.active,
            "design": spec.design.model_dump(),
            **comparison(found, measured, bench, spec),
        },
    )
    return replace(gains, provenance=yaw.provenance(provenance)).with_certificate(final)


def starting_points(
    measured: Sequence[PlantEstimates], spec: TuningSpec, inner: SecondOrder, bench: ResponseDesign
) -> tuple[list[Gains], str]:
    """Gain sets that a search begins at, and their origin: VRFT's of the first log, and the flown ones."""
    first, B = measured[0].experiment, bench.plants[0].body.B
    base = starting_set(first, spec)
    if spec.profile != MIMO:
        return stock_starts(base, first, inner.omega, B), "flown, rigid body"
    # The bandwidth is the design's.
    filters = replace(base.filters, model_omega=FIRST_BANDWIDTH if spec.follow_model else 0.0)
    inverse = np.asarray(np.linalg.inv(B), np.float64)
    base = replace(base, filters=filters, Kff_o=np.eye(2), Kaff_i=inverse)
    starts, origin = [], []
    try:
        task = spec.model_copy(update={"inner": (inner, inner)})
        estimated = estimate(first, task, None, measured[0].body).gains
        starts.append(replace(base, **{name: getattr(estimated, name) for name in LOOP_MATRICES}))
        origin.append("VRFT")
    except TuningError:  # no estimate of that model: another start does
        pass
    if first.flown is not None:
        starts.append(replace(base, **{name: getattr(first.flown, name) for name in LOOP_MATRICES}))
        origin.append("flown")
    if not any(bench.is_stable(start) for start in starts):
        decoupled = inner.omega * inverse
        starts.append(replace(base, Kp_o=inner.omega / 3 * np.eye(2), Kp_i=decoupled, Ki_i=decoupled))
        origin.append("rigid body")
    return starts, ", ".join(origin)


def comparison(
    found: Design, measured: Sequence[PlantEstimates], bench: ResponseDesign, spec: TuningSpec
) -> dict[str, Any]:
    """Predicted figures as plain values: of a design, of the flown gains, and of an alternative.

    That is the same design axis by axis, or for a stock controller our module's with full matrices.

    ``keep_flown`` says why the flown gains are better; it is empty if they are not.
    """
    filters = found.law.filters
    tasks = [(plant, manoeuvres(plant, found.model.discretise(plant.Ts), filters)) for plant in bench.plants]
    new = [predict(found.gains, *task) for task in tasks]
    shown = {"tuned": new}
    if spec.profile != MIMO:
        module = our_module(found, bench, spec)
        shown["module"] = [predict(module.gains, *task) for task in tasks]
    elif spec.full:
        siso = bench.design([found.gains], spec.structure, full=False, bandwidth=found.model.omega)
        shown["siso"] = [predict(siso.gains, *task) for task in tasks]
    result: dict[str, Any] = {}
    flown = [one.experiment.flown for one in measured]
    if all(flown):
        shown["flown"] = [predict(one, *task) for one, task in zip(flown, tasks, strict=True) if one is not None]
        fastest = bench.flown_bandwidth or found.model.omega
        result["flown_bandwidth"] = fastest
        doubts = [
            offaxis_doubt(found.gains, one, *task) for one, task in zip(flown, tasks, strict=True) if one is not None
        ]
        keep = reasons_to_keep(new, shown["flown"], spec.design, found.model.omega / fastest, doubts)
        result |= {"better_than_flown": not keep, "keep_flown": keep}
    if spec.profile != MIMO:
        result |= {WORTH: worth(shown)}
    return {"predicted": {name: _plain(figures) for name, figures in shown.items()}, **result}


def _plain(predictions: Sequence[Prediction]) -> list[dict[str, Any]]:
    """Predictions as TOML and JSON values."""
    return [
        {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(one).items()}
        for one in predictions
    ]
