"""A full reference model, extra poles, and a frequency weight in the criterion (3.1)."""

import numpy as np
import pytest

from mimopilot.sitl.studies.benchmarks import excitation, lv100, numerical_example
from mimopilot.tuning.design.refine_on_model import refine_on_model
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.estimation.vrft import vrft
from mimopilot.tuning.law_filters import Filters
from mimopilot.tuning.loop_controller import LoopController, complementary_sensitivity
from mimopilot.tuning.reference_matrix import ReferenceMatrix, wanted_response
from mimopilot.tuning.reference_model import ReferenceModel, SecondOrder, SecondOrderAndPoles, model_from_table

OMEGA = np.linspace(0.05, 3.1, 40)


def model(num, den, delay=0):
    return ReferenceModel(tuple(num), tuple(den), delay, 1.0)


def reached_by(A):
    """The closed loop that the PI (B0 z - 0.9048 B0)/(z - 1), B0 = K^-1 A, gives G = K/(z - 0.9048).

    G C = A/(z - 1), so T = (z I - I + A)^-1 A, by hand for two axes.
    """
    (a, b), (c, d) = A
    den = [1.0, -(2 - a - d), (1 - a) * (1 - d) - b * c]
    # adj(z I - I + A) A
    rows = [
        [[a, -a * (1 - d) - b * c], [b, -b * (1 - d) - b * d]],
        [[c, -c * (1 - a) - c * a], [d, -d * (1 - a) - b * c]],
    ]
    return ReferenceMatrix(tuple(tuple(model(num, den) if any(num) else None for num in row) for row in rows))


def noise_free(task, samples=2000):
    u = excitation(samples, "together", np.random.default_rng(0))
    return task.run(None, np.zeros_like(u), u, np.random.default_rng(0))


@pytest.mark.parametrize("A", [[[0.1, 0.03], [0.0, 0.1]], [[0.1, 0.03], [-0.02, 0.12]]])
def test_a_full_model_that_a_pi_reaches_is_recovered_exactly(A):
    task, A = numerical_example(), np.array(A)
    wanted = reached_by(A)
    B0 = np.linalg.inv(task.plant.B) @ A
    exact = LoopController.from_polynomial(B0, -0.9048 * B0, 1.0)
    T = complementary_sensitivity(task.plant.frequency_response(OMEGA), exact, OMEGA)
    assert wanted.frequency_response(OMEGA) == pytest.approx(T, abs=1e-12)
    u, y = noise_free(task)
    found = LoopController(vrft(u, y, u, wanted, "PI", weight="identity").gains, Filters(1.0))
    for got, known in zip(found.polynomial(), (B0, -0.9048 * B0), strict=True):
        assert got == pytest.approx(known, rel=1e-6, abs=1e-7)
    assert task.cost(found, wanted) < 1e-12
    # The diagonal part alone is another request, with another answer.
    diagonal = [row[i] for i, row in enumerate(wanted.elements)]
    other = LoopController(vrft(u, y, u, diagonal, "PI", weight="identity").gains, Filters(1.0))
    assert task.cost(other, wanted) > 1e-3


def test_a_diagonal_matrix_gives_what_the_list_of_models_gives():
    task = numerical_example()
    u, y = noise_free(task)
    models = [model([0.1], [1, -0.9]), model([0.2], [1, -0.8])]
    matrix = ReferenceMatrix(((models[0], None), (None, models[1])))
    assert wanted_response(models, OMEGA) == pytest.approx(matrix.frequency_response(OMEGA), abs=1e-15)
    found = [vrft(u, y, u, wanted, "PI", weight="identity").gains for wanted in (models, matrix)]
    # theory: the scalar filter gives the truth [[0.761, -1.217], [0.475, 3.042]] for the proportional part.
    for gains in found:
        assert gains["P"] == pytest.approx(np.array([[0.761, -1.217], [0.475, 3.042]]), abs=1e-3)


def test_determinant_and_adjugate_are_those_of_the_frequency_response():
    generator = np.random.default_rng(3)
    rows = tuple(
        tuple(model(generator.normal(size=2), [1, -0.5, 0.1 * (i + j)], delay=i) for j in range(3)) for i in range(3)
    )
    matrix = ReferenceMatrix(rows)
    M = matrix.frequency_response(OMEGA)
    assert matrix.determinant.frequency_response(OMEGA) == pytest.approx(np.linalg.det(M), rel=1e-9)
    adjugate = np.array([[m.frequency_response(OMEGA) for m in row] for row in matrix.adjugate]).transpose(2, 0, 1)
    assert adjugate @ M == pytest.approx(np.linalg.det(M)[:, None, None] * np.eye(3), abs=1e-9)
    step = np.ones((5, 3))
    by_hand = np.column_stack([sum(m.response(step[:, j]) for j, m in enumerate(row)) for row in matrix.adjugate])
    assert matrix.adjugate_response(step) == pytest.approx(by_hand)


def test_an_impossible_matrix_is_refused():
    m = model([0.1], [1, -0.9])
    with pytest.raises(TuningError, match="determinant is zero"):
        ReferenceMatrix(((m, m), (m, m)))
    with pytest.raises(TuningError, match="expected a square matrix"):
        ReferenceMatrix(((m, m),))


WEIGHTS = {
    "low": model([0.1], [1, -0.9]),
    "very low": model([0.01], [1, -0.99]),
    "high": model([0.5, -0.5], [1, 0.0]),
}


@pytest.mark.parametrize("weight", WEIGHTS)
def test_a_weight_of_the_criterion_favours_its_frequencies(weight):
    """A P controller cannot reach M of the numerical example: the weight decides where the loop is near M."""
    task, emphasis = numerical_example(), WEIGHTS[weight]
    u, y = noise_free(task, 20_000)

    def tuned(emphasis):
        gains = vrft(u, y, u, task.models, "P", weight="identity", emphasis=emphasis).gains
        return LoopController(gains, Filters(1.0))

    plain, weighted = tuned(None), tuned(emphasis)
    assert task.cost(weighted, emphasis=emphasis) < 0.9 * task.cost(plain, emphasis=emphasis)
    assert task.cost(plain) < task.cost(weighted)


def test_the_weighted_criterion_and_its_minimum_on_a_known_plant():
    """LV100: with a weight the minimum of (3.1) is elsewhere, and it is the minimum."""
    task, low = lv100(), ReferenceModel((0.1,), (1.0, -0.9), 0, 0.1)
    printed = task.printed["table_5_1"]["VRFT"]
    start = LoopController.from_polynomial(printed["B0"], printed["B1"], 0.1)
    plain, weighted = (refine_on_model(start, task.plant, task.models, W).controller for W in (None, low))
    assert task.cost(weighted, emphasis=low) < 0.9 * task.cost(plain, emphasis=low)
    assert task.cost(plain) == pytest.approx(0.0515, abs=1e-4)
    assert task.cost(weighted) > task.cost(plain)
    # By hand at four thousand frequencies.
    omega = (np.arange(4000) + 0.5) * np.pi / 0.1 / 4000
    T = complementary_sensitivity(task.plant.frequency_response(omega), plain, omega)
    z = np.exp(1j * omega * 0.1)
    error = np.abs(0.1 / (z - 0.9))[:, None, None] * (0.4 / (z - 0.6))[:, None, None] * np.eye(2)
    error = error - np.abs(0.1 / (z - 0.9))[:, None, None] * T
    assert task.cost(plain, emphasis=low) == pytest.approx(np.mean(np.sum(np.abs(error) ** 2, axis=(1, 2))))
    # A constant weight changes the scale of the criterion, not its minimum.
    double = ReferenceModel((2.0,), (1.0,), 0, 0.1)
    assert task.cost(plain, emphasis=double) == pytest.approx(4 * task.cost(plain))


def test_further_poles_of_a_reference_model():
    Ts = 0.004
    with_pole = SecondOrderAndPoles(20.0, 0.4, (60.0,), 1)
    found, plain = with_pole.discretise(Ts), SecondOrder(20.0, 0.4, 1).discretise(Ts)
    assert len(found.den) == 4
    assert np.roots(found.den).real.min() == pytest.approx(np.exp(-60 * Ts), abs=1e-9)
    assert found.response(np.ones(4000))[-1] == pytest.approx(1.0, abs=1e-9)
    # Far below Nyquist the zero-order hold adds half a period of delay, to both alike.
    omega = np.array([5.0, 20.0])
    ratio = found.frequency_response(omega) / plain.frequency_response(omega)
    assert ratio == pytest.approx(60 / (1j * omega + 60), rel=1e-3)
    assert with_pole.bandwidth == 20.0
    assert SecondOrderAndPoles(20.0, 0.4, (6.0, 60.0)).bandwidth == 6.0
    assert model_from_table(with_pole.as_table(), "here") == with_pole
    with pytest.raises(TuningError, match="poles: got"):
        SecondOrderAndPoles(20.0, 0.4, (-1.0,))
    with pytest.raises(TuningError, match="here: got"):
        model_from_table({"type": "second_order_and_poles", "omega": 20, "zeta": 0.4, "poles": ["x"]}, "here")
