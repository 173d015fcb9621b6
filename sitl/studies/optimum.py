"""The best gains of the controller structure on the true plant: a reference for the methods, not a method.

The doublets are flown in simulation without noise, and all gains are optimised directly. This needs the true plant, so
no data-driven method may use it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

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
from mimopilot.tuning.plant.rigid_body_fit import RigidBody
from mimopilot.tuning.provenance import Provenance
from mimopilot.tuning.reference_model import ReferenceModel

#: The optimised gains: those in the thesis' tables.
FREE = ("Kp_o", "Kp_i", "Ki_i", "Kd_i")
#: Relative step of the finite differences: coarse, because the controller computes in float32.
STEP = 1e-3
LIMITS = 5  # constraints in `OptimumTask.examine`
LOST = 10.0  # rad^2: cost of gains outside the range of their parameters

Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class OptimumTask:
    """The optimisation task: vehicle, doublets, reference model and constraints.

    Attributes
    ----------
    airframe : Airframe
    library : NativeLibrary
        The compiled controller.
    doublets : sequence of 2 Scenario
        Roll, pitch.
    outer : ReferenceModel
        Reference model of the attitude.
    plant : PlantResponse
        Frequency response of the vehicle from a log; the gains must be certifiable with it.
    body : RigidBody
        Rigid-body fit of the same vehicle.
    peak : float
        Largest allowed peak of the sensitivity.
    effort : sequence of 2 float or None
        Largest RMS of the torques in each doublet; None: no limit.
    integral : float, 1/s
        Least integral action, see `tuning.plant.rigid_body_fit.RigidBody.least`: the integrators must trim the
        vehicle.
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
        """Fly both doublets without noise."""
        return [
            fly(self.airframe, Autopilot(self.airframe, gains, NativeController(self.library, gains)), task, 0, False)
            for task in self.doublets
        ]

    def examine(self, gains: Gains) -> tuple[Signal, list[float]]:
        """Fly the doublets with a gain set.

        Returns
        -------
        residuals : (N,) array, rad
            Errors of both angles to the model, weighted as in the method; their sum of squares is a mean square.
        margins : list of `LIMITS` float
            Relative distance to each constraint; negative when violated.
        """
        spans = [stop - start for start, stop in (task.window for task in self.doublets)]
        try:
            flights = self.fly(gains)
        except TuningError:  # a gain is outside the range of its parameter
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
    """RMS of the roll and pitch torques together over the manoeuvre, normalised."""
    return float(moment_rms(flight.record["moment"][slice(*flight.scenario.window), :2].astype(np.float64)))


def best_gains(task: OptimumTask, starts: Sequence[Gains]) -> Gains:
    """Minimise the errors of both angles to the model in both doublets within the constraints.

    Parameters
    ----------
    task : OptimumTask
    starts : sequence of Gains
        Starting points of the descent; the best result is returned.
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
