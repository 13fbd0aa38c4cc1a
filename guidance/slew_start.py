"""Where the solver of a slew starts: the speed along the eigenaxis as an S-curve between moving ends, and its mesh.

The speed about the eigenaxis goes from its value at the start to a peak and to its value at the stop with limited
acceleration and jerk; the part of the end rates across the eigenaxis fades away. The duration of this law is within
half a percent of the optimum for most slews, and its switches tell where the mesh has to be fine.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from guidance.eigenaxis_slew import ramp_time, turn
from guidance.kinematics import norm
from guidance.slew_request import Limits, SlewRequest

Array = np.ndarray


@dataclass(frozen=True)
class SpeedProfile:
    """Seven segments of constant scalar jerk from one speed to another through an angle.

    Attributes:
        angle: rad, at least 0.
        start_speed, stop_speed: rad/s, along the eigenaxis.
        durations: (7,), s.
        jerk: rad/s3.
        fits: whether the angle leaves room for both ramps; if not, the profile overshoots the angle.
    """

    angle: float
    start_speed: float
    stop_speed: float
    durations: Array
    jerk: float
    fits: bool

    @property
    def duration(self) -> float:
        """s."""
        return float(np.sum(self.durations))


def speed_profile(angle: float, start_speed: float, stop_speed: float, limits: Limits) -> SpeedProfile:
    """The quickest profile with zero acceleration at both ends whose speed has one peak."""
    a, j = limits.acceleration, limits.jerk

    def reach(peak: float) -> float:
        return ((start_speed + peak) / 2 * ramp_time(peak - start_speed, a, j)
                + (stop_speed + peak) / 2 * ramp_time(peak - stop_speed, a, j))

    low, high, coast = max(start_speed, stop_speed), limits.rate, 0.0
    fits = True
    if reach(high) <= angle:
        peak = high
        coast = (angle - reach(high)) / high
    elif reach(low) >= angle:
        peak, fits = low, False
    else:
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (middle, high) if reach(middle) < angle else (low, middle)
        peak = low

    def ramp(speed: float) -> tuple[float, float]:
        change = max(peak - speed, 0.0)
        bend = min(a, np.sqrt(change * j)) / j
        return bend, max(ramp_time(change, a, j) - 2 * bend, 0.0)

    (b0, h0), (b1, h1) = ramp(start_speed), ramp(stop_speed)
    return SpeedProfile(angle, start_speed, stop_speed, np.array([b0, h0, b0, coast, b1, h1, b1]), j, fits)


def eigenaxis_profile(request: SlewRequest, limits: Limits, long_way: bool) -> tuple[Array, SpeedProfile]:
    """Unit eigenaxis (3,) in body axes, and the profile along it."""
    phi = turn(request, long_way)
    angle = float(np.linalg.norm(phi))
    if angle > 1e-9:
        axis = phi / angle
    else:
        change = request.start.rate - request.stop.rate
        size = float(np.linalg.norm(change))
        axis = change / size if size > 0 else np.array([1.0, 0.0, 0.0])
    return axis, speed_profile(angle, float(request.start.rate @ axis), float(request.stop.rate @ axis), limits)


def switching_mesh(profile: SpeedProfile, limits: Limits, parts: tuple[int, int, int, int] = (2, 4, 4, 6)) -> Array:
    """Fractions (n,) of the duration, fine about the switches of the profile.

    Args:
        profile: the speed along the eigenaxis.
        limits: of the slew.
        parts: intervals in the first bend, the hold, the second bend, the coast; the slow-down mirrors them.
    """
    total = profile.duration
    least = max(min(0.15 * limits.acceleration / limits.jerk, 0.05 * total), 0.004 * total, 1e-6)

    def graded(length: float, count: int, fine_start: bool, fine_stop: bool) -> Array:
        s = np.linspace(0, 1, count + 1)
        if fine_start and fine_stop:
            s = s - 0.8 * np.sin(2 * np.pi * s) / (2 * np.pi)
        elif fine_stop:
            s = 1 - (1 - s) ** 1.6
        elif fine_start:
            s = s**1.6
        return np.diff(s) * max(length, least)

    d = profile.durations
    bend, hold, middle, coast = parts
    pieces = [graded(d[0], bend, False, False), graded(d[1], hold, False, True), graded(d[2], middle, False, False),
              graded(d[3], coast, True, True), graded(d[4], middle, False, False), graded(d[5], hold, True, False),
              graded(d[6], bend, False, False)]
    lengths = np.concatenate(pieces)
    return lengths / np.sum(lengths)


def starting_motion(request: SlewRequest, axis: Array, profile: SpeedProfile, fractions: Array) \
        -> tuple[Array, Array, Array, float]:
    """Modified Rodrigues parameters against the half-way attitude, rate, acceleration at the nodes, and duration."""
    d, j = profile.durations, profile.jerk
    jerks = j * np.array([1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0])
    times = np.concatenate([[0.0], np.cumsum(d)])
    acceleration = np.concatenate([[0.0], np.cumsum(jerks * d)])
    speed = profile.start_speed + np.concatenate([[0.0], np.cumsum(acceleration[:-1] * d + jerks * d * d / 2)])
    path = np.concatenate([[0.0], np.cumsum(speed[:-1] * d + acceleration[:-1] * d * d / 2 + jerks * d**3 / 6)])
    t = np.concatenate([[0.0], np.cumsum(fractions)]) * profile.duration
    k = np.clip(np.searchsorted(times, t, side="right") - 1, 0, 6)
    s = t - times[k]
    along_a = acceleration[k] + jerks[k] * s
    along = speed[k] + acceleration[k] * s + jerks[k] * s * s / 2
    turned = path[k] + speed[k] * s + acceleration[k] * s * s / 2 + jerks[k] * s**3 / 6
    turned = turned + (profile.angle - path[-1]) * t / profile.duration
    across_start = request.start.rate - profile.start_speed * axis
    across_stop = request.stop.rate - profile.stop_speed * axis

    def fade(since: Array, within: float) -> tuple[Array, Array]:
        y = np.clip(since / within, 0, 1)
        return 1 - y * y * (3 - 2 * y), -6 * y * (1 - y) / within

    within_start = max(float(np.sum(d[:3])), 0.3 * profile.duration)
    within_stop = max(float(np.sum(d[4:])), 0.3 * profile.duration)
    f0, g0 = fade(t, within_start)
    f1, g1 = fade(t[-1] - t, within_stop)
    rate = along[:, None] * axis + f0[:, None] * across_start + f1[:, None] * across_stop
    accelerations = along_a[:, None] * axis + g0[:, None] * across_start - g1[:, None] * across_stop
    sigma = np.tan((turned - profile.angle / 2) / 4)[:, None] * axis
    for values, end in ((rate, "rate"), (accelerations, "acceleration")):
        values[0], values[-1] = getattr(request.start, end), getattr(request.stop, end)
    return sigma, rate, accelerations, profile.duration


def interpolated(times: Array, old_times: Array, values: Array) -> Array:
    """Linear interpolation of vectors (m, n) at new times."""
    return np.stack([np.interp(times, old_times, values[:, i]) for i in range(values.shape[1])], axis=1)


__all__ = ["SpeedProfile", "eigenaxis_profile", "interpolated", "norm", "speed_profile", "starting_motion",
           "switching_mesh"]
