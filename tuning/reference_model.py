"""Reference models: the transfer function required of each closed loop."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from mimopilot.common.toml import shown
from mimopilot.tuning.errors import TuningError

#: Range of attitude loops; beyond it a model is a mistake of the user's: smallest natural frequency, rad/s, largest
#: damping ratio, and largest delay, samples.
MIN_OMEGA, MAX_DAMPING, MAX_DELAY = 1e-3, 10, 100


@dataclass(frozen=True)
class ReferenceModel:
    """Scalar discrete transfer function num(z)/den(z) times z^-delay.

    Attributes
    ----------
    num, den : tuple of float
        Coefficients of descending powers of z; den[0] = 1 and len(num) <= len(den).
    delay : int, samples
        Extra dead time.
    Ts : float, s
        Sampling period.
    label : str
        Specification as text, for reports and messages.
    """

    num: tuple[float, ...]
    den: tuple[float, ...]
    delay: int
    Ts: float
    label: str = ""

    @property
    def taps(self) -> NDArray[np.float64]:
        """Numerator in powers of z^-1, aligned with `den` and preceded by the delay, for `lfilter`."""
        lag = len(self.den) - len(self.num) + self.delay
        return np.concatenate([np.zeros(lag), self.num])

    def response(self, signal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Output of the model from rest, along axis 0.

        Parameters
        ----------
        signal : (N,) or (N, n) array
            Input; columns are independent.
        """
        from scipy.signal import lfilter  # takes a second to import, which most commands do not need

        filtered: NDArray[np.float64] = lfilter(self.taps, self.den, signal, axis=0)
        return filtered

    def over(self, other: ReferenceModel) -> ReferenceModel:
        """Product with the inverse of another model, as one proper and stable filter.

        Raises
        ------
        TuningError
            When the other has more delay, or its inverse is not stable.
        """
        lag = len(self.den) - len(self.num) + self.delay - (len(other.den) - len(other.num) + other.delay)
        if lag < 0 or np.any(np.abs(np.roots(other.num)) >= 1):
            raise TuningError(
                f"reference model {self.label} over {other.label}: the quotient is not a proper, stable filter; give "
                "the first at least the delay of the second"
            )
        num, den = np.polymul(self.num, other.den), np.polymul(self.den, other.num)
        delay = lag - (len(den) - len(num))
        label = f"({self.label}) over ({other.label})"
        return ReferenceModel(tuple(num / den[0]), tuple(den / den[0]), delay, self.Ts, label)

    def frequency_response(self, omega: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Value at z = exp(j omega Ts); omega in rad/s."""
        z = np.exp(1j * np.asarray(omega) * self.Ts)
        value: NDArray[np.complex128] = np.polyval(self.num, z) / np.polyval(self.den, z) * z ** -float(self.delay)
        return value

    def settling_samples(self, fraction: float = 0.01) -> int:
        """Samples until a transient of the model is below `fraction` of its peak, delay included."""
        from scipy.signal import lfilter

        slowest = float(np.max(np.abs(np.roots(self.den))))
        if slowest >= 1:
            raise TuningError(f"reference model {self.label}: pole at {slowest:.4g}, expected inside the unit circle")
        horizon = 1 if slowest == 0 else int(np.ceil(np.log(fraction / 100) / np.log(slowest)))
        transient = np.abs(lfilter([1.0], self.den, np.eye(1, horizon + len(self.den))[0]))
        return int(np.flatnonzero(transient > fraction * transient.max())[-1]) + 1 + self.delay


@runtime_checkable
class ContinuousModel(Protocol):
    """A reference model as specified, in continuous time."""

    type: ClassVar[str]

    @property
    def bandwidth(self) -> float:
        """Frequency at which the magnitude begins to fall, rad/s."""

    def discretise(self, Ts: float) -> ReferenceModel:
        """The model sampled every `Ts` seconds, zero-order hold."""

    def as_table(self) -> dict[str, Any]:
        """Parameters and type as plain TOML values; see `model_from_table`."""


@dataclass(frozen=True)
class SecondOrder:
    """omega^2/(s^2 + 2 zeta omega s + omega^2), times z^-delay.

    Attributes
    ----------
    omega : float, rad/s
        Natural frequency.
    zeta : float
        Damping ratio.
    delay : int, samples
        Extra dead time.
    """

    type: ClassVar[str] = "second_order"

    omega: float
    zeta: float
    delay: int = 0

    def __post_init__(self) -> None:
        whole = 0 <= self.delay < np.inf and self.delay == int(self.delay)
        if not (0 < self.omega < np.inf and 0 < self.zeta < np.inf and whole):
            raise TuningError(
                f"reference model: got omega {self.omega} rad/s, damping {self.zeta}, delay {self.delay}; expected "
                "omega and damping above 0, and a delay of whole samples"
            )
        for name, kind in (("omega", float), ("zeta", float), ("delay", int)):
            object.__setattr__(self, name, kind(getattr(self, name)))

    @property
    def bandwidth(self) -> float:
        """The natural frequency, rad/s."""
        return self.omega

    def discretise(self, Ts: float) -> ReferenceModel:
        """See `second_order`."""
        return second_order(self.omega, self.zeta, self.delay, Ts)

    def as_table(self) -> dict[str, Any]:
        """The model as plain TOML values."""
        return {"type": self.type, **asdict(self)}


@dataclass(frozen=True)
class SecondOrderAndPoles:
    """A second-order model and further real poles: `SecondOrder` times p/(s + p) for each.

    Attributes
    ----------
    omega, zeta, delay
        As in `SecondOrder`.
    poles : tuple of float, rad/s
        Bandwidths of the further poles, such as that of the motors.
    """

    type: ClassVar[str] = "second_order_and_poles"

    omega: float
    zeta: float
    poles: tuple[float, ...]
    delay: int = 0

    def __post_init__(self) -> None:
        SecondOrder(self.omega, self.zeta, self.delay)  # the same checks
        poles = self.poles if isinstance(self.poles, list | tuple) else (self.poles,)
        if not poles or not all(0 < pole < np.inf for pole in poles):
            raise TuningError(f"reference model: poles: got {list(poles)} rad/s, expected one or more, all above 0")
        for name, value in (("omega", float(self.omega)), ("zeta", float(self.zeta)), ("delay", int(self.delay))):
            object.__setattr__(self, name, value)
        object.__setattr__(self, "poles", tuple(float(pole) for pole in poles))

    @property
    def bandwidth(self) -> float:
        """The lowest frequency of the model, rad/s."""
        return min(self.omega, *self.poles)

    def discretise(self, Ts: float) -> ReferenceModel:
        """See `second_order`."""
        return second_order(self.omega, self.zeta, self.delay, Ts, self.poles)

    def as_table(self) -> dict[str, Any]:
        """The model as plain TOML values."""
        return {"type": self.type, **asdict(self), "poles": list(self.poles)}


#: Type -> class of every reference model; a new model needs a class and a row here.
CONTINUOUS_MODELS: dict[str, Callable[..., ContinuousModel]] = {
    SecondOrder.type: SecondOrder,
    SecondOrderAndPoles.type: SecondOrderAndPoles,
}


def model_from_table(table: Any, where: str) -> ContinuousModel:
    """A model from its table, or from the list [omega, zeta, delay] of a second-order one.

    Raises
    ------
    TuningError
        When the type is unknown, or an entry is missing, unknown or not a number.
    """
    if isinstance(table, list | tuple) and len(table) in (2, 3):
        table = {"type": SecondOrder.type, **dict(zip(("omega", "zeta", "delay"), table, strict=False))}
    kind = CONTINUOUS_MODELS.get(table.get("type", "")) if isinstance(table, Mapping) else None
    numbers = [one for name, value in table.items() if name != "type" for one in _each(value)] if kind else []
    if kind is None or any(isinstance(v, bool) or not isinstance(v, int | float) for v in numbers):
        raise TuningError(
            f"{where}: got {shown(table)}, expected [omega, damping, delay], or a table with type "
            f"{' or '.join(CONTINUOUS_MODELS)} and its numbers"
        )
    if not float(table.get("delay", 0)).is_integer():
        raise TuningError(f"{where}: delay: got {table['delay']}, expected whole samples")
    try:
        return kind(**{name: value for name, value in table.items() if name != "type"})
    except TypeError:
        raise TuningError(f"{where}: got {shown(table)}, expected the numbers of a {table['type']} model") from None


def _each(value: Any) -> list[Any]:
    """The items of a list, or a single value."""
    return list(value) if isinstance(value, list | tuple) else [value]


@lru_cache(maxsize=256)
def second_order(omega: float, zeta: float, delay: int, Ts: float, poles: tuple[float, ...] = ()) -> ReferenceModel:
    """Zero-order-hold discretisation of omega^2/(s^2 + 2 zeta omega s + omega^2), times z^-delay.

    Parameters
    ----------
    omega : float, rad/s
        Natural frequency.
    zeta : float
        Damping ratio.
    delay : int, samples
        Extra dead time.
    Ts : float, s
        Sampling period.
    poles : tuple of float, rad/s
        Further factors p/(s + p), discretised together with the rest.

    Raises
    ------
    TuningError
        When omega is above Nyquist, or a number is out of the range of attitude loops.
    """
    if not (MIN_OMEGA <= omega < np.pi / Ts and 0 < zeta <= MAX_DAMPING and 0 <= delay <= MAX_DELAY):
        raise TuningError(
            f"reference model: got omega {omega} rad/s, damping {zeta}, delay {delay}; "
            f"expected {MIN_OMEGA:g} <= omega < {np.pi / Ts:.4g} rad/s, 0 < damping <= {MAX_DAMPING}, "
            f"delay 0 to {MAX_DELAY} samples"
        )
    from scipy.signal import cont2discrete

    factors: Any = np.array([1, 2 * zeta * omega, omega**2])
    for pole in poles:
        factors = np.polymul(factors, [1 / pole, 1])
    num, den, _ = cont2discrete(([omega**2], factors), Ts, method="zoh")
    return ReferenceModel(
        tuple(float(b) for b in num[0][1:]),
        tuple(float(a) for a in den),
        int(delay),
        Ts,
        label=f"{omega:g} rad/s, {zeta:g}, {delay:d}" + "".join(f", pole {pole:g} rad/s" for pole in poles),
    )
