"""Which reference model to ask of the rate loop: the choice that decides the attitude response.

Each candidate is tuned on the log; what its closed loop will then do in a doublet follows from the measured
frequency response by Parseval. Recommended is the gentlest of those that follow the attitude model nearly best.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from tuning.cascade import measured_plant, tune
from tuning.certificate import CERTIFIED
from tuning.closed_loop import ACCURATE, PlantResponse, cascade_loop
from tuning.errors import TuningError
from tuning.experiment import Experiment
from tuning.gains import Gains
from tuning.spec import TuningSpec

BANDWIDTHS = (15.0, 20.0, 25.0, 30.0, 40.0)
DAMPINGS = (0.4, 0.55, 0.7, 1.0)
DELAYS = (0, 2, 4)
#: Following within this share of the best candidate counts as following as well.
NEARLY_BEST = 1.1

Signal = NDArray[np.float64]


@dataclass(frozen=True)
class Doublet:
    """The manoeuvre that candidates are judged by: amplitude (deg) and whole length (s)."""

    amplitude_deg: float = 18.0
    period_s: float = 1.6


@dataclass(frozen=True, eq=False)
class Candidate:
    """One reference model and what came of it.

    Attributes
    ----------
    inner : tuple of (omega rad/s, damping, delay samples)
        Model of the rate loop.
    gains : Gains or None
        Tuned and certified; None when tuning refused, `reason` says why.
    verdict, reason : str
        Of the certificate.
    fit : float
        Share of the moment that the rate controller explains, the smaller of both axes.
    follow_deg, offaxis_deg : tuple of 2 float, deg
        Predicted RMS of the roll and the pitch doublet: distance to the attitude model; the other axis.
    effort : tuple of 2 float
        Predicted RMS of the moments.
    """

    inner: tuple[float, float, int]
    gains: Gains | None
    verdict: str
    reason: str
    fit: float = 0.0
    follow_deg: tuple[float, float] = (np.inf, np.inf)
    offaxis_deg: tuple[float, float] = (np.inf, np.inf)
    effort: tuple[float, float] = (np.inf, np.inf)


def predict(
    gains: Gains, plant: PlantResponse, spec: TuningSpec, doublet: Doublet
) -> tuple[tuple[float, float], tuple[float, float], tuple[float, float]]:
    """Predicted RMS of following (deg), of the other axis (deg) and of the moments, roll then pitch doublet.

    The mean is over twice the doublet's length; frequencies that the log does not know are left out.
    """
    known = plant.at(plant.coherent() & (plant.relative_error() < 3 * ACCURATE))
    loop = cascade_loop(gains, known)
    s = 1j * known.omega
    signal = np.radians(doublet.amplitude_deg) * (1 - np.exp(-s * doublet.period_s / 2)) ** 2 / s
    models = [model.frequency_response(known.omega) for model in spec.models("outer", gains.Ts)]

    def rms(response: NDArray[np.complex128]) -> float:
        energy = np.trapezoid(np.abs(response * signal) ** 2, known.omega) / np.pi
        return float(np.sqrt(energy / (2 * doublet.period_s)))

    follow = [np.degrees(rms(loop.T_o[:, i, i] - models[i])) for i in range(2)]
    offaxis = [np.degrees(rms(loop.T_o[:, 1 - i, i])) for i in range(2)]
    effort = [float(np.hypot(rms(loop.U_o[:, 0, i]), rms(loop.U_o[:, 1, i]))) for i in range(2)]
    return (follow[0], follow[1]), (offaxis[0], offaxis[1]), (effort[0], effort[1])


def advise(
    experiment: Experiment,
    spec: TuningSpec,
    doublet: Doublet | None = None,
    watch: Callable[[Iterable[tuple[float, float, int]]], Iterable[tuple[float, float, int]]] = iter,
) -> tuple[list[Candidate], Candidate]:
    """Tune for every model of the grid and recommend one.

    Parameters
    ----------
    experiment : Experiment
        One flight.
    spec : TuningSpec
        Everything but the inner model, which is scanned.
    doublet : Doublet, optional
        What the candidates are judged by.
    watch : callable, optional
        Wraps the iteration, for a progress bar.

    Returns
    -------
    candidates : list of Candidate
        In the order of the grid.
    recommended : Candidate
        Certified, follows within 10 % of the best certified one, and of those needs the least moment.

    Raises
    ------
    TuningError
        When the log cannot be tuned from at all, or no candidate is certified.
    """
    doublet = doublet or Doublet()
    plant = measured_plant(experiment)
    candidates: list[Candidate] = []
    for inner in watch(list(product(BANDWIDTHS, DAMPINGS, DELAYS))):
        try:
            gains = tune(experiment, spec.model_copy(update={"inner": (inner, inner)}), plant)
        except TuningError as error:
            candidates.append(Candidate(inner, None, "refused", str(error)))
            continue
        verdict, reason = gains.verdict()
        fit = min(gains.provenance["fit"])
        candidates.append(Candidate(inner, gains, verdict, reason, fit, *predict(gains, plant, spec, doublet)))
    good = [candidate for candidate in candidates if candidate.verdict == CERTIFIED]
    if not good:
        raise TuningError(
            f"{experiment.source}: none of {len(candidates)} rate loops is certified; the first: "
            f"{candidates[0].verdict}: {candidates[0].reason}"
        )
    best = min(np.hypot(*candidate.follow_deg) for candidate in good)
    close = [candidate for candidate in good if np.hypot(*candidate.follow_deg) <= NEARLY_BEST * best]
    return candidates, min(close, key=lambda candidate: np.hypot(*candidate.effort))
