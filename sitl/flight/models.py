"""The reference models that a set of gains was made for."""

from __future__ import annotations

from mimopilot.tuning.gains import Gains
from mimopilot.tuning.reference_model import ReferenceModel, SecondOrder

#: The thesis' own, for both axes.
DEFAULT_INNER = (SecondOrder(20.0, 0.4),) * 2
DEFAULT_OUTER = (SecondOrder(10.0, 0.7),) * 2


def reference_models(gains: Gains, axis: int) -> tuple[ReferenceModel, ReferenceModel]:
    """Inner and outer model of an axis, from the gains' provenance; the thesis' own when they have none."""
    inner = (gains.provenance.inner_model or DEFAULT_INNER)[axis]
    outer = (gains.provenance.outer_model or DEFAULT_OUTER)[axis]
    return inner.discretise(gains.Ts), outer.discretise(gains.Ts)
