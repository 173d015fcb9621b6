"""The flown parameters are those at the beginning of the part that is used."""

from dataclasses import replace

import numpy as np
import pytest

from mimopilot.tuning.logs.reader import open_log, read_log
from tests.tuning.logs.flights import (
    ardupilot_messages,
    dataflash_bytes,
    injected,
    make_flight,
    microseconds,
    pulses,
    px4_topics,
    write_ulog,
)
from tests.tuning.logs.test_flown_gains import PX4


@pytest.fixture(scope="module")
def flight():
    """20 s that begin at 10 s, with an injected torque from 15 to 25 s."""
    return make_flight(20.0, inject=lambda t: pulses(t, begin=15.0, end=25.0))


def px4(path, flight, changes):
    return write_ulog(path / "x.ulg", px4_topics(flight, debug_vect=injected(flight)), PX4, changes)


def test_a_gain_changed_before_the_excitation_is_the_flown_one(tmp_path, flight):
    log = read_log(px4(tmp_path, flight, [(11.0, "MC_YAWRATE_P", 0.7), (14.0, "MC_YAWRATE_P", 0.4)]))
    assert log.flown.yaw.Kp_i == pytest.approx(0.4)
    assert log.warnings == ()


def test_a_gain_changed_during_the_excitation_gives_a_warning_and_the_old_value_counts(tmp_path, flight):
    log = read_log(px4(tmp_path, flight, [(17.0, "MC_YAWRATE_P", 0.4), (18.0, "MC_ROLL_P", 5.0)]))
    assert log.flown.yaw.Kp_i == pytest.approx(0.2)
    (warning,) = log.warnings
    assert "MC_YAWRATE_P from 0.2 to 0.4 after 2.0 s; MC_ROLL_P from 6.5 to 5 after 3.0 s" in warning


@pytest.mark.parametrize(
    "change", [(27.5, "MC_YAWRATE_P", 0.4), (17.0, "MC_YAWRATE_P", 0.2), (17.0, "MC_AT_START", 1.0), (17.0, "X", 1.0)]
)
def test_changes_afterwards_to_the_same_value_or_outside_the_loop_give_no_warning(tmp_path, flight, change):
    log = read_log(px4(tmp_path, flight, [change]))
    assert log.flown.yaw.Kp_i == pytest.approx(0.2)
    assert log.warnings == ()


def test_repeated_parm_messages_are_changes(tmp_path, flight):
    names = [b"ATC_RAT_YAW_P", b"LOG_BITMASK", b"ATC_RAT_YAW_P", b"STAT_RUNTIME", b"STAT_RUNTIME"]
    times, values = microseconds([9, 9, 15, 9, 16]), [0.2, 1, 0.4, 5, 35]
    parm = ("PARM", "QNf", ("TimeUS", "Name", "Value"), [times, names, values])
    (tmp_path / "x.bin").write_bytes(dataflash_bytes([parm, *ardupilot_messages(flight)]))
    recording = open_log(tmp_path / "x.bin")
    assert recording.parameters["ATC_RAT_YAW_P"] == pytest.approx(0.2)
    assert [change[:2] for change in recording.changes] == [(15, "ATC_RAT_YAW_P"), (16, "STAT_RUNTIME")]
    (warning,) = read_log(tmp_path / "x.bin").warnings
    assert warning.endswith("ATC_RAT_YAW_P from 0.2 to 0.4 after 5.0 s")


def test_commands_report_what_is_wrong_with_a_log(mimopilot, tmp_path, flight):
    still = replace(flight, u=np.column_stack([flight.u[:, 0], np.zeros(len(flight.t))]))
    px4(tmp_path, still, [(17.0, "MC_ROLL_P", 5.0)])
    for command, begin in (("inspect", "warning: x.ulg: parameters changed"), ("advise", "x.ulg: ")):
        result = mimopilot(command, "x.ulg")
        told = [line for line in result.stderr.splitlines() if "MC_ROLL_P from 6.5 to 5" in line]
        assert len(told) == 1, result.stderr
        assert told[0].startswith(f"mimopilot: {begin}")
