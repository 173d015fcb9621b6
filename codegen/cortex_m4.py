"""The controller on an emulated Cortex-M4F: firmware image, unicorn and QEMU.

`EmulatedController` (unicorn) replaces `codegen.native.NativeController`. `run_in_qemu` boots the emitted firmware
from reset, as a board does.
"""

from __future__ import annotations

import ctypes
import mmap
import re
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.codegen.errors import CodegenError
from mimopilot.codegen.layout import GAINS, INPUT, OUTPUT, STATE, gains_array, input_rows
from mimopilot.codegen.render import render, write_tree
from mimopilot.codegen.toolchain import CORTEX_M4_FLAGS, CXX_FLAGS, WARNINGS, cross_tool, find_tool, run_tool
from mimopilot.common.extras import EMULATOR
from mimopilot.tuning.gains import Gains

#: Memory map of the STM32F405 (RM0090): address and size, bytes, of the flash and of the part of the RAM that is used.
FLASH, FLASH_SIZE = 0x0800_0000, 1 << 20
RAM, RAM_SIZE = 0x2000_0000, 1 << 16
#: Addresses of the structures in the emulated RAM. The stack grows down from its end.
STATE_AT, INPUT_AT, OUTPUT_AT, GAINS_AT = RAM, RAM + 0x400, RAM + 0x600, RAM + 0x800
#: Return address of a call; the emulator stops there.
RETURN = FLASH + FLASH_SIZE - 0x100
#: vmsr fpscr, r0; bx lr. Executed to set FPSCR: unicorn does not apply a register write to it.
SET_FPSCR = bytes.fromhex("e1ee100a7047")

FUNCTIONS = ("initialise", "set_gains", "step")
#: Timeout of a run in QEMU, s; chosen.
QEMU_SECONDS = 300


@dataclass(frozen=True)
class FirmwareImage:
    """Firmware that runs the controller on rows of inputs.

    Attributes
    ----------
    elf : Path
        Linked image.
    core : Path
        Object file of the controller alone; its call graph (``.ci``) is in the same folder.
    flash : bytes
        Content of the flash memory.
    functions : dict
        Name in `FUNCTIONS` -> address.
    """

    elf: Path
    core: Path
    flash: bytes
    functions: dict[str, int]


def build_image(gains: Gains, folder: Path, flags: Sequence[str] = CXX_FLAGS) -> FirmwareImage:
    """Emit the cortex-m4 target into `folder` and compile it.

    Parameters
    ----------
    gains : Gains
        The gains that the firmware starts with.
    folder : Path
        Empty, or generated before.
    flags : sequence of str
        Compiler flags of the controller itself, besides those of the processor.

    Raises
    ------
    CodegenError
        If there is no cross compiler or it fails, or the folder holds files that were not generated.
    """
    compiler = cross_tool("g++")
    write_tree(render(gains, "cortex-m4"), folder)
    build, target = folder / "build", folder / "cortex_m4"
    build.mkdir(exist_ok=True)
    core, elf, flash = build / "mimo_pid.o", build / "rows.elf", build / "rows.bin"
    source = folder / "core" / "mimo_pid.cpp"
    run_tool([compiler, *flags, *WARNINGS, *CORTEX_M4_FLAGS, "-fcallgraph-info=su", "-c", source, "-o", core])
    sources = (target / "startup.cpp", target / "rows_main.cpp", core)
    libraries = ("-Wl,--start-group", "-lc", "-lgcc", "-lrdimon", "-Wl,--end-group")
    link = ("-nostdlib", "-DMIMO_PID_SEMIHOSTING", "-T", target / "stm32f4.ld")
    run_tool([compiler, *CXX_FLAGS, *WARNINGS, *CORTEX_M4_FLAGS, *link, *sources, *libraries, "-o", elf])
    run_tool([cross_tool("objcopy"), "-O", "binary", elf, flash])
    symbols = run_tool([cross_tool("nm"), "-C", elf])
    found = re.findall(rf"^([0-9a-f]+) T mimopilot::({'|'.join(FUNCTIONS)})\(", symbols, re.MULTILINE)
    return FirmwareImage(elf, core, flash.read_bytes(), {name: int(address, 16) for address, name in found})


class EmulatedController:
    """One controller on a Cortex-M4F emulated by unicorn, with the interface of `NativeController`.

    Parameters
    ----------
    image : FirmwareImage
        The firmware; its functions are called directly.
    gains : Gains
        The initial gains.

    Raises
    ------
    Error
        If unicorn is not installed.
    CodegenError
        If the controller refuses its gains.
    """

    def __init__(self, image: FirmwareImage, gains: Gains) -> None:
        EMULATOR.need()
        import unicorn
        from unicorn import arm_const as arm

        self.image = image
        self._memory = mmap.mmap(-1, RAM_SIZE)
        self._uc = unicorn.Uc(unicorn.UC_ARCH_ARM, unicorn.UC_MODE_THUMB | unicorn.UC_MODE_MCLASS)
        self._uc.ctl_set_cpu_model(arm.UC_CPU_ARM_CORTEX_M4)
        self._uc.mem_map(FLASH, FLASH_SIZE)
        self._uc.mem_write(FLASH, image.flash)
        self._uc.mem_write(RETURN - len(SET_FPSCR), SET_FPSCR)
        pointer = ctypes.addressof(ctypes.c_char.from_buffer(self._memory))
        self._uc.mem_map_ptr(RAM, RAM_SIZE, unicorn.UC_PROT_READ | unicorn.UC_PROT_WRITE, pointer)
        self._registers = (arm.UC_ARM_REG_R0, arm.UC_ARM_REG_R1, arm.UC_ARM_REG_R2)
        self._sp, self._lr = arm.UC_ARM_REG_SP, arm.UC_ARM_REG_LR
        self._block_hook = unicorn.UC_HOOK_BLOCK
        self._error: type[Exception] = unicorn.UcError
        # Enable the FPU: full access to coprocessors 10 and 11, then the enable bit of FPEXC.
        self._uc.reg_write(arm.UC_ARM_REG_C1_C0_2, 0xF << 20)
        self._uc.reg_write(arm.UC_ARM_REG_FPEXC, 1 << 30)
        self._call(RETURN - len(SET_FPSCR), 0)

        def view(at: int, dtype: np.dtype[Any]) -> NDArray[Any]:
            return np.frombuffer(self._memory, dtype, 1, at - RAM)

        #: The controller's state, (1,) array of `codegen.layout.STATE`: the emulated memory itself.
        self.state = view(STATE_AT, STATE)
        self._input, self._output, self._gains = view(INPUT_AT, INPUT), view(OUTPUT_AT, OUTPUT), view(GAINS_AT, GAINS)
        self._gains[0] = gains_array(gains)
        if not self._call(image.functions["initialise"], STATE_AT, GAINS_AT):
            raise CodegenError(
                "the controller refused its gains: each must be finite and within its range; correct the gains file"
            )
        self._host_step = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p)(self._step_at)

    def _call(self, function: int, *arguments: int) -> int:
        """Call a function by the ARM procedure call standard (AAPCS); returns r0."""
        for register, value in zip(self._registers, arguments, strict=False):
            self._uc.reg_write(register, value)
        self._uc.reg_write(self._sp, RAM + RAM_SIZE)
        self._uc.reg_write(self._lr, RETURN | 1)
        try:
            self._uc.emu_start(function | 1, RETURN)
        except self._error as error:
            raise CodegenError(f"the emulated controller stopped: {error}", exit_code=1) from error
        return int(self._uc.reg_read(self._registers[0]))

    def _step(self) -> None:
        self._call(self.image.functions["step"], STATE_AT, INPUT_AT, OUTPUT_AT)

    def _step_at(self, state: int, inputs: int, outputs: int) -> None:
        # `state` is in the emulated memory already. After an error the output is NaN, never a stale torque.
        ctypes.memset(outputs, 0xFF, OUTPUT.itemsize)
        ctypes.memmove(self._input.ctypes.data, inputs, INPUT.itemsize)
        self._step()
        ctypes.memmove(outputs, self._output.ctypes.data, OUTPUT.itemsize)

    @property
    def step_address(self) -> int:
        """Address of a function like mimo_pid_step, for calls from compiled loops; uses this controller's state."""
        return int(ctypes.cast(self._host_step, ctypes.c_void_p).value or 0)

    def set_gains(self, gains: Gains | NDArray[np.float32]) -> bool:
        """Change the gains, bumpless. False: refused, the old gains are kept.

        Parameters
        ----------
        gains : Gains or (len(PARAMETERS),) float32 array
            The new gains.
        """
        self._gains[0] = gains_array(gains)
        return bool(self._call(self.image.functions["set_gains"], STATE_AT, GAINS_AT))

    def run(self, inputs: NDArray[Any], after_each: Callable[[], None] = lambda: None) -> NDArray[Any]:
        """Run consecutive control periods.

        Parameters
        ----------
        inputs : (N,) array of `codegen.layout.INPUT`
            One row per period.
        after_each : callable
            Called after each period.

        Returns
        -------
        (N,) array of `codegen.layout.OUTPUT`
        """
        rows = input_rows(inputs)
        outputs = np.zeros(len(rows), OUTPUT)
        for k in range(len(rows)):
            self._input[0] = rows[k]
            self._step()
            outputs[k] = self._output[0]
            after_each()
        return outputs

    def run_traced(self, inputs: NDArray[Any]) -> tuple[NDArray[Any], list[list[tuple[int, int]]]]:
        """As `run`; also returns the basic blocks executed in each period, as (address, bytes)."""
        blocks: list[tuple[int, int]] = []
        periods: list[list[tuple[int, int]]] = []

        def close_period() -> None:
            periods.append(blocks.copy())
            blocks.clear()

        hook = self._uc.hook_add(self._block_hook, lambda _uc, address, size, _data: blocks.append((address, size)))
        outputs = self.run(inputs, close_period)
        self._uc.hook_del(hook)
        return outputs, periods


def load_emulated(gains: Gains) -> EmulatedController:
    """Build the image in a temporary folder, and return the controller on it."""
    with tempfile.TemporaryDirectory() as folder:
        return EmulatedController(build_image(gains, Path(folder)), gains)


def run_in_qemu(image: FirmwareImage, inputs: NDArray[Any]) -> NDArray[Any]:
    """Run control periods on an emulated board (QEMU's netduinoplus2, an STM32F405), from reset.

    Parameters
    ----------
    image : FirmwareImage
        The firmware; it uses the gains that it was generated with.
    inputs : (N,) array of `codegen.layout.INPUT`
        One row per period.

    Returns
    -------
    (N,) array of `codegen.layout.OUTPUT`

    Raises
    ------
    CodegenError
        If QEMU is missing, or the firmware fails.
    """
    qemu = find_tool("qemu-system-arm", "qemu-system-arm")
    folder = image.elf.parent
    (folder / "inputs.bin").write_bytes(inputs.tobytes())
    machine = ("-machine", "netduinoplus2", "-display", "none", "-serial", "none", "-monitor", "none")
    host = ("-semihosting-config", "enable=on,target=native")
    command = [qemu, *machine, *host, "-kernel", str(image.elf)]
    try:
        status = subprocess.run(command, cwd=folder, capture_output=True, check=False, timeout=QEMU_SECONDS).returncode
    except subprocess.TimeoutExpired:
        raise CodegenError(f"the firmware did not end within {QEMU_SECONDS} s in QEMU", exit_code=1) from None
    written = (folder / "outputs.bin").read_bytes() if status == 0 else b""
    if len(written) != len(inputs) * OUTPUT.itemsize:
        raise CodegenError(f"the firmware failed in QEMU (exit status {status}): {' '.join(command)}", exit_code=1)
    return np.frombuffer(written, OUTPUT)
