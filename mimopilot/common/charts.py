"""Style of all figures, and their output as self-contained SVG."""

from __future__ import annotations

import io
from collections.abc import Sequence

import matplotlib
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

#: One colour for one thing in every report, from Okabe and Ito's palette (distinguishable with colour blindness): the
#: gains or the flight that were, the same design axis by axis, the new ones with full matrices, and one more set.
FLOWN, SISO, NEW, FURTHER = "#D55E00", "#0072B2", "#009E73", "#CC79A7"
#: A fifth set or flight.
FIFTH = "#E69F00"
#: Setpoints, reference models, limits and marks.
SETPOINT_COLOUR, MODEL_COLOUR, LIMIT = "#1a1a1a", "#888888", "#B00020"
#: Roll, pitch and yaw side by side, and what is injected; of P. Tol's palette, apart from the colours of gain sets.
AXIS_COLOURS, INJECTED = ("#56B4E9", "#999933", "#332288"), "#882255"
#: What a gain set or a flight is.
IS_FLOWN, IS_SISO, IS_NEW = "flown", "siso", "new"
#: The looks of gain sets, each with its own line style, for print: flown, SISO, new, and further ones.
STYLES: tuple[tuple[str, str], ...] = ((FLOWN, ":"), (SISO, "--"), (NEW, "-"), (FURTHER, "-."), (FIFTH, ":"))
#: Resolution of rasterised parts; chosen.
PIXELS_PER_INCH = 160


def looks(kinds: Sequence[str]) -> list[tuple[str, str]]:
    """Colour and line style of gain sets or flights by what they are; of two of one kind, the second has another look.

    Parameters
    ----------
    kinds : sequence of str
        `IS_FLOWN`, `IS_SISO` or `IS_NEW`.

    Examples
    --------
    >>> looks([IS_SISO, IS_NEW, IS_NEW]) == [STYLES[1], STYLES[2], STYLES[3]]
    True
    """
    own = dict(zip((IS_FLOWN, IS_SISO, IS_NEW), STYLES, strict=False))
    taken = {own[kind] for kind in kinds}
    # Looks of kinds that do not occur come last: they stand for something else in other reports.
    spare = [*STYLES[len(own) :], *(look for look in own.values() if look not in taken)]
    found: list[tuple[str, str]] = []
    for kind in kinds:
        look = own[kind] if own[kind] not in found else next((one for one in spare if one not in found), own[kind])
        found.append(look)
    return found


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
