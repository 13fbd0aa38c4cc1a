"""Where the solver of a slew starts: the speed along the eigenaxis as an S-curve between moving ends, and its mesh.

The speed about the eigenaxis goes from its value at the start to a peak and to its value at the stop with limited
acceleration and jerk; the part of the end rates across the eigenaxis fades away. The duration of this law is within
half a percent of the optimum for most slews, and its switches tell where the mesh has to be fine.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from guidance.eigenaxis_slew import turn
from guidance.slew_request import Limits, SlewRequest

Array = np.ndarray


@dataclass(frozen=True)
class SpeedProfile:
    """Seven segments of constant scalar jerk from one speed to another through an angle.

    Attributes:
        angle: rad, at least 0.
        start_speed, stop_speed: rad/s, along the eigenaxis.
        start_slope: acceleration along the eigenaxis at the start, rad/s2.
        durations: (7,), s.
        jerks: (7,), rad/s3.
        fits: whether the angle leaves room for both ramps; if not, the profile overshoots the angle.
    """

    angle: float
    start_speed: float
    stop_speed: float
    start_slope: float
    durations: Array
    jerks: Array
    fits: bool

    @property
    def duration(self) -> float:
        """s."""
        return float(np.sum(self.durations))


def _ramp(speed: float, slope: float, peak: float, a: float, j: float) -> tuple[Array, float]:
    """Durations (3,) and angle of the quickest way from a speed with a slope up to ``peak`` with slope zero."""
    top = min(a, np.sqrt(max(j * (peak - speed) + slope * slope / 2, 0.0)))
    if top < slope:
        top = slope
    up, down = (top - slope) / j, top / j
    gained = (slope + top) / 2 * up + top / 2 * down
    hold = max(peak - speed - gained, 0.0) / top if top > 0 else 0.0
    after_up = speed + (slope + top) / 2 * up
    after_hold = after_up + top * hold
    angle = (speed * up + slope * up**2 / 2 + j * up**3 / 6 + after_up * hold + top * hold**2 / 2
             + after_hold * down + top * down**2 / 2 - j * down**3 / 6)
    return np.array([up, hold, down]), float(angle)


def speed_profile(angle: float, start_speed: float, stop_speed: float, limits: Limits, start_slope: float = 0.0,
                  stop_slope: float = 0.0) -> SpeedProfile:
    """The quickest profile whose speed has one peak."""
    a, j = limits.acceleration, limits.jerk

    def ramps(peak: float) -> tuple[Array, Array, float]:
        d0, s0 = _ramp(start_speed, start_slope, peak, a, j)
        d1, s1 = _ramp(stop_speed, -stop_slope, peak, a, j)
        return d0, d1, s0 + s1

    def least(speed: float, slope: float) -> float:
        """Lowest peak: slope brought to zero, upwards where it is positive."""
        return speed + slope * abs(slope) / (2 * j)

    low, high = max(least(start_speed, start_slope), least(stop_speed, -stop_slope)), limits.rate
    coast, fits = 0.0, True
    if low >= high or ramps(low)[2] >= angle:
        peak, fits = low, False
    elif ramps(high)[2] <= angle:
        peak = high
        coast = (angle - ramps(high)[2]) / high
    else:
        for _ in range(50):
            middle = (low + high) / 2
            low, high = (middle, high) if ramps(middle)[2] < angle else (low, middle)
        peak = low
    d0, d1, _ = ramps(peak)
    durations = np.concatenate([d0, [coast], d1[::-1]])
    return SpeedProfile(angle, start_speed, stop_speed, start_slope, durations,
                        j * np.array([1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0]), fits)


def eigenaxis_profile(request: SlewRequest, limits: Limits, long_way: bool) -> tuple[Array, SpeedProfile]:
    """Unit eigenaxis (3,) in body axes, and the profile along it."""
    phi = turn(request, long_way)
    angle = float(np.linalg.norm(phi))
    start, stop = request.start, request.stop
    if angle > 1e-9:
        axis = phi / angle
    else:
        change = start.rate - stop.rate
        size = float(np.linalg.norm(change))
        axis = change / size if size > 0 else np.array([1.0, 0.0, 0.0])
    return axis, speed_profile(angle, float(start.rate @ axis), float(stop.rate @ axis), limits,
                               float(start.acceleration @ axis), float(stop.acceleration @ axis))


PARTS = (1, 3, 4, 5)
"""Intervals of the first mesh in the first bend, the hold, the second bend, the coast; the slow-down mirrors them."""


def switching_mesh(profile: SpeedProfile, limits: Limits, *, exact: bool = False,
                   parts: tuple[int, int, int, int] = PARTS) -> Array:
    """Fractions (n,) of the duration, fine about the switches of the profile.

    Args:
        profile: the speed along the eigenaxis.
        limits: of the slew.
        exact: the profile is the answer itself (nothing moves across the eigenaxis): its switches are joints of the
            mesh, and segments of no length give their intervals to their neighbours. Otherwise every segment gets
            some length, since the switches of the answer are near those of the profile and not at them.
        parts: intervals in the segments.
    """
    total = profile.duration
    d = profile.durations.copy()
    bend, hold, middle, coast = parts
    counts = np.array([bend, hold, middle, coast, middle, hold, bend])
    if exact:
        for k, heirs in ((1, (0, 2)), (5, (6, 4)), (3, (2, 4))):
            if d[k] <= 1e-9 * total:
                d[k] = 0.0
                counts[heirs[0]] += counts[k] // 2
                counts[heirs[1]] += counts[k] - counts[k] // 2
                counts[k] = 0
    else:
        d = np.maximum(d, max(min(0.15 * limits.acceleration / limits.jerk, 0.05 * total), 0.004 * total, 1e-6))
    fine = ((False, False), (False, True), (False, False), (True, True), (False, False), (True, False), (False, False))
    lengths = np.concatenate([_graded(d[k], int(counts[k]), *fine[k]) for k in range(7) if counts[k]])
    return lengths / np.sum(lengths)


def even_mesh(duration: float, limits: Limits, count: int) -> Array:
    """Fractions (count,) of the duration: three intervals in the first and the last bend of the jerk, the rest even."""
    bend = min(limits.acceleration / limits.jerk / duration, 0.12)
    ends = np.full(3, bend / 3)
    return np.concatenate([ends, np.full(count - 6, (1 - 2 * bend) / (count - 6)), ends])


def _graded(length: float, count: int, fine_start: bool, fine_stop: bool) -> Array:
    """``count`` intervals of a segment, shorter towards the ends that are to be fine."""
    s = np.linspace(0, 1, count + 1)
    if fine_start and fine_stop:
        s = s - 0.8 * np.sin(2 * np.pi * s) / (2 * np.pi)
    elif fine_stop:
        s = 1 - (1 - s) ** 1.6
    elif fine_start:
        s = s**1.6
    return np.diff(s) * length


def starting_motion(request: SlewRequest, axis: Array, profile: SpeedProfile, fractions: Array) \
        -> tuple[Array, Array, Array, float]:
    """Modified Rodrigues parameters against the half-way attitude, rate, acceleration at the nodes, and duration."""
    d, jerks = profile.durations, profile.jerks
    times = np.concatenate([[0.0], np.cumsum(d)])
    acceleration = profile.start_slope + np.concatenate([[0.0], np.cumsum(jerks * d)])
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
