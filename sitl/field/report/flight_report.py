"""The report of flights: reads the logs, examines the gains, and writes the page and its figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mimopilot.common.charts import STYLES
from mimopilot.common.errors import Error
from mimopilot.common.extras import REPORT
from mimopilot.common.figures import Chart
from mimopilot.common.html_report import Headline, ReportTable, Section, write_report
from mimopilot.sitl.field.report.analysis.flight_data import GainCase, ReportedFlight, gain_cases, read_flights
from mimopilot.sitl.field.report.headline import headline, lead
from mimopilot.sitl.field.report.sections.compare import compare_section
from mimopilot.sitl.field.report.sections.frequency import frequency_section
from mimopilot.sitl.field.report.sections.gain_sets import gains_section
from mimopilot.sitl.field.report.sections.prediction import prediction_section
from mimopilot.sitl.field.report.sections.spectra import filter_section, flight_spectra, spectra_section
from mimopilot.sitl.field.report.sections.stability import stability_section
from mimopilot.sitl.field.report.sections.steps import step_section
from mimopilot.sitl.field.report.sections.timeline import contents_section, timeline_section
from mimopilot.sitl.field.report.sections.tracking import tracking_section
from mimopilot.tuning.gains import Gains
from mimopilot.tuning.logs.columns import Columns
from mimopilot.tuning.spec import TuningSpec

#: Bytes of a page, at most: what mail and a slow link carry. plotly.js has 4.8 MB of it.
LARGEST_PAGE = 6_000_000
#: Most logs of one page; a fifth colour is left for a gain set.
MOST_LOGS = 4


@dataclass(frozen=True, eq=False)
class FlightReport:
    """A report: its conclusion, its sections, and what they are made of."""

    title: str
    lead: str
    headline: Headline
    sections: list[Section]
    flights: list[ReportedFlight]
    cases: list[GainCase]

    @property
    def tables(self) -> list[ReportTable]:
        """The tables of all sections."""
        return [table for section in self.sections for table in section.tables]

    @property
    def charts(self) -> list[Chart]:
        """The figures of all sections."""
        return [chart for section in self.sections for chart in section.charts]

    def write(self, out: Path, figures: Path | None = None) -> list[Path]:
        """Write the page, and its figures as PNG and SVG into a folder; returns the files."""
        write_report(out, self.title, self.lead, self.sections, self.headline, LARGEST_PAGE)
        if figures is None:
            return [out]
        from mimopilot.common.figure_images import write_images

        return [out, *write_images(self.charts, figures)]


def check_count(logs: int, sets: int = 0) -> None:
    """Refuse more logs and gain sets than a page can show.

    Raises
    ------
    Error
    """
    if not 1 <= logs <= MOST_LOGS:
        raise Error(f"{logs} logs: a report has room for 1 to {MOST_LOGS}; make more than one")
    if logs + sets > len(STYLES):
        raise Error(
            f"{logs} logs and {sets} gain sets: a report has colours for {len(STYLES)} together; make more than one"
        )


def make_report(
    logs: Sequence[Path],
    sets: Sequence[tuple[str, Gains]] = (),
    spec: TuningSpec | None = None,
    columns: Columns | None = None,
) -> FlightReport:
    """The report of one flight, or of up to `MOST_LOGS` beside one another.

    Parameters
    ----------
    logs : sequence of Path
        The first is `before` where flights are compared.
    sets : sequence of (name, Gains)
        Shown beside the flown gains.
    spec : TuningSpec, optional
        Its margins are those that the certificates need.
    columns : Columns, optional
        Names and units in CSV and MATLAB files.

    Raises
    ------
    Error
        When there are too many logs, a file is no flight log, two sets have one name, or plotly is not installed.
    """
    REPORT.need()
    check_count(len(logs), len(sets))
    task = spec or TuningSpec()
    flights = read_flights(logs, columns)
    cases = gain_cases(flights, sets, task)
    spectra = [flight_spectra(flight) for flight in flights]
    compared = compare_section(spectra, cases)
    sections = [
        timeline_section(flights),
        *([compared] if compared else []),
        tracking_section(flights, [gains for _, gains in sets]),
        step_section(flights),
        gains_section(cases),
        prediction_section(cases),
        stability_section(cases, task.certificate),
        frequency_section(flights, cases),
        spectra_section(spectra),
        filter_section(spectra, cases, task.certificate),
        contents_section(flights),
    ]
    title = " and ".join(flight.label for flight in flights)
    return FlightReport(f"mimopilot report: {title}", lead(flights), headline(flights, cases), sections, flights, cases)
