"""Figures of `mimopilot.common.figures` as JSON values, for work whose results are kept and drawn later."""

from __future__ import annotations

import base64
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from mimopilot.common.figures import Chart, HeatMap, LimitLine, Line, Panel, SpanMark, Spread

#: Name -> class of everything that a figure is made of.
_KINDS: dict[str, type] = {one.__name__: one for one in (Chart, Panel, Line, Spread, HeatMap, SpanMark, LimitLine)}
#: Keys of a part's class, and of an array's values and shape.
_KIND, _VALUES, _SHAPE = "kind", "f4", "shape"


def chart_to_json(chart: Chart) -> dict[str, Any]:
    """The figure as a JSON value; arrays in single precision, which is what a page draws."""
    value: dict[str, Any] = _to_json(chart)
    return value


def chart_from_json(value: dict[str, Any]) -> Chart:
    """The figure from `chart_to_json`."""
    found = _from_json(value)
    assert isinstance(found, Chart)
    return found


def _to_json(value: Any) -> Any:
    if is_dataclass(value):
        parts = {field.name: _to_json(getattr(value, field.name)) for field in fields(value)}
        return {_KIND: type(value).__name__, **parts}
    if isinstance(value, np.ndarray):
        single = np.ascontiguousarray(value, "<f4")
        return {_VALUES: base64.b64encode(single.tobytes()).decode(), _SHAPE: list(single.shape)}
    return [_to_json(one) for one in value] if isinstance(value, list | tuple) else value


def _from_json(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(_from_json(one) for one in value)
    if not isinstance(value, dict):
        return value
    if _VALUES in value:
        return np.frombuffer(base64.b64decode(value[_VALUES]), "<f4").reshape(value[_SHAPE])
    return _KINDS[value[_KIND]](**{name: _from_json(part) for name, part in value.items() if name != _KIND})
