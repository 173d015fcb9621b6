"""One run of an attitude study: a vehicle flies an experiment, is tuned from it, and flies doublets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import cache
from typing import Any

import numpy as np

from mimopilot.codegen.native import NativeController, NativeLibrary, load_native
from mimopilot.common.blas import reproducible
from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.flight.metrics import Performance, performance
from mimopilot.sitl.flight.scenario import AXES, Scenario, excitation_flight
from mimopilot.sitl.flight.simulator import Flight, fly
from mimopilot.sitl.physics.airframe import Airframe, AirframeFile, load_airframe
from mimopilot.sitl.studies.attitude_study import (
    AUTOTUNE,
    BEST,
    DEFAULT,
    MIMO,
    MIMO_PRINTED,
    MIMO_THESIS,
    PRINTED_KEYS,
    SISO,
    SISO_OWN,
    SISO_PRINTED,
    SISO_THESIS,
    AttitudeStudy,
)
from mimopilot.sitl.studies.autotune import autotune
from mimopilot.sitl.studies.true_plant import TruePlant, optimum_on_true_plant, true_response
from mimopilot.tuning.analysis.certify import certify
from mimopilot.tuning.analysis.manoeuvres import manoeuvres
from mimopilot.tuning.design.cascade import tune
from mimopilot.tuning.design.flown_loop import flown_amplitude
from mimopilot.tuning.design.prediction import Prediction, predict
from mimopilot.tuning.experiment import Experiment
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.motors import fit_motors
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.provenance import Provenance
from mimopilot.tuning.reference_model import ReferenceModel, SecondOrder
from mimopilot.tuning.spec import TuningSpec

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
        Method -> `Performance` of both flights against the thesis' models.
    designed : dict
        Method -> J_M,o (rad^2) of both flights against the attitude model of MIMO's design. Empty without a design.
    truth : dict
        Method -> exact figures on the true plant: ``true_Ms``, and ``noise``, the largest ratio over the axes of the
        torque's noise at hover to that of the flown gains.
    """

    experiment: Flight
    gains: dict[str, Gains]
    flights: dict[str, list[Flight]]
    figures: dict[str, list[Performance]]
    designed: dict[str, list[float]]
    truth: dict[str, dict[str, float]]


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
            SISO_THESIS: tune(siso_log, siso),
            SISO_PRINTED: printed_gains(study, SISO_PRINTED, PRINTED_KEYS[SISO_THESIS], default),
            MIMO_THESIS: tune(log, mimo, measured),
            MIMO_PRINTED: printed_gains(study, MIMO_PRINTED, PRINTED_KEYS[MIMO_THESIS], default),
        }
    own = {SISO_OWN: tune(log, siso)} if siso_log is not log else {}
    return {
        DEFAULT: default,
        AUTOTUNE: autotune(log, default),
        SISO_THESIS: tune(siso_log, siso),
        **own,
        MIMO_THESIS: tune(log, mimo, measured),
        SISO: tune(log, TuningSpec(method="siso"), measured),
        MIMO: tune(log, TuningSpec(), measured),
    }


def printed_gains(study: AttitudeStudy, method: str, key: str, default: Gains) -> Gains:
    """A gain set as the thesis prints it, in the frame (yaw, limits, filter) of the default gains."""
    matrices: Any = {name: np.array(values) for name, values in study.gains_table[1][key].items()}
    return replace(default, certificate=None, provenance=Provenance(f"{method}, {study.gains_table[0]}"), **matrices)


def logs(study: AttitudeStudy, seed: int) -> tuple[Flight, Experiment, Experiment]:
    """Fly the experiment; returns the flight, its log, and the log that SISO is tuned on."""
    flight, log = experiment(study, study.airframe, seed)
    other = log if study.siso_airframe == study.airframe else experiment(study, study.siso_airframe, seed)[1]
    return flight, log, other


def best_gains(log: Experiment, airframe: Airframe, mimo: Gains) -> Gains:
    """The best gains on the true plant for the attitude model of a design on the log: same cost, same constraints."""
    assert log.flown is not None
    model = design_model(mimo)
    found = optimum_on_true_plant(
        airframe, log.flown, amplitude=flown_amplitude(log), bandwidth=model.omega, starts=[mimo]
    )
    return replace(found.gains, provenance=Provenance(BEST, outer_model=(model, model)))


def design_model(gains: Gains) -> SecondOrder:
    """Attitude model that designed gains follow."""
    assert gains.provenance.outer_model is not None
    model = gains.provenance.outer_model[0]
    assert isinstance(model, SecondOrder)
    return model


def true_figures(airframe: Airframe, gains: Mapping[str, Gains]) -> dict[str, dict[str, float]]:
    """Exact figures of gain sets, one of which is `DEFAULT`, see `AttitudeRun.truth`."""
    Ts = gains[DEFAULT].Ts
    plant, truth = true_response(airframe, Ts), TruePlant(airframe, Ts)
    model = SecondOrder(10.0, 0.7).discretise(Ts)  # does not matter for the noise
    task = manoeuvres(plant, model, gains[DEFAULT].filters)
    flown = predict(gains[DEFAULT], plant, task)
    return {
        method: {
            "true_Ms": truth.sensitivity_peak(one),
            "noise": noise_ratio(predict(one, plant, task), flown),
        }
        for method, one in gains.items()
    }


def noise_ratio(ours: Prediction, flown: Prediction) -> float:
    """Largest ratio over the axes of the torque's noise at hover."""
    return float(max(a / b for a, b in zip(ours.noise, flown.noise, strict=True)))


@reproducible
def run(study: AttitudeStudy, seed: int) -> AttitudeRun:
    """Fly the experiment, tune, certify, and fly both doublets with every gain set."""
    flight, log, siso_log = logs(study, seed)
    measured = PlantEstimates(log)
    airframe = _vehicle_and_library(study.airframe)[0].airframe
    tuned = tune_all(study, measured, siso_log)
    if MIMO in tuned:
        tuned[BEST] = best_gains(log, airframe, tuned[MIMO])
    inner, outer = ([model] * 2 for model in study.models(MIMO, log.Ts))
    gains = {
        method: found.with_certificate(certify(found, measured.response, inner, outer))
        for method, found in tuned.items()
    }
    doublets = study.doublets(log.Ts)
    flights = {m: [fly_set(study.airframe, found, task, seed) for task in doublets] for m, found in gains.items()}
    figures = {
        method: [performance_or_lost(one, *study.models(method, log.Ts)) for one in both]
        for method, both in flights.items()
    }
    designed = {}
    if MIMO in gains:
        model = design_model(tuned[MIMO]).discretise(log.Ts)
        designed = {
            method: [performance_or_lost(one, study.models(method, log.Ts)[0], model).J_M_o for one in both]
            for method, both in flights.items()
        }
    return AttitudeRun(flight, gains, flights, figures, designed, true_figures(airframe, gains))


def performance_or_lost(flight: Flight, inner: ReferenceModel, outer: ReferenceModel) -> Performance:
    """Performance of a flight; all figures are infinite when the vehicle was lost."""
    return LOST if flight.crashed_at is not None else performance(flight, inner, outer)


def numbers(found: AttitudeRun) -> dict[str, Any]:
    """The part of a run that goes into the statistics: figures, verdicts and gains by method.

    The figures of an axis are those of `Performance`, and ``J_M_o_design`` of `AttitudeRun.designed` if there is one.
    """
    return {
        method: {
            "verdict": gains.verdict()[0],
            "Ms": gains.certificate.figures.get("Ms") if gains.certificate else None,
            **found.truth[method],
            "gains": {name: np.asarray(getattr(gains, name)).tolist() for name in ("Kp_o", "Kp_i", "Ki_i", "Kd_i")},
            **{
                axis: asdict(found.figures[method][column])
                | ({"J_M_o_design": found.designed[method][column]} if found.designed else {})
                for column, axis in enumerate(AXES)
            },
        }
        for method, gains in found.gains.items()
    }
