"""`mimopilot demo`: the whole process from a flight to tested firmware."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mimopilot.codegen.native import NativeController, load_native
from mimopilot.common.charts import IS_FLOWN, IS_NEW, IS_SISO, looks
from mimopilot.common.console import print_table, print_text
from mimopilot.common.extras import REPORT
from mimopilot.common.files import inside
from mimopilot.common.html_report import Headline, ReportTable, Section, write_report
from mimopilot.common.progress import step
from mimopilot.sitl.autopilot.autopilot import Autopilot
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.field.report.analysis.flight_data import ReportedFlight, gain_cases, read_flights
from mimopilot.sitl.field.report.sections.gain_sets import gains_section
from mimopilot.sitl.field.report.sections.prediction import prediction_section
from mimopilot.sitl.field.report.sections.stability import stability_section
from mimopilot.sitl.flight.excitation_flight import default_yaw_amplitude
from mimopilot.sitl.flight.figures import experiment_charts, manoeuvre_chart
from mimopilot.sitl.flight.flight_log import save_flight
from mimopilot.sitl.flight.metrics import Performance, performance
from mimopilot.sitl.flight.scenario import AXES, Scenario, doublet, excitation_flight
from mimopilot.sitl.flight.simulator import Flight, fly
from mimopilot.sitl.mavlink.simulator_api import lockstep
from mimopilot.sitl.mavlink.simulator_api.plant_process import plant_process
from mimopilot.sitl.physics.airframe import Airframe, load_airframe
from mimopilot.tuning.design.cascade import tune
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.spec import TuningSpec, load_spec

AIRFRAME = "adam0"
#: Gain set -> its name in tables and plots.
LABELS = {"default": "flown", "siso": "SISO", "mimo": "MIMO"}
METHODS = tuple(LABELS)
#: Gain set -> its colour and line style.
LOOKS = dict(zip(LABELS.values(), looks((IS_FLOWN, IS_SISO, IS_NEW)), strict=True))
#: PRBS of the experiment: s per axis, amplitude (normalised torque), bandwidth (rad/s).
SECONDS_PER_AXIS, AMPLITUDE, BANDWIDTH = 20.0, 0.15, 50.0
DOUBLET_DEG, DOUBLET_S = 22.5, 0.42  # deg, s: the thesis' simulated doublet


@dataclass(frozen=True, eq=False)
class DemoSummary:
    """Result of the demo: paths, figures by axis and method, the report's tables, and the run time (s)."""

    paths: dict[str, Path]
    tables: list[ReportTable]
    figures: dict[str, dict[str, Performance]]
    report: Path
    log: Path
    mavlink_samples: int
    mavlink_speed: float
    seconds: float

    def as_json(self) -> dict[str, Any]:
        """The object that ``--json`` prints."""
        return {
            "gains": {method: str(path) for method, path in self.paths.items()},
            "report": str(self.report),
            "log": str(self.log),
            "doublets": {
                axis: {method: asdict(figures) for method, figures in methods.items()}
                for axis, methods in self.figures.items()
            },
            "mavlink": {"samples": self.mavlink_samples, "times_real_time": self.mavlink_speed},
            "seconds": self.seconds,
        }


def run_demo(out: Path, seed: int) -> DemoSummary:
    """Fly, tune, generate, compile, fly again, compare with MAVLink, report.

    Parameters
    ----------
    out : Path
        Folder for all output files.
    seed : int
        Seed of all random numbers.

    Raises
    ------
    SitlError
        When a flight is lost, or the flight over MAVLink differs from the one in process.
    Error
        When plotly is not installed.
    """
    REPORT.need()
    begin = time.monotonic()
    log, report = inside(out, "flight.ulg"), inside(out, "report.html")
    paths = {method: inside(out, f"{method}.gains.toml") for method in METHODS}
    firmware = {method: inside(out, f"firmware/{method}") for method in METHODS}
    vehicle = load_airframe(AIRFRAME)
    airframe, gains = vehicle.airframe, {"default": vehicle.default_gains()}

    with step("experiment: 60 s of flight with a PRBS torque on roll, pitch, then yaw (the first run compiles)"):
        controllers = {"default": _controller(gains["default"], firmware["default"])}
        generator = np.random.default_rng(seed)
        yaw = default_yaw_amplitude(airframe)
        scenario = excitation_flight(
            SECONDS_PER_AXIS, AMPLITUDE, BANDWIDTH, gains["default"].Ts, generator, axes="all", yaw_amplitude=yaw
        )
        autopilot = Autopilot(airframe, gains["default"], controllers["default"])
        flight = _survived(fly(airframe, autopilot, scenario, seed))
        save_flight(log, flight, airframe, gains["default"])

    with step("tuning: gains designed on the log's response, axis by axis (SISO) and with full matrices (MIMO)"):
        (logged,) = read_flights([log], None)
        measured = logged.measured
        assert measured is not None  # its own excitation can be tuned from
        for method in ("siso", "mimo"):
            gains[method] = tune(measured.experiment, load_spec(method=method), measured=measured)
        for method, path in paths.items():
            gains[method].save(path)

    with step("firmware: generating and compiling the C++ of each gain set"):
        for method in ("siso", "mimo"):
            controllers[method] = _controller(gains[method], firmware[method])

    with step("doublets: in process, then over MAVLink"):
        flights: dict[str, dict[str, Flight]] = {}
        for axis in AXES:
            task = doublet(axis, float(np.radians(DOUBLET_DEG)), DOUBLET_S, gains["default"].Ts)
            flights[axis] = {m: _doublet(airframe, gains[m], controllers[m], task, seed) for m in METHODS}
        speed = _check_over_mavlink(airframe, gains["mimo"], controllers["mimo"], flights["roll"]["mimo"], seed)

    figures = {
        axis: {
            method: performance(flight, *gains["mimo"].reference_models(AXES.index(axis)))
            for method, flight in methods.items()
        }
        for axis, methods in flights.items()
    }
    with step("report"):
        tables = _write_report(report, gains, figures, flights, flight, logged)
    samples = len(flights["roll"]["mimo"].record)
    return DemoSummary(
        paths=paths,
        tables=tables,
        figures=figures,
        report=report,
        log=log,
        mavlink_samples=samples,
        mavlink_speed=speed,
        seconds=time.monotonic() - begin,
    )


def _controller(gains: Gains, folder: Path) -> NativeController:
    """Generate, compile and load the C++ of a gain set, with these gains compiled in."""
    return NativeController(load_native(gains, folder))


def _survived(flight: Flight) -> Flight:
    if flight.crashed_at is not None:
        raise SitlError(f"the vehicle was lost at {flight.crashed_at:.2f} s of the {flight.scenario.name}", exit_code=1)
    return flight


def _doublet(airframe: Airframe, gains: Gains, controller: NativeController, task: Scenario, seed: int) -> Flight:
    fresh = NativeController(controller.library)
    return _survived(fly(airframe, Autopilot(airframe, gains, fresh), task, seed))


def _check_over_mavlink(
    airframe: Airframe, gains: Gains, controller: NativeController, flight: Flight, seed: int
) -> float:
    """Repeat a flight over MAVLink and check that all torques are equal bit for bit; returns the real-time factor."""
    autopilot = Autopilot(airframe, gains, NativeController(controller.library))
    autopilot.warm_up()
    with plant_process(AIRFRAME, 0, gains.Ts, seed, None) as port:
        begin = time.monotonic()
        record = lockstep.fly(autopilot, flight.scenario, port)
        elapsed = time.monotonic() - begin
    different = np.flatnonzero(
        (record["moment"].view(np.uint32) != flight.record["moment"].view(np.uint32)).any(axis=1)
    )
    if len(different):
        raise SitlError(
            f"over MAVLink {len(different)} of {len(record)} torques differ from the flight in process, first at "
            f"sample {different[0]}",
            exit_code=1,
        )
    return len(record) * gains.Ts / elapsed


FLOWN_CAPTION = f"Flown: doublet of {DOUBLET_DEG:g} deg, {DOUBLET_S:g} s; J in rad^2 and rad^2/s^2, (6.1)-(6.4)"
FIGURE_COLUMNS = (
    *("doublet", "J_M,o [rad^2]", "J_r,o [rad^2]", "J_r,i [rad^2/s^2]"),
    *("off-axis peak [deg]", "off-axis RMS [deg]", "effort RMS"),
)


def _figure_rows(figures: dict[str, dict[str, Performance]]) -> list[list[str]]:
    return [
        [
            f"{axis}, {LABELS[method]}",
            f"{p.J_M_o:.5f}",
            f"{p.J_r_o:.4f}",
            f"{p.J_r_i:.3f}",
            f"{p.offaxis_peak_deg:.2f}",
            f"{p.offaxis_rms_deg:.2f}",
            f"{p.effort_rms:.3f}",
        ]
        for axis, methods in figures.items()
        for method, p in methods.items()
    ]


def _write_report(
    path: Path,
    gains: dict[str, Gains],
    figures: dict[str, dict[str, Performance]],
    flights: dict[str, dict[str, Flight]],
    experiment: Flight,
    logged: ReportedFlight,
) -> list[ReportTable]:
    """Write the page; returns its tables."""
    inner, outer = gains["mimo"].reference_models(0)
    doublets = [
        manoeuvre_chart(f"doublet-{axis}", {LABELS[m]: f for m, f in methods.items()}, LOOKS, inner, outer)
        for axis, methods in flights.items()
    ]
    lead = (
        "ADAM-0 with 10 % inertia coupling (class values: the thesis prints no inertia), tuned from one "
        f"{3 * SECONDS_PER_AXIS:g} s closed-loop flight without a model of the vehicle. The design finds the attitude "
        f"model that can be followed within its limits: {outer.label} (rad/s, damping, delay in samples). SISO: the "
        "same design, axis by axis. MIMO: with full matrices."
    )
    limits = "; ".join(gains["mimo"].provenance.details["limited_by"]) or "nothing"
    task = TuningSpec()
    cases = gain_cases([logged], [(LABELS[method], gains[method]) for method in ("siso", "mimo")], task)
    sections = [
        Section(
            "Experiment",
            f"PRBS torque on roll, then on pitch (amplitude {AMPLITUDE:g}, bandwidth {BANDWIDTH:g} rad/s), then on yaw "
            f"({np.abs(experiment.scenario.excitation[:, 2]).max():g}, half the bandwidth), under the flown gains.",
            charts=experiment_charts("experiment", experiment),
        ),
        replace(gains_section(cases), text=f"MIMO is limited by: {limits}."),
        prediction_section(cases),
        stability_section(cases, task.certificate),
        Section(
            "Doublets flown",
            f"{DOUBLET_DEG:g} degrees, {DOUBLET_S:g} s. J in rad^2 and rad^2/s^2, over the doublet; J_M,o against the "
            "attitude model above, for all sets. The flight over MAVLink (roll, MIMO) gave the same torques bit for "
            "bit.",
            tables=[ReportTable(FLOWN_CAPTION, FIGURE_COLUMNS, _figure_rows(figures))],
            charts=doublets,
        ),
    ]
    write_report(path, "mimopilot demo", lead, sections, _headline(figures))
    return [table for section in sections for table in section.tables]


def _headline(figures: dict[str, dict[str, Performance]]) -> Headline:
    """What the page shows, and what to do next."""
    moved = {method: found.offaxis_peak_deg for method, found in figures["roll"].items()}
    sentence = (
        f"A doublet on roll moves pitch by {moved['mimo']:.2f} degrees with full gain matrices (MIMO), by "
        f"{moved['siso']:.2f} degrees with the same design axis by axis (SISO), and by {moved['default']:.2f} degrees "
        "with the gains that flew."
    )
    steps = (
        "More of this flight: mimopilot report flight.ulg --gains mimo.gains.toml --out flight.html",
        "Your own log: mimopilot inspect LOG, then mimopilot tune LOG --out my.gains.toml --report tuned.html",
    )
    return Headline(sentence, steps, "good" if moved["mimo"] == min(moved.values()) else "doubt")


def print_summary(summary: DemoSummary) -> None:
    """Print the tables and the paths of all files."""
    for table in summary.tables:
        print_table(table.caption, table.columns, table.rows)
    print_text(
        f"over MAVLink (roll, MIMO): {summary.mavlink_samples} torques, 0 differ from the flight in process; "
        f"{summary.mavlink_speed:.0f} times real time"
    )
    print_text(f"log     {summary.log}")
    for method, path in summary.paths.items():
        print_text(f"gains   {path}  ({method})")
    print_text(f"report  {summary.report}")
    print_text(f"{summary.seconds:.1f} s")
