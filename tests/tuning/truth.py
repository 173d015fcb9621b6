"""The exact closed loop of an airframe about hover, independent of the tested code.

Rigid body and rotors are sampled with a zero-order hold. The computing delay, the gyro's filter and the structural mode
are as simulated; the controller is written out state by state.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag, expm

from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.flight.scenario import excitation_flight
from mimopilot.sitl.flight.simulator import fly
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.sitl.physics.state_estimate import frame_mode, low_pass
from mimopilot.tuning.experiment import Experiment
from mimopilot.tuning.spec import load_spec
from mimopilot.tuning.statespace import StateSpace

TS = 0.004
#: Bandwidth of the excitation, rad/s, the default of the experiment command.
BANDWIDTH = 50.0


def thesis(**options):
    """A specification with the thesis' model of the rate loop, whose figures are known, unless another is given."""
    return load_spec(**{"inner": (20.0, 0.4, 0), **options})


def series(first, second):
    """`second` after `first`."""
    n, m = len(first.A), len(second.A)
    A = np.block([[first.A, np.zeros((n, m))], [second.B @ first.C, second.A]])
    B = np.vstack([first.B, second.B @ first.D])
    return StateSpace(A, B, np.hstack([second.D @ first.C, second.C]), second.D @ first.D, first.Ts)


def delay(samples, Ts=TS):
    """Pure delay on two channels."""
    n = 2 * samples
    A = np.zeros((n, n))
    A[2:, :-2] = np.eye(max(n - 2, 0))
    B = np.zeros((n, 2))
    B[: min(n, 2)] = np.eye(2)[: min(n, 2)]
    C = np.zeros((2, n))
    C[:, max(n - 2, 0) :] = np.eye(2)[:, : min(n, 2)]
    return StateSpace(A, B, C, np.zeros((2, 2)) if samples else np.eye(2), Ts)


def linear_plant(airframe, late=0, Ts=TS):
    """From u to [measured rates, measured angles], with `late` periods of delay added to the airframe's own."""
    plant = airframe.plant()
    inverse, tau = plant.inertia_inverse[:2, :2], airframe.motors.time_constant
    A = np.zeros((6, 6))
    A[:2, :2] = -inverse @ np.diag(plant.rate_damping[:2])
    A[:2, 4:] = inverse @ np.diag(airframe.moment_scale()[:2])
    A[2:4, :2] = np.eye(2)
    A[4:, 4:] = -np.eye(2) / tau
    M = np.zeros((8, 8))
    M[:6, :6], M[4:6, 6:] = A * Ts, np.eye(2) / tau * Ts
    sampled = expm(M)
    body = StateSpace(sampled[:6, :6], sampled[:6, 6:], np.eye(4, 6), np.zeros((4, 2)), Ts)
    whole = series(delay(airframe.computing_delay + late, Ts), body)
    # Structural mode and gyro act on the rates, equally on both axes.
    blocks = []
    for _ in range(2):
        bend = StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((2, 0)), np.array([[1.0], [0.0]]), Ts)
        if airframe.frame is not None:
            f = frame_mode(airframe.frame.frequency_hz, airframe.frame.damping, airframe.frame.gain, Ts)
            F, g = f[:4].reshape(2, 2), f[4:, None] / Ts
            # The new bend acts at once: b(k) = F b(k-1) + g (w(k) - w(k-1)); states b(k-1), w(k-1).
            A1 = np.block([[F, -g], [np.zeros((1, 3))]])
            B1 = np.vstack([g, [[1.0]]])
            C1 = np.array([[F[1, 0], F[1, 1], -g[1, 0]], [F[0, 0], F[0, 1], -g[0, 0]]])
            bend = StateSpace(A1, B1, C1, np.array([[1 + g[1, 0]], [g[0, 0]]]), Ts)
        b0, b1, b2, a1, a2 = low_pass(airframe.gyro_cutoff_hz, Ts)
        gyro = StateSpace(
            np.array([[-a1, 1.0], [-a2, 0.0]]),
            np.array([[b1 - a1 * b0], [b2 - a2 * b0]]),
            np.array([[1.0, 0.0]]),
            np.array([[b0]]),
            Ts,
        )
        passed = StateSpace(
            gyro.A,
            np.hstack([gyro.B, np.zeros((2, 1))]),
            np.vstack([gyro.C, np.zeros((1, 2))]),
            np.array([[b0, 0.0], [0.0, 1.0]]),
            Ts,
        )
        blocks.append(series(bend, passed))
    # Each block: rate -> [filtered rate, bend]. Angles bypass it.
    stack = StateSpace(
        block_diag(*(b.A for b in blocks), np.zeros((0, 0))),
        np.hstack([block_diag(*(b.B for b in blocks)), np.zeros((sum(len(b.A) for b in blocks), 2))]),
        np.vstack(
            [
                block_diag(*(b.C[:1] for b in blocks)),
                block_diag(*(b.C[1:] for b in blocks)),
            ]
        ),
        np.vstack(
            [
                np.hstack([np.diag([b.D[0, 0] for b in blocks]), np.zeros((2, 2))]),
                np.hstack([np.diag([b.D[1, 0] for b in blocks]), np.eye(2)]),
            ]
        ),
        Ts,
    )
    return series(whole, stack)


@dataclass(frozen=True, eq=False)
class Truth:
    """The plant of an airframe and the closed loops of gain sets around it."""

    plant: StateSpace

    @staticmethod
    def of(airframe, late=0):
        return Truth(linear_plant(airframe, late))

    def loop(self, g):
        """A of the closed loop: plant, sum of I, filtered derivative, last rate."""
        p, n = self.plant, len(self.plant.A)
        x = np.eye(n + 6)
        y = p.C[:2] @ x[:n]
        angle = p.C[2:] @ x[:n]
        integral, slope, last = x[n : n + 2], x[n + 2 : n + 4], x[n + 4 :]
        a = g.filters.derivative_pole
        r = -g.Kp_o @ angle
        e = r - y
        new_integral = integral + g.Ts * g.Ki_i @ e
        new_slope = a * slope + (1 - a) / g.Ts * (y - last)
        u = g.Kp_i @ e + new_integral - g.Kd_i @ new_slope + g.Kff_i @ r
        return np.vstack([p.A @ x[:n] + p.B @ u, new_integral, new_slope, y])

    def spectral_radius(self, g):
        """Largest modulus of the closed loop's poles; the plant has no direct path where it is flown."""
        assert not self.plant.D.any()
        return float(np.abs(np.linalg.eigvals(self.loop(g))).max())

    def return_ratio(self, g, omega):
        """L at u of the whole cascade, written out from the difference equation."""
        z = np.exp(1j * omega * g.Ts)[:, None, None]
        G = self.plant.frequency_response(omega)
        a = g.filters.derivative_pole
        error = g.Kp_i + g.Ts * g.Ki_i * z / (z - 1)
        damping = g.Kd_i * (1 - a) * (z - 1) / (g.Ts * (z - a))
        return (error + damping) @ G[:, :2] + (error + g.Kff_i) @ g.Kp_o @ G[:, 2:]

    def margins(self, g, points=6000):
        """Peak of the sensitivity at u, and the smallest phase margin (deg) of an axis with the other one closed."""
        # Denser where modes are narrow.
        grids = np.geomspace(0.05, np.pi / TS * 0.999, points), np.linspace(60, 300, points)
        omega = np.unique(np.concatenate(grids))
        L = self.return_ratio(g, omega)
        S = np.linalg.inv(np.eye(2) + L)
        peak = float(np.linalg.norm(S, ord=2, axis=(1, 2)).max())
        phases = []
        for i in range(2):
            loop = 1 / S[:, i, i] - 1
            size = np.abs(loop)
            crossing = np.flatnonzero((size[1:] - 1) * (size[:-1] - 1) < 0)
            angle = np.degrees(np.angle(-loop[crossing]))
            phases.extend(np.abs(angle))
        return peak, float(min(phases, default=np.inf))


def experiment(name, seed=0, amplitude=0.15, bandwidth=BANDWIDTH, seconds=20.0, gusts=0.0, late=0, airframe=None):
    """A simulated flight as an Experiment; gusts are a coloured torque, their RMS a share of the full torque."""
    vehicle = load_airframe(name)
    airframe = airframe or vehicle.airframe
    airframe = airframe.model_copy(update={"computing_delay": airframe.computing_delay + late})
    gains = vehicle.default_gains()
    rng = np.random.default_rng(seed)
    scenario = excitation_flight(seconds, amplitude, bandwidth, TS, rng)
    pilot = Autopilot(airframe, gains)
    if not gusts:
        record = fly(airframe, pilot, scenario, seed).record
        u = record["moment"][:, :2].astype(float)
        u_bar = record["excitation"][:, :2].astype(float)
    else:
        # A gust is a torque that is not logged: injected with the excitation, then subtracted from both signals.
        noise = np.random.default_rng([seed, 9]).standard_normal((len(scenario.excitation), 2))
        pole = np.exp(-TS / 0.5)
        gust = np.zeros_like(noise)
        for k in range(1, len(gust)):
            gust[k] = pole * gust[k - 1] + np.sqrt(1 - pole**2) * noise[k]
        gust *= gusts
        clean = scenario.excitation.copy()
        scenario.excitation[:, :2] += gust
        record = fly(airframe, pilot, scenario, seed).record
        u = record["moment"][:, :2].astype(float) - gust
        u_bar = clean[:, :2]
    y_i, y_o = (record[field][:, :2].astype(float) for field in ("rates", "attitude"))
    return Experiment(Ts=TS, u=u, y_i=y_i, y_o=y_o, u_bar=u_bar, flown=gains, source=name)
