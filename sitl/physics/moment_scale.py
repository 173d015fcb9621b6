"""The unit of the torque (normalised). Gains used with another unit are wrong in loop gain by the ratio of the two."""

from __future__ import annotations

from collections.abc import Sequence

from mimopilot.sitl.errors import SitlError
from mimopilot.tuning.gains import Gains

TOLERANCE = 0.01  # of each value; chosen: above the rounding of values written with 4 digits, harmless in loop gain


def check_moment_scale(gains: Gains, scale: Sequence[float], whose: str) -> None:
    """Refuse gains whose unit of torque is not that of the target.

    Parameters
    ----------
    gains : Gains
        The gains to check.
    scale : sequence of 3 float, N m
        Torque of u = 1 on the target: roll, pitch, yaw.
    whose : str
        Name of the target in messages.

    Raises
    ------
    SitlError
        When they differ by more than 1 %, naming both, or the gains do not state their unit.
    """
    theirs = ", ".join(f"{v:.4g}" for v in scale)
    if gains.moment_scale is None:
        raise SitlError(
            "moment_scale: the gains do not say how many N m one unit of torque stands for; write it into the gains "
            f"file ({whose} has {theirs})"
        )
    pairs = zip(gains.moment_scale, scale, strict=True)
    if any(abs(ours - target) > TOLERANCE * abs(target) for ours, target in pairs):
        raise SitlError(
            f"moment_scale: the gains are for {', '.join(f'{v:.4g}' for v in gains.moment_scale)} N m per unit, "
            f"{whose} has {theirs}; tune on a log of this vehicle, or convert them (mimopilot convert) if they "
            "are for this vehicle under another allocator"
        )
