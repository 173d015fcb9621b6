"""Rows of `codegen.layout.INPUT` from angles."""

import numpy as np
from scipy.spatial.transform import Rotation

from mimopilot.codegen.layout import INPUT

LEVEL = (1.0, 0.0, 0.0, 0.0)


def quaternion(angles):
    """Quaternions (..., 4), w x y z, of roll, pitch, yaw (..., 3), rad."""
    angles = np.asarray(angles, float)
    rotation = Rotation.from_euler("ZYX", angles.reshape(-1, 3)[:, ::-1])
    return as_wxyz(rotation).reshape(*angles.shape[:-1], 4)


def as_wxyz(rotation):
    """Quaternions (N, 4), w x y z, of rotations; w is not negative."""
    return rotation.as_quat(canonical=True)[..., [3, 0, 1, 2]]


def rotation_of(q):
    """Rotations of quaternions w x y z."""
    return Rotation.from_quat(np.asarray(q, float)[..., [1, 2, 3, 0]])


def tilted(tilt, heading=0.0):
    """Quaternions (..., 4) of a heading (rad), then a tilt (..., 2): 2 sin of half its angle, times its axis."""
    roll, pitch = np.moveaxis(np.asarray(tilt, float) / 2, -1, 0)
    upright, c, s = np.sqrt(1 - roll**2 - pitch**2), np.cos(heading / 2), np.sin(heading / 2)
    return np.stack([c * upright, c * roll - s * pitch, c * pitch + s * roll, s * upright], axis=-1)


def input_rows(rows=1, *, attitude_setpoint=LEVEL, attitude=LEVEL, **values):
    """Armed rows with the given fields, the others 0 and level.

    Attitudes are angles, (..., 3), roll, pitch, yaw, rad, or quaternions, (..., 4).
    """
    inputs = np.zeros(rows, INPUT)
    inputs["armed"] = 1
    for name, value in {"attitude_setpoint": attitude_setpoint, "attitude": attitude}.items():
        inputs[name] = quaternion(value) if np.shape(value)[-1] == 3 else value
    for name, value in values.items():
        inputs[name] = value
    return inputs
