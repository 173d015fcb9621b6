"""Check of the array sizes in a MATLAB file before scipy allocates memory for them.

Format: MathWorks, "MAT-File Format" (R2019b), level 5. A file is a list of elements, each with a tag of type and
length. An array is an element that holds flags, dimensions, name and contents.
"""

from __future__ import annotations

import math
import struct
import zlib
from pathlib import Path

from mimopilot.tuning.errors import TuningError

HEADER, ORDER_AT = 128, 126  # bytes: size of the file header, offset of its byte order mark
COMPRESSED, MATRIX = 15, 14  # data types of elements (table 1-1 there)
CELL, STRUCT, OBJECT, SPARSE, NUMBERS = 1, 2, 3, 5, range(4, 16)  # array classes
MAX_BYTES = 1 << 29  # after decompression: one hour of all signals at 1 kHz is 374 MB
MAX_DEPTH = 32  # levels of nested structures


def check_sizes(path: Path) -> None:
    """Check the size of every array in a level 5 file.

    Raises
    ------
    TuningError
        When an array declares more values than its bytes can hold, or the contents exceed `MAX_BYTES`.
    """
    content = path.read_bytes()
    order = ">" if content[ORDER_AT : ORDER_AT + 2] == b"MI" else "<"
    remaining = MAX_BYTES
    for kind, body in _elements(memoryview(content)[HEADER:], order, padded=False):
        inner = body
        if kind == COMPRESSED:
            inner = memoryview(zlib.decompressobj().decompress(body, remaining + 1))
            if len(inner) > remaining:
                raise TuningError(f"{path}: unpacks to more than {MAX_BYTES >> 20} MiB; save the signals of one flight")
            remaining -= len(inner)
            inner = next((part for _, part in _elements(inner, order)), memoryview(b""))
        if kind in (COMPRESSED, MATRIX) and not _holds_declared_values(inner, order, 0):
            raise TuningError(
                f"{path}: damaged MATLAB file: an array declares more values than it holds; save the file again"
            )


def _elements(data: memoryview, order: str, padded: bool = True) -> list[tuple[int, memoryview]]:
    """Type and bytes of consecutive elements; the list ends at a truncated one."""
    found, at = [], 0
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(order + "II", data, at)
        if kind >> 16:  # small element: up to four bytes are inside the tag
            found.append((kind & 0xFFFF, data[at + 4 : at + 4 + (kind >> 16)]))
            at += 8
            continue
        if size > len(data) - at - 8:
            found.append((kind, data[at + 8 : at + 8]))  # truncated: no data
            break
        found.append((kind, data[at + 8 : at + 8 + size]))
        at += 8 + size + (-size % 8 if padded else 0)
    return found


def _holds_declared_values(array: memoryview, order: str, depth: int) -> bool:
    """Whether the bytes of an array and of all arrays in it can hold the declared values, at one byte each."""
    parts = _elements(array, order)
    if len(parts) < 2 or len(parts[0][1]) < 4:
        return True  # no dimensions are declared
    kind = struct.unpack_from(order + "I", parts[0][1])[0] & 0xFF
    if kind == SPARSE or kind not in (CELL, STRUCT, OBJECT, *NUMBERS):
        return True  # the contents declare the sizes
    lengths = struct.unpack(f"{order}{len(parts[1][1]) // 4}i", parts[1][1][: len(parts[1][1]) // 4 * 4])
    inner = [part for number, part in parts[2:] if number == MATRIX] if kind in (CELL, STRUCT, OBJECT) else []
    return (
        math.prod(max(length, 0) for length in lengths) <= len(array)
        and depth < MAX_DEPTH
        and all(_holds_declared_values(part, order, depth + 1) for part in inner)
    )
