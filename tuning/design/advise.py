"""The design on a log and the alternatives around it, each with its figures."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

from mimopilot.tuning.analysis.certify_axes import certify_axes
from mimopilot.tuning.analysis.manoeuvres import manoeuvres
from mimopilot.tuning.design.prediction import Prediction, predict
from mimopilot.tuning.design.response_design import BANDWIDTHS, ResponseDesign
from mimopilot.tuning.design.tune_by_design import tune_by_design
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.estimation.zeros import flexible_model, slowest_zero
from mimopilot.tuning.experiment import Experiment, external_signal
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.law_filters import MIMO, Filters
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.reference_model import ContinuousModel, second_order
from mimopilot.tuning.spec import TuningSpec

#: Steps along the table of bandwidths of the slower and the faster alternative: a factor of 1.26.
STEPS = 2
#: Cut-offs of the derivative filter, Hz, tried beside the flown one. Above its cut-off D only amplifies noise and
#: structural modes.
CUTOFFS = (20.0, 10.0)
#: Torque noise over the flown gains' of the quieter alternative.
QUIET = 1.0
#: Model from which the search for non-minimum-phase zeros starts: rad/s, damping, delay in samples.
FLEXIBLE = (20.0, 0.7, 0)


@dataclass(frozen=True, eq=False)
class Candidate:
    """One gain set and its figures.

    Attributes
    ----------
    name : str
        What differs: ``recommended``, ``flown``, ``SISO``, ``slower``, ``faster``...
    gains : Gains
        With the certificate from the log.
    bandwidth : float, rad/s
        Of the attitude model that its figures refer to.
    prediction : Prediction
    """

    name: str
    gains: Gains
    bandwidth: float
    prediction: Prediction


@dataclass(frozen=True, eq=False)
class Advice:
    """The recommended gains and the alternatives.

    Attributes
    ----------
    candidates : tuple of Candidate
        The recommended one first, then the flown gains if they are known.
    refused : mapping
        Name of an alternative -> why there is none.
    zero : float or None, rad/s
        Slowest non-minimum-phase zero of the plant (`tuning.estimation.zeros`); None: there is none.
    """

    candidates: tuple[Candidate, ...]
    refused: dict[str, str]
    zero: float | None

    @property
    def recommended(self) -> Candidate:
        """What `tune` finds."""
        return self.candidates[0]


@dataclass(frozen=True)
class Alternative:
    """A design that differs from the recommended one in one respect.

    Attributes
    ----------
    name : str
    bandwidth : float, rad/s
    full : bool
        False: SISO.
    cutoff_hz : float, Hz
        Of the derivative filter.
    noise : float
        Limit of the torque's noise over the flown one's.
    """

    name: str
    bandwidth: float
    full: bool
    cutoff_hz: float
    noise: float


def advise(
    experiment: Experiment,
    spec: TuningSpec,
    watch: Callable[[Iterable[Alternative]], Iterable[Alternative]] = iter,
) -> Advice:
    """The design on a log and the alternatives around it.

    Parameters
    ----------
    experiment : Experiment
        One flight.
    spec : TuningSpec
        Structure and limits; its reference models are not used.
    watch : callable, optional
        Wraps the iteration, for a progress bar.

    Returns
    -------
    Advice

    Raises
    ------
    TuningError
        As `tuning.design.tune_by_design.tune_by_design`.
    """
    if spec.profile != MIMO:
        raise TuningError(f"profile: got {spec.profile}, expected {MIMO}: for a stock controller use tune --profile")
    measured = PlantEstimates(experiment)

    def certified(gains: Gains, outer: ContinuousModel) -> Gains:
        rate, attitude = ([model.discretise(gains.Ts)] * 2 for model in (inner, outer))
        return gains.with_certificate(certify_axes(gains, measured, rate, attitude, spec.certificate))

    best = tune_by_design([measured], spec)
    assert best.provenance.inner_model is not None and best.provenance.outer_model is not None
    inner, outer = best.provenance.inner_model[0], best.provenance.outer_model[0]
    bench = ResponseDesign.of([measured], spec.design, BANDWIDTHS if spec.follow_model else ())
    found = [_candidate("recommended", best, outer, bench)]
    refused: dict[str, str] = {}
    if experiment.flown is not None:
        flown = replace(experiment.flown, filters=replace(experiment.flown.filters, Ts=experiment.Ts))
        found.append(_candidate("flown", certified(flown, outer), outer, bench))
    for one in watch(_alternatives(best, outer.bandwidth, spec, bench.bandwidths)):
        limits = spec.design.model_copy(update={"noise": one.noise})
        start = replace(best, filters=replace(best.filters, derivative_cutoff_hz=one.cutoff_hz))
        try:
            design = ResponseDesign.of([measured], limits, bench.bandwidths).design(
                [start], spec.structure, one.full, one.bandwidth
            )
        except TuningError as error:
            refused[one.name] = str(error)
            continue
        found.append(_candidate(one.name, certified(design.gains, design.model), design.model, bench))
    return Advice(tuple(found), refused, _slowest_zero(experiment, best.derivative_cutoff_hz))


def _alternatives(best: Gains, bandwidth: float, spec: TuningSpec, bandwidths: tuple[float, ...]) -> list[Alternative]:
    """What could be asked for instead of the recommended set."""
    same = Alternative("", bandwidth, spec.method == "mimo", best.derivative_cutoff_hz, spec.design.noise)
    place = min(range(len(bandwidths)), key=lambda k: abs(bandwidths[k] - bandwidth))
    found = [replace(same, name="SISO", full=False)] if same.full else []
    for name, other in (("slower", place - STEPS), ("faster", place + STEPS)):
        if 0 <= other < len(bandwidths):
            found.append(replace(same, name=name, bandwidth=bandwidths[other]))
    found.append(replace(same, name="quieter", noise=QUIET))
    for cutoff in CUTOFFS:
        if same.cutoff_hz == 0 or cutoff < same.cutoff_hz:
            found.append(replace(same, name=f"D filter {cutoff:g} Hz", cutoff_hz=cutoff))
    return found


def _candidate(name: str, gains: Gains, model: ContinuousModel, bench: ResponseDesign) -> Candidate:
    plant = bench.plants[0]
    prediction = predict(gains, plant, manoeuvres(plant, model.discretise(plant.Ts), gains.filters))
    return Candidate(name, gains, model.bandwidth, prediction)


def _slowest_zero(experiment: Experiment, cutoff_hz: float) -> float | None:
    """Slowest non-minimum-phase zero from torque to rate of the two axes, rad/s; None: there is none."""
    start, external = second_order(*FLEXIBLE, experiment.Ts), external_signal(experiment)[0]
    flown = experiment.flown.for_our_law().filters if experiment.flown else Filters(experiment.Ts)
    filters = replace(flown, Ts=experiment.Ts, derivative_cutoff_hz=cutoff_hz)
    models = [
        flexible_model(
            experiment.u[:, axis],
            experiment.y_i[:, axis],
            external,
            start,
            segments=experiment.segments,
            filters=filters,
        )
        for axis in range(2)
    ]
    return slowest_zero(models)
