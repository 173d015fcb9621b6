"""The page of a report in a real browser, its images, and the commands that write it."""

import base64
import json
import re
from pathlib import Path

import numpy as np
import pytest

import mimopilot as mp
from mimopilot.common.charts import AXIS_COLOURS, FLOWN, INJECTED, NEW, SISO, STYLES
from mimopilot.common.errors import Error
from mimopilot.common.figure_images import chart_figure
from mimopilot.common.figures import Chart, HeatMap, Line, Panel, Spread, thinned
from mimopilot.common.html_report import Section, write_report
from mimopilot.common.plotly_page import charts_json, plotly_script
from mimopilot.sitl.field.report.analysis.flight_data import PHASES, ReportedFlight
from mimopilot.sitl.field.report.analysis.further_signals import FurtherSignals
from mimopilot.sitl.field.report.flight_report import LARGEST_PAGE, MOST_LOGS, check_count, make_report
from mimopilot.sitl.field.report.sections.timeline import contents_section, timeline_section
from mimopilot.sitl.studies.reproduce import reproduce
from mimopilot.tuning.logs.inspection import Inspection
from mimopilot.tuning.logs.recording import Recording
from mimopilot.tuning.logs.resample import Series
from tests.conftest import assert_one_clear_line
from tests.sitl.field.report.chromium import Chromium
from tests.tuning.logs.flights import make_flight, table, write_csv

#: Sections of every report, in their order.
HEADINGS = (
    "Timeline",
    "Setpoint and response",
    "Step response",
    "Gains",
    "Predicted motion",
    "Stability and margins",
    "Frequency response of the vehicle",
    "Spectra and vibration",
    "Filters",
    "What the log holds",
)


@pytest.fixture(scope="module")
def folder(bench, tmp_path_factory):
    """The pages of the bench flight and of a log of attitudes alone."""
    path = tmp_path_factory.mktemp("report")
    bench[2].write(path / "flight.html")
    columns = table(make_flight(seconds=30.0, Ts=0.02))
    write_csv(path / "slow.csv", {name: columns[name] for name in ("t", "roll", "pitch", "roll_sp", "pitch_sp")})
    mp.report(path / "slow.csv", path / "slow.html", figures=path / "pictures")
    reproduce("numerical-example", path)
    return path


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with Chromium(tmp_path_factory.mktemp("profile")) as found:
        yield found


@pytest.mark.parametrize(
    ("page", "wanted"),
    [("flight", HEADINGS), ("slow", HEADINGS), ("numerical-example", ("Table 5.3 and Figure 5.3",))],
    ids=["flight", "slow", "study"],
)
@pytest.mark.parametrize("width", [1280, 390])
def test_a_page_draws_all_its_figures_without_error_request_or_sideways_scroll(folder, browser, page, wanted, width):
    browser.errors.clear()
    browser.requests.clear()
    path = folder / f"{page}.html"
    browser.open(path, width)
    panels = int(browser.value("document.querySelectorAll('.panel').length"))
    assert panels == int(browser.value("document.documentElement.dataset.drawn"))
    drawn = browser.value("[...document.querySelectorAll('.panel .js-plotly-plot')].filter(p => p.data.length).length")
    assert drawn == panels > 3
    assert browser.value("document.querySelectorAll('.panel path.js-line, .panel .heatmaplayer image').length") > panels
    assert browser.value("document.documentElement.scrollWidth") <= width
    widest = "Math.max(...[...document.querySelectorAll('.panel')].map(p => p.getBoundingClientRect().right))"
    assert browser.value(widest) <= width
    assert browser.errors == []
    assert {address for address in browser.requests if not address.startswith("data:")} == {path.resolve().as_uri()}
    headings = json.loads(browser.value("JSON.stringify([...document.querySelectorAll('h2')].map(h => h.textContent))"))
    assert [heading for heading in headings if heading in wanted] == list(wanted)


def test_zooming_a_panel_zooms_those_beside_it(folder, browser):
    browser.open(folder / "flight.html", 1280)
    zoom = "Plotly.relayout('tracking-1-0', {'xaxis.range[0]': 2, 'xaxis.range[1]': 3}).then(() => new Promise(r => "
    browser.value(f"{zoom}setTimeout(r, 300)))")
    shown = browser.value("document.getElementById('tracking-1-3').layout.xaxis.range.join()")
    assert shown == "2,3"


def test_a_page_prints_without_a_heading_at_the_end_of_a_sheet(folder, browser):
    from pypdf import PdfReader

    browser.open(folder / "flight.html", 1280)
    browser.print_to(folder / "flight.pdf")
    sheets = [page.extract_text().strip().splitlines() for page in PdfReader(folder / "flight.pdf").pages]
    assert 4 <= len(sheets) < 25
    text = "\n".join("\n".join(lines) for lines in sheets)
    for heading in HEADINGS:
        assert heading in text
    for lines in sheets:
        assert lines
        assert lines[-1].strip() not in HEADINGS
    assert browser.errors == []


def test_the_same_log_gives_the_same_bytes_within_the_size_of_a_page(folder, tmp_path):
    again = tmp_path / "again.html"
    mp.report(folder / "slow.csv", again)
    assert again.read_bytes() == (folder / "slow.html").read_bytes()
    for name in ("flight", "slow"):
        assert (folder / f"{name}.html").stat().st_size < LARGEST_PAGE


def test_a_page_with_too_many_samples_is_drawn_with_fewer_until_it_fits(tmp_path):
    x = np.arange(1600.0)
    wave, curve = np.sin(x), np.exp(0.01j * x)
    lines = [
        Line(x, np.where(x == 700, 9.0, wave)),
        Line(curve.real, curve.imag, text=[f"{one:g} rad/s" for one in x]),
        Spread(x, wave, wave + 1),
        HeatMap(np.arange(256.0), np.arange(128.0), np.arange(128.0)[:, None] * np.ones(256), "dB"),
    ]
    sections = [Section("Many", charts=[Chart(f"chart-{k}", "", [Panel("x", "", "", lines)]) for k in range(2)])]
    page, largest = tmp_path / "page.html", len(plotly_script().encode()) + 60_000
    write_report(page, "Many", "", sections, largest=largest)
    text = page.read_text()
    assert largest - 30_000 < len(text.encode()) <= largest < LARGEST_PAGE
    shown = json.loads(text.split('id="panels">')[1].split("</script>")[0])[0]["data"]
    samples = [np.frombuffer(base64.b64decode(one["y"]["bdata"]), "<f4") for one in shown]
    assert samples[0].max() == 9.0
    assert len(samples[1]) == len(shown[1]["hovertext"])
    assert all(100 <= len(one) <= 1600 for one in samples[:2])
    with pytest.raises(Error, match="name fewer logs or gain sets"):
        write_report(page, "Many", "", sections, largest=largest - 50_000)
    assert page.read_text() == text


def test_a_log_given_twice_is_refused_and_logs_of_one_name_are_told_apart(folder, tmp_path, monkeypatch):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "slow.csv").write_bytes((folder / "slow.csv").read_bytes())
    (tmp_path / "slow.csv").symlink_to(folder / "slow.csv")
    with pytest.raises(Error, match=r"slow\.csv: given twice"):
        make_report([folder / "slow.csv", tmp_path / "slow.csv"])
    monkeypatch.chdir(tmp_path / "a")
    report = make_report([Path("slow.csv"), folder / "slow.csv"])
    assert [flight.label for flight in report.flights] == ["a/slow.csv", f"{folder.name}/slow.csv"]


def test_the_images_are_those_of_the_page(folder):
    names = re.findall(r'id="([a-z0-9-]+)-0" style', (folder / "slow.html").read_text())
    assert {path.stem for path in (folder / "pictures").glob("*.png")} == set(names)
    assert {path.stem for path in (folder / "pictures").glob("*.svg")} == set(names)
    assert (folder / "pictures" / "tracking-1.png").read_bytes()[:4] == b"\x89PNG"
    assert FLOWN.lower() in (folder / "pictures" / "tracking-1.svg").read_text().lower()


@pytest.mark.parametrize("name", ["timeline-1", "sensitivity", "predicted-motion"])
def test_legends_of_images_lie_over_no_curve(bench, name):
    chart = next(one for one in bench[2].charts if one.name == name)
    figure = chart_figure(chart)
    figure.draw_without_rendering()
    shown = figure.axes[: len(chart.panels)]
    boxes = [axes.get_window_extent() for axes in shown]
    legends = [axes.get_legend().get_window_extent() for axes in shown if axes.get_legend()]
    assert legends
    # An edge that both share does not count.
    assert not [one for one in legends for box in boxes if one.overlaps(box.shrunk(0.99, 0.98))]


def test_one_thing_has_one_colour(bench):
    report = bench[2]
    assert [(case.label, case.colour) for case in report.cases] == [("flown", FLOWN), ("my", NEW)]
    assert [colour for colour, _ in STYLES[:3]] == [FLOWN, SISO, NEW]
    assert not {colour for colour, _ in STYLES} & {*AXIS_COLOURS, INJECTED, *PHASES.values()}
    for chart in report.charts:
        for panel in chart.panels:
            for line in panel.lines:
                if getattr(line, "label", "") in ("flown", "my"):
                    assert line.colour == {"flown": FLOWN, "my": NEW}[line.label], chart.name


def test_two_flights_are_compared_on_the_same_axes_with_their_difference(folder, tmp_path):
    fast, slow = tmp_path / "before.csv", tmp_path / "after.csv"
    columns = table(make_flight(seconds=30.0, Ts=0.01))
    write_csv(fast, columns)
    columns["roll"] = 0.5 * columns["roll"]
    write_csv(slow, columns)
    report = make_report([fast, slow])
    section = next(one for one in report.sections if one.heading == "Before and after")
    rows = {row[0]: row[1:] for row in section.tables[0].rows}
    before, after, difference, share = rows["roll: RMS of the angle's error [deg]"]
    errors = [np.degrees(columns["roll_sp"] - factor * columns["roll"]) for factor in (2.0, 1.0)]
    assert [float(before), float(after)] == pytest.approx([np.sqrt(np.mean(one**2)) for one in errors], rel=5e-3)
    assert float(difference) == pytest.approx(float(after) - float(before), abs=0.01)
    sizes = [np.sqrt(np.mean(one**2)) for one in errors]
    assert share == f"{100 * (sizes[1] / sizes[0] - 1):+.0f} %"
    steps = next(chart for chart in report.charts if chart.name == "step-response")
    assert [line.colour for line in steps.panels[0].lines if getattr(line, "label", "")] == [FLOWN, NEW]


def test_a_log_that_cannot_be_tuned_from_says_why_and_shows_the_rest(folder):
    report = make_report([folder / "slow.csv"])
    assert report.headline.sentence.startswith("Gains cannot be tuned from slow.csv: lacks column u_roll and u_pitch")
    assert {"timeline-1", "tracking-1", "step-response"} <= {chart.name for chart in report.charts}
    for section in report.sections:
        assert section.charts or section.tables or section.text, section.heading


def test_a_line_is_interrupted_where_the_log_has_a_gap(tmp_path):
    columns = table(make_flight(seconds=12.0, Ts=0.02))
    kept = (columns["t"] < 14.0) | (columns["t"] > 16.0)
    report = make_report([write_csv(tmp_path / "gap.csv", {name: one[kept] for name, one in columns.items()})])
    for name, title in (("timeline-1", "Angles"), ("tracking-1", "roll rate")):
        chart = next(one for one in report.charts if one.name == name)
        for line in next(panel for panel in chart.panels if panel.title == title).lines:
            (gap,) = np.flatnonzero(np.isnan(line.y))
            assert (line.x[gap - 1], line.x[gap + 1]) == pytest.approx((4.0, 6.0), abs=0.03)


def test_a_crash_is_in_the_headline_and_in_the_timeline(tmp_path):
    columns = table(make_flight(seconds=20.0))
    fallen = columns["t"] > 26.0
    columns["roll"] = np.where(fallen, 3.0, columns["roll"])
    report = make_report([write_csv(tmp_path / "crash.csv", columns)])
    assert report.headline.sentence.startswith("The vehicle tumbled 16.0 s into crash.csv.")
    assert report.headline.tone == "bad"
    assert report.flights[0].phases["crash"][0] == pytest.approx((16.0, 20.0), abs=0.02)


def test_a_crash_with_which_the_log_ends_is_in_the_headline(tmp_path):
    columns = table(make_flight(seconds=12.0, Ts=0.02))
    columns["roll"][-1] = 1.5
    report = make_report([write_csv(tmp_path / "crash.csv", columns)])
    assert report.headline.sentence.startswith("The vehicle tumbled 12.0 s into crash.csv.")
    (begin, end), *_ = report.flights[0].phases["crash"]
    assert end - begin == pytest.approx(0.1)


def test_a_log_with_the_gyro_alone_shows_it():
    t = np.arange(0.0, 10.0, 0.02)
    gyro = Series(t, np.column_stack([np.sin(t), np.cos(t), 0 * t]), "IMU")
    recording = Recording(Path("x.BIN"), "dataflash", {}, {}, (), "")
    found = Inspection(recording, 10.0, None, {}, (), None, {}, "no rates", {}, {})
    flight = ReportedFlight("x.BIN", found, FurtherSignals(gyro=gyro), FLOWN, ":")
    (chart,) = timeline_section([flight]).charts
    assert [panel.title for panel in chart.panels] == ["Gyro"]
    (held,) = contents_section([flight]).tables
    assert ["gyro", "IMU", "50 Hz"] in held.rows


def test_commands_write_the_page_and_refuse_what_is_no_log(folder, mimopilot, tmp_path):
    done = mimopilot("report", folder / "slow.csv", "--out", "page.html", "--json")
    found = json.loads(done.stdout)
    assert done.returncode == 0, done.stderr
    assert found["headline"].startswith("Gains cannot be tuned from")
    assert "tracking-1" in found["figures"]
    flown = mimopilot("fly", "adam0", "--report", "flight.html")
    assert flown.returncode == 0, flown.stderr
    assert "Setpoint and response" in (tmp_path / "flight.html").read_text()
    (tmp_path / "no.txt").write_text("nothing\n")
    assert_one_clear_line(mimopilot("report", "no.txt", "--out", "page.html"), "no.txt", "not a flight log")
    too_many = mimopilot("report", *[folder / "slow.csv"] * (MOST_LOGS + 1), "--out", "page.html")
    assert_one_clear_line(too_many, f"{MOST_LOGS + 1} logs")
    with pytest.raises(Error, match="2 logs and 4 gain sets: a report has colours for 5 together"):
        check_count(2, 4)


def test_thinning_keeps_extremes_gaps_and_equal_steps():
    x = np.arange(10_000) * 0.004
    y = np.sin(x)
    y[1234], y[5000:5100] = 9.0, np.nan
    short, values = thinned(x, y, 400)
    assert len(short) <= 400
    assert np.nanmax(values) == 9.0
    assert np.isnan(values).any()
    assert np.ptp(np.diff(short)) < 1e-9


def test_text_of_a_log_cannot_end_the_script_of_the_page(folder):
    report = make_report([folder / "slow.csv"])
    chart = report.charts[0]
    bad = type(chart)(chart.name, "</script>", [type(chart.panels[0])("</script>", "</script>", "", [])])
    assert "</" not in charts_json([bad])
