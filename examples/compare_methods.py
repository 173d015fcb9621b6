#!/usr/bin/env python3
"""SISO and MIMO, by the design and by VRFT for given models, from one log: predicted margins and flown doublets.

    examples/compare_methods.py OUT

Flies `adam0_boom`, whose roll and pitch are coupled by 40 %. Takes a minute; `--quick` compares two of the four.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import mimopilot as mp

AIRFRAME = "adam0_boom"
#: Label -> options of `tune`. The models are those of the thesis: rate loop 20 rad/s, 0.4; attitude loop 10 rad/s, 0.7.
MODELS = {"inner": (20, 0.4, 0), "outer": (10, 0.7, 0)}
METHODS: dict[str, dict[str, Any]] = {
    "SISO, design": {"method": "siso"},
    "MIMO, design": {},
    "SISO, VRFT": {"method": "siso", **MODELS},
    "MIMO, VRFT": MODELS,
}


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--quick", action="store_true")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)

    log = mp.experiment(AIRFRAME, seed=1, seconds_per_axis=10.0 if options.quick else 20.0, axis="both")
    chosen = ["SISO, VRFT", "MIMO, VRFT"] if options.quick else list(METHODS)
    print(f"{'':14} {'verdict':22} {'Ms':>5} {'other axis, roll / pitch doublet [deg]':>40}")
    for label in chosen:
        gains = mp.tune(log, **METHODS[label])
        gains.save(options.out / f"{label.lower().replace(', ', '-')}.gains.toml")
        peaks = []
        for axis in ("roll", "pitch"):
            flight = mp.fly(AIRFRAME, gains, axis=axis, amplitude_deg=15.0, period_s=0.8)
            peaks.append(f"{mp.performance(flight, gains).offaxis_peak_deg:.2f}")
        figures = gains.certificate.figures if gains.certificate else {}
        print(f"{label:14} {gains.verdict()[0]:22} {figures.get('Ms', float('nan')):5.2f} {' / '.join(peaks):>40}")


if __name__ == "__main__":
    main()
