#!/usr/bin/env python3
"""From a flight log to certified gains and C++, with the prediction checked in a flight.

    examples/log_to_gains.py OUT [LOG]

Without LOG a flight of `adam0` is simulated. Takes half a minute; `--quick` flies a shorter experiment.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import mimopilot as mp


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("log", type=Path, nargs="?")
    parser.add_argument("--quick", action="store_true")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)

    log = options.log
    if log is None:
        log = options.out / "flight.ulg"
        mp.experiment("adam0", log, seed=1, seconds_per_axis=8.0 if options.quick else 20.0)

    found = mp.inspect(log)
    if found.reason:
        raise SystemExit(f"no gains can be tuned from this log: {found.reason}")

    gains = mp.tune(log)
    verdict, reason = gains.verdict()
    gains.save(options.out / "my.gains.toml")
    print(f"{verdict}: {reason}")
    for name in ("Kp_o", "Kp_i", "Ki_i", "Kd_i"):
        print(f"{name} = {getattr(gains, name).round(4).tolist()}")

    mp.generate(gains, options.out / "firmware", target="px4")
    if options.log is None:  # the gains are for adam0, so they can be flown on it
        for label, flown in (("default", None), ("tuned", gains)):
            flight = mp.fly("adam0", flown, axis="roll")
            figures = mp.performance(flight, gains)
            print(f"{label}: the other axis moves by {figures.offaxis_peak_deg:.2f} deg in a roll doublet")


if __name__ == "__main__":
    main()
