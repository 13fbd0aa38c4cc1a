"""The report of a survey plan: globe, figures and tables in one HTML file."""

from __future__ import annotations

import base64
import io
import os

from guidance.survey_plan import SurveyPlan
from problems.area_survey import tables
from problems.area_survey.figures import attitude_figure, map_figure, save_globe


def _embedded(figure: object, title: str) -> str:
    stream = io.BytesIO()
    figure.savefig(stream, dpi=110, format="png")  # type: ignore[attr-defined]
    data = base64.b64encode(stream.getvalue()).decode("ascii")
    return f'<figure><img alt="{title}" style="max-width:100%" src="data:image/png;base64,{data}"></figure>'


def save_report(plan: SurveyPlan, path: str | os.PathLike[str]) -> None:
    """Write the report; it holds all that it shows and asks nothing of a network."""
    parts = ["<h2>Scans</h2>", tables.html_table(tables.COLUMNS, tables.scan_rows(plan)),
             "<h2>Plan</h2>", tables.html_table(("quantity", "value"), [(a, b) for a, b in tables.summary_rows(plan)]),
             "<h2>Map</h2>", _embedded(map_figure(plan), "Footprints on a map")]
    for number in range(len(plan.passes)):
        parts += [f"<h2>Attitude, pass {number + 1}</h2>",
                  _embedded(attitude_figure(plan, number), "Attitude over time")]
    save_globe(plan, path, tables="\n".join(parts))
