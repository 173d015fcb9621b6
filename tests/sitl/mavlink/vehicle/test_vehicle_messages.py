"""The vehicle's answers and telemetry, message by message, without sockets or clock."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.autopilot.autopilot import RECORD
from mimopilot.sitl.autopilot.flight_modes import Commander, Mode, Refused, Severity
from mimopilot.sitl.autopilot.setpoints import Pose
from mimopilot.sitl.autopilot.vertical import Estimate
from mimopilot.sitl.mavlink.simulator_api.plant_link import PlantState
from mimopilot.sitl.mavlink.vehicle.setpoint_messages import SetpointReceiver
from mimopilot.sitl.mavlink.vehicle.small_protocols import PROTOCOLS
from mimopilot.sitl.mavlink.vehicle.telemetry import Telemetry, texts
from mimopilot.sitl.mavlink.vehicle.telemetry_messages import TELEMETRY_MESSAGES
from mimopilot.sitl.mavlink.vehicle.vehicle_commands import VehicleCommands
from mimopilot.sitl.mavlink.vehicle.vehicle_state import VehicleState
from mimopilot.sitl.mavlink.wire.codec import Codec
from mimopilot.sitl.mavlink.wire.px4_modes import custom_mode

ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED = 0, 1, 2, 3
IGNORE_RATES, IGNORE_THRUST, IGNORE_ATTITUDE = 7, 64, 128


def received(message):
    """A message as it arrives: packed by a ground station, then parsed."""
    return next(Codec().parse(Codec(system=255, component=190).pack(message)))


class MessageFixture:
    """A vehicle on the ground with all its message handlers, without sockets."""

    def __init__(self):
        self.vehicle = Commander(0.5)
        self.state = VehicleState(self.vehicle)
        self.telemetry = Telemetry(self.state)
        self.rebooted = False
        self.commands = VehicleCommands(self.vehicle, self.telemetry, self.reboot)
        self.setpoints = SetpointReceiver(self.vehicle)
        self.wait_landed(1.0)

    def reboot(self):
        self.rebooted = True

    def wait_landed(self, seconds):
        begin = max(self.vehicle.now, 0.0)
        for k in range(1, round(seconds / 0.004) + 1):
            self.vehicle.step(begin + 0.004 * k, Estimate(altitude=100.0, yaw=0.5))

    def receive_plant_state(self):
        """Fill the state as after frames from the plant."""
        s = self.state
        s.stamp, s.home = 2_000_000, (473977420, 85455940, 90_000)
        still = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        s.plant = PlantState(2_000_000, *still, 473977510, 85455940, 100_000, 30, 40, -50, *[0] * 5)
        s.imu = (2_000_000, 0.0, 0.0, -9.80665, 0.1, 0.0, 0.0, 0.2, 0.0, 0.4, 1000.0, 0.0, 100.0, 20.0, 7167, 0)
        s.fix = (2_000_000, 473977511, 85455941, 100_100, 90, 150, 50, 30, 40, -50, 5313, 3, 12, 0, 0)
        row = np.zeros(1, RECORD)[0]
        row["attitude"], row["rates"], row["collective"] = (0.1, -0.2, 0.5), (1, 2, 3), 0.45
        row["commands"][:4] = 0.1, 0.2, 0.3, 1.0
        s.record = row
        self.vehicle.estimate = Estimate(0.1, -0.2, 0.5, (1.0, 2.0, 3.0), 100.0, 0.5, 0.3, 0.4)

    def long(self, number, *params):
        """Answers to COMMAND_LONG."""
        seven = [*params, *[0.0] * (7 - len(params))]
        return self.commands.execute(received(mavlink.MAVLink_command_long_message(1, 1, number, 0, *seven)))

    def result(self, number, *params):
        (ack, *_) = self.long(number, *params)
        assert (ack.get_type(), ack.command) == ("COMMAND_ACK", number)
        assert (ack.target_system, ack.target_component) == (255, 190)
        return ack.result

    def send_setpoint(self, message):
        """Handle a setpoint message; return the vehicle's texts."""
        self.vehicle.said.clear()
        assert self.setpoints.receive(received(message)) == []
        return [text for _, text in self.vehicle.said]

    def target(self, mask, q=(1, 0, 0, 0), rates=(0, 0, 0), thrust=0.5):
        return self.send_setpoint(mavlink.MAVLink_set_attitude_target_message(0, 1, 1, mask, list(q), *rates, thrust))


@pytest.fixture
def fixture():
    return MessageFixture()


def test_commands_arm_and_disarm_the_vehicle(fixture):
    assert fixture.result(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1) == ACCEPTED
    assert fixture.vehicle.armed
    assert fixture.result(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0) == ACCEPTED
    assert not fixture.vehicle.armed
    assert fixture.result(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 2) == DENIED
    assert fixture.result(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, math.nan) == DENIED


def test_a_temporary_refusal_states_its_reason(fixture):
    fixture.vehicle.arming_blockers["plant"] = "no plant is connected"
    fixture.vehicle.said.clear()
    assert fixture.result(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1) == TEMPORARILY_REJECTED
    assert fixture.vehicle.said == [(Severity.WARNING, "not armed: no plant is connected")]


def test_disarming_in_the_air_needs_the_force_number(fixture):
    fixture.vehicle.arm()
    fixture.vehicle.vertical.landed = False
    assert fixture.result(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 1) == TEMPORARILY_REJECTED
    assert fixture.vehicle.armed
    assert fixture.result(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 21196) == ACCEPTED
    assert not fixture.vehicle.armed


@pytest.mark.parametrize(
    ("message", "height"),
    [
        (mavlink.MAVLink_command_long_message(1, 1, 22, 0, 0, 0, 0, 0, 0, 0, 7), 7.0),
        (mavlink.MAVLink_command_long_message(1, 1, 22, 0, *[math.nan] * 7), 2.5),
        (mavlink.MAVLink_command_int_message(1, 1, 3, 22, 0, 0, 0, 0, 0, 0, 0, 0, 7), 7.0),  # above home
        (mavlink.MAVLink_command_int_message(1, 1, 0, 22, 0, 0, 0, 0, 0, 0, 0, 0, 107), 7.0),  # above the sea
    ],
)
def test_takeoff_climbs_to_the_height_above_the_ground(fixture, message, height):
    fixture.vehicle.arm()
    (ack,) = fixture.commands.execute(received(message))
    assert ack.result == ACCEPTED
    assert fixture.vehicle.mode is Mode.TAKEOFF
    assert fixture.vehicle._takeoff_altitude == pytest.approx(100 + height)


def test_a_takeoff_too_high_is_denied_and_one_unarmed_is_rejected_temporarily(fixture):
    assert fixture.result(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 5) == TEMPORARILY_REJECTED
    fixture.vehicle.arm()
    assert fixture.result(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 500) == DENIED


@pytest.mark.parametrize(
    ("params", "mode"),
    [((1, 4, 6), Mode.LAND), ((1, 4, 3), Mode.HOLD), ((1, 6, 0), Mode.OFFBOARD), ((1, 0x06040000, 0), Mode.LAND)],
)
def test_modes_can_be_set_as_mavsdk_and_as_mavproxy_do(fixture, params, mode):
    fixture.target(IGNORE_RATES)
    fixture.vehicle.arm()
    assert fixture.result(mavlink.MAV_CMD_DO_SET_MODE, *params) == ACCEPTED
    assert fixture.vehicle.mode is mode
    beat = fixture.telemetry.build(mavlink.MAVLINK_MSG_ID_HEARTBEAT)
    assert beat.custom_mode == custom_mode(mode)
    assert beat.base_mode & 128


@pytest.mark.parametrize("params", [(1, 5, 0), (1, 4, 4), (0, 4, 3), (1, math.nan, 0), (1, 4.5, 0), (1, 4, 2)])
def test_modes_that_do_not_exist_are_denied(fixture, params):
    assert fixture.result(mavlink.MAV_CMD_DO_SET_MODE, *params) == DENIED
    assert fixture.vehicle.mode is Mode.HOLD


def test_offboard_without_setpoints_is_rejected_temporarily(fixture):
    assert fixture.result(mavlink.MAV_CMD_DO_SET_MODE, 1, 6) == TEMPORARILY_REJECTED


def test_unknown_commands_are_unsupported(fixture):
    for number in (31000, 20, 16, 65535):
        assert fixture.result(number) == UNSUPPORTED


def test_reboot_is_refused_while_armed(fixture):
    fixture.vehicle.arm()
    assert fixture.result(mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1) == TEMPORARILY_REJECTED
    assert not fixture.rebooted
    fixture.vehicle.disarm()
    assert fixture.result(mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1) == ACCEPTED
    assert fixture.rebooted


def sent(fixture, seconds, begin=100.0):
    """Number of messages of each kind sent in this time, polled every ms."""
    counts = {}
    for k in range(round(seconds * 1000)):
        for message in fixture.telemetry.take_due(begin + k / 1000):
            counts[message.get_type()] = counts.get(message.get_type(), 0) + 1
    return counts


def test_messages_delayed_by_the_time_budget_are_sent_first_the_next_time(fixture):
    fixture.receive_plant_state()
    wanted = [message.get_type() for message in fixture.telemetry.take_due(100.0)]
    again = MessageFixture()
    again.receive_plant_state()
    one_by_one = [next(again.telemetry.take_due(100.0)).get_type() for _ in wanted]
    assert len(wanted) > 5
    assert sorted(one_by_one) == sorted(wanted)
    assert list(again.telemetry.take_due(100.0)) == []


def test_messages_are_sent_at_their_default_and_requested_rates(fixture):
    fixture.receive_plant_state()
    counts = sent(fixture, 10.0)
    assert counts["HEARTBEAT"] == 10
    assert counts["ATTITUDE"] == 200
    assert counts["LOCAL_POSITION_NED"] == 100
    assert "SCALED_IMU" not in counts
    assert fixture.result(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 30, 10_000) == ACCEPTED
    assert fixture.result(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 26, 100_000) == ACCEPTED
    assert fixture.result(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 32, -1) == ACCEPTED
    _, interval = fixture.long(mavlink.MAV_CMD_GET_MESSAGE_INTERVAL, 30)
    assert (interval.message_id, interval.interval_us) == (30, 10_000)
    assert fixture.long(mavlink.MAV_CMD_GET_MESSAGE_INTERVAL, 32)[1].interval_us == -1
    assert fixture.long(mavlink.MAV_CMD_GET_MESSAGE_INTERVAL, 9999)[1].interval_us == 0
    counts = sent(fixture, 2.0, begin=200.0)
    assert counts["ATTITUDE"] == 200
    assert counts["SCALED_IMU"] == 20
    assert "LOCAL_POSITION_NED" not in counts
    assert fixture.result(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 30, 0) == ACCEPTED
    assert fixture.telemetry.rates[30] == 20.0
    assert fixture.result(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 9999, 1000) == UNSUPPORTED
    for wrong in ((30, math.nan), (30, -7), (30, math.inf), (30, 3e38)):
        assert fixture.result(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, *wrong) == DENIED


def test_the_longest_interval_fits_its_message(fixture):
    assert fixture.result(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 30, 2e9) == ACCEPTED
    _, interval = fixture.long(mavlink.MAV_CMD_GET_MESSAGE_INTERVAL, 30)
    assert received(interval).interval_us == 2_000_000_000


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_every_message_can_be_packed_when_the_state_is_not_finite(fixture, value):
    fixture.receive_plant_state()
    state = fixture.telemetry.state
    for name in ("attitude", "quaternion", "rates", "collective", "commands", "moment"):
        state.record[name] = value
    state.vehicle.estimate = Estimate(value, value, value, (value,) * 3, 10.0, 0.0, 0.0, 0.0)
    for number in TELEMETRY_MESSAGES:
        assert received(fixture.telemetry.build(number)).get_msgId() == number


def test_no_rate_is_faster_than_the_control_loop(fixture):
    fixture.receive_plant_state()
    assert fixture.result(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 30, 1) == ACCEPTED
    assert sent(fixture, 1.0)["ATTITUDE"] <= 251


def test_a_data_stream_request_sets_the_rates_of_its_messages(fixture):
    fixture.receive_plant_state()
    fixture.telemetry.set_stream(mavlink.MAV_DATA_STREAM_ALL, 4.0)
    counts = sent(fixture, 5.0)
    assert counts["ATTITUDE"] == counts["VFR_HUD"] == counts["GPS_RAW_INT"] == 20
    assert counts["HEARTBEAT"] == 5
    fixture.telemetry.set_stream(mavlink.MAV_DATA_STREAM_EXTRA1, 0.0)
    counts = sent(fixture, 5.0, begin=200.0)
    assert "ATTITUDE" not in counts
    assert counts["VFR_HUD"] == 20


def test_before_the_first_plant_frame_only_status_messages_are_sent(fixture):
    assert set(sent(fixture, 3.0)) == {"HEARTBEAT", "SYS_STATUS", "BATTERY_STATUS"}
    assert fixture.result(mavlink.MAV_CMD_REQUEST_MESSAGE, 30) == TEMPORARILY_REJECTED


def test_every_message_can_be_requested_and_packed(fixture):
    fixture.receive_plant_state()
    for number in TELEMETRY_MESSAGES:
        ack, message = fixture.long(mavlink.MAV_CMD_REQUEST_MESSAGE, number)
        assert ack.result == ACCEPTED
        assert received(message).get_msgId() == number
    assert fixture.long(mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES)[1].capabilities & 8192
    # Ground stations probe for unsupported messages; the pilot gets no text.
    fixture.vehicle.said.clear()
    assert fixture.result(mavlink.MAV_CMD_REQUEST_MESSAGE, 435) == UNSUPPORTED
    assert fixture.vehicle.said == []


def test_telemetry_messages_hold_the_state_in_their_units(fixture):
    fixture.receive_plant_state()

    def shown(name):
        return received(fixture.telemetry.build(getattr(mavlink, f"MAVLINK_MSG_ID_{name}")))

    attitude = shown("ATTITUDE")
    assert (attitude.roll, attitude.pitch, attitude.yaw) == pytest.approx((0.1, -0.2, 0.5))
    assert (attitude.rollspeed, attitude.pitchspeed, attitude.yawspeed) == (1, 2, 3)
    assert attitude.time_boot_ms == 2000
    local = shown("LOCAL_POSITION_NED")
    assert (local.x, local.y, local.z) == pytest.approx((1.0019, 0.0, -10.0), abs=1e-3)
    assert (local.vx, local.vy, local.vz) == pytest.approx((0.3, 0.4, -0.5))
    place = shown("GLOBAL_POSITION_INT")
    assert (place.lat, place.alt, place.relative_alt, place.hdg) == (473977510, 100_000, 10_000, 2865)
    gps = shown("GPS_RAW_INT")
    assert (gps.fix_type, gps.lat, gps.vel, gps.cog, gps.satellites_visible) == (3, 473977511, 50, 5313, 12)
    hud = shown("VFR_HUD")
    assert (hud.groundspeed, hud.climb, hud.throttle, hud.heading) == (0.5, 0.5, 45, 28)
    assert shown("ALTITUDE").altitude_relative == pytest.approx(10.0)
    assert shown("HIGHRES_IMU").zacc == pytest.approx(-9.80665)
    assert (shown("SCALED_IMU").zacc, shown("SCALED_IMU").xgyro, shown("SCALED_IMU").zmag) == (-1000, 100, 400)
    servos = shown("SERVO_OUTPUT_RAW")
    assert [servos.servo1_raw, servos.servo2_raw, servos.servo4_raw] == [1100, 1200, 2000]
    assert shown("ATTITUDE_TARGET").thrust == pytest.approx(0.45)
    assert shown("EXTENDED_SYS_STATE").landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND


def test_the_geofence_is_always_healthy(fixture):
    """MAVProxy reports "fence breach" when its healthy bit is missing."""
    for obstacles in ({}, {"plant": "no plant is connected"}, {"rate": "the plant's period is wrong"}):
        fixture.vehicle.arming_blockers = obstacles
        status = fixture.telemetry.build(mavlink.MAVLINK_MSG_ID_SYS_STATUS)
        for field in ("present", "enabled", "health"):
            assert getattr(status, f"onboard_control_sensors_{field}") & mavlink.MAV_SYS_STATUS_GEOFENCE


def test_the_pre_arm_check_is_reported(fixture):
    def status():
        message = fixture.telemetry.build(mavlink.MAVLINK_MSG_ID_SYS_STATUS)
        return message.onboard_control_sensors_health & mavlink.MAV_SYS_STATUS_PREARM_CHECK

    assert status()
    fixture.vehicle.arming_blockers["plant"] = "no plant is connected"
    assert not status()
    beat = fixture.telemetry.build(mavlink.MAVLINK_MSG_ID_HEARTBEAT)
    assert beat.system_status == mavlink.MAV_STATE_BOOT
    del fixture.vehicle.arming_blockers["plant"]
    assert fixture.telemetry.build(0).system_status == mavlink.MAV_STATE_STANDBY
    fixture.vehicle.arm()
    assert fixture.telemetry.build(0).system_status == mavlink.MAV_STATE_ACTIVE


HALF = (math.cos(0.1), math.sin(0.1), 0, 0)  # roll 0.2 rad


def test_attitude_setpoints_follow_the_type_mask(fixture):
    assert fixture.target(IGNORE_RATES, HALF, thrust=0.4) == []
    value = fixture.vehicle.attitude.value
    assert (value.roll, value.pitch, value.yaw) == pytest.approx((0.2, 0, 0), abs=1e-6)
    assert value.thrust == pytest.approx(0.4)
    assert fixture.target(IGNORE_RATES | IGNORE_THRUST, HALF, thrust=math.nan) == []
    assert fixture.vehicle.attitude.value.thrust is None
    assert fixture.target(0, HALF) == []  # zero rates need not be ignored
    assert fixture.target(IGNORE_RATES, HALF, rates=(1, math.nan, 3)) == []


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ({"mask": IGNORE_RATES | IGNORE_ATTITUDE}, "expected an attitude, or all three body rates"),
        ({"mask": 1 | IGNORE_ATTITUDE}, "expected an attitude, or all three body rates"),
        ({"mask": 64 | IGNORE_ATTITUDE}, "body rates need a thrust"),
        ({"mask": IGNORE_RATES | 32}, "thrust along body axes is not supported"),
        ({"mask": 4, "rates": (0, 0.1, 0)}, "with an attitude only the yaw rate counts, add 3"),
        ({"mask": 0, "rates": (math.nan, 0, 0)}, "expected body rates of at most 100 rad/s"),
        ({"mask": IGNORE_ATTITUDE, "rates": (0, 0, 101.0)}, "expected body rates of at most 100 rad/s"),
        ({"mask": IGNORE_RATES, "q": (0, 0, 0, 0)}, "expected a quaternion"),
        ({"mask": IGNORE_RATES, "q": (math.nan, 0, 0, 0)}, "expected a quaternion"),
        ({"mask": IGNORE_RATES, "q": (math.cos(0.6), math.sin(0.6), 0, 0)}, "tilted by at most 60 degrees"),
        ({"mask": IGNORE_RATES, "thrust": 1.1}, "thrust 1.1, expected 0 to 1"),
        ({"mask": IGNORE_RATES, "thrust": math.nan}, "thrust nan"),
    ],
)
def test_implausible_setpoints_are_refused_with_the_reason(fixture, arguments, reason):
    (text,) = fixture.target(**arguments)
    assert reason in text
    assert not fixture.vehicle.attitude.fresh(fixture.vehicle.now)
    assert fixture.target(**arguments) == []  # reported once a second, not for every message
    fixture.wait_landed(1.1)
    assert len(fixture.target(**arguments)) == 1


def test_body_rates_and_the_yaw_rate_of_an_attitude_are_taken_over(fixture):
    assert fixture.target(mask=IGNORE_ATTITUDE, rates=(0.5, -0.25, 1.0), thrust=0.4) == []
    assert fixture.vehicle.attitude.value == pytest.approx((0.5, -0.25, 1.0, 0.4, 0.0, True))
    assert fixture.target(mask=3, rates=(0, 0, 0.75), thrust=0.4) == []
    assert fixture.vehicle.attitude.value[3:] == pytest.approx((0.4, 0.75, False))


def test_manual_control_sets_the_sticks(fixture):
    assert fixture.send_setpoint(mavlink.MAVLink_manual_control_message(1, 200, -400, 750, 1000, 0)) == []
    assert fixture.vehicle.sticks.value == pytest.approx((-0.4, -0.2, 1.0, 0.5))
    assert fixture.send_setpoint(mavlink.MAVLink_manual_control_message(1, 0, 0, 510, 0, 0)) == []
    assert fixture.vehicle.sticks.value.climb == 0.0  # the middle holds the altitude
    (text,) = fixture.send_setpoint(mavlink.MAVLink_manual_control_message(1, 32767, 0, 500, 0, 0))
    assert "sticks refused" in text
    assert fixture.vehicle.sticks.value.pitch == 0.0
    fixture.send_setpoint(mavlink.MAVLink_manual_control_message(7, 1000, 0, 500, 0, 0))  # another vehicle's
    assert fixture.vehicle.sticks.value.pitch == 0.0


def override(*channels):
    return mavlink.MAVLink_rc_channels_override_message(1, 1, *channels, *[65535] * 4)


def test_overridden_channels_set_the_sticks_until_released(fixture):
    assert fixture.send_setpoint(override(1600, 1400, 1750, 2000)) == []
    assert fixture.vehicle.sticks.value == pytest.approx((0.2, -0.2, 1.0, 0.5))
    fixture.wait_landed(1.0)
    assert fixture.send_setpoint(override(1500, 65535, 65535, 65535)) == []
    assert fixture.vehicle.sticks.value == pytest.approx((0.0, -0.2, 1.0, 0.5))
    fixture.wait_landed(1.0)
    fixture.send_setpoint(override(0, 65535, 65535, 65535))
    assert not fixture.vehicle.sticks.fresh(fixture.vehicle.now)
    (text,) = fixture.send_setpoint(override(1500, 1500, 1500, 7))
    assert "channels refused" in text


def test_implausible_and_old_motion_capture_poses_are_dropped(fixture):
    pose = fixture.vehicle.pose
    fixture.send_setpoint(mavlink.MAVLink_att_pos_mocap_message(1000, [math.cos(0.5), 0, 0, math.sin(0.5)], 1, 2, -3))
    assert pose.value == pytest.approx((1, 2, -3, 1.0), abs=1e-6)
    fixture.send_setpoint(mavlink.MAVLink_vision_position_estimate_message(2000, 4, 5, -6, 0.1, 0.1, -2.0))
    assert pose.value == pytest.approx((4, 5, -6, -2.0))
    for late in (1500, 2000):
        fixture.send_setpoint(mavlink.MAVLink_vision_position_estimate_message(late, 0, 0, 0, 0, 0, 0))
    assert pose.value.x == 4.0
    for wrong in (
        mavlink.MAVLink_att_pos_mocap_message(3000, [0, 0, 0, 0], 1, 2, -3),
        mavlink.MAVLink_att_pos_mocap_message(3000, [1, 0, 0, 0], math.nan, 2, -3),
        mavlink.MAVLink_vision_position_estimate_message(3000, 0, 1e7, 0, 0, 0, 0),
        mavlink.MAVLink_vision_position_estimate_message(3000, 0, 0, 0, 0, 0, math.inf),
    ):
        fixture.wait_landed(1.1)
        (text,) = fixture.send_setpoint(wrong)
        assert "pose refused" in text
    assert pose.value.x == 4.0
    # A camera system that restarts resets its time.
    fixture.send_setpoint(mavlink.MAVLink_vision_position_estimate_message(10, 7, 0, 0, 0, 0, 0))
    assert pose.value.x == 7.0


def test_telemetry_sends_the_motion_capture_position_while_it_is_fresh(fixture):
    fixture.receive_plant_state()
    fixture.vehicle.pose.put(Pose(5.0, 6.0, -7.0, 0.5 - math.pi / 2), fixture.vehicle.now)
    local = fixture.telemetry.build(mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED)
    assert (local.x, local.y, local.z) == (5.0, 6.0, -7.0)
    assert (local.vx, local.vy) == pytest.approx((0.4, -0.3))  # in the frame of the cameras
    status = fixture.telemetry.build(mavlink.MAVLINK_MSG_ID_SYS_STATUS)
    assert status.onboard_control_sensors_health & mavlink.MAV_SYS_STATUS_SENSOR_VISION_POSITION


def test_long_texts_are_sent_in_chunks_with_a_common_id():
    (short,) = texts(Severity.INFO, "armed", 7)
    assert (short.severity, short.text, short.id) == (6, "armed", 0)
    long = texts(Severity.CRITICAL, "x" * 120, 7)
    assert [(piece.id, piece.chunk_seq, len(piece.text)) for piece in long] == [(7, 0, 50), (7, 1, 50), (7, 2, 20)]


def answers(message):
    arrived = received(message)
    return PROTOCOLS[arrived.get_type()](arrived)


def test_small_protocols_answer_requests_and_ignore_answers():
    (count,) = answers(mavlink.MAVLink_mission_request_list_message(1, 1, 2))
    assert (count.count, count.mission_type, count.target_system) == (0, 2, 255)
    (ack,) = answers(mavlink.MAVLink_mission_count_message(1, 1, 3, 0))
    assert ack.type == mavlink.MAV_MISSION_UNSUPPORTED
    (time,) = answers(mavlink.MAVLink_timesync_message(0, 1234))
    assert (time.ts1, time.tc1 > 0) == (1234, True)
    assert answers(mavlink.MAVLink_timesync_message(5, 1234)) == []
    assert answers(mavlink.MAVLink_ping_message(1, 2, 0, 0))[0].seq == 2
    assert answers(mavlink.MAVLink_ping_message(1, 2, 1, 1)) == []


@settings(max_examples=300, deadline=None)
@given(st.integers(0, 65535), st.lists(st.floats(width=32), min_size=7, max_size=7))
def test_any_command_with_any_parameters_is_acknowledged(number, params):
    fixture = MessageFixture()
    (ack, *_) = fixture.long(number, *params)
    assert ack.result in (ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED)


@settings(max_examples=50, deadline=None)
@given(st.sampled_from([400, 22, 21, 176, 511, 510, 512, 246]), st.lists(st.floats(width=32), min_size=7, max_size=7))
def test_known_commands_with_any_parameters_are_acknowledged(number, params):
    fixture = MessageFixture()
    assert fixture.result(number, *params) in (ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED)


@settings(max_examples=100, deadline=None)
@given(st.floats(width=32))
def test_every_accepted_interval_can_be_reported_and_used(interval):
    fixture = MessageFixture()
    fixture.long(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 30, interval)
    assert received(fixture.long(mavlink.MAV_CMD_GET_MESSAGE_INTERVAL, 30)[1]).message_id == 30
    assert list(fixture.telemetry.take_due(100.0))


def test_handlers_can_be_added(fixture):
    def handler(command):
        if command.whole(1) == 7:
            raise Refused("not today")
        return []

    fixture.commands.handlers[31010] = handler
    assert fixture.result(31010, 1) == ACCEPTED
    assert fixture.result(31010, 7) == TEMPORARILY_REJECTED
