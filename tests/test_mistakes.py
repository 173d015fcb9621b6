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
