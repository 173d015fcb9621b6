"""One control period of the autopilot host: estimate, altitude hold, the compiled C++, control allocation.

`tick` is compiled by numba and calls the machine code of the controller directly. The in-process loop and the MAVLink
host call this same function.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mimopilot.codegen.cortex_m4 import EmulatedController
from mimopilot.codegen.layout import INPUT, OUTPUT
from mimopilot.codegen.native import NativeController, load_native
from mimopilot.sitl.autopilot.px4_law import Px4Controller
from mimopilot.sitl.physics.airframe import Airframe
from mimopilot.sitl.physics.compiled_step import call_step, compiled, inlined
from mimopilot.sitl.physics.mixer import Allocation, allocate
from mimopilot.sitl.physics.moment_scale import check_moment_scale
from mimopilot.sitl.physics.rigid_body import GRAVITY, MAX_ROTORS
from mimopilot.sitl.physics.state_estimate import euler_angles, quaternion_of
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.parameters import PARAMETERS

MIN_THRUST_RATIO, MAX_THRUST_RATIO = 0.5, 1.5  # of hover; chosen: altitude hold accelerates by at most half of g
MIN_TILT_COSINE = 0.5  # 60 degrees, the largest tilt of a setpoint: beyond it thrust is not increased further

#: Inputs and outputs of one period: the signals of a flight log. The setpoint is roll, pitch, yaw (rad) and its yaw
#: rate (rad/s) or, in rate mode, the body rates (rad/s).
RECORD = np.dtype(
    [
        ("setpoint", "f4", 3),
        ("yaw_rate", "f4"),
        ("rate_mode", "i4"),
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


class ControlLoop(NamedTuple):
    """The compiled controller and the allocation, as `tick` takes them.

    Attributes
    ----------
    step_address, state_address : int
        Addresses of the step function and of the state of the controller.
    inputs, outputs : one-row arrays
        Inputs and outputs of the controller; the saturation of the last period stays in `inputs`.
    allocation : Allocation
    """

    step_address: int
    state_address: int
    inputs: NDArray[Any]
    outputs: NDArray[Any]
    allocation: Allocation


@inlined
def altitude_hold(altitude, climb, target, hover, tilt):  # type: ignore[no-untyped-def]
    """Collective that holds an altitude: 1 rad/s, critically damped, corrected for the tilt (its cosine)."""
    ratio = 1.0 + ((target - altitude) - 2.0 * climb) / GRAVITY
    return hover * min(max(ratio, MIN_THRUST_RATIO), MAX_THRUST_RATIO) / min(max(tilt, MIN_TILT_COSINE), 1.0)


@compiled
def tick_unpacked(  # type: ignore[no-untyped-def]
    step_address, state_address, input_rows, output_rows, allocation, collective, altitude, measurement, row
):
    """`tick` for compiled loops: with a tuple, numba counts the references of its arrays in each call."""
    roll, pitch, yaw = euler_angles(measurement[0], measurement[1], measurement[2], measurement[3])
    inputs = input_rows[0]
    row.attitude[0], row.attitude[1], row.attitude[2] = roll, pitch, yaw
    wanted = quaternion_of(np.float64(row.setpoint[0]), np.float64(row.setpoint[1]), np.float64(row.setpoint[2]))
    inputs.rate_mode, inputs.yaw_rate_setpoint = row.rate_mode, row.yaw_rate
    for i in range(4):
        inputs.attitude[i] = measurement[i]
        inputs.attitude_setpoint[i] = wanted[i]
        row.quaternion[i] = measurement[i]
    for i in range(3):
        inputs.rates[i] = measurement[4 + i]
        inputs.rates_setpoint[i] = row.setpoint[i]
        inputs.excitation[i] = row.excitation[i]
        row.rates[i] = inputs.rates[i]
    call_step(step_address, state_address, input_rows.ctypes.data, output_rows.ctypes.data)
    outputs = output_rows[0]
    for i in range(3):
        row.moment[i] = outputs.moment[i]
        row.rates_setpoint[i] = outputs.rates_setpoint[i]
    row.fault = outputs.fault
    if np.isnan(altitude):
        row.collective = collective
    else:
        tilt = np.cos(roll) * np.cos(pitch)
        # A measurement holds millimetres and cm/s.
        row.collective = altitude_hold(measurement[7] / 1000.0, measurement[8] / 100.0, altitude, collective, tilt)
    if inputs.armed != 0:
        allocate(row.moment, row.collective, allocation, row.commands, row.unallocated)
    else:
        for i in range(row.commands.shape[0]):
            row.commands[i] = 0.0
        for i in range(3):
            row.unallocated[i] = 0.0
    for i in range(3):
        inputs.saturation[i] = int(row.unallocated[i])


@compiled
def tick(loop, collective, altitude, measurement, row):  # type: ignore[no-untyped-def]
    """One control period: setpoint, its yaw rate, rate mode and excitation are given, the rest of `row` is filled.

    `altitude` is the one to hold (m) and `collective` then the thrust fraction of hover. When `altitude` is NaN, the
    collective is given. Motor commands are 0 while the vehicle is disarmed.
    """
    step_address, state_address, inputs, outputs, allocation = loop
    tick_unpacked(step_address, state_address, inputs, outputs, allocation, collective, altitude, measurement, row)


class Autopilot:
    """The autopilot of one vehicle: a compiled controller, altitude hold and control allocation.

    Parameters
    ----------
    airframe : Airframe
        The vehicle.
    gains : Gains
        Initial gains of the controller.
    controller : NativeController, EmulatedController or Px4Controller, optional
        A controller; by default one is generated from the gains and compiled for this machine.
    altitude : float, m
        Altitude to hold.

    Attributes
    ----------
    hover : float
        Collective that carries the weight, thrust fraction.
    loop : ControlLoop
        What `tick` needs of this autopilot.

    Raises
    ------
    SitlError
        When the gains are for another unit of torque than that of this airframe, or do not state theirs.
    """

    def __init__(
        self,
        airframe: Airframe,
        gains: Gains,
        controller: NativeController | EmulatedController | Px4Controller | None = None,
        altitude: float = 10.0,
    ) -> None:
        check_moment_scale(gains, airframe.moment_scale(), airframe.name)
        self.gains = gains
        self.controller = controller or NativeController(load_native(gains), gains)
        self.hover = airframe.plant().mass * GRAVITY / (len(airframe.rotors) * airframe.motors.thrust_max)
        self.altitude = altitude
        self.controls: NDArray[Any] = np.zeros(1, INPUT)
        self.controls["armed"] = 1
        outputs: NDArray[Any] = np.zeros(1, OUTPUT)
        self.loop = ControlLoop(
            self.controller.step_address,
            self.controller.state.ctypes.data,
            self.controls,
            outputs,
            airframe.allocation(),
        )
        self._initial_state = self.controller.state.copy()

    @property
    def parameters(self) -> dict[str, float]:
        """Name -> value of the parameters in flight."""
        gains = self.controller.state["gains"][0].tolist()
        return {parameter.name: value for parameter, value in zip(PARAMETERS, gains, strict=True)}

    def parameter_problem(self) -> str:
        """Parameter that is outside its range, in words; empty: none."""
        for parameter, value in zip(PARAMETERS, self.parameters.values(), strict=True):
            if not parameter.minimum <= value <= parameter.maximum:
                return f"{parameter.name} is {value:g}, outside its range"
        return ""

    def restart(self) -> None:
        """Return to the initial state, for another flight."""
        self.controller.state[:] = self._initial_state
        self.controls["saturation"] = 0

    def warm_up(self) -> None:
        """Compile `tick` now, so that the first period in flight is no slower than the others."""
        controls, state = self.controls.copy(), self.controller.state.copy()
        measurement = np.array([1.0, 0, 0, 0, 0, 0, 0, 0, 0])
        tick(self.loop, self.hover, self.altitude, measurement, np.zeros(1, RECORD)[0])
        self.controls[:], self.controller.state[:] = controls, state
