"""The unfinished file: what survives an interruption, and what is refused."""

import json
import os

import pytest

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.log_transfer import part_file
from mimopilot.sitl.mavlink.log_transfer.part_file import PartFile
from tests.sitl.mavlink.log_transfer.logging_vehicle import content

DATA = content(10_000)


def begin(folder, size=10_000, source="system 1, /log/a.ulg", **options):
    return PartFile(folder, "a.ulg", source, size, **options)


def test_pieces_in_any_order_give_the_file(tmp_path):
    part = begin(tmp_path)
    for start in (9_000, 0, 2_000, 1_000, 2_500, 500):
        part.write(start, DATA[start : start + 4_000])
    part.write(6_000, DATA[6_000:9_500])
    assert not part.missing
    part.close()
    assert part.finish()
    assert (tmp_path / "a.ulg").read_bytes() == DATA
    assert [path.name for path in tmp_path.iterdir()] == ["a.ulg"]


def test_a_killed_download_repeats_only_what_was_not_recorded(tmp_path, monkeypatch):
    monkeypatch.setattr(part_file, "RECORD_EVERY", 3_000)
    part = begin(tmp_path)
    for start in range(0, 5_000, 500):
        part.write(start, DATA[start : start + 500])
    os.close(part._file)  # killed: nothing more is written
    again = begin(tmp_path)
    assert again.resumed == 3_000
    assert again.missing.ranges() == [(3_000, 10_000)]


def test_bytes_that_the_file_lacks_count_as_missing_whatever_the_record_says(tmp_path):
    part = begin(tmp_path)
    part.write(0, DATA)
    part.close()
    os.truncate(tmp_path / "a.ulg.part", 7_000)
    assert begin(tmp_path).missing.ranges() == [(7_000, 10_000)]


def test_a_part_of_another_log_or_without_its_record_is_refused(tmp_path):
    part = begin(tmp_path)
    part.write(0, DATA[:100])
    part.close()
    for changes in ({"source": "system 2, /log/a.ulg"}, {"size": 9_999}, {"size": 10_001}):
        with pytest.raises(SitlError, match=r"a\.ulg\.part: is a part of another log \(system 1, /log/a\.ulg, 10000"):
            begin(tmp_path, **changes)
    assert begin(tmp_path, size=10_001, grows=True).missing.ranges() == [(100, 10_001)]
    for text in ("", "[]", '{"source": 1}', json.dumps({"source": "s", "size": 9, "missing": [[0, 10]]})):
        (tmp_path / "a.ulg.part.json").write_text(text)
        with pytest.raises(SitlError, match=r"nothing says which bytes it holds .* remove it and a\.ulg\.part\.json"):
            begin(tmp_path)


def test_links_are_not_written_through(tmp_path):
    (tmp_path / "victim").write_bytes(b"mine")
    for name in ("a.ulg", "a.ulg.part"):
        (tmp_path / name).symlink_to(tmp_path / "victim")
        with pytest.raises(OSError, match="is a link"):
            begin(tmp_path)
        (tmp_path / name).unlink()
    assert (tmp_path / "victim").read_bytes() == b"mine"
