import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mimopilot.tuning.certificate import Certificate
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains import Gains, gains_to_toml
from mimopilot.tuning.gains_file import gains_from_toml, load_gains
from mimopilot.tuning.law_filters import Filters
from mimopilot.tuning.parameters import MATRICES
from mimopilot.tuning.provenance import Provenance
from tests.conftest import coupled_gains, following_gains

FINITE = st.floats(-1e6, 1e6, allow_nan=False)


@given(
    values=st.lists(FINITE, min_size=33, max_size=33),
    model_omega=st.sampled_from([0.0, 3.0, 10.1]),
    text=st.text(max_size=30),
)
def test_a_gains_file_reads_back_to_the_same_bits(values, model_omega, text):
    from mimopilot.tuning.gains import YawGains

    matrices = {name: np.reshape(values[4 * i : 4 * i + 4], (2, 2)) for i, name in enumerate(MATRICES)}
    filters = Filters(0.004, 30.0, model_omega, 0.7 if model_omega < 5 else 1.1)
    written = Gains(**matrices, yaw=YawGains(*values[28:]), filters=filters, provenance=Provenance(log=text))
    read = gains_from_toml(gains_to_toml(written), "test")
    assert read.elements() == written.elements()
    assert read.provenance == written.provenance
    assert read.moment_scale is None


def test_every_element_can_be_replaced_by_its_code(gains):
    for code, value in gains.elements().items():
        if code in ("TS", "D_POLE"):
            continue
        changed = gains.with_elements({code: value + 0.125})
        differing = {c for c in gains.elements() if changed.elements()[c] != gains.elements()[c]}
        assert differing == {code}
    assert gains.with_elements({"D_POLE": 0.5}).filters.derivative_pole == pytest.approx(0.5, rel=1e-12)


@pytest.mark.parametrize("name", list(MATRICES))
def test_a_missing_matrix_is_an_error_and_never_zeros(tmp_path, name):
    path = tmp_path / "x.gains.toml"
    following_gains().save(path)
    lines = path.read_text().splitlines()
    section = lines.index("[roll_pitch]")
    (drop,) = [i for i, line in enumerate(lines) if line.startswith(f"{name} =") and section < i < section + 8]
    path.write_text("\n".join(lines[:drop] + lines[drop + 1 :]))
    with pytest.raises(TuningError, match=rf"x.gains.toml.*roll_pitch.{name}: missing"):
        load_gains(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("Kp_i = [[0.15, 0.02]", "Kp_i = [[nan, 0.02]", r"Kp_i\[0\]\[0\]: got nan"),
        ("Kp_i = [[0.15, 0.02]", "Kp_i = [[inf, 0.02]", r"Kp_i\[0\]\[0\]: got inf"),
        ("Kp_i = [[0.15, 0.02]", "Kp_i = [[0.15]", "Kp_i: got .* expected a 2x2"),
        ("Kp_i = [[0.15, 0.02]", 'Kp_i = [["a", 0.02]', "Kp_i: got .* expected a 2x2"),
        ("Ts = 0.004", "Ts = 0", "Ts: got 0"),
        ("Ts = 0.004", "Ts = true", "Ts: got True"),
        ("schema = 2", "schema = 7", "schema: got 7"),
        ("schema = 2", "schema = true", "schema: got True"),
        ("Kd_i = 0.01", "Kd_i = nan", "yaw.Kd_i: got nan"),
        ("[limits]", "[limit]", "limit: unknown entry"),
        ("rate_max = [5.0", "rate_max = [-5.0", r"limits.rate_max \(roll\): got -5"),
        ("moment_scale = [2.54592, 2.54592, 0.2736]", "moment_scale = [1]", "moment_scale: got"),
    ],
)
def test_a_wrong_entry_is_named(gains, old, new, message):
    text = gains_to_toml(gains)
    assert old in text
    with pytest.raises(TuningError, match=message):
        gains_from_toml(text.replace(old, new), "file")


def test_matrices_cannot_be_changed_in_place(gains):
    with pytest.raises(ValueError, match="read-only"):
        gains.Kp_i[0, 0] = 1.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        gains.filters = Filters(1.0)


def test_no_cutoff_means_no_filter(gains):
    assert dataclasses.replace(gains, filters=Filters(gains.Ts, 0.0)).filters.derivative_pole == 0.0
    assert gains.filters.derivative_pole == math.exp(-2 * math.pi * 30 * 0.004)


CERTIFICATE = Certificate.from_table(
    {
        "verdict": "unstable",
        "reason": "the determinant encircles 0: the rate loop alone is unstable",
        "figures": {"Ms": 1.4, "phase_margin_deg": {"roll": 45.0, "pitch": 46.0}, "gain_margin": {"roll": "at least"}},
        "band": [1.3, 100.0],
        "thresholds": {"Ms": 1.8, "phase_deg": 40.0, "thin_Ms": 2.5, "thin_phase_deg": 25.0},
        "log_sha256": "0123456789abcdef",
    }
)


def test_a_seal_survives_its_file_to_the_bit(gains):
    sealed = gains.with_certificate(CERTIFICATE)
    read = gains_from_toml(gains_to_toml(sealed), "test")
    assert read.verdict() == sealed.verdict() == (CERTIFICATE.verdict, CERTIFICATE.reason)
    assert gains.verdict()[0] == "none"
    assert sealed.with_certificate(None).verdict()[0] == "none"


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('verdict = "unstable"', 'verdict = "certified"'),
        ("alone is unstable", "alone is well damped"),
        ("Ms = 1.4", "Ms = 1.3"),
        ("pitch = 46.0", "pitch = 46.5"),
        ('roll = "at least"', 'roll = "exact"'),
        ("band = [1.3, 100.0]", "band = [1.3, 200.0]"),
        ("thin_Ms = 2.5", "thin_Ms = 9.5"),
        ("phase_deg = 40.0", "phase_deg = 4.0"),
        ("0123456789abcdef", "0123456789abcdee"),
    ],
)
def test_an_edited_text_or_figure_voids_the_certificate(gains, old, new):
    text = gains_to_toml(gains.with_certificate(CERTIFICATE))
    assert text.count(old) >= 1
    head, tail = text.split("[certificate", 1)
    assert old in tail
    edited = gains_from_toml(f"{head}[certificate{tail.replace(old, new, 1)}", "test")
    assert edited.verdict() == ("void", "the gains or the certificate were edited after it was made")


@pytest.mark.parametrize("base", [coupled_gains, following_gains])
def test_an_edit_of_any_number_of_the_controller_voids_the_certificate(base):
    """Every gain and limit, the period, the cut-off, the model and the unit of torque, even in the last bit."""
    sealed = base().with_certificate(CERTIFICATE)
    gains = sealed
    for code, value in gains.elements().items():
        changed = sealed.with_elements({code: math.nextafter(value, math.inf)})
        assert changed.verdict()[0] == "void", code
    assert dataclasses.replace(sealed, filters=Filters(sealed.Ts, 30.5)).verdict()[0] == "void"
    assert dataclasses.replace(sealed, moment_scale=(2.6, 2.54592, 0.2736)).verdict()[0] == "void"
    assert dataclasses.replace(sealed, moment_scale=None).verdict()[0] == "void"
    assert dataclasses.replace(sealed, provenance=Provenance(details={"note": "mine"})).verdict()[0] == "unstable"


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("Kp_o = [[6.0, 0.3]", "Kp_o = [[6.0, 0.4]"),
        ("Kff_i = [[0.02, 0.001]", "Kff_i = [[0.02, 0.002]"),
        ("Ts = 0.004", "Ts = 0.005"),
        ("derivative_cutoff_hz = 30.0", "derivative_cutoff_hz = 40.0"),
        ("moment_scale = [2.54592", "moment_scale = [3.54592"),
        ("rate_max = [5.0", "rate_max = [6.0"),
        ("Ki_i = 0.1", "Ki_i = 0.2"),
    ],
)
def test_a_number_edited_in_the_file_voids_the_certificate(gains, old, new):
    text = gains_to_toml(gains.with_certificate(CERTIFICATE))
    assert old in text
    assert gains_from_toml(text.replace(old, new, 1), "test").verdict()[0] == "void"


def test_a_certificate_without_a_seal_or_of_another_set_is_void(gains):
    plain = dataclasses.replace(gains, certificate=CERTIFICATE)
    assert plain.verdict()[0] == "void"
    assert "has no seal" in plain.verdict()[1]
    other = gains.with_elements({"AP_RR": 7.0}).with_certificate(CERTIFICATE)
    borrowed = dataclasses.replace(gains, certificate=other.certificate)
    assert borrowed.verdict()[0] == "void"
