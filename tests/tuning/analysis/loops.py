"""Airframes, flights, exact loops and gain sets for the tests of the certificate."""

import dataclasses
from functools import cache

import numpy as np

from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.tuning.law_filters import Filters
from mimopilot.tuning.plant.frequency_response import PlantResponse
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.reference_model import second_order
from tests.tuning.truth import TS, Truth, experiment

MODELS = ((second_order(20, 0.4, 0, TS),) * 2, (second_order(10, 0.7, 0, TS),) * 2)
RIGID = ("adam0", "adam0_boom", "adam0_nominal", "adam0_perturbed", "antr", "px4_sih")
#: Flights that measure the loop well: ANT-R hovers at 14 % of its thrust and is not linear for more torque; the rates
#: of PX4's airframe are noisy.
GOOD = {"antr": {"amplitude": 0.05}, "px4_sih": {"seconds": 40.0}}


def airframe(name, frame=None):
    body = load_airframe(name).airframe
    return body.model_copy(update={"frame": frame}) if frame else body


def defaults(name="adam0"):
    return load_airframe(name).default_gains()


@cache
def flown(name, frame=None):
    """Estimates from a flight with a good excitation."""
    return PlantEstimates(experiment(name, airframe=airframe(name, frame), **GOOD.get(name, {})))


@cache
def truth(name, frame=None):
    return Truth.of(airframe(name, frame))


def exact(plant, omega):
    """Response from an experiment without noise."""
    G, K = plant.frequency_response(omega), len(omega)
    nothing = np.zeros((K, 6, 6)), np.zeros((K, 2, 2))
    return PlantResponse(omega, G[:, :2], G[:, 2:], *nothing, np.ones((K, 2)), TS)


def scaled(gains, inner=1.0, outer=1.0):
    terms = {"Kp_o": outer, "Kp_i": inner, "Ki_i": inner, "Kd_i": inner, "Kff_i": inner}
    return dataclasses.replace(gains, **{name: getattr(gains, name) * factor for name, factor in terms.items()})


def random_set(base, rng):
    """A random gain set: slower and faster loops, with any coupling."""
    scale = {code: np.exp(rng.uniform(-1.2, 1.3)) for code in ("AP", "RP", "RI", "RD")}
    changes, elements = {}, base.elements()
    for code, value in elements.items():
        if code[:2] not in scale or code.endswith("Y"):
            continue
        diagonal = elements[code[:4] + code[3]]
        if code[3] == code[4]:
            changes[code] = float(value * scale[code[:2]] * np.exp(0.25 * rng.normal()))
        else:
            changes[code] = float(value + scale[code[:2]] * 0.25 * abs(diagonal) * rng.normal())
    return base.with_elements(changes)


def random_sets(name, count, seed):
    """Equally many unstable and well damped sets, by the exact loop."""
    rng, base, exactly = np.random.default_rng(seed), defaults(name), truth(name)
    unstable, damped = [], []
    while len(unstable) < count or len(damped) < count:
        gains = random_set(base, rng)
        if exactly.spectral_radius(gains) >= 1:
            if len(unstable) < count:
                unstable.append(gains)
        elif len(damped) < count:
            peak, phase = exactly.margins(gains, 400)
            if peak < 1.6 and phase >= 43:
                damped.append(gains)
    return unstable, damped


def integrating(omega, error=0.0, coherence=1.0, K=100.0):
    """Response of a pure inertia, with the same relative error of every element."""
    s = 1j * omega[:, None, None]
    G, root = K / s * np.eye(2), np.zeros((len(omega), 6, 6))
    root[:, 2, 2] = root[:, 3, 3] = error * K / omega
    reach = np.tile(np.eye(2), (len(omega), 1, 1))
    return PlantResponse(omega, G, G / s, root, reach, np.full((len(omega), 2), coherence), TS)


def plain(kp=0.15, outer=4.0, ki=0.0, kd=0.0):
    """P, or PID, equal on both axes."""
    one, zero = np.eye(2), np.zeros((2, 2))
    return dataclasses.replace(
        defaults(),
        **{"Kp_o": outer * one, "Kp_i": kp * one, "Ki_i": ki * one, "Kd_i": kd * one, "Kff_i": zero},
        filters=Filters(0.004, 30.0),
    )


def grid(end, start=1.0, step=1.02):
    """Frequencies denser than `GRID_STEP`, so that nothing is interpolated."""
    return start * step ** np.arange(np.floor(np.log(end / start) / np.log(step)) + 1)
