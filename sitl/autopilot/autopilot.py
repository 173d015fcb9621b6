"""One control period of the autopilot host: estimate, altitude hold, the compiled C++, control allocation.

`tick` is compiled by numba and calls the controller's machine code directly; the in-process loop and the
MAVLink host call this same function.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from mimopilot.codegen.cortex_m4 import EmulatedController
from mimopilot.codegen.layout import INPUT, OUTPUT
from mimopilot.codegen.native import NativeController, load_native
from mimopilot.sitl.physics.airframe import Airframe
from mimopilot.sitl.physics.compiled import call_step, compiled, inlined
from mimopilot.sitl.physics.mixer import allocate
from mimopilot.sitl.physics.moment_scale import check_moment_scale
from mimopilot.sitl.physics.rigid_body import GRAVITY
from mimopilot.sitl.physics.state_estimate import euler_angles
from mimopilot.tuning.gains import Gains
from numpy.typing import NDArray

MAX_ROTORS = 16

#: What one period leaves behind: the signals of a flight log.
RECORD = np.dtype(
    [
        ("setpoint", "f4", 3),
        ("quaternion", "f4", 4),
        ("attitude", "f4", 3),
        ("rates_setpoint", "f4", 3),
        ("rates", "f4", 3),
        ("moment", "f4", 3),
        ("excitation", "f4", 3),
        ("unallocated", "f4", 3),
        ("collective", "f4"),
        ("commands", "f4", MAX_ROTORS),
        ("fault", "i4"),
    ]
)


@inlined
def altitude_hold(altitude, climb, target, hover, tilt):  # type: ignore[no-untyped-def]
    """Collective that holds an altitude: 1 rad/s, critically damped, corrected for the tilt (its cosine)."""
    lift = 1.0 + ((target - altitude) - 2.0 * climb) / GRAVITY
    return hover * min(max(lift, 0.5), 1.5) / min(max(tilt, 0.5), 1.0)


@compiled
def tick(step_address, state, controls, outputs, allocation, hover, altitude, measurement, row):  # type: ignore[no-untyped-def]
    """One period: `row.setpoint` and `row.excitation` are given, everything else of `row` is filled.

    `controls` and `outputs` are one-row arrays of the controller's input and output; the saturation of the
    last period is kept in `controls`. `hover` is the collective that carries the weight; where no altitude is
    held (NaN) it is the collective itself. The motors of a vehicle that is not armed stand.
    """
    roll, pitch, yaw = euler_angles(measurement[0], measurement[1], measurement[2], measurement[3])
    given = controls[0]
    given.attitude[0], given.attitude[1], given.attitude[2] = roll, pitch, yaw
    for i in range(4):
        row.quaternion[i] = measurement[i]
    for i in range(3):
        given.rates[i] = measurement[4 + i]
        given.attitude_setpoint[i] = row.setpoint[i]
        given.excitation[i] = row.excitation[i]
        row.attitude[i] = given.attitude[i]
        row.rates[i] = given.rates[i]
    call_step(step_address, state.ctypes.data, controls.ctypes.data, outputs.ctypes.data)
    made = outputs[0]
    for i in range(3):
        row.moment[i] = made.moment[i]
        row.rates_setpoint[i] = made.rates_setpoint[i]
    row.fault = made.fault
    if np.isnan(altitude):
        row.collective = hover
    else:
        tilt = np.cos(roll) * np.cos(pitch)
        row.collective = altitude_hold(measurement[7] / 1000.0, measurement[8] / 100.0, altitude, hover, tilt)
    if given.armed != 0:
        allocate(row.moment, row.collective, allocation, row.commands, row.unallocated)
    else:
        for i in range(row.commands.shape[0]):
            row.commands[i] = 0.0
        for i in range(3):
            row.unallocated[i] = 0.0
    for i in range(3):
        given.saturation[i] = int(row.unallocated[i])


class Autopilot:
    """The autopilot of one vehicle: a compiled controller and what surrounds it.

    Parameters
    ----------
    airframe : Airframe
        The vehicle that it flies.
    gains : Gains
        What the controller starts with.
    controller : NativeController or EmulatedController, optional
        A loaded controller; by default one is generated from the gains and compiled for this machine.
    altitude : float, m
        Altitude to hold.

    Raises
    ------
    SitlError
        When the gains are for another unit of moment than this airframe's allocator has, or do not say.
    """

    def __init__(
        self,
        airframe: Airframe,
        gains: Gains,
        controller: NativeController | EmulatedController | None = None,
        altitude: float = 10.0,
    ) -> None:
        check_moment_scale(gains, airframe.moment_scale(), airframe.name)
        self.gains = gains
        self.controller = controller or NativeController(load_native(gains), gains)
        self.step_address = self.controller.step_address
        self.allocation = airframe.allocation()
        self.hover = airframe.plant().mass * GRAVITY / (len(airframe.rotors) * airframe.motors.thrust_max)
        self.altitude = altitude
        self.controls: NDArray[Any] = np.zeros(1, INPUT)
        self.controls["armed"] = 1
        self.outputs: NDArray[Any] = np.zeros(1, OUTPUT)
        self._fresh = self.controller.state.copy()

    def restart(self) -> None:
        """As it was when it was made, for another flight."""
        self.controller.state[:] = self._fresh
        self.controls["saturation"] = 0

    def warm_up(self) -> None:
        """Compile `tick` now, so that the first period in flight is no slower than the others."""
        controls, state = self.controls.copy(), self.controller.state.copy()
        tick(*self.arguments(), np.array([1.0, 0, 0, 0, 0, 0, 0, 0, 0]), np.zeros(1, RECORD)[0])
        self.controls[:], self.controller.state[:] = controls, state

    def arguments(self) -> tuple[Any, ...]:
        """What `tick` is called with, up to the measurement."""
        return (
            self.step_address,
            self.controller.state,
            self.controls,
            self.outputs,
            self.allocation,
            self.hover,
            self.altitude,
        )
