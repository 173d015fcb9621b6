"""Scan of reference models for the rate loop and of derivative filters, with one recommended.

Each candidate is tuned on the log. The measured frequency response predicts its doublet by Parseval's theorem. Of the
candidates that follow the attitude model nearly best, the one with the least torque is recommended.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.analysis.closed_loop import cascade_loop, doublet_spectrum
from mimopilot.tuning.certificate import Verdict
from mimopilot.tuning.design.cascade import tune
from mimopilot.tuning.design.refine_attitude import ACCURATE
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.estimation.zeros import flexible_model, slowest_zero
from mimopilot.tuning.experiment import Experiment, external_signal
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.law import Filters
from mimopilot.tuning.plant.frequency_response import PlantResponse
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.reference_model import SecondOrder, second_order
from mimopilot.tuning.spec import TuningSpec

#: The grid, around the thesis' rate loop of 20 rad/s and damping 0.4: rad/s, damping, delay in samples.
BANDWIDTHS = (15.0, 17.5, 20.0, 22.5, 25.0, 30.0, 40.0)
DAMPINGS = (0.4, 0.55, 0.7, 1.0)
DELAYS = (0, 2, 4)
#: Cut-offs of the derivative filter, Hz, tried beside the flown one. Above its cut-off D only amplifies noise and
#: structural modes; a lower one also lowers a fast loop's gain above the band.
CUTOFFS = (10.0, 5.0)
#: Largest bandwidth over the slowest non-minimum-phase zero (S. Skogestad, I. Postlethwaite, Multivariable Feedback
#: Control: limitations imposed by right half-plane zeros).
ZERO_SHARE = 0.5
#: Model from which the search for non-minimum-phase zeros starts: rad/s, damping, delay in samples.
FLEXIBLE = (20.0, 0.7, 0)
#: Frequency step of the predicted spectrum, rad/s.
RESOLUTION = 0.05
#: Largest relative error of the response at the frequencies of the prediction.
PREDICTABLE = 3 * ACCURATE
#: A candidate whose error is within this factor of the best one's counts as equally good.
NEARLY_BEST = 1.1

#: Rate-loop model and derivative cut-off, Hz.
Choice = tuple[tuple[float, float, int], float]


@dataclass(frozen=True)
class Doublet:
    """The manoeuvre that candidates are compared by: amplitude (deg) and whole length (s)."""

    amplitude_deg: float = 18.0
    period_s: float = 1.6


@dataclass(frozen=True, eq=False)
class Candidate:
    """One reference model and the result of tuning for it.

    Attributes
    ----------
    inner : tuple of (omega rad/s, damping, delay samples)
        Model of the rate loop.
    cutoff_hz : float, Hz
        Of the derivative filter.
    gains : Gains or None
        Tuned and certified; None when tuning was refused, see `reason`.
    verdict, reason : str
        Of the certificate.
    delta : tuple of 2 float
        The certificate's small-gain figure of the rate loop and twice its standard error.
    fit : float
        Share of the torque that the rate controller explains, the smaller of both axes.
    follow_deg, offaxis_deg : tuple of 2 float, deg
        Predicted RMS in the roll and the pitch doublet: error to the attitude model; angle of the other axis.
    effort : tuple of 2 float
        Predicted RMS of the torques (normalised).
    """

    inner: tuple[float, float, int]
    cutoff_hz: float
    gains: Gains | None
    verdict: str
    reason: str
    delta: tuple[float, float] = (np.inf, np.inf)
    fit: float = 0.0
    follow_deg: tuple[float, float] = (np.inf, np.inf)
    offaxis_deg: tuple[float, float] = (np.inf, np.inf)
    effort: tuple[float, float] = (np.inf, np.inf)


@dataclass(frozen=True, eq=False)
class Advice:
    """Result of the scan.

    Attributes
    ----------
    candidates : tuple of Candidate
        In the order of the grid.
    recommended : Candidate
        Certified, error within 10 % of the best certified one, and of those the least torque.
    zero : float or None, rad/s
        Slowest non-minimum-phase zero of the plant (`tuning.estimation.zeros`); no candidate is faster than half of it.
    """

    candidates: tuple[Candidate, ...]
    recommended: Candidate
    zero: float | None


def predict_doublet(
    gains: Gains, plant: PlantResponse, spec: TuningSpec, doublet: Doublet
) -> tuple[tuple[float, float], tuple[float, float], tuple[float, float]]:
    """Predicted RMS of the error (deg), the other axis (deg) and the torques, roll then pitch doublet.

    The mean is over twice the doublet's length. Frequencies above those measured are left out; below them the plant is
    a rigid body.
    """
    known = plant.at(plant.known() & (plant.relative_error() < PREDICTABLE)).extended()
    loop = cascade_loop(gains, known)
    omega = np.arange(RESOLUTION, known.omega[-1], RESOLUTION)
    signal = np.radians(doublet.amplitude_deg) * doublet_spectrum(omega, doublet.period_s)
    models = [model.frequency_response(omega) for model in spec.models("outer", gains.Ts)]
    at = np.concatenate([[0.0], known.omega])
    T_o = [[np.interp(omega, at, [float(i == j), *loop.T_o[:, i, j]]) for j in range(2)] for i in range(2)]
    U_o = [[np.interp(omega, at, [0.0, *loop.U_o[:, i, j]]) for j in range(2)] for i in range(2)]

    def rms(response: NDArray[np.complex128]) -> float:
        energy = np.trapezoid(np.abs(response * signal) ** 2, omega) / np.pi
        return float(np.sqrt(energy / (2 * doublet.period_s)))

    follow = [np.degrees(rms(T_o[i][i] - models[i])) for i in range(2)]
    offaxis = [np.degrees(rms(T_o[1 - i][i])) for i in range(2)]
    effort = [float(np.hypot(rms(U_o[0][i]), rms(U_o[1][i]))) for i in range(2)]
    return (follow[0], follow[1]), (offaxis[0], offaxis[1]), (effort[0], effort[1])


def advise(
    experiment: Experiment,
    spec: TuningSpec,
    doublet: Doublet | None = None,
    watch: Callable[[Iterable[Choice]], Iterable[Choice]] = iter,
) -> Advice:
    """Tune for every model of the grid and recommend one.

    Parameters
    ----------
    experiment : Experiment
        One flight.
    spec : TuningSpec
        Everything but the inner model, which is scanned; a derivative filter given here is kept.
    doublet : Doublet, optional
        The manoeuvre that candidates are compared by.
    watch : callable, optional
        Wraps the iteration, for a progress bar.

    Returns
    -------
    Advice

    Raises
    ------
    TuningError
        When the log cannot be tuned from, no candidate is certified, or a non-minimum-phase zero is too slow for all.
    """
    doublet = doublet or Doublet()
    measured = PlantEstimates(experiment)
    plant = measured.response
    candidates: list[Candidate] = []
    cutoffs = _cutoffs(experiment, spec)
    zero = _slowest_zero(experiment, cutoffs[0])
    bandwidths = [omega for omega in BANDWIDTHS if zero is None or omega <= ZERO_SHARE * zero]
    if zero is not None and not bandwidths:
        raise TuningError(
            f"{experiment.source}: the plant has a non-minimum-phase zero at {zero:.1f} rad/s, too slow for every rate "
            f"loop of the scan; tune with --inner below {ZERO_SHARE * zero:.1f} rad/s"
        )
    spec = spec.model_copy(update={"doublet_s": doublet.period_s})
    for inner, cutoff in watch(list(product(product(bandwidths, DAMPINGS, DELAYS), cutoffs))):
        model = SecondOrder(*inner)
        task = spec.model_copy(update={"inner": (model, model), "derivative_cutoff_hz": cutoff})
        try:
            gains = tune(experiment, task, measured)
        except TuningError as error:
            candidates.append(Candidate(inner, cutoff, None, "refused", str(error)))
            continue
        verdict, reason = gains.verdict()
        figures = gains.certificate.figures if gains.certificate else {}
        follow_deg, offaxis_deg, effort = predict_doublet(gains, plant, spec, doublet)
        candidates.append(
            Candidate(
                inner=inner,
                cutoff_hz=cutoff,
                gains=gains,
                verdict=verdict,
                reason=reason,
                delta=(figures.get("delta", np.inf), figures.get("delta_error", np.inf)),
                fit=min(gains.provenance.fit),
                follow_deg=follow_deg,
                offaxis_deg=offaxis_deg,
                effort=effort,
            )
        )
    good = [candidate for candidate in candidates if candidate.verdict == Verdict.CERTIFIED]
    if not good:
        raise TuningError(
            f"{experiment.source}: none of {len(candidates)} rate loops is certified; the first: "
            f"{candidates[0].verdict}: {candidates[0].reason}"
        )
    best = min(np.hypot(*candidate.follow_deg) for candidate in good)
    close = [candidate for candidate in good if np.hypot(*candidate.follow_deg) <= NEARLY_BEST * best]
    return Advice(tuple(candidates), min(close, key=lambda candidate: np.hypot(*candidate.effort)), zero)


def _slowest_zero(experiment: Experiment, cutoff_hz: float) -> float | None:
    """Slowest non-minimum-phase zero from torque to rate of the two axes, rad/s; None: there is none."""
    start, external = second_order(*FLEXIBLE, experiment.Ts), external_signal(experiment)[0]
    flown = experiment.flown.filters if experiment.flown else Filters(experiment.Ts)
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


def _cutoffs(experiment: Experiment, spec: TuningSpec) -> list[float]:
    """Derivative cut-offs to try, Hz; 0: none."""
    if spec.derivative_cutoff_hz is not None:
        return [spec.derivative_cutoff_hz]
    if experiment.flown is None:
        return list(CUTOFFS)
    flown = experiment.flown.derivative_cutoff_hz
    return [flown, *(cutoff for cutoff in CUTOFFS if flown == 0 or cutoff < flown)]
