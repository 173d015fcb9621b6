"""The gains file: schemas, defaults, and the parameter table behind it."""

import dataclasses
import re

import numpy as np
import pytest

from mimopilot.tuning.certificate import Certificate, Verdict
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains import Limits, YawGains, gains_to_toml
from mimopilot.tuning.gains_file import gains_from_toml
from mimopilot.tuning.law_filters import Filters
from mimopilot.tuning.parameter_row import Row, Shape
from mimopilot.tuning.parameters import MATRICES, ROWS, rows
from mimopilot.tuning.reference_model import SecondOrder
from tests.conftest import coupled_gains, following_gains

SCHEMA_1 = """
schema = 1
Ts = 0.004
derivative_cutoff_hz = 30.0
moment_scale = [2.5, 2.5, 0.3]

[roll_pitch]
Kp_o = [[6.0, 0.0], [0.0, 6.0]]
Kp_i = [[0.15, 0.02], [0.01, 0.13]]
Ki_i = [[0.1, 0.0], [0.0, 0.1]]
Kd_i = [[0.003, 0.0], [0.0, 0.002]]
Kff_i = [[0.0, 0.0], [0.0, 0.0]]

[yaw]
Kp_o = 1.5
Kp_i = 0.5
Ki_i = 0.1
Kd_i = 0.0
Kff_i = 0.0

[limits]
rate_max = [10.0, 10.0, 3.5]
moment_max = [1.0, 1.0, 1.0]
integral_max = [0.3, 0.3, 0.3]

[certificate]
verdict = "certified"
reason = "assumed"
figures = {Ms = 1.4}
band = [1.3, 200.0]
thresholds = {Ms = 1.8}
log_sha256 = "00"
seal = "0123"

[provenance]
method = "mimo"
inner_model = [[30.0, 0.7, 0], [25.0, 0.6, 1]]
outer_model = [[10.0, 0.7, 0], [10.0, 0.7, 0]]
structure = "PID"
"""


def test_a_file_of_schema_1_is_read_and_its_certificate_is_void_with_the_reason():
    gains = gains_from_toml(SCHEMA_1, "old.gains.toml")
    assert gains.Kp_i.tolist() == [[0.15, 0.02], [0.01, 0.13]]
    assert gains.provenance.inner_model == (SecondOrder(30.0, 0.7, 0), SecondOrder(25.0, 0.6, 1))
    verdict, reason = gains.verdict()
    assert verdict == Verdict.VOID
    assert "schema 1" in reason
    again = gains_from_toml(gains_to_toml(gains), "new.gains.toml")
    assert gains_to_toml(again).startswith(gains_to_toml(gains)[:200])
    assert "schema = 2" in gains_to_toml(again)
    assert again.verdict() == (verdict, reason)
    assert again.provenance == gains.provenance
    sealed = again.with_certificate(Certificate(Verdict.CERTIFIED, "anew"))
    assert gains_from_toml(gains_to_toml(sealed), "x").verdict() == (Verdict.CERTIFIED, "anew")


def test_a_matrix_that_is_missing_from_an_old_file_is_an_error():
    with pytest.raises(TuningError, match=r"old: roll_pitch\.Ki_i: missing"):
        gains_from_toml(SCHEMA_1.replace("Ki_i = [[", "Kx_i = [["), "old")


def test_a_parameter_that_is_newer_than_the_file_has_the_default_of_the_table(monkeypatch):
    """As a row that is added to the table will have; a row without a default must be in the file."""
    cutoff = next(row for row in ROWS if row.key == "derivative_cutoff_hz")
    text = SCHEMA_1.replace("derivative_cutoff_hz = 30.0\n", "")
    with pytest.raises(TuningError, match="derivative_cutoff_hz: missing"):
        gains_from_toml(text, "old")
    with_default = [dataclasses.replace(row, default=12.0) if row is cutoff else row for row in ROWS]
    monkeypatch.setattr("mimopilot.tuning.gains_file.ROWS", tuple(with_default))
    assert gains_from_toml(text, "old").derivative_cutoff_hz == 12.0


def test_arducopters_shaping_is_kept_and_changes_no_certificate():
    gains = coupled_gains()
    shaped = dataclasses.replace(gains, filters=dataclasses.replace(gains.filters, shaping_s=0.15))
    shaped = shaped.with_certificate(Certificate(Verdict.CERTIFIED, "assumed"))
    text = gains_to_toml(shaped)
    assert "shaping_s = 0.15" in text and "shaping_s" not in gains_to_toml(gains)
    again = gains_from_toml(text, "x")
    assert gains_to_toml(again) == text and again.filters == shaped.filters
    assert again.with_elements({"RP_RR": 0.2}).filters == shaped.filters
    # It is outside of the loop.
    assert gains_from_toml(text.replace("shaping_s = 0.15", "shaping_s = 0.0"), "x").verdict()[0] == "certified"
    with pytest.raises(TuningError, match=r"shaping_s: got -1\.0 s, expected at least 0"):
        gains_from_toml(text.replace("shaping_s = 0.15", "shaping_s = -1.0"), "x")


def test_every_row_has_its_place_in_the_types_of_the_gains():
    for kind, shapes in ((YawGains, [Shape.YAW]), (Limits, [Shape.AXES]), (Filters, [Shape.POLE, Shape.SCALAR])):
        keys = {field.name for field in dataclasses.fields(kind)} - {"stock", "shaping_s"}
        assert keys == {row.key for row in rows(*shapes)}
    # There are no default gains, except of an option that is off.
    assert all(row.default is None or row.option for row in rows(Shape.MATRIX, Shape.YAW))
    defaults = {field.name: field.default for field in dataclasses.fields(Filters)}
    assert all(defaults[row.key] == row.default for row in rows(Shape.SCALAR) if row.default is not None)


def test_what_a_set_holds_for_its_rows_makes_the_same_set(gains):
    again = type(gains).from_rows({row: gains.of(row) for row in ROWS}, moment_scale=gains.moment_scale)
    assert again.elements() == gains.elements()
    assert gains_to_toml(again) == gains_to_toml(gains)


@pytest.mark.parametrize(
    ("model", "message"),
    [
        ("[30.0]", "inner_model: got .* expected"),
        ('{type = "third_order", omega = 3.0}', "type second_order"),
        ('{type = "second_order", omega = 3.0}', "the numbers of a second_order model"),
        ('{type = "second_order", omega = "fast", zeta = 0.7}', "its numbers"),
        ("[30.0, -0.7, 0]", "damping -0.7"),
    ],
)
def test_a_reference_model_that_is_none_is_refused(model, message):
    text = SCHEMA_1.replace("[25.0, 0.6, 1]", model)
    with pytest.raises(TuningError, match=message):
        gains_from_toml(text, "file")


def test_the_valid_values_of_a_row_are_said():
    assert {str(row.valid) for row in rows(Shape.AXES)} == {"more than 0"}
    row = Row("x", "x", "X", Shape.SCALAR, "", 0.0, 1.0, "of this test")
    assert row.valid.holds(-1e9)
    assert not row.valid.holds(float("nan"))


def test_an_old_file_loads_without_model_following_and_is_written_without_its_keys(gains):
    old = gains_from_toml(SCHEMA_1, "old")
    assert old.filters.followed is None
    assert not np.any(old.Kff_o) and not np.any(old.Kaff_i)
    for one in (old, gains):
        assert not re.search("model_|Kff_o|Kaff_i|Model", gains_to_toml(one))


def test_a_file_with_model_following_holds_its_keys_and_its_law():
    text = gains_to_toml(following_gains())
    for line in ("model_damping = 0.8", "model_omega = 9.0  # rad/s", "Kff_o = [[0.9, 0.04], [-0.03, 1.05]]"):
        assert f"\n{line}\n" in text
    assert text.startswith(gains_to_toml(coupled_gains()).split("schema")[0] + "# Model following")
    assert "schema = 2" in text
    read = gains_from_toml(text, "x")
    assert gains_to_toml(read) == text
    assert read.elements() == following_gains().elements()
    assert gains_from_toml(text.replace("model_damping = 0.8\n", ""), "x").filters.model_damping == 0.7


def test_gains_that_are_kept_while_the_model_is_off_are_written(gains):
    kept = dataclasses.replace(gains, Kff_o=np.eye(2))
    assert list(kept.matrices) == ["Kp_o", "Kp_i", "Ki_i", "Kd_i", "Kff_i"]
    read = gains_from_toml(gains_to_toml(kept), "x")
    assert read.Kff_o.tolist() == [[1, 0], [0, 1]]
    assert list(dataclasses.replace(kept, filters=following_gains().filters).matrices) == list(MATRICES)


def test_a_matrix_that_is_missing_while_the_model_is_on_is_refused(gains):
    on = gains_to_toml(gains).replace("Ts = 0.004", "Ts = 0.004\nmodel_omega = 9.0")
    message = r"^x: roll_pitch\.Kff_o: missing; it has no default while model_omega is not 0: give it, or set model_om"
    with pytest.raises(TuningError, match=message):
        gains_from_toml(on, "x")
    values = {row: gains.of(row) for row in ROWS if row.key not in ("Kaff_i", "model_omega")}
    omega = next(row for row in ROWS if row.key == "model_omega")
    with pytest.raises(TuningError, match=r"^roll_pitch\.Kaff_i: missing"):
        type(gains).from_rows(values | {omega: 9.0})
    assert not np.any(type(gains).from_rows(values).Kaff_i)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("model_omega = 62.6", r"model_omega: got 62\.6 rad/s, expected at most 0\.25/Ts, 62\.5 rad/s"),
        ("model_omega = 1e300", "expected at most 0.25/Ts"),
        ("model_omega = -1.0", "model_omega: got -1.0 rad/s, expected at least 0"),
        ("model_omega = nan", "model_omega: got nan"),
        ("model_omega = 9.0\nmodel_damping = 0.05", "model_damping: got 0.05, expected at least 0.1 and at most 2"),
        ("model_omega = 9.0\nmodel_damping = 2.1", "model_damping: got 2.1, expected at least 0.1 and at most 2"),
        ('model_omega = "9"', "model_omega: got .* expected a number"),
    ],
)
def test_a_model_that_the_recursion_cannot_follow_is_refused(gains, line, message):
    matrices = "Kff_o = [[1.0, 0.0], [0.0, 1.0]]\nKaff_i = [[0.0, 0.0], [0.0, 0.0]]"
    text = gains_to_toml(gains).replace("Ts = 0.004", f"Ts = 0.004\n{line}")
    with pytest.raises(TuningError, match=message):
        gains_from_toml(text.replace("[roll_pitch]", f"[roll_pitch]\n{matrices}"), "x")


def test_a_certificate_of_a_set_without_model_following_keeps_its_seal(gains):
    """Sealed by the version before model following."""
    sealed = gains.with_certificate(Certificate(Verdict.CERTIFIED, "before"))
    assert sealed.certificate is not None
    assert sealed.certificate.seal == "1cbc1c6bc57ef9fd7f70fee88c37821e4613e26325f0d51dec623df75e64e92f"


def test_the_torque_of_the_models_acceleration_has_the_unit_of_torque(gains):
    converted = following_gains().with_moment_scale((5.09184, 2.54592, 0.2736))
    assert converted.Kaff_i == pytest.approx(following_gains().Kaff_i * [[0.5], [1.0]])
    assert (converted.Kff_o == following_gains().Kff_o).all()
