"""The seven-segment S-curve about the eigenaxis: the shortest slew from rest to rest under isotropic norm limits.

Jerk up, acceleration held, jerk down, coast, and the mirror image; segments that the angle leaves no room for have
zero length. With limits on the Euclidean norms of rate, acceleration and jerk nothing is quicker from rest to rest,
which makes it the floor of the slew problem (:mod:`guidance.slew_bounds` proves the bound for moving ends).
"""

from __future__ import annotations

import math

import numpy as np

from guidance.jerk_profile import JerkProfile
from guidance.kinematics import conjugate, logarithm, product
from guidance.slew_request import Limits, SlewRequest

Array = np.ndarray


def ramp_time(change: float, acceleration: float, jerk: float) -> float:
    """Least time (s) to change the rate by ``change`` >= 0 (rad/s) from zero to zero acceleration."""
    if change <= 0:
        return 0.0
    if change <= acceleration**2 / jerk:
        return 2 * math.sqrt(change / jerk)
    return acceleration / jerk + change / acceleration


def s_curve_segments(angle: float, limits: Limits) -> Array:
    """Durations (7,) of the segments for a turn by ``angle`` (rad) from rest to rest, s."""
    a, j, w = limits.acceleration, limits.jerk, limits.rate
    if angle <= 0:
        return np.zeros(7)
    peak_acceleration = (angle * j * j / 2) ** (1 / 3)
    if peak_acceleration <= a:
        peak = peak_acceleration**2 / j
    else:
        peak = a / 2 * (math.sqrt((a / j) ** 2 + 4 * angle / a) - a / j)
    coast = 0.0
    if peak > w:
        peak = w
        coast = angle / w - ramp_time(w, a, j)
    reached = min(a, math.sqrt(peak * j))
    bend = reached / j
    hold = max(ramp_time(peak, a, j) - 2 * bend, 0.0)
    return np.array([bend, hold, bend, coast, bend, hold, bend])


def s_curve_duration(angle: float, limits: Limits) -> float:
    """Least time (s) of a turn by ``angle`` (rad) from rest to rest."""
    return float(np.sum(s_curve_segments(angle, limits)))


def turn(request: SlewRequest, long_way: bool = False) -> Array:
    """Rotation vector (3,), rad, from the start to the stop in body axes of the start, the short or the long way."""
    phi = logarithm(product(conjugate(request.start.quaternion), request.stop.quaternion))
    if not long_way:
        return phi
    angle = float(np.linalg.norm(phi))
    axis = phi / angle if angle > 1e-12 else np.array([1.0, 0.0, 0.0])
    return -(2 * math.pi - angle) * axis


def is_rest_to_rest(request: SlewRequest) -> bool:
    """Whether rates and accelerations at both ends are zero (and no jerk is asked for at the end)."""
    ends = (request.start, request.stop)
    return request.stop.jerk is None and not any(np.any(e.rate) or np.any(e.acceleration) for e in ends)


def eigenaxis_slew(request: SlewRequest, limits: Limits | None = None) -> JerkProfile | None:
    """The S-curve for a request from rest to rest, None for any other.

    Args:
        request: the slew.
        limits: isotropic limits to keep in place of the request's.
    """
    if not is_rest_to_rest(request):
        return None
    phi = turn(request)
    angle = float(np.linalg.norm(phi))
    used = limits or request.limits
    axis = phi / angle if angle > 0 else np.array([1.0, 0.0, 0.0])
    durations = s_curve_segments(angle, used)
    signs = np.array([1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0])
    return JerkProfile(request.start.quaternion, np.zeros(3), np.zeros(3), durations,
                       signs[:, None] * used.jerk * axis[None])
