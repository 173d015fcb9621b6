"""ArduPilot logs of flights with our custom controller, written by the test byte by byte."""

import numpy as np
import pytest

from mimopilot.tuning.logs.reader import open_log, read_log
from mimopilot.tuning.parameters import PARAMETERS, ardupilot_name
from tests.tuning.logs.flights import ardupilot_messages, dataflash_bytes, make_flight, microseconds, pulses

FIELDS = ("TimeUS", "Ph", "RR", "RP", "RY", "UR", "UP", "UY", "XR", "XP", "XY")
#: Our controller takes over 4 s after the start of the log, and hands back 2 s before its end.
BEGIN, END = 14.0, 28.0
#: Of the main controller, whose shaping makes our setpoints, too.
MAIN = {"ATC_RAT_RLL_P": 0.135, "ATC_INPUT_TC": 0.15, "ATC_RATE_FF_ENAB": 1.0}


def inject(t):
    return pulses(t, begin=BEGIN + 0.5, end=END - 0.5)


@pytest.fixture(scope="module")
def flight():
    return make_flight(20.0, inject=inject)


def custom_messages(flight, rates_setpoint):
    """Message MIMO while our controller flies, RATE with the rate setpoint of the idle main one, and its parameters."""
    ours = (flight.t >= BEGIN) & (flight.t < END)
    time, zeros = microseconds(flight.t[ours]), np.zeros(ours.sum())
    excitation = inject(flight.t)[ours]
    columns = [time, zeros.astype(np.int8), *rates_setpoint[ours].T, zeros]
    columns += [*flight.u[ours].T, zeros, *excitation.T, zeros]
    return ("MIMO", "Qbfffffffff", FIELDS, columns)


def parameters(gains):
    values = {ardupilot_name(p.name): gains.elements()[p.code] for p in PARAMETERS} | MAIN
    names = [name.encode() for name in values]
    return ("PARM", "QNf", ("TimeUS", "Name", "Value"), [np.zeros(len(names)), names, list(values.values())])


def test_the_injected_torque_the_rate_setpoint_and_the_gains_are_those_of_our_controller(tmp_path, flight, gains):
    setpoint = 0.3 * np.sin(flight.t)[:, np.newaxis] * [1.0, -2.0]
    (name, kinds, fields, columns), angles = ardupilot_messages(flight)
    idle = [np.full(len(flight.t), 9.0)] * 2  # deg/s
    rate = (name, f"{kinds}ff", (*fields, "RDes", "PDes"), [*columns, *idle])
    path = tmp_path / "x.bin"
    path.write_bytes(dataflash_bytes([rate, angles, custom_messages(flight, setpoint), parameters(gains)]))
    recording = open_log(path)
    ours = (flight.t >= BEGIN) & (flight.t < END)
    torque, rates = recording.signals["u_bar"], recording.signals["r_i"]
    assert torque.values == pytest.approx(inject(flight.t), abs=1e-7)
    assert rates.values[ours] == pytest.approx(setpoint[ours], abs=1e-6)
    assert rates.values[~ours] == pytest.approx(np.radians(9.0), abs=1e-6)
    assert any("our custom controller flew" in note for note in recording.notes)
    log = read_log(path)
    assert log.flown.Kp_i == pytest.approx(gains.Kp_i, rel=1e-6)
    assert log.flown.filters.shaping == (0.15, 0.15, 0.15)
    assert np.abs(log.u_bar).max(axis=0) == pytest.approx([0.1, 0.1])


def test_without_our_message_the_flown_gains_are_the_main_controllers(tmp_path, flight, gains):
    path = tmp_path / "x.bin"
    path.write_bytes(dataflash_bytes([*ardupilot_messages(flight), parameters(gains)]))
    recording = open_log(path)
    assert "u_bar" not in recording.signals
    assert not any(name.startswith("MIMO_") for name in recording.parameters)


def test_system_identification_in_the_same_log_is_the_main_controllers(tmp_path, flight, gains):
    """It adds nothing to the torque of a custom controller."""
    name, kinds, fields, columns = custom_messages(flight, np.zeros((len(flight.t), 2)))
    columns[-3:] = [np.zeros(len(columns[0]))] * 3
    stamps = np.arange(BEGIN - 3.0, BEGIN - 1.0, 0.0025)
    identification = [
        ("SIDD", "Qf", ("TimeUS", "Targ"), [microseconds(stamps), np.full(len(stamps), 0.1)]),
        ("SIDS", "QB", ("TimeUS", "Ax"), [microseconds(stamps[:1]), [10]]),
    ]
    path = tmp_path / "x.bin"
    ours = (name, kinds, fields, columns)
    path.write_bytes(dataflash_bytes([*ardupilot_messages(flight), ours, *identification, parameters(gains)]))
    recording = open_log(path)
    assert recording.signals["u_bar"].values.max() == pytest.approx(0.1)
    assert not any(name.startswith("MIMO_") for name in recording.parameters)
    assert any("the main controller's, and so are the flown gains" in note for note in recording.notes)
