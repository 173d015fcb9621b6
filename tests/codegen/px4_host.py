"""The emitted PX4 module, compiled against stubs of PX4 and driven by text commands.

The stubs have the PX4 names and types that the module uses. They are not PX4, and this is no PX4 build.
"""

from __future__ import annotations

import subprocess
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from mimopilot.codegen.render import render, write_tree
from mimopilot.codegen.toolchain import WARNINGS, find_compiler

STUBS = Path(__file__).parent / "px4_stubs"
STANDARD = {"crtp": "-std=gnu++14", "descriptor": "-std=gnu++17"}
#: PX4's compiler flags for modules, where they could matter here.
PX4_FLAGS = (
    "-O2",
    "-fno-signed-zeros",
    "-fno-trapping-math",
    "-freciprocal-math",
    "-fno-math-errno",
    "-fno-exceptions",
    "-fno-rtti",
    "-Wfloat-equal",
    "-Wcast-align",
    "-Wlogical-op",
    "-Wpointer-arith",
    "-Wframe-larger-than=2048",
    "-Wno-unused-parameter",
)
#: The module's own flags for the core.
CORE_FLAGS = ("-fno-fast-math", "-fno-reciprocal-math", "-fno-associative-math")
#: PX4's own parameters that the module reads, with their defaults in PX4 v1.16; int32 where no point is.
PX4_PARAMETERS = {
    "MPC_MAN_TILT_MAX": 35.0,
    "MC_MAN_TILT_TAU": 0.0,
    "MPC_MAN_Y_MAX": 150.0,
    "MPC_MAN_Y_TAU": 0.08,
    "MPC_YAW_EXPO": 0.6,
    "MPC_HOLD_DZ": 0.1,
    "MC_AIRMODE": 0,
    "MPC_THR_CURVE": 0,
    "MPC_MANTHR_MIN": 0.08,
    "MPC_THR_HOVER": 0.5,
    "MPC_THR_MAX": 1.0,
    "COM_SPOOLUP_TIME": 1.0,
    "MC_ACRO_R_MAX": 100.0,
    "MC_ACRO_P_MAX": 100.0,
    "MC_ACRO_Y_MAX": 100.0,
    "MC_ACRO_EXPO": 0.0,
    "MC_ACRO_EXPO_Y": 0.0,
    "MC_ACRO_SUPEXPO": 0.0,
    "MC_ACRO_SUPEXPOY": 0.0,
    "MC_BAT_SCALE_EN": 0,
    "MC_YAW_TQ_CUTOFF": 2.0,
    "COM_OF_LOSS_T": 1.0,
    "COM_RC_LOSS_T": 0.5,
    "MC_AT_EN": 0,
}
WORDS = {
    "torque": 3,
    "rates": 3,
    "integral": 3,
    "excitation": 3,
    "thrust": 3,
    "attitude": 4,
    "q_d": 4,
    "yaw_rate": 1,
}
OUT = np.dtype([(name, "<f4", count) for name, count in WORDS.items()])


def definitions(files: dict[str, str]) -> dict[str, dict]:
    """Parameter name -> its entry of the emitted module.yaml."""
    (group,) = yaml.safe_load(files["px4/src/modules/mc_mimo_pid/module.yaml"])["parameters"]
    return group["definitions"]


def parameters_header(entries: dict[str, dict]) -> str:
    """What PX4's build generates from module.yaml: an enum, types and defaults."""
    kinds = {name: entry["type"] == "float" for name, entry in entries.items()}
    kinds |= {name: isinstance(value, float) for name, value in PX4_PARAMETERS.items()}
    values = {name: entry["default"] for name, entry in entries.items()} | PX4_PARAMETERS
    names = list(kinds)
    return "\n".join(
        [
            "#pragma once",
            "#include <stdint.h>",
            "#include <stdlib.h>",
            "#include <string.h>",
            "namespace px4 {",
            f"enum class params : uint16_t {{ {', '.join(names)} }};",
            "constexpr bool kFloat[] = {" + ", ".join("true" if kinds[n] else "false" for n in names) + "};",
            "constexpr double kDefaults[] = {" + ", ".join(repr(float(values[n])) for n in names) + "};",
            f"struct Values {{ double v[{len(names)}]; Values() {{ memcpy(v, kDefaults, sizeof(v)); }} }};",
            "inline double *values() { static Values values; return values.v; }",
            "inline const char *name(int i) {",
            "static const char *const names[] = {" + ", ".join(f'"{n}"' for n in names) + "};",
            "return names[i]; }",
            "inline int find(const char *wanted) {",
            f"for (int i = 0; i < {len(names)}; i++) {{ if (strcmp(name(i), wanted) == 0) {{ return i; }} }}",
            "return 0xffff; }",
            "inline void set_value(const char *name, double value) {",
            "const int i = find(name); if (i == 0xffff) { abort(); } values()[i] = value; }",
            "}",
            "",
        ]
    )


def emit(gains, api: str, folder: Path) -> tuple[list[Path], list[str]]:
    """Emit the module; its sources, the core first, and what a compiler must include."""
    files = render(gains, "px4", px4_api=api)
    write_tree(files, folder / "tree")
    (folder / "generated").mkdir(exist_ok=True)
    (folder / "generated" / "generated_parameters.hpp").write_text(parameters_header(definitions(files)))
    module, core, vehicle = (folder / "tree" / name for name in ("px4/src/modules/mc_mimo_pid", "core", "vehicle"))
    includes = [f"-I{module}", f"-I{core}", f"-I{vehicle}", '-DMODULE_NAME="mc_mimo_pid"']
    for path in (folder / "generated", STUBS / api, STUBS / "common"):
        includes += ["-isystem", str(path)]
    return [core / "mimo_pid.cpp", *sorted(vehicle.glob("*.cpp")), *sorted(module.glob("*.cpp"))], includes


def build(gains, api: str, folder: Path) -> Path:
    """Emit, compile with PX4's flags and warnings as errors, and link with the host program."""
    (core, *sources), includes = emit(gains, api, folder)
    common = [find_compiler(), STANDARD[api], *PX4_FLAGS, *includes]
    jobs = {core: [*CORE_FLAGS, *WARNINGS]}
    jobs |= {path: [*WARNINGS, "-Wno-unused-parameter"] for path in sources}
    jobs |= {path: ["-Wall", "-fexceptions", "-frtti"] for path in sorted(STUBS.glob("*.cpp"))}
    objects = []
    for source, flags in jobs.items():
        objects.append(folder / f"{source.stem}.o")
        command = [*common, *flags, "-c", str(source), "-o", str(objects[-1])]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        assert result.returncode == 0, result.stderr
    program = folder / "host"
    subprocess.run([find_compiler(), *map(str, objects), "-o", str(program)], check=True)
    return program


@dataclass
class Transcript:
    """What the host program printed.

    Attributes
    ----------
    out : (N,) array of `OUT`
        Published values after each gyro sample with a publication.
    ticks : list of bool
        For each gyro sample: whether the module published.
    log : list of str
        Log messages of the module.
    exits : list of int
        Return values of start, stop and status.
    other : list of str
        Remaining lines.
    names : list of str
        For each row of `out`: the name with which the module published the excitation, or "silent".
    """

    out: np.ndarray
    ticks: list[bool]
    log: list[str]
    exits: list[int]
    other: list[str]
    names: list[str]

    @property
    def announced(self) -> np.ndarray:
        """For each row of `out`: whether the module published the excitation, too, (N,)."""
        return np.array(self.names) != "silent"


def drive(program: Path, commands: Iterable[str]) -> Transcript:
    """Run the host program on these commands."""
    text = "\n".join(commands) + "\n"
    result = subprocess.run([str(program)], input=text, capture_output=True, text=True, check=False, timeout=60)
    assert result.returncode == 0, result.stdout[-500:] + result.stderr
    assert "two publishers" not in result.stdout
    rows, ticks, log, exits, other, names = [], [], [], [], [], []
    for line in result.stdout.splitlines():
        kind, _, rest = line.partition(" ")
        if kind == "out":
            words = rest.split()
            assert words[-1] in ("MIMO_EXC", "MIMO_EXY", "silent")
            names.append(words[-1])
            rows.append([int(word, 16) for word in words[1:-1]])
        if kind in ("out", "quiet"):
            ticks.append(kind == "out")
        elif kind == "log":
            log.append(rest)
        elif kind == "exit":
            exits.append(int(rest))
        else:
            other.append(line)
    out = np.array(rows, np.uint32).reshape(len(rows), sum(WORDS.values())).view(OUT)[:, 0]
    return Transcript(out, ticks, log, exits, other, names)
