import json

import numpy as np

from mimopilot.common.chart_json import chart_from_json, chart_to_json
from mimopilot.common.figures import Chart, HeatMap, LimitLine, Line, Panel, SpanMark, Spread
from mimopilot.common.plotly_page import charts_json


def test_a_figure_that_was_kept_as_json_is_drawn_alike():
    x = np.arange(50) * 0.25
    y = np.where(x > 5, np.nan, np.sin(x))
    lines = [
        Line(x, y, "a", "#009E73", "--", step=True, error=0 * x + 0.1),
        Line(np.geomspace(1, 9, 50), y, "b", width=0, marker="x", text=["here"] * 50),
        Spread(x, x - 1, x + 1, "band"),
        HeatMap(x[:3], x[:2], np.array([[1.0, np.nan, 3.0], [4.0, 5.0, 6.0]]), "dB", (0.0, 9.0)),
    ]
    marks = [SpanMark(0.0, 1.0, "window"), LimitLine(0.5, "limit", upright=True)]
    panel = Panel("p", "t [s]", "[-]", lines, marks, log_x=True, x_range=(0.1, 9.0), y_names=("one", "two"), height=99)
    chart = Chart("c", "caption", [panel], columns=1, linked=False)
    kept = json.loads(json.dumps(chart_to_json(chart)))
    again = chart_from_json(kept)
    assert charts_json([again]) == charts_json([chart])
    assert (again.name, again.caption, again.columns, again.linked) == ("c", "caption", 1, False)
    assert chart_to_json(again) == kept
