"""What the terminal shows: tables at any width, numbers, verbosity, and pipes whose reader leaves."""

import os
import re
import subprocess
import sys

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mimopilot
from mimopilot.common.console import print_json, print_table, print_text
from mimopilot.common.text_table import folded, plain_zero, text_table, with_deviation
from mimopilot.common.verbosity import Verbosity, verbosity
from mimopilot.tuning.design.advise import Advice, Candidate
from mimopilot.tuning.design.prediction import Prediction
from mimopilot.tuning.gains_file import load_gains
from tests.conftest import run_here
from tests.readable import Printed

WORDS = st.lists(st.text("abcdefgh0123456789.-", min_size=1, max_size=40), max_size=6).map(" ".join)
TABLES = st.integers(1, 9).flatmap(
    lambda n: st.tuples(
        st.lists(WORDS, min_size=n, max_size=n), st.lists(st.lists(WORDS, min_size=n, max_size=n), max_size=5)
    )
)


def letters(text):
    return sorted(plain_zero(text).replace(" ", ""))


@settings(max_examples=40)
@given(TABLES, st.sampled_from([30, 60, 80, 120]))
def test_a_table_fits_and_no_character_is_lost(table, width):
    columns, rows = table
    lines = text_table(columns, rows, width)
    assert max(map(len, lines), default=0) <= width
    shown = letters("".join(lines).replace("─", "").replace(":", ""))
    for row in rows:
        for letter in set(letters(" ".join(row))):
            assert shown.count(letter) >= sum(letters(cell).count(letter) for cell in row)


@settings(max_examples=40)
@given(TABLES)
def test_piped_each_row_is_one_line(table):
    columns, rows = table
    lines = text_table(columns, rows, None)
    assert len(lines) == 2 + len(rows)
    for row, line in zip(rows, lines[2:], strict=True):
        assert letters(line) == letters(" ".join(row))


def test_numbers_are_never_broken_where_they_fit():
    rows = [["Kp_o", *["4.9980 (0.0077)"] * 4], ["Kp_i", *["0.14510 (0.00011)"] * 4]]
    columns = ["", "roll<-roll", "roll<-pitch", "pitch<-roll", "pitch<-pitch"]
    text = "\n".join(text_table(columns, rows, 60))
    assert text.count("4.9980") == text.count("(0.0077)") == 4
    assert "roll<-pitch" in text
    assert text_table(columns, rows, 30)[0] == " Kp_o"
    assert "    roll<-roll: 4.9980 (0.0077)" in text_table(columns, rows, 40)


@pytest.mark.parametrize(
    ("value", "deviation", "text"),
    [
        (4.99801, 0.0077, "4.9980 (0.0077)"),
        (0.1451, 0.00013, "0.14510 (0.00013)"),
        (-12.3456, 0.31, "-12.35 (0.31)"),
        (123.4, 15.0, "123 (15)"),
        (-0.00001, None, "0.0000"),
        (-0.00004, 0.001, "0.0000 (0.0010)"),
        (0.5, 0.0, "0.5000"),
    ],
)
def test_a_number_has_the_digits_that_its_deviation_justifies(value, deviation, text):
    assert with_deviation(value, deviation) == text


def test_a_zero_has_no_sign(capsys):
    print_table("zeros", ["", "a"], [["-0.00", "-0.0000 (0.0001), -0.5, 1e-0, -0.01"]])
    assert "0.00   0.0000 (0.0001), -0.5, 1e-0, -0.01" in capsys.readouterr().out
    print_text("from -0.0000 to -0.0001, -0 dB")
    print_json({"a": [-0.0, {"b": -0.0}], "c": -1.5})
    assert capsys.readouterr().out.split() == [
        *("from", "0.0000", "to", "-0.0001,", "0", "dB"),
        *("{", '"a":', "[", "0.0,", "{", '"b":', "0.0", "}", "],", '"c":', "-1.5", "}"),
    ]


def test_prose_folds_at_spaces_and_keeps_its_indent_and_its_paths():
    path = "/a/path/that/is/longer/than/the/terminal/is/wide.toml"
    text = f"  {path}  (MIMO)\nshort\n\n{'word ' * 20}"
    lines = folded(text, 30)
    assert lines[0] == f"  {path}"
    assert lines[1:4] == ["  (MIMO)", "short", ""]
    assert all(len(line) <= 30 for line in lines[1:])
    assert folded(text, None) == [*text.splitlines()[:3], ("word " * 20).rstrip()]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a flight and gains from it, and what the commands that made them printed."""
    folder, outputs = tmp_path_factory.mktemp("terminal"), {}
    for name, *options in (
        ("experiment", "adam0", "--seconds-per-axis", 8, "--out", "flight.ulg"),
        ("tune", "flight.ulg", "--out", "my.gains.toml", "--verbose"),
    ):
        with pytest.MonkeyPatch.context() as patch:
            printed = Printed(patch)
            outputs[name] = (run_here(folder, name, *options), printed)
    done = outputs["tune"][0]
    assert re.search(r"^mimopilot: reading flight\.ulg: \d+\.\d\d s\n", done.stderr)
    assert "\nmimopilot: designing the gains: " in done.stderr
    return folder, outputs


@pytest.fixture(scope="module")
def folder(made):
    return made[0]


@pytest.mark.parametrize("name", ["experiment", "tune"])
def test_what_made_the_flight_and_the_gains_is_readable_at_any_width(made, name):
    done, printed = made[1][name]
    printed.check(done.stdout, tables=name == "tune")


COMMANDS = {
    "inspect": ("inspect", "flight.ulg"),
    "identify": ("identify", "flight.ulg"),
    "certify": ("certify", "flight.ulg", "--gains", "my.gains.toml"),
    "fly": ("fly", "adam0", "--gains", "my.gains.toml"),
    "faults": ("faults", "adam0", "--runs", "1", "--fault", "motor:1=0.7@0.6", "--workers", "1"),
    "reproduce": ("reproduce", "numerical-example", "--out", "study"),
    "campaign": ("campaign", "adam0", "--runs", "2", "--workers", "1", "--out", "campaign"),
    "replay": ("replay", "campaign", "--run", "1"),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_what_a_command_prints_is_readable_at_any_width(folder, name, monkeypatch):
    printed = Printed(monkeypatch)
    done = run_here(folder, *COMMANDS[name])
    assert done.returncode in (0, 1), done.stderr
    printed.check(done.stdout)


def test_advice_is_readable_at_any_width(folder, monkeypatch):
    """The tuned set stands for its alternatives: their design takes long."""
    gains = load_gains(folder / "my.gains.toml")
    figures = Prediction(**gains.provenance.details["predicted"]["tuned"][0])
    sets = [Candidate(name, gains, 12.6, figures) for name in ("recommended", "flown", "D filter at 20 Hz")]
    found = Advice(tuple(sets), {"faster": "limited by the noise of the torque and by the range of the motors"}, 41.0)
    monkeypatch.setattr(mimopilot, "advise", lambda *_, **__: found, raising=False)
    printed = Printed(monkeypatch)
    done = run_here(folder, "advise", "flight.ulg")
    assert done.returncode == 0, done.stderr
    printed.check(done.stdout)


def test_quiet_shows_only_results_and_errors(folder):
    usual = run_here(folder, "tune", "flight.ulg", "--out", "q.gains.toml", "--inner", "30,0.7,0")
    quiet = run_here(folder, "tune", "flight.ulg", "--out", "q.gains.toml", "--inner", "30,0.7,0", "--quiet")
    assert quiet.stderr == ""
    assert quiet.stdout == usual.stdout
    assert "--quiet and --verbose exclude each other" in run_here(folder, "--quiet", "--verbose", "fly", "adam0").stderr
    assert run_here(folder, "inspect", "missing.ulg", "--quiet").stderr.startswith("mimopilot: ")
    assert verbosity() is Verbosity.NORMAL  # a quiet command leaves none behind it


@pytest.mark.parametrize("arguments", [("--help",), ("faults", "--kinds"), ("fly", "--help")])
def test_a_reader_that_leaves_is_no_failure(arguments):
    command = [sys.executable, "-m", "mimopilot", *arguments]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env={**os.environ, "PYTHONUNBUFFERED": "1"}
    )
    process.stdout.close()
    errors = process.stderr.read().decode()
    assert (process.wait(), errors) == (0, "")
