"""VRFT of the cascade alone: against the thesis' pseudo-code, with each instrument, and its fallback."""

import dataclasses

import numpy as np
import pytest

from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.flight.scenario import excitation_flight
from mimopilot.sitl.flight.simulator import fly
from mimopilot.sitl.physics.airframe import Noise, load_airframe
from mimopilot.tuning.design.cascade import tune
from mimopilot.tuning.design.cascade_estimate import estimate
from mimopilot.tuning.design.quality_checks import check_band, check_estimates
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.estimation.instrumental_variables import align, instruments
from mimopilot.tuning.experiment import Experiment
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.reference_model import second_order
from tests.tuning.analysis.test_certify import experiment
from tests.tuning.literal import literal_cascade
from tests.tuning.truth import thesis

TS = 0.004
MATRICES = ("Kp_i", "Ki_i", "Kd_i", "Kp_o")


@pytest.fixture(scope="module")
def log():
    return experiment("adam0")


def test_the_fast_estimator_equals_the_pseudo_code_of_the_thesis(log):
    models = second_order(20, 0.4, 0, TS), second_order(10, 0.7, 0, TS)
    literal = literal_cascade(log.u, log.y_i, log.y_o, *models, TS, log.flown.derivative_cutoff_hz, 50)
    spec = thesis(weight="identity", instrument="u", trim=False, window=50)
    found = estimate(log, spec).gains
    for name, matrix in zip(MATRICES, literal, strict=True):
        assert getattr(found, name) == pytest.approx(matrix, rel=1e-9, abs=1e-9 * np.abs(matrix).max())


def noisy_flight(seed, excitation_seed=0, late=0, times=10.0):
    """ADAM-0 with `times` its noise, so that the instrument matters; `late` samples of hover come first."""
    vehicle = load_airframe("adam0")
    airframe = vehicle.airframe.model_copy(update={"noise": Noise(angle=0.003 * times, rate=0.01 * times)})
    gains = vehicle.default_gains()
    scenario = excitation_flight(16.0, 0.15, 50.0, TS, np.random.default_rng(excitation_seed))
    record = fly(airframe, Autopilot(airframe, gains), scenario, seed).record
    rows = [record[name][:, :2].astype(float) for name in ("moment", "rates", "attitude", "excitation")]
    u, y_i, y_o, u_bar = (np.vstack([row[:1].repeat(late, axis=0), row]) for row in rows)
    return Experiment(Ts=TS, u=u, y_i=y_i, y_o=y_o, u_bar=u_bar, flown=gains, source=f"flight {seed}")


@pytest.fixture(scope="module")
def noisy():
    return noisy_flight(1)


@pytest.mark.parametrize("method", ["mimo", "siso"])
def test_noise_changes_the_gains_of_every_instrument_by_at_most_three_deviations(noisy, method):
    still, second = noisy_flight(0, times=0.01), noisy_flight(2)
    for name in ("external", "model", "repeated"):
        spec = thesis(method=method, instrument=name, weight="identity")
        exact = estimate(still, spec, still if name == "repeated" else None).gains.Kp_i
        found = estimate(noisy, spec, second if name == "repeated" else None)
        error = np.diag(found.gains.Kp_i - exact)
        assert np.abs(error / np.diag(found.deviations()["Kp_i"])).max() < 3.0, name


def test_an_unexcited_stretch_does_not_harm_the_instrument_of_an_identified_model(log):
    segments = ((0, 5000), (5050, 9950))
    quiet = dataclasses.replace(log, segments=segments, u_bar=log.u_bar * (np.arange(len(log.u)) < 5000)[:, None])
    spec = thesis(instrument="model", structure="P")
    both_axes = dataclasses.replace(
        quiet, u_bar=quiet.u_bar + log.u_bar[::-1] * (np.arange(len(log.u)) < 5000)[:, None]
    )
    assert np.isfinite(estimate(both_axes, spec).gains.Kp_i).all()


def test_the_constant_takes_a_trim_moment_off_and_without_it_the_gains_are_wrong(log):
    trimmed = dataclasses.replace(log, u=log.u + np.array([0.05, -0.03]))
    clean = estimate(log, thesis()).gains
    assert estimate(trimmed, thesis()).gains.Ki_i == pytest.approx(clean.Ki_i, abs=1e-9)
    without = estimate(trimmed, thesis(trim=False)).gains
    assert np.abs(without.Ki_i - clean.Ki_i).max() > 0.05 * clean.Ki_i[0, 0]


@pytest.mark.parametrize("structure", ["P", "PD", "PI", "PIDF"])
def test_only_the_terms_that_are_asked_for_are_not_zero(log, structure):
    found = estimate(log, thesis(structure=structure))
    present = {"P": "Kp_i", "I": "Ki_i", "D": "Kd_i", "F": "Kff_i"}
    for term, matrix in present.items():
        assert (term in structure) == bool(getattr(found.gains, matrix).any())
    assert set(found.deviations()) == {present[term] for term in structure} | {"Kp_o"}


def test_a_second_flight_is_aligned_by_its_excitation(noisy):
    late = noisy_flight(2, late=137)
    first, second = align(noisy, late)
    assert np.array_equal(first.u_bar, second.u_bar)
    assert len(first.u) == len(noisy.u)
    assert second.segments == first.segments == ((0, len(noisy.u)),)
    with pytest.raises(TuningError, match="its excitation differs from that of flight 1"):
        align(noisy, noisy_flight(2, excitation_seed=5))
    with pytest.raises(TuningError, match=r"sampled every 0\.005 s"):
        align(noisy, dataclasses.replace(late, Ts=0.005))


def test_gaps_of_both_flights_are_excluded(noisy):
    second = noisy_flight(2, late=100)
    a = dataclasses.replace(noisy, segments=((0, 3000), (3100, 8000)))
    b = dataclasses.replace(second, segments=((200, 5100), (5150, 8100)))
    first, other = align(a, b)
    assert first.segments == other.segments == ((100, 3000), (3100, 5000), (5050, 8000))


def test_a_second_log_needs_the_instrument_repeated_and_the_other_way_round(noisy):
    for kind, repeat in (("repeated", None), ("external", noisy)):
        with pytest.raises(TuningError, match="only with it"):
            instruments(noisy, kind, repeat)


def negatively_damped(log):
    """A plant with negative damping: holding a rate takes negative torque, which gives a negative Ki."""
    return dataclasses.replace(log, u=log.u - 0.02 * log.y_i)


def test_a_rate_controller_without_inverse_is_replaced_by_its_model_with_a_warning(log):
    found = estimate(negatively_damped(log), thesis(refine=False))
    assert np.linalg.eigvalsh(found.gains.Ki_i + found.gains.Ki_i.T)[0] < 0
    (warning,) = found.warnings
    for text in ("not minimum phase: eigenvalues", "r_i = M_i^-1 y_i", "--structure PD"):
        assert text in warning
    # The rate loop is then its reference model: in closed form s Kp_o M_i = M_o at low frequency.
    assert np.diag(found.gains.Kp_o) == pytest.approx(4.5, rel=0.15)
    tuned = tune(negatively_damped(log), thesis(refine=False))
    assert PlantEstimates(log).body.least(tuned.Ki_i) > 0
    kept, slow = tuned.provenance.warnings[:2]
    assert "the integral gains from this log diverge" in kept
    assert "the inverse rate controller takes" in slow


def test_the_fallback_needs_an_outer_model_with_as_much_delay(log):
    with pytest.raises(TuningError, match="not a proper, stable filter"):
        estimate(negatively_damped(log), thesis(inner=(20.0, 0.4, 3)))


def test_a_bad_condition_number_gives_a_warning_and_a_worse_one_an_error(log):
    found = estimate(log, thesis())
    for condition, refused in ((2e3, False), (2e4, True)):
        solution = dataclasses.replace(found.inner[0].solution, condition=condition)
        loops = [dataclasses.replace(found.inner[0], solution=solution)]
        if refused:
            with pytest.raises(TuningError, match="hardly distinguishable"):
                check_estimates("log", found.stretches, loops, TS)
        else:
            assert any("hardly distinguishable" in text for text in check_estimates("log", found.stretches, loops, TS))


def test_an_excitation_below_the_bandwidth_is_reported_for_each_axis(log):
    from mimopilot.tuning.plant.frequency_response import measured_plant

    plant = measured_plant(log)
    assert check_band("log", plant, (20.0, 20.0)) == []
    fast = check_band("log", plant, (20.0, 250.0))
    assert len(fast) == 1
    assert fast[0].startswith("pitch is excited only from")
    unexcited = dataclasses.replace(plant, coherence=plant.coherence * [1.0, 0.5])
    with pytest.raises(TuningError, match="not excited on pitch"):
        check_band("log", unexcited, (20.0, 20.0))


def test_a_quotient_of_models_is_one_filter():
    fast, slow = second_order(20, 0.4, 1, TS), second_order(10, 0.7, 3, TS)
    quotient = slow.over(fast)
    omega = np.linspace(1, 700, 50)
    assert quotient.frequency_response(omega) == pytest.approx(
        slow.frequency_response(omega) / fast.frequency_response(omega), rel=1e-9
    )
    impulse = np.eye(1, 400)[0]
    assert fast.response(quotient.response(impulse)) == pytest.approx(slow.response(impulse), abs=1e-12)
    with pytest.raises(TuningError, match="not a proper"):
        fast.over(slow)
