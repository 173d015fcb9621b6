"""Self-contained HTML reports: tables and inline SVG figures; no external resources, no date."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jinja2

from mimopilot.common.files import write_atomically

TEMPLATE = Path(__file__).with_name("html_report.html.jinja")


@dataclass(frozen=True)
class ReportTable:
    """Caption, column headings and rows of text."""

    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Section:
    """Heading, paragraph, tables, and figures as SVG text."""

    heading: str
    text: str = ""
    tables: Sequence[ReportTable] = ()
    figures: Sequence[str] = ()


def write_report(path: Path, title: str, lead: str, sections: Sequence[Section]) -> None:
    """Render a report and write it atomically.

    Parameters
    ----------
    path : Path
        The HTML file.
    title, lead : str
        Heading and first paragraph.
    sections : sequence of Section
        In their order on the page.
    """
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, autoescape=True, trim_blocks=True)
    template = environment.from_string(TEMPLATE.read_text())
    write_atomically(path, template.render(title=title, lead=lead, sections=sections))
