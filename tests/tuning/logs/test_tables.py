import re
import struct
import zlib

import numpy as np
import pytest
from scipy.io import savemat

from mimopilot.common.errors import Error
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.logs.columns import load_columns
from mimopilot.tuning.logs.reader import read_log
from mimopilot.tuning.spec import load_spec
from tests.paths import DOCS
from tests.tuning.logs.flights import COLUMNS, make_flight, table, write_csv


@pytest.fixture(scope="module")
def flight():
    return make_flight()


def assert_is(log, flight, tolerance=1e-6):
    assert log.Ts == 0.004
    assert log.segments == ((0, len(flight.t)),)
    for name in ("u", "y_i", "y_o", "r_o"):
        assert getattr(log, name) == pytest.approx(getattr(flight, name), abs=tolerance)


def columns(tmp_path, text):
    (tmp_path / "columns.toml").write_text(text)
    return load_columns(tmp_path / "columns.toml")


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_a_csv_file_with_the_default_columns_needs_no_column_file(tmp_path, flight, delimiter):
    assert_is(read_log(write_csv(tmp_path / "x.csv", table(flight), delimiter)), flight)


@pytest.mark.parametrize("compressed", [False, True])
def test_a_matlab_file_with_the_default_variables_needs_no_column_file(tmp_path, flight, compressed):
    savemat(tmp_path / "x.mat", table(flight), do_compression=compressed)
    assert_is(read_log(tmp_path / "x.mat"), flight)


def test_fields_of_a_matlab_structure_are_named_with_a_dot(tmp_path, flight):
    savemat(tmp_path / "x.mat", {"log": {name: values[:, None] for name, values in table(flight).items()}})
    text = "\n".join(f'{name} = {{ column = "log.{name}" }}' for name in COLUMNS)
    assert_is(read_log(tmp_path / "x.mat", columns(tmp_path, text)), flight)


def test_content_decides_not_the_name(tmp_path, flight):
    assert_is(read_log(write_csv(tmp_path / "x.ulg", table(flight))), flight)


OTHER_NAMES = """
t = { column = "time", unit = "us" }
u_pitch = { sign = -1 }
p = { column = "gyro x", unit = "deg/s" }
q = { column = "gyro y", unit = "deg/s", sign = -1 }
roll = { unit = "deg" }
pitch = { unit = "deg", sign = -1 }
roll_sp = { unit = "deg" }
pitch_sp = { unit = "deg", sign = -1 }
"""


def test_other_names_units_and_signs_are_converted(tmp_path, flight):
    own = table(flight)
    foreign = {
        "time": 1e6 * own["t"],
        "u_roll": own["u_roll"],
        "u_pitch": -own["u_pitch"],
        "gyro x": np.degrees(own["p"]),
        "gyro y": -np.degrees(own["q"]),
        **{name: np.degrees(own[name]) for name in ("roll", "roll_sp")},
        **{name: -np.degrees(own[name]) for name in ("pitch", "pitch_sp")},
    }
    log = read_log(write_csv(tmp_path / "x.csv", foreign), columns(tmp_path, OTHER_NAMES))
    assert_is(log, flight, 1e-5)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('thrust = { column = "T" }', "thrust: not a signal; known signals: t, u_roll"),
        ('p = { column = "gx", units = "deg/s" }', "p.units: unknown entry"),
        ('p = { unit = "deg" }', "p.unit: got 'deg', expected rad/s or deg/s"),
        ('t = { unit = "min" }', "t.unit"),
        ('p = { column = "gyro", index = 0 }', "p.index: got 0, expected greater than or equal to 1"),
        ("u_roll = { sign = 0 }", "u_roll.sign: got 0, expected 1 or -1"),
        ("u_roll = { sign = [", "not a TOML file"),
        ('p = { column = "" }', "p.column"),
    ],
)
def test_a_column_file_with_an_unknown_or_impossible_entry_is_refused(tmp_path, text, words):
    with pytest.raises(Error, match=words):
        columns(tmp_path, text)


def test_a_missing_column_is_named_beside_the_existing_ones(tmp_path, flight):
    path = write_csv(tmp_path / "x.csv", table(flight))
    with pytest.raises(TuningError, match=r"p_sp: no column 'rate'; this file has t, u_roll, u_pitch"):
        read_log(path, columns(tmp_path, 'p_sp = { column = "rate" }'))


def test_a_column_file_for_a_log_that_names_its_signals_is_refused(tmp_path):
    (tmp_path / "x.ulg").write_bytes(b"ULog\x01\x12\x35\x01")
    with pytest.raises(TuningError, match="--columns is for MATLAB and CSV files"):
        read_log(tmp_path / "x.ulg", columns(tmp_path, ""))


def test_columns_of_nan_are_not_logged_and_single_ones_are_missing_samples(tmp_path, flight):
    own = table(flight)
    own["roll_sp"] = np.full(len(flight.t), np.nan)
    own["p"] = own["p"].copy()
    own["p"][500] = np.nan
    own["p"][1000:1100] = np.nan
    log = read_log(write_csv(tmp_path / "x.csv", own))
    assert log.r_o is None
    assert [stop - start for start, stop in log.segments] == pytest.approx([1000, 900], abs=2)
    assert log.y_i[500, 0] == pytest.approx((flight.y_i[499, 0] + flight.y_i[501, 0]) / 2, abs=1e-9)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t,u_roll\n", "no samples below the header"),
        ("a,b\n1,2\n", "no column 't' with the time"),
        ("t,u_roll\n1,abc\n", "expected numbers below one header line.*abc"),
        ("t,u_roll,t\n1,2,3\n", "column t appears twice"),
        ("t,u_roll\n0,1\n1,2\n2,3\n", "lacks column u_pitch|lacks column u_roll and u_pitch"),
        ("0.0,0.1,0.2\n1,2,3\n", "the first line holds numbers"),
        ("FMT, 128, 89, FMT, BBnNZ\n", "an ArduPilot log as text; give the .bin file"),
        ("H Product:Blackbox flight data recorder\n", "a Betaflight log; make a CSV file"),
        ("hello\n", "not a flight log"),
        ("", "not a flight log"),
    ],
)
def test_a_file_that_is_not_a_table_of_signals_is_refused(tmp_path, text, words):
    (tmp_path / "x.csv").write_text(text)
    with pytest.raises(TuningError, match=words):
        read_log(tmp_path / "x.csv")


def test_matlab_7_3_is_refused_with_how_to_save_it(tmp_path):
    (tmp_path / "x.mat").write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512) + b"\x89HDF\r\n\x1a\n")
    with pytest.raises(TuningError, match=r"save\(\.\.\., '-v7'\)"):
        read_log(tmp_path / "x.mat")


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (np.ones((3, 3)), r"u_roll: got float64 of shape \(3, 3\)"),
        ("text", "u_roll: got <U4"),
        (np.ones(7), "u_roll has 7"),
    ],
)
def test_a_matlab_variable_that_is_not_a_vector_of_the_same_length_is_refused(tmp_path, flight, values, words):
    savemat(tmp_path / "x.mat", table(flight) | {"u_roll": values})
    with pytest.raises(TuningError, match=words):
        read_log(tmp_path / "x.mat")


@pytest.mark.parametrize(
    ("names", "factor", "words"),
    [
        (("p", "q"), 180 / np.pi, r"changes 0\.0175 times .* p = \{ column = \"p\", unit = \"deg/s\" \}, q = \{"),
        (("roll", "pitch"), 180 / np.pi, r"degrees are taken for radians; .* roll = \{ .* \"deg\" \}, pitch = \{"),
        (("q",), -1.0, r"wrong sign of q \(pitch\); .* q = \{ column = \"q\", sign = -1 \}"),
        (("u_roll",), 1000.0, r"u_roll, u_pitch: .* % of u are outside \+-5"),
    ],
)
def test_a_wrong_unit_or_sign_is_found(tmp_path, flight, names, factor, words):
    own = table(flight)
    with pytest.raises(TuningError, match=words):
        read_log(write_csv(tmp_path / "x.csv", own | {name: factor * own[name] for name in names}))


@pytest.mark.parametrize(("unit", "factor"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_a_time_in_another_unit_is_refused_with_the_correcting_line(tmp_path, flight, unit, factor):
    path = write_csv(tmp_path / "x.csv", table(flight) | {"t": np.round(factor * (flight.t - 10))})
    line = f't = {{ column = "t", unit = "{unit}" }}'
    with pytest.raises(TuningError, match=r"column t: steps of .* s mean a rate of") as caught:
        read_log(path)
    assert str(caught.value).endswith(f"give its unit in the --columns file: {line}")
    assert_is(read_log(path, columns(tmp_path, line)), flight)


@pytest.mark.parametrize(
    ("time", "words"),
    [
        (lambda t: np.arange(len(t)), "steps of 1 s mean a rate of 1 Hz and a flight of 2000 s: it counts samples"),
        (
            lambda t: (t - 10) / 60,
            r"a rate of 1\.5e\+04 Hz and a flight of 0\.1333 s.*convert the time to s, ms",
        ),
        (lambda t: 0 * t, "column t: the time does not increase"),
        (lambda t: -t, "column t: the time does not increase"),
        (lambda t: 500 * (t - 10), r'a rate of 0\.5 Hz .*unit = "ms"'),
    ],
)
def test_an_impossible_time_is_refused_with_the_rate_found(tmp_path, flight, time, words):
    with pytest.raises(TuningError, match=words):
        read_log(write_csv(tmp_path / "x.csv", table(flight) | {"t": time(flight.t)}))


def test_a_slow_log_in_milliseconds_gets_both_messages(tmp_path):
    flight = make_flight(20.0, 0.02)
    with pytest.raises(TuningError, match=r'unit = "ms" \}; its rate is then 50 Hz, tuning needs 100 Hz'):
        read_log(write_csv(tmp_path / "x.csv", table(flight) | {"t": 1000 * flight.t}))


def test_a_short_log_in_minutes_does_not_count_as_a_fast_one(tmp_path):
    flight = make_flight(20.0, 0.01)
    with pytest.raises(TuningError, match=r"a rate of 6000 Hz and a flight of 0\.3333 s"):
        read_log(write_csv(tmp_path / "x.csv", table(flight) | {"t": np.round((flight.t - 10) / 60, 9)}))
    assert read_log(write_csv(tmp_path / "x.csv", table(make_flight(8.0, 0.0005)))).Ts == 0.0005


@pytest.mark.parametrize("delimiter", [";", "\t"])
def test_decimal_commas_are_read_when_other_characters_separate_the_cells(tmp_path, flight, delimiter):
    path = write_csv(tmp_path / "x.csv", table(flight), delimiter)
    path.write_text(path.read_text().replace(".", ","))
    assert_is(read_log(path), flight)


def test_decimal_commas_between_commas_are_refused_with_the_cause(tmp_path, flight):
    path = write_csv(tmp_path / "x.csv", table(flight))
    path.write_text(path.read_text().replace(".", ","))
    with pytest.raises(TuningError, match=r"cells in the first row, 9 names.*decimal.*semicolons"):
        read_log(path)


def test_all_missing_signals_are_reported_at_once(tmp_path, flight):
    own = table(flight)
    path = write_csv(tmp_path / "x.csv", {"time": own["t"], "p": own["p"], "roll": own["roll"]})
    with pytest.raises(
        TuningError, match=r"no column 't' with the time.*no column u_roll, u_pitch, q, pitch; .* time, p"
    ):
        read_log(path)
    text = 't = { column = "stamp" }\nq = { column = "gyro" }'
    with pytest.raises(
        TuningError, match=r"t: no column 'stamp'; q: no column 'gyro'; no column u_roll, u_pitch, pitch"
    ):
        read_log(path, columns(tmp_path, text))


def test_columns_of_matlab_matrices_are_picked_by_an_index_from_one(tmp_path, flight):
    names = ("p", "q", "roll", "pitch", "u_roll", "u_pitch", "roll_sp", "pitch_sp")
    matrices = {
        "gyro": np.column_stack([flight.y_i, np.zeros(len(flight.t))]),
        "angle": np.column_stack([flight.y_o, np.zeros(len(flight.t))]).T,
        "s": {"u": flight.u, "sp": flight.r_o},
    }
    savemat(tmp_path / "x.mat", {"t": flight.t, **matrices})
    places = ("gyro", "gyro", "angle", "angle", "s.u", "s.u", "s.sp", "s.sp")
    lines = [
        f'{n} = {{ column = "{m}", index = {1 + i % 2} }}' for i, (n, m) in enumerate(zip(names, places, strict=True))
    ]
    assert_is(read_log(tmp_path / "x.mat", columns(tmp_path, "\n".join(lines))), flight)
    lines[1] = 'q = { column = "gyro", index = 4 }'
    with pytest.raises(TuningError, match="q: index 4, expected 1 to 3"):
        read_log(tmp_path / "x.mat", columns(tmp_path, "\n".join(lines)))
    lines[1] = 'q = { column = "gyro" }'
    with pytest.raises(TuningError, match=r'pick its column: q = \{ column = "gyro", index = 1 \} \(the first is 1\)'):
        read_log(tmp_path / "x.mat", columns(tmp_path, "\n".join(lines)))
    with pytest.raises(TuningError, match="p: index picks a column of a MATLAB matrix"):
        read_log(write_csv(tmp_path / "x.csv", table(flight)), columns(tmp_path, "p = { index = 1 }"))


def test_very_many_columns_give_a_short_message(tmp_path):
    names = [f"c{i}" for i in range(50_000)]
    (tmp_path / "x.csv").write_text(",".join(names) + "\n" + ",".join(["1"] * len(names)) + "\n")
    with pytest.raises(TuningError, match="c98, c99 and 49900 more") as caught:
        read_log(tmp_path / "x.csv")
    assert len(str(caught.value)) < 1500


def matlab(kind, shape, contents=b"", packed=False):
    """A MATLAB file with one array of a class with a declared shape."""
    flags = struct.pack("<IIII", 6, 8, kind, 0)
    sizes = struct.pack("<IIii", 5, 8, *shape)
    body = flags + sizes + struct.pack("<HHI", 1, 1, ord("u")) + contents
    element = struct.pack("<II", 14, len(body)) + body
    if packed:
        squeezed = zlib.compress(element)
        element = struct.pack("<II", 15, len(squeezed)) + squeezed
    return b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x100) + b"IM" + element


HUGE = (1 << 15, 1 << 15)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize(
    ("kind", "contents"),
    [
        (1, b""),
        (2, struct.pack("<HHI", 5, 4, 8) + struct.pack("<II", 1, 8) + b"field\0\0\0"),
        (4, b""),
        (6, struct.pack("<II", 9, 1 << 31)),
    ],
    ids=["cell", "structure", "text", "numbers"],
)
def test_a_matlab_array_that_declares_more_than_the_file_holds_is_refused(tmp_path, kind, contents, packed):
    (tmp_path / "x.mat").write_bytes(matlab(kind, HUGE, contents, packed))
    with pytest.raises(TuningError, match="an array declares more values than it holds"):
        read_log(tmp_path / "x.mat")
    (tmp_path / "x.mat").write_bytes(matlab(1, (1, 1), matlab(kind, HUGE, contents)[128:], packed))
    with pytest.raises(TuningError, match="an array declares more values than it holds"):
        read_log(tmp_path / "x.mat")


def test_a_matlab_file_that_decompresses_without_end_is_refused(tmp_path, flight, monkeypatch):
    savemat(tmp_path / "x.mat", table(flight), do_compression=True)
    monkeypatch.setattr("mimopilot.tuning.logs.matlab_sizes.MAX_BYTES", 100_000)
    with pytest.raises(TuningError, match="unpacks to more than"):
        read_log(tmp_path / "x.mat")


def test_other_variables_of_a_matlab_file_do_not_matter(tmp_path, flight):
    others = {"cells": np.array([1.0, "a"], dtype=object), "s": {"x": {"y": [1, 2]}}, "none": {}, "e": np.zeros((0, 3))}
    savemat(tmp_path / "x.mat", table(flight) | others)
    assert_is(read_log(tmp_path / "x.mat"), flight)


def test_the_examples_of_the_manual_are_valid_and_all_that_a_csv_log_needs(tmp_path):
    names, spec = re.findall(r"```toml\n(.*?)```", (DOCS / "logs.md").read_text(), re.DOTALL)[:2]
    assert columns(tmp_path, names).t.unit == "us"
    (tmp_path / "spec.toml").write_text(spec)
    task = load_spec(tmp_path / "spec.toml")
    assert None not in (task.yaw, task.derivative_cutoff_hz, task.moment_scale)
