"""Logs that cannot be true: columns with a wrong sign or unit, or in each other's place.

What is injected must be in the torque, a torque must accelerate its own axis the right way, and rates must be the
derivatives of the angles. Each relation is measured as a 2x2 matrix; which of them are broken tells which column is
wrong.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.estimation.instrumental_variables import excited_stretches
from mimopilot.tuning.experiment import Experiment, external_signal
from mimopilot.tuning.logs.columns import SIGNALS
from mimopilot.tuning.logs.recording import Recording
from mimopilot.tuning.parameters import ROLL_PITCH as AXES
from mimopilot.tuning.plant.frequency_response import measured_plant
from mimopilot.tuning.plant.inertia import RigidBody, rigid_body
from numpy.typing import NDArray

#: Angles are compared with integrated rates over this time, s: noise of the angles divided by it is small.
OVER = 0.1
#: Each second of a flight counts alike, so that a tumble does not outweigh the rest.
WINDOW = 1.0
#: An axis that moves less over `OVER` (RMS, rad) is not judged.
#: So much more an angle must move than a rate's integral to be told from its noise.
STILL, NOISE = 2e-3, 5.0
#: Share of the angles' movement that the rates must explain.
EXPLAINED = 0.5
#: Factors between angles and integrated rates that are no unit: kinematics of banked flight.
SAME_UNIT = (0.4, 2.5)
DEGREE = 180 / math.pi
#: Angular acceleration of a unit of torque that multirotors have, rad/s^2: a heavy lifter, the smallest racers.
ACCELERATION = (3.0, 5000.0)
#: Roll and pitch of one vehicle accelerate alike but for this ratio.
UNLIKE = 20.0
#: What is injected must be in the torque, to this share; a chirp is seen through the loop's own answer.
CONTAINED = 0.3
#: Samples by which the log of the injected torque may be early or late.
LATE = 3
#: The sign of an acceleration is known when it is beyond so many of its standard deviations.
CLEAR = 3.0

#: Roll and pitch that an attitude may have, rad, and the share of samples beyond that damage may explain.
LARGEST, IMPOSSIBLE = (math.pi, math.pi / 2), 2e-3
SIZES = {1: "large", -1: "small"}

Matrix = NDArray[np.float64]
Signal = NDArray[np.float64]


@dataclass(frozen=True)
class _Relation:
    """How one pair of signals follows another: columns in each other's place, and by axis a sign."""

    exchanged: bool = False
    reversed: tuple[bool, bool] = (False, False)


def check_log(experiment: Experiment, recording: Recording) -> None:
    """Refuse a log whose signals contradict each other, naming the column and what mends it.

    Parameters
    ----------
    experiment : Experiment
        The usable part of the log.
    recording : Recording
        The log, for the names of its columns or topics.

    Raises
    ------
    TuningError
        With the cause.
    """
    names = _Names(recording)
    kinematics = _kinematics(experiment)
    _check_derivative(kinematics, names)
    angles = _relation(kinematics.matrix)
    try:
        external, name = external_signal(experiment)
        excited_stretches(experiment, external, "mimo")
        injected = _injected(experiment) if name == "u_bar" else None
        _check_contained(injected, names)
        body = rigid_body(measured_plant(experiment))
    except TuningError as error:
        # Without enough excitation only rates and angles can contradict each other.
        _blame(names, None, None, angles, kinematics.matrix, None)
        _check_units(kinematics.matrix, None, names)
        if experiment.u_bar is None and str(error).startswith(f"{experiment.source}: no excitation"):
            return  # there are other uses of such a log; tuning says what it lacks
        cause = str(error).removeprefix(f"{names.path}: ").removeprefix(f"{experiment.source}: ")
        raise TuningError(f"{names.path}: {cause}") from error
    torque = _relation(body.B)
    _blame(names, injected, torque, angles, kinematics.matrix, body)
    _check_units(kinematics.matrix, body, names)
    _check_clear(body, names)


def _check_contained(injected: Matrix | None, names: _Names) -> None:
    """Refuse torque that was logged before the injection."""
    if injected is None:
        return
    shares = np.linalg.norm(injected, axis=1)
    if shares.min() < CONTAINED:
        raise TuningError(
            f"{names.path}: {names.of('u')} does not contain what was injected on {AXES[int(np.argmin(shares))]} "
            f"({shares.min():.2f} of it, expected 1): log the torque after the injection, at the same rate"
        )


def check_angles(recording: Recording) -> None:
    """Refuse angles that no attitude has: degrees that are taken for radians.

    Raises
    ------
    TuningError
        With the line that mends it.
    """
    names, angles = _Names(recording), np.abs(recording.signals["y_o"].values)
    beyond = np.mean(angles > 1.01 * np.array(LARGEST), axis=0) > IMPOSSIBLE
    if beyond.any():
        wrong = tuple(int(axis) for axis in np.flatnonzero(beyond))
        found = " and ".join(f"{AXES[axis]} reaches {angles[:, axis].max():.3g} rad" for axis in wrong)
        most = " and ".join(f"{LARGEST[axis]:.3g}" for axis in wrong)
        raise TuningError(
            f"{names.path}: {names.of('y_o')}: {found}, expected at most {most}: degrees are taken for radians; "
            f"{names.mend(('y_o',), wrong, 'unit')}; are the rates in degrees, too?"
        )


@dataclass(frozen=True, eq=False)
class _Kinematics:
    """Angles over integrated rates (2, 2), how much of their movement is explained (2,), and whether they move (2,)."""

    matrix: Matrix
    explained: Signal
    moves: NDArray[np.bool_]


def _kinematics(experiment: Experiment) -> _Kinematics:
    """Movement of the angles over a short time, as a matrix times the integral of the rates."""
    step, window = max(1, round(OVER / experiment.Ts)), max(1, round(WINDOW / experiment.Ts))
    outer, inner, moved = np.zeros((2, 2)), np.zeros((2, 2)), np.zeros(2)
    energy = []
    for start, stop in experiment.segments:
        rates = experiment.y_i[start:stop]
        turned = np.cumsum((rates[1:] + rates[:-1]) / 2 * experiment.Ts, axis=0)
        angles = np.unwrap(experiment.y_o[start:stop], axis=0)[1:]
        for begin in range(0, len(turned) - step, window):
            part = slice(begin, begin + window)
            x = turned[step:][part] - turned[:-step][part]
            y = angles[step:][part] - angles[:-step][part]
            x, y = x - x.mean(axis=0), y - y.mean(axis=0)
            size, response = float(np.sum(x**2)), float(np.sum(y**2))
            if size <= 0 or response <= 0:
                continue
            # Each second by its own size: of the rates for the matrix, of the angles for what is explained of them.
            scale = math.sqrt(size * response)
            outer += y.T @ x / scale
            inner += x.T @ x / scale
            moved += np.sum(y**2, axis=0) / scale
            energy.append(np.maximum(np.mean(x**2, axis=0), np.mean(y**2, axis=0) / NOISE**2))
    if not energy:
        return _Kinematics(np.eye(2), np.ones(2), np.zeros(2, bool))
    moves = np.sqrt(np.median(energy, axis=0)) > STILL
    if not moves.all():
        return _Kinematics(np.eye(2), np.ones(2), moves)
    matrix = outer @ np.linalg.pinv(inner)
    explained = np.einsum("ij,ij->i", matrix, outer) / np.maximum(moved, 1e-300)
    return _Kinematics(matrix, explained, moves)


def _injected(experiment: Experiment) -> Matrix:
    """How steps of the injected torque are found in the torque, (2, 2): the identity when the log is true."""
    assert experiment.u_bar is not None
    found = []
    for late in range(-LATE, LATE + 1):
        outer, inner = np.zeros((2, 2)), np.zeros((2, 2))
        for start, stop in experiment.segments:
            u, w = np.diff(experiment.u[start:stop], axis=0), np.diff(experiment.u_bar[start:stop], axis=0)
            u, w = (u[late:], w[: len(w) - late]) if late >= 0 else (u[:late], w[-late:])
            outer += u.T @ w
            inner += w.T @ w
        found.append(outer @ np.linalg.pinv(inner))
    return max(found, key=lambda matrix: float(np.linalg.norm(matrix)))


def _relation(matrix: Matrix) -> _Relation:
    """What is broken in a matrix whose diagonal should be positive and outweigh the rest."""
    own, other = matrix[0, 0] * matrix[1, 1], matrix[0, 1] * matrix[1, 0]
    exchanged = abs(other) > abs(own)
    diagonal = (matrix[0, 1], matrix[1, 0]) if exchanged else (matrix[0, 0], matrix[1, 1])
    return _Relation(exchanged, (bool(diagonal[0] < 0), bool(diagonal[1] < 0)))


def _blame(
    names: _Names,
    injected: Matrix | None,
    torque: _Relation | None,
    angles: _Relation,
    kinematics: Matrix,
    body: RigidBody | None,
) -> None:
    """Name the signals that explain what is broken with the fewest faults; raises where something is."""
    in_torque = _relation(injected) if injected is not None else None
    relations = (in_torque or _Relation(), torque or _Relation(), angles)
    either = () if torque is not None else ("y_i",)
    found = " and ".join(
        text
        for text, relation in zip(
            (
                "" if injected is None else _said("the injected torque is in the torque by", injected),
                "" if body is None else _said("a unit of torque accelerates by", body.B, "rad/s^2"),
                _said("angles move over integrated rates by", kinematics),
            ),
            relations,
            strict=True,
        )
        if text and (relation.exchanged or any(relation.reversed))
    )
    guilty = _guilty(relations[0].exchanged, relations[1].exchanged, relations[2].exchanged, injected is not None)
    if guilty:
        blamed, other = guilty[0], guilty[1] or either
        raise TuningError(
            f"{names.path}: {found}: roll and pitch are exchanged in {names.all(blamed)}; "
            f"{names.mend(blamed, (0, 1), 'other')}{_alike(names.all(other))}"
        )
    for axis, name in enumerate(AXES):
        first, second, third = (relation.reversed[axis] for relation in relations)
        guilty = _guilty(first, second, third, injected is not None)
        if guilty:
            blamed, other = guilty[0], guilty[1] or either
            raise TuningError(
                f"{names.path}: {found}: wrong sign of {names.all(blamed, axis)} ({name}); "
                f"{names.mend(blamed, (axis,), 'sign')}{_alike(names.all(other, axis))}"
            )


def _alike(names: str) -> str:
    return f"; {names} together would look the same" if names else ""


def _guilty(
    injected: bool, torque: bool, angles: bool, injection: bool
) -> tuple[tuple[str, ...], tuple[str, ...]] | None:
    """The signals that break these relations, and those that would break the same; None when all hold."""
    with_injection = ("u", "u_bar") if injection else ("u",)
    table: dict[tuple[bool, bool, bool], tuple[tuple[str, ...], tuple[str, ...]]] = {
        (False, False, True): (("y_o",), ()),
        (False, True, True): (("y_i",), ()),
        (False, True, False): (with_injection, ("y_i", "y_o")),
        (True, True, False): (("u",), ()),
        (True, False, False): (("u_bar",), ()),
        (True, False, True): (("u_bar", "y_o"), ()),
        (True, True, True): (("u", "y_o"), ("u_bar", "y_i")),
    }
    return table.get((injected, torque, angles))


def _check_derivative(kinematics: _Kinematics, names: _Names) -> None:
    """Refuse rates that have nothing to do with the angles."""
    for axis, name in enumerate(AXES):
        if kinematics.moves.all() and kinematics.explained[axis] < EXPLAINED:
            raise TuningError(
                f"{names.path}: the rates in {names.of('y_i')} explain {max(kinematics.explained[axis], 0):.0%} of "
                f"how {name} in {names.of('y_o')} moves, expected nearly all: they are not of one vehicle, not of one "
                "time, or not rates and angles"
            )


def _check_units(kinematics: Matrix, body: RigidBody | None, names: _Names) -> None:
    """Refuse degrees that are taken for radians, and the reverse, in rates, in angles or in both."""
    wrong: list[str] = []
    lines: list[tuple[tuple[str, ...], int]] = []
    for axis, name in enumerate(AXES):
        factor, extreme = float(kinematics[axis, axis]), _extreme(body, axis)
        if SAME_UNIT[0] < factor < SAME_UNIT[1]:
            if not extreme:
                continue
            assert body is not None
            unit = "told in degrees but are in radians, or the torque is no share of the full one"
            wrong.append(
                f"a unit of torque accelerates {name} by {body.B[axis, axis]:.3g} rad/s^2, too {SIZES[extreme]} for "
                f"a multirotor ({ACCELERATION[0]:g} to {ACCELERATION[1]:g}) or beside the other axis: its rates and "
                f"angles are {'in degrees' if extreme > 0 else unit}"
            )
            lines.append((("y_i", "y_o"), axis))
            continue
        degrees = any(SAME_UNIT[0] < ratio < SAME_UNIT[1] for ratio in (factor / DEGREE, factor * DEGREE))
        wrong.append(
            f"{name} moves {factor:.3g} times what its rate makes of it, expected 1: "
            f"{'degrees are taken for radians' if degrees else 'a wrong unit'}"
        )
        if degrees:
            # Rates are wrong where the acceleration is; else the angles are.
            guilty = "y_i" if extreme else "y_o"
            lines.append(((guilty,), axis))
    if wrong:
        mend = names.tell([line for signals, axis in lines for line in names.lines(signals, (axis,), "unit")])
        raise TuningError(f"{names.path}: {'; '.join(wrong)}; {mend or 'correct the unit of one'}")


def _extreme(body: RigidBody | None, axis: int) -> int:
    """1 for an acceleration that is too large, -1 for one that is too small, 0 for one that a multirotor may have."""
    if body is None:
        return 0
    own, other = (abs(float(body.B[i, i])) for i in (axis, 1 - axis))
    if not ACCELERATION[0] <= own <= ACCELERATION[1]:
        return 1 if own > ACCELERATION[1] else -1
    ratio, middle = own / max(other, 1e-9), math.sqrt(ACCELERATION[0] * ACCELERATION[1])
    farther = abs(math.log(own / middle)) > abs(math.log(max(other, 1e-9) / middle))
    if farther and not 1 / UNLIKE <= ratio <= UNLIKE:
        return 1 if ratio > 1 else -1
    return 0


def _check_clear(body: RigidBody, names: _Names) -> None:
    """Refuse a response whose signs are not clear of its error."""
    determinant, deviation = body.determinant()
    for axis, name in enumerate(AXES):
        value, error = body.B[axis, axis], body.deviation[axis, axis]
        if value < CLEAR * error:
            raise TuningError(
                f"{names.path}: a unit of torque accelerates {name} by {value:.3g} +- {error:.2g} rad/s^2: too "
                "uncertain to know its sign; inject a stronger or longer torque"
            )
    if determinant < CLEAR * deviation:
        raise TuningError(
            f"{names.path}: roll and pitch cannot be told apart in the response to torque (determinant "
            f"{determinant:.3g} +- {deviation:.2g}): inject a stronger or longer torque on each axis by itself"
        )


def _said(what: str, matrix: Matrix, unit: str = "") -> str:
    rows = "; ".join(f"{a:.3g}, {b:.3g}" for a, b in matrix)
    return f"{what} [{rows}] {unit}".rstrip()


class _Names:
    """How a log names its signals, and the lines of a column file that mend them."""

    def __init__(self, recording: Recording) -> None:
        self.path, self.recording = recording.path, recording

    def of(self, signal: str) -> str:
        """Both axes of a signal."""
        return self.recording.signals[signal].topic

    def all(self, signals: Sequence[str], axis: int | None = None) -> str:
        """Several signals, on both axes or on one."""
        columns = self.recording.columns
        if columns is None or axis is None:
            return " and ".join(self.of(signal) for signal in signals)
        return " and ".join(columns.name(SIGNALS[signal][axis]) for signal in signals)

    def lines(self, signals: Sequence[str], axes: Sequence[int], what: str) -> list[str]:
        """The lines of a column file for some axes of signals: another ``sign`` or ``unit``, or the ``other`` column;
        none where the log names its signals itself.
        """
        columns = self.recording.columns
        if columns is None:
            return []
        lines = []
        for signal in signals:
            for axis in axes:
                field, other = SIGNALS[signal][axis], SIGNALS[signal][1 - axis]
                lines.append(columns.line(field, other if what == "other" else field, what))
        return lines

    def tell(self, lines: Sequence[str]) -> str:
        """How to give the lines to the program."""
        return f"put into the --columns file: {', '.join(lines)}" if lines else ""

    def mend(self, signals: Sequence[str], axes: Sequence[int], what: str) -> str:
        """What to do about some axes of signals."""
        told = self.tell(self.lines(signals, axes, what))
        return told or f"{self.all(signals)} in this log is not what its name says"
