"""What couples yaw with roll and pitch: its size, and the loop with it, against the exact loop of a linear vehicle."""

import numpy as np
import pytest

from mimopilot.tuning.analysis.certify import certify
from mimopilot.tuning.analysis.certify_axes import certify_axes
from mimopilot.tuning.analysis.cross_terms import MATTERS, examine_cross_terms
from mimopilot.tuning.axes import law_of
from mimopilot.tuning.certificate import Thresholds, Verdict
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.reference_model import second_order
from tests.tuning.three_axes import TS, Vehicle, calm, coupled, faster_yaw

OMEGA = np.geomspace(1.0, 250.0, 40)
INNER, OUTER = second_order(20.0, 0.7, 0, TS), second_order(5.0, 0.7, 0, TS)
#: Yaw moves roll and roll moves yaw, each twice as much as its own axis, with opposite signs. The loop is stable with
#: the slow yaw gains that fly, and unstable with faster ones that are stable on the axis alone.
STRONG = (2.0, -2.0)
#: Matters, but leaves the loop stable.
MODEST = (0.6, -0.5)
BLOCKS = (slice(0, 2), slice(2, 3))


def examined(vehicle, gains, unit=1.0):
    """From a response without error; the unit of the yaw torque as in `PlantEstimates.yaw_unit`."""
    plant = Vehicle(vehicle.B * [1.0, 1.0, unit]).exact(OMEGA)
    return examine_cross_terms(law_of(gains, 3, unit), plant, [INNER] * 3)


def certificate(measured, gains):
    return certify_axes(gains, measured, [INNER] * 2, [OUTER] * 2, Thresholds())


def test_without_coupling_the_cross_terms_do_not_matter():
    found = examined(coupled(0.0, 0.0), calm())
    assert found.effect == pytest.approx(0.0, abs=1e-12)
    assert (found.measured, found.verdict, found.figures) == (False, Verdict.CERTIFIED, None)


def test_the_sensitivity_of_all_three_axes_is_exact():
    vehicle, gains, unit = coupled(*MODEST), faster_yaw(calm(), 2.0), 16.0
    found = examined(vehicle, gains, unit)
    assert found.effect > MATTERS
    assert found.figures["Ms"] == pytest.approx(vehicle.peak(gains), rel=0.01)
    assert found.figures["Ms"] > max(vehicle.peak(gains, axes) for axes in BLOCKS)
    assert set(found.figures["phase_margin_deg"]) == {"roll", "pitch", "yaw"}
    assert found.share == pytest.approx(0.6)
    assert (found.source, found.target) == ("yaw", "roll")


def test_a_combination_of_stable_blocks_that_is_unstable_is_caught():
    vehicle, gains = coupled(*STRONG), faster_yaw(calm(), 4.0)
    assert vehicle.spectral_radius(gains) > 1.01
    for axes in BLOCKS:
        assert vehicle.spectral_radius(gains, axes) < 1
        n = axes.stop - axes.start
        block = certify(law_of(gains, n), vehicle.exact(OMEGA, axes), [INNER] * n, [OUTER] * n)
        assert block.verdict == Verdict.CERTIFIED, block.reason
    found = examined(vehicle, gains)
    assert found.verdict == Verdict.UNSTABLE
    assert "make the loop unstable, though each block is stable" in found.reason


def test_a_log_shows_that_the_combination_is_unstable():
    measured = PlantEstimates(coupled(*STRONG).fly(calm(), seconds=16.0)[0])
    assert certificate(measured, faster_yaw(calm(), 4.0)).verdict == Verdict.UNSTABLE
    assert certificate(measured, calm()).verdict != Verdict.UNSTABLE


def test_a_log_shows_the_cross_terms_and_the_margin_with_them():
    vehicle, gains = coupled(*MODEST), calm()
    found = certificate(PlantEstimates(vehicle.fly(gains, seconds=16.0)[0]), gains).figures
    cross = found["cross_terms"]
    assert cross["measured"] and cross["matters"]
    share = {("yaw", "roll"): 0.6, ("roll", "yaw"): 0.5}[cross["from"], cross["to"]]
    assert cross["share"] == pytest.approx(share, abs=cross["share_error"])
    assert found["Ms"] == pytest.approx(vehicle.peak(gains), abs=found["Ms_error"] + 0.02)


def test_the_verdict_on_random_couplings_is_that_of_the_exact_loop():
    generator, verdicts = np.random.default_rng(3), []
    for _ in range(4):
        to_roll, to_yaw = generator.uniform(-3.0, 3.0, 2)
        vehicle, gains = coupled(to_roll, to_yaw), faster_yaw(calm(), generator.uniform(1.0, 6.0))
        unstable = vehicle.spectral_radius(gains) > 1
        found = examined(vehicle, gains)
        assert (found.verdict != Verdict.CERTIFIED) == unstable, (to_roll, to_yaw, gains.yaw)
        verdicts.append(unstable)
    assert set(verdicts) == {True, False}
