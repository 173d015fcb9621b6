"""Tuning the cascade from one experiment: the rate loop, then the attitude loop around it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tuning.certificate import certify
from tuning.closed_loop import PlantResponse, plant_response, refine_outer
from tuning.controller import rebuild_rate_setpoint
from tuning.errors import TuningError
from tuning.experiment import Experiment
from tuning.gains import Gains, Limits, YawGains
from tuning.gates import examine
from tuning.spec import TuningSpec
from tuning.vrft import LoopEstimate, Segments, vrft

AXES = ("roll", "pitch")
#: Highest frequency of the measured response, rad/s.
UPPER = 300.0
#: Periods of a log and of a gain set may differ by this share.
PERIOD_TOLERANCE = 0.02
TERMS = {"P": "Kp_i", "I": "Ki_i", "D": "Kd_i"}


def tune(experiment: Experiment, spec: TuningSpec | None = None, plant: PlantResponse | None = None) -> Gains:
    """Gains of the whole cascade, by VRFT with extended instrumental variables, (3.26)-(3.34).

    Parameters
    ----------
    experiment : Experiment
        One flight with excitation.
    spec : TuningSpec, optional
        Method and reference models.
    plant : PlantResponse, optional
        The experiment's `measured_plant`, when it is at hand already.

    Returns
    -------
    Gains
        With method, reference models, log and standard deviations in its provenance, and certified.

    Raises
    ------
    TuningError
        When the log has no external signal, is too short or not excited, lacks what the controller needs
        beside roll and pitch, or when the inner controller cannot be run backwards.
    """
    spec = spec or TuningSpec()
    base = _base(experiment, spec)
    instrument, name = external_signal(experiment)
    stretches = excited_stretches(experiment, instrument, spec.method)

    inner = [
        vrft(
            experiment.u[:, axes],
            experiment.y_i[:, axes],
            instrument[:, axes],
            spec.models("inner", experiment.Ts)[axes],
            "PID",
            segments=segments,
            window=spec.window,
            derivative_cutoff_hz=base.derivative_cutoff_hz,
            weight=spec.weight,
            prior=_prior(experiment, spec, axes),
            pull=spec.pull,
        )
        for axes, segments in stretches
    ]
    warnings = examine(experiment, [(axes, loop) for (axes, _), loop in zip(stretches, inner, strict=True)])
    Kp, Ki, Kd = (_assemble(inner, stretches, term) for term in TERMS)
    gains = replace(base, Kp_i=Kp, Ki_i=Ki, Kd_i=Kd)

    settling = 0
    r_i = np.zeros_like(experiment.y_i)
    for start, stop in experiment.segments:
        r_i[start:stop], settling = rebuild_rate_setpoint(gains, experiment.u[start:stop], experiment.y_i[start:stop])
    outer = [
        vrft(
            r_i[:, axes],
            experiment.y_o[:, axes],
            instrument[:, axes],
            spec.models("outer", experiment.Ts)[axes],
            "P",
            segments=segments,
            window=spec.window,
            settling=settling,
            weight="identity",  # the residual is what a P controller cannot do, not noise
        )
        for axes, segments in stretches
    ]
    gains = replace(gains, Kp_o=_assemble(outer, stretches, "P"))
    deviations = {matrix: _assemble(inner, stretches, term, "deviations") for term, matrix in TERMS.items()}
    plant = plant or measured_plant(experiment)
    outer_models = spec.models("outer", experiment.Ts)
    if spec.refine:
        gains, deviations["Kp_o"] = refine_outer(gains, plant, outer_models, full=spec.method == "mimo")
    else:
        deviations["Kp_o"] = _assemble(outer, stretches, "P", "deviations")
    certificate = certify(gains, plant, spec.models("inner", experiment.Ts), outer_models, experiment.sha256)
    provenance = {
        "method": spec.method,
        "log": experiment.source,
        "log_sha256": experiment.sha256,
        "instrument": name,
        "weight": spec.weight,
        "pull": spec.pull,
        "refined": spec.refine,
        "fit": [float(value) for loop in inner for value in loop.solution.r_squared],
        "warnings": warnings,
        "inner_model": [list(model) for model in spec.inner],
        "outer_model": [list(model) for model in spec.outer],
        "window": [inner[0].window, outer[0].window],
        "samples": [inner[0].samples, outer[0].samples],
        "standard_deviation": {matrix: value.tolist() for matrix, value in deviations.items()},
    }
    return replace(gains, certificate=certificate.as_table(), provenance=provenance)


def measured_plant(experiment: Experiment) -> PlantResponse:
    """The plant's frequency response from the experiment's external signal; see `plant_response`."""
    return plant_response(experiment, external_signal(experiment)[0], UPPER)


def certify_from_log(experiment: Experiment, gains: Gains) -> Gains:
    """The gains with a certificate made from a flight of the vehicle, whatever they come from.

    Raises
    ------
    TuningError
        When the log has no external signal, is too short or not excited, or has another period than the gains.
    """
    if abs(experiment.Ts / gains.Ts - 1) > PERIOD_TOLERANCE:
        raise TuningError(
            f"{experiment.source}: sampled every {experiment.Ts:g} s, the gains are for {gains.Ts:g} s; certify them "
            "with a log of the same control rate"
        )
    plant = measured_plant(experiment)
    spec = TuningSpec()
    certificate = certify(
        gains, plant, spec.models("inner", gains.Ts), spec.models("outer", gains.Ts), experiment.sha256
    )
    return replace(gains, certificate=certificate.as_table())


def _base(experiment: Experiment, spec: TuningSpec) -> Gains:
    """Everything that is not tuned: yaw, limits, filter and unit, from the specification or as flown."""
    flown = experiment.flown
    if spec.yaw is None and flown is None:
        raise TuningError(
            f"{experiment.source}: the log does not say which yaw gains flew; give them in a --spec file under [yaw]"
        )
    if spec.derivative_cutoff_hz is None and flown is None:
        raise TuningError(
            f"{experiment.source}: the log does not say which derivative filter flew; give derivative_cutoff_hz (Hz, "
            "0 for none) in a --spec file"
        )
    zero = np.zeros((2, 2))
    cutoff = spec.derivative_cutoff_hz
    yaw = YawGains(**spec.yaw.model_dump()) if spec.yaw else flown.yaw  # type: ignore[union-attr]
    limits = Limits(**spec.limits.model_dump()) if spec.limits else flown.limits if flown else Limits()
    return Gains(
        Kp_o=zero,
        Kp_i=zero,
        Ki_i=zero,
        Kd_i=zero,
        Kff_i=zero,
        yaw=yaw,
        Ts=experiment.Ts,
        derivative_cutoff_hz=flown.derivative_cutoff_hz if cutoff is None and flown else cutoff or 0.0,
        limits=limits,
        moment_scale=spec.moment_scale or (flown.moment_scale if flown else None),
    )


def _prior(experiment: Experiment, spec: TuningSpec, axes: slice) -> dict[str, NDArray[np.float64]] | None:
    """The flying rate gains by term, when the estimate is to be pulled towards them."""
    if spec.pull == 0:
        return None
    flown = experiment.flown
    if flown is None:
        raise TuningError(f"{experiment.source}: pull: the log does not say which gains flew; leave it at 0")
    return {term: getattr(flown, matrix)[axes, axes] for term, matrix in TERMS.items()}


def external_signal(experiment: Experiment) -> tuple[NDArray[np.float64], str]:
    """The instrument, (N, 2), and its name: the injected moment, else the attitude set-point (rad).

    Raises
    ------
    TuningError
        When neither is logged and moves.
    """
    for name in ("u_bar", "r_o"):
        signal = getattr(experiment, name)
        if signal is not None and any(np.ptp(signal[start:stop]) > 0 for start, stop in experiment.segments):
            return signal, name
    raise TuningError(
        f"{experiment.source}: no excitation: neither an injected moment nor a moving attitude set-point is logged; "
        "fly an experiment with a moment injected on roll, then on pitch"
    )


def excited_stretches(
    experiment: Experiment, instrument: NDArray[np.float64], method: str
) -> list[tuple[slice, list[tuple[int, int]]]]:
    """Which axes are tuned together, and on which samples: SISO uses an axis' own part of the flight.

    Raises
    ------
    TuningError
        When an axis is not excited.
    """
    if method == "mimo":
        for axis in range(2):
            if all(np.ptp(instrument[start:stop, axis]) == 0 for start, stop in experiment.segments):
                raise TuningError(f"{experiment.source}: not excited on {AXES[axis]}; inject a moment on that axis too")
        return [(slice(0, 2), list(experiment.segments))]
    stretches = []
    for axis in range(2):
        active: list[tuple[int, int]] = []
        for start, stop in experiment.segments:
            moving = start + np.flatnonzero(instrument[start:stop, axis] != 0)
            if len(moving):
                active.append((int(moving[0]), int(moving[-1]) + 1))
        if not active:
            raise TuningError(f"{experiment.source}: not excited on {AXES[axis]}; inject a moment on that axis too")
        stretches.append((slice(axis, axis + 1), active))
    return stretches


def _assemble(
    estimates: list[LoopEstimate], stretches: Sequence[tuple[slice, Segments]], term: str, what: str = "gains"
) -> NDArray[np.float64]:
    matrix = np.zeros((2, 2))
    for estimate, (axes, _) in zip(estimates, stretches, strict=True):
        matrix[axes, axes] = getattr(estimate, what)[term]
    return matrix
