"""Parameter files: values read back bit for bit, by us and by MAVProxy."""

import math
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.mavparm import MAVParmDict

from mimopilot.common.errors import Error, InputFileError
from mimopilot.sitl.mavlink.wire.float32 import single
from mimopilot.sitl.mavlink.wire.parameter_files import FORMATS, parameter_text, read_parameters
from mimopilot.tuning.logs.parameter_file import NAME
from mimopilot.tuning.parameters import PARAMETERS

names = st.from_regex(NAME, fullmatch=True)
#: -0.0 is read back as 0.0 on purpose: zero has no sign here.
floats32 = st.floats(width=32, allow_nan=False, allow_infinity=False).map(lambda v: v + 0.0)


def bits(value):
    return struct.pack("<f", value)


@pytest.mark.parametrize("form", FORMATS)
@given(values=st.dictionaries(names, floats32, min_size=1, max_size=30))
@settings(deadline=None)
def test_every_float_is_read_back_bit_for_bit(form, values, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / f"round.{form}"
    path.write_text(parameter_text(form, values))
    back = read_parameters(path)
    assert {name: bits(value) for name, value in back.items()} == {name: bits(v) for name, v in values.items()}


@pytest.mark.parametrize("form", ["mavproxy", "missionplanner"])
@given(values=st.dictionaries(names, floats32, min_size=1, max_size=30))
@settings(deadline=None)
def test_mavproxy_reads_the_same_bits(form, values, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / f"mavproxy.{form}"
    path.write_text(parameter_text(form, values))
    loaded = MAVParmDict()
    assert loaded.load(str(path), use_excludes=False)
    assert {name: bits(value) for name, value in loaded.items()} == {name: bits(v) for name, v in values.items()}


def test_a_value_that_needs_more_than_six_digits_is_kept(tmp_path):
    path = tmp_path / "small.parm"
    path.write_text(parameter_text("mavproxy", {"MIMO_RD_RP": 1.2345678e-8}))
    assert read_parameters(path) == {"MIMO_RD_RP": single(1.2345678e-8)}


def test_qgroundcontrols_five_columns_hold_the_vehicle_and_the_type():
    text = parameter_text("qgc", {"MIMO_RP_RR": single(0.12)}, system=3, component=1)
    assert text.splitlines()[2:] == ["3\t1\tMIMO_RP_RR\t0.12\t9"]
    assert text.startswith("# ")


def test_every_parameter_name_is_valid_in_a_file():
    assert all(NAME.fullmatch(p.name) for p in PARAMETERS)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no parameters"),
        ("# only a comment\n", "holds no parameters"),
        ("MIMO_RP_RR", r"line 1: got 'MIMO_RP_RR', expected a parameter name"),
        ("MIMO_RP_RR,0,12", r"line 1: got 'MIMO_RP_RR,0,12'"),
        ("MIMO_RP_RR,abc", r"line 1: MIMO_RP_RR: got 'abc', expected a finite number"),
        ("\nMIMO_RP_RR nan", r"line 2: MIMO_RP_RR: got 'nan'"),
        ("MIMO_RP_RR inf", "got 'inf'"),
        ("MIMO_RP_RR 1e39", "got '1e39'"),
        ("MIMO_RP_RR 1\nMIMO_RP_RR 2", "line 2: MIMO_RP_RR is in the file twice"),
        ("MIMO_RP_RR_TOO_LONG 1", "at most 16 capitals"),
        ("mimo 1", "got 'mimo 1'"),
        ("1\t1\tSYS_AUTOSTART\t4001\t4", "SYS_AUTOSTART: param_type 4, expected 9 or 6"),
        ("1\t1\tMIMO_RP_RR\t0.12", "got '1"),
    ],
)
def test_an_invalid_file_is_refused_with_its_line(tmp_path, text, message):
    path = tmp_path / "x.params"
    path.write_text(text)
    with pytest.raises(Error, match=message):
        read_parameters(path)


@pytest.mark.parametrize("form", FORMATS)
def test_a_file_that_was_truncated_or_edited_is_refused(tmp_path, form):
    values = {p.name: single(0.001 * i + 0.1) for i, p in enumerate(PARAMETERS)}
    path = tmp_path / "x.params"
    text = parameter_text(form, values)
    for size in range(len(text) - 1):  # without its last newline it is still complete
        path.write_text(text[:size])
        with pytest.raises(Error, match=r"holds no parameters|incomplete|cut short"):
            read_parameters(path)
    lines = text.splitlines(keepends=True)
    path.write_text("".join(lines[:-10]))
    count = len(PARAMETERS)
    with pytest.raises(Error, match=f"incomplete: holds {count - 10} parameters, but its first line says {count}"):
        read_parameters(path)
    path.write_text(text.replace("0.105", "0.106"))
    with pytest.raises(Error, match=r"damaged or edited.*delete the first line"):
        read_parameters(path)
    path.write_text(text.replace("0.105", "0.106").split("\n", 1)[1])
    assert read_parameters(path) == values | {PARAMETERS[5].name: single(0.106)}


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    with pytest.raises(InputFileError, match=r"none\.params: cannot read"):
        read_parameters(tmp_path / "none.params")
    (tmp_path / "binary.params").write_bytes(bytes(range(128, 256)))
    with pytest.raises(InputFileError, match=r"binary\.params: cannot read"):
        read_parameters(tmp_path / "binary.params")


@given(st.text(max_size=200))
@settings(deadline=None)
def test_any_text_is_read_or_refused(tmp_path_factory, text):
    path = tmp_path_factory.getbasetemp() / "any.params"
    path.write_text(text, errors="replace")
    try:
        values = read_parameters(path)
    except Error:
        return
    assert all(NAME.fullmatch(name) and math.isfinite(value) for name, value in values.items())
