"""Arming, flight modes and failsafes on a point mass with a floor: no sockets, no clock."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mimopilot.sitl.autopilot.autopilot import altitude_hold
from mimopilot.sitl.autopilot.failure_detector import MAX_TILT
from mimopilot.sitl.autopilot.flight_modes import Commander, Mode, Refused, Severity
from mimopilot.sitl.autopilot.setpoints import AttitudeSetpoint, Pose, Sticks
from mimopilot.sitl.autopilot.vertical import Estimate
from mimopilot.sitl.physics.rigid_body import GRAVITY

TS, HOVER = 0.004, 0.5


class PointMassVehicle:
    """A point mass whose attitude follows the demand with a time constant of 0.1 s; the floor is at altitude 100 m."""

    def __init__(self, altitude=100.0):
        self.vehicle = Commander(HOVER)
        self.estimate = Estimate(altitude=altitude)
        self.time = 50.0
        self.north = self.east = 0.0
        self.sources = []
        self.said = []
        self.highest = altitude
        self.collectives = []
        self.strength = 1.0

    def run(self, seconds):
        for _ in range(round(seconds / TS)):
            for source in self.sources:
                source()
            self.step()

    def step(self):
        e, v = self.estimate, self.vehicle
        demand = v.step(self.time, Estimate(e.roll, e.pitch, e.yaw, e.rates, e.altitude, e.climb, e.north, e.east))
        self.said += v.said
        v.said.clear()
        tilt = math.cos(e.roll) * math.cos(e.pitch)
        self.collective = altitude_hold(e.altitude, e.climb, demand.altitude, demand.collective, tilt)
        if math.isnan(demand.altitude):
            self.collective = demand.collective
        self.collectives.append(self.collective)
        self.demand = demand
        thrust = GRAVITY * self.strength * self.collective / HOVER
        e.climb += TS * (thrust * tilt - GRAVITY)
        e.north += TS * (-thrust * math.sin(e.pitch))
        e.east += TS * (thrust * math.sin(e.roll))
        e.altitude += TS * e.climb
        self.north += TS * e.north
        self.east += TS * e.east
        if e.altitude <= 100.0:
            e.altitude, e.climb = 100.0, max(e.climb, 0.0)
            e.north = e.east = 0.0
        e.roll += TS / 0.1 * (demand.setpoint.roll - e.roll)
        e.pitch += TS / 0.1 * (demand.setpoint.pitch - e.pitch)
        self.highest = max(self.highest, e.altitude)
        self.time += TS

    def texts(self):
        return [text for _, text in self.said]

    def fly(self, height=5.0):
        """Arm, take off and hold."""
        self.run(1.0)
        self.vehicle.arm()
        self.vehicle.take_off(height)
        self.run(height + 12.0)
        assert self.vehicle.mode is Mode.HOLD
        return self


@pytest.fixture
def simulated():
    return PointMassVehicle()


@pytest.fixture
def flying():
    return PointMassVehicle().fly()


def test_the_vehicle_arms_takes_off_to_the_height_holds_it_lands_and_disarms(simulated):
    simulated.run(1.0)
    simulated.vehicle.arm()
    simulated.vehicle.take_off(5.0)
    simulated.run(17.0)
    assert simulated.vehicle.mode is Mode.HOLD
    assert simulated.estimate.altitude == pytest.approx(105.0, abs=0.05)
    assert simulated.highest < 105.1
    simulated.vehicle.enter(Mode.LAND)
    simulated.run(3.0)
    assert simulated.vehicle.armed
    simulated.run(17.0)
    assert not simulated.vehicle.armed
    assert simulated.estimate.altitude == 100.0
    assert simulated.collective == 0.0
    assert simulated.texts() == ["armed", "mode take-off", "mode hold", "mode land", "disarmed: landed"]


def test_weak_motors_still_reach_the_take_off_height(simulated):
    simulated.strength = 0.9
    simulated.run(1.0)
    simulated.vehicle.arm()
    simulated.vehicle.take_off(5.0)
    simulated.run(60.0)
    # Without the trim it would stay a metre too low, where proportional action balances the missing tenth.
    assert simulated.vehicle.mode is Mode.HOLD
    assert simulated.estimate.altitude == pytest.approx(105.0, abs=0.05)
    assert simulated.vehicle.vertical.trim == pytest.approx(1 / 0.9 - 1, rel=0.05)
    simulated.vehicle.enter(Mode.LAND)
    simulated.run(20.0)
    assert not simulated.vehicle.armed


def test_the_rotors_stop_when_disarmed_and_spin_up_slowly_when_armed(simulated):
    simulated.run(2.0)
    assert max(simulated.collectives) == 0.0
    simulated.vehicle.arm()
    simulated.run(3.0)
    steps = [b - a for a, b in zip(simulated.collectives, simulated.collectives[1:], strict=False)]
    assert 0 < max(steps) <= HOVER * TS * 1.001
    assert simulated.collective == pytest.approx(0.2 * HOVER)
    assert simulated.estimate.altitude == 100.0


def test_climb_and_descent_stay_within_their_speed_limits(simulated):
    simulated.run(1.0)
    simulated.vehicle.arm()
    simulated.vehicle.take_off(10.0)
    speeds = []
    for _ in range(220):
        simulated.run(0.1)
        speeds.append(simulated.estimate.climb)
    assert 0.95 < max(speeds) < 1.1
    simulated.vehicle.enter(Mode.LAND)
    while simulated.vehicle.armed:
        simulated.run(0.1)
        speeds.append(simulated.estimate.climb)
        if simulated.estimate.altitude < 100.8:
            assert simulated.estimate.climb > -0.55
    assert -1.1 < min(speeds) < -0.95


def tilted(simulated):
    simulated.estimate.roll = math.radians(20)
    simulated.vehicle.step(simulated.time, simulated.estimate)


def rotating(simulated):
    simulated.estimate.rates = (0.0, 0.6, 0.0)
    simulated.vehicle.step(simulated.time, simulated.estimate)


def falling(simulated):
    simulated.estimate.altitude = 120.0
    simulated.run(0.2)


def without_plant(simulated):
    simulated.vehicle.arming_blockers["plant"] = "no plant is connected"


def offboard_without_setpoints(simulated):
    simulated.vehicle.mode = Mode.OFFBOARD


def sticks_timed_out(simulated):
    simulated.vehicle.mode = Mode.ALTITUDE


@pytest.mark.parametrize(
    ("state", "reason", "forced"),
    [
        (tilted, "not level: tilted by 20 degrees, expected at most 15", True),
        (rotating, "rotating faster than 0.5 rad/s", True),
        (falling, "not on the ground", True),
        (without_plant, "no plant is connected", False),
        (offboard_without_setpoints, "mode offboard, but no setpoints arrive", True),
        (sticks_timed_out, "mode altitude, but no setpoints arrive", True),
    ],
)
def test_arming_is_refused_with_a_reason_and_force_overrides_all_but_the_blockers(simulated, state, reason, forced):
    simulated.run(1.0)
    state(simulated)
    with pytest.raises(Refused, match=reason):
        simulated.vehicle.arm()
    assert not simulated.vehicle.armed
    if forced:
        simulated.vehicle.arm(force=True)
        assert simulated.vehicle.armed
    else:
        with pytest.raises(Refused, match=reason):
            simulated.vehicle.arm(force=True)


def test_a_vehicle_counts_as_landed_only_after_half_a_second_without_motion(simulated):
    simulated.step()
    with pytest.raises(Refused, match="not on the ground"):
        simulated.vehicle.arm()
    simulated.run(0.6)
    simulated.vehicle.arm()


def test_disarming_in_the_air_is_refused_unless_forced(flying):
    with pytest.raises(Refused, match="in the air"):
        flying.vehicle.disarm()
    assert flying.vehicle.armed
    flying.vehicle.disarm(force=True)
    flying.run(0.1)
    assert flying.collective == 0.0


@pytest.mark.parametrize(
    ("ask", "reason"),
    [
        (lambda v: v.take_off(5.0), "already in the air"),
        (lambda v: v.take_off(math.nan), "no take-off to nan m"),
        (lambda v: v.take_off(1000.0), "expected 0.5 to 100 m"),
        (lambda v: v.enter(Mode.OFFBOARD), "no setpoints arrive; send them first"),
        (lambda v: v.enter(Mode.ALTITUDE), "no setpoints arrive; send them first"),
        (lambda v: v.enter(Mode.TAKEOFF), "send the command NAV_TAKEOFF"),
    ],
)
def test_an_impossible_command_is_refused_and_changes_nothing(flying, ask, reason):
    with pytest.raises(Refused, match=reason):
        ask(flying.vehicle)
    assert (flying.vehicle.armed, flying.vehicle.mode) == (True, Mode.HOLD)


def test_take_off_and_landing_need_an_armed_vehicle(simulated):
    simulated.run(1.0)
    for ask in (lambda: simulated.vehicle.take_off(5.0), lambda: simulated.vehicle.enter(Mode.LAND)):
        with pytest.raises(Refused, match="not armed"):
            ask()


def offboard(simulated, *target):
    simulated.sources = [lambda: simulated.vehicle.attitude.put(AttitudeSetpoint(*target), simulated.time)]
    simulated.run(TS)
    simulated.vehicle.enter(Mode.OFFBOARD)


def test_an_offboard_attitude_is_flown_with_altitude_hold(flying):
    offboard(flying, 0.3, -0.2, 1.0, None)
    flying.run(1.0)
    assert flying.demand.setpoint[:3] == (0.3, -0.2, 1.0)
    assert flying.estimate.altitude == pytest.approx(105.0, abs=0.2)


def test_offboard_thrust_is_the_collective(flying):
    offboard(flying, 0.0, 0.0, 0.0, 0.55)
    flying.run(1.0)
    assert flying.collective == 0.55
    assert flying.estimate.climb == pytest.approx(0.1 * GRAVITY, rel=0.02)


def test_offboard_thrust_alone_takes_off_and_lands(simulated):
    simulated.run(1.0)
    offboard(simulated, 0.0, 0.0, 0.0, 0.0)
    simulated.vehicle.arm()
    offboard(simulated, 0.0, 0.0, 0.0, 0.51)
    simulated.run(4.0)
    assert not simulated.vehicle.vertical.landed
    assert simulated.estimate.altitude > 100.5
    offboard(simulated, 0.0, 0.0, 0.0, 0.2)
    simulated.run(4.0)
    assert simulated.vehicle.vertical.landed
    simulated.vehicle.disarm()
    assert not simulated.vehicle.armed


def test_after_a_setpoint_timeout_the_vehicle_levels_and_then_lands(flying):
    offboard(flying, 0.3, 0.0, 0.5, None)
    flying.run(1.0)
    flying.sources = []
    flying.run(0.49)
    assert flying.demand.setpoint.roll == 0.3
    flying.run(0.03)
    assert flying.demand.setpoint[:3] == (0.0, 0.0, 0.5)
    assert flying.vehicle.mode is Mode.OFFBOARD
    assert (Severity.CRITICAL, "no setpoints for 0.5 s: level") in flying.said
    flying.run(1.9)
    assert flying.estimate.altitude == pytest.approx(105.0, abs=0.3)
    flying.run(0.2)
    assert flying.vehicle.mode is Mode.LAND
    assert (Severity.CRITICAL, "no setpoints for 2.5 s: landing") in flying.said
    flying.run(20.0)
    assert not flying.vehicle.armed


def test_setpoints_that_return_before_landing_are_flown_again(flying):
    offboard(flying, 0.3, 0.0, 0.5, None)
    source, flying.sources = flying.sources, []
    flying.run(1.5)
    assert flying.demand.setpoint.roll == 0.0
    flying.sources = source
    flying.run(0.1)
    assert (flying.demand.setpoint.roll, flying.vehicle.mode) == (0.3, Mode.OFFBOARD)


def test_a_setpoint_timeout_on_the_ground_disarms_the_vehicle(simulated):
    simulated.run(1.0)
    offboard(simulated, 0.0, 0.0, 0.0, 0.0)
    simulated.vehicle.arm()
    simulated.sources = []
    simulated.run(3.0)
    assert not simulated.vehicle.armed


def test_sticks_command_tilt_heading_and_climb(flying):
    flying.sources = [lambda: flying.vehicle.sticks.put(Sticks(0.5, -1.0, 1.0, 0.5), flying.time)]
    flying.run(TS)
    flying.vehicle.enter(Mode.ALTITUDE)
    flying.run(1.0)
    assert math.degrees(flying.demand.setpoint.roll) == pytest.approx(17.5)
    assert math.degrees(flying.demand.setpoint.pitch) == pytest.approx(-35.0)
    assert flying.demand.setpoint.yaw == pytest.approx(1.5, abs=0.01)
    flying.run(3.0)
    assert flying.estimate.climb == pytest.approx(0.75, abs=0.1)
    flying.sources = []
    flying.run(25.0)
    assert not flying.vehicle.armed


def test_sticks_take_off_from_the_ground(simulated):
    simulated.sources = [lambda: simulated.vehicle.sticks.put(Sticks(0.0, 0.0, 0.0, 0.5), simulated.time)]
    simulated.run(1.0)
    simulated.vehicle.enter(Mode.ALTITUDE)
    simulated.vehicle.arm()
    simulated.run(5.0)
    assert not simulated.vehicle.vertical.landed
    assert simulated.estimate.altitude > 101.0


@pytest.mark.parametrize("heading", [0.0, 2.0])
def test_with_motion_capture_the_position_is_held(flying, heading):
    # The frame of the cameras is rotated from north by `heading`.
    c, s = math.cos(heading), math.sin(heading)

    def send_pose():
        x, y = c * flying.north + s * flying.east, c * flying.east - s * flying.north
        flying.vehicle.pose.put(Pose(x, y, -flying.estimate.altitude, -heading), flying.time)

    flying.sources = [send_pose]
    flying.run(1.0)
    held = (flying.north, flying.east)
    flying.estimate.north, flying.estimate.east = 0.5, -0.3  # a disturbance
    flying.run(10.0)
    assert (flying.north, flying.east) == pytest.approx(held, abs=0.05)
    flying.sources = []
    flying.run(0.6)
    assert flying.demand.setpoint[:2] == (0.0, 0.0)


def test_a_lost_vehicle_stops_its_rotors(flying):
    offboard(flying, MAX_TILT + 0.2, 0.0, 0.0, None)
    flying.run(2.0)
    assert not flying.vehicle.armed
    assert (Severity.EMERGENCY, "lost: tilted beyond 60 degrees, rotors stopped") in flying.said


def test_losing_the_plant_in_flight_disarms_and_blocks_arming_until_it_returns(flying):
    flying.vehicle.plant_lost("the plant went away")
    assert flying.vehicle.said == [(Severity.CRITICAL, "the plant went away, in flight")]
    assert not flying.vehicle.armed
    with pytest.raises(Refused, match="the plant went away"):
        flying.vehicle.arm(force=True)
    flying.vehicle.plant_back()
    flying.time, flying.estimate = 1.0, Estimate(altitude=100.0)  # another clock
    flying.run(1.0)
    flying.vehicle.arm()


def test_a_slow_begin_of_a_descent_is_not_taken_for_the_ground(flying):
    flying.vehicle.enter(Mode.LAND)
    for _ in range(2000):
        flying.step()
        if flying.estimate.altitude > 100.05:
            assert flying.vehicle.armed
            assert flying.collective > 0.8 * HOVER


ACTIONS = st.sampled_from(["arm", "disarm", "take off", "land", "hold", "offboard", "altitude", "setpoint", "stick"])


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(ACTIONS, st.floats(0.0, 3.0)), max_size=15))
def test_any_sequence_of_commands_gives_a_finite_demand(actions):
    simulated = PointMassVehicle()
    ask = {
        "arm": lambda v: v.arm(),
        "disarm": lambda v: v.disarm(),
        "take off": lambda v: v.take_off(2.0),
        "land": lambda v: v.enter(Mode.LAND),
        "hold": lambda v: v.enter(Mode.HOLD),
        "offboard": lambda v: v.enter(Mode.OFFBOARD),
        "altitude": lambda v: v.enter(Mode.ALTITUDE),
        "setpoint": lambda v: v.attitude.put(AttitudeSetpoint(0.2, 0.1, 1.0, 0.45), v.now),
        "stick": lambda v: v.sticks.put(Sticks(1.0, 1.0, 1.0, -1.0), v.now),
    }
    for action, seconds in actions:
        before = (simulated.vehicle.armed, simulated.vehicle.vertical.landed)
        try:
            ask[action](simulated.vehicle)
        except Refused:
            assert (simulated.vehicle.armed, simulated.vehicle.vertical.landed) == before
        if before == (True, False):
            assert simulated.vehicle.armed  # in the air only the loss of the vehicle stops the rotors
        for _ in range(round(seconds / TS)):
            simulated.step()
            assert 0 <= simulated.collective <= 1
            assert all(math.isfinite(value) for value in simulated.demand.setpoint[:3])
            assert simulated.vehicle.armed or simulated.collective == 0.0
