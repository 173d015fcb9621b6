"""Conversion of gains to the parameters of our module and of stock autopilots."""

import dataclasses
import math

import numpy as np
import pytest

from mimopilot.codegen.layout import to_array
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.profiles import PROFILES, make_plan, make_restore_plan, off_diagonal_shares
from mimopilot.sitl.mavlink.wire.float32 import single
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains import Limits
from mimopilot.tuning.logs.flown_gains import flown_gains
from mimopilot.tuning.parameters import MATRICES, PARAMETERS, ROWS, YAW_GAINS
from tests.conftest import coupled_gains, following_gains


@pytest.fixture
def diagonal(gains):
    """The gains without their off-diagonals."""
    matrices = {name: np.diag(np.diag(getattr(gains, name))) for name in MATRICES}
    return dataclasses.replace(gains, **matrices)


def test_our_module_receives_every_writable_parameter_bit_identical_to_the_struct(gains):
    plan = make_plan(gains)
    array = {p.name: float(v) for p, v in zip(PARAMETERS, to_array(gains), strict=True)}
    assert plan.fixed == {"MIMO_TS": array.pop("MIMO_TS")}
    assert plan.values == array
    assert plan.dropped == {}
    assert plan.scale == ("MIMO_SCALE_R", "MIMO_SCALE_P", "MIMO_SCALE_Y")


def test_px4s_parameters_describe_the_same_controller(diagonal):
    """The log reader, whose table is independent of the profiles, recovers the gains."""
    plan = make_plan(diagonal, "px4-stock")
    found = flown_gains(plan.values, diagonal.Ts)
    for code, value in diagonal.elements().items():
        if not code.startswith("UMAX"):
            assert found.elements()[code] == pytest.approx(value, rel=1e-6), code
    assert plan.values["MC_ROLLRATE_MAX"] == single(math.degrees(5.0))
    assert plan.values["MC_YAWRATE_K"] == 1.0
    assert plan.values["IMU_DGYRO_CUTOFF"] == 30.0
    assert any("moment_max (pitch, yaw)" in note for note in plan.notes)


def test_ardupilots_parameters_are_the_diagonal_gains_in_its_units(diagonal):
    values = make_plan(diagonal, "ardupilot-stock").values
    for axis, name in enumerate(("RLL", "PIT", "YAW")):
        if axis == 2:
            terms = [getattr(diagonal.yaw, matrix) for matrix in YAW_GAINS]
        else:
            terms = [getattr(diagonal, matrix)[axis, axis] for matrix in YAW_GAINS]
        written = [
            values[f"ATC_{part}"] for part in (f"ANG_{name}_P", *(f"RAT_{name}_{t}" for t in ("P", "I", "D", "FF")))
        ]
        assert written == [single(term) for term in terms]
        assert values[f"ATC_RAT_{name}_IMAX"] == single(diagonal.limits.integral_max[axis])
        assert values[f"ATC_RAT_{name}_FLTD"] == 30.0
        assert values[f"ATC_RATE_{name[0]}_MAX"] == single(math.degrees(diagonal.limits.rate_max[axis]))
    assert len(values) == 24


@pytest.mark.parametrize("profile", ["px4-stock", "ardupilot-stock"])
def test_large_off_diagonals_are_dropped_only_on_request(gains, profile):
    with pytest.raises(SitlError, match=rf"R[PD]_RP: the {profile} controller has no off-diagonals, .* 13% of"):
        make_plan(gains, profile)
    plan = make_plan(gains, profile, drop=True)
    assert plan.dropped == off_diagonal_shares(gains)
    assert plan.dropped["RP_RP"] == pytest.approx(0.02 / 0.15)
    assert plan.dropped["AP_PR"] == pytest.approx(0.2 / 5.5)
    assert len(plan.dropped) == 10


def test_an_off_diagonal_in_a_row_with_zero_diagonal_has_an_infinite_share(diagonal):
    odd = dataclasses.replace(diagonal, Kff_i=np.array([[0.0, 0.001], [0.0, 0.0]]))
    assert off_diagonal_shares(odd) == {"RF_RP": math.inf}
    with pytest.raises(SitlError, match="RF_RP"):
        make_plan(odd, "px4-stock")


def test_small_off_diagonals_are_dropped_and_reported(diagonal):
    small = dataclasses.replace(diagonal, Kp_i=np.array([[0.15, 0.003], [0.0, 0.13]]))
    assert make_plan(small, "px4-stock").dropped == {"RP_RP": pytest.approx(0.02)}


@pytest.mark.parametrize(
    ("profile", "change", "message"),
    [
        ("mimo", {"Kp_i": np.eye(2) * 6}, "MIMO_RP_RR: got 6 s, expected 0.0001 to 5"),
        ("px4-stock", {"Kp_i": np.eye(2) * 0.7}, "MC_ROLLRATE_P: got 0.7, expected 0 to 0.5 s"),
        ("px4-stock", {"Kd_i": -np.eye(2) * 0.001}, "MC_ROLLRATE_D: got -0.001, expected 0 to 0.01"),
        ("ardupilot-stock", {"Kp_o": np.eye(2) * 13}, "ATC_ANG_RLL_P: got 13, expected 0 to 12"),
        (
            "ardupilot-stock",
            {"limits": Limits(rate_max=(20.0, 1.0, 1.0))},
            "ATC_RATE_R_MAX: got 1145.92, expected 0 to 1080",
        ),
        ("betaflight", {}, "--profile: got 'betaflight', expected one of mimo, px4-stock, ardupilot-stock"),
    ],
)
def test_values_out_of_range_that_a_vehicle_would_accept_are_refused(diagonal, profile, change, message):
    with pytest.raises((SitlError, TuningError), match=message):
        make_plan(dataclasses.replace(diagonal, **change), profile)


def test_a_stock_controller_flies_without_the_model_and_the_plan_says_so():
    following = following_gains()
    plan = make_plan(following, "px4-stock", drop=True)
    off = dataclasses.replace(following, filters=dataclasses.replace(following.filters, model_omega=0.0))
    assert plan.values == make_plan(off, "px4-stock", drop=True).values
    assert plan.dropped == off_diagonal_shares(coupled_gains())
    assert any("model following has no counterpart" in note for note in plan.notes)
    assert not any("model" in note for note in make_plan(off, "px4-stock", drop=True).notes)


@pytest.mark.parametrize("profile", PROFILES)
def test_every_name_and_value_fits_a_mavlink_message(diagonal, profile):
    for name, value in make_plan(diagonal, profile).values.items():
        assert len(name) <= 16
        assert name == name.upper()
        assert value == single(value)


def test_a_snapshot_must_be_complete_and_within_our_ranges(diagonal):
    values = make_plan(diagonal).values
    plan = make_restore_plan(values | {"MIMO_TS": 0.004, "SYS_X": 1e9}, "old.params")
    assert plan.values == values | {"SYS_X": 1e9}
    assert (plan.fixed, plan.profile) == ({"MIMO_TS": 0.004}, "mimo")
    assert [s.unit for s in plan.settings][:1] == ["1/s"]
    with pytest.raises(SitlError, match=r"old\.params: MIMO_RP_RR: got 99, expected -?[0-9.e-]+ to 5 s"):
        make_restore_plan(values | {"MIMO_RP_RR": 99.0}, "old.params")
    count = sum(len(row.codes) for row in ROWS if row.writable and row.default is None)
    with pytest.raises(SitlError, match=rf"holds {count - 2} of our {count} gains and lacks MIMO_RP_RP and 1 more"):
        make_restore_plan({n: v for n, v in values.items() if n not in ("MIMO_RP_RP", "MIMO_D_POLE")}, "old.params")
    foreign = make_restore_plan({"MC_ROLL_P": 99.0}, "px4.params")
    assert (foreign.values, foreign.profile) == ({"MC_ROLL_P": 99.0}, "px4-stock")
    assert make_restore_plan({"ATC_ANG_RLL_P": 5.0}, "x").profile == "ardupilot-stock"
    assert make_restore_plan({"WPNAV_SPEED": 5.0}, "x").profile == ""
