"""How short a slew can be at best: a bound that no solution beats, and the checks before any solver is called.

With v = |w| the angle between the attitudes is at most the integral of v. Under |eps| <= a and |jerk| <= j the speed
obeys v' <= min(a, |eps_start| + j t), the same backwards from the stop, v <= w_max, and v'' >= -j (the norm of a
vector bends down no faster than its second derivative). The largest angle in a given time under these four is the
scalar S-curve between the end speeds; from rest to rest it is the seven-segment slew itself. Two more bounds come
from the change of rate along a fixed body axis and from the change of acceleration.
"""

from __future__ import annotations

import math

import numpy as np

from guidance.eigenaxis_slew import turn
from guidance.slew_request import Limits, SlewRequest

Array = np.ndarray


def _ramp_from(speed: float, slope: float, peak: float, a: float, j: float) -> tuple[float, float]:
    """Time and angle of the quickest rise from ``speed`` with slope ``slope`` >= 0 to ``peak`` with slope zero."""
    change = peak - speed
    top = min(a, math.sqrt(max(j * change + slope * slope / 2, slope * slope)))
    up, down = (top - slope) / j, top / j
    hold = max(change - (top * top - slope * slope) / (2 * j) - top * top / (2 * j), 0.0) / top if top > 0 else 0.0
    after_up = speed + slope * up + j * up * up / 2
    angle = speed * up + slope * up * up / 2 + j * up**3 / 6
    angle += after_up * hold + top * hold * hold / 2
    after_hold = after_up + top * hold
    angle += after_hold * down + top * down * down / 2 - j * down**3 / 6
    return up + hold + down, angle


def _angle_bound(angle: float, v0: float, e0: float, v1: float, e1: float, limits: Limits) -> float:
    """Least time (s) in which the integral of the speed can reach ``angle`` (rad), 0 where the speeds exceed it."""
    a, j, w = limits.acceleration, limits.jerk, limits.rate
    if angle <= 0:
        return 0.0
    least_peak = max(v0 + e0 * e0 / (2 * j), v1 + e1 * e1 / (2 * j))
    simple = angle / w
    if least_peak >= w:
        return simple

    def both(peak: float) -> tuple[float, float]:
        t0, s0 = _ramp_from(v0, e0, peak, a, j)
        t1, s1 = _ramp_from(v1, e1, peak, a, j)
        return t0 + t1, s0 + s1

    if both(least_peak)[1] >= angle:
        # Too short for an S-curve between the ends: the envelope of the speeds alone.
        def reach(t: float) -> float:
            tau = np.linspace(0, t, 257)
            forward = v0 + np.minimum(e0 * tau + j * tau * tau / 2, a * tau)
            back = t - tau
            backward = v1 + np.minimum(e1 * back + j * back * back / 2, a * back)
            speed = np.minimum(np.minimum(forward, backward), w)
            return float(np.max(speed[1:] + speed[:-1]) and np.sum(np.maximum(speed[1:], speed[:-1])) * t / 256)

        low, high = 0.0, both(least_peak)[0]
        if reach(high) < angle:
            return simple
        for _ in range(40):
            middle = (low + high) / 2
            low, high = (middle, high) if reach(middle) < angle else (low, middle)
        return max(low, simple)
    time, reached = both(w)
    if reached <= angle:
        return time + (angle - reached) / w
    low, high = least_peak, w
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (middle, high) if both(middle)[1] < angle else (low, middle)
    return both(low)[0]


def _rate_change_bound(change: float, a0: float, a1: float, a: float, j: float) -> float:
    """Least time (s) for a scalar rate to change by ``change`` >= 0 from acceleration ``a0`` to ``a1``."""
    def between(top: float) -> tuple[float, float]:
        t0, t1 = abs(top - a0) / j, abs(top - a1) / j
        return t0 + t1, (a0 + top) / 2 * t0 + (a1 + top) / 2 * t1

    direct = abs(a1 - a0) / j
    if change <= (a0 + a1) / 2 * direct:
        return direct  # the other way would only be longer: still a bound
    time, gained = between(a)
    if gained <= change:
        return time + (change - gained) / a
    low, high = max(a0, a1), a
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if between(middle)[1] < change else (low, middle)
    return between(low)[0]


def lower_bound(request: SlewRequest, limits: Limits, *, long_way: bool | None = None) -> float:
    """A time (s) below which no slew under ``limits`` ends, whatever its path.

    Args:
        request: the slew.
        limits: isotropic limits that hold on the way.
        long_way: bound the one way round only; by default both (the shorter angle).
    """
    angle = float(np.linalg.norm(turn(request, bool(long_way))))
    start, stop = request.start, request.stop
    norms = [float(np.linalg.norm(x)) for x in (start.rate, start.acceleration, stop.rate, stop.acceleration)]
    bounds = [_angle_bound(angle, norms[0], norms[1], norms[2], norms[3], limits),
              float(np.linalg.norm(stop.acceleration - start.acceleration)) / limits.jerk]
    difference = stop.rate - start.rate
    change = float(np.linalg.norm(difference))
    if change > 0:
        n = difference / change
        bounds.append(_rate_change_bound(change, float(start.acceleration @ n), float(stop.acceleration @ n),
                                         limits.acceleration, limits.jerk))
    return max(bounds)
