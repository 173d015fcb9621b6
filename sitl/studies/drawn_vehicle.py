"""Random multirotors with the gains that they fly with: what `mimopilot reproduce vehicles` tunes.

The ranges of delay, frame mode, products of inertia, gusts and the flown Ms are those that the study is about. The
others are those of quadrotors of 0.4 to 8 kg, around the airframes that come with mimopilot (`sitl/physics/airframes`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.sitl.physics.airframe import Airframe, Frame, MotorConstants, Noise, Rotor
from mimopilot.sitl.physics.rigid_body import GRAVITY, is_physical_inertia
from mimopilot.sitl.studies.true_plant import TruePlant
from mimopilot.tuning.gains import Gains, Limits, YawGains
from mimopilot.tuning.law_filters import Filters

#: Control period, s: 250 Hz, as all airframes here.
TS = 0.004
#: The study's ranges: products of inertia over the root of both moments; delay, periods of 4 ms; frequency (Hz),
#: damping and gain of the frame mode, which every second vehicle has; RMS of gusts over the full torque; Ms.
PRODUCT, DELAY, GUSTS, FLOWN_MS = (-0.4, 0.4), (0, 6), (0.0, 0.1), (1.2, 2.0)
MODE_HZ, MODE_DAMPING, MODE_GAIN = (15.0, 80.0), (0.02, 0.1), (0.02, 0.8)
#: Mass, kg. Lever arm an axis over 0.177 m (m / 1.45 kg)^(1/3). Moment of inertia over m arm^2: adam0 0.38 and 0.32,
#: antr 0.29 and 0.39. J_zz over J_xx + J_yy: adam0 0.92, antr 0.93.
MASS, ARM, INERTIA, INERTIA_Z = (0.4, 8.0), (0.75, 1.3), (0.27, 0.45), (0.75, 0.98)
ARM_OF, MASS_OF = 0.177, 1.45  # adam0
#: Weight over the largest thrust (adam0 0.49, antr 0.14); rotor lag, s, over 0.05 s (m / 1.45 kg)^(1/4) (adam0 0.050,
#: antr 0.033); rate damping, 1/s (adam0 1.25, antr 3); reaction torque over thrust, m.
HOVER, LAG, RATE_DAMPING, TORQUE_RATIO = (0.25, 0.6), (0.5, 1.5), (0.5, 4.0), (0.012, 0.02)
LAG_OF = 0.05
#: Noise of the state estimate, rad and rad/s (adam0 0.003 and 0.01); cutoff of the gyro filter, Hz, which every second
#: vehicle has (PX4: 40).
ANGLE_NOISE, RATE_NOISE, GYRO_HZ = (0.001, 0.005), (0.005, 0.02), (40.0, 90.0)
#: Weight over the largest thrust below which the allocator uses airmode: hovering there leaves little torque.
AIRMODE = 0.35
#: Rotor speed matters only through its lag; thrust coefficient of adam0, N s^2. Linear drag over mass, 1/s
#: (adam0 0.2).
THRUST_COEFFICIENT, DRAG = 2.3e-5, 0.2
#: Flown attitude gain, 1/s: from the least in ArduPilot's range (ATC_ANG_RLL_P 3) to PX4's default (MC_ROLL_P 6.5).
ATTITUDE_GAIN = (3.0, 6.5)
#: Ki/Kp (1/s) and Kd/Kp (s) of PX4's defaults (MC_ROLLRATE_P 0.15, _I 0.2, _D 0.003), and its IMU_DGYRO_CUTOFF, Hz.
INTEGRAL, DERIVATIVE, CUTOFF_HZ = 0.2 / 0.15, 0.003 / 0.15, 30.0
#: Yaw, in the unit of this bench: attitude and rate P, I, as adam0.
YAW = YawGains(1.5, 0.5, 0.1, 0.0)
#: Rate loop's bandwidths, rad/s, among which the flown gains are looked for, and halvings of an interval between two.
RATE_BANDWIDTHS, HALVINGS = tuple(np.geomspace(2.0, 150.0, 45)), 25

Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class DrawnVehicle:
    """A vehicle, the gains that it flies with, and the weather.

    Attributes
    ----------
    airframe : Airframe
    gains : Gains
        Diagonal.
    flown_Ms : float
        True peak of the sensitivity under these.
    gusts : float
        RMS of the gusts' torque (normalised) on each axis.
    """

    airframe: Airframe
    gains: Gains
    flown_Ms: float
    gusts: float

    def as_json(self) -> dict[str, Any]:
        """What was drawn, as a JSON value."""
        body, frame = self.airframe, self.airframe.frame
        return {
            "mass_kg": body.mass,
            "inertia": [list(row) for row in body.inertia],
            "moment_scale": list(body.moment_scale()),
            "rotor_lag_s": body.motors.time_constant,
            "delay_s": body.computing_delay * TS,
            "gyro_cutoff_hz": body.gyro_cutoff_hz,
            "frame": frame.model_dump() if frame else None,
            "noise": body.noise.model_dump(),
            "gusts": self.gusts,
            "Kp_o": float(self.gains.Kp_o[0, 0]),
            "Kp_i": float(self.gains.Kp_i[0, 0]),
            "flown_Ms": self.flown_Ms,
        }


def draw_vehicle(generator: np.random.Generator) -> DrawnVehicle:
    """Draw Ms, then vehicles until one reaches it."""
    Ms, gusts = float(generator.uniform(*FLOWN_MS)), float(generator.uniform(*GUSTS))
    while True:
        airframe, attitude = draw_airframe(generator), float(generator.uniform(*ATTITUDE_GAIN))
        choice = generator.random()
        gains = None if airframe is None else flown_gains(airframe, Ms, attitude, choice)
        if airframe is not None and gains is not None:
            return DrawnVehicle(airframe, gains, Ms, gusts)


def draw_airframe(generator: np.random.Generator) -> Airframe | None:
    """Draw an airframe; None when no body has the drawn inertia."""

    def uniform(limits: tuple[float, float]) -> float:
        return float(generator.uniform(*limits))

    def logarithmic(limits: tuple[float, float]) -> float:
        return float(np.exp(generator.uniform(*np.log(limits))))

    mass = logarithmic(MASS)
    arms = [ARM_OF * (mass / MASS_OF) ** (1 / 3) * uniform(ARM) for _ in range(2)]
    xx, yy = (uniform(INERTIA) * mass * arm**2 for arm in arms)
    xy, zz = uniform(PRODUCT) * float(np.sqrt(xx * yy)), uniform(INERTIA_Z) * (xx + yy)
    hover, lag = uniform(HOVER), LAG_OF * (mass / MASS_OF) ** 0.25 * logarithmic(LAG)
    damping, ratio = uniform(RATE_DAMPING), uniform(TORQUE_RATIO)
    delay = int(generator.integers(DELAY[0], DELAY[1], endpoint=True))
    noise = Noise(angle=logarithmic(ANGLE_NOISE), rate=logarithmic(RATE_NOISE))
    filtered, cutoff = generator.random() < 0.5, uniform(GYRO_HZ)
    bends = generator.random() < 0.5
    frame = Frame(frequency_hz=logarithmic(MODE_HZ), damping=logarithmic(MODE_DAMPING), gain=logarithmic(MODE_GAIN))
    inertia = ((xx, xy, 0.0), (xy, yy, 0.0), (0.0, 0.0, zz))
    if not is_physical_inertia(np.array(inertia)):
        return None
    return Airframe(
        name="drawn",
        mass=mass,
        inertia=inertia,
        rate_damping=damping,
        drag=DRAG * mass,
        airmode=hover < AIRMODE,
        computing_delay=delay,
        gyro_cutoff_hz=cutoff if filtered else 0.0,
        gains="",
        motors=MotorConstants(
            thrust_max=mass * GRAVITY / (4 * hover),
            time_constant=lag,
            thrust_coefficient=THRUST_COEFFICIENT,
            torque_ratio=ratio,
        ),
        rotors=tuple(
            Rotor(position=(x * arms[1], y * arms[0], 0.0), direction="ccw" if x == y else "cw")
            for x, y in ((1, 1), (-1, -1), (1, -1), (-1, 1))
        ),
        noise=noise,
        frame=frame if bends else None,
    )


def flown_gains(airframe: Airframe, Ms: float, attitude: float, choice: float) -> Gains | None:
    """Gains in the ratios of PX4's defaults whose true peak of the sensitivity is Ms; None when there are none.

    Too low rate gains leave the attitude loop hardly damped, too high ones the rate loop: mostly two scales have the
    same Ms.

    Parameters
    ----------
    airframe : Airframe
    Ms : float
    attitude : float, 1/s
        Attitude gain.
    choice : float
        0 to 1: which of the scales is taken.
    """
    truth, B = TruePlant(airframe, TS), airframe_effectiveness(airframe)

    def gains(rate: float) -> Gains:
        proportional = rate / B * np.eye(2)
        return Gains(
            Kp_o=attitude * np.eye(2),
            Kp_i=proportional,
            Ki_i=INTEGRAL * proportional,
            Kd_i=DERIVATIVE * proportional,
            Kff_i=np.zeros((2, 2)),
            yaw=YAW,
            filters=Filters(TS, CUTOFF_HZ),
            limits=Limits(),
            moment_scale=airframe.moment_scale(),
        )

    def above(rate: float) -> float:
        """Ms over the wanted one, less 1; infinite for an unstable loop."""
        one = gains(rate)
        return truth.sensitivity_peak(one) / Ms - 1 if truth.spectral_radius(one) < 1 else np.inf

    values = [above(rate) for rate in RATE_BANDWIDTHS]
    crossings = [k for k in range(len(values) - 1) if (values[k] > 0) != (values[k + 1] > 0)]
    if not crossings:
        return None
    place = crossings[int(choice * len(crossings))]
    low, high = RATE_BANDWIDTHS[place : place + 2]
    for _ in range(HALVINGS):
        middle = float(np.sqrt(low * high))
        if (above(middle) > 0) == (values[place] > 0):
            low = middle
        else:
            high = middle
    found = gains(float(high if values[place] > 0 else low))
    return found if abs(truth.sensitivity_peak(found) / Ms - 1) < 1e-3 else None


def airframe_effectiveness(airframe: Airframe) -> float:
    """Mean angular acceleration of roll and pitch per unit of torque, rad/s^2: one scale for both, as in PX4."""
    moments = np.array(airframe.moment_scale()[:2]) / np.diag(np.array(airframe.inertia))[:2]
    return float(np.sqrt(moments.prod()))
