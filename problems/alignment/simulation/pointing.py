"""The true attitude in a Doppler session: antenna axes swing slowly about an orbit-fixed look direction.

Everything is a product of direction cosine matrices; rates come from the product rule, so that they belong to the
attitude exactly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline

from problems.alignment.simulation.orbit import Orbit


@dataclass(frozen=True)
class Session:
    """One Doppler session.

    Attributes:
        start: s after the epoch.
        offset: (3) rad, constant part of the angles about antenna x, y, z.
        amplitude, period, phase: (3) rad, s, rad of the swing of each angle.
        tracker_from_antenna: (3, 3) as the attitude control believes it.
        orbit: the true orbit.
        profile: where given, the angles (3, rad) of time after the start that are added to ``offset`` in place of
            the sines; see :func:`profile_spline`.
    """

    start: float
    offset: np.ndarray
    amplitude: np.ndarray
    period: np.ndarray
    phase: np.ndarray
    tracker_from_antenna: np.ndarray
    orbit: Orbit
    profile: BSpline | None = None

    def __call__(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """``tracker_from_inertial`` matrices (n, 3, 3) and rates (n, 3) rad/s of the body in tracker axes."""
        time = np.asarray(time, dtype=float)
        frame, frame_slope = orbit_frame(self.orbit, time)
        if self.profile is None:
            argument = 2.0 * np.pi * (time[:, None] - self.start) / self.period + self.phase
            angle = self.offset + self.amplitude * np.sin(argument)
            slope = self.amplitude * np.cos(argument) * 2.0 * np.pi / self.period
        else:
            angle = self.offset + self.profile(time - self.start)
            slope = self.profile(time - self.start, 1)
        turns = [_turn(axis, angle[:, axis], slope[:, axis]) for axis in range(3)]
        # Yaw first, then pitch, then roll with the look angle in its constant part.
        product, product_slope = frame, frame_slope
        for turn, turn_slope in reversed(turns):
            product, product_slope = turn @ product, turn_slope @ product + turn @ product_slope
        attitude = self.tracker_from_antenna @ product
        attitude_slope = self.tracker_from_antenna @ product_slope
        # tracker_from_inertial turns with minus the cross-product matrix of the rate.
        skew = -attitude_slope @ np.swapaxes(attitude, 1, 2)
        rate = 0.5 * np.stack([skew[:, 2, 1] - skew[:, 1, 2], skew[:, 0, 2] - skew[:, 2, 0],
                               skew[:, 1, 0] - skew[:, 0, 1]], axis=1)
        return attitude, rate


def profile_spline(coefficients: np.ndarray, duration: float) -> BSpline:
    """Cubic B-spline of the coefficients (m, 3) rad, clamped, with uniform knots over ``duration`` s."""
    coefficients = np.asarray(coefficients, dtype=float)
    inner = np.linspace(0.0, duration, len(coefficients) - 2)
    return BSpline(np.concatenate([np.zeros(3), inner, np.full(3, duration)]), coefficients, 3)


def orbit_frame(orbit: Orbit, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Matrices (n, 3, 3) from inertial into x forward, y against the orbit's normal, z down; and their derivatives."""
    position, velocity = orbit.inertial(time)
    force = orbit.acceleration(position)
    down, down_slope = _unit(-position, -velocity)
    across, across_slope = _unit(np.cross(velocity, position), np.cross(force, position))
    forward = np.cross(across, down)
    forward_slope = np.cross(across_slope, down) + np.cross(across, down_slope)
    return np.stack([forward, across, down], axis=1), np.stack([forward_slope, across_slope, down_slope], axis=1)


def _unit(vector: np.ndarray, slope: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    length = np.linalg.norm(vector, axis=1, keepdims=True)
    unit = vector / length
    return unit, (slope - unit * np.sum(unit * slope, axis=1, keepdims=True)) / length


def _turn(axis: int, angle: np.ndarray, slope: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Matrices into axes turned about one axis, and their derivatives."""
    c, s = np.cos(angle), np.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.zeros((len(angle), 3, 3))
    matrix[:, axis, axis] = 1.0
    matrix[:, i, i] = matrix[:, j, j] = c
    matrix[:, i, j], matrix[:, j, i] = s, -s
    derivative = np.zeros_like(matrix)
    derivative[:, i, i] = derivative[:, j, j] = -s * slope
    derivative[:, i, j], derivative[:, j, i] = c * slope, -c * slope
    return matrix, derivative
