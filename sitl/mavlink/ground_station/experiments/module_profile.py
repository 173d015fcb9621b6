"""The experiment on a vehicle that our controller flies: its own injector adds a PRBS to the torque."""

from __future__ import annotations

import math
from typing import ClassVar

from mimopilot.common.errors import check_choice
from mimopilot.sitl.autopilot.excitation_injector import AXIS
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.flight.excitation_flight import AMPLITUDE, VEHICLE_YAW_AMPLITUDE
from mimopilot.sitl.mavlink.ground_station.experiments.experiment_profile import (
    ExcitationOptions,
    ExperimentProfile,
    ExperimentResult,
    Preparation,
    Restoration,
    SaveValues,
    VehicleSession,
)
from mimopilot.sitl.mavlink.ground_station.experiments.module_injector import (
    INTEGERS,
    NAMES,
    check_settings,
    excite,
    start_monitor,
)
from mimopilot.sitl.mavlink.ground_station.experiments.vehicle_setup import (
    on_the_ground,
    read_known,
    reboot,
    set_values,
    values_of,
    write_back,
)
from mimopilot.sitl.mavlink.ground_station.flight_monitor import FlightMonitor
from mimopilot.sitl.mavlink.ground_station.upload import read_values
from mimopilot.sitl.mavlink.wire.float32 import shortest, single
from mimopilot.sitl.mavlink.wire.px4_modes import EXCITED_MODES
from mimopilot.tuning.excitation import hold_from_bandwidth
from mimopilot.tuning.parameters import EXCITATION
from mimopilot.tuning.px4_names import LOG_PROFILE, TUNING_PROFILE

PX4 = 12  # MAV_AUTOPILOT_PX4
#: --axis -> value of `AXIS`.
AXES = {"roll": 1, "pitch": 2, "both": 3, "yaw": 4, "all": 5}


def injector_settings(excitation: ExcitationOptions, Ts: float) -> dict[str, float]:
    """The injector's parameters, name -> value in single precision, for a control period (s).

    Raises
    ------
    SitlError
        Naming the first option or parameter that is wrong.
    TuningError
        If the bandwidth is wrong.
    """
    hold_min, hold_max = hold_from_bandwidth(excitation.bandwidth, Ts)
    values = _settings(excitation) | {"MIMO_EX_HMIN": hold_min, "MIMO_EX_HMAX": hold_max}
    check_settings(values)
    return {name: single(values[name]) for name in NAMES}


def _settings(excitation: ExcitationOptions) -> dict[str, float]:
    """The parameters that do not depend on the control period, which only the vehicle knows."""
    axis = excitation.axis or "all"
    check_choice("--axis", axis, AXES, SitlError)
    check_choice("--mode", excitation.mode, EXCITED_MODES, SitlError)
    return {
        AXIS: AXES[axis],
        "MIMO_EX_AMP": AMPLITUDE if excitation.amplitude is None else excitation.amplitude,
        "MIMO_EX_AMPY": VEHICLE_YAW_AMPLITUDE if excitation.yaw_amplitude is None else excitation.yaw_amplitude,
        "MIMO_EX_DUR": excitation.seconds_per_axis,
        "MIMO_EX_SEED": excitation.seed,
        "MIMO_EX_MODE": EXCITED_MODES[excitation.mode][0],
        "MIMO_EX_TILT": math.radians(excitation.tilt_deg),
    }


def check_log(session: VehicleSession) -> None:
    """Refuse a PX4 whose log would be too slow for tuning.

    Raises
    ------
    SitlError
        With the parameter and its value.
    """
    client = session.client
    assert client.vehicle is not None
    if client.vehicle.autopilot != PX4:
        return
    profile = round(session.run(read_values(client, [LOG_PROFILE]))[LOG_PROFILE])
    if profile & TUNING_PROFILE != TUNING_PROFILE:
        raise SitlError(
            f"{LOG_PROFILE} is {profile}: the log rate would be too low for tuning; land, set it to {TUNING_PROFILE}, "
            "and take off again",
            exit_code=1,
        )


class ModuleInjection(ExperimentProfile):
    """The experiment with our injector. Its settings go back at the end of `excite`."""

    name: ClassVar[str] = "mimo"
    integers: ClassVar[frozenset[str]] = INTEGERS | {LOG_PROFILE}

    def __init__(self, options: ExcitationOptions, save: SaveValues) -> None:
        super().__init__(options, save)
        check_settings(_settings(options))  # before a vehicle is in the air
        self.wanted: dict[str, float] = {}

    def prepare(self, session: VehicleSession) -> Preparation:
        """On PX4 set the log profile, which acts from the next boot on; nothing on other autopilots."""
        monitor = on_the_ground(session, self.name)
        if not self._on_px4(session):
            return Preparation()
        old = values_of(session.run(read_known(session.client, [LOG_PROFILE])))
        new = {LOG_PROFILE: float(round(old[LOG_PROFILE]) | TUNING_PROFILE)}
        if new == old:
            return Preparation()
        self.remember(old)
        session.run(set_values(session.client, new, old, store=True))
        reboot(session, monitor)
        return Preparation(new, True)

    def check(self, session: VehicleSession) -> FlightMonitor:
        """Check that the vehicle hovers under our controller, and logs fast enough."""
        session.run(session.client.await_heartbeat())
        Ts = session.run(read_values(session.client, ["MIMO_TS"]))["MIMO_TS"]
        self.wanted = injector_settings(self.options, Ts)
        monitor = session.run(start_monitor(session.client, round(self.wanted["MIMO_EX_MODE"])))
        check_log(session)
        return monitor

    @property
    def settings(self) -> dict[str, float]:
        """The injector's parameters."""
        return self.wanted

    def describe(self) -> list[list[str]]:
        """The injector's parameters."""
        return [[s.name, shortest(self.wanted[s.name]), s.unit, s.description] for s in EXCITATION]

    def excite(self, session: VehicleSession, monitor: FlightMonitor) -> ExperimentResult:
        """Run the injector once."""
        return session.run(excite(session.client, monitor, self.wanted))

    def restore(self, session: VehicleSession) -> Restoration:
        """Write the log profile back."""
        return Restoration(session.run(write_back(session.client, self.old)) if self.old else {})

    @staticmethod
    def _on_px4(session: VehicleSession) -> bool:
        assert session.client.vehicle is not None
        return session.client.vehicle.autopilot == PX4
