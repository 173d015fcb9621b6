import json

import numpy as np
import pytest

from mimopilot.common.console import print_table
from mimopilot.sitl.studies.benchmark_figures import spread_figure
from mimopilot.sitl.studies.benchmark_studies import gain_spread, run_cbt, run_ift, study_lv100
from mimopilot.sitl.studies.benchmarks import excitation, lv100
from mimopilot.sitl.studies.reproduce import reproduce
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.estimation.cbt_ift import correlation_based_tuning, iterative_feedback_tuning
from mimopilot.tuning.law_filters import Filters
from mimopilot.tuning.loop_controller import LoopController, closed_loop
from tests.conftest import assert_one_clear_line


@pytest.mark.parametrize("seed", [100, 101, 102])
def test_correlation_based_tuning_needs_eight_experiments(seed):
    task = lv100()
    found = run_cbt(task, seed)
    assert found.experiments == 8
    assert task.cost(found.controller) <= 0.060


@pytest.mark.parametrize("seed", [100, 101, 102])
def test_iterative_feedback_tuning_converges_in_six_iterations_and_at_most_500_experiments(seed):
    task = lv100()
    found = run_ift(task, seed)
    assert len(found.costs) == 7
    assert found.experiments <= 500
    assert task.cost(found.controller) <= 0.080
    # It measures what it minimises: J_MR, from 0.88 with the initial controller.
    assert found.costs[-1] == pytest.approx(task.cost(found.controller), rel=0.1)


def test_every_requested_experiment_is_counted():
    task, asked = lv100(), []
    generator = np.random.default_rng(0)

    def experiment(controller, r, u_bar):
        asked.append(float(np.abs(u_bar).max()))
        return task.run(controller, r, u_bar, generator)

    r = generator.choice([-1.0, 1.0], (300, 2))
    found = iterative_feedback_tuning(experiment, task.initial, task.models, r, iterations=2, repetitions=1)
    assert found.experiments == len(asked) == 1 + 2 * (8 + 3)
    assert max(asked) == pytest.approx(1.0)  # never injects more than the amplitude
    asked.clear()
    w = excitation(500, "together", generator)[:, 0]
    assert correlation_based_tuning(experiment, task.models, w, repetitions=3).experiments == len(asked) == 6


def test_a_budget_that_does_not_allow_one_iteration_is_refused():
    task = lv100()
    with pytest.raises(TuningError, match="expected 84 or more"):
        iterative_feedback_tuning(lambda c, r, u: (u, r), task.initial, task.models, np.ones((10, 2)), most=50)


def test_repeated_tunings_agree_with_table_5_2():
    task = lv100()
    gains = {N: gain_spread(task, N, 100, 0) for N in (1000, 10_000)}
    printed = task.printed["table_5_2"]
    for t, term in enumerate(("Kp", "Ki")):
        for element, figures in printed[term].items():
            i, j = (int(v) - 1 for v in element.split(","))
            mean = abs(gains[10_000][:, t, i, j].mean())
            # The thesis does not print its amplitude: means agree to 15 % or three of its deviations.
            assert abs(mean - figures["mean_1e4"]) < max(0.15 * figures["mean_1e4"], 3 * figures["std_1e4"])
    ratio = gains[1000].std(axis=0) / gains[10_000].std(axis=0)
    # Ten times the data: the spread falls by the root of ten, 3.16.
    assert np.median(ratio) == pytest.approx(np.sqrt(10), rel=0.2)


def test_the_numerical_example_beside_table_5_3(tmp_path):
    found = reproduce("numerical-example", tmp_path)
    table = found.figures["numerical-example"]["table_5_3"]
    for key in ("B0", "B1"):
        assert np.array(table["MIMO"][key]) == pytest.approx(
            np.array(table["MIMO, Table 5.3 as printed"][key]), abs=5.1e-4
        )
    assert table["MIMO"]["J_MR"] < 1e-12
    # Each axis has the ideal controller of its own element: 0.1/g (z - 0.9048).
    assert np.diag(table["SISO"]["B0"]) == pytest.approx([0.1 / 0.09516, 0.1 / 0.04758], rel=1e-3)
    first = found.report.read_bytes()
    assert b"Table 5.3" in first
    assert reproduce("numerical-example", tmp_path).report.read_bytes() == first


def test_lv100_has_every_table_and_figure_and_is_reproducible(capsys):
    found = study_lv100(runs=4, seeds=1)
    text = " ".join([section.heading + section.text for section in found.sections])
    text += " ".join(cell for table in found.tables for row in [[table.caption], *table.rows] for cell in row)
    for word in ("Table 5.1", "Table 5.2", "Figure 5.1", "Figure 5.2", "CbT", "IFT", "469", "as printed"):
        assert word in text
    charts = [chart.name for section in found.sections for chart in section.charts]
    assert charts == ["lv100-sensitivity", "lv100-steps"]
    assert sum(figure.startswith("<svg") for section in found.sections for figure in section.figures) == 2
    assert json.dumps(found.figures)
    assert study_lv100(runs=4, seeds=1).as_json()["sections"] == found.as_json()["sections"]
    for table in found.tables:
        print_table(table.caption, table.columns, table.rows)
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 80
    # Nothing is cut: each row of a matrix on its own line, with the cost and the runs beside the first.
    first, second = found.tables[0].rows[-2:]
    assert first == ["VRFT, (2,1) corrected", "0.3552 z - 0.07165", "0.3997 z - 0.2918", "0.0562", ""]
    assert second == ["Table 5.1 as printed", "19.8 z - 19.2", "-3.151 z + 2.215", "", ""]


def test_figure_5_2_shows_every_run_and_their_mean():
    task = lv100()
    gains = gain_spread(task, 1000, 3, 0)
    figure = spread_figure(task, gains, 40, "steps")
    panel = figure.axes[1]  # output 1, setpoint 2
    runs, (wanted, mean) = panel.lines[:3], panel.lines[3:]
    steps = np.array([line.get_ydata() for line in runs])
    assert mean.get_ydata() == pytest.approx(steps.mean(axis=0))
    assert not np.any(wanted.get_ydata())
    inputs = np.zeros((40, 6))
    inputs[:, 1] = 1.0
    loop = LoopController({"P": gains[1, 0], "I": gains[1, 1]}, Filters(0.1))
    assert steps[1] == pytest.approx(closed_loop(task.plant, loop).simulate(inputs)[:, 2])


def test_the_command_prints_one_json_object_and_refuses_an_unknown_study(mimopilot):
    result = mimopilot("reproduce", "numerical-example", "--out", "o", "--json")
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["numerical-example"]["table_5_3"]["SISO"]["J_MR"] == pytest.approx(
        0.0227, abs=1e-3
    )
    assert mimopilot("reproduce", "table-9").returncode == 2


def test_identify_shows_the_rate_dynamics_of_a_flown_experiment(mimopilot, tmp_path):
    log = tmp_path / "flight.ulg"
    assert mimopilot("experiment", "adam0", "--seconds-per-axis", "8", "--out", log).returncode == 0
    result = mimopilot("identify", log, "--out", "plant.toml", "--json")
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout)
    assert len(found["poles"]) == found["order"] == len(found["A"])
    assert min(found["fit_percent"]) > 80
    assert f"Ts = {found['Ts']}" in (tmp_path / "plant.toml").read_text()
    assert_one_clear_line(mimopilot("identify", log, "--past", "5", "--future", "9"), "future")
