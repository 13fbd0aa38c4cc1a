"""The survey plan as text and as tables in HTML."""

from __future__ import annotations

import html
import math
from typing import Any

from guidance.survey_plan import SurveyPlan

COLUMNS = ("scan", "kind", "name", "direction", "image motion", "start, s", "stop, s", "length, km", "width, km",
           "area, km2", "off nadir, deg", "centre lat, lon")


def scan_rows(plan: SurveyPlan) -> list[tuple[str, ...]]:
    """One row of text for each scan, after :data:`COLUMNS`."""
    rows: list[tuple[str, ...]] = []
    for s in plan.answer()["scans"]:
        rows.append((str(s["index"]), s["kind"], s["name"], s["direction"], s["image_motion"], f"{s['start_s']:.2f}",
                     f"{s['stop_s']:.2f}", f"{s['length_km']:.2f}", f"{s['width_km']:.2f}", f"{s['area_km2']:.0f}",
                     f"{s['largest_off_nadir_deg']:.2f}", f"{s['center'][0]:.4f}, {s['center'][1]:.4f}"))
    return rows


def summary_rows(plan: SurveyPlan) -> list[tuple[str, str]]:
    """Quantity and value for the whole plan."""
    limits = plan.request.limits
    rows = [("epoch", plan.request.orbit.epoch.isoformat() + " UTC"),
            ("duration", f"{plan.stop - plan.start:.2f} s, from {plan.start:.2f} to {plan.stop:.2f} s")]
    if plan.area_duration is not None:
        rows.append(("areas alone", f"{plan.area_duration:.2f} s"))
    for area in plan.areas:
        rows.append((f"{area.request.name}: covered", f"{100 * area.covered:.3f} %"))
        if area.overlap is not None:
            rows.append((f"{area.request.name}: least overlap",
                         f"{100 * area.overlap:.2f} %, asked {100 * area.request.overlap:g} %"))
        rows.append((f"{area.request.name}: number of scans",
                     f"{len(area.outlines)} planned; as printed 2b(1-p/50)/(s0+sm) = {area.count.printed:.2f}, "
                     f"corrected 2b/((s0+sm)(1-p/100)) = {area.count.corrected:.2f}, with swaths "
                     f"{area.count.nadir_swath / 1e3:.1f} and {area.count.widest_swath / 1e3:.1f} km"))
    rows.append(("largest off-nadir angle", f"{math.degrees(plan.off_nadir):.2f} deg, limit "
                                            f"{math.degrees(limits.off_nadir):g} deg"))
    for name, value, limit, unit in (("rate", plan.largest[0], limits.rate, "deg/s"),
                                     ("acceleration", plan.largest[1], limits.acceleration, "deg/s2"),
                                     ("jerk", plan.largest[2], limits.jerk, "deg/s3")):
        rows.append((f"largest {name}", f"{math.degrees(value):.5f} {unit}, limit {math.degrees(limit):g} {unit}"))
    rows.append(("slews", ", ".join(f"{j.duration:.2f} s / {math.degrees(j.angle):.1f} deg" for j in plan.joins)))
    answer = plan.answer()
    rows += [("frame", answer["frame"]), ("force model", answer["force_model"]),
             ("Earth", answer["earth_orientation"])]
    return rows


def text(plan: SurveyPlan) -> Any:
    """The plan as rich tables for a terminal."""
    from rich.console import Group
    from rich.table import Table

    scans = Table("scan", "name", "direction", "start, s", "stop, s", "km", "x km", "off nadir", box=None,
                  header_style="bold")
    places = Table("scan", "image motion", "area, km2", "centre lat, lon, deg", box=None, header_style="bold")
    for row in scan_rows(plan):
        scans.add_row(row[0], row[2], row[3], *row[5:9], row[10])
        places.add_row(row[0], row[4], row[9], row[11])
    whole = Table("", "", box=None, show_header=False)
    for name, value in summary_rows(plan):
        whole.add_row(name, value)
    return Group(plan.why(), "", scans, "", places, "", whole)


def html_table(columns: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """A table in HTML."""
    head = "".join(f"<th>{html.escape(c)}</th>" for c in columns)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(c)}</td>" for c in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
