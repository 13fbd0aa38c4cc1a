"""Geometry of lines of sight and of ground lines on the WGS 84 ellipsoid, for arrays of points.

Latitudes and longitudes are geodetic, in radians; azimuths are in radians, clockwise from north; Earth-fixed
coordinates (ITRF axes) are in metres. Every function takes scalars or arrays and broadcasts them.

Geodesics are solved by the nested series of T. Vincenty (Survey Review 23, 1975, number 176): the direct problem always
converges and is good to a tenth of a millimetre; the inverse problem is asked here only for distances far below half
a turn of the Earth, and says so where it fails.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.models.errors import GeometryError

Array = NDArray[np.float64]

EQUATORIAL_RADIUS = 6378137.0  # m, WGS 84
FLATTENING = 1 / 298.257223563  # WGS 84
POLAR_RADIUS = EQUATORIAL_RADIUS * (1 - FLATTENING)  # m
ECCENTRICITY_SQUARED = FLATTENING * (2 - FLATTENING)


def ellipsoid_normal(latitude: ArrayLike, longitude: ArrayLike) -> Array:
    """Outward unit normal (..., 3) of the ellipsoid, Earth-fixed axes."""
    latitude, longitude = np.broadcast_arrays(np.asarray(latitude, float), np.asarray(longitude, float))
    return np.stack([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], -1)


def local_axes(latitude: ArrayLike, longitude: ArrayLike) -> tuple[Array, Array, Array]:
    """Unit vectors east, north and up (each (..., 3), Earth-fixed axes)."""
    latitude, longitude = np.broadcast_arrays(np.asarray(latitude, float), np.asarray(longitude, float))
    sine, cosine = np.sin(longitude), np.cos(longitude)
    east = np.stack([-sine, cosine, np.zeros_like(sine)], -1)
    up = ellipsoid_normal(latitude, longitude)
    return east, np.cross(up, east), up


def earth_fixed_from_geodetic(latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike = 0.0) -> Array:
    """Earth-fixed position (..., 3) in m of geodetic latitude, longitude (rad) and height (m)."""
    latitude = np.asarray(latitude, float)
    normal = ellipsoid_normal(latitude, longitude)
    transverse = EQUATORIAL_RADIUS / np.sqrt(1 - ECCENTRICITY_SQUARED * np.sin(latitude) ** 2)
    height = np.asarray(height, float)
    scale = np.stack(np.broadcast_arrays(transverse + height, transverse + height,
                                         transverse * (1 - ECCENTRICITY_SQUARED) + height), -1)
    return normal * scale


def geodetic_from_earth_fixed(position: ArrayLike) -> tuple[Array, Array, Array]:
    """Geodetic latitude, longitude (rad) and height (m) of Earth-fixed positions (..., 3) in m, outside the core.

    Newton iterations on the reduced latitude, started by B. R. Bowring's formula (Survey Review 23, 1976, number 181):
    rounding error after three of them for any height from the surface to the Moon.
    """
    position = np.asarray(position, float)
    x, y, z = position[..., 0], position[..., 1], position[..., 2]
    across = np.hypot(x, y)
    second = ECCENTRICITY_SQUARED / (1 - ECCENTRICITY_SQUARED)
    reduced = np.arctan2(z * EQUATORIAL_RADIUS, across * POLAR_RADIUS)
    latitude = reduced
    for _ in range(4):
        latitude = np.arctan2(z + second * POLAR_RADIUS * np.sin(reduced) ** 3,
                              across - ECCENTRICITY_SQUARED * EQUATORIAL_RADIUS * np.cos(reduced) ** 3)
        reduced = np.arctan2((1 - FLATTENING) * np.sin(latitude), np.cos(latitude))
    sine, cosine = np.sin(latitude), np.cos(latitude)
    surface = EQUATORIAL_RADIUS * np.sqrt(1 - ECCENTRICITY_SQUARED * sine**2)
    height = across * cosine + z * sine - surface
    return latitude, np.arctan2(y, x), height


def nearest_intersection(position: ArrayLike, direction: ArrayLike) -> Array:
    """Where the ray from ``position`` along ``direction`` first meets the ellipsoid.

    Args:
        position: Earth-fixed position of the camera (..., 3), m, outside the ellipsoid.
        direction: line of sight (..., 3), Earth-fixed axes, of any length.

    Returns:
        Earth-fixed positions (..., 3) in m; NaN where the ray misses the Earth.
    """
    stretch = np.array([1.0, 1.0, EQUATORIAL_RADIUS / POLAR_RADIUS]) / EQUATORIAL_RADIUS
    position, direction = np.asarray(position, float), np.asarray(direction, float)
    p, d = position * stretch, direction * stretch
    a, b, c = np.sum(d * d, -1), np.sum(p * d, -1), np.sum(p * p, -1) - 1
    discriminant = b * b - a * c
    with np.errstate(invalid="ignore", divide="ignore"):
        distance = c / (-b + np.sqrt(discriminant))
    distance = np.where((discriminant >= 0) & (b < 0), distance, np.nan)
    return position + distance[..., None] * direction


def off_nadir_angle(position: ArrayLike, direction: ArrayLike) -> Array:
    """Angle (rad) of a line of sight from the geodetic nadir (the ellipsoid's normal through the satellite)."""
    latitude, longitude, _ = geodetic_from_earth_fixed(position)
    nadir = -ellipsoid_normal(latitude, longitude)
    direction = np.asarray(direction, float)
    sine = np.linalg.norm(np.cross(direction, nadir), axis=-1)
    return np.arctan2(sine, np.sum(direction * nadir, -1))


def _series(reduced_square: Array) -> tuple[Array, Array]:
    """Vincenty's A and B from u squared (his equations 3 and 4)."""
    u = reduced_square
    a = 1 + u / 16384 * (4096 + u * (-768 + u * (320 - 175 * u)))
    b = u / 1024 * (256 + u * (-128 + u * (74 - 47 * u)))
    return a, b


def _correction(b: Array, sine: Array, cosine: Array, middle: Array) -> Array:
    """Vincenty's delta sigma (his equation 6)."""
    return b * sine * (middle + b / 4 * (cosine * (2 * middle**2 - 1)
                                         - b / 6 * middle * (4 * sine**2 - 3) * (4 * middle**2 - 3)))


def _longitude_series(cosine_square: Array) -> Array:
    """Vincenty's C (his equation 10)."""
    return FLATTENING / 16 * cosine_square * (4 + FLATTENING * (4 - 3 * cosine_square))


def geodesic_direct(latitude: ArrayLike, longitude: ArrayLike, azimuth: ArrayLike, distance: ArrayLike,
                    ) -> tuple[Array, Array, Array]:
    """End of a geodesic: latitude, longitude (rad, -pi..pi) and the azimuth (rad) of its continuation there.

    Args:
        latitude, longitude: start, rad.
        azimuth: azimuth at the start, rad.
        distance: length along the ellipsoid, m; negative lengths go backwards.
    """
    latitude, longitude, azimuth, distance = np.broadcast_arrays(
        *(np.asarray(v, float) for v in (latitude, longitude, azimuth, distance)))
    tangent = (1 - FLATTENING) * np.tan(latitude)
    cosine_u = 1 / np.sqrt(1 + tangent**2)
    sine_u = tangent * cosine_u
    sine_azimuth, cosine_azimuth = np.sin(azimuth), np.cos(azimuth)
    start = np.arctan2(tangent, cosine_azimuth)
    sine_alpha = cosine_u * sine_azimuth
    cosine_square = 1 - sine_alpha**2
    a, b = _series(cosine_square * (EQUATORIAL_RADIUS**2 - POLAR_RADIUS**2) / POLAR_RADIUS**2)
    plain = distance / (POLAR_RADIUS * a)
    arc = plain
    for _ in range(12):
        middle = np.cos(2 * start + arc)
        arc = plain + _correction(b, np.sin(arc), np.cos(arc), middle)
    middle = np.cos(2 * start + arc)
    sine, cosine = np.sin(arc), np.cos(arc)
    other = sine_u * sine - cosine_u * cosine * cosine_azimuth
    end_latitude = np.arctan2(sine_u * cosine + cosine_u * sine * cosine_azimuth,
                              (1 - FLATTENING) * np.hypot(sine_alpha, other))
    spherical = np.arctan2(sine * sine_azimuth, cosine_u * cosine - sine_u * sine * cosine_azimuth)
    c = _longitude_series(cosine_square)
    difference = spherical - (1 - c) * FLATTENING * sine_alpha * (
        arc + c * sine * (middle + c * cosine * (2 * middle**2 - 1)))
    return end_latitude, wrapped(longitude + difference), np.arctan2(sine_alpha, -other)


def geodesic_inverse(start_latitude: ArrayLike, start_longitude: ArrayLike, stop_latitude: ArrayLike,
                     stop_longitude: ArrayLike) -> tuple[Array, Array, Array]:
    """Length (m) of the geodesic between two points and its azimuths (rad) at the start and at the stop.

    Raises:
        GeometryError: the points are nearly opposite on the Earth, where the series does not converge.
    """
    lat1, lon1, lat2, lon2 = np.broadcast_arrays(
        *(np.asarray(v, float) for v in (start_latitude, start_longitude, stop_latitude, stop_longitude)))
    u1, u2 = np.arctan((1 - FLATTENING) * np.tan(lat1)), np.arctan((1 - FLATTENING) * np.tan(lat2))
    sine1, cosine1, sine2, cosine2 = np.sin(u1), np.cos(u1), np.sin(u2), np.cos(u2)
    difference = wrapped(lon2 - lon1)
    spherical = difference
    change = np.inf
    for _ in range(60):
        x = cosine2 * np.sin(spherical)
        y = cosine1 * sine2 - sine1 * cosine2 * np.cos(spherical)
        sine = np.hypot(x, y)
        cosine = sine1 * sine2 + cosine1 * cosine2 * np.cos(spherical)
        arc = np.arctan2(sine, cosine)
        safe = np.where(sine == 0, 1, sine)
        sine_alpha = np.where(sine == 0, 0, cosine1 * cosine2 * np.sin(spherical) / safe)
        cosine_square = 1 - sine_alpha**2
        equatorial = cosine_square < 1e-14
        middle = np.where(equatorial, 0, cosine - 2 * sine1 * sine2 / np.where(equatorial, 1, cosine_square))
        c = _longitude_series(cosine_square)
        update = difference + (1 - c) * FLATTENING * sine_alpha * (
            arc + c * sine * (middle + c * cosine * (2 * middle**2 - 1)))
        change = float(np.max(np.abs(update - spherical), initial=0.0))
        spherical = update
        if change < 1e-14:
            break
    if not change < 1e-10 or np.any(np.abs(spherical) > np.pi):
        raise GeometryError("the geodesic between nearly opposite points of the Earth is not determined",
                            remedy="ask for points less than 19,000 km apart")
    a, b = _series(cosine_square * (EQUATORIAL_RADIUS**2 - POLAR_RADIUS**2) / POLAR_RADIUS**2)
    length = POLAR_RADIUS * a * (arc - _correction(b, sine, cosine, middle))
    forward = np.arctan2(cosine2 * np.sin(spherical), cosine1 * sine2 - sine1 * cosine2 * np.cos(spherical))
    arriving = np.arctan2(cosine1 * np.sin(spherical), -sine1 * cosine2 + cosine1 * sine2 * np.cos(spherical))
    return length, forward, arriving


class EquidistantPlane:
    """The azimuthal equidistant plane of a point: distance and azimuth from the point are true.

    Args:
        latitude, longitude: the centre, rad.
        azimuth: azimuth of the plane's ``along`` axis at the centre, rad; ``across`` is 90 degrees to its right.
    """

    def __init__(self, latitude: float, longitude: float, azimuth: float = 0.0):
        self.latitude, self.longitude, self.azimuth = float(latitude), float(longitude), float(azimuth)

    def to_plane(self, latitude: ArrayLike, longitude: ArrayLike) -> tuple[Array, Array]:
        """Coordinates along and across (m) of points given in rad."""
        distance, azimuth, _ = geodesic_inverse(self.latitude, self.longitude, latitude, longitude)
        return distance * np.cos(azimuth - self.azimuth), distance * np.sin(azimuth - self.azimuth)

    def to_ellipsoid(self, along: ArrayLike, across: ArrayLike) -> tuple[Array, Array]:
        """Latitude and longitude (rad) of points given along and across (m)."""
        along, across = np.asarray(along, float), np.asarray(across, float)
        latitude, longitude, _ = geodesic_direct(self.latitude, self.longitude,
                                                 self.azimuth + np.arctan2(across, along), np.hypot(along, across))
        return latitude, longitude


def wrapped(angle: ArrayLike) -> Array:
    """The angle (rad) brought into [-pi, pi)."""
    return np.mod(np.asarray(angle, float) + np.pi, 2 * np.pi) - np.pi


class GroundLine:
    """A geodesic on the ellipsoid, by its distance from the start.

    Args:
        latitude, longitude: start, rad.
        azimuth: azimuth at the start, rad.
    """

    def __init__(self, latitude: float, longitude: float, azimuth: float):
        self.latitude, self.longitude, self.azimuth = float(latitude), float(longitude), float(azimuth)

    def at(self, distance: ArrayLike) -> tuple[Array, Array]:
        """Earth-fixed positions (..., 3) in m and unit tangents (..., 3) at distances (m) from the start."""
        latitude, longitude, azimuth = geodesic_direct(self.latitude, self.longitude, self.azimuth, distance)
        east, north, _ = local_axes(latitude, longitude)
        tangent = np.sin(azimuth)[..., None] * east + np.cos(azimuth)[..., None] * north
        return earth_fixed_from_geodetic(latitude, longitude), tangent

    def shifted(self, distance: float) -> GroundLine:
        """The same geodesic, started ``distance`` (m) farther on."""
        latitude, longitude, azimuth = geodesic_direct(self.latitude, self.longitude, self.azimuth, distance)
        return GroundLine(float(latitude), float(longitude), float(azimuth))
