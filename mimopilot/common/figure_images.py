"""Figures of `mimopilot.common.figures` as matplotlib draws them: PNG and SVG files."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from mimopilot.common.charts import PIXELS_PER_INCH, svg
from mimopilot.common.figures import Chart, HeatMap, Line, Panel, SpanMark, Spread
from mimopilot.common.files import inside, write_atomically

#: Width of a figure, inches, and pixels of `Panel.height` in an inch.
WIDTH, PIXELS = 9.0, 96.0
#: Letters of a legend in the whole width, and the thickest line in one, points.
LETTERS, THICKEST = 150, 3.0
#: Points of a line in a page's pixel.
POINTS = 0.75


def write_images(charts: Sequence[Chart], folder: Path) -> list[Path]:
    """Write every figure as PNG and SVG into a folder, which is made if it is missing.

    Returns
    -------
    list of Path
    """
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for chart in charts:
        figure, picture = chart_figure(chart), io.BytesIO()
        drawing = svg(figure, chart.name)  # which also computes the layout, once for both
        figure.savefig(picture, format="png", dpi=PIXELS_PER_INCH, metadata={"Software": None})
        for suffix, content in ((".png", picture.getvalue()), (".svg", drawing)):
            path = inside(folder, chart.name + suffix)
            write_atomically(path, content)
            written.append(path)
    return written


def chart_figure(chart: Chart) -> Figure:
    """A figure with all panels of its description."""
    rows = -(-len(chart.panels) // chart.columns)
    height = sum(
        max(panel.height for panel in chart.panels[row * chart.columns : (row + 1) * chart.columns])
        for row in range(rows)
    )
    figure = Figure(figsize=(WIDTH, height / PIXELS + 0.4), layout="constrained")
    grid: Any = figure.subplots(rows, chart.columns, squeeze=False)
    for axes, panel in zip(grid.flat, chart.panels, strict=False):
        _draw(axes, panel, figure, chart.columns)
    for axes in list(grid.flat)[len(chart.panels) :]:
        axes.set_visible(False)
    return figure


def _draw(axes: Any, panel: Panel, figure: Figure, columns: int) -> None:
    for item in panel.lines:
        if isinstance(item, HeatMap):
            low, high = item.z_range or (None, None)
            scale = {"cmap": "cividis", "vmin": low, "vmax": high}
            mesh = axes.pcolormesh(item.x, item.y, item.z, shading="nearest", rasterized=True, **scale)
            figure.colorbar(mesh, ax=axes, label=item.label)
        elif isinstance(item, Spread):
            shade = {"color": item.colour, "alpha": item.opacity, "linewidth": 0, "label": item.label or None}
            axes.fill_between(item.x, item.low, item.high, **shade)
        else:
            _draw_line(axes, item)
    for mark in panel.marks:
        if isinstance(mark, SpanMark):
            span = axes.axhspan if mark.across else axes.axvspan
            span(mark.begin, mark.end, color=mark.colour, alpha=mark.opacity, linewidth=0, label=mark.label or None)
        else:
            straight = axes.axvline if mark.upright else axes.axhline
            straight(mark.at, color=mark.colour, linestyle=mark.dash, linewidth=0.9)
            if mark.label:
                place = (mark.at, 0.98) if mark.upright else (0.99, mark.at)
                to = axes.get_xaxis_transform() if mark.upright else axes.get_yaxis_transform()
                turned = (
                    {"rotation": 90, "ha": "left", "va": "top"} if mark.upright else {"ha": "right", "va": "bottom"}
                )
                axes.text(*place, mark.label, transform=to, color=mark.colour, fontsize=7, clip_on=True, **turned)
    axes.set_xlabel(panel.x_label, fontsize=9)
    axes.set_ylabel(panel.y_label, fontsize=9)
    axes.set_xscale("log" if panel.log_x else "linear")
    axes.set_yscale("log" if panel.log_y else "linear")
    if panel.x_names:
        axes.set_xticks(range(len(panel.x_names)), panel.x_names, fontsize=8)
    if panel.y_names:
        axes.set_yticks(range(len(panel.y_names)), panel.y_names, fontsize=8)
        axes.set_ylim(*(panel.y_range or (-0.6, len(panel.y_names) - 0.4)))
    if panel.x_range:
        axes.set_xlim(*panel.x_range)
    if panel.y_range:
        axes.set_ylim(*panel.y_range)
    if panel.equal:
        axes.set_aspect("equal", adjustable="box" if panel.x_range else "datalim")
    axes.grid(alpha=0.3)
    _head(axes, panel.title, columns)


def _head(axes: Any, title: str, columns: int) -> None:
    """Title and legend above the axes, where they lie over no curve."""
    labels = axes.get_legend_handles_labels()[1]
    if not labels:
        axes.set_title(title, loc="left", fontsize=10)
        return
    # As many entries in a row as there is room for: the handle of an entry is as wide as four letters.
    fitting = int(LETTERS / columns / (max(map(len, labels)) + 4))
    place = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "borderaxespad": 0.2, "ncols": max(1, fitting)}
    legend = axes.legend(title=title, alignment="left", frameon=False, fontsize=7, title_fontsize=10, **place)
    for handle in legend.legend_handles:
        if isinstance(handle, Line2D):
            handle.set_linewidth(min(handle.get_linewidth(), THICKEST))


def _draw_line(axes: Any, line: Line) -> None:
    look = {
        "color": line.colour,
        "linestyle": line.dash if line.width > 0 else "none",
        "linewidth": POINTS * line.width,
        "marker": line.marker or None,
        "alpha": line.opacity,
        "label": line.label or None,
    }
    if line.error is not None:
        axes.errorbar(line.x, line.y, yerr=line.error, capsize=2, **look)
    else:
        axes.plot(line.x, line.y, drawstyle="steps-post" if line.step else "default", **look)
