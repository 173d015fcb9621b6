"""Tuning of repeated experiments: distributions of the gains, their predicted deviations and their verdicts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mimopilot.common.charts import NEW, SETPOINT_COLOUR, svg
from mimopilot.common.console import json_text, progress_console
from mimopilot.common.files import inside, write_atomically
from mimopilot.common.parallel import processes, run_all
from mimopilot.tuning.design.cascade import tune
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.logs.blackbox_file import BESIDE
from mimopilot.tuning.logs.columns import Columns
from mimopilot.tuning.logs.formats import SUFFIXES
from mimopilot.tuning.logs.reader import read_log
from mimopilot.tuning.parameter_row import Shape
from mimopilot.tuning.parameters import MATRICES, rows
from mimopilot.tuning.spec import TuningSpec

QUANTILES = (0.05, 0.5, 0.95)
#: Elements of a matrix, row by row: output <- error.
PAIRS = ("roll<-roll", "roll<-pitch", "pitch<-roll", "pitch<-pitch")
UNITS = {row.key: row.unit or "-" for row in rows(Shape.MATRIX)}
CURVE, BARS = SETPOINT_COLOUR, NEW


@dataclass(frozen=True)
class LogOutcome:
    """Result of one log: gains, or the reason why it was refused."""

    log: str
    gains: Gains | None
    refusal: str = ""


@dataclass(frozen=True)
class GainDistribution:
    """Distribution of one gain over all tuned logs.

    Attributes
    ----------
    matrix, pair : str
        Which gain.
    mean, deviation : float
        Observed.
    quantiles : tuple of 3 float
        5, 50 and 95 %.
    predicted : float
        Mean of the standard deviations predicted from each log.
    """

    matrix: str
    pair: str
    mean: float
    deviation: float
    quantiles: tuple[float, float, float]
    predicted: float


@dataclass(frozen=True, eq=False)
class RepeatedTuning:
    """Results of all logs of a campaign, in order."""

    outcomes: tuple[LogOutcome, ...]

    @property
    def tuned(self) -> list[Gains]:
        """The gain sets that were found."""
        return [outcome.gains for outcome in self.outcomes if outcome.gains is not None]

    @property
    def refusals(self) -> dict[str, str]:
        """Log -> why it was refused."""
        return {outcome.log: outcome.refusal for outcome in self.outcomes if outcome.gains is None}

    @property
    def verdicts(self) -> dict[str, int]:
        """Verdict -> number of sets, the most frequent first."""
        return dict(Counter(gains.verdict()[0] for gains in self.tuned).most_common())

    def values(self, matrix: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Gains and predicted deviations of a matrix, (n, 4) each, row by row; NaN where none was predicted."""
        gains = np.array([getattr(one, matrix).ravel() for one in self.tuned])
        nothing = np.full((2, 2), np.nan)
        predicted = [np.ravel(one.provenance.standard_deviation.get(matrix, nothing)) for one in self.tuned]
        return gains, np.array(predicted, np.float64)

    def elements(self) -> list[GainDistribution]:
        """Distribution of every gain that was estimated."""
        found = []
        for matrix in MATRICES:
            gains, predicted = self.values(matrix)
            for i, pair in enumerate(PAIRS):
                if np.isnan(predicted[:, i]).all():
                    continue
                low, middle, high = (float(value) for value in np.quantile(gains[:, i], QUANTILES))
                mean, deviation = (
                    float(gains[:, i].mean()),
                    float(gains[:, i].std(ddof=1)) if len(gains) > 1 else np.nan,
                )
                found.append(
                    GainDistribution(
                        matrix=matrix,
                        pair=pair,
                        mean=mean,
                        deviation=deviation,
                        quantiles=(low, middle, high),
                        predicted=float(predicted[:, i].mean()),
                    )
                )
        return found

    def as_json(self) -> dict[str, Any]:
        """The object that ``--json`` prints and `summary.json` holds."""
        return {
            "logs": len(self.outcomes),
            "tuned": len(self.tuned),
            "verdicts": self.verdicts,
            "refusals": self.refusals,
            "gains": [vars(element) for element in self.elements()],
        }


def _is_log(path: Path) -> bool:
    """Whether a file is a log by its name, and not the settings of one."""
    return path.suffix.lower() in SUFFIXES and not path.name.endswith(BESIDE)


def find_logs(paths: Sequence[Path]) -> list[Path]:
    """The given logs, and those of the given folders in order of their names.

    Raises
    ------
    TuningError
        When a folder holds no log, or two logs have the same name.
    """
    found: list[Path] = []
    for path in paths:
        inside = sorted(filter(_is_log, path.iterdir())) if path.is_dir() else [path]
        if not inside:
            raise TuningError(f"{path}: no logs in this folder; expected files ending in {', '.join(SUFFIXES)}")
        found += inside
    doubles = [name for name, count in Counter(path.stem for path in found).items() if count > 1]
    if doubles:
        raise TuningError(f"two logs are called {doubles[0]}: their gains would share one file; rename one")
    return found


def tune_all(
    logs: Sequence[Path], spec: TuningSpec, out: Path, workers: int, columns: Columns | None = None
) -> RepeatedTuning:
    """Tune each log by itself; write each gain set, a figure and a summary.

    Parameters
    ----------
    logs : sequence of Path
        Repeated experiments.
    spec : TuningSpec
        For all of them.
    out : Path
        Folder: `gains/`, `gains.svg` and `summary.json` are written.
    workers : int
        Processes; results do not depend on their number.
    columns : Columns, optional
        Columns of logs that are tables.

    Raises
    ------
    TuningError
        When every log is refused, with the reason for the first.
    """
    from rich.progress import Progress

    summary, figure = inside(out, "summary.json"), inside(out, "gains.svg")
    inside(out, "gains")
    outcomes: dict[Path, LogOutcome] = {}
    with processes(workers) as executor, Progress(console=progress_console(), transient=True) as bar:
        task = bar.add_task("tuning", total=len(logs))

        def keep(log: Path, outcome: LogOutcome) -> None:
            outcomes[log] = outcome
            bar.advance(task)
            if outcome.gains is not None:
                outcome.gains.save(inside(out, f"gains/{log.stem}.gains.toml"))

        run_all(executor, 2 * workers, partial(_tune, spec, columns), logs, keep)
    found = RepeatedTuning(tuple(outcomes[log] for log in logs))
    if not found.tuned:
        raise TuningError(f"{len(logs)} of {len(logs)} logs were refused, the first: {found.outcomes[0].refusal}")
    write_atomically(summary, json_text(found.as_json()))
    write_atomically(figure, svg(gains_figure(found), "gains"))
    return found


def _tune(spec: TuningSpec, columns: Columns | None, log: Path) -> LogOutcome:
    try:
        return LogOutcome(log.name, tune(read_log(log, columns), spec))
    except TuningError as error:
        return LogOutcome(log.name, None, str(error))


def gains_figure(found: RepeatedTuning) -> Figure:
    """Histogram of every gain, with the normal distribution of its mean and mean predicted deviation."""
    matrices = list(dict.fromkeys(element.matrix for element in found.elements()))
    figure = Figure(figsize=(10, 0.8 + 2.0 * len(matrices)), layout="constrained")
    panels: Any = figure.subplots(len(matrices), 4, squeeze=False)
    for row, matrix in zip(panels, matrices, strict=True):
        gains, predicted = found.values(matrix)
        for i, panel in enumerate(row):
            value, sigma = gains[:, i], float(np.mean(predicted[:, i]))
            panel.hist(value, bins="sturges", density=True, color=BARS, alpha=0.5, edgecolor=BARS, label="observed")
            if sigma > 0:
                x = np.linspace(-4, 4, 161) * max(sigma, float(value.std())) + value.mean()
                y = np.exp(-0.5 * ((x - value.mean()) / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))
                panel.plot(x, y, color=CURVE, linestyle="--", linewidth=1.6, label="predicted")
            panel.set_xlabel(f"{matrix} {PAIRS[i]} [{UNITS[matrix]}]", fontsize=8)
            panel.tick_params(labelsize=7)
            panel.xaxis.get_offset_text().set_fontsize(7)
            panel.locator_params(axis="x", nbins=4)
            panel.set_yticks([])
    panels[0, 0].set_ylabel("density", fontsize=8)
    panels[0, 0].legend(fontsize=7)
    figure.suptitle(f"Gains from {len(found.tuned)} experiments", x=0.02, ha="left")
    return figure
