"""What yaw does to roll and pitch and they to yaw: its size, and the loop of all three axes with it.

The controller has no gains between yaw and the others. With L_d the loop without the cross terms and X = L - L_d,
det(I + L) = det(I + L_d) det(I + S_d X), S_d = (I + L_d)^-1. S_d X has a block A from yaw and a block B to yaw. With
the yaw torque in the unit in which both are of one size (see `tuning.analysis.margins.balanced`) sigma_max(S_d X) is
(|A| |B|)^(1/2). Where that is small, the loop's encirclements are those of its blocks, and its sensitivity differs by
little. Else det(I + L) / det(I + L_d) must not encircle 0, and the sensitivity is that of all three axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.analysis.beyond_band import loop_gain_above
from mimopilot.tuning.analysis.closed_loop import CascadeLoop, slow_growth, whole_loop
from mimopilot.tuning.analysis.stability_figures import nominal_and_drawn_loops, stability_figures
from mimopilot.tuning.axes import Law
from mimopilot.tuning.certificate import Verdict
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.law import cascade_response
from mimopilot.tuning.parameter_row import AXES
from mimopilot.tuning.plant.frequency_response import DRAWS, MIN_FREQUENCIES, PlantResponse
from mimopilot.tuning.plant.rigid_body_fit import continued_below, rigid_body
from mimopilot.tuning.reference_model import ReferenceModel

#: (|A| |B|)^(1/2), errors included, above which the cross terms count: below it they change the sensitivity by at most
#: a ninth, as much as the certificate's own errors.
MATTERS = 0.1
#: Deviations that a cross term exceeds to be called measured: the largest of 4 elements at 50 frequencies exceeds them
#: by chance in one log of 40 (exp(-9) each).
SURE = 3.0
#: Elements between yaw and the others.
CROSS: NDArray[np.bool_] = np.array([[False, False, True], [False, False, True], [True, True, False]])

Complex = NDArray[np.complex128]
Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CrossTerms:
    """The cross terms of a gain set around a measured response of all three axes.

    Attributes
    ----------
    share, share_error : float
        Of the rate that a torque causes on its own axis, the share that it causes on the other, where that is largest
        beyond `SURE` deviations; and two standard deviations of it.
    measured : bool
        Whether any exceeds that many.
    source, target : str
        Axis of the torque, and of the rate.
    omega : float, rad/s
        Where.
    effect : float
        Largest (|A| |B|)^(1/2), errors (two standard deviations) included.
    verdict : Verdict
        Of the loop with the cross terms, as far as they change it; ``certified`` if they do not matter.
    reason : str
        Why it is not ``certified``.
    figures : mapping
        Of all three axes, as `tuning.certificate.Certificate.figures`; empty if the cross terms do not matter.
    """

    share: float
    share_error: float
    measured: bool
    source: str
    target: str
    omega: float
    effect: float
    verdict: Verdict = Verdict.CERTIFIED
    reason: str = ""
    figures: dict[str, Any] | None = None

    def as_table(self) -> dict[str, Any]:
        """What the certificate holds of it, as plain values."""
        found: dict[str, Any] = {"from": self.source, "to": self.target}
        found |= {name: getattr(self, name) for name in ("share", "share_error", "measured", "omega", "effect")}
        return {**found, "limit": MATTERS, "matters": self.effect > MATTERS}


def examine_cross_terms(law: Law, plant: PlantResponse, inner: Sequence[ReferenceModel]) -> CrossTerms:
    """The cross terms of a law of three axes, and the verdict on the loop with them.

    Parameters
    ----------
    law : Law
        Of three axes.
    plant : PlantResponse
        Of three axes, with the period of the law.
    inner : sequence of 3 ReferenceModel
        Of the rate loops.

    Raises
    ------
    TuningError
        When the response is known at too few frequencies.
    """
    known = plant.at(plant.known_run())
    if len(known.omega) < MIN_FREQUENCIES:
        raise TuningError(f"all three axes are known at fewer than {MIN_FREQUENCIES} frequencies in a row")
    body = rigid_body(known)
    found = _largest_share(known)
    plant = continued_below(known, body)
    effect = _effect(law, plant)
    if effect <= MATTERS:
        return CrossTerms(*found, effect)
    dense, nominal, draws = nominal_and_drawn_loops(law, plant)
    figures = stability_figures(float(loop_gain_above(law, known)[-1]), dense, nominal, draws, inner)
    unstable = [any(_encirclements(loop)) for loop in draws].count(True)
    verdict, reason = Verdict.CERTIFIED, ""
    slow = slow_growth(law, body.model(law.Ts), float(known.omega[0]))
    if any(_encirclements(nominal)) and unstable > DRAWS / 2:
        verdict = Verdict.UNSTABLE
        reason = f"the cross terms of {found[3]} and {found[4]} make the loop unstable, though each block is stable"
    elif unstable:
        verdict = Verdict.NOT_CERTIFIED
        reason = f"with the cross terms of yaw {unstable} of {DRAWS} plants within the log's error are unstable"
    elif slow is not None:
        verdict = Verdict.NOT_CERTIFIED
        reason = f"with the cross terms of yaw the loop around the fitted rigid body is unstable at {slow:.2g} rad/s"
    return CrossTerms(*found, effect, verdict, reason, figures)


def _largest_share(known: PlantResponse) -> tuple[float, float, bool, str, str, float]:
    """The first six fields of `CrossTerms`."""
    own = np.abs(np.diagonal(known.G_i, axis1=1, axis2=2))[:, None, :]
    share, deviation = np.abs(known.G_i) / own, known.deviation() / own
    beyond = np.where(CROSS, share - SURE * deviation, -np.inf)
    k, i, j = np.unravel_index(np.argmax(beyond), share.shape)
    found = float(share[k, i, j]), 2 * float(deviation[k, i, j]), bool(beyond[k, i, j] > 0)
    return *found, AXES[j], AXES[i], float(known.omega[k])


def _effect(law: Law, plant: PlantResponse) -> float:
    """Largest (|A| |B|)^(1/2), errors included; below the band of the fitted body, whose error is small there."""
    _, L, _ = whole_loop(law, plant)
    S_d: Complex = np.linalg.inv(np.eye(3) + np.where(CROSS, 0, L)).astype(np.complex128)
    _, C_o, C_y = cascade_response(law, plant.omega)
    # S_d has no cross terms, so those of S_d times the error of L are S_d times those of the error.
    rows = np.linalg.norm(S_d @ (C_y @ plant.rate_residual() + C_o @ plant.angle_residual()), axis=2)
    deviation = rows[:, :, None] * np.linalg.norm(plant.reach, axis=1)[:, None, :]
    cross = S_d @ np.where(CROSS, L, 0)
    sizes = [
        np.linalg.norm(cross[block], axis=1) + np.sqrt(2) * np.linalg.norm(deviation[block], axis=1)
        for block in (np.s_[:, :2, 2], np.s_[:, 2, :2])
    ]
    return float(np.sqrt(np.max(sizes[0] * sizes[1])))


def _encirclements(loop: CascadeLoop) -> tuple[int, int]:
    """Encirclements of 0 by det(I + L) / det(I + L_d): rate loop, whole cascade.

    Both integrators cancel in the quotient. It goes to a real number of either sign at low frequencies, where the
    vehicle is a rigid body, and to 1 above the band, where both loops vanish; each by the shortest way.
    """
    counts = []
    for L in (loop.L_i, loop.L_u):
        quotient = np.linalg.det(np.eye(3) + L) / np.linalg.det(np.eye(3) + np.where(CROSS, 0, L))
        change = float(np.sum(np.angle(quotient[1:] / quotient[:-1])))
        begin = float(np.angle(quotient[0] * np.sign(quotient[0].real)))
        counts.append(round((begin + change - float(np.angle(quotient[-1]))) / np.pi))
    return counts[0], counts[1]
