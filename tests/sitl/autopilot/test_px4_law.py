"""The bench's stock PX4: its law against closed forms and rules written down a second time, and its autotune."""

import math

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from mimopilot.codegen.layout import INPUT, OUTPUT
from mimopilot.sitl.autopilot.autotune_module import AutotuneModule, State
from mimopilot.sitl.autopilot.px4_law import Px4Controller
from mimopilot.sitl.autopilot.px4_parameters import px4_parameters
from mimopilot.sitl.autopilot.setpoints import Sticks
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.sitl.physics.compiled_step import call_step, compiled

TS = 0.004
HANDS_OFF = Sticks(0.0, 0.0, 0.0, 0.0)


@compiled
def _run(address, state, inputs, outputs):
    for k in range(inputs.shape[0]):
        call_step(
            address,
            state.ctypes.data,
            inputs.ctypes.data + k * inputs.itemsize,
            outputs.ctypes.data + k * outputs.itemsize,
        )


@pytest.fixture(scope="module")
def parameters():
    vehicle = load_airframe("adam0")
    values = {p.name: float(p.value) for p in px4_parameters(vehicle.default_gains(), 40.0)}
    # Each axis has its own gains, so that exchanged ones are found.
    changes = {
        **{"MC_PITCH_P": 5.0, "MC_PITCHRATE_P": 0.2, "MC_PITCHRATE_K": 1.5, "MC_ROLLRATE_FF": 0.02},
        **{"MC_YAWRATE_D": 0.01, "MC_PITCHRATE_MAX": 90.0},
    }
    return values | changes


def flown(parameters, count, **columns):
    """Outputs of the law for inputs of `count` periods: level, armed and in the air unless they say otherwise."""
    controller = Px4Controller(parameters, TS)
    inputs, outputs = np.zeros(count, INPUT), np.zeros(count, OUTPUT)
    inputs["attitude"][:, 0] = inputs["attitude_setpoint"][:, 0] = 1.0
    inputs["armed"] = 1
    for name, values in columns.items():
        inputs[name] = values
    _run(controller.step_address, controller.state, inputs, outputs)
    return outputs, controller


def tilt_first(q, d, weight):
    """Twice the vector part of PX4's attitude error, as it is described: rotate the thrust first, then about it."""
    now, wanted = (Rotation.from_quat(np.roll(x, -1)) for x in (q, d))
    z, z_d = now.apply([0, 0, 1]), wanted.apply([0, 0, 1])
    axis = np.cross(z, z_d)
    angle = math.atan2(np.linalg.norm(axis), z @ z_d)
    tilt = Rotation.from_rotvec(axis / max(np.linalg.norm(axis), 1e-12) * angle)
    reduced = tilt * now
    turn = (reduced.inv() * wanted).as_rotvec()
    assert np.abs(turn[:2]).max() < 1e-9
    error = (now.inv() * reduced * Rotation.from_rotvec(weight * turn)).as_quat()
    return 2 * error[:3] * (1 if error[3] >= 0 else -1)


def test_the_attitude_law_rotates_the_thrust_first(parameters):
    q, d = (Rotation.random(200, rng=np.random.default_rng(s)).as_quat(scalar_first=True) for s in (1, 2))
    wide = parameters | {f"MC_{axis}RATE_MAX": 1e6 for axis in ("ROLL", "PITCH", "YAW")}
    outputs, _ = flown(wide, 200, attitude=q, attitude_setpoint=d, yaw_rate_setpoint=0.3)
    weight = parameters["MC_YAW_WEIGHT"]
    P = np.array([parameters["MC_ROLL_P"], 5.0, parameters["MC_YAW_P"] / weight])
    earth = Rotation.from_quat(q, scalar_first=True).inv().apply([0, 0, 1])
    expected = np.array([tilt_first(a, b, weight) for a, b in zip(q, d, strict=True)]) * P + 0.3 * earth
    # A rate setpoint acts in the next period.
    np.testing.assert_allclose(outputs["rates_setpoint"][1:], expected[:-1], atol=2e-5)
    limited, _ = flown(parameters, 200, attitude=q, attitude_setpoint=d)
    assert np.abs(limited["rates_setpoint"][:, 1]).max() == pytest.approx(math.radians(90.0))


def test_the_rate_law_has_the_closed_form_of_its_filters(parameters):
    """Of PX4's own order: the integral of before, derivative low-pass, K on P, I and D but not on FF, yaw low-pass."""
    generator = np.random.default_rng(3)
    rates, wanted = 1e-3 * generator.standard_normal((2, 400, 3))
    rates[0] = 0.0
    outputs, _ = flown(parameters, 400, rates=rates, rates_setpoint=wanted, rate_mode=1)
    rates, wanted = rates.astype(np.float32).astype(float), wanted.astype(np.float32).astype(float)
    alpha = TS / (TS + 1 / (2 * math.pi * 30.0))
    beta = TS / (TS + 1 / (2 * math.pi * 2.0))
    for i, axis in enumerate(("ROLL", "PITCH", "YAW")):
        P, I, D, K, FF = (parameters[f"MC_{axis}RATE_{letter}"] for letter in ("P", "I", "D", "K", "FF"))  # noqa: E741
        error = wanted[:, i] - rates[:, i]
        integral = lfilter([0.0, I * TS], [1.0, -1.0], error)
        derivative = lfilter([alpha / TS, -alpha / TS], [1.0, alpha - 1.0], rates[:, i])
        torque = K * (P * error + integral - D * derivative) + FF * wanted[:, i]
        if i == 2:
            torque = lfilter([beta], [1.0, beta - 1.0], torque)
        # The integral fades by (e / 7 rad/s)^2: not seen here.
        np.testing.assert_allclose(outputs["moment"][:, i], torque, atol=3e-9, err_msg=axis)


def integral_of(parameters, **columns):
    columns = {"rates_setpoint": 1.0, "rate_mode": 1, **columns}
    _, controller = flown(parameters, 10, **columns)
    return controller.state["integral"][0]


def test_the_integral_follows_px4s_rules(parameters):
    P = parameters | {f"MC_{axis}RATE_I": 0.5 for axis in ("ROLL", "PITCH", "YAW")} | {"MC_PITCHRATE_K": 1.0}
    fade = 1 - (1.0 / math.radians(400.0)) ** 2
    np.testing.assert_allclose(integral_of(P), 10 * 0.5 * fade * TS)
    np.testing.assert_allclose(integral_of(P, saturation=(1, -1, 0)), [0.0, 0.02 * fade, 0.02 * fade])
    assert not integral_of(P, armed=0)[0] > 0.5 * fade * TS  # of the last period only
    assert not integral_of(P, landed=1).any()
    assert not integral_of(P, rates_setpoint=7.0).any()  # beyond 400 deg/s
    assert integral_of(P | {"MC_RR_INT_LIM": 0.005})[0] == 0.005


def test_the_autotune_excites_axis_after_axis_and_applies_nothing():
    values = {"MC_AT_START": 1.0, "MC_AT_SYSID_AMP": 2.0}
    module, k, signal, states = AutotuneModule(values), 0, [], []
    while values["MC_AT_START"]:
        k += 1
        signal.append(module.step(k * TS, True, HANDS_OFF))
        states.append(module.state)
    signal, states = np.array(signal), np.array(states)
    assert list(dict.fromkeys(states.tolist())) == [*range(State.APPLY + 1), State.COMPLETE]
    for axis, state in enumerate((State.ROLL, State.PITCH, State.YAW)):
        active = signal[:, axis] != 0
        assert (states[active] == state).all()
        assert active.sum() * TS == pytest.approx((5.1, 5.1, 10.0)[axis], abs=0.2)
        # Held for 0.1 s, the first hold 0.6 s, behind a high-pass of 0.2 s.
        held = signal[active, axis][::25]
        np.testing.assert_allclose(held[:6], 2.0 * (2 / 3) ** np.arange(6))
        assert held[6] == pytest.approx(-2.0 * (1 - (2 / 3) ** 6))


def test_a_stick_ends_the_autotune():
    values = {"MC_AT_START": 1.0, "MC_AT_SYSID_AMP": 2.0}
    module = AutotuneModule(values)
    moved = [module.step(k * TS, True, Sticks(0.06 if k > 2000 else 0.0, 0.0, 0.0, 0.0)) for k in range(1, 3000)]
    assert any(moved[1990])
    assert not any(moved[2030])
    assert (module.state, values["MC_AT_START"]) == (State.IDLE, 0.0)


def test_a_second_autotune_publishes_at_the_times_of_the_first():
    """A log has its values at one interval; PX4 also publishes while it waits."""
    values = {"MC_AT_START": 0.0, "MC_AT_SYSID_AMP": 2.0}
    module, signal = AutotuneModule(values), []
    for pause in (3, 39):  # control periods; the second is longer than 0.1 s and no multiple of it
        end = len(signal) + pause
        values["MC_AT_START"] = 0.0
        while len(signal) < end or values["MC_AT_START"]:
            signal.append(module.step((len(signal) + 1) * TS, True, HANDS_OFF)[0])
            if len(signal) == end:
                values["MC_AT_START"] = 1.0
    changes = np.flatnonzero(np.diff(signal)) + 1
    assert len(changes) > 100 and len(set((changes % 25).tolist())) == 1
