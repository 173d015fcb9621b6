"""Instruments: signals of an experiment that are independent of the loop's noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.experiment import SIGNALS, Experiment, YawSignals, excited_segments, external_signal
from mimopilot.tuning.parameter_row import ROLL_PITCH
from mimopilot.tuning.plant.frequency_response import MIN_FREQUENCIES
from mimopilot.tuning.plant.local_polynomial import local_response
from mimopilot.tuning.plant.rates_model import pbsid_by_response

#: Smallest correlation of the excitations of two flights of the same experiment.
SAME_EXCITATION = 0.99
#: Largest relative difference of the periods of two logs: their rows are paired.
SAME_PERIOD = 1e-6

Signal = NDArray[np.float64]
Segments = tuple[tuple[int, int], ...]
Stretches = list[tuple[slice, list[tuple[int, int]]]]


@dataclass(frozen=True, eq=False)
class Instruments:
    """Signals that VRFT's instruments are made of.

    Attributes
    ----------
    external : (N, 2) array
        External signal; what it does not explain is noise.
    lagged : (N, 2) array
        Signal whose lags are the instruments: `external`, or u.
    name : str
        For the provenance.
    y_i, y_o : (N, 2) arrays or None, rad/s, rad
        Outputs with independent noise, whose regressors replace the lags; None: lags are used.
    """

    external: Signal
    lagged: Signal
    name: str
    y_i: Signal | None = None
    y_o: Signal | None = None


def instruments(experiment: Experiment, kind: str, repeat: Experiment | None = None) -> Instruments:
    """Instruments of an experiment.

    Parameters
    ----------
    experiment : Experiment
    kind : str
        ``external``: lags of the external signal. ``u``: lags of u, the thesis' choice; in closed loop it contains
        fed-back noise. ``model``: outputs simulated by a PBSID model from the external signal to the outputs.
        ``repeated``: outputs of a second flight of the same experiment.
    repeat : Experiment, optional
        The second flight, with the same excitation in each row; see `align`.

    Raises
    ------
    TuningError
        When there is no external signal, the model is not stable, or the second flight is missing or unexpected.
    """
    external, name = external_signal(experiment)
    if (kind == "repeated") != (repeat is not None):
        raise TuningError(
            f"instrument {kind!r} {'with' if repeat else 'without'} a second log: give a second flight of the same "
            "experiment with instrument 'repeated', and only with it"
        )
    if repeat is not None:
        return Instruments(external, external, f"second experiment {repeat.source}", repeat.y_i, repeat.y_o)
    if kind == "model":
        y = np.hstack([experiment.y_i, experiment.y_o])
        found = local_response(external, y, experiment.Ts, experiment.segments)
        spread, size = (np.linalg.norm(part, axis=(1, 2)) for part in (found.deviation(), found.response))
        well = spread < size  # responses with larger errors do not help to fit a model
        if np.count_nonzero(well) < MIN_FREQUENCIES:
            raise TuningError(
                f"{experiment.source}: not excited: the outputs' response is known at {np.count_nonzero(well)} "
                f"frequencies, {MIN_FREQUENCIES} are needed; inject a stronger or longer torque, or leave "
                "--instrument model out"
            )
        model, _ = pbsid_by_response(
            external,
            y,
            experiment.Ts,
            found.omega[well],
            found.response[well],
            found.deviation()[well],
            segments=experiment.segments,
            least_fit=-np.inf,  # an instrument only needs to resemble the outputs; its strength is checked later
        )
        simulated = np.zeros_like(y)
        for start, stop in experiment.segments:
            simulated[start:stop] = model.simulate(external[start:stop])
        name = f"PBSID model of order {model.order}"
        return Instruments(external, external, name, simulated[:, :2], simulated[:, 2:])
    if kind == "u":
        return Instruments(external, experiment.u, "u")
    return Instruments(external, external, name)


def excited_stretches(experiment: Experiment, external: Signal, method: str) -> Stretches:
    """Axes that are tuned together, and their samples: SISO uses only the part of a flight that excites the axis.

    Raises
    ------
    TuningError
        When an axis is not excited.
    """
    stretches: Stretches = []
    for axis in range(2):
        active = excited_segments(experiment.segments, external[:, axis])
        if not active:
            name = ROLL_PITCH[axis]
            raise TuningError(f"{experiment.source}: not excited on {name}; inject a torque on that axis too")
        stretches.append((slice(axis, axis + 1), active))
    return stretches if method == "siso" else [(slice(0, 2), list(experiment.segments))]


def align(first: Experiment, second: Experiment) -> tuple[Experiment, Experiment]:
    """Two flights of the same experiment, cut so that each row has the same excitation in both.

    Raises
    ------
    TuningError
        When their periods or their excitations differ.
    """
    from scipy.signal import correlate  # takes a second to import, which most commands do not need

    one, other = external_signal(first)[0], external_signal(second)[0]
    if abs(first.Ts / second.Ts - 1) > SAME_PERIOD:
        raise TuningError(
            f"{second.source}: sampled every {second.Ts:g} s, {first.source} every {first.Ts:g} s; give a second "
            "flight with the same period"
        )
    likeness = sum(correlate(one[:, i], other[:, i], method="fft") for i in range(2))
    shift = int(np.argmax(likeness)) - (len(other) - 1)
    size = np.sqrt(np.sum(one**2) * np.sum(other**2))
    if np.max(likeness) < SAME_EXCITATION * size:
        raise TuningError(
            f"{second.source}: its excitation differs from that of {first.source} (correlation "
            f"{np.max(likeness) / size:.2f}); give a second flight with the same amplitude, hold times and seed"
        )
    start, stop = max(shift, 0), min(len(one), len(other) + shift)

    def shared(segments: Segments, others: Segments) -> Segments:
        return tuple(
            (max(a, c + shift) - start, min(b, d + shift) - start)
            for a, b in segments
            for c, d in others
            if max(a, c + shift) < min(b, d + shift)
        )

    kept = shared(first.segments, second.segments)
    of_yaw = shared(first.yaw.segments, second.yaw.segments) if first.yaw and second.yaw else ()
    return _cut(first, start, stop, kept, of_yaw), _cut(second, start - shift, stop - shift, kept, of_yaw)


def _cut(experiment: Experiment, start: int, stop: int, segments: Segments, of_yaw: Segments) -> Experiment:
    """Rows start..stop of all signals; without yaw where both flights have none of its segments."""

    def cut(signals: Experiment | YawSignals) -> dict[str, Any]:
        values = {name: getattr(signals, name) for name in SIGNALS}
        return {name: None if value is None else value[start:stop] for name, value in values.items()}

    yaw = YawSignals(**cut(experiment.yaw), segments=of_yaw) if experiment.yaw and of_yaw else None
    return replace(experiment, **cut(experiment), yaw=yaw, segments=segments)
