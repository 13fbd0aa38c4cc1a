"""Pictures of a survey plan: attitude over time, footprints on a map, and a globe to turn in a browser.

The first two are the figures 1 and 2 of Somov, Butyrin, Makarov for the plan at hand. The globe is one HTML file that
holds everything it needs; opening it sends no request to a network.
"""

from __future__ import annotations

import itertools
import math
import os
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np

from estimator.models.files import written_atomically
from guidance.coverage import scan_line
from guidance.ground_geometry import (
    EQUATORIAL_RADIUS,
    POLAR_RADIUS,
    earth_fixed_from_geodetic,
    geodetic_from_earth_fixed,
    nearest_intersection,
)
from guidance.kinematics import (
    angles_312,
    conjugate,
    inertial_from_orbital,
    product,
    rodrigues_from_quaternion,
    sign_continuous,
)
from guidance.scan import line_of_sight
from guidance.survey_plan import PlannedPass, PlannedScan, SurveyPlan

COLOURS = {"area": "#1f6fb4", "route": "#d1691a"}
REVERSE_COLOUR = "#2a9d5c"


def _colour(planned: PlannedScan) -> str:
    if planned.kind == "route":
        return COLOURS["route"]
    return COLOURS["area"] if planned.scan.forward else REVERSE_COLOUR


def _shade(axes: Any, planned: PlannedPass) -> None:
    for scan in planned.scans:
        axes.axvspan(scan.scan.start, scan.scan.stop, color=_colour(scan), alpha=0.16, linewidth=0)


def attitude_figure(plan: SurveyPlan, number: int = 0) -> Any:
    """Angles 312 in the orbital frame, parameters sigma, rate and acceleration over one pass (a matplotlib figure).

    Args:
        number: index of the pass.
    """
    from matplotlib.figure import Figure

    planned = plan.passes[number]
    times = np.linspace(planned.start, planned.stop, 2000)
    motion = planned.motion(times)
    position, velocity = planned.arc.inertial(times)
    orbital = sign_continuous(inertial_from_orbital(position, velocity))
    angles = np.degrees(np.unwrap(angles_312(product(conjugate(orbital), motion.quaternion)), axis=0))
    sign = np.sign(motion.quaternion[len(times) // 2, 0])
    sigma = rodrigues_from_quaternion(motion.quaternion * sign, shortest=False)
    figure = Figure(figsize=(10.5, 11.0), layout="constrained")
    rows = figure.subplots(4, 1, sharex=True)
    panels = [
        (angles, "angles in the orbital frame, deg", ("roll φ₁", "yaw φ₂", "pitch φ₃")),
        (sigma, "modified Rodrigues parameters σ", ("σ₁", "σ₂", "σ₃")),
        (np.degrees(motion.rate), "angular velocity ω, deg/s", ("ω₁", "ω₂", "ω₃")),
        (np.degrees(motion.acceleration), "angular acceleration ε, deg/s²", ("ε₁", "ε₂", "ε₃")),
    ]
    for axes, (values, label, names) in zip(rows, panels, strict=True):
        _shade(axes, planned)
        for column, (name, colour) in enumerate(zip(names, ("#b5382f", "#2d7f45", "#2b55a0"), strict=True)):
            axes.plot(times, values[:, column], label=name, color=colour, linewidth=1.3)
        axes.set_ylabel(label, fontsize=9)
        axes.grid(alpha=0.3)
        axes.margins(x=0)
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    rows[2].plot(times, np.degrees(np.linalg.norm(motion.rate, axis=1)), color="0.35", linewidth=0.8, linestyle="--")
    rows[3].plot(times, np.degrees(np.linalg.norm(motion.acceleration, axis=1)), color="0.35", linewidth=0.8,
                 linestyle="--")
    top = rows[0].secondary_xaxis("top")
    top.set_xticks([s.scan.middle for s in planned.scans])
    area = itertools.count(1)
    top.set_xticklabels([s.name if s.kind == "route" else f"{next(area)}{'+' if s.scan.forward else '−'}"
                         for s in planned.scans], fontsize=9)
    top.tick_params(length=0)
    rows[-1].set_xlabel(f"seconds from {plan.request.orbit.epoch.isoformat()} UTC (dashed: length of the vector)")
    figure.suptitle("Attitude over the plan; shaded: scans (+ forward, − reverse)", fontsize=11)
    return figure


def _contour(planned: PlannedScan) -> tuple[np.ndarray, np.ndarray]:
    """Latitude and longitude (rad) around a footprint."""
    scan = planned.scan
    line = scan.footprint(np.linspace(scan.start, scan.stop, 41))
    points = np.concatenate([scan_line(scan, scan.start, 9), line.right[1:], scan_line(scan, scan.stop, 9)[::-1][1:],
                             line.left[::-1][1:]])
    latitude, longitude, _ = geodetic_from_earth_fixed(points)
    return latitude, longitude


def _sight(plan: SurveyPlan, planned: PlannedPass, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Satellite and ground point on the line of sight (n, 3; Earth-fixed, m)."""
    position, sight, _ = line_of_sight(planned.arc, plan.camera, times, planned.motion(times).quaternion)
    return position, nearest_intersection(position, sight)


def map_figure(plan: SurveyPlan) -> Any:
    """Footprints and the trace of the line of sight on a map (a matplotlib figure)."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Polygon

    reference = plan.scans[len(plan.scans) // 2].scan.center[1]

    def degrees(latitude: Any, longitude: Any) -> tuple[np.ndarray, np.ndarray]:
        offset = np.remainder(np.asarray(longitude) - reference + np.pi, 2 * np.pi) - np.pi
        return np.degrees(reference + offset), np.degrees(np.asarray(latitude))

    figure = Figure(figsize=(8.6, 9.4), layout="constrained")
    axes = figure.subplots()
    area = itertools.count(1)
    seen: list[np.ndarray] = []
    for planned in plan.scans:
        x, y = degrees(*_contour(planned))
        seen.append(np.stack([x, y], -1))
        axes.add_patch(Polygon(np.stack([x, y], -1), closed=True, facecolor=_colour(planned), alpha=0.28,
                               edgecolor=_colour(planned), linewidth=1.2))
        start, stop = (planned.scan.footprint(np.array([t])).center for t in (planned.scan.start, planned.scan.stop))
        (x0, y0), (x1, y1) = (degrees(*geodetic_from_earth_fixed(p)[:2]) for p in (start, stop))
        axes.annotate("", (x1[0], y1[0]), (x0[0], y0[0]),
                      arrowprops={"arrowstyle": "-|>", "color": _colour(planned), "linewidth": 1.6, "shrinkA": 0,
                                  "shrinkB": 0})
        cx, cy = degrees(*planned.scan.center)
        label = planned.name if planned.kind == "route" else f"{next(area)}{'+' if planned.scan.forward else '−'}"
        axes.text(float(cx), float(cy), label, ha="center", va="center", fontsize=10,
                  bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1.5})
    for number, passed in enumerate(plan.passes):
        times = np.linspace(passed.start, passed.stop, 1500)
        _, ground = _sight(plan, passed, times)
        x, y = degrees(*geodetic_from_earth_fixed(ground)[:2])
        axes.plot(x, y, color="0.15", linewidth=0.9, label="trace of the line of sight" if number == 0 else None)
        seen.append(np.stack([x, y], -1))
        track = passed.arc.ground_track(times)
        x, y = degrees(track[0], track[1])
        axes.plot(x, y, color="0.45", linewidth=1.0, linestyle=":", label="ground track" if number == 0 else None)
    for index, planned_area in enumerate(plan.areas):
        a, b = planned_area.request.length / 2, planned_area.request.width / 2
        side = np.linspace(-1, 1, 21)
        along = np.concatenate([a * side, np.full(21, a), -a * side, np.full(21, -a)])
        across = np.concatenate([np.full(21, -b), b * side, np.full(21, b), -b * side])
        x, y = degrees(*planned_area.plane.to_ellipsoid(along, across))
        axes.plot(x, y, color="#8c1d40", linewidth=2.0, label="area" if index == 0 else None)
    latitude = float(np.mean([s.scan.center[0] for s in plan.scans]))
    stretch = 1 / max(0.05, math.cos(latitude))
    axes.set_aspect(stretch)
    points = np.concatenate(seen)
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    # A frame no slimmer than 1 : 1.6 around all that is seen; the rest of the ground track is cut off.
    size = np.maximum(1.1 * (high - low), 1.1 * (high - low)[::-1] * np.array([stretch, 1 / stretch]) / 1.6)
    middle = 0.5 * (low + high)
    axes.set_xlim(middle[0] - size[0] / 2, middle[0] + size[0] / 2)
    axes.set_ylim(middle[1] - size[1] / 2, middle[1] + size[1] / 2)
    axes.set_xlabel("longitude, deg")
    axes.set_ylabel("latitude, deg")
    axes.grid(alpha=0.35)
    axes.legend(loc="best", fontsize=9)
    axes.set_title("Footprints (blue forward, green reverse, orange routes) and line of sight", fontsize=11)
    return figure


def save_figures(plan: SurveyPlan, directory: str | os.PathLike[str]) -> list[Path]:
    """Write the two figures as PNG (one attitude figure a pass) and give their paths."""
    folder = Path(directory)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    many = len(plan.passes) > 1
    figures = [(f"figure-1-attitude{f'-pass-{n + 1}' if many else ''}.png", attitude_figure(plan, n))
               for n in range(len(plan.passes))] + [("figure-2-map.png", map_figure(plan))]
    for name, figure in figures:
        with written_atomically(folder / name) as temporary:
            figure.savefig(temporary, dpi=130, format="png")
        paths.append(folder / name)
    return paths


# ------------------------------------------------------------------------------------------------------------- globe


def _closed(latitude: np.ndarray, longitude: np.ndarray, height: float) -> np.ndarray:
    points = earth_fixed_from_geodetic(latitude, longitude, height) / 1e3
    return np.concatenate([points, points[:1]])


def globe(plan: SurveyPlan, *, frames: int = 160) -> Any:
    """The plan on a globe: footprints, trace of the line of sight, and the satellite moving (a plotly figure).

    Args:
        frames: steps of the animation.
    """
    import plotly.graph_objects as go

    data: list[Any] = []
    latitude, longitude = np.meshgrid(np.radians(np.linspace(-90, 90, 91)), np.radians(np.linspace(-180, 180, 181)),
                                      indexing="ij")
    shrunk = 0.9985
    sphere = earth_fixed_from_geodetic(latitude, longitude) / 1e3 * shrunk
    data.append(go.Surface(x=sphere[..., 0], y=sphere[..., 1], z=sphere[..., 2], showscale=False, hoverinfo="skip",
                           surfacecolor=np.zeros_like(latitude), colorscale=[[0, "#dfe8ee"], [1, "#dfe8ee"]],
                           lighting={"ambient": 0.85, "diffuse": 0.25, "specular": 0.02}, name="Earth"))
    grid: list[np.ndarray] = []
    gap = np.full((1, 3), np.nan)
    turn = np.radians(np.linspace(-180, 180, 361))
    for parallel in np.radians(np.arange(-80, 81, 10)):
        grid += [earth_fixed_from_geodetic(np.full_like(turn, parallel), turn) / 1e3, gap]
    for meridian in np.radians(np.arange(-180, 180, 10)):
        arc = np.radians(np.linspace(-85, 85, 171))
        grid += [earth_fixed_from_geodetic(arc, np.full_like(arc, meridian)) / 1e3, gap]
    lines = np.concatenate(grid)
    data.append(go.Scatter3d(x=lines[:, 0], y=lines[:, 1], z=lines[:, 2], mode="lines", hoverinfo="skip",
                             line={"color": "#a9b8c3", "width": 1}, name="every 10 degrees"))
    number = itertools.count(1)
    for planned in plan.scans:
        contour = _closed(*_contour(planned), height=2000.0)
        scan = planned.scan
        label = planned.name if planned.kind == "route" else f"scan {next(number)}"
        text = (f"{label}, {'forward' if scan.forward else 'reverse'}, {scan.kind_of_motion}<br>"
                f"{scan.start:.2f} to {scan.stop:.2f} s<br>{scan.length / 1e3:.2f} x {scan.width / 1e3:.2f} km")
        data.append(go.Scatter3d(x=contour[:, 0], y=contour[:, 1], z=contour[:, 2], mode="lines", name=label,
                                 text=[text] * len(contour), hoverinfo="text",
                                 line={"color": _colour(planned), "width": 5}))
    for planned_area in plan.areas:
        a, b = planned_area.request.length / 2, planned_area.request.width / 2
        corner = planned_area.plane.to_ellipsoid([-a, a, a, -a], [-b, -b, b, b])
        box = _closed(corner[0], corner[1], 4000.0)
        data.append(go.Scatter3d(x=box[:, 0], y=box[:, 1], z=box[:, 2], mode="lines", hoverinfo="name",
                                 name=planned_area.request.name, line={"color": "#8c1d40", "width": 4}))
    moving: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    share = max(2, frames // len(plan.passes))
    for index, passed in enumerate(plan.passes):
        fine = np.linspace(passed.start, passed.stop, 800)
        satellite, ground = _sight(plan, passed, fine)
        for points, colour, name, width in ((ground / 1e3 * 1.0003, "#202020", "line of sight", 2),
                                            (satellite / 1e3, "#6a3d9a", "satellite", 3)):
            data.append(go.Scatter3d(x=points[:, 0], y=points[:, 1], z=points[:, 2], mode="lines", hoverinfo="skip",
                                     line={"color": colour, "width": width}, name=name, showlegend=index == 0))
        times = np.linspace(passed.start, passed.stop, share)
        satellite, ground = _sight(plan, passed, times)
        moving += list(zip(times, satellite / 1e3, ground / 1e3, strict=True))

    def beam(moment: tuple[Any, np.ndarray, np.ndarray]) -> Any:
        _, satellite, ground = moment
        return go.Scatter3d(x=[satellite[0], ground[0]], y=[satellite[1], ground[1]], z=[satellite[2], ground[2]],
                            mode="lines+markers", line={"color": "#e31a1c", "width": 4}, name="camera",
                            marker={"size": [6, 3], "color": "#e31a1c"}, hoverinfo="skip")

    data.append(beam(moving[0]))
    last = len(data) - 1
    steps = [go.Frame(data=[beam(m)], traces=[last], name=f"{m[0]:.1f}") for m in moving]
    center = earth_fixed_from_geodetic(*plan.scans[len(plan.scans) // 2].scan.center)
    direction = center / np.linalg.norm(center)
    side = np.cross([0.0, 0.0, 1.0], direction)
    side = side / max(1e-9, float(np.linalg.norm(side)))
    bound = 1.15 * EQUATORIAL_RADIUS / 1e3
    # Scene coordinates: the ranges below map the Earth's radius to 0.5 / 1.15.
    target = direction * 0.5 * POLAR_RADIUS / 1e3 / bound
    eye = target + 0.2 * direction + 0.1 * side - 0.08 * np.array([0.0, 0.0, 1.0])
    hidden = {"visible": False, "showbackground": False, "range": [-bound, bound]}
    figure = go.Figure(data=data, frames=steps)
    epoch = plan.request.orbit.epoch
    figure.update_layout(
        title={"text": f"Survey from {(epoch + timedelta(seconds=plan.start)).isoformat(timespec='seconds')} UTC: "
                       f"{len(plan.scans)} scans, {plan.stop - plan.start:.1f} s"},
        scene={"xaxis": hidden, "yaxis": hidden, "zaxis": hidden, "aspectmode": "cube",
               "camera": {"eye": dict(zip("xyz", (float(v) for v in eye), strict=True)),
                          "center": dict(zip("xyz", (float(v) for v in target), strict=True)),
                          "up": {"x": 0, "y": 0, "z": 1}}},
        margin={"l": 0, "r": 0, "t": 46, "b": 30}, legend={"x": 0.01, "y": 0.98, "bgcolor": "rgba(255,255,255,0.7)"},
        updatemenus=[{"type": "buttons", "x": 0.02, "y": 0.06, "direction": "left", "showactive": False, "buttons": [
            {"label": "play", "method": "animate",
             "args": [None, {"frame": {"duration": 60, "redraw": True}, "fromcurrent": True,
                             "transition": {"duration": 0}}]},
            {"label": "pause", "method": "animate",
             "args": [[None], {"frame": {"duration": 0, "redraw": False}, "mode": "immediate"}]}]}],
        sliders=[{"x": 0.2, "len": 0.75, "y": 0.08, "currentvalue": {"prefix": "seconds from the epoch: "}, "steps": [
            {"label": f"{m[0]:.1f}", "method": "animate",
             "args": [[f"{m[0]:.1f}"], {"mode": "immediate", "frame": {"duration": 0, "redraw": True},
                                        "transition": {"duration": 0}}]} for m in moving]}],
    )
    return figure


def save_globe(plan: SurveyPlan, path: str | os.PathLike[str], *, tables: str = "") -> None:
    """Write the globe as one HTML file that needs no network.

    Args:
        tables: HTML to stand under the globe.
    """
    figure = globe(plan)
    figure.update_layout(height=760)
    body = figure.to_html(full_html=False, include_plotlyjs=True, auto_play=False,
                          config={"displaylogo": False, "responsive": True})
    page = f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>Survey plan</title>
<link rel="icon" href="data:,">
<style>body {{ font-family: sans-serif; margin: 0 1rem 2rem; color: #222; }}
table {{ border-collapse: collapse; font-size: 0.85rem; margin: 1rem 0; }}
td, th {{ border-bottom: 1px solid #ccc; padding: 0.25rem 0.7rem; text-align: right; }} th {{ background: #f2f4f6; }}
td:first-child, th:first-child {{ text-align: left; }}</style></head>
<body>{body}
{tables}
</body></html>
"""
    with written_atomically(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
