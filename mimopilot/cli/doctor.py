"""`mimopilot doctor`: what this machine has of what the commands need, and how to install the rest."""

from __future__ import annotations

import errno
import os
import shutil
import socket
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

import typer

from mimopilot.cli.options import JsonOption
from mimopilot.common.extras import EXTRAS

#: Oldest Python that the package installs on.
PYTHON = (3, 11)
#: Ports that commands use by default, and what for.
PORTS = {14550: ("UDP", "ground stations"), 5760: ("TCP", "ground stations")}
#: Group that may open serial ports on Debian.
SERIAL_GROUP = "dialout"
#: Free space for compiled code, bytes: a few hundred libraries of 100 kB.
CACHE_BYTES = 100 << 20


@dataclass(frozen=True)
class Check:
    """One thing that was looked for.

    Attributes
    ----------
    name : str
    needed : bool
        False: only some commands need it.
    ok : bool
    found : str
        What is there.
    advice : str
        What to do if it is not as needed.
    """

    name: str
    needed: bool
    ok: bool
    found: str
    advice: str = ""


def register(app: typer.Typer) -> None:
    """Add this command to the command line."""
    app.command(epilog="Example: mimopilot doctor --json")(doctor)


def doctor(as_json: JsonOption = False) -> None:
    """Check packages, compilers, emulators, ports and the cache. Exit code 1: something needed is missing."""
    from mimopilot.common.console import print_json, print_table

    checks = list(every_check())
    missing = [check.name for check in checks if check.needed and not check.ok]
    if as_json:
        print_json({"ok": not missing, "missing": missing, "checks": [asdict(check) for check in checks]})
    else:
        rows = [[check.name, _verdict(check), check.found, "" if check.ok else check.advice] for check in checks]
        print_table("mimopilot doctor", ["what", "state", "found", "what to do"], rows)
        print(f"missing: {', '.join(missing)}" if missing else "everything that is needed is there")
    if missing:
        raise typer.Exit(1)


def _verdict(check: Check) -> str:
    return "ok" if check.ok else "missing" if check.needed else "optional"


def every_check() -> Iterator[Check]:
    """All checks, those that are needed first."""
    found = ".".join(map(str, sys.version_info[:3]))
    oldest = ".".join(map(str, PYTHON))
    yield Check("Python", True, sys.version_info >= PYTHON, found, f"install Python {oldest} or later")
    yield from _dependencies()
    yield _compiler()
    yield _cache()
    make = "apt-get install make"
    yield _program("make", "make", "builds and tests the emitted C++", make)
    cross = "apt-get install gcc-arm-none-eabi libnewlib-arm-none-eabi"
    yield _program("cross compiler", "arm-none-eabi-g++", "pil, --on cortex-m4", cross)
    yield _program("QEMU", "qemu-system-arm", "pil --emulator qemu", "apt-get install qemu-system-arm")
    for extra in EXTRAS:
        yield _package(extra.package, extra.use.rstrip(","), extra.advice)
    yield _serial()
    for port, (protocol, use) in PORTS.items():
        yield _port(port, protocol, use)


def _dependencies() -> Iterator[Check]:
    """The packages that mimopilot cannot run without, and their versions."""
    for line in requires("mimopilot") or ():
        if "extra ==" not in line:
            name = line.partition(">")[0].strip()
            yield _package(name, "", f"pip install '{line}'", needed=True)


def _package(name: str, use: str, advice: str, needed: bool = False) -> Check:
    try:
        return Check(name, needed, True, version(name), advice)
    except PackageNotFoundError:
        return Check(name, needed, False, "", f"for {use}: {advice}" if use else advice)


def _compiler() -> Check:
    from mimopilot.codegen.errors import CodegenError
    from mimopilot.codegen.toolchain import find_compiler, run_tool

    try:
        path = find_compiler()
        found = f"{path}: {run_tool([path, '-dumpfullversion', '-dumpversion']).strip()}"
    except CodegenError as error:
        return Check("C++ compiler", True, False, str(error).partition(";")[0], "apt-get install g++")
    return Check("C++ compiler", True, True, found)


def _program(name: str, program: str, use: str, advice: str) -> Check:
    path = shutil.which(program)
    return Check(name, False, path is not None, path or "", f"for {use}: {advice}")


def _cache() -> Check:
    """Where compiled code is kept from one run to the next."""
    from mimopilot.common.cache import cache_folder, is_temporary

    folder = cache_folder()
    if is_temporary(folder):
        return Check("cache", True, False, "none that only you can write to", "set XDG_CACHE_HOME to a folder of yours")
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    free = shutil.disk_usage(folder).free
    found = f"{folder}: {size / 1e6:.0f} MB, {free / 1e9:.1f} GB free"
    return Check("cache", True, free > CACHE_BYTES, found, f"free {CACHE_BYTES >> 20} MB, or set XDG_CACHE_HOME")


def _serial() -> Check:
    """Whether this user may open the serial ports that are there."""
    ports = sorted(path for pattern in ("ttyACM*", "ttyUSB*") for path in Path("/dev").glob(pattern))
    if ports:
        closed = [str(path) for path in ports if not os.access(path, os.R_OK | os.W_OK)]
        found = ", ".join(closed or map(str, ports))
        return Check("serial ports", False, not closed, found, f"sudo adduser $USER {SERIAL_GROUP}, then log in again")
    allowed = _in_serial_group()
    found = "no vehicle is plugged in" + ("" if allowed else f"; you are not in the group {SERIAL_GROUP}")
    return Check("serial ports", False, allowed, found, f"sudo adduser $USER {SERIAL_GROUP}, then log in again")


def _in_serial_group() -> bool:
    try:
        import grp

        return os.geteuid() == 0 or grp.getgrnam(SERIAL_GROUP).gr_gid in os.getgroups()
    except (ImportError, KeyError):  # not a Unix, or one without this group: it has other rules
        return True


def _port(port: int, protocol: str, use: str) -> Check:
    kind = socket.SOCK_DGRAM if protocol == "UDP" else socket.SOCK_STREAM
    with socket.socket(socket.AF_INET, kind) as one:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, int(protocol == "TCP"))
        try:
            one.bind(("127.0.0.1", port))
        except OSError as error:
            taken = "in use" if error.errno == errno.EADDRINUSE else error.strerror or str(error)
            advice = "end the program that uses it, or give another port"
            return Check(f"port {port}", False, False, f"{protocol}, {use}: {taken}", advice)
    return Check(f"port {port}", False, True, f"{protocol}, {use}: free")
