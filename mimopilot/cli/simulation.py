"""Commands of the simulation in process: experiments and flights."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import typer

from mimopilot.cli.options import (
    AirframeArgument,
    AmplitudeOption,
    AxisOption,
    FaultOption,
    GainsOption,
    JsonOption,
    KeyOption,
    LogOutOption,
    PeriodOption,
    ReportOption,
    ScenarioOption,
    SeedOption,
    SystemOption,
    TailOption,
    TimeoutOption,
    YesOption,
)
from mimopilot.common.console import print_json, print_table, print_text, progress_console
from mimopilot.common.errors import check_not_given

if TYPE_CHECKING:
    from mimopilot.sitl.flight.excitation_flight import ExperimentPlan
    from mimopilot.sitl.flight.simulator import Flight
    from mimopilot.sitl.mavlink.ground_station.experiments.experiment_profile import ExcitationOptions
    from mimopilot.sitl.mavlink.ground_station.session import LinkOptions
    from mimopilot.sitl.physics.airframe import Airframe
    from mimopilot.tuning.gains import Gains

#: Tilt beyond which the experiment on a vehicle stops, degrees: that of the injector's own parameter, MIMO_EX_TILT.
TILT_DEG = 28.0
#: Of the excitation, chosen: length on each axis (s), bandwidth (rad/s).
SECONDS, BANDWIDTH = 20.0, 50.0
#: Profiles whose vehicle has an exciter of its own.
STOCK = ("px4-stock", "ardupilot-stock")
#: Vehicles that are named when several were lost.
NAMED = 5


def register(app: typer.Typer) -> None:
    """Add these commands to the command line."""
    app.command(epilog="Example: mimopilot experiment adam0 --seed 1 --out flight.ulg")(experiment)
    app.command(epilog="Example: mimopilot fly adam0 --gains my.gains.toml --axis roll --json")(fly)
    app.command(epilog="Example: mimopilot convert px4.gains.toml px4_sih --out sih.gains.toml")(convert)


def convert(
    gains: Annotated[Path, typer.Argument(help="Gains file of this vehicle, made with another allocator.")],
    airframe: Annotated[str, typer.Argument(help="Airframe with the target allocator.")],
    out: Annotated[Path, typer.Option(dir_okay=False, help="Where the converted gains are written: FILE.gains.toml.")],
) -> None:
    """Convert gains to the unit of torque of an airframe's allocator: the torque in N m stays the same."""
    import mimopilot as mp

    loaded, scale = mp.load_gains(gains), mp.load_airframe(airframe).moment_scale()
    loaded.with_moment_scale(scale).save(out)
    before, after = (", ".join(f"{value:.4g}" for value in triple) for triple in (loaded.moment_scale or (), scale))
    print_text(f"{out}: one unit of torque stood for {before} N m, now for {after} N m (roll, pitch, yaw)")


def experiment(
    airframe: Annotated[str | None, typer.Argument(help="Airframe to simulate; or give --connect.")] = None,
    out: Annotated[
        Path | None, typer.Option(help="Log to write (ULog, .ulg), of a simulated flight; a folder for --runs.")
    ] = None,
    connect: Annotated[
        str | None, typer.Option(help="Link to a vehicle that hovers under our controller; see upload.")
    ] = None,
    profile: Annotated[
        str | None,
        typer.Option(
            help="With --connect: mimo (our module's injector, the default), px4-stock (PX4's autotune) or "
            "ardupilot-stock (its mode SystemID)."
        ),
    ] = None,
    gains: GainsOption = None,
    axis: Annotated[
        str | None,
        typer.Option(
            help="One after the other: all (roll, pitch, yaw), both (roll, pitch), roll, pitch, or yaw.",
            show_default="all",
        ),
    ] = None,
    seconds_per_axis: Annotated[
        float | None, typer.Option(help="Length of the excitation on each axis, s.", show_default="20")
    ] = None,
    amplitude: Annotated[
        float | None,
        typer.Option(
            help="Of the torque on roll and pitch (normalised); 0.15, or less if the motors would saturate. With "
            "--profile px4-stock: of the rate setpoint, rad/s (1.5)."
        ),
    ] = None,
    yaw_amplitude: Annotated[
        float | None,
        typer.Option(help="Of the torque on yaw; 0.3 (a vehicle: 0.2), or less if the motors would saturate."),
    ] = None,
    bandwidth: Annotated[float | None, typer.Option(help="Of the injected torque, rad/s.", show_default="50")] = None,
    seed: SeedOption = 0,
    runs: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Number of flights, with consecutive seeds: flight-SEED.ulg, for tune --campaign. With --profile "
            "px4-stock: runs of the autotune in the flight (4).",
        ),
    ] = None,
    excitation_seed: Annotated[
        int | None, typer.Option(min=0, help="Inject the same torque in every run; by default each has its own.")
    ] = None,
    both_axes: Annotated[
        bool, typer.Option("--both-axes", help="Simulated: excite roll and pitch at once, each with its own torque.")
    ] = False,
    mode: Annotated[
        str | None,
        typer.Option(
            help="With --connect: flight mode to excite in: hold (the default), position, altitude, offboard."
        ),
    ] = None,
    tilt_deg: Annotated[
        float | None, typer.Option(help="With --connect: stop beyond this roll or pitch, degrees (28).")
    ] = None,
    snapshot: Annotated[
        Path | None, typer.Option(help="With --connect: where the old parameters go; by default a new file.")
    ] = None,
    yes: YesOption = False,
    timeout: TimeoutOption = 12.0,
    signing_key: KeyOption = None,
    system: SystemOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Fly with a PRBS added to the torque on roll, then pitch, then yaw (--both-axes: roll and pitch at once); log it.

    Simulated in process; or with --connect on a vehicle in the air, by its own injector. The flight is then monitored:
    tilt, flight mode, a lost link and Ctrl-C end the excitation, and the vehicle's parameters are restored. With a
    stock --profile, begin with the disarmed vehicle on the ground: it is prepared, and excited once it hovers.
    """
    from mimopilot.sitl.errors import SitlError

    if (airframe is None) == (connect is None):
        raise SitlError("give either an airframe to simulate, or --connect to a vehicle")
    if connect is not None:
        from mimopilot.sitl.mavlink.ground_station.experiments.experiment_profile import ExcitationOptions
        from mimopilot.sitl.mavlink.ground_station.session import LinkOptions

        check_not_given(
            "for a simulated flight only; a vehicle has its gains and writes its own log",
            out=out,
            gains=gains,
            runs=runs if profile != "px4-stock" else None,
            excitation_seed=excitation_seed,
            both_axes=both_axes or None,
        )
        own: dict[str, object] = {"seed": seed or None, "yaw_amplitude": yaw_amplitude}
        if profile == "px4-stock":
            own |= {"seconds_per_axis": seconds_per_axis, "bandwidth": bandwidth}
        elif profile == "ardupilot-stock":
            own |= {"mode": mode}
        check_not_given(f"not with --profile {profile}, whose excitation has none", **own if profile in STOCK else {})
        excite_vehicle(
            LinkOptions(
                connect, system, timeout, signing_key, force_armed=True, yes=yes, as_json=as_json, snapshot=snapshot
            ),
            profile or "mimo",
            ExcitationOptions(
                axis=axis,
                seconds_per_axis=SECONDS if seconds_per_axis is None else seconds_per_axis,
                amplitude=amplitude,
                bandwidth=BANDWIDTH if bandwidth is None else bandwidth,
                seed=seed,
                mode=mode or "hold",
                tilt_deg=TILT_DEG if tilt_deg is None else tilt_deg,
                runs=runs,
                yaw_amplitude=yaw_amplitude,
            ),
        )
        return
    from mimopilot.api.arguments import given_vehicle
    from mimopilot.sitl.flight.excitation_flight import ExperimentPlan, default_amplitude

    check_not_given("belong to --connect", mode=mode, tilt_deg=tilt_deg, profile=profile, snapshot=snapshot)
    if out is None:
        raise SitlError("--out: name the log to write, FILE.ulg")
    if out.is_dir() and runs is None:
        raise SitlError(f"--out: {out} is a folder; give the log to write, FILE.ulg, or --runs")
    body, controller = given_vehicle(airframe or "", gains)
    strength = default_amplitude(body) if amplitude is None else amplitude
    plan = ExperimentPlan(
        body,
        controller,
        SECONDS if seconds_per_axis is None else seconds_per_axis,
        strength,
        BANDWIDTH if bandwidth is None else bandwidth,
        excitation_seed,
        both_axes,
        axis or "all",
        yaw_amplitude,
    )
    if runs is None:
        simulate_experiment(plan, out, seed)
    else:
        simulate_experiments(plan, out, range(seed, seed + runs))


def excite_vehicle(link: LinkOptions, profile: str, excitation: ExcitationOptions) -> None:
    """`experiment --connect`: the exciter of a vehicle in the air."""
    from mimopilot.sitl.mavlink.ground_station.experiments.experiment_console import experiment as excite

    excite(link, profile, excitation)


def simulate_experiment(plan: ExperimentPlan, out: Path, seed: int) -> None:
    """`experiment AIRFRAME`: one simulated flight and its log."""
    import numpy as np

    from mimopilot.sitl.flight.excitation_flight import check_survived

    flight = plan.record(out, seed)
    angles = np.degrees(np.abs(flight.truth["attitude"]).max(axis=0))
    seconds = len(flight.record) * plan.gains.Ts
    print_text(
        f"{out}: {seconds:.1f} s, largest roll {angles[0]:.1f} deg, pitch {angles[1]:.1f} deg, yaw {angles[2]:.1f} deg"
    )
    check_survived(flight)


def simulate_experiments(plan: ExperimentPlan, out: Path, seeds: range) -> None:
    """`experiment AIRFRAME --runs`: a simulated flight and a log for each seed."""
    from rich.progress import Progress

    from mimopilot.common.parallel import cores
    from mimopilot.sitl.errors import SitlError
    from mimopilot.sitl.flight.excitation_flight import repeat_experiment

    with Progress(console=progress_console(), transient=True) as bar:
        task = bar.add_task("flying", total=len(seeds))
        lost = repeat_experiment(plan, out, seeds, cores(), lambda: bar.advance(task))
    print_text(f"{out}: {len(seeds)} logs of {plan.seconds:.1f} s")
    if lost:
        names = ", ".join(f"{seed} at {when:.2f} s" for seed, when in list(lost.items())[:NAMED])
        raise SitlError(
            f"{len(lost)} of {len(seeds)} vehicles were lost (seed {names}); lower --amplitude", exit_code=1
        )


def fly(
    airframe: AirframeArgument,
    gains: GainsOption = None,
    scenario: ScenarioOption = "doublet",
    axis: AxisOption = None,
    amplitude_deg: AmplitudeOption = None,
    period_s: PeriodOption = None,
    tail_s: TailOption = None,
    fault: FaultOption = None,
    seed: SeedOption = 0,
    out: LogOutOption = None,
    on: Annotated[str, typer.Option(help="native, or cortex-m4: the emulated processor of the vehicle.")] = "native",
    report: ReportOption = None,
    as_json: JsonOption = False,
) -> None:
    """Fly the generated C++ in process and print how well it followed; with faults also their effect."""
    from dataclasses import asdict, replace

    import mimopilot as mp
    from mimopilot.api.arguments import given_vehicle
    from mimopilot.sitl.errors import SitlError
    from mimopilot.sitl.flight.fault_recovery import recovery
    from mimopilot.sitl.flight.flight_log import save_flight
    from mimopilot.sitl.flight.metrics import FIGURE_LABELS
    from mimopilot.sitl.flight.scenario import AXES, scenario_of

    body, controller = given_vehicle(airframe, gains)
    task = scenario_of(scenario, axis, amplitude_deg, period_s, tail_s, fault or (), controller.Ts)
    flight = mp.fly(body, controller, task, seed=seed, on=cast("Literal['native', 'cortex-m4']", on))
    figures: dict[str, Any] = {**asdict(mp.performance(flight, controller)), "crashed_at_s": flight.crashed_at}
    if task.faults:
        healthy = mp.fly(body, controller, replace(task, faults=()), seed=seed)
        figures |= {"faults": list(map(str, task.faults)), **asdict(recovery(flight, healthy))}
    if out is not None:
        save_flight(out, flight, body, controller)
    if report is not None:
        report_flight(report, flight, body, controller)
    if as_json:
        print_json({"airframe": body.name, "scenario": task.name, "axis": AXES[task.axis], "seed": seed, **figures})
    else:
        inner, outer = controller.reference_models(task.axis)
        rows = [[label, _text(figures[name])] for name, label in FIGURE_LABELS.items() if name in figures]
        title = (
            f"{body.name}, {task.name} on {AXES[task.axis]}, against {inner.label} (inner) and {outer.label} (outer)"
        )
        print_table(", ".join([title, *map(str, task.faults)]), ["figure", "value"], rows)
    if flight.crashed_at is not None:
        raise SitlError(f"the vehicle was lost at {flight.crashed_at:.2f} s", exit_code=1)
    if flight.record["fault"].any():
        raise SitlError("the controller's inputs were invalid for too long: it only damped the rates", exit_code=1)


def report_flight(out: Path, flight: Flight, airframe: Airframe, gains: Gains) -> None:
    """`fly --report`: the page about the log of a simulated flight."""
    import tempfile

    from mimopilot.cli.report import write_report_of
    from mimopilot.sitl.flight.flight_log import save_flight
    from mimopilot.tuning.spec import TuningSpec

    with tempfile.TemporaryDirectory() as scratch:
        log = Path(scratch) / f"{airframe.name}-{flight.scenario.name}.ulg"
        save_flight(log, flight, airframe, gains)
        write_report_of([log], (), out, None, TuningSpec())


def _text(value: float | str | None) -> str:
    """A figure in a table, with the digits that hold for another seed of the noise and other versions of numpy."""
    if value in (None, ""):
        return "-"
    return f"{value:#.3g}".rstrip(".") if isinstance(value, float) else str(value)
