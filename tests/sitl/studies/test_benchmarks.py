import numpy as np
import pytest

from mimopilot.sitl.studies.benchmarks import excitation, lv100, numerical_example
from mimopilot.tuning.design.refine_on_model import refine_on_model
from mimopilot.tuning.estimation.vrft import vrft
from mimopilot.tuning.law_filters import Filters
from mimopilot.tuning.loop_controller import LoopController, closed_loop
from mimopilot.tuning.plant.pbsid import pbsid

TS = 0.1
BEST = 0.0515


def printed(name, correct=False):
    table = lv100().printed["table_5_1"][name]
    B0, B1 = np.array(table["B0"]), np.array(table["B1"])
    if correct:
        B1[1, 0] = -19.2
    return LoopController.from_polynomial(B0, B1, TS)


@pytest.mark.parametrize(
    ("name", "correct", "figure"),
    [("VRFT", False, 0.0591), ("VRFT", True, 0.0562), ("CbT", False, 0.0587), ("IFT", False, 0.0788)],
)
def test_the_printed_controllers_have_their_known_cost(name, correct, figure):
    assert lv100().cost(printed(name, correct)) == pytest.approx(figure, abs=5e-5)


def test_the_best_pi_has_its_known_cost_and_refinement_on_the_true_plant_finds_it():
    task = lv100()
    best = LoopController.from_polynomial(
        [[0.4432, 0.4428], [22.94, -3.797]], [[-0.1291, -0.3331], [-22.17, 2.363]], TS
    )
    assert task.cost(best) == pytest.approx(BEST, abs=5e-5)
    found = refine_on_model(printed("IFT"), task.plant, task.models)
    assert task.cost(found.controller) <= task.cost(best) + 1e-6
    for got, known in zip(found.controller.polynomial(), best.polynomial(), strict=True):
        assert got == pytest.approx(known, rel=2e-3)


def test_the_initial_controller_as_printed_is_unstable_and_with_its_second_row_negated_is_not():
    task = lv100()
    as_printed = LoopController.from_polynomial(**task.printed["C0_printed"], Ts=TS)
    radius = [abs(closed_loop(task.plant, c).poles[0]) for c in (as_printed, task.initial)]
    assert radius == pytest.approx([1.0083, 0.9968], abs=5e-5)


def test_the_closed_loop_equals_plant_and_controller_computed_sample_by_sample():
    task, N = lv100(), 60
    rng = np.random.default_rng(3)
    r, u_bar = rng.standard_normal((2, N, 2))
    u, y = task.run(task.initial, r, u_bar, np.random.default_rng(5))
    v = task.deviation * np.random.default_rng(5).standard_normal((N, 2))
    assert y == pytest.approx(task.plant.simulate(u) + v, abs=1e-12)
    Kp, Ki = task.initial.gain("P"), task.initial.gain("I")
    assert u == pytest.approx((r - y) @ Kp.T + TS * np.cumsum(r - y, axis=0) @ Ki.T + u_bar, abs=1e-12)


def test_runs_computed_together_equal_runs_computed_one_by_one():
    task = lv100()
    u_bar = excitation(200, "together", np.random.default_rng(0))
    two = np.stack([u_bar, -u_bar], axis=1)
    still = np.zeros_like(two)
    quiet = np.random.default_rng(0)
    u, y = task.run(task.initial, still, two, quiet)
    alone = closed_loop(task.plant, task.initial)
    noise = task.deviation * np.random.default_rng(0).standard_normal(two.shape)
    for i in range(2):
        signals = alone.simulate(np.hstack([still[:, i], two[:, i], noise[:, i]]))
        assert np.hstack([u[:, i], y[:, i]]) == pytest.approx(signals, abs=1e-12)


@pytest.mark.parametrize("design", ["in turn", "together"])
def test_one_lv100_experiment_gives_a_controller_close_to_the_best_possible(design):
    # Requirement: median of 20 seeds at most 0.054 from one experiment of 5000 samples, amplitude 1.
    task = lv100()
    plain, refined = [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        u_bar = excitation(5000, design, rng)
        assert np.abs(u_bar).max() == 1.0
        u, y = task.run(task.initial, np.zeros_like(u_bar), u_bar, rng)
        start = LoopController(vrft(u, y, u_bar, task.models, "PI").gains, Filters(TS))
        model = pbsid(u, y, TS, external=u_bar)
        plain.append(task.cost(start))
        refined.append(task.cost(refine_on_model(start, model.plant, task.models).controller))
    assert np.median(refined) <= 0.0535
    assert max(refined) <= 0.058
    # Only by refinement: VRFT alone does not reach it.
    assert np.median(plain) > 0.056


def test_the_numerical_example_has_its_closed_form_controller():
    task = numerical_example()
    u = excitation(1000, "together", np.random.default_rng(0))
    u, y = task.run(None, np.zeros_like(u), u, np.random.default_rng(0))
    estimate = vrft(u, y, u, task.models, "PI", window=20, weight="identity")
    first, second = LoopController(estimate.gains, Filters(1.0)).polynomial()
    inverse = 0.1 * np.linalg.inv(task.plant.B)
    assert first == pytest.approx(inverse, rel=1e-8)
    assert second == pytest.approx(-0.9048 * inverse, rel=1e-8)
