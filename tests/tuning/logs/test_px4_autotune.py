"""A stock PX4 that tunes itself is an experiment: its excitation is found, checked and tuned from."""

import numpy as np
import pytest

from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.flight.scenario import Scenario
from mimopilot.sitl.flight.simulator import fly
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.experiment import external_signal
from mimopilot.tuning.logs.reader import read_log
from mimopilot.tuning.plant.frequency_response import measured_plant
from mimopilot.tuning.plant.rigid_body_fit import rigid_body
from tests.tuning.logs.flights import Flight, px4_topics, three, write_ulog

TS, HOLD = 0.004, 25  # the topic is published every 0.1 s
RUNS, SECONDS = 4, 6.0


def excitation(generator):
    """Rate setpoint (N, 2), rad/s: roll then pitch in each run, a high-passed square signal held for 0.1 s."""
    blocks = round(SECONDS / TS / HOLD)
    axis = np.repeat(np.tile([0, 1], RUNS), blocks)
    signs = generator.choice([-1.0, 1.0], len(axis)).repeat(2)[: len(axis)]
    filtered, high = np.zeros(len(axis)), 0.0
    for k in range(1, len(axis)):
        high = 2 / 3 * (high + signs[k] - signs[k - 1])  # 0.2 s at 0.1 s
        filtered[k] = high
    rate = np.zeros((len(axis), 2))
    rate[np.arange(len(axis)), axis] = filtered
    return rate.repeat(HOLD, axis=0)


@pytest.fixture(scope="module")
def flown():
    """A flight of adam0_boom; the excitation reaches the rate setpoint through the attitude setpoint over its gain."""
    vehicle = load_airframe("adam0_boom")
    gains = vehicle.default_gains()
    r_bar = excitation(np.random.default_rng(3))
    setpoint = np.zeros((len(r_bar), 3))
    setpoint[:, :2] = r_bar @ np.linalg.inv(gains.Kp_o).T
    scenario = Scenario("autotune", TS, setpoint, np.zeros_like(setpoint), 0, (0, len(setpoint)))
    return r_bar, fly(vehicle.airframe, Autopilot(vehicle.airframe, gains), scenario, 5).record, gains


def stock_log(path, flown, factor=1.0):
    """The log that a stock PX4 writes of it: level attitude setpoint, the autotune's topic every 0.1 s."""
    r_bar, record, gains = flown
    t = 10.0 + np.arange(len(record)) * TS
    u, y_i, y_o = (record[name][:, :2].astype(float) for name in ("moment", "rates", "attitude"))
    still = np.zeros_like(u)
    flight = Flight(t, u, y_i, y_o, still, still)
    stamps = np.round(1e6 * (t + 0.0004)).astype(np.uint64)
    rates = record["rates_setpoint"].astype(np.float32)
    topics = {
        "vehicle_rates_setpoint": {"timestamp": stamps, "roll": rates[:, 0].copy(), "pitch": rates[:, 1].copy()},
        "autotune_attitude_control_status": {
            "timestamp": stamps[::HOLD],
            "rate_sp": three(factor * r_bar)[::HOLD].copy(),
        },
    }
    stock = {
        f"MC_{axis}{name}": value
        for i, axis in enumerate(("ROLL", "PITCH"))
        for name, value in (
            ("_P", gains.Kp_o[i, i]),
            ("RATE_P", gains.Kp_i[i, i]),
            ("RATE_I", gains.Ki_i[i, i]),
            ("RATE_D", gains.Kd_i[i, i]),
        )
    }
    return write_ulog(path, px4_topics(flight, **topics), stock)


def test_the_injected_rate_is_the_external_signal_and_gives_the_coupled_plant(flown, tmp_path):
    experiment = read_log(stock_log(tmp_path / "stock.ulg", flown))
    signal, name = external_signal(experiment)
    assert name == "r_bar"
    # The excitation as flown, from its first move to 2 s after the last.
    first = np.flatnonzero(flown[0].any(axis=1))[0]
    np.testing.assert_allclose(signal, flown[0][first : first + len(signal)], atol=1e-6)
    assert len(signal) > 0.99 * len(flown[0])
    found = rigid_body(measured_plant(experiment)).B
    airframe = load_airframe("adam0_boom").airframe
    inertia = np.array(airframe.plant().inertia)[:2, :2]
    true = np.linalg.inv(inertia) * np.array(airframe.moment_scale()[:2])
    # The gyroscopic effect of yaw is left out of the inverse; the coupling is 30 % of the diagonal.
    assert found / found[0, 0] == pytest.approx(true / true[0, 0], abs=0.06)
    assert abs(found[0, 1] / found[0, 0]) > 0.2


def test_a_rate_setpoint_without_the_injected_rate_is_refused(flown, tmp_path):
    with pytest.raises(TuningError, match=r"vehicle_rates_setpoint does not contain the rate injected on (roll|pitch)"):
        read_log(stock_log(tmp_path / "wrong.ulg", flown, factor=-1.0))
