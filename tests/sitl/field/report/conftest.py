"""A bench flight with excitation, shared by the tests of reports."""

import pytest

import mimopilot as mp
from mimopilot.sitl.field.report.flight_report import make_report


@pytest.fixture(scope="session")
def bench(tmp_path_factory):
    """The experiment, a gain set (in my.gains.toml beside the log), and the report of both."""
    log = tmp_path_factory.mktemp("bench") / "flight.ulg"
    flight = mp.experiment("adam0", log, seed=1, seconds_per_axis=8.0)
    gains = flight.flown.with_elements({"RP_RR": 0.18, "RP_PP": 0.18, "RI_RR": 0.1, "RI_PP": 0.1})
    gains.save(log.with_name("my.gains.toml"))
    return flight, gains, make_report([log], [("my", gains)])
