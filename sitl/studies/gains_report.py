"""Tables of `mimopilot reproduce gains`: flown doublets and exact linear figures of every gain set of a vehicle."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from mimopilot.common.html_report import ReportTable
from mimopilot.sitl.flight.scenario import AXES
from mimopilot.sitl.studies.attitude_study import AUTOTUNE, DEFAULT, MIMO, MIMO_THESIS, SISO, SISO_THESIS
from mimopilot.sitl.studies.gains_run import (
    AMPLITUDES_DEG,
    BEST,
    BEST_FOLLOWING,
    BEST_SAME,
    LQG,
    MIMO_FOLLOWING,
    PERIODS,
    SAME,
    SETS,
    SISO_FOLLOWING,
)
from mimopilot.sitl.studies.linear_loop import DOMINANT
from mimopilot.tuning.certificate import Verdict
from mimopilot.tuning.design.prediction import TAIL
from mimopilot.tuning.spec import DesignLimits

#: J_M is printed in this unit, rad^2.
UNIT, UNIT_TEXT = 1e-5, "1e-5 rad^2"
PERIODS_TEXT = ", ".join(f"{period:g}" for period in PERIODS)

#: Verdict of the certificate -> as short text.
SHORT = {
    str(Verdict.CERTIFIED): "yes",
    str(Verdict.THIN): "thin",
    str(Verdict.NOT_CERTIFIED): "no",
}

Run = Mapping[str, Any]

LEAD = (
    f"{DEFAULT}: the gains that flew during the experiment. {AUTOTUNE}: the rule of PX4's autotune. {SISO_THESIS} and "
    f"{MIMO_THESIS}: VRFT for them. {SISO} and {MIMO}: what mimopilot tune designs on the measured response without a "
    f"model, axis by axis and with full matrices; {SISO_FOLLOWING} and {MIMO_FOLLOWING}: with model following. "
    f"{BEST}, {BEST_SAME} and {BEST_FOLLOWING}: the same cost and constraints on the true plant, which no method "
    f"knows. {LQG}: a servo with as many states as the vehicle, from its exact model, for an attitude model of "
    f"{SAME.omega:g} rad/s; the weight makes the noise of its torque {DesignLimits().noise:g} times the flown. It "
    "cannot be flown as gains and knows no limits of the motors: all of its figures are linear. J: mean square of the "
    f"angle's error to an attitude model of {SAME.omega:g} rad/s, {SAME.zeta:g}, over a doublet and {TAIL:g} s after "
    "it, mean of roll and pitch; own: to the set's own model, whose bandwidth is in the last column. Peak: largest "
    "angle of the other axis in any of these doublets. Cross: RMS of the other axis over doublet and tail, in percent "
    f"of the amplitude. Damping: least damping ratio of the closed loop's poles slower than {DOMINANT:g} rad/s. Noise: "
    "of the torque at hover, over the flown gains'. Torque: the largest in a doublet of "
    f"{AMPLITUDES_DEG[-1]:g} degrees, as if there were no limits. Certified: from the log; thin: a thin margin. "
    "Medians over the seeds."
)


def gains_tables(vehicle: str, runs: Sequence[Run]) -> list[ReportTable]:
    """The tables of a vehicle from its runs: one of the flights for each amplitude, and the linear figures."""
    return [*(_flown_table(vehicle, runs, size) for size in AMPLITUDES_DEG), _linear_table(vehicle, runs)]


def gains_figures(runs: Sequence[Run]) -> dict[str, Any]:
    """A vehicle's part of the object that ``--json`` prints: by set, medians over the seeds, and every run."""
    return {
        "seeds": len(runs),
        "medians": {
            name: {
                "runs": len(_having(runs, name)),
                "linear": linear_medians(runs, name),
                "flights": [flown_medians(runs, name, size, period) for size in AMPLITUDES_DEG for period in PERIODS]
                if name != LQG
                else [],
            }
            for name in SETS
            if _having(runs, name)
        },
        "runs": list(runs),
    }


def _having(runs: Sequence[Run], name: str) -> list[Any]:
    """The results of a set in the runs that have it."""
    return [run[name] for run in runs if "refused" not in run[name]]


def flown_medians(runs: Sequence[Run], name: str, amplitude_deg: float, period_s: float) -> dict[str, Any]:
    """Medians of the figures of one doublet, each the mean of roll and pitch; see `gains_run.flights`.

    ``offaxis_rms_deg`` is the root of the mean square of both.
    """
    rows = [
        row
        for one in _having(runs, name)
        for row in one["flights"]
        if (row["amplitude_deg"], row["period_s"]) == (amplitude_deg, period_s)
    ]

    def median(figure: str, mean: Callable[[Any], Any] = np.mean) -> float:
        return float(np.median([mean([row[axis][figure] for axis in AXES]) for row in rows]))

    own = {"J_M_o_own": median("J_M_o_own")} if "J_M_o_own" in rows[0][AXES[0]] else {}
    return {
        "amplitude_deg": amplitude_deg,
        "period_s": period_s,
        "J_M_o": median("J_M_o"),
        **own,
        "offaxis_peak_deg": median("offaxis_peak_deg"),
        "offaxis_rms_deg": median("offaxis_rms_deg", lambda values: np.sqrt(np.mean(np.square(values)))),
    }


def linear_medians(runs: Sequence[Run], name: str) -> dict[str, Any]:
    """Medians of `gains_run.LinearBench.figures`."""
    every = [one["linear"] for one in _having(runs, name)]
    return {figure: np.median([one[figure] for one in every], axis=0).tolist() for figure in every[0]}


def _flown_table(vehicle: str, runs: Sequence[Run], size: float) -> ReportTable:
    rows = []
    for name in SETS:
        if name == LQG or not _having(runs, name):
            continue
        found = [flown_medians(runs, name, size, period) for period in PERIODS]
        own = [_unit(one["J_M_o_own"]) if "J_M_o_own" in one else "" for one in found]
        peak = max(one["offaxis_peak_deg"] for one in found)
        rows.append([name, *(_unit(one["J_M_o"]) for one in found), *own, f"{peak:.2f}", _models(runs, name)])
    columns = ("set", *_columns("J"), *_columns("own"), "peak", "rad/s")
    caption = f"{vehicle}, flown: doublets of {size:g} deg and {PERIODS_TEXT} s; J [{UNIT_TEXT}], peak [deg]"
    return ReportTable(caption, columns, rows)


def _columns(first: str) -> tuple[str, ...]:
    return (f"{first} {PERIODS[0]:g}", *(f"{period:g}" for period in PERIODS[1:]))


def _unit(value: float) -> str:
    """J_M in `UNIT`."""
    if not np.isfinite(value):
        return "lost"
    scaled = value / UNIT
    return f"{scaled:.0f}" if scaled >= 100 else f"{scaled:.3g}"


def _models(runs: Sequence[Run], name: str) -> str:
    """Bandwidths of the own attitude models of a set in all runs, rad/s."""
    labels = {one["model"] for one in _having(runs, name)} - {None}
    return " / ".join(sorted((str(label).partition(" rad/s")[0] for label in labels), key=float))


def _linear_table(vehicle: str, runs: Sequence[Run]) -> ReportTable:
    rows = []
    for name in SETS:
        having = _having(runs, name)
        if not having:
            rows.append([name, *[""] * 8, f"refused: {runs[0][name]['refused']}"[:60]])
            continue
        found = linear_medians(runs, name)
        size = float(np.radians(AMPLITUDES_DEG[0]))
        cross = 100 * float(np.sqrt(np.mean(found["offaxis"])))
        verdicts = sorted({SHORT.get(one["verdict"], one["verdict"]) for one in having} - {""})
        missing = len(runs) - len(having)
        rows.append(
            [
                name,
                *(_unit(size**2 * value) for value in found["J_M"]),
                f"{cross:.2f}",
                f"{found['Ms']:.2f}",
                f"{found['damping']:.2f}",
                f"{found['noise']:.2f}",
                f"{found['torque'][0]:.2f}",
                " / ".join(verdicts) + (f"; refused in {missing}" if missing else ""),
            ]
        )
    caption = (
        f"{vehicle}, exact on the linear plant: J [{UNIT_TEXT}] of {AMPLITUDES_DEG[0]:g} deg; cross [%]; noise over "
        "the flown"
    )
    columns = ("set", *_columns("J"), "cross", "Ms", "damping", "noise", "torque", "certified")
    return ReportTable(caption, columns, rows)
