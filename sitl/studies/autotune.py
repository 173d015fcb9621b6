"""Per-axis baseline: the rule of PX4's autotune applied to the same log.

PX4's multicopter autotune tunes one axis at a time. It low-passes u and the rate at the gyro cut-off (30 Hz),
high-passes them at 0.5 Hz, and fits by least squares

    y(k) = -a1 y(k-1) - a2 y(k-2) + b0 u(k-1) + b1 u(k-2) + b2 u(k-3)

at a period of at most 10 ms. It then designs a PID by generalised minimum variance: T. Yamamoto, K. Fujii, M. Kaneda,
"Design and implementation of a self-tuning PID controller" (1998). With B(1) = b0 + b1 + b2 and the wanted denominator
P(z^-1) = 1 + p1 z^-1 + p2 z^-2 (rise time 0.14 s, critically damped), the polynomials of

    P = (1 - z^-1) A (1 + e1 z^-1) + z^-2 (f0 + f1 z^-1 + f2 z^-2)

give the law (lambda + (1 + e1) B(1)) du = F(1) r - F y, which is an I-PD controller; lambda = 0.7 lowers the gains.
The attitude gain commands full torque at 60 degrees of error, within 2 to 6.5 1/s. Written from that description.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, sosfilt

from mimopilot.tuning.estimation.instrumental_variables import excited_stretches
from mimopilot.tuning.experiment import Experiment, external_signal
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.provenance import Provenance

BAND_HZ = (0.5, 30.0)  # high-pass and low-pass, PX4
PERIOD = 0.010  # s, largest period of the model, PX4
RISE_TIME, LAMBDA = 0.14, 0.7  # s, -: PX4
FULL_MOMENT = np.radians(60.0)  # rad of error at full torque, PX4
ATTITUDE_GAIN = (2.0, 6.5)  # 1/s, limits of PX4
#: Torque of PX4's allocation of an X quadrotor over ours, per unit of u; lambda is in PX4's unit.
UNIT = np.sqrt(2.0)

Signal = NDArray[np.float64]


def autotune(experiment: Experiment, flown: Gains) -> Gains:
    """Diagonal gains by the rule above; everything else as flown.

    Parameters
    ----------
    experiment : Experiment
        One flight that excites each axis in turn.
    flown : Gains
        The gains that flew.
    """
    external, _ = external_signal(experiment)
    found = np.zeros((4, 2))
    for axis, (_, segments) in enumerate(excited_stretches(experiment, external, "siso")):
        parts = [(experiment.u[a:b, axis] / UNIT, experiment.y_i[a:b, axis]) for a, b in segments]
        a, b, Ts = identify_arx(parts, experiment.Ts)
        Kp, Ki, Kd = UNIT * minimum_variance_pid(a, b, Ts)
        found[:, axis] = np.clip(1.0 / (FULL_MOMENT * Kp / UNIT), *ATTITUDE_GAIN), Kp, Ki, Kd
    Kp_o, Kp_i, Ki_i, Kd_i = (np.diag(row) for row in found)
    zero = np.zeros((2, 2))
    return replace(
        flown,
        Kp_o=Kp_o,
        Kp_i=Kp_i,
        Ki_i=Ki_i,
        Kd_i=Kd_i,
        Kff_i=zero,
        certificate=None,
        provenance=Provenance("autotune", experiment.source),
    )


def identify_arx(parts: list[tuple[Signal, Signal]], Ts: float) -> tuple[Signal, Signal, float]:
    """Second-order ARX model of one axis by least squares.

    Parameters
    ----------
    parts : list of (u, y)
        Segments without a gap, (N,) arrays each.
    Ts : float, s

    Returns
    -------
    a, b : (2,), (3,) arrays
    period : float, s
        Sampling period of the model.
    """
    every = max(1, int(PERIOD / Ts + 1e-9))
    low, high = BAND_HZ
    filters = np.vstack(
        [butter(2, high, "low", fs=1 / Ts, output="sos"), butter(1, low, "high", fs=1 / Ts, output="sos")]
    )
    rows, targets = [], []
    for u, y in parts:
        u_f, y_f = (sosfilt(filters, signal)[::every] for signal in (u, y))
        rows.append(np.column_stack([-y_f[2:-1], -y_f[1:-2], u_f[2:-1], u_f[1:-2], u_f[:-3]]))
        targets.append(y_f[3:])
    solution = np.linalg.lstsq(np.vstack(rows), np.concatenate(targets), rcond=None)[0]
    return solution[:2], solution[2:], every * Ts


def minimum_variance_pid(a: Signal, b: Signal, Ts: float, rise_time: float = RISE_TIME) -> Signal:
    """Kp, Ki, Kd of the I-PD controller that comes closest to the generalised minimum-variance law.

    Parameters
    ----------
    a, b : (2,), (3,) arrays
        Denominator and numerator of the model.
    Ts : float, s
        Sampling period of the model.
    rise_time : float, s
        Of the wanted closed loop.
    """
    # A critically damped pair of poles: P = (1 - exp(-2 Ts / rise time) z^-1)^2.
    pole = np.exp(-2.0 * Ts / rise_time)
    wanted = np.array([1.0, -2.0 * pole, pole**2, 0.0, 0.0])
    rising = np.convolve([1.0, -1.0], [1.0, *a])
    e1 = wanted[1] - rising[1]
    f = (wanted - np.convolve([1.0, e1], rising))[2:]
    size = LAMBDA + (1.0 + e1) * np.sum(b)
    # F / size = (Ki Ts) + Kp (1 - z^-1) + (Kd / Ts) (1 - z^-1)^2, power by power.
    return np.array([-(f[1] + 2.0 * f[2]) / size, np.sum(f) / (size * Ts), f[2] * Ts / size])
