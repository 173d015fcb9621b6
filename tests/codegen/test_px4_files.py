"""The files of the PX4 target: module.yaml by PX4's rules, start-up scripts, golden directories."""

import dataclasses
import json
import re
import subprocess

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from mimopilot.codegen.errors import CodegenError
from mimopilot.codegen.firmware_number import firmware_number
from mimopilot.codegen.px4 import yaml_number
from mimopilot.codegen.render import render
from mimopilot.codegen.targets import TEMPLATES, targets
from mimopilot.codegen.toolchain import find_compiler
from mimopilot.tuning.parameters import ENABLE, EXCITATION, FIRMWARE_NUMBER, IDENTITY, PARAMETERS, SET_NUMBER
from tests.codegen.golden_files import check_golden
from tests.codegen.px4_host import PX4_FLAGS, definitions

MODULE = "px4/src/modules/mc_mimo_pid"
PLAIN = ("actuation", "sticks", "throttle")
#: Units that PX4's validator accepts and we could need.
PX4_UNITS = {"s", "rad", "rad/s", "rad/s^2", "deg", "deg/s", "Hz", "Nm", "norm"}


def test_the_yaml_has_every_parameter_with_the_gains_as_defaults(gains):
    entries = definitions(render(gains, "px4"))
    values = gains.elements()
    for parameter in PARAMETERS:
        assert np.float32(entries[parameter.name]["default"]) == np.float32(values[parameter.code])
    assert [np.float32(entries[p.name]["default"]) for p in IDENTITY] == list(np.float32(gains.moment_scale))
    for setting in EXCITATION:
        assert entries[setting.name]["default"] == pytest.approx(setting.default)
        assert entries[setting.name]["type"] == ("int32" if setting.integer else "float")
    table = (*PARAMETERS, *IDENTITY, FIRMWARE_NUMBER, *EXCITATION, SET_NUMBER, ENABLE)
    assert set(entries) == {p.name for p in table}
    assert np.float32(entries["MIMO_FW_ID"]["default"]) == firmware_number(gains)


def test_the_yaml_keeps_px4s_rules_even_those_its_validator_does_not_check(gains):
    text = render(gains.with_elements({"RD_RP": 1e-5, "RD_PR": -2.5e-7}), "px4")[f"{MODULE}/module.yaml"]
    (group,) = yaml.safe_load(text)["parameters"]
    for name, entry in group["definitions"].items():
        assert re.fullmatch("[A-Z][A-Z0-9_]{0,15}", name)
        assert entry.keys() <= {
            *("description", "type", "unit", "default", "min", "max", "decimal", "increment"),
        }, name  # any value of a volatile key marks it volatile
        assert len(entry["description"]["short"]) <= 70 and "\n" not in entry["description"]["short"]
        assert len(entry["description"]["long"]) > len(entry["description"]["short"])
        number = {"float": float, "int32": int}[entry["type"]]
        for key in ("default", "min", "max"):
            assert type(entry[key]) is number, (name, key, entry[key])  # 1e-05 would be a string
            assert np.isfinite(entry[key])
        assert entry["min"] <= entry["default"] <= entry["max"]
        if "unit" in entry:
            assert entry["unit"] in PX4_UNITS
        if number is float:
            assert 0 < entry["increment"] <= 0.01 and 3 <= entry["decimal"] <= 6
    assert ".nan" not in text.lower() and "volatile" not in text
    assert "1.0e-05" in text and "-2.5e-07" in text


def test_off_diagonal_gains_may_be_negative_and_fixed_parameters_have_one_value(gains):
    entries = definitions(render(gains, "px4"))
    for parameter in PARAMETERS:
        entry = entries[parameter.name]
        if re.fullmatch("[AR][PIDF]_(RP|PR)", parameter.code):
            assert entry["min"] == -entry["max"] < 0
        if not parameter.writable:
            assert entry["min"] == entry["default"] == entry["max"]


def test_gains_without_a_unit_of_torque_publish_none(gains):
    files = render(dataclasses.replace(gains, moment_scale=None), "px4")
    assert not [name for name in definitions(files) if "SCALE" in name]
    assert "MIMO_SCALE" not in files[f"{MODULE}/parameters.hpp"]


@given(st.floats(width=32, allow_nan=False, allow_infinity=False))
def test_a_yaml_number_reads_back_as_a_float_with_the_same_bits(value):
    read = yaml.safe_load(yaml_number(value))
    assert type(read) is float
    assert np.float32(read).tobytes() == np.float32(value).tobytes()


def test_the_defaults_set_every_gain_the_gyro_rate_and_the_log_profile(gains):
    files = render(gains, "px4")
    lines = files["px4/sd_card/etc/config.txt"].splitlines()
    defaults = dict(line.split()[2:] for line in lines if line.startswith("param set-default"))
    values = gains.elements()
    for parameter in PARAMETERS:
        if parameter.writable:
            assert np.float32(defaults.pop(parameter.name)) == np.float32(values[parameter.code])
    assert defaults == {"MIMO_EN": "1", "MC_AT_EN": "0", "IMU_GYRO_RATEMAX": "250", "SDLOG_PROFILE": "49"}
    assert files["px4/airframe/mimo_defaults.txt"] in files["px4/sd_card/etc/config.txt"]


def test_the_start_up_lines_start_the_module_and_stop_nothing(gains):
    script = render(gains, "px4")["px4/sd_card/etc/extras.txt"]
    order = [script.index(word) for word in ("set +e", "MIMO_EN 0", "then\n\tmc_mimo_pid start", "set -e")]
    assert order == sorted(order) and " stop" not in script
    assert subprocess.run(["sh", "-n"], input=script, text=True, check=False).returncode == 0


def test_cmake_needs_no_px4_library_and_disables_fast_math_for_the_core(gains):
    cmake = render(gains, "px4")[f"{MODULE}/CMakeLists.txt"]
    assert "DEPENDS" not in re.sub("#.*", "", cmake)
    for flag in ("-fno-fast-math", "-fno-reciprocal-math", "-fno-associative-math"):
        assert flag in cmake


def test_the_core_refuses_to_compile_with_px4s_flags(gains, tmp_path):
    files = render(gains, "px4")
    for name in ("mimo_pid.cpp", "mimo_pid.hpp"):
        (tmp_path / name).write_text(files[f"core/{name}"])
    command = [find_compiler(), "-std=gnu++14", *PX4_FLAGS, "-fsyntax-only", str(tmp_path / "mimo_pid.cpp")]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode != 0 and "add -fno-fast-math" in result.stderr


@pytest.mark.parametrize("name", (*PLAIN, "attitude", "excitation"))
def test_files_independent_of_px4_include_no_px4_header(name):
    folder = TEMPLATES / (MODULE if name in PLAIN else "vehicle")
    for path in (folder / f"{name}.hpp", folder / f"{name}.cpp"):
        included = set(re.findall(r"#include [<\"](.*)[>\"]", path.read_text()))
        assert included <= {f"{name}.hpp", "stock_settings.hpp", "stdint.h", "float.h", "math.h"}
    flags = ["-std=c++11", "-Wall", "-Wextra", "-Werror", "-fsyntax-only"]
    subprocess.run([find_compiler(), *flags, str(folder / f"{name}.cpp")], check=True)


def test_an_unknown_px4_interface_is_refused(gains):
    with pytest.raises(CodegenError, match="px4-api: got 'v9', expected one of crtp, descriptor"):
        render(gains, "px4", px4_api="v9")


def templated(api, gains):
    """The files of px4/ and vehicle/ rendered from a template."""
    files = render(gains, "px4", px4_api=api)
    return {
        name: text
        for name, text in files.items()
        if (TEMPLATES / f"{name}.jinja").is_file() and name.startswith(("px4/", "vehicle/"))
    }


@pytest.mark.parametrize("api", targets()["px4"].options["px4_api"])
def test_the_rendered_files_match_the_golden_files(gains, api, request):
    files = templated(api, gains)
    check_golden(f"px4-{api}", files, request.config.getoption("--update-golden"))


def test_the_px4_interfaces_differ_only_in_the_module_and_its_readme(gains):
    crtp, descriptor = (render(gains, "px4", px4_api=api) for api in ("crtp", "descriptor"))
    different = {name for name in crtp if crtp[name] != descriptor[name]}
    assert different == {f"{MODULE}/mc_mimo_pid.cpp", f"{MODULE}/mc_mimo_pid.hpp", "px4/README.md", "manifest.json"}
    assert json.loads(crtp["manifest.json"])["gains_sha256"] == json.loads(descriptor["manifest.json"])["gains_sha256"]
