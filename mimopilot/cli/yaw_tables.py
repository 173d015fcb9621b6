"""What the tuning commands print of yaw: its gains, predicted figures, margins, and what couples it with the others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from mimopilot.common.console import print_table, print_text
from mimopilot.common.text_table import with_deviation

if TYPE_CHECKING:
    from mimopilot.tuning.gains import Gains

#: Columns of the table of predicted figures.
PREDICTED_YAW = ("", "tracking [deg]", "disturbance [deg]", "torque noise", "Ms")


def yaw_mapping(gains: Gains) -> dict[str, Any]:
    """Yaw of a tuned set as JSON values: gains, standard deviations, origin, predicted figures, certificate."""
    origin, certificate = gains.provenance, gains.certificate
    found = {**asdict(gains.yaw), "standard_deviation": origin.standard_deviation.get("yaw", {})}
    found |= origin.details.get("yaw", {})
    if certificate is not None and "yaw" in certificate.figures:
        found["certificate"] = certificate.figures["yaw"]
        found |= {name: found["certificate"][name] for name in ("Ms", "band") if name in found["certificate"]}
    return found


def yaw_cell(gains: Gains, name: str, deviations: Mapping[str, Any]) -> str:
    """A yaw gain with its standard deviation where it is known; empty if yaw has no gain of that name."""
    value, deviation = getattr(gains.yaw, name, None), deviations.get("yaw", {}).get(name)
    if value is None:
        return ""
    return with_deviation(value, deviation)


def print_yaw(gains: Gains) -> None:
    """Where the yaw gains come from: their predicted figures beside those of the flown ones, or why they are kept."""
    from mimopilot.tuning.design.prediction_rows import softer

    details = gains.provenance.details.get("yaw")
    if details is None:
        return
    if "attitude_model" in details:
        rows = [
            [f"{name}, {log}" if len(details["logs"]) > 1 else name, *_cells(figures)]
            for name in ("flown", "tuned")
            for log, figures in zip(details["logs"], details["predicted"].get(name, ()), strict=False)
        ]
        model, signals = details["attitude_model"]["omega"], ", ".join(dict.fromkeys(details["excited_by"]))
        title = f"Predicted, yaw (excited by {signals}). In doublets of 10 degrees, 1.2 to 6 s:\n"
        figures = f"RMS error to the model ({model:g} rad/s), angle after a torque step, and torque at hover"
        print_table(title + figures, PREDICTED_YAW, rows)
        if details.get("better_than_flown"):
            print_text("better than the yaw gains that flew")
            for trade_off in softer(details["predicted"]):
                print_text(trade_off)
    if "kept" in details:
        print_text(f"yaw: the gains are kept as they were: {details['kept']}")
    elif details["limited_by"]:
        print_text(f"yaw is limited by: {', '.join(details['limited_by'])}")


def _cells(figures: Mapping[str, float]) -> list[str]:
    return [
        f"{figures['follow_deg']:.2f}",
        f"{figures['disturbance_deg']:.2f}",
        f"{figures['noise']:.4f}",
        f"{figures['Ms']:.2f}",
    ]


def yaw_margins(figures: Mapping[str, Any]) -> Sequence[list[str]]:
    """Rows of the table of margins: yaw by itself."""
    yaw = figures.get("yaw", {})
    if "Ms" not in yaw:
        return []
    low, high = yaw["band"]
    kind, decibels = yaw["gain_margin"], f"{yaw['gain_margin_db']:.1f} dB"
    gain = {"exact": decibels, "at least": f"at least {decibels}"}.get(kind, "gain not known")
    return [
        [f"yaw alone, {low:.1f} to {high:.0f} rad/s", f"Ms {yaw['Ms']:.2f} +- {yaw['Ms_error']:.2f}"],
        [
            "yaw alone",
            f"{gain}, {yaw['phase_margin_deg']:.0f} +- {yaw['phase_margin_error_deg']:.0f} deg, "
            f"{yaw['delay_margin_ms']:.1f} ms",
        ],
    ]


def print_cross_terms(figures: Mapping[str, Any]) -> None:
    """What couples yaw with roll and pitch, and whether the certificate counts it; or why yaw is not examined."""
    yaw, cross = figures.get("yaw"), figures.get("cross_terms")
    if yaw is not None and "Ms" not in yaw:
        print_text(f"yaw is {yaw['verdict']}: {yaw['reason']}")
    if cross is None:
        return
    if "share" not in cross:
        print_text(f"cross terms of yaw: not known: {cross['reason']}")
        return
    size = (
        f"at most {cross['share']:.1%} +- {cross['share_error']:.1%} of a {cross['from']} torque's effect goes to "
        f"{cross['to']} (at {cross['omega']:.1f} rad/s)"
        if cross["measured"]
        else "none above its error"
    )
    counted = (
        f"they may change the loop by {cross['effect']:.0%}, error included, so the margins are those of all three axes"
        if cross["matters"]
        else f"they change the loop by less than {cross['limit']:.0%}, error included: yaw is a loop by itself"
    )
    print_text(f"cross terms of yaw: {size}; {counted}")
