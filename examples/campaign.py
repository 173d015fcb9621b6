#!/usr/bin/env python3
"""Two gain sets on many varied vehicles: which survives, which follows better, and how sure that is.

    examples/campaign.py OUT

OUT/campaign/report.html is the answer. 500 runs take a few minutes on two cores; `--quick` flies 4.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

import mimopilot as mp

#: What varies: factors on the airframe's own values (relative), or SI units.
VARY = """
mass = { normal = [1.0, 0.05], relative = true }
inertia.xx = { uniform = [0.9, 1.2], relative = true }
inertia.yy = { uniform = [0.9, 1.2], relative = true }
wind.north = { normal = [0.0, 2.0] }                      # m/s
"""


def command(folder: Path, *arguments: str) -> None:
    """Run a command of mimopilot in a folder."""
    line = [sys.executable, "-m", "mimopilot", *arguments]
    print("$ mimopilot", *arguments, flush=True)
    subprocess.run(line, cwd=folder, check=True)


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--quick", action="store_true")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)

    # With given models a set takes a second, by the design several.
    models = {"inner": (20, 0.6, 0), "outer": (8, 0.8, 0)} if options.quick else {}
    log = mp.experiment("adam0", seed=1, axis="both", seconds_per_axis=8.0 if options.quick else 20.0)
    for method in ("siso", "mimo"):
        mp.tune(log, method=method, **models).save(options.out / f"{method}.gains.toml")
    (options.out / "vary.toml").write_text(VARY)

    runs = ("--runs", "4", "--workers", "1") if options.quick else ("--runs", "500")
    sets = ("--gains", "siso.gains.toml", "--gains", "mimo.gains.toml")
    command(options.out, "campaign", "adam0", *sets, *runs, "--vary", "vary.toml", "--out", "campaign")
    # The report names the run in which a set did worst; each run can be flown again, bit for bit.
    command(options.out, "replay", "campaign", "--run", "3", "--gains", "mimo", "--axis", "pitch", "--out", "worst.ulg")


if __name__ == "__main__":
    main()
