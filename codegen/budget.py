"""Processor in the loop: the same rows on the Cortex-M4 and on the host, and what a step costs.

Cycles are estimated from the instructions that were executed, by class, between two sums. The source is ARM's
Cortex-M4 Technical Reference Manual (DDI 0439), its tables of instruction and FPU timings, with memory without
wait states, as the STM32F4's flash accelerator gives for code that is in its cache:

============================  =======  ======================================================================
class                         lower    upper
============================  =======  ======================================================================
data processing, compare      1        1
IT                            0        1: folded into the instruction before it, or not
multiply-accumulate           1        2
divide (integer)              2        12
load one word                 1        3: pipelined, or alone and its result used at once
store one word                1        2
load or store N words         1 + N    2 + N, with the PC among them 4 + N
branch                        1        4: not taken, or a whole refill of the pipeline
call, return                  2        4
FPU add, multiply, compare    1        2: the result used at once
FPU multiply-accumulate       3        4
FPU divide, square root       14       15
FPU load one word             1        3
FPU store one word            1        2
FPU status to the flags       1        2
============================  =======  ======================================================================

Interrupts, and the first execution of code that is not in the cache yet, come on top.
"""

from __future__ import annotations

import re
import tempfile
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mimopilot.codegen.cortex_m4 import EmulatedController, Image, build_image, run_in_qemu
from mimopilot.codegen.errors import CodegenError
from mimopilot.codegen.native import NativeController, load_native
from mimopilot.codegen.toolchain import CXX_FLAGS, cross_tool, run_tool
from mimopilot.codegen.vectors import random_inputs
from mimopilot.tuning.gains import Gains
from numpy.typing import NDArray

CLOCK = 168e6
PERIOD = 4e-3
EMULATORS = ("unicorn", "qemu")
#: What the controller may take from a C library: copies and fills of memory.
LIBRARY = {"memcpy", "memset", "memmove"}

#: Mnemonic -> (lower, upper) cycles; the first that matches. N words are added to a multiple load or store.
_CYCLES = (
    (r"v(ldm|stm|push|pop)", (1, 2)),
    (r"vldr", (1, 3)),
    (r"vstr", (1, 2)),
    (r"v(div|sqrt)", (14, 15)),
    (r"v(f?n?m[al][as])", (3, 4)),
    (r"v", (1, 2)),
    (r"(ldm|stm|push|pop|ldrd|strd)", (1, 2)),
    (r"ldr", (1, 3)),
    (r"str", (1, 2)),
    (r"[us]div", (2, 12)),
    (r"(ml[as]|[us]mlal)", (1, 2)),
    (r"it[te]*$", (0, 1)),
    (r"(bl|bx|blx)$", (2, 4)),
    (r"(b|cbn?z)((eq|ne|cs|cc|mi|pl|vs|vc|hi|ls|ge|lt|gt|le)?(\.[nw])?)$", (1, 4)),
    (r"", (1, 1)),
)
_PC = 2


@dataclass(frozen=True)
class Figure:
    """One line of the budget page.

    Attributes
    ----------
    name : str
        Its key in the JSON object.
    text : str
        What it is, with its unit.
    value : float
        As measured or estimated.
    limit : float or None
        The most that is allowed; None: not budgeted.
    """

    name: str
    text: str
    value: float
    limit: float | None = None

    @property
    def passed(self) -> bool:
        """Whether the limit is kept."""
        return self.limit is None or self.value <= self.limit


def cycles(instruction: str) -> tuple[int, int]:
    """Lower and upper estimate for one instruction, as objdump writes it.

    Examples
    --------
    >>> cycles("vadd.f32 s0, s1, s2"), cycles("push {r4, r5, lr}"), cycles("vpop {d8-d9}")
    ((1, 2), (4, 5), (5, 6))
    """
    mnemonic, _, operands = instruction.partition(" ")
    lower, upper = next(cost for pattern, cost in _CYCLES if re.match(pattern, mnemonic))
    words = 2 if mnemonic.startswith(("ldrd", "strd")) else 0
    registers = re.search(r"\{(.*)\}", operands)
    if registers:
        for entry in registers[1].split(", "):
            first, _, last = entry.partition("-")
            count = int(last[1:]) - int(first[1:]) + 1 if last else 1
            words += count * (2 if first.startswith("d") else 1)
        upper += _PC if "pc" in registers[1] else 0
    return lower + words, upper + words


def step_costs(image: Image, periods: Sequence[Sequence[tuple[int, int]]]) -> NDArray[np.int64]:
    """Instructions and cycles of traced periods.

    Parameters
    ----------
    image : Image
        What ran.
    periods : sequence of sequences of (address, bytes)
        The blocks of each period, from `EmulatedController.run_traced`.

    Returns
    -------
    (N, 3) array
        Instructions, lower and upper estimate of the cycles.
    """
    listing = run_tool([cross_tool("objdump"), "-d", "--no-show-raw-insn", image.elf])
    at = {
        int(address, 16): (1, *cycles(f"{mnemonic} {operands}"))
        for address, mnemonic, operands in re.findall(r"^ *([0-9a-f]+):\t(\S+)[ \t]*(.*)$", listing, re.MULTILINE)
    }
    blocks = {block for period in periods for block in period}
    cost = {
        (start, size): np.sum([at[k] for k in range(start, start + size, 2) if k in at], axis=0)
        for start, size in blocks
    }
    return np.array([np.sum([cost[block] for block in period], axis=0) for period in periods])


def stack_bytes(image: Image) -> int:
    """The deepest stack of any call into the controller, from the compiler's call graph."""
    graph = image.core.with_suffix(".ci").read_text()
    own = {title: int(size) for title, size in re.findall(r'node: { title: "([^"]*)".*\\n(\d+) bytes \(', graph)}
    called = defaultdict(set)
    for source, target in re.findall(r'edge: { sourcename: "([^"]*)" targetname: "([^"]*)"', graph):
        called[source].add(target)

    def deepest(function: str) -> int:
        return own.get(function, 0) + max((deepest(target) for target in called[function]), default=0)

    return max(deepest(function) for function in own)


def foreign_symbols(image: Image) -> list[str]:
    """What the controller calls and does not bring, beyond `LIBRARY`."""
    undefined = run_tool([cross_tool("nm"), "-u", image.core]).split()
    return sorted(set(undefined) - {"U"} - LIBRARY)


def processor_in_the_loop(
    gains: Gains, rows: int = 10_000, emulator: str = "unicorn", flags: Sequence[str] = CXX_FLAGS
) -> list[Figure]:
    """Run the same rows on the Cortex-M4 and on the host, and measure what a step costs.

    Parameters
    ----------
    gains : Gains
        What both fly with.
    rows : int
        How many control periods, one after another.
    emulator : str
        Whose outputs are compared: one of `EMULATORS`. The cost is always traced by unicorn.
    flags : sequence of str
        Of the controller's compilation for the target.

    Raises
    ------
    CodegenError
        When a tool is missing or fails.
    """
    if emulator not in EMULATORS:
        raise CodegenError(f"emulator: got {emulator!r}, expected one of {', '.join(EMULATORS)}")
    inputs = random_inputs(rows, np.random.default_rng(1))
    with tempfile.TemporaryDirectory() as folder:
        image = build_image(gains, Path(folder), flags)
        expected = NativeController(load_native(gains), gains).run(inputs)
        outputs, periods = EmulatedController(image, gains).run_traced(inputs)
        if emulator == "qemu":
            outputs = run_in_qemu(image, inputs)
        return [
            Figure("rows", "rows", rows),
            Figure("rows_different", "rows that differ from the host's", different_rows(outputs, expected), 0),
            *_time_figures(step_costs(image, periods)),
            *_size_figures(image),
        ]


def different_rows(a: NDArray[Any], b: NDArray[Any]) -> int:
    """How many rows of two arrays of structures differ in any bit."""
    return int((a.view(np.uint8) != b.view(np.uint8)).reshape(len(a), -1).any(axis=1).sum())


def _time_figures(costs: NDArray[np.int64]) -> list[Figure]:
    instructions, lower, upper = costs.T
    most = int(upper.max())
    return [
        Figure("instructions_min", "instructions a step, fewest", int(instructions.min())),
        Figure("instructions_mean", "instructions a step, mean", float(instructions.mean())),
        Figure("instructions_max", "instructions a step, most", int(instructions.max()), 400),
        Figure("cycles_lower", "cycles of the longest step, lower estimate", int(lower.max())),
        Figure("cycles_upper", "cycles of the longest step, upper estimate", most),
        Figure("microseconds_lower", "the same at 168 MHz, us, lower estimate", float(lower.max() / CLOCK * 1e6)),
        Figure("microseconds_upper", "the same at 168 MHz, us, upper estimate", most / CLOCK * 1e6),
        Figure("budget_share", "share of 4 ms, upper estimate", most / CLOCK / PERIOD, 0.0015),
    ]


def _size_figures(image: Image) -> list[Figure]:
    foreign = foreign_symbols(image)
    text, data, bss = map(int, run_tool([cross_tool("size"), image.core]).splitlines()[1].split()[:3])
    return [
        Figure("text_bytes", "code of the controller, bytes", text, 2048),
        Figure("data_bytes", "initialised memory of the controller, bytes", data, 0),
        Figure("bss_bytes", "other static memory of the controller, bytes", bss, 0),
        Figure("stack_bytes", "stack of the controller, bytes", stack_bytes(image), 128),
        Figure("foreign_symbols", ": ".join(("library functions beyond memcpy and memset", *foreign)), len(foreign), 0),
    ]
