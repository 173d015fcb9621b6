"""Logs of other vehicles are refused with the vehicle type; of a VTOL the hover is used."""

import numpy as np
import pytest

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.logs.inspection import inspect_log
from mimopilot.tuning.logs.reader import read_log
from tests.tuning.logs.flights import (
    ardupilot_messages,
    dataflash_bytes,
    make_flight,
    microseconds,
    px4_topics,
    write_ulog,
)


@pytest.fixture(scope="module")
def flight():
    return make_flight(20.0)


def px4(path, flight, parameters=(), **status):
    """A log with vehicle_status every second: a number, or its values from then on."""
    times = flight.t[0] + np.arange(20.0)
    fields = {name: np.resize(np.asarray(value, np.uint8), 20) for name, value in status.items()}
    topic = {"timestamp": microseconds(times), **fields}
    extra = {"vehicle_status": topic} if status else {}
    return write_ulog(path / "x.ulg", px4_topics(flight, **extra), parameters)


@pytest.mark.parametrize(
    ("status", "name"),
    [
        ({"vehicle_type": 2}, "a fixed wing"),
        ({"vehicle_type": 2, "system_type": 1, "is_vtol": 0}, "a fixed wing"),
        ({"vehicle_type": 3}, "a rover or boat"),
        ({"vehicle_type": 3, "system_type": 10}, "a rover"),
        ({"vehicle_type": 3, "system_type": 11}, "a boat"),
        ({"vehicle_type": 0, "system_type": 12}, "a submarine"),
        ({"vehicle_type": 4}, "an airship"),
        ({"vehicle_type": 1, "system_type": 4}, "a helicopter"),
        ({"is_rotary_wing": 0, "system_type": 1}, "a fixed wing"),
        ({"is_rotary_wing": 0}, "no rotary wing"),
        ({"is_rotary_wing": 0, "is_vtol": 1}, "a VTOL in forward flight throughout"),
        ({"vehicle_type": 2, "is_vtol": 1, "system_type": 22}, "a VTOL in forward flight throughout"),
        ({"vehicle_type": 1, "is_vtol": 1, "in_transition_mode": 1}, "a VTOL in forward flight throughout"),
        ({"system_type": 21}, "a VTOL, and vehicle_status does not tell when it hovered"),
    ],
)
def test_px4_status_tells_vehicles_that_are_not_multirotors(tmp_path, flight, status, name):
    path = px4(tmp_path, flight, **status)
    with pytest.raises(TuningError, match=f"not a multirotor: {name} .vehicle_status"):
        read_log(path)
    assert inspect_log(path).reason.startswith(f"not a multirotor: {name}")


@pytest.mark.parametrize(
    "status",
    [
        {"vehicle_type": 1},
        {"vehicle_type": 1, "system_type": 2, "is_vtol": 0, "in_transition_mode": 0},
        {"vehicle_type": 0, "system_type": 0},
        {"is_rotary_wing": 1, "system_type": 13},
        {"vehicle_type": 1, "system_type": 14},
    ],
)
def test_multirotor_logs_of_every_release_are_read_completely(tmp_path, flight, status):
    log = read_log(px4(tmp_path, flight, **status))
    assert log.seconds == pytest.approx(20)
    assert log.warnings == ()


def test_the_parameter_is_used_when_no_status_is_logged(tmp_path, flight):
    with pytest.raises(TuningError, match=r"not a multirotor: a rover \(parameter MAV_TYPE is 10\)"):
        read_log(px4(tmp_path, flight, {"MAV_TYPE": 10}))
    assert read_log(px4(tmp_path, flight, {"MAV_TYPE": 2})).warnings == ()
    assert read_log(px4(tmp_path, flight, {"MAV_TYPE": 1}, vehicle_type=1)).warnings == ()


@pytest.mark.parametrize(
    "status",
    [
        {"vehicle_type": [1] * 12 + [2] * 8},
        {"vehicle_type": [1] * 12 + [2] * 8, "is_vtol": 1},
        {"vehicle_type": 1, "is_vtol": 1, "in_transition_mode": [0] * 12 + [1] * 8},
        {"is_rotary_wing": [1] * 12 + [0] * 8, "is_vtol": 1},
        {"is_rotary_wing": [1] * 14 + [0] * 6, "system_type": 20, "in_transition_mode": [0] * 12 + [1] * 8},
    ],
)
def test_only_the_hover_of_a_vtol_is_used_with_a_warning(tmp_path, flight, status):
    log = read_log(px4(tmp_path, flight, **status))
    assert log.seconds == pytest.approx(12, abs=0.01)
    assert log.u == pytest.approx(flight.u[: len(log.u)], abs=1e-6)
    assert log.warnings == ("a VTOL: only the time in hover is used",)


def ardupilot(path, flight, text, modes=(), **parameters):
    names = [name.encode() for name in parameters]
    messages = [
        ("MSG", "QZ", ("TimeUS", "Message"), [[0], [text.encode()]]),
        *ardupilot_messages(flight),
    ]
    if names:
        messages.append(
            ("PARM", "QNf", ("TimeUS", "Name", "Value"), [np.zeros(len(names)), names, list(parameters.values())])
        )
    if modes:
        times, numbers = zip(*modes, strict=True)
        messages.append(("MODE", "QB", ("TimeUS", "ModeNum"), [microseconds(times), list(numbers)]))
    (path / "x.bin").write_bytes(dataflash_bytes(messages))
    return path / "x.bin"


@pytest.mark.parametrize(
    ("text", "parameters", "name"),
    [
        ("ArduPlane V4.5.7 (abc)", {}, "a fixed wing"),
        ("APM:Plane v3.8.0", {}, "a fixed wing"),
        ("ArduRover V4.2.3 (abc)", {}, "a rover"),
        ("APM:Rover v2.42", {}, "a rover"),
        ("ArduRover V4.5.0", {"FRAME_CLASS": 2}, "a boat"),
        ("ArduSub V4.1.0", {}, "a submarine"),
        ("Blimp V4.6.0-dev (abc)", {}, "a blimp"),
        ("AntennaTracker V1.2.0", {}, "an antenna tracker"),
        ("ArduCopter V4.5.7 (abc)", {"FRAME_CLASS": 6}, "a helicopter"),
        ("ArduCopter V4.5.7 (abc)", {"FRAME_CLASS": 11}, "a helicopter"),
        ("Frame: HELI", {}, "a helicopter"),
        ("ArduPlane V4.5.7 (abc)", {"Q_ENABLE": 1}, "a VTOL that never hovered"),
    ],
)
def test_ardupilot_firmware_and_frame_tell_vehicles_that_are_not_multirotors(tmp_path, flight, text, parameters, name):
    path = ardupilot(tmp_path, flight, text, modes=[(10, 10)], **parameters)
    with pytest.raises(TuningError, match=rf"not a multirotor: {name} \("):
        read_log(path)


@pytest.mark.parametrize("text", ["ArduCopter V4.5.7 (abc)", "APM:Copter V3.4-rc2 (f46a31d0)", "SubCopter X", ""])
def test_copters_and_unknown_firmware_are_read(tmp_path, flight, text):
    assert read_log(ardupilot(tmp_path, flight, text, FRAME_CLASS=1)).seconds == pytest.approx(20)


def test_only_the_q_modes_of_a_quadplane_are_used(tmp_path, flight):
    path = ardupilot(tmp_path, flight, "ArduPlane V4.6.0", [(10, 17), (15, 19), (22, 10)], Q_ENABLE=1)
    log = read_log(path)
    assert log.seconds == pytest.approx(12, abs=0.01)
    assert "VTOL" in log.warnings[0]
