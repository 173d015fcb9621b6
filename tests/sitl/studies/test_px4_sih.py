"""Logs of PX4 in its own simulator: tuning from them, and the same gains in our simulation.

The files hold the experiment of one flight each: 16 s of injected torque per axis, at 250 Hz, a vehicle with and one
without coupling between roll and pitch. The plant is PX4's own.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.flight.scenario import doublet
from mimopilot.sitl.flight.simulator import fly
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.tuning.certificate import Verdict
from mimopilot.tuning.design.cascade import tune
from mimopilot.tuning.logs.reader import read_log
from mimopilot.tuning.reference_model import second_order
from mimopilot.tuning.spec import load_spec
from tests.paths import DATA

TS = 0.004
YAW = {"Kp_o": 2.8, "Kp_i": 0.2, "Ki_i": 0.1, "Kd_i": 0.0}
#: N m of one unit in PX4's allocation, 2 sqrt(2) b T_max.
SCALE = (2 * np.sqrt(2) * 0.18 * 8.0, 2 * np.sqrt(2) * 0.18 * 8.0, 0.2828)


def spec(**changes):
    return load_spec(yaw=YAW, moment_scale=SCALE, **changes)


@pytest.fixture(scope="module")
def logs():
    vehicle = load_airframe("px4_sih")
    in_px4 = vehicle.default_gains().with_moment_scale(SCALE)
    return {name: replace(read_log(DATA / f"px4_sih_{name}.mat"), flown=in_px4) for name in ("coupled", "symmetric")}


def test_the_off_diagonal_gains_match_the_inertia_on_the_coupled_vehicle_and_vanish_on_the_other(logs):
    J = np.array(load_airframe("px4_sih").airframe.inertia)[:2, :2]
    thesis = spec(inner=(20.0, 0.4, 0))
    coupled, symmetric = (tune(logs[name], thesis) for name in ("coupled", "symmetric"))
    ratios = coupled.Kp_i / np.diag(coupled.Kp_i)[:, None]
    assert ratios == pytest.approx(J / np.diag(J)[:, None], abs=0.02)
    assert np.abs(symmetric.Kp_i[[0, 1], [1, 0]]).max() < 0.02 * symmetric.Kp_i[0, 0]
    # The integral gain is poorly known: its relative interval is ten times that of P.
    for gains in (coupled, symmetric):
        wide = np.diag(gains.provenance.standard_deviation["Ki_i"]) / np.diag(gains.Ki_i)
        narrow = np.diag(gains.provenance.standard_deviation["Kp_i"]) / np.diag(gains.Kp_i)
        assert (wide > 10 * narrow).all()


def doublets(gains):
    """RMS to the outer reference model and off-axis standard deviation, deg, of 18 degree doublets in simulation.

    Off the axis counts the direction of the thrust in the heading of the setpoint, which the law controls. At 18
    degrees the motors saturate and the heading is up to 5 degrees off: by itself 1.5 degrees of the other Euler angle.
    """
    body = load_airframe("px4_sih").airframe
    outer = second_order(10, 0.7, 0, TS)
    follow, offaxis = [], []
    for column, axis in enumerate(("roll", "pitch")):
        task = doublet(axis, np.radians(18.0), 1.6, TS, tail=0.8)
        flight = fly(body, Autopilot(body, gains.with_moment_scale(body.moment_scale())), task, noise=False)
        rows = slice(task.window[0], task.window[0] + round(2.4 / TS))
        angles = flight.truth["attitude"][rows]
        away = angles[:, column] - outer.response(task.setpoint[:, column])[rows]
        follow.append(np.degrees(np.sqrt(np.mean(away**2))))
        down = Rotation.from_euler("ZYX", angles[:, ::-1]).apply([0.0, 0.0, 1.0])
        offaxis.append(np.degrees(np.std((-down[:, 1], down[:, 0])[1 - column])))
    return np.array(follow), np.array(offaxis)


def test_the_simulation_flies_the_flown_gains_as_px4_did(logs):
    follow, offaxis = doublets(logs["coupled"].flown)
    # PX4 flew 1.1 / 1.4 and 1.08 / 1.18 degrees (a law on Euler angles, so off the axis of these); its estimate drifts
    # by a degree, our true angle does not.
    assert follow == pytest.approx([1.1, 1.4], abs=0.3)
    assert offaxis == pytest.approx([1.08, 1.18], abs=0.15)


def test_tuned_gains_decouple_and_those_with_model_following_also_track_better_than_the_flown_ones(logs):
    """At 18 degrees the flown gains use the motors' whole range: without feed-forward nothing follows better there."""
    flown_follow, flown_offaxis = doublets(logs["coupled"].flown)
    for follow_model, ratio in ((False, 1.2), (True, 0.9)):
        best = tune(logs["coupled"], load_spec(follow_model=follow_model))
        assert best.verdict()[0] == Verdict.CERTIFIED
        follow, offaxis = doublets(best)
        assert (follow < ratio * flown_follow).all()
        assert (offaxis < 0.2 * flown_offaxis).all()
