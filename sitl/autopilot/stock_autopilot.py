"""An autopilot with a stock PX4's controllers, parameters and autotune, in place of the generated controller."""

from __future__ import annotations

from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.autopilot.autotune_module import AutotuneModule
from mimopilot.sitl.autopilot.px4_law import Px4Controller
from mimopilot.sitl.autopilot.px4_parameters import px4_parameters
from mimopilot.sitl.physics.airframe import Airframe
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.px4_names import AUTOTUNE_ENABLE, AUTOTUNE_START, LOG_PROFILE


class StockAutopilot(Autopilot):
    """A stock PX4 with the diagonal of some gains.

    Parameters
    ----------
    airframe, gains, altitude
        As of `Autopilot`.

    Attributes
    ----------
    table : tuple of Px4Parameter
    values : dict
        Parameter -> value now.
    module : AutotuneModule or None
        Started at the last boot; None: MC_AT_EN was 0.

    Raises
    ------
    SitlError
        As `Autopilot`.
    """

    def __init__(self, airframe: Airframe, gains: Gains, altitude: float = 10.0) -> None:
        self.table = px4_parameters(gains, airframe.gyro_cutoff_hz)
        self.values = {parameter.name: float(parameter.value) for parameter in self.table}
        self.law = Px4Controller(self.values, gains.Ts)
        super().__init__(airframe, gains, self.law, altitude)
        self.module: AutotuneModule | None = None
        self.boot()

    def boot(self) -> None:
        """Take over what PX4 reads at boot: the autotune module and the log profile."""
        self.values[AUTOTUNE_START] = 0.0
        self.module = AutotuneModule(self.values) if self.values[AUTOTUNE_ENABLE] > 0 else None
        self._log_profile = self.values[LOG_PROFILE]

    def set_parameter(self, name: str, value: float) -> None:
        """Change a parameter; the controllers take it over at once."""
        self.values[name] = value
        self.law.configure(self.values)

    @property
    def parameters(self) -> dict[str, float]:
        """Name -> value of the parameters in flight, whole numbers as int; the log profile is that of the last boot."""
        values = self.values | {LOG_PROFILE: self._log_profile}
        return {p.name: int(values[p.name]) if p.integer else values[p.name] for p in self.table}

    def parameter_problem(self) -> str:
        """PX4 accepts any parameter."""
        return ""
