"""Rows and remarks on the predicted figures of a design."""

import pytest

from mimopilot.tuning.design.prediction_rows import softer


@pytest.mark.parametrize(
    ("after", "before", "told"),
    [
        ((0.06, 0.08), (0.06, 0.08), ""),
        ((0.066, 0.088), (0.06, 0.08), ""),
        ((0.05, 0.09), (0.06, 0.08), "pitch 0.09 degrees, flown 0.08"),  # both together: 3 % farther
        (3.9, 3.5, "yaw 3.90 degrees, flown 3.50"),
        (3.5, 3.9, ""),
    ],
)
def test_a_set_that_gives_way_more_to_a_torque_on_any_axis_is_told_beside_its_merits(after, before, told):
    texts = softer({"tuned": [{"disturbance_deg": after}], "flown": [{"disturbance_deg": before, "Ms": 3.28}]})
    assert texts == ([f"but a step of torque moves it farther ({told}, at Ms 3.28)"] if told else [])
    assert softer({"tuned": [{"disturbance_deg": after}]}) == []
