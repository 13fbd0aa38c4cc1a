"""A slew checked by an integration that knows nothing of the solver's: the classical Runge-Kutta method, dense."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from guidance.jerk_profile import JerkProfile, running_products
from guidance.kinematics import angle_between, norm, product
from guidance.slew_request import SlewRequest

Array = np.ndarray


@dataclass(frozen=True)
class Verification:
    """What the dense integration found.

    Attributes:
        rate, acceleration, jerk: largest norms, rad/s, rad/s2, rad/s3.
        terminal_error: angle to the attitude asked for at the stop, rad.
        terminal_rate_error, terminal_acceleration_error: rad/s, rad/s2.
        samples: number of points.
    """

    rate: float
    acceleration: float
    jerk: float
    terminal_error: float
    terminal_rate_error: float
    terminal_acceleration_error: float
    samples: int


def integrate(profile: JerkProfile, points: int = 10_000) -> tuple[Array, Array, Array, Array]:
    """Times (m,), quaternions (m, 4), rates (m, 3), accelerations (m, 3) on about ``points`` points.

    Every step ends at a joint or before it; rate and acceleration are summed step by step from the jerk, and the
    attitude takes one classical Runge-Kutta step of ``q' = q o w / 2`` at a time.
    """
    joints = np.concatenate([[0.0], np.cumsum(profile.durations)])
    grid = np.unique(np.concatenate([np.linspace(0, joints[-1], points), joints]))
    steps = np.diff(grid)
    middle = (grid[:-1] + grid[1:]) / 2
    jerk = profile.jerks[np.clip(np.searchsorted(joints, middle, side="right") - 1, 0, len(profile.jerks) - 1)]
    h = steps[:, None]
    acceleration = np.concatenate([profile.acceleration[None], profile.acceleration + np.cumsum(h * jerk, axis=0)])
    gained = h * acceleration[:-1] + h * h / 2 * jerk
    rate = np.concatenate([profile.rate[None], profile.rate + np.cumsum(gained, axis=0)])
    half = rate[:-1] + h / 2 * acceleration[:-1] + h * h / 8 * jerk

    def slope(q: Array, w: Array) -> Array:
        return 0.5 * product(q, np.concatenate([np.zeros((len(w), 1)), w], axis=1))

    one = np.tile([1.0, 0.0, 0.0, 0.0], (len(steps), 1))
    k1 = slope(one, rate[:-1])
    k2 = slope(one + h / 2 * k1, half)
    k3 = slope(one + h / 2 * k2, half)
    k4 = slope(one + h * k3, rate[1:])
    step = one + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    attitude = running_products(np.concatenate([profile.quaternion[None], step / norm(step)[:, None]]))
    return grid, attitude, rate, acceleration


def verify(profile: JerkProfile, request: SlewRequest, points: int = 10_000) -> Verification:
    """Integrate densely and compare with the request."""
    grid, attitude, rate, acceleration = integrate(profile, points)
    used = profile.durations > 0
    return Verification(
        float(np.max(norm(rate))), float(np.max(norm(acceleration))),
        float(np.max(norm(profile.jerks[used]), initial=0.0)),
        float(angle_between(attitude[-1], request.stop.quaternion)),
        float(np.linalg.norm(rate[-1] - request.stop.rate)),
        float(np.linalg.norm(acceleration[-1] - request.stop.acceleration)), len(grid))
