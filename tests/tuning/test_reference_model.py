import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains import gains_to_toml
from mimopilot.tuning.gains_file import gains_from_toml
from mimopilot.tuning.provenance import Provenance
from mimopilot.tuning.reference_model import CONTINUOUS_MODELS, ReferenceModel, followed_model, second_order
from mimopilot.tuning.spec import load_spec

TS = 1 / 250

#: omega (rad/s), damping, delay (samples), numerator and denominator as printed in the thesis.
PRINTED = [
    (20, 0.4, 0, ("0.003131", "0.003065"), ("-1.932", "0.9380")),
    (10, 0.7, 0, ("0.0007852", "0.0007706"), ("-1.9440", "0.9455")),
    (15, 0.33, 0, ("0.001776", "0.001753"), ("-1.958", "0.9612")),
    (10, 0.8, 0, ("0.0007831", "0.0007666"), ("-1.936", "0.938")),
    (30, 0.3, 1, ("0.007022", "0.006855"), ("-1.917", "0.9305")),
    (20, 0.8, 1, ("0.003066", "0.002938"), ("-1.874", "0.8799")),
]


@pytest.mark.parametrize(("omega", "zeta", "delay", "num", "den"), PRINTED)
def test_second_order_models_have_the_printed_digits(omega, zeta, delay, num, den):
    model = second_order(omega, zeta, delay, TS)
    assert model.delay == delay
    assert model.den[0] == 1
    for value, text in zip((*model.num, *model.den[1:]), (*num, *den), strict=True):
        # One unit in the last printed digit: the thesis truncates some entries and rounds others.
        decimals = len(text.split(".")[1])
        assert abs(value - float(text)) < 10.0**-decimals


@given(omega=st.floats(1, 100), zeta=st.floats(0.1, 2), delay=st.integers(0, 5))
def test_a_model_has_unit_gain_and_its_delay(omega, zeta, delay):
    model = second_order(omega, zeta, delay, TS)
    assert sum(model.num) / sum(model.den) == pytest.approx(1, rel=1e-5)
    step = model.response(np.ones(20))
    assert (step[: delay + 1] == 0).all()
    assert step[delay + 1] > 0


def test_the_step_response_is_that_of_the_continuous_model():
    omega, zeta = 20.0, 0.4
    t = TS * np.arange(200)
    damped = omega * math.sqrt(1 - zeta**2)
    exact = 1 - np.exp(-zeta * omega * t) * (np.cos(damped * t) + zeta * omega / damped * np.sin(damped * t))
    # Zero-order hold is exact for a step.
    assert second_order(omega, zeta, 0, TS).response(np.ones(200)) == pytest.approx(exact, abs=1e-12)


def test_the_frequency_response_is_the_transform_of_the_impulse_response():
    model = second_order(20, 0.4, 2, TS)
    impulse = model.response(np.eye(1, 4096)[0])
    omega = np.array([1.0, 20.0, 100.0])
    transform = [np.sum(impulse * np.exp(-1j * w * TS * np.arange(4096))) for w in omega]
    assert model.frequency_response(omega) == pytest.approx(np.array(transform), abs=1e-9)


def test_the_transient_is_below_one_percent_after_settling():
    model = second_order(10, 0.7, 3, TS)
    impulse = np.abs(model.response(np.eye(1, 2000)[0]))
    assert impulse[model.settling_samples() + 1 :].max() < 0.011 * impulse.max()
    assert impulse[model.settling_samples() // 2 :].max() > 0.02 * impulse.max()


@pytest.mark.parametrize(
    ("omega", "zeta", "delay"), [(0, 0.4, 0), (20, -1, 0), (20, 0.4, -1), (1e4, 0.4, 0), (math.nan, 1, 0)]
)
def test_an_impossible_model_is_refused(omega, zeta, delay):
    with pytest.raises(TuningError, match="reference model"):
        second_order(omega, zeta, delay, TS)


@dataclasses.dataclass(frozen=True)
class FirstOrder:
    """omega/(s + omega): all that another kind of model needs, beside its row in `CONTINUOUS_MODELS`."""

    type = "first_order"

    omega: float

    @property
    def bandwidth(self):
        return self.omega

    def discretise(self, Ts):
        pole = math.exp(-self.omega * Ts)
        return ReferenceModel((1 - pole,), (1.0, -pole), 0, Ts, label=f"{self.omega:g} rad/s, first order")

    def as_table(self):
        return {"type": self.type, "omega": self.omega}


def test_another_kind_of_model_is_one_class_and_one_row(monkeypatch, gains):
    monkeypatch.setitem(CONTINUOUS_MODELS, FirstOrder.type, FirstOrder)
    first = {"type": "first_order", "omega": 25.0}
    spec = load_spec(inner=[first, [30.0, 0.7]], outer={**first, "omega": 8})
    assert spec.inner[0] == FirstOrder(25.0)
    slow, fast = spec.models("outer", 0.004)[0], spec.models("inner", 0.004)[0]
    assert slow.response(np.ones(2000))[-1] == pytest.approx(1.0, rel=1e-9)
    assert fast.response(np.ones(10))[9] == pytest.approx(1 - math.exp(-25 * 0.036), rel=1e-9)
    tagged = dataclasses.replace(gains, provenance=Provenance(inner_model=spec.inner, outer_model=spec.outer))
    read = gains_from_toml(gains_to_toml(tagged), "file")
    assert read.provenance.inner_model == spec.inner
    assert read.reference_models(0)[1].den == slow.den


def recursion(setpoint, omega, damping, Ts):
    """The flown attitude model, sample by sample: angle, rate and acceleration."""
    angle = rate = 0.0
    found = []
    for r in setpoint:
        acceleration = omega**2 * (r - angle) - 2 * damping * omega * rate
        rate += Ts * acceleration
        angle += Ts * rate
        found.append((angle, rate, acceleration))
    return np.array(found)


@given(omega=st.floats(0.5, 62.5), damping=st.floats(0.1, 2.0), seed=st.integers(0, 100))
def test_the_followed_model_is_the_flown_recursion(omega, damping, seed):
    setpoint = np.random.default_rng(seed).normal(size=200)
    model = followed_model(omega, damping, TS)
    angle = recursion(setpoint, omega, damping, TS)[:, 0]
    assert model.response(setpoint) == pytest.approx(angle, abs=1e-9)
    assert sum(model.num) / sum(model.den) == pytest.approx(1, rel=1e-6)
    # Stable, and no mode alternates from sample to sample.
    poles = np.roots(model.den)
    assert (np.abs(poles) < 1).all()
    assert (poles.real >= 0).all()


def test_the_followed_models_frequency_response_is_that_of_the_recursion():
    w = 2 * np.pi * np.array([1, 2, 5, 20, 60]) / (1000 * TS)
    model = followed_model(12.0, 0.6, TS)
    for omega, expected in zip(w, model.frequency_response(w), strict=True):
        k = np.arange(4000)
        settled = slice(3000, 4000)  # whole periods, after the transient
        angle = recursion(np.cos(omega * TS * k), 12.0, 0.6, TS)[settled, 0]
        assert 2 * np.mean(angle * np.exp(-1j * omega * TS * k[settled])) == pytest.approx(expected, abs=1e-9)


def test_the_followed_model_approaches_the_continuous_one_as_the_period_shrinks():
    """First order in Ts: the error halves with the period."""
    omega, damping = 10.0, 0.7
    w = np.array([1.0, 5.0, 10.0, 30.0])
    s = 1j * w
    exact = omega**2 / (s**2 + 2 * damping * omega * s + omega**2)
    errors = [np.abs(followed_model(omega, damping, Ts).frequency_response(w) - exact) for Ts in (2e-3, 1e-3, 1e-4)]
    assert errors[0] / errors[1] == pytest.approx(2, rel=0.05)
    assert errors[1] / errors[2] == pytest.approx(10, rel=0.05)
    assert errors[2].max() < 2e-3
