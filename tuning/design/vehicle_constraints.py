"""The constraints of a design on one vehicle: stability, noise, motors, the autopilot's ranges, and its flown gains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.analysis.beyond_band import MAX_SENSITIVITY_BELOW_BAND
from mimopilot.tuning.analysis.manoeuvres import doublet_torque
from mimopilot.tuning.axes import Law, axes_slice, flown_law
from mimopilot.tuning.control_laws import control_law
from mimopilot.tuning.design.constraints import (
    SHARE,
    Constraint,
    Cut,
    Definite,
    Distance,
    MotorLimit,
    NoiseLimit,
    ParameterRange,
)
from mimopilot.tuning.design.disturbance_limit import no_softer_than
from mimopilot.tuning.design.flown_loop import flown_amplitude, flown_loop, flown_noise
from mimopilot.tuning.design.free_gains import FreeGains
from mimopilot.tuning.design.positive_integral import MIN_INTEGRAL_RATIO
from mimopilot.tuning.design.prediction import FAST
from mimopilot.tuning.design.rate_loop_gain import gain_above_band, structural_modes
from mimopilot.tuning.experiment import Experiment
from mimopilot.tuning.gains import Limits
from mimopilot.tuning.law_filters import Filters
from mimopilot.tuning.law_terms import ATTITUDE, TERMS
from mimopilot.tuning.motors import Motors
from mimopilot.tuning.plant.wide_response import WideResponse
from mimopilot.tuning.spec import DesignLimits

#: Share of the limit of noise that is used: the ratio of two predictions errs by 1 to 2 % (simulated airframes).
NOISE = 0.98
#: Motors of a log that does not hold their commands: a quadrotor, X, that hovers at half thrust.
USUAL_MOTORS = Motors(np.array([[-0.5, 0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, -0.5]]), np.full(4, 0.5))
#: Share of a motor's range that the rotors' torque may use in the doublets, and the peak of its command. In PX4's
#: simulator sets with peaks of 1.25 flew as predicted, those with 1.5 and 1.8 lost following. Those are for the size of
#: the setpoints; the angles, whose size counts here, overshoot them by a fifth.
RANGE, PEAK = 0.95, 1.5

Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MeasuredVehicle:
    """A vehicle as one flight measured it.

    Attributes
    ----------
    plant : WideResponse
        Its response.
    experiment : Experiment
        Its flown gains, motors and manoeuvres.
    noise : (2, n) array
        RMS of the torque at hover under the flown gains: all of it, and its part above `FAST`.
    limited : (K,) bool array
        Frequencies of the measured response at which the rate loop's gain is limited, whatever the fitted body says.
    """

    plant: WideResponse
    experiment: Experiment
    noise: Signal
    limited: NDArray[np.bool_]

    @classmethod
    def of(cls, plant: WideResponse, experiment: Experiment) -> MeasuredVehicle:
        """The vehicle of a flight, its rate loop limited nowhere yet."""
        return cls(plant, experiment, flown_noise(experiment, plant), np.zeros(len(plant.response.omega), bool))


def vehicle_constraints(
    vehicle: MeasuredVehicle, limits: DesignLimits, free: FreeGains, starts: Sequence[Law], step: Signal
) -> list[Constraint]:
    """The constraints of a design around one vehicle.

    Parameters
    ----------
    vehicle : MeasuredVehicle
    limits : DesignLimits
    free : FreeGains
    starts : sequence of Law
        Where the search begins: the least integral gain goes by their proportional gains.
    step : (K, n) array, s
        Angle after the step of torque for each axis, see `analysis.manoeuvres.Manoeuvres`.
    """
    plant = vehicle.plant
    B, floor = plant.body.B, 1 / limits.Ms
    proportional = max(float(plant.body.least(start.Kp_i)) for start in starts)
    begin = slice(plant.band.start, plant.band.start + 1)
    found: list[Constraint] = [
        *(Distance(cut, slice(0, plant.band.stop), floor) for cut in Cut),
        Distance(Cut.TORQUE, begin, 1 / (SHARE * MAX_SENSITIVITY_BELOW_BAND)),
        *(
            NoiseLimit(NOISE * limits.noise * part, above)
            for part, above in zip(vehicle.noise, (0.0, FAST), strict=True)
        ),
        gain_above_band(plant),
        structural_modes(plant, vehicle.limited),
        Definite(ATTITUDE.matrix, np.eye(plant.axes), 0.0),
    ]
    if TERMS["I"].matrix in free.units:
        found.append(Definite(TERMS["I"].matrix, B, MIN_INTEGRAL_RATIO * max(proportional, 0.0)))
    if TERMS["D"].matrix in free.units:
        found += [Definite(TERMS["D"].matrix, each, 0.0) for each in (B, np.eye(plant.axes))]
    largest = control_law(free.base.filters).largest or {}
    axes = axes_slice(plant.axes)
    found += [ParameterRange(name, np.array(largest[name][axes])) for name in free.units if name in largest]
    found += _actuators(vehicle, free.base.filters)
    flown = flown_law(vehicle.experiment)
    if flown is not None:
        found += no_softer_than(flown_loop(flown, plant), step, found)
    return found


def _actuators(vehicle: MeasuredVehicle, filters: Filters) -> list[Constraint]:
    """Limits of the motors in the manoeuvres of the flown size; for yaw those of its torque and its rate."""
    plant, experiment = vehicle.plant, vehicle.experiment
    size, flown, found = flown_amplitude(experiment), flown_law(experiment), list[Constraint]()
    if plant.axes == 1:
        limits = experiment.flown.limits if experiment.flown else Limits()
        mixer, room, name = np.ones((1, 1)), np.full((1, 2), limits.moment_max[2]), "range of the yaw torque"
        fastest = limits.rate_max[2] / (2 * size)  # a doublet's setpoint jumps by twice its size
        found.append(Definite(ATTITUDE.matrix, -np.eye(1), -fastest, "limit of the yaw rate"))
    else:
        motors = experiment.motors or USUAL_MOTORS
        mixer, room = motors.mixer, np.column_stack([motors.hover, 1 - motors.hover])
        name = "range of the motors"
    loop = None if flown is None else flown_loop(flown, plant)
    # The rotors' torque stays within the range. Their command may exceed it for less than their lag.
    torques = doublet_torque(plant, filters, size, (plant.shape[1], 0.0))
    for share, torque in zip((RANGE, PEAK), torques, strict=True):
        limit = MotorLimit(torque, mixer, share * room, name)
        # What the flown gains use is allowed: the steps of a doublet are sharper than a pilot's.
        used = 1.0 if loop is None else max(1.0, 1 - limit.margin(loop))
        found.append(replace(limit, room=used * limit.room))
    return found
