"""Repeated experiments: each log is tuned by itself, and the distributions of the gains are reported."""

import json

import numpy as np
import pytest

from mimopilot.sitl.flight.excitation_flight import ExperimentPlan, log_name, repeat_experiment
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.tuning.design.cascade import tune
from mimopilot.tuning.design.many_logs import PAIRS, find_logs
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains_file import load_gains
from mimopilot.tuning.logs.reader import read_log
from mimopilot.tuning.parameters import MATRICES
from tests.conftest import assert_one_clear_line


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Four experiments with the same excitation, and a file that is not a log."""
    folder = tmp_path_factory.mktemp("logs")
    vehicle = load_airframe("adam0")
    plan = ExperimentPlan(vehicle.airframe, vehicle.default_gains(), 10.0, 0.15, 50.0, 7)
    flown = []
    assert repeat_experiment(plan, folder, range(3, 7), 2, lambda: flown.append(1)) == {}
    assert len(flown) == 4
    (folder / "notes.ulg").write_text("nothing")
    return folder


def test_runs_of_an_experiment_differ_by_their_seeds_and_share_the_excitation(logs, mimopilot, tmp_path):
    options = ["--seconds-per-axis", 10, "--seed", 5, "--excitation-seed", 7, "--out", "one.ulg"]
    assert mimopilot("experiment", "adam0", *options).returncode == 0
    assert log_name(logs, 5).read_bytes() == (tmp_path / "one.ulg").read_bytes()
    first, second = (read_log(log_name(logs, seed)) for seed in (3, 4))
    assert (first.u_bar == second.u_bar).all()
    assert (first.y_i != second.y_i).any()


def test_a_campaign_tunes_each_log_by_itself_and_reports_the_distributions(logs, mimopilot, tmp_path):
    finished = mimopilot("tune", logs, "--campaign", "--out", "tuned", "--json")
    assert finished.returncode == 0, finished.stderr
    found = json.loads(finished.stdout)
    assert (found["logs"], found["tuned"], sum(found["verdicts"].values())) == (5, 4, 4)
    assert list(found["refusals"]) == ["notes.ulg"]
    sets = [load_gains(path) for path in sorted((tmp_path / "tuned" / "gains").iterdir())]
    assert (sets[2].Kp_i == tune(read_log(log_name(logs, 5))).Kp_i).all()
    elements = {(one["matrix"], one["pair"]): one for one in found["gains"]}
    assert len(elements) == 16
    for (matrix, pair), one in elements.items():
        i, j = divmod(PAIRS.index(pair), 2)
        values = np.array([getattr(gains, matrix)[i, j] for gains in sets])
        deviations = [gains.provenance.standard_deviation[matrix][i][j] for gains in sets]
        assert one["mean"] == pytest.approx(values.mean(), rel=1e-12)
        assert one["deviation"] == pytest.approx(values.std(ddof=1), rel=1e-9)
        assert one["predicted"] == pytest.approx(np.mean(deviations), rel=1e-12)
        assert one["quantiles"][1] == pytest.approx(np.median(values), rel=1e-12)
    svg = (tmp_path / "tuned" / "gains.svg").read_text()
    assert svg.startswith("<svg")
    assert {matrix for matrix, _ in elements} == set(MATRICES) - {"Kff_i", "Kff_o", "Kaff_i"}


def test_a_campaign_without_logs_is_refused(logs, mimopilot, tmp_path):
    two = [log_name(logs, 3), log_name(logs, 4)]
    (tmp_path / "empty").mkdir()
    assert_one_clear_line(mimopilot("tune", "empty", "--campaign", "--out", "t"), "no logs in this folder")
    assert_one_clear_line(
        mimopilot("tune", logs / "notes.ulg", "--campaign", "--out", "t"), "1 of 1 logs were refused", "notes.ulg"
    )
    both = mimopilot("tune", logs, "--campaign", "--repeat", two[0], "--out", "t")
    assert_one_clear_line(both, "--repeat: belongs to one log")
    assert not (tmp_path / "t").exists()
    with pytest.raises(TuningError, match="two logs are called flight-0003"):
        find_logs([logs, log_name(logs, 3)])
