import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tuning.errors import TuningError
from tuning.gains import MATRICES, Gains, gains_from_toml, gains_to_toml, load_gains

FINITE = st.floats(-1e6, 1e6, allow_nan=False)


@given(values=st.lists(FINITE, min_size=25, max_size=25), text=st.text(max_size=30))
def test_a_gains_file_reads_back_to_the_same_bits(values, text):
    from tuning.gains import YawGains

    matrices = {name: np.reshape(values[4 * i : 4 * i + 4], (2, 2)) for i, name in enumerate(MATRICES)}
    written = Gains(
        **matrices, yaw=YawGains(*values[20:]), Ts=0.004, derivative_cutoff_hz=30.0, provenance={"log": text}
    )
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
    assert gains.with_elements({"D_POLE": 0.5}).derivative_pole == pytest.approx(0.5, rel=1e-12)


@pytest.mark.parametrize("name", list(MATRICES))
def test_a_missing_matrix_is_an_error_and_never_zeros(gains, tmp_path, name):
    path = tmp_path / "x.gains.toml"
    gains.save(path)
    lines = path.read_text().splitlines()
    section = lines.index("[roll_pitch]")
    (drop,) = [i for i, line in enumerate(lines) if line.startswith(f"{name} =") and section < i < section + 6]
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
        ("schema = 1", "schema = 7", "schema: got 7"),
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
        gains.Ts = 1.0


def test_no_cutoff_means_no_filter(gains):
    assert dataclasses.replace(gains, derivative_cutoff_hz=0.0).derivative_pole == 0.0
    assert gains.derivative_pole == math.exp(-2 * math.pi * 30 * 0.004)
