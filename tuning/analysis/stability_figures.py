"""The certificate's figures: peak of the sensitivity, margins and small gain, each with its error."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mimopilot.tuning.analysis import margins
from mimopilot.tuning.analysis.closed_loop import CascadeLoop, cascade_loop
from mimopilot.tuning.axes import Law, axis_names
from mimopilot.tuning.plant.frequency_response import DRAWS, PlantResponse
from mimopilot.tuning.reference_model import ReferenceModel
from mimopilot.tuning.small_matrices import singular_values

#: Largest relative step between neighbouring frequencies. Near instability the sensitivity's peak is narrower than the
#: measured response's own grid.
GRID_STEP = 0.05


def nominal_and_drawn_loops(gains: Law, plant: PlantResponse) -> tuple[PlantResponse, CascadeLoop, list[CascadeLoop]]:
    """The plant on a grid that resolves narrow peaks, its loop, and the loops of plants drawn from its error."""
    generator, dense = np.random.default_rng(0), plant.interpolated(GRID_STEP)
    others = (plant.draw(generator).interpolated(GRID_STEP) for _ in range(DRAWS))
    return dense, cascade_loop(gains, dense), [cascade_loop(gains, other) for other in others]


def _peak_and_error(nominal: CascadeLoop, draws: list[CascadeLoop]) -> tuple[float, float]:
    peaks = [margins.peak(margins.sensitivity(loop)) for loop in (nominal, *draws)]
    return peaks[0], 2 * float(np.std(peaks[1:]))


def stability_figures(
    gain_above: float,
    plant: PlantResponse,
    nominal: CascadeLoop,
    draws: list[CascadeLoop],
    inner: Sequence[ReferenceModel],
) -> dict[str, Any]:
    """Figures of `tuning.certificate.Certificate`.

    Parameters
    ----------
    gain_above : float
        Bound of the rate loop's gain above the band.
    plant : PlantResponse
        The response that `nominal` is made of.
    nominal, draws
        See `nominal_and_drawn_loops`.
    inner : sequence of n ReferenceModel
        Of the rate loop.
    """
    identity, names = np.eye(plant.axes), axis_names(plant.axes)
    m = np.stack([model.frequency_response(plant.omega) for model in inner], axis=1)[:, :, None] * identity

    def delta(loop: CascadeLoop) -> float:
        # D_M = M - (I - M) G K; G K and K G have the same loop, here cut at u.
        return float(singular_values(m - (identity - m) @ loop.L_i)[0].max())

    S = margins.sensitivity(nominal)
    loops = margins.axis_loops(S)
    found = [margins.phase_margin(loop, plant.omega) for loop in loops]
    drawn = np.array(
        [
            [margins.phase_margin(loop, plant.omega)[0] for loop in margins.axis_loops(margins.sensitivity(draw))]
            for draw in draws
        ]
    )
    spread = [2 * float(np.std(phases)) if np.isfinite(phases).all() else 0.0 for phases in drawn.T]
    disk = margins.disk_margin(S)
    gain_db, phase_deg = margins.simultaneous_margins(disk)
    Ms, Ms_error = _peak_and_error(nominal, draws)
    return {
        "Ms": Ms,
        "Ms_error": Ms_error,
        "delta": delta(nominal),
        "delta_error": 2 * float(np.std([delta(loop) for loop in draws])),
        "distance": float(np.abs(np.linalg.det(identity + nominal.L_u)).min()),
        "disk_margin": disk,
        "simultaneous_gain_db": gain_db,
        "simultaneous_phase_deg": phase_deg,
        **margins.gain_margins(loops, gain_above),
        "phase_margin_deg": {axis: phase for axis, (phase, _) in zip(names, found, strict=True)},
        "phase_margin_error_deg": dict(zip(names, spread, strict=True)),
        "delay_margin_ms": {axis: delay for axis, (_, delay) in zip(names, found, strict=True)},
    }
