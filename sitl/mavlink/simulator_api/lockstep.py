"""A scenario flown over MAVLink in lockstep with a plant process, bit for bit as in one process."""

from __future__ import annotations

import select
import socket
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.sitl.autopilot.autopilot import RECORD, Autopilot, tick
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.flight.scenario import Scenario
from mimopilot.sitl.mavlink.simulator_api.plant_link import PlantState, actuator_controls
from mimopilot.sitl.mavlink.wire.codec import COMPONENT, SYSTEM
from mimopilot.sitl.mavlink.wire.fast_codec import SPIN_S, STATE, FastCodec, receive
from mimopilot.sitl.mavlink.wire.sockets import LOOPBACK
from mimopilot.sitl.physics.state_estimate import MEASUREMENT_SIZE

CONNECT_S = 10.0  # s, timeout of the connection; chosen


def fly(autopilot: Autopilot, scenario: Scenario, port: int) -> NDArray[Any]:
    """Fly a scenario with a plant process on this machine, from its first frame.

    Parameters
    ----------
    autopilot : Autopilot
        A newly made one.
    scenario : Scenario
        Setpoints and excitation.
    port : int
        TCP port of the plant.

    Returns
    -------
    (N,) array of `sitl.autopilot.autopilot.RECORD`

    Raises
    ------
    SitlError
        When there is no plant, or it disconnects before the end.
    """
    try:
        plant = socket.create_connection((LOOPBACK, port), timeout=CONNECT_S)
    except OSError as error:
        raise SitlError(
            f"no plant on TCP port {port}: {error}; start one: mimopilot plant --port {port}", exit_code=1
        ) from error
    with plant:
        plant.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        record = np.zeros(len(scenario.setpoint), RECORD)
        record["setpoint"], record["excitation"] = scenario.setpoint, scenario.excitation
        count = _exchange(autopilot, plant, record)
    if count < len(record):
        raise SitlError(f"the plant disconnected after {count} of {len(record)} periods", exit_code=1)
    return record


def _exchange(autopilot: Autopilot, plant: socket.socket, record: NDArray[Any]) -> int:
    """Answer frames until the record is full; return the number of periods flown.

    A repeated frame is answered, but not flown.
    """
    codec, measurement = FastCodec(SYSTEM, COMPONENT), np.zeros(MEASUREMENT_SIZE)
    count, stamp, answer = 0, -1, b""
    plant.setblocking(False)
    while count < len(record):
        data = receive(plant, SPIN_S)
        if data is None:
            select.select([plant], [], [])
            continue
        if not data:
            break
        for kind, fields in codec.parse(data):
            if kind is not STATE or count == len(record):
                continue
            state = PlantState(*fields)
            if state.stamp > stamp:
                stamp = state.stamp
                state.measure(measurement)
                tick(autopilot.loop, autopilot.hover, autopilot.altitude, measurement, record[count])
                answer = actuator_controls(codec, stamp, record[count]["commands"], True)
                count += 1
            plant.sendall(answer)
    return count
