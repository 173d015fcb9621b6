"""PX4 logs of every layout, written by the tests; recorded logs are other people's data."""

import struct

import numpy as np
import pytest

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.logs.inspection import inspect_log
from mimopilot.tuning.logs.reader import open_log, read_log
from tests.tuning.logs.flights import (
    attitude,
    injected,
    make_flight,
    microseconds,
    pulses,
    px4_topics,
    three,
    write_ulog,
)

PERIOD = 0.004


@pytest.fixture(scope="module")
def flight():
    return make_flight()


def layout(flight, release):
    """Topics as a PX4 release named them; torque, rates and attitude share the stamps of the gyro."""
    stamps = {"timestamp": microseconds(flight.t), "timestamp_sample": microseconds(flight.t)}
    plain = {"timestamp": stamps["timestamp"]}
    p, q = flight.y_i.T.astype(np.float32)
    roll, pitch = flight.r_o.T.astype(np.float32)
    angles = {"roll_body": roll, "pitch_body": pitch}
    unused = {"q_d": np.zeros((len(flight.t), 4), np.float32)}
    control = {**stamps, "control": np.column_stack([flight.u, 0 * flight.u + 0.4, 0 * flight.u]).astype(np.float32)}
    q_att = attitude(flight.y_o)
    if release == "1.8":
        return [
            ("actuator_controls_0", 0, control),
            ("vehicle_attitude", 0, {**plain, "q": q_att, "rollspeed": p, "pitchspeed": q}),
            ("vehicle_attitude_setpoint", 0, {**plain, **angles, **unused}),
        ]
    if release == "1.11":
        return [
            ("actuator_controls_0", 0, control),
            ("vehicle_angular_velocity", 0, {**stamps, "xyz": three(flight.y_i)}),
            ("vehicle_attitude", 0, {**plain, "q": q_att}),
            ("vehicle_attitude_setpoint", 0, {**plain, **angles, "q_d": attitude(flight.r_o)}),
        ]
    setpoint = {**plain, "q_d": attitude(flight.r_o)} | (angles if release == "1.14" else {})
    return [
        ("vehicle_torque_setpoint", 0, {**stamps, "xyz": three(flight.u)}),
        ("vehicle_angular_velocity", 0, {**stamps, "xyz": three(flight.y_i)}),
        ("vehicle_attitude", 0, {**stamps, "q": q_att}),
        ("vehicle_attitude_setpoint", 0, setpoint),
    ]


@pytest.mark.parametrize("release", ["1.8", "1.11", "1.14", "1.17"])
def test_the_signals_of_every_layout_are_found(tmp_path, flight, release):
    log = read_log(write_ulog(tmp_path / "x.ulg", layout(flight, release)))
    assert log.Ts == PERIOD
    assert log.segments == ((0, len(flight.t)),)
    assert log.u == pytest.approx(flight.u, abs=1e-6)
    assert log.y_i == pytest.approx(flight.y_i, abs=1e-6)
    assert log.y_o == pytest.approx(flight.y_o, abs=1e-6)
    assert log.r_o == pytest.approx(flight.r_o, abs=1e-6)


def test_torque_and_rates_of_one_cycle_are_paired_although_published_at_different_times(tmp_path, flight):
    late = np.random.default_rng(2).integers(300, 2500, (2, len(flight.t)))
    sample = microseconds(flight.t)
    topics = [
        (
            "vehicle_torque_setpoint",
            0,
            {"timestamp": sample + late[0].astype(np.uint64), "timestamp_sample": sample, "xyz": three(flight.u)},
        ),
        (
            "vehicle_angular_velocity",
            0,
            {"timestamp": sample + late[1].astype(np.uint64), "timestamp_sample": sample, "xyz": three(flight.y_i)},
        ),
        ("vehicle_attitude", 0, {"timestamp": sample, "q": attitude(flight.y_o)}),
    ]
    log = read_log(write_ulog(tmp_path / "x.ulg", topics))
    assert log.u == pytest.approx(flight.u, abs=1e-6)
    assert log.y_i == pytest.approx(flight.y_i, abs=1e-6)


@pytest.mark.parametrize("zeros", ["all", "first hundred"])
def test_the_publication_time_is_used_when_timestamp_sample_is_zero(tmp_path, flight, zeros):
    topics = px4_topics(flight)
    for _, _, fields in topics:
        fields["timestamp"] = microseconds(flight.t)
        if "timestamp_sample" in fields:
            fields["timestamp_sample"] = np.where(
                np.arange(len(flight.t)) < (100 if zeros != "all" else 1 << 30), 0, fields["timestamp"]
            ).astype(np.uint64)
    log = read_log(write_ulog(tmp_path / "x.ulg", topics))
    assert log.segments == ((0, len(flight.t)),)
    assert log.u == pytest.approx(flight.u, abs=1e-6)


@pytest.mark.parametrize("publication", [0.0001, 0.0004, 0.0006])
def test_excitation_belongs_to_the_cycle_that_published_it_with_its_torque(tmp_path, publication):
    flight = make_flight(inject=lambda t: pulses(t, begin=t[0] + 1.0))
    topics = px4_topics(flight, debug_vect=injected(flight, publication))
    log = read_log(write_ulog(tmp_path / "x.ulg", topics))
    assert log.u_bar == pytest.approx(flight.u_bar[250:])
    assert log.u == pytest.approx(flight.u[250:], abs=1e-6)


def test_excitation_that_is_published_only_while_it_runs_is_zero_outside(tmp_path):
    flight = make_flight(seconds=14.0, inject=lambda t: pulses(t, begin=13.0, end=19.0))
    topic = injected(flight)
    whole = read_log(write_ulog(tmp_path / "whole.ulg", px4_topics(flight, debug_vect=topic)))
    # Two runs, each from a zero before to one after: the second pulse train is cut out of the first.
    runs = (flight.t > 12.99) & (flight.t < 19.002) & ~((flight.t > 15.5) & (flight.t < 16.5))
    topic["x"][(flight.t > 15.48) & (flight.t < 16.52)] = topic["y"][(flight.t > 15.48) & (flight.t < 16.52)] = 0
    quiet = {name: values[runs] for name, values in topic.items()}
    full = read_log(write_ulog(tmp_path / "full.ulg", px4_topics(flight, debug_vect=topic)))
    log = read_log(write_ulog(tmp_path / "quiet.ulg", px4_topics(flight, debug_vect=quiet)))
    for name in ("u", "u_bar", "y_i", "y_o"):
        assert getattr(log, name) == pytest.approx(getattr(full, name), abs=1e-9)
    assert log.segments == full.segments == whole.segments
    assert not log.u_bar[round((15.6 - 13) / PERIOD) : round((16.4 - 13) / PERIOD)].any()
    found = inspect_log(tmp_path / "quiet.ulg")
    assert found.signals["u_bar"].gaps == 0 and found.signals["u_bar"].rate_hz == pytest.approx(250, rel=1e-3)


def test_the_parts_of_the_torque_are_noted(tmp_path, flight):
    k = np.arange(0, len(flight.t), 5)
    data = np.zeros((len(k), 58), np.float32)
    data[:, :15] = np.arange(15) / 100
    name = np.full(len(k), b"MIMO_PID", "S10")
    name[::7] = b"other"
    parts = {"timestamp": microseconds(flight.t[k]), "id": np.zeros(len(k), "<u2"), "name": name, "data": data}
    found = inspect_log(write_ulog(tmp_path / "x.ulg", px4_topics(flight, debug_array=parts)))
    (note,) = found.recording.notes
    assert "P 0 / 0.01 / 0.02, I 0.03 / 0.04 / 0.05, D 0.06 / 0.07 / 0.08" in note
    assert "feed-forward 0.09 / 0.1 / 0.11, cross-axis 0.12 / 0.13 / 0.14" in note
    other = {**parts, "name": np.full(len(k), b"other", "S10")}
    assert not inspect_log(write_ulog(tmp_path / "y.ulg", px4_topics(flight, debug_array=other))).recording.notes


def test_a_setpoint_published_between_two_cycles_is_used_by_the_second(tmp_path, flight):
    rates = {
        "timestamp": microseconds(flight.t + 0.0025),
        "roll": flight.t.astype(np.float32),
        "pitch": flight.t.astype(np.float32),
    }
    log = read_log(write_ulog(tmp_path / "x.ulg", px4_topics(flight, vehicle_rates_setpoint=rates)))
    # Torque is published 0.4 ms after its sample, so the setpoint at 2.5 ms is used by the next one.
    assert log.r_i[1:, 0] == pytest.approx(flight.t[:-1], abs=1e-5)


def test_only_the_first_instance_of_a_topic_counts(tmp_path, flight):
    topics = px4_topics(flight)
    other = {**topics[1][2], "xyz": three(7 * flight.y_i)}
    log = read_log(write_ulog(tmp_path / "x.ulg", [("vehicle_angular_velocity", 1, other), *topics]))
    assert log.y_i == pytest.approx(flight.y_i, abs=1e-6)


def test_the_last_setpoint_of_equal_stamps_counts(tmp_path, flight):
    topics = px4_topics(flight)
    stamps = np.repeat(microseconds(flight.t[::2]), 2)
    roll = np.arange(len(stamps)) * 1e-4
    topics[3] = ("vehicle_attitude_setpoint", 0, {"timestamp": stamps, "q_d": attitude(np.column_stack([roll, roll]))})
    log = read_log(write_ulog(tmp_path / "x.ulg", topics))
    assert log.r_o[::2, 0] == pytest.approx(roll[1::2], abs=1e-6)


def test_a_dropout_splits_the_log_and_is_not_filled(tmp_path, flight):
    keep = (flight.t < 13) | (flight.t > 13.164)
    topics = [(name, i, {k: v[keep] for k, v in fields.items()}) for name, i, fields in px4_topics(flight)]
    log = read_log(write_ulog(tmp_path / "x.ulg", topics))
    assert len(log.segments) == 2
    for start, stop in log.segments:
        assert log.u[start:stop] == pytest.approx(flight.u[start:stop], abs=1e-6)
    assert (log.segments[1][0] - log.segments[0][1]) * PERIOD == pytest.approx(0.16, abs=0.009)


def test_the_message_names_the_missing_topic_the_logging_profile_and_the_logged_topics(tmp_path, flight):
    topics = px4_topics(flight)[1:]
    path = write_ulog(tmp_path / "x.ulg", topics, {"SDLOG_PROFILE": 1.0})
    with pytest.raises(
        TuningError,
        match=r"lacks vehicle_torque_setpoint .*actuator_controls_0.*SDLOG_PROFILE to 49.*it is 1\).*vehicle_attitude",
    ):
        read_log(path)


def test_default_logging_is_refused_as_too_slow(tmp_path, flight):
    topics = px4_topics(flight)
    topics[0] = ("vehicle_torque_setpoint", 0, {k: v[::12] for k, v in topics[0][2].items()})
    with pytest.raises(
        TuningError, match=r"too slow: vehicle_torque_setpoint is logged at 20\.8 Hz.*SDLOG_PROFILE to 49"
    ):
        read_log(write_ulog(tmp_path / "x.ulg", topics))


def test_the_release_is_read_and_not_invented(tmp_path, flight):
    path = write_ulog(tmp_path / "x.ulg", px4_topics(flight))
    assert open_log(path).format == "ULog, PX4 1.13.2"
    path.write_bytes(path.read_bytes().replace(struct.pack("<I", 0x010D02FF), struct.pack("<I", 0x000000FF), 1))
    assert open_log(path).format == "ULog, PX4"


@pytest.mark.parametrize(("profile", "advice"), [(17, "to 49 .*it is 17"), (49, "49, which logs every loop")])
def test_the_advice_on_the_logging_profile_names_no_setting_that_is_right_already(tmp_path, flight, profile, advice):
    path = write_ulog(tmp_path / "x.ulg", px4_topics(flight)[1:], {"SDLOG_PROFILE": profile})
    with pytest.raises(TuningError, match=f"SDLOG_PROFILE (is )?{advice}"):
        read_log(path)
