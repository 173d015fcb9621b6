"""Refusing a MATLAB file that claims more than it holds, before its reader makes room for it.

The layout is that of MathWorks' "MAT-File Format" (R2019b), level 5: elements with a tag of type and length, an array
being an element of flags, dimensions, name and contents.
"""

from __future__ import annotations

import math
import struct
import zlib
from pathlib import Path

from mimopilot.tuning.errors import TuningError

HEADER, ORDER_AT = 128, 126  # bytes of the file header; where it says the byte order
COMPRESSED, MATRIX = 15, 14
CELL, STRUCT, OBJECT, SPARSE, NUMBERS = 1, 2, 3, 5, range(4, 16)
MAX_BYTES = 1 << 29  # unpacked: an hour of all signals at 1 kHz is 374 MB
MAX_DEPTH = 32  # structures in structures


def check_sizes(path: Path) -> None:
    """Check every array of a level 5 file.

    Raises
    ------
    TuningError
        When an array claims more values than its bytes can hold, or the contents unpack to more than `MAX_BYTES`.
    """
    content = path.read_bytes()
    order = ">" if content[ORDER_AT : ORDER_AT + 2] == b"MI" else "<"
    room = MAX_BYTES
    for kind, body in _elements(memoryview(content)[HEADER:], order, padded=False):
        inner = body
        if kind == COMPRESSED:
            inner = memoryview(zlib.decompressobj().decompress(body, room + 1))
            if len(inner) > room:
                raise TuningError(f"{path}: unpacks to more than {MAX_BYTES >> 20} MiB; save the signals of one flight")
            room -= len(inner)
            inner = next((part for _, part in _elements(inner, order)), memoryview(b""))
        if kind in (COMPRESSED, MATRIX) and not _holds(inner, order, 0):
            raise TuningError(f"{path}: damaged MATLAB file: an array claims more values than it has; save it again")


def _elements(data: memoryview, order: str, padded: bool = True) -> list[tuple[int, memoryview]]:
    """Type and bytes of the elements that follow each other; one that is cut ends the list."""
    found, at = [], 0
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(order + "II", data, at)
        if kind >> 16:  # up to four bytes are packed into the tag
            found.append((kind & 0xFFFF, data[at + 4 : at + 4 + (kind >> 16)]))
            at += 8
            continue
        if size > len(data) - at - 8:
            found.append((kind, data[at + 8 : at + 8]))  # nothing is there of what is claimed
            break
        found.append((kind, data[at + 8 : at + 8 + size]))
        at += 8 + size + (-size % 8 if padded else 0)
    return found


def _holds(array: memoryview, order: str, depth: int) -> bool:
    """Whether the values that an array claims, and those of the arrays in it, can be in its bytes: one byte each."""
    parts = _elements(array, order)
    if len(parts) < 2 or len(parts[0][1]) < 4:
        return True  # nothing is claimed
    kind = struct.unpack_from(order + "I", parts[0][1])[0] & 0xFF
    if kind == SPARSE or kind not in (CELL, STRUCT, OBJECT, *NUMBERS):
        return True  # sizes are those of the contents
    lengths = struct.unpack(f"{order}{len(parts[1][1]) // 4}i", parts[1][1][: len(parts[1][1]) // 4 * 4])
    inner = [part for number, part in parts[2:] if number == MATRIX] if kind in (CELL, STRUCT, OBJECT) else []
    return (
        math.prod(max(length, 0) for length in lengths) <= len(array)
        and depth < MAX_DEPTH
        and all(_holds(part, order, depth + 1) for part in inner)
    )
