"""Rows and remarks on the predicted figures of a design."""

from dataclasses import replace

import pytest

from mimopilot.tuning.design.prediction import Prediction, reasons_to_keep
from mimopilot.tuning.design.prediction_rows import softer
from mimopilot.tuning.spec import DesignLimits


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
    assert texts == ([f"a step of torque moves it farther ({told}, at Ms 3.28)"] if told else [])
    assert softer({"tuned": [{"disturbance_deg": after}]}) == []


@pytest.mark.parametrize(("Ms", "kept"), [(1.5, True), (1.7, False)])
@pytest.mark.parametrize("disturbance", [(3.0,), (0.3, 0.5)])
def test_flown_gains_with_margins_are_kept_if_they_give_way_less_to_a_torque(Ms, kept, disturbance):
    """Whose margins are too thin is no measure: the design must give away stiffness to have more."""
    none = (0.0,) * len(disturbance)
    flown = Prediction(tuple(2.0 for _ in none), none, disturbance, none, none, Ms)
    noise = tuple(1e-3 for _ in none)
    flown = replace(flown, noise=noise, fast_noise=noise)
    new = replace(flown, follow_deg=tuple(1.0 for _ in none), Ms=1.5)
    assert reasons_to_keep([new], [flown], DesignLimits(), 1.0) == []
    new = replace(new, disturbance_deg=(*disturbance[:-1], 1.2 * disturbance[-1]))
    reasons = reasons_to_keep([new], [flown], DesignLimits(), 1.0)
    axis = "yaw" if len(disturbance) == 1 else "pitch"
    expected = f"a step of torque moves it farther ({axis} {1.2 * disturbance[-1]:.2f} degrees, flown"
    assert len(reasons) == kept and all(reason.startswith(expected) for reason in reasons)
