"""What the air does to a radio signal: delay (Saastamoinen) and bending (ITU-R P.834)."""

from __future__ import annotations

import casadi as ca
import numpy as np

from estimator.models.earth import EQUATORIAL_RADIUS
from estimator.models.rotations import Matrix

LOWEST_ELEVATION = 0.05  # rad, below which the delay is held


def saastamoinen_delay(elevation: Matrix, altitude: Matrix) -> Matrix:
    """One-way delay (m) of the standard atmosphere.

    Saastamoinen (1972) with the correction table of the station's height as a function (an exponential within 2 % of
    it), for 18 degrees Celsius, 1013.25 hPa and 50 % humidity at sea level.

    Args:
        elevation: geometric, rad.
        altitude: of the station, m.
    """
    pressure = 1013.25 * (1 - 2.26e-5 * altitude) ** 5.225  # hPa
    temperature = 291.16 - 6.5e-3 * altitude  # K
    humidity = 0.5 * ca.exp(-6.396e-4 * altitude)
    vapour = humidity * ca.exp(-37.2465 + 0.213166 * temperature - 2.56908e-4 * temperature**2)  # hPa
    sine = ca.sin(ca.fmax(elevation, LOWEST_ELEVATION))
    correction = 1.156 * ca.exp(-altitude / 7050.0)  # hPa
    return 2.277e-3 / sine * (pressure + (1255 / temperature + 0.05) * vapour - correction * (1 / sine**2 - 1))


def zenith_mapping(elevation: Matrix) -> Matrix:
    """Ratio of slant to zenith delay of a thin flat layer, held below :data:`LOWEST_ELEVATION`."""
    return 1 / ca.sin(ca.fmax(elevation, LOWEST_ELEVATION))


def ionosphere_mapping(elevation: Matrix, height: float = 350e3) -> Matrix:
    """Ratio of slant to vertical delay of a thin shell at ``height`` (m)."""
    sine = EQUATORIAL_RADIUS / (EQUATORIAL_RADIUS + height) * ca.cos(elevation)
    return 1 / ca.sqrt(1 - sine * sine)


def refraction(elevation: Matrix, altitude: Matrix) -> Matrix:
    """Angle (rad) by which the air lifts a satellite (ITU-R P.834, bending as a function of the geometric elevation).

    Args:
        elevation: geometric, rad; held below -1 degree.
        altitude: of the station, m.
    """
    e = ca.fmax(elevation * 180 / np.pi, -1.0)
    h = altitude * 1e-3
    inverse = (
        1.728
        + 0.5411 * e
        + 0.03723 * e * e
        + h * (0.1815 + 0.06272 * e + 0.01380 * e * e)
        + h * h * (0.01727 + 0.008288 * e)
    )
    return np.pi / 180 / inverse
