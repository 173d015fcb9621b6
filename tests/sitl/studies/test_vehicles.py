"""The study of random vehicles: what is drawn, how runs are judged, and that it is resumed."""

import json

import numpy as np
import pytest

from mimopilot.sitl.studies import drawn_vehicle, vehicle_bars
from mimopilot.sitl.studies.drawn_vehicle import draw_vehicle
from mimopilot.sitl.studies.true_plant import gust_spectrum
from mimopilot.sitl.studies.vehicle_run import SECONDS, fly_experiment, gust_torque
from mimopilot.sitl.studies.vehicles import reproduce_vehicles
from tests.conftest import assert_one_clear_line
from tests.tuning.truth import Truth

TS = 0.004


def inside(value, limits):
    return limits[0] <= value <= limits[1]


@pytest.mark.parametrize("seed", range(2))
def test_a_drawn_vehicle_is_in_the_ranges_of_the_study_and_its_gains_have_the_drawn_margin(seed):
    generator = np.random.default_rng([seed, 0])
    vehicle = draw_vehicle(generator)
    body, J = vehicle.airframe, np.array(vehicle.airframe.inertia)
    assert inside(body.mass, drawn_vehicle.MASS)
    assert abs(J[0, 1]) <= 0.4 * np.sqrt(J[0, 0] * J[1, 1])
    assert 0 <= body.computing_delay * TS <= 0.024
    assert 0 <= vehicle.gusts <= 0.1
    if body.frame is not None:
        assert inside(body.frame.frequency_hz, (15, 80))
        assert inside(body.frame.damping, (0.02, 0.1))
        assert inside(body.frame.gain, (0.02, 0.8))
    truth = Truth.of(body)
    assert truth.spectral_radius(vehicle.gains) < 1
    assert inside(vehicle.flown_Ms, (1.2, 2.0))
    assert truth.margins(vehicle.gains)[0] == pytest.approx(vehicle.flown_Ms, rel=3e-3)
    for name in ("Kp_o", "Kp_i", "Ki_i", "Kd_i"):
        matrix = getattr(vehicle.gains, name)
        assert matrix[0, 1] == matrix[1, 0] == 0
        assert (np.diag(matrix) > 0).all()
    flown = fly_experiment(vehicle, 2 * seed, generator)
    assert inside(flown.seconds, SECONDS)
    log = flown.log
    assert log.seconds == pytest.approx(flown.seconds, abs=2 * TS)
    assert np.unique(np.abs(log.u_bar)).tolist() == pytest.approx([0, flown.amplitude])
    again = draw_vehicle(np.random.default_rng([seed, 0]))
    assert again.as_json() == vehicle.as_json()


def test_about_half_of_the_vehicles_have_a_frame_mode_and_all_delays_occur():
    drawn = [drawn_vehicle.draw_airframe(np.random.default_rng(seed)) for seed in range(400)]
    bodies = [body for body in drawn if body is not None]
    assert len(bodies) > 350
    assert np.mean([body.frame is not None for body in bodies]) == pytest.approx(0.5, abs=0.08)
    assert {body.computing_delay for body in bodies} == set(range(7))


def test_gusts_have_their_spectrum():
    torque = gust_torque(400_000, 0.05, TS, np.random.default_rng(0))
    assert torque.std(axis=0) == pytest.approx([0.05] * 2, rel=0.05)
    power = np.mean([np.abs(np.fft.rfft(part)) ** 2 / 4000 for part in torque[:, 0].reshape(-1, 4000)], axis=0)
    omega = 2 * np.pi * np.arange(len(power)) / (4000 * TS)
    for low, high in ((2, 4), (10, 20), (100, 200)):
        band = (omega > low) & (omega < high)
        assert power[band].mean() == pytest.approx(gust_spectrum(omega[band], TS, 0.05).mean(), rel=0.15)


def made_run(seed=0, outcome="certified", **changes):
    """A run that reaches every bar; changes by dotted name."""
    flights = {"tuned": {"follow_deg": 0.5, "offaxis_deg": 0.2}, "flown": {"follow_deg": 1.0, "offaxis_deg": 0.4}}
    run = {
        "seed": seed,
        "outcome": outcome,
        "reasons": [],
        "vehicle": {"gusts": 0.01, "flown_Ms": 1.3, "frame": None},
        "experiment": {"seconds": 35.0},
        "tuned": {
            "verdict": "certified",
            "Ms": 1.5,
            "certified_Ms": 1.55,
            "spectral_radius": 0.999,
            "noise_ratio": 1.2,
            "limited_by": [],
            "true_reasons": [],
            "flights": flights,
        },
        "optimum": {"feasible": True, "follow_ratio": 0.5, "reasons_to_keep": []},
    }
    for name, value in changes.items():
        *path, last = name.split("__")
        target = run
        for part in path:
            target = target[part]
        target[last] = value
    return run


def refused(seed, text, **changes):
    return made_run(seed, "refused", tuned=None, reasons=[text], **changes)


def figures(runs):
    return {bar.name: bar for bar in vehicle_bars.bars(runs)}


def test_runs_that_reach_every_bar():
    found = figures([made_run(seed) for seed in range(5)])
    assert all(bar.met for bar in found.values())
    assert not any(bar.failed for bar in found.values())


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"tuned__flights__tuned__follow_deg": 1.1}, "follows worse"),
        ({"tuned__flights__tuned__offaxis_deg": 0.5}, "other axis"),
        ({"tuned__Ms": 1.7}, "Ms 1.700, allowed 1.600"),
        ({"tuned__noise_ratio": 1.6}, "hover noise 1.60"),
    ],
)
def test_a_certified_set_that_is_not_better_misses_the_bar(changes, words):
    found = figures([made_run(0), made_run(7, **changes)])
    bar = found["refused with a true reason, or better than the flown gains"]
    assert (bar.count, bar.of, bar.met) == (1, 2, False)
    assert [seed for seed, _ in bar.failed] == [7]
    assert words in bar.failed[0][1]


def test_what_counts_as_better():
    # Equally decoupled below 0.1 degrees; a margin as thin as the flown one.
    fine = made_run(0, tuned__flights__tuned__offaxis_deg=0.09, tuned__flights__flown__offaxis_deg=0.05)
    assert vehicle_bars.shortfalls(fine) == []
    assert vehicle_bars.shortfalls(made_run(0, tuned__Ms=1.85, vehicle__flown_Ms=1.9)) == []


def test_unstable_sets_and_wrong_margins_are_counted_among_the_certified():
    found = figures([made_run(0), made_run(1, tuned__spectral_radius=1.001), made_run(2, tuned__certified_Ms=1.3)])
    assert found["unstable among the certified"].failed == ((1, "spectral radius 1.00100"),)
    assert [seed for seed, _ in found["certified Ms within 10 % of the true one"].failed] == [2]


def test_refusals_count_only_where_the_optimum_is_better_than_the_flown_gains():
    text = "log: no gains of this structure are certified: Ms 1.7 + 0.3 is above 1.8"
    runs = [made_run(0), refused(1, text), refused(2, text, optimum__follow_ratio=0.95)]
    runs += [refused(3, text, vehicle__gusts=0.05), refused(4, text, experiment__seconds=20.0)]
    found = figures(runs)
    assert (found["improvable ones refused, all"].count, found["improvable ones refused, all"].of) == (3, 4)
    calm = found["improvable ones refused, gusts up to 2 %, 30 s"]
    assert (calm.count, calm.of, calm.met) == (1, 2, False)
    assert found["refused with a true reason, or better than the flown gains"].met


def test_a_reason_to_keep_the_flown_gains_must_hold_on_the_true_plant():
    reason = "it moves the other axis more (0.5 degrees, flown 0.3)"
    same = "it moves the other axis more (0.6 degrees, flown 0.2)"
    other = "its margin is thinner (Ms 1.7, flown 1.3)"
    runs = [
        made_run(0, "keep", reasons=[reason], tuned__true_reasons=[same]),
        made_run(1, "keep", reasons=[reason], tuned__true_reasons=[other]),
        made_run(2, "keep", reasons=[reason, other], tuned__true_reasons=[other]),
    ]
    bar = figures(runs)["refused with a true reason, or better than the flown gains"]
    assert [seed for seed, _ in bar.failed] == [1]


def test_a_refusal_because_of_a_frame_mode_names_the_notch_at_its_frequency():
    frame = {"frequency_hz": 30.0, "damping": 0.03, "gain": 0.4}
    text = "log: at 190 rad/s (31 Hz) the loop's gain may reach 0.8: a mode of the frame; filter the rates (notch)"
    wrong = text.replace("31", "40")
    runs = [
        refused(0, text, vehicle__frame=frame),
        refused(1, wrong, vehicle__frame=frame),
        refused(2, text),
        refused(3, "log: nothing; the design is limited by a mode of the frame", vehicle__frame=frame),
    ]
    found = figures(runs)
    failed = dict(found["refusals because of a frame mode that name the notch"].failed)
    assert set(failed) == {1, 2, 3}
    assert "the mode is at 30.0 Hz" in failed[1]
    assert "the vehicle has none" in failed[2]
    assert failed[3] == "names no notch, or no frequency"
    assert {seed for seed, _ in found["refused with a true reason, or better than the flown gains"].failed} == {1, 2}


def test_runs_are_kept_and_one_seed_is_replayed(tmp_path, mimopilot):
    first = reproduce_vehicles(tmp_path / "a", runs=2, first=31, workers=2)
    assert [run["seed"] for run in first.figures["runs"]] == [31, 32]
    report = first.report.read_bytes()
    parts = sorted((tmp_path / "a" / "parts").iterdir())
    kept = {path: path.stat().st_mtime_ns for path in parts}
    assert len(kept) == 2
    again = reproduce_vehicles(tmp_path / "a", runs=2, first=31, workers=1)
    assert {path: path.stat().st_mtime_ns for path in parts} == kept
    assert again.report.read_bytes() == report
    result = mimopilot("reproduce", "vehicles", "--runs", 1, "--first", 32, "--workers", 1, "--out", "b", "--json")
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout)
    assert found["runs"] == [json.loads(json.dumps(first.figures["runs"][1]))]
    assert {bar["name"] for bar in found["bars"]} == {bar["name"] for bar in first.figures["bars"]}


def test_options_of_the_other_studies_are_refused(mimopilot):
    assert_one_clear_line(mimopilot("reproduce", "vehicles", "--seeds", 3), "--seeds")
    assert_one_clear_line(mimopilot("reproduce", "lv100", "--runs", 3), "--runs")
    assert_one_clear_line(mimopilot("reproduce", "lv100", "--first", 3), "--first")
