"""Margins of a measured loop: gain, phase and delay of one axis, and of all axes at once."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.analysis.closed_loop import CascadeLoop
from mimopilot.tuning.axes import axis_names
from mimopilot.tuning.parameter_row import AXES
from mimopilot.tuning.small_matrices import inverse, singular_values

#: Smallest cross term: avoids a division by 0.
SMALLEST = 1e-12

Complex = NDArray[np.complex128]
Signal = NDArray[np.float64]


def sensitivity(loop: CascadeLoop) -> Complex:
    """S = (I + L_u)^-1 at the plant's input, (K, n, n); that of three axes `balanced`."""
    S = inverse(np.eye(loop.L_u.shape[-1]) + loop.L_u)
    return balanced(S) if S.shape[-1] == len(AXES) else S


def balanced(S: Complex) -> Complex:
    """S of three axes with the yaw torque in the unit, at each frequency, in which both cross terms are of one size.

    No margin depends on the unit of a torque, but singular values do: in another unit a coupling of one direction
    alone, which changes no margin, would look like a thin one. D S D^-1 bounds the structured singular value from above
    (A. Packard, J. Doyle, "The complex structured singular value", Automatica 29, 1993).
    """
    to_yaw, from_yaw = np.linalg.norm(S[:, 2, :2], axis=1), np.linalg.norm(S[:, :2, 2], axis=1)
    unit = np.sqrt(np.maximum(from_yaw, SMALLEST) / np.maximum(to_yaw, SMALLEST))
    scaled = S.copy()
    scaled[:, 2, :2] *= unit[:, None]
    scaled[:, :2, 2] /= unit[:, None]
    return scaled


def peak(S: Complex) -> float:
    """Ms: the largest singular value of a sensitivity (K, n, n) over all frequencies."""
    return float(singular_values(S)[0].max())


def disk_margin(S: Complex) -> float:
    """Radius of the largest disk about 1 of complex factors that all channels tolerate at once.

    1 over the peak of S - I/2 (P. Seiler, A. Packard, P. Gahinet, "An introduction to disk margins", IEEE Control
    Systems 40, 2020).
    """
    return 1 / peak(S - np.eye(S.shape[-1]) / 2)


def simultaneous_margins(disk: float) -> tuple[float, float]:
    """Changes of gain (dB, up or down) and of phase (deg) that a disk margin allows on all axes at once."""
    ratio = (2 + disk) / (2 - disk) if disk < 2 else np.inf
    return float(20 * np.log10(ratio)), float(2 * np.degrees(np.arctan(disk / 2)))


def axis_loops(S: Complex) -> Complex:
    """The loop of each axis with the others closed, 1 / S_ii - 1, (n, K)."""
    loops: Complex = 1 / np.diagonal(S, axis1=1, axis2=2).T - 1
    return loops


def phase_margin(loop: Complex, omega: Signal) -> tuple[float, float]:
    """Smallest phase margin (deg) and smallest delay margin (ms) of one loop; infinite if its gain is never 1.

    Parameters
    ----------
    loop : (K,) array
    omega : (K,) array, rad/s
    """
    size, phase = np.log(np.abs(loop)), np.unwrap(np.angle(loop))
    at, place = _crossings(size)
    if not len(at):
        return np.inf, np.inf
    crossing = _between(np.log(omega), at, place)
    lag = np.degrees(_between(phase, at, place)) + 180.0
    delays = np.radians(lag % 360.0) / np.exp(crossing) * 1e3
    return float(np.min(np.abs((lag + 180.0) % 360.0 - 180.0))), float(np.min(delays))


def gain_margin(loop: Complex) -> float:
    """Smallest factor, up or down, that makes one loop (K,) unstable, dB; infinite if its phase is never 180 deg."""
    at, place = _crossings(loop.imag)
    if not len(at):
        return np.inf
    size = _between(np.log(np.abs(loop)), at, place)
    opposite = _between(loop.real, at, place) < 0
    return float(np.min(np.abs(20 / np.log(10) * size[opposite]), initial=np.inf))


def gain_margins(loops: Complex, gain_above: float) -> dict[str, Any]:
    """Gain margin of each axis, as far as the log shows it.

    Parameters
    ----------
    loops : (n, K) array
        In the band.
    gain_above : float
        Upper bound of the loop's gain above the band: no margin larger than 1 / gain_above is claimed.

    Returns
    -------
    dict
        ``gain_margin_db``: by axis, never negative. ``gain_margin``: by axis, the kind of the number: ``exact``, ``at
        least`` or ``not known`` (the number is then 0).
    """
    ceiling = -20 * float(np.log10(gain_above)) if gain_above > 0 else np.inf
    margins, kinds = {}, {}
    for axis, loop in zip(axis_names(len(loops)), loops, strict=True):
        found = gain_margin(loop)
        if found <= ceiling:
            margins[axis], kinds[axis] = found, "exact"
        else:
            margins[axis], kinds[axis] = (ceiling, "at least") if ceiling > 0 else (0.0, "not known")
    return {"gain_margin_db": margins, "gain_margin": kinds}


def _crossings(values: Signal) -> tuple[NDArray[np.intp], Signal]:
    """Zero crossings: index of the sample before, and the fraction of the step to the next."""
    at = np.flatnonzero(values[:-1] * values[1:] < 0)
    return at, values[at] / (values[at] - values[at + 1])


def _between(values: Signal, at: NDArray[np.intp], place: Signal) -> Signal:
    """Values at crossings, by linear interpolation."""
    between: Signal = values[at] + place * (values[at + 1] - values[at])
    return between
