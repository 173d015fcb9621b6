"""Flight modes of the emitted PX4 module beside PX4's own rules, computed here a second time in double precision.

The rules are those of mc_att_control and mc_rate_control of PX4 v1.16.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mimopilot.codegen.layout import INPUT
from mimopilot.codegen.native import NativeController, load_native
from tests.codegen.px4_host import PX4_PARAMETERS, drive

PERIOD = 0.004  # s
HOLD, ACRO, OFFBOARD, STABILIZED = 4, 10, 14, 15
LEVEL = "attitude 1 0 0 0 0 1 0 0 0"
START = ["gyro 0 0 0 0", "start", LEVEL, "land 0 0"]
BY_STICKS = f"mode 1 1 0 1 {STABILIZED}"
BY_RATE_STICKS = f"mode 1 1 0 0 {ACRO}"
BY_RATES = f"mode 1 0 0 0 {OFFBOARD} 1"
LEVEL_SETPOINT = "setpoint 1 0 0 0 0 0 0 -0.5"
TILTED = "setpoint 0.995 0.0998749 0 0 0 0 0 -0.5"
STEP = "gyro 4000 0 0 0"
SPOOL_UP = [STEP] * 1100  # 1 s without thrust, then 2 s to full thrust, and the bottom's 1.6 s


def text(*values):
    """Numbers as text that the host program reads back with the same bits."""
    return " ".join("nan" if np.isnan(v) else float(np.float32(v)).hex() for v in values)


def parameters(changed):
    return [f"param {name} {text(value)}" for name, value in changed.items()]


def heading(angle):
    return f"attitude {text(np.cos(angle / 2), 0, 0, np.sin(angle / 2))} 0 1 0 0 0"


def by_sticks(program, *commands, **changed):
    """The last samples of a flight in Stabilized mode, after the motors have spooled up in the air."""
    prepared = [*parameters(changed), *START, BY_STICKS, "sticks 1 0 0 0 0", *SPOOL_UP]
    count = sum(command.startswith("gyro") for command in commands)
    return drive(program, [*prepared, *commands]).out[-count:]


def wrap(angle):
    return np.mod(angle + np.pi, 2 * np.pi) - np.pi


def expo(x, share):
    return (1 - share) * x + share * x**3


class Stock:
    """Stabilized mode of mc_att_control."""

    def __init__(self, **changed):
        self.p = {**PX4_PARAMETERS, **changed}
        self.tilt = np.zeros(2)
        self.rate = 0.0
        self.held = None
        self.mean_error = None
        self.error_reference = self.correction = 0.0
        self.converging = False
        self.minimum = self.maximum = 0.0
        self.hover = self.p["MPC_THR_HOVER"]
        self.estimate = None

    def alpha(self, name):
        return PERIOD / (self.p[name] + PERIOD)

    def ramps(self, landed, spooled_up):
        def slew(value, target, rate):
            return value + np.clip(target - value, -rate * PERIOD, rate * PERIOD)

        self.minimum = slew(self.minimum, 0.0 if landed else self.p["MPC_MANTHR_MIN"], 0.05)
        self.maximum = slew(self.maximum, 1.0, 0.5) if spooled_up else 0.0
        if self.estimate is not None:
            self.hover = slew(self.hover, self.estimate, 0.05)

    def hover_message(self, valid, thrust):
        self.estimate = np.clip(thrust, 0.05, 0.9) if valid else self.p["MPC_THR_HOVER"]

    def thrust(self, throttle):
        ends = self.minimum, self.p["MPC_THR_MAX"]
        curve = self.p["MPC_THR_CURVE"]
        middle = {1: np.mean(ends), 2: self.p["MPC_THR_HOVER"]}.get(curve, self.hover)
        return min(np.interp(throttle, [-1, 0, 1], [ends[0], middle, ends[1]]), self.maximum)

    def converge(self, psi, unaided):
        before, self.correction = self.correction, 0.0
        if not np.isnan(unaided):
            error = wrap(psi - unaided)
            mean = error if self.mean_error is None else self.mean_error
            self.mean_error = mean + PERIOD / (1 + PERIOD) * (error - mean)
            was, self.converging = self.converging, abs(wrap(error - mean)) > np.radians(1)
            if not self.converging:
                self.error_reference = error
                if was:
                    self.held = None
            self.correction = wrap(error - self.error_reference)
        return self.correction - before

    def setpoint(self, roll, pitch, yaw, throttle, psi, good, unaided):
        """q_d as a Rotation, and the yaw rate."""
        zone = self.p["MPC_HOLD_DZ"]
        stick = np.sign(yaw) * max(abs(yaw) - zone, 0) / (1 - zone)
        target = np.radians(self.p["MPC_MAN_Y_MAX"]) * expo(stick, self.p["MPC_YAW_EXPO"])
        if (throttle < -0.9 and self.p["MC_AIRMODE"] != 2) or not good:
            self.held = None
        change = self.converge(psi, unaided)
        self.rate += self.alpha("MPC_MAN_Y_TAU") * (target - self.rate)
        if abs(self.rate) > np.finfo(np.float32).eps:
            self.held = None
        elif self.held is None:
            self.held = psi
        else:
            self.held += change
        most = np.radians(self.p["MPC_MAN_TILT_MAX"])
        self.tilt = self.tilt + self.alpha("MC_MAN_TILT_TAU") * (most * np.array([roll, -pitch]) - self.tilt)
        vector = self.tilt * min(1, most / max(np.linalg.norm(self.tilt), 1e-12))
        towards = psi if self.held is None else self.held
        return Rotation.from_euler("z", towards) * Rotation.from_rotvec([*vector, 0]), self.rate


@pytest.mark.parametrize(
    "changed",
    [
        {},
        {"MC_MAN_TILT_TAU": 0.2, "MPC_THR_CURVE": 1, "MPC_MANTHR_MIN": 0.12, "MC_AIRMODE": 2},
        {"MPC_THR_CURVE": 2, "MPC_THR_HOVER": 0.35, "MPC_THR_MAX": 0.9, "MPC_MAN_TILT_MAX": 50.0},
        {"MPC_MAN_Y_TAU": 0.02, "MPC_YAW_EXPO": 0.0, "MPC_HOLD_DZ": 0.2, "MPC_MAN_Y_MAX": 90.0},
    ],
)
def test_a_random_flight_in_stabilized_mode_is_as_with_px4s_controller(program, changed):
    rng, stock = np.random.default_rng(11), Stock(**changed)
    commands = [*parameters(changed), "gyro 0 0 0 0", "start", LEVEL, BY_STICKS]
    expected, sticks, psi, landed, good, unaided, converging = [], np.zeros(4), 0.0, True, True, np.nan, 0
    for k in range(6000):
        if k % 250 == 0:
            sticks = np.float32(rng.uniform(-1, 1, 4)) * (rng.random(4) < [0.7, 0.7, 0.2, 0.7])
            sticks[3] = rng.choice([sticks[3], sticks[3], -1.0, 1.0])
            commands.append(f"sticks 1 {text(*sticks)}")
        if k % 10 == 0:
            psi = wrap(psi + rng.normal() * 0.01)
            commands.append(heading(psi))
        if k % 250 == 0:
            landed = k < 500 or rng.random() < 0.2
            commands.append(f"land {int(landed)} 1")  # "maybe landed" does not matter
        if k % 70 == 0:
            good = rng.random() < 0.9
            unaided = np.nan if k < 700 or rng.random() < 0.1 else wrap(psi + 3 + rng.normal() * 0.1)
            commands.append(f"heading {int(good)} {text(unaided)}")
        if k > 1200 and k % 90 == 0:
            valid, hover = rng.random() < 0.7, rng.uniform(0, 1)
            commands.append(f"hover {int(valid)} {text(hover)}")
            stock.hover_message(valid, hover)
        commands.append(STEP)
        converging += stock.converging and stock.held is not None
        stock.ramps(landed, (k + 1) * PERIOD > stock.p["COM_SPOOLUP_TIME"] + 1e-9)
        expected.append((*stock.setpoint(*sticks, psi, good, unaided), stock.thrust(sticks[3])))
    out = drive(program, commands).out[1:]  # it takes over with the second sample, and publishes with the third
    expected = expected[-len(out) :]
    assert len(out) == 5998
    turn = Rotation.from_quat(np.roll(out["q_d"], -1, axis=1)) * Rotation.concatenate([q for q, _, _ in expected]).inv()
    assert turn.magnitude().max() < 5e-6  # rad, single precision
    np.testing.assert_allclose(out["yaw_rate"][:, 0], [rate for _, rate, _ in expected], atol=2e-6)
    np.testing.assert_allclose(-out["thrust"][:, 2], [thrust for _, _, thrust in expected], atol=2e-5)
    assert (out["thrust"][:, :2] == 0).all()
    assert converging > 100


def test_the_thrust_is_ramped_from_zero_after_the_spool_up_time(program):
    commands = [*START, BY_STICKS, "sticks 1 0 0 0 1", *[STEP] * 1000]
    thrust = -drive(program, commands).out["thrust"][:, 2]
    assert (thrust[:248] == 0).all()
    np.testing.assert_allclose(thrust[250:], np.minimum(0.002 * np.arange(1, 750), 1.0), atol=3e-3)


def test_started_in_the_air_the_thrust_does_not_start_from_zero(program):
    before = [BY_STICKS, "land 0 0", "gyro 0 0 0 0", "gyro 2000000 0 0 0"]
    commands = [*before, *START[1:], "sticks 1 0 0 0 -0.5", STEP, STEP]
    assert -drive(program, commands).out["thrust"][-1, 2] == pytest.approx(0.5 * (0.08 + 0.5), abs=1e-6)


def test_a_heading_reset_shifts_the_held_heading(program):
    reset = heading(0.4).split()
    out = by_sticks(program, " ".join([*reset[:5], "1", *reset[1:5]]), STEP, STEP)
    np.testing.assert_allclose(out["q_d"][-1], [np.cos(0.2), 0, 0, np.sin(0.2)], atol=1e-6)


def test_sticks_that_are_nan_count_as_centred_and_as_no_throttle(program):
    out = by_sticks(program, "sticks 1 nan nan nan nan", STEP, STEP)
    np.testing.assert_allclose(out["q_d"][-1], [1, 0, 0, 0], atol=1e-6)
    assert -out["thrust"][-1, 2] == pytest.approx(0.08, abs=1e-6)


def test_leaving_the_mode_forgets_the_sticks(program):
    away = [f"mode 1 0 1 1 {HOLD}", "setpoint 1 0 0 0 0 0 0 -0.5", STEP, heading(1.0), "sticks 1 0 0 0 0", STEP]
    out = by_sticks(program, "sticks 1 1 0 1 0", *[STEP] * 100, *away, BY_STICKS, STEP, MC_MAN_TILT_TAU=0.5)
    np.testing.assert_allclose(out["q_d"][-1], [np.cos(0.5), 0, 0, np.sin(0.5)], atol=1e-6)
    assert out["yaw_rate"][-1] == 0


# Rate modes.


def super_expo(x, share, bend):
    return expo(x, share) * (1 - bend) / (1 - abs(x) * bend)


def rate_inputs(out, rates, wanted):
    inputs = np.zeros(len(out), INPUT)
    inputs["rate_mode"] = inputs["armed"] = 1
    inputs["rates"], inputs["rates_setpoint"] = rates, wanted
    return inputs


def assert_flown(gains, out, rates):
    """Torques and rate setpoints are those of the rate controller alone, bit for bit."""
    controller = NativeController(load_native(gains), gains)
    rest = rate_inputs(out[:1], 0, 0)
    rest["armed"] = 0  # PX4's own controllers fly
    controller.run(rest)
    expected = controller.run(rate_inputs(out, rates, out["rates"]))
    assert out["torque"].tobytes() == np.ascontiguousarray(expected["moment"]).tobytes()


@pytest.mark.parametrize(
    "changed",
    [
        {},
        {"MC_ACRO_R_MAX": 360.0, "MC_ACRO_P_MAX": 250.0, "MC_ACRO_Y_MAX": 150.0, "MC_ACRO_EXPO": 0.69},
        {"MC_ACRO_EXPO_Y": 0.4, "MC_ACRO_SUPEXPO": 0.7, "MC_ACRO_SUPEXPOY": 0.99, "MC_ACRO_EXPO": 0.1},
    ],
)
def test_acro_flies_px4s_rates_with_the_rate_gains_alone(program, gains, changed):
    rng, p = np.random.default_rng(4), {**PX4_PARAMETERS, **changed}
    commands, wanted, thrusts, rates = [], [], [], []
    for k in range(400):
        if k % 5 == 0:
            sticks = np.float32(rng.uniform(-1, 1, 4)) * (rng.random(4) < 0.8)
            commands.append(f"sticks 1 {text(*sticks)}")
        rates.append(np.float32(rng.normal(size=3)))
        commands += [heading(rng.uniform(-3, 3)), f"gyro 4000 {text(*rates[-1])}"]
        roll, pitch, yaw, throttle = sticks.astype(float)
        curve = p["MC_ACRO_EXPO"], p["MC_ACRO_SUPEXPO"]
        unit = [super_expo(roll, *curve), super_expo(-pitch, *curve)]
        unit += [super_expo(yaw, p["MC_ACRO_EXPO_Y"], p["MC_ACRO_SUPEXPOY"])]
        wanted.append(np.radians([p["MC_ACRO_R_MAX"], p["MC_ACRO_P_MAX"], p["MC_ACRO_Y_MAX"]]) * unit)
        thrusts.append((throttle + 1) / 2)
    off = {**changed, "MC_YAW_TQ_CUTOFF": 0.0}
    out = drive(program, [*parameters(off), *START, BY_RATE_STICKS, STEP, *commands]).out
    assert len(out) == 400
    np.testing.assert_allclose(out["rates"], wanted, rtol=2e-6, atol=2e-6)
    np.testing.assert_allclose(-out["thrust"][:, 2], thrusts, atol=1e-6)
    assert_flown(gains, out, rates)


def off_board(program, *commands):
    hold = [*START, f"mode 1 0 1 1 {HOLD}", LEVEL_SETPOINT, STEP, TILTED, *[STEP] * 9]
    return drive(program, [*parameters({"MC_YAW_TQ_CUTOFF": 0.0}), *hold, BY_RATES, *commands])


def flown_before(controller, out):
    """The native controller after the attitude mode of `off_board`."""
    inputs = rate_inputs(out, 0, 0)
    inputs["rate_mode"] = 0
    inputs["attitude"], inputs["attitude_setpoint"] = out["attitude"], out["q_d"]
    controller.run(inputs)


def test_off_board_rates_are_flown_with_their_thrust(program, gains):
    rng, commands, rates, wanted = np.random.default_rng(6), [], [], []
    for k in range(200):
        if k % 4 == 0:
            wanted.append(np.float32(rng.normal(size=3)))
            commands.append(f"rates_setpoint {text(*wanted[-1], 0.1, -0.2, -0.3)}")
        rates.append(np.float32(rng.normal(size=3)))
        commands.append(f"gyro 4000 {text(*rates[-1])}")
    out = off_board(program, *commands).out[9:]
    assert len(out) == 200
    # It does not publish its own: the topic keeps the other program's.
    np.testing.assert_array_equal(out["rates"], np.repeat(wanted, 4, axis=0))
    assert (out["thrust"] == np.float32([0.1, -0.2, -0.3])).all()
    inputs = rate_inputs(out, rates, out["rates"])
    before = NativeController(load_native(gains), gains)
    level = np.zeros(10, INPUT)
    level["attitude"][:, 0] = level["attitude_setpoint"][:, 0] = 1
    level["armed"][1:] = 1
    level["attitude_setpoint"][1:] = np.float32([0.995, 0.0998749, 0, 0])
    before.run(level)
    assert out["torque"].tobytes() == np.ascontiguousarray(before.run(inputs)["moment"]).tobytes()


def test_its_own_last_rate_setpoint_is_not_taken_for_an_off_board_one(program, gains):
    out = off_board(program, *[STEP] * 60).out
    before, out = out[:-60], out[-60:]
    assert before["rates"][-1, 0] > 1
    controller = NativeController(load_native(gains), gains)
    flown_before(controller, before)
    expected = controller.run(rate_inputs(out, 0, 0))  # no rate until the first message
    assert out["torque"].tobytes() == np.ascontiguousarray(expected["moment"]).tobytes()
    assert (expected["fault"] == 0).all() and (np.abs(out["torque"]) < 0.02).all()
    arrived = off_board(program, *[STEP] * 60, "rates_setpoint 0 1 0 0 0 -0.4", STEP)
    assert arrived.out["torque"][-1, 1] > 0.1
    assert arrived.out["thrust"][-1, 2] == np.float32(-0.4)


def test_an_off_board_rate_that_is_nan_is_not_controlled(program):
    commands = ["rates_setpoint nan 0.5 nan nan nan -0.4", "gyro 4000 0.7 0.1 -0.3"]
    out = off_board(program, *commands).out[-1]
    assert np.isfinite(out["torque"]).all()
    plain = off_board(program, "rates_setpoint 0.7 0.5 -0.3 0 0 -0.4", commands[1]).out[-1]
    assert out["torque"].tobytes() == plain["torque"].tobytes()
    assert out["thrust"].tolist() == plain["thrust"].tolist()


def test_the_attitude_is_flown_again_after_a_rate_mode(program):
    back = [f"mode 1 0 1 1 {HOLD}", TILTED, STEP]
    result = off_board(program, "rates_setpoint 0 0 0 0 0 -0.5", *[STEP] * 50, *back)
    np.testing.assert_allclose(result.out["rates"][-1], result.out["rates"][8], atol=1e-6)


# Torque and thrust after the controller.


def flown(program, commands, **changed):
    """Rows of a flight in Hold, without and with `changed`, beside each other."""
    hold = [*START, f"mode 1 0 1 1 {HOLD}", "setpoint 1 0 0 0 0 0 0 -0.5"]
    plain = {"MC_YAW_TQ_CUTOFF": 0.0}
    return [drive(program, [*parameters({**plain, **extra}), *hold, *commands]) for extra in ({}, changed)]


def turning(count, seed=5):
    rates = np.random.default_rng(seed).normal(size=(count, 3)) * [0.5, 0.5, 1.0]
    return [f"gyro 4000 {text(*row)}" for row in rates]


@pytest.mark.parametrize("cutoff", [2.0, 10.0])
def test_the_yaw_torque_is_low_passed_as_in_px4(program, cutoff):
    before, after = (result.out["torque"] for result in flown(program, turning(300), MC_YAW_TQ_CUTOFF=cutoff))
    assert (before[:, :2] == after[:, :2]).all()
    state, share = 0.0, PERIOD / (PERIOD + 1 / (2 * np.pi * cutoff))
    for raw, filtered in zip(before[:, 2], after[:, 2], strict=True):
        state += share * (raw - state)
        assert filtered == pytest.approx(state, abs=1e-6)
    assert after[:, 2].std() < 0.5 * before[:, 2].std()


def test_torque_and_thrust_are_scaled_by_the_battery_if_enabled(program):
    messages = ["battery 1 1.3", *turning(50), "battery 0 5", *turning(50), "battery 1 -1", *turning(50)]
    before, after = flown(program, [*turning(50), *messages], MC_BAT_SCALE_EN=1)
    factor = np.where(np.arange(199) < 49, 1.0, 1.3)[:, None]  # unknown: as before; not connected: ignored
    for name in ("torque", "thrust"):
        np.testing.assert_allclose(after.out[name], np.clip(before.out[name] * factor, -1, 1), rtol=1e-6)
    (off, _) = flown(program, [*messages, *turning(50)])
    assert (off.out["thrust"][:, 2] == np.float32(-0.5)).all()


def test_the_power_of_the_torques_is_published_each_half_second(program):
    result, _ = flown(program, turning(1000))
    lines = [line.split()[1:] for line in result.other if line.startswith("power")]
    powers = [np.array([int(word, 16) for word in words], np.uint32).view(np.float32) for words in lines]
    time = np.add.accumulate(np.full(200, PERIOD, np.float32))
    count = int(np.argmax(time > 0.5)) + 1
    assert len(powers) == 999 // count
    squares = result.out["torque"][: count * len(powers)].astype(float) ** 2
    np.testing.assert_allclose(powers, squares.reshape(-1, count, 3).mean(axis=1), rtol=1e-4)
