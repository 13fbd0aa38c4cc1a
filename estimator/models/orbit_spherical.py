"""Motion near the stationary orbit in spherical coordinates, its linearization in closed form, and shaping filters.

State: distance r (m), right ascension (rad), declination (rad) and their rates. The satellite feels the central
field and a thrust acceleration perpendicular to the radius and parallel to the equator (the book's equations 3.59
and 3.61).
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from estimator.models.earth import GRAVITATIONAL_PARAMETER
from estimator.models.rotations import Matrix

STATE_NAMES = (
    "distance",
    "right ascension",
    "declination",
    "distance rate",
    "right ascension rate",
    "declination rate",
)


def spherical_rates(state: Matrix, thrust: Matrix = 0.0) -> Matrix:
    """Derivative (6) of the spherical state (6) with thrust acceleration (m/s2), equation 3.61."""
    r, d, vr, va, vd = state[0], state[2], state[3], state[4], state[5]
    return ca.vertcat(
        vr,
        va,
        vd,
        r * va**2 * ca.cos(d) ** 2 + r * vd**2 - GRAVITATIONAL_PARAMETER / r**2,
        -2 * vr * va / r + 2 * va * vd * ca.tan(d) + thrust / (r * ca.cos(d)),
        -2 * vr * vd / r - va**2 * ca.sin(d) * ca.cos(d),
    )


def cartesian_rates(state: Matrix, thrust: Matrix = 0.0) -> Matrix:
    """The same motion in Cartesian coordinates (6), for comparison."""
    r, v = state[:3], state[3:]
    radius = ca.sqrt(ca.sumsqr(r))
    east = ca.vertcat(-r[1], r[0], 0) / ca.sqrt(r[0] ** 2 + r[1] ** 2)
    return ca.vertcat(v, -GRAVITATIONAL_PARAMETER / radius**3 * r + thrust * east)


def cartesian_from_spherical(state: Matrix) -> Matrix:
    """Celestial position and velocity (6), m and m/s."""
    r, a, d, vr, va, vd = (state[i] for i in range(6))
    ca_, sa, cd, sd = ca.cos(a), ca.sin(a), ca.cos(d), ca.sin(d)
    radial, east = ca.vertcat(cd * ca_, cd * sa, sd), ca.vertcat(-sa, ca_, 0)
    north = ca.vertcat(-sd * ca_, -sd * sa, cd)
    return ca.vertcat(r * radial, vr * radial + r * va * cd * east + r * vd * north)


def spherical_from_cartesian(state: Matrix) -> Matrix:
    """Spherical state (6) of a celestial one; not defined on the Earth's axis."""
    p, v = state[:3], state[3:]
    r, across = ca.sqrt(ca.sumsqr(p)), ca.sqrt(p[0] ** 2 + p[1] ** 2)
    vr = ca.dot(p, v) / r
    va = (p[0] * v[1] - p[1] * v[0]) / across**2
    vd = (v[2] - vr * p[2] / r) / across
    return ca.vertcat(r, ca.atan2(p[1], p[0]), ca.atan2(p[2], across), vr, va, vd)


def stationary_matrix(radius: float, rate: float) -> np.ndarray:
    """Matrix (6, 6) of the motion linearized about a circular equatorial orbit."""
    a = np.zeros((6, 6))
    a[:3, 3:] = np.eye(3)
    a[3, 0], a[3, 4] = 3 * rate**2, 2 * radius * rate
    a[4, 3] = -2 * rate / radius
    a[5, 2] = -(rate**2)
    return a


def stationary_transition(radius: float, rate: float, interval: float) -> np.ndarray:
    """Transition matrix (6, 6) over ``interval`` (s) about a circular equatorial orbit, in closed form.

    Args:
        radius: m. rate: rad/s.
    """
    r0, n, t = radius, rate, interval
    s, c = np.sin(n * t), np.cos(n * t)
    return np.array(
        [
            [4 - 3 * c, 0, 0, s / n, 2 * r0 * (1 - c) / n, 0],
            [6 * (s - n * t) / r0, 1, 0, -2 * (1 - c) / (n * r0), 4 * s / n - 3 * t, 0],
            [0, 0, c, 0, 0, s / n],
            [3 * n * s, 0, 0, c, 2 * r0 * s, 0],
            [6 * n * (c - 1) / r0, 0, 0, -2 * s / r0, 4 * c - 3, 0],
            [0, 0, -n * s, 0, 0, c],
        ]
    )


def thrust_transition(radius: float, rate: float, interval: float, decay: float = 0.0) -> np.ndarray:
    """Response (6,) after ``interval`` to a unit thrust error at its start that decays as ``exp(-decay t)``.

    The book has this column by numerical integration only; about the stationary orbit it has a closed form.
    """
    r0, n, t, a = radius, rate, interval, decay
    s, c = np.sin(n * t), np.cos(n * t)
    if a * t < 1e-6:
        return np.array(
            [
                2 * (n * t - s) / n**2,
                (4 * (1 - c) / n**2 - 1.5 * t**2) / r0,
                0.0,
                2 * (1 - c) / n,
                (4 * s / n - 3 * t) / r0,
                0.0,
            ]
        )
    e, k = np.exp(-a * t), n**2 / (a**2 + n**2)
    scale = 2 / (a * n)
    distance = scale * ((1 - c) - k * (e - c + a / n * s))
    distance_rate = scale * (n * s - k * (-a * e + n * s + a * c))
    integral = scale * ((t - s / n) - k * ((1 - e) / a - s / n + a / n**2 * (1 - c)))
    angle_rate = -2 * n / r0 * distance + (1 - e) / (a * r0)
    angle = -2 * n / r0 * integral + (t - (1 - e) / a) / (a * r0)
    return np.array([distance, angle, 0.0, distance_rate, angle_rate, 0.0])


def decay_of_interval(interval: float) -> float:
    """Decay rate (1/s) of a first-order shaping filter whose values are independent after ``interval`` (s).

    The 99 % rule: the conditional variance reaches 99 % of the stationary one after the correlation interval, so
    ``exp(-2 a tau) = 0.01``. An infinite interval gives 0 (a random constant), a vanishing one white noise whose
    integral vanishes unless the variance grows as 1/interval.

    Raises:
        ValueError: the interval is not positive.
    """
    if not interval > 0:
        raise ValueError(f"a correlation interval must be positive, not {interval}")
    return float(np.log(100.0) / (2 * interval)) if np.isfinite(interval) else 0.0


def diffusion_of_interval(sigma: float, interval: float) -> float:
    """Coefficient B of ``dx = -a x dt + B w`` with white noise w of unit intensity and stationary sigma."""
    return float(sigma * np.sqrt(2 * decay_of_interval(interval)))


def shaping_step(sigma: float, interval: float, step: float) -> tuple[float, float]:
    """Factor and variance of the noise added over one step of a first-order shaping filter."""
    factor = float(np.exp(-decay_of_interval(interval) * step))
    return factor, sigma**2 * (1 - factor**2)
