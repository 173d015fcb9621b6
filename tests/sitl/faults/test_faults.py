"""Faults: their notation, and their effects against values worked out by hand."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mimopilot.codegen.native import NativeController, load_native
from mimopilot.common.errors import InputFileError
from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.autopilot.setpoints import STALE_SECONDS
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.faults.inject_plant import FaultInjection
from mimopilot.sitl.faults.kinds import KINDS, fault_help, parse_fault, parse_faults
from mimopilot.sitl.flight.flight_log import save_flight
from mimopilot.sitl.flight.scenario import doublet, excitation_flight, hover, load_scenario, step
from mimopilot.sitl.flight.simulator import Simulator, fly
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.sitl.physics.rigid_body import GRAVITY
from mimopilot.tuning.design.cascade import tune
from mimopilot.tuning.logs.reader import read_log
from mimopilot.tuning.spec import load_spec
from tests.conftest import assert_one_clear_line

TS = 0.004


@pytest.fixture(scope="module")
def vehicle():
    return load_airframe("adam0")


@pytest.fixture(scope="module")
def library(vehicle):
    return load_native(vehicle.default_gains())


@pytest.fixture(scope="module")
def flown(vehicle, library):
    """Fly a scenario with faults, by default without noise."""

    def run(scenario, *texts, seed=0, noise=False):
        gains = vehicle.default_gains()
        autopilot = Autopilot(vehicle.airframe, gains, NativeController(library, gains))
        faults = tuple(map(parse_fault, texts))
        return fly(vehicle.airframe, autopilot, replace(scenario, faults=faults), seed, noise)

    return run


def injection(vehicle, *texts, seed=0, seconds=None):
    simulator = Simulator(vehicle.airframe, TS, 0, noise=False)
    faults = tuple(map(parse_fault, texts))
    return simulator, FaultInjection(faults, vehicle.airframe, simulator, TS, seed, seconds=seconds)


def link(vehicle, text, samples, seed=0):
    """Runs and command ages of a flight with one fault of the link."""
    _, injected = injection(vehicle, text, seed=seed)
    pieces = list(injected.segments(0, samples))
    assert len(pieces) == 1
    return pieces[0][1:]


# Notation.

POSITIVE = st.floats(0, 1e6, allow_nan=False)


@st.composite
def notations(draw):
    name = draw(st.sampled_from(sorted(KINDS)))
    kind = KINDS[name]
    target = {
        "motor": st.integers(1, 16).map(str),
        "axis": st.sampled_from(["roll", "pitch", "yaw"]),
        "position": st.lists(st.floats(-10, 10), min_size=3, max_size=3).map(lambda p: ",".join(map(repr, p))),
        "matrix": st.sampled_from(["Kp_o", "Kp_i", "Ki_i", "Kd_i", "Kff_i"]),
        None: st.just(""),
    }[kind.target]
    text = name
    if kind.target and (kind.needs_target or draw(st.booleans())):
        text += ":" + draw(target)
    if kind.unit is not None:
        text += "=" + repr(draw(st.floats(kind.smallest, kind.largest)))
    text += "@" + repr(draw(POSITIVE))
    if kind.lasts and draw(st.booleans()):
        text += "+" + repr(draw(st.floats(1e-9, 1e6)))
    return text


@given(notations())
def test_a_fault_reads_back_from_its_own_text_as_the_same_fault(text):
    fault = parse_fault(text)
    assert parse_fault(str(fault)) == fault


@given(notations())
def test_each_field_is_read_from_its_place(text):
    fault, head = parse_fault(text), text.split("@")[0]
    assert fault.kind == head.split("=")[0].split(":")[0]
    if "=" in head:
        assert fault.size == float(head.split("=")[1])
    at, *duration = text.split("@")[1].replace("e+", "e").split("+")
    assert fault.at == float(at)
    assert fault.duration == (float(duration[0]) if duration else None)


def test_help_names_every_kind_with_the_unit_of_its_size():
    lines = {line.split(":")[0].split("=")[0].split("[")[0]: line for line in fault_help().splitlines()[1:]}
    assert set(lines) == set(KINDS)
    for name, kind in KINDS.items():
        assert kind.unit is None or f"[{kind.unit}, " in lines[name]


WRONG = {
    "motor:5=0.5@1": ("adam0 has motors 1 to 4",),
    "motor=0.5@1": ("needs a motor",),
    "motor:x=0.5@1": ("motor", "integer"),
    "motor:3=1.5@1": ("size: got 1.5", "0 to 1 (share)"),
    "motor:3@1": ("size: got none", "share"),
    "mass=1@1": ("needs a position",),
    "mass:1,2=1@1": ("position",),
    "mass:0,0,0=0@1": ("0.001 to 100 (kg)",),
    "gyro-bias:up=1@1": ("axis", "roll, pitch or yaw"),
    "gyro-bias=nan@1": ("size", "finite"),
    "gyro-stuck=1@1": ("takes no size",),
    "delay:3=0.01@1": ("takes no target",),
    "gain:Kp=2@1": ("matrix",),
    "gain:Kp_o=8@1": ("MIMO_AP_RR would be 52", "0.01 to 50"),
    "skip=3@1+1": ("takes no duration",),
    "link@-1": ("at:", "greater than or equal to 0"),
    "link@1+0": ("duration", "greater than 0"),
    "link@7": ("begins at 7 s, but the flight ends at 2.916 s",),
    "rocket@1": ("unknown kind 'rocket'", "motor, battery"),
    "motor:3=0.7": ("expected KIND[:TARGET][=SIZE]@AT[+DURATION]",),
}


@pytest.mark.parametrize("text", WRONG)
def test_a_wrong_fault_is_refused_with_its_text_and_what_was_expected(flown, text):
    with pytest.raises(SitlError) as caught:
        flown(doublet("roll", 0.2, 0.42, TS), text)
    assert caught.value.exit_code == 2
    assert str(caught.value).startswith(f"fault '{text}': ")
    for word in WRONG[text]:
        assert word in str(caught.value)


def test_a_plant_process_refuses_faults_of_the_autopilot():
    assert [str(fault) for fault in parse_faults(["motor:1=0.5@2", "loss=0.1@0"], ("plant", "link"), "it")] == [
        "motor:1=0.5@2",
        "loss=0.1@0",
    ]
    with pytest.raises(SitlError, match="fault 'stale@1': acts on the autopilot, which is not part of it"):
        parse_faults(["stale@1"], ("plant", "link"), "it")


FILE = """
manoeuvre = "doublet"
axis = "pitch"
amplitude_deg = 15
period_s = 0.42

[[fault]]
kind = "motor"
motor = 3
size = 0.7
at = 1.2
duration = 0.5

[[fault]]
kind = "loss"
size = 0.2
at = 1
"""


def test_a_scenario_file_flies_as_the_same_options_on_the_command_line(mimopilot, tmp_path):
    (tmp_path / "a.toml").write_text(FILE)
    given = ("--axis", "pitch", "--amplitude-deg", 15, "--fault", "motor:3=0.7@1.2+0.5", "--fault", "loss=0.2@1")
    from_file = mimopilot("fly", "adam0", "--scenario", "a.toml", "--json")
    from_options = mimopilot("fly", "adam0", *given, "--json")
    assert from_file.returncode == 0, from_file.stderr
    assert from_file.stdout == from_options.stdout
    assert json.loads(from_file.stdout)["faults"] == ["motor:3=0.7@1.2+0.5", "loss=0.2@1"]
    refused = mimopilot("fly", "adam0", "--scenario", "a.toml", "--axis", "roll")
    assert_one_clear_line(refused, "--axis", "a.toml")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("doublet", "loop"), ("manoeuvre", "'loop'")),
        (("amplitude_deg", "amplitude"), ("amplitude", "unknown entry")),
        (("= 15", "= 90"), ("got 90 degrees",)),
        (("motor = 3", "engine = 3"), ("fault 1", "engine")),
        (("size = 0.2", "size = 2"), ("fault 2", "0 to 1 (probability)")),
        (("[[fault]]", "[fault]"), ("not a TOML file",)),
        (("= 0.42", "= 0.42.1"), ("not a TOML file",)),
    ],
)
def test_an_error_in_a_scenario_file_is_reported_with_its_name_and_entry(tmp_path, change, words):
    path = tmp_path / "wrong.toml"
    path.write_text(FILE.replace(*change))
    with pytest.raises((SitlError, InputFileError)) as caught:
        load_scenario(path, TS)
    for word in (str(path), *words):
        assert word in str(caught.value)


# Effects.


def test_a_flight_cut_into_segments_equals_the_whole_one_in_every_bit(flown):
    scenario = doublet("roll", 0.3, 0.42, TS)
    whole = flown(scenario, noise=True, seed=4)
    # A motor that keeps all of its thrust, a delay that is the vehicle's own, gains times one.
    cut = flown(scenario, "motor:2=1@0.8+0.3", f"delay={TS}@0.5+1", "gain=1@1.3+0.1", noise=True, seed=4)
    assert cut.record.tobytes() == whole.record.tobytes()
    assert cut.truth.tobytes() == whole.truth.tobytes()


@pytest.mark.parametrize("share", [0.9, 0.7, 0.0])
def test_a_weak_motor_gives_the_moment_of_its_lost_thrust(vehicle, share):
    simulator, injected = injection(vehicle, f"motor:3={share}@0")
    next(injected.segments(0, 1))
    airframe, plant = vehicle.airframe, simulator.plant
    thrust = airframe.mass * GRAVITY / 4
    simulator.state[13 + 2] *= np.sqrt(share)  # its speed has settled
    commands = np.full(16, thrust / airframe.motors.thrust_max, np.float32)
    for _ in range(3):
        simulator.advance(commands)
    lost = (1 - share) * thrust
    x, y, _ = airframe.rotors[2].position
    moment = np.array([lost * y, -lost * x, lost * airframe.motors.torque_ratio])  # motor 3 rotates clockwise
    # Within 12 ms only this moment matters; damping is about 1 %.
    expected = np.linalg.solve(np.array(airframe.inertia), moment) * 3 * TS
    assert simulator.state[10:13] == pytest.approx(expected, rel=0.02, abs=1e-6)
    assert plant.effectiveness.tolist() == [1.0, 1.0, share, 1.0]


def settled_thrust(flight, vehicle, share=1.0):
    """Thrust (N) of each motor at the end of a hover."""
    return flight.record["commands"][-50:, :4].mean(axis=0) * share * vehicle.airframe.motors.thrust_max


def test_the_weak_motor_finally_carries_a_quarter_of_the_weight_again(flown, vehicle):
    flight = flown(hover("roll", 40.0, TS), "motor:3=0.7@1")
    thrust = settled_thrust(flight, vehicle, np.array([1, 1, 0.7, 1]))
    assert thrust == pytest.approx(np.full(4, vehicle.airframe.mass * GRAVITY / 4), rel=2e-3)
    assert np.degrees(np.abs(flight.truth["attitude"][-50:, :2]).max()) < 0.05


def test_a_sagging_battery_reduces_the_thrust_in_a_ramp(flown, vehicle):
    simulator, injected = injection(vehicle, "battery=0.8@0.4+0.2")
    shares = {}
    for piece, _, _ in injected.segments(0, 300):
        shares[piece.start] = float(simulator.plant.effectiveness[0])
    assert [shares[k] for k in (0, 100, 125, 150)] == pytest.approx([1.0, 1.0, 0.9, 0.8])
    assert list(shares.values()) == sorted(shares.values(), reverse=True)
    thrust = settled_thrust(flown(hover("roll", 20.0, TS), "battery=0.8@1+2"), vehicle, 0.8)
    assert thrust.sum() == pytest.approx(vehicle.airframe.mass * GRAVITY, rel=1e-4)


def test_a_load_in_flight_is_carried_by_the_motors_near_it(flown, vehicle):
    load, place = 0.16, np.array([0.1, -0.12, 0.05])
    mass = vehicle.airframe.mass + load
    thrust = settled_thrust(flown(hover("roll", 40.0, TS), "mass:0.1,-0.12,0.05=0.16@1"), vehicle)
    assert thrust.sum() == pytest.approx(mass * GRAVITY, rel=1e-4)
    # The lever rule: the centre of thrust is above the centre of gravity.
    centre = np.array([rotor.position for rotor in vehicle.airframe.rotors]).T @ thrust / thrust.sum()
    assert centre[:2] == pytest.approx(load * place[:2] / mass, rel=5e-3)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_attaching_a_load_keeps_position_and_velocity_and_detaching_restores_the_plant(seed):
    vehicle = load_airframe("adam0")
    generator = np.random.default_rng(seed)
    x, y, z = generator.uniform(-0.3, 0.3, 3)
    simulator, injected = injection(vehicle, f"mass:{x},{y},{z}={generator.uniform(0.1, 1)}@0.004+0.004")
    state = simulator.state
    state[3:6], state[10:13] = generator.normal(size=3), generator.normal(size=3)
    state[6:10] = generator.normal(size=4)
    state[6:10] /= np.linalg.norm(state[6:10])

    def rotor():
        w, a, b, c = state[6:10]
        rotation = np.array(
            [
                [1 - 2 * (b * b + c * c), 2 * (a * b - w * c), 2 * (a * c + w * b)],
                [2 * (a * b + w * c), 1 - 2 * (a * a + c * c), 2 * (b * c - w * a)],
                [2 * (a * c - w * b), 2 * (b * c + w * a), 1 - 2 * (a * a + b * b)],
            ]
        )
        arm = simulator.plant.rotors[1]
        return np.concatenate([state[0:3] + rotation @ arm, state[3:6] + rotation @ np.cross(state[10:13], arm)])

    before, healthy, found = rotor(), simulator.plant, []
    for _ in injected.segments(0, 3):
        found.append((rotor(), simulator.plant.mass))
    assert [mass > healthy.mass for _, mass in found] == [False, True, False]
    for place, _ in found:
        assert place == pytest.approx(before, abs=1e-12)
    for name in ("mass", "inertia", "rotors", "effectiveness"):
        assert getattr(simulator.plant, name) == pytest.approx(getattr(healthy, name), rel=1e-12, abs=1e-15)


def test_a_biased_gyro_tilts_the_vehicle_by_the_bias_over_the_attitude_gain(flown, vehicle):
    # The integrator brings the measured rate to its setpoint, which then equals the bias: -Kp_o phi = bias.
    flight = flown(hover("roll", 30.0, TS), "gyro-bias:roll=0.2@1")
    expected = -0.2 / vehicle.default_gains().Kp_o[0, 0]
    assert flight.truth["attitude"][-1, 0] == pytest.approx(expected, rel=1e-3)
    assert abs(flight.truth["attitude"][-1, 1]) < 1e-3


def test_one_nan_sample_moves_the_vehicle_by_less_than_a_tenth_of_a_degree(flown):
    scenario = doublet("roll", np.radians(15), 0.42, TS)
    healthy, flight = flown(scenario, noise=True), flown(scenario, "gyro-nan@1.1+0.004", noise=True)
    assert np.isnan(flight.record["rates"]).any(axis=1).nonzero()[0].tolist() == [275]
    assert np.isfinite(flight.record["moment"]).all()
    assert 0 < np.degrees(np.abs(flight.truth["attitude"] - healthy.truth["attitude"]).max()) < 0.1


def test_a_stuck_gyro_repeats_its_rate_on_one_axis_only_and_then_measures_again(flown):
    rates = flown(doublet("roll", 0.2, 0.42, TS), "gyro-stuck:roll@1.1+0.1", noise=True).record["rates"]
    repeats = np.flatnonzero(rates[1:] == rates[:-1])
    same = (rates[1:] == rates[:-1]).nonzero()
    assert len(repeats) == 25
    assert (same[0] + 1).tolist() == list(range(275, 300))
    assert set(same[1].tolist()) == {0}


def test_gyro_noise_has_its_size_while_the_fault_lasts(flown):
    flight = flown(hover("roll", 12.0, TS), "gyro-noise=0.1@4+4", noise=True)
    error = (flight.record["rates"] - flight.truth["rates"]).reshape(3, 1000, 3).std(axis=1)
    assert error == pytest.approx(np.array([[0.01] * 3, [0.1] * 3, [0.01] * 3]), rel=0.08)


def test_a_delay_applies_to_every_command(vehicle):
    runs, ages = link(vehicle, "delay=0.02@0.04+0.04", 40)
    assert runs is None
    # Sample 10 is the first that is 5 periods late: until it arrives the command of sample 9 - 1 acts on, and 9 itself.
    assert ages.tolist() == [1] * 10 + [1, 2, 3, 4, 5] + [5] * 5 + [5, 1] + [1] * 18


def test_the_limit_cycle_starts_at_the_delay_margin_that_the_certificate_gives(vehicle, library, tmp_path):
    own = vehicle.default_gains()
    scenario = excitation_flight(20.0, 0.15, 50.0, TS, np.random.default_rng(0))
    experiment = fly(vehicle.airframe, Autopilot(vehicle.airframe, own, NativeController(library, own)), scenario, 0)
    save_flight(tmp_path / "a.ulg", experiment, vehicle.airframe, own)
    gains = tune(read_log(tmp_path / "a.ulg"), load_spec(method="mimo"))
    assert gains.certificate is not None
    margin = min(gains.certificate.figures["delay_margin_ms"].values()) / 1e3
    allowed = int(vehicle.airframe.computing_delay + margin / TS)  # whole periods, the vehicle's own among them

    def growth(periods):
        faults = (parse_fault(f"delay={periods * TS}@0.5"),)
        task = replace(step("roll", np.radians(2.0), 15.0, TS), faults=faults)
        flight = fly(vehicle.airframe, Autopilot(vehicle.airframe, gains), task, 0, noise=False)
        rates = np.abs(flight.truth["rates"][:, 0])
        return rates[-500:].max() / rates[500:1000].max()

    assert 4 < allowed < 12
    assert growth(allowed) < 0.1
    assert growth(allowed + 1) > 3


def test_jitter_delivers_the_newest_command_that_has_arrived(vehicle):
    _, ages = link(vehicle, "jitter=0.02@0", 4000)
    acting = np.arange(4000) - ages
    assert (np.diff(acting) >= 0).all()
    assert ages.min() == 1 and 3 <= ages.max() <= 6
    # The newest of commands that are 1 to 6 periods late, alike: older than d when all d before it come later.
    shares = [np.prod([(6 - i) / 6 for i in range(1, d)]) for d in range(1, 7)]
    for d, share in enumerate(shares, 1):
        assert np.mean(ages >= d) == pytest.approx(share, abs=0.03)


def test_measurements_are_lost_with_the_given_probability_and_differ_between_seeds(vehicle):
    runs = [link(vehicle, "loss=0.3@0", 10_000, seed)[0] for seed in (1, 1, 2)]
    assert (runs[0] == runs[1]).all()
    assert (runs[0] != runs[2]).any()
    assert set(runs[0]) == {0, 1}
    assert np.mean(runs[0] == 0) == pytest.approx(0.3, abs=4 * np.sqrt(0.3 * 0.7 / 10_000))
    doubled = link(vehicle, "duplicate=0.3@0", 10_000)[0]
    assert set(doubled) == {1, 2}
    assert np.mean(doubled == 2) == pytest.approx(0.3, abs=4 * np.sqrt(0.3 * 0.7 / 10_000))


@pytest.mark.parametrize(("text", "missing"), [("skip=5@0.4", 5), ("clock=0.1@0.4", 25), ("link@0.4+0.2", 50)])
def test_an_autopilot_without_ticks_holds_its_outputs(flown, text, missing):
    flight = flown(hover("roll", 1.0, TS), text, noise=True)
    assert np.flatnonzero(flight.runs == 0).tolist() == list(range(100, 100 + missing))
    for name in ("moment", "commands", "rates"):
        held = flight.record[name][99 : 100 + missing]
        assert (held == held[0]).all()
        assert (flight.record[name][100 + missing] != held[0]).any()


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.lists(st.integers(1, 60), min_size=1, max_size=8))
def test_one_period_at_a_time_gives_the_same_link_as_long_segments(seed, blocks):
    vehicle = load_airframe("adam0")
    texts = ("loss=0.3@0.01+0.5", "duplicate=0.2@0.1", "jitter=0.02@0.05+0.3", "delay=0.03@0.2+0.1", "loss=0.1@0")

    def flown_in(sizes):
        _, injected = injection(vehicle, *texts, seed=seed)
        start, runs, ages = 0, [], []
        for size in sizes:
            for _, ran, late in injected.segments(start, start + size):
                runs, ages = [*runs, *ran], [*ages, *late]
            start += size
        return runs, ages

    assert flown_in(blocks) == flown_in([1] * sum(blocks))


def test_corrupted_gains_are_written_into_the_controller_and_then_restored(vehicle, library):
    gains = replace(vehicle.default_gains(), Kff_o=np.eye(2), Kaff_i=0.006 * np.eye(2))
    controller = NativeController(library, gains)
    autopilot = Autopilot(vehicle.airframe, gains, controller)
    before = controller.state["gains"][0].copy()
    simulator = Simulator(vehicle.airframe, TS, 0)
    faults = tuple(map(parse_fault, ("gain:Kp_i=0.5@0.004+0.008", "gain=2@0.008+0.008")))
    injected = FaultInjection(faults, vehicle.airframe, simulator, TS, 0, autopilot=autopilot)
    held = np.array([controller.state["gains"][0].copy() for _ in injected.segments(0, 5)])
    factors = np.ones((5, len(before)), np.float32)
    Kp_i = slice(4, 8)
    factors[1, Kp_i] = 0.5
    factors[2, :28], factors[2, Kp_i] = 2, 1  # both at once
    factors[3, :28] = 2  # seven matrices of four; neither yaw nor a limit
    assert (held == factors * before).all()


def test_a_stale_setpoint_is_flown_for_half_a_second_and_then_level_with_its_heading(flown):
    scenario = hover("roll", 2.0, TS)
    scenario.setpoint[:] = [0.1, -0.05, 0.2]
    scenario.setpoint[60:, 0] = 0.2
    flown_for = flown(scenario, "stale@0.2+1").record["setpoint"]
    last_fresh = 49 + round(STALE_SECONDS / TS)
    assert (flown_for[: last_fresh + 1] == np.float32([0.1, -0.05, 0.2])).all()
    assert (flown_for[last_fresh + 1 : 300] == np.float32([0, 0, 0.2])).all()
    assert (flown_for[300:] == np.float32([0.2, -0.05, 0.2])).all()
    blip = flown(scenario, "stale@0.2+0.4").record["setpoint"]
    assert (blip[:150] == np.float32([0.1, -0.05, 0.2])).all()
    assert (blip[150:] == np.float32([0.2, -0.05, 0.2])).all()
