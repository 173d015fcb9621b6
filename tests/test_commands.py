"""The command line as a user meets it, on real input, and what it says to mistakes."""

import json
import os
import re
import subprocess
import sys

import pytest
from pyulog import ULog

from mimopilot.codegen.targets import targets
from mimopilot.sitl.physics.airframe import FOLDER, known_airframes
from mimopilot.tuning.gains_file import load_gains
from mimopilot.tuning.logs.ulog_file import open_ulog
from mimopilot.tuning.reference_model import SecondOrder
from tests.conftest import assert_one_clear_line, run_here
from tests.paths import DOCS
from tests.readable import Printed

COMMANDS = [
    *("demo", "reproduce", "experiment", "inspect", "identify", "tune", "certify", "advise", "generate", "pil"),
    *("fly", "faults", "campaign", "replay", "sitl", "plant", "convert", "upload", "restore", "params"),
    *("import-params", "logs", "doctor"),
]


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A short experiment, flown by the command."""
    path = tmp_path_factory.mktemp("log") / "flight.ulg"
    assert run_here(path.parent, "experiment", "adam0", "--seconds-per-axis", "10", "--out", path).returncode == 0
    return path


def test_help_starts_without_the_heavy_libraries(mimopilot):
    heavy = ("numpy", "scipy", "numba", "matplotlib", "pydantic", "pymavlink")
    code = f"import sys, mimopilot; print([m for m in {heavy} if m in sys.modules])"
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"
    )


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_an_example(mimopilot, command):
    result = mimopilot(command, "--help")
    assert result.returncode == 0
    assert f"Example: mimopilot {command}" in result.stdout


def test_the_commands_are_all_listed(mimopilot):
    listing = mimopilot("--help").stdout
    for command in COMMANDS:
        assert f"  {command} " in listing


def test_from_a_log_to_a_flight_by_the_commands_alone(mimopilot, log, tmp_path):
    tuned = mimopilot("tune", log, "--out", "my.gains.toml", "--json")
    assert tuned.returncode == 0, tuned.stderr
    found = json.loads(tuned.stdout)
    for name in ("Kp_o", "Kp_i", "Ki_i", "Kd_i", "Kff_i"):
        assert [len(row) for row in found[name]] == [2, 2]
    # 10 % coupling in the inertia: positive off-diagonals, about a tenth of the diagonal.
    assert 0.05 < found["Kp_i"][0][1] / found["Kp_i"][1][1] < 0.18
    assert mimopilot("generate", "my.gains.toml", "--target", "native", "--out", "cpp").returncode == 0
    assert (
        subprocess.run(
            ["make", "-s", "-C", tmp_path / "cpp/native", "test"], capture_output=True, check=False
        ).returncode
        == 0
    )
    flown = mimopilot("fly", "adam0", "--gains", "my.gains.toml", "--axis", "pitch", "--out", "doublet.ulg", "--json")
    assert flown.returncode == 0, flown.stderr
    figures = json.loads(flown.stdout)
    assert figures["axis"] == "pitch"
    assert figures["offaxis_peak_deg"] < 0.6
    assert ULog(str(tmp_path / "doublet.ulg")).get_dataset("vehicle_torque_setpoint")


def test_gains_in_doubt_are_not_emitted_unless_asked(mimopilot, log, tmp_path):
    assert mimopilot("tune", log, "--out", "x.gains.toml").returncode == 0
    text = (tmp_path / "x.gains.toml").read_text()
    assert 'verdict = "certified"' in text
    line = next(row for row in text.splitlines() if row.startswith("Kp_i = [["))
    (tmp_path / "x.gains.toml").write_text(text.replace(line, "Kp_i = [[2.5, 0.0], [0.0, 0.12]]"))
    assert_one_clear_line(mimopilot("generate", "x.gains.toml", "--out", "cpp"), "void", "edited", "--uncertified")
    assert not (tmp_path / "cpp").exists()
    examined = mimopilot("certify", log, "--gains", "x.gains.toml", "--out", "y.gains.toml", "--json")
    assert examined.returncode == 1
    assert json.loads(examined.stdout)["verdict"] == "unstable"
    assert_one_clear_line(mimopilot("generate", "y.gains.toml", "--out", "cpp"), "unstable")
    forced = mimopilot("generate", "y.gains.toml", "--out", "cpp", "--uncertified")
    assert forced.returncode == 0
    assert "unstable" in forced.stderr


def test_tables_are_the_default_output(mimopilot, log):
    result = mimopilot("tune", log, "--method", "siso", "--out", "s.gains.toml")
    assert "SISO gains" in result.stdout
    assert "pitch<-roll" in result.stdout


def test_equal_seeds_give_equal_logs(mimopilot, tmp_path):
    for name in ("a.ulg", "b.ulg"):
        assert mimopilot("experiment", "adam0", "--seconds-per-axis", "3", "--seed", "4", "--out", name).returncode == 0
    assert (tmp_path / "a.ulg").read_bytes() == (tmp_path / "b.ulg").read_bytes()


def test_models_window_and_specification_are_taken(mimopilot, log, tmp_path):
    (tmp_path / "spec.toml").write_text(
        "inner = [[25, 0.5, 1], [20, 0.4, 0]]\nouter = [9, 0.8, 0]\nderivative_cutoff_hz = 0\n"
    )
    result = mimopilot(
        "tune", log, "--spec", "spec.toml", "--outer", "8,0.9,2", "--window", "40", "--out", "x.gains.toml"
    )
    assert result.returncode == 0, result.stderr
    gains = load_gains(tmp_path / "x.gains.toml")
    assert gains.provenance.inner_model == (SecondOrder(25.0, 0.5, 1), SecondOrder(20.0, 0.4, 0))
    assert gains.provenance.outer_model == (SecondOrder(8.0, 0.9, 2),) * 2
    assert gains.provenance.details["window"] == [40, 40]
    assert gains.derivative_cutoff_hz == 0.0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("fly", "adam1"), ("unknown airframe 'adam1'", "adam0_nominal", "antr")),
        (("fly", "adam0", "--gains", "none.toml"), ("none.toml", "cannot read")),
        (("fly", "adam0", "--amplitude-deg", "1000"), ("amplitude: got 1000 degrees", "at most 60")),
        (("fly", "adam0", "--period-s", "0.001"), ("period: got 0.001 s",)),
        (("fly", "heavy.toml"), ("heavy.toml", "does not fly")),
        (("fly", "still.toml"), ("still.toml", "no torque on some axis")),
        (("experiment", "adam0", "--bandwidth", "1e-20", "--out", "x.ulg"), ("a pulse may last",)),
        (("experiment", "adam0", "--seconds-per-axis", "1e12", "--out", "x.ulg"), ("seconds_per_axis: got",)),
        (("plant", "adam0", "--rate", "nan"), ("--rate nan",)),
        (("tune", "LOG", "--inner", "20,1e300,0", "--out", "x.toml"), ("reference model",)),
        (("tune", "LOG", "--window", "5000", "--out", "x.toml"), ("window",)),
        (("tune", "LOG", "--out", "folder"), ("folder",)),
        (("generate", "odd.toml", "--out", "cpp"), ("odd.toml", "provenance")),
        (("fly", "adam0", "--axis", "yaw"), ("axis: got 'yaw'",)),
        (("fly", "adam0", "--scenario", "spin"), ("scenario: got 'spin'",)),
        (("fly", "adam0", "--amplitude-deg", "nan"), ("amplitude: got nan",)),
        (("tune", "none.ulg", "--out", "x.toml"), ("none.ulg", "no such file")),
        (("tune", "text.ulg", "--out", "x.toml"), ("text.ulg", "not a flight log")),
        (("tune", "cut.ulg", "--out", "x.toml"), ("cut.ulg",)),
        (("tune", "LOG", "--inner", "20", "--out", "x.toml"), ("expected OMEGA,ZETA,DELAY",)),
        (("tune", "LOG", "--inner", "20,-1,0", "--out", "x.toml"), ("inner", "damping -1")),
        (("tune", "LOG", "--method", "magic", "--out", "x.toml"), ("--method: got 'magic', expected mimo or siso",)),
        (("tune", "LOG", "--outer", "0.5,0.7,0", "--out", "x.toml"), ("too short",)),
        (("generate", "bad.toml", "--out", "cpp"), ("bad.toml", "schema")),
        (("experiment", "adam0", "--axis", "up", "--out", "x.ulg"), ("axis: got 'up'",)),
        (("experiment", "adam0", "--tilt-deg", "0", "--out", "x.ulg"), ("--tilt-deg", "belong to --connect")),
        (("experiment", "adam0", "--bandwidth", "-5", "--out", "x.ulg"), ("bandwidth: got -5",)),
        (("experiment", "adam0", "--seconds-per-axis", "2", "--out", "text.ulg/x.ulg"), ("text.ulg",)),
        (("plant", "adam0", "--speed", "fast"), ("--speed fast",)),
    ],
)
def test_a_mistake_is_one_clear_line_and_nothing_is_written(mimopilot, log, tmp_path, arguments, words):
    (tmp_path / "text.ulg").write_text("hello")
    (tmp_path / "cut.ulg").write_bytes(log.read_bytes()[:300])
    (tmp_path / "bad.toml").write_text("a = 1")
    (tmp_path / "odd.toml").write_text("schema = 1\nprovenance = 3\n")
    (tmp_path / "folder").mkdir()
    adam0 = (FOLDER / "adam0.toml").read_text()
    (tmp_path / "heavy.toml").write_text(adam0.replace("mass = 1.45", "mass = 100.0"))
    (tmp_path / "still.toml").write_text(adam0.replace("0.1768", "0.0"))
    before = sorted(p.name for p in tmp_path.iterdir())
    assert_one_clear_line(mimopilot(*(log if a == "LOG" else a for a in arguments)), *words)
    assert sorted(p.name for p in tmp_path.iterdir()) == before


def test_a_gains_file_with_a_matrix_that_is_not_finite_is_refused(mimopilot, log, tmp_path):
    mimopilot("tune", log, "--out", "x.gains.toml")
    text = (tmp_path / "x.gains.toml").read_text()
    line = next(row for row in text.splitlines() if row.startswith("Ki_i = [["))
    (tmp_path / "x.gains.toml").write_text(text.replace(line, "Ki_i = [[nan, 0.0], [0.0, 0.1]]"))
    assert_one_clear_line(mimopilot("generate", "x.gains.toml", "--out", "cpp"), "Ki_i[0][0]: got nan")
    (tmp_path / "x.gains.toml").write_text(text.replace(line + "\n", ""))
    assert_one_clear_line(mimopilot("fly", "adam0", "--gains", "x.gains.toml"), "roll_pitch.Ki_i: missing")
    assert not (tmp_path / "cpp").exists()


def test_without_a_compiler_the_package_is_named(mimopilot_process, tmp_path):
    environment = {**os.environ, "PATH": "/nowhere", "XDG_CACHE_HOME": str(tmp_path)}
    assert_one_clear_line(mimopilot_process("fly", "adam0", env=environment), "no C++ compiler", "apt-get install g++")


def test_a_log_without_the_topics_names_them_and_its_own(mimopilot, tmp_path):
    import numpy as np

    from mimopilot.sitl.flight.ulog_writer import ulog_bytes

    topics = {
        "vehicle_attitude": {"q": np.tile(np.float32([1, 0, 0, 0]), (3000, 1))},
        "battery_status": {"voltage_v": np.ones(3000, np.float32)},
    }
    (tmp_path / "x.ulg").write_bytes(ulog_bytes(0.004, topics, {}, {}))
    result = mimopilot("tune", "x.ulg", "--out", "x.toml")
    assert_one_clear_line(
        result, "vehicle_torque_setpoint", "vehicle_angular_velocity", "battery_status, vehicle_attitude"
    )


@pytest.mark.parametrize(("Ts", "seconds", "words"), [(0.02, 20, "too slow"), (0.004, 3, "too short")])
def test_a_slow_or_short_log_is_refused(mimopilot, tmp_path, Ts, seconds, words):
    import numpy as np

    from mimopilot.sitl.flight.ulog_writer import ulog_bytes

    n = round(seconds / Ts)
    xyz = np.random.default_rng(0).standard_normal((n, 3)).astype(np.float32)
    topics = {
        "vehicle_torque_setpoint": {"xyz": xyz},
        "vehicle_angular_velocity": {"xyz": xyz},
        "vehicle_attitude": {"q": np.tile(np.float32([1, 0, 0, 0]), (n, 1))},
    }
    (tmp_path / "x.ulg").write_bytes(ulog_bytes(Ts, topics, {}, {}))
    assert_one_clear_line(mimopilot("tune", "x.ulg", "--out", "x.toml"), words)


def test_a_full_disk_leaves_the_old_file_whole(tmp_path, monkeypatch):
    from mimopilot.common.files import write_atomically

    path = tmp_path / "x"
    write_atomically(path, "old")

    def fail(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match=r"x.*No space left|No space left.*x'"):
        write_atomically(path, "new")
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["x"]


def test_the_demo_runs_the_whole_workflow(mimopilot, tmp_path, monkeypatch):
    result = mimopilot("demo", "--out", "out", "--seed", "1", "--json")
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout)
    assert set(found["gains"]) == {"default", "siso", "mimo"}
    for path in (*found["gains"].values(), found["report"], found["log"]):
        assert (tmp_path / path).stat().st_size > 500
    for axis in ("roll", "pitch"):
        methods = found["doublets"][axis]
        assert set(methods) == {"default", "siso", "mimo"}
        for figures in methods.values():
            assert set(figures) == {
                "J_M_o",
                "J_M_i",
                "J_r_o",
                "J_r_i",
                "offaxis_peak_deg",
                "offaxis_rms_deg",
                "effort_rms",
                "peak_deg",
                "saturated",
            }
        # What full matrices are for: the other axis stays where it is. Both designs follow better than what flew; the
        # same design axis by axis follows a little better still in this doublet, which saturates the motors.
        assert methods["mimo"]["offaxis_rms_deg"] < 0.33 * methods["siso"]["offaxis_rms_deg"]
        assert methods["mimo"]["J_M_o"] < 0.75 * methods["default"]["J_M_o"]
        assert methods["mimo"]["J_M_o"] < 1.25 * methods["siso"]["J_M_o"]
    for method in ("siso", "mimo"):
        assert load_gains(tmp_path / found["gains"][method]).verdict()[0] == "certified"
    assert found["mavlink"]["samples"] == 729
    page = (tmp_path / found["report"]).read_text()
    assert len(page) < 6_000_000
    for chart in ("experiment", "gains", "predicted-motion", "sensitivity", "doublet-roll", "doublet-pitch"):
        assert f'<div id="{chart}-0"' in page
    assert "<figure><svg" not in page
    # As in a flight's report: with the error, and the digits that it justifies; the design predicted the same.
    row = re.search(r"roll: tracking error in doublets \[deg\]</td>(.*)</tr>", page)[1]
    values = re.findall(r">([0-9.]+) \+- ([0-9.]+)<", row)
    predicted = load_gains(tmp_path / found["gains"]["mimo"]).provenance.details["predicted"]
    for name, (value, error) in zip(("flown", "siso", "tuned"), values, strict=True):
        assert len(value) == len(error)
        assert float(value) == pytest.approx(predicted[name][0]["follow_deg"][0], abs=float(error))
    peaks = [found["doublets"]["roll"][name]["offaxis_peak_deg"] for name in ("mimo", "siso", "default")]
    headline = re.search(r'<div class="headline good">\n<p>(.*)</p>', page)[1]
    assert re.findall(r"([0-9.]+) degrees", headline) == [f"{peak:.2f}" for peak in peaks]
    printed = Printed(monkeypatch)
    again = mimopilot("demo", "--out", "again", "--seed", "1")
    printed.check(again.stdout)
    for name in ("flight.ulg", "mimo.gains.toml", "siso.gains.toml", "report.html", "firmware/mimo/manifest.json"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "again" / name).read_bytes()
    assert again.returncode == 0


def test_damage_of_a_log_is_reported_once_by_every_command_that_reads_it(mimopilot, log, tmp_path):
    data = bytearray(log.read_bytes())
    data[open_ulog(log).topics[0].offsets[1000] + 2] ^= 0xFF  # the kind of a message
    (tmp_path / "x.ulg").write_bytes(data)
    for command in (
        ("inspect", "x.ulg"),
        ("identify", "x.ulg"),
        ("tune", "x.ulg", "--out", "g.gains.toml"),
        ("certify", "x.ulg", "--gains", "g.gains.toml"),
    ):
        told = [line for line in mimopilot(*command).stderr.splitlines() if "damaged: " in line]
        assert len(told) == 1, command
        pattern = r"mimopilot: warning: x\.ulg: damaged: \d+ of \d+ bytes, in 1 place, are not valid"
        assert re.match(pattern, told[0])
    assert "damaged: " in (tmp_path / "g.gains.toml").read_text()


def test_help_and_manual_name_every_target_and_airframe(mimopilot):
    manual = "".join(page.read_text() for page in DOCS.glob("*.md"))
    help_text = " ".join(mimopilot("generate", "--help").stdout.split())
    for name, target in targets().items():
        assert f"{name}: {target.help}" in help_text
        assert f"--target {name}" in manual
        for option, values in target.options.items():
            assert f"{option.replace('_', '-')} ({name}): {', '.join(values)}" in help_text
    flights = mimopilot("fly", "--help").stdout
    for name in known_airframes():
        assert name in flights
        assert f"`{name}`" in manual
