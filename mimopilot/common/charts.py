"""How all figures look: colours that survive colour-blindness and print, as self-contained SVG."""

from __future__ import annotations

import io

import matplotlib
from matplotlib.figure import Figure

#: Okabe-Ito colours, each with a line style of its own.
STYLES: tuple[tuple[str, str], ...] = (("#D55E00", ":"), ("#0072B2", "--"), ("#009E73", "-"), ("#CC79A7", "-."))
#: Of what is drawn as pixels.
PIXELS_PER_INCH = 160


def svg(figure: Figure, name: str) -> str:
    """The figure as SVG text; the same data give the same bytes. `name` keeps ids apart within one page."""
    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": f"mimopilot {name}"}):
        figure.savefig(buffer, format="svg", dpi=PIXELS_PER_INCH, metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]
