"""The unit of the control moment: gains moved between two units are wrong by their ratio in loop gain."""

from __future__ import annotations

from collections.abc import Sequence

from mimopilot.sitl.errors import SitlError
from mimopilot.tuning.gains import Gains

TOLERANCE = 0.01


def check_moment_scale(gains: Gains, scale: Sequence[float], whose: str) -> None:
    """Refuse gains whose unit of moment is not the target's.

    Parameters
    ----------
    gains : Gains
        The set.
    scale : sequence of 3 float, N m
        Moment of u = 1 on the target: roll, pitch, yaw.
    whose : str
        The target's name in messages.

    Raises
    ------
    SitlError
        When they differ by more than 1 %, naming both, or the gains do not say theirs.
    """
    theirs = ", ".join(f"{v:.4g}" for v in scale)
    if gains.moment_scale is None:
        raise SitlError(
            "moment_scale: the gains do not say how many N m one unit of moment stands for; write it into the gains "
            f"file ({whose} has {theirs})"
        )
    pairs = zip(gains.moment_scale, scale, strict=True)
    if any(abs(ours - target) > TOLERANCE * abs(target) for ours, target in pairs):
        raise SitlError(
            f"moment_scale: the gains are for {', '.join(f'{v:.4g}' for v in gains.moment_scale)} N m per unit, "
            f"{whose} has {theirs}; tune on a log of this vehicle, or convert them (mimopilot convert) if they "
            "are for this vehicle under another allocator"
        )
