"""What to tune for: reference models, method, and what the log does not say. TOML in, validated."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from mimopilot.tuning.certificate import DEFAULT_THRESHOLDS, Thresholds
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.reference_model import ReferenceModel, SecondOrder, model_from_table
from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator

from mimopilot.common.toml import checked, read_toml

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Triple = tuple[Positive, Positive, Positive]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class YawSpec(_Table):
    """Yaw gains, for logs that do not hold them; names as in `tuning.gains.YawGains`."""

    Kp_o: Finite
    Kp_i: Finite
    Ki_i: Finite
    Kd_i: Finite
    Kff_i: Finite = 0.0


class LimitsSpec(_Table):
    """Saturations; names and units as in `tuning.gains.Limits`."""

    rate_max: Triple
    moment_max: Triple
    integral_max: Triple


class Manoeuvre(_Table):
    """A doublet that all gains are refined for, `tuning.design.refine_manoeuvre`.

    Attributes
    ----------
    amplitude_deg : float, deg
    period_s : float, s
        Its whole length.
    effort : tuple of 2 float or None
        RMS of both moments together that the roll and the pitch doublet may need; None: what they need with the
        gains that VRFT gives.
    """

    amplitude_deg: Annotated[float, Field(gt=0, le=60)]
    period_s: Annotated[float, Field(gt=0, le=60)]
    effort: tuple[Positive, Positive] | None = None


class TuningSpec(_Table):
    """One tuning task.

    Attributes
    ----------
    method : str
        ``mimo``: full matrices. ``siso``: each axis by itself, with the optimal prefilter (3.12).
    inner, outer : tuple of 2 SecondOrder
        Reference models of the rate and the attitude loop, roll then pitch. In TOML [omega rad/s, damping, delay
        samples], one list for both axes or one each.
    structure : str
        Terms of the rate controller: letters of ``PIDF`` in that order, P among them. The attitude controller is P.
    instrument : str
        ``external``: lags of the injected moment, or of the set-point. ``u``: lags of the moment that acted, the
        thesis' choice. ``model``, ``repeated``: see `tuning.estimation.instrumental_variables.instruments`.
    trim : bool
        Estimate a constant (trim, initial integrator) on each stretch; the thesis does not.
    window : int or None, samples
        Lags of the instrument; None: from the reference model.
    weight : str
        Of the rate loop's instruments: ``optimal`` is (3.30), in two steps; ``identity`` is plain least squares.
        (3.30) holds where the residual is noise, so the attitude loop, whose residual is what a P controller
        cannot do, always uses the latter.
    pull : float
        Pull of the rate gains towards the flying ones, the safe choice on a short log: 1 goes half of the way for a
        gain that stands alone; 0 none.
    refine : bool
        Refine the attitude gains on the measured frequency response, `tuning.analysis.closed_loop.refine_outer`; False
        leaves them as VRFT gives them.
    doublet_s : float or None, s
        Length of the doublet that the refinement weighs errors by; None: 1/omega, for set-points of all kinds.
    manoeuvre : Manoeuvre or None
        Refine all gains, of both loops, for this doublet; None: the rate loop stays as its model asks.
    derivative_cutoff_hz : float or None, Hz
        Of the derivative filter that will fly; None: as flown.
    moment_scale : tuple of 3 float or None, N m
        What one unit of u stands for; None: as logged.
    yaw, limits
        None: as flown.
    certificate : Thresholds
        Margins that verdicts need.
    """

    method: Literal["mimo", "siso"] = "mimo"
    inner: tuple[SecondOrder, SecondOrder] = (SecondOrder(30.0, 0.7), SecondOrder(30.0, 0.7))
    outer: tuple[SecondOrder, SecondOrder] = (SecondOrder(10.0, 0.7), SecondOrder(10.0, 0.7))
    structure: Annotated[str, Field(pattern="^PI?D?F?$")] = "PID"
    instrument: Literal["external", "u", "model", "repeated"] = "external"
    trim: bool = True
    window: Annotated[int, Field(ge=1, le=500)] | None = None
    weight: Literal["identity", "optimal"] = "optimal"
    pull: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    refine: bool = True
    doublet_s: Annotated[float, Field(gt=0, le=60)] | None = None
    manoeuvre: Manoeuvre | None = None
    derivative_cutoff_hz: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None
    moment_scale: Triple | None = None
    yaw: YawSpec | None = None
    limits: LimitsSpec | None = None
    certificate: Thresholds = DEFAULT_THRESHOLDS

    @field_validator("inner", "outer", mode="before")
    @classmethod
    def _one_model_for_both_axes(cls, value: object, info: ValidationInfo) -> object:
        several = isinstance(value, list | tuple) and len(value) == 2 and not isinstance(value[0], int | float)
        models = value if isinstance(value, list | tuple) and several else (value, value)
        return tuple(
            model if isinstance(model, SecondOrder) else model_from_table(model, str(info.field_name))
            for model in models
        )

    def models(self, loop: Literal["inner", "outer"], Ts: float) -> list[ReferenceModel]:
        """Reference models of a loop, roll then pitch."""
        return [model.discretise(Ts) for model in getattr(self, loop)]


def load_spec(path: Path | None = None, **overrides: object) -> TuningSpec:
    """A specification from a TOML file, with the given entries replaced (None: not given).

    Raises
    ------
    TuningError
        When the file cannot be read, is not TOML, or holds an unknown or impossible entry.
    """
    table = read_toml(path, "specification") if path is not None else {}
    table |= {name: value for name, value in overrides.items() if value is not None}
    return checked(TuningSpec, table, str(path or "specification"))


def parse_model(text: str) -> SecondOrder:
    """``OMEGA,ZETA,DELAY`` (rad/s, damping, samples) as it stands on the command line.

    Raises
    ------
    TuningError
        When it is not two or three numbers.

    Examples
    --------
    >>> parse_model("20,0.4,0")
    SecondOrder(omega=20.0, zeta=0.4, delay=0)
    """
    parts = text.split(",")
    try:
        if len(parts) not in (2, 3):
            raise ValueError
        omega, zeta, delay = float(parts[0]), float(parts[1]), int(parts[2]) if len(parts) == 3 else 0
    except ValueError:
        raise TuningError(f"reference model: got {text!r}, expected OMEGA,ZETA,DELAY such as 20,0.4,0") from None
    return SecondOrder(omega, zeta, delay)


def parse_doublet(text: str) -> dict[str, float]:
    """``DEGREES,SECONDS`` as it stands on the command line: a `Manoeuvre`.

    Raises
    ------
    TuningError
        When it is not two numbers.
    """
    try:
        amplitude, period = (float(part) for part in text.split(","))
    except ValueError:
        raise TuningError(f"doublet: got {text!r}, expected DEGREES,SECONDS such as 22.5,0.42") from None
    return {"amplitude_deg": amplitude, "period_s": period}
