"""Rows and remarks on the predicted figures of a design."""

import dataclasses

import pytest

from mimopilot.tuning.design.prediction_rows import softer
from tests.tuning.analysis.loops import defaults


@pytest.mark.parametrize(("after", "told"), [((0.06, 0.08), ""), ((0.066, 0.088), ""), ((0.09, 0.12), "0.15 degrees")])
def test_a_set_that_gives_way_more_to_a_torque_is_told_beside_its_merits(after, told):
    gains = defaults()
    figures = {"tuned": [{"disturbance_deg": after}], "flown": [{"disturbance_deg": (0.06, 0.08), "Ms": 3.28}]}
    provenance = dataclasses.replace(gains.provenance, details={"predicted": figures})
    text = softer(dataclasses.replace(gains, provenance=provenance))
    assert bool(text) == bool(told) and told in text
    if told:
        assert "flown 0.10, at Ms 3.28" in text
