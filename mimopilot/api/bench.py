"""Simulated flights."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from mimopilot.api.arguments import given_gains, given_vehicle
from mimopilot.common.blas import reproducible
from mimopilot.common.errors import check_choice

if TYPE_CHECKING:
    from mimopilot.api.arguments import GainSet, PathLike
    from mimopilot.sitl.flight.metrics import Performance
    from mimopilot.sitl.flight.scenario import Scenario
    from mimopilot.sitl.flight.simulator import Flight
    from mimopilot.sitl.physics.airframe import Airframe
    from mimopilot.tuning.experiment import Experiment


def load_airframe(name_or_path: PathLike) -> Airframe:
    """Load an airframe.

    Parameters
    ----------
    name_or_path : str or Path
        Name of an airframe that comes with mimopilot, or a TOML file.

    Returns
    -------
    Airframe

    Raises
    ------
    Error
        When the name is unknown, or the vehicle cannot fly.
    """
    from mimopilot.sitl.physics.airframe import load_airframe as load

    return load(str(name_or_path)).airframe


def fly(
    airframe: PathLike | Airframe,
    gains: GainSet | None = None,
    scenario: PathLike | Scenario = "doublet",
    *,
    axis: str | None = None,
    amplitude_deg: float | None = None,
    period_s: float | None = None,
    tail_s: float | None = None,
    faults: Iterable[str] = (),
    seed: int = 0,
    noise: bool = True,
    on: Literal["native", "cortex-m4"] = "native",
) -> Flight:
    """Fly the generated C++ in process.

    Parameters
    ----------
    airframe : str, Path or Airframe
        Name, TOML file, or an airframe.
    gains : str, Path or Gains, optional
        By default the airframe's own.
    scenario : str, Path or Scenario
        ``doublet``, ``step``, ``hover``, a scenario file (TOML), or a scenario.
    axis : str, optional
        ``roll`` (the default) or ``pitch``.
    amplitude_deg, period_s, tail_s : float, optional
        Of the manoeuvre; 22.5 degrees, 0.42 s and 1.5 s by default.
    faults : iterable of str
        ``KIND[:TARGET][=SIZE]@AT[+DURATION]``.
    seed : int
        Of the measurement noise.
    noise : bool
        False: exact measurements.
    on : str
        ``native``, or ``cortex-m4``: the vehicle's processor, emulated.

    Returns
    -------
    Flight
        See `performance` for its figures and `plot_flight`.

    Raises
    ------
    Error
        When the airframe, the gains, the scenario or a fault is not possible.
    """
    from mimopilot.sitl.autopilot.autopilot import Autopilot
    from mimopilot.sitl.errors import SitlError
    from mimopilot.sitl.flight.scenario import Scenario, scenario_of
    from mimopilot.sitl.flight.simulator import fly as fly_scenario

    check_choice("on", on, ("native", "cortex-m4"), SitlError)
    body, controller = given_vehicle(airframe, gains)
    task = (
        scenario
        if isinstance(scenario, Scenario)
        else scenario_of(str(scenario), axis, amplitude_deg, period_s, tail_s, list(faults), controller.Ts)
    )
    processor = None
    if on == "cortex-m4":
        from mimopilot.codegen.cortex_m4 import load_emulated

        processor = load_emulated(controller)
    return fly_scenario(body, Autopilot(body, controller, processor), task, seed, noise)


def performance(flight: Flight, gains: GainSet) -> Performance:
    """Figures of a flight over its manoeuvre, against the reference models of the gains.

    Parameters
    ----------
    flight : Flight
    gains : str, Path or Gains

    Returns
    -------
    Performance
        J_M and J_r of (6.1)-(6.4), peaks, off-axis RMS, effort; units in the names of its attributes.

    Raises
    ------
    Error
        When the gains cannot be read.
    """
    from mimopilot.sitl.flight.metrics import performance as figures

    return figures(flight, *given_gains(gains).reference_models(flight.scenario.axis))


@reproducible
def experiment(
    airframe: PathLike | Airframe,
    out: PathLike | None = None,
    *,
    gains: GainSet | None = None,
    seconds_per_axis: float = 20.0,
    amplitude: float | None = None,
    bandwidth: float = 50.0,
    seed: int = 0,
    excitation_seed: int | None = None,
    both_axes: bool = False,
    axis: str = "all",
    yaw_amplitude: float | None = None,
) -> Experiment:
    """Fly a simulated experiment with a PRBS added to the torque on roll, then on pitch, then on yaw.

    Parameters
    ----------
    airframe, gains
        As in `fly`.
    out : str or Path, optional
        Where its log is written (ULog).
    seconds_per_axis : float, s
    amplitude : float, optional
        Of the injected torque (normalised); by default 0.15, or less if the motors would saturate.
    bandwidth : float, rad/s
        Of the injected torque.
    seed : int
        Of the measurement noise, and of the excitation where `excitation_seed` is not given.
    excitation_seed : int, optional
        Of the excitation.
    both_axes : bool
        Excite roll and pitch at once, for `seconds_per_axis`.
    axis : str
        ``all``, ``both`` (roll, then pitch), ``roll``, ``pitch`` or ``yaw``.
    yaw_amplitude : float, optional
        On yaw; by default 0.3, or less if the motors would saturate.

    Returns
    -------
    Experiment
        As read from the log.

    Raises
    ------
    Error
        When the airframe or the excitation is not possible, or the vehicle is lost.
    """
    from mimopilot.sitl.flight.excitation_flight import ExperimentPlan, check_survived, default_amplitude
    from mimopilot.tuning.logs.reader import read_log as read

    body, controller = given_vehicle(airframe, gains)
    strength = default_amplitude(body) if amplitude is None else amplitude
    plan = ExperimentPlan(
        body, controller, seconds_per_axis, strength, bandwidth, excitation_seed, both_axes, axis, yaw_amplitude
    )
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "flight.ulg" if out is None else Path(out)
        check_survived(plan.record(path, seed))
        return read(path)
