import numpy as np
import pytest

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.flight.excitation_flight import ExperimentPlan
from mimopilot.sitl.flight.scenario import doublet, excitation_flight, limit_rate, load_scenario
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.tuning.design.cascade_estimate import estimate
from mimopilot.tuning.logs.reader import read_log
from mimopilot.tuning.logs.yaw import torque_to_acceleration
from mimopilot.tuning.reference_model import SecondOrder
from mimopilot.tuning.spec import TuningSpec
from tests.conftest import assert_one_clear_line

TS = 0.004


def test_a_rate_limited_doublet_ramps_at_that_rate():
    rate, height = np.radians(200.0), np.radians(20.0)
    task = limit_rate(doublet("pitch", height, 1.0, TS), rate)
    steps = np.diff(task.setpoint[:, 1])
    assert np.abs(steps).max() == pytest.approx(rate * TS)
    start = task.window[0]
    # 20 degrees at 200 deg/s: 25 samples; -20 degrees from +20: 50.
    assert task.setpoint[start + 23, 1] < height - 1e-9
    assert task.setpoint[start + 24, 1] == pytest.approx(height)
    assert task.setpoint[start + 125 + 49, 1] == pytest.approx(-height)
    assert task.setpoint[start + 125 + 48, 1] > -height + 1e-9
    assert not task.setpoint[:, [0, 2]].any()
    # A doublet that is too short for the rate does not reach its height.
    assert limit_rate(doublet("roll", height, 0.08, TS), rate).setpoint.max() == pytest.approx(10 * rate * TS)


def test_a_fast_limiter_changes_nothing_and_a_rate_of_zero_is_refused():
    task = doublet("roll", 0.3, 0.4, TS)
    assert (limit_rate(task, 1e4).setpoint == task.setpoint).all()
    with pytest.raises(SitlError, match="rate_limit_deg_s: got 0 deg/s, expected above 0"):
        limit_rate(task, 0.0)


def test_a_scenario_file_limits_the_rate(tmp_path, mimopilot):
    path = tmp_path / "mine.toml"
    path.write_text('manoeuvre = "doublet"\nrate_limit_deg_s = 220\n')
    assert np.abs(np.diff(load_scenario(path, TS).setpoint[:, 0])).max() == pytest.approx(np.radians(220.0) * TS)
    path.write_text('manoeuvre = "step"\nrate_limit_deg_s = -1\n')
    assert_one_clear_line(mimopilot("fly", "adam0", "--scenario", path), "mine.toml: rate_limit_deg_s: got -1 deg/s")


def test_both_axes_are_excited_at_once_and_independently():
    task = excitation_flight(20.0, 0.15, 50.0, TS, np.random.default_rng(0), together=True)
    assert task.excitation.shape == (5000, 3)
    roll, pitch = task.excitation[:, 0], task.excitation[:, 1]
    assert (np.abs(roll) == 0.15).all() and (np.abs(pitch) == 0.15).all()
    assert not task.excitation[:, 2].any()
    assert abs(np.corrcoef(roll, pitch)[0, 1]) < 0.1


def test_yaw_comes_last_and_leaves_the_pulses_of_roll_and_pitch_as_they_are():
    both, every = (
        excitation_flight(5.0, 0.15, 50.0, TS, np.random.default_rng(3), axes=axes, yaw_amplitude=0.3).excitation
        for axes in ("both", "all")
    )
    assert np.array_equal(every[:2500], both)
    assert set(np.abs(every[2500:, 2])) == {0.3} and not every[2500:, :2].any()
    lengths = np.diff(np.flatnonzero(np.diff(every[2500:, 2])))
    assert lengths.min() >= 2 * 16 and 4 * 16 < lengths.max() <= 2 * 64
    for axes, column in (("pitch", 1), ("yaw", 2)):
        alone = excitation_flight(5.0, 0.15, 50.0, TS, np.random.default_rng(3), axes=axes, yaw_amplitude=0.3)
        assert np.array_equal(alone.excitation[:, column], every[1250 * column : 1250 * (column + 1), column])
    together = excitation_flight(5.0, 0.15, 50.0, TS, np.random.default_rng(3), together=True, axes="all").excitation
    assert np.array_equal(together[:1250, 1], both[1250:, 1]) and len(together) == 2500


def test_the_experiment_holds_yaw_in_its_own_segment_and_roll_and_pitch_as_without_it(tmp_path):
    vehicle = load_airframe("adam0")
    logs = []
    for axes in ("both", "all"):
        plan = ExperimentPlan(vehicle.airframe, vehicle.default_gains(), 6.0, 0.15, 50.0, 1, axes=axes)
        flight = plan.record(tmp_path / f"{axes}.ulg", 0)
        logs.append(read_log(tmp_path / f"{axes}.ulg"))
    both, every = logs
    assert (both.segments, every.segments, every.yaw.segments) == (((0, 3000),), ((0, 3000),), ((3000, 4500),))
    assert every.all_segments == ((0, 4500),)
    for name in ("u", "y_i", "y_o", "u_bar"):
        assert np.array_equal(getattr(every, name)[:3000], getattr(both, name)[:3000])
    assert np.array_equal(every.yaw.u_bar[3000:], flight.record["excitation"][3000:, 2])
    assert np.abs(every.yaw.u_bar).max() == np.float32(0.2)  # a fifth of what saturates a motor of adam0
    assert every.amplitude == both.amplitude
    acceleration = torque_to_acceleration(every.yaw, every.yaw.u_bar, TS)[0]
    assert acceleration == pytest.approx(9.3, rel=0.25)  # true value; the motors' lag counts as a delay


def test_the_command_excites_both_axes_and_the_log_gives_the_gains_of_one_axis_after_the_other(mimopilot, tmp_path):
    log = tmp_path / "both.ulg"
    done = mimopilot("experiment", "adam0", "--both-axes", "--axis", "both", "--seconds-per-axis", "30", "--out", log)
    assert done.returncode == 0, done.stderr
    assert "30.0 s" in done.stdout
    vehicle = load_airframe("adam0")
    plan = ExperimentPlan(vehicle.airframe, vehicle.default_gains(), 20.0, 0.15, 50.0, None)
    plan.record(tmp_path / "turn.ulg", 0)
    model = SecondOrder(30.0, 0.7), SecondOrder(10.0, 0.7)
    spec = TuningSpec(inner=(model[0],) * 2, outer=(model[1],) * 2)
    both, turn = (estimate(read_log(path), spec).gains for path in (log, tmp_path / "turn.ulg"))
    assert np.diag(both.Kp_i) == pytest.approx(np.diag(turn.Kp_i), rel=0.03)
    assert np.diag(both.Ki_i) == pytest.approx(np.diag(turn.Ki_i), rel=0.15)
    assert_one_clear_line(
        mimopilot("experiment", "--connect", "udpin:127.0.0.1:1", "--both-axes"), "--both-axes", "simulated"
    )
