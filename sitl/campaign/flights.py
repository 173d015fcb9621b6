"""The flights of a campaign, chunk by chunk: the work of every worker process, on any machine."""

from __future__ import annotations

import io
from collections.abc import Iterator
from functools import lru_cache
from threading import Lock
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from mimopilot.codegen.render import generator_version
from mimopilot.common.files import seal
from mimopilot.sitl.autopilot.autopilot import RECORD, Autopilot
from mimopilot.sitl.campaign.draws import Draw, RunSampler
from mimopilot.sitl.campaign.plan import CampaignPlan, plan_from_files
from mimopilot.sitl.errors import SitlError
from mimopilot.sitl.faults.inject_plant import FaultInjection
from mimopilot.sitl.flight.metrics import performance
from mimopilot.sitl.flight.simulator import TRUTH, Flight, Simulator, first_loss

CHUNK = 64  # runs per chunk: at most these are lost when a worker dies
_runner_lock = Lock()


class FlightRunner:
    """Flies the runs of a campaign one after the other; reuses its buffers for every flight.

    Parameters
    ----------
    plan : CampaignPlan
        The campaign.
    """

    def __init__(self, plan: CampaignPlan) -> None:
        self.plan = plan
        first = next(iter(plan.gains.values()))
        self.autopilots = {name: Autopilot(plan.airframe, gains) for name, gains in plan.gains.items()}
        self.models = {
            (name, scenario.axis): gains.reference_models(scenario.axis)
            for name, gains in plan.gains.items()
            for scenario in plan.scenarios
        }
        self.simulator = Simulator(plan.airframe, first.Ts, 0)
        samples = len(plan.scenarios[0].setpoint)
        self.noise = np.empty((samples, self.simulator.noise(1).shape[1]))
        self.truth = np.zeros(samples, TRUTH)
        self.record = np.zeros(samples, RECORD)
        self.runs = np.ones(samples, np.int64)
        self.sampler = RunSampler(plan.airframe, plan.description.vary, plan.scenarios[0])

    def draw(self, run: int) -> Draw:
        """Draw a run and its noise, which is the same for all flights of the run."""
        seed = self.plan.description.seed
        np.random.default_rng([seed, run, 1]).standard_normal(out=self.noise)
        return self.sampler.draw(seed, run)

    def fly(self, draw: Draw, gains: str, index: int) -> Flight:
        """Fly scenario `index` with the run that was drawn last; the next flight overwrites the result."""
        simulator, autopilot, record = self.simulator, self.autopilots[gains], self.record
        scenario = self.plan.scenarios[index]
        simulator.plant, simulator.delay = draw.plant, draw.delay
        simulator.sensors = simulator.sensors._replace(
            angle_deviation=draw.angle_deviation, rate_deviation=draw.rate_deviation
        )
        simulator.restart(draw.state.copy())
        autopilot.restart()
        seed = [self.plan.description.seed, draw.run, 1]
        injection = FaultInjection(draw.faults, self.plan.airframe, simulator, scenario.Ts, seed, autopilot=autopilot)
        record["setpoint"] = injection.setpoints(draw.factor * scenario.setpoint)
        self.runs[:] = 1
        for piece, runs, delays in injection.segments(0, len(record)):
            simulator.fly(autopilot, self.noise[piece], record[piece], self.truth[piece], runs, delays)
            if runs is not None:
                self.runs[piece] = runs
        return Flight(scenario, record, self.truth, self.runs)

    def flights(self, run: int) -> Iterator[tuple[dict[str, Any], Flight]]:
        """Fly a run with every gain set on every axis; yields each flight with its row of the results."""
        draw = self.draw(run)
        for name in self.plan.gains:
            for index, axis in enumerate(self.plan.description.axes):
                flight = self.fly(draw, name, index)
                yield self.row(run, draw, name, axis, flight), flight

    def row(self, run: int, draw: Draw, name: str, axis: str, flight: Flight) -> dict[str, Any]:
        """The row of a flight in the results."""
        lost = first_loss(flight.truth, flight.record, flight.scenario.Ts)
        figures = performance(flight, *self.models[name, flight.scenario.axis])
        return {
            "run": run,
            "gains": name,
            "axis": axis,
            "survived": lost < 0,
            "lost_at_s": lost * flight.scenario.Ts if lost >= 0 else np.nan,
            **vars(figures),
            "rejected_draws": draw.rejected,
            **draw.values,
        }


def chunk_count(plan: CampaignPlan) -> int:
    """Number of chunk_count of a campaign."""
    return -(-plan.description.runs // CHUNK)


def runs_of(plan: CampaignPlan, chunk: int) -> range:
    """The runs of a chunk."""
    return range(chunk * CHUNK, min((chunk + 1) * CHUNK, plan.description.runs))


def label(plan: CampaignPlan, chunk: int) -> str:
    """Label of a part file: digest of the campaign, and its runs."""
    runs = runs_of(plan, chunk)
    return f"{plan.digest} runs {runs[0]} to {runs[-1]}"


def fly_chunk(files: dict[str, str], chunk: int) -> bytes:
    """Fly the runs of a chunk.

    Parameters
    ----------
    files : dict
        Files of the `CampaignPlan`.
    chunk : int
        Number of the chunk, from 0.

    Returns
    -------
    bytes
        A Parquet file with one row per flight, ordered by run, gain set and axis; sealed with `label`.

    Raises
    ------
    SitlError
        When this worker has another version of mimopilot than the campaign.
    """
    with _runner_lock:  # a cluster worker may have several threads, but there is one runner
        runner = flight_runner(tuple(files.items()))
        version = runner.plan.description.mimopilot
        if version != generator_version():
            raise SitlError(
                f"a worker has mimopilot {generator_version()}, the campaign has {version}; install the same version"
            )
        rows = [row for run in runs_of(runner.plan, chunk) for row, _ in runner.flights(run)]
    stream = io.BytesIO()
    pq.write_table(pa.Table.from_pylist(rows, schema(rows[0])), stream)
    return seal(stream.getvalue(), label(runner.plan, chunk))


def schema(row: dict[str, Any]) -> pa.Schema:
    """Types of the results' columns."""
    types = {int: pa.int64(), bool: pa.bool_(), str: pa.dictionary(pa.int32(), pa.string())}
    return pa.schema([(name, types.get(type(value), pa.float64())) for name, value in row.items()])


@lru_cache(maxsize=1)
def flight_runner(files: tuple[tuple[str, str], ...]) -> FlightRunner:
    """The runner of a plan's files; cached for the next chunk."""
    return FlightRunner(plan_from_files(dict(files)))
