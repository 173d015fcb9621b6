"""The measured response of an airframe and its error beside the exact response."""

from dataclasses import replace

import numpy as np
import pytest

from mimopilot.sitl.physics.airframe import Frame, load_airframe
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.plant.frequency_response import (
    PlantResponse,
    _angles_from_rates,
    measured_plant,
    plant_response,
)
from tests.tuning.truth import TS, experiment, linear_plant

AIRFRAMES = ("adam0", "adam0_boom", "adam0_flexible", "adam0_nominal", "adam0_perturbed", "antr", "px4_sih")


def relative(found, true):
    return np.linalg.norm(found - true, axis=(1, 2)) / np.linalg.norm(true, axis=(1, 2))


@pytest.mark.parametrize("name", AIRFRAMES)
def test_the_measured_response_is_that_of_the_airframe(name):
    """Thrust is the square of a rotor's speed, and angles are large at low frequencies: right to a few percent."""
    plant = measured_plant(experiment(name, amplitude=0.05 if name == "antr" else 0.15))
    exact = linear_plant(load_airframe(name).airframe).frequency_response(plant.omega)
    band = (plant.omega > 4) & (plant.omega < 60)
    assert plant.known()[band].all()
    claimed = np.linalg.norm(plant.deviation(), axis=(1, 2)) / np.linalg.norm(plant.G_i, axis=(1, 2))
    assert np.max((relative(plant.G_i, exact[:, :2]) - 3 * claimed)[band]) < 0.03
    assert np.median(relative(plant.G_i, exact[:, :2])[band]) < 0.03
    assert np.median(relative(plant.G_o, exact[:, 2:])[band]) < 0.03


@pytest.mark.parametrize(("hz", "gain"), [(12.0, 0.4), (25.0, 0.4), (25.0, 0.8), (30.0, 0.4)])
def test_a_frame_mode_is_found_at_its_frequency(hz, gain):
    body = load_airframe("adam0").airframe.model_copy(update={"frame": Frame(frequency_hz=hz, damping=0.02, gain=gain)})
    plant = measured_plant(experiment("adam0", airframe=body))
    exact = linear_plant(body).frequency_response(plant.omega)
    w = 2 * np.pi * hz
    near = (plant.omega > 0.95 * w) & (plant.omega < 1.05 * w)
    assert np.diff(plant.omega[near]).max() < 0.02 * w
    top = near & (np.linalg.norm(exact[:, :2], axis=(1, 2)) > 0.5 * np.linalg.norm(exact[near, :2], axis=(1, 2)).max())
    assert np.median(relative(plant.G_i, exact[:, :2])[top]) < 0.2
    size = np.linalg.norm(plant.G_i, axis=(1, 2))
    assert plant.omega[near][np.argmax(size[near])] == pytest.approx(w, rel=0.02)
    # The response of a rigid frame is much smaller there.
    rigid = linear_plant(load_airframe("adam0").airframe).frequency_response(np.array([w]))[:, :2]
    assert size[near].max() > 4 * np.linalg.norm(rigid)


def test_the_error_is_that_of_repeated_flights():
    """Rates and, above the first octaves, angles; 16 flights with other noise and other excitation of the same size."""
    plants = [measured_plant(experiment("adam0", seed, seconds=10.0)) for seed in range(16)]
    omega = plants[0].omega
    band = (omega > 20) & (omega < 80)
    for name in ("G_i", "G_o"):
        values = np.array([getattr(plant, name)[band] for plant in plants])
        spread = np.sqrt(np.mean(np.abs(values - values.mean(axis=0)) ** 2, axis=0) * 16 / 15)
        if name == "G_i":
            claimed = np.mean([plant.deviation()[band] for plant in plants], axis=0)
        else:
            draws = [plant.draw(np.random.default_rng(k)).G_o[band] for plant in plants[:4] for k in range(32)]
            means = np.repeat([plant.G_o[band] for plant in plants[:4]], 32, axis=0)
            claimed = np.sqrt(np.mean(np.abs(np.array(draws) - means) ** 2, axis=0))
        # Smoothing counts overlapping windows as half as many: the error is slightly above the spread.
        assert 0.6 < np.median(spread / claimed) < 1.25


def synthetic(omega, error=0.0, coherence=1.0, K=100.0):
    """An integrating body with the same relative error of every element."""
    s = 1j * omega[:, None, None]
    G, root = K / s * np.eye(2), np.zeros((len(omega), 6, 6))
    root[:, 2, 2] = root[:, 3, 3] = error * K / omega
    reach, coherences = np.tile(np.eye(2), (len(omega), 1, 1)), np.full((len(omega), 2), coherence)
    return PlantResponse(omega, G, G / s, root, reach, coherences, TS)


def test_noise_beyond_the_band_does_not_change_the_angles_within():
    omega = np.geomspace(4, 600, 120)
    plant = synthetic(omega, 0.05)
    beyond = omega > 100
    # There the rates are noise that looks known, and the angles are those of another body.
    coherence = np.where((omega > 60)[:, None] & ~beyond[:, None], 0.0, plant.coherence)
    unknown = (omega > 60) & ~beyond
    root = plant.root.astype(complex)
    root[unknown] *= 100
    odd = replace(
        plant, G_o=np.where(beyond[:, None, None], 300 * plant.G_o, plant.G_o), coherence=coherence, root=root
    )
    assert odd.known()[beyond].all() and odd.omega[odd.known_run()[-1]] <= 60
    found = _angles_from_rates(odd)
    assert found.G_o[~beyond] == pytest.approx(plant.G_o[~beyond])


def test_the_deviation_is_that_of_drawn_plants():
    omega = np.linspace(2, 20, 10)
    plant = synthetic(omega, 0.1)
    rng = np.random.default_rng(0)
    draws = np.array([plant.draw(rng).G_i - plant.G_i for _ in range(4000)])
    assert plant.deviation() == pytest.approx(np.sqrt(np.mean(np.abs(draws) ** 2, axis=0)), rel=0.06)
    assert plant.deviation()[0] == pytest.approx(np.full((2, 2), 0.1 * 100 / 2))
    assert plant.relative_error() == pytest.approx(0.0)


@pytest.mark.parametrize(
    ("error", "coherence", "known"),
    [
        # Frobenius norms: 0.2 for each element is 0.28 for the matrix.
        (0.2, 0.1, True),
        (0.23, 0.1, False),
        (0.23, 0.71, True),
        (0.48, 0.71, True),
        (0.51, 0.71, False),
        (0.3, 0.69, False),
    ],
)
def test_a_response_is_known_by_its_coherence_or_by_its_error(error, coherence, known):
    assert (synthetic(np.linspace(2, 20, 10), error, coherence).known() == known).all()


def test_one_axis_without_coherence_is_not_known():
    plant = synthetic(np.linspace(2, 20, 10), 0.3)
    assert plant.known().all()
    plant.coherence[3, 1] = 0.5
    assert np.flatnonzero(~plant.known()).tolist() == [3]


def test_a_small_gap_does_not_end_the_known_band_and_a_large_one_does():
    omega = np.arange(1.0, 60.0)
    for lacking, last in (((19, 22), 59.0), ((19, 30), 19.0), ((40, 56), 40.0)):
        plant = synthetic(omega)
        plant.coherence[lacking[0] : lacking[1]] = 0.0
        plant.root[lacking[0] : lacking[1]] += np.eye(6) * 1e3
        run = plant.omega[plant.known_run()]
        # With nothing from 20 to 30 rad/s the side below has fewer frequencies, but four octaves against one.
        assert (run[0], run[-1]) == (1.0, last)
    poor = synthetic(omega)
    poor.root[:3] *= 0
    poor.root[:3, 2, 2] = poor.root[:3, 3, 3] = 0.3 * 100 / omega[:3]
    assert poor.known().all()
    assert poor.omega[poor.known_run()][0] == 4.0  # it begins where the error is small
    nothing = synthetic(omega, 5.0, 0.0)
    assert len(nothing.known_run()) == 0
    assert nothing.band(0) is None


def test_interpolation_is_exact_for_a_damped_body():
    """Exact for a damped body, close for a vehicle with motors."""
    omega = np.arange(1.3, 100.0, 1.3)
    K = np.array([[80.0, -8.0], [-7.0, 90.0]])
    s = 1j * omega[:, None, None]
    plant = replace(synthetic(omega), G_i=K / (s + 1.5), G_o=K / (s + 1.5) / s)
    body = plant.interpolated(0.05)
    s = 1j * body.omega[:, None, None]
    assert body.G_i == pytest.approx(K / (s + 1.5), rel=1e-12)
    assert body.G_o == pytest.approx(K / (s + 1.5) / s, rel=1e-12)
    assert np.max(body.omega[1:] / body.omega[:-1]) < 1.05 + 1e-9
    assert set(omega) <= set(body.omega)
    truth = linear_plant(load_airframe("adam0").airframe)
    exact = truth.frequency_response(omega)
    between = replace(plant, G_i=exact[:, :2], G_o=exact[:, 2:]).interpolated(0.05)
    assert relative(between.G_i, truth.frequency_response(between.omega)[:, :2]).max() < 0.02


def test_the_response_is_extended_downwards_as_an_integrating_body():
    plant = synthetic(np.arange(3.0, 30.0), 0.1).extended()
    s = 1j * plant.omega[:, None, None]
    assert plant.omega[0] == pytest.approx(1.0)
    assert plant.G_i == pytest.approx(100 / s * np.eye(2))
    assert plant.G_o == pytest.approx(100 / s**2 * np.eye(2))
    assert plant.deviation()[0] == pytest.approx(3 * plant.deviation()[2])


@pytest.mark.parametrize(("name", "said"), [("y_i", "rates"), ("y_o", "angles")])
def test_a_log_with_roll_in_place_of_pitch_is_refused(name, said):
    log = experiment("adam0", seconds=10.0)
    twice = replace(log, **{name: np.repeat(getattr(log, name)[:, :1], 2, axis=1)})
    with pytest.raises(TuningError, match=f"roll and pitch {said} are the same signal"):
        measured_plant(twice)


def test_a_torque_that_does_not_move_both_axes_is_refused():
    log = experiment("adam0", seconds=10.0)
    with pytest.raises(TuningError, match="not excited: the external signal does not move every torque"):
        plant_response(replace(log, u=np.repeat(log.u[:, :1], 2, axis=1)), log.u_bar)
