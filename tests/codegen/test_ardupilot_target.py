"""The custom controller for ArduPilot: its script, its files, and its behaviour in stand-ins of ArduPilot."""

import ast
import compileall
import math
import shutil
import sys
from dataclasses import replace

import numpy as np
import pytest

from mimopilot.codegen import ardupilot
from mimopilot.codegen.ardupilot import LARGEST_INDEX, group
from mimopilot.codegen.errors import CodegenError
from mimopilot.codegen.firmware_number import firmware_number
from mimopilot.codegen.layout import INPUT
from mimopilot.codegen.native import NativeController, load_native
from mimopilot.codegen.render import render
from mimopilot.codegen.targets import TEMPLATES
from mimopilot.tuning.parameters import (
    ARDUPILOT_EXCITATION,
    ARDUPILOT_PREFIX,
    FIRMWARE_NUMBER,
    IDENTITY,
    NAME_LENGTH,
    PARAMETERS,
    SET_NUMBER,
    ardupilot_name,
)
from tests.codegen.ardupilot_host import (
    LOG_EXCITATION,
    LOG_FAULTS,
    LOG_RATE,
    LOG_TORQUE,
    LOGGED,
    PHASE,
    TORQUE,
    VERSIONS,
    at_400_hz,
    build,
    emit,
    fly,
    install,
    stand_in,
)
from tests.codegen.golden_files import check_golden
from tests.conftest import coupled_gains

#: Hover, tilted by 0.1 rad of roll, and turning.
TILTED = f"attitude {math.cos(0.05)} {math.sin(0.05)} 0 0"
TURNING = "gyro 0.2 -0.1 0.05"
MAIN, MAIN_INTEGRAL = np.array([0.03, -0.02, 0.05]), np.array([0.08, -0.06, 0.01])
#: More than the integral gains in one period in these tests: Ki_i (0.25) times the rate error (0.8 rad/s) times Ts.
ONE_PERIOD = 6e-4
MAIN_FLIES = (
    f"main {' '.join(map(str, MAIN))}",
    f"integral {' '.join(map(str, MAIN_INTEGRAL))}",
)


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    from tests.conftest import coupled_gains

    return emit(at_400_hz(coupled_gains()), tmp_path_factory.mktemp("ardupilot"))


@pytest.fixture(scope="module")
def program(tree, tmp_path_factory):
    return build("master", tree, tmp_path_factory.mktemp("host"))


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# The script


@pytest.mark.parametrize("version", VERSIONS)
def test_the_script_adds_lines_only_and_a_second_run_and_the_removal_change_nothing(version, tree, tmp_path):
    ardupilot = stand_in(version, tmp_path)
    before = contents(ardupilot)
    assert "files changed" in install(tree, ardupilot).stdout
    added = contents(ardupilot)
    for name, content in before.items():
        kept = [line for line in added[name].splitlines() if not line.endswith(b"// mimopilot")]
        assert kept == content.splitlines()
    new = b"new " if version == "4.5" else b"NEW_NOTHROW "
    source = next(content for name, content in added.items() if name.name == "AC_CustomControl.cpp")
    assert b"_backend = " + new + b"AC_CustomControl_MIMO(" in source
    assert "nothing to change" in install(tree, ardupilot).stdout
    assert contents(ardupilot) == added
    assert install(tree, ardupilot, "--remove").returncode == 0
    assert contents(ardupilot) == before


@pytest.mark.parametrize(
    ("name", "anchor"),
    [
        ("AC_CustomControl.h", "#ifndef CUSTOMCONTROL_MAX_TYPES"),
        ("AC_CustomControl.h", "#define CUSTOMCONTROL_MAX_TYPES 2"),
        ("AC_CustomControl.h", "CONT_PID             = 2,"),
        ("AC_CustomControl.cpp", '#include "AC_CustomControl_PID.h"'),
        ("AC_CustomControl.cpp", '    AP_SUBGROUPVARPTR(_backend, "2_"'),
        ("AC_CustomControl.cpp", "NEW_NOTHROW AC_CustomControl_PID("),
        ("AC_CustomControl_config.h", "#ifndef AP_CUSTOMCONTROL_PID_ENABLED"),
    ],
)
def test_the_script_changes_nothing_if_a_place_is_not_found(name, anchor, tree, tmp_path):
    ardupilot = stand_in("master", tmp_path)
    path = ardupilot / "libraries" / "AC_CustomControl" / name
    text = path.read_text()
    assert anchor in text
    path.write_text(text.replace(anchor, "changed "))
    before = contents(ardupilot)
    done = install(tree, ardupilot)
    assert done.returncode == 1 and name in done.stderr and "nothing was changed" in done.stderr
    assert "Traceback" not in done.stderr
    assert contents(ardupilot) == before


def test_the_script_refuses_another_controller_with_our_number_and_a_folder_that_is_not_ardupilot(tree, tmp_path):
    ardupilot = stand_in("master", tmp_path)
    header = ardupilot / "libraries" / "AC_CustomControl" / "AC_CustomControl.h"
    header.write_text(header.read_text().replace("CONT_PID             = 2,", "CONT_PID = 2,\n        CONT_OTHER = 3,"))
    before = contents(ardupilot)
    assert "another custom controller has number 3" in install(tree, ardupilot).stderr
    header.write_text(header.read_text().replace("CONT_OTHER = 3,", "CONT_OTHER=3"))
    assert "another custom controller has number 3" in install(tree, ardupilot).stderr
    header.write_text(header.read_text().replace("CONT_OTHER=3", "CONT_OTHER = 3,"))
    assert contents(ardupilot) == before
    assert "give the folder of ArduPilot's source" in install(tree, tmp_path).stderr


def test_the_script_refuses_a_place_that_is_there_twice(tree, tmp_path):
    ardupilot = stand_in("master", tmp_path)
    source = ardupilot / "libraries" / "AC_CustomControl" / "AC_CustomControl.cpp"
    source.write_text(source.read_text() + '#include "AC_CustomControl_PID.h"\n')
    before = contents(ardupilot)
    refused = install(tree, ardupilot)
    assert refused.returncode == 1 and "found 2 lines like" in refused.stderr and "expected one" in refused.stderr
    assert contents(ardupilot) == before


def test_the_script_completes_an_earlier_run_and_removes_what_that_left(tree, tmp_path):
    ardupilot = stand_in("master", tmp_path)
    before = contents(ardupilot)
    install(tree, ardupilot)
    complete = contents(ardupilot)
    library = ardupilot / "libraries" / "AC_CustomControl"
    # An earlier version had a file more, which would be compiled, too; a line and a file of ours were lost.
    note = library / "utility" / "mimopilot.txt"
    (library / "utility" / "older.cpp").touch()
    note.write_text(note.read_text() + "utility/older.cpp\n../AC_PID/AC_PID.cpp\n")
    other = library.parent / "AC_PID" / "AC_PID.cpp"
    other.parent.mkdir()
    other.touch()
    (library / "utility" / "excitation.cpp").unlink()
    header = library / "AC_CustomControl.h"
    header.write_text("".join(line for line in header.read_text().splitlines(True) if "CONT_MIMO" not in line))
    assert install(tree, ardupilot).returncode == 0
    assert other.exists()
    other.unlink()
    assert contents(ardupilot) == complete
    install(tree, ardupilot, "--remove")
    assert contents(ardupilot) == before


def test_the_script_alone_and_a_source_that_cannot_be_written_are_refused(tree, tmp_path):
    ardupilot = stand_in("master", tmp_path)
    before = contents(ardupilot)
    alone = tmp_path / "alone"
    shutil.copytree(tree / "ardupilot", alone / "ardupilot")
    assert "run the script where `mimopilot generate` wrote it" in install(alone, ardupilot).stderr
    (ardupilot / "libraries" / "AC_CustomControl" / "AC_CustomControl_MIMO.cpp").mkdir()
    refused = install(tree, ardupilot)
    assert refused.returncode == 1 and "Traceback" not in refused.stderr and "nothing was changed" in refused.stderr
    assert contents(ardupilot) == before


def test_the_script_keeps_mixed_line_ends(tree, tmp_path):
    ardupilot = stand_in("master", tmp_path)
    header = ardupilot / "libraries" / "AC_CustomControl" / "AC_CustomControl.h"
    header.write_bytes(header.read_bytes().replace(b"\n", b"\r\n", 1))
    before = header.read_bytes()
    assert install(tree, ardupilot).returncode == 0
    assert header.read_bytes().count(b"\r\n") == 1
    install(tree, ardupilot, "--remove")
    assert header.read_bytes() == before


def test_the_script_keeps_windows_line_ends(tree, tmp_path):
    ardupilot = stand_in("master", tmp_path)
    header = ardupilot / "libraries" / "AC_CustomControl" / "AC_CustomControl.h"
    header.write_bytes(header.read_bytes().replace(b"\n", b"\r\n"))
    install(tree, ardupilot)
    content = header.read_bytes()
    assert b"CONT_MIMO" in content and content.count(b"\n") == content.count(b"\r\n")


def test_the_script_needs_nothing_but_python():
    source = ast.parse((TEMPLATES / "ardupilot" / "install.py").read_text())
    imported = {n.name for node in ast.walk(source) if isinstance(node, ast.Import) for n in node.names}
    imported |= {node.module for node in ast.walk(source) if isinstance(node, ast.ImportFrom)}
    assert imported <= sys.stdlib_module_names


def test_what_pip_compiles_of_the_script_is_not_emitted(gains, tmp_path, monkeypatch):
    shutil.copytree(TEMPLATES, tmp_path / "templates")
    compileall.compile_dir(tmp_path / "templates", quiet=1)
    assert list((tmp_path / "templates" / "ardupilot").glob("__pycache__/*.pyc"))
    expected = render(gains, "ardupilot")
    monkeypatch.setattr("mimopilot.codegen.render.TEMPLATES", tmp_path / "templates")
    assert render(gains, "ardupilot") == expected


# The parameters


def test_the_group_has_every_parameter_within_ardupilots_limits(gains):
    table = (*PARAMETERS, *IDENTITY, FIRMWARE_NUMBER, *ARDUPILOT_EXCITATION, SET_NUMBER)
    entries = group(gains)
    assert [ARDUPILOT_PREFIX + entry.name for entry in entries] == [ardupilot_name(p.name) for p in table]
    assert all(len(ardupilot_name(p.name)) <= NAME_LENGTH for p in table)
    indices = [entry.index for entry in entries]
    assert len(set(indices)) == len(table) and min(indices) >= 1 and max(indices) <= LARGEST_INDEX


#: As first emitted, in 2026. Vehicles have values stored under these indices: never change a line, only add.
EMITTED = (
    *("AP_RR", "AP_RP", "AP_PR", "AP_PP", "RP_RR", "RP_RP", "RP_PR", "RP_PP", "RI_RR", "RI_RP"),
    *("RI_PR", "RI_PP", "RD_RR", "RD_RP", "RD_PR", "RD_PP", "RF_RR", "RF_RP", "RF_PR", "RF_PP"),
    *("AF_RR", "AF_RP", "AF_PR", "AF_PP", "RA_RR", "RA_RP", "RA_PR", "RA_PP", "AP_YY", "RP_YY"),
    *("RI_YY", "RD_YY", "RF_YY", "RMAX_R", "RMAX_P", "RMAX_Y", "UMAX_R", "UMAX_P", "UMAX_Y", "IMAX_R"),
    *("IMAX_P", "IMAX_Y", "YAW_W", "SP_SLEW", "D_POLE", "TS", "M_DAMP", "M_OMEGA", "SCALE_R", "SCALE_P"),
    *("SCALE_Y", "EX_AX", "EX_AMP", "EX_AMPY", "EX_HMIN", "EX_HMAX", "EX_DUR", "EX_SEED", "EX_MODE", "EX_TILT"),
    *("FW_ID", "SET_ID"),
)


def test_a_parameter_keeps_its_index_in_all_versions(gains):
    indices = {entry.name: entry.index for entry in group(gains)}
    # A parameter that no longer exists leaves its index unused.
    assert [indices.get(name, place) for place, name in enumerate(EMITTED, 1)] == list(range(1, len(EMITTED) + 1))
    assert all(index > len(EMITTED) for name, index in indices.items() if name not in EMITTED)


def test_a_new_row_of_the_table_moves_no_index_and_needs_one_of_its_own(gains, monkeypatch):
    before = {entry.name: entry.index for entry in group(gains)}
    row = replace(ARDUPILOT_EXCITATION[0], name="MIMO_NEW")
    monkeypatch.setattr(ardupilot, "ARDUPILOT_EXCITATION", (row, *ARDUPILOT_EXCITATION))
    with pytest.raises(CodegenError, match="MIMO_NEW: has no index in ArduPilot; append it"):
        group(gains)
    monkeypatch.setitem(ardupilot.INDEX, "NEW", len(EMITTED) + 1)
    assert {entry.name: entry.index for entry in group(gains)} == before | {"NEW": len(EMITTED) + 1}


def test_an_index_does_not_depend_on_the_gains(gains):
    full = {entry.name: entry.index for entry in group(gains)}
    without = {entry.name: entry.index for entry in group(replace(gains, moment_scale=None))}
    assert full.items() > without.items() and {n for n in full if n not in without} == {"SCALE_R", "SCALE_P", "SCALE_Y"}


def test_the_rendered_files_match_the_golden_files(gains, request):
    files = render(at_400_hz(gains), "ardupilot")
    made = {n: t for n, t in files.items() if (TEMPLATES / f"{n}.jinja").is_file() and n.startswith("ardupilot/")}
    check_golden("ardupilot", made, request.config.getoption("--update-golden"))


# The controller


@pytest.mark.parametrize("version", [version for version in VERSIONS if version != "master"])
def test_it_compiles_in_other_versions_and_flies(version, tree, tmp_path):
    rows, texts = fly(build(version, tree, tmp_path), *MAIN_FLIES, "switch 1", "step 1")
    assert not texts
    np.testing.assert_allclose(rows[0, TORQUE], MAIN + MAIN_INTEGRAL, atol=1e-6)


def test_it_takes_over_without_a_jump_and_its_own_law_remains(program):
    ours = ("ff 0.01 0 0", TILTED, TURNING, "switch 1", "step 400")
    rows, texts = fly(program, *MAIN_FLIES, *ours)
    assert not texts
    np.testing.assert_allclose(rows[0, TORQUE], MAIN + MAIN_INTEGRAL + [0.01, 0, 0], atol=ONE_PERIOD)
    # The difference fades in 0.1 s: no step of the torque from sample to sample, either.
    plain, _ = fly(program, TILTED, TURNING, "switch 1", "step 400")
    difference = rows[:, TORQUE] - plain[:, TORQUE]
    assert np.abs(np.diff(rows[:, TORQUE], axis=0)).max() < 0.01
    # Of the main controller's integrators all remains, within our limits.
    np.testing.assert_allclose(difference[-1], MAIN_INTEGRAL, atol=5e-3)


def test_it_flies_the_law_of_the_core(program):
    from tests.conftest import coupled_gains

    gains = at_400_hz(coupled_gains())
    rows, _ = fly(program, TILTED, TURNING, "switch 1", "step 300")
    inputs = np.zeros(300, INPUT)
    inputs["attitude_setpoint"] = [1, 0, 0, 0]
    inputs["attitude"] = [math.cos(0.05), math.sin(0.05), 0, 0]
    inputs["rates"] = [0.2, -0.1, 0.05]
    inputs["armed"] = 1
    out = NativeController(load_native(gains), gains).run(inputs)[-1]
    np.testing.assert_allclose(rows[-1, LOG_RATE], out["rates_setpoint"], atol=1e-6)
    # What was missing to the main controller's torque has faded in 0.75 s to less than a thousandth.
    np.testing.assert_allclose(rows[-1, TORQUE], out["moment"], atol=1e-3)


def test_the_yaw_rate_of_the_target_is_fed_about_the_earths_axis(program):
    tilt = 0.3
    target = f"{math.cos(tilt / 2)} {math.sin(tilt / 2)} 0 0"
    body = np.array([0.0, 0.5 * math.sin(tilt), 0.5 * math.cos(tilt)])  # 0.5 rad/s of heading, in body axes
    rate = "target_rate " + " ".join(map(str, body))
    rows, _ = fly(program, f"attitude {target}", f"target {target}", rate, "switch 1", "step 1")
    np.testing.assert_allclose(rows[0, LOG_RATE], body, atol=1e-6)


def test_the_rate_of_the_shaped_target_is_fed_forward_on_roll_and_pitch(program):
    # 0.5 rad/s is 0.08 rad ahead: 2 sin of half of it is less than it by 3e-4 of it, its turn is small.
    rows, _ = fly(program, "target_rate 0.5 -0.3 0", "switch 1", "step 1")
    np.testing.assert_allclose(rows[0, LOG_RATE], [0.5, -0.3, 0], atol=1e-3)
    # The attitude model makes rates of its own, from rest.
    rows, _ = fly(program, "param M_OMEGA 9", "target_rate 0.5 -0.3 0", "switch 1", "step 1")
    np.testing.assert_allclose(rows[0, LOG_RATE], 0, atol=1e-6)


def test_acro_without_an_attitude_loop_flies_the_rates(program):
    acro = ("mode 1", "other ACRO_OPTIONS 2", "rate_target 0.7 -0.4 0.2", TILTED, "switch 1", "step 1")
    rows, _ = fly(program, *acro)
    np.testing.assert_allclose(rows[0, LOG_RATE], [0.7, -0.4, 0.2], atol=1e-6)


def test_what_is_fixed_in_the_firmware_is_shown_whatever_a_parameter_file_has_stored(program):
    stored = ("param FW_ID 7", "param TS 0.004", "param SCALE_Y 9", "param SP_SLEW 0.5", "param SET_ID 8")
    names = ("FW_ID", "TS", "SCALE_Y", "SP_SLEW", "SET_ID")
    _, texts = fly(program, *stored, "switch 1", "step 500", *(f"value {name}" for name in names))
    gains = at_400_hz(coupled_gains())
    expected = (firmware_number(gains), 0.0025, gains.moment_scale[2], 0.5, 8)
    assert [np.float32(text) for text in texts[-5:]] == [np.float32(value) for value in expected]


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("period 0.003333", "loop rate is not the gains'"),
        ("other CC_AXIS_MASK 3", "CC_AXIS_MASK is not 7"),
        ("other FSTRATE_ENABLE 1", "FSTRATE_ENABLE is not 0"),
        ("param RP_RR 9", "parameter out of range"),
        ("param RP_RR 0.3", "SET_ID is not the firmware's"),
    ],
)
def test_what_it_must_not_fly_the_main_controller_flies_with_its_integrators(line, text, program):
    rows, texts = fly(program, line, *MAIN_FLIES, "slope 0.001 0 -0.002", TILTED, "switch 1", "step 50")
    assert texts[-1] == f"MIMO: {text}: main flies"
    # As the main controller alone: its integrators go on, although ArduPilot zeroes them after each update.
    steps = np.arange(1, 51)[:, np.newaxis] * [0.001, 0, -0.002]
    np.testing.assert_allclose(rows[:, TORQUE], MAIN + MAIN_INTEGRAL + steps, atol=1e-5)
    assert not rows[:, LOGGED].any()


def test_late_samples_are_counted_and_fly(program):
    lines = (TILTED, "switch 1", "step 500", "interval 10000", "step 3", "interval 2500", "step 500")
    rows, texts = fly(program, *lines)
    assert not texts and rows[:, LOGGED].all()
    assert rows[499, LOG_FAULTS] == 0 and (rows[502:, LOG_FAULTS] == 3).all()
    # The count is of one flight with this controller, and is not of the time without it.
    rows, _ = fly(program, *lines, "switch 0", "interval 90000", "step 5", "interval 2500", "switch 1", "step 500")
    assert rows[-1, LOGGED] == 1 and rows[-1, LOG_FAULTS] == 0


def test_a_loop_that_runs_slower_in_flight_is_left_to_the_main_controller_without_our_trim_lost(program):
    """Ts is the gains' as asked for, but the processor does not keep it: 8 % over a second."""
    lines = ("gyro -0.1 0 0", "switch 1", "step 800", "param EX_AX 1", "step 450", "interval 2700", "step 1000")
    rows, texts = fly(program, *MAIN_FLIES, *lines)
    assert texts == ["MIMO excitation: roll", "MIMO: loop rate is not the gains': main flies"]
    flown = rows[:, LOGGED] == 1
    left = int(np.argmin(flown))
    assert flown[:left].all() and not flown[left:].any()
    # The mean of a second with both intervals is wrong, or the next one's.
    assert 1250 <= left <= 1250 + 2 * 400
    # Ours held `kept` in its integrators: its torque is that and Kp_i times the rate error (0.1 rad/s of roll).
    kept = rows[left - 1, TORQUE] - rows[left - 1, LOG_EXCITATION] - 0.1 * np.array([0.15, 0.01, 0])
    assert np.abs(kept).min() > 0.005
    np.testing.assert_allclose(rows[left, TORQUE], MAIN + kept, atol=ONE_PERIOD)
    np.testing.assert_allclose(rows[-1, TORQUE], MAIN + kept, atol=ONE_PERIOD)
    # Switched again, it flies again if the loop keeps the period.
    rows, _ = fly(program, *lines, "switch 0", "interval 2500", "step 9", "switch 1", "step 900")
    assert (rows[-900:, LOGGED] == 1).all()


def test_a_limit_flag_stops_the_integrators_in_the_direction_of_its_own_torque(program):
    error = ("gyro -0.1 0 0",)  # roll's torque is positive and grows
    free, _ = fly(program, *error, "switch 1", "step 400")
    held, _ = fly(program, *error, "switch 1", "step 200", "limit 1 0 0", "step 200")
    assert free[399, 0] > free[199, 0] + 0.01
    np.testing.assert_allclose(held[201:, 0], held[201, 0], atol=1e-3)
    # Out of saturation it may integrate: the torque is still positive, and the error has changed its sign.
    left, _ = fly(program, *error, "switch 1", "step 400", "gyro 0.02 0 0", "step 50", "limit 1 0 0", "step 100")
    assert left[450, 0] > 0 and left[-1, 0] < left[451, 0] - 4e-4


def test_integrators_are_zero_with_idle_motors_and_held_on_the_ground(program):
    error = ("gyro -0.1 0 0", "switch 1")
    for ground in ("spool 1", "spool 0", "flying 0"):
        rows, _ = fly(program, ground, *error, "step 400")
        assert rows[-1, 0] == pytest.approx(0.15 * 0.1, abs=1e-5), ground  # Kp_i times the rate error


def test_new_gains_act_within_a_second_and_wrong_ones_are_refused_as_a_whole(program):
    # In hover the rate error alone makes torque: Kp_i and the integral.
    from tests.conftest import coupled_gains

    lines = ("gyro -0.1 0 0", "switch 1", "step 10")
    number = firmware_number(at_400_hz(coupled_gains()))
    rows, texts = fly(program, *lines, f"param SET_ID {number}", "param RI_RR 5", "step 500")
    slope = np.diff(rows[:, 0])
    assert not texts and slope[-1] == pytest.approx(5 * 0.1 * 0.0025, rel=0.01)
    rows, texts = fly(program, *lines, "param RI_RR 5", "param RP_PP -1", "step 500")
    assert texts == ["MIMO: RP_PP out of range, no gain changed"]
    slope = np.diff(rows[:, 0])
    assert slope[-1] == pytest.approx(0.25 * 0.1 * 0.0025, rel=0.02)
    # Values that were stored for another firmware.
    rows, texts = fly(program, *lines, "param SET_ID 1", "param RI_RR 5", "step 500")
    assert texts == [f"MIMO: CC3_SET_ID is not {number}, no gain changed"]
    assert np.diff(rows[:, 0])[-1] == pytest.approx(0.25 * 0.1 * 0.0025, rel=0.02)


def test_the_injector_excites_one_axis_after_the_other_and_is_logged(program):
    ask = ("param EX_DUR 0.5", "param EX_HMIN 2", "param EX_HMAX 9")
    lines = (*ask, "switch 1", "step 10", "param EX_AX 5", "step 2600")
    rows, texts = fly(program, *lines)
    assert texts == [f"MIMO excitation: {t}" for t in ("roll", "pause", "pitch", "pause", "yaw", "finished")]
    assert rows[:, LOGGED].all()
    excited = rows[:, LOG_EXCITATION]
    phases = rows[:, PHASE].astype(int)
    for axis, (phase, amplitude) in enumerate([(0, 0.1), (1, 0.1), (3, 0.2)]):
        assert (phases == phase).sum() == 200
        assert set(np.round(np.abs(excited[phases == phase, axis]), 6)) == {amplitude}
        assert not excited[phases != phase, axis].any()
    np.testing.assert_array_equal(rows[:, LOG_TORQUE], rows[:, TORQUE])
    # It is in the torque, one for one.
    without, _ = fly(program, *ask, "switch 1", "step 2610")
    np.testing.assert_allclose(rows[:, TORQUE] - without[:, TORQUE], excited, atol=1e-6)


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("sticks 0 0.15 0 0", "stop: a stick moved"),
        ("mode 2", "stop: mode, ground or disarmed"),
        ("flying 0", "stop: mode, ground or disarmed"),
        (f"attitude {math.cos(0.3)} {math.sin(0.3)} 0 0", "stop: EX_TILT"),
        ("param EX_AX 0", "cancelled"),
    ],
)
def test_the_injector_stops(line, text, program):
    lines = ("switch 1", "step 10", "param EX_AX 3", "step 500", line, "step 450")
    rows, texts = fly(program, *lines)
    assert texts == ["MIMO excitation: roll", f"MIMO excitation: {text}"]
    assert rows[505, LOG_EXCITATION].any() or "EX_AX" not in line
    assert not rows[-1, LOG_EXCITATION].any() and rows[-1, PHASE] == -1


def test_an_excitation_asked_for_before_the_change_is_none(program):
    for lines in (
        ("param EX_AX 5", "switch 1", "step 900"),
        ("switch 1", "step 10", "switch 0", "param EX_AX 5", "switch 1", "step 900"),
    ):
        rows, texts = fly(program, *lines)
        assert not texts and not rows[:, LOG_EXCITATION].any()


def test_invalid_inputs_damp_the_rates_and_are_told(program):
    rows, texts = fly(program, TURNING, "switch 1", "step 40", "attitude nan 0 0 0", "step 40")
    assert texts == ["MIMO: invalid inputs 0x2, only rates are damped"]
    assert np.isfinite(rows).all() and rows[-1, 0] < 0 < rows[-1, 1]
