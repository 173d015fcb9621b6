"""A bench flight with excitation, shared by the tests of reports."""

from dataclasses import replace

import pytest

import mimopilot as mp
from mimopilot.sitl.field.report.flight_report import make_report


@pytest.fixture(scope="session")
def bench(tmp_path_factory):
    """The experiment, a gain set (in my.gains.toml beside the log), and the report of both."""
    log = tmp_path_factory.mktemp("bench") / "flight.ulg"
    flight = mp.experiment("adam0", log, seed=1, seconds_per_axis=8.0)
    gains = flight.flown.with_elements({"RP_RR": 0.18, "RP_PP": 0.18, "RI_RR": 0.1, "RI_PP": 0.1})
    # So short an excitation of yaw does not show the crossover of the flown yaw gains, which is lower.
    gains = replace(gains, yaw=replace(gains.yaw, Kp_o=2.5, Kp_i=1.0))
    gains.save(log.with_name("my.gains.toml"))
    return flight, gains, make_report([log], [("my", gains)])
