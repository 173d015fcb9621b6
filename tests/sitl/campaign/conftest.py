"""The vehicle of the campaigns."""

import pytest

from mimopilot.sitl.physics.airframe import load_airframe


@pytest.fixture(scope="module")
def vehicle():
    return load_airframe("adam0")
