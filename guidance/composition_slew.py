"""The slew as a product of three rotations, each by a degree-7 spline, that meets every boundary condition.

``Lam(t) = Lam_i o exp(p1(t)) o exp(phi(t) e3) o exp(p2(t))``: p1 carries the rate and the acceleration of the start and
dies out, phi turns about the eigenaxis e3 of the whole turn, p2 grows into the rate, the acceleration and the jerk of
the stop. At p = 0 the motion of exp(p) is ``w = p'``, ``eps = p''``, ``eps' = p''' - p' x p'' / 2``, which gives the
third derivatives at the ends.

Source: Somov, Butyrin, Makarov, section 1, condition (2), "necessary and sufficient condition of solvability of the
Darboux problem"; the paper prints no formula. The product is the publicly known form with scalar angles about fixed
axes, made of vector splines here, since scalar ones cannot meet an acceleration that is not along the rate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from guidance.eigenaxis_slew import turn
from guidance.kinematics import Motion, compose, exponential_motion, product
from guidance.least_time import largest_ratio, least_feasible_time
from guidance.slew_request import Limits, SlewRequest
from guidance.vector_spline import hermite_matrix

Array = np.ndarray


@dataclass(frozen=True)
class CompositionSlew:
    """The law for any duration.

    Attributes:
        start: ``inertial_from_body`` at the start (4,).
        conditions: (3, 2, 4, 3): of p1, phi e3, p2: value and three time derivatives at both ends.
        duration: s.
    """

    start: Array
    conditions: Array
    duration: float = 1.0

    @classmethod
    def between(cls, request: SlewRequest, *, long_way: bool = False) -> CompositionSlew:
        """The law for a request; its duration is to be set by :func:`composition_slew`."""
        a, b = request.start, request.stop
        jerk = np.zeros(3) if b.jerk is None else b.jerk
        conditions = np.zeros((3, 2, 4, 3))
        conditions[0, 0, 1:] = a.rate, a.acceleration, np.cross(a.rate, a.acceleration) / 2
        conditions[1, 1, 0] = turn(request, long_way)
        conditions[2, 1, 1:] = b.rate, b.acceleration, jerk + np.cross(b.rate, b.acceleration) / 2
        return cls(a.quaternion, conditions)

    def _motion(self, durations: Array, tau: Array) -> Motion:
        """Motion against the start for durations (m, 1, 1) at tau (s,): arrays (m, s, ...)."""
        powers = durations[..., None] ** np.arange(4)[None, None, :, None]  # (m, 1, 4, 1)
        matrix = hermite_matrix(4)
        factors = []
        for part in self.conditions:
            scaled = (part[None] * powers).reshape(len(durations), 8, 3)
            coefficients = np.einsum("ij,mjn->imn", matrix, scaled)
            values = []
            for order in range(4):
                c = np.polynomial.polynomial.polyder(coefficients, order, axis=0) if order else coefficients
                sampled = np.einsum("si,imn->msn", np.polynomial.polynomial.polyvander(tau, len(c) - 1), c)
                values.append(sampled / durations**order)
            factors.append(exponential_motion(*values))
        return compose(compose(factors[0], factors[1]), factors[2])

    def sampled(self, durations: Array, samples: int) -> Motion:
        """Motion against the start at ``samples`` equal steps for many durations: arrays (m, samples, ...)."""
        return self._motion(np.asarray(durations, dtype=float)[:, None, None], np.linspace(0, 1, samples))

    def motion(self, times: Array) -> Motion:
        """Attitude ``inertial_from_body``, rate, acceleration and jerk at ``times`` (m,), s."""
        m = self._motion(np.array([[[self.duration]]]), np.asarray(times, dtype=float) / self.duration)
        return Motion(product(np.broadcast_to(self.start, m.quaternion[0].shape), m.quaternion[0]), m.rate[0],
                      m.acceleration[0], m.jerk[0])


def composition_slew(request: SlewRequest, limits: Limits, lower: float, *, long_way: bool = False) \
        -> CompositionSlew | None:
    """The law in its least feasible time, or None where no time will do.

    Args:
        request: the slew, with or without the jerk at the stop (zero where it is not asked for).
        limits: isotropic limits to keep.
        lower: a lower bound of the time, s.
        long_way: turn the other way about the eigenaxis.
    """
    law = CompositionSlew.between(request, long_way=long_way)
    duration = least_feasible_time(lambda t, n: largest_ratio(law.sampled(t, n), limits), max(lower, 1e-3))
    return None if duration is None else CompositionSlew(law.start, law.conditions, duration)
