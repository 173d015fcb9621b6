"""A synthetic flight of a rigid body that follows setpoints, and writers of its logs."""

import struct
from dataclasses import dataclass

import numpy as np

from mimopilot.sitl.flight.flight_log import quaternions
from mimopilot.sitl.flight.ulog_writer import HEADER, _declare, _keyed, _message


@dataclass(frozen=True)
class Flight:
    """Signals (N, 2) of torque, rad/s, rad, and the time (N,), s; u_bar is the injected part of u."""

    t: np.ndarray
    u: np.ndarray
    y_i: np.ndarray
    y_o: np.ndarray
    r_o: np.ndarray
    u_bar: np.ndarray


def make_flight(seconds=8.0, Ts=0.004, start=10.0, still=(0.0, 0.0), inject=lambda t: np.zeros((len(t), 2))):
    """A flight; `still` is the time on the ground before and after it, s."""
    t = start + np.arange(round(seconds / Ts)) * Ts
    ground = (t < start + still[0]) | (t > t[-1] - still[1])
    generator = np.random.default_rng(1)
    hold = max(1, round(0.1 / Ts))
    r_o = 0.2 * generator.choice([-1.0, 1.0], (len(t) // hold + 1, 2)).repeat(hold, axis=0)[: len(t)]
    r_o[ground] = 0.0
    u_bar = inject(t)
    u, y_i, y_o = np.zeros((3, len(t), 2))
    dither = 0.01 * generator.standard_normal((len(t), 2))
    for k in range(1, len(t)):
        if ground[k]:
            continue
        y_i[k] = y_i[k - 1] + Ts * (ACCELERATION * u[k - 1] - y_i[k - 1])
        y_o[k] = y_o[k - 1] + Ts * (y_i[k] + y_i[k - 1]) / 2
        u[k] = 0.1 * (4.0 * (r_o[k] - y_o[k]) - y_i[k]) + dither[k] + u_bar[k]
    return Flight(t, u, y_i, y_o, r_o, u_bar)


#: Of roll and pitch for a unit of torque, rad/s^2.
ACCELERATION = np.array([100.0, 120.0])


def pulses(t, amplitude=0.1, begin=-np.inf, end=np.inf):
    """Torque of random sign on both axes, (N, 2), held for 40 ms, from `begin` to `end` (s)."""
    hold = max(1, round(0.04 / (t[1] - t[0])))
    signs = np.random.default_rng(0).choice([-amplitude, amplitude], (len(t) // hold + 1, 2))
    return np.where(((t >= begin) & (t < end))[:, None], signs.repeat(hold, axis=0)[: len(t)], 0.0)


def injected(flight, publication=0.0004):
    """The topic that holds what was injected, published so long after the gyro sample."""
    x, y = flight.u_bar.astype(np.float32).T
    name = np.full(len(flight.t), b"MIMO_EXC", "S10")
    return {"timestamp": microseconds(flight.t + publication), "x": x.copy(), "y": y.copy(), "name": name}


def three(values):
    """The pair of signals as float32 x, y, z."""
    return np.column_stack([values, np.zeros(len(values))]).astype(np.float32)


def microseconds(t):
    return np.round(np.asarray(t) * 1e6).astype(np.uint64)


def attitude(y_o):
    return quaternions(three(y_o))


def write_ulog(path, topics, parameters=(), changes=()):
    """A ULog file of topics (name, instance, fields), each with its own time stamps, which `fields` hold.

    `changes` (time s, name, value) are parameters that are set among the messages of the first topic.
    """
    head = [HEADER, struct.pack("<Q", 0), _message("B", bytes(40)), _keyed("I", "char[3] sys_name", b"PX4")]
    head += [_keyed("I", "uint32_t ver_sw_release", struct.pack("<I", 0x010D02FF))]
    formats = {name: fields for name, _, fields in topics}
    head += [
        _message("F", f"{name}:{''.join(_declare(k, v) for k, v in fields.items())}".encode())
        for name, fields in formats.items()
    ]
    head += [_keyed("P", f"float {name}", struct.pack("<f", value)) for name, value in dict(parameters).items()]
    body = []
    for number, (name, instance, fields) in enumerate(topics):
        body.append(_message("A", struct.pack("<BH", instance, number) + name.encode()))
        columns = [(field, values.dtype.str, values.shape[1:]) for field, values in fields.items()]
        rows = np.zeros(len(next(iter(fields.values()))), np.dtype(columns))
        for field, values in fields.items():
            rows[field] = values
        messages = [_message("D", struct.pack("<H", number) + row.tobytes()) for row in rows]
        for time, name, value in () if number else changes:
            last = int(np.searchsorted(rows["timestamp"], round(time * 1e6), side="right")) - 1
            messages[last] += _keyed("P", f"float {name}", struct.pack("<f", value))
        body += messages
    path.write_bytes(b"".join(head + body))
    return path


def px4_topics(flight, **extra):
    """The topics of a PX4 1.14 log at full rate, every torque published 0.4 ms after its gyro sample."""
    sample = {"timestamp": microseconds(flight.t + 0.0004), "timestamp_sample": microseconds(flight.t)}
    topics = {
        "vehicle_torque_setpoint": {**sample, "xyz": three(flight.u)},
        "vehicle_angular_velocity": {**sample, "xyz": three(flight.y_i)},
        "vehicle_attitude": {**sample, "q": attitude(flight.y_o)},
        "vehicle_attitude_setpoint": {"timestamp": sample["timestamp"], "q_d": attitude(flight.r_o)},
        **extra,
    }
    return [(name, 0, fields) for name, fields in topics.items()]


KINDS = {"Q": "<u8", "I": "<u4", "f": "<f4", "B": "u1", "c": "<i2", "N": "S16", "Z": "S64", "b": "i1"}


def dataflash_bytes(messages):
    """A dataflash log of messages (name, format letters, column names, columns)."""
    out = [struct.pack("<3sBB4s16s64s", b"\xa3\x95\x80", 128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")]
    for kind, (name, letters, names, columns) in enumerate(messages, 1):
        record = np.dtype(
            [("head", "S2"), ("kind", "u1"), *((n, KINDS[c]) for n, c in zip(names, letters, strict=True))]
        )
        description = struct.pack(
            "<3sBB4s16s64s",
            b"\xa3\x95\x80",
            kind,
            record.itemsize,
            name.encode(),
            letters.encode(),
            ",".join(names).encode(),
        )
        rows = np.zeros(len(columns[0]), record)
        rows["head"], rows["kind"] = b"\xa3\x95", kind
        for n, values in zip(names, columns, strict=True):
            rows[n] = values
        out += [description, rows.tobytes()]
    return b"".join(out)


def ardupilot_messages(flight, angles="ANG"):
    """RATE and the angles in degrees, as ArduPilot logs them in every loop."""
    degrees = 180 / np.pi
    rate = [*(degrees * flight.y_i.T), *flight.u.T]
    angle = [*(degrees * flight.y_o.T), *(degrees * flight.r_o.T)]
    if angles == "ATT":
        angle = [np.round(100 * a) for a in angle]
    stamps = microseconds(flight.t)
    return [
        ("RATE", "Qffff", ("TimeUS", "R", "P", "ROut", "POut"), [stamps, *rate]),
        (
            angles,
            "Qffff" if angles == "ANG" else "Qcccc",
            ("TimeUS", "Roll", "Pitch", "DesRoll", "DesPitch"),
            [stamps, *angle],
        ),
    ]


def old_ardupilot_messages(flight):
    """RATE, ATT and EV as ArduCopter 3.2 and 3.3 log them: milliseconds, hundredths of degrees, inputs of +-4500."""
    hundredths = 100 * 180 / np.pi
    stamps = np.floor(np.asarray(flight.t) * 1e3 + 1e-6).astype(np.uint32)
    rate = [*(hundredths * flight.y_i.T), *(4500 * flight.u.T)]
    angle = [np.round(hundredths * a) for a in (*flight.y_o.T, *flight.r_o.T)]
    return [
        ("RATE", "Iffff", ("TimeMS", "R", "P", "ROut", "POut"), [stamps, *rate]),
        ("ATT", "Icccc", ("TimeMS", "Roll", "Pitch", "DesRoll", "DesPitch"), [stamps, *angle]),
    ]


COLUMNS = ("t", "u_roll", "u_pitch", "p", "q", "roll", "pitch", "roll_sp", "pitch_sp")


def table(flight):
    """Columns of a flight by their default names, SI units."""
    signals = (flight.t[:, None], flight.u, flight.y_i, flight.y_o, flight.r_o)
    return dict(zip(COLUMNS, np.column_stack(signals).T, strict=True))


def write_csv(path, columns, delimiter=","):
    rows = np.column_stack(list(columns.values()))
    lines = [delimiter.join(f"{value:.9g}" for value in row) for row in rows]
    path.write_text("\n".join([delimiter.join(columns), *lines]) + "\n")
    return path


@dataclass(frozen=True)
class YawFlight:
    """Signals (N,) of yaw in the samples of a `Flight`: torque, rad/s, rad, and the injected part of the torque."""

    u: np.ndarray
    y_i: np.ndarray
    y_o: np.ndarray
    u_bar: np.ndarray


#: Of yaw for a unit of torque, rad/s^2.
YAW_ACCELERATION = 10.0


def turning(flight, begin=-np.inf, end=np.inf, heading=3.0):
    """Yaw of a flight that holds a heading (rad), with a torque of random sign injected from `begin` to `end` (s)."""
    t, Ts = flight.t, flight.t[1] - flight.t[0]
    hold = max(1, round(0.2 / Ts))
    signs = np.random.default_rng(2).choice([-0.2, 0.2], len(t) // hold + 1).repeat(hold)[: len(t)]
    u_bar = np.where((t >= begin) & (t < end), signs, 0.0)
    u, y_i, y_o = np.zeros((3, len(t)))
    y_o[0] = heading
    for k in range(1, len(t)):
        y_i[k] = y_i[k - 1] + Ts * YAW_ACCELERATION * u[k - 1]
        y_o[k] = y_o[k - 1] + Ts * (y_i[k] + y_i[k - 1]) / 2
        u[k] = 0.3 * (1.5 * (heading - y_o[k]) - y_i[k]) + u_bar[k]
    # The body turns about the vertical: its rate and the heading are those at the small tilt of this flight.
    rate = (y_i * np.cos(flight.y_o[:, 1]) - flight.y_i[:, 1] * np.sin(flight.y_o[:, 0])) / np.cos(flight.y_o[:, 0])
    return YawFlight(u, rate, y_o, u_bar)


def wrapped(angle):
    """Angle from -pi to pi, as logs hold a heading."""
    return np.remainder(angle + np.pi, 2 * np.pi) - np.pi
