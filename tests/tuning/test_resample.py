import numpy as np
import pytest

from tuning.errors import TuningError
from tuning.logs.resample import Series, held_samples, monotone, on_common_grid

ALWAYS = [(-np.inf, np.inf)]


def series(time, offset=0.0):
    time = np.asarray(time, float)
    return Series(time, np.column_stack([np.sin(time) + offset, np.cos(time)]), "topic")


def grid(parts=ALWAYS, **signals):
    return on_common_grid({name: monotone(s) for name, s in signals.items()}, parts, "log", "set SDLOG_PROFILE to 17")


def uniform(seconds=10.0, Ts=0.004, start=1.0):
    return start + Ts * np.arange(round(seconds / Ts))


def test_equal_stamps_pair_exactly():
    t = uniform()
    out = grid(u=series(t), y_i=series(t, 1), y_o=series(t, 2))
    assert out.Ts == 0.004
    assert out.segments == ((0, len(t)),)
    assert (out.signals["u"] == series(t).values).all()
    assert out.signals["y_i"] == pytest.approx(series(t, 1).values, abs=1e-12)


def test_single_missing_samples_do_not_shift_the_rest():
    t = uniform()
    keep = np.ones(len(t), bool)
    keep[[100, 700, 1500]] = False
    out = grid(u=series(t[keep]), y_i=series(t), y_o=series(t))
    assert out.segments == ((0, len(t)),)
    rows = np.flatnonzero(keep)
    assert (out.signals["u"][rows] == series(t).values[rows]).all()
    assert (out.signals["u"][100] == series(t).values[99]).all()


def test_a_gap_splits_the_log():
    t = uniform(20)
    keep = (t < 9) | (t > 9.1)
    out = grid(u=series(t[keep]), y_i=series(t), y_o=series(t))
    assert len(out.segments) == 2
    assert out.segments[0][1] * 0.004 + 1 == pytest.approx(9.0, abs=0.01)
    assert out.segments[1][0] * 0.004 + 1 == pytest.approx(9.1, abs=0.01)


def test_of_repeated_stamps_the_last_value_is_kept():
    t = uniform()
    doubled = np.repeat(t, 2)
    values = np.column_stack([np.arange(len(doubled)), np.arange(len(doubled))]).astype(float)
    out = grid(u=Series(doubled, values, "topic"), y_i=series(t), y_o=series(t))
    assert (out.signals["u"][:, 0] == 2 * np.arange(len(t)) + 1).all()


def test_time_going_back_is_dropped():
    t = uniform()
    broken = t.copy()
    broken[500] = t[400]
    out = grid(u=series(broken), y_i=series(t), y_o=series(t))
    assert len(out.signals["u"]) == len(t)
    assert np.isfinite(out.signals["u"]).all()


def test_a_torque_at_50_hz_is_refused_with_its_rate():
    t = uniform()
    with pytest.raises(TuningError, match=r"too slow: .*50\.0 Hz.*SDLOG_PROFILE"):
        grid(u=series(uniform(Ts=0.02)), y_i=series(t), y_o=series(t))


def test_three_seconds_are_too_short():
    t = uniform(3)
    with pytest.raises(TuningError, match=r"too short: 3\.0 s"):
        grid(u=series(t), y_i=series(t), y_o=series(t))
