"""The loop outside the band in which its response is known: bounds above and below it, and structural modes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from mimopilot.tuning.analysis import margins
from mimopilot.tuning.analysis.closed_loop import cascade_loop
from mimopilot.tuning.axes import Law
from mimopilot.tuning.law import cascade_response
from mimopilot.tuning.plant.frequency_response import COHERENT, PlantResponse
from mimopilot.tuning.small_matrices import singular_values

#: Largest gain of the rate loop above the band: 6 dB below instability, if the plant falls like an integrator there.
MAX_GAIN_ABOVE_BAND = 0.5
#: Largest sensitivity at the band's lower end, below which the vehicle is the fitted rigid body: most frequencies at
#: which the loop amplifies must be measured. Of 40 random vehicles in gusts none was unstable or above Ms 1.8 with it.
MAX_SENSITIVITY_BELOW_BAND = 1.5
#: Least gain of the loop there: a band that begins above the crossover says nothing about the margins.
MIN_GAIN_AT_BAND_START = 1.0
#: Above the frequency where the loop first falls below the limit, noise may exceed it up to this ratio of frequencies.
CROSSOVER_NOISE_RATIO = 1.25
#: A gain whose error is below this share of it counts as measured, whatever the coherence.
MEASURED_ERROR = 0.4
#: Frequencies from the band's end to Nyquist on which the controller's response is searched for its maximum.
GRID_POINTS = 200
#: Smallest distance of the loop from -1 that a peak of the sensitivity is computed from: it bounds the peak.
MIN_DISTANCE = 1e-6

Signal = NDArray[np.float64]


def reason_beyond_band(gains: Law, known: PlantResponse, gain_above: float) -> str:
    """Why the loop cannot be judged outside the band; empty when the assumptions made there hold.

    Parameters
    ----------
    gains : Law
    known : PlantResponse
        In the band.
    gain_above : float
        Bound of the rate loop's gain above the band, see `loop_gain_above`.
    """
    if gain_above > MAX_GAIN_ABOVE_BAND:
        return (
            f"excitation ends at {known.omega[-1]:.0f} rad/s, where the loop's gain may still reach {gain_above:.2f} "
            f"(at most {MAX_GAIN_ABOVE_BAND:g}): excite a wider band"
        )
    if gain_above + attitude_gain_above(gains, known) >= 1:
        return (
            f"excitation ends at {known.omega[-1]:.0f} rad/s, where the whole cascade's gain may still reach 1: "
            "excite a wider band"
        )
    weakest = loop_at_band_start(gains, known)
    if weakest < MIN_GAIN_AT_BAND_START:
        return (
            f"excitation begins at {known.omega[0]:.1f} rad/s, where the loop's gain is {weakest:.2g} in its weakest "
            f"direction (at least {MIN_GAIN_AT_BAND_START:g}): the crossover is not measured; excite lower frequencies"
        )
    remaining = sensitivity_at_band_start(gains, known)
    if remaining > MAX_SENSITIVITY_BELOW_BAND:
        return (
            f"excitation begins at {known.omega[0]:.1f} rad/s, where the sensitivity is still {remaining:.2f} (at most "
            f"{MAX_SENSITIVITY_BELOW_BAND:g}); the loop below is not measured: excite lower frequencies, or ask for a "
            "faster attitude loop"
        )
    return ""


def loop_gain_above(gains: Law, plant: PlantResponse) -> Signal:
    """Upper bound of the rate loop's gain above each frequency of the plant, (K,).

    The supremum over w > w_k of sigma_max(G(w_k)) (w_k / w) sigma_max(C_y)(w). A rate is the integral of the torque
    over the inertia, behind motors and filters, so |G| falls at least like 1/w. A constant |G| would be the weaker
    assumption, but it counts a filtered D with its gain at the Nyquist frequency, where no vehicle responds. From its
    largest value on, w |G| is fitted by a sequence that does not rise, which also removes noise.
    """
    grid = np.concatenate([plant.omega, np.linspace(plant.omega[-1], np.pi / gains.Ts, GRID_POINTS)[1:]])
    falling = singular_values(cascade_response(gains, grid)[2])[0] / grid
    highest = np.maximum.accumulate(falling[..., ::-1], axis=-1)[..., ::-1][..., : len(plant.omega)]
    bound: Signal = falling_gain(plant) * highest
    return bound


def falling_gain(plant: PlantResponse) -> Signal:
    """Bound of w sigma_max(G_i) above each frequency, (K,): it does not rise from its largest value on."""
    gain: Signal = singular_values(plant.G_i)[0] * plant.omega
    top = int(np.argmax(gain))
    gain[top:] = isotonic_regression(gain[top:], increasing=False).x
    return gain


def attitude_gain_above(gains: Law, plant: PlantResponse) -> float:
    """Upper bound of what the attitude path C_o G_o adds to the loop's gain above the plant's band.

    G_o falls at least like 1/w^2 there, see `loop_gain_above`.
    """
    grid = np.linspace(plant.omega[-1], np.pi / gains.Ts, GRID_POINTS)
    path = np.linalg.norm(cascade_response(gains, grid)[1], ord=2, axis=(1, 2)) * (plant.omega[-1] / grid) ** 2
    return float(np.linalg.norm(plant.G_o[-1], ord=2) * path.max())


def sensitivity_at_band_start(gains: Law, known: PlantResponse) -> float:
    """The sensitivity's largest singular value at the lowest frequency of the band."""
    return margins.peak(margins.sensitivity(cascade_loop(gains, known.at(np.array([0])))))


def loop_at_band_start(gains: Law, known: PlantResponse) -> float:
    """The loop's smallest singular value at the lowest frequency of the band."""
    return float(np.linalg.svd(cascade_loop(gains, known.at(np.array([0]))).L_u, compute_uv=False).min())


def find_structural_mode(gains: Law, plant: PlantResponse) -> tuple[float, float] | None:
    """Measured frequency above the crossover at which the rate loop's gain exceeds the limit again.

    Parameters
    ----------
    gains : Law
    plant : PlantResponse
        The whole response, known or not.

    Returns
    -------
    tuple of 2 float or None
        Frequency (rad/s) at which it exceeds the limit most surely, and the gain plus its error there; None: nowhere.
    """
    counts, gain, error = _exceeded(gains, plant)
    if not counts.any():
        return None
    surest = int(np.argmax(np.where(counts, gain - error, -np.inf)))
    return float(plant.omega[surest]), float((gain + error)[surest])


def exceeded_frequencies(gains: Law, plant: PlantResponse) -> NDArray[np.bool_]:
    """Measured frequencies above the crossover at which the rate loop's gain may exceed the limit, (K,)."""
    return _exceeded(gains, plant)[0]


def _exceeded(gains: Law, plant: PlantResponse) -> tuple[NDArray[np.bool_], Signal, Signal]:
    """See `exceeded_frequencies`; and the gain and its error, (K,)."""
    gain, error = _rate_loop_gain(gains, plant)
    known = np.flatnonzero(plant.known())
    small = known[gain[known] + error[known] <= MAX_GAIN_ABOVE_BAND]
    small = small[small > known[np.argmax(gain[known])]] if len(small) else small
    if not len(small):
        return np.zeros(len(gain), bool), gain, error
    above_crossover = plant.omega > CROSSOVER_NOISE_RATIO * plant.omega[small[0]]
    return _measured(plant, gain, error) & above_crossover & (gain + error > MAX_GAIN_ABOVE_BAND), gain, error


def sensitivity_peak_above(gains: Law, plant: PlantResponse, end: float) -> float:
    """Largest sensitivity at measured frequencies above `end` (rad/s), errors included; 0: none measured."""
    gain, error = _rate_loop_gain(gains, plant)
    counts = _measured(plant, gain, error) & (plant.omega > end)
    if not counts.any():
        return 0.0
    least = singular_values(np.eye(plant.axes) + cascade_loop(gains, plant.at(counts)).L_u)[1] - error[counts]
    return float(1 / max(least.min(), MIN_DISTANCE))


def _measured(plant: PlantResponse, gain: Signal, error: Signal) -> NDArray[np.bool_]:
    """Frequencies at which the loop's gain counts as measured, (K,).

    Where the response is known; also where an axis is coherent or the error is small, at this frequency and at a
    neighbour.
    """
    seen = np.any(plant.coherence > COHERENT, axis=1) | (error < MEASURED_ERROR * gain)
    # A single value may exceed these limits by chance; a mode shows at neighbouring frequencies, too.
    neighbour = np.append(seen[1:], False) | np.append(False, seen[:-1])
    return np.asarray(plant.known() | (seen & neighbour))


def _rate_loop_gain(gains: Law, plant: PlantResponse) -> tuple[Signal, Signal]:
    """sigma_max of the rate loop, (K,), and the RMS of the error's norm: two deviations of an element."""
    controller = cascade_response(gains, plant.omega)[2]
    gain = singular_values(controller @ plant.G_i)[0]
    # Independent errors of the elements: C E has the covariance sum |C_ij|^2 dev_jk^2.
    spread = np.sqrt(np.abs(controller) ** 2 @ plant.deviation() ** 2)
    return gain, np.linalg.norm(spread, axis=(1, 2))
