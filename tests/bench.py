"""`make bench`: measured speeds, each beside its reference, in one run."""

from __future__ import annotations

import itertools
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from mimopilot.codegen.budget import processor_in_the_loop
from mimopilot.codegen.cortex_m4 import load_emulated
from mimopilot.codegen.native import NativeController, build_native, load_native
from mimopilot.codegen.vectors import random_inputs, reference_outputs
from mimopilot.common.console import print_table
from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.flight.scenario import doublet, excitation_flight
from mimopilot.sitl.flight.simulator import fly
from mimopilot.sitl.mavlink.ground_station.connection import Connection
from mimopilot.sitl.mavlink.ground_station.events import run_exchange
from mimopilot.sitl.mavlink.ground_station.parameter_protocol import AUTOSAVE_S, ParameterClient
from mimopilot.sitl.mavlink.ground_station.upload import read_values, write_and_verify
from mimopilot.sitl.mavlink.simulator_api import lockstep
from mimopilot.sitl.mavlink.simulator_api.ardupilot_json import PACKETS
from mimopilot.sitl.mavlink.simulator_api.json_server import JsonServer
from mimopilot.sitl.mavlink.simulator_api.plant_process import plant_process
from mimopilot.sitl.mavlink.simulator_api.simulated_vehicle import SimulatedVehicle
from mimopilot.sitl.mavlink.wire.codec import Codec
from mimopilot.sitl.mavlink.wire.fast_codec import ARMED, SENSOR, FastCodec
from mimopilot.sitl.mavlink.wire.float32 import single
from mimopilot.sitl.mavlink.wire.sockets import LOOPBACK, udp_socket
from mimopilot.sitl.physics.airframe import Airframe, load_airframe
from mimopilot.sitl.physics.rigid_body import GRAVITY
from mimopilot.sitl.studies.standard_faults import standard_faults
from mimopilot.tuning.controller import Controller
from mimopilot.tuning.logs.reader import read_log
from tests.bench_autotune import autotune_rows
from tests.bench_campaign import campaign_rows, rotorpy_rows
from tests.bench_tuning import best, tuning_rows
from tests.sitl.mavlink import flood
from tests.sitl.mavlink.scripted_vehicle import ScriptedVehicle, UdpVehicle

TS = 0.004


def command(*arguments: str) -> Callable[[], object]:
    line = [sys.executable, "-m", "mimopilot", *arguments]
    return lambda: subprocess.run(line, check=True, capture_output=True)


def upload_seconds(round_trip: float) -> float:
    """A 25-parameter upload to a scripted vehicle over loopback, from its first HEARTBEAT to the stored set, s."""
    new = {f"MIMO_X_{i:02d}": single(0.1 * i + 0.05) for i in range(25)}
    vehicle = ScriptedVehicle(dict.fromkeys(new, 0.0))
    with UdpVehicle(vehicle, delay=round_trip) as link:
        connection = Connection(link.url)
        client = ParameterClient(connection.now())
        run_exchange(client.await_heartbeat(), connection)
        begin = time.perf_counter()
        held = run_exchange(read_values(client, list(new)), connection)
        outcome = run_exchange(write_and_verify(client, new, held), connection)
        seconds = time.perf_counter() - begin
        connection.close()
    if (outcome.state, outcome.storage, vehicle.values) != ("verified", "acknowledged", new):
        raise RuntimeError(f"the upload ended as {outcome}")
    return seconds


def fault_rows() -> list[list[str]]:
    """Duration of the `faults` command."""
    runs, faults = 40, len(standard_faults(load_airframe("adam0").airframe))
    seconds = best(command("faults", "adam0", "--runs", str(runs)), 2)
    title = f"mimopilot faults, {runs * faults} flights with faults and {runs} without, start included"
    return [[title, f"{seconds:.1f} s", "1000 runs under 60 s"]]


def plant_rows(airframe: Airframe) -> list[list[str]]:
    """Time of one period in the plant process: vehicle and messages separately, and what the fast codec saves."""
    vehicle = SimulatedVehicle(airframe, TS, 0, 10.0, print)
    hover = [vehicle.simulator.plant.mass * GRAVITY / (4 * airframe.motors.thrust_max)] * 16
    codec, generic, periods = FastCodec(1, 1), Codec(), 2000

    def repeat(work: Callable[[], object]) -> Callable[[], object]:
        return lambda: [work() for _ in range(periods)]

    body = best(repeat(lambda: vehicle.fly(hover, ARMED))) / periods
    vehicle.restart()
    vehicle.periods = 1  # neither the first nor every 25th
    messages = best(repeat(vehicle.pack_messages)) / periods
    fields = (1, *[0.5] * 13, 63, 0)
    data = codec.pack(SENSOR, *fields)
    fast = best(repeat(lambda: codec.parse(codec.pack(SENSOR, *fields)))) / periods
    slow = best(repeat(lambda: [list(generic.parse(data)), generic.pack(SENSOR(*fields))])) / periods
    return [
        ["one period of the plant process: body, ground, estimate", f"{body * 1e6:.0f} us", ""],
        ["its messages: instruments read, HIL_SENSOR and HIL_STATE_QUATERNION packed", f"{messages * 1e6:.0f} us", ""],
        ["HIL_SENSOR packed and parsed, fast codec", f"{fast * 1e6:.1f} us", f"pymavlink {slow * 1e6:.0f} us"],
    ]


def ardupilot_rows(airframe: Airframe) -> list[list[str]]:
    """Speed of the plant under ArduPilot's JSON protocol, over UDP: processor time of one core, the peer's included."""
    rate, frames = 1200, 2400
    vehicle = SimulatedVehicle(airframe, 1 / rate, 0, 0.0, print, sensor_noise=False)
    magic, layout = next(iter(PACKETS.items()))
    count = itertools.count()
    with udp_socket(LOOPBACK, 0) as link, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.connect(link.getsockname())
        server = JsonServer(vehicle, link, None, child=False)

        def fly() -> float:
            begin = time.process_time()
            for _ in range(frames):
                peer.send(layout.pack(magic, rate, next(count), *[1000] * 16))
                server.answer_one()
                peer.recv(4096)
            return time.process_time() - begin

        seconds = min(fly() for _ in range(5)) / frames
    title = f"plant under ArduPilot's JSON protocol, {rate} Hz, one core"
    return [[title, f"{1 / (seconds * rate):.1f} x real time, {seconds * 1e6:.0f} us a frame", "at least 2"]]


def main() -> None:
    vehicle = load_airframe("adam0")
    gains, airframe = vehicle.default_gains(), vehicle.airframe
    rows: list[list[str]] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)

        rows.append(["mimopilot --help", f"{best(command('--help')):.2f} s", "under 0.2 s"])
        rows.append(["mimopilot demo", f"{best(command('demo', '--out', name + '/demo'), 2):.1f} s", "under 60 s"])
        numbers = iter(range(100))
        build = best(lambda: build_native(gains, folder / f"b{next(numbers)}"), 3)
        rows.append(["emit and compile the native library", f"{build:.2f} s", ""])

        begin = time.perf_counter()
        figures = {figure.name: figure for figure in processor_in_the_loop(gains)}
        pace = figures["rows"].value / (time.perf_counter() - begin)
        rows.append(["pil, compiled, traced and compared", f"{pace:.0f} rows/s", ""])
        for figure in figures.values():
            if figure.limit is not None:
                rows.append([f"pil, {figure.text}", f"{figure.value:.4g}", f"at most {figure.limit:g}"])

        scenario = excitation_flight(20.0, 0.15, 50.0, TS, np.random.default_rng(0))
        library = load_native(gains)

        def flight() -> object:
            return fly(airframe, Autopilot(airframe, gains, NativeController(library, gains)), scenario, 0)

        flight()
        speed = 40.0 / best(flight)
        title = "flight in process, one core, 6 degrees of freedom, RK4 at 1 kHz"
        rows.append([title, f"{speed:.0f} x real time", "over 5000"])
        rows += rotorpy_rows(speed)
        rows += campaign_rows(folder)
        rows += fault_rows()
        processor = load_emulated(gains)
        emulated = 40.0 / best(lambda: fly(airframe, Autopilot(airframe, gains, processor), scenario, 0), 2)
        rows.append(["the same on the emulated Cortex-M4", f"{emulated:.0f} x real time", f"1/{speed / emulated:.0f}"])

        task = doublet("roll", 0.39, 4.0, TS, tail=20.0)
        autopilot = Autopilot(airframe, gains, NativeController(library, gains))
        autopilot.warm_up()
        with plant_process("adam0", 0, TS, 0, None) as port:
            begin = time.perf_counter()
            lockstep.fly(autopilot, task, port)
            over_wire = len(task.setpoint) * TS / (time.perf_counter() - begin)
        beside = f"at least 20; 1/{speed / over_wire:.0f}"
        rows.append(["the same as two processes over MAVLink", f"{over_wire:.0f} x real time", beside])

        rows += plant_rows(airframe)
        rows += ardupilot_rows(airframe)

        inputs = random_inputs(2000, np.random.default_rng(0))
        native = best(lambda: NativeController(library, gains).run(inputs)) / len(inputs)
        reference = best(lambda: reference_outputs(Controller(gains), inputs), 2) / len(inputs)
        rows.append(["one step of the controller, compiled", f"{native * 1e9:.0f} ns", ""])
        rows.append(
            ["one step of the controller, Python reference", f"{reference * 1e6:.0f} us", f"{reference / native:.0f} x"]
        )

        rows += tuning_rows(read_log(folder / "demo" / "flight.ulg"))
        for round_trip, limit in ((0.0, f"{AUTOSAVE_S:g} s are waited"), (0.1, f"{AUTOSAVE_S:g} s are waited")):
            slowest = max(upload_seconds(round_trip) for _ in range(3))
            title = f"upload of 25 parameters, verified and stored, round trip {round_trip * 1e3:.0f} ms"
            rows.append([title, f"{slowest:.2f} s", limit])
        rows += flood.rows()
        rows += autotune_rows()
    print_table("mimopilot bench", ["what", "figure", "beside"], rows)


if __name__ == "__main__":
    main()
