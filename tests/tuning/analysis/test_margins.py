"""Margins of loops with known closed-form margins, and against python-control."""

import control
import numpy as np
import pytest

from mimopilot.tuning.analysis.closed_loop import CascadeLoop
from mimopilot.tuning.analysis.margins import (
    axis_loops,
    disk_margin,
    gain_margin,
    gain_margins,
    peak,
    phase_margin,
    sensitivity,
    simultaneous_margins,
)

OMEGA = np.geomspace(1e-2, 1e2, 8000)
S = 1j * OMEGA
#: Tolerance of crossings interpolated on this grid of 0.12 % steps.
EXACT = 1e-4


def diagonal(*loops):
    """Loops of uncoupled axes, (K, 2, 2)."""
    matrix = np.zeros((len(OMEGA), len(loops), len(loops)), complex)
    for i, loop in enumerate(loops):
        matrix[:, i, i] = loop
    return matrix


def sensitivity_of(L):
    empty = np.zeros_like(L)
    return sensitivity(CascadeLoop(empty, L, empty, empty))


def test_an_integrator_has_90_degrees_and_infinite_gain_margin():
    loop = 2 / S
    sensitivities = sensitivity_of(diagonal(loop, loop))
    assert peak(sensitivities) == pytest.approx(1.0, abs=1e-3)
    assert disk_margin(sensitivities) == pytest.approx(2.0, abs=1e-6)
    phase, late = phase_margin(loop, OMEGA)
    assert phase == pytest.approx(90.0, rel=EXACT)
    assert late == pytest.approx(np.pi / 2 / 2 * 1e3, rel=EXACT)
    assert gain_margin(loop) == np.inf


@pytest.mark.parametrize("T", [0.3, 1.0])
def test_a_delay_reduces_phase_and_delay_margin(T):
    loop = np.exp(-S * T) / S
    phase, late = phase_margin(loop, OMEGA)
    assert phase == pytest.approx(90 - np.degrees(T), rel=EXACT)
    assert late == pytest.approx((np.pi / 2 - T) * 1e3, rel=EXACT)
    assert gain_margin(loop) == pytest.approx(20 * np.log10(np.pi / 2 / T), rel=EXACT)


def test_three_lags_have_their_textbook_gain_margin():
    """1 / (s (s + 1)^2) crosses the real axis at -1/2; 1 / (s + 1)^3 at -1/8."""
    assert gain_margin(1 / (S * (S + 1) ** 2)) == pytest.approx(20 * np.log10(2), rel=EXACT)
    assert gain_margin(1 / (S + 1) ** 3) == pytest.approx(20 * np.log10(8), rel=EXACT)


def test_a_conditionally_stable_loop_has_the_margin_of_a_lower_gain():
    """(s + 1)^2 / s^3 is stable above a gain of 1/2, without an upper bound."""
    assert gain_margin((S + 1) ** 2 / S**3) == pytest.approx(20 * np.log10(2), rel=EXACT)


def test_a_leading_loop_has_a_delay_margin_of_270_degrees():
    """s crosses 1 at +90 degrees: the phase margin is 90 degrees, the delay margin 270 degrees."""
    phase, late = phase_margin(S, OMEGA)
    assert phase == pytest.approx(90.0, rel=EXACT)
    assert late == pytest.approx(1.5 * np.pi * 1e3, rel=EXACT)


def test_the_smallest_delay_may_be_at_another_crossing_than_the_smallest_phase():
    """A crossing at 1 rad/s with 30 degrees; a resonance at 30 rad/s with more phase, but less delay margin."""
    resonance = 0.02 * S / (S**2 + 2 * 0.005 * 30 * S + 900) * 30
    loop = np.exp(-S * np.pi / 3) / S + resonance * np.exp(S * np.pi / 6)
    found = phase_margin(loop, OMEGA)
    data = control.frd(loop, OMEGA)
    _, phases, _, _, at, _ = control.stability_margins(data, returnall=True)
    assert len(at) == 3
    assert found[0] == pytest.approx(np.abs((phases + 180) % 360 - 180).min(), rel=1e-3)
    assert found[1] == pytest.approx((np.radians(phases % 360) / at).min() * 1e3, rel=1e-3)
    assert np.argmin((phases % 360) / at) != np.argmin(np.abs((phases + 180) % 360 - 180))


@pytest.mark.parametrize("seed", range(6))
def test_a_single_loop_has_the_margins_of_python_control(seed):
    rng = np.random.default_rng(seed)
    poles, gain = rng.uniform(0.5, 8, 3), rng.uniform(0.5, 1.5)
    system = control.tf([gain * poles.prod()], np.poly([0, *-poles]))
    loop = system(S)
    gm, pm, sm, _, crossing, _ = control.stability_margins(system)
    sensitivities = sensitivity_of(diagonal(loop, loop))
    assert gain_margin(loop) == pytest.approx(20 * np.log10(gm), rel=1e-3)
    assert phase_margin(loop, OMEGA) == pytest.approx((pm, np.radians(pm) / crossing * 1e3), rel=1e-3)
    assert peak(sensitivities) == pytest.approx(1 / sm, rel=1e-3)
    disk, gain_db, phase = control.disk_margins(system, OMEGA, skew=0.0)
    assert disk_margin(sensitivities) == pytest.approx(disk, rel=1e-6)
    assert simultaneous_margins(disk_margin(sensitivities)) == pytest.approx((gain_db, phase), rel=1e-6)


def test_a_disk_margin_of_one_is_a_factor_of_three_and_53_degrees():
    assert simultaneous_margins(1.0) == pytest.approx((20 * np.log10(3), 2 * np.degrees(np.arctan(0.5))))
    assert simultaneous_margins(2.0) == (np.inf, 90.0)


def coupled():
    """A strongly coupled loop of two axes with different gains."""
    return np.array([[6.0, 2.5], [-1.5, 4.0]]) / (S * (0.1 * S + 1) ** 2)[:, None, None]


def test_factors_beyond_the_disk_margin_can_destabilise_and_those_within_cannot():
    L = coupled()
    sensitivities = sensitivity_of(L)
    radius = disk_margin(sensitivities)
    worst = int(np.argmax(np.linalg.norm(sensitivities - np.eye(2) / 2, ord=2, axis=(1, 2))))
    U, _, V = np.linalg.svd(sensitivities[worst] - np.eye(2) / 2)

    def distance(size, at, direction):
        """|det(I + L F)| with the factors F = (I + D/2) (I - D/2)^-1, |D| = size."""
        D = size * direction
        F = (np.eye(2) + D / 2) @ np.linalg.inv(np.eye(2) - D / 2)
        return abs(np.linalg.det(np.eye(2) + L[at] @ F))

    # The sign is that of I + L F = (I + L) (I + (I - 2 S) D / 2) (I - D/2)^-1.
    direction = np.outer(V[0].conj(), U[:, 0].conj())
    assert distance(radius, worst, direction) < 1e-9
    assert distance(0.9 * radius, worst, direction) > 0.01
    rng = np.random.default_rng(0)
    for at in range(0, len(OMEGA), 400):
        X = rng.standard_normal((2, 2)) + 1j * rng.standard_normal((2, 2))
        assert distance(0.9 * radius, at, X / np.linalg.norm(X, ord=2)) > 0.01


def test_the_loop_of_an_axis_has_the_other_axis_closed():
    L = coupled()
    roll, pitch = axis_loops(sensitivity_of(L))
    assert roll == pytest.approx(L[:, 0, 0] - L[:, 0, 1] * L[:, 1, 0] / (1 + L[:, 1, 1]), rel=1e-9)
    assert pitch == pytest.approx(L[:, 1, 1] - L[:, 1, 0] * L[:, 0, 1] / (1 + L[:, 0, 0]), rel=1e-9)


def test_the_peak_is_the_largest_singular_value():
    """Not that of a single axis: of this matrix it is 1 + sqrt(2)."""
    L = np.broadcast_to(np.linalg.inv([[1.0, 2.0], [0.0, 1.0]]) - np.eye(2), (5, 2, 2)).astype(complex)
    assert peak(sensitivity_of(L)) == pytest.approx(1 + np.sqrt(2))


@pytest.mark.parametrize(
    ("above", "expected"),
    [
        (0.05, [(20 * np.log10(2), "exact"), (20 * np.log10(8), "exact")]),
        (0.25, [(20 * np.log10(2), "exact"), (20 * np.log10(4), "at least")]),
        (0.8, [(20 * np.log10(1.25), "at least")] * 2),
        (1.0, [(0.0, "not known")] * 2),
        (7.0, [(0.0, "not known")] * 2),
        (0.0, [(20 * np.log10(2), "exact"), (20 * np.log10(8), "exact")]),
    ],
)
def test_no_gain_margin_is_claimed_beyond_the_bound_above_the_band(above, expected):
    loops = np.stack([1 / (S * (S + 1) ** 2), 1 / (S + 1) ** 3])
    found = gain_margins(loops, above)
    for axis, (margin, kind) in zip(("roll", "pitch"), expected, strict=True):
        assert found["gain_margin_db"][axis] == pytest.approx(margin, rel=EXACT)
        assert found["gain_margin"][axis] == kind
