"""The emitted Crazyflie app, compiled against stand-ins for the firmware's headers and called through cffi.

The stand-ins have the names and types that the app uses. They are not the firmware, and this is no firmware build.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cffi

from mimopilot.codegen.render import render, write_tree
from mimopilot.codegen.toolchain import WARNINGS, find_compiler, find_tool, run_tool
from mimopilot.tuning.gains import Gains
from tests.conftest import coupled_gains

STUBS = Path(__file__).parent / "crazyflie_stubs"
#: With the firmware's flags that matter here; -O1 compiles faster than its -Os.
FLAGS = ("-O1", "-fno-math-errno", "-fPIC")
C_ONLY = ("-std=gnu11",)
CXX_ONLY = ("-std=gnu++17", "-fno-exceptions", "-fno-rtti")
FUNCTIONS = """
void controllerOutOfTreeInit(void);
bool controllerOutOfTreeTest(void);
void controllerOutOfTree(control_t *, const setpoint_t *, const sensorData_t *, const state_t *, uint32_t);
struct table_row { uint16_t type; const char *name; void *address; };
struct log_row { uint8_t type; const char *name; void *address; };
extern const struct table_row param_table[];
extern const struct log_row log_table[];
const char *param_group(void);
const char *log_group(void);
void run_app(int allowed);
"""


def crazyflie_gains(Ts: float = 0.002) -> Gains:
    """`coupled_gains` at the Crazyflie's rate, with its size of torque."""
    gains = coupled_gains()
    return replace(gains, filters=replace(gains.filters, Ts=Ts), moment_scale=(0.0078, 0.0075, 0.0017))


def emit(gains: Gains, folder: Path) -> tuple[list[Path], list[str]]:
    """Emit the app; its sources, and what a compiler must include."""
    write_tree(render(gains, "crazyflie"), folder)
    source = folder / "crazyflie/src"
    names = re.findall(r"obj-y \+= (\w+)\.o", (source / "Kbuild").read_text())
    files = [next(source.glob(f"{name}.c*")) for name in names]
    return files, [f"-I{folder / 'core'}", f"-I{folder / 'vehicle'}", "-isystem", str(STUBS)]


def compile_all(compilers: tuple[str, str], sources: Iterable[Path], flags: Iterable[str], folder: Path) -> list[Path]:
    """Compile with warnings as errors; the objects."""
    objects = []
    for source in sources:
        c = source.suffix == ".c"
        own = (*C_ONLY, *(one for one in WARNINGS if one != "-Wpedantic")) if c else (*CXX_ONLY, *WARNINGS)
        objects.append(folder / f"{source.stem}.o")
        run_tool([compilers[0 if c else 1], *flags, *own, "-c", source, "-o", objects[-1]])
    return objects


class Host:
    """One vehicle with the app on board, on level ground, its motors stopped.

    Parameters
    ----------
    gains : Gains
    folder : Path
        Where to emit and compile.
    attitude_rate : int
        The firmware's, Hz.
    like : Host, optional
        One of the same gains: only what depends on the firmware's rate is compiled again.
    """

    def __init__(self, gains: Gains, folder: Path, attitude_rate: int = 500, like: Host | None = None) -> None:
        sources, includes = emit(gains, folder)
        flags = [*FLAGS, *includes, f"-DATTITUDE_RATE={attitude_rate}"]
        compilers = find_tool("gcc", "gcc"), find_compiler()
        kept = [] if like is None else [one for one in like.objects if one.stem != "mimo_controller"]
        new = [one for one in (*sources, STUBS / "firmware.c") if one.stem not in {same.stem for same in kept}]
        self.objects = objects = [*kept, *compile_all(compilers, new, flags, folder)]
        library = folder / "app.so"
        run_tool([compilers[1], "-shared", *objects, "-o", library, "-lm"])
        ffi = cffi.FFI()
        types = re.sub(r"/\*.*?\*/|^#.*?$", "", (STUBS / "stabilizer_types.h").read_text(), flags=re.DOTALL | re.M)
        ffi.cdef(types + FUNCTIONS)
        self.ffi, self.lib = ffi, ffi.dlopen(str(library))
        self.firmware = self.lib.firmware
        self.parameters = self._table(self.lib.param_table, {6: "float *", 8: "uint8_t *"})
        self.defaults = {name: address[0] for name, (_, address) in self.parameters.items()}
        self.logged = self._table(self.lib.log_table, {1: "uint8_t *", 4: "int8_t *", 7: "float *"})
        self.start()

    def _table(self, rows: Any, pointers: dict[int, str]) -> dict[str, tuple[int, Any]]:
        """Name -> type and place in memory."""
        table, i = {}, 0
        while rows[i].name != self.ffi.NULL:
            kind = rows[i].type
            table[self.ffi.string(rows[i].name).decode()] = kind, self.ffi.cast(pointers[kind & 0x0F], rows[i].address)
            i += 1
        return table

    def start(self, **parameters: float) -> None:
        """Switch the vehicle on: with these parameters, as an upload has stored them, else the built-in ones."""
        number = {"SET_ID": self.defaults["FW_ID"]} if parameters.keys() - {"EN", "EX_AX"} else {}
        for name, value in (self.defaults | number | parameters).items():
            self.parameters[name][1][0] = int(value) if name == "STATE" else value
        for name in ("flying", "pid_inits", "pid_calls", "position_calls", "position_resets", "thrust", "idle_thrust"):
            setattr(self.firmware, name, 0)
        self.firmware.pid_passes = True
        self.control, self.setpoint = self.ffi.new("control_t *"), self.ffi.new("setpoint_t *")
        self.sensors, self.state = self.ffi.new("sensorData_t *"), self.ffi.new("state_t *")
        self.state.attitudeQuaternion.w = 1.0
        self.firmware.desired.roll = self.firmware.desired.pitch = self.firmware.desired.yaw = 0.0
        self.tick = 1
        self.lib.controllerOutOfTreeInit()

    def take_off(self, **parameters: float) -> None:
        """Start with our controller chosen, and fly with a thrust of half the most, level, in attitude mode."""
        self.start(EN=1.0, **parameters)
        self.setpoint.mode.roll = self.setpoint.mode.pitch = 1
        self.setpoint.mode.yaw = 2
        self.run(2)
        self.setpoint.thrust = 32767.5
        self.firmware.flying = True
        self.run(2)

    def run(self, ticks: int = 2) -> Any:
        """Call the controller for so many ms; the control."""
        for _ in range(ticks):
            self.tick += 1
            self.lib.controllerOutOfTree(self.control, self.setpoint, self.sensors, self.state, self.tick)
        return self.control

    def write(self, **parameters: float) -> None:
        """Write parameters, as the firmware's parameter task does."""
        for name, value in parameters.items():
            self.parameters[name][1][0] = value

    @property
    def console(self) -> str:
        """What the app tells on the console within a second."""
        self.lib.run_app(2)
        return str(self.ffi.string(self.firmware.console).decode())

    def log(self, name: str) -> float:
        """A log variable now."""
        return float(self.logged[name][1][0])

    @property
    def torque(self) -> list[float]:
        """N m, x forward, y left, z up."""
        return [self.control.torqueX, self.control.torqueY, self.control.torqueZ]
