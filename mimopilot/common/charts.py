"""Style of all figures, and their output as self-contained SVG."""

from __future__ import annotations

import io

import matplotlib
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

#: Okabe-Ito colours (distinguishable with colour blindness); each has its own line style, for print.
STYLES: tuple[tuple[str, str], ...] = (("#D55E00", ":"), ("#0072B2", "--"), ("#009E73", "-"), ("#CC79A7", "-."))
#: Resolution of rasterised parts; chosen.
PIXELS_PER_INCH = 160


def svg(figure: Figure, name: str) -> str:
    """The figure as SVG text; the same data give the same bytes. `name` makes the ids unique within a page."""
    buffer = io.StringIO()
    if (layout := figure.get_layout_engine()) is not None:
        layout.execute(figure)
    figure.set_layout_engine("none")
    # `Figure.savefig` would draw three times as much: once for the layout, once to no purpose, once for the file.
    figure.set_dpi(PIXELS_PER_INCH)
    with matplotlib.rc_context({"svg.hashsalt": f"mimopilot {name}"}):
        FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]
