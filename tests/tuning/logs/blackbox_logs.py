"""A synthetic flight of Betaflight and writers of its log as the usual tools decode it."""

from dataclasses import dataclass

import numpy as np

#: Units of the mixer for a torque of 1, and rad/s^2 for a torque of 1: roll, pitch.
SCALE, ACCELERATION = 1000.0, np.array([100.0, 120.0])
#: s.
TS = 0.002
FIRST_ORDER = {"dterm_lpf1_type": "0", "dterm_lpf1_dyn_hz": "75,150", "dterm_lpf2_type": "0"}
SETTINGS = {
    "Product": "Blackbox flight data recorder by Nicholas Sherlock",
    "Firmware revision": "Betaflight 2025.12.0 (0000000) STM32F7X2",
    "looptime": "125",
    "pid_process_denom": "2",
    "rollPID": "45,80,30",
    "pitchPID": "47,84,34",
    "yawPID": "45,80,0",
    "levelPID": "50,75,75",
    "d_max": "40,46,0",
    **FIRST_ORDER,
    "dterm_lpf2_static_hz": "150",
    "iterm_windup": "80",
    "pidsum_limit": "500",
    "pidsum_limit_yaw": "400",
    "rate_limits": "1998,1998,1998",
    "motorOutput": "48,2047",
    "chirp_amplitude_roll": "60",
    "chirp_amplitude_pitch": "60",
}


@dataclass(frozen=True)
class BetaflightFlight:
    """Time (N,), s; (N, 2) in forward, left, up: P, I, deg/s, rad, deg/s; the chirp's debug fields (N, 4)."""

    t: np.ndarray
    P: np.ndarray
    I: np.ndarray  # noqa: E741
    rates: np.ndarray
    angles: np.ndarray
    setpoint: np.ndarray
    debug: np.ndarray

    @property
    def torque(self):
        """(N, 2), normalised, forward, right, down."""
        return (np.round(self.P) + np.round(self.I)) / SCALE * [1.0, -1.0]


def chirp(t, begin, seconds, hertz=(0.4, 30.0)):
    """Phase in 0 to 2 pi, excitation and frequency (N,), zero outside of the run; chirp.c's, written in closed form."""
    since, inside = t - begin, (t >= begin) & (t < begin + seconds)
    rate = np.log(hertz[1] / hertz[0]) / seconds
    frequency = hertz[0] * np.exp(rate * since)
    phase = 2 * np.pi / rate * (frequency - hertz[0]) % (2 * np.pi)
    return (np.where(inside, x, 0.0) for x in (phase, np.cos(phase) * np.minimum(frequency, 1.0), frequency))


def shaped(wave, lag=3.0, lead=30.0):
    """The excitation behind the phase compensation (1 + s/lead) / (1 + s/lag), by steps of a hundredth of a sample."""
    found, x, tau = np.zeros(len(wave)), 0.0, 1 / (2 * np.pi * lag)
    ratio, decay = lag / lead, np.exp(-TS / tau)
    for k, value in enumerate(wave):
        x = decay * x + (1 - decay) * value
        found[k] = ratio * value + (1 - ratio) * x
    return found


def betaflight_flight(seconds=4.0, size=60.0, sticks=None):
    """A chirp of roll, then one of pitch, `size` deg/s; or the rate setpoints (N, 2), deg/s, of `sticks`."""
    t = 100.0 + np.arange(round((2 * seconds + 4) / TS)) * TS
    debug, injected = np.tile([0.0, -1.0, 0.0, 0.0], (len(t), 1)), np.zeros((len(t), 2))
    if sticks is None:
        for axis, begin in enumerate((101.0, 103.0 + seconds)):
            phase, wave, frequency = chirp(t, begin, seconds)
            on = frequency > 0
            debug[on] = np.column_stack([5e3 * phase, np.full(len(t), axis), 10 * frequency, 1e3 * wave])[on]
            injected[on, axis] = size * shaped(wave)[on]
    setpoint = np.zeros((len(t), 2)) if sticks is None else np.asarray(sticks(t))
    P, I, rates, angles = np.zeros((4, len(t), 2))  # noqa: E741
    setpoint = setpoint + injected
    noise = 3.0 * np.random.default_rng(1).standard_normal((len(t), 2))
    for k in range(1, len(t)):
        torque = (P[k - 1] + I[k - 1] + noise[k - 1]) / SCALE
        rates[k] = rates[k - 1] + TS * (np.degrees(ACCELERATION * torque) - rates[k - 1])
        angles[k] = angles[k - 1] + np.radians(TS * (rates[k] + rates[k - 1]) / 2)
        error = setpoint[k] - rates[k] - (2.0 * np.degrees(angles[k]) if sticks is None else 0.0)
        P[k], I[k] = 2.0 * error, np.clip(I[k - 1] + 5.0 * TS * error, -200, 200)
        setpoint[k] -= 2.0 * np.degrees(angles[k]) if sticks is None else 0.0
    return BetaflightFlight(t, P, I, rates, angles, setpoint, np.round(debug))


def quaternion(angles):
    """x, y, z as logged, of roll and pitch in forward, left, up."""
    roll, pitch = angles.T / 2
    x, y, z = np.sin(roll) * np.cos(pitch), np.cos(roll) * np.sin(pitch), -np.sin(roll) * np.sin(pitch)
    return np.round(np.column_stack([x, y, z]) * 32767)


def table(flight, attitude="quaternion", resolution=1.0):
    """Name -> column of numbers, as logged; `attitude`: quaternion, degrees (--simulate-imu), none."""
    none = np.zeros(len(flight.t))
    columns = {"loopIteration": np.arange(len(flight.t)), "time": np.round(flight.t * 1e6)}
    for name, values, factor in (
        ("axisP", flight.P, 1.0),
        ("axisI", flight.I, 1.0),
        ("rcCommand", 0 * flight.P, resolution),
        ("setpoint", flight.setpoint, resolution),
        ("gyroADC", flight.rates, resolution),
    ):
        three = np.column_stack([values, none])
        columns |= {f"{name}[{i}]": np.round(three[:, i] * factor) for i in range(3)}
    if attitude == "quaternion":
        columns |= {f"imuQuaternion[{i}]": column for i, column in enumerate(quaternion(flight.angles).T)}
    columns |= {f"debug[{i}]": column for i, column in enumerate(flight.debug.T)}
    columns |= {f"motor[{i}]": np.full(len(flight.t), 600.0) for i in range(4)}
    if attitude == "degrees":
        roll, pitch = np.degrees(flight.angles).T
        columns |= {"roll": np.round(roll, 2), "pitch": np.round(pitch, 2), "heading": none}
    return columns


def write_decoded(path, columns, units=None, settings=None):
    """As blackbox_decode writes it, and settings beside it (--save-headers); a column of text at the end."""
    units = {"time": "us"} | (units or {})
    names = [f"{name} ({units[name]})" if name in units else name for name in columns]
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    lines = [", ".join([*names, "flightModeFlags (flags)"])]
    lines += [
        ", ".join([*(f"{cell:g}" if cell < 1e6 else f"{cell:.0f}" for cell in row), "ANGLE_MODE|MAG"]) for row in rows
    ]
    path.write_text("\n".join([*lines, ""]))
    if settings is not None:
        text = "".join(f'{name},"{value}"\n' for name, value in settings.items())
        path.with_name(f"{path.stem}.headers.csv").write_text(f"fieldname, fieldvalue\n{text}")
    return path


def write_exported(path, columns, settings=None):
    """As Blackbox Explorer exports it: settings first, all names in quotes."""
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    lines = [f'"{name}","{value}"' for name, value in (settings or SETTINGS).items()]
    lines.append(",".join(f'"{name}"' for name in columns))
    lines += [",".join("NaN" if cell != cell else repr(cell) for cell in row) for row in rows]
    path.write_text("\n".join([*lines, ""]))
    return path
