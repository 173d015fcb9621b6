"""What other filters would cost or give, by the certificate: the same examination of the same gains behind them.

A filter of the measured rates is part of the measured response and of the measured noise, so a change of it multiplies
both by the ratio of both filters. Advice rests on three things together: a tone in the gyro's spectrum, the torque that
it causes, and the certificate behind the changed filter. Coherence alone never decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mimopilot.sitl.field.report.analysis.flight_data import GainCase
from mimopilot.sitl.field.report.analysis.loop_filters import DERIVATIVE, LOW_PASS, NOTCH, LoopFilter
from mimopilot.sitl.field.report.analysis.vibration import AirSpectrum, Tone
from mimopilot.tuning.analysis.certify import certify, reason_unknown
from mimopilot.tuning.certificate import ACCEPTED, Certificate, Thresholds, Verdict
from mimopilot.tuning.design.free_gains import free_gains
from mimopilot.tuning.design.loop_gradient import LoopGradient
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.plant.frequency_response import SAME_PERIOD, PlantResponse
from mimopilot.tuning.plant.wide_response import WideResponse
from mimopilot.tuning.spec import TuningSpec

#: Factor by which a cut-off is tried higher and lower, and the step that it is rounded to, Hz.
FACTOR, ROUNDED = 1.5, 5.0
#: Width of a notch that is tried, as a share of its frequency, and the least, Hz: PX4's default is 20 Hz.
WIDTH, LEAST_WIDTH = 0.25, 10.0
#: Hz. Torque above it is noise and vibration: no attitude loop of a multirotor of 0.2 kg and more responds there.
NOISE_FROM = 30.0
#: Share of the torque's power above `NOISE_FROM` that a tone must cause to be worth a notch.
WORTH = 0.2
#: RMS of the torque (normalised) above `NOISE_FROM` at hover up to which it is quiet: a fifteenth of the excitation
#: that tunes; chosen.
QUIET = 0.01
#: Degrees of phase margin that a higher cut-off must give, and that a lower one may cost.
MATTERS = 2.0
#: Share of the torque's noise that a lower cut-off must leave at most.
LEFT = 0.9
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
        Smallest phase margin minus that before; negative: it costs. NaN: no margin is known behind it.
    noise : float
        Torque above `NOISE_FROM` at hover that noise causes, RMS, over that before; NaN: not known.
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


def of_both_axes(case: GainCase, thresholds: Thresholds) -> GainCase | None:
    """The set with the certificate of roll and pitch alone, as behind the changes; None: its margins are not known."""
    measured = case.flight.measured
    if measured is None or case.unknown or case.gains.certificate is None or not case.gains.certificate.figures:
        return None
    return replace(case, gains=replace(case.gains, certificate=_examined(case.gains, measured.response, thresholds)))


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
        From `of_both_axes`.
    filters : sequence of LoopFilter
        In the flight.
    tones : sequence of Tone
        In the gyro's spectrum.
    torque : AirSpectrum or None
        Of the torque in the air, without the injected part.
    thresholds : Thresholds
    """
    changes = []
    for old in filters:
        if old.kind == LOW_PASS or old.acts_on == DERIVATIVE:
            for factor in (FACTOR, 1 / FACTOR):
                hertz = max(ROUNDED, ROUNDED * round(old.hertz * factor / ROUNDED))
                changes.append(_cutoff(case, old, replace(old, hertz=hertz), thresholds))
    high = [tone for tone in tones if tone.hertz >= NOISE_FROM]
    loudest = sorted(high, key=lambda tone: -np.nan_to_num(tone_share(tone, torque)))
    return changes + [_notch(case, filters, tone, torque, thresholds) for tone in loudest[:MOST_NOTCHES]]


def behind(plant: PlantResponse, old: LoopFilter | None, new: LoopFilter | None) -> PlantResponse:
    """A response as it would be with another filter of the measured rates; None: no filter."""
    ratio = _ratio(plant.omega, old, new)
    root = plant.root.copy()
    root[:, 2:4] *= ratio
    return replace(plant, G_i=plant.G_i * ratio, root=root)


def with_derivative_filter(gains: Gains, hertz: float) -> Gains:
    """The gains, also those of a stock controller, with another cut-off of roll's and pitch's derivative filter, Hz."""
    stock = gains.filters.stock
    if stock is None:
        filters = replace(gains.filters, derivative_cutoff_hz=hertz)
    else:
        filters = replace(gains.filters, stock=replace(stock, derivative_hz=(hertz, hertz, *stock.derivative_hz[2:])))
    return replace(gains, filters=filters, certificate=None)


def torque_noise(
    gains: Gains, plant: WideResponse, old: LoopFilter | None = None, new: LoopFilter | None = None
) -> float:
    """RMS of the torque at hover above `NOISE_FROM` that the log's noise causes, the larger axis.

    With `new` instead of `old` as the filter of the measured rates. NaN for another control period than the log's.
    """
    if abs(gains.Ts / plant.Ts - 1) > SAME_PERIOD:
        return float("nan")
    ratio, noise = _ratio(plant.omega, old, new), plant.noise.copy()
    noise[:, :2] *= ratio
    changed = replace(plant, G_i=plant.G_i * ratio, noise=noise)
    free = free_gains(gains, plant.body)
    return float(LoopGradient(changed, free, free.vector(gains)).noise_rms(2 * np.pi * NOISE_FROM).max())


def torque_rms(torque: AirSpectrum | None) -> float:
    """RMS of a flown torque above `NOISE_FROM`, the larger axis; NaN: not logged, or too slowly."""
    if torque is None or torque.hertz[-1] < 1.5 * NOISE_FROM:
        return float("nan")
    return float(np.sqrt(torque.density[torque.hertz >= NOISE_FROM].sum(axis=0).max() * torque.hertz[0]))


def tone_share(tone: Tone, torque: AirSpectrum | None) -> float:
    """Share of a flown torque's power above `NOISE_FROM` that a tone causes, on the axis with more; NaN: not known."""
    if torque is None or not torque_rms(torque) > 0:
        return float("nan")
    above = torque.hertz >= NOISE_FROM
    near = above & (np.abs(torque.hertz - tone.hertz) <= _width(tone) / 2)
    return float((torque.density[near].sum(axis=0) / torque.density[above].sum(axis=0)).max())


def least_phase(certificate: Certificate | None) -> float:
    """Smallest phase margin over the axes, deg; NaN without figures."""
    margins = certificate.figures.get("phase_margin_deg", {}) if certificate else {}
    return float(min(margins.values(), default=float("nan")))


def _ratio(omega: Signal, old: LoopFilter | None, new: LoopFilter | None) -> NDArray[np.complex128]:
    ratio = np.ones(len(omega), complex)
    ratio = ratio * new.response(omega) if new else ratio
    ratio = ratio / old.response(omega) if old else ratio
    return np.asarray(ratio[:, None, None])


def _width(tone: Tone) -> float:
    return max(LEAST_WIDTH, ROUNDED * round(WIDTH * tone.hertz / ROUNDED))


def _examined(gains: Gains, plant: PlantResponse, thresholds: Thresholds) -> Certificate:
    spec = TuningSpec()
    return certify(gains, plant, spec.models("inner", gains.Ts), spec.models("outer", gains.Ts), thresholds=thresholds)


def _margin_change(case: GainCase, gains: Gains, plant: PlantResponse, found: Certificate) -> float:
    """Smallest phase margin behind a changed filter minus that of the case, deg; NaN: not known there."""
    if reason_unknown(gains, plant.at_period(gains.Ts)):
        return float("nan")
    return least_phase(found) - least_phase(case.gains.certificate)


def _cutoff(case: GainCase, old: LoopFilter, new: LoopFilter, thresholds: Thresholds) -> FilterChange:
    """Another cut-off of a low-pass filter, of the rates or of the derivative alone."""
    measured, wide, gains = case.flight.measured, case.flight.wide, case.gains
    assert measured is not None
    before = torque_noise(gains, wide) if wide else float("nan")
    plant = measured.response
    if old.acts_on == DERIVATIVE:
        gains = with_derivative_filter(gains, new.hertz)
        after = torque_noise(gains, wide) if wide else float("nan")
    else:
        plant = behind(plant, old, new)
        after = torque_noise(gains, wide, old, new) if wide else float("nan")
    found, higher = _examined(gains, plant, thresholds), new.hertz > old.hertz
    margin = _margin_change(case, gains, plant, found)
    reason = ""
    if not np.isfinite(after):
        reason = "the torque's noise behind it is not known"
    elif found.verdict != Verdict.CERTIFIED:
        reason = f"behind it the gains are {found.verdict}"
    elif higher and margin < MATTERS:
        reason = f"it gives less than {MATTERS:g} degrees"
    elif higher and after > QUIET:
        reason = "the torque would be noisy"
    elif not higher and before <= QUIET:
        reason = f"the torque above {NOISE_FROM:g} Hz is quiet already"
    elif not higher and margin < -MATTERS:
        reason = f"it costs more than {MATTERS:g} degrees"
    elif not higher and after > LEFT * before:
        reason = "it hardly quiets the torque"
    good = "less delay, and the torque stays quiet" if higher else "it quiets a noisy torque for little margin"
    text = f"{'raise' if higher else 'lower'} {old.name} from {old.hertz:g} to {new.hertz:g} Hz"
    return FilterChange(text, found, margin, after / before, not reason, reason or good)


def _notch(
    case: GainCase, filters: Sequence[LoopFilter], tone: Tone, torque: AirSpectrum | None, thresholds: Thresholds
) -> FilterChange:
    """A notch at a tone."""
    measured, wide, gains = case.flight.measured, case.flight.wide, case.gains
    assert measured is not None
    new = LoopFilter("notch", NOTCH, float(round(tone.hertz)), width_hz=_width(tone))
    plant = behind(measured.response, None, new)
    found = _examined(gains, plant, thresholds)
    noise = torque_noise(gains, wide, None, new) / torque_noise(gains, wide) if wide else float("nan")
    share = tone_share(tone, torque)
    if not np.isfinite(share):
        why, advised = "the tone's share of the torque is not known", False
    else:
        why = f"the tone is {share:.0%} of the torque's power above {NOISE_FROM:g} Hz"
        loud = share >= WORTH and torque_rms(torque) > QUIET
        advised = loud and found.verdict in ACCEPTED
        if share < WORTH:
            why += ": not worth a notch"
        elif not loud:
            why += f", which is quiet: {torque_rms(torque):.2g} RMS"
        why += "" if found.verdict in ACCEPTED else f"; but behind it the gains are {found.verdict}"
    margin = _margin_change(case, gains, plant, found)
    ardupilot = case.flight.recording.format.startswith("dataflash")
    return FilterChange(f"add a notch: {_setting(new, tone, filters, ardupilot)}", found, margin, noise, advised, why)


def _setting(new: LoopFilter, tone: Tone, filters: Sequence[LoopFilter], ardupilot: bool) -> str:
    """The parameters of a notch in the first free place."""
    names = " ".join(one.name for one in filters)
    if ardupilot:
        name = "INS_HNTC2" if "INS_HNTCH" in names else "INS_HNTCH"
        fixed = f"{name}_ENABLE 1, {name}_FREQ {new.hertz:g}, {name}_BW {new.width_hz:g}, {name}_MODE "
        return fixed + ("1 (it moves with the throttle; set REF)" if tone.follows_thrust else "0")
    name = "IMU_GYRO_NF1" if "IMU_GYRO_NF0" in names else "IMU_GYRO_NF0"
    fixed = f"{name}_FRQ {new.hertz:g}, {name}_BW {new.width_hz:g}"
    return fixed + ("; better IMU_GYRO_DNF_EN: it moves with the thrust" if tone.follows_thrust else "")
