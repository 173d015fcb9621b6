"""What faults did to a flight: against the same flight without them, and what the autopilot itself could know."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mimopilot.sitl.autopilot.setpoints import STALE_SECONDS
from mimopilot.sitl.flight.simulator import CRASH_ANGLE, CRASH_SECONDS, Flight
from numpy.typing import NDArray

RECOVERED = np.radians(1.0)  # from the flight without faults, for good
SUNK = 2.0  # m
PATIENCE_S = 0.1  # that rates may repeat themselves, or an axis may saturate, before it is called a failure


@dataclass(frozen=True)
class Recovery:
    """How a flight with faults went.

    Attributes
    ----------
    lost_at_s : float or None, s
        When the vehicle was lost, see `sitl.flight.simulator.Flight.crashed_at`; None: it survived.
    deviation_peak_deg, deviation_rms_deg : float, deg
        True roll or pitch against the same flight without faults, from the first fault to the end or the loss: the
        largest distance, and the RMS of the larger one of both axes.
    recovery_s : float or None, s
        From the first fault until both stay within 1 degree of that flight; None: never, or lost.
    saturated_since : int
        Samples after the first fault in which a moment could not be given in full.
    detected_s : float or None, s
        From the first fault until the autopilot could know; None: it could not.
    detected_by : str
        What tells it, see `detection`; empty when nothing does.
    nonfinite : int
        Moments and motor commands of the whole flight that are not finite numbers.
    """

    lost_at_s: float | None
    deviation_peak_deg: float
    deviation_rms_deg: float
    recovery_s: float | None
    saturated_since: int
    detected_s: float | None
    detected_by: str
    nonfinite: int


def recovery(flight: Flight, sound: Flight) -> Recovery:
    """Compare a flight with the same one, of the same seed, without its faults.

    Parameters
    ----------
    flight : Flight
        Of a scenario with faults; without any it is judged from its start.
    sound : Flight
        Of the same scenario without any.
    """
    Ts, record, lost_at = flight.scenario.Ts, flight.record, flight.crashed_at
    begin = round(min((fault.at for fault in flight.scenario.faults), default=0.0) / Ts)
    end = len(record) if lost_at is None else max(begin + 1, round(lost_at / Ts))
    apart = np.abs(flight.truth["attitude"] - sound.truth["attitude"])[begin:end, :2].max(axis=1)
    outside = np.flatnonzero(apart > RECOVERED)
    back = 0 if len(outside) == 0 else int(outside[-1]) + 1
    found = detection(flight, begin)
    return Recovery(
        lost_at_s=lost_at,
        deviation_peak_deg=float(np.degrees(apart.max())),
        deviation_rms_deg=float(np.degrees(np.sqrt(np.mean(apart**2)))),
        recovery_s=back * Ts if lost_at is None and back < len(apart) else None,
        saturated_since=int(np.any(record["unallocated"][begin:end] != 0, axis=1).sum()),
        detected_s=None if found is None else (found[0] - begin) * Ts,
        detected_by="" if found is None else found[1],
        nonfinite=int(np.sum(~np.isfinite(record["moment"])) + np.sum(~np.isfinite(record["commands"]))),
    )


def detection(flight: Flight, begin: int) -> tuple[int, str] | None:
    """The first sample, from `begin` on, at which the autopilot could know that something is wrong, and how.

    Only signals that a vehicle has are used:

    - ``input``: the controller's fault flag, an input invalid for more than 25 samples;
    - ``clock``: a tick is missing or repeated, seen from the time stamps when the next one comes;
    - ``stuck``: a measured rate repeats itself, bit for bit, for 0.1 s;
    - ``motors``: a moment on the same axis cannot be given for 0.1 s;
    - ``altitude``: it is 2 m below where it was at `begin`;
    - ``attitude``: the estimate is beyond 60 degrees for 0.3 s (PX4's failure detector, FD_FAIL_R, FD_FAIL_P);
    - ``set-point``: none for 0.5 s.

    Returns
    -------
    (sample, how) or None
        None: nothing is noticed before the flight ends.
    """
    record, Ts = flight.record[begin:], flight.scenario.Ts
    patience = max(1, round(PATIENCE_S / Ts))
    ran = np.ones(len(record), np.int64) if flight.runs is None else flight.runs[begin:]
    missed = np.concatenate([[False], ran[:-1] == 0])
    rates = flight.record["rates"][max(begin - 1, 0) :]
    repeated = np.zeros((len(record), 3), np.bool_)
    repeated[len(repeated) - len(rates) + 1 :] = rates[1:] == rates[:-1]
    tilted = np.any(np.abs(record["attitude"][:, :2]) > CRASH_ANGLE, axis=1)
    height = flight.truth["position"][begin:, 2]
    sunk = height > height[0] + SUNK  # the vehicle's own estimate is this, rounded to a millimetre
    signs = {
        "input": _first(record["fault"][:, None] != 0, 1),
        "clock": _first(((ran > 1) | (missed & (ran > 0)))[:, None], 1),
        "stuck": _first(repeated & (ran > 0)[:, None], patience),
        "motors": _first(record["unallocated"] != 0, patience),
        "altitude": _first(sunk[:, None], 1),
        "attitude": _first(tilted[:, None], max(1, round(CRASH_SECONDS / Ts))),
        "set-point": _stale(flight, begin),
    }
    seen = [(sample, how) for how, sample in signs.items() if sample is not None]
    if not seen:
        return None
    sample, how = min(seen)
    return begin + sample, how


def _first(signs: NDArray[np.bool_], length: int) -> int | None:
    """First sample at which a column of (N, n) has been true for `length` samples in a row."""
    total = np.vstack([np.zeros((1, signs.shape[1]), np.int64), np.cumsum(signs, axis=0)])
    ends = np.flatnonzero(np.any(total[length:] - total[:-length] == length, axis=1))
    return int(ends[0]) + length - 1 if len(ends) else None


def _stale(flight: Flight, begin: int) -> int | None:
    """First sample that is flown without a set-point, from `begin` on."""
    late = (
        round((fault.at + STALE_SECONDS) / flight.scenario.Ts)
        for fault in flight.scenario.faults
        if fault.kind == "stale" and (fault.duration is None or fault.duration > STALE_SECONDS)
    )
    sample = min(late, default=len(flight.record))
    return sample - begin if sample < len(flight.record) else None
