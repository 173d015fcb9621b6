"""Files: reading is bounded, writing is atomic and stays inside the output folder."""

import os
import socket

import pytest

from mimopilot.common.errors import InputFileError
from mimopilot.common.files import MAX_TEXT_BYTES, inside, read_bytes, read_text, seal, sha256, unseal, write_atomically


def test_only_a_regular_file_of_bounded_size_is_read(tmp_path, monkeypatch):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "dangling").symlink_to("nothing")
    (tmp_path / "device").symlink_to("/dev/zero")
    monkeypatch.chdir(tmp_path)  # the path of a socket has at most 107 bytes
    with socket.socket(socket.AF_UNIX) as server:
        server.bind("socket")
    with (tmp_path / "sparse").open("wb") as stream:
        stream.truncate(10 << 30)
    expected = {
        "pipe": "it is a pipe",
        "folder": "Is a directory",
        "loop": "symbolic links",
        "dangling": "does not exist",
        "device": "it is a device",
        "socket": "No such device",
        "sparse": "10737418240 bytes, expected at most 1048576",
    }
    for name, words in expected.items():
        with pytest.raises(InputFileError, match=rf"{name}: cannot read the gains file: .*{words}"):
            read_bytes(tmp_path / name, "gains file")
    (tmp_path / "full").write_bytes(b"x" * MAX_TEXT_BYTES)
    (tmp_path / "link").symlink_to("full")
    assert len(read_text(tmp_path / "link", "gains file")) == MAX_TEXT_BYTES
    (tmp_path / "marked").write_bytes("\ufeffa = 1".encode())
    assert read_text(tmp_path / "marked", "gains file") == "a = 1"
    (tmp_path / "full").write_bytes(b"x" * (MAX_TEXT_BYTES + 1))
    with pytest.raises(InputFileError, match=f"{MAX_TEXT_BYTES + 1} bytes"):
        read_bytes(tmp_path / "full", "gains file")


def test_links_pipes_and_devices_are_neither_replaced_nor_written_through(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "own").write_text("old")
    for name, target in (("null", "/dev/null"), ("link", "own"), ("loop", "loop"), ("dangling", "nothing")):
        (tmp_path / name).symlink_to(target)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(OSError, match="is a device or a pipe"):
        write_atomically(tmp_path / "pipe", "new")
    for name in ("null", "link", "loop", "dangling"):
        with pytest.raises(OSError, match="is a link"):
            write_atomically(tmp_path / name, "new")
        assert (tmp_path / name).is_symlink()
    assert sorted(tmp_path.iterdir()) == before
    assert (tmp_path / "own").read_text() == "old"


def test_a_link_inside_an_output_folder_is_refused_but_the_folder_may_be_a_link(tmp_path):
    out = tmp_path / "out"
    (tmp_path / "real" / "sub").mkdir(parents=True)
    out.symlink_to("real")
    assert inside(out, "sub/deep/file") == out / "sub/deep/file"
    (out / "away").symlink_to(tmp_path)
    (out / "sub/file").symlink_to("gone")
    (out / "loop").symlink_to("loop")
    for name, link in (("away/x/y", "away"), ("sub/file", "sub/file"), ("loop/x", "loop"), ("loop", "loop")):
        with pytest.raises(OSError, match="is a link") as caught:
            inside(out, name)
        assert caught.value.filename == str(out / link)
    (tmp_path / "gone").symlink_to("nothing")
    with pytest.raises(OSError, match="leads to no folder"):
        inside(tmp_path / "gone", "x")
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="is a file"):
        inside(tmp_path / "file", "x")


def test_a_changed_or_missing_byte_breaks_the_seal():
    sealed = seal(b"con\ntent\n", "label")
    assert unseal(sealed) == (b"con\ntent\n", "label")
    assert unseal(seal(b"", "")) == (b"", "")
    assert unseal(sha256(b"").encode()) is None
    for place in range(len(sealed)):
        assert unseal(sealed[:place]) is None
        assert unseal(sealed[:place] + bytes([sealed[place] ^ 1]) + sealed[place + 1 :]) is None
    assert unseal(sealed + b"\0") is None
    assert unseal(bytes(4096)) is None
