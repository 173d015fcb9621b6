"""Flights of a linear vehicle whose response on all three axes is known in closed form.

Every axis is a damped integrator behind a delay: G_i(z) = B (1 - a) / c z^-(d+1) / (1 - a / z), a = exp(-c Ts), with a
full 3x3 control effectiveness B. The loop is stepped with the flown law; many flights are stepped at once.
"""

from dataclasses import dataclass, replace

import numpy as np

from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.tuning import law
from mimopilot.tuning.axes import law_of
from mimopilot.tuning.excitation import hold_from_bandwidth, prbs
from mimopilot.tuning.experiment import Experiment, YawSignals
from mimopilot.tuning.law_state_space import state_space
from mimopilot.tuning.law_terms import ERROR, RATE, SETPOINT
from mimopilot.tuning.plant.frequency_response import PlantResponse

TS = 0.004
#: Of adam0 without products of inertia, rad/s^2 per unit of torque; its damping (1/s) and delay (periods).
B = np.diag([150.0, 150.0, 9.0])
DAMPING, LATE = 1.0, 4
#: Standard deviation of the noise of rates (rad/s) and angles (rad).
NOISE = (0.004, 0.0005)


def flown():
    return load_airframe("adam0").default_gains()


def _rate_matrices(whole, axes):
    return {letter: matrix[axes, axes] for letter, matrix in law.rate_matrices(whole).items()}


@dataclass(frozen=True)
class Vehicle:
    """The vehicle and its exact loop."""

    B: np.ndarray
    late: int = LATE

    def response(self, omega):
        """Of rates and angles to the torque, (K, 3, 3) each; angles by the trapezoidal rule."""
        z = np.exp(1j * omega * TS)[:, None, None]
        a = np.exp(-DAMPING * TS)
        rates = self.B * (1 - a) / DAMPING / (z - a) * z**-self.late
        return rates, rates * TS / 2 * (z + 1) / (z - 1)

    def exact(self, omega, axes=slice(0, 3)):
        """What an experiment without noise gives, for some axes."""
        G_i, G_o = (G[:, axes, axes] for G in self.response(omega))
        n, K = G_i.shape[1], len(omega)
        nothing = np.zeros((K, 3 * n, 3 * n), complex), np.zeros((K, n, n), complex)
        return PlantResponse(omega, G_i, G_o, *nothing, np.ones((K, n)), TS)

    def loop(self, gains, axes=slice(0, 3)):
        """The closed loop as a matrix: from [state, u_bar, noise of rates, of angles] to [next state, u, y_i, y_o]."""
        whole = law_of(gains, 3)
        rate_law = state_space(_rate_matrices(whole, axes), whole.filters)
        n, m, a = len(rate_law.C), len(rate_law.A), np.exp(-DAMPING * TS)
        size = m + n * (2 + self.late)
        inputs = np.split(np.eye(size + 3 * n), np.cumsum([m, *[n] * (4 + self.late)]))
        memory, rate, angle, *queue = inputs[: 3 + self.late]
        u_bar, of_rate, of_angle = inputs[3 + self.late :]
        y_i, y_o = rate + of_rate, angle + of_angle
        setpoint = -whole.Kp_o[axes, axes] @ y_o
        signals = {ERROR: setpoint - y_i, RATE: y_i, SETPOINT: setpoint}
        u = rate_law.C @ memory + sum(rate_law.D[name] @ value for name, value in signals.items()) + u_bar
        memory = rate_law.A @ memory + sum(rate_law.B[name] @ value for name, value in signals.items())
        turned = a * rate + self.B[axes, axes] @ queue[0] * (1 - a) / DAMPING
        angle = angle + TS / 2 * (rate + turned)
        return np.vstack([memory, turned, angle, *queue[1:], u, u, y_i, y_o]), size

    def spectral_radius(self, gains, axes=slice(0, 3)):
        """Of the closed loop."""
        matrix, size = self.loop(gains, axes)
        return float(np.abs(np.linalg.eigvals(matrix[:size, :size])).max())

    def peak(self, gains, axes=slice(0, 3)):
        """Ms: largest singular value of the sensitivity at the torques; of yaw's in the unit that makes it least."""
        omega = np.geomspace(0.1, np.pi / TS * 0.999, 2000)
        G_i, G_o = (G[:, axes, axes] for G in self.response(omega))
        whole = law_of(gains, 3)
        of_r, of_y = law.rate_response(_rate_matrices(whole, axes), whole.filters, omega)
        L = of_y @ G_i + of_r @ whole.Kp_o[axes, axes] @ G_o
        least = np.full(len(omega), np.inf)
        for unit in np.geomspace(1e-3, 1e3, 121) if len(L[0]) == 3 else (1.0,):
            scale = np.array([1.0, 1.0, unit])[axes]
            scaled = np.eye(len(scale)) + L * scale / scale[:, None]
            least = np.minimum(least, 1 / np.linalg.svd(scaled, compute_uv=False)[:, -1])
        return float(least.max())

    def fly(self, gains, count=1, seconds=12.0, amplitude=(0.1, 0.1, 0.2), bandwidth=(50.0, 50.0, 25.0), seed=0):
        """Flights that excite roll, pitch and yaw one after the other, as experiments."""
        generator = np.random.default_rng(seed)
        n = round(seconds / TS)
        u_bar = np.zeros((3 * n, 3, count))
        for axis in range(3):
            holds = hold_from_bandwidth(bandwidth[axis], TS)
            for flight in range(count):
                if amplitude[axis]:
                    u_bar[axis * n : (axis + 1) * n, axis, flight] = prbs(n, amplitude[axis], *holds, generator)
        matrix, size = self.loop(gains)
        noise = np.repeat(NOISE, 3)[:, None] * generator.standard_normal((3 * n, 6, count))
        state, rows = np.zeros((size, count)), []
        for outside in np.concatenate([u_bar, noise], axis=1):
            found = matrix @ np.vstack([state, outside])
            state = found[:size]
            rows.append(found[size:])
        u, y_i, y_o = np.split(np.array(rows), 3, axis=1)
        return [self._log(gains, *(s[:, :, k] for s in (u, y_i, y_o, u_bar)), f"flight {k}") for k in range(count)]

    def _log(self, gains, u, y_i, y_o, u_bar, source):
        names = ("u", "y_i", "y_o", "u_bar")
        signals = dict(zip(names, (u, y_i, y_o, u_bar), strict=True))
        yaw = YawSignals(**{name: s[:, 2] for name, s in signals.items()})
        return Experiment(Ts=TS, **{name: s[:, :2] for name, s in signals.items()}, flown=gains, source=source, yaw=yaw)


def coupled(to_roll, to_yaw):
    """A vehicle whose yaw torque moves roll, and whose roll torque moves yaw, by these shares of their own axis."""
    effectiveness = B.copy()
    effectiveness[0, 2], effectiveness[2, 0] = to_roll * B[2, 2], to_yaw * B[0, 0]
    return Vehicle(effectiveness)


def calm():
    """Gains whose loop of roll and pitch has a good margin around `B`."""
    gains = flown()
    return replace(gains, **{name: 0.7 * getattr(gains, name) for name in ("Kp_i", "Ki_i", "Kd_i")})


def faster_yaw(gains, factor):
    """The set with faster yaw: attitude gain times 2, rate gains times a factor."""
    yaw = gains.yaw
    return replace(gains, yaw=replace(yaw, Kp_o=2 * yaw.Kp_o, Kp_i=factor * yaw.Kp_i, Ki_i=factor * yaw.Ki_i))
