"""The stock laws in tuning, against recursions written from the documentation of PX4, ArduPilot and Betaflight."""

import dataclasses
import math

import numpy as np
import pytest

from mimopilot.codegen.render import render
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains import gains_to_toml
from mimopilot.tuning.gains_file import gains_from_toml
from mimopilot.tuning.law import rate_matrices, regressors, response, setpoint_rate_response, shaping_response
from mimopilot.tuning.law_state_space import state_space
from mimopilot.tuning.law_terms import ERROR, RATE, SETPOINT
from mimopilot.tuning.parameters import YAW_GAINS
from tests.conftest import stock_gains

STOCK = ("px4-stock", "ardupilot-stock", "betaflight")
SAMPLES = 400


def terms(gains, axis):
    """Kp, Ki, Kd and Kff of an axis."""
    names = YAW_GAINS[1:]
    return [getattr(gains.yaw, n) if axis == 2 else getattr(gains, n)[axis, axis] for n in names]


def weight(hertz, Ts):
    """Weight of a new sample in the first-order low-pass of both autopilots."""
    return 1.0 if hertz == 0 else Ts / (Ts + 1 / (2 * math.pi * hertz))


def px4(gains, axis, setpoint, rate):
    """PX4's rate controller for small signals: the torque uses the integral of before."""
    Kp, Ki, Kd, Kff = terms(gains, axis)
    Ts, stock = gains.Ts, gains.filters.stock
    a, b = weight(stock.derivative_hz[axis], Ts), weight(stock.torque_hz[axis], Ts)
    integral = slope = torque = 0.0
    before, made = rate[0], []
    for r, y in zip(setpoint, rate, strict=True):
        slope += a * ((y - before) / Ts - slope)
        before = y
        torque += b * (Kp * (r - y) + integral - Kd * slope + Kff * r - torque)
        integral += Ki * (r - y) * Ts
        made.append(torque)
    return made


def ardupilot(gains, axis, setpoint, rate):
    """ArduPilot's AC_PID, from rest: setpoint, error and derivative each behind a low-pass."""
    Kp, Ki, Kd, Kff = terms(gains, axis)
    Ts, stock = gains.Ts, gains.filters.stock
    a, b, c = (weight(f[axis], Ts) for f in (stock.setpoint_hz, stock.error_hz, stock.derivative_hz))
    target = error = integral = derivative = 0.0
    made = []
    for r, y in zip(setpoint, rate, strict=True):
        last_target, last_error = target, error
        target += a * (r - target)
        error += b * (target - y - error)
        derivative += c * ((error - last_error) / Ts - derivative)
        integral += Ki * error * Ts
        feedforward = Kff * target + stock.derivative_feedforward[axis] * (target - last_target) / Ts
        made.append(Kp * error + integral + Kd * derivative + feedforward)
    return made


def betaflight(gains, axis, setpoint, rate):
    """Betaflight's pid.c in angle mode, from rest: setpoint behind a PT3 of 50 Hz, gyro behind two PT1."""
    Kp, Ki, Kd, Kff = terms(gains, axis)
    Ts, stock = gains.Ts, gains.filters.stock
    a, b = weight(stock.derivative_hz[axis], Ts), weight(stock.derivative2_hz[axis], Ts)
    c = weight(50.0 * 1.961459177, Ts)
    stages, first, second, integral, made = [0.0] * 3, rate[0], rate[0], 0.0, []
    for r, y in zip(setpoint, rate, strict=True):
        for i in range(3):  # each stage takes the new output of the one before it
            stages[i] += c * ((stages[i - 1] if i else r) - stages[i])
        before = second
        first += a * (y - first)
        second += b * (first - second)
        integral += Ki * (stages[2] - y) * Ts
        made.append(Kp * (stages[2] - y) + integral - Kd * (second - before) / Ts + Kff * stages[2])
    return made


RECURSIONS = dict(zip(STOCK, (px4, ardupilot, betaflight), strict=True))


@pytest.fixture(scope="module", params=STOCK)
def case(request):
    """A set, setpoints and rates (N, 3) that begin at zero, and the torque of the documented law."""
    gains = stock_gains(request.param)
    signals = np.random.default_rng(0).normal(size=(2, SAMPLES, 3))
    signals[:, :1] = 0.0
    recursion = RECURSIONS[request.param]
    torque = [recursion(gains, axis, signals[0, :, axis], signals[1, :, axis]) for axis in range(3)]
    return gains, *signals, np.array(torque).T


def test_the_regressors_and_the_state_space_are_the_documented_law(case):
    gains, setpoint, rate, torque = case
    signals = {ERROR: setpoint - rate, RATE: rate, SETPOINT: setpoint}
    for axis in range(3):
        matrices = dict(zip("PIDF", (np.array([[value]]) for value in terms(gains, axis)), strict=True))
        filters, one = gains.filters.on(slice(axis, axis + 1)), {n: s[:, [axis]] for n, s in signals.items()}
        x = regressors("PIDF", one[ERROR], one[RATE], one[SETPOINT], filters)
        tuned = x @ np.concatenate([matrices[letter][0] for letter in "PIDF"])
        if filters.stock.derivative_feedforward[0]:
            x = regressors("G", one[ERROR], one[RATE], one[SETPOINT], filters)
            tuned += x[:, 0] * filters.stock.derivative_feedforward[0]
        assert tuned == pytest.approx(torque[:, axis], abs=1e-9)
    law, made = state_space(rate_matrices(gains), gains.filters), []
    w = np.zeros(len(law.A))
    for k in range(SAMPLES):
        now = {name: signal[k, :2] for name, signal in signals.items()}
        made.append(law.C @ w + sum(law.D[name] @ value for name, value in now.items()))
        w = law.A @ w + sum(law.B[name] @ value for name, value in now.items())
    assert np.array(made) == pytest.approx(torque[:, :2], abs=1e-9)


@pytest.mark.parametrize("controller", STOCK)
def test_the_response_of_all_axes_is_that_of_the_documented_law(controller):
    """By the recursions' answers to a sine of 300 periods, of which the first 200 are for their transient."""
    gains, periods = stock_gains(controller), 300
    recursion = RECURSIONS[controller]
    for samples in (20, 80):  # a period of the sine
        omega = 2 * np.pi / samples / gains.Ts
        law = response(gains, np.array([omega]))[0]
        k = np.arange(periods * samples)
        sine, still = np.sin(2 * np.pi * k / samples), np.zeros(len(k))
        used = slice(200 * samples, None)

        def phasor(signal, used=used, k=k, samples=samples):
            # Without the offset that the integral keeps from the start of the sine.
            return 2j * np.mean(signal[used] * np.exp(-2j * np.pi * k[used] / samples))

        for axis in range(3):
            of_setpoint = phasor(np.array(recursion(gains, axis, sine, still)))
            of_rate = phasor(np.array(recursion(gains, axis, still, sine)))
            Kp_o = gains.yaw.Kp_o if axis == 2 else gains.Kp_o[axis, axis]
            assert law[3 + axis, 6 + axis] == pytest.approx(of_rate, rel=1e-6)
            # A rate setpoint acts one period after the attitude that it is made of, but for Betaflight.
            delay = 1.0 if controller == "betaflight" else np.exp(-1j * omega * gains.Ts)
            late = Kp_o * of_setpoint * delay
            assert law[3 + axis, 3 + axis] == pytest.approx(-late, rel=1e-6)
            if any(gains.filters.shaping):  # ArduPilot: so does the rate at which the setpoint moves on
                late += of_setpoint * (1 / delay - 1) / gains.Ts * delay
            assert law[3 + axis, axis] == pytest.approx(late, rel=1e-6)


def shaped(given, T, Ts):
    """ArduCopter's attitude_command_model, below its limits: the setpoint (N,) and the rate that is fed forward."""
    angle = speed = acceleration = 0.0
    angles, rates = [], []
    for wanted in given:
        angle += speed * Ts  # update_attitude_target
        asked = (wanted - angle) / T - speed  # the square root controller, and the closing rate behind k_v
        acceleration = (asked - speed) / T
        speed += acceleration * Ts
        angles.append(angle)
        rates.append(speed)
    return np.array(angles), np.array(rates)


def test_the_shaping_is_that_of_arducopters_recursion():
    gains = stock_gains("ardupilot-stock")
    T, Ts, samples = gains.filters.shaping[0], gains.Ts, 800
    omega = 2 * np.pi / samples / Ts
    k = np.arange(20 * samples)
    angles, rates = shaped(np.sin(2 * np.pi * k / samples), T, Ts)
    used = slice(10 * samples, None)
    found, moving = (2j * np.mean(s[used] * np.exp(-2j * np.pi * k[used] / samples)) for s in (angles, rates))
    # Continuous against discrete: about a period of delay in two seconds.
    assert shaping_response(gains.filters, np.array([omega]))[0] == pytest.approx(found, abs=0.02)
    # What is fed forward is the setpoint's own difference, a period ahead.
    late = setpoint_rate_response(gains.filters, 1, np.array([omega]))[0, 0, 0] * np.exp(1j * omega * Ts)
    assert late * found == pytest.approx(moving, rel=1e-6)


def test_our_law_in_arducopter_has_its_feed_forward_also():
    gains = stock_gains("ardupilot-stock").for_our_law()
    assert gains.filters.shaping == stock_gains("ardupilot-stock").filters.shaping
    omega = np.array([0.5, 5.0])
    without = dataclasses.replace(gains, filters=dataclasses.replace(gains.filters, shaping_s=0.0))
    more = response(gains, omega) - response(without, omega)
    difference = (1 - np.exp(-1j * omega * gains.Ts)) / gains.Ts
    assert more[:, :3, :3] == pytest.approx(difference[:, None, None] * np.eye(3), rel=1e-9)
    assert not more[:, :, 3:].any()
    # With model following the model makes the rates of roll and pitch.
    following = {"model_omega": 8.0, "shaping_s": 0.15}
    model = dataclasses.replace(gains, filters=dataclasses.replace(gains.filters, **following))
    without = dataclasses.replace(model, filters=dataclasses.replace(model.filters, shaping_s=0.0))
    more = response(model, omega) - response(without, omega)
    assert more[:, 2, 2] == pytest.approx(difference, rel=1e-9) and not more[:, :2].any()


def test_a_file_without_the_shaping_has_none_and_keeps_its_certificate():
    gains = stock_gains("ardupilot-stock")
    none = dataclasses.replace(
        gains,
        filters=gains.filters.stock
        and dataclasses.replace(
            gains.filters, stock=dataclasses.replace(gains.filters.stock, shaping_s=(0.0, 0.0, 0.0))
        ),
    )
    text = gains_to_toml(none)
    line = next(line for line in text.splitlines() if line.startswith("shaping_s"))
    assert gains_from_toml(text.replace(line + "\n", ""), "x").filters == none.filters


@pytest.mark.parametrize("controller", STOCK)
def test_a_file_says_for_which_controller_it_is_and_comes_back_the_same(controller):
    gains = stock_gains(controller)
    text = gains_to_toml(gains)
    assert f'controller = "{controller}"' in text
    assert gains_to_toml(gains_from_toml(text, "x")) == text
    assert gains_from_toml(text, "x").filters == gains.filters
    for line, message in (
        ('controller = "inav"', "x: controller: got 'inav', expected one of mimo, px4-stock"),
        ('controller = "mimo"', "x: filters: unknown entry"),
    ):
        with pytest.raises(TuningError, match=message):
            gains_from_toml(text.replace(f'controller = "{controller}"', line), "x")
    first = next(line for line in text.splitlines() if line.startswith("derivative_hz"))
    with pytest.raises(TuningError, match=r"filters\.derivative_hz: missing"):
        gains_from_toml(text.replace(first, ""), "x")
    with pytest.raises(TuningError, match=r"filters\.derivative_hz \(pitch\): got -1.0, expected at least 0"):
        gains_from_toml(text.replace(first, "derivative_hz = [1.0, -1.0, 2.0]"), "x")
    with pytest.raises(TuningError, match=r"filters\.notch_hz: unknown entry; known: derivative_hz"):
        gains_from_toml(text.replace(first, f"{first}\nnotch_hz = [1.0, 1.0, 1.0]"), "x")


@pytest.mark.parametrize("controller", STOCK)
def test_a_stock_set_holds_nothing_that_its_controller_lacks(controller):
    gains = stock_gains(controller)
    with pytest.raises(TuningError, match=rf"Kp_i: got off-diagonal gains \[0.01, 0.0\].*{controller}.*is diagonal"):
        dataclasses.replace(gains, Kp_i=np.array([[0.1, 0.01], [0.0, 0.1]]))
    with pytest.raises(TuningError, match=f"model_omega: got 9.0, but the {controller} controller has none"):
        dataclasses.replace(gains, filters=dataclasses.replace(gains.filters, model_omega=9.0))
    with pytest.raises(TuningError, match=f"controller: the gains are for {controller}, expected mimo"):
        render(gains, "native")
    assert gains.for_our_law().elements()["D_POLE"] == pytest.approx(
        math.exp(-2 * math.pi * gains.filters.stock.derivative_hz[0] * gains.Ts)
    )


def test_another_unit_of_torque_leaves_the_torque_as_it_was():
    gains = stock_gains("ardupilot-stock")
    twice = gains.with_moment_scale(tuple(2 * value for value in gains.moment_scale))
    omega = np.array([20.0])
    assert 2 * response(twice, omega)[:, 3:, :9] == pytest.approx(response(gains, omega)[:, 3:, :9])
