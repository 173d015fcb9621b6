"""The control law in tuning agrees with the compiled C++, for every parameter."""

import dataclasses

import numpy as np
import pytest

from mimopilot.codegen.layout import offset
from mimopilot.codegen.native import NativeController, load_native
from mimopilot.tuning.law import response
from mimopilot.tuning.law_filters import Filters
from mimopilot.tuning.law_terms import ATTITUDE, ATTITUDE_FEEDFORWARD, LOOP_TERMS, TERMS
from mimopilot.tuning.parameter_row import Shape
from mimopilot.tuning.parameters import PARAMETERS, ROWS
from tests.codegen.input_rows import input_rows
from tests.conftest import coupled_gains, following_gains

INPUTS = ("attitude_setpoint", "attitude", "rates", "excitation")
#: Samples per period, and the lines at which responses are compared: 0.5 to 120 Hz of a 250 Hz loop.
SAMPLES = 2000
LINES = np.unique(np.geomspace(4, 960, 24).round().astype(int))[-20:]
#: rad and so on: small enough for the linear law and to reach no limit, large enough for single precision.
AMPLITUDE = 1e-3


@pytest.fixture(scope="module")
def library():
    return load_native(coupled_gains())


def compiled_response(library, gains):
    """Response of the compiled C++ to multisines, (lines, 6, 12): rate setpoint and torque from `INPUTS`."""
    phases = np.random.default_rng(0).uniform(0, 2 * np.pi, len(LINES))
    k = np.arange(2 * SAMPLES)
    signal = np.sum(np.cos(2 * np.pi * np.outer(LINES, k) / SAMPLES + phases[:, None]), axis=0) * AMPLITUDE
    spectrum = np.fft.fft(signal[SAMPLES:].astype(np.float32).astype(np.float64))[LINES]
    found = np.zeros((len(LINES), 6, 12), complex)
    for column in range(12):
        axes = np.zeros((2 * SAMPLES, 3))
        axes[:, column % 3] = signal
        outputs = NativeController(library, gains).run(input_rows(2 * SAMPLES, **{INPUTS[column // 3]: axes}))[SAMPLES:]
        assert not outputs["fault"].any()
        made = np.hstack([outputs["rates_setpoint"], outputs["moment"]]).astype(np.float64)
        found[:, :, column] = np.fft.fft(made, axis=0)[LINES] / spectrum[:, None]
    return found


def perturbed(gains, code):
    """The gains with one element changed considerably."""
    value = gains.elements()[code]
    changed = {"TS": 0.0025, "D_POLE": 0.8, "M_DAMP": 1.2, "M_OMEGA": 14.0}.get(code, 1.5 * value + 0.013)
    if code.startswith(("RMAX", "UMAX", "IMAX")):
        changed = 0.9 * value
    if code == "SP_SLEW":
        changed = 24.0  # beyond what the signals need
    return gains.with_elements({code: changed})


def distance(library, gains):
    """`difference` of the compiled code to the law."""
    omega = 2 * np.pi * LINES / SAMPLES / gains.Ts
    law = response(gains, omega)
    return difference(compiled_response(library, gains), law)


def difference(other, law):
    """Largest difference, relative to the largest response of that output to that kind of input."""
    size = np.abs(law).reshape(len(LINES), 6, 4, 3).max(axis=(0, 3), keepdims=True)
    size = np.broadcast_to(size, (len(LINES), 6, 4, 3)).reshape(law.shape)
    return np.max(np.abs(other - law) / np.where(size > 0, size, 1.0))


@pytest.mark.parametrize("base", [coupled_gains, following_gains])
@pytest.mark.parametrize("code", [parameter.code for parameter in PARAMETERS])
def test_the_law_and_the_compiled_code_respond_alike_when_any_parameter_changes(library, base, code):
    gains = perturbed(base(), code)
    assert gains.elements()[code] != base().elements()[code]
    assert distance(library, gains) < 1e-5


def test_each_parameter_changes_the_response_far_beyond_the_tolerance():
    """So the test above detects a law that omits a parameter; limits and the yaw weight do not act there."""
    omega = 2 * np.pi * LINES / SAMPLES / 0.004
    start = response(following_gains(), omega)
    for parameter in PARAMETERS:
        if not parameter.code.startswith(("RMAX", "UMAX", "IMAX", "YAW_W", "SP_SLEW", "TS")):
            changed = response(perturbed(following_gains(), parameter.code), omega)
            assert difference(changed, start) > 1e-3, parameter.code


def test_every_gain_matrix_is_a_term_of_the_law():
    """Those of the attitude controller and those in `TERMS` are all the matrices; a shaped setpoint is no row of it."""
    terms = (ATTITUDE, ATTITUDE_FEEDFORWARD, *TERMS.values())
    assert {row.key for row in ROWS if row.shape is Shape.MATRIX} == {term.matrix for term in terms}
    assert "".join(LOOP_TERMS) == "PIDF"
    filters = {row.key for row in ROWS if row.shape in (Shape.POLE, Shape.SCALAR)}
    assert {field.name for field in dataclasses.fields(Filters)} == filters | {"stock", "shaping_s"}


def test_rows_are_contiguous_in_memory():
    sizes = [4 * len(row.codes) for row in ROWS]
    assert [offset(row) for row in ROWS] == list(np.cumsum([0, *sizes[:-1]]))
