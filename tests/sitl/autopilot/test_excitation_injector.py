"""The excitation injector: one run for each request, which ends when a condition fails."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mimopilot.sitl.autopilot.excitation_injector import NO_MOMENT, Conditions, ExcitationPhase, Injector
from mimopilot.tuning.excitation import prbs
from mimopilot.tuning.parameters import EXCITATION

TS = 0.004
HOVER = Conditions(True, 4, (0.0, 0.0), (0.0, 0.0, 0.0, 0.0))
DEFAULTS = {setting.name: setting.default for setting in EXCITATION}
SHORT = DEFAULTS | {"MIMO_EX_DUR": 0.8, "MIMO_EX_SEED": 5}
SAMPLES = 200


def requested(axis=3, **settings):
    injector = Injector(TS)
    injector.configure(SHORT | settings)
    injector.configure(SHORT | settings | {"MIMO_EX_AX": axis})
    return injector


def flown(injector, samples, conditions=HOVER):
    return np.array([injector.step(conditions) for _ in range(samples)])


def test_both_axes_get_the_prbs_of_the_tuner_one_after_the_other_once():
    injector = requested()
    moment = flown(injector, 2000)
    pause = round(1 / TS)
    for axis, start, seed in ((0, 0, 10), (1, SAMPLES + pause, 11)):
        expected = prbs(SAMPLES, 0.1, 10, 60, np.random.default_rng(seed))
        assert np.array_equal(moment[start : start + SAMPLES, axis], expected)
        moment[start : start + SAMPLES, axis] = 0
    assert not moment.any()
    assert injector.phase is ExcitationPhase.OFF
    assert injector.said[-1] == "excitation finished"


def test_yaw_is_the_last_of_all_axes_with_its_own_amplitude_and_longer_pulses():
    moment = flown(requested(5, MIMO_EX_AMPY=0.3), 2000)
    start = 2 * (SAMPLES + round(1 / TS))
    yaw = prbs(SAMPLES, 0.3, 20, 120, np.random.default_rng(12))
    assert np.array_equal(moment[start : start + SAMPLES, 2], yaw)
    moment[start : start + SAMPLES, 2] = 0
    assert np.array_equal(moment, flown(requested(3), 2000))


@pytest.mark.parametrize(("rate", "samples"), [(2.1, 0), (-2.1, 0), (1.9, 105), (-1.2, 166), (float("nan"), 0)])
def test_yaw_stops_when_it_turns_too_fast_or_too_far_and_roll_does_not(rate, samples):
    injector = requested(4, MIMO_EX_DUR=10.0)
    assert flown(injector, 100)[:, 2].all()
    turning = HOVER._replace(yaw_rate=rate)
    assert np.count_nonzero(flown(injector, 400, turning)) == pytest.approx(samples, abs=1)
    assert injector.said[-1] == "excitation stopped: turned too fast or too far"
    assert np.count_nonzero(flown(requested(1), 400, turning)) == SAMPLES


@pytest.mark.parametrize(("axis", "column"), [(1, 0), (2, 1), (4, 2)])
def test_one_axis_can_be_excited_alone(axis, column):
    moment = flown(requested(axis), 2 * SAMPLES)
    assert np.abs(moment[:SAMPLES, column]).min() > 0
    assert not np.delete(moment, column, axis=1).any()
    assert not moment[SAMPLES:].any()


@pytest.mark.parametrize(
    ("conditions", "words"),
    [
        (HOVER._replace(ready=False), "mode left"),
        (HOVER._replace(mode=18), "mode left"),
        (HOVER._replace(attitude=(0.0, -0.51)), "MIMO_EX_TILT"),
        (HOVER._replace(attitude=(float("nan"), 0.0)), "MIMO_EX_TILT"),
        (HOVER._replace(sticks=(0.0, 0.0, 0.0, 0.2)), "stick moved"),
    ],
)
def test_a_failed_condition_ends_the_run_at_once(conditions, words):
    injector = requested()
    assert flown(injector, 50)[:, 0].all()
    assert injector.step(conditions) == NO_MOMENT
    assert words in injector.said[-1]
    assert not flown(injector, 2000).any()


def test_zero_cancels_the_run_and_allows_another():
    injector = requested()
    first = flown(injector, 100)
    injector.configure(SHORT)
    assert injector.said[-1] == "excitation cancelled"
    assert not flown(injector, 10).any()
    injector.configure(SHORT | {"MIMO_EX_AX": 3})
    assert np.array_equal(flown(injector, 100), first)


def test_another_run_needs_zero_first_and_new_settings_wait_for_it():
    injector = requested()
    flown(injector, 100)
    injector.configure(SHORT | {"MIMO_EX_AX": 3, "MIMO_EX_AMP": 0.4})
    assert np.abs(flown(injector, 10)).max() == pytest.approx(0.1)
    flown(injector, 2000)
    injector.configure(SHORT | {"MIMO_EX_AX": 1})
    assert not flown(injector, 100).any()


def test_a_request_left_from_an_earlier_flight_starts_no_run():
    injector = Injector(TS)
    injector.configure(SHORT | {"MIMO_EX_AX": 3})
    assert not flown(injector, 1000).any()


def test_the_run_waits_for_its_mode_in_the_air():
    injector = requested()
    assert not flown(injector, 500, HOVER._replace(mode=17)).any()
    assert injector.phase is ExcitationPhase.WAITING
    assert flown(injector, SAMPLES)[:, 0].all()


def test_a_minimum_pulse_above_the_maximum_is_refused():
    injector = requested(MIMO_EX_HMIN=50, MIMO_EX_HMAX=20)
    assert "MIMO_EX_HMIN is above MIMO_EX_HMAX" in injector.said[-1]
    assert not flown(injector, 100).any()


@given(
    st.fixed_dictionaries(
        {
            s.name: (st.integers(int(s.minimum), int(s.maximum)) if s.integer else st.floats(s.minimum, s.maximum))
            for s in EXCITATION
        }
    ),
    st.lists(st.sampled_from([HOVER, HOVER._replace(ready=False), HOVER._replace(attitude=(2.0, 0.0))]), max_size=60),
)
def test_the_torque_never_exceeds_its_amplitude_and_is_zero_outside_of_flight(settings, flight):
    injector = Injector(TS)
    injector.configure(settings | {"MIMO_EX_AX": 0})
    injector.configure(settings)
    for conditions in flight:
        moment = injector.step(conditions)
        assert max(map(abs, moment[:2])) <= settings["MIMO_EX_AMP"] and abs(moment[2]) <= settings["MIMO_EX_AMPY"]
        if conditions is not HOVER:
            assert moment == NO_MOMENT
