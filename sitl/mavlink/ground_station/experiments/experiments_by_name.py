"""The experiments by the profile's name, which is that of an upload."""

from __future__ import annotations

from mimopilot.common.errors import check_choice
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.experiments.experiment_profile import (
    ExcitationOptions,
    ExperimentProfile,
    SaveValues,
)
from mimopilot.sitl.mavlink.ground_station.experiments.module_profile import ModuleInjection
from mimopilot.sitl.mavlink.ground_station.experiments.px4_autotune import Px4Autotune
from mimopilot.sitl.mavlink.ground_station.experiments.system_identification import SystemIdentification
from mimopilot.sitl.mavlink.ground_station.profiles import ARDUPILOT_CUSTOM

EXPERIMENTS: dict[str, type[ExperimentProfile]] = {
    profile.name: profile for profile in (ModuleInjection, Px4Autotune, SystemIdentification)
}

#: Profile of an upload that has no experiment -> how to fly one.
BY_HAND = {
    ARDUPILOT_CUSTOM: (
        "our custom controller's experiment is started by hand: hover with it in the flight mode of CC3_EX_MODE, set "
        "CC3_EX_AX to 5 (ardupilot/README.md of `mimopilot generate --target ardupilot`), land, and go on with "
        "`mimopilot logs`, `tune` and `upload`"
    )
}


def check_experiment(name: str) -> None:
    """Refuse a profile that has no experiment.

    Raises
    ------
    SitlError
        With what to do instead.
    """
    if name in BY_HAND:
        raise SitlError(f"--profile {name}: {BY_HAND[name]}")
    check_choice("--profile", name, EXPERIMENTS, SitlError)


def experiment_profile(name: str, options: ExcitationOptions, save: SaveValues) -> ExperimentProfile:
    """The experiment of a profile, for one flight.

    Raises
    ------
    SitlError
        If the profile is unknown, or an option does not fit it.
    """
    check_experiment(name)
    return EXPERIMENTS[name](options, save)
