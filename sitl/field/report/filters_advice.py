"""What other filters would cost or give, by the certificate: the same examination of the same gains behind them.

A filter of the measured rates is part of the measured response, so a change of it multiplies that response by the ratio
of both filters. Advice rests on three things together: a tone in the gyro's spectrum, the torque that it causes, and the
certificate behind the changed filter. Coherence alone never decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mimopilot.sitl.field.report.flight_data import GainCase
from mimopilot.sitl.field.report.loop_filters import DERIVATIVE, LOW_PASS, NOTCH, RATES, LoopFilter
from mimopilot.sitl.field.report.vibration import AirSpectrum, Tone
from mimopilot.tuning.analysis.certify import certify
from mimopilot.tuning.certificate import ACCEPTED, Certificate, Thresholds, Verdict
from mimopilot.tuning.plant.frequency_response import PlantResponse
from mimopilot.tuning.spec import TuningSpec

#: Factor by which a cut-off is tried higher and lower, and the step that it is rounded to, Hz.
FACTOR, ROUNDED = 1.5, 5.0
#: Width of a notch that is tried, as a share of its frequency, and the least, Hz: PX4's default is 20 Hz.
WIDTH, LEAST_WIDTH = 0.25, 10.0
#: Hz. Torque above it is noise and vibration: no attitude loop of a multirotor of 0.2 kg and more responds there.
NOISE_FROM = 30.0
#: Share of the torque's power above `NOISE_FROM` that a tone must cause to be worth a notch.
WORTH = 0.2
#: RMS of the torque (normalised) above `NOISE_FROM` below which a higher cut-off is worth its noise: a fifteenth of the
#: excitation that tunes; chosen.
QUIET = 0.01
#: Degrees of phase margin that a change of a cut-off must give.
LEAST_GAIN = 2.0
#: Most notches that are tried.
MOST_NOTCHES = 2

Signal = NDArray[np.float64]


@dataclass(frozen=True)
class FilterChange:
    """One change of a filter and what it does.

    Attributes
    ----------
    text : str
        The change, with the parameters' names.
    certificate : Certificate
        Of the same gains behind it.
    margin_deg : float, deg
        Smallest phase margin minus that before; negative: it costs.
    noise : float
        Torque above `NOISE_FROM` over that before, RMS; NaN: the torque is not logged fast enough.
    advised : bool
    why : str
        Why it is advised or not.
    """

    text: str
    certificate: Certificate
    margin_deg: float
    noise: float
    advised: bool
    why: str


def behind(plant: PlantResponse, old: LoopFilter | None, new: LoopFilter | None) -> PlantResponse:
    """A response as it would be with another filter of the measured rates; None: no filter."""
    ratio = np.ones(len(plant.omega), complex)
    ratio = ratio * new.response(plant.omega) if new else ratio
    ratio = ratio / old.response(plant.omega) if old else ratio
    root = plant.root.copy()
    root[:, 2:4] *= ratio[:, None, None]
    return replace(plant, G_i=plant.G_i * ratio[:, None, None], root=root)


def filter_changes(
    case: GainCase,
    filters: Sequence[LoopFilter],
    tones: Sequence[Tone],
    torque: AirSpectrum | None,
    thresholds: Thresholds,
) -> list[FilterChange]:
    """Changes of the filters of a vehicle, each examined.

    Parameters
    ----------
    case : GainCase
        With its certificate.
    filters : sequence of LoopFilter
        In the flight.
    tones : sequence of Tone
        In the gyro's spectrum.
    torque : AirSpectrum or None
        Of the torque in the air.
    thresholds : Thresholds
    """
    if case.flight.measured is None or case.gains.certificate is None or not case.gains.certificate.figures:
        return []
    ardupilot = case.flight.recording.format.startswith("dataflash")
    changes = []
    for old in filters:
        if old.kind == LOW_PASS or old.acts_on == DERIVATIVE:
            for factor in (FACTOR, 1 / FACTOR):
                hertz = max(ROUNDED, ROUNDED * round(old.hertz * factor / ROUNDED))
                changes.append(_cutoff(case, old, replace(old, hertz=hertz), torque, thresholds))
    for tone in _worth_a_notch(tones, torque)[:MOST_NOTCHES]:
        changes.append(_notch(case, tone, torque, thresholds, ardupilot))
    return changes


def torque_rms(torque: AirSpectrum | None, weight: Signal | None = None) -> float:
    """RMS of the torque above `NOISE_FROM`, the larger axis, with a weight (F,) of its density; NaN: not known."""
    if torque is None or torque.hertz[-1] < 1.5 * NOISE_FROM:
        return float("nan")
    above = torque.hertz >= NOISE_FROM
    density = torque.density[above] if weight is None else torque.density[above] * weight[above, None]
    return float(np.sqrt(density.sum(axis=0).max() * torque.hertz[0]))


def tone_share(tone: Tone, torque: AirSpectrum | None) -> float:
    """Share of the torque's power above `NOISE_FROM` within a notch's width of a tone; NaN: not known."""
    total = torque_rms(torque)
    if torque is None or not total > 0:
        return float("nan")
    near = np.abs(torque.hertz - tone.hertz) <= _width(tone) / 2
    return float((torque_rms(torque, near.astype(np.float64)) / total) ** 2)


def _worth_a_notch(tones: Sequence[Tone], torque: AirSpectrum | None) -> list[Tone]:
    """Tones above the loop, by the torque that they cause."""
    high = [tone for tone in tones if tone.hertz >= NOISE_FROM]
    return sorted(high, key=lambda tone: -np.nan_to_num(tone_share(tone, torque)))


def _width(tone: Tone) -> float:
    return max(LEAST_WIDTH, ROUNDED * round(WIDTH * tone.hertz / ROUNDED))


def _examined(case: GainCase, plant: PlantResponse, thresholds: Thresholds) -> Certificate:
    spec = TuningSpec()
    models = (spec.models("inner", case.gains.Ts), spec.models("outer", case.gains.Ts))
    return certify(case.gains, plant, *models, thresholds=thresholds)


def least_phase(certificate: Certificate | None) -> float:
    """Smallest phase margin over the axes, deg; NaN without figures."""
    margins = certificate.figures.get("phase_margin_deg", {}) if certificate else {}
    return float(min(margins.values(), default=float("nan")))


def _cutoff(
    case: GainCase, old: LoopFilter, new: LoopFilter, torque: AirSpectrum | None, thresholds: Thresholds
) -> FilterChange:
    assert case.flight.measured is not None
    response = case.flight.measured.response
    noise = float("nan")
    if old.acts_on == RATES:
        found = _examined(case, behind(response, old, new), thresholds)
        if torque is not None:
            omega = 2 * np.pi * torque.hertz
            weight = np.abs(new.response(omega) / old.response(omega)) ** 2
            noise = torque_rms(torque, weight) / torque_rms(torque)
    else:
        filters = replace(case.gains.filters, derivative_cutoff_hz=new.hertz)
        changed = replace(case, gains=replace(case.gains, filters=filters, certificate=None))
        found = _examined(changed, response, thresholds)
    margin = least_phase(found) - least_phase(case.gains.certificate)
    quiet = torque_rms(torque) * (noise if noise == noise else FACTOR)
    if new.hertz <= old.hertz:
        loud = torque_rms(torque) > QUIET and margin > -LEAST_GAIN and found.verdict in ACCEPTED
        advised = loud and found.verdict == Verdict.CERTIFIED
        why = (
            "the torque is noisy, and the margin stays"
            if advised
            else f"the torque above {NOISE_FROM:g} Hz is small already: nothing to win"
            if torque_rms(torque) <= QUIET
            else "it costs margin"
        )
    else:
        advised = margin >= LEAST_GAIN and quiet <= QUIET and found.verdict in ACCEPTED
        why = (
            "less delay, and the torque stays quiet"
            if advised
            else "the torque's noise is not known"
            if not quiet == quiet
            else f"it gives less than {LEAST_GAIN:g} degrees"
            if margin < LEAST_GAIN
            else "the torque is too noisy for it"
        )
    verb = "raise" if new.hertz > old.hertz else "lower"
    return FilterChange(f"{verb} {old.name} from {old.hertz:g} to {new.hertz:g} Hz", found, margin, noise, advised, why)


def _notch(
    case: GainCase, tone: Tone, torque: AirSpectrum | None, thresholds: Thresholds, ardupilot: bool
) -> FilterChange:
    assert case.flight.measured is not None
    hertz, wide = round(tone.hertz), _width(tone)
    new = LoopFilter("notch", NOTCH, hertz, width_hz=wide)
    found = _examined(case, behind(case.flight.measured.response, None, new), thresholds)
    margin = least_phase(found) - least_phase(case.gains.certificate)
    weight = np.abs(new.response(2 * np.pi * torque.hertz)) ** 2 if torque is not None else None
    noise = torque_rms(torque, weight) / torque_rms(torque) if torque is not None else float("nan")
    share = tone_share(tone, torque)
    keeps = found.verdict in ACCEPTED
    advised = bool(share >= WORTH and keeps)
    why = (
        "the share of the tone in the torque is not known"
        if not share == share
        else f"the tone is {share:.0%} of the torque's power above {NOISE_FROM:g} Hz"
        + ("" if share >= WORTH else ": not worth a notch")
        + ("" if keeps else "; but the loop behind it is not certified")
    )
    if ardupilot:
        text = f"INS_HNTCH_ENABLE 1, INS_HNTCH_FREQ {hertz:g}, INS_HNTCH_BW {wide:g}, INS_HNTCH_MODE 0"
        moving = "; it moves with the thrust: INS_HNTCH_MODE 1 (throttle) with INS_HNTCH_REF"
    else:
        text = f"IMU_GYRO_NF0_FRQ {hertz:g}, IMU_GYRO_NF0_BW {wide:g}"
        moving = "; it moves with the thrust: a dynamic notch (IMU_GYRO_DNF_EN) follows it"
    return FilterChange(
        f"add a notch: {text}{moving if tone.follows_thrust else ''}", found, margin, noise, advised, why
    )
