"""Fixtures of the upload tests."""

import pytest

from mimopilot.sitl.mavlink.ground_station.profiles import make_plan
from mimopilot.tuning.certificate import Certificate, Verdict
from mimopilot.tuning.parameters import IDENTITY
from tests.sitl.mavlink.running import WAITS
from tests.sitl.mavlink.scripted_vehicle import float32

#: Number of the firmware of these vehicles.
NUMBER = 123456.0


@pytest.fixture
def quick_mimopilot(monkeypatch, mimopilot):
    """The command line with the shortened `WAITS`: a real upload waits for seconds."""
    for (module, name), value in WAITS.items():
        monkeypatch.setattr(f"{module}.{name}", value)
    return mimopilot


@pytest.fixture
def certified(gains, tmp_path):
    """A gains file with a certificate for its matrices."""
    path = tmp_path / "my.gains.toml"
    gains.with_certificate(Certificate(Verdict.CERTIFIED, "by this test")).save(path)
    return path


@pytest.fixture
def new(gains):
    return make_plan(gains).bound(NUMBER).values


@pytest.fixture
def old(gains, new):
    """Every gain on the vehicle differs from the new one; the period and the unit of torque do not. None is stored."""
    identity = dict(zip((p.name for p in IDENTITY), gains.moment_scale, strict=True))
    values = {name: value * 0.875 or 0.125 for name, value in new.items()} | {"MIMO_TS": gains.Ts} | identity
    values |= {"MIMO_FW_ID": NUMBER, "MIMO_SET_ID": 0.0}
    return {name: float32(value) for name, value in values.items()}
