"""The design on the measured response: gains of fixed structure with stability and margins inside.

The cost is how well the attitude follows a second-order model over a family of doublets, how little the other axis
moves, and how little a step of torque does. The constraints are the certificate's, robust to the error of the
response, and the noise of the torque. The bandwidth of the model is found: a slower one gives away stiffness, a faster
one cannot be followed within the constraints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.analysis.beyond_band import exceeded_frequencies
from mimopilot.tuning.analysis.closed_loop import model_spectral_radius
from mimopilot.tuning.analysis.manoeuvres import manoeuvres
from mimopilot.tuning.axes import Law, flown_law
from mimopilot.tuning.design.constraints import Definite
from mimopilot.tuning.design.descent import INFEASIBLE, DesignTask, PlantTask, descend
from mimopilot.tuning.design.free_gains import FreeGains, free_gains
from mimopilot.tuning.design.prediction import SLOWEST, bandwidth, sensitivity_peak
from mimopilot.tuning.design.vehicle_constraints import MeasuredVehicle, vehicle_constraints
from mimopilot.tuning.experiment import Experiment
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.law_terms import LOOP_TERMS, TERMS
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.plant.wide_response import WideResponse, wide_response
from mimopilot.tuning.reference_model import SecondOrder
from mimopilot.tuning.spec import DesignLimits

#: Bandwidths of the attitude model, rad/s: ten a factor of 3.16 (ISO 3, R20), from a heavy lifter to a small racer. No
#: position controller or pilot uses a faster attitude.
_DECADE = (2.8, 3.2, 3.6, 4.0, 4.5, 5.0, 5.6, 6.3, 7.1, 8.0, 9.0, 10.0, 11.2, 12.5, 14.0, 16.0, 18.0, 20.0)
BANDWIDTHS: tuple[float, ...] = (*_DECADE, 22.4, 25.0)
#: Those where an autopilot shapes the setpoint and feeds its rate forward. The shaping makes the attitude slow; the
#: model stands for the lag behind it only, and flown gains may have less lag than 25 rad/s.
SHAPED_BANDWIDTHS = (*BANDWIDTHS, 28.0, 31.5, 35.5, 40.0, 45.0, 50.0, 56.0, 63.0, 71.0, 80.0, 90.0, 100.0)
#: Where the search begins, rad/s, and its first step along the table.
FIRST_BANDWIDTH, FIRST_STRIDE = 10.0, 2
#: Damping of the attitude model: 5 % overshoot, the usual choice.
DAMPING = 0.7
#: A descent during the search ends with a step that lowers the merit by less than this share, the last one sooner than
#: that.
ROUGHLY, EXACTLY = 2e-2, 1e-4
#: Factor on the limit of Ms after gains without a certificate.
TIGHTER = 0.95
#: Factors on the rate gains of a starting point.
SCALES = (1.0, 0.7, 0.5, 0.35, 0.25)
#: A constraint whose margin is below this is active.
ACTIVE = 0.02
#: Share of the cost that a bound must cost to be worth a warning.
COSTS = 0.05
#: The bandwidth is the largest with a cost below the first, or below the least times the second: 7 % of RMS error.
GOOD, NEARLY_BEST = 0.005, 1.05

Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Design:
    """Gains designed on the response of one or more flights.

    Attributes
    ----------
    law : Law
        Of its axes, without a certificate.
    model : SecondOrder
        The attitude model that they follow.
    cost : float
        Mean relative energy of the errors.
    violation : float
        Sum of the relative violations of the constraints, 0 if all hold.
    active : list of str
        What limits the design, the tightest first.
    task, vector : DesignTask and (n,) array
        What was solved, and its solution.
    """

    law: Law
    model: SecondOrder
    cost: float
    violation: float
    active: list[str]
    task: DesignTask
    vector: Signal

    @property
    def gains(self) -> Gains:
        """The set that was designed for roll and pitch."""
        assert isinstance(self.law, Gains)
        return self.law

    @property
    def feasible(self) -> bool:
        """Whether all constraints hold."""
        return self.violation < INFEASIBLE


@dataclass(frozen=True, eq=False)
class ResponseDesign:
    """Designs on the logs of one vehicle.

    Attributes
    ----------
    vehicles : sequence of MeasuredVehicle
        One for each log.
    limits : DesignLimits
    flown_bandwidth : float or None, rad/s
        Of the attitude model that the flown gains follow best, the fastest of all logs. None: not known.
    slowest : float, rad/s
        Least bandwidth of a design: the flown one, if the flown gains keep the limit of Ms.
    bandwidths : tuple of float, rad/s
        Those that the attitude model may have, in rising order.
    """

    vehicles: Sequence[MeasuredVehicle]
    limits: DesignLimits
    flown_bandwidth: float | None = None
    slowest: float = BANDWIDTHS[0]
    bandwidths: tuple[float, ...] = BANDWIDTHS

    @classmethod
    def of(
        cls, measured: Sequence[PlantEstimates], limits: DesignLimits, bandwidths: tuple[float, ...] = ()
    ) -> ResponseDesign:
        """Designs on the responses measured in one or more flights.

        By default with the bandwidths of roll and pitch.

        Raises
        ------
        TuningError
            When a response is known at too few frequencies.
        """
        plants, flights = [wide_response(one) for one in measured], [one.experiment for one in measured]
        return cls.around(plants, flights, limits, bandwidths)

    @classmethod
    def around(
        cls,
        plants: Sequence[WideResponse],
        experiments: Sequence[Experiment],
        limits: DesignLimits,
        bandwidths: tuple[float, ...] = (),
    ) -> ResponseDesign:
        """Designs on given responses; of the experiments only the flown gains, motors and attitudes are used."""
        if not bandwidths:
            shaped = all(one.flown is not None and any(one.flown.filters.shaping) for one in experiments)
            bandwidths = SHAPED_BANDWIDTHS if shaped else BANDWIDTHS
        vehicles = [MeasuredVehicle.of(plant, one) for one, plant in zip(experiments, plants, strict=True)]
        flown = [flown_law(one) for one in experiments]
        pairs = [(one, plant) for one, plant in zip(flown, plants, strict=True) if one is not None]
        if len(pairs) < len(plants):
            return cls(vehicles, limits, None, bandwidths[0], bandwidths)
        fastest = max(bandwidth(one, plant, bandwidths, DAMPING) for one, plant in pairs)
        safe = all(sensitivity_peak(one, plant) <= limits.Ms for one, plant in pairs)
        slowest = SLOWEST * fastest if safe else bandwidths[0]
        return cls(vehicles, limits, fastest, slowest, bandwidths)

    @property
    def plants(self) -> list[WideResponse]:
        """Response of each vehicle."""
        return [vehicle.plant for vehicle in self.vehicles]

    def tighter(self, gains: Law) -> ResponseDesign:
        """The design after gains that lacked a certificate.

        The rate loop is limited where its gain may have exceeded the certificate's limit; if it did so nowhere, the
        limit of Ms is lower.
        """
        exceeded = [exceeded_frequencies(gains, plant.response) for plant in self.plants]
        if any(which.any() for which in exceeded):
            pairs = zip(self.vehicles, exceeded, strict=True)
            return replace(self, vehicles=[replace(one, limited=one.limited | which) for one, which in pairs])
        return replace(self, limits=self.limits.model_copy(update={"Ms": TIGHTER * self.limits.Ms}))

    def design(
        self,
        starts: Sequence[Law],
        structure: str,
        full: bool,
        bandwidth: float | None = None,
    ) -> Design:
        """The best gains for the best bandwidth.

        Parameters
        ----------
        starts : sequence of Law
            Where the search begins; the first gives what is not tuned. If it follows a model, the model's
            bandwidth is that of the design.
        structure : str
            Letters of `tuning.law.LOOP_TERMS`.
        full : bool
            False: the diagonals only (SISO).
        bandwidth : float, rad/s, optional
            Of the attitude model; by default it is found.
        """
        free = free_gains(starts[0], self.plants[0].body, structure, full)
        wanted = self.flown_bandwidth or FIRST_BANDWIDTH
        first = min(self.bandwidths, key=lambda one: abs(one - wanted))
        task = self.task(free, starts, first if bandwidth is None else bandwidth)
        stable = [start for start in starts if self.is_stable(start)]
        ends = [descend(task, _scaled(task, start), ROUGHLY) for start in stable or starts]
        vector = min(ends, key=task.merit)
        if bandwidth is None:
            bandwidth, task, vector = self._best_bandwidth(task, vector, first)
        vector = descend(task, vector, EXACTLY)
        return Design(
            law=task.free.gains(vector),
            model=SecondOrder(bandwidth, DAMPING),
            cost=task.cost(vector),
            violation=task.violation(vector),
            active=task.active(vector, ACTIVE),
            task=task,
            vector=vector,
        )

    def is_stable(self, gains: Law) -> bool:
        """Whether the loop around every fitted rigid body is stable: a descent keeps what it starts with."""
        return all(model_spectral_radius(gains, plant.body.model(plant.Ts)) < 1 for plant in self.plants)

    def _best_bandwidth(self, task: DesignTask, vector: Signal, begin: float) -> tuple[float, DesignTask, Signal]:
        """The largest bandwidth of nearly the least merit: along the table from the first one."""
        first, table = self.bandwidths.index(begin), self.bandwidths
        found = {first: (task.merit(vector), task, vector)}

        def merit(place: int) -> float:
            if not 0 <= place < len(table) or table[place] < self.slowest:
                return np.inf
            if place not in found:
                nearest = min(found, key=lambda known: abs(known - place))
                moved = _with_bandwidth(task, table[place])
                end = descend(moved, found[nearest][2], ROUGHLY)
                found[place] = moved.merit(end), moved, end
            return found[place][0]

        best, stride = first, FIRST_STRIDE
        while stride:
            better = min((best, best + stride, best - stride), key=merit)
            best, stride = better, stride if better != best else stride // 2
        enough = max(GOOD, NEARLY_BEST * merit(best))
        while merit(best + 1) <= enough:
            best += 1
        return table[best], *found[best][1:]

    def task(self, free: FreeGains, starts: Sequence[Law], bandwidth: float) -> DesignTask:
        """Cost and constraints around every plant."""
        model = SecondOrder(bandwidth, DAMPING).discretise(free.base.Ts)
        asked = [manoeuvres(plant, model, free.base.filters) for plant in self.plants]
        return DesignTask(
            _following(free, bandwidth),
            [
                PlantTask(vehicle.plant, one, vehicle_constraints(vehicle, self.limits, free, starts, one.step))
                for vehicle, one in zip(self.vehicles, asked, strict=True)
            ],
        )


def _scaled(task: DesignTask, start: Law) -> Signal:
    """A starting point with its rate gains scaled to the least merit: the search begins near its constraints."""
    rate = [term.matrix for term in LOOP_TERMS.values()]
    scaled = [
        task.free.vector(replace(start, **{name: factor * getattr(start, name) for name in rate}))  # type: ignore[arg-type]
        for factor in SCALES
    ]
    return min(scaled, key=task.merit)


def _with_bandwidth(task: DesignTask, bandwidth: float) -> DesignTask:
    """The task for another attitude model."""
    model = SecondOrder(bandwidth, DAMPING).discretise(task.free.base.Ts)
    plants = [replace(one, manoeuvres=replace(one.manoeuvres, model=model)) for one in task.plants]
    return replace(task, free=_following(task.free, bandwidth), plants=plants)


def _following(free: FreeGains, bandwidth: float) -> FreeGains:
    """The free gains with this bandwidth of the attitude model, if they follow one."""
    if free.base.filters.followed is None:
        return free
    filters = replace(free.base.filters, model_omega=bandwidth, model_damping=DAMPING)
    return replace(free, base=replace(free.base, filters=filters))


def vehicle_damps(design: Design) -> bool:
    """Whether the bound on the derivative gain is active and costs following: a negative one would follow better."""
    task, vector = design.task, design.vector
    name = Definite(TERMS["D"].matrix, np.eye(1), 0.0).name
    if name not in task.active(vector, ACTIVE):
        return False
    plants = [
        replace(one, constraints=[limit for limit in one.constraints if limit.name != name]) for one in task.plants
    ]
    free = replace(task, plants=plants)
    return free.merit(descend(free, vector, ROUGHLY)) < (1 - COSTS) * task.merit(vector)
