"""Processor in the loop: the same inputs on the Cortex-M4 and on the host, and the cost of a control step.

The cycles of a step are bounded by a lower and an upper sum over its executed instructions. Costs are from ARM's
Cortex-M4 Technical Reference Manual (DDI 0439), tables of instruction and FPU timings. Memory has no wait states, as
the STM32F4's flash accelerator provides for code in its cache:

============================  =======  ======================================================================
class                         lower    upper
============================  =======  ======================================================================
data processing, compare      1        1
IT                            0        1: folded into the preceding instruction, or not
multiply-accumulate           1        2
divide (integer)              2        12
load one word                 1        3: pipelined, or alone with its result used at once
store one word                1        2
load or store N words         1 + N    2 + N, including the PC 4 + N
branch                        1        4: not taken, or a full pipeline refill
call, return                  2        4
FPU add, multiply, compare    1        2: the result used at once
FPU multiply-accumulate       3        4
FPU divide, square root       14       15
FPU load one word             1        3
FPU store one word            1        2
FPU status to the flags       1        2
============================  =======  ======================================================================

Interrupts, and the first execution of code outside the cache, are not included.
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
from numpy.typing import NDArray

from mimopilot.codegen.cortex_m4 import EmulatedController, FirmwareImage, build_image, run_in_qemu
from mimopilot.codegen.errors import CodegenError
from mimopilot.codegen.native import NativeController, load_native
from mimopilot.codegen.toolchain import CXX_FLAGS, cross_tool, run_tool
from mimopilot.codegen.vectors import SEED, random_inputs
from mimopilot.common.errors import check_choice
from mimopilot.tuning.gains import Gains

#: Core clock, Hz: that of the STM32F4 on Pixhawk boards.
CLOCK = 168e6
#: Control period that the budget is for, s.
PERIOD = 4e-3
#: Limits, all chosen: bytes of code and of stack; instructions of a step and share of 4 ms, without and with model
#: following.
MAX_TEXT_BYTES, MAX_STACK_BYTES = 3072, 128
MAX_STEP = (540, 0.002)
MAX_STEP_FOLLOWING = (700, 0.0026)
#: What a setpoint slew limit may add to both.
MAX_SLEW = (150, 0.0008)
EMULATORS = ("unicorn", "qemu")
#: C library functions that the controller may call: copying and filling memory.
LIBRARY = {"memcpy", "memset", "memmove"}

#: (pattern of the mnemonic, (lower, upper) cycles); the first match counts. Multiple load and store: plus N words.
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
#: Additional upper cycles if the PC is loaded.
_PC = 2


@dataclass(frozen=True)
class BudgetItem:
    """One line of the budget page.

    Attributes
    ----------
    name : str
        Key in the JSON object.
    text : str
        Description, with the unit.
    value : float
        Measured or estimated.
    limit : float or None
        Largest allowed value; None: not limited.
    """

    name: str
    text: str
    value: float
    limit: float | None = None

    @property
    def passed(self) -> bool:
        """Whether the value is within its limit."""
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


def step_costs(image: FirmwareImage, periods: Sequence[Sequence[tuple[int, int]]]) -> NDArray[np.int64]:
    """Instructions and cycles of each traced control period.

    Parameters
    ----------
    image : FirmwareImage
        The firmware that was traced.
    periods : sequence of sequences of (address, bytes)
        Basic blocks of each period, from `EmulatedController.run_traced`.

    Returns
    -------
    (N, 3) array
        Instructions, lower and upper estimate of the cycles, of N periods.
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


def stack_bytes(image: FirmwareImage) -> int:
    """Largest stack use of any call into the controller, bytes, from the compiler's call graph."""
    graph = image.core.with_suffix(".ci").read_text()
    own = {title: int(size) for title, size in re.findall(r'node: { title: "([^"]*)".*\\n(\d+) bytes \(', graph)}
    called = defaultdict(set)
    for source, target in re.findall(r'edge: { sourcename: "([^"]*)" targetname: "([^"]*)"', graph):
        called[source].add(target)

    def deepest(function: str) -> int:
        return own.get(function, 0) + max((deepest(target) for target in called[function]), default=0)

    return max(deepest(function) for function in own)


def undefined_symbols(image: FirmwareImage) -> list[str]:
    """Undefined symbols of the controller that are not in `LIBRARY`."""
    listing = run_tool([cross_tool("nm"), "-u", image.core]).split()
    return sorted(set(listing) - {"U"} - LIBRARY)


def processor_in_the_loop(
    gains: Gains, rows: int = 10_000, emulator: str = "unicorn", flags: Sequence[str] = CXX_FLAGS
) -> list[BudgetItem]:
    """Run the same inputs on the Cortex-M4 and on the host; measure the cost of a step.

    Parameters
    ----------
    gains : Gains
        Gains of both controllers.
    rows : int
        Number of consecutive control periods.
    emulator : str
        Emulator whose outputs are compared, one of `EMULATORS`. The cost is always traced in unicorn.
    flags : sequence of str
        Compiler flags of the controller on the target.

    Raises
    ------
    CodegenError
        If a tool is missing or fails.
    """
    check_choice("emulator", emulator, EMULATORS, CodegenError)
    inputs = random_inputs(rows, np.random.default_rng(SEED))
    with tempfile.TemporaryDirectory() as folder:
        image = build_image(gains, Path(folder), flags)
        expected = NativeController(load_native(gains), gains).run(inputs)
        outputs, periods = EmulatedController(image, gains).run_traced(inputs)
        if emulator == "qemu":
            outputs = run_in_qemu(image, inputs)
        return [
            BudgetItem("rows", "rows", rows),
            BudgetItem("rows_different", "rows that differ from the host", different_rows(outputs, expected), 0),
            *_time_items(step_costs(image, periods), gains.Ts, *_step_limits(gains)),
            *_size_items(image),
        ]


def _step_limits(gains: Gains) -> tuple[int, float]:
    """Largest instructions of a step and share of the period that the options of a set may cost."""
    instructions, share = MAX_STEP_FOLLOWING if gains.filters.followed else MAX_STEP
    more, more_share = MAX_SLEW if gains.filters.setpoint_slew else (0, 0.0)
    return instructions + more, share + more_share


def different_rows(a: NDArray[Any], b: NDArray[Any]) -> int:
    """Number of rows that differ in any bit between two structured arrays."""
    return int((a.view(np.uint8) != b.view(np.uint8)).reshape(len(a), -1).any(axis=1).sum())


def _time_items(costs: NDArray[np.int64], Ts: float, max_instructions: int, max_share: float) -> list[BudgetItem]:
    instructions, lower, upper = costs.T
    most = int(upper.max())
    return [
        BudgetItem("instructions_min", "instructions per step, minimum", int(instructions.min())),
        BudgetItem("instructions_mean", "instructions per step, mean", float(instructions.mean())),
        BudgetItem("instructions_max", "instructions per step, maximum", int(instructions.max()), max_instructions),
        BudgetItem("cycles_lower", "cycles of the longest step, lower estimate", int(lower.max())),
        BudgetItem("cycles_upper", "cycles of the longest step, upper estimate", most),
        BudgetItem("microseconds_lower", "the same at 168 MHz, us, lower estimate", float(lower.max() / CLOCK * 1e6)),
        BudgetItem("microseconds_upper", "the same at 168 MHz, us, upper estimate", most / CLOCK * 1e6),
        BudgetItem("budget_share", "share of 4 ms, upper estimate", most / CLOCK / PERIOD, max_share),
        BudgetItem("period_share", f"share of the gains' period, {1e3 * Ts:g} ms, upper estimate", most / CLOCK / Ts),
    ]


def _size_items(image: FirmwareImage) -> list[BudgetItem]:
    undefined = undefined_symbols(image)
    library_text = ": ".join(("library functions other than memcpy, memset, memmove", *undefined))
    text, data, bss = map(int, run_tool([cross_tool("size"), image.core]).splitlines()[1].split()[:3])
    return [
        BudgetItem("text_bytes", "code of the controller, bytes", text, MAX_TEXT_BYTES),
        BudgetItem("data_bytes", "initialised memory of the controller, bytes", data, 0),
        BudgetItem("bss_bytes", "other static memory of the controller, bytes", bss, 0),
        BudgetItem("stack_bytes", "stack of the controller, bytes", stack_bytes(image), MAX_STACK_BYTES),
        BudgetItem("foreign_symbols", library_text, len(undefined), 0),
    ]
