"""A hundred autotunes with a fault at a random moment; part of `make bench`."""

from __future__ import annotations

import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

from tests.sitl.field.conftest import scripted_fields
from tests.sitl.field.faults import FAULTS, WHOLE_S, run_with_fault

RUNS = 100


def autotune_rows() -> list[list[str]]:
    """Rows (what, figure, beside): how often the gains were kept in the end; a set that is not told ends the bench."""
    begin, kept = time.perf_counter(), Counter[str]()
    for seed in range(RUNS):
        generator = np.random.default_rng(seed)
        fault, at = FAULTS[seed % len(FAULTS)], float(generator.uniform(0.0, WHOLE_S))
        with tempfile.TemporaryDirectory() as folder, scripted_fields(Path(folder)) as make:
            messages = run_with_fault(make(seed=seed), fault, at, generator)
        kept["kept" if not messages[-1] else "old"] += 1
    figure = f"{kept['kept']} kept, {kept['old']} with the old gains"
    seconds = time.perf_counter() - begin
    return [
        [f"{RUNS} autotunes, each with a fault at a random moment", figure, f"none mixed or untold; {seconds:.0f} s"]
    ]
