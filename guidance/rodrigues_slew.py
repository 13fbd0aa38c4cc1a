"""Slews whose modified Rodrigues parameters are one polynomial of degree 5, 7 or 9, in the least feasible time.

The parameters are those of the rotation from the attitude half-way between the ends, so that the short way and the
long way round are both free of the singularity at a full turn. Degree 5 meets attitude, rate and acceleration; degree
7 also the jerk (zero at the start, the wanted one or zero at the stop); degree 9 also a zero derivative of the jerk
in the parameters.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from guidance.eigenaxis_slew import turn
from guidance.kinematics import Motion, exponential, motion_from_rodrigues, product, rodrigues_derivatives
from guidance.least_time import largest_ratio, least_feasible_time
from guidance.slew_request import Limits, SlewRequest
from guidance.vector_spline import hermite_matrix

Array = np.ndarray


@functools.lru_cache(maxsize=64)
def _basis(conditions: int, samples: int) -> Array:
    """(4, samples, 2k): value and three derivatives of the polynomials of unit conditions on a grid of [0, 1]."""
    matrix = hermite_matrix(conditions)
    tau = np.linspace(0, 1, samples)
    rows = []
    for order in range(4):
        derived = np.polynomial.polynomial.polyder(matrix, order, axis=0) if order else matrix
        rows.append(np.polynomial.polynomial.polyvander(tau, derived.shape[0] - 1) @ derived)
    return np.array(rows)


@dataclass(frozen=True)
class RodriguesSlew:
    """The polynomial of one way round, for any duration.

    Attributes:
        reference: attitude half-way between the ends, ``inertial_from_reference`` (4,).
        derivatives: (2, k, 3): the parameters and their time derivatives at both ends.
        duration: s.
    """

    reference: Array
    derivatives: Array
    duration: float = 1.0

    @classmethod
    def between(cls, request: SlewRequest, degree: int, *, long_way: bool = False) -> RodriguesSlew:
        """The law for a request; its duration is to be set by :func:`rodrigues_slew`."""
        count = (degree + 1) // 2
        phi = turn(request, long_way)
        half_angle = float(np.linalg.norm(phi)) / 2
        axis = phi / (2 * half_angle) if half_angle > 0 else np.array([1.0, 0.0, 0.0])
        reference = product(request.start.quaternion, exponential(phi / 2))
        sigma = np.tan(half_angle / 4) * axis
        conditions = np.zeros((2, max(count, 4), 3))
        for i, (end, value) in enumerate(((request.start, -sigma), (request.stop, sigma))):
            conditions[i, 0] = value
            conditions[i, 1:4] = rodrigues_derivatives(value, end.rate, end.acceleration, end.jerk)
        return cls(reference, conditions[:, :count])

    def sampled(self, durations: Array, samples: int) -> Motion:
        """Motion relative to the reference at ``samples`` equal steps for many durations: arrays (m, samples, ...)."""
        count = self.derivatives.shape[1]
        powers = durations[:, None, None, None] ** np.arange(count)[None, None, :, None]
        scaled = (self.derivatives[None] * powers).reshape(len(durations), 2 * count, 3)
        values = np.einsum("dsc,mcn->dmsn", _basis(count, samples), scaled)
        t = durations[:, None, None]
        return motion_from_rodrigues(values[0], values[1] / t, values[2] / t**2, values[3] / t**3)

    def motion(self, times: Array) -> Motion:
        """Attitude ``inertial_from_body``, rate, acceleration and jerk at ``times`` (m,), s."""
        count = self.derivatives.shape[1]
        scaled = (self.derivatives * (self.duration ** np.arange(count))[None, :, None]).reshape(2 * count, 3)
        coefficients = hermite_matrix(count) @ scaled
        tau = np.asarray(times, dtype=float) / self.duration
        values = []
        for order in range(4):
            derived = np.polynomial.polynomial.polyder(coefficients, order, axis=0) if order else coefficients
            values.append(np.polynomial.polynomial.polyval(tau, derived).T / self.duration**order)
        m = motion_from_rodrigues(*values)
        return Motion(product(np.broadcast_to(self.reference, m.quaternion.shape), m.quaternion), m.rate,
                      m.acceleration, m.jerk)


def rodrigues_slew(request: SlewRequest, degree: int, limits: Limits, lower: float, *, long_way: bool = False,
                   accurate: bool = True) -> RodriguesSlew | None:
    """The polynomial slew with the least feasible time, or None where no time will do.

    Args:
        request: the slew.
        degree: 5, 7 or 9; degree 5 cannot meet a jerk at the end and gives None where one is asked for.
        limits: isotropic limits to keep.
        lower: a lower bound of the time, s.
        long_way: go round the other way.
        accurate: False for a quick estimate, good for a starting point.
    """
    if degree == 5 and request.stop.jerk is not None and accurate:
        return None
    law = RodriguesSlew.between(request, degree, long_way=long_way)
    duration = least_feasible_time(lambda t, n: largest_ratio(law.sampled(t, n), limits), max(lower, 1e-3),
                                   accurate=accurate)
    return None if duration is None else RodriguesSlew(law.reference, law.derivatives, duration)
