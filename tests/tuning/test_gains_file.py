"""The gains file: schemas, defaults, and the parameter table behind it."""

import dataclasses

import pytest

from mimopilot.tuning.certificate import Certificate, Verdict
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains import Limits, YawGains, gains_to_toml
from mimopilot.tuning.gains_file import gains_from_toml
from mimopilot.tuning.law import Filters
from mimopilot.tuning.parameter_row import Row, Shape
from mimopilot.tuning.parameters import ROWS, rows
from mimopilot.tuning.reference_model import SecondOrder

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


def test_every_row_has_its_place_in_the_types_of_the_gains():
    for kind, shapes in ((YawGains, [Shape.YAW]), (Limits, [Shape.AXES]), (Filters, [Shape.POLE, Shape.SCALAR])):
        assert {field.name for field in dataclasses.fields(kind)} == {row.key for row in rows(*shapes)}
    assert all(row.default is None for row in rows(Shape.MATRIX, Shape.YAW))  # there are no default gains


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
