"""Commands that write into a folder: nothing leaves it; what cannot be written is reported first."""

import pytest

from tests.conftest import assert_one_clear_line

LINKS = {
    "demo": "firmware/siso",
    "campaign adam0 --runs 2": "gains",
    "reproduce lv100": "lv100.html",
    "experiment adam0 --runs 2 --seconds-per-axis 3": "flight-0000.ulg",
    "tune log.csv --campaign": "summary.json",
}


@pytest.mark.parametrize(("command", "name"), LINKS.items())
def test_no_command_follows_a_link_out_of_its_folder(mimopilot, tmp_path, command, name):
    (tmp_path / "log.csv").write_text("t,p\n0,0\n")
    outside = tmp_path / "outside"
    outside.mkdir()
    link = tmp_path / "out" / name
    link.parent.mkdir(parents=True)
    link.symlink_to(outside / "file" if "." in name else outside)
    found = mimopilot(*command.split(), "--out", "out")
    assert_one_clear_line(found, f"out/{name}: is a link, and nothing is written through it")
    assert list(outside.iterdir()) == []
    assert link.is_symlink()
    assert not [path for path in (tmp_path / "out").rglob("*") if path.is_file()]


@pytest.mark.parametrize(
    ("out", "words"), [("dangling", "is a link that leads to no folder"), ("/dev/null", "is a file")]
)
def test_an_output_that_is_no_folder_is_reported(mimopilot, tmp_path, out, words):
    (tmp_path / "dangling").symlink_to("nothing")
    assert_one_clear_line(mimopilot("reproduce", "lv100", "--out", out), f"{out}: {words}; give --out a folder")
    assert not (tmp_path / "nothing").exists()
