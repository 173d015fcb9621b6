"""Report of an attitude study: tables and plots, beside the values printed in the thesis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from mimopilot.common.figures import Chart
from mimopilot.common.html_report import ReportTable, Section
from mimopilot.sitl.flight.figures import experiment_charts, manoeuvre_chart
from mimopilot.sitl.flight.scenario import AXES
from mimopilot.sitl.physics.airframe import load_airframe
from mimopilot.sitl.studies.attitude_figures import (
    COSTS,
    ELEMENTS,
    HIGH,
    LOOKS,
    LOW,
    MATRICES,
    SAME_MODEL,
    SAME_MODEL_LABEL,
    TUNED,
    costs_chart,
    experiment_motors_chart,
    gains_chart,
    motors_chart,
    tracking_chart,
)
from mimopilot.sitl.studies.attitude_run import AttitudeRun
from mimopilot.sitl.studies.attitude_statistics import StudyStatistics
from mimopilot.sitl.studies.attitude_study import (
    AUTOTUNE,
    BEST,
    DEFAULT,
    MIMO,
    MIMO_PRINTED,
    MIMO_THESIS,
    PRINTED_KEYS,
    SISO,
    SISO_OWN,
    SISO_PRINTED,
    SISO_THESIS,
    AttitudeStudy,
)
from mimopilot.sitl.studies.printed_figures import printed_figures, printed_table

COMPARABILITY = (
    "Only trends can be compared with the thesis' real flights: the inertias, motors and winds there are not known, "
    "and those of the simulation are class values."
)
METHODS = (
    f"{DEFAULT}: the gains that flew during the experiment. {AUTOTUNE}: one axis at a time by the rule of PX4's "
    f"autotune, from the same log. {SISO_THESIS} and {MIMO_THESIS}: VRFT for them. {SISO} and {MIMO}: what mimopilot "
    f"tune designs on the measured response without a model, axis by axis and with full matrices. {BEST}: the same "
    f"cost and constraints on the true plant, which no method knows, for the attitude model of {MIMO}. J is against "
    "the thesis' models (the designs are not made for them); the last column is J_M,o against the attitude model of "
    f"{MIMO}, which its design finds, for all methods alike. Effort: RMS of both torques together."
)
FITTED_METHODS = (
    f"The airframe is fitted to the printed gains. {DEFAULT}: the gains that flew during the experiment. {SISO_THESIS} "
    f"and {MIMO_THESIS}: VRFT for them. {SISO_PRINTED} and {MIMO_PRINTED}: the gains of the thesis, flown here. J is "
    "against the models that each was tuned for. Effort: RMS of both torques together."
)
SPREAD_COLUMNS = ("gain", *ELEMENTS)
COST_COLUMNS = ("doublet, method", *(text.partition(" [")[0].removesuffix(", RMS of u") for text in COSTS.values()))
CERTIFICATE_COLUMNS = ("method", "seeds: verdict", "Ms", "true Ms", "noise", "lost flights")


def run_charts(study: AttitudeStudy, found: AttitudeRun) -> list[Chart]:
    """The time histories of one run, in the order of the report: of the experiment, then of the doublets."""
    name = study.name
    inner, outer = study.models(MIMO, found.experiment.scenario.Ts)
    rotors = len(load_airframe(study.airframe).airframe.rotors)
    charts = [
        *experiment_charts(f"{name}-experiment", found.experiment),
        experiment_motors_chart(found.experiment, rotors, name),
    ]
    others = (DEFAULT, SISO_PRINTED, MIMO_PRINTED) if study.fitted else (DEFAULT, AUTOTUNE, MIMO, BEST)
    for key, methods in (("ours", TUNED), ("others", others)):
        for axis, moved in enumerate(AXES):
            flights = {m: found.flights[m][axis] for m in methods if m in found.flights}
            charts.append(manoeuvre_chart(f"{name}-{key}-{moved}", flights, LOOKS, inner, outer))
    return [*charts, tracking_chart(found, study), motors_chart(found, rotors, name)]


def study_sections(found: StudyStatistics, shown: Sequence[Chart]) -> list[Section]:
    """The report sections of a study; `shown` are those of `run_charts`."""
    study, name = found.study, found.study.name
    inner, outer = study.models(MIMO, load_airframe(study.airframe).default_gains().Ts)
    _, axis, costs = study.costs_table
    flown = [chart for chart in shown if chart.name.startswith(f"{name}-experiment")]
    limited = f", setpoint limited to {study.rate_limit_deg_s:g} degrees/s" if study.rate_limit_deg_s else ""
    return [
        Section(
            f"{name}: experiment",
            _lead(study, inner.label, outer.label),
            charts=flown,
        ),
        Section(
            f"{name}: gains",
            f"Medians, in brackets {LOW} to {HIGH} % of {len(found.runs)} experiments with different noise and PRBS. "
            "Kp_o in 1/s, Kp_i in s, Ki_i without unit, Kd_i in s^2.",
            [gains_table(found), *([printed_table(found)] if study.fitted else [])],
            charts=[gains_chart(found, study.gains_table[1], study.gains_table[0])],
        ),
        Section(
            f"{name}: doublets",
            f"Doublet of {study.amplitude_deg:g} degrees, {study.period_s:g} s{limited}; J over the doublet. "
            f"{FITTED_METHODS if study.fitted else METHODS} "
            f"{COMPARABILITY if costs else ''}",
            [costs_table(found), certificates_table(found)],
            charts=[costs_chart(found, study.methods(), costs, axis), *shown[len(flown) :]],
        ),
    ]


def _lead(study: AttitudeStudy, inner: str, outer: str) -> str:
    seconds, amplitude, bandwidth = study.excitation
    text = (
        f"{load_airframe(study.airframe).airframe.description}. PRBS of amplitude {amplitude:g} and {bandwidth:g} "
        f"rad/s for {seconds:g} s on each axis under the default gains. The thesis' models (rad/s, damping, delay in "
        f"samples): rate loop {inner}; attitude loop {outer}."
    )
    (omega, zeta, delay), (omega_o, zeta_o, delay_o) = study.siso_models
    if study.siso_models != (study.inner, study.outer):
        text += f" {SISO_THESIS}: {omega:g}, {zeta:g}, {delay}; {omega_o:g}, {zeta_o:g}, {delay_o}."
    if study.siso_airframe != study.airframe:
        text += f" {SISO_THESIS}: tuned on the log of {study.siso_airframe}, as in the thesis."
        if SISO_OWN in study.methods():
            text += f" {SISO_OWN} is tuned on this vehicle's own log."
    return text


def gains_table(found: StudyStatistics) -> ReportTable:
    """Median and spread of the gains of every method, beside the thesis' values."""
    number, printed = found.study.gains_table
    rows = []
    for matrix in MATRICES:
        for method in found.study.methods():
            values = found.gains(method, matrix).reshape(-1, 4)
            low, middle, high = np.percentile(values, [LOW, 50, HIGH], axis=0)
            cells = [
                _plain(f"{m:.4f}") + (f" ({_plain(f'{a:.4f}')} to {_plain(f'{b:.4f}')})" if b - a > 1e-9 else "")
                for a, m, b in zip(low, middle, high, strict=True)
            ]
            rows.append([f"{matrix}  {method}", *cells])
            if (key := PRINTED_KEYS.get(method, "")) in printed:
                rows.append([f"{matrix}  {key}, {number}", *(f"{v:.4f}" for v in np.ravel(printed[key][matrix]))])
    return ReportTable(f"{found.study.name}: gains, output <- error", SPREAD_COLUMNS, rows)


def costs_table(found: StudyStatistics) -> ReportTable:
    """Medians of every figure by axis and method, beside the thesis' real flights."""
    number, axis_printed, printed = found.study.costs_table
    last = [] if found.study.fitted else [SAME_MODEL]
    rows = []
    for axis in AXES:
        for method in found.study.methods():
            medians = [_figure(name, found.median(method, axis, name)) for name in (*COSTS, *last)]
            rows.append([f"{axis}, {method}", *medians])
            if axis == axis_printed and (key := PRINTED_KEYS.get(method, "")) in printed:
                flown = [_figure(name, printed[key][name]) if name in printed[key] else "" for name in COSTS]
                rows.append([f"{axis}, {key}, {number} (real flight)", *flown, *("" for _ in last)])
    caption = f"{found.study.name}: medians of {len(found.runs)} seeds; J in rad^2 and rad^2/s^2, peak in deg"
    return ReportTable(caption, (*COST_COLUMNS, *(SAME_MODEL_LABEL for _ in last)), rows)


def certificates_table(found: StudyStatistics) -> ReportTable:
    """Certificates of every method, from this vehicle's own log."""
    rows = []
    for method in found.study.methods():
        verdicts = ", ".join(f"{count}: {verdict}" for verdict, count in found.verdicts(method).items())
        peaks = [run[method]["Ms"] for run in found.runs if run[method]["Ms"] is not None]
        lost = sum(np.isinf(found.values(method, axis, "effort_rms")).sum() for axis in AXES)
        true = (f"{found.true_median(method, name):.2f}" for name in ("true_Ms", "noise"))
        rows.append([method, verdicts, f"{np.median(peaks):.2f}" if peaks else "", *true, str(lost)])
    return ReportTable(
        f"{found.study.name}: certificates; medians of Ms, of the true Ms, and of the torque's noise over the flown",
        CERTIFICATE_COLUMNS,
        rows,
    )


def study_figures(found: StudyStatistics) -> dict[str, Any]:
    """The study's part of the object that ``--json`` prints."""
    study = found.study

    def spread(values: Any) -> dict[str, Any]:
        low, middle, high = np.percentile(values, [LOW, 50, HIGH], axis=0)
        return {"median": middle.tolist(), f"p{LOW}": low.tolist(), f"p{HIGH}": high.tolist()}

    figures = [*COSTS, *([] if study.fitted else [SAME_MODEL])]
    return {
        "seeds": len(found.runs),
        "methods": {
            method: {
                "verdicts": found.verdicts(method),
                "gains": {matrix: spread(found.gains(method, matrix)) for matrix in MATRICES},
                **{name: found.true_median(method, name) for name in ("true_Ms", "noise")},
                **{axis: {name: spread(found.values(method, axis, name)) for name in figures} for axis in AXES},
            }
            for method in study.methods()
        },
        "printed": _printed(study),
        **(
            {"comparison": [asdict(one) | {"sign": one.sign, "near": one.near} for one in printed_figures(found)]}
            if study.fitted
            else {}
        ),
    }


def _printed(study: AttitudeStudy) -> Mapping[str, Any]:
    number, axis, costs = study.costs_table
    found: dict[str, Any] = {}
    if study.gains_table[1]:
        found[study.gains_table[0]] = study.gains_table[1]
    if costs:
        found[f"{number}, {axis}"] = costs
    return found


def _figure(name: str, value: float) -> str:
    return f"{value:.2f}" if name == "offaxis_peak_deg" else f"{value:.3g}"


def _plain(text: str) -> str:
    """The number without a minus sign before zero."""
    return text.removeprefix("-") if not text.strip("-0.") else text
