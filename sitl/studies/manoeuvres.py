"""`mimopilot reproduce manoeuvres`: turns, flips, recovery and heading steps under the flown law and an Euler law.

The Euler law takes the differences of roll, pitch and yaw for the attitude error and gives the yaw rate to body z
alone, which is the usual simplification in design; see `euler_rates`. Both use the same gains and the same rate
controller, without measurement noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mimopilot.common.files import inside
from mimopilot.common.html_report import ReportTable, Section, write_report
from mimopilot.sitl.autopilot.autopilot import RECORD, Autopilot
from mimopilot.sitl.flight.scenario import Scenario
from mimopilot.sitl.flight.simulator import TRUTH, Simulator
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.sitl.physics.state_estimate import euler_angles, quaternion_of
from mimopilot.sitl.studies.reproduction import Reproduction
from mimopilot.tuning.controller import Controller
from mimopilot.tuning.gains import Gains

MANOEUVRES = "manoeuvres"
AIRFRAMES = ("adam0", "adam0_boom", "antr")
ALTITUDE = 200.0  # m; high enough for every manoeuvre
SETTLE = 1.0  # s of hover before each manoeuvre
#: Bank angles (deg) and yaw rate (rad/s) of the coordinated turns, and their time (s); judged over its second half.
BANKS_DEG, YAW_RATE, TURN = (20.0, 35.0, 45.0), 1.5, 6.0
FLIP_RATE = 8.0  # rad/s; 460 deg/s, within what small vehicles reach
RECOVERY_DEG, HEADINGS_DEG = 150.0, (90.0, 170.0)
AFTER = 4.0  # s after a flip, a step or an upset
_UNITS = (("roll", np.array([1, 0, 0])), ("pitch", np.array([0, 1, 0])))
LEVEL_DEG, ARRIVED_DEG = 10.0, 5.0  # tilt of a recovered vehicle, error of a heading that is reached

Law = Callable[[Gains, NDArray[np.float64], NDArray[np.float64], float], NDArray[np.float64]]


@dataclass(frozen=True)
class Manoeuvre:
    """A scenario, the attitude that it starts from (roll, pitch, yaw; rad), and what is judged.

    `judge` returns name -> figure, from the scenario and the true motion (N,) of `sitl.flight.simulator.TRUTH`.
    """

    name: str
    scenario: Scenario
    judge: Callable[[Scenario, NDArray[Any]], dict[str, float]]
    start: tuple[float, float, float] = (0.0, 0.0, 0.0)


def euler_rates(
    gains: Gains, attitude: NDArray[np.float64], setpoint: NDArray[np.float64], yaw_rate: float
) -> NDArray[np.float64]:
    """Rate setpoint (3,), rad/s, of the law on Euler angles, both (3,), rad."""
    error = setpoint - attitude
    error[2] = np.remainder(error[2] + np.pi, 2 * np.pi) - np.pi
    rates = np.append(gains.Kp_o @ error[:2], gains.yaw.Kp_o * error[2] + yaw_rate)
    limit = np.array(gains.limits.rate_max)
    return np.asarray(np.clip(rates, -limit, limit), dtype=np.float64)


def fly_manoeuvre(name: str, gains: Gains, manoeuvre: Manoeuvre, law: Law | None = None) -> NDArray[Any]:
    """Fly a manoeuvre.

    Parameters
    ----------
    name : str
        Airframe.
    gains : Gains
    manoeuvre : Manoeuvre
    law : callable, optional
        Attitude controller that takes the place of the compiled one, outside of the rate mode.

    Returns
    -------
    (N,) array of `sitl.flight.simulator.TRUTH`
    """
    airframe, scenario = load_airframe(name).airframe, manoeuvre.scenario
    samples = len(scenario.setpoint)
    simulator = Simulator(airframe, scenario.Ts, 0, noise=False, altitude=ALTITUDE)
    state = simulator.state.copy()
    state[6:10] = quaternion_of(*manoeuvre.start)
    simulator.restart(state)
    autopilot = Autopilot(airframe, gains, altitude=ALTITUDE)
    record, truth, still = np.zeros(samples, RECORD), np.zeros(samples, TRUTH), np.zeros((samples, 6))
    record["setpoint"] = scenario.setpoint
    record["yaw_rate"] = 0.0 if scenario.yaw_rate is None else scenario.yaw_rate
    record["rate_mode"] = False if scenario.rate_mode is None else scenario.rate_mode
    if law is None:
        simulator.fly(autopilot, still, record, truth)
        return truth
    for k in range(samples):
        one = slice(k, k + 1)
        if not record["rate_mode"][k]:
            angles = np.array(euler_angles(*simulator.state[6:10]))
            record["setpoint"][k] = law(gains, angles, scenario.setpoint[k].copy(), float(record["yaw_rate"][k]))
            record["rate_mode"][k] = True
        simulator.fly(autopilot, still[one], record[one], truth[one])
    return truth


def tilt_deg(attitude: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angle between body z and down, deg, of attitudes (N, 3), rad."""
    cosine = np.cos(attitude[:, 0]) * np.cos(attitude[:, 1])
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))), dtype=np.float64)


def manoeuvres(Ts: float) -> list[Manoeuvre]:
    """The manoeuvres, at a control period (s)."""
    upset = _hover(Ts, AFTER, "recovery")
    return [
        *(_turn(Ts, bank) for bank in BANKS_DEG),
        _flip(Ts, 0),
        _flip(Ts, 1),
        Manoeuvre(
            f"recovery from {RECOVERY_DEG:g} deg of roll",
            upset,
            _recovery,
            (np.radians(RECOVERY_DEG), 0.0, 0.0),
        ),
        Manoeuvre(
            f"recovery from {RECOVERY_DEG:g} deg, oblique",
            upset,
            _recovery,
            tuple(Rotation.from_rotvec(np.radians(RECOVERY_DEG) * np.array([0.6, 0.8, 0.0])).as_euler("ZYX")[::-1]),
        ),
        *(_heading(Ts, angle) for angle in HEADINGS_DEG),
    ]


def _hover(Ts: float, seconds: float, name: str) -> Scenario:
    setpoint = np.zeros((round(seconds / Ts), 3))
    return Scenario(name, Ts, setpoint, np.zeros_like(setpoint), 0, (0, len(setpoint)))


def _turn(Ts: float, bank: float) -> Manoeuvre:
    scenario = _hover(Ts, SETTLE + TURN, "turn")
    start = round(SETTLE / Ts)
    setpoint, yaw_rate = scenario.setpoint.copy(), np.zeros(len(scenario.setpoint))
    setpoint[start:, 0], yaw_rate[start:] = np.radians(bank), YAW_RATE
    setpoint[:, 2] = np.cumsum(yaw_rate) * Ts
    return Manoeuvre(
        f"turn at {bank:g} deg of bank",
        replace(scenario, setpoint=setpoint, yaw_rate=yaw_rate, window=(start, len(setpoint))),
        _turn_errors,
    )


def _turn_errors(scenario: Scenario, truth: NDArray[Any]) -> dict[str, float]:
    half = slice(sum(scenario.window) // 2, scenario.window[1])
    flown, wanted = truth["attitude"][half], scenario.setpoint[half]
    heading = np.degrees(np.abs(np.remainder(flown[:, 2] - wanted[:, 2] + np.pi, 2 * np.pi) - np.pi))
    cosine = np.sum(_body_z(flown) * _body_z(wanted), axis=1)
    tilt = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return {"tilt error, deg": float(tilt.max()), "heading error, deg": float(heading.max())}


def _body_z(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Direction of body z in earth axes (N, 3), of roll, pitch, yaw (N, 3), rad."""
    return np.asarray(Rotation.from_euler("ZYX", angles[:, ::-1]).apply([0.0, 0.0, 1.0]), dtype=np.float64)


def _flip(Ts: float, axis: int) -> Manoeuvre:
    scenario = _hover(Ts, SETTLE + 2 * np.pi / FLIP_RATE + AFTER, "flip")
    start, stop = round(SETTLE / Ts), round((SETTLE + 2 * np.pi / FLIP_RATE) / Ts)
    setpoint, rate_mode = scenario.setpoint.copy(), np.zeros(len(scenario.setpoint), bool)
    setpoint[start:stop, axis], rate_mode[start:stop] = FLIP_RATE, True
    flown = replace(scenario, setpoint=setpoint, rate_mode=rate_mode, axis=axis, window=(start, stop))
    return Manoeuvre(f"flip in {('roll', 'pitch')[axis]}", flown, _flip_figures)


def _flip_figures(scenario: Scenario, truth: NDArray[Any]) -> dict[str, float]:
    start, stop = scenario.window
    turned = np.degrees(truth["rates"][start:stop, scenario.axis].sum() * scenario.Ts)
    after = _recovery(replace(scenario, window=(stop, len(truth))), truth)
    return {"turned at the end of the rate setpoint, deg": turned, **after}


def _recovery(scenario: Scenario, truth: NDArray[Any]) -> dict[str, float]:
    after = truth[scenario.window[0] :]
    tilt = tilt_deg(after["attitude"])
    beyond = np.flatnonzero(tilt > LEVEL_DEG)
    seconds = (beyond[-1] + 1) * scenario.Ts if len(beyond) else 0.0
    lost = seconds >= len(after) * scenario.Ts
    turned = np.degrees(np.abs(np.remainder(after["attitude"][-1, 2] + np.pi, 2 * np.pi) - np.pi))
    return {"level again, s": np.inf if lost else seconds, "heading error, deg": turned}


def _heading(Ts: float, angle: float) -> Manoeuvre:
    scenario = _hover(Ts, SETTLE + AFTER, "heading")
    start = round(SETTLE / Ts)
    setpoint = scenario.setpoint.copy()
    setpoint[start:, 2] = np.radians(angle)
    flown = replace(scenario, setpoint=setpoint, window=(start, len(setpoint)))
    return Manoeuvre(f"heading step of {angle:g} deg", flown, _heading_figures)


def _heading_figures(scenario: Scenario, truth: NDArray[Any]) -> dict[str, float]:
    after = truth[scenario.window[0] :]
    wanted = scenario.setpoint[-1, 2]
    error = np.degrees(np.abs(np.remainder(after["attitude"][:, 2] - wanted + np.pi, 2 * np.pi) - np.pi))
    beyond = np.flatnonzero(error > ARRIVED_DEG)
    arrived = (beyond[-1] + 1) * scenario.Ts if len(beyond) else 0.0
    late = arrived >= len(after) * scenario.Ts
    return {"heading reached, s": np.inf if late else arrived, "largest tilt, deg": tilt_deg(after["attitude"]).max()}


def attitude_errors() -> list[tuple[str, NDArray[np.float64], NDArray[np.float64]]]:
    """Attitude errors (3,), deg, of the flown law and as differences of Euler angles: for attitudes and setpoints.

    The flown one is the rate setpoint with an attitude gain of 1 on each axis.
    """
    sizes = [(size, axis, unit) for size in (5, 10, 25) for axis, unit in _UNITS]
    cases = [(f"level to {axis} of {size} deg", np.zeros(3), size * unit) for size, axis, unit in sizes]
    cases += [(f"{axis} from -{size} to {size} deg", -size * unit, size * unit) for size, axis, unit in sizes[2:]]
    cases += [
        (f"roll {bank} deg, to {what}", np.array([bank, 0, 0]), np.array([bank, 0, 0]) + change)
        for bank in (20, 45)
        for what, change in (("pitch of 10 deg", (0, 10, 0)), ("heading of 10 deg", (0, 0, 10)))
    ]
    wide = (100.0,) * 3
    start = load_airframe(AIRFRAMES[0]).default_gains()
    gains = replace(
        start, Kp_o=np.eye(2), yaw=replace(start.yaw, Kp_o=1.0), limits=replace(start.limits, rate_max=wide)
    )
    found = []
    for name, attitude, setpoint in cases:
        q, wanted = (np.array(quaternion_of(*np.radians(angles))) for angles in (attitude, setpoint))
        flown = Controller(gains, np.float64).step(wanted, q, np.zeros(3)).rates_setpoint
        found.append((name, np.degrees(flown), np.subtract(setpoint, attitude).astype(float)))
    return found


def _errors_table() -> ReportTable:
    rows = [
        (name, *(f"{one:.2f}" for one in flown), *(f"{one:.2f}" for one in euler))
        for name, flown, euler in attitude_errors()
    ]
    columns = ("attitude error, deg", "roll", "pitch", "yaw", "Euler roll", "Euler pitch", "Euler yaw")
    return ReportTable("Attitude error of the flown law, and as differences of Euler angles", columns, rows)


def reproduce_manoeuvres(out: Path) -> Reproduction:
    """Fly the suite with the airframes' own gains and write its report, manoeuvres.html."""
    report = inside(out, f"{MANOEUVRES}.html")
    figures: dict[str, Any] = {}
    tables = []
    for name in AIRFRAMES:
        gains = load_airframe(name).default_gains()
        rows = []
        for one in manoeuvres(gains.Ts):
            flown = one.judge(one.scenario, fly_manoeuvre(name, gains, one))
            euler = one.judge(one.scenario, fly_manoeuvre(name, gains, one, euler_rates))
            figures.setdefault(name, {})[one.name] = {"quaternion": _plain(flown), "euler": _plain(euler)}
            rows += [(one.name, key, _shown(flown[key]), _shown(euler[key])) for key in flown]
        tables.append(ReportTable(name, ("manoeuvre", "figure", "flown law", "Euler law"), rows))
    lead = (
        f"The attitude law on quaternions beside one on Euler angles, same gains. Turns: {YAW_RATE:g} rad/s, largest "
        "angle between the thrust's direction and the setpoint's, and error of the heading, over the last "
        f"{TURN / 2:g} s. Flips: {FLIP_RATE:g} rad/s in rate mode. Level again: tilt below {LEVEL_DEG:g} degrees for "
        "good. Heading reached: within {ARRIVED_DEG:g} degrees for good."
    )
    sections = [Section(table.caption, load_airframe(table.caption).airframe.description, [table]) for table in tables]
    tables.append(_errors_table())
    sections.append(Section("Attitude error", "For one axis from level the flown law has 2 sin(a/2).", tables[-1:]))
    write_report(report, f"mimopilot reproduce {MANOEUVRES}", lead, sections)
    return Reproduction(figures, tuple(tables), report)


def _plain(found: dict[str, float]) -> dict[str, float | None]:
    return {key: float(value) if np.isfinite(value) else None for key, value in found.items()}


def _shown(value: float) -> str:
    return f"{value:.2f}" if np.isfinite(value) else "never"
