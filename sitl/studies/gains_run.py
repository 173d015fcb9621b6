"""One run of `mimopilot reproduce gains`: every gain set of one vehicle from one experiment, and its figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mimopilot.common.blas import reproducible
from mimopilot.sitl.flight.scenario import AXES, doublet
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.sitl.studies.attitude_run import experiment, fly_set, performance_or_lost
from mimopilot.sitl.studies.attitude_study import AUTOTUNE, DEFAULT, MIMO, MIMO_THESIS, SISO, SISO_THESIS, AttitudeStudy
from mimopilot.sitl.studies.autotune import autotune
from mimopilot.sitl.studies.linear_loop import LinearLoop
from mimopilot.sitl.studies.lqg import lqg_with_noise
from mimopilot.sitl.studies.true_plant import TruePlant, optimum_on_true_plant
from mimopilot.tuning.analysis.certify import certify
from mimopilot.tuning.design.cascade import tune
from mimopilot.tuning.design.flown_loop import flown_amplitude
from mimopilot.tuning.design.prediction import TAIL
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains import Gains, gains_to_toml
from mimopilot.tuning.gains_file import gains_from_toml
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.provenance import Provenance
from mimopilot.tuning.reference_model import SecondOrder, second_order
from mimopilot.tuning.spec import DesignLimits, TuningSpec

#: Lengths (s) and amplitudes (deg) of the doublets; the figures include `TAIL` seconds after them.
PERIODS, AMPLITUDES_DEG = (0.42, 0.8, 1.6), (5.0, 15.0, 22.5)
#: The attitude model that all sets are compared with: bandwidth (rad/s), damping.
SAME = SecondOrder(10.0, 0.7)
#: Designs with model following, and the LQG servo.
SISO_FOLLOWING, MIMO_FOLLOWING, LQG = "SISO, following", "MIMO, following", "LQG (linear)"
#: Best on the true plant: with the bandwidth that it finds, for the attitude model `SAME`, and with model following.
BEST, BEST_SAME, BEST_FOLLOWING = "optimum", f"optimum, {SAME.omega:g} rad/s", "optimum, following"
#: All gain sets, in the order of the tables.
SETS = (
    DEFAULT,
    AUTOTUNE,
    SISO_THESIS,
    MIMO_THESIS,
    SISO,
    MIMO,
    BEST,
    BEST_SAME,
    SISO_FOLLOWING,
    MIMO_FOLLOWING,
    BEST_FOLLOWING,
    LQG,
)


def optima(study: AttitudeStudy) -> dict[str, str]:
    """The best gains on the true plant, from the experiment with seed 0: set -> text of its gains file.

    Of the experiment only the size of the angles counts, which the motors must be able to fly.
    """
    airframe = load_airframe(study.airframe).airframe
    _, log = experiment(study, study.airframe, 0)
    assert log.flown is not None
    size, found = flown_amplitude(log), {}
    tasks: dict[str, dict[str, Any]] = {
        BEST: {},
        BEST_SAME: {"bandwidth": SAME.omega},
        BEST_FOLLOWING: {"follow_model": True},
    }
    for name, task in tasks.items():
        best = optimum_on_true_plant(airframe, log.flown, amplitude=size, **task)
        provenance = Provenance(name, outer_model=(best.model, best.model), details={"limited_by": best.active})
        found[name] = gains_to_toml(replace(best.gains, certificate=None, provenance=provenance))
    return found


def tuned_sets(study: AttitudeStudy, measured: PlantEstimates) -> tuple[dict[str, Gains], dict[str, str]]:
    """Gain sets from one log, each by its method, and the reason of each that is refused."""
    log = measured.experiment
    assert log.flown is not None
    flown = log.flown
    inner, outer = (SecondOrder(*model) for model in (study.inner, study.outer))
    siso_inner, siso_outer = (SecondOrder(*model) for model in study.siso_models)
    specs = {
        SISO_THESIS: TuningSpec(method="siso", inner=(siso_inner, siso_inner), outer=(siso_outer, siso_outer)),
        MIMO_THESIS: TuningSpec(inner=(inner, inner), outer=(outer, outer)),
        SISO: TuningSpec(method="siso"),
        MIMO: TuningSpec(),
        SISO_FOLLOWING: TuningSpec(method="siso", follow_model=True),
        MIMO_FOLLOWING: TuningSpec(follow_model=True),
    }
    ways: dict[str, Callable[[], Gains]] = {DEFAULT: lambda: flown, AUTOTUNE: lambda: autotune(log, flown)}
    ways |= {name: lambda spec=spec: tune(log, spec, measured) for name, spec in specs.items()}  # type: ignore[misc]
    found, refused = {}, {}
    for name, way in ways.items():
        try:
            found[name] = way()
        except TuningError as error:
            refused[name] = str(error)
    return found, refused


@dataclass(frozen=True, eq=False)
class LinearBench:
    """Exact figures of the sets of one vehicle.

    Attributes
    ----------
    truth : TruePlant
    flown : Gains
        Their noise is the unit.
    """

    truth: TruePlant
    flown: Gains

    def figures(self, loop: LinearLoop) -> dict[str, Any]:
        """Spectral radius, Ms, damping, noise over the flown, and by length of the doublet J_M and the cross axis.

        J_M and the mean square of the other axis are over doublet and tail, for an amplitude of 1 rad, mean of roll and
        pitch.
        """
        Ts = loop.plant.Ts
        model, radius = SAME.discretise(Ts), loop.spectral_radius
        stable = radius < 1
        return {
            "spectral_radius": radius,
            "Ms": loop.sensitivity_peak(self.truth.fine, self.truth.fine_response),
            "damping": loop.damping,
            "noise": float((loop.noise / self.truth.loop(self.flown).noise).max()),
            "J_M": [float(np.mean(loop.J_M(model, period, TAIL))) if stable else np.inf for period in PERIODS],
            "offaxis": [_offaxis(loop, period) if stable else np.inf for period in PERIODS],
            "torque": [_torque(loop, period) if stable else np.inf for period in PERIODS],
        }


def _offaxis(loop: LinearLoop, period: float) -> float:
    """Mean square of the other axis for a doublet of 1 rad, mean of roll and pitch."""
    return float(np.mean([loop.doublet(axis, period, TAIL)[1][:, 1 - axis] ** 2 for axis in range(2)]))


def _torque(loop: LinearLoop, period: float) -> float:
    """Largest torque (normalised) in a doublet of the largest of `AMPLITUDES_DEG`, as if there were no limits."""
    size = float(np.radians(max(AMPLITUDES_DEG)))
    return size * float(max(np.abs(loop.doublet(axis, period, TAIL)[2]).max() for axis in range(2)))


def flights(study: AttitudeStudy, gains: Gains, seed: int) -> list[dict[str, Any]]:
    """Figures of each doublet with noise: period, amplitude, and of each axis J_M,o and the other axis.

    ``J_M_o`` is against `SAME`, ``J_M_o_own`` against the set's own attitude model, if it has one.
    """
    rows = []
    for amplitude in AMPLITUDES_DEG:
        for period in PERIODS:
            row: dict[str, Any] = {"amplitude_deg": amplitude, "period_s": period}
            for axis, name in enumerate(AXES):
                task = doublet(name, float(np.radians(amplitude)), period, gains.Ts, TAIL, study.lead_s)
                flight = fly_set(
                    study.airframe, gains, replace(task, window=(task.window[0], len(task.setpoint))), seed
                )
                inner = second_order(*study.inner, gains.Ts)
                figures = performance_or_lost(flight, inner, SAME.discretise(gains.Ts))
                row[name] = {
                    "J_M_o": figures.J_M_o,
                    "offaxis_peak_deg": figures.offaxis_peak_deg,
                    "offaxis_rms_deg": figures.offaxis_rms_deg,
                }
                if gains.provenance.outer_model is not None:
                    own = gains.provenance.outer_model[axis].discretise(gains.Ts)
                    row[name]["J_M_o_own"] = performance_or_lost(flight, inner, own).J_M_o
            rows.append(row)
    return rows


@reproducible
def run_gains(task: tuple[AttitudeStudy, int], best: Mapping[str, str]) -> dict[str, Any]:
    """One run.

    Parameters
    ----------
    task : (AttitudeStudy, int)
        Vehicle, experiment and the thesis' models; the seed.
    best : mapping
        See `optima`.

    Returns
    -------
    dict
        Name of each set -> ``refused`` with the reason, or its ``model`` (own attitude model as text), ``verdict``,
        ``linear`` (see `LinearBench.figures`), ``flights`` (see `flights`; not of the LQG servo) and ``gains``.
    """
    study, seed = task
    airframe = load_airframe(study.airframe).airframe
    _, log = experiment(study, study.airframe, seed)
    assert log.flown is not None
    measured = PlantEstimates(log)
    sets, refused = tuned_sets(study, measured)
    sets |= {name: gains_from_toml(text, name) for name, text in best.items()}
    truth = TruePlant(airframe, log.Ts)
    bench = LinearBench(truth, log.flown)
    found: dict[str, Any] = {name: {"refused": reason} for name, reason in refused.items()}
    models = [second_order(*model, log.Ts) for model in (study.inner, study.outer)]
    for name, gains in sets.items():
        own = gains.provenance.outer_model
        certificate = certify(gains, measured.response, [models[0]] * 2, [models[1]] * 2)
        found[name] = {
            "model": None if own is None else own[0].discretise(gains.Ts).label,
            "verdict": str(certificate.verdict),
            "linear": bench.figures(truth.loop(gains)),
            "flights": flights(study, gains, seed),
            "gains": {matrix: value.tolist() for matrix, value in gains.matrices.items()},
        }
    allowed = DesignLimits().noise * truth.loop(log.flown).noise
    servo = LinearLoop(truth.model, lqg_with_noise(airframe, SAME.discretise(log.Ts), allowed))
    found[LQG] = {"model": SAME.discretise(log.Ts).label, "verdict": "", "linear": bench.figures(servo)}
    return {name: found[name] for name in SETS}
