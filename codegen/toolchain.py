"""Compilers of the host and of the Cortex-M4: finding them, their flags, running them."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

from mimopilot.codegen.errors import CodegenError

#: Flags of every build, also in the emitted Makefiles. No contraction: the result must equal the reference bit for bit.
#: For size, as PX4 builds: the Cortex-M4 then multiplies and adds in one instruction, which rounds twice.
CXX_FLAGS = ("-std=c++17", "-Os", "-ffp-contract=off", "-fno-math-errno", "-fno-exceptions", "-fno-rtti")
WARNINGS = (
    "-Wall",
    "-Wextra",
    "-Wpedantic",
    "-Wconversion",
    "-Wsign-conversion",
    "-Wdouble-promotion",
    "-Wfloat-conversion",
    "-Wshadow",
    "-Werror",
)
#: The Pixhawk Mini's processor: single-precision FPU, arguments in FPU registers. Scheduling would split conditional
#: blocks: more code for the same time.
CORTEX_M4_FLAGS = ("-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard", "-fno-schedule-insns2")
CROSS = "arm-none-eabi-"


def find_compiler() -> str:
    """Path of the host's C++ compiler: $CXX, else g++, else clang++.

    Raises
    ------
    CodegenError
        If there is none; names the package that installs it.
    """
    wanted = os.environ.get("CXX")
    for name in (wanted,) if wanted else ("g++", "clang++"):
        path = shutil.which(name)
        if path:
            return path
    missing = f"CXX={wanted} is not on the PATH" if wanted else "neither g++ nor clang++ is on the PATH"
    raise CodegenError(f"no C++ compiler: {missing}; install one, on Debian: apt-get install g++")


def find_tool(name: str, packages: str) -> str:
    """Path of a program that Debian's `packages` install.

    Raises
    ------
    CodegenError
        If it is not on the PATH; names the packages.
    """
    path = shutil.which(name)
    if path is None:
        raise CodegenError(f"{name} is not on the PATH; install it, on Debian: apt-get install {packages}")
    return path


def cross_tool(name: str) -> str:
    """Path of a program of the Cortex-M4's toolchain: ``g++``, ``nm``, ..."""
    return find_tool(CROSS + name, "gcc-arm-none-eabi libnewlib-arm-none-eabi")


def run_tool(command: Sequence[str | Path], folder: Path | None = None) -> str:
    """Run a compiler or one of its tools; returns its standard output.

    Raises
    ------
    CodegenError
        If it fails; shows its first error lines and the command to repeat.
    """
    words = [str(word) for word in command]
    result = subprocess.run(words, capture_output=True, text=True, check=False, cwd=folder)
    if result.returncode != 0:
        first = "\n".join(result.stderr.splitlines()[:5]) or f"exit status {result.returncode}, no message"
        raise CodegenError(f"{Path(words[0]).name} failed:\n{first}\nto repeat: {' '.join(words)}", exit_code=1)
    return result.stdout


def compile_shared(compiler: str, sources: Sequence[Path], output: Path) -> None:
    """Compile `sources` into the shared library `output`; on failure no file is left.

    Raises
    ------
    CodegenError
        If the compiler fails.
    """
    temporary = output.with_name(f".{output.name}.{os.getpid()}")
    try:
        run_tool([compiler, *CXX_FLAGS, *WARNINGS, "-shared", "-fPIC", "-o", temporary, *sources])
        temporary.replace(output)
    finally:
        temporary.unlink(missing_ok=True)
