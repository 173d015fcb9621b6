"""Gains designed on the measured response of one or more flights, compared with those that flew."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from mimopilot.tuning.analysis.certify import certify
from mimopilot.tuning.analysis.manoeuvres import manoeuvres
from mimopilot.tuning.certificate import Certificate, Verdict
from mimopilot.tuning.design.cascade_estimate import estimate, starting_set
from mimopilot.tuning.design.prediction import Prediction, offaxis_doubt, predict, reasons_to_keep
from mimopilot.tuning.design.response_design import FIRST_BANDWIDTH, Design, ResponseDesign, vehicle_damps
from mimopilot.tuning.design.stock_profile import WORTH, at_loop_rates, in_digits, our_module, stock_starts, worth
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.law import ATTITUDE, LOOP_TERMS
from mimopilot.tuning.law_terms import MIMO
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.provenance import Provenance
from mimopilot.tuning.reference_model import ContinuousModel, SecondOrder
from mimopilot.tuning.spec import TuningSpec

#: The rate loop's model that VRFT starts from: bandwidth times delay and rotor lag, its range (rad/s), its damping.
REACHABLE, SLOWEST, FASTEST, DAMPING = 1.0, 5.0, 60.0, 0.7
#: Most designs: each that lacks a certificate tightens the next.
MAX_DESIGNS = 5
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
    bench = ResponseDesign.of(measured, spec.design)
    inner = _rate_model(bench)
    starts, origin = starting_points(measured, spec, inner, bench)
    found, certificates = _certified_design(bench, measured, spec, starts, inner)
    warnings = [] if all(one.experiment.motors for one in measured) else [MOTORS_UNKNOWN]
    if vehicle_damps(found):
        warnings.append(VEHICLE_DAMPS)
    provenance = Provenance(
        method=spec.label,
        inner_model=(inner, inner),
        outer_model=(found.model, found.model),
        standard_deviation={name: value.tolist() for name, value in bench.deviations(found).items()},
        warnings=tuple(warnings),
        details={
            "structure": spec.structure,
            "start": origin,
            "limited_by": found.active,
            "design": spec.design.model_dump(),
            **comparison(found, measured, bench, spec),
        },
    )
    return replace(found.gains, provenance=provenance).with_certificate(_weakest(certificates))


def _certified_design(
    bench: ResponseDesign,
    measured: Sequence[PlantEstimates],
    spec: TuningSpec,
    starts: Sequence[Gains],
    inner: SecondOrder,
) -> tuple[Design, list[Certificate]]:
    """The first design that is certified on every log, with tighter limits after each that is not."""
    source = measured[0].experiment.source
    bandwidth = None
    for _ in range(MAX_DESIGNS):
        found = bench.design(starts, spec.structure, spec.full, bandwidth)
        found = replace(found, gains=in_digits(found.gains))
        certificates = [
            certificate(at_loop_rate, one, spec, inner, found.model)
            for one in measured
            for at_loop_rate in at_loop_rates(found.gains, one.experiment)
        ]
        missing = [one for one in certificates if one.verdict != Verdict.CERTIFIED]
        if not missing:
            return found, certificates
        starts, bandwidth = [found.gains], found.model.omega
        bench = bench.tighter(found.gains)
    limits = f"; the design is limited by {', '.join(found.active)}" if found.active else ""
    raise TuningError(
        f"{source}: no gains of this structure are certified, nothing is written: {missing[0].reason}{limits}"
    )


def certificate(
    gains: Gains, measured: PlantEstimates, spec: TuningSpec, inner: ContinuousModel, outer: ContinuousModel
) -> Certificate:
    """The certificate of a designed set from one log."""
    return certify(
        gains,
        measured.response,
        [inner.discretise(gains.Ts)] * 2,
        [outer.discretise(gains.Ts)] * 2,
        measured.experiment.sha256,
        spec.certificate,
        lambda: measured.model,
    )


def _weakest(certificates: Sequence[Certificate]) -> Certificate:
    """The certificate with the thinnest margin; it holds those of the other logs."""
    weakest = max(certificates, key=lambda one: one.figures["Ms"] + one.figures["Ms_error"])
    return replace(weakest, further=tuple(one.as_table() for one in certificates if one is not weakest))


def _rate_model(bench: ResponseDesign) -> SecondOrder:
    """A rate loop that the slowest of the plants can reach."""
    lag = max(plant.shape[0] + plant.shape[1] for plant in bench.plants)
    top = min(plant.omega[plant.band.stop - 1] for plant in bench.plants) / 2
    fastest = max(SLOWEST, min(FASTEST, float(top)))
    return SecondOrder(round(float(np.clip(REACHABLE / max(lag, 1e-3), SLOWEST, fastest)), 1), DAMPING)


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
    tasks = [(plant, manoeuvres(plant, found.model.discretise(plant.Ts))) for plant in bench.plants]
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
