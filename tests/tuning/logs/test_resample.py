import numpy as np
import pytest

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.logs.resample import Series, held_samples, monotone, on_common_grid

ALWAYS = [(-np.inf, np.inf)]


def series(time, offset=0.0):
    time = np.asarray(time, float)
    return Series(time, np.column_stack([np.sin(time) + offset, np.cos(time)]), "topic")


def grid(parts=ALWAYS, **signals):
    return on_common_grid({name: monotone(s) for name, s in signals.items()}, parts, "log", "set SDLOG_PROFILE to 49")


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


def test_the_last_value_of_equal_stamps_is_kept():
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


def test_one_stamp_far_ahead_costs_only_its_own_sample():
    t = uniform()
    broken = t.copy()
    broken[500] = 1e6
    assert len(monotone(series(broken)).time) == len(t) - 1
    assert grid(u=series(broken), y_i=series(t), y_o=series(t)).segments == ((0, len(t)),)


def test_a_last_stamp_far_ahead_on_every_signal_is_refused_without_filling_memory():
    t = uniform()
    t[-1] = 1e13
    with pytest.raises(TuningError, match="damaged time stamps"):
        grid(u=series(t), y_i=series(t), y_o=series(t))


def test_only_the_given_parts_are_used():
    t = uniform(20)
    out = grid(parts=[(3.0, 9.0), (12.0, 15.0)], u=series(t), y_i=series(t), y_o=series(t))
    lengths = [0.004 * (stop - start) for start, stop in out.segments]
    assert lengths == pytest.approx([6.0, 3.0], abs=0.01)
    start = out.segments[1][0]
    assert out.signals["u"][start] == pytest.approx(series([12.0]).values[0], abs=0.004)


def held(time, period):
    return Series(time, np.floor(time / period + 1e-9)[:, None] * [0.01, 0.02], "torque")


@pytest.mark.parametrize("rows", [2, 3, 5])
def test_a_value_repeated_over_rows_is_recognised_as_held(rows):
    assert held_samples(held(uniform(), 0.004 * rows).values) == rows


def test_a_coarsely_quantised_signal_does_not_count_as_held():
    noise = np.round(np.random.default_rng(0).standard_normal((5000, 2)) * 0.7)
    assert held_samples(noise) == 1
    # At rest for half of the time every row is still a new value.
    noise[2500:] = 0
    assert held_samples(np.random.default_rng(1).standard_normal((5000, 2)) * (noise != 0)) == 1


def test_a_torque_held_at_50_hz_is_refused_although_logged_at_250_hz():
    t = uniform()
    with pytest.raises(TuningError, match=r"too slow: torque is logged at 250\.0 Hz but .* held for 5 .* 50\.0 Hz"):
        grid(u=held(t, 0.02), y_i=series(t), y_o=series(t))


def tone(time, hertz):
    phase = 2 * np.pi * hertz * np.asarray(time)
    return Series(np.asarray(time), np.column_stack([np.sin(phase), np.cos(phase)]), "topic")


@pytest.mark.parametrize("slow", [0.008, 0.0072])
def test_slower_angles_decimate_every_signal_to_their_rate_by_the_same_filter(slow):
    t = uniform(20)
    fast = tone(t, 5)
    both = Series(t, fast.values + tone(t, 110).values, "topic")
    out = grid(u=both, y_i=fast, y_o=tone(uniform(20, slow), 5))
    assert out.Ts == pytest.approx(slow, rel=0.01)
    inner = slice(100, -100)
    # Frequencies above the slow rate are removed from the fast signal; those below are neither changed nor delayed.
    time = 1.0 + out.Ts * np.arange(len(out.signals["u"]))
    assert out.signals["u"][inner] == pytest.approx(tone(time, 5).values[inner], abs=0.02)
    assert out.signals["y_i"][inner] == pytest.approx(tone(time, 5).values[inner], abs=0.01)
    assert out.signals["y_o"][inner] == pytest.approx(tone(time, 5).values[inner], abs=0.02)


def test_nothing_is_filtered_across_a_gap():
    t = uniform(20)
    keep = (t < 9) | (t > 9.2)
    jump = Series(t[keep], np.where(t[keep] < 9.1, 0.0, 1.0)[:, None] * [1, 1], "topic")
    noise = np.random.default_rng(0).standard_normal((len(jump.time), 2)) * 1e-3
    out = grid(u=Series(jump.time, jump.values + noise, "topic"), y_i=series(t), y_o=series(uniform(20, 0.008)))
    (a, b), (c, d) = out.segments
    assert b == c
    assert np.abs(out.signals["u"][a:b]).max() < 0.01
    assert np.abs(out.signals["u"][c:d] - 1).max() < 0.01


def test_rates_slower_than_100_hz_are_refused():
    t = uniform()
    with pytest.raises(TuningError, match=r"too slow: .*62\.5 Hz"):
        grid(u=series(t), y_i=series(uniform(Ts=0.016)), y_o=series(t))
