"""A wrong file, name or port: one clear line that names the true cause."""

import os
import socket

import pytest

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.flight.ulog_writer import HEADER, _message
from mimopilot.sitl.mavlink.wire.sockets import listen, udp_socket
from mimopilot.sitl.physics.airframe import FOLDER
from tests.conftest import assert_one_clear_line, coupled_gains, run_here


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mistakes")
    coupled_gains().save(folder / "my.gains.toml")
    text = (folder / "my.gains.toml").read_text()
    (folder / "future.gains.toml").write_text(text.replace("schema = 2", "schema = 3"))
    (folder / "airframe.toml").write_text((FOLDER / "adam0.toml").read_text())
    (folder / "typo.toml").write_text('metod = "siso"')
    (folder / "case.toml").write_text("[design]\nMS = 1.5")
    (folder / "strange.toml").write_text("[design]\nxyzzy = 1")
    (folder / "cut.ulg").write_bytes(HEADER + bytes(8) + _message("B", bytes(40)) + b"\x40\x00F half a message")
    (folder / "empty").touch()
    (folder / "folder").mkdir()
    (folder / "link.ulg").symlink_to("nowhere.ulg")
    (folder / "link.gains.toml").symlink_to("nowhere.toml")
    return folder


MISTAKES = {
    "gains as airframe": (("fly", "my.gains.toml"), ("is a gains file, expected an airframe", "--gains my.gains.toml")),
    "ULog as gains": (("generate", "cut.ulg", "--out", "x"), ("it is a flight log (ULog), expected text",)),
    "airframe as gains": (("generate", "airframe.toml", "--out", "x"), ("not a mimopilot gains file",)),
    "gains as log": (("inspect", "my.gains.toml"), ("a TOML file", "expected PX4 ULog")),
    "gains as specification": (
        ("tune", "cut.ulg", "--spec", "my.gains.toml", "--out", "o.gains.toml"),
        ("is a gains file, expected a specification",),
    ),
    "typo": (("tune", "cut.ulg", "--spec", "typo.toml", "--out", "o"), ("metod: unknown entry; did you mean method?",)),
    "typo in a table": (
        ("tune", "cut.ulg", "--spec", "case.toml", "--out", "o"),
        ("design.MS: unknown entry; did you mean Ms?",),
    ),
    "unlike any entry": (
        ("tune", "cut.ulg", "--spec", "strange.toml", "--out", "o"),
        ("design.xyzzy: unknown entry; known: ", "Ms"),
    ),
    "link to nothing, log": (("inspect", "link.ulg"), ("it is a link to nowhere.ulg, which does not exist",)),
    "link to nothing, gains": (
        ("generate", "link.gains.toml", "--out", "x"),
        ("it is a link to nowhere.toml, which does not exist",),
    ),
    "folder": (("inspect", "."), ("it is a folder",)),
    "later schema": (
        ("generate", "future.gains.toml", "--out", "x"),
        ("schema: got 3", "knows up to 2", "from a later one; update mimopilot"),
    ),
    "half a log": (
        ("tune", "cut.ulg", "--out", "o.gains.toml"),
        ("cut.ulg: the file ends inside a message", "fetch it again. In what is left: lacks"),
    ),
}


#: What is typed -> words of the one line; by the parser, or before a command begins its work.
LINES = {
    "tun x": ("no such command 'tun'", "see mimopilot --help"),
    "--foo": ("no such option: --foo", "see mimopilot --help"),
    "tune": ("tune: missing argument", "see mimopilot tune --help"),
    "upload my.gains.toml": ("upload: missing option '--connect'",),
    "experiment adam0 --see 1": ("experiment: no such option: --see", "--seed"),
    "experiment adam0 --seed -1 --out x": ("experiment: invalid value for '--seed': ", "mimopilot experiment --help"),
    "experiment adam0 --out x --amplitude 0,1": ("invalid value for '--amplitude': ",),
    "reproduce lv99": ("reproduce: invalid value for ", "lv100"),
    "fly adam0 adam0": ("fly: ", "unexpected extra argument"),
    "fly adam0 --on foo": ("on: got 'foo', expected one of native, cortex-m4",),
    "tune cut.ulg --out x --profile bf": (
        "--profile: got 'bf', expected mimo, ",
        "or betaflight",
    ),
    "tune cut.ulg --out x --window -3": ("--window: got -3, expected greater than or equal to 1",),
    "tune cut.ulg --out x --inner 20;0.4": ("--inner: got '20;0.4', expected OMEGA,ZETA,DELAY",),
    "tune cut.ulg --out x --structure XYZ": ("--structure: got 'XYZ', expected P, PI, ",),
    "tune cut.ulg --out cut.ulg": ("--out: cut.ulg is read by this command; give another path",),
    "report cut.ulg --out ./cut.ulg": ("--out: cut.ulg is read by this command",),
    "params my.gains.toml --out my.gains.toml": ("--out: my.gains.toml is read by this command",),
    "tune cut.ulg --out x --report x": ("--out: x is given for two results",),
    "tune cut.ulg --out -": ("--out: nothing is written to standard output",),
    "tune cut.ulg --out folder": ("--out: folder is a folder; give the file to write", "--campaign"),
    "tune cut.ulg --out x --report folder": ("tune: invalid value for '--report': ", "'folder' is a directory"),
    "experiment adam0 --out folder": ("--out: folder is a folder; give the log to write", "--runs"),
    "advise cut.ulg --out cut.ulg/x": ("--out: cut.ulg/x: cut.ulg is not a folder",),
    "generate my.gains.toml --uncertified --out x --px4-api v9": (
        "px4-api: got 'v9', expected one of crtp, descriptor",
    ),
    "fly adam0 --scenario my.gains.toml": ("is a gains file, expected a scenario file",),
    "campaign adam0 --runs 1 --out x --vary my.gains.toml": ("is a gains file, expected a specification of ",),
    "restore my.gains.toml --connect udpin:127.0.0.1:1": ("a TOML file", "expected a parameter file"),
    "inspect /dev/null": ("/dev/null: it is a device or a pipe; give the path of a flight log",),
    "inspect empty": ("empty: not a flight log: it is empty",),
    "sitl adam0 --bind 192.0.2.1": ("this machine has no such address",),
    "plant adam0 --serial /dev/null,57600": ("cannot be opened: it is no serial port",),
    "plant adam0 --serial /dev/nowhere,57600": ("cannot be opened: there is no such device; is the cable plugged in?",),
    "autotune --connect tcp:127.0.0.1:1 --out x --yes --take-off -1": ("--take-off: got -1, expected 1 to 120 m",),
    "autotune --connect tcp:127.0.0.1:1 --out x --yes --amplitude -1": ("MIMO_EX_AMP: got -1, expected 0 to 0.5",),
}


@pytest.mark.parametrize("line", LINES)
def test_a_mistake_on_the_line_is_told_in_one_line_before_the_work(line, folder):
    before = {path: path.stat().st_mtime_ns for path in folder.iterdir() if path.exists()}
    done = run_here(folder, *line.split())
    assert_one_clear_line(done, *LINES[line], code=1 if "cannot be opened" in LINES[line][0] else 2)
    assert done.stderr.startswith("mimopilot: ")
    assert {path: path.stat().st_mtime_ns for path in folder.iterdir() if path.exists()} == before


def test_without_a_command_the_help_is_printed(folder):
    done = run_here(folder)
    assert (done.returncode, done.stderr) == (0, "")
    assert "  tune  " in done.stdout


def test_a_certificate_may_replace_the_gains_that_it_is_about(folder):
    done = run_here(folder, "convert", "my.gains.toml", "adam0", "--out", "my.gains.toml")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", MISTAKES)
def test_the_message_names_the_cause(name, folder):
    arguments, words = MISTAKES[name]
    assert_one_clear_line(run_here(folder, *arguments), *words)
    assert not [path for path in ("x", "o", "o.gains.toml") if (folder / path).exists()]


@pytest.mark.parametrize("open_port", [listen, udp_socket])
def test_a_port_that_only_root_may_use_is_named_as_such(open_port, monkeypatch):
    def refuse(*_):
        raise PermissionError(13, os.strerror(13))

    monkeypatch.setattr(socket.socket, "bind", refuse)
    with pytest.raises(SitlError, match=r"port 80 on 127\.0\.0\.1 .*ports below 1024 are reserved .*choose one above"):
        open_port("127.0.0.1", 80)
