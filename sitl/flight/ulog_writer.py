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

#: Name, type and shape of a column of a structured array.
Column = tuple[str, str, tuple[int, ...]]

_TYPES = {"f4": "float", "f8": "double", "u1": "uint8_t", "i4": "int32_t", "u2": "uint16_t", "S": "char"}


def ulog_bytes(
    Ts: float,
    topics: Mapping[str, Fields],
    parameters: Mapping[str, float],
    information: Mapping[str, str],
    samples: Mapping[str, tuple[int, int]] | None = None,
) -> bytes:
    """Make a ULog file in which a topic has one message for each sample, or for each of some samples.

    Parameters
    ----------
    Ts : float, s
        Sampling period.
    topics : mapping
        Topic -> fields, all of the same length N. ``timestamp`` and ``timestamp_sample`` (microseconds)
        are added in front.
    parameters : mapping
        Parameter name -> value: a float, or an int, which is stored as INT32.
    information : mapping
        Key -> text, such as ``sys_name``.
    samples : mapping, optional
        Topic -> first sample that has a message, and samples from one message to the next; by default 0 and 1.

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
    chosen = {topic: (samples or {}).get(topic, (0, 1)) for topic in topics}
    columns: dict[tuple[int, int], list[Column]] = {choice: [] for choice in sorted(set(chosen.values()))}
    data: dict[str, NDArray[Any]] = {}
    subscriptions = []
    for number, (topic, fields) in enumerate(topics.items()):
        named = {"timestamp": stamps, "timestamp_sample": stamps, **fields}
        definitions.append(_message("F", f"{topic}:{''.join(_declare(k, v) for k, v in named.items())}".encode()))
        subscriptions.append(_message("A", struct.pack("<BH", 0, number) + topic.encode()))
        payload = sum(value.dtype.itemsize * int(np.prod(value.shape[1:])) for value in named.values())
        layout = columns[chosen[topic]]
        for name, kind, value in (("size", "<u2", payload + 2), ("type", "u1", ord("D")), ("id", "<u2", number)):
            layout.append((f"{topic}.{name}", kind, ()))
            data[f"{topic}.{name}"] = np.array(value)
        for name, array in named.items():
            layout.append((f"{topic}.{name}", array.dtype.str, array.shape[1:]))
            data[f"{topic}.{name}"] = array[chosen[topic][0] :: chosen[topic][1]]
    definitions += [_parameter(name, value) for name, value in parameters.items()]
    return b"".join(definitions + subscriptions) + _messages(columns, data, count)


def _messages(columns: Mapping[tuple[int, int], list[Column]], data: Mapping[str, NDArray[Any]], count: int) -> bytes:
    """The messages of `count` samples in order of time; columns by first sample and samples between messages."""
    rows = {}
    for (first, period), layout in columns.items():
        rows[first, period] = np.zeros(len(range(first, count, period)), np.dtype(layout))
        for column, *_ in layout:
            rows[first, period][column] = data[column]
    if list(rows) == [(0, 1)]:
        return rows[0, 1].tobytes()
    return b"".join(
        found[(k - first) // period].tobytes()
        for k in range(count)
        for (first, period), found in rows.items()
        if k >= first and (k - first) % period == 0
    )


def _parameter(name: str, value: float) -> bytes:
    kind, code = ("int32_t", "<i") if isinstance(value, int) else ("float", "<f")
    return _keyed("P", f"{kind} {name}", struct.pack(code, value))


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
