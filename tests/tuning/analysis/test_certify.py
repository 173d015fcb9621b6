"""The certificate against the exact closed loop of simulated airframes, for random gain sets."""

import dataclasses

import numpy as np
import pytest

from mimopilot.common.errors import InputFileError
from mimopilot.sitl.physics.airframe import Frame, load_airframe
from mimopilot.tuning.analysis.beyond_band import find_structural_mode
from mimopilot.tuning.analysis.certify import certify
from mimopilot.tuning.certificate import Thresholds, Verdict
from mimopilot.tuning.design.cascade import certify_from_log, tune
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.law_filters import Filters
from mimopilot.tuning.plant.frequency_response import PlantResponse
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.spec import load_spec
from tests.tuning.analysis.loops import MODELS, exact, random_set
from tests.tuning.truth import TS, Truth, experiment

#: Amplitude of the excitation; ANT-R hovers at 14 % of its thrust and is not linear for a larger one.
PLANTS = {"adam0": 0.15, "adam0_perturbed": 0.15, "adam0_boom": 0.15, "antr": 0.05, "px4_sih": 0.15}


@pytest.fixture(scope="module")
def flights():
    found = {}
    for name, amplitude in PLANTS.items():
        log = experiment(name, amplitude=amplitude)
        found[name] = (log, PlantEstimates(log), Truth.of(load_airframe(name).airframe))
    return found


def test_the_measured_response_is_that_of_the_plant(flights):
    for _, measured, truth in flights.values():
        plant = measured.response
        band = (plant.omega > 4) & (plant.omega < 60)
        true = exact(truth.plant, plant.omega)
        for got, wanted in ((plant.G_i, true.G_i), (plant.G_o, true.G_o)):
            error = np.linalg.norm(got - wanted, axis=(1, 2)) / np.linalg.norm(wanted, axis=(1, 2))
            assert np.median(error[band]) < 0.03
        # The estimated error is the true one where noise dominates.
        noisy = plant.known() & (plant.omega > 60)
        error = np.linalg.norm(plant.G_i - true.G_i, axis=(1, 2)) / np.linalg.norm(plant.deviation(), axis=(1, 2))
        assert 0.4 < np.sqrt(np.mean(error[noisy] ** 2)) < 1.6


def judged(measured, truth, count, rng):
    """Verdicts on sets that have good margins in the true loop, and on unstable ones."""
    bases = (measured.experiment.flown, tune(measured.experiment))
    good, unstable = [], []
    while len(good) < count or len(unstable) < count:
        gains = random_set(bases[rng.integers(2)], rng)
        if truth.spectral_radius(gains) >= 1:
            kind = unstable
        else:
            Ms, phase = truth.margins(gains, 500)
            kind = good if Ms < 1.6 and phase >= 43 else None
        if kind is not None and len(kind) < count:
            kind.append(certify(gains, measured.response, *MODELS, model=lambda: measured.model).verdict)
    return good, unstable


def test_no_unstable_set_passes_and_nearly_all_good_ones_are_certified(flights):
    rng = np.random.default_rng(7)
    good, unstable = [], []
    for _, measured, truth in flights.values():
        one, other = judged(measured, truth, 12, rng)
        good, unstable = good + one, unstable + other
    assert not {Verdict.CERTIFIED, Verdict.THIN} & set(unstable)
    assert unstable.count(Verdict.UNSTABLE) >= 0.9 * len(unstable)
    assert good.count(Verdict.CERTIFIED) >= 0.95 * len(good)


@pytest.fixture(scope="module", params=[(25.0, 0.4), (25.0, 0.8), (12.0, 0.4)], ids=str)
def flexible(request):
    frequency, gain = request.param
    frame = Frame(frequency_hz=frequency, damping=0.02, gain=gain)
    airframe = load_airframe("adam0").airframe.model_copy(update={"frame": frame})
    return frequency, PlantEstimates(experiment("adam0", airframe=airframe)), Truth.of(airframe)


def test_a_structural_mode_is_detected_and_sets_that_it_destabilises_are_not_certified(flexible):
    frequency, measured, truth = flexible
    omega = 2 * np.pi * frequency
    near = np.abs(measured.response.omega / omega - 1) < 0.05
    true = exact(truth.plant, measured.response.omega[near]).G_i
    error = np.linalg.norm(measured.response.G_i[near] - true, axis=(1, 2)) / np.linalg.norm(true, axis=(1, 2))
    assert np.median(error) < 0.25
    rng, base, named = np.random.default_rng(1), load_airframe("adam0").default_gains(), 0
    for _ in range(40):
        gains = random_set(base, rng)
        found = certify(gains, measured.response, *MODELS, model=lambda: measured.model)
        if truth.spectral_radius(gains) >= 1:
            assert found.verdict in (Verdict.UNSTABLE, Verdict.NOT_CERTIFIED)
        elif truth.margins(gains, 500)[0] > 2.6:
            assert found.verdict not in (Verdict.CERTIFIED, Verdict.THIN)
        again = find_structural_mode(gains, measured.response)
        named += again is not None and abs(again[0] / omega - 1) < 0.05
    assert named >= 10


def test_noise_is_not_taken_for_a_structural_mode(flights):
    _, measured, _ = flights["adam0"]
    assert find_structural_mode(load_airframe("adam0").default_gains(), measured.response) is None


@pytest.mark.parametrize("name", ["y_i", "y_o"])
def test_a_log_with_roll_in_the_pitch_column_is_refused(flights, name):
    log = flights["adam0"][0]
    twice = dataclasses.replace(log, **{name: np.repeat(getattr(log, name)[:, :1], 2, axis=1)})
    with pytest.raises(TuningError, match="are the same signal"):
        certify_from_log(twice, log.flown)


def test_interpolation_between_frequencies_follows_a_rigid_body(flights):
    """Exact for a body with damping, and close for a vehicle with motors."""
    omega = np.arange(1.3, 100.0, 1.3)
    K = np.array([[80.0, -8.0], [-7.0, 90.0]])
    empty = np.zeros((len(omega), 6, 6)), np.zeros((len(omega), 2, 2))
    s = 1j * omega[:, None, None]
    body = PlantResponse(omega, K / (s + 1.5), K / (s + 1.5) / s, *empty, np.ones((len(omega), 2)), TS).interpolated(
        0.05
    )
    s = 1j * body.omega[:, None, None]
    assert body.G_i == pytest.approx(K / (s + 1.5), rel=1e-12)
    assert body.G_o == pytest.approx(K / (s + 1.5) / s, rel=1e-12)
    assert np.max(body.omega[1:] / body.omega[:-1]) < 1.05 + 1e-9
    assert set(omega) <= set(body.omega)
    plant = flights["adam0"][2].plant
    between = exact(plant, omega).interpolated(0.05)
    true = exact(plant, between.omega).G_i
    error = np.linalg.norm(between.G_i - true, axis=(1, 2)) / np.linalg.norm(true, axis=(1, 2))
    assert error.max() < 0.02


def test_margins_are_those_of_the_exact_loop(flights):
    """Ms and phase margin, within their errors and the motors' square law."""
    for log, measured, truth in flights.values():
        for gains in (log.flown, tune(log)):
            figures = certify(gains, measured.response, *MODELS).figures
            Ms, phase = truth.margins(gains)
            assert figures["Ms"] == pytest.approx(Ms, rel=0.06)
            assert min(figures["phase_margin_deg"].values()) == pytest.approx(phase, abs=4)


def test_the_errors_of_peak_and_phase_margin_are_their_spread_over_logs():
    truth = Truth.of(load_airframe("px4_sih").airframe)
    gains = load_airframe("px4_sih").default_gains()
    found = [certify(gains, PlantEstimates(experiment("px4_sih", seed=s)).response, *MODELS).figures for s in range(12)]
    phases = [(f["phase_margin_deg"]["pitch"], f["phase_margin_error_deg"]["pitch"]) for f in found]
    peaks = [(f["Ms"], f["Ms_error"]) for f in found]
    for pairs, true in ((peaks, truth.margins(gains)[0]), (phases, np.mean([phase for phase, _ in phases]))):
        values, errors = np.array(pairs).T
        spread = np.sqrt(np.mean((values - true) ** 2))
        # Two standard errors: with 12 logs their estimate is good to a factor of two.
        assert 0.5 * spread < np.mean(errors) < 5 * spread


def test_each_verdict_is_given_with_its_reason(flights):
    _, measured, truth = flights["adam0"]
    plant = measured.response
    base = load_airframe("adam0").default_gains()
    assert certify(base, plant, *MODELS).verdict == Verdict.CERTIFIED
    reversed_axis = base.with_elements({"RP_PP": -0.15})
    assert truth.spectral_radius(reversed_axis) > 1
    found = certify(reversed_axis, plant, *MODELS)
    assert (found.verdict, "rate loop" in found.reason) == (Verdict.UNSTABLE, True)
    thinner = (1.75, Verdict.THIN, "is above 1.8"), (2.6, Verdict.NOT_CERTIFIED, "the margin is too thin")
    for factor, verdict, text in thinner:
        outer = base.with_elements({"AP_RR": 6.5 * factor, "AP_PP": 6.5 * factor})
        assert truth.spectral_radius(outer) < 1
        found = certify(outer, plant, *MODELS)
        assert found.verdict == verdict
        assert text in found.reason
    narrow = plant.at(plant.omega < 12)
    found = certify(base, narrow, *MODELS)
    assert found.verdict == Verdict.NOT_CERTIFIED
    assert "excitation ends at" in found.reason
    diverging = base.with_elements({"RI_RP": 0.3, "RI_PR": -0.05})
    assert "Ki_i through the measured plant" in certify(diverging, plant, *MODELS).reason
    late = plant.at(plant.omega > 14)
    assert "excitation begins at 14.7" in certify(outer, late, *MODELS).reason


def test_a_controller_without_an_integral_can_be_certified(flights):
    for _, measured, truth in flights.values():
        gains = dataclasses.replace(measured.experiment.flown, Ki_i=np.zeros((2, 2)))
        assert truth.spectral_radius(gains) == pytest.approx(1.0)  # the unused integrals stay constant
        assert certify(gains, measured.response, *MODELS).verdict in (Verdict.CERTIFIED, Verdict.THIN)
        one = dataclasses.replace(gains, Ki_i=np.diag([0.05, 0.0]))
        assert certify(one, measured.response, *MODELS).verdict != Verdict.UNSTABLE
        bad = dataclasses.replace(gains, Kp_i=gains.Kp_i * np.array([[1.0], [-1.0]]))
        assert certify(bad, measured.response, *MODELS).verdict not in (Verdict.CERTIFIED, Verdict.THIN)
        assert certify(bad, measured.response, *MODELS, model=lambda m=measured: m.model).verdict == Verdict.UNSTABLE


def test_thresholds_can_be_set_are_stored_and_are_sealed(flights):
    log, measured, _ = flights["adam0"]
    gains = log.flown
    strict = certify_from_log(log, gains, load_spec(certificate={"Ms": 1.2, "phase_deg": 60.0}))
    assert strict.verdict()[0] == Verdict.THIN
    assert strict.certificate.thresholds["Ms"] == 1.2
    loose = Thresholds(thin_Ms=9.0, thin_phase_deg=5.0)
    outer = gains.with_elements({"AP_RR": 16.0, "AP_PP": 16.0})
    assert certify(outer, measured.response, *MODELS).verdict == Verdict.NOT_CERTIFIED
    assert certify(outer, measured.response, *MODELS, thresholds=loose).verdict == Verdict.THIN
    with pytest.raises(InputFileError, match="thin_Ms must be at least Ms"):
        load_spec(certificate={"Ms": 3.0})
    edited = dataclasses.replace(strict.certificate, thresholds={**strict.certificate.thresholds, "Ms": 1.8})
    assert dataclasses.replace(strict, certificate=edited).verdict()[0] == "void"


def test_the_identified_model_decides_only_if_the_response_leaves_the_verdict_open(flights):
    _, measured, _ = flights["adam0"]
    base = measured.experiment.flown
    response, model = measured.response, measured.model
    late, thin = response.at(response.omega > 14), base.with_elements({"AP_RR": 17.0, "AP_PP": 17.0})
    assert certify(thin, late, *MODELS).verdict == Verdict.NOT_CERTIFIED
    assert certify(thin, late, *MODELS, model=lambda: model).verdict == Verdict.NOT_CERTIFIED
    growing = dataclasses.replace(model, B=-model.B)
    assert certify(thin, late, *MODELS, model=lambda: growing).verdict == Verdict.UNSTABLE
    assert certify(base, response, *MODELS, model=lambda: growing).verdict == Verdict.CERTIFIED


@pytest.mark.parametrize(
    "edit",
    [
        lambda g: dataclasses.replace(g, Kp_o=g.Kp_o * 1.0001),
        lambda g: dataclasses.replace(g, filters=dataclasses.replace(g.filters, Ts=0.0041)),
        lambda g: dataclasses.replace(g, filters=Filters(g.Ts, 31.0)),
        lambda g: dataclasses.replace(g, moment_scale=(2.5, 2.5, 0.3)),
        lambda g: dataclasses.replace(g, limits=dataclasses.replace(g.limits, moment_max=(0.9, 1.0, 1.0))),
        lambda g: dataclasses.replace(g, yaw=dataclasses.replace(g.yaw, Kp_i=0.51)),
        *(
            lambda g, name=name, value=value: dataclasses.replace(
                g, certificate=dataclasses.replace(g.certificate, **{name: value})
            )
            for name, value in (
                ("verdict", Verdict.THIN),
                ("reason", "none"),
                ("band", (0.1, 700.0)),
                ("log_sha256", "0"),
                ("figures", {}),
            )
        ),
        lambda g: dataclasses.replace(g, certificate=dataclasses.replace(g.certificate, seal="")),
    ],
)
def test_any_edit_voids_the_certificate(flights, tmp_path, edit):
    from mimopilot.tuning.gains_file import load_gains

    log = flights["adam0"][0]
    examined = certify_from_log(log, log.flown)
    examined.save(tmp_path / "x.gains.toml")
    loaded = load_gains(tmp_path / "x.gains.toml")
    assert loaded.verdict()[0] == Verdict.CERTIFIED
    edit(loaded).save(tmp_path / "y.gains.toml")
    assert load_gains(tmp_path / "y.gains.toml").verdict()[0] == "void"


def test_a_log_with_another_unit_of_torque_is_refused(flights):
    log = flights["adam0"][0]
    other_unit = dataclasses.replace(log.flown, moment_scale=(25.0, 25.0, 2.7))
    with pytest.raises(TuningError, match=r"u = 1 stands for 2\.546, 2\.546 N m .* not for 25, 25; convert"):
        certify_from_log(log, other_unit)
    assert dataclasses.replace(log.flown, certificate=None).verdict()[0] == "none"


def test_the_loop_becomes_unstable_beyond_its_margins(flights):
    _, measured, _ = flights["adam0"]
    airframe = load_airframe("adam0").airframe
    gains = measured.experiment.flown.with_elements({"RP_RR": 0.5, "RP_PP": 0.5, "AP_RR": 4.0, "AP_PP": 4.0})
    figures = certify(gains, measured.response, *MODELS).figures
    # Both axes are delayed: the margin of each is with the other one on time.
    late = min(figures["delay_margin_ms"].values()) / 1e3 / TS
    assert Truth.of(airframe, int(0.8 * late)).spectral_radius(gains) < 1
    assert Truth.of(airframe, int(1.25 * late) + 1).spectral_radius(gains) > 1
    # The gain margin is a lower bound: the true one may be larger.
    assert set(figures["gain_margin"].values()) <= {"exact", "at least"}
    margin = 10 ** (figures["gain_margin_db"]["roll"] / 20)
    assert margin > 1.5
    truth = Truth.of(airframe)
    for factor in (0.95 * margin, 1 / margin):
        codes = [f"{code}_R{axis}" for code in ("RP", "RI", "RD") for axis in "RP"]
        assert truth.spectral_radius(gains.with_elements({c: gains.elements()[c] * factor for c in codes})) < 1
    if figures["gain_margin"]["roll"] == "exact":
        beyond = {c: gains.elements()[c] * 1.1 * margin for c in codes}
        assert truth.spectral_radius(gains.with_elements(beyond)) > 1
