"""Tuning specification: reference models, method, and what the log lacks. Read from TOML and validated."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator, model_validator

from mimopilot.common.errors import InputFileError
from mimopilot.common.toml import checked, complaint, read_toml
from mimopilot.tuning.certificate import DEFAULT_THRESHOLDS, Thresholds
from mimopilot.tuning.control_laws import LAWS
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.law_filters import MIMO
from mimopilot.tuning.reference_model import ContinuousModel, ReferenceModel, SecondOrder, model_from_table

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Triple = tuple[Positive, Positive, Positive]
#: Roll, pitch; checked by a validator of `TuningSpec`.
Models = tuple[ContinuousModel, ContinuousModel]
#: Models of a loop if only those of the other one are given.
DEFAULT_MODELS: dict[str, Models] = {"inner": (SecondOrder(30.0, 0.7),) * 2, "outer": (SecondOrder(10.0, 0.7),) * 2}


class _SpecTable(BaseModel):
    """Table of the specification: unknown entries are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class YawSpec(_SpecTable):
    """Yaw gains, for logs without them; names and units as in `tuning.gains.YawGains`."""

    Kp_o: Finite
    Kp_i: Finite
    Ki_i: Finite
    Kd_i: Finite
    Kff_i: Finite = 0.0


class LimitsSpec(_SpecTable):
    """Saturations; names and units as in `tuning.gains.Limits`."""

    rate_max: Triple
    moment_max: Triple
    integral_max: Triple


class DesignLimits(_SpecTable):
    """Limits of the design on the measured response.

    Attributes
    ----------
    Ms : float
        Largest singular value of the sensitivity, cut at the torques and at the angles, the response's error included.
        1.6 leaves 36 degrees and 8.5 dB on each axis (S. Skogestad, I. Postlethwaite, Multivariable Feedback Control).
    noise : float
        RMS of the torque at hover that noise causes, over that of the flown gains, for each axis.
    """

    Ms: Annotated[float, Field(gt=1.05, le=2.5)] = 1.6
    noise: Annotated[float, Field(gt=0, le=10)] = 1.5


class TuningSpec(_SpecTable):
    """One tuning task.

    Attributes
    ----------
    profile : str
        Controller that the gains are for: ``mimo`` (ours), ``px4-stock``, ``ardupilot-stock`` or ``betaflight``. Those
        of a stock one are designed within its own law, diagonal, from a flight with it.
    method : str
        ``mimo``: full matrices. ``siso``: each axis by itself, with the optimal prefilter (3.12).
    inner, outer : tuple of 2 ContinuousModel or None
        Reference models of the rate and the attitude loop, roll then pitch. In TOML [omega rad/s, damping, delay
        samples], one list for both axes or one for each. Both None: the gains are designed on the measured response,
        see `tuning.design.response_design`. Else VRFT finds them for these models, as in the thesis; one that is not
        given is 30 rad/s, 0.7 or 10 rad/s, 0.7.
    structure : str
        Terms of the rate controller: letters of ``PIDF`` in that order, P among them. The attitude controller is P.
    instrument : str
        ``external``: lags of the injected torque, or of the setpoint. ``u``: lags of the whole torque, the thesis'
        choice. ``model``, ``repeated``: see `tuning.estimation.instrumental_variables.instruments`.
    trim : bool
        Estimate a constant (trim, initial integrator) on each stretch; the thesis does not.
    window : int or None, samples
        Lags of the instrument; None: from the reference model.
    weight : str
        Weight of the rate loop's instruments: ``optimal`` is (3.30), in two steps; ``identity`` is plain least squares.
        (3.30) needs a residual that is noise. The attitude loop's residual is the P controller's error, so that loop
        always uses ``identity``.
    pull : float
        Pull of the rate gains towards the flown ones, for short logs: 1 moves a single gain halfway, 0 not at all.
    refine : bool
        Refine VRFT's attitude gains on the measured frequency response, see `tuning.design.refine_attitude`.
    derivative_cutoff_hz : float or None, Hz
        Cut-off of the derivative filter; None: as flown.
    moment_scale : tuple of 3 float or None, N m
        Torque of u = 1; None: as logged.
    yaw, limits
        None: as flown.
    certificate : Thresholds
        Margins that the verdict needs.
    design : DesignLimits
        Limits of the design on the measured response.
    follow_model : bool
        Design for model following: the attitude model runs in the controller, with feed-forward.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)

    profile: Literal["mimo", "px4-stock", "ardupilot-stock", "betaflight"] = "mimo"
    method: Literal["mimo", "siso"] = "mimo"
    inner: Models | None = None
    outer: Models | None = None
    structure: Literal["P", "PI", "PD", "PID", "PF", "PIF", "PDF", "PIDF"] = "PID"
    instrument: Literal["external", "u", "model", "repeated"] = "external"
    trim: bool = True
    window: Annotated[int, Field(ge=1, le=500)] | None = None
    weight: Literal["identity", "optimal"] = "optimal"
    pull: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    refine: bool = True
    derivative_cutoff_hz: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None
    moment_scale: Triple | None = None
    yaw: YawSpec | None = None
    limits: LimitsSpec | None = None
    certificate: Thresholds = DEFAULT_THRESHOLDS
    design: DesignLimits = DesignLimits()
    follow_model: bool = False

    @field_validator("inner", "outer", mode="before")
    @classmethod
    def _one_model_for_both_axes(cls, value: object, info: ValidationInfo) -> object:
        if value is None:
            return None
        several = isinstance(value, list | tuple) and len(value) == 2 and not isinstance(value[0], int | float)
        models = value if isinstance(value, list | tuple) and several else (value, value)
        return tuple(
            model if isinstance(model, ContinuousModel) else model_from_table(model, str(info.field_name))
            for model in models
        )

    def models(self, loop: Literal["inner", "outer"], Ts: float) -> list[ReferenceModel]:
        """Reference models of a loop, roll then pitch; `DEFAULT_MODELS` if none are given."""
        return [model.discretise(Ts) for model in self.continuous(loop)]

    def continuous(self, loop: Literal["inner", "outer"]) -> Models:
        """The same, as specified."""
        given: Models | None = getattr(self, loop)
        return given or DEFAULT_MODELS[loop]

    @model_validator(mode="after")
    def _stock_laws_are_as_they_are(self) -> TuningSpec:
        if self.profile == MIMO:
            return self
        given = {
            "method": self.method != "mimo",
            "inner, outer": self.for_models,
            "follow_model": self.follow_model,
            "derivative_cutoff_hz": self.derivative_cutoff_hz is not None,
        }
        for name in (name for name, found in given.items() if found):
            raise ValueError(
                f"{name}: not with profile {self.profile}, whose law is diagonal, with the filters that flew; leave it "
                "out"
            )
        return self

    @property
    def label(self) -> str:
        """Name of the method: that of the stock controller, if it is for one."""
        return self.method if self.profile == MIMO else self.profile

    @property
    def full(self) -> bool:
        """Whether the gains have off-diagonals."""
        return self.method == "mimo" and LAWS[self.profile].coupled

    @property
    def for_models(self) -> bool:
        """Whether the gains are asked for reference models, as in the thesis."""
        return self.inner is not None or self.outer is not None


def load_spec(path: Path | None = None, **overrides: object) -> TuningSpec:
    """Specification from a TOML file, with the given entries replaced (None: not given).

    Raises
    ------
    Error
        When the file cannot be read, is not TOML, or has an unknown or invalid entry.
    """
    table = read_toml(path, "specification", "leave out --spec") if path is not None else {}
    given = {name: value for name, value in overrides.items() if value is not None}
    try:
        TuningSpec.model_validate(given)
    except ValidationError as error:
        raise InputFileError(f"--{complaint(error, TuningSpec)}") from error
    table |= given
    return checked(TuningSpec, table, str(path or "specification"))


def parse_model(text: str, option: str = "") -> tuple[float, float, int]:
    """Parse a second-order reference model of the command line: ``OMEGA,ZETA,DELAY`` (rad/s, damping, samples).

    Raises
    ------
    TuningError
        When it is not two or three numbers.

    Examples
    --------
    >>> parse_model("20,0.4,0")
    (20.0, 0.4, 0)
    """
    parts = text.split(",")
    try:
        if len(parts) not in (2, 3):
            raise ValueError
        return float(parts[0]), float(parts[1]), int(parts[2]) if len(parts) == 3 else 0
    except ValueError:
        raise TuningError(
            f"{option or 'reference model'}: got {text!r}, expected OMEGA,ZETA,DELAY such as 20,0.4,0"
        ) from None
