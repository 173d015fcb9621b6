"""Chapter 6 of the thesis on the bench: each vehicle flies its experiment, is tuned from it, and flies doublets."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields, replace
from functools import cache
from typing import Any

import numpy as np
from mimopilot.codegen.native import NativeController, NativeLibrary, load_native
from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.flight.metrics import Performance, performance
from mimopilot.sitl.flight.scenario import AXES, Scenario, doublet, excitation_flight
from mimopilot.sitl.flight.simulator import Flight, fly
from mimopilot.sitl.physics.airframe import Vehicle, load_airframe
from mimopilot.sitl.studies.autotune import autotune
from mimopilot.sitl.studies.benchmarks import TABLES
from mimopilot.sitl.studies.optimum import Task, best_gains, flown_effort
from mimopilot.tuning.analysis.certificate import certify
from mimopilot.tuning.analysis.doublet_prediction import doublet_effort, doublet_model
from mimopilot.tuning.analysis.stability_figures import GRID_STEP, sensitivity_peak
from mimopilot.tuning.certificate import DEFAULT_THRESHOLDS
from mimopilot.tuning.design.cascade import tune
from mimopilot.tuning.design.refine_for_manoeuvre import INTEGRAL_SHARE
from mimopilot.tuning.experiment import Experiment
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.motors import fit_motors
from mimopilot.tuning.plant.frequency_response import measured_plant
from mimopilot.tuning.plant.inertia import rigid_body
from mimopilot.tuning.plant.measured import Measured
from mimopilot.tuning.reference_model import ReferenceModel, SecondOrder, second_order
from mimopilot.tuning.spec import Manoeuvre, TuningSpec

DEFAULT, AUTOTUNE, SISO, SISO_OWN = "default", "autotune", "SISO", "SISO, perturbed log"
MIMO, REFINED, BEST, BOUND = "MIMO", "MIMO for the doublet", "best on the true plant", "the same with any effort"
#: Effort over SISO's that is asked of the refined gains, as predicted: the 10 % of the expectation less what a
#: prediction may miss.
EFFORT = 1.04
#: Seeds whose logs say what refined gains spend and how far a log leaves Ms open.
TYPICAL = (0, 1, 2)
#: Figures of a flight in which the vehicle was lost.
LOST = Performance(**dict.fromkeys((field.name for field in fields(Performance)), np.inf))  # type: ignore[arg-type]
#: Hover before a doublet; a mass at one motor takes longer to be trimmed out.
LEAD_S, TRIM_S = 1.0, 6.0

Model = tuple[float, float, int]


@dataclass(frozen=True)
class Study:
    """One vehicle and what is asked of it.

    Attributes
    ----------
    name, title : str
    airframe : str
    inner, outer : (rad/s, damping, delay in samples)
        Reference models of the rate and the attitude loop.
    siso_models : (inner, outer)
        Those that SISO was tuned for.
    siso_airframe : str
        Whose log SISO is tuned on.
    amplitude_deg, period_s : float
        Of the doublet.
    lead_s : float
        Hover before it.
    excitation : (s an axis, amplitude, rad/s)
        PRBS of the experiment.
    gains_table : (str, mapping)
        Name of the thesis' table of gains and what it prints.
    costs_table : (str, axis, mapping)
        The same for J.
    offaxis : float or None
        What MIMO's off-axis peak may be, over SISO's; None: nothing is coupled.
    """

    name: str
    title: str
    airframe: str
    inner: Model
    outer: Model
    siso_models: tuple[Model, Model]
    siso_airframe: str
    amplitude_deg: float
    period_s: float
    lead_s: float
    excitation: tuple[float, float, float]
    gains_table: tuple[str, dict[str, Any]]
    costs_table: tuple[str, str, dict[str, Any]]
    offaxis: float | None

    def models(self, method: str, Ts: float) -> tuple[ReferenceModel, ReferenceModel]:
        """Rate-loop and attitude-loop model that a method's flights are compared with: those it was tuned for."""
        inner, outer = self.siso_models if method in (SISO, SISO_OWN) else (self.inner, self.outer)
        return second_order(*inner, Ts), second_order(*outer, Ts)

    def doublets(self, Ts: float, **lengths: float) -> list[Scenario]:
        """Roll, pitch; `lengths` are those of `doublet`."""
        height = float(np.radians(self.amplitude_deg))
        return [doublet(axis, height, self.period_s, Ts, **({"lead": self.lead_s} | lengths)) for axis in AXES]

    def methods(self) -> list[str]:
        """Names of all gain sets, in the order of the tables."""
        own = [SISO_OWN] if self.siso_airframe != self.airframe else []
        return [DEFAULT, AUTOTUNE, SISO, *own, MIMO, REFINED, BEST, BOUND]


def studies() -> dict[str, Study]:
    """The studies by name, from the thesis' tables; the strongly coupled one is our own."""
    printed = json.loads(TABLES.read_text())

    def model(entry: dict[str, Any]) -> Model:
        return float(entry["omega"]), float(entry["zeta"]), int(entry["delay"])

    def made(
        name: str, title: str, airframe: str, key: str, gains: str, costs: str, offaxis: float | None, **changes: Any
    ) -> Study:
        part = printed[key]
        models = part.get("reference_models", {"MIMO": part, "SISO": part})
        inner, outer = (model(models["MIMO"][loop]) for loop in ("inner", "outer"))
        siso_inner, siso_outer = (model(models["SISO"][loop]) for loop in ("inner", "outer"))
        prbs = part.get("prbs", printed["adam0_simulation"]["prbs"])
        task = part["doublet"]
        number, _, axis = costs.partition(" ")
        entry = {
            "name": name,
            "title": title,
            "airframe": airframe,
            "inner": inner,
            "outer": outer,
            "siso_models": (siso_inner, siso_outer),
            "siso_airframe": airframe,
            "amplitude_deg": float(task["amplitude_deg"]),
            "period_s": task["period_s"],
            "lead_s": LEAD_S,
            "excitation": (float(prbs["seconds_per_axis"]), float(prbs["amplitude"]), float(prbs["bandwidth_rad_s"])),
            "gains_table": (f"Table {gains}", part[f"table_{gains.replace('.', '_')}"] if gains else {}),
            "costs_table": (
                f"Table {number}",
                axis,
                part[f"table_{number.replace('.', '_')}_{axis}"] if costs else {},
            ),
            "offaxis": offaxis,
        }
        return Study(**(entry | changes))

    simulation = made("adam0-sim", "ADAM-0, 10 % coupling", "adam0", "adam0_simulation", "5.4", "", 1 / 3)
    return {
        study.name: study
        for study in (
            simulation,
            made("adam0", "ADAM-0, nominal", "adam0_nominal", "adam0_flight_nominal", "6.2", "6.3 roll", None),
            made(
                "adam0-perturbed",
                "ADAM-0, 160 g at motor 3",
                "adam0_perturbed",
                "adam0_flight_perturbed",
                "6.4",
                "6.5 pitch",
                1 / 3,
                siso_airframe="adam0_nominal",
                lead_s=TRIM_S,
            ),
            # The thesis does not print the length of ANT-R's doublet.
            made("antr", "ANT-R", "antr", "antr_flight", "6.7", "6.8 roll", None, period_s=0.4),
            replace(
                simulation,
                name="adam0-small",
                title="ADAM-0, 10 % coupling, small doublet",
                amplitude_deg=8.0,  # far from the motors' limits, where the vehicle is linear
                gains_table=("", {}),
            ),
            replace(
                simulation,
                name="coupled",
                title="ADAM-0 with a boom, 40 % coupling",
                airframe="adam0_boom",
                siso_airframe="adam0_boom",
                amplitude_deg=15.0,  # at 22.5 its motors saturate
                gains_table=("", {}),
                offaxis=1 / 5,
            ),
        )
    }


@dataclass(frozen=True, eq=False)
class Run:
    """One experiment and what came of it.

    Attributes
    ----------
    experiment : Flight
    gains : dict
        Method -> set, certified from the experiment.
    flights : dict
        Method -> roll and pitch doublet.
    figures : dict
        Method -> `Performance` of both.
    """

    experiment: Flight
    gains: dict[str, Gains]
    flights: dict[str, list[Flight]]
    figures: dict[str, list[Performance]]


@cache
def _bench(airframe: str) -> tuple[Vehicle, Gains, NativeLibrary]:
    vehicle = load_airframe(airframe)
    default = vehicle.default_gains()
    return vehicle, default, load_native(default)


def fly_set(airframe: str, gains: Gains, scenario: Scenario, seed: int, noise: bool = True) -> Flight:
    """One flight of a vehicle under a gain set."""
    vehicle, _, library = _bench(airframe)
    autopilot = Autopilot(vehicle.airframe, gains, NativeController(library, gains))
    return fly(vehicle.airframe, autopilot, scenario, seed, noise)


def _safe(flight: Flight, airframe: str, scenario: Scenario) -> Flight:
    """A flight that must not be lost."""
    if flight.crashed_at is not None:
        raise SitlError(f"{airframe}: lost at {flight.crashed_at:.2f} s of the {scenario.name}", exit_code=1)
    return flight


def experiment(study: Study, airframe: str, seed: int, noise: bool = True) -> tuple[Flight, Experiment]:
    """The excitation flight of a study on a vehicle, and its signals as they are logged; with or without noise."""
    vehicle, default, _ = _bench(airframe)
    scenario = excitation_flight(*study.excitation, default.Ts, np.random.default_rng(seed))
    flight = _safe(fly_set(airframe, default, scenario, seed, noise), airframe, scenario)
    names = {"u": "moment", "y_i": "rates", "y_o": "attitude", "u_bar": "excitation", "r_o": "setpoint"}
    signals: Any = {name: flight.record[field][:, :2].astype(np.float64) for name, field in names.items()}
    motors = fit_motors(signals["u"], flight.record["commands"][:, : len(vehicle.airframe.rotors)].astype(np.float64))
    return flight, Experiment(Ts=default.Ts, source=f"{airframe}, seed {seed}", flown=default, motors=motors, **signals)


def tune_all(study: Study, measured: Measured, siso_log: Experiment) -> dict[str, Gains]:
    """Every data-driven method, each from one log."""
    log = measured.experiment
    default = _bench(study.airframe)[1]
    own, others = ((SecondOrder(*m) for m in models) for models in ((study.inner, study.outer), study.siso_models))
    (inner, outer), (siso_inner, siso_outer) = own, others
    siso = TuningSpec(method="siso", inner=(siso_inner, siso_inner), outer=(siso_outer, siso_outer))
    mimo = TuningSpec(inner=(inner, inner), outer=(outer, outer))
    found = {DEFAULT: default, AUTOTUNE: autotune(log, default), SISO: tune(siso_log, siso)}
    if siso_log is not log:
        found[SISO_OWN] = tune(log, siso)
    task = Manoeuvre(amplitude_deg=study.amplitude_deg, period_s=study.period_s)
    roll, pitch = doublet_effort(found[SISO], doublet_model(measured, task))
    task = task.model_copy(update={"effort": (EFFORT * roll, EFFORT * pitch)})
    found[MIMO] = tune(log, mimo, measured)
    found[REFINED] = tune(log, mimo.model_copy(update={"manoeuvre": task}), measured)
    return found


def logs(study: Study, seed: int) -> tuple[Flight, Experiment, Experiment]:
    """The study's excitation flight, its log, and the log that SISO is tuned on."""
    flight, log = experiment(study, study.airframe, seed)
    other = log if study.siso_airframe == study.airframe else experiment(study, study.siso_airframe, seed)[1]
    return flight, log, other


def optimum(study: Study) -> dict[str, Gains]:
    """The best gains on the true plant: with the effort of the refined ones and the certificate's margins, and with
    those margins and as much effort as it takes.
    """
    found, errors, bands = [], [], []
    for seed in TYPICAL:
        _, log, siso_log = logs(study, seed)
        measured = Measured(log)
        plant = measured.response
        found.append(tune_all(study, measured, siso_log))
        errors.append(sensitivity_peak(found[-1][REFINED], plant)[1])
        bands.append(plant.omega[plant.coherent_run()[[0, -1]]])
    # Without noise a vehicle in balance needs no hover, and what comes after the doublet does not count.
    doublets = study.doublets(log.Ts, tail=0.1, **({"lead": 0.1} if study.lead_s == LEAD_S else {}))
    spent = [
        [flown_effort(fly_set(study.airframe, gains[REFINED], task, 0, noise=False)) for task in doublets]
        for gains in found
    ]
    # The margins are those of the true plant, as a log without noise shows it, in the band of a log with noise and less
    # what that leaves open.
    plant = measured_plant(experiment(study, study.airframe, TYPICAL[0], noise=False)[1])
    body = rigid_body(plant)
    low, high = np.median(bands, axis=0)
    plant = plant.at((low <= plant.omega) & (plant.omega <= high)).interpolated(GRID_STEP)
    vehicle, _, library = _bench(study.airframe)
    task = Task(
        vehicle.airframe,
        library,
        doublets,
        study.models(BEST, log.Ts)[1],
        plant,
        body,
        DEFAULT_THRESHOLDS.thin_Ms - float(np.median(errors)),
        [float(rms) for rms in np.median(spent, axis=0)],
        INTEGRAL_SHARE * float(body.least(found[0][MIMO].Ki_i)),
    )
    best = best_gains(task, [found[0][AUTOTUNE], *(gains[REFINED] for gains in found)])
    return {BEST: best, BOUND: best_gains(replace(task, effort=None), [best])}


def run(study: Study, seed: int, best: dict[str, Gains]) -> Run:
    """Fly the experiment, tune, certify, and fly both doublets with every set."""
    flight, log, siso_log = logs(study, seed)
    measured = Measured(log)
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
    return Run(flight, gains, flights, figures)


def numbers(found: Run) -> dict[str, Any]:
    """What of a run goes into statistics: figures, verdicts and gains by method."""
    return {
        method: {
            "verdict": gains.verdict()[0],
            "Ms": gains.certificate.figures.get("Ms") if gains.certificate else None,
            "gains": {name: np.asarray(getattr(gains, name)).tolist() for name in ("Kp_o", "Kp_i", "Ki_i", "Kd_i")},
            **{axis: asdict(figures) for axis, figures in zip(AXES, found.figures[method], strict=True)},
        }
        for method, gains in found.gains.items()
    }
