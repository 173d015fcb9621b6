"""The certificate against plants whose closed loop is known exactly."""

import dataclasses

import numpy as np
import pytest
from scipy.linalg import expm

from sitl.airframe import load_airframe
from sitl.autopilot import Autopilot
from sitl.loop import fly
from sitl.scenario import excitation_flight
from tuning.cascade import certify_from_log, tune
from tuning.certificate import CERTIFIED, DENSE, NOT_CERTIFIED, THIN, UNSTABLE, certify, loop_above
from tuning.closed_loop import PlantResponse, cascade_loop, plant_response
from tuning.errors import TuningError
from tuning.experiment import Experiment
from tuning.reference import second_order

TS = 0.004
MODELS = ((second_order(20, 0.4, 0, TS),) * 2, (second_order(10, 0.7, 0, TS),) * 2)
#: Amplitude of the excitation: ANT-R hovers at 14 % of its thrust, where a larger one is no longer linear.
PLANTS = {"adam0": 0.15, "antr": 0.05, "adam0_perturbed": 0.15}


class Linear:
    """Rates, angles and motors of an airframe about hover, sampled: the truth, which no method here uses."""

    def __init__(self, airframe):
        plant = airframe.plant()
        inverse = plant.inertia_inverse[:2, :2]
        tau = airframe.motors.time_constant
        A = np.zeros((6, 6))
        A[:2, :2] = -inverse @ np.diag(plant.rate_damping[:2])
        A[:2, 4:] = inverse @ np.diag(airframe.moment_scale()[:2])
        A[2:4, :2] = np.eye(2)
        A[4:, 4:] = -np.eye(2) / tau
        M = np.zeros((8, 8))
        M[:6, :6], M[4:6, 6:] = A * TS, np.eye(2) / tau * TS
        sampled = expm(M)
        self.A, self.B = sampled[:6, :6], sampled[:6, 6:]

    def spectral_radius(self, g, late_roll=0):
        """Of the closed loop with one period of computing delay, and more on roll, written out state by state."""
        a, n = g.derivative_pole, 14 + late_roll
        names = ("y", "angle", "motor", "u", "I", "d", "last")
        take = {name: np.eye(n)[2 * i : 2 * i + 2] for i, name in enumerate(names)}
        e = -g.Kp_o @ take["angle"] - take["y"]
        integral = take["I"] + g.Ts * g.Ki_i @ e
        d = a * take["d"] + (1 - a) / g.Ts * (take["y"] - take["last"])
        u = g.Kp_i @ e + integral - g.Kd_i @ d - g.Kff_i @ g.Kp_o @ take["angle"]
        F = np.zeros((n, n))
        F[:6, :6], F[:6, 6:8] = self.A, self.B
        F[6:8], F[8:10], F[10:12], F[12:14] = u, integral, d, take["y"]
        if late_roll:  # a chain between the controller's roll output and the state that acts
            F[6] = np.eye(n)[14]
            F[14:] = [*np.eye(n)[15:].tolist(), u[0].tolist()]
        return float(np.abs(np.linalg.eigvals(F)).max())

    def response(self, omega):
        z = np.exp(1j * omega * TS)[:, None, None]
        G = np.linalg.solve(z * np.eye(6) - self.A, np.broadcast_to(self.B, (len(omega), 6, 2))) / z
        empty = np.zeros((len(omega), 6, 6)), np.zeros((len(omega), 2, 2))
        return PlantResponse(omega, G[:, :2], G[:, 2:4], *empty, np.ones((len(omega), 2)), TS)

    def peak(self, gains):
        loop = cascade_loop(gains, self.response(np.linspace(0.5, 780, 2000)))
        return float(np.linalg.norm(np.linalg.inv(np.eye(2) + loop.L_u), ord=2, axis=(1, 2)).max())


def experiment(name, seed=0):
    vehicle = load_airframe(name)
    gains = vehicle.default_gains()
    scenario = excitation_flight(20.0, PLANTS[name], 50.0, TS, np.random.default_rng(seed))
    record = fly(vehicle.airframe, Autopilot(vehicle.airframe, gains), scenario, seed).record
    u, y_i, y_o, u_bar = (record[field][:, :2].astype(float) for field in ("moment", "rates", "attitude", "excitation"))
    return Experiment(Ts=TS, u=u, y_i=y_i, y_o=y_o, u_bar=u_bar, flown=gains, source=name)


@pytest.fixture(scope="module")
def flights():
    found = {}
    for name in PLANTS:
        log = experiment(name)
        found[name] = (log, plant_response(log, log.u_bar, 300.0), Linear(load_airframe(name).airframe))
    return found


def test_the_measured_response_is_that_of_the_plant(flights):
    for _, plant, linear in flights.values():
        band = (plant.omega > 4) & (plant.omega < 30)
        exact = linear.response(plant.omega)
        for measured, true in ((plant.G_i, exact.G_i), (plant.G_o, exact.G_o)):
            error = np.linalg.norm(measured - true, axis=(1, 2)) / np.linalg.norm(true, axis=(1, 2))
            assert np.median(error[band]) < 0.03


def random_sets(base, rng, linear, count):
    """Gain sets of all kinds; half of them unstable by the true model."""
    stable, unstable = [], []
    while len(stable) < count or len(unstable) < count:
        scale = {code: np.exp(rng.uniform(-1.5, 2.2)) for code in ("RP", "RI")} | {"RD": 1.0}
        changes = {}
        for code, value in base.elements().items():
            if code[:2] not in ("AP", "RP", "RI", "RD") or code.endswith("Y"):
                continue
            diagonal = base.elements()[code[:4] + code[3]]
            if code[3] == code[4]:
                loop = np.exp(rng.uniform(-1.5, 1.2)) if code[:2] == "AP" else scale[code[:2]]
                changes[code] = float(value * loop * np.exp(0.5 * rng.normal()))
            else:
                changes[code] = float(value + 0.2 * diagonal * rng.normal())
        gains = base.with_elements(changes)
        kind = stable if linear.spectral_radius(gains) < 1 else unstable
        if len(kind) < count:
            kind.append(gains)
    return stable, unstable


def test_no_unstable_set_is_certified_and_most_well_damped_ones_are(flights):
    rng = np.random.default_rng(1)
    wrong = good = certified = total = 0
    for name, (log, plant, linear) in flights.items():
        tuned = tune(log)
        for base in (load_airframe(name).default_gains(), tuned):
            stable, unstable = random_sets(base, rng, linear, 24)
            total += len(stable) + len(unstable)
            wrong += sum(certify(g, plant, *MODELS).verdict in (CERTIFIED, THIN) for g in unstable)
            damped = [g for g in stable if linear.peak(g) < 2]
            good += len(damped)
            certified += sum(certify(g, plant, *MODELS).verdict == CERTIFIED for g in damped)
    assert total >= 200
    assert wrong == 0
    assert good >= 15
    assert certified >= 0.8 * good


def test_a_loop_whose_peak_lies_between_two_frequencies_is_not_certified(flights):
    """Found by the random sets above: it oscillates for ever, and no frequency of the response is near to tell."""
    _, plant, linear = flights["adam0"]
    gains = dataclasses.replace(
        load_airframe("adam0").default_gains(),
        Kp_o=np.array([[3.60637712, 0.5622347], [-0.21474633, 2.40205198]]),
        Kp_i=np.array([[0.04127214, 0.01336016], [-0.00997128, 0.0399068]]),
        Ki_i=np.array([[0.42462993, 0.01774655], [-0.0068396, 0.37196562]]),
        Kd_i=np.array([[0.00359859, -0.00103487], [-0.00096178, 0.00885978]]),
    )
    assert linear.spectral_radius(gains) > 1
    coarse = np.linalg.inv(np.eye(2) + cascade_loop(gains, plant).L_u)
    fine = np.linalg.inv(np.eye(2) + cascade_loop(gains, plant.interpolated(DENSE)).L_u)
    seen, there = (np.linalg.norm(S, ord=2, axis=(1, 2)).max() for S in (coarse, fine))
    assert there > 1.5 * seen
    assert certify(gains, plant, *MODELS).verdict not in (CERTIFIED, THIN)


def test_a_loop_that_is_unstable_below_the_excitation_is_not_certified(flights):
    """Found by random sets, too: with little gain it oscillates at 0.75 rad/s, where the experiment says nothing."""
    _, plant, linear = flights["adam0_perturbed"]
    gains = dataclasses.replace(
        load_airframe("adam0_perturbed").default_gains(),
        Kp_o=np.array([[3.9007844, -0.984454], [0.2805008, 2.474772]]),
        Kp_i=np.array([[0.01589068, 0.003974913], [0.01549479, 0.02283862]]),
        Ki_i=np.array([[0.006566379, 0.02338456], [-0.006409221, 0.01000748]]),
        Kd_i=np.array([[0.002297327, 9.970663e-05], [0.0004827753, 0.00801818]]),
    )
    assert linear.spectral_radius(gains) > 1.0005
    certificate = certify(gains, plant, *MODELS)
    assert certificate.verdict == NOT_CERTIFIED
    assert "excitation begins at 1.3 rad/s, where the sensitivity is still" in certificate.reason


@pytest.mark.parametrize("name", ["y_i", "y_o"])
def test_a_log_with_roll_in_place_of_pitch_is_refused(flights, name):
    log = flights["adam0"][0]
    twice = dataclasses.replace(log, **{name: np.repeat(getattr(log, name)[:, :1], 2, axis=1)})
    with pytest.raises(TuningError, match="are one signal"):
        certify_from_log(twice, log.flown)


def test_the_response_between_its_frequencies_is_that_of_a_body(flights):
    """Exact for a body with damping, and near for a vehicle with motors."""
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
    linear = flights["adam0"][2]
    between = linear.response(omega).interpolated(0.05)
    true = linear.response(between.omega).G_i
    error = np.linalg.norm(between.G_i - true, axis=(1, 2)) / np.linalg.norm(true, axis=(1, 2))
    assert error.max() < 0.02


def test_what_the_loop_reaches_above_the_band_is_less_moved_by_noise(flights):
    """w |G| does not rise: the fit by such a sequence is nearer to the truth than the last value alone."""
    linear, gains = flights["adam0"][2], load_airframe("adam0").default_gains()
    plant, rng = linear.response(np.linspace(2.0, 110.0, 50)), np.random.default_rng(3)
    true = loop_above(gains, plant)[-1]
    fitted, last = [], []
    for _ in range(100):
        shape = (50, 2, 2)
        noise = (rng.normal(size=shape) + 1j * rng.normal(size=shape)) * 0.1
        noisy = dataclasses.replace(plant, G_i=plant.G_i + noise * np.abs(plant.G_i).max(axis=(1, 2), keepdims=True))
        fitted.append(loop_above(gains, noisy)[-1] / true - 1)
        last.append(loop_above(gains, noisy.at([-1]))[-1] / true - 1)
    assert np.std(fitted) < 0.8 * np.std(last)
    assert abs(np.mean(fitted)) < abs(np.mean(last))


def test_the_peak_of_the_sensitivity_is_the_true_one(flights):
    for name, (log, plant, linear) in flights.items():
        for gains in (load_airframe(name).default_gains(), tune(log)):
            figures = certify(gains, plant, *MODELS).figures
            # The motors' thrust is the square of their speed: a hovering model is right to a few percent.
            assert figures["Ms"] == pytest.approx(linear.peak(gains), rel=0.08)


def test_each_verdict_is_given_with_its_reason(flights):
    _, plant, linear = flights["adam0"]
    base = load_airframe("adam0").default_gains()
    assert certify(base, plant, *MODELS).verdict == CERTIFIED
    reversed_axis = base.with_elements({"RP_PP": -0.15})
    assert linear.spectral_radius(reversed_axis) > 1
    found = certify(reversed_axis, plant, *MODELS)
    assert (found.verdict, "rate loop" in found.reason) == (UNSTABLE, True)
    fast_outer = base.with_elements({"AP_RR": 14.0, "AP_PP": 14.0})
    assert linear.spectral_radius(fast_outer) < 1
    found = certify(fast_outer, plant, *MODELS)
    assert found.verdict == THIN
    assert "Ms" in found.reason
    noisy = base.with_elements({"RD_RR": 0.05, "RD_PP": 0.05})
    assert certify(noisy, plant, *MODELS).verdict in (NOT_CERTIFIED, UNSTABLE)
    narrow = plant.at(plant.omega < 12)
    found = certify(base, narrow, *MODELS)
    assert found.verdict == NOT_CERTIFIED
    assert "excitation ends at" in found.reason


def test_an_edited_matrix_voids_the_certificate(flights, tmp_path):
    from tuning.gains import load_gains

    tuned = tune(flights["adam0"][0])
    tuned.save(tmp_path / "x.gains.toml")
    assert load_gains(tmp_path / "x.gains.toml").verdict() == tuned.verdict()
    assert tuned.verdict()[0] in (CERTIFIED, THIN)
    edited = dataclasses.replace(tuned, Kp_o=tuned.Kp_o * 1.0001)
    assert edited.verdict()[0] == "void"
    other_unit = dataclasses.replace(tuned, moment_scale=(25.0, 25.0, 2.7))
    assert other_unit.verdict()[0] == "void"
    with pytest.raises(TuningError, match=r"stands for 2\.546, 2\.546 N m .* in the gains for 25, 25"):
        certify_from_log(flights["adam0"][0], other_unit)
    assert dataclasses.replace(tuned, certificate=None).verdict()[0] == "none"


def test_margins_are_where_the_loop_becomes_unstable(flights):
    _, plant, linear = flights["adam0"]
    gains = (
        load_airframe("adam0").default_gains().with_elements({"RP_RR": 0.5, "RP_PP": 0.5, "AP_RR": 4.0, "AP_PP": 4.0})
    )
    figures = certify(gains, plant, *MODELS).figures
    late = figures["delay_margin_ms"]["roll"] / 1e3 / TS
    assert linear.spectral_radius(gains, late_roll=int(0.85 * late)) < 1
    assert linear.spectral_radius(gains, late_roll=int(1.15 * late) + 1) > 1
    # The gain margin is one that can be vouched for: the truth may be larger.
    margin = 10 ** (figures["gain_margin_db"]["roll"] / 20)
    assert margin > 1.5
    for factor in (margin, 1 / margin):
        codes = [f"{code}_R{axis}" for code in ("RP", "RI", "RD") for axis in "RP"]
        assert linear.spectral_radius(gains.with_elements({c: gains.elements()[c] * factor for c in codes})) < 1
