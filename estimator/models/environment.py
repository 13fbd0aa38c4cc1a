"""The surroundings of a spacecraft along its orbit: gravity, magnetic field, Sun, shadow, air, Earth's motion.

The inertial frame is the campaign's: the Earth turns about its +z by ``angle at epoch + rate t``, and the
geomagnetic field turns with it. Directions from astropy (barycentric, ICRS axes) are used in the same axes; polar
motion, precession and nutation within a campaign, arcseconds to arcminutes against the campaign's own simple rotation,
are below what any effect of the library can see.

astropy and ppigrf are imported when first needed and never reach for the network.
"""

from __future__ import annotations

import datetime
import itertools
import logging
import warnings

import numpy as np
from scipy.interpolate import CubicSpline

from estimator.models.earth import EQUATORIAL_RADIUS, FLATTENING, GRAVITATIONAL_PARAMETER, J2
from estimator.models.errors import NotFiniteError, RequestError, ShapeError

SUN_RADIUS = 6.957e8  # m, IAU 2015 nominal
REFERENCE_ALTITUDE = 7.0e5  # m
REFERENCE_DENSITY = 3.6e-14  # kg/m3 at the reference altitude, mean solar activity
SCALE_HEIGHT = 7.1e4  # m
FIELD_SPACING = 10.0  # s between evaluations of the geomagnetic model, which is interpolated by a cubic spline
FIELD_TOLERANCE = 1e-9  # T: largest interpolation error that is accepted
FIELD_YEARS = (1900, 2030)  # covered by the IGRF coefficients

_log = logging.getLogger(__name__)


def gravity(position: np.ndarray) -> np.ndarray:
    """Acceleration (n, 3) m/s2 of the central term and J2 at ``position`` (n, 3) m, inertial, +z the polar axis.

    Source: Montenbruck and Gill, Satellite Orbits, section 3.2.
    """
    square = np.sum(position**2, axis=1, keepdims=True)
    z2 = position[:, 2:] ** 2 / square
    oblate = 1.5 * J2 * EQUATORIAL_RADIUS**2 / square
    factor = np.concatenate([1 - oblate * (5 * z2 - 1)] * 2 + [1 - oblate * (5 * z2 - 3)], axis=1)
    return -GRAVITATIONAL_PARAMETER / (square * np.sqrt(square)) * position * factor


def orbit_phase(position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Angle (n,) rad in (-pi, pi] along the orbit from the ascending node; from the x axis where there is no node."""
    normal = np.cross(position, velocity)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal / np.where(length > 0, length, 1)
    node = np.stack([-normal[:, 1], normal[:, 0], np.zeros(len(normal))], axis=1)
    equatorial = np.hypot(node[:, 0], node[:, 1]) < 1e-9
    node[equatorial] = (1.0, 0.0, 0.0)
    ahead = np.cross(normal, node)
    return np.arctan2(np.sum(position * ahead, axis=1), np.sum(position * node, axis=1))


def altitude(position: np.ndarray) -> np.ndarray:
    """Height (n,) m above the Earth's ellipsoid along the radius, to first order in the flattening."""
    radius = np.linalg.norm(position, axis=1)
    return radius - EQUATORIAL_RADIUS * (1 - FLATTENING * (position[:, 2] / radius) ** 2)


def density(position: np.ndarray) -> np.ndarray:
    """Density (n,) kg/m3 of an exponential atmosphere: scale height 71 km about 700 km altitude."""
    return REFERENCE_DENSITY * np.exp(-(altitude(position) - REFERENCE_ALTITUDE) / SCALE_HEIGHT)


def sunlit(position: np.ndarray, sun: np.ndarray, sun_distance: np.ndarray | float = 1.495978707e11) -> np.ndarray:
    """Visible fraction (n,) of the Sun's disc: 1 in sunlight, 0 in the Earth's shadow, smooth in the penumbra.

    The Earth's limb is taken as a straight edge across the disc, as it is to the ratio of the two radii (1/250 in a
    low orbit).

    Args:
        position: (n, 3) m from the Earth's centre.
        sun: (n, 3) unit vectors from the spacecraft to the Sun, same axes.
        sun_distance: (n,) m.
    """
    radius = np.linalg.norm(position, axis=1)
    to_earth = -position / radius[:, None]
    separation = 2 * np.arctan2(np.linalg.norm(sun - to_earth, axis=1), np.linalg.norm(sun + to_earth, axis=1))
    earth = np.arcsin(np.clip(EQUATORIAL_RADIUS / radius, 0, 1))
    disc = np.arcsin(SUN_RADIUS / np.asarray(sun_distance))
    u = np.clip((separation - earth) / disc, -1, 1)
    return 0.5 + (u * np.sqrt(1 - u * u) + np.arcsin(u)) / np.pi


def _rotated_about_z(vectors: np.ndarray, angle: np.ndarray) -> np.ndarray:
    cosine, sine = np.cos(angle), np.sin(angle)
    x, y, z = vectors.T
    return np.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=1)


def _utc(epoch: str) -> datetime.datetime:
    try:
        moment = datetime.datetime.fromisoformat(epoch.strip().replace("Z", "+00:00"))
    except ValueError as error:
        raise RequestError("the epoch is not an ISO 8601 date and time", where="epoch", value=repr(epoch),
                           remedy="write it as 2024-03-01T00:00:00Z") from error
    return moment if moment.tzinfo is None else moment.astimezone(datetime.UTC).replace(tzinfo=None)


def geomagnetic_field(epoch: str, time: np.ndarray, position_earth_fixed: np.ndarray) -> np.ndarray:
    """IGRF field (n, 3) T in Earth-fixed axes at ``position_earth_fixed`` (n, 3) m, evaluated at every point.

    The coefficients are those of the first and the last time, interpolated linearly between; before 1900 and after 2030
    they are those of the nearer end, and a warning is logged.
    """
    import ppigrf

    start = _utc(epoch)
    first, last = datetime.datetime(FIELD_YEARS[0], 1, 1), datetime.datetime(FIELD_YEARS[1], 1, 1)
    wanted = [start + datetime.timedelta(seconds=float(t)) for t in (time.min(), time.max())]
    dates = [min(max(date, first), last) for date in wanted]
    if dates != wanted:
        _log.warning("the IGRF covers %d to %d; its coefficients of %s stand for %s", *FIELD_YEARS,
                     dates[0].date(), wanted[0].date())
    x, y, z = position_earth_fixed.T
    across = np.hypot(x, y)
    colatitude, longitude = np.arctan2(across, z), np.arctan2(y, x)
    # the model is singular on the polar axis itself; a microradian beside it the field is the same
    colatitude = np.clip(colatitude, 1e-6, np.pi - 1e-6)
    radius = np.hypot(across, z)
    same = dates[0] == dates[1]
    components = ppigrf.igrf_gc(radius / 1e3, np.degrees(colatitude), np.degrees(longitude),
                                dates[:1] if same else dates)  # km, degrees, nT
    span = time.max() - time.min()
    weight = np.zeros(len(time)) if same or span <= 0 else (time - time.min()) / span
    radial, south, east = ((1 - weight) * c[0] + weight * c[-1] for c in components)
    outward = radial * np.sin(colatitude) + south * np.cos(colatitude)
    field = np.stack([outward * np.cos(longitude) - east * np.sin(longitude),
                      outward * np.sin(longitude) + east * np.cos(longitude),
                      radial * np.cos(colatitude) - south * np.sin(colatitude)], axis=1)
    return field * 1e-9  # nT to T


def _stretches(time: np.ndarray) -> list[tuple[int, int]]:
    """Index ranges without a gap longer than the spacing of the field's knots."""
    cuts = np.flatnonzero(np.diff(time) > FIELD_SPACING) + 1
    ends = [0, *cuts.tolist(), len(time)]
    return list(itertools.pairwise(ends))


def _field_along(epoch: str, time: np.ndarray, position: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Field (n, 3) T in inertial axes: the model at knots about ten seconds apart, a spline between.

    Points midway between knots are evaluated as well; where one of them disagrees, every point is.
    """
    order = np.argsort(time, kind="stable")
    sorted_time = time[order]
    knots: list[int] = []
    splines: list[tuple[int, int, list[int]]] = []
    for a, b in _stretches(sorted_time):
        at = np.arange(sorted_time[a], sorted_time[b - 1] + FIELD_SPACING, FIELD_SPACING)
        chosen = np.unique(np.clip(np.searchsorted(sorted_time[a:b], at), 0, b - a - 1)) + a
        chosen = chosen[np.diff(sorted_time[chosen], prepend=-np.inf) > 0]
        if len(chosen) < 5 or b - a < 3 * len(chosen):
            knots.extend(range(a, b))
        else:
            splines.append((a, b, chosen.tolist()))
            knots.extend(chosen.tolist())
    checks = [(c[i] + c[i + 1]) // 2 for _, _, c in splines for i in {0, len(c) // 3, 2 * len(c) // 3, len(c) - 2}]
    wanted = np.unique(np.array([*knots, *checks], dtype=int))

    def evaluate(rows: np.ndarray) -> np.ndarray:
        at = order[rows]
        earth_fixed = _rotated_about_z(position[at], -angle[at])
        return _rotated_about_z(geomagnetic_field(epoch, time[at], earth_fixed), angle[at])

    sorted_field = np.full((len(time), 3), np.nan)
    known = evaluate(wanted)
    sorted_field[wanted] = known
    for a, b, at_knots in splines:
        sorted_field[a:b] = CubicSpline(sorted_time[at_knots], sorted_field[at_knots])(sorted_time[a:b])
    if np.max(np.abs(sorted_field[wanted] - known)) > FIELD_TOLERANCE:
        sorted_field = evaluate(np.arange(len(time)))
    field = np.empty_like(sorted_field)
    field[order] = sorted_field
    return field


def earth_and_sun(epoch: str, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Velocity (n, 3) m/s of the Earth against the solar system's barycentre, and the Sun (n, 3) m from the Earth.

    The Sun's place is geometric (no light time, no aberration: 20 arcseconds). Source: astropy's built-in ephemeris,
    evaluated at least every half hour and interpolated; times more than a day apart are taken for themselves.
    """
    order = np.argsort(time, kind="stable")
    cuts = np.flatnonzero(np.diff(time[order]) > 86400.0) + 1  # s; years without samples must not cost knots
    velocity, sun = np.empty((len(time), 3)), np.empty((len(time), 3))
    for rows in np.split(order, cuts):
        velocity[rows], sun[rows] = _earth_and_sun_along(epoch, time[rows])
    return velocity, sun


def _earth_and_sun_along(epoch: str, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """:func:`earth_and_sun` at times (n,) s without long gaps."""
    from astropy import units
    from astropy.coordinates import get_body_barycentric, get_body_barycentric_posvel
    from astropy.time import Time, TimeDelta
    from astropy.utils import iers

    first, last = float(time.min()) - 1.0, float(time.max()) + 1.0
    knots = np.linspace(first, last, max(5, int((last - first) / 1800.0) + 2))
    with iers.conf.set_temp("auto_download", False), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # dates beyond the table of leap seconds: a second moves nothing here
        moments = Time(_utc(epoch), scale="utc").tdb + TimeDelta(knots, format="sec")
        place, speed = get_body_barycentric_posvel("earth", moments, ephemeris="builtin")
        sun = get_body_barycentric("sun", moments, ephemeris="builtin")
        velocity = speed.xyz.to_value(units.m / units.s).T
        relative = (sun - place).xyz.to_value(units.m).T
    return CubicSpline(knots, velocity)(time), CubicSpline(knots, relative)(time)


def environment_table(epoch: str, time: np.ndarray, position_inertial: np.ndarray, velocity_inertial: np.ndarray,
                      earth_rotation_angle_at_epoch: float, earth_rotation_rate: float) -> dict[str, np.ndarray]:
    """Everything of a :class:`~estimator.effects.declaration.Sample` that depends on time and orbit alone.

    Args:
        epoch: UTC, ISO 8601.
        time: (n,) s after the epoch, in any order.
        position_inertial: (n, 3) m.
        velocity_inertial: (n, 3) m/s.
        earth_rotation_angle_at_epoch: rad, about +z from inertial.
        earth_rotation_rate: rad/s.

    Returns:
        The arrays of :data:`~estimator.effects.declaration.ENVIRONMENT` by name: (n,) where the size is 1, else (n, 3).

    Raises:
        ShapeError: the arrays do not have one row per time.
        NotFiniteError: a time, position or velocity is not finite.
        RequestError: the epoch cannot be read, or a position lies inside the Earth.
    """
    time = np.asarray(time, dtype=float)
    position = np.asarray(position_inertial, dtype=float)
    velocity = np.asarray(velocity_inertial, dtype=float)
    if time.ndim != 1:
        raise ShapeError("time must have one dimension", where="time", value=time.shape)
    for name, array in (("position_inertial", position), ("velocity_inertial", velocity)):
        if array.shape != (len(time), 3):
            raise ShapeError("one row of three per time is needed", where=name, value=array.shape,
                             limit=(len(time), 3))
    for name, array in (("time", time), ("position_inertial", position), ("velocity_inertial", velocity)):
        if not np.all(np.isfinite(array)):
            row = int(np.flatnonzero(~np.isfinite(array.reshape(len(time), -1)).all(axis=1))[0])
            raise NotFiniteError("a value is not finite", where=f"{name}[{row}]")
    _utc(epoch)
    if len(time) == 0:
        vector, scalar = np.zeros((0, 3)), np.zeros(0)
        return {"time": scalar, "position": vector, "velocity": vector, "acceleration": vector,
                "earth_fixed_velocity": vector, "earth_angle": scalar, "orbit_phase": scalar, "magnetic_field": vector,
                "sun": vector, "sunlit": scalar, "density": scalar, "earth_velocity": vector}
    radius = np.linalg.norm(position, axis=1)
    if radius.min() < 6.3e6:  # m, below the polar radius
        row = int(np.argmin(radius))
        raise RequestError("the position lies inside the Earth", where=f"position_inertial[{row}]",
                           value=f"{radius[row]:.6g} m from the centre", limit="6.3e6 m", remedy="give metres")
    angle = earth_rotation_angle_at_epoch + earth_rotation_rate * time
    spin = np.stack([-position[:, 1], position[:, 0], np.zeros(len(time))], axis=1) * earth_rotation_rate
    earth_velocity, sun_from_earth = earth_and_sun(epoch, time)
    sun_from_here = sun_from_earth - position
    sun_distance = np.linalg.norm(sun_from_here, axis=1)
    sun = sun_from_here / sun_distance[:, None]
    return {
        "time": time,
        "position": position,
        "velocity": velocity,
        "acceleration": gravity(position),
        "earth_fixed_velocity": velocity - spin,
        "earth_angle": angle,
        "orbit_phase": orbit_phase(position, velocity),
        "magnetic_field": _field_along(epoch, time, position, angle),
        "sun": sun,
        "sunlit": sunlit(position, sun, sun_distance),
        "density": density(position),
        "earth_velocity": earth_velocity,
    }
