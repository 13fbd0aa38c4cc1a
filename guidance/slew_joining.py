"""The slew between two given motions: a quick estimate of its time for planning, and the slew itself.

The survey planner needs both through one small interface. The slew is the optimal one of
:mod:`guidance.slew_optimum`; where that finds none, the closed-form polynomial in modified Rodrigues parameters with
the least feasible time stands in.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.models.errors import InfeasibleError
from guidance.kinematics import Motion, angle_between, conjugate, logarithm, product
from guidance.rodrigues_slew import RodriguesSlew, rodrigues_slew
from guidance.slew_bounds import lower_bound
from guidance.slew_request import Boundary, Limits, SlewRequest

if TYPE_CHECKING:
    from guidance.slew_optimum import Optimum

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Join:
    """A slew between two motions.

    Attributes:
        start: s from the epoch.
        duration: s.
        angle: rad, of the rotation from the first to the last attitude.
        law: ``optimal`` or the name of the closed form.
        at: motion at times since the slew's start, s.
        memory: what the solver can start a neighbouring slew from.
    """

    start: float
    duration: float
    angle: float
    law: str
    at: Callable[[Array], Motion]
    memory: Optimum | None = None

    @property
    def stop(self) -> float:
        """s from the epoch."""
        return self.start + self.duration

    def motion(self, times: ArrayLike) -> Motion:
        """Attitude (inertial from body), rate, acceleration, jerk at times (s from the epoch) inside the slew."""
        return self.at(np.clip(np.asarray(times, float) - self.start, 0.0, self.duration))


def end_of(motion: Motion) -> Motion:
    """One instant (arrays (4,), (3,)) of a motion sampled at one time."""
    return Motion(*(np.asarray(v).reshape(-1, v.shape[-1])[-1]
                    for v in (motion.quaternion, motion.rate, motion.acceleration, motion.jerk)))


def estimated_duration(start: Motion, stop: Motion, limits: Limits) -> float:
    """Time (s) that a good slew takes, to a few per cent and without solving for it.

    The rotation vector is treated as a plane displacement. The mean of the end rates is taken out; what is left is
    done by two opposite half-pulses of acceleration, on top of the constant acceleration that changes the rate, each
    with ramps of the jerk limit.
    """
    turn = logarithm(product(conjugate(start.quaternion), stop.quaternion))
    change = stop.rate - start.rate
    mean = 0.5 * (start.rate + stop.rate)
    speed_change = float(np.linalg.norm(change))

    def excess(duration: float) -> float:
        half = 0.5 * duration
        left = turn - mean * duration
        size = float(np.linalg.norm(left))
        square = half**4 - 4 * half * size / limits.jerk
        if square < 0:
            return 1.0
        pulse = (half**2 - math.sqrt(square)) * limits.jerk / (2 * half)
        square = duration**2 - 4 * speed_change / limits.jerk
        if square < 0:
            return 1.0
        steady = 0.5 * (duration - math.sqrt(square)) * limits.jerk
        direction = left / size if size > 0 else np.zeros(3)
        push = change * (steady / speed_change) if speed_change > 0 else np.zeros(3)
        largest = max(float(np.linalg.norm(push + pulse * direction)), float(np.linalg.norm(push - pulse * direction)))
        peak = float(np.linalg.norm(mean + pulse * (half - pulse / limits.jerk) * direction))
        return max(largest / limits.acceleration, peak / limits.rate) - 1

    low, high = 1e-3, 4.0
    while excess(high) > 0:
        low, high = high, 1.3 * high
        if high > 3600:
            return math.inf
    for _ in range(30):
        middle = 0.5 * (low + high)
        if excess(middle) > 0:
            low = middle
        else:
            high = middle
    return high


def _request(start: Motion, stop: Motion, limits: Limits) -> SlewRequest:
    flip = -1.0 if float(start.quaternion @ stop.quaternion) < 0 else 1.0
    return SlewRequest(limits, Boundary(start.quaternion, start.rate, start.acceleration),
                       Boundary(flip * stop.quaternion, stop.rate, stop.acceleration))


class Joiner:
    """Makes slews under given limits.

    Args:
        limits: of the survey.
        margin: share of every limit that the slews leave unused (a guard for readers that differentiate the file).
        optimal: use the optimal control problem; otherwise the closed form of degree 5.
    """

    def __init__(self, limits: Limits, *, margin: float = 1e-6, optimal: bool = True):
        share = 1 - margin
        self.limits = Limits(limits.rate * share, limits.acceleration * share, limits.jerk * share)
        self.optimal = optimal

    def estimate(self, start: Motion, stop: Motion) -> float:
        """See :func:`estimated_duration`."""
        return estimated_duration(start, stop, self.limits)

    def join(self, start: Motion, stop: Motion, at: float, near: Join | None = None) -> Join:
        """The fastest slew from the motion ``start`` to the motion ``stop``, begun at ``at`` (s from the epoch).

        Args:
            near: a slew between nearly the same motions, from which to start.

        Raises:
            InfeasibleError: no slew under the limits joins the two.
        """
        for name, limit in (("rate", self.limits.rate), ("acceleration", self.limits.acceleration)):
            for end in (start, stop):
                found = float(np.linalg.norm(getattr(end, name)))
                if found > limit * (1 + 1e-5):
                    raise InfeasibleError(f"the {name} at the end of a slew is {math.degrees(found):.4f} deg, limit "
                                          f"{math.degrees(limit):.4f} deg", limit=name, excess=found - limit)
        request = _request(start, stop, self.limits)
        angle = float(angle_between(start.quaternion, stop.quaternion))
        if self.optimal:
            found_slew = _optimum(request, near.memory if near is not None else None)
            if found_slew is not None:
                return Join(at, found_slew.duration, angle, "optimal", found_slew.profile.motion, found_slew)
        law = _closed_form(request, self.limits)
        return Join(at, law.duration, angle, "polynomial of degree 5", law.motion)

    def join_in(self, start: Motion, stop: Motion, at: float, duration: float) -> Join | None:
        """A smooth slew that takes exactly ``duration``, or None where the limits do not allow it."""
        request = _request(start, stop, self.limits)
        angle = float(angle_between(start.quaternion, stop.quaternion))
        if self.optimal and duration < 120.0:
            smooth = _optimum(replace(request, objective="smoothness", duration=duration), None)
            if smooth is not None:
                return Join(at, duration, angle, "smoothest", smooth.profile.motion)
        for degree in (7, 5):
            law = RodriguesSlew.between(request, degree)
            law = RodriguesSlew(law.reference, law.derivatives, duration)
            times = np.linspace(0, duration, 400)
            motion = law.motion(times)
            if all(float(np.max(np.linalg.norm(v, axis=-1))) <= limit for v, limit in
                   ((motion.rate, self.limits.rate), (motion.acceleration, self.limits.acceleration),
                    (motion.jerk, self.limits.jerk))):
                return Join(at, duration, angle, f"polynomial of degree {degree}", law.motion)
        return None


def _closed_form(request: SlewRequest, limits: Limits) -> RodriguesSlew:
    law = rodrigues_slew(request, 5, limits, lower_bound(request, limits))
    if law is None:
        raise InfeasibleError("no slew under the limits on rate, acceleration and jerk joins two scans",
                              limit="rate, acceleration, jerk")
    return law


def _optimum(request: SlewRequest, near: Optimum | None) -> Optimum | None:
    """The optimal slew, or None where the solver certifies none."""
    from guidance.slew_optimum import optimal_slew

    try:
        return optimal_slew(request, near=near)
    except InfeasibleError:
        return None
