"""Noise of the measured rates and angles: gusts, sensors and vibration, as one log contains them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.experiment import Experiment, external_signal
from mimopilot.tuning.plant.frequency_response import PlantResponse, hermitian_root

#: Samples of a segment of Welch's estimate, and the least number: 4 s and 1 s at 250 Hz.
SEGMENT, SHORTEST = 1024, 256
#: Half width over which the estimate is averaged, as a share of the frequency.
WIDTH = 0.03

Complex = NDArray[np.complex128]
Signal = NDArray[np.float64]


def noise_root(experiment: Experiment, plant: PlantResponse, omega: Signal) -> Complex:
    """Square root of the spectrum of n = [n_i, n_o], y_i = G_i u + n_i, y_o = G_o u + n_o.

    At frequencies of the response it is the residual of its fit, [-G_i I 0; -G_o 0 I] times the residual of [u, y_i,
    y_o]: it does not depend on the gains that flew. Above, where the excitation ends and no vehicle responds, it is
    Welch's estimate of the signals' own spectrum.

    Parameters
    ----------
    experiment : Experiment
    plant : PlantResponse
        Its measured response.
    omega : (K,) array, rad/s

    Returns
    -------
    (K, 2n, 2n) array
        R with R R^H the spectrum, rad/s and rad; a variance is Ts / pi times its integral from 0 to pi / Ts.
    """
    of_angles = plant.angle_residual() if plant.angle_noise is None else plant.angle_noise
    residual = np.concatenate([plant.rate_residual(), of_angles], axis=1)
    inside = residual @ residual.conj().transpose(0, 2, 1)
    spectrum = inside[np.abs(plant.omega[:, None] - omega).argmin(axis=0)]
    above = omega > plant.omega[-1]
    if above.any():
        spectrum[above] = _welch(experiment, np.hstack([experiment.y_i, experiment.y_o]), omega[above])
    return hermitian_root(spectrum)


def flown_torque_noise(experiment: Experiment, plant: PlantResponse, omega: Signal, lowest: float = 0.0) -> Signal:
    """RMS of the torque (normalised) that noise caused in the flight, for each axis, (n,): its excitation is left out.

    Parameters
    ----------
    experiment, plant, omega
        See `noise_root`; `omega` reaches the Nyquist frequency.
    lowest : float, rad/s
        Only the noise at higher frequencies counts.
    """
    root = plant.root[:, : plant.axes]
    power = np.einsum("kij,kij->ki", root, root.conj()).real
    density = power[np.abs(plant.omega[:, None] - omega).argmin(axis=0)]
    above = omega > plant.omega[-1]
    if above.any():
        signal, name = external_signal(experiment)
        torque = experiment.u - signal if name == "u_bar" else experiment.u
        density[above] = np.einsum("kii->ki", _welch(experiment, torque, omega[above])).real
    density[omega <= lowest] = 0.0
    return np.asarray(np.sqrt(np.trapezoid(density, omega, axis=0) * experiment.Ts / np.pi))


def _welch(experiment: Experiment, signals: Signal, omega: Signal) -> Complex:
    """Cross spectra (K, n, n) of signals (N, n), in the unit of a normalised DFT, averaged around each frequency."""
    from scipy.signal import csd

    longest = max(stop - start for start, stop in experiment.segments)
    length = int(np.clip(longest // 4, min(SHORTEST, longest), SEGMENT))
    total, samples = 0.0, 0
    for start, stop in experiment.segments:
        if stop - start < length:
            continue
        part = signals[start:stop]
        _, found = csd(part.T[:, None], part.T[None], fs=1 / experiment.Ts, nperseg=length)
        total, samples = total + found * (stop - start), samples + stop - start
    # A one-sided density per Hz holds both halves of the spectrum; csd conjugates its first signal.
    spectra = np.moveaxis(np.asarray(total), -1, 0).conj() / samples / 2 / experiment.Ts
    places = 2 * np.pi * np.arange(len(spectra)) / (length * experiment.Ts)
    near = np.abs(places - omega[:, None]) <= np.maximum(WIDTH * omega, 2 * places[1])[:, None]
    near = near & (places > 0)
    averaged: Complex = np.einsum("kf,fij->kij", near / near.sum(axis=1, keepdims=True), spectra)
    return averaged
