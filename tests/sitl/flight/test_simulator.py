"""In-process flights: the loop, the log and its reader, performance figures."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyulog import ULog

from mimopilot.codegen.cortex_m4 import load_emulated
from mimopilot.sitl.autopilot.autopilot import RECORD, Autopilot
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.flight.flight_log import flight_log_bytes, quaternions, save_flight
from mimopilot.sitl.flight.metrics import performance
from mimopilot.sitl.flight.scenario import doublet, excitation_flight, hover, make_scenario, step
from mimopilot.sitl.flight.simulator import TRUTH, Flight, Simulator, fly
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.sitl.physics.state_estimate import euler_angles, quaternion_of
from mimopilot.tuning.controller import Controller
from mimopilot.tuning.logs.reader import read_log
from mimopilot.tuning.parameters import PARAMETERS
from mimopilot.tuning.reference_model import second_order

TS = 0.004


@pytest.fixture(scope="module")
def vehicle():
    return load_airframe("adam0")


def fresh(vehicle):
    return Autopilot(vehicle.airframe, vehicle.default_gains())


def short_experiment(vehicle, seed=3, seconds=4.0):
    scenario = excitation_flight(seconds, 0.15, 50.0, TS, np.random.default_rng(seed))
    return fly(vehicle.airframe, fresh(vehicle), scenario, seed)


def following(vehicle, omega=10.0, damping=0.8):
    """The default gains with model following, Kff_o and Kaff_i as by the airframe's inertia."""
    gains, inertia = vehicle.default_gains(), np.linalg.inv(vehicle.airframe.plant().inertia_inverse)[:2, :2]
    return replace(
        gains,
        filters=replace(gains.filters, model_omega=omega, model_damping=damping),
        Kff_o=np.eye(2),
        Kaff_i=inertia / np.array(vehicle.airframe.moment_scale()[:2])[:, None],
    )


def test_the_same_seed_gives_the_same_log_and_another_does_not(vehicle):
    gains = vehicle.default_gains()
    logs = [flight_log_bytes(short_experiment(vehicle, seed), vehicle.airframe, gains) for seed in (3, 3, 4)]
    assert logs[0] == logs[1] != logs[2]


def test_the_torques_in_flight_are_those_of_the_python_reference(vehicle):
    flight = short_experiment(vehicle)
    controller = Controller(vehicle.default_gains())
    saturation = np.zeros(3)
    for row in flight.record:
        wanted = quaternion_of(*row["setpoint"].astype(float))
        out = controller.step(np.float32(wanted), row["quaternion"], row["rates"], row["excitation"], saturation)
        assert (out.moment == row["moment"]).all()
        saturation = row["unallocated"]


def test_a_flight_with_model_following_is_that_of_the_python_reference(vehicle):
    gains, scenario = following(vehicle), doublet("roll", np.radians(15), 0.9, TS)
    flight = fly(vehicle.airframe, Autopilot(vehicle.airframe, gains), scenario, 3)
    controller, saturation = Controller(gains), np.zeros(3)
    for row in flight.record:
        wanted = quaternion_of(*row["setpoint"].astype(float))
        out = controller.step(np.float32(wanted), row["quaternion"], row["rates"], row["excitation"], saturation)
        assert (out.moment == row["moment"]).all()
        saturation = row["unallocated"]


def test_each_feedforward_halves_the_distance_to_the_model_and_decouples(vehicle):
    """A doublet of 15 degrees with 10 % inertia coupling: 4.9, 2.3 and 1.0 degrees RMS from the model.

    The largest pitch angle falls from 0.66 degrees, of the flown gains, to 0.34.
    """
    gains, scenario, zero = following(vehicle), doublet("roll", np.radians(15), 0.9, TS), np.zeros((2, 2))
    sets = (replace(gains, Kff_o=zero, Kaff_i=zero), replace(gains, Kaff_i=zero), gains)
    flights = [fly(vehicle.airframe, Autopilot(vehicle.airframe, one), scenario, 3, noise=False) for one in sets]
    model = gains.filters.followed.response(flights[0].record["setpoint"][:, 0].astype(float))
    errors = [np.degrees(np.sqrt(np.mean((one.record["attitude"][:, 0] - model) ** 2))) for one in flights]
    assert errors == pytest.approx([4.9, 2.3, 1.0], rel=0.1)
    coupled = fly(vehicle.airframe, fresh(vehicle), scenario, 3, noise=False).record["attitude"][:, 1]
    peaks = [np.degrees(np.abs(one).max()) for one in (flights[-1].record["attitude"][:, 1], coupled)]
    assert peaks == pytest.approx([0.34, 0.66], rel=0.05)


def test_a_minute_on_the_emulated_processor_equals_the_flight_of_the_native_library_in_every_bit(vehicle):
    scenario = excitation_flight(30.0, 0.15, 50.0, TS, np.random.default_rng(2))
    gains = vehicle.default_gains()
    native = fly(vehicle.airframe, fresh(vehicle), scenario, 5)
    emulated = fly(vehicle.airframe, Autopilot(vehicle.airframe, gains, load_emulated(gains)), scenario, 5)
    assert len(native.record) == 15_000
    assert np.abs(native.record["moment"]).max() > 0.1
    assert native.record.tobytes() == emulated.record.tobytes()
    assert native.truth.tobytes() == emulated.truth.tobytes()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_processor_that_stops_gives_no_stale_torque_and_the_vehicle_is_lost(vehicle):
    gains = vehicle.default_gains()
    processor = load_emulated(gains)
    processor.image.functions["step"] = 0x3000_0000  # no memory there
    flight = fly(vehicle.airframe, Autopilot(vehicle.airframe, gains, processor), hover("roll", 1.0, TS), 0)
    assert np.isnan(flight.record["moment"]).all()
    assert flight.crashed_at == 0.0


def test_the_noise_has_the_standard_deviation_of_the_airframe_and_can_be_switched_off(vehicle):
    scenario = hover("roll", 8.0, TS)
    noisy = fly(vehicle.airframe, fresh(vehicle), scenario, 1)
    for measured, true, sigma in (("attitude", "attitude", 0.003), ("rates", "rates", 0.01)):
        error = noisy.record[measured] - noisy.truth[true]
        assert error.std(axis=0) == pytest.approx(sigma, rel=0.06)
    exact = fly(vehicle.airframe, fresh(vehicle), scenario, 1, noise=False)
    assert exact.record["attitude"] == pytest.approx(exact.truth["attitude"], abs=1e-6)


def test_the_block_size_does_not_change_the_noise(vehicle):
    whole = Simulator(vehicle.airframe, TS, 7).noise(1000)
    parts = Simulator(vehicle.airframe, TS, 7)
    assert (np.vstack([parts.noise(n) for n in (1, 249, 500, 250)]) == whole).all()


def test_a_command_acts_one_period_after_its_measurement(vehicle):
    # A torque injected at sample k: motors may move in [k+1, k+2), the rate is seen to change at k+2.
    scenario = hover("roll", 0.4, TS)
    scenario.excitation[50:, 0] = 0.5
    flight = fly(vehicle.airframe, fresh(vehicle), scenario, noise=False)
    # The command is single precision, so hover is not exactly at rest.
    moved = np.flatnonzero(np.abs(flight.truth["rates"][:, 0]) > 1e-3)
    assert flight.record["moment"][50, 0] > 0.4
    assert moved[0] == 52


def test_the_altitude_is_held_during_the_experiment(vehicle):
    flight = short_experiment(vehicle)
    assert np.abs(flight.truth["position"][:, 2] + 10.0).max() < 0.5


def test_the_log_of_a_flight_reads_back_with_the_same_signals(vehicle, tmp_path):
    flight = short_experiment(vehicle)
    save_flight(tmp_path / "a.ulg", flight, vehicle.airframe, vehicle.default_gains())
    read = read_log(tmp_path / "a.ulg")
    # The experiment ends with its last injected sample; here the whole flight is excited.
    assert read.Ts == TS
    assert read.segments == ((0, len(flight.record)),)
    for name, field in (("u", "moment"), ("y_i", "rates"), ("r_i", "rates_setpoint"), ("u_bar", "excitation")):
        assert (getattr(read, name) == flight.record[field][:, :2]).all()
    assert read.y_o == pytest.approx(flight.record["attitude"][:, :2], abs=1e-6)
    assert read.flown is not None
    for code, value in vehicle.default_gains().elements().items():
        assert read.flown.elements()[code] == pytest.approx(value, rel=1e-6)
    assert read.flown.moment_scale == pytest.approx(vehicle.default_gains().moment_scale, rel=1e-6)


def test_pyulog_reads_the_log_as_a_px4_log(vehicle, tmp_path):
    flight = short_experiment(vehicle)
    save_flight(tmp_path / "a.ulg", flight, vehicle.airframe, vehicle.default_gains())
    log = ULog(str(tmp_path / "a.ulg"))
    assert not log.file_corruption
    assert log.msg_info_dict["sys_name"] == "mimopilot"
    torque = log.get_dataset("vehicle_torque_setpoint").data
    rates = log.get_dataset("vehicle_angular_velocity").data
    assert (torque["timestamp_sample"] == rates["timestamp_sample"]).all()
    assert (np.diff(torque["timestamp"]) == 4000).all()
    assert (torque["xyz[1]"] == flight.record["moment"][:, 1]).all()
    assert (log.get_dataset("debug_vect").data["x"] == flight.record["excitation"][:, 0]).all()
    for parameter in PARAMETERS:
        assert parameter.name in log.initial_parameters


@given(st.tuples(st.floats(-3, 3), st.floats(-1.5, 1.5), st.floats(-3, 3)))
@settings(deadline=None)
def test_quaternions_and_euler_angles_are_inverse_to_each_other(angles):
    q = quaternions(np.array([angles]))[0].astype(float)
    assert euler_angles(*q) == pytest.approx(angles, abs=2e-6)


def test_an_exact_measurement_is_the_state_in_single_precision(vehicle):
    simulator = Simulator(vehicle.airframe, TS, 0, noise=False, altitude=12.3456)
    out = simulator.measure(np.ones(6))
    assert out == pytest.approx([1, 0, 0, 0, 0, 0, 0, 12346, 0])


def synthetic_flight(response, rate):
    """A flight with given signals, to check the figures by hand."""
    scenario = doublet("roll", 0.2, 0.4, TS, tail=0.2)
    record, truth = np.zeros(len(scenario.setpoint), RECORD), np.zeros(len(scenario.setpoint), TRUTH)
    record["setpoint"] = scenario.setpoint
    record["attitude"][:, 0] = response(scenario.setpoint[:, 0])
    record["rates_setpoint"][:, 0] = 1.0
    record["rates"][:, 0] = rate
    record["moment"][:, :2] = [0.3, 0.4]
    truth["attitude"][:, 1] = np.radians(2.0)
    return Flight(scenario, record, truth)


def test_the_performance_figures_follow_their_definitions():
    inner, outer = second_order(20, 0.4, 0, TS), second_order(10, 0.7, 0, TS)
    flight = synthetic_flight(outer.response, 0.5)
    figures = performance(flight, inner, outer)
    assert figures.J_M_o == pytest.approx(0, abs=1e-12)
    window = slice(*flight.scenario.window)
    setpoint = flight.scenario.setpoint[window, 0]
    assert window.stop - window.start == 100
    assert figures.J_r_o == pytest.approx(
        np.mean((outer.response(flight.scenario.setpoint[:, 0])[window] - setpoint) ** 2), rel=1e-5
    )
    assert figures.J_r_i == pytest.approx(0.25)
    assert figures.J_M_i == pytest.approx(np.mean((0.5 - inner.response(np.ones(len(flight.record)))[window]) ** 2))
    assert figures.offaxis_peak_deg == pytest.approx(2.0)
    assert figures.offaxis_rms_deg == pytest.approx(2.0)
    assert figures.effort_rms == pytest.approx(0.5)


def test_a_vehicle_is_lost_after_the_time_beyond_the_largest_tilt(vehicle):
    unstable = vehicle.default_gains().with_elements({"RP_RP": 1.0, "RP_PR": 1.0})
    flight = fly(vehicle.airframe, Autopilot(vehicle.airframe, unstable), hover("roll", 6.0, TS), 1)
    assert flight.crashed_at is not None
    tilt = np.abs(flight.truth["attitude"][:, 0])
    first = np.flatnonzero(tilt > np.radians(60))[0] * TS
    assert flight.crashed_at >= first + 0.28


def test_touching_the_ground_is_a_loss(vehicle):
    low = Autopilot(vehicle.airframe, vehicle.default_gains(), altitude=0.02)
    flight = fly(vehicle.airframe, low, step("roll", np.radians(59.0), 6.0, TS), 1)
    assert flight.crashed_at is not None
    first = np.flatnonzero(flight.truth["position"][:, 2] > 0)[0]
    assert flight.crashed_at == pytest.approx(first * TS)


def test_a_steady_flight_is_not_a_loss(vehicle):
    assert fly(vehicle.airframe, fresh(vehicle), hover("roll", 2.0, TS), 1).crashed_at is None


def test_a_doublet_is_up_then_down_then_level():
    scenario = doublet("pitch", 0.4, 0.42, TS)
    start, stop = scenario.window
    assert stop - start == 104
    assert (scenario.setpoint[start : start + 52, 1] == 0.4).all()
    assert (scenario.setpoint[start + 52 : stop, 1] == -0.4).all()
    assert (scenario.setpoint[stop:] == 0).all()
    assert (scenario.setpoint[:, [0, 2]] == 0).all()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: make_scenario("loop", "roll", 10, 1, TS), "scenario: got 'loop'"),
        (lambda: make_scenario("doublet", "yaw", 10, 1, TS), "axis: got 'yaw'"),
        (lambda: step("roll", -1, 1, TS), "amplitude: got -57.2958 degrees"),
        (lambda: step("roll", 0.1, float("nan"), TS), "period: got nan"),
        (lambda: excitation_flight(20, 1.5, 50, TS, np.random.default_rng(0)), "amplitude: got 1.5"),
    ],
)
def test_an_impossible_scenario_is_refused(call, message):
    with pytest.raises(SitlError, match=message):
        call()
