"""Gains for another control period than the usual 4 ms: each command runs at theirs."""

import json
from dataclasses import replace

import pytest

from mimopilot import fly, load_gains, performance
from mimopilot.sitl.physics.airframe import FOLDER

SLOW = FOLDER / "adam0.gains.toml"


@pytest.fixture(scope="module")
def fast(tmp_path_factory):
    """The gains of adam0 at 500 Hz, the rate of a Crazyflie."""
    gains = load_gains(SLOW)
    path = tmp_path_factory.mktemp("gains") / "fast.gains.toml"
    replace(gains, filters=replace(gains.filters, Ts=0.002)).save(path)
    return path


def test_a_flight_has_a_sample_each_period_and_follows_the_setpoint_alike(fast):
    flights = {path: fly("adam0", path, tail_s=0.5, noise=False) for path in (SLOW, fast)}
    slow, quick = (len(flight.record) for flight in flights.values())
    assert quick == pytest.approx(2 * slow, abs=2)
    peaks = [performance(flight, path).peak_deg for path, flight in flights.items()]
    assert peaks[1] == pytest.approx(peaks[0], rel=0.05)


def test_faults_are_timed_in_seconds_and_the_controller_holds_25_of_its_own_samples(fast, mimopilot):
    arguments = ("faults", "adam0", "--runs", 1, "--workers", 1, "--fault", "gyro-nan@1.1+0.2", "--json")
    result = mimopilot(*arguments, "--gains", SLOW, "--gains", fast)
    assert result.returncode == 0, result.stderr
    assert [row["detected_s"] for row in json.loads(result.stdout)["rows"]] == [0.1, 0.05]
    refused = mimopilot("fly", "adam0", "--gains", fast, "--fault", "delay=0.9@1")
    assert refused.returncode == 2 and "at most 0.508 s at a period of 0.002 s" in refused.stderr


def test_pil_gives_the_share_of_the_gains_own_period(fast, mimopilot):
    result = mimopilot("pil", fast, "--rows", 200, "--json")
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout)
    assert found["period_share"] == pytest.approx(2 * found["budget_share"]) and found["rows_different"] == 0
