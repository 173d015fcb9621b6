"""Writers of a Crazyflie's logs: the uSD deck's binary log, and cfclient's CSV."""

import struct
import zlib

import numpy as np

DEGREE = np.pi / 180


def mimo_variables(flight):
    """The log variables of our controller: SI units, body FRD."""
    columns = {"u": flight.u, "ub": flight.u_bar, "y_i": flight.y_i, "y_o": flight.y_o, "r_o": flight.r_o}
    names = {"u": "uR uP", "ub": "ubR ubP", "y_i": "p q", "y_o": "roll pitch", "r_o": "rollSp pitchSp"}
    return {
        f"mimo.{name}": ("f", columns[key][:, axis])
        for key, text in names.items()
        for axis, name in enumerate(text.split())
    }


def stock_variables(flight):
    """The same flight as the stock firmware logs it: degrees; gyro with y to the left and z up."""
    return {
        "gyro.x": ("f", flight.y_i[:, 0] / DEGREE),
        "gyro.y": ("f", -flight.y_i[:, 1] / DEGREE),
        "stabilizer.roll": ("f", flight.y_o[:, 0] / DEGREE),
        "stabilizer.pitch": ("f", flight.y_o[:, 1] / DEGREE),
        "controller.roll": ("f", flight.r_o[:, 0] / DEGREE),
        "controller.pitch": ("f", flight.r_o[:, 1] / DEGREE),
        "controller.cmd_roll": ("f", 65535 * flight.u[:, 0]),
        "controller.cmd_pitch": ("f", 65535 * flight.u[:, 1]),
    }


def usd_bytes(time, variables, version=2, events=()):
    """A uSD log of ``group.name`` -> (type letter, values) at `time` (s), and further events (number, name, time)."""
    stamp, scale = {1: ("I", 1e3), 2: ("Q", 1e6)}[version]
    kinds = [(0xFFFF, "fixedFrequency", variables), *((number, name, {}) for number, name, _ in events)]
    head = struct.pack("<BHH", 0xBC, version, len(kinds))
    for number, name, columns in kinds:
        texts = [f"{column}({letter})".encode() + b"\0" for column, (letter, _) in columns.items()]
        head += struct.pack("<H", number) + name.encode() + b"\0" + struct.pack("<H", len(texts)) + b"".join(texts)
    row = struct.Struct(f"<H{stamp}" + "".join(letter for letter, _ in variables.values()))
    columns = [values.tolist() for _, values in variables.values()]
    rows = [(t, row.pack(0xFFFF, round(t * scale), *values)) for t, *values in zip(time, *columns, strict=True)]
    rows += [(t, struct.pack(f"<H{stamp}", number, round(t * scale))) for number, _, t in events]
    body = head + b"".join(data for _, data in sorted(rows, key=lambda one: one[0]))
    return body + struct.pack("<I", zlib.crc32(body))


def write_csv_block(path, time, variables, every=1):
    """A CSV file of one log block, every so many samples."""
    lines = [",".join(["Timestamp", *variables])]
    columns = [values[::every].tolist() for _, values in variables.values()]
    lines += [
        ",".join([str(round(1e3 * t)), *map(str, values)]) for t, *values in zip(time[::every], *columns, strict=True)
    ]
    path.write_text("\n".join(lines) + "\n")
    return path
