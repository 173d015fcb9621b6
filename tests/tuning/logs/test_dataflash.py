"""ArduPilot logs, written by the test byte by byte."""

import numpy as np
import pytest

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.logs.dataflash_file import open_dataflash
from mimopilot.tuning.logs.reader import open_log, read_log
from tests.tuning.logs.flights import (
    ardupilot_messages,
    dataflash_bytes,
    make_flight,
    microseconds,
    old_ardupilot_messages,
)


@pytest.fixture(scope="module")
def flight():
    return make_flight()


def write(path, messages):
    path.write_bytes(dataflash_bytes(messages))
    return path


def parameters(**values):
    names = [name.encode() for name in values]
    return ("PARM", "QNf", ("TimeUS", "Name", "Value"), [np.zeros(len(names)), names, list(values.values())])


@pytest.mark.parametrize(("angles", "tolerance"), [("ANG", 1e-6), ("ATT", np.radians(0.0051))])
def test_degrees_become_radians_and_hundredths_of_degrees_are_scaled_once(tmp_path, flight, angles, tolerance):
    log = read_log(write(tmp_path / "x.bin", ardupilot_messages(flight, angles)))
    assert log.Ts == 0.004
    assert log.segments == ((0, len(flight.t)),)
    assert log.u == pytest.approx(flight.u, abs=1e-7)
    assert log.y_i == pytest.approx(flight.y_i, abs=1e-6)
    assert log.y_o == pytest.approx(flight.y_o, abs=tolerance)
    assert log.r_o == pytest.approx(flight.r_o, abs=tolerance)


def test_fast_angles_are_preferred_to_those_at_ten_hertz(tmp_path, flight):
    rate, fast = ardupilot_messages(flight, "ANG")
    _, slow = ardupilot_messages(flight, "ATT")
    slow = (*slow[:3], [column[::25] for column in slow[3]])
    log = read_log(write(tmp_path / "x.bin", [slow, rate, fast]))
    assert log.y_o == pytest.approx(flight.y_o, abs=1e-6)


def test_angles_at_ten_hertz_alone_are_refused(tmp_path, flight):
    rate, slow = ardupilot_messages(flight, "ATT")
    slow = (*slow[:3], [column[::25] for column in slow[3]])
    with pytest.raises(TuningError, match=r"too slow: ATT is logged at 10\.0 Hz.*bit 0.*LOG_BITMASK"):
        read_log(write(tmp_path / "x.bin", [rate, slow]))


def test_without_rate_messages_the_bit_to_set_and_the_slow_substitute_are_named(tmp_path, flight):
    stamps = microseconds(flight.t[::25])
    pidr = ("PIDR", "Qf", ("TimeUS", "Act"), [stamps, np.zeros(len(stamps))])
    path = write(tmp_path / "x.bin", [pidr, parameters(LOG_BITMASK=2242524.0)])
    with pytest.raises(TuningError, match=r"lacks message RATE.*bit 0.*it is 2242524, so 2242525.*PIDR, at 10\.0 Hz"):
        read_log(path)


def test_outliers_of_values_and_times_cost_single_samples(tmp_path, flight):
    messages = ardupilot_messages(flight)
    rate = messages[0][3]
    rate[0] = rate[0].copy()
    rate[0][700] = 3
    rate[0][900] = 1 << 60
    rate[1] = rate[1].copy()
    rate[1][500] = 1e30
    rate[3] = rate[3].copy()
    rate[3][600] = np.nan
    log = read_log(write(tmp_path / "x.bin", messages))
    assert log.segments == ((0, len(flight.t)),)
    good = np.setdiff1d(np.arange(len(flight.t)), [500, 600, 700, 900])
    assert log.u[good] == pytest.approx(flight.u[good], abs=1e-7)
    assert log.y_i[good] == pytest.approx(flight.y_i[good], abs=1e-6)
    assert np.abs(log.y_i).max() < 2


def chirps(t, seconds=6.0):
    """The waveforms of two runs with a second between, the first on roll and the second on pitch, (N, 2)."""
    columns = []
    for run in range(2):
        since = t - (t[0] + 0.5 + run * (seconds + 1))
        columns.append(np.where((since >= 0) & (since < seconds), 0.1 * np.sin(9 * since**2 + 0.1), 0.0))
    return np.column_stack(columns)


def identification(flight, axes, seconds=6.0):
    """Runs of the system identification mode, one after the other with a second between."""
    waveforms, setups, columns = [], [], chirps(flight.t, seconds)
    for run, axis in enumerate(axes):
        begin = flight.t[0] + 0.5 + run * (seconds + 1)
        inside = (flight.t >= begin) & (flight.t < begin + seconds)
        waveforms.append(np.column_stack([microseconds(flight.t[inside]), columns[inside, run]]))
        setups.append((microseconds(begin - 0.001), axis))
    waveform, setup = np.concatenate(waveforms), np.array(setups)
    return [
        ("SIDD", "Qf", ("TimeUS", "Targ"), [waveform[:, 0].astype(np.uint64), waveform[:, 1]]),
        ("SIDS", "QB", ("TimeUS", "Ax"), [setup[:, 0].astype(np.uint64), setup[:, 1]]),
    ]


def test_the_waveform_of_the_mixer_axes_is_the_excitation_and_marks_the_experiment(tmp_path):
    flight = make_flight(18.0, inject=chirps)
    log = read_log(write(tmp_path / "x.bin", [*ardupilot_messages(flight), *identification(flight, (10, 11))]))
    assert len(log.u) * log.Ts == pytest.approx(15.0, abs=0.02)  # and 2 s after it
    assert np.abs(log.u_bar[:1490, 0]).max() == pytest.approx(0.1, rel=1e-3)
    assert not log.u_bar[:1490, 1].any()
    assert not log.u_bar[1510:1740].any()
    assert np.abs(log.u_bar[1760:, 1]).max() == pytest.approx(0.1, rel=1e-3)
    assert not log.u_bar[1760:, 0].any()


def test_a_waveform_added_elsewhere_is_not_part_of_the_torque(tmp_path):
    flight = make_flight(18.0)
    log = read_log(write(tmp_path / "x.bin", [*ardupilot_messages(flight), *identification(flight, (7, 2))]))
    assert log.u_bar is None
    assert log.r_o is not None


def events(*pairs):
    times, codes = zip(*pairs, strict=True)
    return ("EV", "QB", ("TimeUS", "Id"), [microseconds(times), list(codes)])


def test_only_the_time_between_take_off_and_landing_is_used(tmp_path):
    flight = make_flight(20.0)
    path = write(
        tmp_path / "x.bin", [*ardupilot_messages(flight), events((11.0, 10), (14.0, 28), (25.0, 18), (26.0, 11))]
    )
    log = read_log(path)
    assert log.seconds == pytest.approx(11.0, abs=0.01)
    assert log.u == pytest.approx(flight.u[1000 : 1000 + len(log.u)], abs=1e-7)


def test_a_part_of_the_flown_gains_is_not_enough_and_their_law_is_noted(tmp_path, flight):
    path = write(tmp_path / "x.bin", [*ardupilot_messages(flight), parameters(ATC_RAT_RLL_P=0.135)])
    recording = open_log(path)
    assert recording.parameters["ATC_RAT_RLL_P"] == pytest.approx(0.135)
    assert "the flown gains are ArduPilot's" in recording.notes[0]
    assert read_log(path).flown is None


@pytest.mark.parametrize("Ts", [0.0025, 0.004, 0.01])
def test_logs_of_arducopter_3_are_read_in_their_own_units_and_milliseconds(tmp_path, Ts):
    flight = make_flight(10.0, Ts)
    log = read_log(write(tmp_path / "x.bin", old_ardupilot_messages(flight)))
    assert log.Ts == pytest.approx(Ts, rel=1e-5)
    assert len(log.segments) == 1
    assert len(log.u) == pytest.approx(len(flight.t), abs=1)
    assert log.u == pytest.approx(flight.u[: len(log.u)], abs=1e-6)
    # The stamps of all messages are truncated to milliseconds.
    assert log.y_i == pytest.approx(flight.y_i[: len(log.u)], abs=2e-3)
    assert log.y_o == pytest.approx(flight.y_o[: len(log.u)], abs=5e-4)
    assert "3.3 and older" in open_log(tmp_path / "x.bin").format


def test_milliseconds_with_current_units_are_read_correctly(tmp_path, flight):
    rate, angles = ardupilot_messages(flight, "ATT")
    milli = [("TimeMS", *names[1:]) for _, _, names, _ in (rate, angles)]
    old = [
        (name, "I" + letters[1:], names, [np.round(flight.t * 1e3), *values[1:]])
        for (name, letters, _, values), names in zip((rate, angles), milli, strict=True)
    ]
    log = read_log(write(tmp_path / "x.bin", old))
    assert log.u == pytest.approx(flight.u, abs=1e-6)
    assert log.y_i == pytest.approx(flight.y_i, abs=1e-5)


def test_events_without_a_time_take_that_of_their_place_in_the_log(tmp_path):
    flight = make_flight(20.0)
    path = write(tmp_path / "x.bin", [("EV", "B", ("Id",), [[28]]), *old_ardupilot_messages(flight)])
    whole = path.read_bytes()
    takeoff, event = open_dataflash(path).offsets["RATE"][1500], 2 * 89
    path.write_bytes(whole[:event] + whole[event + 4 : takeoff] + whole[event : event + 4] + whole[takeoff:])
    log = read_log(path)
    assert log.seconds == pytest.approx(14, abs=0.01)
    assert log.u == pytest.approx(flight.u[-len(log.u) :], abs=1e-6)


def test_an_old_px4_log_is_recognised(tmp_path):
    time = ("TIME", "Q", ("StartTime",), [microseconds(np.arange(100) * 0.005)])
    att = ("ATT", "ffffff", ("qw", "Roll", "Pitch", "Yaw", "RollRate", "PitchRate"), [np.zeros(100)] * 6)
    with pytest.raises(TuningError, match=r"an old PX4 log \(sdlog2, .px4log\).*1.8 or later.*sdlog2_dump.py"):
        read_log(write(tmp_path / "x.px4log", [time, att]))


def firmware(text):
    return ("MSG", "QZ", ("TimeUS", "Message"), [[0], [text.encode()]])


@pytest.mark.parametrize(
    ("text", "values", "advice", "never"),
    [
        ("ArduCopter V4.5.7", {"LOG_BITMASK": 176126}, "it is 176126, so 176127", "already"),
        ("ArduCopter V4.5.7", {}, "set bit 0 .fast attitude. of LOG_BITMASK and fly", "it is"),
        (
            "APM:Copter V3.4-rc2",
            {"LOG_BITMASK": 32767},
            "RATE and ATT are needed at 100 Hz.*ArduCopter 4.0 or later",
            "so 32767",
        ),
        (
            "ArduCopter V4.5.7",
            {"LOG_BITMASK": 1, "LOG_FILE_RATEMAX": 25},
            "LOG_FILE_RATEMAX to 0 .*it is 25 Hz",
            "so 1",
        ),
        ("ArduCopter V4.5.7", {"LOG_BITMASK": 65535}, "RATE and ANG.*100 Hz.*clear its other bits", "so 65535"),
    ],
)
def test_the_advice_on_a_slow_log_names_no_setting_that_is_right_already(tmp_path, flight, text, values, advice, never):
    slow = [
        (name, letters, names, [v[::10] for v in rows]) for name, letters, names, rows in ardupilot_messages(flight)
    ]
    with pytest.raises(
        TuningError, match=r"RATE is logged at 25\.0 Hz; ANG is logged at 25\.0 Hz; .*" + advice
    ) as caught:
        read_log(write(tmp_path / "x.bin", [firmware(text), parameters(**values), *slow]))
    assert never not in str(caught.value)
