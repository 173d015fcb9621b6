"""Numbers of a report: step responses, tones, delays, margins, filters."""

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.signal
from scipy.signal import butter, group_delay

import mimopilot as mp
from mimopilot.common.figures import SpanMark
from mimopilot.sitl.field.report.analysis.filters_advice import (
    behind,
    filter_changes,
    least_phase,
    of_both_axes,
    torque_noise,
    with_derivative_filter,
)
from mimopilot.sitl.field.report.analysis.flight_data import PHASES, gain_cases
from mimopilot.sitl.field.report.analysis.loop_filters import (
    DERIVATIVE,
    FIRST_ORDER,
    LOW_PASS,
    NOTCH,
    LoopFilter,
    filters_of,
    moving_filters,
)
from mimopilot.sitl.field.report.analysis.predicted_motion import doublet_setpoint, predicted_motion
from mimopilot.sitl.field.report.analysis.step_response import WIDEST, estimate_step
from mimopilot.sitl.field.report.analysis.vibration import Tone, air_spectrum, find_tones, spectrogram
from mimopilot.sitl.field.report.analysis.weak_coherence import coherence_note, deciding_range, weak_ranges
from mimopilot.sitl.field.report.flight_report import make_report
from mimopilot.sitl.field.report.headline import _next_step, headline
from mimopilot.sitl.field.report.sections.compare import _set_figures
from mimopilot.sitl.field.report.sections.frequency import coherence_band
from mimopilot.sitl.field.report.sections.spectra import _change_table
from mimopilot.sitl.field.report.sections.stability import crossover, loops_of, margin_table
from mimopilot.sitl.field.report.sections.tracking import busiest, tracking_error
from mimopilot.tuning.axes import law_of
from mimopilot.tuning.certificate import Certificate, Thresholds, Verdict
from mimopilot.tuning.law_filters import StockFilters
from mimopilot.tuning.logs.resample import Series
from mimopilot.tuning.reference_model import second_order
from mimopilot.tuning.spec import TuningSpec
from tests.tuning.logs.flights import make_flight, px4_topics, table, write_csv, write_ulog


def steps(Ts, seconds=40.0, size=0.2, hold=0.5):
    """Time (N,) and setpoints (N, 1), rad, that step at random."""
    t = np.arange(0, seconds, Ts)
    choices = np.random.default_rng(0).choice([-size, 0.0, size], round(seconds / hold) + 1)
    return t, choices.repeat(round(hold / Ts))[: len(t), None]


@pytest.mark.parametrize(("Ts", "noise"), [(0.004, 0.002), (0.004, 0.05), (0.02, 0.005), (0.05, 0.002)])
def test_the_step_response_of_a_known_system_is_within_its_band(Ts, noise):
    t, r = steps(Ts)
    model = second_order(9.0, 0.6, 0, Ts)
    y = model.response(r) + noise * np.random.default_rng(1).standard_normal(r.shape)
    found, why = estimate_step(Series(t, r, "r"), Series(t, y, "y"), [(0.0, 40.0)], 0)
    assert why == ""
    true = model.response(np.ones((round(1.4 / Ts), 1)))[:, 0]
    error = found.step - np.interp(found.time, np.arange(len(true)) * Ts, true)
    assert np.mean(np.abs(error) <= found.band) > 0.9
    assert np.abs(error).max() < 0.03
    assert found.width < 0.1
    assert found.stretches == 21
    # zeta = 0.6: exp(-pi zeta / sqrt(1 - zeta^2)) = 9.5 %.
    assert found.overshoot() == pytest.approx(0.095, abs=0.02)


def test_a_step_response_whose_band_is_wider_than_the_answer_is_refused():
    t, r = steps(0.01, size=0.01)
    noise = np.random.default_rng(2).standard_normal(r.shape)
    found, why = estimate_step(Series(t, r, "r"), Series(t, noise, "y"), [(0.0, 40.0)], 0)
    assert found is None
    assert float(why.split(" stretches is ")[1].split(" times")[0]) >= WIDEST


def test_a_setpoint_that_does_not_move_gives_no_step_response():
    t, r = steps(0.01, size=0.0)
    found, why = estimate_step(Series(t, r, "r"), Series(t, r, "y"), [(0.0, 40.0)], 0)
    assert found is None
    assert "in 0 stretches" in why


def humming(tones, seconds=30.0, rate=500.0):
    """A gyro (N, 3), rad/s, with noise and tones (Hz, amplitude, axis)."""
    t = np.arange(0, seconds, 1 / rate)
    values = 0.05 * np.random.default_rng(3).standard_normal((len(t), 3))
    for hertz, amplitude, axis in tones:
        values[:, axis] += amplitude * np.sin(2 * np.pi * hertz * t)
    return Series(t, values, "gyro")


def test_tones_are_found_at_their_frequency_and_harmonics_named():
    series = humming([(83.37, 0.1, 0), (166.74, 0.06, 1), (41.2, 0.05, 2)])
    found = {round(tone.hertz): tone for tone in find_tones(air_spectrum(series, [(0.0, 30.0)]))}
    assert sorted(found) == [41, 83, 167]
    assert found[83].hertz == pytest.approx(83.37, abs=0.15)
    assert found[167].hertz == pytest.approx(166.74, abs=0.15)
    assert [found[k].axis for k in (83, 167, 41)] == [0, 1, 2]
    assert found[167].harmonic_of == pytest.approx(83.37, abs=0.15)
    assert found[83].harmonic_of == 0.0


def test_noise_alone_shows_no_tone():
    assert find_tones(air_spectrum(humming([]), [(0.0, 30.0)])) == []
    assert find_tones(air_spectrum(humming([], seconds=3.0), [(0.0, 3.0)])) == []


def test_a_tone_that_moves_with_the_thrust_is_told_from_one_that_stays():
    series = humming([(60.0, 0.1, 1)])
    t = series.time
    thrust_of = 0.5 + 0.1 * np.sin(2 * np.pi * t / 15)
    turning = np.cumsum(150 * (1 + 0.5 * (thrust_of - 0.5))) * (t[1] - t[0])
    series.values[:, 0] += 0.5 * np.sin(2 * np.pi * turning)
    slices = spectrogram(series, [(0.0, 30.0)])
    thrust = np.interp(slices[0], t, thrust_of)
    found = find_tones(air_spectrum(series, [(0.0, 30.0)]), slices, thrust)
    assert {tone.follows_thrust for tone in found if 140 < tone.hertz < 160} == {True}
    assert [tone.follows_thrust for tone in found if 58 < tone.hertz < 62] == [False]


@pytest.mark.parametrize("hertz", [20.0, 40.0, 90.0])
def test_the_delay_of_a_low_pass_is_that_of_its_closed_form_and_of_the_sampled_filter(hertz):
    second, first = LoopFilter("x", LOW_PASS, hertz), LoopFilter("x", FIRST_ORDER, hertz)
    assert second.delay() == pytest.approx(math.sqrt(2) / (2 * math.pi * hertz))
    assert first.delay() == pytest.approx(1 / (2 * math.pi * hertz))
    rate = 8000.0
    _, samples = group_delay(butter(2, hertz, fs=rate), w=[0.01], fs=rate)
    assert second.delay() == pytest.approx(samples[0] / rate, rel=1e-3)
    slow = np.array([0.01])
    for one in (second, first, LoopFilter("x", NOTCH, hertz, width_hz=20.0, depth_db=40.0)):
        assert one.delay() == pytest.approx(-np.angle(one.response(slow))[0] / slow[0], rel=1e-3)


def test_a_notch_stops_its_frequency_and_a_low_pass_has_half_the_power_at_its_cut_off():
    notch = LoopFilter("x", NOTCH, 80.0, width_hz=20.0)
    at = 2 * np.pi * np.array([80.0, math.sqrt(80.0**2 + 10.0**2) - 10.0, 0.5])
    assert np.abs(notch.response(at)) == pytest.approx([0.0, math.sqrt(0.5), 1.0], abs=1e-4)
    assert abs(LoopFilter("x", LOW_PASS, 30.0).response(np.array([60 * math.pi]))[0]) == pytest.approx(math.sqrt(0.5))


def test_filters_are_found_by_the_names_of_both_autopilots(gains):
    px4 = filters_of({"IMU_GYRO_CUTOFF": 40.0, "IMU_GYRO_NF0_FRQ": 83.0, "IMU_GYRO_NF0_BW": 20.0}, gains)
    assert [(one.kind, one.hertz) for one in px4] == [(LOW_PASS, 40.0), (NOTCH, 83.0), (FIRST_ORDER, 30.0)]
    assert px4[2].acts_on == DERIVATIVE
    harmonic = {"INS_HNTCH_ENABLE": 1.0, "INS_HNTCH_FREQ": 58.8, "INS_HNTCH_BW": 12.0, "INS_HNTCH_HMNCS": 3.0}
    ardupilot = filters_of({"INS_GYRO_FILTER": 42.0, **harmonic}, None)
    assert [(one.kind, one.hertz) for one in ardupilot] == [(LOW_PASS, 42.0), (NOTCH, 58.8), (NOTCH, 117.6)]
    assert filters_of({"IMU_GYRO_CUTOFF": 0.0}, None) == []
    assert "IMU_GYRO_DNF_EN" in moving_filters({"IMU_GYRO_DNF_EN": 3.0})[0]
    assert "INS_HNTCH_MODE" in moving_filters(harmonic | {"INS_HNTCH_MODE": 1.0})[0]
    assert moving_filters(harmonic | {"IMU_GYRO_DNF_EN": 0.0}) == []


def test_the_interval_of_a_coherence_holds_it_and_shrinks_with_the_record():
    omega, value = np.array([5.0, 20.0]), np.array([0.9, 0.5])
    low, high = coherence_band(value, omega, 40.0)
    assert np.all((low < value) & (value < high) & (high < 1))
    longer = coherence_band(value, omega, 400.0)
    assert np.all(longer[1] - longer[0] < high - low)


def test_margins_are_those_of_the_certificate(bench):
    flight, gains, report = bench
    certificate = mp.certify(flight, gains).certificate
    case = next(case for case in report.cases if case.label == "my")
    assert case.gains.certificate.figures == certificate.figures
    table = next(table for table in report.tables if table.caption == "Margins by the certificate")
    shown = {row[0]: row[table.columns.index("my")] for row in table.rows}
    assert [float(part) for part in shown["Ms"].split(" +- ")] == pytest.approx(
        [certificate.figures["Ms"], certificate.figures["Ms_error"]], rel=0.05
    )
    phase, error = shown["phase margin, roll"].removesuffix(" deg").split(" +- ")
    assert float(phase) == pytest.approx(certificate.figures["phase_margin_deg"]["roll"], abs=float(error) / 10)
    assert shown["delay margin, pitch"] == f"{certificate.figures['delay_margin_ms']['pitch']:.1f} ms"


def test_predicted_doublets_and_steps_of_torque_end_at_rest_with_the_figures_of_tune(bench):
    _, gains, report = bench
    motion = predicted_motion(gains, report.flights[0].wide)
    # Nothing moves before; the doublet is followed and ends; the integral removes the step of torque.
    assert np.abs(motion.doublet[motion.time < 0]).max() < 0.1
    assert np.abs(motion.torque[motion.time < 0]).max() < 0.02
    held = (motion.time > 0.5) & (motion.time < 0.6)
    assert motion.doublet[held, 0, 0] == pytest.approx(motion.setpoint[held], abs=1.0)
    assert np.abs(motion.doublet[-10:]).max() < 0.3
    pushed = motion.torque[:, 0, 0]
    assert 0.2 < pushed.max() < 2.0
    assert abs(pushed[-1]) < 0.7 * pushed.max()


@pytest.mark.parametrize("integral", [10.0, 0.5, 0.0], ids=["fast", "slower than the response", "none"])
def test_the_predicted_doublet_and_step_of_torque_of_yaw_are_those_of_the_closed_form(bench, integral):
    _, gains, report = bench
    measured, b = report.flights[0].wide_yaw, 40.0
    s = 1j * measured.omega[:, None, None]
    body = replace(measured.body, B=np.array([[b]]))
    plant = replace(
        measured, G_i=b / s, G_o=b / s**2, body=body, error_i=0 * measured.error_i, error_o=0 * measured.error_o
    )
    p, i, attitude = 12 / b, integral / b, 2.0
    yaw = replace(gains.yaw, Kp_o=attitude, Kp_i=p, Ki_i=i, Kd_i=0.0, Kff_i=0.0)
    motion = predicted_motion(law_of(replace(gains, yaw=yaw), 1), plant)
    # u = (p + i / s) (attitude (r - y) - rate), rate = b u / s; the loop is delayed by half of the hold and the sum.
    below = [1.0, p * b, (attitude * p + i) * b, attitude * i * b]
    time = np.linspace(0.0, motion.time[-1], 4000)
    above = [attitude * p * b, attitude * i * b]
    _, step = scipy.signal.step((above, below) if integral else (above[:-1], below[:-1]), T=time)
    _, pushed = scipy.signal.step(([0.5, 0.0], below) if integral else ([0.5], below[:-1]), T=time)
    halves = [np.interp(motion.time - at, time, step, left=0.0) for at in (0.0, 1.75, 3.5)]
    doublet = 10.0 * (halves[0] - 2 * halves[1] + halves[2])
    assert motion.setpoint == pytest.approx(doublet_setpoint(motion.time, 3.5))
    assert motion.doublet[:, 0, 0] == pytest.approx(doublet, abs=0.25)
    after = motion.time > 0
    known = np.degrees(np.interp(motion.time, time, pushed, left=0.0))
    assert motion.torque[after, 0, 0] == pytest.approx(known[after], abs=0.03 * known.max())


def test_yaw_is_predicted_and_compared_beside_roll_and_pitch(bench):
    report = bench[2]
    charts = {chart.name: chart for chart in report.charts}
    titles = [panel.title for panel in charts["predicted-motion-yaw"].panels]
    assert titles == ["yaw doublet: yaw", "step of torque on yaw: yaw"]
    for panel in charts["predicted-motion-yaw"].panels:
        assert [line.label for line in panel.lines if getattr(line, "label", "")][-1] == "my"
    stability = next(one for one in report.sections if one.heading == "Stability and margins")
    assert any(point.startswith("flown: yaw is not examined: excitation begins at") for point in stability.points)
    rows = {row[0]: row[1:] for row in report.tables[0].rows}
    assert {"Ms", "roll: phase margin [deg]", "pitch: torque noise at hover"} <= set(rows)
    new = report.cases[1]
    assert {"yaw: Ms", "yaw: phase margin [deg]"} <= set(_set_figures(new, new))
    before, after, difference, _ = rows["roll: off-axis motion in doublets [deg]"]
    values = [float(cell.split(" +- ")[0]) for cell in (before, after, difference)]
    assert values[1] - values[0] == pytest.approx(values[2], abs=1.5 * 10.0 ** -len(before.split()[0].split(".")[1]))
    # Both sets are predicted around the same plants: their difference is surer than two independent figures.
    errors = [float(cell.split(" +- ")[1]) for cell in (before, after, difference)]
    assert errors[2] < np.hypot(errors[0], errors[1])


def test_the_time_that_excites_yaw_is_used_and_what_cannot_be_tuned_from_is_not(bench, tmp_path):
    flight = bench[2].flights[0]
    (excited,) = flight._excited((flight.recording.yaw,))
    assert any(begin <= excited[0] and excited[1] <= end for begin, end in flight.phases["used"])
    still = make_report([write_csv(tmp_path / "still.csv", table(make_flight(seconds=12.0, Ts=0.02)))]).flights[0]
    assert still.found.reason
    assert still.phases["used"] == ()


def test_a_filter_costs_the_phase_that_it_takes_at_the_crossover(bench):
    report = bench[2]
    case = next(case for case in report.cases if case.label == "my")
    notch = LoopFilter("notch", NOTCH, 45.0, width_hz=30.0)
    response = case.flight.measured.response
    changed = behind(response, None, notch)
    assert changed.G_i / response.G_i == pytest.approx(
        np.broadcast_to(notch.response(response.omega)[:, None, None], response.G_i.shape)
    )
    assert np.array_equal(changed.G_o, response.G_o)
    assert behind(changed, notch, None).G_i == pytest.approx(response.G_i)
    torque = air_spectrum(case.flight.signal("u"), case.flight.airborne)
    case = of_both_axes(case, Thresholds())
    found = filter_changes(case, [], [Tone(45.0, 20.0, 0)], torque, Thresholds())
    rows = _change_table(found, case).rows
    assert float(rows[1][3]) - float(rows[0][3]) == pytest.approx(float(rows[1][4]), abs=0.11)
    crossing = 20.0  # rad/s, about: of the sensitivity's rise
    assert [change.text for change in found] == ["add a notch: IMU_GYRO_NF0_FRQ 45, IMU_GYRO_NF0_BW 10"]
    narrow = LoopFilter("notch", NOTCH, 45.0, width_hz=10.0)
    assert found[0].margin_deg == pytest.approx(-narrow.lag_deg(crossing), abs=0.5)
    assert found[0].margin_deg < 0
    assert not found[0].advised


def test_advice_rests_on_the_torque_and_the_certificate_not_on_the_tone_alone(bench):
    case = of_both_axes(next(case for case in bench[2].cases if case.label == "my"), Thresholds())
    flight = case.flight
    torque = flight.signal("u")
    hum = np.sin(2 * np.pi * 70 * torque.time)[:, None]
    quiet = Series(torque.time, 0.05 * torque.values + 0.005 * hum, "u")
    loud = Series(torque.time, torque.values + 0.05 * hum, "u")
    for series, advised, why in ((torque, False, "not worth"), (quiet, False, "which is quiet"), (loud, True, "power")):
        spectrum = air_spectrum(series, flight.airborne)
        change = filter_changes(case, [], [Tone(70.0, 20.0, 0)], spectrum, Thresholds())[0]
        assert change.advised is advised, change.why
        assert why in change.why
    strict = Thresholds(Ms=1.05, thin_Ms=1.1)
    assert not filter_changes(case, [], [Tone(70.0, 20.0, 0)], spectrum, strict)[0].advised


def test_weak_coherence_in_the_known_band_is_told_with_what_it_means_for_the_margins(bench):
    case = bench[2].cases[0]
    response, loops = case.flight.measured.response, loops_of(case)
    run = response.known_run()
    omega = response.omega[run]
    low, high = deciding_range(loops.axis_loops[0], loops.omega)
    assert low < crossover(loops.axis_loops[0], loops.omega) < high
    for begin, end, decides in ((low, high, True), (3 * high, 5 * high, False)):
        hit = (response.omega >= begin) & (response.omega <= end)
        coherence = np.where(hit[:, None], [0.5, 0.9], np.where(response.omega <= omega[-1], 0.9, 0.1)[:, None])
        weak = replace(response, coherence=coherence)
        first, last = response.omega[hit][[0, -1]]
        assert weak_ranges(weak) == [(first, last)]
        note = coherence_note(weak, loops.axis_loops, loops.omega)
        assert f"below 0.7 at {first:.3g} to {last:.3g} rad/s, inside the known band" in note
        assert ("fly the experiment again" in note) is decides
        assert ("nothing to do" in note) is not decides
    strong = replace(response, coherence=np.ones_like(response.coherence))
    assert coherence_note(strong, loops.axis_loops, loops.omega) == ""


def test_gains_whose_crossover_the_flight_does_not_show_get_bounds_and_another_experiment(bench):
    _, gains, report = bench
    fast = gains.with_elements({"RD_RR": 0.04, "RD_PP": 0.04})
    cases = gain_cases(report.flights, [("fast", fast)], TuningSpec())
    assert cases[-1].unknown.startswith("excitation ends at")
    told = headline(report.flights, cases)
    assert told.sentence.startswith("The gains 'fast' cannot be judged from this flight: excitation ends at")
    assert told.tone == "doubt"
    assert told.steps[0].startswith("Fly the experiment again with other frequencies")
    assert not any("tune" in step for step in told.steps)
    rows = {row[0]: row[-1] for row in margin_table(cases).rows}
    assert rows["Ms"].startswith("at least ")
    assert rows["disk margin"].startswith("at most ")
    assert rows["phase margin, roll"] == rows["delay margin, roll"] == "not known"
    assert of_both_axes(cases[-1], Thresholds()) is None
    assert "Ms" not in _set_figures(*cases)
    wrong = replace(gains, moment_scale=tuple(2 * one for one in gains.moment_scale))
    refused = headline(report.flights, gain_cases(report.flights, [("other", wrong)], TuningSpec()))
    assert refused.sentence.startswith("No certificate for 'other': ")
    assert "mimopilot convert" in refused.sentence


def test_the_band_of_yaw_is_shaded_in_its_sensitivity(bench):
    report = bench[2]
    chart = next(one for one in report.charts if one.name == "stability-yaw")
    spans = [(mark.begin, mark.end) for mark in chart.panels[0].marks if isinstance(mark, SpanMark)]
    band = report.cases[-1].gains.certificate.figures["yaw"]["band"]
    assert spans == [pytest.approx(tuple(band))]
    assert tuple(band) != report.cases[-1].gains.certificate.band


def test_a_lower_derivative_filter_quiets_the_predicted_torque(bench):
    _, gains, report = bench
    case = next(case for case in report.cases if case.label == "my")
    cutoffs = [
        replace(gains, filters=replace(gains.filters, derivative_cutoff_hz=hertz)) for hertz in (10.0, 30.0, 60.0)
    ]
    noise = [torque_noise(one, case.flight.wide) for one in cutoffs]
    assert noise[0] < noise[1] < noise[2]
    assert least_phase(case.gains.certificate) == min(case.gains.certificate.figures["phase_margin_deg"].values())


def test_the_derivative_filter_of_a_stock_set_is_its_own(gains):
    stock = StockFilters("px4-stock", derivative_hz=(30.0, 30.0, 30.0))
    own = replace(gains.filters, derivative_cutoff_hz=0.0, stock=stock)
    diagonal = {name: np.diag(np.diag(matrix)) for name, matrix in gains.matrices.items()}
    changed = with_derivative_filter(replace(gains, filters=own, **diagonal), 20.0)
    assert changed.filters.stock.derivative_hz == (20.0, 20.0, 30.0)
    assert with_derivative_filter(gains, 20.0).derivative_cutoff_hz == 20.0


def test_what_is_used_leaves_the_gaps_out(bench):
    flight = replace(bench[2].flights[0])
    flight.__dict__["_gaps"] = lambda: ((2.0, 3.0), (5.0, 5.5))
    length = flight.span[1] - flight.span[0]
    used = [pytest.approx(part, abs=0.01) for part in ((0.0, 2.0), (3.0, 5.0), (5.5, length))]
    assert list(flight.phases["used"]) == used


def test_certified_gains_are_put_on_the_vehicle_by_the_command_of_their_controller(bench, gains):
    case = next(case for case in bench[2].cases if case.label == "my")
    stock = replace(
        gains.filters, derivative_cutoff_hz=0.0, stock=StockFilters("px4-stock", derivative_hz=(30.0, 30.0, 30.0))
    )
    diagonal = {name: np.diag(np.diag(matrix)) for name, matrix in gains.matrices.items()}
    for one, wanted in ((case.gains, "BAUD"), (replace(gains, filters=stock, **diagonal), "--profile px4-stock")):
        step = _next_step(replace(case, gains=one, problem="left out"), Certificate(Verdict.CERTIFIED, ""))
        assert step.startswith("Put them on the vehicle: mimopilot upload GAINS")
        assert step.endswith(wanted)
    table = next(one for one in bench[2].tables if one.caption.startswith("Gains"))
    assert ["controller", "mimo", "mimo"] in [list(row) for row in table.rows]


def test_phases_of_a_flight_are_told_apart(tmp_path):
    flight = make_flight(seconds=12.0, still=(2.0, 1.0))
    landed = ((flight.t < 12.0) | (flight.t > 21.0)).astype(np.uint8)
    topics = px4_topics(
        flight, vehicle_land_detected={"timestamp": np.round(flight.t * 1e6).astype(np.uint64), "landed": landed}
    )
    report = make_report([write_ulog(tmp_path / "hop.ulg", topics)])
    phases = report.flights[0].phases
    assert set(phases) == set(PHASES)
    (first, last) = phases["ground"]
    assert first == pytest.approx((0.0, 2.0), abs=0.01)
    assert last == pytest.approx((11.0, 12.0), abs=0.01)
    assert phases["air"][0] == pytest.approx((2.0, 11.0), abs=0.01)
    assert not phases["crash"] and not phases["gaps"]
    assert report.sections[0].heading == "Timeline"


def test_the_detail_of_a_flight_is_where_it_is_excited_even_if_a_setpoint_moves_a_little_elsewhere(bench):
    flight = bench[2].flights[0]
    t = np.arange(0.0, 24.0, 0.01)
    nudge = np.where((t > 20) & (t < 21), math.radians(0.5), 0.0)[:, None] * np.ones(2)
    injected = np.where((t > 4) & (t < 8), math.radians(8) * np.sin(6 * t), 0.0)[:, None] * np.ones(2)
    signals = {"r_o": Series(t, nudge, "r"), "y_o": Series(t, nudge + injected, "y")}
    recording = replace(flight.recording, signals=signals)
    begin, end = busiest(replace(flight, found=replace(flight.found, recording=recording)), (0.0, 24.0))
    assert begin == pytest.approx(4.0)
    assert end == pytest.approx(8.0)
    signals["r_o"] = Series(t, nudge + injected, "r")
    assert busiest(replace(flight, found=replace(flight.found, recording=recording)), (0.0, 24.0)) == (begin, end)


def test_the_tracking_error_is_that_of_the_signals_in_the_air():
    t = np.arange(0, 10, 0.01)
    setpoint, answer = np.zeros((len(t), 2)), np.zeros((len(t), 2))
    setpoint[t >= 5] = math.radians(2.0)
    error = tracking_error(Series(t, setpoint, "r"), Series(t, answer, "y"), [(4.0, 6.0)])
    assert np.sqrt(np.mean(error**2, axis=0)) == pytest.approx([math.sqrt(2.0)] * 2, rel=0.01)
    assert tracking_error(None, Series(t, answer, "y"), [(4.0, 6.0)]) is None
