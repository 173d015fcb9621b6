"""The command `autotune`, against `mimopilot sitl`."""

import json
import subprocess

import pytest

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.field.autotune_run import AutotuneOptions
from mimopilot.sitl.field.workflow import autotune
from mimopilot.sitl.mavlink.ground_station.profiles import make_plan
from mimopilot.tuning.gains_file import load_gains
from tests.conftest import assert_one_clear_line
from tests.sitl.mavlink.running import PATIENCE_S, QUICK, Pilot, running_sitl


def test_one_command_tunes_a_simulated_vehicle(tmp_path):
    # Three times real time: setpoints older than 0.5 s of the vehicle's time are too old.
    with running_sitl("--speed", "3", "--log", tmp_path / "flight.ulg") as sitl:
        words = ("autotune", "--connect", f"tcp:127.0.0.1:{sitl.tcp}", "--out", "tuned", "--take-off", 2, "--yes")
        line = [*QUICK, *map(str, (*words, "--seconds-per-axis", 6, "--json"))]
        done = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, timeout=3 * PATIENCE_S)
        assert done.returncode == 0, done.stderr
        found = json.loads(done.stdout)
        assert (found["result"], found["new_values_may_be_on_the_vehicle"]) == ("kept", False)
        assert found["steps"]["checks"]["simulated"]
        pilot = Pilot(f"udpin:127.0.0.1:{sitl.udp}")
        assert not pilot.armed()
        for name, value in make_plan(load_gains(tmp_path / "tuned" / "new.gains.toml")).values.items():
            pilot.link.mav.param_request_read_send(1, 1, name.encode(), -1)
            answer = pilot.asks("PARAM_VALUE")
            assert (answer.param_id, answer.param_value) == (name, value)
        pilot.close()


def test_without_a_terminal_the_command_asks_for_yes(mimopilot):
    done = mimopilot("autotune", "--connect", "tcp:127.0.0.1:1", "--out", "tuned")
    assert_one_clear_line(done, "no terminal to ask", "--yes")
    done = mimopilot("autotune", "--connect", "tcp:127.0.0.1:1", "--out", "tuned", "--yes", "--profile", "betaflight")
    assert_one_clear_line(done, "--profile: got 'betaflight'", "px4-stock")


@pytest.mark.parametrize(
    ("profile", "words"),
    [
        (
            "ardupilot-custom",
            ("ardupilot-custom: our custom controller's experiment is started by hand", "CC3_EX_AX to 5"),
        ),
        (
            "ardupilot-stock",
            ("--take-off: not with --profile ardupilot-stock", "only from Stabilize", "take off by hand"),
        ),
    ],
)
def test_what_only_a_pilot_can_fly_is_refused_before_a_link_is_opened(profile, words, tmp_path):
    options = AutotuneOptions("no link", tmp_path / "out", profile=profile, take_off=3.0)
    with pytest.raises(SitlError) as refused:
        autotune(options, dialogue=None)
    for word in words:
        assert word in str(refused.value)
    assert not (tmp_path / "out").exists()
