"""The vehicle's state machine on a point mass with a floor: no sockets, no clock."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mimopilot.sitl.autopilot.autopilot import altitude_hold
from mimopilot.sitl.autopilot.flight_modes import MAX_TILT, Mode, Refused, Severity, Vehicle
from mimopilot.sitl.autopilot.setpoints import Attitude, Pose, Sticks
from mimopilot.sitl.autopilot.vertical import Estimate
from mimopilot.sitl.physics.rigid_body import GRAVITY

TS, HOVER = 0.004, 0.5


class Bench:
    """A vehicle on a point mass whose attitude follows with 0.1 s; the floor is at altitude 100 m."""

    def __init__(self, altitude=100.0):
        self.vehicle = Vehicle(HOVER)
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
        lift = GRAVITY * self.strength * self.collective / HOVER
        e.climb += TS * (lift * tilt - GRAVITY)
        e.north += TS * (-lift * math.sin(e.pitch))
        e.east += TS * (lift * math.sin(e.roll))
        e.altitude += TS * e.climb
        self.north += TS * e.north
        self.east += TS * e.east
        if e.altitude <= 100.0:
            e.altitude, e.climb = 100.0, max(e.climb, 0.0)
            e.north = e.east = 0.0
        e.roll += TS / 0.1 * (demand.roll - e.roll)
        e.pitch += TS / 0.1 * (demand.pitch - e.pitch)
        self.highest = max(self.highest, e.altitude)
        self.time += TS

    def texts(self):
        return [text for _, text in self.said]

    def fly(self, height=5.0):
        """Armed, in the air, holding."""
        self.run(1.0)
        self.vehicle.arm()
        self.vehicle.take_off(height)
        self.run(height + 12.0)
        assert self.vehicle.mode is Mode.HOLD
        return self


@pytest.fixture
def bench():
    return Bench()


@pytest.fixture
def flying():
    return Bench().fly()


def test_it_arms_takes_off_to_the_height_holds_it_lands_and_disarms(bench):
    bench.run(1.0)
    bench.vehicle.arm()
    bench.vehicle.take_off(5.0)
    bench.run(17.0)
    assert bench.vehicle.mode is Mode.HOLD
    assert bench.estimate.altitude == pytest.approx(105.0, abs=0.05)
    assert bench.highest < 105.1
    bench.vehicle.enter(Mode.LAND)
    bench.run(3.0)
    assert bench.vehicle.armed
    bench.run(17.0)
    assert not bench.vehicle.armed
    assert bench.estimate.altitude == 100.0
    assert bench.collective == 0.0
    assert bench.texts() == ["armed", "mode take-off", "mode hold", "mode land", "disarmed: landed"]


def test_weak_motors_still_take_it_to_its_height(bench):
    bench.strength = 0.9
    bench.run(1.0)
    bench.vehicle.arm()
    bench.vehicle.take_off(5.0)
    bench.run(60.0)
    # Without learning it would hang a metre too low, where proportional action balances the missing tenth.
    assert bench.vehicle.mode is Mode.HOLD
    assert bench.estimate.altitude == pytest.approx(105.0, abs=0.05)
    assert bench.vehicle.lift.trim == pytest.approx(1 / 0.9 - 1, rel=0.05)
    bench.vehicle.enter(Mode.LAND)
    bench.run(20.0)
    assert not bench.vehicle.armed


def test_the_rotors_stand_when_disarmed_and_spin_up_gently_when_armed(bench):
    bench.run(2.0)
    assert max(bench.collectives) == 0.0
    bench.vehicle.arm()
    bench.run(3.0)
    steps = [b - a for a, b in zip(bench.collectives, bench.collectives[1:], strict=False)]
    assert 0 < max(steps) <= HOVER * TS * 1.001
    assert bench.collective == pytest.approx(0.2 * HOVER)
    assert bench.estimate.altitude == 100.0


def test_it_climbs_and_sinks_no_faster_than_it_may(bench):
    bench.run(1.0)
    bench.vehicle.arm()
    bench.vehicle.take_off(10.0)
    speeds = []
    for _ in range(220):
        bench.run(0.1)
        speeds.append(bench.estimate.climb)
    assert 0.95 < max(speeds) < 1.1
    bench.vehicle.enter(Mode.LAND)
    while bench.vehicle.armed:
        bench.run(0.1)
        speeds.append(bench.estimate.climb)
        if bench.estimate.altitude < 100.8:
            assert bench.estimate.climb > -0.55
    assert -1.1 < min(speeds) < -0.95


def tilted(bench):
    bench.estimate.roll = math.radians(20)
    bench.vehicle.step(bench.time, bench.estimate)


def turning(bench):
    bench.estimate.rates = (0.0, 0.6, 0.0)
    bench.vehicle.step(bench.time, bench.estimate)


def falling(bench):
    bench.estimate.altitude = 120.0
    bench.run(0.2)


def without_plant(bench):
    bench.vehicle.obstacles["plant"] = "no plant is connected"


def offboard_without_setpoints(bench):
    bench.vehicle.mode = Mode.OFFBOARD


def sticks_let_go(bench):
    bench.vehicle.mode = Mode.ALTITUDE


@pytest.mark.parametrize(
    ("state", "reason", "forced"),
    [
        (tilted, "not level: tilted by 20 degrees, at most 15", True),
        (turning, "it turns", True),
        (falling, "not on the ground", True),
        (without_plant, "no plant is connected", False),
        (offboard_without_setpoints, "mode offboard, but no set-points arrive", True),
        (sticks_let_go, "mode altitude, but no set-points arrive", True),
    ],
)
def test_arming_is_refused_with_the_reason_and_force_overrides_what_is_not_fundamental(bench, state, reason, forced):
    bench.run(1.0)
    state(bench)
    with pytest.raises(Refused, match=reason):
        bench.vehicle.arm()
    assert not bench.vehicle.armed
    if forced:
        bench.vehicle.arm(force=True)
        assert bench.vehicle.armed
    else:
        with pytest.raises(Refused, match=reason):
            bench.vehicle.arm(force=True)


def test_a_vehicle_that_has_just_appeared_is_not_known_to_stand(bench):
    bench.step()
    with pytest.raises(Refused, match="not on the ground"):
        bench.vehicle.arm()
    bench.run(0.6)
    bench.vehicle.arm()


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
        (lambda v: v.take_off(5.0), "in the air already"),
        (lambda v: v.take_off(math.nan), "no take-off to nan m"),
        (lambda v: v.take_off(1000.0), "expected 0.5 to 100 m"),
        (lambda v: v.enter(Mode.OFFBOARD), "no set-points arrive, send them first"),
        (lambda v: v.enter(Mode.ALTITUDE), "no set-points arrive, send them first"),
        (lambda v: v.enter(Mode.TAKEOFF), "is a command"),
    ],
)
def test_what_cannot_be_flown_is_refused_and_changes_nothing(flying, ask, reason):
    with pytest.raises(Refused, match=reason):
        ask(flying.vehicle)
    assert (flying.vehicle.armed, flying.vehicle.mode) == (True, Mode.HOLD)


def test_take_off_and_landing_need_an_armed_vehicle(bench):
    bench.run(1.0)
    for ask in (lambda: bench.vehicle.take_off(5.0), lambda: bench.vehicle.enter(Mode.LAND)):
        with pytest.raises(Refused, match="not armed"):
            ask()


def offboard(bench, *target):
    bench.sources = [lambda: bench.vehicle.attitude.put(Attitude(*target), bench.time)]
    bench.run(TS)
    bench.vehicle.enter(Mode.OFFBOARD)


def test_offboard_attitude_is_flown_and_the_altitude_held(flying):
    offboard(flying, 0.3, -0.2, 1.0, None)
    flying.run(1.0)
    assert flying.demand[:3] == (0.3, -0.2, 1.0)
    assert flying.estimate.altitude == pytest.approx(105.0, abs=0.2)


def test_offboard_thrust_is_the_collective(flying):
    offboard(flying, 0.0, 0.0, 0.0, 0.55)
    flying.run(1.0)
    assert flying.collective == 0.55
    assert flying.estimate.climb == pytest.approx(0.1 * GRAVITY, rel=0.02)


def test_offboard_thrust_alone_takes_off_and_lands(bench):
    bench.run(1.0)
    offboard(bench, 0.0, 0.0, 0.0, 0.0)
    bench.vehicle.arm()
    offboard(bench, 0.0, 0.0, 0.0, 0.51)
    bench.run(4.0)
    assert not bench.vehicle.lift.landed
    assert bench.estimate.altitude > 100.5
    offboard(bench, 0.0, 0.0, 0.0, 0.2)
    bench.run(4.0)
    assert bench.vehicle.lift.landed
    bench.vehicle.disarm()
    assert not bench.vehicle.armed


def test_stale_setpoints_level_the_vehicle_and_then_land_it(flying):
    offboard(flying, 0.3, 0.0, 0.5, None)
    flying.run(1.0)
    flying.sources = []
    flying.run(0.49)
    assert flying.demand.roll == 0.3
    flying.run(0.03)
    assert flying.demand[:3] == (0.0, 0.0, 0.5)
    assert flying.vehicle.mode is Mode.OFFBOARD
    assert (Severity.CRITICAL, "no set-points for 0.5 s: level") in flying.said
    flying.run(1.9)
    assert flying.estimate.altitude == pytest.approx(105.0, abs=0.3)
    flying.run(0.2)
    assert flying.vehicle.mode is Mode.LAND
    assert (Severity.CRITICAL, "no set-points for 2.5 s: landing") in flying.said
    flying.run(20.0)
    assert not flying.vehicle.armed


def test_setpoints_that_return_while_it_is_level_are_flown_again(flying):
    offboard(flying, 0.3, 0.0, 0.5, None)
    source, flying.sources = flying.sources, []
    flying.run(1.5)
    assert flying.demand.roll == 0.0
    flying.sources = source
    flying.run(0.1)
    assert (flying.demand.roll, flying.vehicle.mode) == (0.3, Mode.OFFBOARD)


def test_stale_setpoints_on_the_ground_end_in_a_disarmed_vehicle(bench):
    bench.run(1.0)
    offboard(bench, 0.0, 0.0, 0.0, 0.0)
    bench.vehicle.arm()
    bench.sources = []
    bench.run(3.0)
    assert not bench.vehicle.armed


def test_sticks_steer_tilt_heading_and_climb(flying):
    flying.sources = [lambda: flying.vehicle.sticks.put(Sticks(0.5, -1.0, 1.0, 0.5), flying.time)]
    flying.run(TS)
    flying.vehicle.enter(Mode.ALTITUDE)
    flying.run(1.0)
    assert math.degrees(flying.demand.roll) == pytest.approx(17.5)
    assert math.degrees(flying.demand.pitch) == pytest.approx(-35.0)
    assert flying.demand.yaw == pytest.approx(1.5, abs=0.01)
    flying.run(3.0)
    assert flying.estimate.climb == pytest.approx(0.75, abs=0.1)
    flying.sources = []
    flying.run(25.0)
    assert not flying.vehicle.armed


def test_sticks_lift_it_from_the_ground(bench):
    bench.sources = [lambda: bench.vehicle.sticks.put(Sticks(0.0, 0.0, 0.0, 0.5), bench.time)]
    bench.run(1.0)
    bench.vehicle.enter(Mode.ALTITUDE)
    bench.vehicle.arm()
    bench.run(5.0)
    assert not bench.vehicle.lift.landed
    assert bench.estimate.altitude > 101.0


@pytest.mark.parametrize("heading", [0.0, 2.0])
def test_with_motion_capture_it_stays_where_it_is(flying, heading):
    # The frame of the cameras is turned against north by `heading`.
    c, s = math.cos(heading), math.sin(heading)

    def see():
        x, y = c * flying.north + s * flying.east, c * flying.east - s * flying.north
        flying.vehicle.pose.put(Pose(x, y, -flying.estimate.altitude, -heading), flying.time)

    flying.sources = [see]
    flying.run(1.0)
    place = (flying.north, flying.east)
    flying.estimate.north, flying.estimate.east = 0.5, -0.3  # a push
    flying.run(10.0)
    assert (flying.north, flying.east) == pytest.approx(place, abs=0.05)
    flying.sources = []
    flying.run(0.6)
    assert flying.demand[:2] == (0.0, 0.0)


def test_a_vehicle_that_is_lost_stops_its_rotors(flying):
    offboard(flying, MAX_TILT + 0.2, 0.0, 0.0, None)
    flying.run(2.0)
    assert not flying.vehicle.armed
    assert (Severity.EMERGENCY, "lost: tilted too far for too long, rotors stopped") in flying.said


def test_a_plant_that_is_lost_in_flight_disarms_and_blocks_until_it_is_back(flying):
    flying.vehicle.plant_lost("the plant went away")
    assert flying.vehicle.said == [(Severity.CRITICAL, "the plant went away, in flight")]
    assert not flying.vehicle.armed
    with pytest.raises(Refused, match="the plant went away"):
        flying.vehicle.arm(force=True)
    flying.vehicle.plant_back()
    flying.time, flying.estimate = 1.0, Estimate(altitude=100.0)  # another clock
    flying.run(1.0)
    flying.vehicle.arm()


def test_a_descent_that_is_slow_to_begin_is_no_ground(flying):
    flying.vehicle.enter(Mode.LAND)
    for _ in range(2000):
        flying.step()
        if flying.estimate.altitude > 100.05:
            assert flying.vehicle.armed
            assert flying.collective > 0.8 * HOVER


ACTIONS = st.sampled_from(["arm", "disarm", "take off", "land", "hold", "offboard", "altitude", "set-point", "stick"])


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(ACTIONS, st.floats(0.0, 3.0)), max_size=15))
def test_whatever_is_asked_the_demand_is_credible(actions):
    bench = Bench()
    ask = {
        "arm": lambda v: v.arm(),
        "disarm": lambda v: v.disarm(),
        "take off": lambda v: v.take_off(2.0),
        "land": lambda v: v.enter(Mode.LAND),
        "hold": lambda v: v.enter(Mode.HOLD),
        "offboard": lambda v: v.enter(Mode.OFFBOARD),
        "altitude": lambda v: v.enter(Mode.ALTITUDE),
        "set-point": lambda v: v.attitude.put(Attitude(0.2, 0.1, 1.0, 0.45), v.now),
        "stick": lambda v: v.sticks.put(Sticks(1.0, 1.0, 1.0, -1.0), v.now),
    }
    for action, seconds in actions:
        before = (bench.vehicle.armed, bench.vehicle.lift.landed)
        try:
            ask[action](bench.vehicle)
        except Refused:
            assert (bench.vehicle.armed, bench.vehicle.lift.landed) == before
        if before == (True, False):
            assert bench.vehicle.armed  # in the air nothing but the loss of the vehicle stops the rotors
        for _ in range(round(seconds / TS)):
            bench.step()
            assert 0 <= bench.collective <= 1
            assert all(math.isfinite(value) for value in bench.demand[:3])
            assert bench.vehicle.armed or bench.collective == 0.0
