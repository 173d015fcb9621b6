"""A flight of the bench's stock PX4 whose autotune ran: its log is an experiment, and too slow with PX4's defaults."""

import numpy as np
import pytest

import mimopilot as mp
from mimopilot.sitl.autopilot.autotune_module import AutotuneModule
from mimopilot.sitl.autopilot.setpoints import Sticks
from mimopilot.sitl.autopilot.stock_autopilot import StockAutopilot
from mimopilot.sitl.flight.scenario import Scenario
from mimopilot.sitl.flight.simulator import fly
from mimopilot.sitl.flight.stock_log import stock_log
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.experiment import external_signal
from mimopilot.tuning.logs.reader import read_log
from mimopilot.tuning.plant.frequency_response import measured_plant
from mimopilot.tuning.plant.rigid_body_fit import rigid_body

TS, RUNS = 0.004, 2


@pytest.fixture(scope="module")
def vehicle():
    return load_airframe("adam0")


@pytest.fixture(scope="module")
def flown(vehicle):
    """The autopilot, and its flight in which the autotune ran twice."""
    autopilot = StockAutopilot(vehicle.airframe, vehicle.default_gains())
    values = {"MC_AT_START": 0.0, "MC_AT_SYSID_AMP": 1.5}
    module, added = AutotuneModule(values), []
    for _ in range(RUNS):
        values["MC_AT_START"] = 1.0
        while values["MC_AT_START"]:
            added.append(module.step(TS * (len(added) + 1), True, Sticks(0.0, 0.0, 0.0, 0.0)))
    excitation = np.array(added)
    still = np.zeros_like(excitation)
    return autopilot, fly(
        vehicle.airframe, autopilot, Scenario("autotune", TS, still, excitation, 0, (0, len(still))), 5
    )


def log_of(path, flown, vehicle, profile):
    autopilot, flight = flown
    parameters = autopilot.parameters | {"SDLOG_PROFILE": profile}
    path.write_bytes(stock_log(flight.record, np.zeros(len(flight.record), bool), TS, vehicle.airframe, parameters))
    return path


def test_the_flight_is_an_experiment_that_gives_the_coupled_plant_and_gains(flown, vehicle, tmp_path):
    assert flown[1].crashed_at is None
    experiment = read_log(log_of(tmp_path / "fast.ulg", flown, vehicle, 17))
    assert external_signal(experiment)[1] == "r_bar"
    assert experiment.Ts == TS
    assert experiment.yaw.r_bar.any()
    assert experiment.flown.Kp_i == pytest.approx(vehicle.default_gains().Kp_i)
    found = rigid_body(measured_plant(experiment)).B
    inertia = np.array(vehicle.airframe.plant().inertia)[:2, :2]
    true = np.linalg.inv(inertia) * np.array(vehicle.airframe.moment_scale()[:2])
    # In units of the diagonal; the coupling is 9 to 11 % of it.
    size = np.sqrt(np.outer(np.diag(true), np.diag(true)))
    assert found / size == pytest.approx(true / size, abs=0.03)
    gains = mp.tune(experiment, inner=(20.0, 0.7), outer=(10.0, 0.7))
    # The inverse of the plant is proportional to the inertia: both off-diagonals have its sign and size.
    ratio = gains.Kp_i / np.sqrt(np.outer(np.diag(gains.Kp_i), np.diag(gains.Kp_i)))
    expected = inertia[0, 1] / np.sqrt(inertia[0, 0] * inertia[1, 1])
    assert ratio[[0, 1], [1, 0]] == pytest.approx([expected, expected], abs=0.03)


def test_with_px4s_default_profile_the_log_is_too_slow(flown, vehicle, tmp_path):
    with pytest.raises(TuningError, match=r"logged at 50.0 Hz.*set SDLOG_PROFILE"):
        read_log(log_of(tmp_path / "slow.ulg", flown, vehicle, 1))
