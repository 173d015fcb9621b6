"""The experiments by the profile's name, which is that of an upload."""

from __future__ import annotations

from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.experiments.experiment_profile import (
    ExcitationOptions,
    ExperimentProfile,
    SaveValues,
)
from mimopilot.sitl.mavlink.ground_station.experiments.module_profile import ModuleInjection
from mimopilot.sitl.mavlink.ground_station.experiments.px4_autotune import Px4Autotune
from mimopilot.sitl.mavlink.ground_station.experiments.system_identification import SystemIdentification

EXPERIMENTS: dict[str, type[ExperimentProfile]] = {
    profile.name: profile for profile in (ModuleInjection, Px4Autotune, SystemIdentification)
}


def experiment_profile(name: str, options: ExcitationOptions, save: SaveValues) -> ExperimentProfile:
    """The experiment of a profile, for one flight.

    Raises
    ------
    SitlError
        If the profile is unknown, or an option does not fit it.
    """
    if name not in EXPERIMENTS:
        raise SitlError(f"--profile: got {name!r}, expected one of {', '.join(EXPERIMENTS)}")
    return EXPERIMENTS[name](options, save)
