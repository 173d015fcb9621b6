"""The design for a stock controller: what it starts from, at which rates it is certified, and what it cannot do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from mimopilot.tuning.axes import Law, axes_slice
from mimopilot.tuning.control_laws import control_law
from mimopilot.tuning.design.prediction import Prediction
from mimopilot.tuning.design.response_design import Design, ResponseDesign
from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.experiment import Experiment
from mimopilot.tuning.gains import Gains, Matrix
from mimopilot.tuning.law_filters import MIMO
from mimopilot.tuning.law_terms import LOOP_TERMS
from mimopilot.tuning.logs.flown_gains import LACKING, LOOP_RATE
from mimopilot.tuning.logs.imported_gains import SAME_RATE
from mimopilot.tuning.spec import TuningSpec

#: Significant digits of the gains for a stock controller: as a user types them into a ground station.
DIGITS = 4
#: Details of a gain set's origin: what the off-diagonals of our module would bring.
WORTH = "worth_of_off_diagonals"


AnyLaw = TypeVar("AnyLaw", bound=Law)


def check_profile(experiment: Experiment, spec: TuningSpec) -> None:
    """Refuse a log whose flight was not with the controller that the gains are for.

    Raises
    ------
    TuningError
        When it was not, or when the log does not say which filters flew.
    """
    if spec.profile == MIMO:
        return
    flown = experiment.flown
    if flown is not None and flown.controller == spec.profile:
        largest = control_law(flown.filters).largest
        if "F" in spec.structure and largest is not None and not any(largest[LOOP_TERMS["F"].matrix]):
            raise TuningError(
                f"structure: got {spec.structure}, but the {spec.profile} controller has no F; leave it out"
            )
        return
    lacking = flown.provenance.details.get(LACKING) if flown is not None else None
    if lacking:
        raise TuningError(
            f"{experiment.source}: lacks {', '.join(lacking)}, filters of the {spec.profile} controller; log all "
            "parameters and fly again"
        )
    what = "its parameters hold no complete set of gains" if flown is None else f"it flew {flown.controller} gains"
    raise TuningError(
        f"{experiment.source}: {what}; gains for {spec.profile} are designed from a flight with that controller"
    )


def stock_starts(base: Gains, experiment: Experiment, omega: float, B: Matrix) -> list[Gains]:
    """Gain sets that the search begins at: the flown one, and one for the rigid body.

    Parameters
    ----------
    base : Gains
        Filters, limits and yaw.
    experiment : Experiment
    omega : float, rad/s
        Bandwidth of the rate loop.
    B : (2, 2) array, rad/s^2
        Control effectiveness.
    """
    assert experiment.flown is not None  # see check_profile
    proportional = np.diag(omega / np.diag(B))
    rigid = replace(base, Kp_o=omega / 3 * np.eye(2), Kp_i=proportional, Ki_i=proportional)
    names = ("Kp_o", *(term.matrix for term in LOOP_TERMS.values()))
    flown: dict[str, Any] = {name: getattr(experiment.flown, name) for name in names}
    return [replace(base, **flown), rigid]


def in_digits(law: AnyLaw) -> AnyLaw:
    """A stock law with its gains rounded to `DIGITS` or to its steps, within the autopilot's ranges; ours as it is."""
    largest = control_law(law.filters).largest
    if largest is None:
        return law

    def rounded(name: str) -> Matrix:
        values = np.diag(getattr(law, name))
        tops = np.array(largest[name])[axes_slice(len(values))].tolist()
        step = control_law(law.filters).step.get(name)
        digits = [step * round(value / step) if step else float(f"{value:.{DIGITS}g}") for value in values]
        digits = [min(digits)] * len(digits) if name in control_law(law.filters).shared else digits
        return np.diag([min(max(v, 0.0), top) for v, top in zip(digits, tops, strict=True)])

    changed: dict[str, Any] = {name: rounded(name) for name in largest}
    return replace(law, **changed)


def at_loop_rates(law: AnyLaw, experiment: Experiment) -> list[AnyLaw]:
    """The law at the control rate of the log and, if the parameters of a stock one say another, at that.

    A log may leave out samples, and a simulated vehicle may be slower than its parameter.
    """
    details = experiment.flown.provenance.details if experiment.flown is not None else {}
    rate = details.get(LOOP_RATE)
    if law.filters.stock is None or not rate or abs(rate * law.Ts - 1) <= SAME_RATE:
        return [law]
    return [law, replace(law, filters=replace(law.filters, Ts=1 / rate))]


def our_module(found: Design, bench: ResponseDesign, spec: TuningSpec) -> Design:
    """The design of full matrices in our law for the same attitude model, around the same plants."""
    start = found.gains.for_our_law()
    return bench.design([start], spec.structure, full=True, bandwidth=found.model.omega)


def worth(predicted: Mapping[str, Sequence[Prediction]]) -> dict[str, list[list[float]]]:
    """Predicted RMS (deg) of the other axis in roll and in pitch doublets, by gain set; one pair for each log."""
    return {name: [list(one.offaxis_deg) for one in figures] for name, figures in predicted.items()}
