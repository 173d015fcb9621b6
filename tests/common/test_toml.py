"""TOML files of users: an error is one line, and written values read back unchanged."""

import dataclasses
import datetime
import math
import tomllib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mimopilot.common.errors import InputFileError
from mimopilot.common.toml import MAX_DEPTH, MAX_SHOWN, MAX_TOKEN, parse_toml, read_toml, shown, toml_entries
from mimopilot.tuning.gains import gains_to_toml
from mimopilot.tuning.gains_file import gains_from_toml
from mimopilot.tuning.provenance import Provenance
from tests.conftest import assert_one_clear_line

REFUSED_TEXTS = {
    "decimal digits": ("a = " + "9" * 5000, "a number or key of 5000 characters"),
    "hexadecimal digits": ("a = 0x" + "f" * 5000, "a number or key of 5002 characters"),
    "a long key": ("k" * 5000 + " = 1", "a number or key of 5000 characters"),
    "dotted": (".".join("a" * 5000) + " = 1", f"nested deeper than {MAX_DEPTH}"),
    "dotted with spaces": (" \t. ".join("a" * 5000) + " = 1", f"nested deeper than {MAX_DEPTH}"),
    "dotted and quoted": (".".join(['"x.y"', "'z'"] * 2500) + " = 1", f"nested deeper than {MAX_DEPTH}"),
    "a dotted header": ("[" + ".".join("a" * 5000) + "]", f"nested deeper than {MAX_DEPTH}"),
    "nested lists": ("a = " + "[" * 5000 + "]" * 5000, f"nested deeper than {MAX_DEPTH}"),
    "nested tables": ("a = " + "{b = " * 5000 + "1" + "}" * 5000, f"nested deeper than {MAX_DEPTH}"),
    "many dots and brackets": ("a = " + "{b.c.d = " * 10 + "1" + "}" * 10, f"nested deeper than {MAX_DEPTH}"),
    "behind four quotes": ('a = {b = """x"""", ' + ".".join("c" * 5000) + ' = "d"}', f"nested deeper than {MAX_DEPTH}"),
    "an escaped quote": ('"\\"" = 1\n' + ".".join("c" * 5000) + " = 1", f"nested deeper than {MAX_DEPTH}"),
    "an open string": ('a = "' + '\\"' * 200_000, "not a TOML file"),
    "an open text": ('a = """' + '\\"""' * 200_000, "not a TOML file"),
    "spaces": (" " * 1_000_000 + "a", "not a TOML file"),
    "a control character": ("a = 1\0", "not a TOML file"),
}


@pytest.mark.parametrize("name", REFUSED_TEXTS)
def test_a_text_that_would_overload_the_parser_is_refused_in_one_line(name):
    text, message = REFUSED_TEXTS[name]
    with pytest.raises(InputFileError) as caught:
        parse_toml(text, "file")
    assert message in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1
    assert len(str(caught.value)) < 300


def test_long_words_and_brackets_inside_strings_and_comments_are_accepted():
    dots = ".".join("a" * 500)
    text = f"""
    a = "{dots}" # {dots} {"[" * 500}
    b = '{dots}{"[" * 500}'
    c = \"\"\"{dots} "" {"[" * 500} \\\" \"\"\"\"
    d = '''{"9" * 5000}'''
    "{dots}" = [1.5, 1e300, 1979-05-27T07:32:00.999999-07:00]
    """
    assert parse_toml(text, "file") == tomllib.loads(text)


def test_nesting_up_to_the_limit_is_read_and_deeper_nesting_is_refused():
    lists = MAX_DEPTH - 1  # the table around them is one level
    assert parse_toml("a = " + "[" * lists + "]" * lists, "file")
    with pytest.raises(InputFileError, match="nested deeper"):
        parse_toml("a = " + "[" * MAX_DEPTH + "]" * MAX_DEPTH, "file")
    assert parse_toml(".".join("a" * MAX_DEPTH) + " = 1", "file")
    with pytest.raises(InputFileError, match="nested deeper"):
        parse_toml(".".join("a" * (MAX_DEPTH + 1)) + " = 1", "file")
    assert parse_toml("a = " + "9" * MAX_TOKEN, "file") == {"a": int("9" * MAX_TOKEN)}


PLAIN = (
    st.booleans()
    | st.integers(-(10**30), 10**30)
    | st.floats(allow_nan=False)
    | st.text(max_size=9)
    | st.dates()
    | st.datetimes(timezones=st.none() | st.just(datetime.UTC))
    | st.times()
)
VALUES = st.recursive(PLAIN, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner), max_leaves=10)


@settings(deadline=None, max_examples=50)
@given(st.dictionaries(st.text(max_size=9), VALUES, max_size=5))
def test_written_values_read_back_unchanged(table):
    assert tomllib.loads("\n".join(toml_entries(table))) == table


def test_unusual_keys_and_values_are_preserved_by_a_gains_file(gains, mimopilot, tmp_path):
    odd = {'a "quoted" = key': 1, "a.b": {"": "empty", "line\nbreak": [{"ü ]": "\U0001f681\u2028"}]}, "'": math.inf}
    odd |= {"k" * 300: "long", "\x7f\\": "back\\slash", "when": datetime.datetime(2026, 1, 2, 3, 4)}
    written = dataclasses.replace(gains, provenance=Provenance.from_table(odd))
    read = gains_from_toml(gains_to_toml(written), "file")
    assert read.provenance.details == odd
    written.save(tmp_path / "odd.gains.toml")
    done = mimopilot("convert", "odd.gains.toml", "px4_sih", "--out", "bench.gains.toml")
    assert done.returncode == 0, done.stderr
    assert read_toml(tmp_path / "bench.gains.toml", "gains file")["provenance"] == odd


def test_half_a_surrogate_pair_is_written_as_the_replacement_character(gains):
    text = gains_to_toml(dataclasses.replace(gains, provenance=Provenance(log="x\udcff.ulg")))
    assert gains_from_toml(text, "file").provenance.log == "x\ufffd.ulg"


@given(st.text() | st.integers() | st.lists(st.text()))
def test_a_value_in_a_message_is_shortened_to_one_line(value):
    assert len(shown(value)) <= MAX_SHOWN
    assert len(shown(value).splitlines()) == 1


@pytest.mark.parametrize(
    "command",
    [
        ("generate", "BAD", "--out", "x"),
        ("fly", "BAD"),
        ("fly", "odd.toml"),
        ("fly", "adam0", "--scenario", "BAD"),
        ("campaign", "adam0", "--vary", "BAD", "--out", "x"),
        ("tune", "log.csv", "--spec", "BAD", "--out", "x"),
        ("inspect", "log.csv", "--columns", "BAD"),
        ("restore", "BAD", "--connect", "udpin:127.0.0.1:0"),
    ],
)
def test_every_command_refuses_a_device_instead_of_a_file(mimopilot, tmp_path, command):
    from mimopilot.sitl.physics.airframe import FOLDER

    (tmp_path / "log.csv").write_text("t,p\n0,0\n")
    (tmp_path / "bad.toml").symlink_to("/dev/zero")
    own = (FOLDER / "adam0.toml").read_text()
    (tmp_path / "odd.toml").write_text(own.replace('"adam0.gains.toml"', '"/dev/zero"'))
    found = mimopilot(*("bad.toml" if word == "BAD" else word for word in command))
    assert_one_clear_line(found, "cannot read the", "it is a device")
    assert not (tmp_path / "x").exists()
