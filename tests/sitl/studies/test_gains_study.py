"""The table of gain sets with one seed and one vehicle: each figure against another way to it."""

import json

import numpy as np
import pytest

from mimopilot.common.long_work import run_pieces
from mimopilot.sitl.flight.scenario import AXES
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.sitl.studies import gains_study
from mimopilot.sitl.studies.attitude_study import AUTOTUNE, DEFAULT, MIMO, MIMO_THESIS, SISO, SISO_THESIS
from mimopilot.sitl.studies.gains_report import flown_medians, gains_figures, gains_tables, linear_medians
from mimopilot.sitl.studies.gains_run import (
    AMPLITUDES_DEG,
    BEST,
    BEST_FOLLOWING,
    BEST_SAME,
    LQG,
    MIMO_FOLLOWING,
    PERIODS,
    SETS,
    SISO_FOLLOWING,
)

NOISE = load_airframe("adam0_boom").airframe.noise.angle


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("gains")


@pytest.fixture(scope="module")
def found(folder):
    """The result of the command for the strongly coupled vehicle alone, and its run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gains_study, "VEHICLES", ("coupled",))
        result = gains_study.reproduce_gains(folder, 1, 2)
    return result, result.figures["adam0_boom"]["runs"]


def test_every_set_has_every_figure(found):
    result, (run,) = found
    assert tuple(run) == SETS
    for name in SETS:
        assert "refused" not in run[name], run[name]
        flights = run[name].get("flights", [])
        sizes = {(row["amplitude_deg"], row["period_s"]) for row in flights}
        assert sizes == (set() if name == LQG else {(a, p) for a in AMPLITUDES_DEG for p in PERIODS})
        assert all(np.isfinite(row[axis]["J_M_o"]) for row in flights for axis in AXES)
        assert run[name]["linear"]["spectral_radius"] < 1
    assert json.loads(json.dumps(result.as_json()))["report"].endswith("gains.html")


@pytest.mark.parametrize("name", [DEFAULT, AUTOTUNE, SISO, MIMO, BEST, MIMO_FOLLOWING])
def test_small_flights_agree_with_the_linear_figures(found, name):
    """Measured angles hold the noise of the estimate, too; that of the true angle is small."""
    _, (run,) = found
    size = np.radians(AMPLITUDES_DEG[0])
    for period, linear in zip(PERIODS, run[name]["linear"]["J_M"], strict=True):
        flown = flown_medians([run], name, AMPLITUDES_DEG[0], period)["J_M_o"]
        assert flown == pytest.approx(size**2 * linear + NOISE**2, rel=0.15, abs=3e-6)


@pytest.mark.parametrize("name", [SISO, MIMO, BEST, BEST_SAME, SISO_FOLLOWING, MIMO_FOLLOWING, BEST_FOLLOWING])
def test_designs_keep_their_limits_on_the_true_plant(found, name):
    _, (run,) = found
    assert run[name]["linear"]["Ms"] <= 1.6 * 1.01
    assert run[name]["linear"]["noise"] <= 1.5 * 1.01


def test_the_design_is_near_the_optimum_and_decouples(found):
    """At 15 and 22.5 degrees the motors saturate and the heading is off, which moves the other Euler angle, too."""
    _, (run,) = found
    assert run[MIMO]["model"] == run[BEST]["model"]  # so J_M is for one model
    for size, decoupled in zip(AMPLITUDES_DEG, (0.25, 0.4, 0.75), strict=True):
        for period in PERIODS:
            ours, best, siso = (flown_medians([run], name, size, period) for name in (MIMO, BEST, SISO))
            assert ours["J_M_o_own"] <= 1.15 * best["J_M_o_own"]
            assert ours["offaxis_rms_deg"] < decoupled * siso["offaxis_rms_deg"]


def test_for_one_attitude_model_the_optimum_is_better_than_what_flew(found):
    _, (run,) = found
    for size in AMPLITUDES_DEG[:2]:  # at 22.5 degrees the motors saturate, and linear figures do not count
        for period in PERIODS:
            best, flown = (flown_medians([run], name, size, period)["J_M_o"] for name in (BEST_SAME, DEFAULT))
            assert best < 0.8 * flown


def test_the_servo_shows_what_the_structure_costs(found):
    _, (run,) = found
    servo = run[LQG]["linear"]
    assert servo["noise"] == pytest.approx(1.5, rel=1e-3)
    for place in range(len(PERIODS)):
        assert servo["J_M"][place] < 0.2 * run[BEST_SAME]["linear"]["J_M"][place]
    # It asks for more than the motors have, and its margin is none that would be certified.
    assert servo["torque"][0] > 1.0
    assert servo["Ms"] > 2.5
    assert "flights" not in run[LQG]


def test_only_sets_with_a_model_are_judged_by_it(found):
    _, (run,) = found
    for name in (DEFAULT, AUTOTUNE):
        assert "J_M_o_own" not in flown_medians([run], name, 5.0, 0.8)
    for name in (SISO_THESIS, MIMO_THESIS, BEST_SAME):  # 10 rad/s, 0.7
        figures = flown_medians([run], name, 5.0, 0.8)
        assert figures["J_M_o_own"] == figures["J_M_o"]


def test_medians_are_over_the_runs_that_have_a_set(found):
    _, (run,) = found
    other = {name: dict(one) for name, one in run.items()}
    other[MIMO] = {"refused": "too short"}
    other[DEFAULT]["linear"] = run[DEFAULT]["linear"] | {"Ms": run[DEFAULT]["linear"]["Ms"] + 1.0}
    assert linear_medians([run, other], DEFAULT)["Ms"] == pytest.approx(run[DEFAULT]["linear"]["Ms"] + 0.5)
    assert gains_figures([run, other])["medians"][MIMO]["runs"] == 1
    assert any("refused in 1" in cell for row in gains_tables("x", [run, other])[-1].rows for cell in row)
    assert any(cell == "refused: too short" for row in gains_tables("x", [other])[-1].rows for cell in row)


def test_the_tables_fit_into_100_columns(found):
    result, _ = found
    for table in result.tables:
        widths = [max(len(cell) for cell in column) for column in zip(table.columns, *table.rows, strict=True)]
        assert 1 + sum(widths) + 3 * (len(widths) - 1) + 1 <= 100
        assert len(table.caption) <= 100


def test_a_finished_study_is_not_computed_again(folder, found, monkeypatch):
    monkeypatch.setattr(gains_study, "VEHICLES", ("coupled",))

    def refuse(pieces, out, workers, what):
        return run_pieces(pieces, out, 0, what)  # without workers nothing can be computed

    monkeypatch.setattr(gains_study, "run_pieces", refuse)
    again = gains_study.reproduce_gains(folder, 1, 2)
    assert again.figures == found[0].figures
    assert again.report.read_bytes() == found[0].report.read_bytes()
