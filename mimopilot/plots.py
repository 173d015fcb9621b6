"""Figures as matplotlib axes, for scripts and notebooks: one function a figure, each returns the axes it drew on."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mimopilot.sitl.flight.simulator import Flight
from mimopilot.tuning import law
from mimopilot.tuning.gains import Gains

#: Frequencies of a Bode plot below the Nyquist frequency, and the lowest, rad/s: slower than any attitude loop.
POINTS, LOWEST = 400, 0.1


def plot_flight(flight: Flight) -> Any:
    """Setpoint, attitude, body rate and torque of both axes over time.

    Parameters
    ----------
    flight : Flight

    Returns
    -------
    (3, 2) array of Axes
        Columns: roll, pitch. The figure is ``axes[0, 0].figure``.
    """
    time = np.arange(len(flight.record)) * flight.scenario.Ts
    axes: Any = Figure(figsize=(10, 7), layout="constrained").subplots(3, 2, sharex=True)
    record, truth = flight.record, flight.truth
    for i, name in enumerate(("roll", "pitch")):
        axes[0, i].step(time, np.degrees(record["setpoint"][:, i]), where="post", color="black", label="setpoint")
        axes[0, i].plot(time, np.degrees(truth["attitude"][:, i]), label="attitude")
        rates_setpoint = np.degrees(record["rates_setpoint"][:, i])
        axes[1, i].step(time, rates_setpoint, where="post", color="black", label="rate setpoint")
        axes[1, i].plot(time, np.degrees(truth["rates"][:, i]), label="body rate")
        axes[2, i].step(time, record["moment"][:, i], where="post", label="torque (normalised)")
        axes[0, i].set_title(name)
        axes[2, i].set_xlabel("time [s]")
        for panel, unit in zip(axes[:, i], ("deg", "deg/s", "-"), strict=True):
            panel.set_ylabel(f"[{unit}]")
            panel.grid(alpha=0.3)
            panel.legend(loc="upper right")
    return axes


def plot_bode(gains: Gains) -> Any:
    """Bode plot of the rate controller, from measured body rate to torque: gain and phase of its four elements.

    Parameters
    ----------
    gains : Gains

    Returns
    -------
    (2, 4) array of Axes
        Rows: gain (dB), phase (degrees). Columns: roll from roll, roll from pitch, pitch from roll, pitch from pitch.
    """
    omega = np.geomspace(LOWEST, np.pi / gains.Ts, POINTS, endpoint=False)
    response = law.rate_response(law.rate_matrices(gains), gains.filters, omega)[1].reshape(POINTS, 4)
    axes: Any = Figure(figsize=(12, 5), layout="constrained").subplots(2, 4, sharex=True)
    pairs = ("roll from roll", "roll from pitch", "pitch from roll", "pitch from pitch")
    for column, (name, element) in enumerate(zip(pairs, response.T, strict=True)):
        if np.any(element):
            axes[0, column].semilogx(omega, 20 * np.log10(np.abs(element)))
            axes[1, column].semilogx(omega, np.degrees(np.unwrap(np.angle(element))))
        axes[0, column].set_title(name)
        axes[1, column].set_xlabel("frequency [rad/s]")
    axes[0, 0].set_ylabel("gain [dB]")
    axes[1, 0].set_ylabel("phase [deg]")
    for panel in axes.flat:
        panel.grid(alpha=0.3, which="both")
    return axes
