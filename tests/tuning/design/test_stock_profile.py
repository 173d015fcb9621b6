"""Gains for the stock controllers: designed within their law, certified in it, and worth less than full matrices."""

import dataclasses

import numpy as np
import pytest

from mimopilot.common.errors import Error
from mimopilot.sitl.mavlink.ground_station.betaflight_lines import betaflight_lines
from mimopilot.sitl.mavlink.ground_station.profiles import make_plan
from mimopilot.tuning.analysis.certify import certify
from mimopilot.tuning.analysis.closed_loop import cascade_loop
from mimopilot.tuning.analysis.manoeuvres import manoeuvres
from mimopilot.tuning.design.advise import advise
from mimopilot.tuning.design.cascade import certify_from_log, tune
from mimopilot.tuning.design.disturbance_limit import ROOM
from mimopilot.tuning.design.free_gains import free_gains
from mimopilot.tuning.design.loop_gradient import LoopGradient
from mimopilot.tuning.design.prediction import predict
from mimopilot.tuning.design.response_design import BANDWIDTHS, ResponseDesign
from mimopilot.tuning.design.stock_profile import in_digits
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.gains_file import load_gains
from mimopilot.tuning.law_filters import Filters, StockFilters
from mimopilot.tuning.plant.plant_estimates import PlantEstimates
from mimopilot.tuning.reference_model import second_order
from mimopilot.tuning.spec import TuningSpec, load_spec
from tests.tuning.analysis.loops import MODELS, airframe, defaults, exact, grid
from tests.tuning.truth import TS, Truth, experiment

VEHICLE = "adam0_boom"
FILTERS = {
    "px4-stock": StockFilters("px4-stock", (30.0,) * 3, torque_hz=(0.0, 0.0, 2.0)),
    "ardupilot-stock": StockFilters("ardupilot-stock", (20.0,) * 3, (20.0,) * 3, (0.0, 0.0, 2.5)),
    "betaflight": StockFilters("betaflight", (75.0,) * 3, derivative2_hz=(150.0,) * 3),
}


def stock_set(controller, gains=None):
    """The vehicle's default gains, or other diagonal ones, in a stock law."""
    gains = gains or defaults(VEHICLE)
    matrices = {name: np.diag(np.diag(matrix)) for name, matrix in gains.matrices.items()}
    return dataclasses.replace(gains, certificate=None, filters=Filters(TS, stock=FILTERS[controller]), **matrices)


@pytest.fixture(scope="module")
def log():
    """A flight on the coupled vehicle, as if PX4's own controllers had flown these gains."""
    found = experiment(VEHICLE)
    details = {"loop_rate_hz": 800.0}
    flown = stock_set("px4-stock")
    origin = dataclasses.replace(flown.provenance, details=details)
    return dataclasses.replace(found, flown=dataclasses.replace(flown, provenance=origin))


@pytest.fixture(scope="module")
def tuned(log):
    return tune(log, load_spec(profile="px4-stock"))


def documented(gains, omega):
    """C_y and C_o of the stock law of both axes, written in z from the autopilots' code."""
    z, Ts, stock = np.exp(1j * omega * gains.Ts), gains.Ts, gains.filters.stock

    def low_pass(hertz):
        a = 1.0 if hertz == 0 else Ts / (Ts + 1 / (2 * np.pi * hertz))
        return a * z / (z - 1 + a)

    slope = (z - 1) / (Ts * z) * low_pass(stock.derivative_hz[0])
    Kp, Ki, Kd, Kp_o = (np.diag(getattr(gains, n))[None] for n in ("Kp_i", "Ki_i", "Kd_i", "Kp_o"))
    if stock.controller == "betaflight":
        of_y = Kp + Ki * (Ts * z / (z - 1))[:, None] + Kd * (slope * low_pass(stock.derivative2_hz[0]))[:, None]
        of_r = (Kp + Ki * (Ts * z / (z - 1))[:, None]) * (low_pass(50.0 * 1.961459177) ** 3)[:, None]
        return of_y[:, :, None] * np.eye(2), (of_r * Kp_o)[:, :, None] * np.eye(2)
    if stock.controller == "px4-stock":
        of_r = Kp + Ki * (Ts / (z - 1))[:, None]
        of_y = of_r + Kd * slope[:, None]
    else:
        of_y = Kp + Ki * (Ts * z / (z - 1))[:, None] + Kd * slope[:, None]
        of_r = of_y * low_pass(stock.setpoint_hz[0])[:, None]
    return of_y[:, :, None] * np.eye(2), (of_r * Kp_o / z[:, None])[:, :, None] * np.eye(2)


@pytest.mark.parametrize("controller", FILTERS)
def test_the_certificates_margin_is_that_of_the_documented_law(controller):
    gains, omega = stock_set(controller), grid(600.0)
    plant = exact(Truth.of(airframe(VEHICLE)).plant, omega)
    C_y, C_o = documented(gains, omega)
    smallest = np.linalg.svd(np.eye(2) + C_y @ plant.G_i + C_o @ plant.G_o, compute_uv=False)[:, -1]
    figures = certify(gains, plant, *MODELS).figures
    assert figures["Ms"] == pytest.approx(1 / smallest.min(), rel=1e-6)
    ours = certify(gains.for_our_law(), plant, *MODELS).figures
    assert abs(ours["Ms"] / figures["Ms"] - 1) > 0.003  # so that the law matters


def arducopter_flight(gains, plant, given):
    """ArduCopter's recursions in closed loop around a plant, from a given to the shaped setpoint and the angle, (N, 2).

    In the order of its own loop: the rate controller first, then the attitude controller.
    """
    T, Ts, n = gains.filters.shaping[0], gains.Ts, 2
    Kp_o, Kp, Ki, Kd = (np.diag(getattr(gains, name)) for name in ("Kp_o", "Kp_i", "Ki_i", "Kd_i"))
    stock = gains.filters.stock
    a, c = (Ts / (Ts + 1 / (2 * np.pi * hertz[0])) for hertz in (stock.setpoint_hz, stock.derivative_hz))
    state = np.zeros(len(plant.A))
    rate, target, error, slope, integral, angle, speed = (np.zeros(n) for _ in range(7))
    setpoints, angles = [], []
    for wanted in given:
        out = plant.C @ state
        target = target + a * (rate - target)
        last, error = error, target - out[:n]
        slope = slope + c * ((error - last) / Ts - slope)
        integral = integral + Ki * error * Ts
        angle = angle + speed * Ts
        setpoints.append(angle)
        angles.append(out[n:])
        speed = speed + ((wanted - angle) / T - 2 * speed) / T * Ts
        rate = Kp_o * (angle - out[n:]) + speed
        state = plant.A @ state + plant.B @ (Kp * error + integral + Kd * slope)
    return np.array(setpoints), np.array(angles)


def test_arducopters_feed_forward_is_in_the_predicted_following():
    """The angle's answer to the logged setpoint, while both axes' given ones move as a sine."""
    gains = stock_set("ardupilot-stock")
    stock = dataclasses.replace(gains.filters.stock, shaping_s=(0.15,) * 3)
    gains = dataclasses.replace(gains, filters=dataclasses.replace(gains.filters, stock=stock))
    samples, periods = 200, 40
    k, omega = np.arange(samples * periods), np.array([2 * np.pi / samples / TS])
    truth = Truth.of(airframe(VEHICLE)).plant
    flown = arducopter_flight(gains, truth, np.outer(np.sin(omega[0] * TS * k), [1.0, -0.5]))
    used = slice(len(k) // 2, None)
    setpoint, angle = (2j * np.exp(-1j * omega[0] * TS * k[used]) @ s[used] / len(k[used]) for s in flown)
    T = cascade_loop(gains, exact(truth, omega)).T_o[0]
    assert T @ setpoint == pytest.approx(angle, abs=1e-3 * np.abs(angle).max())
    without = dataclasses.replace(gains, filters=dataclasses.replace(gains.filters, stock=FILTERS["ardupilot-stock"]))
    slower = cascade_loop(without, exact(truth, omega)).T_o[0]
    assert np.linalg.norm(slower @ setpoint - angle) > 0.2 * np.linalg.norm(angle)


def remaining(gains, bench):
    """Root of the energy of each angle while it returns from an offset."""
    plant = bench.plants[0]
    free = free_gains(gains, plant.body, full=False)
    S = np.eye(2) - LoopGradient(plant, free, free.vector(gains)).T_y
    weight = manoeuvres(plant, second_order(9.0, 0.7, 0, plant.Ts), gains.filters).offset
    return np.sqrt(np.einsum("k,kii->i", weight, np.abs(S) ** 2))


def test_a_design_for_arducopter_follows_better_and_is_no_softer_in_gusts(log):
    """Its setpoint's rate is fed forward, so following alone would ask for next to no angle P."""
    shaped = dataclasses.replace(FILTERS["ardupilot-stock"], shaping_s=(0.15,) * 3)
    flown = stock_set("ardupilot-stock")
    flown = dataclasses.replace(flown, Kp_o=4.5 * np.eye(2), filters=dataclasses.replace(flown.filters, stock=shaped))
    bench = ResponseDesign.of([PlantEstimates(dataclasses.replace(log, flown=flown))], TuningSpec().design)
    found = bench.design([flown], "PID", full=False)
    task = found.task.plants[0].manoeuvres
    new, old = (predict(gains, bench.plants[0], task) for gains in (found.gains, flown))
    assert found.feasible
    assert max(np.divide(new.disturbance_deg, old.disturbance_deg)) < ROOM * 1.01
    assert np.linalg.norm(new.follow_deg) < np.linalg.norm(old.follow_deg)
    assert max(np.divide(remaining(found.gains, bench), remaining(flown, bench))) < 1.15


def test_our_gains_for_arducopter_are_designed_for_its_shaped_setpoints(log):
    """Their setpoint's rate is fed forward, too: without that the same gains would follow much worse."""
    stock = dataclasses.replace(FILTERS["ardupilot-stock"], shaping_s=(0.15,) * 3)
    flown = stock_set("ardupilot-stock")
    flown = dataclasses.replace(flown, Kp_o=4.5 * np.eye(2), filters=dataclasses.replace(flown.filters, stock=stock))
    ours = flown.for_our_law()
    bench = ResponseDesign.of([PlantEstimates(dataclasses.replace(log, flown=ours))], TuningSpec().design)
    assert bench.bandwidths[-1] > BANDWIDTHS[-1]
    found = bench.design([ours], "PID", full=False, bandwidth=BANDWIDTHS[-1])
    without = dataclasses.replace(ours, filters=dataclasses.replace(ours.filters, shaping_s=0.0))
    task = found.task.plants[0].manoeuvres
    new, old, lagging = (
        float(np.linalg.norm(predict(gains, bench.plants[0], task).follow_deg))
        for gains in (found.gains, ours, without)
    )
    assert new < old < lagging / 2
    assert max(np.divide(remaining(found.gains, bench), remaining(ours, bench))) < 1.15


def test_a_stock_set_is_diagonal_certified_at_both_rates_and_in_few_digits(tuned):
    assert (tuned.controller, tuned.provenance.method, tuned.verdict()[0]) == ("px4-stock", "px4-stock", "certified")
    certificate = tuned.certificate
    rates = [certificate.as_table(), *certificate.further]
    assert len(rates) == 2
    assert sum("carried from 250 to 800 Hz" in one["reason"] for one in rates) == 1
    for name in ("Kp_o", "Kp_i", "Ki_i", "Kd_i"):
        for value in np.diag(getattr(tuned, name)):
            assert value == float(f"{value:.4g}")
    assert tuned.filters.stock == FILTERS["px4-stock"]


def test_what_is_uploaded_is_what_was_certified(log, tuned):
    values = make_plan(tuned, "px4-stock").values
    assert values["MC_ROLLRATE_P"] == np.float32(tuned.Kp_i[0, 0])
    assert values["MC_PITCHRATE_D"] == np.float32(tuned.Kd_i[1, 1])
    again = certify_from_log(log, tuned)
    assert again.verdict()[0] == "certified"
    fields = {name: value for name, value in vars(tuned).items() if name != "filters"}
    moved = Gains(**fields, filters=dataclasses.replace(tuned.filters, stock=FILTERS["ardupilot-stock"]))
    assert moved.verdict()[0] == "void"


def test_the_worth_of_off_diagonals_is_told(tuned):
    """The vehicle is coupled: a diagonal controller cannot decouple it, full matrices can."""
    details = tuned.provenance.details
    worth = {name: np.hypot(*pairs[0]) for name, pairs in details["worth_of_off_diagonals"].items()}
    assert set(worth) == {"flown", "tuned", "module"}
    assert worth["module"] < 0.5 * worth["tuned"]
    assert details["better_than_flown"] or details["keep_flown"]
    assert [one["offaxis_deg"] for one in details["predicted"]["module"]] == details["worth_of_off_diagonals"]["module"]


def test_a_log_of_another_controller_is_refused(log):
    for flown, profile, message in (
        (
            defaults(VEHICLE),
            "px4-stock",
            "it flew mimo gains; gains for px4-stock are designed from a flight with",
        ),
        (log.flown, "ardupilot-stock", "it flew px4-stock gains"),
        (None, "px4-stock", "its parameters hold no complete set"),
    ):
        with pytest.raises(TuningError, match=message):
            tune(dataclasses.replace(log, flown=flown), TuningSpec(profile=profile))
    with pytest.raises(TuningError, match="profile: got px4-stock, expected mimo"):
        advise(log, TuningSpec(profile="px4-stock"))
    lacking = dataclasses.replace(defaults(VEHICLE).provenance, details={"lacking_parameters": ["IMU_DGYRO_CUTOFF"]})
    flown = dataclasses.replace(defaults(VEHICLE), provenance=lacking)
    with pytest.raises(TuningError, match="lacks IMU_DGYRO_CUTOFF, filters of the px4-stock controller"):
        tune(dataclasses.replace(log, flown=flown), TuningSpec(profile="px4-stock"))


@pytest.mark.parametrize(
    ("option", "name"),
    [
        ({"method": "siso"}, "method"),
        ({"inner": (20.0, 0.4, 0)}, "inner, outer"),
        ({"follow_model": True}, "follow_model"),
        ({"derivative_cutoff_hz": 20.0}, "derivative_cutoff_hz"),
    ],
)
def test_a_stock_law_is_taken_as_it_is(option, name):
    with pytest.raises(Error, match=f"{name}: not with profile px4-stock"):
        load_spec(profile="px4-stock", **option)


def whole_numbers(**changes):
    """A set of Betaflight whose numbers on its command line are known."""
    degree = np.pi / 180
    numbers = {"Kp_o": (50, 50), "Kp_i": (45, 47), "Ki_i": (80, 84), "Kd_i": (30, 34), "Kff_i": (0, 0)} | changes
    scale = {"Kp_o": 0.1, "Kp_i": 0.032029e-3 / degree, "Ki_i": 0.244381e-3 / degree, "Kd_i": 0.000529e-3 / degree}
    matrices = {name: scale.get(name, 1.0) * np.diag(pair) for name, pair in numbers.items()}
    return dataclasses.replace(stock_set("betaflight"), **matrices)


def test_betaflights_lines_hold_the_numbers_of_its_command_line(tmp_path):
    path = tmp_path / "bf.gains.toml"
    whole_numbers().save(path)
    lines = betaflight_lines(load_gains(path)).splitlines()
    gains = ("p_roll = 45", "i_roll = 80", "d_roll = 30", "p_pitch = 47", "i_pitch = 84", "d_pitch = 34")
    others = ("angle_p_gain = 50", "d_max_roll = 0", "dterm_lpf1_static_hz = 75", "dterm_lpf2_static_hz = 150")
    assert {f"set {line}" for line in (*gains, *others)} <= set(lines)
    assert lines[-1] == "save"


def test_betaflight_takes_only_what_was_certified_as_it_flies():
    for gains, message in (
        (
            dataclasses.replace(defaults(VEHICLE), Kp_i=np.array([[0.15, 0.02], [0.0, 0.15]])),
            r"are for mimo: .* off-diagonals \(up to 0\..*would be lost.*tune LOG --profile betaflight",
        ),
        (
            whole_numbers(Kp_i=(45.5, 47)),
            r"p_roll: got 45\.5, expected a whole number from 0 to 250: rounding would fly",
        ),
        (whole_numbers(Kd_i=(30, 251)), "d_pitch: got 251, expected a whole number from 0 to 250"),
        (whole_numbers(Kp_o=(50, 51)), r"angle_p_gain: got \[50, 51\] for roll and pitch"),
    ):
        with pytest.raises(Error, match=message):
            betaflight_lines(gains)
    with pytest.raises(Error, match=r"over MAVLink.*--format betaflight"):
        make_plan(whole_numbers(), "betaflight")


def test_a_design_for_betaflight_is_rounded_to_its_numbers_before_the_certificate():
    rounded = in_digits(whole_numbers(Kp_i=(45.4, 300), Kp_o=(52.6, 50.2), Kd_i=(29.6, 34.4)))
    expected = whole_numbers(Kp_i=(45, 250), Kp_o=(50, 50), Kd_i=(30, 34))
    for name in ("Kp_o", "Kp_i", "Ki_i", "Kd_i"):
        np.testing.assert_allclose(getattr(rounded, name), getattr(expected, name), rtol=1e-12)


def test_feed_forward_of_the_rate_setpoint_is_not_in_betaflights_law(log):
    flown = dataclasses.replace(log, flown=stock_set("betaflight"))
    with pytest.raises(TuningError, match="structure: got PIDF, but the betaflight controller has no F"):
        tune(flown, TuningSpec(profile="betaflight", structure="PIDF"))
