import warnings
from dataclasses import replace

import numpy as np
import pytest

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.law_filters import Filters
from mimopilot.tuning.logs.reader import read_log
from mimopilot.tuning.loop_controller import LoopController, closed_loop
from mimopilot.tuning.plant.frequency_response import measured_plant
from mimopilot.tuning.plant.pbsid import pbsid
from mimopilot.tuning.plant.rates_model import fit, identify_rates, pbsid_by_response
from mimopilot.tuning.statespace import StateSpace
from tests.paths import DATA

TS = 0.1
#: Two coupled outputs; one pole outside the unit circle, so that it can only be identified in closed loop.
PLANT = StateSpace(
    np.array([[1.02, 0.05, 0.0], [0.0, 0.7, 0.2], [0.0, -0.2, 0.7]]),
    np.array([[0.3, 0.1], [0.2, -0.4], [0.1, 0.5]]),
    np.array([[1.0, 0.2, 0.0], [0.1, 1.0, 0.3]]),
    np.zeros((2, 2)),
    TS,
)
CONTROLLER = LoopController({"P": np.diag([0.4, 0.2])}, Filters(TS))


def closed_loop_data(samples, noise=0.1, seed=0):
    rng = np.random.default_rng(seed)
    loop = closed_loop(PLANT, CONTROLLER)
    assert loop.stable
    w = np.hstack(
        [np.zeros((samples, 2)), rng.choice([-1.0, 1.0], (samples, 2)), noise * rng.standard_normal((samples, 2))]
    )
    signals = loop.simulate(w)
    return signals[:, :2], signals[:, 2:], w[:, 2:4]


def response_error(plant):
    omega = np.linspace(0.3, np.pi / TS, 200)
    true, found = PLANT.frequency_response(omega), plant.frequency_response(omega)
    return np.linalg.norm(true - found) / np.linalg.norm(true)


def test_an_unstable_plant_is_found_from_closed_loop_data():
    u, y, _ = closed_loop_data(20000)
    model = pbsid(u, y, TS)
    assert model.order == 3
    assert model.plant.poles == pytest.approx(PLANT.poles, abs=0.01)
    assert response_error(model.plant) < 0.02


def test_the_error_falls_as_one_over_the_root_of_the_sample_count():
    def median(samples):
        return np.median(
            [
                response_error(pbsid(*closed_loop_data(samples, seed=s)[:2], TS, order=3, past=10).plant)
                for s in range(8)
            ]
        )

    # Nine times the data: a third of the error.
    assert 2 < median(1000) / median(9000) < 4.5


def test_without_noise_the_plant_is_exact():
    u, y, _ = closed_loop_data(600, noise=1e-5)
    model = pbsid(u, y, TS, order=3, past=6)
    assert response_error(model.plant) < 1e-4
    assert pbsid(u, y, TS, past=6).order == 3


def test_a_direct_term_needs_the_external_signal_in_closed_loop():
    plant = StateSpace(0.8 * np.eye(2), np.eye(2), np.eye(2), np.array([[0.5, 0.1], [0.0, 0.3]]), TS)
    loop = closed_loop(plant, LoopController({"P": 0.3 * np.eye(2)}, Filters(TS)))
    rng = np.random.default_rng(1)
    u_bar, v = rng.choice([-1.0, 1.0], (20000, 2)), rng.standard_normal((20000, 2))
    signals = loop.simulate(np.hstack([0 * v, u_bar, v]))
    u, y = signals[:, :2], signals[:, 2:]
    right = pbsid(u, y, TS, order=2, external=u_bar).plant.D
    wrong = pbsid(u, y, TS, order=2, external=u).plant.D
    assert right == pytest.approx(plant.D, abs=0.05)
    assert np.abs(wrong - plant.D).max() > 0.1


def test_the_prediction_leaves_the_innovation_and_the_simulation_the_noise():
    u, y, _ = closed_loop_data(8000, noise=0.1)
    model = pbsid(u, y, TS, order=3)
    error = y - model.predict(u, y)
    assert np.cov(error[100:].T) == pytest.approx(model.covariance, rel=0.05, abs=5e-4)
    lagged = np.corrcoef(error[101:, 0], error[100:-1, 0])[0, 1]
    assert abs(lagged) < 0.04
    with pytest.raises(TuningError, match=r"pole at modulus 1\.0"):
        model.simulate(u)


def test_segments_are_not_joined_across_a_gap():
    u, y, _ = closed_loop_data(6000, noise=1e-5)
    y[3000:3100] = 1e3  # samples between segments must not matter
    model = pbsid(u, y, TS, order=3, past=6, segments=[(0, 3000), (3100, 6000)])
    assert response_error(model.plant) < 1e-4


def test_the_fit_is_a_percentage_of_the_deviation():
    y = np.array([[1.0], [-1.0], [1.0], [-1.0]])
    assert fit(y, y) == pytest.approx([100.0])
    assert fit(y, 0.75 * y) == pytest.approx([75.0])


def test_windows_orders_and_data_that_cannot_work_are_refused():
    u, y, _ = closed_loop_data(500)
    with pytest.raises(TuningError, match="1 <= future <= past"):
        pbsid(u, y, TS, past=10, future=11)
    with pytest.raises(TuningError, match=r"order 40; expected 1\.\.39"):
        pbsid(u, y, TS, order=40)
    with pytest.raises(TuningError, match="too short"):
        pbsid(u[:200], y[:200], TS)
    with pytest.raises(TuningError, match="not excited"):
        pbsid(0 * u, y, TS)


@pytest.fixture(scope="module", params=["coupled", "symmetric"])
def genuine(request):
    """A PX4 flight and its response."""
    log = read_log(DATA / f"px4_sih_{request.param}.mat")
    return log, measured_plant(log)


def test_a_px4_flight_gets_an_order_that_fits_its_response(genuine):
    log, plant = genuine
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = identify_rates(log, plant)
    assert found.model.predictor_stable
    assert found.response_percent > 80
    sure = plant.at(plant.known() & (plant.rate_error() < 0.05))
    modelled = found.model.plant.frequency_response(sure.omega)
    off = np.linalg.norm(sure.omega[:, None, None] * (modelled - sure.G_i))
    assert off < 0.1 * np.linalg.norm(sure.omega[:, None, None] * sure.G_i)
    assert (found.one_step_percent > 50).all()


def test_a_given_order_that_diverges_is_refused(genuine):
    """Any order has a stable predictor or is refused, and nothing overflows."""
    log, plant = genuine
    refused = 0
    for order in (1, 2, 3, 30):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                assert identify_rates(log, plant, order=order).model.predictor_stable
            except TuningError as error:
                assert f"the predictor of order {order} is not stable" in str(error)
                refused += 1
    assert refused >= 1


def test_the_order_by_response_is_that_of_the_plant():
    u, y, _ = closed_loop_data(20000)
    omega = np.linspace(0.3, np.pi / TS, 100)
    true = PLANT.frequency_response(omega)
    model, percent = pbsid_by_response(u, y, TS, omega, true, 0.01 * np.abs(true))
    assert model.order == 3
    assert percent > 97
    assert response_error(model.plant) < 0.02


def test_a_model_that_does_not_fit_the_response_is_refused():
    u, y, _ = closed_loop_data(4000)
    omega = np.linspace(0.3, np.pi / TS, 100)
    with pytest.raises(TuningError, match=r"no model of order 1 to 12 fits .* \(best fit -\d+ %"):
        pbsid_by_response(u, y, TS, omega, -PLANT.frequency_response(omega), np.full((len(omega), 2, 2), 1e-3))


def test_a_log_without_any_known_frequency_is_refused(genuine):
    log, plant = genuine
    unknown = replace(plant, root=plant.root * 1e6, coherence=0 * plant.coherence)
    with pytest.raises(TuningError, match="not excited: the rate response is known at no frequency"):
        identify_rates(log, unknown)
