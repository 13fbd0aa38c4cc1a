"""Smooth vector splines of odd degree through values and derivatives at knots.

A spline of degree 2k - 1 takes the value and k - 1 derivatives at every knot: degree 5 value, rate and acceleration,
degree 7 also the jerk, degree 9 also the derivative of the jerk. Pieces join with k - 1 continuous derivatives.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from estimator.models.errors import NotFiniteError, ShapeError, TimeOrderError

Array = np.ndarray


@functools.cache
def hermite_matrix(conditions: int) -> Array:
    """Matrix (2k, 2k) from value and derivatives at 0 and at 1 to the coefficients of the polynomial on [0, 1].

    Columns: value, first, ..., (k-1)-th derivative at 0, then the same at 1. Rows: powers 0 to 2k - 1. The matrix is
    of integers over factorials, so that solving in floating point and rounding gives it exactly.
    """
    size = 2 * conditions
    rows = np.zeros((size, size))
    for order in range(conditions):
        rows[order, order] = math.factorial(order)
        for power in range(order, size):
            rows[conditions + order, power] = math.factorial(power) / math.factorial(power - order)
    scale = np.array([math.factorial(i % conditions) for i in range(size)], dtype=float)
    exact = np.rint(np.linalg.inv(rows) * scale)
    result = exact / scale
    result.flags.writeable = False
    return result


@dataclass(frozen=True)
class VectorSpline:
    """Piecewise polynomial with values in R^n.

    Attributes:
        knots: times (m + 1,), s, increasing.
        coefficients: (m, degree + 1, n): powers of (t - knot) / (length of the piece).
    """

    knots: Array
    coefficients: Array

    @classmethod
    def through(cls, knots: ArrayLike, conditions: ArrayLike) -> VectorSpline:
        """The spline through ``conditions``.

        Args:
            knots: times (m + 1,), s, increasing.
            conditions: (m + 1, k, n): value and k - 1 derivatives at every knot; the degree is 2k - 1 (k = 3, 4, 5
                for degrees 5, 7, 9; any k >= 1 is taken).

        Raises:
            ShapeError, TimeOrderError, NotFiniteError: arrays that do not fit, times that do not increase, NaN.
        """
        times, values = np.asarray(knots, dtype=float), np.asarray(conditions, dtype=float)
        if values.ndim != 3 or times.ndim != 1 or len(times) != len(values) or len(times) < 2:
            raise ShapeError("a spline takes knots (m + 1) and conditions (m + 1, k, n)", where="vector spline",
                             value=f"{times.shape} and {values.shape}")
        if not (np.all(np.isfinite(times)) and np.all(np.isfinite(values))):
            raise NotFiniteError("a knot or a condition is not finite", where="vector spline")
        lengths = np.diff(times)
        if np.any(lengths <= 0):
            raise TimeOrderError("the knots do not increase", where="vector spline",
                                 value=f"step {float(lengths.min()):g} s", limit="above 0 s")
        count = values.shape[1]
        powers = lengths[:, None, None] ** np.arange(count)[None, :, None]
        both = np.concatenate([values[:-1] * powers, values[1:] * powers], axis=1)
        return cls(times, np.einsum("ij,mjn->min", hermite_matrix(count), both))

    @property
    def degree(self) -> int:
        """Degree of the pieces."""
        return self.coefficients.shape[1] - 1

    def __call__(self, times: ArrayLike, order: int = 0) -> Array:
        """Value, or derivative of the given order, at ``times`` (any shape): shape (..., n).

        Outside the knots the first and last polynomials go on.
        """
        t = np.asarray(times, dtype=float)
        flat = t.reshape(-1)
        piece = np.clip(np.searchsorted(self.knots, flat, side="right") - 1, 0, len(self.knots) - 2)
        length = self.knots[piece + 1] - self.knots[piece]
        tau = (flat - self.knots[piece]) / length
        c = self.coefficients[piece]
        degree = self.degree
        result = np.zeros((len(flat), c.shape[2]))
        for power in range(degree, order - 1, -1):
            factor = math.factorial(power) / math.factorial(power - order)
            result = result * tau[:, None] + factor * c[:, power, :]
        result = result / length[:, None] ** order
        return result.reshape((*t.shape, c.shape[2]))

    def derivatives(self, times: ArrayLike, count: int = 4) -> tuple[Array, ...]:
        """Value and derivatives up to order ``count - 1`` at ``times``, each (..., n)."""
        return tuple(self(times, order) for order in range(count))
