"""Figures of `mimopilot.common.figures` as plotly.js draws them: plain values, and the script that draws them.

plotly.js comes with the Python package plotly and is embedded once; a page asks nothing of a network. The same figures
give the same bytes.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from mimopilot.common.figures import Chart, HeatMap, LimitLine, Line, Panel, SpanMark, Spread

#: matplotlib's line styles in plotly.
_DASHES = {"-": "solid", "--": "dash", ":": "dot", "-.": "dashdot"}
_MARKERS = {"o": "circle", "x": "x-thin-open", "s": "square"}
#: Largest deviation of x from equal steps, in steps, that is drawn as equal steps: a hundredth of a pixel.
_UNIFORM = 0.02
#: Colours of heat maps: even in lightness, for colour blindness and print.
SCALE = "Cividis"
#: Most significant digits of a coordinate in the page: finer than a pixel at any zoom that makes sense.
_DIGITS = 7


def plotly_script() -> str:
    """The text of plotly.js."""
    from plotly.offline import get_plotlyjs

    return str(get_plotlyjs())


def panel_id(chart: Chart, place: int) -> str:
    """Identifier of a panel's element in the page."""
    return f"{chart.name}-{place}"


def charts_json(charts: Sequence[Chart]) -> str:
    """All panels of some figures as JSON, for the script of the page: a list of id, data, layout, group."""
    panels = []
    for chart in charts:
        for place, panel in enumerate(chart.panels):
            group = chart.name if chart.linked and len(chart.panels) > 1 else ""
            panels.append({"id": panel_id(chart, place), "group": group, **panel_json(panel)})
    # "</" must not end the script element early.
    return json.dumps(panels, separators=(",", ":"), allow_nan=False).replace("</", "<\\/")


def panel_json(panel: Panel) -> dict[str, Any]:
    """``data`` and ``layout`` of one panel for plotly.js."""
    data: list[dict[str, Any]] = []
    for item in panel.lines:
        data += _heat(item) if isinstance(item, HeatMap) else _spread(item) if isinstance(item, Spread) else _line(item)
    axes = {
        "xaxis": _axis(panel.x_label, panel.log_x, panel.x_range, panel.x_names),
        "yaxis": _axis(panel.y_label, panel.log_y, panel.y_range, panel.y_names),
    }
    if panel.equal:
        axes["yaxis"] |= {"scaleanchor": "x", "scaleratio": 1}
    shapes: list[dict[str, Any]] = []
    notes: list[dict[str, Any]] = []
    for mark in panel.marks:
        if isinstance(mark, SpanMark):
            _add_span(mark, shapes)
        else:
            _add_limit(mark, panel, shapes, notes)
    return {
        "data": data,
        "layout": {**axes, "shapes": shapes, "annotations": notes},
        "height": panel.height,
    }


def _axis(label: str, log: bool, span: tuple[float, float] | None, names: Sequence[str]) -> dict[str, Any]:
    axis: dict[str, Any] = {"title": {"text": _text(label)}}
    if log:
        axis |= {"type": "log", "dtick": "D2" if span and span[1] < 20 * span[0] else 1}
    if span:
        axis["range"] = [_number(np.log10(value) if log else value) for value in span]
    if names:
        axis |= {"tickmode": "array", "tickvals": list(range(len(names))), "ticktext": [_text(n) for n in names]}
        axis["range"] = axis.get("range", [-0.6, len(names) - 0.4])
    return axis


def _line(line: Line) -> list[dict[str, Any]]:
    mode = "+".join(name for name, used in (("lines", line.width > 0), ("markers", bool(line.marker))) if used)
    trace: dict[str, Any] = {
        "type": "scatter",
        "mode": mode,
        **_abscissa(line.x),
        "y": _array(line.y),
        "opacity": line.opacity,
        **_legend(line.label),
    }
    if line.width > 0:
        trace["line"] = {"color": line.colour, "width": line.width, "dash": _DASHES[line.dash]}
        trace["line"] |= {"shape": "hv"} if line.step else {}
    if line.marker:
        trace["marker"] = {"color": line.colour, "symbol": _MARKERS[line.marker], "size": 8}
        trace["marker"] |= {"line": {"width": 2, "color": line.colour}} if line.marker == "x" else {}
    if line.error is not None:
        trace["error_y"] = {"type": "data", "array": _array(line.error), "color": line.colour, "thickness": 1.5}
    if line.text:
        trace["hovertext"] = [_text(one) for one in line.text]
        trace["hoverinfo"] = "text+x+y" if line.width == 0 else "text"
    return [trace]


def _spread(band: Spread) -> list[dict[str, Any]]:
    edge = {"type": "scatter", "mode": "lines", "line": {"width": 0}, "hoverinfo": "skip"}
    fill = _rgba(band.colour, band.opacity)
    pieces = []
    finite = np.isfinite(band.low) & np.isfinite(band.high)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], finite.astype(np.int8), [0]])))
    for number, (a, b) in enumerate(zip(edges[::2], edges[1::2], strict=True)):
        x, low, high = (np.asarray(values)[a:b] for values in (band.x, band.low, band.high))
        outline = {"x": _array(np.concatenate([x, x[::-1]])), "y": _array(np.concatenate([high, low[::-1]]))}
        pieces.append({**edge, **outline, "fill": "toself", "fillcolor": fill, **_legend("" if number else band.label)})
    return pieces


def _heat(heat: HeatMap) -> list[dict[str, Any]]:
    z = np.clip(np.round(np.asarray(heat.z)), -127, 127)
    packed = _packed(z.astype("<f4"), "f4") if np.isnan(z).any() else _packed(z.astype(np.int8), "i1")
    ends = dict(zip(("zmin", "zmax"), map(_number, heat.z_range), strict=True)) if heat.z_range else {}
    return [
        {
            "type": "heatmap",
            "x": _array(heat.x),
            "y": _array(heat.y),
            "z": packed,
            **ends,
            "colorscale": SCALE,
            "colorbar": {"title": {"text": _text(heat.label), "side": "right"}, "thickness": 10, "len": 1.0},
        }
    ]


def _add_span(mark: SpanMark, shapes: list[dict[str, Any]]) -> None:
    along, other = ("y", "x") if mark.across else ("x", "y")
    place = {f"{along}0": _number(mark.begin), f"{along}1": _number(mark.end), f"{other}0": 0, f"{other}1": 1}
    shapes.append(
        {
            "type": "rect",
            **place,
            f"{other}ref": "paper",
            "layer": "below",
            "line": {"width": 0},
            "fillcolor": _rgba(mark.colour, mark.opacity),
            "showlegend": bool(mark.label),
            "name": _text(mark.label),
        }
    )


def _add_limit(mark: LimitLine, panel: Panel, shapes: list[dict[str, Any]], notes: list[dict[str, Any]]) -> None:
    along, other = ("x", "y") if mark.upright else ("y", "x")
    place = {f"{along}0": _number(mark.at), f"{along}1": _number(mark.at), f"{other}0": 0, f"{other}1": 1}
    line = {"color": mark.colour, "width": 1.2, "dash": _DASHES[mark.dash]}
    shapes.append({"type": "line", **place, f"{other}ref": "paper", "line": line})
    if mark.label:
        log = panel.log_x if mark.upright else panel.log_y
        at = _number(np.log10(mark.at) if log else mark.at)
        where = (
            {"x": at, "y": 1, "yref": "paper", "xanchor": "left", "yanchor": "top", "textangle": 90}
            if mark.upright
            else {"x": 1, "xref": "paper", "y": at, "xanchor": "right", "yanchor": "bottom"}
        )
        notes.append({**where, "text": _text(mark.label), "showarrow": False, "font": {"color": mark.colour}})


def _legend(label: str) -> dict[str, Any]:
    return {"name": _text(label), "showlegend": bool(label)} if label else {"showlegend": False, "hoverinfo": "skip"}


def _abscissa(x: Any) -> dict[str, Any]:
    """Abscissa of a line; equal steps take two numbers."""
    if not isinstance(x, np.ndarray) or x.dtype.kind not in "fi" or len(x) < 3:
        return {"x": _array(x)}
    step = (x[-1] - x[0]) / (len(x) - 1)
    if step > 0 and np.all(np.abs(x - (x[0] + step * np.arange(len(x)))) <= _UNIFORM * step):
        return {"x0": _number(float(x[0])), "dx": _number(float(step))}
    return {"x": _array(x)}


def _array(values: Any) -> Any:
    """Numbers in single precision, as bytes that plotly.js reads."""
    return _packed(np.asarray(values, "<f4"), "f4")


def _packed(values: Any, kind: str) -> dict[str, str]:
    packed = {"dtype": kind, "bdata": base64.b64encode(np.ascontiguousarray(values).tobytes()).decode()}
    return packed | ({"shape": ", ".join(map(str, values.shape))} if values.ndim > 1 else {})


def _number(value: Any) -> float:
    return float(f"{float(value):.{_DIGITS}g}")


def _rgba(colour: str, opacity: float) -> str:
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},{opacity:g})"


def _text(text: str) -> str:
    """Text that plotly.js does not take for markup."""
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
