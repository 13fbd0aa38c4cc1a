"""Accelerations of a satellite other than the Earth's gravity, as pure CasADi functions; SI, celestial axes."""

from __future__ import annotations

import casadi as ca
import numpy as np

from estimator.models.earth import EQUATORIAL_RADIUS, FLATTENING
from estimator.models.rotations import Matrix

SUN_PARAMETER = 1.32712440018e20  # m3/s2, IAU
MOON_PARAMETER = 4.9028000661e12  # m3/s2, DE 430
SUN_RADIUS = 6.957e8  # m, IAU 2015 nominal
ASTRONOMICAL_UNIT = 1.495978707e11  # m, IAU 2012
SUNLIGHT_PRESSURE = 4.56e-6  # N/m2 at one astronomical unit (1367 W/m2 over the speed of light)


def third_body(position: Matrix, body: Matrix, parameter: float) -> Matrix:
    """Acceleration (3) by a distant point mass, relative to the Earth's centre.

    Written without the difference of two nearly equal terms (Battin, 1999, section 8.4): with
    ``q = r.(r - 2 s)/s.s``, the result is ``-mu/d^3 (r + f(q) s)``, ``d`` the distance to the body.

    Args:
        position: (3) of the satellite, m, geocentric.
        body: (3) of the body, m, geocentric.
        parameter: gravitational parameter of the body, m3/s2.
    """
    q = ca.dot(position, position - 2 * body) / ca.dot(body, body)
    f = q * (3 + 3 * q + q * q) / (1 + (1 + q) ** 1.5)
    distance = ca.sqrt(ca.sumsqr(position - body))
    return -parameter / distance**3 * (position + f * body)


def sunlit_fraction(position: Matrix, sun: Matrix) -> Matrix:
    """Share of the solar disk that the Earth leaves visible, smooth through the penumbra (0 to 1).

    The overlap of the two disks is replaced by a smooth step across the penumbra's width, which has the same
    integral over a crossing to first order and, unlike the exact overlap, a derivative everywhere.
    """
    toward = sun - position
    distance = ca.sqrt(ca.sumsqr(toward))
    radius = ca.sqrt(ca.sumsqr(position))
    cosine = -ca.dot(position, toward) / (radius * distance)
    sine = ca.sqrt(ca.sumsqr(ca.cross(position, toward))) / (radius * distance)
    separation = ca.atan2(sine, cosine)
    earth = ca.asin(ca.fmin(EQUATORIAL_RADIUS / radius, 1 - 1e-12))
    u = (separation - earth) / (SUN_RADIUS / distance)  # -1 umbra, +1 full light
    s = ca.fmin(ca.fmax(0.5 * (u + 1), 0.0), 1.0)
    return s * s * s * (10 + s * (-15 + 6 * s))


def solar_pressure(position: Matrix, sun: Matrix, area_over_mass: Matrix) -> Matrix:
    """Acceleration (3) of a sphere by sunlight per unit of the reflection coefficient, m/s2.

    Args:
        position, sun: (3) geocentric, m.
        area_over_mass: m2/kg.
    """
    away = position - sun
    distance = ca.sqrt(ca.sumsqr(away))
    pressure = SUNLIGHT_PRESSURE * (ASTRONOMICAL_UNIT / distance) ** 2
    return sunlit_fraction(position, sun) * pressure * area_over_mass * away / distance


_HEIGHTS = np.array([120, 130, 140, 150, 180, 200, 220, 250, 300, 350, 400, 450, 500, 600, 700, 800, 900, 1000.0])  # km
_DENSITIES = np.array(
    [  # kg/m3, US Standard Atmosphere 1976
        2.222e-8,
        8.152e-9,
        3.831e-9,
        2.076e-9,
        5.194e-10,
        2.541e-10,
        1.367e-10,
        6.073e-11,
        1.916e-11,
        7.014e-12,
        2.803e-12,
        1.184e-12,
        5.215e-13,
        1.137e-13,
        3.070e-14,
        1.136e-14,
        5.759e-15,
        3.561e-15,
    ]
)
_FIT = np.polynomial.Polynomial.fit(np.log(_HEIGHTS - 90), np.log(_DENSITIES), 7)
_FIT_COEFFICIENTS = _FIT.convert().coef
_SCALE_HEIGHT_ABOVE = 268e3  # m, of the table's end


def air_density(height: Matrix) -> Matrix:
    """Mean density of the air (kg/m3) at a height (m) above the ellipsoid: a smooth fit to US Standard Atmosphere 1976.

    Within 10 % of the table from 120 to 1000 km, exponential above. Its real value varies several-fold with the Sun's
    activity, which a drag coefficient that is estimated absorbs.
    """
    within = ca.fmin(ca.fmax(height, 110e3), 1000e3)
    s = ca.log(within * 1e-3 - 90)
    value: Matrix = 0.0
    for c in reversed(_FIT_COEFFICIENTS):
        value = value * s + float(c)
    return ca.exp(value - ca.fmax(height - 1000e3, 0.0) / _SCALE_HEIGHT_ABOVE)


def height_above_ellipsoid(position: Matrix) -> Matrix:
    """Height (m) above the WGS 84 ellipsoid to first order of the flattening (within 40 m to 1000 km)."""
    radius = ca.sqrt(ca.sumsqr(position))
    sine = position[2] / radius
    return radius - EQUATORIAL_RADIUS * (1 - FLATTENING * sine * sine)


def drag(position: Matrix, velocity: Matrix, spin: Matrix, area_over_mass: Matrix) -> Matrix:
    """Acceleration (3) by the air per unit of the drag coefficient, the air turning with the Earth, m/s2.

    Args:
        position, velocity: (3) celestial, m and m/s.
        spin: (3) angular velocity of the Earth, celestial axes, rad/s.
        area_over_mass: m2/kg.
    """
    relative = velocity - ca.cross(spin, position)
    speed = ca.sqrt(ca.sumsqr(relative))
    return -0.5 * air_density(height_above_ellipsoid(position)) * area_over_mass * speed * relative


def orbital_axes(position: Matrix, velocity: Matrix) -> Matrix:
    """Matrix (3, 3) whose columns are the radial, along-track and cross-track unit vectors."""
    radial = position / ca.sqrt(ca.sumsqr(position))
    normal = ca.cross(position, velocity)
    cross = normal / ca.sqrt(ca.sumsqr(normal))
    return ca.horzcat(radial, ca.cross(cross, radial), cross)
