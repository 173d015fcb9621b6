"""The part of a log in flight, and the refusal of logs without flight."""

import numpy as np
import pytest

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.logs.flight_phase import FADE, bridged, flying_parts, intersection, intervals
from mimopilot.tuning.logs.reader import open_log, read_log
from tests.tuning.logs.flights import make_flight, microseconds, px4_topics, table, write_csv, write_ulog


@pytest.fixture(scope="module")
def flight():
    return make_flight(20.0)


def landed(*changes):
    """vehicle_land_detected, published at (second, landed)."""
    times, values = zip(*changes, strict=True)
    return {"timestamp": microseconds(times), "landed": np.array(values, np.uint8)}


def armed(*changes):
    times, values = zip(*changes, strict=True)
    return {"timestamp": microseconds(times), "armed": np.array(values, np.uint8)}


def read(path, flight, **topics):
    return read_log(write_ulog(path / "x.ulg", px4_topics(flight, **topics)))


def test_time_on_the_ground_according_to_the_land_detector_is_not_used(tmp_path, flight):
    log = read(tmp_path, flight, vehicle_land_detected=landed((10, 1), (14, 0), (20, 0), (26, 1), (27, 1)))
    assert log.seconds == pytest.approx(12.0, abs=0.01)
    assert log.u[log.segments[0][0]] == pytest.approx(flight.u[1000], abs=1e-6)


def test_a_touch_and_go_splits_the_flight(tmp_path, flight):
    log = read(tmp_path, flight, vehicle_land_detected=landed((10, 0), (17, 1), (20, 0)))
    assert [round(0.004 * (stop - start), 1) for start, stop in log.segments] == [7.0, 10.0]


def test_a_disarmed_vehicle_does_not_fly(tmp_path, flight):
    log = read(tmp_path, flight, vehicle_land_detected=landed((10, 0)), actuator_armed=armed((10, 0), (12, 1), (24, 0)))
    assert log.seconds == pytest.approx(12.0, abs=0.01)


def test_without_land_detector_thrust_tells_the_flight_and_short_idling_counts_as_flight(tmp_path, flight):
    up = np.where((flight.t > 13) & (flight.t < 27) & ~((flight.t > 19) & (flight.t < 19.6)), -0.4, -0.02)
    thrust = {
        "timestamp": microseconds(flight.t),
        "xyz": np.column_stack([0 * up, 0 * up, up]).astype(np.float32),
    }
    log = read(tmp_path, flight, vehicle_thrust_setpoint=thrust)
    assert log.seconds == pytest.approx(14.0, abs=0.01)
    assert len(log.segments) == 1


def test_a_thrust_that_is_nan_throughout_is_no_evidence_of_the_ground(tmp_path, flight):
    thrust = {"timestamp": microseconds(flight.t), "xyz": np.full((len(flight.t), 3), np.nan, np.float32)}
    log, without = read(tmp_path, flight, vehicle_thrust_setpoint=thrust), read(tmp_path, flight)
    assert log.seconds == without.seconds > 0


def test_a_log_that_was_landed_throughout_is_refused(tmp_path, flight):
    with pytest.raises(TuningError, match=r"no flight: .* vehicle_land_detected\.landed .* never left the ground"):
        read(tmp_path, flight, vehicle_land_detected=landed((10, 1), (15, 1)))


def test_a_log_at_rest_is_refused_even_if_the_land_detector_reports_flight(tmp_path):
    at_rest = make_flight(10.0, still=(10.0, 0.0))
    with pytest.raises(TuningError, match=r"airborne for 1\.2 s .*, but the body rates in .* do not change"):
        read(tmp_path, at_rest, vehicle_land_detected=landed((10, 1), (14, 0), (15.2, 1)))


@pytest.mark.parametrize(
    ("name", "words"), [("y_i", "the body rates in p, q do not change"), ("u", "u_roll, u_pitch does not change")]
)
def test_a_table_without_motion_is_refused(tmp_path, flight, name, words):
    columns = table(flight)
    for column in {"u": ("u_roll", "u_pitch"), "y_i": ("p", "q")}[name]:
        columns[column] = np.full(len(flight.t), 0.01)
    with pytest.raises(TuningError, match=f"no flight: {words}"):
        read_log(write_csv(tmp_path / "x.csv", columns))


def test_sensor_noise_on_the_ground_is_not_motion(tmp_path):
    at_rest = make_flight(10.0, still=(10.0, 0.0))
    columns = table(at_rest)
    for column in ("p", "q"):
        columns[column] = 0.004 * np.random.default_rng(3).standard_normal(len(at_rest.t))
    with pytest.raises(TuningError, match="no flight: the body rates in p, q do not change"):
        read_log(write_csv(tmp_path / "x.csv", columns))


def test_rest_before_and_after_the_flight_is_cut_off_when_no_state_is_logged(tmp_path):
    log = read_log(write_csv(tmp_path / "x.csv", table(make_flight(30.0, still=(10.0, 8.0)))))
    # One second remains on either side.
    assert 12.0 < log.seconds < 14.5


def injected(flight, begin, end):
    u_bar = np.where((flight.t >= begin) & (flight.t < end), 0.1, 0).astype(np.float32)
    name = np.full(len(flight.t), b"MIMO_EXC", "S10")
    return {"timestamp": microseconds(flight.t + 0.0004), "x": u_bar, "y": u_bar, "name": name}


def test_injected_excitation_marks_the_experiment_within_the_flight(tmp_path, flight):
    states = landed((10, 1), (12, 0), (28, 1))
    topics = px4_topics(flight, vehicle_land_detected=states, debug_vect=injected(flight, 15.0, 24.0))
    ((begin, end),), warnings = flying_parts(open_log(write_ulog(tmp_path / "x.ulg", topics)))
    assert end - begin == pytest.approx(9.0 + FADE, abs=0.01)
    assert not warnings


def test_excitation_on_the_ground_is_refused(tmp_path, flight):
    states = landed((10, 1), (22, 0), (28, 1))
    with pytest.raises(TuningError, match="on the ground while a torque was injected"):
        read(tmp_path, flight, vehicle_land_detected=states, debug_vect=injected(flight, 12.0, 20.0))


def test_a_state_holds_until_the_next_message_and_beyond_both_ends():
    time, flag = np.array([1.0, 2.0, 3.0, 4.0]), np.array([True, False, True, True])
    assert intervals(time, flag) == ((-np.inf, 2.0), (3.0, np.inf))
    assert intervals(time[:0], flag[:0]) == ()


def test_intervals_are_joined_and_intersected():
    assert bridged(((0, 1), (1.5, 2), (4, 5))) == ((0, 2), (4, 5))
    assert intersection(((0, 2), (3, 6)), ((1, 4), (5, 9))) == ((1, 2), (3, 4), (5, 6))
