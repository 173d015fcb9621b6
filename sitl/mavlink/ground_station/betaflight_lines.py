"""Gains as lines for Betaflight's command line (CLI), which its configurator and presets take.

Names and ranges: settings.c of Betaflight 2025.12; scales: `tuning.stock_laws`. The lines also switch off what the
certificate does not cover: the growth of D in fast movements, and the rise of its low-pass with the throttle.
"""

from __future__ import annotations

import math

import numpy as np

from mimopilot.sitl.errors import SitlError
from mimopilot.tuning.control_laws import control_law
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.law_filters import BETAFLIGHT, MIMO

#: Letter of a setting -> gain.
LETTERS = {"p": "Kp_i", "i": "Ki_i", "d": "Kd_i"}
AXES = ("roll", "pitch")
#: Difference from a whole number that rounding of a gains file explains.
ROUNDING = 1e-3


def betaflight_lines(gains: Gains) -> str:
    """The lines, without a profile: they change the one that is selected.

    Parameters
    ----------
    gains : Gains
        For Betaflight. Yaw and feed-forward stay as they are on the vehicle.

    Raises
    ------
    SitlError
        When the set is for another controller, or a gain is not a whole number of Betaflight's units.
    """
    if gains.controller != BETAFLIGHT:
        lost = ""
        if gains.controller == MIMO:
            largest = max(float(np.abs(matrix[[0, 1], [1, 0]]).max()) for matrix in gains.matrices.values())
            lost = f" and its off-diagonals (up to {largest:.3g}) would be lost" if largest else ""
        raise SitlError(
            f"--format {BETAFLIGHT}: the gains are for {gains.controller}: Betaflight's law is another one{lost}, so "
            f"their certificate says nothing about it; design and certify a diagonal set of whole numbers: mimopilot "
            f"tune LOG --profile {BETAFLIGHT}"
        )
    stock = gains.filters.stock
    assert stock is not None  # the set is for Betaflight
    verdict = gains.verdict()[0]
    lines = [
        f"# mimopilot: gains for Betaflight 2025.12, {verdict}, in angle mode.",
        "# They change the selected profile: choose it first (profile 0, ...). Yaw and feed-forward stay as they are.",
        "# Betaflight 4.5: replace d_max_roll and d_max_pitch by d_min_roll and d_min_pitch.",
        "# Not for versions before 4.5: their angle mode is another one.",
        "set simplified_pids_mode = OFF",
        "set simplified_dterm_filter = OFF",
    ]
    for axis, name in enumerate(AXES):
        lines += [
            f"set {letter}_{name} = {_whole(gains, key, axis, f'{letter}_{name}')}" for letter, key in LETTERS.items()
        ]
        lines.append(f"set d_max_{name} = 0")
    levels = {_whole(gains, "Kp_o", axis, "angle_p_gain") for axis in range(len(AXES))}
    if len(levels) > 1:
        raise SitlError(f"angle_p_gain: got {sorted(levels)} for roll and pitch, but Betaflight has one for both")
    lines.append(f"set angle_p_gain = {levels.pop()}")
    for which, cutoffs in ((1, stock.derivative_hz), (2, stock.derivative2_hz)):
        lines += [f"set dterm_lpf{which}_type = PT1", f"set dterm_lpf{which}_static_hz = {_hertz(cutoffs[0], which)}"]
    lines += ["set dterm_lpf1_dyn_min_hz = 0", "save"]
    return "\n".join([*lines, ""])


def _whole(gains: Gains, key: str, axis: int, name: str) -> int:
    """The number on the command line of a gain; refuses one that would be rounded, as the certificate is not of it."""
    law = control_law(gains.filters)
    assert law.largest is not None  # the set is for Betaflight
    number = float(getattr(gains, key)[axis, axis]) / law.step[key]
    most = round(law.largest[key][axis] / law.step[key])
    if abs(number - round(number)) > ROUNDING or not 0 <= round(number) <= most:
        raise SitlError(
            f"{name}: got {number:.6g}, expected a whole number from 0 to {most}: rounding would fly another set than "
            f"the certified one; tune again with --profile {BETAFLIGHT}"
        )
    return round(number)


def _hertz(cutoff: float, which: int) -> int:
    if not math.isclose(cutoff, round(cutoff)):
        raise SitlError(f"dterm_lpf{which}_static_hz: got {cutoff:g} Hz, expected a whole number")
    return round(cutoff)
