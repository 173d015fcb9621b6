"""One run of an attitude study: a vehicle flies an experiment, is tuned from it, and flies doublets."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from functools import cache
from typing import Any

import numpy as np

from mimopilot.codegen.native import NativeController, NativeLibrary, load_native
from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.flight.metrics import Performance, performance
from mimopilot.sitl.flight.scenario import AXES, Scenario, excitation_flight
from mimopilot.sitl.flight.simulator import Flight, fly
from mimopilot.sitl.physics.airframe import AirframeFile, load_airframe
from mimopilot.sitl.studies.attitude_study import (
    AUTOTUNE,
    BEST,
    BOUND,
    DEFAULT,
    LEAD_S,
    MIMO,
    MIMO_PRINTED,
    REFINED,
    SISO,
    SISO_OWN,
    SISO_PRINTED,
    AttitudeStudy,
)
from mimopilot.sitl.studies.autotune import autotune
from mimopilot.sitl.studies.optimum import OptimumTask, best_gains, flown_effort
from mimopilot.tuning.analysis.certify import certify
from mimopilot.tuning.analysis.doublet_prediction import doublet_effort, doublet_model
from mimopilot.tuning.analysis.stability_figures import GRID_STEP, sensitivity_peak
from mimopilot.tuning.certificate import DEFAULT_THRESHOLDS
from mimopilot.tuning.design.cascade import tune
from mimopilot.tuning.design.constrained_least_squares import INFEASIBLE
from mimopilot.tuning.design.refine_for_manoeuvre import INTEGRAL_SHARE
from mimopilot.tuning.experiment import Experiment
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.motors import fit_motors
from mimopilot.tuning.plant.frequency_response import measured_plant
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.plant.rigid_body_fit import rigid_body
from mimopilot.tuning.provenance import Provenance
from mimopilot.tuning.reference_model import SecondOrder
from mimopilot.tuning.spec import Manoeuvre, TuningSpec

#: Predicted effort of the refined gains over SISO's. The expectation allows 1.10; the rest is for prediction error.
EFFORT_RATIO = 1.04
#: Seeds whose logs give the typical effort of the refined gains and the typical error of Ms.
TYPICAL = (0, 1, 2)
#: Figures of a lost flight.
LOST = Performance(**dict.fromkeys((field.name for field in fields(Performance)), np.inf))  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class AttitudeRun:
    """One experiment, the gains tuned from it, and their flights.

    Attributes
    ----------
    experiment : Flight
    gains : dict
        Method -> gains with the certificate from the experiment.
    flights : dict
        Method -> flights of the roll and the pitch doublet.
    figures : dict
        Method -> `Performance` of both flights.
    """

    experiment: Flight
    gains: dict[str, Gains]
    flights: dict[str, list[Flight]]
    figures: dict[str, list[Performance]]


@cache
def _vehicle_and_library(airframe: str) -> tuple[AirframeFile, Gains, NativeLibrary]:
    vehicle = load_airframe(airframe)
    default = vehicle.default_gains()
    return vehicle, default, load_native(default)


def fly_set(airframe: str, gains: Gains, scenario: Scenario, seed: int, noise: bool = True) -> Flight:
    """One flight of a vehicle under a gain set."""
    vehicle, _, library = _vehicle_and_library(airframe)
    autopilot = Autopilot(vehicle.airframe, gains, NativeController(library, gains))
    return fly(vehicle.airframe, autopilot, scenario, seed, noise)


def _require_survival(flight: Flight, airframe: str, scenario: Scenario) -> Flight:
    """Return the flight; raises when the vehicle was lost."""
    if flight.crashed_at is not None:
        raise SitlError(
            f"{airframe}: the vehicle was lost at {flight.crashed_at:.2f} s of the {scenario.name}", exit_code=1
        )
    return flight


def experiment(study: AttitudeStudy, airframe: str, seed: int, noise: bool = True) -> tuple[Flight, Experiment]:
    """Fly the excitation of a study on a vehicle; returns the flight and its logged signals."""
    vehicle, default, _ = _vehicle_and_library(airframe)
    scenario = excitation_flight(*study.excitation, default.Ts, np.random.default_rng(seed))
    flight = _require_survival(fly_set(airframe, default, scenario, seed, noise), airframe, scenario)
    names = {"u": "moment", "y_i": "rates", "y_o": "attitude", "u_bar": "excitation", "r_o": "setpoint"}
    signals: Any = {name: flight.record[field][:, :2].astype(np.float64) for name, field in names.items()}
    motors = fit_motors(signals["u"], flight.record["commands"][:, : len(vehicle.airframe.rotors)].astype(np.float64))
    return flight, Experiment(Ts=default.Ts, source=f"{airframe}, seed {seed}", flown=default, motors=motors, **signals)


def tune_all(study: AttitudeStudy, measured: PlantEstimates, siso_log: Experiment) -> dict[str, Gains]:
    """Tune by every data-driven method, each from one log."""
    log = measured.experiment
    default = _vehicle_and_library(study.airframe)[1]
    inner, outer = (SecondOrder(*model) for model in (study.inner, study.outer))
    siso_inner, siso_outer = (SecondOrder(*model) for model in study.siso_models)
    siso = TuningSpec(method="siso", inner=(siso_inner, siso_inner), outer=(siso_outer, siso_outer), **study.options)
    mimo = TuningSpec(inner=(inner, inner), outer=(outer, outer), **study.options)
    if study.fitted:
        return {
            DEFAULT: default,
            SISO: tune(siso_log, siso),
            SISO_PRINTED: printed_gains(study, SISO, default),
            MIMO: tune(log, mimo, measured),
            MIMO_PRINTED: printed_gains(study, MIMO, default),
        }
    found = {DEFAULT: default, AUTOTUNE: autotune(log, default), SISO: tune(siso_log, siso)}
    if siso_log is not log:
        found[SISO_OWN] = tune(log, siso)
    task = Manoeuvre(amplitude_deg=study.amplitude_deg, period_s=study.period_s)
    roll, pitch = doublet_effort(found[SISO], doublet_model(measured, task))
    task = task.model_copy(update={"effort": (EFFORT_RATIO * roll, EFFORT_RATIO * pitch)})
    found[MIMO] = tune(log, mimo, measured)
    found[REFINED] = tune(log, mimo.model_copy(update={"manoeuvre": task}), measured)
    return found


def printed_gains(study: AttitudeStudy, method: str, default: Gains) -> Gains:
    """A gain set as the thesis prints it, in the frame (yaw, limits, filter) of the default gains."""
    matrices: Any = {name: np.array(values) for name, values in study.gains_table[1][method].items()}
    return replace(default, certificate=None, provenance=Provenance(f"{method}, {study.gains_table[0]}"), **matrices)


def logs(study: AttitudeStudy, seed: int) -> tuple[Flight, Experiment, Experiment]:
    """Fly the experiment; returns the flight, its log, and the log that SISO is tuned on."""
    flight, log = experiment(study, study.airframe, seed)
    other = log if study.siso_airframe == study.airframe else experiment(study, study.siso_airframe, seed)[1]
    return flight, log, other


def _short_doublets(study: AttitudeStudy, gains: Gains) -> list[Scenario]:
    """The doublets without noise: the flight after them does not count, and a balanced vehicle needs no hover before.

    An unbalanced one gets its trim as injected torque: the integrators would need seconds of hover to find it.
    """
    short = study.doublets(gains.Ts, tail=0.1, lead=0.1)
    if study.lead_s == LEAD_S:
        return short
    long = study.doublets(gains.Ts)[0]
    trim = fly_set(study.airframe, gains, long, 0, noise=False).record["moment"][long.window[0] - 1]
    return [replace(task, excitation=np.tile(trim.astype(np.float64), (len(task.setpoint), 1))) for task in short]


def optimum(study: AttitudeStudy, thorough: bool = True) -> dict[str, Gains]:
    """The best gains on the true plant, within the certificate's margins.

    Parameters
    ----------
    study : AttitudeStudy
    thorough : bool
        Descend from every start, else only until a descent ends within the constraints: half of the time, and J is up
        to 7 % larger.

    Returns
    -------
    dict
        BEST: with the effort of the refined gains. BOUND: with any effort.
    """
    found, errors, bands = [], [], []
    for seed in TYPICAL:
        _, log, siso_log = logs(study, seed)
        measured = PlantEstimates(log)
        plant = measured.response
        found.append(tune_all(study, measured, siso_log))
        errors.append(sensitivity_peak(found[-1][REFINED], plant)[1])
        bands.append(plant.omega[plant.coherent_run()[[0, -1]]])
    doublets = _short_doublets(study, found[0][REFINED])
    spent = [
        [flown_effort(fly_set(study.airframe, gains[REFINED], task, 0, noise=False)) for task in doublets]
        for gains in found
    ]
    # Margins of the true plant: its response from a log without noise, in the band of a log with noise; the limit on Ms
    # is reduced by the error of Ms from a log with noise.
    plant = measured_plant(experiment(study, study.airframe, TYPICAL[0], noise=False)[1])
    body = rigid_body(plant)
    low, high = np.median(bands, axis=0)
    plant = plant.at((low <= plant.omega) & (plant.omega <= high)).interpolated(GRID_STEP)
    vehicle, _, library = _vehicle_and_library(study.airframe)
    task = OptimumTask(
        airframe=vehicle.airframe,
        library=library,
        doublets=doublets,
        outer=study.models(BEST, log.Ts)[1],
        plant=plant,
        body=body,
        peak=DEFAULT_THRESHOLDS.thin_Ms - float(np.median(errors)),
        effort=[float(rms) for rms in np.median(spent, axis=0)],
        integral=INTEGRAL_SHARE * float(body.least(found[0][MIMO].Ki_i)),
    )
    starts = [*(gains[REFINED] for gains in found), found[0][AUTOTUNE]]
    best = best_gains(task, starts) if thorough else _first_feasible(task, starts)
    return {BEST: best, BOUND: best_gains(replace(task, effort=None), [best])}


def _first_feasible(task: OptimumTask, starts: list[Gains]) -> Gains:
    """The optimum from the first start whose descent ends within the constraints, else the one nearest to them."""
    ends: list[tuple[float, Gains]] = []
    for start in starts:
        found = best_gains(task, [start])
        left = min(task.examine(found)[1])
        if left > -INFEASIBLE:
            return found
        ends.append((left, found))
    return max(ends, key=lambda end: end[0])[1]


def run(study: AttitudeStudy, seed: int, best: dict[str, Gains]) -> AttitudeRun:
    """Fly the experiment, tune, certify, and fly both doublets with every gain set."""
    flight, log, siso_log = logs(study, seed)
    measured = PlantEstimates(log)
    inner, outer = ([model] * 2 for model in study.models(MIMO, log.Ts))
    gains = {
        method: found.with_certificate(certify(found, measured.response, inner, outer))
        for method, found in (tune_all(study, measured, siso_log) | best).items()
    }
    doublets = study.doublets(log.Ts)
    flights = {m: [fly_set(study.airframe, found, task, seed) for task in doublets] for m, found in gains.items()}
    figures = {
        method: [
            LOST if one.crashed_at is not None else performance(one, *study.models(method, log.Ts)) for one in both
        ]
        for method, both in flights.items()
    }
    return AttitudeRun(flight, gains, flights, figures)


def numbers(found: AttitudeRun) -> dict[str, Any]:
    """The part of a run that goes into the statistics: figures, verdicts and gains by method."""
    return {
        method: {
            "verdict": gains.verdict()[0],
            "Ms": gains.certificate.figures.get("Ms") if gains.certificate else None,
            "gains": {name: np.asarray(getattr(gains, name)).tolist() for name in ("Kp_o", "Kp_i", "Ki_i", "Kd_i")},
            **{axis: asdict(figures) for axis, figures in zip(AXES, found.figures[method], strict=True)},
        }
        for method, gains in found.gains.items()
    }
