"""Period, filters and attitude model of a control law: ours, and those of PX4, ArduPilot and Betaflight."""

from __future__ import annotations

from dataclasses import dataclass, replace

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.parameter_row import AXES, NOT_NEGATIVE, pole_of
from mimopilot.tuning.parameters import YAW_WEIGHT
from mimopilot.tuning.reference_model import ReferenceModel, followed_model

#: Names of the laws; those of the stock ones are also the profiles of an upload.
MIMO, PX4_STOCK, ARDUPILOT_STOCK, BETAFLIGHT = "mimo", "px4-stock", "ardupilot-stock", "betaflight"


@dataclass(frozen=True)
class StockFilters:
    """Filters and fixed gains of a stock law, each for roll, pitch, yaw.

    Attributes
    ----------
    controller : str
        Key of `LAWS`.
    derivative_hz, setpoint_hz, error_hz, torque_hz, derivative2_hz : tuple of float, Hz
        Cut-offs of the first-order low-passes of the derivative, the rate setpoint, the rate error and the torque, and
        of a second one of the derivative; 0: no filter.
    derivative_feedforward : tuple of float, s^2
        Torque from the derivative of the rate setpoint.
    shaping_s : tuple of float, s
        Time constant of the attitude setpoint's shaping, whose rate is fed forward; 0: neither.
    """

    controller: str
    derivative_hz: tuple[float, ...]
    setpoint_hz: tuple[float, ...] = (0.0, 0.0, 0.0)
    error_hz: tuple[float, ...] = (0.0, 0.0, 0.0)
    torque_hz: tuple[float, ...] = (0.0, 0.0, 0.0)
    derivative_feedforward: tuple[float, ...] = (0.0, 0.0, 0.0)
    shaping_s: tuple[float, ...] = (0.0, 0.0, 0.0)
    derivative2_hz: tuple[float, ...] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name in STOCK_FILTERS:
            for axis, value in zip(AXES, getattr(self, name), strict=False):
                if not NOT_NEGATIVE.holds(value):
                    raise TuningError(f"filters.{name} ({axis}): got {value}, expected {NOT_NEGATIVE}")

    def on(self, axes: slice, yaw_unit: float = 1.0) -> StockFilters:
        """The filters of some axes, see `Filters.on`."""
        found = replace(self, **{name: getattr(self, name)[axes] for name in STOCK_FILTERS})
        *others, yaw = found.derivative_feedforward
        return found if yaw_unit == 1.0 else replace(found, derivative_feedforward=(*others, yaw / yaw_unit))


#: Names of the filters and fixed gains.
STOCK_FILTERS = (
    "derivative_hz",
    "setpoint_hz",
    "error_hz",
    "torque_hz",
    "derivative_feedforward",
    "shaping_s",
    "derivative2_hz",
)
#: Those that were not known from the beginning: at 0 they change no certificate.
LATER_FILTERS = ("shaping_s", "derivative2_hz")


@dataclass(frozen=True)
class Filters:
    """Period, filters and attitude model of the law.

    Attributes
    ----------
    Ts : float, s
        Control period.
    derivative_cutoff_hz : float, Hz
        Cut-off f_d of our law's first-order derivative filter; 0 means no filter. Stock laws have theirs in `stock`.
    model_omega : float, rad/s
        Natural frequency of the attitude model; 0 means no model following.
    model_damping : float
        Damping ratio of the attitude model.
    yaw_weight : float
        Weight of the yaw error in the attitude error, above 0 and at most 1.
    setpoint_slew : float, rad/s
        Slew limit of the attitude setpoint; 0 means none.
    stock : StockFilters or None
        The stock law that the gains are for. None: ours.
    shaping_s : float, s
        Of our law where ArduPilot gives its setpoints: time constant of their shaping; their rate is fed forward. 0:
        neither. It is outside of the loop.
    """

    Ts: float
    derivative_cutoff_hz: float = 0.0
    model_omega: float = 0.0
    model_damping: float = 0.7
    yaw_weight: float = YAW_WEIGHT
    setpoint_slew: float = 0.0
    stock: StockFilters | None = None
    shaping_s: float = 0.0

    @property
    def derivative_pole(self) -> float:
        """Pole a = exp(-2 pi f_d Ts) of our derivative filter; 0 when f_d = 0."""
        return pole_of(self.derivative_cutoff_hz, self.Ts)

    @property
    def followed(self) -> ReferenceModel | None:
        """Attitude model of roll and of pitch; None: no model following."""
        return followed_model(self.model_omega, self.model_damping, self.Ts) if self.model_omega else None

    @property
    def shaping(self) -> tuple[float, ...]:
        """Time constant (s) of the autopilot's shaping of the setpoint, for each axis; 0: none."""
        return (self.shaping_s,) * 3 if self.stock is None else self.stock.shaping_s

    def on(self, axes: slice, yaw_unit: float = 1.0) -> Filters:
        """The filters of some axes: 0 roll, 1 pitch, 2 yaw, the last with another unit of torque."""
        return self if self.stock is None else replace(self, stock=self.stock.on(axes, yaw_unit))
