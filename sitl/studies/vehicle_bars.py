"""What the runs of `mimopilot reproduce vehicles` must reach: the bars, and the runs that miss them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mimopilot.common.html_report import ReportTable
from mimopilot.tuning.certificate import Verdict
from mimopilot.tuning.design.prediction import DECOUPLED, ROUNDING
from mimopilot.tuning.spec import DesignLimits

#: Share of the runs that are refused with a true reason or better than the flown gains.
GOOD_SHARE = 0.95
#: The optimum beats the flown gains when it follows with at most this share of their RMS error.
BEATS = 0.9
#: Largest share refused of the vehicles that can be improved: all, and those with gusts up to a share of the full
#: torque and an experiment of so many s or more.
REFUSED_OF_ALL, REFUSED_OF_CALM, CALM, LONG = 0.40, 0.15, 0.02, 30.0
#: Certified Ms over the true one: within this in this share of the certified sets.
MS_WITHIN, MS_SHARE = 0.10, 0.95
#: Relative difference of the frequency that a refusal names to that of the frame mode.
MODE_WITHIN = 0.10
#: What stands in a refusal because of a frame mode; what a refusal's reason ends with.
MODE, LIMITS = "mode of the frame", "; the design is limited by"
#: Beginning of each reason to keep the flown gains -> name of its kind.
KEEP = {
    "it follows": "follows no better",
    "it moves the other axis": "moves the other axis more",
    "its margin is thinner": "thinner margin",
    "it drives the motors": "more noise",
}
#: Text in a refusal -> name of its kind; the first that fits.
REFUSALS = {
    MODE: "frame mode",
    "fewer than": "excitation reaches too few frequencies",
    "not excited": "not excited",
    "excitation begins": "excitation begins too high",
    "excitation ends": "excitation ends too low",
    "too close to instability": "error too large for stability",
    "the phase margin of": "phase margin and its error",
    "is above": "Ms and its error",
    "saturated": "saturated",
    "encircles": "unstable",
    "not positive in every direction": "integral not positive",
}

#: Outcomes of a run, see `sitl.studies.vehicle_run.run_vehicle`.
OUTCOMES = ("certified", "keep", "refused")

Run = Mapping[str, Any]


@dataclass(frozen=True)
class Bar:
    """One requirement on the runs.

    Attributes
    ----------
    name : str
    share : float
        Found share.
    target : float
    most : bool
        Whether the target is the largest share, else the smallest.
    count, of : int
        Runs behind the share.
    failed : tuple of (int, str)
        Seed of each run that misses it, and how.
    """

    name: str
    share: float
    target: float
    most: bool
    count: int
    of: int
    failed: tuple[tuple[int, str], ...]

    @property
    def met(self) -> bool:
        """Whether the runs reach it."""
        return self.share <= self.target if self.most else self.share >= self.target


def kinds(run: Run) -> list[str]:
    """Kinds of the reasons of a run that was not certified as better."""
    if run["outcome"] == "refused":
        text = run["reasons"][0].partition(LIMITS)[0]
        return [next((name for part, name in REFUSALS.items() if part in text), "other")]
    return [_keep_kind(reason) for reason in run["reasons"]]


def _keep_kind(reason: str) -> str:
    return next((name for begin, name in KEEP.items() if reason.startswith(begin)), "other")


def can_improve(run: Run) -> bool:
    """Whether the best gains on the true plant are better than the flown ones by 10 % of the following error."""
    best = run["optimum"]
    return bool(best["feasible"] and best["follow_ratio"] <= BEATS and not best["reasons_to_keep"])


def false_reason(run: Run) -> str:
    """Why no stated reason of a run that was not certified as better is true; empty when one is.

    A reason to keep the flown gains is true when it holds on the true plant, too. A frame mode is true when the vehicle
    has one at that frequency. The others are about the log, not the vehicle: they count as true.
    """
    if run["outcome"] == "refused":
        text = run["reasons"][0].partition(LIMITS)[0]
        return _wrong_mode(run, text) if MODE in text else ""
    true = {_keep_kind(reason) for reason in run["tuned"]["true_reasons"]}
    return "" if true & set(kinds(run)) else f"on the true plant not so: {'; '.join(run['reasons'])}"


def _named_hz(text: str) -> list[float]:
    return [float(value) for value in re.findall(r"([0-9.]+) Hz", text)]


def _wrong_mode(run: Run, text: str) -> str:
    """Why a refusal because of a frame mode is wrong about its frequency; empty when it is right."""
    frame, named = run["vehicle"]["frame"], _named_hz(text)
    if frame is None:
        return "names a frame mode, and the vehicle has none"
    if "notch" not in text or not named:
        return "names no notch, or no frequency"
    true = frame["frequency_hz"]
    right = any(abs(hz / true - 1) <= MODE_WITHIN for hz in named)
    return "" if right else f"names {', '.join(f'{hz:g}' for hz in named)} Hz, the mode is at {true:.1f} Hz"


def is_limited_by_mode(run: Run) -> bool:
    """Whether a run that was not certified as better is so because of a frame mode, by its own words."""
    words = [*run["reasons"], *(run["tuned"]["limited_by"] if run["tuned"] else [])]
    return run["outcome"] != "certified" and any(MODE in text for text in words)


def shortfalls(run: Run) -> list[str]:
    """What a certified set lacks on the true vehicle; empty: it is better than the flown gains."""
    tuned, limits = run["tuned"], DesignLimits()
    ours, before = tuned["flights"]["tuned"], tuned["flights"]["flown"]
    found = []
    if not ours["follow_deg"] < before["follow_deg"]:
        found.append(f"follows worse: {ours['follow_deg']:.3f} deg, flown {before['follow_deg']:.3f}")
    if not ours["offaxis_deg"] <= max(before["offaxis_deg"], DECOUPLED):
        found.append(f"moves the other axis more: {ours['offaxis_deg']:.3f} deg, flown {before['offaxis_deg']:.3f}")
    allowed = max(limits.Ms, run["vehicle"]["flown_Ms"])
    if tuned["Ms"] > allowed * (1 + ROUNDING):
        found.append(f"Ms {tuned['Ms']:.3f}, allowed {allowed:.3f} (certified {tuned['certified_Ms']:.3f})")
    if tuned["noise_ratio"] > limits.noise * (1 + ROUNDING):
        found.append(f"hover noise {tuned['noise_ratio']:.2f} of the flown")
    return found


def bars(runs: Sequence[Run]) -> list[Bar]:
    """The bars of the study, over runs of `sitl.studies.vehicle_run.run_vehicle`."""

    def share(
        name: str, target: float, most: bool, among: Sequence[Run], missed: Callable[[Run], str], of: int = 0
    ) -> Bar:
        failed = tuple((int(run["seed"]), how) for run in among if (how := missed(run)))
        total = of or len(among)
        count = len(failed) if most else total - len(failed)
        return Bar(name, count / total if total else 0.0 if most else 1.0, target, most, count, total, failed)

    certified = [run for run in runs if run["outcome"] == "certified"]
    signed = [run for run in runs if run["tuned"] and run["tuned"]["verdict"] == Verdict.CERTIFIED]
    improvable = [run for run in runs if can_improve(run)]
    calm = [run for run in improvable if run["vehicle"]["gusts"] <= CALM and run["experiment"]["seconds"] >= LONG]

    def refused(run: Run) -> str:
        return "; ".join(kinds(run)) if run["outcome"] != "certified" else ""

    def wrong(run: Run) -> str:
        return "; ".join(shortfalls(run)) if run["outcome"] == "certified" else false_reason(run)

    def notch(run: Run) -> str:
        return _wrong_mode(run, "; ".join(text.partition(LIMITS)[0] for text in run["reasons"]))

    def unstable(run: Run) -> str:
        radius = run["tuned"]["spectral_radius"]
        return f"spectral radius {radius:.5f}" if radius >= 1 else ""

    def far(run: Run) -> str:
        ratio = run["tuned"]["certified_Ms"] / run["tuned"]["Ms"]
        return "" if abs(ratio - 1) <= MS_WITHIN else f"certified Ms over the true one {ratio:.3f}"

    named = [run for run in runs if is_limited_by_mode(run)]
    return [
        share("unstable among the certified", 0.0, True, signed, unstable),
        share("refused with a true reason, or better than the flown gains", GOOD_SHARE, False, runs, wrong),
        share("of those certified: better than the flown gains", GOOD_SHARE, False, certified, wrong),
        share("improvable ones refused, gusts up to 2 %, 30 s", REFUSED_OF_CALM, True, calm, refused),
        share("improvable ones refused, all", REFUSED_OF_ALL, True, improvable, refused),
        share("refusals because of a frame mode that name the notch", 1.0, False, named, notch),
        share("certified Ms within 10 % of the true one", MS_SHARE, False, signed, far),
    ]


def bars_table(found: Sequence[Bar]) -> ReportTable:
    """The bars with their figures."""
    rows = [
        [
            bar.name,
            f"{bar.count} of {bar.of}",
            f"{bar.share:.1%}",
            f"{'at most' if bar.most else 'at least'} {bar.target:.0%}",
            "yes" if bar.met else "NO",
        ]
        for bar in found
    ]
    return ReportTable("Bars", ("what", "runs", "share", "target", "met"), rows)


def outcomes_table(runs: Sequence[Run]) -> ReportTable:
    """How often each outcome and each kind of reason occurs; of those, how many could be improved.

    A run may have several reasons to keep the flown gains.
    """
    rows = []
    for outcome in OUTCOMES:
        those = [run for run in runs if run["outcome"] == outcome]
        rows.append([outcome, str(len(those)), str(sum(map(can_improve, those)))])
        named = [(name, can_improve(run)) for run in those if outcome != OUTCOMES[0] for name in kinds(run)]
        for name, count in sorted(Counter(name for name, _ in named).items(), key=lambda item: (-item[1], item[0])):
            rows.append([f"- {name}", str(count), str(named.count((name, True)))])
    return ReportTable("Outcomes and reasons", ("outcome", "runs", "of these improvable"), rows)


def failures_table(found: Sequence[Bar]) -> ReportTable:
    """Every run that misses a bar, with its seed."""
    rows = [[str(seed), bar.name, how] for bar in found for seed, how in bar.failed]
    return ReportTable("Runs that miss a bar", ("seed", "bar", "how"), rows)
