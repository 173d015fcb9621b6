"""What excited a flight of Betaflight: its chirp, or the pilot's sticks in acro mode. Both are rate setpoints."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.logs.blackbox_file import BlackboxTable

Signal = NDArray[np.float64]

#: Debug mode CHIRP (pid.c): phase in 1/5000 rad, axis (-1: inactive), frequency in 0.1 Hz, excitation in 1/1000. The
#: first versions of 2025.12 log the phase only.
PHASE, AXIS, FREQUENCY, EXCITATION = range(4)
PHASE_SCALE, FREQUENCY_SCALE, EXCITATION_SCALE = 5e3, 10.0, 1e3
#: Hz: defaults of chirp_lag_freq_hz and chirp_lead_freq_hz (pid.c).
LAG, LEAD = 3.0, 30.0
#: Hz: a slower chirp has the amplitude of f / 1 Hz (chirp.c).
FULL_FROM = 1.0
#: Of the sampling rate: what is faster appears in the log as something slower.
HIGHEST = 0.4
#: Correlation of the rate setpoint with a signal that it contains.
CONTAINED = 0.5
#: Share of the setpoint's variance that the stick explains in acro mode; 1 but for the smoothing of both.
EXPLAINED = 0.9
#: Share of a stick's half range (rcCommand is +-500) that counts as moved, and of the samples that must be.
MOVED, OFTEN = 0.02, 0.02
STICK = 500.0


def chirp(log: BlackboxTable, setpoint: Signal, Ts: float) -> Signal | None:
    """Rate injected by the chirp, (N, 3), deg/s, in Betaflight's axes; None when it did not fly.

    Parameters
    ----------
    log : BlackboxTable
    setpoint : (N, 3) array, deg/s
    Ts : float, s
        Period of the log.
    """
    debug = log.vector("debug", 4)
    if debug is None or not np.isfinite(debug).all():
        return None
    named = debug[:, EXCITATION].any()
    wave = debug[:, EXCITATION] / EXCITATION_SCALE if named else _from_phase(debug[:, PHASE] / PHASE_SCALE, Ts)
    if wave is None or np.abs(wave).max() > 1.0 + 1 / EXCITATION_SCALE or not wave.any():
        return None
    axis = debug[:, AXIS] if named else _axis_of(wave, setpoint)
    if not np.isin(axis, (-1, 0, 1, 2)).all():
        return None
    frequency = debug[:, FREQUENCY] / FREQUENCY_SCALE if named else np.zeros(len(wave))
    wave = np.where((axis >= 0) & (frequency < HIGHEST / Ts), wave, 0.0)
    shaped = _lead_lag(wave, log.number("chirp_lag_freq_hz") or LAG, log.number("chirp_lead_freq_hz") or LEAD, Ts)
    injected = np.zeros_like(setpoint)
    for i, name in enumerate(("roll", "pitch", "yaw")):
        active = (axis == i) & (wave != 0)
        if not active.any():
            continue
        part, whole = np.diff(shaped[active]), np.diff(setpoint[active, i])
        # Another debug mode may hold numbers that look like a chirp.
        if _correlation(part, whole) < CONTAINED:
            return None
        # Without the settings its size is that of the setpoint's part that follows it.
        size = log.number(f"chirp_amplitude_{name}") or float(part @ whole / (part @ part))
        injected[active, i] = size * shaped[active]
    return injected if injected.any() else None


def _from_phase(phase: Signal, Ts: float) -> Signal | None:
    """The excitation from its phase (rad); None when it is none."""
    if phase.min() < 0 or phase.max() > 2 * math.pi + 1 / PHASE_SCALE or not phase.any():
        return None
    active = phase > 0
    frequency = np.gradient(np.unwrap(phase)) / (2 * math.pi * Ts)
    return np.where(active, np.cos(phase) * np.clip(frequency / FULL_FROM, 0.0, 1.0), 0.0)


def _axis_of(wave: Signal, setpoint: Signal) -> Signal:
    """Axis of each run of an excitation, the one whose setpoint follows it best; -1 outside of the runs."""
    axis = np.full(len(wave), -1.0)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (wave != 0).astype(int), [0]])))
    for a, b in zip(edges[::2], edges[1::2], strict=True):
        if b - a > 2:
            shares = [_correlation(np.diff(wave[a:b]), np.diff(setpoint[a:b, i])) for i in range(3)]
            axis[a:b] = int(np.argmax(shares))
    return axis


def _lead_lag(wave: Signal, lag: float, lead: float, Ts: float) -> Signal:
    """The excitation behind Betaflight's phase compensation: less of it the faster it is, (1 + s/lead)/(1 + s/lag)."""
    from scipy.signal import bilinear, lfilter

    numerator, denominator = bilinear([1 / (2 * math.pi * lead), 1], [1 / (2 * math.pi * lag), 1], 1 / Ts)
    return np.asarray(lfilter(numerator, denominator, wave))


def _correlation(x: Signal, y: Signal) -> float:
    size = float(np.linalg.norm(x - x.mean()) * np.linalg.norm(y - y.mean()))
    return float((x - x.mean()) @ (y - y.mean())) / size if size > 0 else 0.0


def sticks(log: BlackboxTable, setpoint: Signal, scale: float) -> bool:
    """Whether the rate setpoints of roll and pitch are the sticks' alone, as in acro mode, and both moved.

    Parameters
    ----------
    log : BlackboxTable
    setpoint : (N, 3) array, deg/s
    scale : float
        Units of rcCommand in the log for each of its own.
    """
    stick = log.vector("rcCommand", 3)
    if stick is None:
        return False
    for i in range(2):
        x, y = stick[:, i] / (scale * STICK), setpoint[:, i]
        usable = np.isfinite(x) & np.isfinite(y)
        if not usable.any() or np.mean(np.abs(x[usable]) > MOVED) < OFTEN:
            return False
        # Rates and expo: an odd curve of the stick.
        curve = np.column_stack([x[usable] * np.abs(x[usable]) ** n for n in range(5)])
        rest = y[usable] - curve @ np.linalg.lstsq(curve, y[usable], rcond=None)[0]
        if np.mean(rest**2) > (1 - EXPLAINED) * np.mean(y[usable] ** 2):
            return False
    return True
