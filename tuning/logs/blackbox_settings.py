"""Settings in the header of a Betaflight log, as the values of its command line."""

from __future__ import annotations

from collections.abc import Sequence

from mimopilot.tuning.logs.blackbox_file import BlackboxTable

#: Betaflight: type 0 of a low-pass is the first-order one, PT1 (lowpassFilterType_e in filter.h).
PT1 = 0
_AXES = ("roll", "pitch", "yaw")


def parameters(log: BlackboxTable) -> dict[str, float]:
    """Name on the command line -> value, of what the law needs; empty when the settings are not known.

    The cut-off of a dynamic low-pass of D is its lowest. Up to Betaflight 4.5 ``d_roll`` is the gain in fast
    movements and ``d_min_roll`` the one that is flown; since 2025.12 ``d_roll`` is flown and ``d_max_roll`` the
    gain in fast movements. The latter names are used.
    """
    found: dict[str, float] = {}
    flown_d = log.numbers("d_min")
    for axis, name in enumerate(_AXES):
        gains = log.numbers(f"{name}PID")
        if len(gains) < 3:
            return {}
        found |= dict(zip((f"p_{name}", f"i_{name}", f"d_{name}"), gains, strict=False))
        if len(flown_d) == 3 and 0 < flown_d[axis] < gains[2]:
            found[f"d_{name}"] = flown_d[axis]
    given = {"angle_p_gain": log.number("levelPID")}
    given |= {f"dterm_lpf{which}_static_hz": _cutoff(log, which) for which in (1, 2)}
    given |= {f"{axis}_rate_limit": limit for axis, limit in zip(_AXES, log.numbers("rate_limits"), strict=False)}
    windup = log.number("iterm_windup")
    for which_limit in ("", "_yaw"):
        limit = log.number(f"pidsum_limit{which_limit}")
        given |= {f"pidsum_limit{which_limit}": limit}
        # The integral ends at this share of the limit of the sum (pid_init.c); before 2025.12 yaw's at roll's.
        given |= {f"iterm_limit{which_limit}": None if limit is None or windup is None else limit * windup / 100}
    looptime, denominator = log.number("looptime"), log.number("pid_process_denom")
    if looptime and denominator:
        given["pid_loop_hz"] = 1e6 / (looptime * denominator)
    return found | {name: value for name, value in given.items() if value is not None}


def _cutoff(log: BlackboxTable, which: int) -> float | None:
    """Cut-off of a first-order low-pass of D, Hz; None: not known, or of another kind."""
    if log.number(f"dterm_lpf{which}_type") not in (PT1, None):
        return None
    lowest = log.number(f"dterm_lpf{which}_dyn_hz")
    return lowest or log.number(f"dterm_lpf{which}_static_hz")


def differences(log: BlackboxTable, used: Sequence[str]) -> tuple[str, ...]:
    """What the flown controller does that its set of gains does not say."""
    notes = []
    if not log.settings:
        return ("the settings are not known: decode with blackbox_decode --save-headers, or export from the Explorer",)
    if any(log.numbers("d_max")) or any(log.numbers("d_min")):
        notes.append("D grows up to d_max in fast movements, here the gain of calm flight counts as flown")
    if log.number("dterm_lpf1_dyn_hz"):
        notes.append("the low-pass of D rises with the throttle, here its lowest cut-off counts as flown")
    if log.number("tpa_rate"):
        notes.append("TPA lowers P and D at high throttle, here it counts as off")
    for which in (1, 2):
        if "p_roll" in used and log.number(f"dterm_lpf{which}_type") not in (PT1, None):
            notes.append(f"dterm_lpf{which}_type is not PT1, the only kind that is modelled: the gains are not read")
    return tuple(notes)
