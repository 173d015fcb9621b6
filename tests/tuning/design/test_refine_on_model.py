"""One loop refined on an identified plant."""

import numpy as np
import pytest

from mimopilot.tuning.design.refine_on_model import frequency_grid, refine_on_model
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.law_filters import Filters
from mimopilot.tuning.loop_controller import LoopController, closed_loop, complementary_sensitivity
from mimopilot.tuning.reference_model import ReferenceModel
from mimopilot.tuning.statespace import StateSpace

TS = 0.004
PLANT = StateSpace(np.array([[0.9]]), np.array([[1.0]]), np.array([[0.5]]), np.zeros((1, 1)), TS)


def test_refinement_finds_the_pid_controller_that_reaches_the_model_exactly():
    # P, I and D on 0.5/(z - 0.9) without derivative filter: the closed loop in polynomials is the model.
    kp, ki, kd = 0.2, 4.0, 0.0004
    c, d = (kp + TS * ki, -kp), kd / TS
    num = 0.5 * np.array([c[0], c[1], 0.0])
    den = np.polymul(np.polymul([1, -0.9], [1, -1]), [1, 0]) + np.r_[0.0, num] + np.r_[0.0, 0.5 * d * np.poly([1, 1])]
    model = ReferenceModel(tuple(num), tuple(den), 0, TS)
    start = LoopController({t: np.array([[v]]) for t, v in (("P", 0.1), ("I", 2.0), ("D", 0.0001))}, Filters(TS))
    found = refine_on_model(start, PLANT, [model])
    assert found.after < 1e-12 < found.before
    assert found.controller.matrix == pytest.approx(np.array([[kp, ki, kd]]), rel=1e-5)


def test_the_loop_in_state_space_has_the_frequency_response_of_the_formula():
    controller = LoopController(
        {t: np.array([[v]]) for t, v in zip("PIDF", (0.2, 4.0, 0.0004, 0.05), strict=True)}, Filters(TS, 30.0)
    )
    omega = frequency_grid(TS, 50)
    T = closed_loop(PLANT, controller).frequency_response(omega)[:, 1:, :1]
    formula = complementary_sensitivity(PLANT.frequency_response(omega), controller, omega)
    assert np.allclose(T, formula, rtol=1e-9, atol=0)


def test_refinement_from_unstable_gains_is_refused():
    wild = LoopController({"P": np.array([[10.0]])}, Filters(TS))
    with pytest.raises(TuningError, match="not stable"):
        refine_on_model(wild, PLANT, [ReferenceModel((0.1,), (1.0, -0.9), 0, TS)])
