"""The `sitl` command: assembles the vehicle, and runs it until Ctrl-C."""

from __future__ import annotations

import signal
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from pymavlink.dialects.v20 import common as mavlink

from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.autopilot.excitation_injector import Injector
from mimopilot.sitl.autopilot.px4_law import Px4Controller
from mimopilot.sitl.autopilot.stock_autopilot import StockAutopilot
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.faults.inject_autopilot import AutopilotFaults
from mimopilot.sitl.faults.inject_plant import check_fault
from mimopilot.sitl.faults.kinds import Fault
from mimopilot.sitl.flight.flight_log import vehicle_log
from mimopilot.sitl.flight.scenario import Scenario
from mimopilot.sitl.flight.scripted_pilot import ScriptedPilot
from mimopilot.sitl.flight.stock_log import stock_log
from mimopilot.sitl.mavlink.simulator_api.plant_link import PlantLink
from mimopilot.sitl.mavlink.simulator_api.plant_process import PlantProcess
from mimopilot.sitl.mavlink.vehicle.autotune_command import AutotuneCommand
from mimopilot.sitl.mavlink.vehicle.flight_recorder import FlightRecorder
from mimopilot.sitl.mavlink.vehicle.ground_station_link import GroundStationLink
from mimopilot.sitl.mavlink.vehicle.host import Host
from mimopilot.sitl.mavlink.vehicle.log_server import LogServer
from mimopilot.sitl.mavlink.vehicle.parameter_server import ParameterServer
from mimopilot.sitl.mavlink.vehicle.parameter_store import ParameterStore
from mimopilot.sitl.mavlink.vehicle.px4_parameter_server import Px4ParameterServer
from mimopilot.sitl.mavlink.vehicle.stations import Stations
from mimopilot.sitl.mavlink.vehicle.telemetry import Telemetry
from mimopilot.sitl.mavlink.vehicle.torque_injection import TorqueInjection
from mimopilot.sitl.mavlink.vehicle.vehicle_commands import VehicleCommands
from mimopilot.sitl.mavlink.wire.signing import Signer, read_key
from mimopilot.sitl.physics.airframe import Airframe
from mimopilot.tuning.gains import Gains


@dataclass(frozen=True)
class SitlOptions:
    """Options of the `sitl` command.

    Attributes
    ----------
    name : str
        Name or file of the airframe.
    airframe : Airframe
    gains : Gains
    plant : (host, port) or None
        Address of a running plant; None: start one.
    port : int
        TCP port of the started plant; 0: any.
    ground_port, vehicle_port, tcp_port, bind
        See `sitl.mavlink.vehicle.stations.Stations`.
    signing_key : Path or None
        File of the signing key.
    parameters : Path or None
        File that stores changed parameters.
    speed : float or None
        Times real time; None: as fast as possible.
    seed : int
        Seed of the plant's noise.
    log : Path or None
        File of the first flight's log.
    scenario : Scenario or None
        Flown at once, without a ground station.
    faults : tuple of Fault
        In seconds from the first frame of the plant.
    stock : bool
        Fly a stock PX4's controllers in place of the generated one.
    """

    name: str
    airframe: Airframe
    gains: Gains
    plant: tuple[str, int] | None
    port: int
    ground_port: int
    vehicle_port: int
    tcp_port: int
    bind: str
    signing_key: Path | None
    parameters: Path | None
    speed: float | None
    seed: int
    log: Path | None
    scenario: Scenario | None
    faults: tuple[Fault, ...]
    stock: bool = False


def run(options: SitlOptions) -> None:
    """Run the vehicle until Ctrl-C, or until the end of its scenario.

    Raises
    ------
    SitlError
        When a port, a file or the gains cannot be used.
    """
    with ExitStack() as leaving:
        host, ground = _assemble(options, leaving)
        print(f"{options.airframe.name}: {ground.stations}, plant {host.plant.place}; Ctrl-C ends", flush=True)
        begin = time.monotonic()
        try:
            host.run(ground)
            pace = host.response_times.periods * options.gains.Ts / (time.monotonic() - begin)
            print(f"flown at {pace:.3g} times real time")
        except KeyboardInterrupt:
            written = host.leave()
            print(f"ended: {host.response_times}{'; logged: ' if written else ''}{', '.join(map(str, written))}")


def _assemble(options: SitlOptions, leaving: ExitStack) -> tuple[Host, GroundStationLink]:
    gains, key = options.gains, options.signing_key
    plant_faults = _check_faults(options)
    signer = Signer(read_key(key)) if key else None
    stations = Stations(options.ground_port, options.vehicle_port, options.tcp_port, options.bind, signer)
    leaving.callback(stations.close)
    if stations.exposed:
        print("warning: anyone who reaches this address can command the vehicle; require a key with --signing-key")
    child = PlantProcess(options.name, options.port, gains.Ts, options.seed, options.speed, faults=plant_faults)
    link = PlantLink(options.plant or child)
    leaving.callback(link.close)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # end as on Ctrl-C: logs written, plant ended
    if link.child is not None:
        link.child.start()  # it starts while we compile
    stock = StockAutopilot(options.airframe, gains) if options.stock else None
    autopilot = stock or Autopilot(options.airframe, gains)
    autopilot.warm_up()
    make_log = vehicle_log if stock is None else stock_log
    log = FlightRecorder(options.log, options.airframe, gains.Ts, make_log) if options.log else None
    host = Host(autopilot, link, log)
    leaving.callback(host.leave)
    if len(options.faults) > len(plant_faults):
        host.faults = AutopilotFaults(options.faults, gains.Ts, autopilot)
    telemetry = Telemetry(host.state)
    commands = VehicleCommands(host.vehicle, telemetry, host.reboot)
    store = ParameterStore(options.parameters) if options.parameters else None
    server = _serve_parameters(host, gains, store) if stock is None else _serve_stock(host, stock, commands, store)
    if options.scenario is not None:
        host.pilot = pilot = ScriptedPilot(options.scenario)
        host.excitation = lambda now: pilot.moment
    leaving.callback(server.close)
    if server.summary:
        print(server.summary)
    if link.child is not None:
        link.child.wait()
    return host, GroundStationLink(server, commands, telemetry, stations, LogServer(log.logs if log else ()))


def _serve_parameters(host: Host, gains: Gains, store: ParameterStore | None) -> ParameterServer:
    """Our module's parameters and injector."""
    injector = Injector(gains.Ts)
    host.excitation = TorqueInjection(injector, host.state)
    controller = host.autopilot.controller
    assert not isinstance(controller, Px4Controller)
    return ParameterServer(controller, gains, injector, store)


def _serve_stock(
    host: Host, autopilot: StockAutopilot, commands: VehicleCommands, store: ParameterStore | None
) -> Px4ParameterServer:
    """A stock PX4's parameters and autotune, and its identity."""
    host.state.autopilot = mavlink.MAV_AUTOPILOT_PX4
    host.excitation = autotune = AutotuneCommand(autopilot, host.state)
    commands.handlers[mavlink.MAV_CMD_DO_AUTOTUNE_ENABLE] = autotune.execute

    def reboot() -> None:
        host.reboot()
        autopilot.boot()

    commands.reboot = reboot
    return Px4ParameterServer(autopilot, store)


def _check_faults(options: SitlOptions) -> list[Fault]:
    """Check the faults; return those of the plant and its link, which only a plant of ours can have."""
    for fault in options.faults:
        check_fault(fault, options.airframe, options.gains.Ts, None)
    plant_faults = [fault for fault in options.faults if fault.place != "autopilot"]
    if options.plant and plant_faults:
        raise SitlError(
            f"fault {str(plant_faults[0])!r}: belongs to the plant, which runs already: give it to that command"
        )
    return plant_faults
