"""Chapter 5 of the thesis: its two benchmarks computed again, beside the printed values."""

from __future__ import annotations

import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from mimopilot.common.charts import IS_NEW, IS_SISO, looks, svg
from mimopilot.common.html_report import ReportTable, Section
from mimopilot.sitl.studies.benchmark_figures import sensitivity_chart, spread_figure, step_chart
from mimopilot.sitl.studies.benchmarks import Benchmark, Signal, excitation, lv100, numerical_example
from mimopilot.sitl.studies.report_part import ReportPart
from mimopilot.tuning.design.refine_on_model import refine_on_model
from mimopilot.tuning.estimation.cbt_ift import Comparison, correlation_based_tuning, iterative_feedback_tuning
from mimopilot.tuning.estimation.siso import siso_vrft
from mimopilot.tuning.estimation.vrft import vrft
from mimopilot.tuning.law_filters import Filters
from mimopilot.tuning.loop_controller import LoopController
from mimopilot.tuning.plant.pbsid import pbsid

SAMPLES = 5000  # per experiment
IFT_SAMPLES = 1000  # per experiment of Iterative Feedback Tuning
RUNS, LENGTHS = 500, (1000, 10_000)  # experiments of Table 5.2, and their lengths in samples
CHUNK, WORKERS = 25, 2  # experiments simulated at once; threads
STEP = 60  # samples of a step response
SEEDS = 20  # experiments per design in the one-experiment comparison
CONTROLLER_COLUMNS = ("controller", "column 1", "column 2", "J_MR", "runs")
ONE_EXPERIMENT = "Noise variance 0.0025, amplitude 1. No method knows the plant; J_MR is computed on it."
SPREAD_COLUMNS = ("gain, N", "mean", "std", "printed |mean|", "printed std")


def one_experiment(task: Benchmark, design: str, seed: int, samples: int = SAMPLES) -> tuple[Signal, Signal, Signal]:
    """u_bar, u and y, each (samples, 2), of one experiment under the initial controller."""
    generator = np.random.default_rng(seed)
    u_bar = excitation(samples, design, generator)
    return u_bar, *task.run(task.initial, np.zeros_like(u_bar), u_bar, generator)


def tune_once(task: Benchmark, design: str, seed: int) -> dict[str, LoopController]:
    """Tune by every method that needs one experiment, on the same experiment.

    Parameters
    ----------
    task : Benchmark
    design : str
        See `sitl.studies.benchmarks.excitation`.
    seed : int

    Returns
    -------
    dict
        Method -> controller.
    """
    u_bar, u, y = one_experiment(task, design, seed)
    Ts, models = task.plant.Ts, task.models
    thesis = vrft(u, y, u, models, "PI", weight="identity")
    external = vrft(u, y, u_bar, models, "PI", weight="identity")
    optimal = LoopController(vrft(u, y, u_bar, models, "PI").gains, Filters(Ts))
    plant = pbsid(u, y, Ts, external=u_bar).plant
    return {
        "VRFT, instrument u, W = I (thesis)": LoopController(thesis.gains, Filters(Ts)),
        "VRFT, instrument u_bar, W = I": LoopController(external.gains, Filters(Ts)),
        "VRFT, instrument u_bar, optimal W": optimal,
        "VRFT, refined on a PBSID model": refine_on_model(optimal, plant, models).controller,
    }


def run_cbt(task: Benchmark, seed: int) -> Comparison:
    """Tune by Correlation-based Tuning: 8 experiments of 5000 samples, binary input of amplitude 1."""
    generator = np.random.default_rng(seed)
    w = generator.choice([-1.0, 1.0], SAMPLES)
    return correlation_based_tuning(lambda c, r, u: task.run(c, r, u, generator), task.models, w)


def run_ift(task: Benchmark, seed: int) -> Comparison:
    """Tune by Iterative Feedback Tuning: 6 iterations of 1000-sample experiments, binary setpoint of amplitude 1."""
    generator = np.random.default_rng(seed)
    r = generator.choice([-1.0, 1.0], (IFT_SAMPLES, 2))
    assert task.initial is not None
    return iterative_feedback_tuning(lambda c, r, u: task.run(c, r, u, generator), task.initial, task.models, r)


def gain_spread(task: Benchmark, samples: int, runs: int, seed: int) -> Signal:
    """Gains from repeated simulated experiments, as in Table 5.2.

    Parameters
    ----------
    task : Benchmark
    samples, runs : int
    seed : int

    Returns
    -------
    (runs, 2, 2, 2) array
        Run, Kp or Ki, row, column: VRFT with instrument u_bar and W = I, one axis after the other.
    """
    starts = range(0, runs, CHUNK)

    def chunk(start: int) -> list[Signal]:
        generator = np.random.default_rng([seed, samples, start])
        count = min(CHUNK, runs - start)
        u_bar = np.stack([excitation(samples, "in turn", generator) for _ in range(count)], axis=1)
        u, y = task.run(task.initial, np.zeros_like(u_bar), u_bar, generator)
        gains = []
        for i in range(count):
            found = vrft(u[:, i], y[:, i], u_bar[:, i], task.models, "PI", weight="identity").gains
            gains.append(np.stack([found["P"], found["I"]]))
        return gains

    with ThreadPoolExecutor(WORKERS) as pool:
        return np.array([gain for part in pool.map(chunk, starts) for gain in part])


def study_numerical_example() -> ReportPart:
    """Table 5.3 and Figure 5.3: noise-free MIMO and SISO VRFT."""
    task = numerical_example()
    half = 1000
    u = excitation(2 * half, "in turn", np.random.default_rng(0))
    u, y = task.run(None, np.zeros_like(u), u, np.random.default_rng(0))
    mimo = LoopController(vrft(u, y, u, task.models, "PI", weight="identity").gains, Filters(task.plant.Ts))
    axes = []
    for i, part in enumerate((slice(half), slice(half, None))):
        u_i, y_i = u[part, i : i + 1], y[part, i : i + 1]
        axes.append(siso_vrft(u_i, y_i, u_i, task.model, "PI", repeated=y_i, weight="identity"))
    diagonal = {term: np.diag([axis.gain(term).item() for axis in axes]) for term in "PI"}
    found = {"MIMO": mimo, "SISO": LoopController(diagonal, Filters(task.plant.Ts))}
    shown = _beside(found, _printed(task, "table_5_3"), "Table 5.3")
    table = ReportTable("Table 5.3: (B0 z + B1)/(z - 1), noise-free", CONTROLLER_COLUMNS, _rows(task, shown, {}))
    caption = "Figure 5.3: steps of the setpoints, MIMO and SISO VRFT."
    chart = step_chart("numerical-example-steps", caption, task, found, looks([IS_NEW, IS_SISO]), STEP)
    lead = (
        "The 2x2 numerical example of the thesis, tuned without noise: white inputs, one after the other, in open loop."
    )
    section = Section("Table 5.3 and Figure 5.3", "J_MR: (3.1), here on the true plant.", [table], charts=[chart])
    return ReportPart(lead, [section], {"table_5_3": _numbers(task, shown, {})})


def study_lv100(runs: int = RUNS, seeds: int = SEEDS) -> ReportPart:
    """Tables 5.1 and 5.2, Figures 5.1 and 5.2, and J_MR from one experiment over noise seeds.

    Parameters
    ----------
    runs : int
        Experiments per length in Table 5.2.
    seeds : int
        Experiments per design in the one-experiment comparison.
    """
    task = lv100()
    studies = {design: [tune_once(task, design, seed) for seed in range(seeds)] for design in ("in turn", "together")}
    comparisons = {"CbT": run_cbt(task, 0), "IFT": run_ift(task, 0)}
    begin = time.monotonic()
    gains = {N: gain_spread(task, N, runs, 0) for N in LENGTHS}
    seconds = time.monotonic() - begin

    medians = {
        design: {method: float(np.median([task.cost(run[method]) for run in studies[design]])) for method in tuned[0]}
        for design, tuned in studies.items()
    }
    refined = studies["together"][0]["VRFT, refined on a PBSID model"]
    ours = {**studies["in turn"][0], "VRFT, refined, both axes at once": refined}
    ours |= {name: comparison.controller for name, comparison in comparisons.items()}
    printed = _printed(task, "table_5_1")
    corrected = np.array(task.printed["table_5_1"]["VRFT"]["B1"])
    corrected[1, 0] = -19.2  # Table 5.1 contradicts Table 5.2, which has this value
    printed["VRFT with (2,1) corrected"] = LoopController.from_polynomial(
        printed["VRFT"].polynomial()[0], corrected, 0.1
    )
    experiments = {name: comparison.experiments for name, comparison in comparisons.items()}
    shown = _beside(ours, printed, "Table 5.1")
    rms = {d: [np.sqrt(np.mean(s**2, axis=0)).tolist() for s in one_experiment(task, d, 0)[1:]] for d in medians}

    tables = (
        ReportTable(
            "Table 5.1: (B0 z + B1)/(z - 1) by each method", CONTROLLER_COLUMNS, _rows(task, shown, experiments)
        ),
        ReportTable(
            f"J_MR from one experiment, N = {SAMPLES}: median of {seeds} seeds",
            ("method", *(f"axes {design}" for design in medians)),
            [[m, *(f"{medians[d][m]:.4f}" for d in medians)] for m in medians["in turn"]]
            + [["best possible 2x2 PI", *[f"{task.printed['J_MR']['best_2x2_PI']:.4f}"] * 2]]
            + [
                [f"rms of {name}, 1 / 2", *(f"{rms[d][i][0]:.2f} / {rms[d][i][1]:.2f}" for d in medians)]
                for i, name in enumerate(("u", "y"))
            ],
        ),
        ReportTable(f"Table 5.2: gains of {runs} experiments per length", SPREAD_COLUMNS, _spread_rows(task, gains)),
    )
    main = {
        name: ours[name] for name in ("VRFT, instrument u_bar, W = I", "VRFT, refined on a PBSID model", "CbT", "IFT")
    }
    colours = looks([IS_NEW] * len(main))
    sections = [
        Section(
            "Table 5.1 and Figure 5.1",
            "CbT: 8 experiments in open loop. IFT: 6 iterations. The thesis does not print the amplitude; 1 is used.",
            tables[:1],
            charts=[
                sensitivity_chart("lv100-sensitivity", "Figure 5.1: complementary sensitivity.", task, main, colours),
                step_chart("lv100-steps", "Steps of the setpoints.", task, main, colours, STEP),
            ],
        ),
        Section("One experiment", ONE_EXPERIMENT, tables[1:2]),
        Section(
            "Table 5.2 and Figure 5.2",
            "VRFT, instrument u_bar, W = I. The thesis prints magnitudes.",
            tables[2:],
            [
                svg(
                    spread_figure(task, found, STEP, f"LV100: steps with the gains of {runs} experiments, N = {N}"),
                    f"spread {N}",
                )
                for N, found in gains.items()
            ],
        ),
    ]
    figures = {
        "table_5_1": _numbers(task, shown, experiments),
        "one_experiment_median_J_MR": medians,
        "rms_u_y": rms,
        "table_5_2": {
            str(N): {"mean": g.mean(axis=0).tolist(), "std": g.std(axis=0, ddof=1).tolist()} for N, g in gains.items()
        },
        "table_5_2_seconds": seconds,
    }
    return ReportPart("The LV100 gas turbine, M = 0.4/(z - 0.6) I, Ts = 0.1 s.", sections, figures)


def _printed(task: Benchmark, table: str) -> dict[str, LoopController]:
    return {n: LoopController.from_polynomial(**v, Ts=task.plant.Ts) for n, v in task.printed[table].items()}


def _beside(
    ours: Mapping[str, LoopController], printed: Mapping[str, LoopController], table: str
) -> dict[str, LoopController]:
    return {**ours, **{f"{name}, {table} as printed": controller for name, controller in printed.items()}}


def _rows(task: Benchmark, shown: Mapping[str, LoopController], experiments: Mapping[str, int]) -> list[list[str]]:
    """Two rows for each controller, those of its matrix: 80 columns hold no more."""
    rows = []
    for name, controller in shown.items():
        B0, B1 = controller.polynomial()
        count = experiments.get(name, "" if "printed" in name else 1)
        beside = ((f"{task.cost(controller):.4f}", str(count)), ("", ""))
        for part, first, second, figures in zip(_name_lines(name), B0, B1, beside, strict=True):
            cells = [f"{b0:.4g} z {'-' if b1 < 0 else '+'} {abs(b1):.4g}" for b0, b1 in zip(first, second, strict=True)]
            rows.append([part, *cells, *figures])
    return rows


def _name_lines(name: str) -> tuple[str, str]:
    """Name of a controller on two short lines."""
    short = name
    for long, brief in ((" with (2,1)", ", (2,1)"), ("instrument ", ""), (" at once", ""), (" on a PBSID", ", PBSID")):
        short = short.replace(long, brief)
    first, _, second = short.rpartition(", ") if short.endswith("printed") else short.partition(", ")
    return (first, second) if first else (second, "")


def _numbers(task: Benchmark, shown: Mapping[str, LoopController], experiments: Mapping[str, int]) -> dict[str, Any]:
    return {
        name: {
            "B0": controller.polynomial()[0].tolist(),
            "B1": controller.polynomial()[1].tolist(),
            "J_MR": task.cost(controller),
            **({"experiments": experiments[name]} if name in experiments else {}),
        }
        for name, controller in shown.items()
    }


def _spread_rows(task: Benchmark, gains: Mapping[int, Signal]) -> list[list[str]]:
    rows = []
    for t, term in enumerate(("Kp", "Ki")):
        for element, printed in task.printed["table_5_2"][term].items():
            i, j = (int(v) - 1 for v in element.split(","))
            for (N, found), power in zip(gains.items(), ("1e3", "1e4"), strict=True):
                value = found[:, t, i, j]
                ours = [f"{value.mean():.3f}", f"{value.std(ddof=1):.3f}"]
                theirs = [f"{printed[f'{what}_{power}']:.3f}" for what in ("mean", "std")]
                rows.append([f"{term}({element}), {N}", *ours, *theirs])
    return rows
