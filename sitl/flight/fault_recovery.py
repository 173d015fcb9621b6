"""Effect of faults on a flight, against the same flight without them, and when the autopilot could detect them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mimopilot.sitl.autopilot.failure_detector import MAX_TILT, MAX_TILT_SECONDS
from mimopilot.sitl.autopilot.setpoints import STALE_SECONDS
from mimopilot.sitl.flight.simulator import Flight

RECOVERED_ANGLE = np.radians(1.0)  # rad, from the flight without faults; chosen: above the noise of the estimate
ALTITUDE_LOSS = 2.0  # m; chosen: far above what a manoeuvre loses
PERSISTENCE_S = 0.1  # of a repeated rate or a saturated axis; chosen: 25 samples at 250 Hz, as the input check


@dataclass(frozen=True)
class Recovery:
    """Result of a flight with faults.

    Attributes
    ----------
    lost_at_s : float or None, s
        Time of the loss, see `sitl.flight.simulator.Flight.crashed_at`; None: the vehicle survived.
    deviation_peak_deg, deviation_rms_deg : float, deg
        Difference of true roll or pitch from the same flight without faults, from the first fault to the end or the
        loss: the largest, and the RMS of the larger one of both axes.
    recovery_s : float or None, s
        From the first fault until both axes stay within 1 degree of that flight; None: never, or lost.
    saturated_since : int
        Samples after the first fault in which an axis is saturated.
    detected_s : float or None, s
        From the first fault until the autopilot could detect it; None: it could not.
    detected_by : str
        Signal that shows it, see `detection`; empty: none.
    nonfinite : int
        Number of torques and motor commands of the whole flight that are not finite.
    """

    lost_at_s: float | None
    deviation_peak_deg: float
    deviation_rms_deg: float
    recovery_s: float | None
    saturated_since: int
    detected_s: float | None
    detected_by: str
    nonfinite: int


def recovery(flight: Flight, healthy: Flight) -> Recovery:
    """Compare a flight with the same one, of the same seed, without its faults.

    Parameters
    ----------
    flight : Flight
        Flight with faults; without any, it is compared from its start.
    healthy : Flight
        Flight of the same scenario without faults.
    """
    Ts, record, lost_at = flight.scenario.Ts, flight.record, flight.crashed_at
    begin = round(min((fault.at for fault in flight.scenario.faults), default=0.0) / Ts)
    end = len(record) if lost_at is None else max(begin + 1, round(lost_at / Ts))
    difference = np.abs(flight.truth["attitude"] - healthy.truth["attitude"])[begin:end, :2].max(axis=1)
    outside = np.flatnonzero(difference > RECOVERED_ANGLE)
    back = 0 if len(outside) == 0 else int(outside[-1]) + 1
    found = detection(flight, begin)
    return Recovery(
        lost_at_s=lost_at,
        deviation_peak_deg=float(np.degrees(difference.max())),
        deviation_rms_deg=float(np.degrees(np.sqrt(np.mean(difference**2)))),
        recovery_s=back * Ts if lost_at is None and back < len(difference) else None,
        saturated_since=int(np.any(record["unallocated"][begin:end] != 0, axis=1).sum()),
        detected_s=None if found is None else (found[0] - begin) * Ts,
        detected_by="" if found is None else found[1],
        nonfinite=int(np.sum(~np.isfinite(record["moment"])) + np.sum(~np.isfinite(record["commands"]))),
    )


def detection(flight: Flight, begin: int) -> tuple[int, str] | None:
    """First sample, from `begin` on, at which the autopilot could detect a failure, and the signal that shows it.

    Only signals that a vehicle has are used:

    - ``input``: fault flag of the controller, an input invalid for more than 25 samples;
    - ``clock``: a tick is missing or repeated, known from the time stamps of the next one;
    - ``stuck``: a measured rate repeats in every bit for 0.1 s;
    - ``motors``: the same axis is saturated for 0.1 s;
    - ``altitude``: 2 m below the altitude at `begin`;
    - ``attitude``: the estimate is beyond 60 degrees for 0.3 s, see `sitl.autopilot.failure_detector`;
    - ``set-point``: none for 0.5 s.

    Returns
    -------
    (sample, signal) or None
        None: nothing is detected before the flight ends.
    """
    record, Ts = flight.record[begin:], flight.scenario.Ts
    persistence = max(1, round(PERSISTENCE_S / Ts))
    ran = np.ones(len(record), np.int64) if flight.runs is None else flight.runs[begin:]
    missed = np.concatenate([[False], ran[:-1] == 0])
    rates = flight.record["rates"][max(begin - 1, 0) :]
    repeated = np.zeros((len(record), 3), np.bool_)
    repeated[len(repeated) - len(rates) + 1 :] = rates[1:] == rates[:-1]
    tilted = np.any(np.abs(record["attitude"][:, :2]) > MAX_TILT, axis=1)
    down = flight.truth["position"][begin:, 2]
    sunk = down > down[0] + ALTITUDE_LOSS  # the estimate is the true altitude, rounded to a millimetre
    signs = {
        "input": _first(record["fault"][:, None] != 0, 1),
        "clock": _first(((ran > 1) | (missed & (ran > 0)))[:, None], 1),
        "stuck": _first(repeated & (ran > 0)[:, None], persistence),
        "motors": _first(record["unallocated"] != 0, persistence),
        "altitude": _first(sunk[:, None], 1),
        "attitude": _first(tilted[:, None], max(1, round(MAX_TILT_SECONDS / Ts))),
        "set-point": _stale(flight, begin),  # this spelling is a JSON value
    }
    detected = [(sample, how) for how, sample in signs.items() if sample is not None]
    if not detected:
        return None
    sample, how = min(detected)
    return begin + sample, how


def _first(signs: NDArray[np.bool_], length: int) -> int | None:
    """First sample at which a column of (N, n) has been true for `length` samples in a row."""
    total = np.vstack([np.zeros((1, signs.shape[1]), np.int64), np.cumsum(signs, axis=0)])
    ends = np.flatnonzero(np.any(total[length:] - total[:-length] == length, axis=1))
    return int(ends[0]) + length - 1 if len(ends) else None


def _stale(flight: Flight, begin: int) -> int | None:
    """First sample after the setpoint timeout, from `begin` on."""
    late = (
        round((fault.at + STALE_SECONDS) / flight.scenario.Ts)
        for fault in flight.scenario.faults
        if fault.kind == "stale" and (fault.duration is None or fault.duration > STALE_SECONDS)
    )
    sample = min(late, default=len(flight.record))
    return sample - begin if sample < len(flight.record) else None
