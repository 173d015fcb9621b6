"""The parameters of a vehicle's stock controller, read over MAVLink."""

from __future__ import annotations

from pymavlink.dialects.v20 import common as mavlink

from mimopilot.common.files import sha256
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.mavlink.ground_station.parameter_protocol import Answer
from mimopilot.sitl.mavlink.ground_station.session import LinkOptions, Session, open_session
from mimopilot.sitl.mavlink.ground_station.vehicle_kinds import MULTIROTORS, describe
from mimopilot.sitl.mavlink.wire.float32 import shortest
from mimopilot.tuning.logs.imported_gains import INTEGERS, ParameterSource, vehicle_names
from mimopilot.tuning.logs.stock_controllers import ARDUPILOT, PX4
from mimopilot.tuning.parameter_row import PREFIX

#: MAV_AUTOPILOT -> its controller.
STOCK = {mavlink.MAV_AUTOPILOT_PX4: PX4, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: ARDUPILOT}

#: Tries for a parameter that the gains do not need: 3 s.
OTHER_TRIES = 6


def read_stock_parameters(options: LinkOptions) -> ParameterSource:
    """Read what `tuning.logs.imported_gains.import_gains` needs from a vehicle; nothing is written.

    Raises
    ------
    SitlError
        When no vehicle answers, it is no multirotor with PX4 or ArduPilot, or a parameter is not read.
    """
    with open_session(options, INTEGERS) as session:
        vehicle = session.run(session.client.await_heartbeat())
        stock = STOCK.get(vehicle.autopilot)
        if stock is None or vehicle.type not in MULTIROTORS:
            raise SitlError(
                f"the vehicle is {describe(vehicle)} (system {vehicle.system}); stock gains are read from multirotors "
                "with PX4 or ArduPilot"
            )
        needed, others = vehicle_names(stock)
        values = _read(session, needed)
        # A vehicle may not answer for what it lacks, and many lack some of these.
        session.client.tries = min(session.client.tries, OTHER_TRIES)
        values |= _read(session, others)
    unknown = [name for name in others if name not in values and not name.startswith(PREFIX)]
    warnings = (f"not on the vehicle, or not answered: {', '.join(unknown)}",) if unknown else ()
    text = "".join(f"{name} {shortest(value)}\n" for name, value in sorted(values.items()))
    return ParameterSource(options.connect, "vehicle", values, sha256(text), warnings=warnings)


def _read(session: Session, names: list[str]) -> dict[str, float]:
    """Values of the parameters that the vehicle has."""
    answers: dict[str, Answer] = session.run(session.client.read(names, "reading", keep_going=True))
    for name, answer in answers.items():
        if answer.problem and (not answer.absent or session.client.lost):
            raise SitlError(f"{name}: {answer.problem}", exit_code=1)
    return {name: answer.value for name, answer in answers.items() if answer.value is not None}
