"""What `import mimopilot` offers, beside what the command line does."""

import json
import os
import subprocess
import sys

import matplotlib
import numpy as np
import pytest

import mimopilot as mp
from mimopilot.tuning.reference_model import SecondOrder
from tests.sitl.mavlink.running import running_sitl

SECONDS = 12.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("api")


@pytest.fixture(scope="module")
def log(folder):
    return mp.experiment("adam0", folder / "flight.ulg", seconds_per_axis=SECONDS, seed=3)


@pytest.fixture(scope="module")
def gains(log):
    return mp.tune(log, inner=(30, 0.7, 0), outer=(10, 0.7, 0))


def test_every_public_name_is_there_and_no_other():
    for name in mp.__all__:
        assert getattr(mp, name) is not None
    with pytest.raises(AttributeError, match=r"no attribute 'tuna'; public names: .*tune"):
        mp.tuna  # noqa: B018
    assert mp.__version__


def test_an_experiment_is_the_log_that_it_writes(log, folder):
    again = mp.read_log(str(folder / "flight.ulg"))
    assert again.sha256 == log.sha256
    assert np.array_equal(again.u, log.u)
    assert mp.inspect(folder / "flight.ulg").reason is None


def test_tuning_gives_the_same_bytes_as_the_command_whatever_the_caller_loaded_before(gains, folder):
    """Here numpy is loaded by a script with several BLAS threads; the command is a process of its own."""
    script = (
        "import numpy, scipy.linalg; numpy.linalg.svd(numpy.ones((300, 300)))\n"
        "import mimopilot as mp\n"
        "mp.tune('flight.ulg', inner=(30, 0.7, 0), outer=(10, 0.7, 0)).save('script.gains.toml')"
    )
    threads = {f"{name}_NUM_THREADS": "4" for name in ("OPENBLAS", "OMP", "MKL")}
    subprocess.run([sys.executable, "-c", script], cwd=folder, check=True, env={**os.environ, **threads})
    command = ["tune", "flight.ulg", "--inner", "30,0.7,0", "--outer", "10,0.7,0", "--out", "command.gains.toml"]
    subprocess.run([sys.executable, "-m", "mimopilot", *command], cwd=folder, check=True, capture_output=True)
    assert (folder / "script.gains.toml").read_bytes() == (folder / "command.gains.toml").read_bytes()
    gains.save(folder / "here.gains.toml")
    assert (folder / "here.gains.toml").read_bytes() == (folder / "command.gains.toml").read_bytes()
    assert mp.load_gains(folder / "here.gains.toml").elements() == gains.elements()


def test_a_specification_can_be_overridden(log):
    given = mp.tune(log, inner=(25, 0.5), outer=(9, 0.8), method="siso", structure="PI")
    assert (given.provenance.method, given.provenance.details["structure"]) == ("siso", "PI")
    assert given.provenance.inner_model[0] == SecondOrder(25, 0.5, 0)
    assert not np.any(given.Kd_i)


def test_a_certificate_is_made_of_a_log_and_gains(log, gains, folder):
    examined = mp.certify(log, gains)
    assert isinstance(examined.certificate, mp.Certificate)
    assert examined.verdict()[0] is mp.Verdict.CERTIFIED
    assert examined.certificate.figures == gains.certificate.figures
    assert "certified" in repr(examined)
    assert len(repr(examined)) < 200


def test_a_flight_has_the_figures_of_the_command(gains, folder):
    gains.save(folder / "fly.gains.toml")
    flight = mp.fly("adam0", folder / "fly.gains.toml", axis="pitch", seed=5)
    command = [sys.executable, "-m", "mimopilot", "fly", "adam0", "--gains", "fly.gains.toml", "--axis", "pitch"]
    done = subprocess.run([*command, "--seed", "5", "--json"], cwd=folder, check=True, capture_output=True, text=True)
    printed = json.loads(done.stdout)
    for name, value in vars(mp.performance(flight, gains)).items():
        assert printed[name] == value, name
    body = mp.load_airframe("adam0")
    assert isinstance(body, mp.Airframe)
    assert mp.performance(mp.fly(body, gains, axis="pitch", seed=5), gains) == mp.performance(flight, gains)
    lost = mp.fly("adam0", gains, faults=["motor:1=0@0.5"], seed=5)
    assert lost.crashed_at > 0.5


def test_code_is_generated_for_a_target(gains, folder):
    tree = mp.generate(gains, str(folder / "cpp"), target="px4", px4_api="descriptor")
    assert folder / "cpp" / "core" / "mimo_pid.cpp" in tree.files == tree.written
    assert all(path.is_file() for path in tree.files)
    assert mp.generate(gains, folder / "cpp", target="px4", px4_api="descriptor").written == []
    assert tree.warnings == []
    with pytest.raises(mp.Error, match="target: got 'zx81', expected one of ardupilot, cortex-m4, "):
        mp.generate(gains, folder / "cpp", target="zx81")


def test_gains_reach_a_vehicle_or_nothing_does(gains, folder):
    with running_sitl() as sitl:
        url = f"tcp:127.0.0.1:{sitl.tcp}"
        assert mp.upload(gains, url, dry_run=True).state == "dry run"
        done = mp.upload(gains, url, snapshot=folder / "old.params")
        assert done.state == "verified"
        assert (folder / "old.params").read_text().count("MIMO_")
        again = mp.upload(gains, url)
        assert again.state == "verified"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: mp.read_log("none.ulg"), "none.ulg: no such file"),
        (lambda: mp.load_gains("none.toml"), "none.toml: cannot read"),
        (lambda: mp.load_airframe("adam1"), "unknown airframe 'adam1'"),
        (lambda: mp.fly(mp.load_airframe("adam0")), "has none of its own; give them"),
        (lambda: mp.fly("adam0", on="abacus"), "expected one of native, cortex-m4"),
        (lambda: mp.tune("none.ulg", inner=(-1, 0.7, 0)), "inner.*omega -1"),
        (lambda: mp.tune("none.ulg", magic=True), "magic"),
    ],
)
def test_a_mistake_is_one_family_of_errors(call, message):
    with pytest.raises(mp.Error, match=message) as caught:
        call()
    assert caught.value.exit_code == 2


def test_figures_are_axes_with_labels_and_the_flown_signals(gains):
    flight = mp.fly("adam0", gains)
    axes = mp.plot_flight(flight)
    assert axes.shape == (3, 2)
    setpoint, attitude = axes[0, 0].get_lines()
    assert np.allclose(attitude.get_ydata(), np.degrees(flight.truth["attitude"][:, 0]))
    assert np.allclose(setpoint.get_ydata(), np.degrees(flight.record["setpoint"][:, 0]))
    assert axes[0, 0].get_ylabel() == "[deg]"
    assert isinstance(axes[0, 0].figure, matplotlib.figure.Figure)


def test_the_bode_plot_is_the_controller_in_closed_form(gains):
    axes = mp.plot_bode(gains)
    omega, gain = (np.asarray(data) for data in axes[0, 1].get_lines()[0].get_data())
    z, Ts, a = np.exp(1j * omega * gains.Ts), gains.Ts, np.exp(-2 * np.pi * gains.derivative_cutoff_hz * gains.Ts)
    element = gains.Kp_i[0, 1] + gains.Ki_i[0, 1] * Ts * z / (z - 1)
    element = element + gains.Kd_i[0, 1] * (1 - a) * (z - 1) / (Ts * (z - a))
    assert gain == pytest.approx(20 * np.log10(np.abs(element)), rel=1e-9)
