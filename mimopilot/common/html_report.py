"""Self-contained HTML reports: tables, inline SVG and interactive figures; no external resources, no date."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import jinja2

from mimopilot.common.errors import Error
from mimopilot.common.figures import MOST_SAMPLES, Chart, reduced
from mimopilot.common.files import write_atomically

#: Characters of a table's cell above which it is a sentence and folded.
LONGEST_CELL = 40
#: Samples of a line below which a figure is of no use.
FEWEST_SAMPLES = 100
#: Share of the samples that is left where a page is too large; chosen: a step takes a fraction of a second.
FEWER = 0.8

TEMPLATE = Path(__file__).with_name("html_report.html.jinja")


@dataclass(frozen=True)
class ReportTable:
    """Caption, column headings and rows of text."""

    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]

    @property
    def wordy(self) -> set[int]:
        """Columns that hold sentences, which are folded and left-aligned."""
        return {place for row in self.rows for place, cell in enumerate(row) if len(cell) > LONGEST_CELL}


@dataclass(frozen=True)
class Section:
    """Heading, paragraph, points, interactive figures, tables, and figures as SVG text."""

    heading: str
    text: str = ""
    tables: Sequence[ReportTable] = ()
    figures: Sequence[str] = ()
    charts: Sequence[Chart] = ()
    points: Sequence[str] = ()

    @property
    def anchor(self) -> str:
        """Identifier of the heading in the page."""
        return re.sub(r"[^a-z0-9]+", "-", self.heading.lower()).strip("-")


@dataclass(frozen=True)
class Headline:
    """The conclusion at the top: a sentence, what to do next, a colour, and what the conclusion rests on.

    The colour is ``good``, ``doubt`` or ``bad``.
    """

    sentence: str
    steps: Sequence[str] = ()
    tone: str = "doubt"
    notes: Sequence[str] = ()


def write_report(
    path: Path,
    title: str,
    lead: str,
    sections: Sequence[Section],
    headline: Headline | None = None,
    largest: int | None = None,
) -> None:
    """Render a report and write it atomically.

    Parameters
    ----------
    path : Path
        The HTML file.
    title, lead : str
        Heading and first paragraph.
    sections : sequence of Section
        In their order on the page.
    headline : Headline, optional
        Conclusion above the first paragraph.
    largest : int, optional
        Bytes of the page, at most: its figures are drawn with fewer samples, step by step, until they fit.

    Raises
    ------
    Error
        When they do not fit with `FEWEST_SAMPLES` either.
    """
    text, samples = _page(title, lead, sections, headline), MOST_SAMPLES
    while largest is not None and len(text.encode()) > largest:
        samples = int(FEWER * samples)
        if samples < FEWEST_SAMPLES:
            raise Error(
                f"{path.name}: the page would have more than {largest / 1e6:g} MB; name fewer logs or gain sets"
            )
        sections = [replace(one, charts=[reduced(chart, samples) for chart in one.charts]) for one in sections]
        text = _page(title, lead, sections, headline)
    write_atomically(path, text)


def _page(title: str, lead: str, sections: Sequence[Section], headline: Headline | None) -> str:
    charts = [chart for section in sections for chart in section.charts]
    drawing = {}
    if charts:  # plotly.js has nearly 5 MB: a page without interactive figures does not carry it
        from mimopilot.common.plotly_page import charts_json, panel_id, plotly_script

        drawing = {"plotly": plotly_script(), "panels": charts_json(charts), "panel_id": panel_id}
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, autoescape=True, trim_blocks=True)
    template = environment.from_string(TEMPLATE.read_text())
    return template.render(title=title, lead=lead, sections=sections, headline=headline, **drawing)
