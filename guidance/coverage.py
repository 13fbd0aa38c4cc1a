"""How much of an area the footprints cover, and how much neighbours overlap.

Everything is measured in the azimuthal equidistant plane of the area's centre, on lines across the scans ("stations"):
on each station a footprint is an interval, so that the covered length and the overlap of neighbours are exact there.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from guidance.ground_geometry import EquidistantPlane, geodetic_from_earth_fixed, nearest_intersection
from guidance.scan import Scan, line_of_sight

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Outline:
    """A footprint in the plane of an area: its two long edges and its two ends, each (n, 2): along, across, in m.

    ``lower`` and ``upper`` are the edges with the smaller and the larger ``across``; the ends go from lower to upper.
    All are ordered by rising ``along`` (the edges) and from the lower to the upper edge (the ends).
    """

    lower: Array
    upper: Array
    near: Array
    far: Array

    @property
    def polygon(self) -> Array:
        """The whole contour (n, 2), not closed."""
        return np.concatenate([self.near, self.upper[1:], self.far[::-1][1:], self.lower[::-1][1:-1]])

    def interval(self, stations: Array) -> tuple[Array, Array]:
        """Where lines ``along = constant`` cross the footprint: lower and upper ``across`` (NaN where they miss it)."""
        contour = self.polygon
        closed = np.concatenate([contour, contour[:1]])
        x0, y0, x1, y1 = closed[:-1, 0], closed[:-1, 1], closed[1:, 0], closed[1:, 1]
        s = stations[:, None]
        crossing = (np.minimum(x0, x1) <= s) & (s <= np.maximum(x0, x1)) & (x0 != x1)
        step = np.where(x0 != x1, x1 - x0, 1.0)
        y = np.where(crossing, y0 + (s - x0) / step * (y1 - y0), np.nan)
        hit = crossing.any(axis=1)
        low = np.where(hit, np.min(np.where(crossing, y, np.inf), axis=1), np.nan)
        high = np.where(hit, np.max(np.where(crossing, y, -np.inf), axis=1), np.nan)
        return low, high


def outline(scan: Scan, plane: EquidistantPlane, count: int = 33, across: int = 17) -> Outline:
    """The contour of a scan's footprint in the plane of an area.

    Args:
        count: instants along the scan.
        across: points on the detector line at each end.
    """
    times = np.linspace(scan.start, scan.stop, count)
    position, sight, axis = line_of_sight(scan.arc, scan.camera, times, scan.motion(times).quaternion)
    fan = scan.camera.half_field * np.linspace(-1, 1, across)
    which = np.concatenate([np.arange(count), np.arange(count), np.zeros(across, int), np.full(across, count - 1)])
    tangent = np.concatenate([np.full(count, fan[0]), np.full(count, fan[-1]), fan, fan])
    ground = nearest_intersection(position[which], sight[which] + tangent[:, None] * axis[which])
    latitude, longitude, _ = geodetic_from_earth_fixed(ground)
    points = np.stack(plane.to_plane(latitude, longitude), -1)
    edges = [points[:count], points[count:2 * count]]
    ends = [points[2 * count:2 * count + across], points[2 * count + across:]]
    if edges[0][-1, 0] + edges[1][-1, 0] < edges[0][0, 0] + edges[1][0, 0]:
        edges, ends = [e[::-1] for e in edges], ends[::-1]
    if edges[0][:, 1].mean() > edges[1][:, 1].mean():
        edges = edges[::-1]
    ends = [e if e[-1, 1] > e[0, 1] else e[::-1] for e in ends]
    return Outline(edges[0], edges[1], ends[0], ends[1])


def scan_line(scan: Scan, time: float, count: int) -> Array:
    """Ground points (count, 3; Earth-fixed, m) on the detector line at one instant, from its left to its right end."""
    position, sight, axis = line_of_sight(scan.arc, scan.camera, np.array([time]), scan.motion([time]).quaternion)
    sign = 1.0 if scan.forward != scan.turned else -1.0
    tangents = sign * scan.camera.half_field * np.linspace(-1, 1, count)
    return nearest_intersection(position, sight + tangents[:, None] * axis)


def covered_fraction(outlines: list[Outline], length: float, width: float, stations: int = 801) -> float:
    """Share of the rectangle ``length`` by ``width`` (m, about the plane's origin) inside any of the footprints."""
    x = (np.arange(stations) + 0.5) / stations * length - length / 2
    low, high = (np.stack(v) for v in zip(*(o.interval(x) for o in outlines), strict=True))
    low, high = np.clip(low, -width / 2, width / 2), np.clip(high, -width / 2, width / 2)
    low, high = np.where(np.isnan(low), width, low), np.where(np.isnan(high), width, high)
    order = np.argsort(low, axis=0)
    low, high = np.take_along_axis(low, order, 0), np.take_along_axis(high, order, 0)
    covered = np.zeros_like(x)
    reached = np.full_like(x, -width / 2)
    for a, b in zip(low, high, strict=True):
        covered += np.maximum(b - np.maximum(a, reached), 0)
        reached = np.maximum(reached, np.minimum(b, width / 2))
    return float(np.mean(covered) / width)


def overlaps(first: Outline, second: Outline, length: float, stations: int = 201) -> Array:
    """Overlap of two neighbours over the wider of the two, on stations over the area's length; second lies above.

    Where one of them does not reach a station the overlap there is -1: nothing is covered twice.
    """
    x = np.linspace(-length / 2, length / 2, stations)
    a, b = first.interval(x), second.interval(x)
    widest = np.maximum(a[1] - a[0], b[1] - b[0])
    with np.errstate(invalid="ignore"):
        share = (a[1] - b[0]) / widest
    return np.where(np.isnan(share), -1.0, share)


def least_overlap(outlines: list[Outline], length: float) -> float | None:
    """Least overlap between neighbours (share of the wider one), None for a single footprint.

    Args:
        outlines: in rising order across.
        length: of the area, m: the overlap is looked at over this length.
    """
    if len(outlines) < 2:
        return None
    ordered = sorted(outlines, key=lambda o: float(o.lower[:, 1].mean() + o.upper[:, 1].mean()))
    return float(min(np.min(overlaps(a, b, length)) for a, b in itertools.pairwise(ordered)))
