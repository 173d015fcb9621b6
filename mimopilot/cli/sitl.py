"""Commands of the simulation over MAVLink: the vehicle for ground stations, and the plant for an autopilot."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from mimopilot.cli.options import (
    AirframeArgument,
    AmplitudeOption,
    AxisOption,
    FaultOption,
    GainsOption,
    PeriodOption,
    SeedOption,
    SpeedOption,
)
from mimopilot.common.errors import check_choice, check_not_given


def register(app: typer.Typer) -> None:
    """Add these commands to the command line."""
    app.command(
        epilog="Example: mimopilot sitl adam0 --gains my.gains.toml, then mavproxy.py --master=udp:127.0.0.1:14550"
    )(sitl)
    app.command(epilog="Example: mimopilot plant adam0; mimopilot plant adam0 --protocol ardupilot-json")(plant)


def sitl(
    airframe: AirframeArgument,
    gains: GainsOption = None,
    autopilot: Annotated[
        str, typer.Option(help="mimo: the generated controller. px4-stock: a stock PX4's, with the gains' diagonal.")
    ] = "mimo",
    plant: Annotated[str | None, typer.Option(help="HOST:PORT of a running plant; by default one is started.")] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port of the started plant; 0: any.")] = 0,
    ground_port: Annotated[
        int, typer.Option(min=1, max=65535, help="UDP port where the ground station listens.")
    ] = 14550,
    vehicle_port: Annotated[
        int, typer.Option(min=0, max=65535, help="UDP port where the vehicle listens to ground stations; 0: any.")
    ] = 18570,
    tcp_port: Annotated[
        int, typer.Option(min=0, max=65535, help="TCP port where ground stations connect; 0: any.")
    ] = 5760,
    bind: Annotated[
        str, typer.Option(help="Local address of both; 0.0.0.0: all, and anybody on the network commands the vehicle.")
    ] = "127.0.0.1",
    signing_key: Annotated[
        Path | None,
        typer.Option(help="Sign with this key (32 bytes or 64 hexadecimal digits), reject unsigned frames."),
    ] = None,
    parameters: Annotated[
        Path | None,
        typer.Option(help="Store here what ground stations change; at the next start it overrides the gains."),
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
    from mimopilot.api.arguments import given_vehicle
    from mimopilot.sitl.faults.kinds import parse_fault
    from mimopilot.sitl.flight.scenario import scenario_of
    from mimopilot.sitl.mavlink.vehicle.sitl_console import SitlOptions, run

    check_choice("--autopilot", autopilot, ("mimo", "px4-stock"))
    body, controller = given_vehicle(airframe, gains)
    task, faults = None, tuple(map(parse_fault, fault or ()))
    if scenario is not None:
        task = scenario_of(scenario, axis, amplitude_deg, period_s, None, fault or (), controller.Ts)
        faults = task.faults
    else:
        check_not_given("only with a --scenario; give one", axis=axis, amplitude_deg=amplitude_deg, period_s=period_s)
    if plant:
        check_not_given(
            "belong to the plant: with --plant, give them where it was started",
            port=port or None,
            speed=speed if speed != "1" else None,
            seed=seed or None,
        )
    run(
        SitlOptions(
            name=airframe,
            airframe=body,
            gains=controller,
            plant=_address(plant) if plant else None,
            port=port,
            ground_port=ground_port,
            vehicle_port=vehicle_port,
            tcp_port=tcp_port,
            bind=bind,
            signing_key=signing_key,
            parameters=parameters,
            speed=_times(speed),
            seed=seed,
            log=log,
            scenario=task,
            faults=faults,
            stock=autopilot == "px4-stock",
        )
    )


def plant(
    airframe: AirframeArgument,
    protocol: Annotated[
        str, typer.Option(help="px4: PX4's simulator API, over TCP. ardupilot-json: ArduPilot's, over UDP.")
    ] = "px4",
    port: Annotated[
        int | None,
        typer.Option(
            min=0, max=65535, help="Port to listen on; 0: any free one.", show_default="4560; ardupilot-json: 9002"
        ),
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option(
            help="Frames per second (the autopilot's control rate), Hz.", show_default="250; ardupilot-json: its own"
        ),
    ] = None,
    speed: Annotated[
        str | None,
        typer.Option(help="Times real time, or max: as fast as possible.", show_default="1; ardupilot-json: max"),
    ] = None,
    altitude: Annotated[
        float, typer.Option(min=0, max=1000, help="Initial hover altitude, m; 0: on the ground, rotors standing.")
    ] = 0.0,
    seed: SeedOption = 0,
    fault: FaultOption = None,
    child: Annotated[bool, typer.Option("--child", help="End when standard input is closed.")] = False,
    serial: Annotated[
        str | None, typer.Option(help="DEVICE,BAUD of a board in HITL mode, in place of the TCP port; in real time.")
    ] = None,
) -> None:
    """Serve the plant alone to PX4's or ArduPilot's simulation, one autopilot after another, in lockstep."""
    import mimopilot as mp
    from mimopilot.sitl.errors import SitlError
    from mimopilot.sitl.faults.kinds import parse_faults
    from mimopilot.sitl.mavlink.simulator_api.hitl import SerialPlant
    from mimopilot.sitl.mavlink.simulator_api.json_server import FRAME_RATE, PORT, JsonServer, check_json_faults
    from mimopilot.sitl.mavlink.simulator_api.plant_server import PlantServer
    from mimopilot.sitl.mavlink.simulator_api.simulated_vehicle import SimulatedVehicle
    from mimopilot.sitl.mavlink.wire.sockets import LOOPBACK, listen, udp_socket

    def report(text: str) -> None:
        print(f"mimopilot: plant: {text}", file=sys.stderr, flush=True)

    check_choice("--protocol", protocol, ("px4", "ardupilot-json"))
    json = protocol == "ardupilot-json"
    if json:
        check_not_given(
            "not with ardupilot-json: ArduPilot sets the rate (SIM_RATE_HZ), and boots on the ground",
            rate=rate,
            altitude=altitude or None,
            serial=serial,
        )
    rate = FRAME_RATE if json else 250.0 if rate is None else rate
    times = _times(speed or ("max" if json else "1"))
    if not 1 <= rate <= 1e4:
        raise SitlError(f"--rate {rate}: expected 1 to 10000 Hz")
    if serial and times != 1.0:
        raise SitlError(f"--speed {speed}: a board on a serial port flies in real time")
    faults = parse_faults(fault or (), ("plant", "link"), "the plant")
    if json:
        check_json_faults(faults)
    body = mp.load_airframe(airframe)
    vehicle = SimulatedVehicle(body, round(1 / rate, 9), seed, altitude, report, faults, sensor_noise=not json)
    try:
        if json:
            advice = "is another simulator running? Choose another port with --port, and the same for arducopter"
            with udp_socket(LOOPBACK, PORT if port is None else port, advice) as link:
                print(f"plant of {airframe} listens on UDP {LOOPBACK}:{link.getsockname()[1]}", flush=True)
                JsonServer(vehicle, link, times, child).serve()
        if serial:
            board = SerialPlant(vehicle, serial)
            print(f"plant of {airframe}: serial port {serial}", flush=True)
            board.serve()
        with listen(LOOPBACK, 4560 if port is None else port) as socket:
            print(f"plant of {airframe} listens on TCP {LOOPBACK}:{socket.getsockname()[1]}", flush=True)
            PlantServer(vehicle, socket, times, child).serve()
    except KeyboardInterrupt:
        pass


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
