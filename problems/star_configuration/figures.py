"""The sphere of directions: an interactive page that needs no network, and pictures for a report.

Angles are drawn true on the unit sphere of body axes. The ellipsoid at the centre is the attitude covariance: its
half-axes are proportional to the standard deviations about the body axes, scaled to fit.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from estimator.models.files import written_atomically
from problems.star_configuration.catalogue_selection import Camera, Selection
from problems.star_configuration.optimal_directions import Configuration, KeepOut
from problems.star_configuration.sighting_plan import SightingPlan

_INK, _MUTED, _STAR, _FIXED, _CONE, _AXIS = "#1f2933", "#9aa5b1", "#c2410c", "#1d4ed8", "#b91c1c", "#047857"


def circle(centre: Any, half_angle: float, points: int = 181) -> np.ndarray:
    """Points (points x 3) of the circle at ``half_angle`` (rad) about ``centre`` (3) on the unit sphere."""
    c = np.asarray(centre, dtype=float)
    c = c / np.linalg.norm(c)
    first = np.cross(np.eye(3)[int(np.argmin(np.abs(c)))], c)
    first /= np.linalg.norm(first)
    second = np.cross(c, first)
    angle = np.linspace(0, 2 * np.pi, points)[:, None]
    return np.cos(half_angle) * c + np.sin(half_angle) * (np.cos(angle) * first + np.sin(angle) * second)


def _ellipsoid(covariance: np.ndarray, size: float = 0.35) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Surface of the error ellipsoid, its longest half-axis ``size``."""
    values, vectors = np.linalg.eigh(covariance)
    half = np.sqrt(np.maximum(values, 0))
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 37), np.linspace(0, np.pi, 19))
    ball = np.stack((np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)))
    shape = np.einsum("ij,j,jkl->ikl", vectors, size * half / half.max(), ball)
    return shape[0], shape[1], shape[2]


def sphere_page(configuration: Configuration, path: str | os.PathLike[str]) -> None:
    """Write an interactive page (HTML, self-contained) of a configuration: turn it with the mouse.

    Args:
        configuration: from :func:`optimal_directions`.
        path: where to write.
    """
    request = configuration.request
    title = (
        f"{request.count} star directions, best for {request.criterion}: "
        f"K0 = {configuration.K0:.6g}, K1 = {configuration.K1:.6g} (sigma = 1)"
    )
    labels = [f"sensor {i + 1}" for i in range(len(configuration.directions))]
    _write_sphere(
        path,
        title,
        configuration.directions,
        labels,
        np.array(request.fixed).reshape(-1, 3),
        request.keep_outs,
        (),
        configuration.axis,
        configuration.covariance,
        None,
    )


def sky_page(selection: Selection, catalogue: Any, cameras: Sequence[Camera], path: str | os.PathLike[str]) -> None:
    """Write an interactive page (HTML, self-contained) of the chosen stars among the visible ones, body axes."""
    candidates = selection.candidates
    chosen = selection.chosen
    labels = [
        f"{catalogue.name[s] or catalogue.identifier[s]}, magnitude {catalogue.magnitude[s]:.2f}, {cameras[c].name}"
        for s, c in zip(candidates.star[chosen], candidates.camera[chosen], strict=True)
    ]
    title = (
        f"{len(chosen)} of {len(candidates)} visible stars: K0 = {selection.criteria.K0:.6g}, "
        f"K1 = {selection.criteria.K1:.6g} (sigma = 1); {selection.why}"
    )
    _write_sphere(
        path,
        title,
        candidates.directions[chosen],
        labels,
        np.zeros((0, 3)),
        (),
        [(camera.boresight, camera.half_angle, camera.name) for camera in cameras],
        selection.criteria.axis,
        selection.criteria.covariance,
        candidates.directions,
    )


def _write_sphere(
    path: str | os.PathLike[str],
    title: str,
    directions: np.ndarray,
    labels: list[str],
    fixed: np.ndarray,
    cones: Sequence[KeepOut],
    fields: Sequence[tuple[Any, float, str]],
    axis: np.ndarray,
    covariance: np.ndarray | None,
    others: np.ndarray | None,
) -> None:
    import plotly.graph_objects as go

    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 61), np.linspace(0, np.pi, 31))
    traces: list[Any] = [
        go.Surface(
            x=0.995 * np.cos(u) * np.sin(v),
            y=0.995 * np.sin(u) * np.sin(v),
            z=0.995 * np.cos(v),
            opacity=0.12,
            showscale=False,
            colorscale=[[0, _MUTED], [1, _MUTED]],
            hoverinfo="skip",
        )
    ]
    for angle in range(-60, 90, 30):
        ring = circle((0, 0, 1), np.radians(90 - angle))
        traces.append(_line(go, ring, _MUTED, 1, ""))
    for axis_name, end in zip("xyz", np.eye(3), strict=True):
        traces.append(_line(go, np.array([[0, 0, 0], 1.2 * end]), _MUTED, 2, ""))
        traces.append(
            go.Scatter3d(
                x=[1.26 * end[0]],
                y=[1.26 * end[1]],
                z=[1.26 * end[2]],
                mode="text",
                text=[axis_name],
                textfont={"color": _INK, "size": 14},
                hoverinfo="skip",
                showlegend=False,
            )
        )
    if others is not None:
        traces.append(
            go.Scatter3d(
                x=others[:, 0],
                y=others[:, 1],
                z=others[:, 2],
                mode="markers",
                name="visible",
                marker={"size": 3, "color": _MUTED},
                hoverinfo="skip",
            )
        )
    for rows, color, name, words in (
        (directions, _STAR, "sighted", labels),
        (fixed, _FIXED, "on board", [f"on board {i + 1}" for i in range(len(fixed))]),
    ):
        if len(rows) == 0:
            continue
        spokes = np.full((3 * len(rows), 3), np.nan)
        spokes[0::3], spokes[1::3] = 0.0, rows
        traces.append(_line(go, spokes, color, 4, ""))
        traces.append(
            go.Scatter3d(
                x=rows[:, 0],
                y=rows[:, 1],
                z=rows[:, 2],
                mode="markers",
                name=name,
                text=words,
                marker={"size": 6, "color": color},
                hovertemplate="%{text}<br>(%{x:.5f}, %{y:.5f}, %{z:.5f})<extra></extra>",
            )
        )
    for cone in cones:
        traces.append(_line(go, circle(cone.direction, cone.half_angle), _CONE, 4, f"keep out: {cone.name}"))
    for centre, half_angle, name in fields:
        traces.append(_line(go, circle(centre, half_angle), _FIXED, 4, f"field of {name}"))
    traces.append(_line(go, np.array([-1.15 * axis, 1.15 * axis]), _AXIS, 5, "axis of K1", dash="dash"))
    if covariance is not None:
        x, y, z = _ellipsoid(covariance)
        traces.append(
            go.Surface(
                x=x,
                y=y,
                z=z,
                opacity=0.45,
                showscale=False,
                colorscale=[[0, _AXIS], [1, _AXIS]],
                name="attitude error",
                hovertemplate="attitude error, one sigma, scaled<extra></extra>",
            )
        )
    hidden = {"visible": False}
    figure = go.Figure(traces)
    figure.update_layout(
        title={"text": title, "font": {"size": 15, "color": _INK}},
        paper_bgcolor="white",
        scene={
            "xaxis": hidden,
            "yaxis": hidden,
            "zaxis": hidden,
            "aspectmode": "cube",
            "camera": {"eye": {"x": 0.95, "y": 0.8, "z": 0.55}},
        },
        legend={"x": 0.01, "y": 0.95},
        margin={"l": 0, "r": 0, "t": 60, "b": 0},
    )
    with written_atomically(path) as temporary:
        figure.write_html(str(temporary), include_plotlyjs=True, full_html=True, default_height="96vh")


def _line(go: Any, points: np.ndarray, color: str, width: float, name: str, dash: str = "solid") -> Any:
    """A line on the sphere; it has a legend entry if it has a name."""
    return go.Scatter3d(
        x=points[:, 0],
        y=points[:, 1],
        z=points[:, 2],
        mode="lines",
        name=name,
        showlegend=bool(name),
        line={"color": color, "width": width, "dash": dash},
        hoverinfo="name" if name else "skip",
    )


def _canvas(width: float, height: float) -> tuple[Any, Any]:
    """A matplotlib figure that needs no display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, FigureCanvasAgg(figure)


def _save(figure: Any, path: str | os.PathLike[str]) -> None:
    with written_atomically(path) as temporary:
        figure.savefig(temporary, dpi=130)


def _draw_hemispheres(
    figure: Any, directions: np.ndarray, fixed: np.ndarray, cones: Sequence[KeepOut], axis: np.ndarray
) -> None:
    """Two equal-area discs, the half of the sphere with z > 0 and the half with z < 0."""
    grid = figure.add_gridspec(1, 2)
    entries: dict[str, Any] = {}
    for column, sign in enumerate((1.0, -1.0)):
        ax = figure.add_subplot(grid[column])
        ax.set_aspect("equal")
        ax.set_axis_off()
        ax.set_title("z > 0, seen from +z" if sign > 0 else "z < 0, seen through from +z", fontsize=10)
        for polar in (30, 60, 90):
            radius = np.sqrt(2) * np.sin(np.radians(polar) / 2)
            angle = np.linspace(0, 2 * np.pi, 181)
            ax.plot(radius * np.cos(angle), radius * np.sin(angle), color=_INK if polar == 90 else _MUTED, lw=0.8)
        for name, (x, y) in (("x", (1.06, 0.0)), ("y", (0.0, 1.06))):
            ax.text(x, y, name, ha="center", va="center", color=_INK)

        def flat(rows: np.ndarray, side: float = sign) -> np.ndarray:
            # A direction within rounding of the rim belongs to both discs.
            shown = rows[side * rows[:, 2] >= -1e-9]
            return shown[:, :2] / np.sqrt(1 + np.abs(shown[:, 2:]))

        for cone in cones:
            ring = circle(cone.direction, cone.half_angle, 721)
            here = sign * ring[:, 2] >= 0
            lines = np.where(here[:, None], ring[:, :2] / np.sqrt(1 + np.abs(ring[:, 2:])), np.nan)
            ax.plot(lines[:, 0], lines[:, 1], color=_CONE, lw=1.4, label=f"keep out: {cone.name}")
        for rows, color, label, marker in (
            (directions, _STAR, "best directions", "o"),
            (fixed, _FIXED, "on board", "s"),
            (np.array([axis, -axis]), _AXIS, "axis of K1", "x"),
        ):
            points = flat(rows)
            if len(rows):
                ax.scatter(points[:, 0], points[:, 1], color=color, marker=marker, s=36, label=label, zorder=3)
        handles, labels = ax.get_legend_handles_labels()
        entries |= dict(zip(labels, handles, strict=True))
    figure.legend(list(entries.values()), list(entries), loc="outside lower center", ncols=4, fontsize=8, frameon=False)


def sphere_picture(configuration: Configuration, path: str | os.PathLike[str]) -> None:
    """Write a picture (PNG) of a configuration: both halves of the sphere in an equal-area projection."""
    figure, _ = _canvas(8.4, 4.9)
    request = configuration.request
    figure.suptitle(
        f"{request.count} directions, best for {request.criterion}: K0 = {configuration.K0:.5g}, "
        f"K1 = {configuration.K1:.5g} (sigma = 1)",
        fontsize=11,
    )
    _draw_hemispheres(
        figure, configuration.directions, np.array(request.fixed).reshape(-1, 3), request.keep_outs, configuration.axis
    )
    _save(figure, path)


def sky_picture(selection: Selection, catalogue: Any, cameras: Sequence[Camera], path: str | os.PathLike[str]) -> None:
    """Write a picture (PNG) of each camera's field: visible stars by brightness, the chosen ones marked and named."""
    figure, _ = _canvas(5.2 * len(cameras), 5.6)
    figure.suptitle(
        f"K0 = {selection.criteria.K0:.5g}, K1 = {selection.criteria.K1:.5g} (sigma = 1); {selection.why}", fontsize=10
    )
    candidates = selection.candidates
    inside = np.zeros(len(candidates), dtype=bool)
    inside[selection.chosen] = True
    for index, camera in enumerate(cameras):
        ax = figure.add_subplot(1, len(cameras), index + 1)
        ring = circle(camera.boresight, camera.half_angle)
        c = np.array(camera.boresight)
        first = np.cross(np.eye(3)[int(np.argmin(np.abs(c)))], c)
        first /= np.linalg.norm(first)
        frame = np.vstack((first, np.cross(c, first)))

        def flat(rows: np.ndarray, centre: np.ndarray = c, across: np.ndarray = frame) -> np.ndarray:
            angle = np.arccos(np.clip(rows @ centre, -1, 1))
            plane = rows @ across.T
            return np.degrees(angle)[:, None] * plane / np.maximum(np.linalg.norm(plane, axis=1), 1e-300)[:, None]

        edge = flat(ring)
        ax.plot(edge[:, 0], edge[:, 1], color=_FIXED, lw=1)
        here = candidates.camera == index
        for mask, color, label in ((here & ~inside, _MUTED, "visible"), (here & inside, _STAR, "chosen")):
            points = flat(candidates.directions[mask])
            size = 10 + 12 * np.clip(camera.magnitude_limit - catalogue.magnitude[candidates.star[mask]], 0, 6)
            ax.scatter(points[:, 0], points[:, 1], s=size, color=color, label=f"{label} ({int(mask.sum())})", zorder=3)
            if label == "chosen":
                for (x, y), star in zip(points, candidates.star[mask], strict=True):
                    ax.annotate(
                        str(catalogue.name[star] or catalogue.identifier[star]),
                        (x, y),
                        xytext=(4, 4),
                        textcoords="offset points",
                        fontsize=7,
                        color=_INK,
                    )
        ax.set_aspect("equal")
        ax.set_xlabel("across the boresight [deg]")
        ax.set_ylabel("across the boresight [deg]")
        ax.set_title(camera.name, fontsize=10)
        ax.legend(fontsize=8, loc="upper right")
    _save(figure, path)


def plan_picture(plan: SightingPlan, path: str | os.PathLike[str]) -> None:
    """Write a picture (PNG) of a sighting plan: who is followed when, and the error about each body axis."""
    arcs = plan.arcs
    figure, _ = _canvas(9.0, 4.5 + 0.045 * len(arcs))
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(2 + 0.02 * len(arcs), 1))
    cameras = sorted({a.camera for a in arcs})
    colors = dict(zip(cameras, (_STAR, _FIXED, _AXIS, _CONE, _INK, _MUTED) * (1 + len(cameras) // 6), strict=False))
    for row, arc in enumerate(arcs):
        top.plot([arc.start / 60, arc.end / 60], [row, row], color=colors[arc.camera], lw=2.5, solid_capstyle="butt")
    for camera in cameras:
        top.plot([], [], color=colors[camera], lw=2.5, label=camera)
    top.set_ylabel("sighting, in order of start")
    top.legend(fontsize=8, loc="upper left")
    top.set_title(f"{len(arcs)} sightings; {plan.acquisitions} acquisitions", fontsize=10)
    for column, color in enumerate((_STAR, _FIXED, _AXIS)):
        bottom.plot(
            plan.times / 60,
            np.where(np.isfinite(plan.axis_sigma[:, column]), plan.axis_sigma[:, column], np.nan),
            color=color,
            lw=1.2,
            label=f"about {'xyz'[column]}",
        )
    bottom.set_xlabel("time [min]")
    bottom.set_ylabel("error [sigma]")
    bottom.set_ylim(bottom=0)
    bottom.legend(fontsize=8, ncols=3)
    _save(figure, path)
