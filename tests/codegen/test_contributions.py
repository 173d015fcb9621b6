"""``core/contributions.hpp``, compiled: the parts of the controller output that a vehicle logs."""

import cffi
import numpy as np
import pytest

from mimopilot.codegen.native import NativeController, load_native
from mimopilot.codegen.render import render, write_tree
from mimopilot.codegen.toolchain import compile_shared, find_compiler
from mimopilot.codegen.vectors import random_inputs
from mimopilot.tuning.parameters import MATRICES
from tests.codegen.input_rows import input_rows
from tests.conftest import coupled_gains, following_gains

PARTS = ("proportional", "integral", "derivative", "feedforward", "cross")
CALLER = """
#include "core/contributions.hpp"

extern "C" void parts_of(const void *state, const void *output, float *parts)
{
    mimopilot::Contributions made;
    const auto &flown = *static_cast<const mimopilot::State *>(state);
    mimopilot::contributions(flown, *static_cast<const mimopilot::Output *>(output), made);
    __builtin_memcpy(parts, &made, sizeof(made));
}
"""


@pytest.fixture(scope="module")
def parts_of(tmp_path_factory):
    """Parts of a controller's last step with an output, (5, 3), in the order of `PARTS`."""
    tree = tmp_path_factory.mktemp("parts")
    write_tree(render(coupled_gains(), "native"), tree)
    (tree / "caller.cpp").write_text(CALLER)
    compile_shared(find_compiler(), [tree / "caller.cpp"], tree / "parts.so")
    ffi = cffi.FFI()
    ffi.cdef("void parts_of(const void *, const void *, float *);")
    library = ffi.dlopen(str(tree / "parts.so"))

    def parts(controller, output):
        found = np.zeros((len(PARTS), 3), np.float32)
        addresses = (ffi.from_buffer(a) for a in (controller.state, output))
        library.parts_of(*addresses, ffi.from_buffer("float[]", found))
        return found.astype(float)

    return parts


@pytest.fixture(scope="module")
def library():
    return load_native(coupled_gains())


def diagonal(gains):
    """The gains without coupling."""
    codes = [f"{code}_{pair}" for code in MATRICES.values() for pair in ("RP", "PR")]
    return gains.with_elements(dict.fromkeys(codes, 0.0))


@pytest.mark.parametrize("base", [coupled_gains, following_gains])
@pytest.mark.parametrize("coupled", [True, False])
def test_the_parts_sum_to_the_controller_output_in_every_mode(parts_of, library, base, coupled):
    gains = base() if coupled else diagonal(base())
    wide = gains.with_elements({f"UMAX_{axis}": 1.0 for axis in "RPY"})
    controller = NativeController(library, wide)
    inputs = random_inputs(4000, np.random.default_rng(3))
    compared = faulty = in_rate_mode = 0
    for row in np.split(inputs, len(inputs)):
        output = controller.run(row)
        parts = parts_of(controller, output)
        excitation = np.where(np.abs(row["excitation"][0]) <= 1, row["excitation"][0], 0).astype(float)
        u, fault = output["moment"][0].astype(float), output["fault"][0]
        v = u if fault else u - excitation
        lost = np.array([fault >> (2 + j) & 1 for j in range(3)], bool)  # those have no torque
        inside = (np.abs(u) < 1) & ~lost
        size = np.abs(parts).sum(axis=0) + np.abs(excitation) + 1e-30
        assert (np.abs(parts.sum(axis=0) - v) < 1e-6 * size)[inside].all()
        assert (parts[4] == 0).all() or coupled
        assert parts[4, 2] == 0
        compared += inside.sum()
        faulty += bool(fault)
        in_rate_mode += bool(row["rate_mode"][0])
    assert compared > 8000 and faulty > 30 and in_rate_mode > 500


def test_each_part_is_that_of_its_own_gains(parts_of, library):
    """By hand, in the third period of constant rates and setpoint, in rate mode."""
    gains = coupled_gains()
    r, y = np.array([0.3, -0.2, 0.1]), np.array([[0, 0, 0], [0.1, 0.2, -0.1], [0.1, 0.2, -0.1]])
    controller = NativeController(library, gains)
    output = controller.run(input_rows(3, rate_mode=1, rates_setpoint=r, rates=y))
    found = dict(zip(PARTS, parts_of(controller, output[2:].copy()), strict=True))

    def own(name):
        return np.append(np.diag(getattr(gains, name)), getattr(gains.yaw, name))

    def other(name, x):
        matrix = getattr(gains, name)
        return np.array([matrix[0, 1] * x[1], matrix[1, 0] * x[0], 0.0])

    a = gains.filters.derivative_pole
    e, d = r - y[2], a * (1 - a) * y[1] / 0.004
    sum_of_e = 3 * r - y.sum(axis=0)
    Ki = np.diag(own("Ki_i"))
    Ki[:2, :2] = gains.Ki_i
    assert found["proportional"] == pytest.approx(own("Kp_i") * e, rel=1e-5)
    assert found["derivative"] == pytest.approx(-own("Kd_i") * d, rel=1e-5)
    assert found["feedforward"] == pytest.approx(own("Kff_i") * r, rel=1e-5)
    assert found["integral"] == pytest.approx(0.004 * Ki @ sum_of_e, rel=1e-5)
    cross = other("Kp_i", e) - other("Kd_i", d) + other("Kff_i", r)
    assert found["cross"] == pytest.approx(cross, rel=1e-5, abs=1e-9)
