"""Checks that the signals of a log agree: they find wrong signs and units, and exchanged columns.

The torque must contain the injected torque, a torque must accelerate its own axis in its own direction, and rates
must be the derivatives of the angles. Which of these relations are broken tells which column is wrong.
"""

from __future__ import annotations

import math

import numpy as np

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.estimation.instrumental_variables import excited_stretches
from mimopilot.tuning.experiment import Experiment, external_signal
from mimopilot.tuning.logs.column_corrections import SignalNames
from mimopilot.tuning.logs.recording import Recording
from mimopilot.tuning.logs.signal_relations import (
    Kinematics,
    Matrix,
    SignalRelation,
    classify,
    faulty_signals,
    injected_in,
    measure_kinematics,
)
from mimopilot.tuning.parameter_row import ROLL_PITCH
from mimopilot.tuning.plant.frequency_response import measured_plant
from mimopilot.tuning.plant.rigid_body_fit import RigidBody, rigid_body

#: Fraction of the angles' movement that the rates must explain.
EXPLAINED = 0.5
#: Range of the ratio of angles to integrated rates with the same unit: banked flight changes it by kinematics.
SAME_UNIT = (0.4, 2.5)
DEGREE = 180 / math.pi
#: rad/s^2 per unit of torque, from a heavy lifter to the smallest racers.
ACCELERATION = (3.0, 5000.0)
#: Largest ratio between the accelerations of roll and pitch of one vehicle.
MAX_AXIS_RATIO = 20.0
#: Least part of the injected torque in the logged torque, expected 1. The loop's response hides some of a chirp.
CONTAINED = 0.3
#: Standard deviations from zero from which on the sign of an acceleration is certain.
CLEAR = 3.0
#: rad: largest roll and pitch of an attitude.
LARGEST = (math.pi, math.pi / 2)
#: Fraction of angles beyond `LARGEST` that damage may explain.
IMPOSSIBLE = 2e-3
SIZES = {1: "large", -1: "small"}


def check_log(experiment: Experiment, recording: Recording) -> None:
    """Check that the signals of a log agree.

    Parameters
    ----------
    experiment : Experiment
        The usable part of the log.
    recording : Recording
        The log, for the names of its signals.

    Raises
    ------
    TuningError
        Names the wrong signal and its correction.
    """
    names = SignalNames(recording)
    kinematics = measure_kinematics(experiment)
    _check_derivative(kinematics, names)
    angles = classify(kinematics.matrix)
    try:
        external, name = external_signal(experiment)
        excited_stretches(experiment, external, "mimo")
        injected = injected_in(experiment.u, external, experiment.segments) if name == "u_bar" else None
        _check_contained(injected, names)
        _check_rate_injection(experiment, names)
        body = rigid_body(measured_plant(experiment))
    except TuningError as error:
        # Without enough excitation only rates and angles can be compared.
        _check_order_and_signs(names, None, None, angles, kinematics.matrix, None)
        _check_units(kinematics.matrix, None, names)
        if experiment.u_bar is None and str(error).startswith(f"{experiment.source}: no excitation"):
            return  # such a log has other uses; tuning reports the lack of excitation
        cause = str(error).removeprefix(f"{names.path}: ").removeprefix(f"{experiment.source}: ")
        raise TuningError(f"{names.path}: {cause}") from error
    torque = classify(body.B)
    _check_order_and_signs(names, injected, torque, angles, kinematics.matrix, body)
    _check_units(kinematics.matrix, body, names)
    _check_clear(body, names)


def _check_contained(injected: Matrix | None, names: SignalNames) -> None:
    """Check that the torque was logged after the injection."""
    if injected is None:
        return
    shares = np.linalg.norm(injected, axis=1)
    if shares.min() < CONTAINED:
        axis = ROLL_PITCH[int(np.argmin(shares))]
        raise TuningError(
            f"{names.path}: {names.of('u')} does not contain the torque injected on {axis} "
            f"({shares.min():.2f} of it, expected 1): log the torque after the injection, at the same rate"
        )


def _check_rate_injection(experiment: Experiment, names: SignalNames) -> None:
    """Check that the rate setpoint contains what was injected into it."""
    if experiment.r_bar is None or experiment.r_i is None:
        return
    shares = np.diag(injected_in(experiment.r_i, experiment.r_bar, experiment.segments))
    if shares.min() < CONTAINED:
        axis = ROLL_PITCH[int(np.argmin(shares))]
        raise TuningError(
            f"{names.path}: {names.of('r_i')} does not contain the rate injected on {axis}, {names.of('r_bar')} "
            f"({shares.min():.2f} of it, expected 1): log both, and the torque, at full rate"
        )


def check_angles(recording: Recording) -> None:
    """Check that roll and pitch are within the range of attitudes; degrees taken for radians are not.

    Raises
    ------
    TuningError
        With the column-file line that corrects it.
    """
    names, angles = SignalNames(recording), np.abs(recording.signals["y_o"].values)
    beyond = np.mean(angles > 1.01 * np.array(LARGEST), axis=0) > IMPOSSIBLE
    if beyond.any():
        wrong = tuple(int(axis) for axis in np.flatnonzero(beyond))
        found = " and ".join(f"{ROLL_PITCH[axis]} reaches {angles[:, axis].max():.3g} rad" for axis in wrong)
        most = " and ".join(f"{LARGEST[axis]:.3g}" for axis in wrong)
        raise TuningError(
            f"{names.path}: {names.of('y_o')}: {found}, expected at most {most}: degrees are taken for radians; "
            f"{names.correction(('y_o',), wrong, 'unit')}; check the unit of the rates, too"
        )


def _check_order_and_signs(
    names: SignalNames,
    injected: Matrix | None,
    torque: SignalRelation | None,
    angles: SignalRelation,
    kinematics: Matrix,
    body: RigidBody | None,
) -> None:
    """Check the order of the axes and the signs.

    Raises
    ------
    TuningError
        Names the fewest signals that explain the broken relations.
    """
    in_torque = classify(injected) if injected is not None else None
    relations = (in_torque or SignalRelation(), torque or SignalRelation(), angles)
    either = () if torque is not None else ("y_i",)
    found = " and ".join(
        text
        for text, relation in zip(
            (
                ""
                if injected is None
                else _matrix_text("the gain from the injected torque to the torque is", injected),
                "" if body is None else _matrix_text("the acceleration per unit of torque is", body.B, "rad/s^2"),
                _matrix_text("the ratio of angles to integrated rates is", kinematics),
            ),
            relations,
            strict=True,
        )
        if text and (relation.exchanged or any(relation.reversed))
    )
    faulty = faulty_signals(
        relations[0].exchanged, relations[1].exchanged, relations[2].exchanged, injected is not None
    )
    if faulty:
        signals, other = faulty[0], faulty[1] or either
        raise TuningError(
            f"{names.path}: {found}: roll and pitch are exchanged in {names.all(signals)}; "
            f"{names.correction(signals, (0, 1), 'other')}{_alternative(names.all(other))}"
        )
    for axis, name in enumerate(ROLL_PITCH):
        first, second, third = (relation.reversed[axis] for relation in relations)
        faulty = faulty_signals(first, second, third, injected is not None)
        if faulty:
            signals, other = faulty[0], faulty[1] or either
            raise TuningError(
                f"{names.path}: {found}: wrong sign of {names.all(signals, axis)} ({name}); "
                f"{names.correction(signals, (axis,), 'sign')}{_alternative(names.all(other, axis))}"
            )


def _alternative(names: str) -> str:
    return f"; the same error in {names} together would look the same" if names else ""


def _check_derivative(kinematics: Kinematics, names: SignalNames) -> None:
    """Check that the rates explain the movement of the angles."""
    for axis, name in enumerate(ROLL_PITCH):
        if kinematics.moves.all() and kinematics.explained[axis] < EXPLAINED:
            raise TuningError(
                f"{names.path}: the rates in {names.of('y_i')} explain {max(kinematics.explained[axis], 0):.0%} of "
                f"the movement of {name} in {names.of('y_o')}, expected nearly all: they are from different vehicles "
                "or times, or are not rates and angles; check the columns"
            )


def _check_units(kinematics: Matrix, body: RigidBody | None, names: SignalNames) -> None:
    """Check the units of rates and angles: degrees taken for radians or the reverse, in one or both."""
    wrong: list[str] = []
    lines: list[tuple[tuple[str, ...], int]] = []
    for axis, name in enumerate(ROLL_PITCH):
        factor, extreme = float(kinematics[axis, axis]), _extreme(body, axis)
        if SAME_UNIT[0] < factor < SAME_UNIT[1]:
            if not extreme:
                continue
            assert body is not None
            unit = "declared as degrees but in radians, or the torque is not a fraction of full torque"
            wrong.append(
                f"a unit of torque accelerates {name} by {body.B[axis, axis]:.3g} rad/s^2, too {SIZES[extreme]} for "
                f"a multirotor ({ACCELERATION[0]:g} to {ACCELERATION[1]:g}) or beside the other axis: its rates and "
                f"angles are {'in degrees' if extreme > 0 else unit}"
            )
            lines.append((("y_i", "y_o"), axis))
            continue
        degrees = any(SAME_UNIT[0] < ratio < SAME_UNIT[1] for ratio in (factor / DEGREE, factor * DEGREE))
        wrong.append(
            f"{name} changes {factor:.3g} times the integral of its rate, expected 1: "
            f"{'degrees are taken for radians' if degrees else 'a wrong unit'}"
        )
        if degrees:
            # If the acceleration is implausible, the rates are wrong; else the angles.
            faulty = "y_i" if extreme else "y_o"
            lines.append(((faulty,), axis))
    if wrong:
        lines_text = names.instruction(
            [line for signals, axis in lines for line in names.lines(signals, (axis,), "unit")]
        )
        raise TuningError(
            f"{names.path}: {'; '.join(wrong)}; {lines_text or 'correct the unit of the rates or of the angles'}"
        )


def _extreme(body: RigidBody | None, axis: int) -> int:
    """1 for an acceleration too large for a multirotor, -1 for one too small, 0 for a plausible one."""
    if body is None:
        return 0
    own, other = (abs(float(body.B[i, i])) for i in (axis, 1 - axis))
    if not ACCELERATION[0] <= own <= ACCELERATION[1]:
        return 1 if own > ACCELERATION[1] else -1
    ratio, middle = own / max(other, 1e-9), math.sqrt(ACCELERATION[0] * ACCELERATION[1])
    farther = abs(math.log(own / middle)) > abs(math.log(max(other, 1e-9) / middle))
    if farther and not 1 / MAX_AXIS_RATIO <= ratio <= MAX_AXIS_RATIO:
        return 1 if ratio > 1 else -1
    return 0


def _check_clear(body: RigidBody, names: SignalNames) -> None:
    """Check that the signs of the response are certain."""
    determinant, deviation = body.determinant()
    for axis, name in enumerate(ROLL_PITCH):
        value, error = body.B[axis, axis], body.deviation[axis, axis]
        if value < CLEAR * error:
            raise TuningError(
                f"{names.path}: a unit of torque accelerates {name} by {value:.3g} +- {error:.2g} rad/s^2: the "
                "sign is not certain; inject a stronger or longer torque"
            )
    if determinant < CLEAR * deviation:
        raise TuningError(
            f"{names.path}: roll and pitch cannot be separated in the response to torque (determinant "
            f"{determinant:.3g} +- {deviation:.2g}): inject a stronger or longer torque on each axis by itself"
        )


def _matrix_text(what: str, matrix: Matrix, unit: str = "") -> str:
    rows = "; ".join(f"{a:.3g}, {b:.3g}" for a, b in matrix)
    return f"{what} [{rows}] {unit}".rstrip()
