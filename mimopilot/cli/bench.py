"""The commands of this room."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

AirframeArgument = Annotated[
    str,
    typer.Argument(
        help="Airframe: adam0, adam0_boom, adam0_flexible, adam0_nominal, adam0_perturbed, antr, px4_sih; or a TOML "
        "file."
    ),
]
GainsOption = Annotated[Path | None, typer.Option(help="Gains file; by default the airframe's own.")]
FaultOption = Annotated[
    list[str] | None,
    typer.Option("--fault", help="KIND[:TARGET][=SIZE]@AT[+DURATION], seconds; see mimopilot faults --kinds."),
]
AxisOption = Annotated[str | None, typer.Option(help="roll or pitch.", show_default="roll")]
AmplitudeOption = Annotated[float | None, typer.Option(help="Of the doublet or step, degrees.", show_default="22.5")]
PeriodOption = Annotated[
    float | None, typer.Option(help="Length of the whole doublet, of the step or of the hover, s.", show_default="0.42")
]
TailOption = Annotated[float | None, typer.Option(help="Level flight after a doublet, s.", show_default="1.5")]
SeedOption = Annotated[int, typer.Option(min=0, help="Seed of all randomness.")]
SpeedOption = Annotated[str, typer.Option(help="Times real time, or max: as fast as it goes.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]


def register(app: typer.Typer) -> None:
    """Add this room's commands to the front door."""
    app.command(epilog="Example: mimopilot experiment adam0 --seed 1 --out flight.ulg")(experiment)
    app.command(epilog="Example: mimopilot fly adam0 --gains my.gains.toml --axis roll --json")(fly)
    app.command(
        epilog="Example: mimopilot sitl adam0 --gains my.gains.toml, then mavproxy.py --master=udp:127.0.0.1:14550"
    )(sitl)
    app.command(epilog="Example: mimopilot plant adam0 --port 4560")(plant)
    app.command(epilog="Example: mimopilot convert px4.gains.toml px4_sih --out bench.gains.toml")(convert)


def convert(
    gains: Annotated[Path, typer.Argument(help="Gains file of this vehicle, made with another allocator.")],
    airframe: Annotated[str, typer.Argument(help="Airframe whose allocator they are wanted for.")],
    out: Annotated[Path, typer.Option(help="Where the converted gains are written: FILE.gains.toml.")],
) -> None:
    """Bring gains into the unit of moment of an airframe's allocator: the moment in N m stays the same."""
    from mimopilot.sitl.physics.airframe import load_airframe
    from mimopilot.tuning.gains_file import load_gains

    loaded, scale = load_gains(gains), load_airframe(airframe).airframe.moment_scale()
    loaded.with_moment_scale(scale).save(out)
    before, after = (", ".join(f"{value:.4g}" for value in triple) for triple in (loaded.moment_scale or (), scale))
    print(f"{out}: one unit of moment stood for {before} N m, now for {after} N m (roll, pitch, yaw)")


def _load(airframe: str, gains: Path | None) -> tuple[Any, Any]:
    from mimopilot.sitl.physics.airframe import load_airframe
    from mimopilot.tuning.gains_file import load_gains

    vehicle = load_airframe(airframe)
    return vehicle.airframe, load_gains(gains) if gains else vehicle.default_gains()


def _text(value: Any) -> str:
    """A figure in a table."""
    return "-" if value in (None, "") else value if isinstance(value, str) else f"{value:.5g}"


def experiment(
    airframe: Annotated[str | None, typer.Argument(help="Airframe to simulate; or give --connect.")] = None,
    out: Annotated[
        Path | None, typer.Option(help="Log to write (ULog, .ulg), of a simulated flight; a folder for --runs.")
    ] = None,
    connect: Annotated[
        str | None, typer.Option(help="Link to a vehicle that hovers under our controller; see upload.")
    ] = None,
    gains: GainsOption = None,
    axis: Annotated[
        str | None, typer.Option(help="With --connect: roll, pitch, or both, one after the other (the default).")
    ] = None,
    seconds_per_axis: Annotated[float, typer.Option(help="Length of the excitation on each axis, s.")] = 20.0,
    amplitude: Annotated[
        float | None,
        typer.Option(help="Of the injected torque (normalised); 0.15, or less where the motors have little room."),
    ] = None,
    bandwidth: Annotated[float, typer.Option(help="Of the injected moment, rad/s.")] = 50.0,
    seed: SeedOption = 0,
    runs: Annotated[
        int | None,
        typer.Option(min=1, help="Fly it so many times, seed by seed: flight-SEED.ulg, for tune --campaign."),
    ] = None,
    excitation_seed: Annotated[
        int | None, typer.Option(min=0, help="Inject the same moment in every run; by default each has its own.")
    ] = None,
    mode: Annotated[
        str | None,
        typer.Option(
            help="With --connect: flight mode to excite in: hold (the default), position, altitude, offboard."
        ),
    ] = None,
    tilt_deg: Annotated[
        float | None, typer.Option(help="With --connect: stop beyond this roll or pitch, degrees (28).")
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
    timeout: Annotated[float, typer.Option(min=0.5, max=600, help="Silence of the vehicle that ends all, s.")] = 12.0,
    signing_key: Annotated[Path | None, typer.Option(help="Key of the link; see upload.")] = None,
    system: Annotated[int, typer.Option(min=0, max=255, help="The vehicle's system number; see upload.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """Fly with a pseudo-random moment injected on roll, then on pitch, and log it.

    Simulated in process; or with --connect on a vehicle in the air, whose own injector does it. That one is watched on
    the way: tilt, flight mode, link and Ctrl-C end it, and its parameters are put back.
    """
    from mimopilot.sitl.errors import SitlError

    if (airframe is None) == (connect is None):
        raise SitlError("give either an airframe to simulate, or --connect to a vehicle")
    if airframe is not None:
        if out is None:
            raise SitlError("--out: name the log to write, FILE.ulg")
        if (axis, mode, tilt_deg) != (None,) * 3:
            raise SitlError("--axis, --mode, --tilt-deg: belong to --connect; a simulated flight excites both axes")
        excitation = (seconds_per_axis, amplitude, bandwidth, excitation_seed)
        _simulated_experiment(airframe, out, gains, excitation, seed, runs)
        return
    if (out, gains, runs, excitation_seed) != (None,) * 4:
        raise SitlError(
            "--out, --gains, --runs, --excitation-seed: are of a simulated flight; a vehicle has its gains and writes "
            "its own log"
        )
    from mimopilot.sitl.flight.excitation_flight import AMPLITUDE
    from mimopilot.sitl.mavlink.ground_station.experiment_console import ExcitationOptions
    from mimopilot.sitl.mavlink.ground_station.experiment_console import experiment as fly_experiment
    from mimopilot.sitl.mavlink.ground_station.session import LinkOptions

    options = LinkOptions(connect or "", system, timeout, signing_key, force_armed=True, yes=yes, as_json=as_json)
    tilt = 28.0 if tilt_deg is None else tilt_deg
    strength = AMPLITUDE if amplitude is None else amplitude
    choice = ExcitationOptions(axis or "both", seconds_per_axis, strength, bandwidth, seed, mode or "hold", tilt)
    fly_experiment(options, choice)


def _simulated_experiment(
    airframe: str,
    out: Path,
    gains: Path | None,
    excitation: tuple[float, float | None, float, int | None],
    seed: int,
    runs: int | None,
) -> None:
    import numpy as np

    from mimopilot.sitl.errors import SitlError
    from mimopilot.sitl.flight.excitation_flight import ExperimentPlan, default_amplitude, repeat_experiment

    body, controller = _load(airframe, gains)
    seconds, amplitude, bandwidth, excitation_seed = excitation
    strength = default_amplitude(body) if amplitude is None else amplitude
    plan = ExperimentPlan(body, controller, seconds, strength, bandwidth, excitation_seed)
    if runs is not None:
        from rich.progress import Progress

        from mimopilot.common.console import progress_console
        from mimopilot.common.parallel import cores

        with Progress(console=progress_console(), transient=True) as bar:
            task = bar.add_task("flying", total=runs)
            lost = repeat_experiment(plan, out, range(seed, seed + runs), cores(), lambda: bar.advance(task))
        print(f"{out}: {runs} logs of {2 * excitation[0]:.1f} s")
        if lost:
            names = ", ".join(f"{one} at {when:.2f} s" for one, when in list(lost.items())[:5])
            raise SitlError(f"{len(lost)} of {runs} vehicles were lost (seed {names}); lower --amplitude", exit_code=1)
        return
    flight = plan.record(out, seed)
    tilt = np.degrees(np.abs(flight.truth["attitude"][:, :2]).max(axis=0))
    print(f"{out}: {len(flight.record) * controller.Ts:.1f} s, largest roll {tilt[0]:.1f} deg, pitch {tilt[1]:.1f} deg")
    if flight.crashed_at is not None:
        raise SitlError(f"the vehicle was lost at {flight.crashed_at:.2f} s; lower --amplitude", exit_code=1)


def scenario_of(
    name: str,
    axis: str | None,
    amplitude_deg: float | None,
    period_s: float | None,
    tail_s: float | None,
    faults: list[str] | None,
    Ts: float,
) -> Any:
    """The scenario that the options of a command ask for, with its faults."""
    from dataclasses import replace

    from mimopilot.sitl.errors import SitlError
    from mimopilot.sitl.faults.kinds import parse_fault
    from mimopilot.sitl.flight.scenario import AMPLITUDE_DEG, PERIOD_S, TAIL_S, load_scenario, make_scenario

    if name.endswith(".toml"):
        if (axis, amplitude_deg, period_s, tail_s) != (None,) * 4:
            raise SitlError(f"--axis, --amplitude-deg, --period-s, --tail-s: {name} says them; change them there")
        task = load_scenario(Path(name), Ts)
    else:
        values = zip((amplitude_deg, period_s, tail_s), (AMPLITUDE_DEG, PERIOD_S, TAIL_S), strict=True)
        amplitude, period, tail = (default if value is None else value for value, default in values)
        task = make_scenario(name, axis or "roll", amplitude, period, Ts, tail)
    return replace(task, faults=(*task.faults, *map(parse_fault, faults or ())))


def fly(
    airframe: AirframeArgument,
    gains: GainsOption = None,
    scenario: Annotated[str, typer.Option(help="doublet, step, hover, or a scenario file (TOML).")] = "doublet",
    axis: AxisOption = None,
    amplitude_deg: AmplitudeOption = None,
    period_s: PeriodOption = None,
    tail_s: TailOption = None,
    fault: FaultOption = None,
    seed: SeedOption = 0,
    out: Annotated[Path | None, typer.Option(help="Also write the flight as a log (ULog, .ulg).")] = None,
    on: Annotated[str, typer.Option(help="native, or cortex-m4: the emulated processor of the vehicle.")] = "native",
    as_json: JsonOption = False,
) -> None:
    """Fly the generated C++ in process and print how well it followed; with faults also what they did."""
    from dataclasses import asdict, replace

    from mimopilot.codegen.cortex_m4 import load_emulated
    from mimopilot.common.console import print_json, print_table
    from mimopilot.sitl.autopilot.autopilot import Autopilot
    from mimopilot.sitl.errors import SitlError
    from mimopilot.sitl.flight.fault_recovery import recovery
    from mimopilot.sitl.flight.flight_log import save_flight
    from mimopilot.sitl.flight.metrics import FIGURE_LABELS, performance
    from mimopilot.sitl.flight.scenario import AXES
    from mimopilot.sitl.flight.simulator import fly as fly_scenario

    body, controller = _load(airframe, gains)
    task = scenario_of(scenario, axis, amplitude_deg, period_s, tail_s, fault, controller.Ts)
    if on not in ("native", "cortex-m4"):
        raise SitlError(f"--on: got {on!r}, expected native or cortex-m4")
    processor = load_emulated(controller) if on == "cortex-m4" else None
    flight = fly_scenario(body, Autopilot(body, controller, processor), task, seed)
    inner, outer = controller.reference_models(task.axis)
    figures: dict[str, Any] = {**asdict(performance(flight, inner, outer)), "crashed_at_s": flight.crashed_at}
    if task.faults:
        sound = fly_scenario(body, Autopilot(body, controller), replace(task, faults=()), seed)
        figures |= {"faults": list(map(str, task.faults)), **asdict(recovery(flight, sound))}
    if out is not None:
        save_flight(out, flight, body, controller)
    if as_json:
        print_json({"airframe": body.name, "scenario": task.name, "axis": AXES[task.axis], "seed": seed, **figures})
    else:
        rows = [[FIGURE_LABELS[name], _text(value)] for name, value in figures.items() if name in FIGURE_LABELS]
        title = (
            f"{body.name}, {task.name} on {AXES[task.axis]}, against {inner.label} (inner) and {outer.label} (outer)"
        )
        print_table(", ".join([title, *map(str, task.faults)]), ["figure", "value"], rows)
    if flight.crashed_at is not None:
        raise SitlError(f"the vehicle was lost at {flight.crashed_at:.2f} s", exit_code=1)
    if flight.record["fault"].any():
        raise SitlError("the controller refused its inputs for too long and only damped the rates", exit_code=1)


def _times(speed: str) -> float | None:
    """``--speed``: times real time; None for ``max``."""
    from mimopilot.sitl.errors import SitlError

    try:
        times = None if speed == "max" else float(speed)
    except ValueError:
        times = 0.0
    if times is not None and not 0.01 <= times <= 1000:
        raise SitlError(f"--speed {speed}: expected 0.01 to 1000, or max")
    return times


def _address(text: str) -> tuple[str, int]:
    """HOST:PORT."""
    from mimopilot.sitl.errors import SitlError

    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise SitlError(f"--plant {text}: expected HOST:PORT, such as 127.0.0.1:4560")
    return host, int(port)


def sitl(
    airframe: AirframeArgument,
    gains: GainsOption = None,
    plant: Annotated[
        str | None, typer.Option(help="HOST:PORT of a plant that runs already; by default one is started.")
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port of the started plant; 0: any.")] = 0,
    ground_port: Annotated[
        int, typer.Option(min=1, max=65535, help="UDP port where the ground station listens.")
    ] = 14550,
    vehicle_port: Annotated[
        int, typer.Option(min=0, max=65535, help="UDP port where ground stations may speak first; 0: any.")
    ] = 18570,
    tcp_port: Annotated[
        int, typer.Option(min=0, max=65535, help="TCP port where ground stations connect; 0: any.")
    ] = 5760,
    bind: Annotated[
        str, typer.Option(help="Local address of both; 0.0.0.0: all, and whoever reaches it commands the vehicle.")
    ] = "127.0.0.1",
    signing_key: Annotated[
        Path | None, typer.Option(help="Sign with this key (32 bytes or 64 hexadecimal digits), hear nothing unsigned.")
    ] = None,
    parameters: Annotated[
        Path | None,
        typer.Option(help="Keep here what ground stations change; at the next start it outranks the gains."),
    ] = None,
    speed: SpeedOption = "1",
    seed: SeedOption = 0,
    fault: FaultOption = None,
    log: Annotated[
        Path | None, typer.Option(help="Log each flight, arming to disarming, at full rate: FILE.ulg, FILE-2.ulg ...")
    ] = None,
    scenario: Annotated[
        str | None, typer.Option(help="Take off, fly doublet, step, hover or a scenario file, land and end.")
    ] = None,
    axis: AxisOption = None,
    amplitude_deg: AmplitudeOption = None,
    period_s: PeriodOption = None,
) -> None:
    """Run the vehicle for ground stations: autopilot host and plant in two processes. Ctrl-C ends it."""
    from mimopilot.sitl.errors import SitlError
    from mimopilot.sitl.faults.kinds import parse_fault
    from mimopilot.sitl.mavlink.vehicle.sitl_console import SitlOptions, run

    body, controller = _load(airframe, gains)
    task, faults = None, tuple(map(parse_fault, fault or ()))
    if scenario is not None:
        task = scenario_of(scenario, axis, amplitude_deg, period_s, None, fault, controller.Ts)
        faults = task.faults
    elif (axis, amplitude_deg, period_s) != (None,) * 3:
        raise SitlError("--axis, --amplitude-deg, --period-s: they belong to a --scenario; give one")
    if plant and (port, speed, seed) != (0, "1", 0):
        raise SitlError("--port, --speed and --seed belong to the plant: with --plant, say them where it was started")
    address = _address(plant) if plant else None
    links = (ground_port, vehicle_port, tcp_port, bind, signing_key)
    times = _times(speed)
    run(SitlOptions(airframe, body, controller, address, port, *links, parameters, times, seed, log, task, faults))


def plant(
    airframe: AirframeArgument,
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port to listen on; 0: any free one.")] = 4560,
    rate: Annotated[float, typer.Option(help="Frames a second (the autopilot's control rate), Hz.")] = 250.0,
    speed: SpeedOption = "1",
    altitude: Annotated[
        float, typer.Option(min=0, max=1000, help="Where it starts hovering, m; 0: on the ground, rotors standing.")
    ] = 0.0,
    seed: SeedOption = 0,
    fault: FaultOption = None,
    child: Annotated[bool, typer.Option("--child", help="End when standard input is closed.")] = False,
    serial: Annotated[
        str | None, typer.Option(help="DEVICE,BAUD of a board in HITL mode, in place of the TCP port; in real time.")
    ] = None,
) -> None:
    """Serve the plant alone over PX4's simulator API to one autopilot after another, in lockstep over TCP."""
    from mimopilot.sitl.errors import SitlError
    from mimopilot.sitl.faults.kinds import parse_faults
    from mimopilot.sitl.mavlink.simulator_api.hitl import SerialPlant
    from mimopilot.sitl.mavlink.simulator_api.plant_server import PlantServer
    from mimopilot.sitl.mavlink.simulator_api.simulated_vehicle import SimulatedVehicle
    from mimopilot.sitl.mavlink.wire.sockets import LOOPBACK, listen
    from mimopilot.sitl.physics.airframe import load_airframe

    times = _times(speed)
    if not 1 <= rate <= 1e4:
        raise SitlError(f"--rate {rate}: expected 1 to 10000 Hz")

    def tell(text: str) -> None:
        print(f"mimopilot: plant: {text}", file=sys.stderr, flush=True)

    if serial and times != 1.0:
        raise SitlError(f"--speed {speed}: a board on a serial port flies in real time")
    faults = parse_faults(fault or (), ("plant", "link"), "the plant")
    vehicle = SimulatedVehicle(load_airframe(airframe).airframe, round(1 / rate, 9), seed, altitude, tell, faults)
    try:
        if serial:
            board = SerialPlant(vehicle, serial)
            print(f"plant of {airframe} speaks on {serial}", flush=True)
            board.serve()
        with listen(LOOPBACK, port) as socket:
            print(f"plant of {airframe} listens on TCP {LOOPBACK}:{socket.getsockname()[1]}", flush=True)
            PlantServer(vehicle, socket, times, child).serve()
    except KeyboardInterrupt:
        pass
