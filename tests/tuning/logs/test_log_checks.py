"""Wrong signs and units and exchanged columns are refused with the correcting line."""

import itertools
import tomllib

import numpy as np
import pytest

from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.logs.columns import SIGNALS, Columns
from mimopilot.tuning.logs.reader import read_log
from mimopilot.tuning.plant.frequency_response import measured_plant
from mimopilot.tuning.plant.rigid_body_fit import rigid_body
from tests.tuning.truth import experiment

NAMES = ("t", *SIGNALS["u"], *SIGNALS["y_i"], *SIGNALS["y_o"], *SIGNALS["u_bar"])
PLACES = {signal: [NAMES.index(name) for name in names] for signal, names in SIGNALS.items() if names[0] in NAMES}
DEGREE = 180 / np.pi


@pytest.fixture(scope="module")
def good():
    log = experiment("adam0", seconds=6.0)
    t = np.arange(len(log.u)) * log.Ts
    return np.column_stack([t, log.u, log.y_i, log.y_o, log.u_bar])


@pytest.fixture(scope="module")
def acceleration():
    airframe = load_airframe("adam0").airframe
    return airframe.plant().inertia_inverse[:2, :2] @ np.diag(airframe.moment_scale()[:2])


def write(path, table):
    np.savetxt(path, table, delimiter=",", header=",".join(NAMES), comments="", fmt="%.8g")
    return path


def refusal(path):
    with pytest.raises(TuningError) as caught:
        read_log(path)
    return str(caught.value)


def told(message):
    """The column-file lines in a refusal."""
    return message.split("put into the --columns file: ")[1].split("; ")[0].replace(" }, ", " }\n")


def mended(path, message, acceleration):
    """Check that the log read with the lines of its refusal is that of the vehicle."""
    lines = message.split("put into the --columns file: ")[1].split("; ")[0].replace(" }, ", " }\n")
    log = read_log(path, Columns.model_validate(tomllib.loads(lines)))
    assert pytest.approx(acceleration, rel=0.15, abs=10) == rigid_body(measured_plant(log)).B
    return log


def test_a_correct_log_is_read(good, acceleration, tmp_path):
    log = read_log(write(tmp_path / "x.csv", good))
    assert log.warnings == ()
    assert pytest.approx(acceleration, rel=0.05, abs=5) == rigid_body(measured_plant(log)).B


@pytest.mark.parametrize("name", NAMES[1:])
def test_a_wrong_sign_names_its_column_and_the_given_line_corrects_it(good, acceleration, tmp_path, name):
    table = good.copy()
    table[:, NAMES.index(name)] *= -1
    path = write(tmp_path / "x.csv", table)
    message = refusal(path)
    assert f"wrong sign of {name} (" in message
    assert f'{name} = {{ column = "{name}", sign = -1 }}' in message
    mended(path, message, acceleration)


@pytest.mark.parametrize("names", [("u_roll", "u_bar_roll"), ("q", "pitch"), ("u_pitch", "u_bar_pitch")])
def test_two_equivalent_explanations_are_both_reported(good, tmp_path, names):
    table = good.copy()
    table[:, [NAMES.index(name) for name in names]] *= -1
    path = write(tmp_path / "x.csv", table)
    message = refusal(path)
    assert "together would look the same" in message
    read_log(path, Columns.model_validate(tomllib.loads(told(message))))
    axis = "roll" if "roll" in names[0] else "pitch"
    assert f"wrong sign of u_{axis} and u_bar_{axis} ({axis})" in message


SOME = [signals for n in (1, 2, 3) for signals in itertools.combinations(PLACES, n)]


@pytest.mark.parametrize("swapped", SOME, ids="+".join)
def test_exchanged_columns_are_named_and_the_given_lines_correct_them(good, acceleration, tmp_path, swapped):
    table = good.copy()
    for signal in swapped:
        table[:, PLACES[signal]] = table[:, PLACES[signal][::-1]]
    path = write(tmp_path / "x.csv", table)
    message = refusal(path)
    assert "roll and pitch are exchanged in" in message
    B = rigid_body(measured_plant(read_log(path, Columns.model_validate(tomllib.loads(told(message)))))).B
    # An exchange of roll and pitch in all signals cannot be detected: it only renames the axes.
    renamed = acceleration[::-1, ::-1]
    assert any(np.allclose(B, true, rtol=0.15, atol=10) for true in (acceleration, renamed))


@pytest.mark.parametrize("gentle", [0.05, 0.6])
@pytest.mark.parametrize(
    "names", [("p",), ("q",), ("p", "q"), ("roll",), ("roll", "pitch"), ("p", "roll"), ("p", "q", "roll", "pitch")]
)
def test_degrees_for_radians_are_refused_with_the_correcting_line(good, tmp_path, names, gentle):
    table = good.copy()
    table[:, 1:] *= gentle
    table[:, [NAMES.index(name) for name in names]] *= DEGREE
    message = refusal(write(tmp_path / "x.csv", table))
    # At least one line is right and none is wrong; further ones follow in the next refusal.
    units = {"p": "deg/s", "q": "deg/s", "roll": "deg", "pitch": "deg"}
    named = [name for name in units if f'{name} = {{ column = "{name}", unit = "{units[name]}" }}' in message]
    assert named
    assert set(named) <= set(names)


def test_radians_declared_as_degrees_are_refused(good, tmp_path):
    path = write(tmp_path / "x.csv", good)
    columns = Columns.model_validate({name: {"unit": "deg/s"} for name in ("p", "q")})
    with pytest.raises(TuningError, match=r"57\.3 times the integral of its rate"):
        read_log(path, columns)


def test_torque_without_the_injection_rates_of_another_time_and_noise_are_refused(good, tmp_path):
    table = good.copy()
    table[:, PLACES["u"]] -= table[:, PLACES["u_bar"]]
    assert "does not contain the torque injected on" in refusal(write(tmp_path / "x.csv", table))
    table = good.copy()
    table[:, PLACES["y_i"]] = np.roll(table[:, PLACES["y_i"]], 125, axis=0)
    assert "from different vehicles or times" in refusal(write(tmp_path / "x.csv", table))


def tumble(table, begin, seconds=1.0):
    """A roll of 360 degrees, wrapped at 180."""
    table, at = table.copy(), round(begin / 0.004)
    n = round(seconds / 0.004)
    turn = np.linspace(0, 2 * np.pi, n)
    roll, p = NAMES.index("roll"), NAMES.index("p")
    table[at : at + n, roll] = (table[at : at + n, roll] + turn + np.pi) % (2 * np.pi) - np.pi
    table[at : at + n, p] += 2 * np.pi / seconds
    return table


def test_the_log_before_a_tumble_is_used_and_a_warning_is_given(good, tmp_path):
    log = read_log(write(tmp_path / "x.csv", tumble(good, 10.5)))
    assert log.seconds == pytest.approx(10.5 + 75 / 360 - 1.0, abs=0.1)
    assert "tumbled at 10.7 s (tilt beyond 75 degrees): only the log until 1 s before" in log.warnings[0]


@pytest.mark.parametrize(("name", "begin"), [("q", 10.5), ("p", 10.5), ("pitch", 7.0)])
def test_a_wrong_sign_is_found_despite_a_tumble(good, tmp_path, name, begin):
    table = tumble(good, begin)
    table[:, NAMES.index(name)] *= -1
    message = refusal(write(tmp_path / "x.csv", table))
    axis = "roll" if name in ("p", "roll") else "pitch"
    assert "wrong sign of" in message
    assert f"({axis})" in message


def test_every_command_gives_the_same_message(good, tmp_path, mimopilot):
    table = good.copy()
    table[:, PLACES["u"]] = table[:, PLACES["u"][::-1]]
    path = write(tmp_path / "x.csv", table)
    cause = refusal(path).removeprefix(f"{path}: ")
    load_airframe("adam0").default_gains().save(tmp_path / "g.gains.toml")
    for command in (
        ("tune", path, "--out", "out.gains.toml"),
        ("advise", path),
        ("identify", path),
        ("certify", path, "--gains", "g.gains.toml"),
    ):
        result = mimopilot(*command)
        assert (result.returncode, cause in result.stderr) == (2, True), result.stderr
    assert cause in mimopilot("inspect", path).stdout.replace("\n", " ").replace("  ", " ")
    assert not (tmp_path / "out.gains.toml").exists()
