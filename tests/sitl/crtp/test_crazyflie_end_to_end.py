"""A simulated Crazyflie at 500 Hz: experiment, gains, flight; and what the manual says of its log."""

import json
import re

from mimopilot.codegen.render import render
from mimopilot.tuning.crazyflie_names import LOG_VARIABLES
from mimopilot.tuning.gains_file import load_gains
from tests.codegen.crazyflie_host import crazyflie_gains
from tests.docs.blocks import BLOCKS
from tests.paths import DOCS

#: Most variables of one event on the uSD deck (MAX_USD_LOG_VARIABLES_PER_EVENT).
MOST_VARIABLES = 20


def test_a_crazyflie_is_tuned_at_500_hz(mimopilot, tmp_path):
    flown = mimopilot("experiment", "cf2", "--axis", "both", "--seconds-per-axis", "10", "--out", "cf2.ulg")
    assert flown.returncode == 0, flown.stderr
    tuned = mimopilot("tune", "cf2.ulg", "--out", "cf2.gains.toml", "--json")
    assert tuned.returncode == 0, tuned.stderr
    found = load_gains(tmp_path / "cf2.gains.toml")
    assert found.Ts == 0.002
    assert found.verdict()[0].value == "certified"
    errors = {}
    for name, gains in (("flown", ()), ("tuned", ("--gains", "cf2.gains.toml"))):
        shown = mimopilot("fly", "cf2", *gains, "--json")
        assert shown.returncode == 0, shown.stderr
        errors[name] = json.loads(shown.stdout)
    assert errors["tuned"]["crashed_at_s"] is None
    assert errors["tuned"]["J_M_o"] < errors["flown"]["J_M_o"]


def test_the_manuals_configuration_logs_variables_that_there_are():
    (block,) = (one for one in BLOCKS if one.page == DOCS / "crazyflie.md" and "fixedFrequency" in one.text)
    variables = re.findall(r"^(\w+\.\w+)$", block.text, re.MULTILINE)
    ours = {f"mimo.{variable.name}" for variable in LOG_VARIABLES}
    assert set(variables) <= ours | {"supervisor.info"}
    assert len(variables) <= MOST_VARIABLES
    emitted = render(crazyflie_gains(), "crazyflie")["crazyflie/README.md"]
    assert f"```\n{block.text.strip()}\n```" in emitted
