"""ArduPilot logs, written here byte by byte."""

import numpy as np
import pytest

from tests.tuning.logs.flights import ardupilot_messages, dataflash_bytes, make_flight, microseconds
from tuning.errors import TuningError
from tuning.logs.reader import open_log, read_log


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


def test_without_rate_messages_the_bit_to_set_and_the_slow_stand_in_are_named(tmp_path, flight):
    stamps = microseconds(flight.t[::25])
    pidr = ("PIDR", "Qf", ("TimeUS", "Act"), [stamps, np.zeros(len(stamps))])
    path = write(tmp_path / "x.bin", [pidr, parameters(LOG_BITMASK=2242524.0)])
    with pytest.raises(TuningError, match=r"lacks message RATE.*bit 0.*it is 2242524, so 2242525.*PIDR, at 10\.0 Hz"):
        read_log(path)


def test_wild_values_and_times_cost_single_samples(tmp_path, flight):
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


def identification(flight, axes, seconds=3.0):
    """Runs of the system identification mode, one after the other with a second between."""
    waveforms, setups = [], []
    for run, axis in enumerate(axes):
        begin = flight.t[0] + 0.5 + run * (seconds + 1)
        t = flight.t[(flight.t >= begin) & (flight.t < begin + seconds)]
        waveforms.append(np.column_stack([microseconds(t), 0.1 * np.sin(9 * (t - begin) ** 2 + 0.1)]))
        setups.append((microseconds(begin - 0.001), axis))
    waveform, setup = np.concatenate(waveforms), np.array(setups)
    return [
        ("SIDD", "Qf", ("TimeUS", "Targ"), [waveform[:, 0].astype(np.uint64), waveform[:, 1]]),
        ("SIDS", "QB", ("TimeUS", "Ax"), [setup[:, 0].astype(np.uint64), setup[:, 1]]),
    ]


def test_the_waveform_of_the_mixer_axes_is_the_excitation_and_marks_the_experiment(tmp_path):
    flight = make_flight(12.0)
    log = read_log(write(tmp_path / "x.bin", [*ardupilot_messages(flight), *identification(flight, (10, 11))]))
    assert len(log.u) * log.Ts == pytest.approx(7.0, abs=0.02)
    assert np.abs(log.u_bar[:740, 0]).max() == pytest.approx(0.1, rel=1e-3)
    assert not log.u_bar[:740, 1].any()
    assert not log.u_bar[760:990].any()
    assert np.abs(log.u_bar[1010:, 1]).max() == pytest.approx(0.1, rel=1e-3)
    assert not log.u_bar[1010:, 0].any()


def test_a_waveform_added_elsewhere_is_no_part_of_the_moment(tmp_path):
    flight = make_flight(12.0)
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


def test_flown_gains_are_left_out_with_the_reason(tmp_path, flight):
    path = write(tmp_path / "x.bin", [*ardupilot_messages(flight), parameters(ATC_RAT_RLL_P=0.135)])
    recording = open_log(path)
    assert recording.parameters["ATC_RAT_RLL_P"] == pytest.approx(0.135)
    assert "D acts on the filtered error" in recording.notes[0]
    assert read_log(path).flown is None
