"""The conclusion at the top of a report: one sentence, and what to do next."""

from __future__ import annotations

from collections.abc import Sequence

from mimopilot.common.html_report import Headline
from mimopilot.sitl.field.report.analysis.filters_advice import least_phase
from mimopilot.sitl.field.report.analysis.flight_data import GainCase, ReportedFlight
from mimopilot.tuning.certificate import ACCEPTED, Verdict

#: Verdict -> colour of the conclusion.
TONES = {Verdict.CERTIFIED: "good", Verdict.THIN: "doubt"}
#: Where the names of everything in a log begin in a message: of no use in a sentence.
CONTENTS = " In this log: "


def lead(flights: Sequence[ReportedFlight]) -> str:
    """What the report is about."""
    told = []
    for flight in flights:
        air = sum(b - a for a, b in flight.airborne)
        known = (
            f"{air:.1f} s of it in the air" if flight.recording.airborne is not None else "flight not marked in the log"
        )
        told.append(f"{flight.label}: {flight.recording.format}, {flight.span[1] - flight.span[0]:.1f} s, {known}.")
    return " ".join(told)


def headline(flights: Sequence[ReportedFlight], cases: Sequence[GainCase]) -> Headline:
    """The conclusion about the newest gains that can be judged, else about the log."""
    crashed = next((flight for flight in flights if flight.phases["crash"]), None)
    before = ""
    if crashed is not None:
        fell = max(crashed.phases["crash"][0][0], crashed.tumbles[0][0])
        before = f"The vehicle tumbled {fell:.1f} s into {crashed.label}. "
    judged = [case for case in cases if not case.problem and case.gains.certificate]
    if not judged:
        return _without_certificate(flights, cases, before)
    case = judged[-1]
    certificate = case.gains.certificate
    assert certificate is not None
    name = "The gains that flew" if case.flown and len(flights) == 1 else f"The gains '{case.label}'"
    if certificate.verdict in ACCEPTED:
        phase = least_phase(certificate) // 1  # "or more": rounded down
        margins = f"Ms {certificate.figures['Ms']:.2f}, phase margin {phase:.0f} degrees or more"
        sentence = f"{before}{name} are {certificate.verdict} on this vehicle: {margins}."
    else:
        sentence = f"{before}{name} are {certificate.verdict}: {certificate.reason}."
    log = case.flight.recording.path.name
    steps = []
    if case.flown:
        steps.append(
            f"Find better gains from this flight: mimopilot tune {log} --out my.gains.toml --report tuned.html"
        )
    elif certificate.verdict == Verdict.CERTIFIED:
        steps.append("Put them on the vehicle: mimopilot upload GAINS --connect DEVICE,BAUD")
    else:
        steps.append(f"Tune again before flying them: mimopilot tune {log} --out my.gains.toml")
    return Headline(sentence, steps, "bad" if crashed else TONES.get(certificate.verdict, "bad"))


def _without_certificate(flights: Sequence[ReportedFlight], cases: Sequence[GainCase], before: str) -> Headline:
    refused = next((flight for flight in flights if flight.found.reason), None)
    if refused is not None:
        reason = str(refused.found.reason).partition(CONTENTS)[0].rstrip(". ")
        sentence = f"{before}Gains cannot be tuned from {refused.label}: {reason}."
        steps = ["What the log does show is below. For gains, mend this and fly again; mimopilot inspect checks a log."]
        return Headline(sentence, steps, "bad" if before else "doubt")
    tone = "bad" if before else "doubt"
    if cases:
        problem = next(case for case in cases if case.problem or not case.gains.certificate)
        return Headline(f"{before}No certificate for '{problem.label}': {problem.problem}.", (), tone)
    names = " and ".join(flight.label for flight in flights)
    step = f"Find gains: mimopilot tune {flights[0].recording.path.name} --out my.gains.toml, then report --gains."
    return Headline(f"{before}Gains can be tuned from {names}, which does not hold those that flew.", [step], tone)
