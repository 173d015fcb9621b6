"""The yaw axis of every log format: found, unwrapped, checked; left out with a warning where it is no use."""

import numpy as np
import pytest
from scipy.signal import lfilter

from mimopilot.sitl.flight.flight_log import quaternions
from mimopilot.tuning.experiment import external_yaw_signal
from mimopilot.tuning.logs.columns import Columns
from mimopilot.tuning.logs.inspection import inspect_log
from mimopilot.tuning.logs.reader import read_log
from mimopilot.tuning.logs.yaw import torque_to_acceleration
from tests.tuning.logs.flights import (
    YAW_ACCELERATION,
    ardupilot_messages,
    dataflash_bytes,
    make_flight,
    microseconds,
    pulses,
    px4_topics,
    table,
    turning,
    wrapped,
    write_csv,
    write_ulog,
)

DEGREE = 180 / np.pi
#: s: roll and pitch are excited until here, yaw from there to the end of the third number.
UNTIL, FROM, END = 20.0, 21.0, 33.0


@pytest.fixture(scope="module")
def flight():
    """From 10 s to 37 s; the heading crosses 180 degrees."""
    return make_flight(27.0, inject=lambda t: pulses(t, end=UNTIL))


@pytest.fixture(scope="module")
def yaw(flight):
    found = turning(flight, FROM, END, heading=np.pi)
    assert np.ptp(np.sign(wrapped(found.y_o))) == 2
    return found


def three(pair, one):
    return np.column_stack([pair, one]).astype(np.float32)


def ulog_topics(flight, yaw):
    """Topics of a PX4 log in which our module injects: one message of its torque a sample."""
    topics = dict((name, fields) for name, _, fields in px4_topics(flight))
    topics["vehicle_torque_setpoint"]["xyz"] = three(flight.u, yaw.u)
    topics["vehicle_angular_velocity"]["xyz"] = three(flight.y_i, yaw.y_i)
    topics["vehicle_attitude"]["q"] = quaternions(three(flight.y_o, yaw.y_o))
    topics["vehicle_attitude_setpoint"]["q_d"] = quaternions(three(flight.r_o, np.full(len(flight.t), np.pi)))
    # The last message of each stretch holds zeros.
    running = (flight.t < UNTIL + 0.002) | ((flight.t >= FROM - 0.5) & (flight.t < END + 0.002))
    on_yaw = (flight.t >= FROM) & running
    topics["debug_vect"] = {
        "timestamp": microseconds(flight.t + 0.0004)[running],
        "x": np.where(on_yaw, yaw.u_bar, flight.u_bar[:, 0]).astype(np.float32)[running],
        "y": np.where(on_yaw, 0.1, flight.u_bar[:, 1]).astype(np.float32)[running],
        "name": np.where(on_yaw, np.array(b"MIMO_EXY", "S10"), np.array(b"MIMO_EXC", "S10"))[running],
    }
    return [(name, 0, fields) for name, fields in topics.items()]


def dataflash_messages(flight, yaw):
    """RATE and ANG with yaw, and SystemID on the mixer axes of roll, pitch and yaw."""
    (_, letters, names, rate), (_, _, angle_names, angle) = ardupilot_messages(flight)
    rate, angle = [*rate, DEGREE * yaw.y_i, yaw.u], [*angle, np.remainder(DEGREE * yaw.y_o, 360)]
    inside = flight.t < UNTIL, (flight.t >= FROM) & (flight.t < END)
    # SystemID excites one axis at a time: roll's torque here stays that of pitch, too.
    stamps = np.concatenate([flight.t[part] for part in inside])
    waveform = np.concatenate([flight.u_bar[inside[0], 0], yaw.u_bar[inside[1]]])
    return [
        ("RATE", letters + "ff", (*names, "Y", "YOut"), rate),
        ("ANG", "Qfffff", (*angle_names, "Yaw"), angle),
        ("SIDD", "Qf", ("TimeUS", "Targ"), [microseconds(stamps), waveform]),
        ("SIDS", "QB", ("TimeUS", "Ax"), [microseconds([10.0, FROM]), [10, 12]]),
    ]


def csv_columns(flight, yaw):
    return table(flight) | {
        "u_bar_roll": flight.u_bar[:, 0],
        "u_bar_pitch": flight.u_bar[:, 1],
        "u_yaw": yaw.u,
        "r": yaw.y_i,
        "yaw": wrapped(yaw.y_o),
        "u_bar_yaw": yaw.u_bar,
    }


def check(log, flight, yaw):
    """The signals of yaw are those of the flight, in the stretch that excites it, 2 s after, and up to 2 s before."""
    ((start, stop),) = log.yaw.segments
    before = int(np.flatnonzero(log.yaw.u_bar[start:stop])[0])
    assert before * log.Ts <= 2.0
    assert (stop - start - before) * log.Ts == pytest.approx(END - FROM + 2.0, abs=0.02)
    first = np.flatnonzero(yaw.u_bar)[0] - before
    rows = slice(first, first + stop - start)
    np.testing.assert_allclose(log.yaw.u[start:stop], yaw.u[rows], atol=1e-6)
    np.testing.assert_allclose(log.yaw.y_i[start:stop], yaw.y_i[rows], atol=1e-5)
    turned = log.yaw.y_o[start:stop] - yaw.y_o[rows]
    np.testing.assert_allclose(turned, 2 * np.pi * round(turned[0] / 2 / np.pi), atol=2e-4)
    np.testing.assert_allclose(log.yaw.u_bar[start:stop], yaw.u_bar[rows], atol=1e-6)
    assert external_yaw_signal(log.yaw)[1] == "u_bar"
    assert torque_to_acceleration(log.yaw, log.yaw.u_bar, log.Ts)[0] == pytest.approx(YAW_ACCELERATION, rel=0.05)
    # Roll and pitch end before yaw is excited.
    assert log.segments[-1][1] <= start
    assert not log.warnings


def test_a_ulog_with_mimo_exy_holds_yaw(flight, yaw, tmp_path):
    log = read_log(write_ulog(tmp_path / "x.ulg", ulog_topics(flight, yaw)))
    check(log, flight, yaw)
    start, stop = log.yaw.segments[0]
    # The setpoint is on the heading's turn; y of MIMO_EXY is no torque.
    np.testing.assert_allclose(log.yaw.r_o[start:stop] - np.median(log.yaw.y_o[start:stop]), 0.0, atol=0.1)
    assert not log.u_bar[start:stop].any()
    found = inspect_log(tmp_path / "x.ulg")
    assert found.external == {"roll": "u_bar", "pitch": "u_bar", "yaw": "u_bar"}
    assert found.excitation["u_bar yaw"].rms == pytest.approx(0.2 * np.sqrt(12 / 14), rel=0.02)
    assert found.yaw["y_i"].maximum == pytest.approx((yaw.y_i.max(),), abs=1e-5)


def test_the_yaw_torque_of_our_module_is_taken_before_the_autopilots_low_pass(flight, yaw, tmp_path):
    topics = ulog_topics(flight, yaw)
    share = 1 - 1 / (1 + 2 * np.pi * 2.0 * np.median(np.diff(flight.t)))  # first order, 2 Hz
    passed = lfilter([share], [1, share - 1], yaw.u)
    torque = next(fields for name, _, fields in topics if name == "vehicle_torque_setpoint")
    torque["xyz"] = three(flight.u, passed)
    settings = {"MIMO_EN": 1, "MC_YAW_TQ_CUTOFF": 2.0}
    log = read_log(write_ulog(tmp_path / "x.ulg", topics, parameters=settings))
    ((start, stop),) = log.yaw.segments
    first = np.flatnonzero(yaw.u_bar)[0] - np.flatnonzero(log.yaw.u_bar[start:stop])[0]
    np.testing.assert_allclose(log.yaw.u[start:stop], yaw.u[first : first + stop - start], atol=1e-4)
    # PX4's own controllers: their law has the low-pass.
    stock = read_log(write_ulog(tmp_path / "y.ulg", topics, parameters={"MIMO_EN": 0, "MC_YAW_TQ_CUTOFF": 2.0}))
    assert stock.yaw is None or np.abs(stock.yaw.u[start:stop]).max() < np.abs(log.yaw.u[start:stop]).max()


def test_a_table_holds_yaw(flight, yaw, tmp_path):
    check(read_log(write_csv(tmp_path / "x.csv", csv_columns(flight, yaw))), flight, yaw)


def test_a_dataflash_log_holds_yaw_and_names_the_axes_of_system_identification(yaw, tmp_path):
    roll_only = make_flight(27.0, inject=lambda t: pulses(t, end=UNTIL) * [1, 0])
    path = tmp_path / "x.bin"
    path.write_bytes(dataflash_bytes(dataflash_messages(roll_only, turning(roll_only, FROM, END, heading=np.pi))))
    found = inspect_log(path)
    assert found.external == {"roll": "u_bar", "yaw": "u_bar"}
    assert found.recording.notes[-1].endswith(
        "SID_AXIS 10: injected torque on roll; SID_AXIS 12: injected torque on yaw"
    )
    ((start, stop),) = found.experiment.yaw.segments
    assert (stop - start) * 0.004 == pytest.approx(END - UNTIL + 2.0, abs=0.02)
    rate = found.experiment.yaw.y_i[start:stop]
    turned = np.cumsum(rate) * 0.004
    assert np.ptp(found.experiment.yaw.y_o[start:stop]) == pytest.approx(np.ptp(turned), rel=0.1)


def test_a_gap_in_the_yaw_columns_alone_cuts_only_yaw(flight, yaw, tmp_path):
    columns = csv_columns(flight, yaw)
    columns["r"] = np.where((flight.t > 25) & (flight.t < 26), np.nan, columns["r"])
    log = read_log(write_csv(tmp_path / "x.csv", columns))
    assert len(log.segments) == 1 and len(log.yaw.segments) == 2
    (_, before), (after, _) = log.yaw.segments
    assert (after - before) * log.Ts == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"u_yaw": -1}, "a unit of the torque in u_yaw accelerates yaw by -"),
        ({"r": -1}, "the heading in yaw turns against the rate in r"),
        ({"r": DEGREE}, "the integral of r, expected 1: degrees are taken for radians; put into"),
        ({"u_bar_yaw": -1}, "u_yaw does not contain what was injected, u_bar_yaw"),
        ({"u_yaw": 100}, "u_yaw: "),
    ],
)
def test_yaw_signals_that_do_not_agree_are_left_out_with_a_warning_that_names_the_column(
    flight, yaw, tmp_path, change, words
):
    columns = csv_columns(flight, yaw)
    for name, factor in change.items():
        columns[name] = factor * columns[name]
    log = read_log(write_csv(tmp_path / "x.csv", columns))
    assert log.yaw is None
    (warning,) = log.warnings
    assert warning.startswith("yaw is left out: ") and words in warning
    if set(change.values()) == {-1}:
        # The line that the warning gives mends it.
        assert f'{next(iter(change))} = {{ column = "{next(iter(change))}", sign = -1 }}' in warning
        name = next(iter(change))
        mended = read_log(tmp_path / "x.csv", Columns.model_validate({name: {"column": name, "sign": -1}}))
        assert mended.yaw is not None and not mended.warnings


def test_columns_of_something_else_and_slow_yaw_leave_a_good_log_of_roll_and_pitch(flight, yaw, tmp_path):
    columns = csv_columns(flight, yaw)
    slow = np.where(np.arange(len(flight.t)) % 10 == 0, columns["yaw"], np.nan)
    log = read_log(write_csv(tmp_path / "slow.csv", columns | {"yaw": slow}))
    assert log.yaw is None and "yaw is left out: too slow: yaw is logged at 25.0 Hz" in log.warnings[0]
    path = write_csv(tmp_path / "other.csv", columns)
    lines = path.read_text().splitlines()
    place = lines[0].split(",").index("r")
    cells = [line.split(",") for line in lines]
    text = [cells[0], *([*row[:place], "red", *row[place + 1 :]] for row in cells[1:])]
    path.write_text("\n".join(",".join(row) for row in text) + "\n")
    other = read_log(path)
    assert other.yaw is None and not other.warnings
    assert other.segments == log.segments


def test_a_log_without_yaw_excitation_uses_roll_and_pitchs_stretches(flight, tmp_path):
    still = turning(flight)
    quiet = {name: values for name, values in csv_columns(flight, still).items() if name != "u_bar_yaw"}
    log = read_log(write_csv(tmp_path / "x.csv", quiet | {"u_yaw": np.zeros(len(flight.t)), "r": 0 * flight.t}))
    assert log.yaw is None or external_yaw_signal(log.yaw) is None
