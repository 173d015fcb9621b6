"""Speed of the estimators, each beside its reference; part of `make bench`."""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mimopilot.sitl.studies.benchmark_studies import gain_spread
from mimopilot.sitl.studies.benchmarks import lv100, numerical_example
from mimopilot.tuning.analysis.certify import certify
from mimopilot.tuning.design.cascade import tune
from mimopilot.tuning.design.cascade_estimate import estimate
from mimopilot.tuning.estimation.vrft import vrft
from mimopilot.tuning.experiment import Experiment
from mimopilot.tuning.plant.frequency_response import measured_plant
from mimopilot.tuning.spec import load_spec
from tests.tuning.literal import literal_cascade

Signal = np.ndarray
#: What a log holds for tuning: u, u_bar, rates and angles, two axes each.
CHANNELS = 8


def best(call: Callable[[], object], repeats: int = 5) -> float:
    """Shortest of several runs, s."""
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return min(times)


def ms(seconds: float) -> str:
    return f"{seconds * 1e3:.1f} ms"


def tuning_rows(experiment: Experiment) -> list[list[str]]:
    """Rows (what, figure, beside) for a log of 10^4 samples."""
    return [*_cascade(experiment), *_long(experiment), *_against_pyvrft(), *_table_5_2()]


def _cascade(experiment: Experiment) -> list[list[str]]:
    N, Ts = len(experiment.u), experiment.Ts
    plain = load_spec(weight="identity", instrument="u", trim=False, window=50)
    spec = load_spec()
    inner, outer = (plain.models(loop, Ts) for loop in ("inner", "outer"))
    cutoff = experiment.flown.derivative_cutoff_hz
    begin = time.perf_counter()
    oracle = literal_cascade(experiment.u, experiment.y_i, experiment.y_o, inner[0], outer[0], Ts, cutoff, 50)
    literal = time.perf_counter() - begin
    fast = best(lambda: estimate(experiment, plain), 20)
    found = estimate(experiment, plain).gains
    apart = max(
        np.abs(getattr(found, name) - matrix).max() / np.abs(matrix).max()
        for name, matrix in zip(("Kp_i", "Ki_i", "Kd_i", "Kp_o"), oracle, strict=True)
    )
    two_step = best(lambda: estimate(experiment, spec), 20)
    uncertain = best(lambda: estimate(experiment, spec).deviations())
    plant = measured_plant(experiment)
    gains = estimate(experiment, spec).gains
    response = best(lambda: measured_plant(experiment))
    verdict = best(lambda: certify(gains, plant, inner, outer))
    title = f"cascade, N = {N}, 2 x 101 instruments"
    return [
        [f"{title}, W = I, instrument u: pseudo-code, literally", ms(literal), ""],
        [f"{title}, W = I, instrument u", ms(fast), f"{literal / fast:.0f} x; equal to {apart:.0e}; at most 10 ms"],
        [f"cascade, N = {N}, default: two-step weight, trim, u_bar", ms(two_step), "at most 100 ms"],
        ["the same with standard deviations", ms(uncertain), "at most 100 ms"],
        ["certificate: frequency response and verdict", ms(response + verdict), "at most 1 s"],
        ["tune, all of it", ms(best(lambda: tune(experiment))), ""],
    ]


def _long(experiment: Experiment) -> list[list[str]]:
    plain = load_spec(weight="identity", instrument="u", trim=False, window=50)
    times = {}
    for N in (100_000, 1_000_000):
        repeats = N // len(experiment.u)
        names = ("u", "u_bar", "y_i", "y_o")
        signals = {name: np.tile(getattr(experiment, name), (repeats, 1)) for name in names}
        log = replace(experiment, **signals, r_o=None, r_i=None, segments=((0, repeats * len(experiment.u)),))
        times[N] = best(lambda log=log: estimate(log, plain), 3)
    default = best(lambda: estimate(log, load_spec()), 2)
    tracemalloc.start()
    estimate(log, load_spec())
    peak = tracemalloc.get_traced_memory()[1] / (CHANNELS * 8 * N)
    tracemalloc.stop()
    ratio = times[1_000_000] / times[100_000]
    beside = f"{ratio:.1f} x N = 10^5; at most 1.5 s"
    return [
        ["cascade, N = 10^6, W = I, instrument u", ms(times[1_000_000]), beside],
        ["cascade, N = 10^6, default", ms(default), f"peak memory {peak:.1f} x the data; at most 12"],
    ]


def _against_pyvrft() -> list[list[str]]:
    import vrft as pyvrft
    from scipy.signal import TransferFunction

    task = numerical_example()
    Ts = task.plant.Ts
    u = np.random.default_rng(0).choice([-1.0, 1.0], (10_000, 2))
    y = task.plant.simulate(u)
    model = TransferFunction([0.1], [1.0, -0.9], dt=Ts)
    terms = [[TransferFunction([1.0], [1.0], dt=Ts)], [TransferFunction([1.0, 0.0], [1.0, -1.0], dt=Ts)]]
    structure = [[terms, terms], [terms, terms]]
    diagonal = [[model, 0], [0, model]]

    def theirs() -> Signal:
        return pyvrft.design(u, y, y, diagonal, structure, diagonal)

    def ours() -> dict[str, Signal]:
        return vrft(u, y, u, task.models, "PI", window=50, weight="identity").gains

    slow, fast = best(theirs, 1), best(ours, 20)
    P = ours()["P"]
    # pyvrft orders row by row, P and I of each element.
    apart = np.abs(np.ravel(theirs()).reshape(2, 2, 2)[:, :, 0] - P).max() / np.abs(P).max()
    name = "2x2 PI of the numerical example, N = 10^4"
    return [
        [f"{name}: pyvrft", ms(slow), ""],
        [name, ms(fast), f"{slow / fast:.0f} x; Kp equal to {apart:.0e}"],
    ]


def _table_5_2() -> list[list[str]]:
    task = lv100()
    spread = best(lambda: [gain_spread(task, N, 500, 0) for N in (1000, 10_000)], 1)
    return [["1,000 LV100 tunings of Table 5.2, simulation included", f"{spread:.1f} s", "at most 10 s"]]
