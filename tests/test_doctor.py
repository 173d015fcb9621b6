"""What `mimopilot doctor` finds, and what it advises."""

import json
import re
import socket

import pytest

from mimopilot.cli import doctor
from mimopilot.common import cache
from tests.conftest import run_here


def checks():
    return {check.name: check for check in doctor.every_check()}


def test_this_machine_has_what_is_needed_with_versions(tmp_path):
    done = run_here(tmp_path, "doctor", "--json")
    found = json.loads(done.stdout)
    assert (done.returncode, found["ok"], found["missing"]) == (0, True, [])
    by_name = {check["name"]: check for check in found["checks"]}
    for name in ("Python", "numpy", "scipy", "numba"):
        assert re.match(r"\d+\.\d+", by_name[name]["found"])
    assert re.search(r"\+\+: \d+", by_name["C++ compiler"]["found"])
    assert "everything that is needed is there" in run_here(tmp_path, "doctor").stdout


def test_what_is_missing_is_named_with_the_debian_package(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CXX", raising=False)
    done = run_here(tmp_path, "doctor")
    assert done.returncode == 1
    assert "missing: C++ compiler" in done.stdout
    for package in ("g++", "make", "gcc-arm-none-eabi libnewlib-arm-none-eabi", "qemu-system-arm"):
        assert f"apt-get install {package}" in done.stdout


def test_a_missing_package_is_named(monkeypatch):
    def unknown(name):
        raise doctor.PackageNotFoundError(name)

    monkeypatch.setattr(doctor, "version", unknown)
    found = checks()
    assert (found["numpy"].needed, found["numpy"].ok) == (True, False)
    assert found["numpy"].advice.startswith("pip install 'numpy>=")
    assert found["unicorn"].advice.endswith("pip install 'mimopilot[emulator]'")
    assert not found["unicorn"].needed


def test_a_cache_that_others_could_write_to_is_not_used(monkeypatch):
    monkeypatch.setattr(cache, "_private_folder", lambda folder: None)
    assert (checks()["cache"].ok, checks()["cache"].found) == (False, "none that only you can write to")


def test_a_full_disk_is_noticed(monkeypatch):
    monkeypatch.setattr(doctor, "CACHE_BYTES", 1 << 62)
    assert not checks()["cache"].ok


@pytest.mark.parametrize(("protocol", "kind"), [("UDP", socket.SOCK_DGRAM), ("TCP", socket.SOCK_STREAM)])
def test_a_port_in_use_is_named(protocol, kind, monkeypatch):
    with socket.socket(socket.AF_INET, kind) as taken:
        taken.bind(("127.0.0.1", 0))
        if kind == socket.SOCK_STREAM:
            taken.listen()
        port = taken.getsockname()[1]
        monkeypatch.setattr(doctor, "PORTS", {port: (protocol, "testing")})
        found = checks()[f"port {port}"]
        assert (found.ok, found.needed, found.found) == (False, False, f"{protocol}, testing: in use")
    assert checks()[f"port {port}"].ok


def test_serial_ports_need_the_group(monkeypatch):
    monkeypatch.setattr(doctor, "_in_serial_group", lambda: False)
    monkeypatch.setattr(doctor.Path, "glob", lambda *_: iter(()))
    found = checks()["serial ports"]
    assert not found.ok
    assert "not in the group dialout" in found.found
    assert found.advice.startswith("sudo adduser $USER dialout")
