"""Test vectors: random inputs, and the outputs of the independent Python reference, bit for bit."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.codegen.layout import INPUT, OUTPUT
from mimopilot.tuning.controller import Controller
from mimopilot.tuning.gains import Gains

#: Control periods of the emitted test, and the seed of all test vectors; chosen.
ROWS, SEED = 256, 1


def random_inputs(rows: int, generator: np.random.Generator) -> NDArray[Any]:
    """Random inputs that reach every branch of the controller.

    Normal flight, saturation, denormals, and values that are not finite or far out of range: single ones, and runs
    longer than the 25 periods for which the controller holds an input.

    Parameters
    ----------
    rows : int
        Number of control periods.
    generator : numpy.random.Generator
        Source of all randomness.

    Returns
    -------
    (rows,) array of `codegen.layout.INPUT`
    """
    # All magnitudes and probabilities are chosen to reach the branches often enough.
    inputs = np.zeros(rows, INPUT)
    scale = 10.0 ** generator.uniform(-3, 0.5, (rows, 1))
    for name, size in (("rates", 3.0), ("rates_setpoint", 3.0), ("excitation", 0.1)):
        inputs[name] = np.clip(generator.standard_normal((rows, 3)) * scale, -8, 8) * size
    inputs["excitation"] = np.clip(inputs["excitation"], -1, 1)
    turns = generator.standard_normal((rows, 3)) * np.clip(scale, 0, 1)
    for name, share in (("attitude", 1.0), ("attitude_setpoint", generator.choice([0.0, 1.0, 1.3], (rows, 1)))):
        inputs[name] = _quaternions(turns * share + 0.3 * generator.standard_normal((rows, 3)) * scale, generator)
    some = slice(None, None, max(1, rows // 4))
    inputs["attitude_setpoint"][some] = inputs["attitude"][some][:, [1, 0, 3, 2]]  # about half a turn
    inputs["yaw_rate_setpoint"] = generator.choice([np.nan, 0.0, 0.5, -2.0], rows)
    inputs["saturation"] = generator.choice([-1, 0, 0, 0, 1], (rows, 3))
    inputs["armed"] = generator.random(rows) > 0.02
    inputs["landed"] = generator.random(rows) < 0.05
    inputs["rate_mode"] = np.arange(rows) % 160 >= 120
    inputs["silent"] = np.where(generator.random(rows) < 0.005, 1 << generator.integers(0, 5, rows), 0)
    extreme = np.array([np.nan, np.inf, -np.inf, 1e38, -1e38, 1e-40, -1e-42, 0.0, -0.0, 100.0, 12.6], np.float32)
    for name in ("attitude_setpoint", "attitude", "rates_setpoint", "rates", "excitation"):
        hit = generator.random(inputs[name].shape) < 0.01
        inputs[name][hit] = generator.choice(extreme, int(hit.sum()))
    inputs["yaw_rate_setpoint"][generator.random(rows) < 0.01] = 1e38
    for _ in range(max(1, rows // 500)):
        start = int(generator.integers(0, max(1, rows - 60)))
        name = ("attitude_setpoint", "attitude", "rates_setpoint", "rates")[int(generator.integers(4))]
        inputs[name][start : start + int(generator.integers(20, 40)), int(generator.integers(3))] = np.nan
    return inputs


def _quaternions(turns: NDArray[np.float64], generator: np.random.Generator) -> NDArray[np.float64]:
    """Quaternions (N, 4) of rotation vectors (N, 3), rad, of either sign and a length up to 0.5 % from 1."""
    angle = np.linalg.norm(turns, axis=1, keepdims=True)
    q = np.hstack([np.cos(angle / 2), np.sin(angle / 2) * turns / np.maximum(angle, 1e-12)])
    factor = generator.choice([-1, 1], (len(q), 1)) * generator.choice([1.0, 0.995, 1.005], (len(q), 1))
    return np.asarray(factor * q, dtype=np.float64)


def reference_outputs(controller: Controller, inputs: NDArray[Any]) -> NDArray[Any]:
    """Outputs of the Python reference, as rows of `codegen.layout.OUTPUT`."""
    outputs = np.zeros(len(inputs), OUTPUT)
    for row, output in zip(inputs, outputs, strict=True):
        step = controller.step(
            row["rates_setpoint"] if row["rate_mode"] else row["attitude_setpoint"],
            row["attitude"],
            row["rates"],
            row["excitation"],
            row["saturation"],
            bool(row["armed"]),
            bool(row["landed"]),
            row["yaw_rate_setpoint"],
            bool(row["rate_mode"]),
            int(row["silent"]),
        )
        output["moment"], output["rates_setpoint"] = step.moment, step.rates_setpoint
        output["fault"], output["fault_count"] = step.fault, step.fault_count
    return outputs


def emitted_vectors(gains: Gains) -> dict[str, list[list[str]]]:
    """Inputs and expected outputs for the emitted test, as rows of 32-bit hexadecimal words."""
    inputs = random_inputs(ROWS, np.random.default_rng(SEED))
    outputs = reference_outputs(Controller(gains), inputs)
    return {"inputs": _words(inputs), "outputs": _words(outputs)}


def _words(rows: NDArray[Any]) -> list[list[str]]:
    words = rows.view(np.uint32).reshape(len(rows), -1)
    return [[f"0x{int(word):08x}U" for word in row] for row in words]
