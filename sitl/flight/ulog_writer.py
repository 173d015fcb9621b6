"""Writes ULog files (PX4's log format) from arrays: uniform sampling, any topics, no wall-clock time.

pyulog reads and copies ULog files but cannot make one from arrays. PX4's documentation describes the format.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

HEADER = b"ULog\x01\x12\x35\x01"  # magic, then version 1
EPOCH_US = 1_000_000  # us, time stamp of the first sample; chosen: readers take 0 as no time

#: Fields of a topic: name -> (N,) or (N, m) array; the dtype gives the type in the file.
Fields = Mapping[str, NDArray[Any]]

_TYPES = {"f4": "float", "f8": "double", "u1": "uint8_t", "i4": "int32_t", "u2": "uint16_t", "S": "char"}


def ulog_bytes(
    Ts: float, topics: Mapping[str, Fields], parameters: Mapping[str, float], information: Mapping[str, str]
) -> bytes:
    """Make a ULog file in which every topic has one message for each sample.

    Parameters
    ----------
    Ts : float, s
        Sampling period.
    topics : mapping
        Topic -> fields, all of the same length N. ``timestamp`` and ``timestamp_sample`` (microseconds)
        are added in front.
    parameters : mapping
        Parameter name -> value, stored as float.
    information : mapping
        Key -> text, such as ``sys_name``.

    Returns
    -------
    bytes
        The file; the same input gives the same bytes.
    """
    count = len(next(iter(next(iter(topics.values())).values())))
    stamps = EPOCH_US + np.round(np.arange(count) * Ts * 1e6).astype(np.uint64)
    definitions = [HEADER, struct.pack("<Q", EPOCH_US), _message("B", bytes(40))]
    definitions += [
        _keyed("I", f"char[{len(text.encode())}] {key}", text.encode()) for key, text in information.items()
    ]
    columns: list[tuple[str, str, tuple[int, ...]]] = []
    data: dict[str, NDArray[Any]] = {}
    subscriptions = []
    for number, (topic, fields) in enumerate(topics.items()):
        named = {"timestamp": stamps, "timestamp_sample": stamps, **fields}
        definitions.append(_message("F", f"{topic}:{''.join(_declare(k, v) for k, v in named.items())}".encode()))
        subscriptions.append(_message("A", struct.pack("<BH", 0, number) + topic.encode()))
        payload = sum(value.dtype.itemsize * int(np.prod(value.shape[1:])) for value in named.values())
        for name, kind, value in (("size", "<u2", payload + 2), ("type", "u1", ord("D")), ("id", "<u2", number)):
            columns.append((f"{topic}.{name}", kind, ()))
            data[f"{topic}.{name}"] = np.array(value)
        for name, array in named.items():
            columns.append((f"{topic}.{name}", array.dtype.str, array.shape[1:]))
            data[f"{topic}.{name}"] = array
    definitions += [_keyed("P", f"float {name}", struct.pack("<f", value)) for name, value in parameters.items()]
    rows = np.zeros(count, np.dtype(columns))
    for column, values in data.items():
        rows[column] = values
    return b"".join(definitions + subscriptions) + rows.tobytes()


def _message(kind: str, payload: bytes) -> bytes:
    return struct.pack("<HB", len(payload), ord(kind)) + payload


def _keyed(kind: str, key: str, value: bytes) -> bytes:
    return _message(kind, struct.pack("<B", len(key)) + key.encode() + value)


def _declare(name: str, values: NDArray[Any]) -> str:
    if values.dtype == np.uint64:
        return f"uint64_t {name};"
    if values.dtype.kind == "S":
        return f"char[{values.dtype.itemsize}] {name};"
    kind = _TYPES[values.dtype.str[1:]]
    return f"{kind}[{values.shape[1]}] {name};" if values.ndim == 2 else f"{kind} {name};"
