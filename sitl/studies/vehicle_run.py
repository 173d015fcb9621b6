"""One run of `mimopilot reproduce vehicles`: a random vehicle flies an experiment, is tuned, and flies doublets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.codegen.native import NativeController, NativeLibrary, load_native
from mimopilot.common.blas import reproducible
from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.flight.excitation_flight import default_amplitude
from mimopilot.sitl.flight.scenario import AXES, Scenario, doublet, excitation_flight, hover
from mimopilot.sitl.flight.simulator import Flight, fly
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.sitl.studies.drawn_vehicle import DrawnVehicle, draw_vehicle
from mimopilot.sitl.studies.true_plant import GUST_SECONDS, TruePlant, optimum_on_true_plant, true_response
from mimopilot.tuning.analysis.manoeuvres import manoeuvres
from mimopilot.tuning.design.cascade import tune
from mimopilot.tuning.design.flown_loop import flown_amplitude
from mimopilot.tuning.design.prediction import TAIL, Prediction, predict, reasons_to_keep
from mimopilot.tuning.design.response_design import Design
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.experiment import Experiment
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.motors import fit_motors
from mimopilot.tuning.reference_model import ReferenceModel, SecondOrder
from mimopilot.tuning.spec import DesignLimits

#: Length of the whole experiment, s, half of it on each axis, as the study wants it; bandwidth of the excitation,
#: rad/s, the default of `mimopilot experiment`.
SECONDS, BANDWIDTH = (10.0, 40.0), 50.0
#: A user injects the proposed torque or down to this share of it. It is halved when the vehicle was lost or tilted by
#: more than so many radians (30 degrees) and so many times what it does in hover in these gusts; at most so often.
LEAST_SHARE, TILT, TILT_OF_HOVER, HALVINGS = 0.5, float(np.radians(30.0)), 1.5, 4
#: Doublets: length (s) and amplitude over that of the experiment. The four of the design, and a small one.
DOUBLETS = ((0.4, 1.0), (0.7, 1.0), (1.2, 1.0), (2.0, 1.0), (0.7, 0.25))
#: Hover before a doublet, s: the noise has settled.
LEAD = 1.0

Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class VehicleExperiment:
    """The experiment of a vehicle.

    Attributes
    ----------
    log : Experiment
    seconds : float, s
        On both axes together.
    amplitude : float
        Of the injected torque (normalised).
    tilt : float, rad
        Largest angle.
    """

    log: Experiment
    seconds: float
    amplitude: float
    tilt: float


@cache
def _library() -> NativeLibrary:
    return load_native(load_airframe("adam0").default_gains())


def fly_gains(vehicle: DrawnVehicle, gains: Gains, scenario: Scenario, seed: int) -> Flight:
    """One flight of a vehicle under a gain set."""
    autopilot = Autopilot(vehicle.airframe, gains, NativeController(_library(), gains))
    return fly(vehicle.airframe, autopilot, scenario, seed)


def gust_torque(samples: int, rms: float, Ts: float, generator: np.random.Generator) -> Signal:
    """Torque (normalised) of gusts on roll and pitch, (samples, 2), with the spectrum of `true_plant.gust_spectrum`."""
    from scipy.signal import lfilter

    pole = np.exp(-Ts / GUST_SECONDS)
    white = generator.standard_normal((samples, 2))
    gusts: Signal = rms * np.sqrt(1 - pole**2) * lfilter([1.0], [1.0, -pole], white, axis=0)
    return gusts


def fly_experiment(vehicle: DrawnVehicle, seed: int, generator: np.random.Generator) -> VehicleExperiment | None:
    """Fly the experiment as a user would; None when the vehicle is lost in the gusts, or at every amplitude.

    A gust is a torque that the log does not hold: it is injected with the excitation and taken out of the logged
    signals.
    """
    Ts, seconds = vehicle.gains.Ts, float(generator.uniform(*SECONDS))
    amplitude = default_amplitude(vehicle.airframe) * float(generator.uniform(LEAST_SHARE, 1.0))
    excitation_seed = int(generator.integers(2**31))
    still = hover(AXES[0], 2 * round(seconds / 2 / Ts) * Ts, Ts)
    gusts = gust_torque(len(still.excitation), vehicle.gusts, Ts, np.random.default_rng([excitation_seed, 1]))
    still.excitation[:, :2] = gusts
    hovering = _tilt(fly_gains(vehicle, vehicle.gains, still, seed))
    if not np.isfinite(hovering):
        return None
    allowed = max(TILT, TILT_OF_HOVER * hovering)
    for halvings in range(HALVINGS + 1):
        strength = amplitude / 2**halvings
        scenario = excitation_flight(seconds / 2, strength, BANDWIDTH, Ts, np.random.default_rng(excitation_seed))
        injected = scenario.excitation[:, :2].copy()
        scenario.excitation[:, :2] += gusts
        flight = fly_gains(vehicle, vehicle.gains, scenario, seed)
        if _tilt(flight) <= allowed:
            break
    tilt = _tilt(flight)
    if not np.isfinite(tilt):
        return None
    names = {"u": "moment", "y_i": "rates", "y_o": "attitude", "r_o": "setpoint"}
    signals: Any = {name: flight.record[field][:, :2].astype(np.float64) for name, field in names.items()}
    commands = flight.record["commands"][:, : len(vehicle.airframe.rotors)].astype(np.float64)
    motors = fit_motors(signals["u"], commands)
    signals["u"] = signals["u"] - gusts
    log = Experiment(Ts=Ts, u_bar=injected, source="experiment", flown=vehicle.gains, motors=motors, **signals)
    return VehicleExperiment(log, seconds, strength, tilt)


def _tilt(flight: Flight) -> float:
    """Largest angle of a flight, rad; infinite when the vehicle was lost."""
    return np.inf if flight.crashed_at is not None else float(np.abs(flight.truth["attitude"][:, :2]).max())


def doublet_figures(
    vehicle: DrawnVehicle, gains: Gains, model: ReferenceModel, amplitude: float, seed: int, gusts: float
) -> dict[str, float]:
    """Figures of the five doublets on both axes, of the true angles, in degrees for doublets of 10 degrees.

    Parameters
    ----------
    vehicle : DrawnVehicle
    gains : Gains
    model : ReferenceModel
        Of the attitude.
    amplitude : float, rad
    seed : int
        Of the noise and of the gusts.
    gusts : float
        RMS of their torque (normalised).

    Returns
    -------
    dict
        ``follow_deg``, ``offaxis_deg``: RMS over a doublet and `TAIL` of the error to the model and of the other axis,
        both relative to the doublet's amplitude; root of the mean square over all. Infinite when the vehicle was lost.
    """
    Ts, follow, offaxis = gains.Ts, [], []
    for number, (period, share) in enumerate(DOUBLETS):
        for column, axis in enumerate(AXES):
            size = amplitude * share
            scenario = doublet(axis, size, period, Ts, TAIL, LEAD)
            draws = np.random.default_rng([seed, number, column])
            scenario.excitation[:, :2] += gust_torque(len(scenario.excitation), gusts, Ts, draws)
            flight = fly_gains(vehicle, gains, scenario, seed)
            if flight.crashed_at is not None:
                return {"follow_deg": np.inf, "offaxis_deg": np.inf}
            angles = flight.truth["attitude"][:, :2]
            error = angles[:, column] - model.response(scenario.setpoint[:, column])
            judged = slice(scenario.window[0], None)
            follow.append(np.mean(error[judged] ** 2) / size**2)
            offaxis.append(np.mean(angles[judged, 1 - column] ** 2) / size**2)
    return {
        "follow_deg": float(10 * np.sqrt(np.mean(follow))),
        "offaxis_deg": float(10 * np.sqrt(np.mean(offaxis))),
    }


@reproducible
def run_vehicle(seed: int) -> dict[str, Any]:
    """One run.

    Returns
    -------
    dict
        JSON values. ``outcome``: ``certified``, ``keep`` (what was flown) or ``refused``, with the ``reasons``;
        ``tuned`` and ``flown``: true figures; ``optimum``: of the best gains on the true plant.
    """
    attempt = 0
    while True:
        generator = np.random.default_rng([seed, attempt])
        vehicle = draw_vehicle(generator)
        flown = fly_experiment(vehicle, 2 * seed, generator)
        if flown is not None:
            break
        attempt += 1
    truth, size = TruePlant(vehicle.airframe, vehicle.gains.Ts), flown_amplitude(flown.log)
    limits = DesignLimits()
    found: dict[str, Any] = {
        "seed": seed,
        "vehicle": vehicle.as_json(),
        "experiment": {
            "seconds": flown.seconds,
            "amplitude": flown.amplitude,
            "tilt_deg": float(np.degrees(flown.tilt)),
            "lost_before": attempt,
        },
        "tuned": None,
    }
    try:
        tuned = tune(flown.log)
    except TuningError as error:
        found |= {"outcome": "refused", "reasons": [str(error)]}
        starts: Sequence[Gains] = ()
    else:
        details = tuned.provenance.details
        keep = list(details["keep_flown"])
        found |= {"outcome": "keep" if keep else "certified", "reasons": keep}
        found["tuned"] = _tuned_figures(vehicle, truth, size, tuned, limits, 2 * seed + 1)
        starts = (tuned,)
    best = optimum_on_true_plant(vehicle.airframe, vehicle.gains, vehicle.gusts, size, starts=starts, limits=limits)
    found["optimum"] = _optimum_figures(vehicle, truth, best, limits)
    return found


def _predictions(vehicle: DrawnVehicle, model: ReferenceModel, gusts: float, *sets: Gains) -> list[Prediction]:
    """Exact figures on the true plant, see `Prediction`."""
    plant = true_response(vehicle.airframe, vehicle.gains.Ts, gusts)
    task = manoeuvres(plant, model, vehicle.gains.filters)
    return [predict(one, plant, task) for one in sets]


def _tuned_figures(
    vehicle: DrawnVehicle, truth: TruePlant, size: float, tuned: Gains, limits: DesignLimits, seed: int
) -> dict[str, Any]:
    """True figures of tuned gains beside those of the flown ones, with doublets of a size (rad)."""
    assert tuned.provenance.outer_model is not None
    assert tuned.certificate is not None
    wanted = tuned.provenance.outer_model[0]
    assert isinstance(wanted, SecondOrder)
    model = wanted.discretise(tuned.Ts)
    details = tuned.provenance.details
    both = (tuned, vehicle.gains)
    ours, before = _predictions(vehicle, model, vehicle.gusts, *both)
    calm = _predictions(vehicle, model, 0.0, *both)
    sets = {"tuned": tuned, "flown": vehicle.gains}
    return {
        "verdict": str(tuned.certificate.verdict),
        "certified_Ms": tuned.certificate.figures["Ms"],
        "certified_Ms_error": tuned.certificate.figures["Ms_error"],
        "band": list(tuned.certificate.band),
        "Ms": truth.sensitivity_peak(tuned),
        "spectral_radius": truth.spectral_radius(tuned),
        "noise_ratio": _noise_ratio(ours, before),
        "noise_ratio_calm": _noise_ratio(*calm),
        "bandwidth": wanted.omega,
        "amplitude_deg": float(np.degrees(size)),
        "limited_by": list(details["limited_by"]),
        "start": details["start"],
        "predicted": details["predicted"],
        "true_prediction": {
            name: {"follow_deg": list(one.follow_deg), "offaxis_deg": list(one.offaxis_deg)}
            for name, one in zip(sets, (ours, before), strict=True)
        },
        "true_reasons": reasons_to_keep([ours], [before], limits, slower=1.0),
        "flights": {name: doublet_figures(vehicle, one, model, size, seed, 0.0) for name, one in sets.items()},
        "flights_in_gusts": {
            name: doublet_figures(vehicle, one, model, size, seed, vehicle.gusts) for name, one in sets.items()
        },
        "gains": {name: getattr(tuned, name).tolist() for name in ("Kp_o", "Kp_i", "Ki_i", "Kd_i")},
    }


def _noise_ratio(ours: Prediction, before: Prediction) -> float:
    """Largest ratio over the axes of the torque's noise at hover."""
    return float(max(a / b for a, b in zip(ours.noise, before.noise, strict=True)))


def _optimum_figures(vehicle: DrawnVehicle, truth: TruePlant, best: Design, limits: DesignLimits) -> dict[str, Any]:
    """How the best gains on the true plant compare with the flown ones."""
    ours, before = _predictions(
        vehicle, best.model.discretise(vehicle.gains.Ts), vehicle.gusts, best.gains, vehicle.gains
    )
    reasons = reasons_to_keep([ours], [before], limits, slower=1.0) if best.feasible else ["no feasible gains"]
    return {
        "feasible": best.feasible,
        "bandwidth": best.model.omega,
        "cost": best.cost,
        "Ms": truth.sensitivity_peak(best.gains),
        "limited_by": best.active,
        "follow_ratio": float(np.linalg.norm(ours.follow_deg) / np.linalg.norm(before.follow_deg)),
        "offaxis_deg": [float(np.linalg.norm(one.offaxis_deg)) for one in (ours, before)],
        "reasons_to_keep": reasons,
    }
