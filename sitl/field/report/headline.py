"""The conclusion at the top of a report: one sentence, and what to do next."""

from __future__ import annotations

import shlex
from collections.abc import Sequence

from mimopilot.common.html_report import Headline
from mimopilot.sitl.field.report.analysis.filters_advice import least_phase
from mimopilot.sitl.field.report.analysis.flight_data import GainCase, ReportedFlight
from mimopilot.sitl.field.report.analysis.weak_coherence import coherence_note
from mimopilot.sitl.field.report.sections.stability import loops_of, yaw_loops_of
from mimopilot.tuning.certificate import ACCEPTED, Certificate, Verdict
from mimopilot.tuning.experiment import external_signal
from mimopilot.tuning.law_filters import ARDUPILOT_STOCK, BETAFLIGHT, PX4_STOCK

#: Verdict -> colour of the conclusion.
TONES = {Verdict.CERTIFIED: "good", Verdict.THIN: "doubt"}
#: External signal of an experiment -> how to excite other frequencies.
WIDER = {
    "u_bar": "Our module: mimopilot experiment --bandwidth, or MIMO_EX_HMIN and MIMO_EX_HMAX (shorter pulses reach "
    "higher). ArduPilot: SID_F_START_HZ and SID_F_STOP_HZ. A longer or stronger excitation widens the band, too.",
    "r_bar": "PX4's autotune: more runs, or a larger MC_AT_SYSID_AMP. ArduPilot: SID_F_START_HZ and SID_F_STOP_HZ.",
    "r_o": "A setpoint hardly reaches the frequencies of the crossover: inject a torque instead.",
}
#: Controller of a set -> how its gains get to the vehicle, where that is not `UPLOAD`.
UPLOAD = "upload GAINS --connect DEVICE,BAUD"
PUT = {
    PX4_STOCK: f"{UPLOAD} --profile {PX4_STOCK}",
    ARDUPILOT_STOCK: f"{UPLOAD} --profile {ARDUPILOT_STOCK}",
    BETAFLIGHT: f"params GAINS --format {BETAFLIGHT}",
}
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
    newest = cases[-1] if cases else None
    if not judged or (newest is not None and newest.problem and not newest.flown):
        return _without_certificate(flights, cases, before)
    case = judged[-1]
    certificate = case.gains.certificate
    assert certificate is not None
    if case.flown:
        name = "The gains that flew" if len(flights) == 1 else f"The gains {case.label}"
    else:
        name = f"The gains '{case.label}'"
    tone = TONES.get(certificate.verdict, "bad")
    if certificate.verdict in ACCEPTED:
        phase = least_phase(certificate) // 1  # "or more": rounded down
        margins = f"Ms {certificate.figures['Ms']:.2f}, phase margin {phase:.0f} degrees or more"
        sentence = f"{before}{name} are {certificate.verdict} on this vehicle: {margins}."
    elif case.unknown and certificate.verdict == Verdict.NOT_CERTIFIED:
        sentence, tone = f"{before}{name} cannot be judged from this flight: {case.unknown}.", "doubt"
    else:
        sentence = f"{before}{name} are {certificate.verdict}: {certificate.reason}."
    steps = [_next_step(case, certificate)]
    return Headline(sentence, steps, "bad" if crashed else tone, coherence_notes(case))


def _next_step(case: GainCase, certificate: Certificate) -> str:
    """What to do about the gains that are judged."""
    log = shlex.quote(case.flight.recording.path.name)
    if case.unknown and certificate.verdict == Verdict.NOT_CERTIFIED:
        how = WIDER[external_signal(case.flight.measured.experiment)[1]] if case.flight.measured else ""
        return f"Fly the experiment again with other frequencies, and make the report of that flight. {how}"
    if case.flown:
        return f"Find better gains from this flight: mimopilot tune {log} --out my.gains.toml --report tuned.html"
    if certificate.verdict == Verdict.CERTIFIED:
        return f"Put them on the vehicle: mimopilot {PUT.get(case.gains.controller, UPLOAD)}"
    return f"Tune again before flying them: mimopilot tune {log} --out my.gains.toml"


def coherence_notes(case: GainCase) -> list[str]:
    """Where the excitation explains too little inside the bands that the certificate of a set rests on."""
    notes = list[str]()
    if case.unknown:  # the band ends too early anyway
        return notes
    for loops, plant in (
        (loops_of(case), case.flight.measured.response if case.flight.measured else None),
        (yaw_loops_of(case), case.flight.yaw_response),
    ):
        if loops is not None and plant is not None:
            notes.append(coherence_note(plant, loops.axis_loops, loops.omega))
    return [note for note in notes if note]


def _without_certificate(flights: Sequence[ReportedFlight], cases: Sequence[GainCase], before: str) -> Headline:
    refused = next((flight for flight in flights if flight.found.reason), None)
    if refused is not None:
        reason = str(refused.found.reason).partition(CONTENTS)[0].rstrip(". ")
        sentence = f"{before}Gains cannot be tuned from {refused.label}: {reason}."
        steps = ["What the log does show is below. For gains, mend this and fly again; mimopilot inspect checks a log."]
        return Headline(sentence, steps, "bad" if before else "doubt")
    tone = "bad" if before else "doubt"
    problem = next((case for case in reversed(cases) if case.problem or not case.gains.certificate), None)
    if problem is not None:
        return Headline(f"{before}No certificate for '{problem.label}': {problem.problem}.", (), tone)
    names = " and ".join(flight.label for flight in flights)
    log = shlex.quote(flights[0].recording.path.name)
    step = (
        f"Find gains: mimopilot tune {log} --spec flown.toml --out my.gains.toml --report tuned.html, where flown.toml "
        "says what flew (the manual: Logs)."
    )
    return Headline(f"{before}Gains can be tuned from {names}, which does not hold those that flew.", [step], tone)
