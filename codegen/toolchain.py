"""The host's C++ compiler."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

from codegen.errors import CodegenError

#: Flags of every host build; the Makefile that is emitted uses the same.
CXX_FLAGS = ("-std=c++17", "-O2", "-ffp-contract=off", "-fno-exceptions", "-fno-rtti")
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


def find_compiler() -> str:
    """Path of the host's C++ compiler: $CXX, else g++, else clang++.

    Raises
    ------
    CodegenError
        When there is none, naming the package that installs it.
    """
    wanted = os.environ.get("CXX")
    for name in (wanted,) if wanted else ("g++", "clang++"):
        path = shutil.which(name)
        if path:
            return path
    missing = f"CXX={wanted} is not on the PATH" if wanted else "neither g++ nor clang++ is on the PATH"
    raise CodegenError(f"no C++ compiler: {missing}; install one, on Debian: apt-get install g++")


def compile_shared(compiler: str, sources: Sequence[Path], output: Path) -> None:
    """Build `sources` into the shared library `output`; nothing is left behind on failure.

    Raises
    ------
    CodegenError
        When the compiler fails: its first lines and the command to repeat.
    """
    temporary = output.with_name(f".{output.name}.{os.getpid()}")
    command = [compiler, *CXX_FLAGS, *WARNINGS, "-shared", "-fPIC", "-o", str(temporary), *map(str, sources)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode != 0:
        temporary.unlink(missing_ok=True)
        first = "\n".join(result.stderr.splitlines()[:5]) or f"exit status {result.returncode}, no message"
        raise CodegenError(f"the C++ compiler failed:\n{first}\nto repeat: {' '.join(command)}", exit_code=1)
    temporary.replace(output)
