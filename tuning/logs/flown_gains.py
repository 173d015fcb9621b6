"""The gains that flew, from the vehicle's parameters: this controller's (``MIMO_``), else PX4's (``MC_``)."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from mimopilot.tuning.gains import Gains, Limits, Triple, YawGains
from mimopilot.tuning.law import Filters
from mimopilot.tuning.parameter_row import PREFIX, cutoff_of
from mimopilot.tuning.parameters import LIMITS, MATRICES
from mimopilot.tuning.provenance import Provenance

SCALE = "SCALE"

#: Matrix -> PX4's parameter for an axis. PX4 multiplies the rate terms by MC_*RATE_K.
_PX4 = {
    "Kp_o": "MC_{axis}_P",
    "Kp_i": "MC_{axis}RATE_P",
    "Ki_i": "MC_{axis}RATE_I",
    "Kd_i": "MC_{axis}RATE_D",
    "Kff_i": "MC_{axis}RATE_FF",
}
_PX4_AXES = ("ROLL", "PITCH", "YAW")
_PX4_INTEGRAL = ("MC_RR_INT_LIM", "MC_PR_INT_LIM", "MC_YR_INT_LIM")


def flown_gains(parameters: Mapping[str, float], Ts: float) -> Gains | None:
    """The gains in a vehicle's parameters.

    Parameters
    ----------
    parameters : mapping
        Parameter name -> value, as logged.
    Ts : float, s
        Control period.

    Returns
    -------
    Gains or None
        None when the parameters do not describe a complete controller. Elements without a ``MIMO_`` parameter in
        the log (yaw, limits) are PX4's.
    """
    # Vehicles store float32: use the shortest decimal that rounds to the same float32.
    values = {name: float(str(np.float32(value))) for name, value in parameters.items()}

    def find(code: str, fallback: str, factor: float = 1.0) -> float:
        ours = values.get(PREFIX + code)
        return ours if ours is not None else factor * values.get(fallback, math.nan)

    def gain(name: str, i: int, j: int) -> float:
        code = f"{MATRICES[name]}_{'RPY'[i]}{'RPY'[j]}"
        if i != j:
            return values.get(PREFIX + code, 0.0)
        axis = _PX4_AXES[i]
        factor = 1.0 if name == "Kp_o" else values.get(f"MC_{axis}RATE_K", 1.0)
        return find(code, _PX4[name].format(axis=axis), factor)

    def triple(name: str, fallback: tuple[str, ...], factor: float) -> Triple:
        r, p, y = (find(f"{LIMITS[name]}_{letter}", key, factor) for letter, key in zip("RPY", fallback, strict=True))
        return r, p, y

    matrices = {name: np.array([[gain(name, i, j) for j in range(2)] for i in range(2)]) for name in MATRICES}
    yaw = YawGains(**{name: gain(name, 2, 2) for name in MATRICES})
    rates = tuple(f"MC_{axis}RATE_MAX" for axis in _PX4_AXES)
    limits = Limits(
        rate_max=triple("rate_max", rates, math.pi / 180),
        moment_max=tuple(values.get(f"{PREFIX}UMAX_{letter}", 1.0) for letter in "RPY"),  # type: ignore[arg-type]
        integral_max=triple("integral_max", _PX4_INTEGRAL, 1.0),
    )
    numbers = [*np.concatenate([m.ravel() for m in matrices.values()]), *vars(yaw).values()]
    numbers += [*limits.rate_max, *limits.moment_max, *limits.integral_max]
    if not np.isfinite(numbers).all():
        return None
    pole = values.get(PREFIX + "D_POLE")
    cutoff = values.get("IMU_DGYRO_CUTOFF", 0.0) if pole is None else float(f"{cutoff_of(pole, Ts):.6g}")
    scale = [values.get(f"{PREFIX}{SCALE}_{letter}") for letter in "RPY"]
    if min(*limits.rate_max, *limits.moment_max, *limits.integral_max) <= 0:
        return None
    return Gains(
        **matrices,  # type: ignore[arg-type]
        yaw=yaw,
        filters=Filters(Ts, cutoff),
        limits=limits,
        moment_scale=None if None in scale else tuple(scale),  # type: ignore[arg-type]
        provenance=Provenance("flown"),
    )
