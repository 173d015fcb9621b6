import re
from importlib import import_module
from typing import get_args

import pytest

from mimopilot.cli.options import LogArgument
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.logs.formats import FORMATS, known_formats
from mimopilot.tuning.logs.reader import open_log
from tests.paths import DOCS


@pytest.mark.parametrize("row", FORMATS, ids=lambda row: row.name)
def test_every_format_has_a_reader_and_is_named_in_the_manual_and_in_the_help(row):
    module, _, function = row.reader.partition(":")
    assert callable(getattr(import_module(module), function))
    (table,) = re.findall(r"^\| log \|.*\n(?:\|.*\n)+", (DOCS / "logs.md").read_text(), re.MULTILINE)
    argument = next(part for part in get_args(LogArgument) if hasattr(part, "help"))
    assert row.name in table
    assert row.name in argument.help


def test_an_unknown_format_is_refused_with_the_known_ones(tmp_path):
    path = tmp_path / "x.bin"
    path.write_bytes(b"\x00\x01\x02\x03")
    with pytest.raises(TuningError, match="not a flight log") as error:
        open_log(path)
    assert known_formats() in str(error.value)


def test_a_file_matches_one_format_at_most():
    heads = (
        b"ULog\x01\x12\x35\x01",
        b"\xa3\x95\x80",
        b"MATLAB 5.0 MAT-file, Platform\x00",
        b"loopIteration, time (us), axisP[0]\n0, 1, 2\n",
        b"t,p,q\n0,1,2\n",
    )
    for head, row in zip(heads, FORMATS, strict=True):
        first = next(one for one in FORMATS if one.matches(head))
        assert first == row
        # Of decoded blackbox logs, which are CSV files, too, the names of the columns are known.
        others = [one.name for one in FORMATS if one.matches(head) and one != row]
        assert others == (["CSV"] if row.name == "Betaflight blackbox" else [])
