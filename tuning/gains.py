"""The gains of the cascaded controller: the contract between tuning, code generation and simulation.

One controller is five 2x2 matrices for roll and pitch, five scalars for yaw, its period and filters, and its limits.
Model following adds two matrices.
Element (i, j) of a matrix maps the error on axis j to output i. Every scalar has a short code, such as ``RP_RR``
(rate P, roll from roll). On a vehicle the parameter's name is that code with the prefix ``MIMO_``. The table of all of
them is `tuning.parameters`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.common.files import sha256, write_atomically
from mimopilot.tuning.certificate import Certificate, Verdict
from mimopilot.tuning.control_laws import control_law
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.gains_text import gains_text
from mimopilot.tuning.law_filters import LATER_FILTERS, MIMO, Filters, StockFilters
from mimopilot.tuning.parameter_checks import check_values
from mimopilot.tuning.parameter_row import AXES, NOT_NEGATIVE, POSITIVE, Row, Shape
from mimopilot.tuning.parameters import IDENTITY, MATRICES, ROWS, YAW_GAINS, rows
from mimopilot.tuning.provenance import Provenance
from mimopilot.tuning.reference_model import ReferenceModel, SecondOrder

Matrix = NDArray[np.float64]
Triple = tuple[float, float, float]

#: Reference models of the thesis' flights (chapter 6): rate loop, attitude loop.
THESIS_INNER = (SecondOrder(20.0, 0.4),) * 2
THESIS_OUTER = (SecondOrder(10.0, 0.7),) * 2
#: Stands for a matrix that was not given: zeros, but only while the option that it belongs to is off.
_NOT_GIVEN: Matrix = np.empty((0, 0))
#: Seal of a certificate that was read from a gains file of schema 1.
SCHEMA_1 = "schema 1"
#: Largest relative difference of the ratios of roll and pitch at which a certificate stays valid: rounding of the unit.
SAME_RATIO = 1e-3


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
        Limit of the attitude controller's output, the rate setpoint.
    moment_max : tuple of 3 float
        Limit of the torque u (normalised), excitation included.
    integral_max : tuple of 3 float
        Limit of the integral term I, in the unit of u.
    """

    rate_max: Triple = (10.0, 10.0, 3.5)
    moment_max: Triple = (1.0, 1.0, 1.0)
    integral_max: Triple = (0.3, 0.3, 0.3)


@dataclass(frozen=True, eq=False, repr=False)
class Gains:
    """A complete set of gains for one vehicle.

    Attributes
    ----------
    Kp_o : (2, 2) array, 1/s
        Attitude controller: rate setpoint from angle error.
    Kp_i, Ki_i, Kd_i, Kff_i : (2, 2) arrays, s, 1, s^2, s
        Rate controller: torque (normalised) from rate error, its integral, the measured angular acceleration
        (subtracted) and the rate setpoint.
    yaw : YawGains
        The same five terms for yaw.
    filters : Filters
        Control period and filters.
    limits : Limits
        Saturations.
    Kff_o, Kaff_i : (2, 2) arrays, 1, s^2
        Model following: rate setpoint from the rate of the attitude model, torque from its angular acceleration. Zero
        if not given, which is an error while the model is on (`filters.model_omega`).
    moment_scale : tuple of 3 float or None, N m
        Torque of u = 1 on roll, pitch and yaw. None: not known.
    certificate : Certificate or None
        Stability of the loop. Valid only while neither it nor the gains are edited; see `verdict`. None: never
        examined.
    provenance : Provenance
        Origin of the gains.

    Raises
    ------
    TuningError
        When a matrix is not 2x2 or is missing, a number is not finite, a limit is out of its range, or a set for a
        stock controller has what that one does not have.
    """

    Kp_o: Matrix
    Kp_i: Matrix
    Ki_i: Matrix
    Kd_i: Matrix
    Kff_i: Matrix
    yaw: YawGains
    filters: Filters
    limits: Limits = Limits()
    Kff_o: Matrix = field(default_factory=lambda: _NOT_GIVEN)
    Kaff_i: Matrix = field(default_factory=lambda: _NOT_GIVEN)
    moment_scale: Triple | None = None
    certificate: Certificate | None = None
    provenance: Provenance = field(default_factory=Provenance)

    def __post_init__(self) -> None:
        for row in rows(Shape.MATRIX):
            name, given = row.key, getattr(self, row.key)
            if given is _NOT_GIVEN:
                if self.uses(row):
                    raise TuningError(
                        f"{row.section}.{name}: missing; it has no default while {row.option} is not 0: give it, or "
                        f"set {row.option} to 0"
                    )
                given = np.full((2, 2), row.default)
            matrix = np.array(given, dtype=np.float64)
            if matrix.shape != (2, 2):
                raise TuningError(f"{name}: got shape {matrix.shape}, expected (2, 2), roll then pitch")
            matrix.flags.writeable = False
            object.__setattr__(self, name, matrix)
        for row in ROWS:
            check_values(row, self._values(row), self.Ts)
        self._check_law()
        shaping = self.filters.shaping_s
        if not NOT_NEGATIVE.holds(shaping) or (shaping and self.filters.stock):
            expected = 0 if self.filters.stock else NOT_NEGATIVE
            raise TuningError(f"shaping_s: got {shaping} s, expected {expected}; a stock set has it in its filters")
        for axis, value in zip(AXES, self.moment_scale or (), strict=False):
            if not POSITIVE.holds(value):
                raise TuningError(f"moment_scale ({axis}): got {value} N m, expected {POSITIVE}")

    def _check_law(self) -> None:
        """Refuse what the law of a stock controller does not have."""
        law = control_law(self.filters)
        for row in ROWS:
            if row.key in law.lacks and any(value != (row.default or 0.0) for value in self._values(row)):
                raise TuningError(f"{row.key}: got {self.of(row)}, but the {self.controller} controller has none")
            if row.shape is Shape.MATRIX and not law.coupled and np.any(self.of(row)[[0, 1], [1, 0]]):
                raise TuningError(
                    f"{row.key}: got off-diagonal gains {self.of(row)[[0, 1], [1, 0]].tolist()}, expected 0: the "
                    f"{self.controller} controller is diagonal"
                )

    @classmethod
    def from_rows(
        cls, values: Mapping[Row, Any], stock: StockFilters | None = None, shaping_s: float = 0.0, **others: Any
    ) -> Gains:
        """A set from what it holds for the rows of the parameter table, see `of`; `others`: the other attributes.

        A row with a default may be left out; `stock` and `shaping_s` are those of `Filters`.
        """
        parts: dict[Shape, dict[str, Any]] = {shape: {} for shape in Shape}
        for row, value in values.items():
            shaped = np.reshape(value, (2, 2)) if row.shape is Shape.MATRIX else value
            parts[row.shape][row.key] = tuple(shaped) if row.shape is Shape.AXES else shaped
        return cls(
            **parts[Shape.MATRIX],
            yaw=YawGains(**parts[Shape.YAW]),
            filters=Filters(**parts[Shape.POLE], **parts[Shape.SCALAR], stock=stock, shaping_s=shaping_s),
            limits=Limits(**parts[Shape.AXES]),
            **others,
        )

    def __repr__(self) -> str:
        return (
            f"<Gains {self.provenance.method or 'of unknown origin'}, {1 / self.Ts:g} Hz, Kp_o "
            f"{np.round(self.Kp_o, 4).tolist()}, Kp_i {np.round(self.Kp_i, 4).tolist()}, {self.verdict()[0]}>"
        )

    @property
    def Ts(self) -> float:  # noqa: N802
        """Control period, s."""
        return self.filters.Ts

    @property
    def derivative_cutoff_hz(self) -> float:
        """Cut-off of the derivative filter, of roll, Hz; 0: none."""
        stock = self.filters.stock
        return self.filters.derivative_cutoff_hz if stock is None else stock.derivative_hz[0]

    @property
    def controller(self) -> str:
        """Controller that the set is for: ``mimo`` (ours), ``px4-stock``, ``ardupilot-stock``, ``betaflight``."""
        return MIMO if self.filters.stock is None else self.filters.stock.controller

    def for_our_law(self) -> Gains:
        """The gains in our law, without a certificate; a stock law's filter of D, roll's, and its shaping are kept."""
        if self.filters.stock is None:
            return self
        filters = replace(
            self.filters,
            stock=None,
            derivative_cutoff_hz=self.derivative_cutoff_hz,
            shaping_s=self.filters.shaping[0],
        )
        return replace(self, filters=filters, certificate=None)

    def of(self, row: Row) -> Any:
        """Value of a row of the parameter table: a matrix, a triple or a number."""
        holder = {Shape.MATRIX: self, Shape.YAW: self.yaw, Shape.AXES: self.limits}.get(row.shape, self.filters)
        return getattr(holder, row.key)

    def uses(self, row: Row) -> bool:
        """Whether a row has an effect: it belongs to no option, or to one that is switched on."""
        return not row.option or getattr(self.filters, row.option) != 0

    @property
    def matrices(self) -> dict[str, Matrix]:
        """Name -> gain matrix of those that are used; see `uses`."""
        return {row.key: self.of(row) for row in rows(Shape.MATRIX) if self.uses(row)}

    def at_default(self, row: Row) -> bool:
        """Whether every number of a row is its default; False if it has none."""
        return row.default is not None and all(value == row.default for value in self._values(row))

    def _values(self, row: Row) -> list[float]:
        """`of` as a list, in the order of `Row.codes`."""
        return [float(value) for value in np.ravel(self.of(row))]

    def elements(self) -> dict[str, float]:
        """Every number of our controller by code, in the order of the C++ struct.

        Raises
        ------
        TuningError
            When the set is for a stock controller.
        """
        if self.controller != MIMO:
            raise TuningError(
                f"controller: the gains are for {self.controller}, expected {MIMO}: our controller flies those of "
                "`mimopilot tune` without --profile"
            )
        return {
            code: row.element(value, self.Ts)
            for row in ROWS
            for code, value in zip(row.codes, self._values(row), strict=True)
        }

    def with_elements(self, changes: Mapping[str, float]) -> Gains:
        """Copy with some elements replaced, given by code; see `elements`.

        Raises
        ------
        TuningError
            When a code is unknown or a value breaks a rule of `Gains`.
        """
        elements = self.elements()
        unknown = sorted(set(changes) - set(elements))
        if unknown:
            raise TuningError(f"unknown gain element {', '.join(unknown)}; known: {', '.join(elements)}")
        elements |= changes
        values: dict[Row, Any] = {}
        for row in ROWS:
            changed = [elements[code] for code in row.codes]
            values[row] = changed[0] if len(changed) == 1 else changed
            if row.shape is Shape.POLE:
                if not row.valid.holds(changed[0]):
                    raise TuningError(f"{row.code}: got {changed[0]}, expected {row.valid}; 0: no filter")
                moved = {row.code, "TS"} & changes.keys()
                values[row] = row.value(changed[0], elements["TS"]) if moved else self.of(row)
        return Gains.from_rows(
            values,
            shaping_s=self.filters.shaping_s,
            moment_scale=self.moment_scale,
            certificate=self.certificate,
            provenance=self.provenance,
        )

    def reference_models(self, axis: int) -> tuple[ReferenceModel, ReferenceModel]:
        """Reference models of the rate and the attitude loop on an axis; the thesis' own when none are known."""
        inner = (self.provenance.inner_model or THESIS_INNER)[axis]
        outer = (self.provenance.outer_model or THESIS_OUTER)[axis]
        return inner.discretise(self.Ts), outer.discretise(self.Ts)

    def identity(self) -> dict[str, float]:
        """Name -> value of `tuning.parameters.IDENTITY`; empty when the unit of torque is not known."""
        return {p.name: value for p, value in zip(IDENTITY, self.moment_scale or (), strict=False)}

    def with_certificate(self, certificate: Certificate | None) -> Gains:
        """The set with a certificate, sealed by the hash of both: an edit of either voids it."""
        if certificate is None:
            return replace(self, certificate=None)
        return replace(self, certificate=replace(certificate, seal=self._seal(certificate)))

    def _seal(self, certificate: Certificate) -> str:
        """Hash of a certificate and of every number that the loop's stability depends on.

        A parameter at its default is left out: a set keeps its certificate when the table gains a row.
        """
        content = {name: value for name, value in certificate.as_table().items() if name != "seal"}
        numbers: dict[str, float] = {}
        for row in ROWS:
            values = self._values(row)
            if not self.at_default(row):
                numbers |= dict(zip(row.codes, (row.element(value, self.Ts) for value in values), strict=True))
                numbers |= {row.key: values[0]} if row.shape is Shape.POLE else {}
        if self.filters.stock is not None:
            law = asdict(self.filters.stock)
            content |= {"law": {k: v for k, v in law.items() if k not in LATER_FILTERS or any(v)}}
        return sha256(json.dumps([content, numbers, self.moment_scale], sort_keys=True, default=str))

    def verdict(self) -> tuple[Verdict, str]:
        """Verdict of the certificate and its reason; ``none`` without one, ``void`` if it or a gain was edited."""
        found = self.certificate
        if found is None:
            return Verdict.NONE, "stability was never examined"
        if found.seal == SCHEMA_1:
            return Verdict.VOID, "the certificate is from a gains file of schema 1, whose seal covers less"
        if not found.seal:
            return Verdict.VOID, "the certificate has no seal: it is from an earlier version, or was written by hand"
        if found.seal != self._seal(found):
            return Verdict.VOID, "the gains or the certificate were edited after it was made"
        return found.verdict, found.reason

    def with_moment_scale(self, scale: Triple) -> Gains:
        """The same controller for an allocator with another unit of torque.

        Rate gains and the limits of the torque and of its integral are in that unit. All are multiplied by old over
        new, for each axis, so that the torque in N m stays the same; no limit exceeds 1. If roll and pitch have the
        same ratio the certificate stays valid and is sealed again; else its figures would change, and it is removed.

        Parameters
        ----------
        scale : tuple of 3 float, N m
            Torque of u = 1 on the target: roll, pitch, yaw.

        Raises
        ------
        TuningError
            When the set's own unit is not known.
        """
        if self.moment_scale is None:
            raise TuningError("moment_scale: the torque of u = 1 in N m is not known; write it into the gains file")
        ratio = np.array(self.moment_scale) / np.array(scale)
        matrices = {name: getattr(self, name) * ratio[:2, None] for name in MATRICES if name.endswith("_i")}
        yaw = {name: getattr(self.yaw, name) * float(ratio[2]) for name in YAW_GAINS if name.endswith("_i")}
        limits = {
            name: tuple(min(float(v * r), 1.0) for v, r in zip(getattr(self.limits, name), ratio, strict=True))
            for name in ("moment_max", "integral_max")
        }
        deviations = dict(self.provenance.standard_deviation)
        for name in deviations.keys() & matrices.keys():
            deviations[name] = (np.array(deviations[name]) * ratio[:2, None]).tolist()
        stock = self.filters.stock
        if stock is not None:
            moved = tuple(v * float(r) for v, r in zip(stock.derivative_feedforward, ratio, strict=True))
            stock = replace(stock, derivative_feedforward=moved)
        of_yaw = deviations.get("yaw", {})
        if of_yaw:
            deviations["yaw"] = {n: v * float(ratio[2]) if n.endswith("_i") else v for n, v in of_yaw.items()}
        changed = replace(
            self,
            moment_scale=scale,
            filters=replace(self.filters, stock=stock),
            yaw=replace(self.yaw, **yaw),
            limits=replace(self.limits, **limits),  # type: ignore[arg-type]
            provenance=replace(self.provenance, standard_deviation=deviations),
            **matrices,
        )
        if self.certificate is None or self.verdict()[0] == Verdict.VOID:
            return changed
        if abs(ratio[0] / ratio[1] - 1) > SAME_RATIO:
            return replace(changed, certificate=None)
        return changed.with_certificate(self.certificate)

    def save(self, path: str | Path) -> None:
        """Write the set as a readable TOML file, ``*.gains.toml``, atomically."""
        write_atomically(Path(path), gains_to_toml(self))


def gains_to_toml(gains: Gains) -> str:
    """Text of the gains file; reading it back restores the same bits of every float."""
    written = {row: gains.of(row) for row in ROWS if gains.uses(row) or not gains.at_default(row)}
    return gains_text(written, gains.filters, gains.moment_scale, gains.certificate, gains.provenance)
