"""Many runs of an attitude study, and their statistics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.sitl.studies.attitude_study import AttitudeStudy


@dataclass(frozen=True, eq=False)
class StudyStatistics:
    """The runs of a study and their statistics.

    Attributes
    ----------
    study : AttitudeStudy
    runs : list of dict
        `sitl.studies.attitude_run.numbers` of every seed, in order.
    """

    study: AttitudeStudy
    runs: list[dict[str, Any]]

    def values(self, method: str, axis: str, figure: str) -> NDArray[np.float64]:
        """One figure of the doublets on an axis over the seeds, (seeds,); see `attitude_run.numbers`."""
        return np.array([run[method][axis][figure] for run in self.runs], dtype=np.float64)

    def median(self, method: str, axis: str, figure: str) -> float:
        """The median of `values`."""
        return float(np.median(self.values(method, axis, figure)))

    def true_median(self, method: str, figure: str) -> float:
        """Median of an exact figure: ``true_Ms`` or ``noise``, see `attitude_run.AttitudeRun`."""
        return float(np.median([run[method][figure] for run in self.runs]))

    def gains(self, method: str, matrix: str) -> NDArray[np.float64]:
        """A matrix over the seeds, (seeds, 2, 2)."""
        return np.array([run[method]["gains"][matrix] for run in self.runs], dtype=np.float64)

    def verdicts(self, method: str) -> dict[str, int]:
        """Certificate's verdict -> number of seeds."""
        found = [run[method]["verdict"] for run in self.runs]
        return {verdict: found.count(verdict) for verdict in sorted(set(found))}
