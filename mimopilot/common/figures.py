"""Description of a figure, independent of how it is drawn.

`mimopilot.common.plotly_page` draws it in an interactive page, `mimopilot.common.figure_images` as PNG and SVG.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mimopilot.common.charts import LIMIT

Signal = NDArray[np.float64]

#: Most samples of a drawn line: at 600 pixels more cannot be told apart, and a page holds some hundred lines.
MOST_SAMPLES = 1600
#: Cells of a heat map for each sample of a line where figures are reduced: a cell takes an eighth of a sample's bytes.
CELLS = 8


@dataclass(frozen=True, eq=False)
class Line:
    """A line, or markers, through points; NaN interrupts it.

    Attributes
    ----------
    x, y : (N,) arrays
        In the panel's units.
    label : str
        In the legend; empty: not in it.
    colour : str
        As #RRGGBB.
    dash : str
        As in matplotlib: ``-``, ``--``, ``:``, ``-.``.
    width : float, px
        0: markers only.
    marker : str
        Empty, ``o``, ``x`` or ``s``.
    step : bool
        Each value holds until the next.
    error : (N,) array or None
        Half length of the error bars.
    text : sequence of str
        What is shown when the pointer is on a point, beside its coordinates.
    opacity : float
    """

    x: Any
    y: Any
    label: str = ""
    colour: str = "#1a1a1a"
    dash: str = "-"
    width: float = 1.6
    marker: str = ""
    step: bool = False
    error: Any = None
    text: Sequence[str] = ()
    opacity: float = 1.0


@dataclass(frozen=True, eq=False)
class Spread:
    """A filled band between two curves: x, low, high (N,)."""

    x: Any
    low: Any
    high: Any
    label: str = ""
    colour: str = "#888888"
    opacity: float = 0.22


@dataclass(frozen=True, eq=False)
class HeatMap:
    """Values z (len(y), len(x)) as colours, in whole steps of the unit that `label` names; NaN has none.

    `z_range` are the values at the ends of the scale; None: the least and the largest.
    """

    x: Any
    y: Any
    z: Any
    label: str
    z_range: tuple[float, float] | None = None


@dataclass(frozen=True)
class SpanMark:
    """A shaded stretch of the x axis, or of the y axis where `across` is true."""

    begin: float
    end: float
    label: str = ""
    colour: str = "#009E73"
    across: bool = False
    opacity: float = 0.10


@dataclass(frozen=True)
class LimitLine:
    """A straight line across the panel at a value of y, or of x where `upright` is true."""

    at: float
    label: str = ""
    colour: str = LIMIT
    upright: bool = False
    dash: str = "--"


@dataclass(frozen=True, eq=False)
class Panel:
    """One pair of axes.

    Attributes
    ----------
    title, x_label, y_label : str
        With units.
    lines : sequence of Line, Spread or HeatMap
        Drawn in this order.
    marks : sequence of SpanMark or LimitLine
    log_x, log_y : bool
    equal : bool
        One unit of x is as long as one of y.
    x_range, y_range : (low, high) or None
        None: as wide as the data.
    y_names, x_names : sequence of str
        Names of the values 0, 1, 2... instead of numbers.
    height : int, px
    """

    title: str
    x_label: str
    y_label: str
    lines: Sequence[Line | Spread | HeatMap]
    marks: Sequence[SpanMark | LimitLine] = ()
    log_x: bool = False
    log_y: bool = False
    equal: bool = False
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    y_names: Sequence[str] = ()
    x_names: Sequence[str] = ()
    height: int = 260


@dataclass(frozen=True, eq=False)
class Chart:
    """A figure: panels in rows, with one caption.

    Attributes
    ----------
    name : str
        Name of its file, unique within a report: letters, digits and hyphens.
    caption : str
        What is shown and how to read it.
    panels : sequence of Panel
        Row by row.
    columns : int
        Panels beside one another on a wide page; 1 on a phone.
    linked : bool
        Zooming along x in one panel zooms the others, too.
    """

    name: str
    caption: str
    panels: Sequence[Panel] = field(default_factory=tuple)
    columns: int = 2
    linked: bool = True


def thinned(x: Signal, y: Signal, most: int = MOST_SAMPLES) -> tuple[Signal, Signal]:
    """At most about `most` samples of a line that looks the same: the least and the largest value of each stretch.

    Parameters
    ----------
    x, y : (N,) arrays
        NaN in y stays a gap.
    most : int

    Returns
    -------
    x, y : (M,) arrays
        Equally spaced stretches, so that a uniform x stays uniform.
    """
    if len(y) <= most:
        return np.asarray(x, np.float64), np.asarray(y, np.float64)
    # A stretch is an even number of samples: its two values take places half a stretch apart.
    length = 2 * int(np.ceil(len(y) / most))
    count = len(y) // length
    pieces = np.asarray(y[: count * length], np.float64).reshape(count, length)
    gaps = np.isnan(pieces)
    low, high = np.where(gaps, np.inf, pieces), np.where(gaps, -np.inf, pieces)
    lowest, highest = low.argmin(axis=1), high.argmax(axis=1)
    values = np.column_stack([low.min(axis=1), high.max(axis=1)])
    falling = highest < lowest
    values[falling] = values[falling, ::-1]
    values[gaps.any(axis=1)] = np.nan
    places = (np.arange(count) * length)[:, None] + np.array([0, length // 2])
    return np.asarray(x, np.float64)[places.ravel()], values.ravel()


def reduced(chart: Chart, most: int) -> Chart:
    """The figure with at most about `most` samples of each line and band, and `CELLS` times as many of a heat map."""
    panels = [replace(panel, lines=[_reduced(one, most) for one in panel.lines]) for panel in chart.panels]
    return replace(chart, panels=panels)


def _reduced(item: Line | Spread | HeatMap, most: int) -> Line | Spread | HeatMap:
    if isinstance(item, HeatMap):
        return _coarser(item, CELLS * most)
    every = -(-len(item.x) // most)
    if every <= 1:
        return item
    if isinstance(item, Spread):
        return replace(item, x=item.x[::every], low=item.low[::every], high=item.high[::every])
    if not item.marker and not item.text and np.all(np.diff(np.asarray(item.x, np.float64)) > 0):
        x, y = thinned(item.x, item.y, most)
        return replace(item, x=x, y=y)
    error = None if item.error is None else item.error[::every]
    return replace(item, x=item.x[::every], y=item.y[::every], text=item.text[::every], error=error)


def _coarser(heat: HeatMap, cells: int) -> HeatMap:
    """The largest value of each block of cells, so that tones stay."""
    x, y, z = (np.asarray(values, np.float64) for values in (heat.x, heat.y, heat.z))
    while z.size > cells and min(z.shape) > 1:
        along = int(z.shape[1] >= z.shape[0])
        even = z.shape[along] // 2 * 2
        first, second = (np.take(z, np.arange(start, even, 2), axis=along) for start in (0, 1))
        z = np.fmax(first, second)
        if along:
            x = (x[0:even:2] + x[1:even:2]) / 2
        else:
            y = (y[0:even:2] + y[1:even:2]) / 2
    return replace(heat, x=x, y=y, z=z)
