"""Campaigns of the tests: a variation, plans and draws."""

import tomllib
from dataclasses import replace

from mimopilot.common.toml import checked, parse_toml
from mimopilot.sitl.campaign.draws import RunSampler
from mimopilot.sitl.campaign.flights import CHUNK
from mimopilot.sitl.campaign.plan import make_plan
from mimopilot.sitl.campaign.variation import Variation
from mimopilot.sitl.flight.scenario import doublet

RUNS = 16 * CHUNK  # enough to interrupt the campaign while it flies
VARY = """
mass = { normal = [1.0, 0.05], relative = true }
delay = { uniform = [0.5, 3.5] }
[inertia]
xx = { uniform = [0.9, 1.3], relative = true }
[motors]
effectiveness = { uniform = [0.8, 1.0] }
time_constant = { loguniform = [0.03, 0.08] }
[noise]
rate = { uniform = [0.5, 2.0], relative = true }
[attitude_deg]
roll = { normal = [0.0, 5.0] }
[rates_deg_s]
pitch = { normal = [0.0, 20.0] }
[wind]
north = { normal = [1.0, 2.0] }
"""


def plan_of(vehicle, gains=None, vary=VARY, **entries):
    given = {"runs": 2 * CHUNK + 5, "seed": 3, "manoeuvre": "doublet", "axes": ["roll", "pitch"]}
    given |= {"amplitude_deg": 22.5, "period_s": 0.42, "tail_s": 1.5, "vary": tomllib.loads(vary)}
    return make_plan(vehicle, gains or {"default": vehicle.default_gains()}, **(given | entries))


def unstable(gains):
    return replace(gains, Kp_i=gains.Kp_i + 5 * gains.Kp_i[::-1], certificate=None)  # couples the axes


def variation(text):
    return checked(Variation, parse_toml(text, "spec.toml"), "spec.toml")


def drawn(vehicle, vary, runs=2000):
    sampler = RunSampler(vehicle.airframe, variation(vary), doublet("roll", 0.4, 0.42, 0.004))
    return [sampler.draw(5, run) for run in range(runs)]
