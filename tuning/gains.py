"""The gains of the cascaded controller: the contract between tuning, code generation and the bench.

One controller is five 2x2 matrices for roll and pitch, five scalars for yaw, its period, the cut-off
of its derivative filter and its limits. Element (i, j) of a matrix makes output i from the error on
axis j. Every scalar also has a short code, such as ``RP_RR`` (rate P, roll from roll); on a vehicle
that code with the prefix ``MIMO_`` is the parameter's name.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from mimopilot.tuning.errors import TuningError
from numpy.typing import NDArray

from mimopilot.common.files import sha256, write_atomically
from mimopilot.common.toml import parse_toml, read_toml, shown, shown_text, toml_entries, toml_value

SCHEMA = 1
PARAMETER_PREFIX = "MIMO_"
AXES = ("roll", "pitch", "yaw")
AXIS_LETTERS = "RPY"

#: Matrix -> code of its loop and term. The order is that of the C++ struct and of every table.
MATRICES = {"Kp_o": "AP", "Kp_i": "RP", "Ki_i": "RI", "Kd_i": "RD", "Kff_i": "RF"}
LIMITS = {"rate_max": "RMAX", "moment_max": "UMAX", "integral_max": "IMAX"}

Matrix = NDArray[np.float64]
Triple = tuple[float, float, float]


@dataclass(frozen=True)
class YawGains:
    """The scalar P + PID of the yaw axis; units as in `Gains`."""

    Kp_o: float
    Kp_i: float
    Ki_i: float
    Kd_i: float
    Kff_i: float = 0.0


@dataclass(frozen=True)
class Limits:
    """Saturations of the controller, each for roll, pitch, yaw.

    Attributes
    ----------
    rate_max : tuple of 3 float, rad/s
        Limit of the rate set-point that the outer loop makes.
    moment_max : tuple of 3 float
        Limit of the dimensionless control moment u, excitation included.
    integral_max : tuple of 3 float
        Limit of the integral term I, in the unit of u.
    """

    rate_max: Triple = (10.0, 10.0, 3.5)
    moment_max: Triple = (1.0, 1.0, 1.0)
    integral_max: Triple = (0.3, 0.3, 0.3)


@dataclass(frozen=True, eq=False)
class Gains:
    """A complete set of gains for one vehicle.

    Attributes
    ----------
    Kp_o : (2, 2) array, 1/s
        Outer loop: rate set-point from angle error.
    Kp_i, Ki_i, Kd_i, Kff_i : (2, 2) arrays, s, 1, s^2, s
        Inner loop: dimensionless moment from rate error, its integral, the measured angular
        acceleration (subtracted) and the rate set-point.
    yaw : YawGains
        The same five terms for yaw.
    Ts : float, s
        Control period.
    derivative_cutoff_hz : float, Hz
        Cut-off of the derivative's first-order filter; 0 means no filter.
    limits : Limits
        Saturations.
    moment_scale : tuple of 3 float or None, N m
        Moment that one unit of u stands for on roll, pitch and yaw. None: the log did not say.
    certificate : mapping or None
        What `tuning.analysis.certificate` found: verdict, reason, figures, band, thresholds, the hash of the log, and
        a seal. It counts only while neither it nor the gains are edited; see `verdict`. None: never examined.
    provenance : mapping
        Where the gains come from: method, log, reference models, standard deviations. Plain TOML values.

    Raises
    ------
    TuningError
        When a matrix is not 2x2, a number is not finite, or a limit is out of its range.
    """

    Kp_o: Matrix
    Kp_i: Matrix
    Ki_i: Matrix
    Kd_i: Matrix
    Kff_i: Matrix
    yaw: YawGains
    Ts: float
    derivative_cutoff_hz: float
    limits: Limits = Limits()
    moment_scale: Triple | None = None
    certificate: Mapping[str, Any] | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in MATRICES:
            matrix = np.array(getattr(self, name), dtype=np.float64)
            if matrix.shape != (2, 2):
                raise TuningError(f"{name}: got shape {matrix.shape}, expected (2, 2), roll then pitch")
            matrix.flags.writeable = False
            object.__setattr__(self, name, matrix)
        for code, value in self._numbers().items():
            if not math.isfinite(value):
                raise TuningError(f"{code}: got {value}, expected a finite number; tune again or correct the file")
        if not 1e-4 <= self.Ts <= 1.0:
            raise TuningError(f"Ts: got {self.Ts} s, expected 0.0001 to 1 s")
        if self.derivative_cutoff_hz < 0:
            raise TuningError(f"derivative_cutoff_hz: got {self.derivative_cutoff_hz}, expected 0 (no filter) or more")
        triples = {f"limits.{name}": getattr(self.limits, name) for name in LIMITS}
        triples["moment_scale"] = self.moment_scale or ()
        for name, triple in triples.items():
            for axis, value in zip(AXES, triple, strict=False):
                if value <= 0:
                    raise TuningError(f"{name} ({axis}): got {value}, expected more than 0")

    def _numbers(self) -> dict[str, float]:
        numbers = {"Ts": self.Ts, "derivative_cutoff_hz": self.derivative_cutoff_hz}
        for name in MATRICES:
            for (i, j), value in np.ndenumerate(getattr(self, name)):
                numbers[f"{name}[{i}][{j}]"] = float(value)
            numbers[f"yaw.{name}"] = float(getattr(self.yaw, name))
        for name in LIMITS:
            numbers |= {f"limits.{name}[{i}]": float(v) for i, v in enumerate(getattr(self.limits, name))}
        numbers |= {f"moment_scale[{i}]": float(v) for i, v in enumerate(self.moment_scale or ())}
        return numbers

    @property
    def derivative_pole(self) -> float:
        """Pole a = exp(-2 pi f_d Ts) of the derivative filter; 0 when f_d = 0."""
        return derivative_pole(self.derivative_cutoff_hz, self.Ts)

    def with_certificate(self, certificate: Mapping[str, Any] | None) -> Gains:
        """The set with a certificate, sealed by the hash of both: whoever edits either of them voids it."""
        if certificate is None:
            return replace(self, certificate=None)
        return replace(self, certificate={**certificate, "seal": self._seal(certificate)})

    def _seal(self, certificate: Mapping[str, Any]) -> str:
        """Hash of a certificate and of everything that the loop's stability depends on, exactly."""
        said = {name: value for name, value in certificate.items() if name != "seal"}
        numbers = {**self.elements(), "derivative_cutoff_hz": self.derivative_cutoff_hz}
        return sha256(json.dumps([said, numbers, self.moment_scale], sort_keys=True, default=str))

    def verdict(self) -> tuple[str, str]:
        """Verdict of the certificate and its reason: ``none`` without one, ``void`` when it or a gain was edited."""
        if self.certificate is None:
            return "none", "stability was never examined"
        if "seal" not in self.certificate:
            return "void", "the certificate is of an earlier version, or was written by hand"
        if self.certificate["seal"] != self._seal(self.certificate):
            return "void", "the gains or the certificate were edited after it was made"
        return str(self.certificate.get("verdict")), str(self.certificate.get("reason"))

    def elements(self) -> dict[str, float]:
        """Every number that the controller runs on, by code, in the order of the C++ struct."""
        values: dict[str, float] = {}
        for name, code in MATRICES.items():
            for (i, j), value in np.ndenumerate(getattr(self, name)):
                values[f"{code}_{AXIS_LETTERS[i]}{AXIS_LETTERS[j]}"] = float(value)
        for name, code in MATRICES.items():
            values[f"{code}_YY"] = float(getattr(self.yaw, name))
        for name, code in LIMITS.items():
            for letter, value in zip(AXIS_LETTERS, getattr(self.limits, name), strict=True):
                values[f"{code}_{letter}"] = float(value)
        values["D_POLE"] = self.derivative_pole
        values["TS"] = self.Ts
        return values

    def with_elements(self, changes: Mapping[str, float]) -> Gains:
        """Copy with the elements named by code replaced; see `elements`.

        Raises
        ------
        TuningError
            When a code is unknown or a value breaks a rule of `Gains`.
        """
        values = self.elements()
        unknown = sorted(set(changes) - set(values))
        if unknown:
            raise TuningError(f"unknown gain element {', '.join(unknown)}; known: {', '.join(values)}")
        values |= changes

        def matrix(code: str) -> Matrix:
            return np.array([[values[f"{code}_{i}{j}"] for j in "RP"] for i in "RP"])

        def triple(code: str) -> Triple:
            return (values[f"{code}_R"], values[f"{code}_P"], values[f"{code}_Y"])

        cutoff = self.derivative_cutoff_hz
        if "D_POLE" in changes or "TS" in changes:
            pole = values["D_POLE"]
            if not 0 <= pole < 1:
                raise TuningError(f"D_POLE: got {pole}, expected 0 (no filter) to below 1")
            cutoff = -math.log(pole) / (2 * math.pi * values["TS"]) if pole > 0 else 0.0
        return replace(
            self,
            yaw=YawGains(**{name: values[f"{code}_YY"] for name, code in MATRICES.items()}),
            Ts=values["TS"],
            derivative_cutoff_hz=cutoff,
            limits=Limits(**{name: triple(code) for name, code in LIMITS.items()}),
            **{name: matrix(code) for name, code in MATRICES.items()},  # type: ignore[arg-type]
        )

    def with_moment_scale(self, scale: Triple) -> Gains:
        """The same controller for an allocator whose unit of moment is another.

        Rate gains and the limits of the moment and of its integral are in that unit: all are multiplied by old over
        new, an axis at a time, so that the moment in N m stays; a limit stays within 1, the most there is. Where roll
        and pitch have one ratio the certificate holds on and is bound to the new matrices; else its figures would
        change, and it is left out.

        Parameters
        ----------
        scale : tuple of 3 float, N m
            What one unit stands for on the target: roll, pitch, yaw.

        Raises
        ------
        TuningError
            When the set does not say its own unit.
        """
        if self.moment_scale is None:
            raise TuningError(
                "moment_scale: the gains do not say how many N m one unit of moment stands for; write it into "
                "their file"
            )
        ratio = np.array(self.moment_scale) / np.array(scale)
        rows = {name: getattr(self, name) * ratio[:2, None] for name in MATRICES if name.endswith("_i")}
        yaw = {name: getattr(self.yaw, name) * float(ratio[2]) for name in MATRICES if name.endswith("_i")}
        limits = {
            name: tuple(min(float(v * r), 1.0) for v, r in zip(getattr(self.limits, name), ratio, strict=True))
            for name in ("moment_max", "integral_max")
        }
        changed = replace(
            self,
            moment_scale=scale,
            yaw=replace(self.yaw, **yaw),
            limits=replace(self.limits, **limits),  # type: ignore[arg-type]
            **rows,  # type: ignore[arg-type]
        )
        deviations = dict(self.provenance.get("standard_deviation", {}))
        for name in deviations.keys() & rows.keys():
            deviations[name] = (np.array(deviations[name]) * ratio[:2, None]).tolist()
        if deviations:
            changed = replace(changed, provenance={**self.provenance, "standard_deviation": deviations})
        if self.certificate is None or self.verdict()[0] == "void":
            return changed
        if abs(ratio[0] / ratio[1] - 1) > 1e-3:
            return replace(changed, certificate=None)
        return changed.with_certificate(self.certificate)

    def save(self, path: Path) -> None:
        """Write the set as a readable TOML file, atomically."""
        write_atomically(path, gains_to_toml(self))


def derivative_pole(cutoff_hz: float, Ts: float) -> float:
    """Pole of the first-order derivative filter, exp(-2 pi f_d Ts), 0 when f_d = 0.

    Parameters
    ----------
    cutoff_hz : float, Hz
        Cut-off f_d.
    Ts : float, s
        Control period.
    """
    return math.exp(-2 * math.pi * cutoff_hz * Ts) if cutoff_hz > 0 else 0.0


def load_gains(path: Path) -> Gains:
    """Read a ``*.gains.toml`` file.

    Raises
    ------
    TuningError
        When the file is missing, is not TOML, lacks a matrix, or holds a number that is not finite.
    """
    return _gains_from_table(read_toml(path, "gains file"), str(path))


def gains_from_toml(text: str, where: str) -> Gains:
    """Parse the text of a gains file; `where` names it in messages. See `load_gains`."""
    return _gains_from_table(parse_toml(text, where), where)


def _gains_from_table(table: dict[str, Any], where: str) -> Gains:
    if table.get("schema") != SCHEMA:
        raise TuningError(
            f"{where}: schema: got {shown(table.get('schema'))}, expected {SCHEMA}; not a mimopilot gains file?"
        )
    known = {
        "schema",
        "Ts",
        "derivative_cutoff_hz",
        "moment_scale",
        "roll_pitch",
        "yaw",
        "limits",
        "certificate",
        "provenance",
    }
    for key in sorted(set(table) - known):
        raise TuningError(f"{where}: {shown_text(key)}: unknown entry; known: {', '.join(sorted(known))}")
    for name in ("certificate", "provenance"):
        if not isinstance(table.get(name, {}), dict):
            raise TuningError(f"{where}: {name}: got {shown(table[name])}, expected a table")
    try:
        scale = _get(table, "moment_scale", "")
        return Gains(
            **{name: _matrix(_get(table, "roll_pitch", ""), name) for name in MATRICES},
            yaw=YawGains(**{name: _number(_get(table, "yaw", ""), name, "yaw") for name in MATRICES}),
            Ts=_number(table, "Ts", ""),
            derivative_cutoff_hz=_number(table, "derivative_cutoff_hz", ""),
            limits=Limits(**{name: _triple(_get(_get(table, "limits", ""), name, "limits"), name) for name in LIMITS}),
            moment_scale=None if scale == "unknown" else _triple(scale, "moment_scale"),
            certificate=table.get("certificate"),
            provenance=table.get("provenance", {}),
        )
    except (TuningError, OverflowError) as error:
        raise TuningError(f"{where}: {error}") from error


def _get(table: Any, key: str, section: str) -> Any:
    if not isinstance(table, dict) or key not in table:
        name = f"{section}.{key}" if section else key
        raise TuningError(f"{name}: missing; every entry must be given, there are no default gains")
    return table[key]


def _number(table: Any, key: str, section: str) -> float:
    value = _get(table, key, section)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TuningError(f"{f'{section}.' if section else ''}{key}: got {shown(value)}, expected a number")
    return float(value)


def _matrix(table: Any, key: str) -> Matrix:
    rows = _get(table, key, "roll_pitch")
    well_formed = (
        isinstance(rows, list)
        and len(rows) == 2
        and all(isinstance(row, list) and len(row) == 2 for row in rows)
        and all(isinstance(v, int | float) and not isinstance(v, bool) for row in rows for v in row)
    )
    if not well_formed:
        raise TuningError(f"roll_pitch.{key}: got {shown(rows)}, expected a 2x2 list of numbers, roll then pitch")
    return np.array(rows, dtype=np.float64)


def _triple(value: Any, name: str) -> Triple:
    if (
        not isinstance(value, list)
        or len(value) != 3
        or not all(isinstance(v, int | float) and not isinstance(v, bool) for v in value)
    ):
        raise TuningError(f"{name}: got {shown(value)}, expected three numbers: roll, pitch, yaw")
    return (float(value[0]), float(value[1]), float(value[2]))


def gains_to_toml(gains: Gains) -> str:
    """Text of the gains file: every float is printed so that reading it back gives the same bits."""

    def matrix(name: str) -> str:
        rows = getattr(gains, name)
        return f"{name} = [{', '.join('[' + ', '.join(repr(float(v)) for v in row) + ']' for row in rows)}]"

    scale = toml_value(list(gains.moment_scale)) if gains.moment_scale else '"unknown"'
    lines = [
        "# mimopilot gains. Row: output; column: error; roll then pitch. Positive Kd damps.",
        "# r_i = Kp_o (r_o - y_o);  u = Kp_i (r_i - y_i) + I - Kd_i dy_i/dt + Kff_i r_i,  I += Ts Ki_i (r_i - y_i)",
        f"schema = {SCHEMA}",
        f"Ts = {float(gains.Ts)!r}  # s",
        f"derivative_cutoff_hz = {float(gains.derivative_cutoff_hz)!r}  # 0: no filter",
        f"moment_scale = {scale}  # N m that u = 1 stands for: roll, pitch, yaw",
        "",
        "[roll_pitch]",
        *(matrix(name) for name in MATRICES),
        "",
        "[yaw]",
        *(f"{name} = {float(getattr(gains.yaw, name))!r}" for name in MATRICES),
        "",
        "[limits]  # roll, pitch, yaw",
        *(f"{name} = {toml_value(list(getattr(gains.limits, name)))}" for name in LIMITS),
    ]
    for name in ("certificate", "provenance"):
        if getattr(gains, name):
            lines += ["", f"[{name}]", *toml_entries(getattr(gains, name))]
    return "\n".join(lines) + "\n"
