"""The least time at which a closed-form slew keeps its limits everywhere."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from guidance.kinematics import Motion, norm
from guidance.slew_request import Limits

Array = np.ndarray


class ClosedForm(Protocol):
    """A slew given by formulas: its duration and its motion at any time."""

    @property
    def duration(self) -> float:
        """Length of the slew, s."""
        ...

    def motion(self, times: Array) -> Motion:
        """Attitude, rate, acceleration and jerk at ``times`` (m,), s."""
        ...


def peak(values: Array) -> Array:
    """Largest value of a smooth sampled function over the last axis, by a parabola through the highest sample."""
    count = values.shape[-1]
    index = np.argmax(values, axis=-1, keepdims=True)
    inner = np.clip(index, 1, count - 2)
    left, middle, right = (np.take_along_axis(values, inner + d, axis=-1) for d in (-1, 0, 1))
    curvature = left - 2 * middle + right
    top = np.where(curvature < 0, middle - (right - left) ** 2 / (8 * np.where(curvature < 0, curvature, 1)), middle)
    highest = np.take_along_axis(values, index, axis=-1)
    near = (index > 0) & (index < count - 1)
    return np.where(near, np.maximum(top, highest), highest)[..., 0]


def largest_ratio(motion: Motion, limits: Limits) -> Array:
    """Largest of |rate|, |acceleration|, |jerk| over their limits along the samples (second axis from the last)."""
    # The squares are smooth where the norm has a corner at zero.
    pairs = ((motion.rate, limits.rate), (motion.acceleration, limits.acceleration), (motion.jerk, limits.jerk))
    return np.max([np.sqrt(peak(np.square(norm(v) / limit))) for v, limit in pairs], axis=0)


def least_feasible_time(ratio: Callable[[Array, int], Array], lower: float, *, reach: float = 12.0,
                        accurate: bool = True) -> float | None:
    """The least duration, from ``lower`` up, at which the largest ratio to the limits is at most one.

    Args:
        ratio: of durations (m,), s, and a number of samples: largest ratio to the limits (m,).
        lower: no shorter time is looked at, s, above zero.
        reach: the search ends at ``reach * lower``.
        accurate: refine to a relative 1e-9 on 1024 samples; otherwise to 1e-3 on 48, for a starting point.

    Returns:
        The duration, or None if no duration within reach will do. With moving ends feasibility is not monotonic in
        the duration: the first feasible stretch is the one taken.
    """
    coarse = 48 if not accurate else 96
    grid = lower * np.geomspace(1.0, reach, 64)
    good = np.flatnonzero(ratio(grid, coarse) <= 1)
    for first in good[:4]:
        low, high = (grid[first - 1], grid[first]) if first else (lower, grid[first])
        if first == 0:
            low = lower
        rounds, samples, count = (5, 1024, 9) if accurate else (1, 48, 16)
        for _ in range(rounds):
            inner = np.linspace(low, high, count)
            inside = np.flatnonzero(ratio(inner, samples) <= 1)
            if not len(inside):
                low, high = high, high * (1 + 1e-3)
                continue
            best = int(inside[0])
            high = inner[best]
            low = inner[max(best - 1, 0)]
            if accurate and high - low < 1e-9 * high:
                break
        # The parabola of the peaks is itself accurate to about 1e-7: keep clear of the limits by that much.
        high *= 1 + 1e-6 if accurate else 1.0
        if float(ratio(np.array([high]), samples)[0]) <= 1 + 1e-9:
            return float(high)
    return None
