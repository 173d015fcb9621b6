"""The studies of chapter 6 of the thesis: vehicle, experiment, reference models and doublets of each."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mimopilot.sitl.flight.scenario import AXES, Scenario, doublet, limit_rate
from mimopilot.sitl.studies.benchmarks import TABLES
from mimopilot.tuning.reference_model import ReferenceModel, second_order

#: The gains that flew, and those of the rule of PX4's autotune.
DEFAULT, AUTOTUNE = "default", "autotune"
#: VRFT for the thesis' reference models; SISO also on the vehicle's own log where the thesis took another one.
SISO_THESIS, MIMO_THESIS, SISO_OWN = "SISO, thesis' models", "MIMO, thesis' models", "SISO, thesis' models, own log"
#: Designed on the measured response, axis by axis and with full matrices, and the same on the true plant.
SISO, MIMO, BEST = "SISO", "MIMO", "best on the true plant"
#: The thesis' printed gains, flown here.
SISO_PRINTED, MIMO_PRINTED = "SISO as printed", "MIMO as printed"
#: Method -> its key in the thesis' tables.
PRINTED_KEYS = {SISO_THESIS: "SISO", MIMO_THESIS: "MIMO"}
#: s of hover before a doublet; with a mass at one motor the integrators need longer to trim.
LEAD_S, TRIM_S = 1.0, 6.0

#: Bandwidth (rad/s), damping, delay (samples).
Model = tuple[float, float, int]


@dataclass(frozen=True)
class AttitudeStudy:
    """One vehicle, its experiment, reference models and doublets.

    Attributes
    ----------
    name, title : str
    airframe : str
    inner, outer : (rad/s, damping, delay in samples)
        The thesis' reference models of the rate and the attitude loop.
    siso_models : (inner, outer)
        The same for SISO.
    siso_airframe : str
        Vehicle on whose log SISO is tuned.
    amplitude_deg, period_s : float
        Amplitude (deg) and length (s) of the doublet.
    lead_s : float
        Hover before the doublet, s.
    excitation : (float, float, float)
        PRBS of the experiment: duration per axis (s), amplitude (normalised torque), bandwidth (rad/s).
    gains_table : (str, mapping)
        Name of the thesis' table of gains, and its values.
    costs_table : (str, axis, mapping)
        The same for the costs J.
    offaxis : float or None
        Largest off-axis peak of MIMO over SISO's, both by design; None: the axes are not coupled.
    fitted : bool
        The airframe is fitted to the printed gains. It flies the thesis' methods, tuned in the thesis' way, and the
        printed gains themselves; there are no expectations of ours.
    options : dict
        Entries of the tuning specification with which the airframe was fitted.
    rate_limit_deg_s : float or None
        Largest rate of the setpoint in the doublet, deg/s.
    """

    name: str
    title: str
    airframe: str
    inner: Model
    outer: Model
    siso_models: tuple[Model, Model]
    siso_airframe: str
    amplitude_deg: float
    period_s: float
    lead_s: float
    excitation: tuple[float, float, float]
    gains_table: tuple[str, dict[str, Any]]
    costs_table: tuple[str, str, dict[str, Any]]
    offaxis: float | None
    fitted: bool = False
    options: dict[str, Any] = field(default_factory=dict)
    rate_limit_deg_s: float | None = None

    def models(self, method: str, Ts: float) -> tuple[ReferenceModel, ReferenceModel]:
        """The thesis' reference models of rate and attitude loop for the costs of a method: MIMO's, or SISO's own."""
        own = method in (SISO_THESIS, SISO_OWN, SISO_PRINTED)
        inner, outer = self.siso_models if own else (self.inner, self.outer)
        return second_order(*inner, Ts), second_order(*outer, Ts)

    def doublets(self, Ts: float, **lengths: float) -> list[Scenario]:
        """The roll and the pitch doublet; `lengths` are passed to `doublet`."""
        height = float(np.radians(self.amplitude_deg))
        tasks = [doublet(axis, height, self.period_s, Ts, **({"lead": self.lead_s} | lengths)) for axis in AXES]
        if self.rate_limit_deg_s is None:
            return tasks
        return [limit_rate(task, float(np.radians(self.rate_limit_deg_s))) for task in tasks]

    def methods(self) -> list[str]:
        """Names of all methods, in the order of the tables."""
        if self.fitted:
            return [DEFAULT, SISO_THESIS, SISO_PRINTED, MIMO_THESIS, MIMO_PRINTED]
        own = [SISO_OWN] if self.siso_airframe != self.airframe else []
        return [DEFAULT, AUTOTUNE, SISO_THESIS, *own, MIMO_THESIS, SISO, MIMO, BEST]


def studies() -> dict[str, AttitudeStudy]:
    """The studies by name. All are from the thesis' tables but adam0-small and coupled.

    Those of the thesis are flown twice: on our class values, and on airframes that are fitted to the printed gains.
    """
    printed = json.loads(TABLES.read_text())

    def model(entry: dict[str, Any]) -> Model:
        return float(entry["omega"]), float(entry["zeta"]), int(entry["delay"])

    def made(
        name: str, title: str, airframe: str, key: str, gains: str, costs: str, offaxis: float | None, **changes: Any
    ) -> AttitudeStudy:
        part = printed[key]
        models = part.get("reference_models", {"MIMO": part, "SISO": part})
        inner, outer = (model(models["MIMO"][loop]) for loop in ("inner", "outer"))
        siso_inner, siso_outer = (model(models["SISO"][loop]) for loop in ("inner", "outer"))
        prbs = part.get("prbs", printed["adam0_simulation"]["prbs"])
        task = part["doublet"]
        number, _, axis = costs.partition(" ")
        entry = {
            "name": name,
            "title": title,
            "airframe": airframe,
            "inner": inner,
            "outer": outer,
            "siso_models": (siso_inner, siso_outer),
            "siso_airframe": airframe,
            "amplitude_deg": float(task["amplitude_deg"]),
            "period_s": task["period_s"],
            "lead_s": LEAD_S,
            "excitation": (float(prbs["seconds_per_axis"]), float(prbs["amplitude"]), float(prbs["bandwidth_rad_s"])),
            "gains_table": (f"Table {gains}", part[f"table_{gains.replace('.', '_')}"] if gains else {}),
            "costs_table": (
                f"Table {number}",
                axis,
                part[f"table_{number.replace('.', '_')}_{axis}"] if costs else {},
            ),
            "offaxis": offaxis,
        }
        return AttitudeStudy(**(entry | changes))

    simulation = made("adam0-sim", "ADAM-0, 10 % coupling", "adam0", "adam0_simulation", "5.4", "", 1 / 3)
    nominal = made("adam0", "ADAM-0, nominal", "adam0_nominal", "adam0_flight_nominal", "6.2", "6.3 roll", None)
    perturbed = made(
        "adam0-perturbed",
        "ADAM-0, 160 g at motor 3",
        "adam0_perturbed",
        "adam0_flight_perturbed",
        "6.4",
        "6.5 pitch",
        1 / 3,
        siso_airframe="adam0_nominal",
        lead_s=TRIM_S,
    )
    # The thesis does not print the length of ANT-R's doublet.
    racer = made("antr", "ANT-R", "antr", "antr_flight", "6.7", "6.8 roll", None, period_s=0.4)
    small = replace(
        simulation,
        name="adam0-small",
        title="ADAM-0, 10 % coupling, small doublet",
        amplitude_deg=8.0,  # no motor saturates: the vehicle is linear
        gains_table=("", {}),
    )
    coupled = replace(
        simulation,
        name="coupled",
        title="ADAM-0 with a boom, 40 % coupling",
        airframe="adam0_boom",
        siso_airframe="adam0_boom",
        amplitude_deg=15.0,  # at 22.5 the motors saturate
        gains_table=("", {}),
        offaxis=1 / 5,
    )
    own: dict[str, Any] = {"instrument": "u", "weight": "identity"}  # the thesis' own estimator
    # Name, study, airframe, airframe of SISO's log, options, rate limit of the setpoint. The thesis' flights had a rate
    # limiter and it does not print the rate: it is chosen so that the printed gains of MIMO give the printed J_r,o
    # (0.161 and 0.016 rad^2). Without one J_r,o would be 0.71, more than without any response, and 0.067. 220 deg/s is
    # also PX4's default MC_ROLLRATE_MAX. ANT-R's printed J_r,o needs none.
    fits: tuple[tuple[str, AttitudeStudy, str, str, dict[str, Any], float | None], ...] = (
        ("adam0-sim-thesis", simulation, "adam0_thesis", "adam0_thesis", {}, None),
        ("adam0-thesis", nominal, "adam0_thesis_flown", "adam0_thesis_flown", own, 220.0),
        ("adam0-perturbed-thesis", perturbed, "adam0_thesis_perturbed", "adam0_thesis_flown", own, 50.0),
        ("antr-thesis", racer, "antr_thesis", "antr_thesis", own, None),
    )
    fitted = [
        replace(
            study,
            name=name,
            title=f"{study.title}, fitted to {study.gains_table[0]}",
            airframe=airframe,
            siso_airframe=siso,
            fitted=True,
            options=options,
            rate_limit_deg_s=rate,
        )
        for name, study, airframe, siso, options, rate in fits
    ]
    every = (simulation, nominal, perturbed, racer, small, coupled, *fitted)
    return {study.name: study for study in every}
