"""The reference models that a set of gains was made for."""

from __future__ import annotations

from mimopilot.tuning.gains import Gains
from mimopilot.tuning.reference_model import ReferenceModel, second_order

DEFAULT_INNER = (20.0, 0.4, 0)
DEFAULT_OUTER = (10.0, 0.7, 0)


def reference_models(gains: Gains, axis: int) -> tuple[ReferenceModel, ReferenceModel]:
    """Inner and outer model of an axis, from the gains' provenance; the thesis' own when they have none."""
    inner: tuple[float, float, int] = gains.provenance.get("inner_model", [DEFAULT_INNER, DEFAULT_INNER])[axis]
    outer: tuple[float, float, int] = gains.provenance.get("outer_model", [DEFAULT_OUTER, DEFAULT_OUTER])[axis]
    return second_order(*inner, gains.Ts), second_order(*outer, gains.Ts)
