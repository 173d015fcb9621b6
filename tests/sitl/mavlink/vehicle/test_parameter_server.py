"""The vehicle's parameters: ranges, refusals, the running controller, and the file that stores them."""

import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mimopilot.codegen.layout import INPUT
from mimopilot.codegen.native import NativeController, load_native
from mimopilot.common.errors import Error
from mimopilot.sitl.autopilot.excitation_injector import Injector
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.vehicle.parameter_server import ParameterServer
from mimopilot.sitl.mavlink.vehicle.parameter_store import ParameterStore
from mimopilot.sitl.mavlink.wire.parameter_files import read_parameters
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.tuning.parameters import EXCITATION, IDENTITY, PARAMETERS
from tests.sitl.mavlink.running import wait_for

#: Also the numbers of the firmware and of the stored set.
ALL = len(PARAMETERS + IDENTITY + EXCITATION) + 2


def start(store=None):
    gains = load_airframe("adam0").default_gains()
    return ParameterServer(NativeController(load_native(gains), gains), gains, Injector(gains.Ts), store)


@pytest.fixture
def server():
    return start()


def kinds(answers):
    return [a.get_type() for a in answers]


def test_a_written_parameter_changes_the_running_controller(server):
    (answer,) = server.write("MIMO_RP_RR", 0.12, 9)
    assert np.float32(answer.param_value) == np.float32(0.12)
    assert server.controller.state["gains"][0, 4] == np.float32(0.12)
    assert server.read("MIMO_RP_RR", -1)[0].param_value == np.float32(0.12)


def test_a_written_excitation_parameter_reaches_the_injector(server):
    server.write("MIMO_EX_DUR", 3.0, 9)
    server.write("MIMO_EX_AX", 2.0, 9)
    assert server.injector.said == ["excitation: waits for its mode in the air"]


@pytest.mark.parametrize(
    ("name", "value", "kind", "reason"),
    [
        ("MIMO_NOPE", 1.0, 9, 1),
        ("MIMO_RP_RR", 99.0, 9, 2),
        ("MIMO_RP_RR", math.nan, 9, 2),
        ("MIMO_RP_RR", math.inf, 9, 2),
        ("MIMO_EX_AMP", 0.51, 9, 2),
        ("MIMO_EX_SEED", 1.5, 9, 2),
        ("MIMO_EX_AX", math.nan, 9, 2),
        ("MIMO_TS", 0.002, 9, 5),
        ("MIMO_SCALE_R", 1.0, 9, 5),
        ("MIMO_RP_RR", 0.1, 6, 7),
    ],
)
def test_a_refused_write_says_why_and_changes_nothing(server, name, value, kind, reason):
    before = server.controller.state.tobytes(), dict(server.values)
    answers = server.write(name, value, kind)
    assert answers[0].get_type() == "PARAM_ERROR"
    assert answers[0].error == reason
    assert kinds(answers[1:]) == ([] if reason == 1 else ["PARAM_VALUE"])
    assert (server.controller.state.tobytes(), server.values) == before


def test_the_parameter_list_holds_the_whole_table_in_order(server):
    listing = server.listing()
    assert [m.param_index for m in listing] == list(range(ALL))
    assert {m.param_count for m in listing} == {ALL}
    for i in (0, 20, 38, ALL - 1):
        assert server.read("", i)[0].param_value == listing[i].param_value
    assert kinds(server.read("", ALL)) == ["PARAM_ERROR"]


@given(value=st.floats(-1, 1, width=32), rate=st.floats(-0.5, 0.5, width=32))
@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_change_in_flight_does_not_change_the_torque_abruptly(server, value, rate):
    inputs = np.zeros(40, INPUT)
    inputs["armed"] = inputs["attitude"][:, 0] = inputs["attitude_setpoint"][:, 0] = 1
    inputs["rates"][:, 0] = rate / 10
    before = server.controller.run(inputs)["moment"][-1]
    server.write("MIMO_RP_RR", value, 9)
    server.write("MIMO_RI_RR", 0.0001, 9)
    after = server.controller.run(inputs[:1])["moment"][0]
    # Only one period's integral may be added; the integrator limit is not reached here.
    assert np.abs(after - before).max() <= 0.004 * 0.05 * 1.0 + 1e-6


# The parameter file.


def close_and_read(server):
    server.close()
    return read_parameters(server.store.path)


def test_a_change_is_written_to_the_file_without_a_storage_command(tmp_path):
    server = start(ParameterStore(tmp_path / "p.params"))
    server.write("MIMO_RP_RR", 0.12, 9)
    wait_for(server.store.path.exists)
    assert read_parameters(server.store.path)["MIMO_RP_RR"] == np.float32(0.12)
    server.close()


def test_changed_parameters_and_no_others_survive_a_restart(tmp_path):
    path = tmp_path / "p.params"
    server = start(ParameterStore(path))
    assert server.summary == ""
    server.write("MIMO_RP_RR", 0.12, 9)
    server.write("MIMO_EX_AMP", 0.2, 9)
    server.write("MIMO_EX_AX", 3.0, 9)
    held = close_and_read(server)
    fixed = {"MIMO_TS", "MIMO_FW_ID", *(p.name for p in IDENTITY)}
    assert set(held) == fixed | {"MIMO_RP_RR", "MIMO_EX_AMP"}

    again = start(ParameterStore(path))
    assert again.controller.state["gains"][0, 4] == np.float32(0.12)
    assert again.values["MIMO_EX_AMP"] == np.float32(0.2)
    assert again.values["MIMO_EX_AX"] == 0.0  # an experiment of an earlier flight does not start again
    assert again.summary.startswith(f"{path}: 2 parameters override the gains: MIMO_RP_RR 0.12 (else 0.15)")
    again.write("MIMO_RP_RR", again.defaults["MIMO_RP_RR"], 9)
    assert set(close_and_read(again)) == fixed | {"MIMO_EX_AMP"}


def test_no_file_is_written_when_no_value_changes(tmp_path):
    server = start(ParameterStore(tmp_path / "p.params"))
    server.write("MIMO_RP_RR", server.values["MIMO_RP_RR"], 9)
    server.write("MIMO_RP_RR", math.nan, 9)
    server.close()
    assert list(tmp_path.iterdir()) == []


LINE = "1\t1\t{}\t{}\t9\n"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("\x00\x01", "p.params"),
        ("1\t1\tMIMO_RP_RR\t0.1", "line 1"),
        (LINE.format("MIMO_RP_RR", "nan"), "MIMO_RP_RR.*finite"),
        (LINE.format("MIMO_NOPE", "1"), "MIMO_NOPE: this vehicle has no such parameter"),
        (LINE.format("MIMO_RP_RR", "99"), "MIMO_RP_RR: got 99.0, expected 0.0001 to 5"),
        (LINE.format("MIMO_EX_SEED", "1.5"), "MIMO_EX_SEED: got 1.5, expected a whole number"),
        (LINE.format("MIMO_TS", "0.002"), "MIMO_TS is 0.002, the gains are for 0.004"),
        (LINE.format("MIMO_SCALE_R", "1"), "of a vehicle with other gains"),
        (LINE.format("MIMO_FW_ID", "7"), "of a vehicle with other gains"),
    ],
)
def test_an_invalid_file_is_one_clear_error_and_stays_unchanged(tmp_path, content, message):
    path = tmp_path / "p.params"
    path.write_text(content)
    with pytest.raises(Error, match=message) as error:
        start(ParameterStore(path))
    assert error.value.exit_code == 2
    assert "\n" not in str(error.value)
    assert path.read_text() == content


def test_a_failed_write_is_reported_and_tried_again(tmp_path):
    path = tmp_path / "p.params"
    server = start(ParameterStore(path))
    path.mkdir()
    server.write("MIMO_RP_RR", 0.12, 9)
    assert not server.flush()
    assert "p.params" in server.take_write_error()
    with pytest.raises(SitlError, match=r"not stored: .*p\.params"):
        server.close()
    path.rmdir()
    assert close_and_read(server)["MIMO_RP_RR"] == np.float32(0.12)
