"""Control allocation within and at the limits of the motors."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.sitl.physics.mixer import allocate, make_allocation, moment_scale

UNIT = st.floats(-1, 1)


def run(allocation, moments, collective):
    commands, unallocated = np.zeros(len(allocation.mixer)), np.zeros(3)
    allocate(np.asarray(moments, float), collective, allocation, commands, unallocated)
    return commands, unallocated


def given_moments(allocation, commands):
    return (np.linalg.pinv(allocation.mixer) @ commands)[:3]


def hexacopter(airmode):
    angles = np.radians([30, 90, 150, 210, 270, 330])
    rotors = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(6)]) * 0.3
    return make_allocation(rotors, np.array([1.0, -1, 1, -1, 1, -1]), 8.0, 0.02, airmode)


def vehicles():
    return [
        load_airframe("adam0").airframe.allocation(),
        load_airframe("antr").airframe.allocation(),
        hexacopter(False),
        hexacopter(True),
    ]


def test_one_unit_of_torque_is_2_b_t_max():
    airframe = load_airframe("adam0").airframe
    roll, pitch, yaw = airframe.moment_scale()
    assert roll == pitch == pytest.approx(2 * 0.1768 * 7.2)
    assert yaw == pytest.approx(2 * 7.2 * 0.019)
    rotors, spin = airframe.geometry()
    assert moment_scale(rotors, spin, 7.2, 0.019) == pytest.approx([roll, pitch, yaw])


@given(roll=UNIT, pitch=UNIT, yaw=UNIT, collective=st.floats(0, 1), vehicle=st.integers(0, 3))
@settings(max_examples=300, deadline=None)
def test_commands_stay_in_range_and_feasible_torques_are_given_exactly(roll, pitch, yaw, collective, vehicle):
    allocation = vehicles()[vehicle]
    moments = np.array([roll, pitch, yaw])
    commands, unallocated = run(allocation, moments, collective)
    assert ((commands >= 0) & (commands <= 1)).all()
    wanted = allocation.mixer @ np.append(moments, collective)
    got = given_moments(allocation, commands)
    if ((wanted >= 0) & (wanted <= 1)).all():
        assert commands == pytest.approx(wanted, abs=1e-9)
        assert (unallocated == 0).all()
    for axis in range(3):
        if unallocated[axis] == 0:
            assert got[axis] == pytest.approx(moments[axis], abs=1e-8)
        else:
            assert unallocated[axis] == np.sign(moments[axis])
            # Reduced, never reversed.
            low, high = sorted((0.0, moments[axis]))
            assert low - 1e-8 <= got[axis] <= high + 1e-8
    # Yaw is reduced before roll and pitch, which are scaled together.
    if unallocated[:2].any():
        assert abs(got[2]) < 1e-7
        if min(abs(roll), abs(pitch)) > 1e-6:
            assert got[0] * pitch == pytest.approx(got[1] * roll, abs=1e-8)


def test_at_the_upper_limit_the_collective_is_lowered():
    allocation = load_airframe("adam0").airframe.allocation()
    commands, unallocated = run(allocation, [0.4, 0.0, 0.0], 0.95)
    assert given_moments(allocation, commands)[0] == pytest.approx(0.4)
    assert commands.max() == pytest.approx(1.0)
    assert (unallocated == 0).all()


def test_airmode_raises_the_collective_and_without_it_the_torque_is_reduced():
    airframe = load_airframe("antr").airframe
    hover = 0.745 * 9.80665 / 4 / 13
    with_airmode = airframe.allocation()
    without = airframe.model_copy(update={"airmode": False}).allocation()
    assert given_moments(with_airmode, run(with_airmode, [0.8, 0, 0], hover)[0])[0] == pytest.approx(0.8)
    commands, unallocated = run(without, [0.8, 0, 0], hover)
    # Half of the collective on each side: hovering at 14 % of the thrust leaves 28 % of the torque.
    assert given_moments(without, commands)[0] == pytest.approx(2 * hover, rel=1e-6)
    assert unallocated[0] == 1


def test_rotors_that_cannot_control_every_axis_are_refused():
    line = np.array([[0.1, 0.1, 0], [-0.1, -0.1, 0], [0.2, 0.2, 0], [-0.2, -0.2, 0]])
    with pytest.raises(SitlError, match="independently"):
        make_allocation(line, np.array([1.0, 1, -1, -1]), 7.0, 0.02, False)
