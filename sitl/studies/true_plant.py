"""What gains do on the true plant of an airframe, and the best gains for it: references, which no tuning may use.

The true plant is the linear model about hover, known exactly, with the true spectrum of the noise. The optimum on it is
the design of `mimopilot tune` on this response instead of a measured one: the same cost and the same constraints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mimopilot.sitl.physics.airframe import Airframe
from mimopilot.sitl.physics.linear_model import control_effectiveness, linear_model, linear_model_with_noise
from mimopilot.sitl.physics.rigid_body import GRAVITY
from mimopilot.sitl.physics.state_estimate import low_pass
from mimopilot.sitl.studies.linear_loop import LinearLoop, controller_of
from mimopilot.tuning.design.response_design import FIRST_BANDWIDTH, Design, ResponseDesign
from mimopilot.tuning.experiment import Experiment
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.motors import Motors
from mimopilot.tuning.plant.frequency_response import PlantResponse, hermitian_root
from mimopilot.tuning.plant.rigid_body_fit import LOWEST, RigidBody
from mimopilot.tuning.plant.wide_response import STEP, TOP, WideResponse
from mimopilot.tuning.spec import DesignLimits, TuningSpec
from mimopilot.tuning.statespace import Response, StateSpace

#: Largest relative step between the frequencies at which margins are computed.
FINE_STEP = 2e-3
#: A frame mode's peak is resolved this far from its frequency (relative), in steps of this share of its damping.
AROUND_MODE, MODE_STEP = 0.25, 0.3
#: Time constant of gusts, s: a length of 2 to 5 m at a wind of 5 to 10 m/s. First-order (MIL-F-8785C, Dryden).
GUST_SECONDS = 0.5
#: Integral and proportional gains of a starting point from the rigid body: attitude (rad/s), rate loop (rad/s).
START_ATTITUDE, START_RATE = 4.0, 12.0

Signal = NDArray[np.float64]


def frequencies(airframe: Airframe, Ts: float, step: float) -> Signal:
    """Frequencies (K,), rad/s, from `LOWEST` to the Nyquist frequency, dense where the frame bends.

    Parameters
    ----------
    airframe : Airframe
    Ts : float, s
    step : float
        Largest relative step between neighbours.
    """
    top = TOP * np.pi / Ts
    omega: Signal = np.geomspace(LOWEST, top, int(np.log(top / LOWEST) / np.log1p(step)) + 2)
    if airframe.frame is not None:
        mode, near = 2 * np.pi * airframe.frame.frequency_hz, np.log1p(AROUND_MODE)
        count = int(2 * near / (MODE_STEP * airframe.frame.damping)) + 1
        omega = np.union1d(omega, mode * np.exp(np.linspace(-near, near, count)))
    inside: Signal = omega[omega <= top]
    return inside


def gust_spectrum(omega: Signal, Ts: float, rms: float) -> Signal:
    """Spectrum (K,) of gusts: a torque of this RMS (normalised), filtered by a first-order low-pass of `GUST_SECONDS`.

    In the unit of `tuning.plant.noise_spectrum`: the variance is Ts / pi times its integral.
    """
    pole = np.exp(-Ts / GUST_SECONDS)
    spectrum: Signal = rms**2 * (1 - pole**2) / np.abs(1 - pole * np.exp(-1j * omega * Ts)) ** 2
    return spectrum


def true_response(airframe: Airframe, Ts: float, gusts: float = 0.0) -> WideResponse:
    """The response of the true plant: without error, with the true spectrum of the noise.

    Parameters
    ----------
    airframe : Airframe
    Ts : float, s
        Control period.
    gusts : float
        RMS of the torque (normalised) of gusts on each axis.
    """
    omega = frequencies(airframe, Ts, STEP)
    count = len(omega)
    G = linear_model(airframe, Ts).frequency_response(omega)
    body = RigidBody(control_effectiveness(airframe), np.zeros((2, 2)))
    b0, b1, b2, a1, a2 = low_pass(airframe.gyro_cutoff_hz, Ts)
    z = np.exp(1j * omega * Ts)
    gyro = np.abs((b0 + b1 / z + b2 / z**2) / (1 + a1 / z + a2 / z**2))
    deviation = np.column_stack([airframe.noise.rate * gyro] * 2 + [np.full(count, airframe.noise.angle)] * 2)
    spectrum = (deviation[:, :, None] ** 2 * np.eye(4)).astype(np.complex128)
    spectrum += gust_spectrum(omega, Ts, gusts)[:, None, None] * G @ G.conj().transpose(0, 2, 1)
    known = PlantResponse(
        omega=omega,
        G_i=G[:, :2],
        G_o=G[:, 2:],
        root=np.zeros((count, 6, 6), complex),
        reach=np.zeros((count, 2, 2), complex),
        coherence=np.ones((count, 2)),
        Ts=Ts,
    )
    filter_delay = (b1 + 2 * b2) / (b0 + b1 + b2) - (a1 + 2 * a2) / (1 + a1 + a2)  # samples, at low frequency
    delay = (airframe.computing_delay + 0.5 + filter_delay) * Ts
    return WideResponse(
        omega=omega,
        G_i=known.G_i,
        G_o=known.G_o,
        band=slice(0, count),
        error_i=np.zeros((count, 2, 6), complex),
        error_o=np.zeros((count, 2, 6), complex),
        reach=known.reach,
        noise=hermitian_root(spectrum),
        noise_deviation=np.zeros(count),
        body=body,
        response=known,
        shape=(delay, airframe.motors.time_constant, airframe.rate_damping),
        Ts=Ts,
    )


@dataclass(frozen=True, eq=False)
class TruePlant:
    """The linear model of an airframe, and the exact margins of gain sets around it.

    Attributes
    ----------
    airframe : Airframe
    Ts : float, s
    """

    airframe: Airframe
    Ts: float

    @cached_property
    def model(self) -> StateSpace:
        """See `sitl.physics.linear_model.linear_model_with_noise`."""
        return linear_model_with_noise(self.airframe, self.Ts)

    @cached_property
    def fine(self) -> Signal:
        """Frequencies (K,), rad/s, dense enough for the margin."""
        return frequencies(self.airframe, self.Ts, FINE_STEP)

    @cached_property
    def fine_response(self) -> Response:
        """The model's response from the torques at `fine`, (K, 4, 2)."""
        return self.model.frequency_response(self.fine)[:, :, :2]

    def loop(self, gains: Gains) -> LinearLoop:
        """The loop of a gain set."""
        return LinearLoop(self.model, controller_of(gains))

    def sensitivity_peak(self, gains: Gains) -> float:
        """Ms: largest singular value of the sensitivity, cut at the torques. Says nothing about stability."""
        return self.loop(gains).sensitivity_peak(self.fine, self.fine_response)

    def spectral_radius(self, gains: Gains) -> float:
        """Largest modulus of the closed loop's poles; the loop is stable below 1."""
        return self.loop(gains).spectral_radius


def flight_of(airframe: Airframe, flown: Gains, amplitude: float) -> Experiment:
    """What the design needs of a flight besides the response: size of the manoeuvres, motors, flown gains.

    Parameters
    ----------
    airframe : Airframe
    flown : Gains
    amplitude : float, rad
        Size of the manoeuvres.
    """
    plant, mixer = airframe.plant(), airframe.allocation().mixer
    hover = plant.mass * GRAVITY / (len(plant.rotors) * plant.thrust_max)
    angles = amplitude * np.array([[1.0, 1.0], [-1.0, -1.0]])
    none = np.zeros_like(angles)
    motors = Motors(np.ascontiguousarray(mixer[:, :2]), hover * mixer[:, 3])
    return Experiment(Ts=flown.Ts, u=none, y_i=none, y_o=angles, source=airframe.name, flown=flown, motors=motors)


def optimum_on_true_plant(
    airframe: Airframe,
    flown: Gains,
    gusts: float = 0.0,
    amplitude: float = float(np.radians(10.0)),
    bandwidth: float | None = None,
    starts: Sequence[Gains] = (),
    limits: DesignLimits | None = None,
    follow_model: bool = False,
) -> Design:
    """The best gains of the structure on the true plant, within the constraints of the design.

    Parameters
    ----------
    airframe : Airframe
    flown : Gains
        Their noise limits that of the optimum; they give filters, limits and yaw, and a starting point.
    gusts : float
        See `true_response`.
    amplitude : float, rad
        Size of the manoeuvres, which the motors must be able to fly.
    bandwidth : float, rad/s, optional
        Of the attitude model; by default it is found.
    starts : sequence of Gains, optional
        Further starting points.
    limits : DesignLimits, optional
        By default those of `mimopilot tune`.
    follow_model : bool
        With model following: the attitude model runs in the controller.
    """
    spec = TuningSpec()
    plant, flight = true_response(airframe, flown.Ts, gusts), flight_of(airframe, flown, amplitude)
    bench = ResponseDesign.around([plant], [flight], limits or spec.design)
    inverse = np.linalg.inv(plant.body.B).astype(np.float64)
    first = flown
    if follow_model:  # the bandwidth is the design's
        filters = replace(flown.filters, model_omega=bandwidth or FIRST_BANDWIDTH)
        first = replace(flown, filters=filters, Kff_o=np.eye(2), Kaff_i=inverse)
    rigid = replace(first, Kp_o=START_ATTITUDE * np.eye(2), Kp_i=START_RATE * inverse, Ki_i=START_RATE * inverse)
    return bench.design([first, rigid, *starts], spec.structure, spec.method == "mimo", bandwidth)
