"""A design that is repeated with tighter limits until it is certified, for any axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mimopilot.tuning.analysis.certify import certify
from mimopilot.tuning.analysis.certify_axes import ORDER
from mimopilot.tuning.axes import Law
from mimopilot.tuning.certificate import Certificate, Verdict
from mimopilot.tuning.design.response_design import Design, ResponseDesign
from mimopilot.tuning.design.stock_profile import at_loop_rates, in_digits
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.reference_model import ContinuousModel, SecondOrder
from mimopilot.tuning.spec import TuningSpec

#: A rate loop that a vehicle reaches: bandwidth times delay and rotor lag, its range (rad/s), its damping.
REACHABLE, SLOWEST, FASTEST, DAMPING = 1.0, 5.0, 60.0, 0.7
#: Most designs: each that lacks a certificate tightens the next.
MAX_DESIGNS = 5


def certified_design(
    bench: ResponseDesign,
    measured: Sequence[PlantEstimates],
    spec: TuningSpec,
    starts: Sequence[Law],
    inner: SecondOrder,
) -> tuple[Design, list[Certificate]]:
    """The first design that is certified on every log, with tighter limits after each that is not; else the last one.

    Parameters
    ----------
    bench : ResponseDesign
    measured : sequence of PlantEstimates
        Of the axes that are designed, one for each log.
    spec : TuningSpec
    starts : sequence of Law
        See `ResponseDesign.design`.
    inner : SecondOrder
        Model of the rate loop, see `rate_model`.
    """
    bandwidth = None
    for attempt in range(MAX_DESIGNS):
        found = bench.design(starts, spec.structure, spec.full, bandwidth)
        found = replace(found, law=in_digits(found.law))
        certificates = [
            certificate(at_rate, one, spec, inner, found.model)
            for one in measured
            for at_rate in at_loop_rates(found.law, one.experiment)
        ]
        if not uncertified(certificates) or attempt == MAX_DESIGNS - 1:
            break
        starts, bandwidth = [found.law], found.model.omega
        bench = bench.tighter(found.law)
    return found, certificates


def uncertified(certificates: Sequence[Certificate]) -> list[Certificate]:
    """Those with another verdict than ``certified``."""
    return [one for one in certificates if one.verdict != Verdict.CERTIFIED]


def certificate(
    law: Law, measured: PlantEstimates, spec: TuningSpec, inner: ContinuousModel, outer: ContinuousModel
) -> Certificate:
    """The certificate of a designed law from one log of its axes."""
    axes = measured.response.axes
    return certify(
        law,
        measured.response,
        [inner.discretise(law.Ts)] * axes,
        [outer.discretise(law.Ts)] * axes,
        measured.experiment.sha256,
        spec.certificate,
        # A model is identified from both rates of roll and pitch.
        (lambda: measured.model) if axes == 2 else (lambda: None),
    )


def rate_model(bench: ResponseDesign) -> SecondOrder:
    """A rate loop that the slowest of the plants can reach."""
    lag = max(plant.shape[0] + plant.shape[1] for plant in bench.plants)
    top = min(plant.omega[plant.band.stop - 1] for plant in bench.plants) / 2
    fastest = max(SLOWEST, min(FASTEST, float(top)))
    return SecondOrder(round(float(np.clip(REACHABLE / max(lag, 1e-3), SLOWEST, fastest)), 1), DAMPING)


def weakest(certificates: Sequence[Certificate]) -> Certificate:
    """The certificate with the worst verdict and the thinnest margin; it holds those of the other logs."""

    def badness(one: Certificate) -> tuple[int, float]:
        return ORDER.index(one.verdict), one.figures.get("Ms", np.inf) + one.figures.get("Ms_error", 0.0)

    found = max(certificates, key=badness)
    return replace(found, further=tuple(one.as_table() for one in certificates if one is not found))
