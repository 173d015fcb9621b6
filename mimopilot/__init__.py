"""From one flight log to tuned, tested C++ for a multirotor's attitude controller.

Examples
--------
>>> import mimopilot as mp
>>> log = mp.experiment("adam0", seed=1)  # or mp.read_log("flight.ulg")
>>> gains = mp.tune(log, inner=(30, 0.7, 0), outer=(10, 0.7, 0))
>>> str(gains.verdict()[0])
'certified'
>>> flight = mp.fly("adam0", gains, axis="roll")
>>> flight.crashed_at is None
True
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

#: Public name -> where it is defined. It is imported when it is first asked for: numpy, scipy and numba take a second.
_PUBLIC = {
    "read_log": "mimopilot.api.tuning",
    "inspect": "mimopilot.api.tuning",
    "tune": "mimopilot.api.tuning",
    "certify": "mimopilot.api.tuning",
    "advise": "mimopilot.api.tuning",
    "load_gains": "mimopilot.api.tuning",
    "import_params": "mimopilot.api.vehicle",
    "generate": "mimopilot.api.codegen",
    "load_airframe": "mimopilot.api.bench",
    "fly": "mimopilot.api.bench",
    "performance": "mimopilot.api.bench",
    "report": "mimopilot.api.report",
    "experiment": "mimopilot.api.bench",
    "upload": "mimopilot.api.vehicle",
    "autotune": "mimopilot.api.vehicle",
    "list_logs": "mimopilot.api.vehicle",
    "download_log": "mimopilot.api.vehicle",
    "plot_flight": "mimopilot.plots",
    "plot_bode": "mimopilot.plots",
    "Error": "mimopilot.common.errors",
    "Gains": "mimopilot.tuning.gains",
    "Experiment": "mimopilot.tuning.experiment",
    "Certificate": "mimopilot.tuning.certificate",
    "Verdict": "mimopilot.tuning.certificate",
    "Airframe": "mimopilot.sitl.physics.airframe",
    "Flight": "mimopilot.sitl.flight.simulator",
}

if TYPE_CHECKING:
    from mimopilot.api.bench import experiment as experiment
    from mimopilot.api.bench import fly as fly
    from mimopilot.api.bench import load_airframe as load_airframe
    from mimopilot.api.bench import performance as performance
    from mimopilot.api.codegen import generate as generate
    from mimopilot.api.report import report as report
    from mimopilot.api.tuning import advise as advise
    from mimopilot.api.tuning import certify as certify
    from mimopilot.api.tuning import inspect as inspect
    from mimopilot.api.tuning import load_gains as load_gains
    from mimopilot.api.tuning import read_log as read_log
    from mimopilot.api.tuning import tune as tune
    from mimopilot.api.vehicle import autotune as autotune
    from mimopilot.api.vehicle import download_log as download_log
    from mimopilot.api.vehicle import import_params as import_params
    from mimopilot.api.vehicle import list_logs as list_logs
    from mimopilot.api.vehicle import upload as upload
    from mimopilot.common.errors import Error as Error
    from mimopilot.plots import plot_bode as plot_bode
    from mimopilot.plots import plot_flight as plot_flight
    from mimopilot.sitl.flight.simulator import Flight as Flight
    from mimopilot.sitl.physics.airframe import Airframe as Airframe
    from mimopilot.tuning.certificate import Certificate as Certificate
    from mimopilot.tuning.certificate import Verdict as Verdict
    from mimopilot.tuning.experiment import Experiment as Experiment
    from mimopilot.tuning.gains import Gains as Gains

__all__ = sorted(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("mimopilot")
    if name not in _PUBLIC:
        raise AttributeError(f"module 'mimopilot' has no attribute {name!r}; public names: {', '.join(__all__)}")
    return getattr(import_module(_PUBLIC[name]), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
