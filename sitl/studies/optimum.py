"""The best that the controller's structure can do on the true plant: the yardstick, not a method.

It flies the doublets in the bench itself, without noise, and changes every gain until nothing gets better. A vehicle's
owner cannot do that; no data-driven method may use it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from mimopilot.codegen.native import NativeController, NativeLibrary
from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.flight.scenario import Scenario
from mimopilot.sitl.flight.simulator import Flight, fly
from mimopilot.sitl.physics.airframe import Airframe
from mimopilot.tuning.analysis.beyond_band import MAX_GAIN_ABOVE_BAND, loop_gain_above
from mimopilot.tuning.analysis.closed_loop import cascade_loop
from mimopilot.tuning.analysis.doublet_prediction import moment_rms
from mimopilot.tuning.design.constrained_least_squares import INFEASIBLE, constrained_least_squares
from mimopilot.tuning.design.refine_for_manoeuvre import OTHER_AXIS, typical_sizes
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.plant.frequency_response import PlantResponse
from mimopilot.tuning.plant.inertia import RigidBody
from mimopilot.tuning.provenance import Provenance
from mimopilot.tuning.reference_model import ReferenceModel
from numpy.typing import NDArray

#: Every gain of the structure that the thesis' tables have.
FREE = ("Kp_o", "Kp_i", "Ki_i", "Kd_i")
#: Relative step of the differences: the flown controller is single precision.
STEP = 1e-3
#: Limits of `Task.examine`, and what a gain set that cannot fly costs (rad^2).
LIMITS, LOST = 5, 10.0

Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Task:
    """What is to be flown best.

    Attributes
    ----------
    airframe : Airframe
    library : NativeLibrary
        The compiled controller.
    doublets : sequence of 2 Scenario
        Roll, pitch.
    outer : ReferenceModel
        What the attitude should follow.
    plant : PlantResponse
        Response of the vehicle that a log gives: the gains must be ones that could be certified from it.
    peak : float
        Largest peak of the sensitivity for that.
    effort : sequence of 2 float or None
        RMS of the moments allowed in each doublet; None: as much as it takes.
    integral : float, 1/s
        Integral action that is needed, see `tuning.plant.inertia.RigidBody.least`: a vehicle must find its trim.
    """

    airframe: Airframe
    library: NativeLibrary
    doublets: Sequence[Scenario]
    outer: ReferenceModel
    plant: PlantResponse
    body: RigidBody
    peak: float
    effort: Sequence[float] | None
    integral: float

    def fly(self, gains: Gains) -> list[Flight]:
        """Both doublets, without noise."""
        return [
            fly(self.airframe, Autopilot(self.airframe, gains, NativeController(self.library, gains)), task, 0, False)
            for task in self.doublets
        ]

    def examine(self, gains: Gains) -> tuple[Signal, list[float]]:
        """Distance of both angles to the model in each sample, weighed as the method does so that the sum of squares
        is a mean square (rad^2), and what the limits leave.
        """
        spans = [stop - start for start, stop in (task.window for task in self.doublets)]
        try:
            flights = self.fly(gains)
        except TuningError:  # a gain outside of the range of its parameter
            samples = 2 * sum(spans)
            return np.full(samples, np.sqrt(LOST / samples)), [-1.0] * LIMITS
        errors = []
        for axis, (flight, span) in enumerate(zip(flights, spans, strict=True)):
            error = flight.truth["attitude"][:, :2] / np.sqrt(span)
            error[:, axis] -= self.outer.response(flight.scenario.setpoint[:, axis]) / np.sqrt(span)
            error[:, 1 - axis] *= OTHER_AXIS
            errors.append(error[slice(*flight.scenario.window)].ravel())
        residuals = np.concatenate(errors)
        allowed = self.effort or (np.inf, np.inf)
        loop = np.linalg.svd(np.eye(2) + cascade_loop(gains, self.plant).L_u, compute_uv=False)
        return residuals, [
            *(1 - flown_effort(flight) / most for flight, most in zip(flights, allowed, strict=True)),
            1 - float((1 / loop).max()) / self.peak,
            1 - float(loop_gain_above(gains, self.plant)[-1]) / MAX_GAIN_ABOVE_BAND,
            float(self.body.least(gains.Ki_i)) / self.integral - 1,
        ]


def flown_effort(flight: Flight) -> float:
    """RMS of the roll and pitch moments together over the manoeuvre."""
    return float(moment_rms(flight.record["moment"][slice(*flight.scenario.window), :2].astype(np.float64)))


def best_gains(task: Task, starts: Sequence[Gains]) -> Gains:
    """The gains that keep both angles nearest to the model in both doublets within the limits, from several starts.

    Parameters
    ----------
    task : Task
    starts : sequence of Gains
        Where the descent begins; the best end counts.
    """
    ends = []
    for start in starts:
        sizes = typical_sizes(start)
        scale = np.repeat([sizes[name] for name in FREE], 4)
        first = np.concatenate([getattr(start, name).ravel() for name in FREE]) / scale

        def at(values: Signal, start: Gains = start, scale: Signal = scale) -> Gains:
            parts = np.split(values * scale, len(FREE))
            matrices = {name: part.reshape(2, 2) for name, part in zip(FREE, parts, strict=True)}
            return replace(start, certificate=None, provenance=Provenance("optimum"), **matrices)  # type: ignore[arg-type]

        def examine(points: Signal, at: Callable[[Signal], Gains] = at) -> tuple[Signal, Signal]:
            every = [task.examine(at(values)) for values in points]
            return np.array([residuals for residuals, _ in every]), np.array([left for _, left in every])

        found = at(constrained_least_squares(examine, first, STEP)[0])
        residuals, left = task.examine(found)
        ends.append((min(left) < -INFEASIBLE, float(residuals @ residuals), found))
    return min(ends, key=lambda end: end[:2])[2]
