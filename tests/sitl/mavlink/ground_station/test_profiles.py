"""Conversion of gains to the parameters of our module and of stock autopilots."""

import dataclasses
import math

import numpy as np
import pytest

from mimopilot.codegen.layout import to_array
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.profiles import PROFILES, law_of, make_plan, make_restore_plan
from mimopilot.sitl.mavlink.wire.float32 import single
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains import Limits
from mimopilot.tuning.logs.flown_gains import flown_gains
from mimopilot.tuning.parameters import PARAMETERS, ROWS, YAW_GAINS
from tests.conftest import coupled_gains, stock_gains

STOCK = ("px4-stock", "ardupilot-stock")


def set_for(profile):
    """A set that the profile uploads."""
    return stock_gains(profile) if profile in STOCK else coupled_gains()


def test_our_module_receives_every_writable_parameter_bit_identical_to_the_struct(gains):
    plan = make_plan(gains)
    array = {p.name: float(v) for p, v in zip(PARAMETERS, to_array(gains), strict=True)}
    assert plan.fixed == {"MIMO_TS": array.pop("MIMO_TS")}
    assert plan.values == array
    assert plan.scale == ("MIMO_SCALE_R", "MIMO_SCALE_P", "MIMO_SCALE_Y")


def test_px4s_parameters_describe_the_same_controller():
    """The log reader, whose table is independent of the profiles, recovers the set."""
    gains = stock_gains("px4-stock")
    plan = make_plan(gains, "px4-stock")
    found = flown_gains(plan.values, gains.Ts)
    for code, value in gains.for_our_law().elements().items():
        assert found.for_our_law().elements()[code] == pytest.approx(value, rel=1e-6), code
    assert found.filters.stock == gains.filters.stock
    assert plan.values["MC_ROLLRATE_MAX"] == single(math.degrees(5.0))
    assert plan.values["MC_YAWRATE_K"] == 1.0
    assert (plan.values["IMU_DGYRO_CUTOFF"], plan.values["MC_YAW_TQ_CUTOFF"]) == (30.0, 2.0)


def test_ardupilots_parameters_are_the_gains_in_its_units():
    gains, profile = stock_gains("ardupilot-stock"), "ardupilot-stock"
    values, stock = make_plan(gains, profile).values, gains.filters.stock
    for axis, name in enumerate(("RLL", "PIT", "YAW")):
        if axis == 2:
            terms = [getattr(gains.yaw, matrix) for matrix in YAW_GAINS]
        else:
            terms = [getattr(gains, matrix)[axis, axis] for matrix in YAW_GAINS]
        written = [
            values[f"ATC_{part}"] for part in (f"ANG_{name}_P", *(f"RAT_{name}_{t}" for t in ("P", "I", "D", "FF")))
        ]
        assert written == [single(term) for term in terms]
        assert values[f"ATC_RAT_{name}_IMAX"] == single(gains.limits.integral_max[axis])
        filters = [values[f"ATC_RAT_{name}_{filter}"] for filter in ("FLTT", "FLTE", "FLTD", "D_FF")]
        held = (stock.setpoint_hz, stock.error_hz, stock.derivative_hz, stock.derivative_feedforward)
        assert filters == [single(one[axis]) for one in held]
        assert values[f"ATC_RATE_{name[0]}_MAX"] == single(math.degrees(gains.limits.rate_max[axis]))
    assert values["ATC_INPUT_TC"] == single(stock.shaping_s[0])
    assert len(values) == 34
    free = dataclasses.replace(gains, limits=dataclasses.replace(gains.limits, rate_max=Limits().rate_max))
    assert [make_plan(free, profile).values[f"ATC_RATE_{axis}_MAX"] for axis in "RPY"] == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("profile", PROFILES)
def test_a_set_for_another_controller_is_refused(profile):
    for controller, other in zip(("mimo", *STOCK), (coupled_gains(), *map(stock_gains, STOCK)), strict=True):
        if controller != law_of(profile):
            message = f"--profile {profile}: the gains are for {controller}; upload them with --profile {controller}"
            with pytest.raises(SitlError, match=message):
                make_plan(other, profile)


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
        ("inav", {}, "--profile: got 'inav', expected one of mimo, px4-stock, ardupilot-stock"),
    ],
)
def test_values_out_of_range_that_a_vehicle_would_accept_are_refused(profile, change, message):
    with pytest.raises((SitlError, TuningError), match=message):
        make_plan(dataclasses.replace(set_for(profile), **change), profile)


@pytest.mark.parametrize("profile", PROFILES)
def test_every_name_and_value_fits_a_mavlink_message(profile):
    for name, value in make_plan(set_for(profile), profile).values.items():
        assert len(name) <= 16
        assert name == name.upper()
        assert value == single(value)


def test_a_snapshot_must_be_complete_and_within_our_ranges(gains):
    values = make_plan(gains).values
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
