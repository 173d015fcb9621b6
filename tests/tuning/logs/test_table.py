import numpy as np
import pytest
from scipy.io import savemat

from tests.tuning.logs.flights import COLUMNS, make_flight, table, write_csv
from tuning.errors import TuningError
from tuning.logs.columns import load_columns
from tuning.logs.reader import read_log


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
def test_a_csv_file_with_the_default_columns_needs_no_mapping(tmp_path, flight, delimiter):
    assert_is(read_log(write_csv(tmp_path / "x.csv", table(flight), delimiter)), flight)


@pytest.mark.parametrize("compressed", [False, True])
def test_a_matlab_file_with_the_default_variables_needs_no_mapping(tmp_path, flight, compressed):
    savemat(tmp_path / "x.mat", table(flight), do_compression=compressed)
    assert_is(read_log(tmp_path / "x.mat"), flight)


def test_fields_of_a_matlab_structure_are_named_with_a_dot(tmp_path, flight):
    savemat(tmp_path / "x.mat", {"log": {name: values[:, None] for name, values in table(flight).items()}})
    text = "\n".join(f'{name} = {{ column = "log.{name}" }}' for name in COLUMNS)
    assert_is(read_log(tmp_path / "x.mat", columns(tmp_path, text)), flight)


def test_content_decides_not_the_name(tmp_path, flight):
    assert_is(read_log(write_csv(tmp_path / "x.ulg", table(flight))), flight)


FOREIGN = """
t = { column = "time", unit = "us" }
u_pitch = { sign = -1 }
p = { column = "gyro x", unit = "deg/s" }
q = { column = "gyro y", unit = "deg/s", sign = -1 }
roll = { unit = "deg" }
pitch = { unit = "deg", sign = -1 }
roll_sp = { unit = "deg" }
pitch_sp = { unit = "deg", sign = -1 }
"""


def test_foreign_names_units_and_signs_are_mapped(tmp_path, flight):
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
    log = read_log(write_csv(tmp_path / "x.csv", foreign), columns(tmp_path, FOREIGN))
    assert_is(log, flight, 1e-5)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('thrust = { column = "T" }', "thrust: no signal; known signals: t, u_roll"),
        ('p = { column = "gx", units = "deg/s" }', "p.units: Extra inputs"),
        ('p = { unit = "deg" }', "p.unit: Input should be 'rad/s' or 'deg/s'"),
        ('t = { unit = "min" }', "t.unit"),
        ("u_roll = { sign = 0 }", "u_roll.sign: Input should be 1 or -1"),
        ("u_roll = { sign = [", "not a TOML file"),
        ('p = { column = "" }', "p.column"),
    ],
)
def test_a_mapping_with_an_unknown_or_impossible_entry_is_refused(tmp_path, text, words):
    with pytest.raises(TuningError, match=words):
        columns(tmp_path, text)


def test_a_mapped_column_that_is_not_there_is_named_beside_those_that_are(tmp_path, flight):
    path = write_csv(tmp_path / "x.csv", table(flight))
    with pytest.raises(TuningError, match=r"p_sp: no column 'rate'; this file has t, u_roll, u_pitch"):
        read_log(path, columns(tmp_path, 'p_sp = { column = "rate" }'))


def test_a_mapping_for_a_log_that_names_its_signals_is_refused(tmp_path):
    (tmp_path / "x.ulg").write_bytes(b"ULog\x01\x12\x35\x01")
    with pytest.raises(TuningError, match="a column file is for CSV and MATLAB files"):
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
    assert log.y_i[500, 0] == pytest.approx(flight.y_i[500, 0], abs=4e-3)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t,u_roll\n", "no samples below the header"),
        ("a,b\n1,2\n", "no column 't' with the time"),
        ("t,u_roll\n1,abc\n", "not a table of numbers.*abc"),
        ("t,u_roll,t\n1,2,3\n", "column t appears twice"),
        ("t,u_roll\n0,1\n1,2\n2,3\n", "lacks column u_pitch|lacks column u_roll and u_pitch"),
        ("hello\n", "not a flight log"),
        ("", "not a flight log"),
    ],
)
def test_what_is_not_a_table_of_signals_is_refused(tmp_path, text, words):
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
def test_a_matlab_variable_that_is_no_vector_of_the_same_length_is_refused(tmp_path, flight, values, words):
    savemat(tmp_path / "x.mat", table(flight) | {"u_roll": values})
    with pytest.raises(TuningError, match=words):
        read_log(tmp_path / "x.mat")


@pytest.mark.parametrize(
    ("names", "factor", "words"),
    [
        (("p", "q"), 180 / np.pi, r"p, q is 57\.\d times the derivative of roll, pitch"),
        (("roll", "pitch"), 180 / np.pi, r"roll, pitch: .* % of y_o lie outside"),
        (("q",), -1.0, r"pitch: p, q is -1 times the derivative"),
        (("u_roll",), 1000.0, r"u_roll, u_pitch: .* % of u lie outside \+-5"),
    ],
)
def test_a_wrong_unit_or_sign_is_found(tmp_path, flight, names, factor, words):
    own = table(flight)
    with pytest.raises(TuningError, match=words):
        read_log(write_csv(tmp_path / "x.csv", own | {name: factor * own[name] for name in names}))
