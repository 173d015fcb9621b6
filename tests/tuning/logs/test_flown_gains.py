import re

import numpy as np
import pytest

from mimopilot.tuning.logs.flown_gains import flown_gains
from tests.conftest import following_gains

PX4 = {
    **{f"MC_{axis}_P": 6.5 for axis in ("ROLL", "PITCH")},
    "MC_YAW_P": 2.8,
    **{
        f"MC_{axis}RATE_{term}": value
        for axis in ("ROLL", "PITCH")
        for term, value in (("P", 0.15), ("I", 0.2), ("D", 0.003), ("FF", 0.0), ("K", 2.0))
    },
    **{f"MC_YAWRATE_{term}": value for term, value in (("P", 0.2), ("I", 0.1), ("D", 0.0), ("FF", 0.0))},
    "MC_ROLLRATE_MAX": 220.0,
    "MC_PITCHRATE_MAX": 220.0,
    "MC_YAWRATE_MAX": 200.0,
    "MC_RR_INT_LIM": 0.3,
    "MC_PR_INT_LIM": 0.3,
    "MC_YR_INT_LIM": 0.3,
    "IMU_DGYRO_CUTOFF": 30.0,
}


def test_stock_px4_parameters_are_read_with_their_units_and_overall_factor():
    gains = flown_gains(PX4, 0.004)
    assert gains is not None
    assert gains.Kp_i == pytest.approx(np.eye(2) * 0.30)
    assert gains.Kd_i == pytest.approx(np.eye(2) * 0.006)
    assert gains.Kp_o == pytest.approx(np.eye(2) * 6.5)
    assert gains.yaw.Kp_i == 0.2
    assert gains.limits.rate_max == pytest.approx((np.radians(220), np.radians(220), np.radians(200)))
    assert gains.derivative_cutoff_hz == 30.0
    assert gains.moment_scale is None


def test_mimo_parameters_take_precedence():
    ours = {"MIMO_RP_RR": 0.12, "MIMO_RP_RP": 0.01, "MIMO_D_POLE": 0.5, "MIMO_RMAX_R": 7.0}
    gains = flown_gains(PX4 | ours | {f"MIMO_SCALE_{a}": 2.5 for a in "RPY"}, 0.004)
    assert gains is not None
    assert gains.Kp_i[0] == pytest.approx([0.12, 0.01])
    assert gains.Kp_i[1, 1] == pytest.approx(0.30)
    assert gains.limits.rate_max[0] == 7.0
    assert gains.filters.derivative_pole == pytest.approx(0.5, rel=1e-5)
    assert gains.moment_scale == (2.5, 2.5, 2.5)


def test_mimo_parameters_do_not_count_while_the_stock_controllers_fly():
    ours = {"MIMO_RP_RR": 0.12, "MIMO_RP_RP": 0.01, "MIMO_SCALE_R": 2.5}
    gains = flown_gains(PX4 | ours | {"MIMO_EN": 0}, 0.004)
    assert gains is not None and gains.Kp_i == pytest.approx(np.eye(2) * 0.30) and gains.moment_scale is None
    assert flown_gains(PX4 | ours | {"MIMO_EN": 1}, 0.004).Kp_i[0] == pytest.approx([0.12, 0.01])


@pytest.mark.parametrize("missing", ["MC_ROLLRATE_P", "MC_YAW_P", "MC_RR_INT_LIM", "MC_ROLLRATE_MAX"])
def test_parameters_of_an_incomplete_controller_give_no_gains(missing):
    assert flown_gains({k: v for k, v in PX4.items() if k != missing}, 0.004) is None


def test_model_following_is_read_with_its_matrices_or_not_at_all():
    flown = following_gains()
    logged = {f"MIMO_{code}": np.float32(value) for code, value in flown.elements().items()}
    read = flown_gains(logged, flown.Ts)
    assert read is not None
    assert (read.filters.model_omega, read.filters.model_damping) == (9.0, 0.8)
    assert read.Kaff_i.tolist() == flown.Kaff_i.tolist()
    without = flown_gains({name: v for name, v in logged.items() if not re.match("MIMO_(AF|RA|M)_", name)}, flown.Ts)
    assert without is not None and without.filters.followed is None
    assert flown_gains({name: v for name, v in logged.items() if not name.startswith("MIMO_AF")}, flown.Ts) is None
    assert flown_gains({name: v for name, v in logged.items() if name != "MIMO_RA_RP"}, flown.Ts) is None
    assert flown_gains(logged, 0.05) is None  # a model too fast for this period
