"""Stations on the ellipsoid: geodetic coordinates, local axes (WGS 84)."""

from __future__ import annotations

import casadi as ca
import numpy as np

from estimator.models.earth import EQUATORIAL_RADIUS, FLATTENING
from estimator.models.rotations import Matrix

ECCENTRICITY_SQUARED = FLATTENING * (2 - FLATTENING)


def earth_fixed_position(latitude: Matrix, longitude: Matrix, altitude: Matrix) -> Matrix:
    """Earth-fixed position (3), m, of geodetic latitude and longitude (rad) and altitude (m); the book's (3.65)."""
    normal = EQUATORIAL_RADIUS / ca.sqrt(1 - ECCENTRICITY_SQUARED * ca.sin(latitude) ** 2)
    across = (normal + altitude) * ca.cos(latitude)
    along = (normal * (1 - ECCENTRICITY_SQUARED) + altitude) * ca.sin(latitude)
    return ca.vertcat(across * ca.cos(longitude), across * ca.sin(longitude), along)


def station_position(latitude: float, longitude: float, altitude: float) -> np.ndarray:
    """:func:`earth_fixed_position` as numbers (3,)."""
    return np.asarray(ca.DM(earth_fixed_position(ca.DM(latitude), ca.DM(longitude), ca.DM(altitude)))).ravel()


def east_north_up(latitude: float, longitude: float) -> np.ndarray:
    """Matrix (3, 3) of local (east, north, up) from Earth-fixed axes; up is the normal of the ellipsoid."""
    sb, cb, sl, cl = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    return np.array([[-sl, cl, 0.0], [-sb * cl, -sb * sl, cb], [cb * cl, cb * sl, sb]])
