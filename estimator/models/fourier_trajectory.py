"""Trajectory as a Fourier extension: cosines and sines of twice the arc's period, fitted on the arc only.

On an arc of length T, centred at ``middle``, a coordinate is

    x(t) = c_0 + sum_{d=1..D} c_d cos(pi d (t - middle) / T) + c_{D+d} sin(pi d (t - middle) / T),

equation (20) of Likhansky and Alekseev in real form. An orbit is not periodic on the arc, and the half-frequency
basis is what lets the series converge without Gibbs' phenomenon. Three printed statements do not hold:

* the functions are said to be orthonormal, and (22), (23) project on them; they are a *frame* with bound 2 (a Fourier
  extension: inner products sin(pi n/2)/(pi n/2) for even and odd alike), so the printed projection gives twice the
  trajectory in the middle of the arc and once at its ends. The coefficients need a truncated least-squares fit
  (:mod:`estimator.linear_block`);
* (24) has the wrong sign: the derivative of Re(c exp(j k d t)) is -k d Im(c exp(j k d t)). :meth:`FourierFrame.basis`
  with ``derivative=1`` is the right one;
* (25), and (21) with it, count 2D+1 parameters of equal weight. The numerical rank of the frame is about
  D + 20..40, and the variance of the velocity is that of ``derivative basis x covariance of the coefficients``
  without a further factor (2D+1): :meth:`estimator.linear_block.LinearBlock.standard_deviation`.

The singular value decomposition of the frame on its arc is known: its right singular vectors are discrete prolate
spheroidal sequences of half bandwidth 1/4 (Slepian 1978), eigenvectors of a tridiagonal matrix with a zero diagonal.
:func:`concentrated_directions` has them; about half of the singular values are zero to rounding.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TypeVar

import casadi as ca
import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy.linalg import eigh_tridiagonal

from estimator.models._polynomial_cells import evaluate_in_cells
from estimator.models.errors import RequestError, ShapeError

_DENSE_ENTRIES = 3_000_000  # entries of a basis matrix that may be formed at once
_FINE_TABLE = 32  # multiples of the phase whose sines are computed; the others are products


Symbolic = TypeVar("Symbolic", ca.SX, ca.MX)


@dataclass(frozen=True)
class FourierFrame:
    """Cosines and sines of frequency pi d / (stop - start), d = 0..degree, on the arc from ``start`` to ``stop``.

    Args:
        start: first time of the arc, s.
        stop: last time of the arc, s.
        degree: D, the number of frequencies above zero.

    Columns: 1, cos 1..D, sin 1..D; phases count from the middle of the arc.
    Raises RequestError for an arc without length and for a negative degree.
    """

    start: float
    stop: float
    degree: int

    def __post_init__(self) -> None:
        if not (np.isfinite(self.start) and np.isfinite(self.stop) and self.stop > self.start):
            raise RequestError("the arc of a Fourier frame has no length", where="FourierFrame",
                               value=f"{self.start} s to {self.stop} s", remedy="give start < stop, both finite")
        if int(self.degree) != self.degree or self.degree < 0:
            raise RequestError("the degree of a Fourier frame is a whole number", where="FourierFrame.degree",
                               value=self.degree, limit=">= 0")
        object.__setattr__(self, "degree", int(self.degree))

    @property
    def size(self) -> int:
        """Number of columns, 2 degree + 1."""
        return 2 * self.degree + 1

    @property
    def span(self) -> float:
        """Length of the arc, s."""
        return self.stop - self.start

    @property
    def middle(self) -> float:
        """Time at which all sines are zero, s."""
        return self.start + 0.5 * self.span

    @property
    def frequencies(self) -> np.ndarray:
        """Angular frequencies of degrees 0..D, rad/s."""
        return np.pi / self.span * np.arange(self.degree + 1)

    def basis(self, time: np.ndarray, derivative: int = 0) -> np.ndarray:
        """All columns, or their derivatives of any order, at the given times.

        Args:
            time: (n,) s; times outside the arc extrapolate.
            derivative: order of the time derivative.

        Returns:
            (n, size), unit s^-derivative.
        """
        time = np.atleast_1d(np.asarray(time, dtype=float))
        if time.ndim != 1:
            raise ShapeError("times are a vector", where="FourierFrame.basis", value=time.shape, limit="(n,)")
        columns = np.empty((time.size, self.size))
        self._cosines_and_sines(time, derivative, columns[:, : self.degree + 1], columns[:, self.degree + 1 :])
        return columns

    def _cosines_and_sines(self, time: np.ndarray, derivative: int, even: np.ndarray, odd: np.ndarray) -> None:
        """Fill ``even`` (n, D+1) with the columns that start as cosines and ``odd`` (n, D) with the sines."""
        order = _whole_order(derivative)
        frequency = self.frequencies
        gain = frequency**order
        cosine, sine = self._harmonics(time)
        # cos, -sin, -cos, sin and sin, cos, -sin, -cos: the derivative turns the phase by a quarter each time.
        even[:] = cosine if order % 2 == 0 else sine
        odd[:] = (sine if order % 2 == 0 else cosine)[:, 1:]
        if order:
            even *= gain * (-1.0 if order % 4 in (1, 2) else 1.0)
            odd *= gain[1:] * (-1.0 if order % 4 in (2, 3) else 1.0)

    def _harmonics(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cosines and sines (n, D+1) of all multiples of the phase: products of a coarse and a fine table of them."""
        phase = np.pi / self.span * (time - self.middle)
        if self.degree < 2 * _FINE_TABLE:
            angle = np.multiply.outer(phase, np.arange(self.degree + 1))
            return np.cos(angle), np.sin(angle)
        fine = np.exp(1j * np.multiply.outer(phase, np.arange(_FINE_TABLE)))
        coarse = np.exp(1j * np.multiply.outer(phase, np.arange(0, self.degree + 1, _FINE_TABLE)))
        table = (coarse[:, :, None] * fine[:, None, :]).reshape(time.size, -1)[:, : self.degree + 1]
        return table.real, table.imag

    def basis_symbolic(self, time: Symbolic, derivative: int = 0) -> Symbolic:
        """The columns at one symbolic time: (size, 1), equal to a row of :meth:`basis`.

        Args:
            time: scalar CasADi expression, s.
            derivative: order of the time derivative.
        """
        order = _whole_order(derivative)
        frequency = ca.DM(self.frequencies)
        turned = frequency * (time - self.middle) + 0.5 * np.pi * order
        gain = frequency**order if order else ca.DM.ones(self.degree + 1)
        return ca.vertcat(gain * ca.cos(turned), gain[1:] * ca.sin(turned[1:]))

    def evaluate(self, coefficients: np.ndarray, time: np.ndarray, derivative: int = 0) -> np.ndarray:
        """The series, or its derivative, at many times, without the n x size matrix where that would be large.

        Args:
            coefficients: (size, d).
            time: (n,) s, in any order.
            derivative: order of the time derivative.

        Returns:
            (n, d), unit of the coefficients times s^-derivative. For large n the series is first turned into
            polynomials on short cells, exact to rounding of the largest coefficient.
        """
        time = np.atleast_1d(np.asarray(time, dtype=float))
        coefficients = np.asarray(coefficients, dtype=float)
        if time.size * self.size <= _DENSE_ENTRIES:
            return self.basis(time, derivative) @ coefficients
        return evaluate_in_cells(self, coefficients, time, derivative)

    def concentrated_basis(self, time: np.ndarray, directions: Directions, derivative: int = 0) -> np.ndarray:
        """The frame in the orthonormal functions of :func:`concentrated_directions`: (n, directions.rank)."""
        time = np.asarray(time, dtype=float)
        result = np.empty((time.size, directions.rank))
        columns = directions.even.shape[1]
        step = max(1, _DENSE_ENTRIES // self.size)
        for first in range(0, time.size, step):
            part = slice(first, first + step)
            chunk = time[part]
            even, odd = np.empty((chunk.size, self.degree + 1)), np.empty((chunk.size, self.degree))
            self._cosines_and_sines(chunk, derivative, even, odd)
            np.matmul(even, directions.even, out=result[part, :columns])
            np.matmul(odd, directions.odd, out=result[part, columns:])
        return result


def _whole_order(derivative: int) -> int:
    if int(derivative) != derivative or derivative < 0:
        raise RequestError("the order of a derivative is a whole number", where="FourierFrame", value=derivative,
                           limit=">= 0")
    return int(derivative)


@dataclass(frozen=True)
class Directions:
    """Coefficient vectors whose functions are orthonormal on the arc (mean square 1), best concentrated first.

    Attributes:
        even: (D+1, e) coefficients of 1, cos 1..D of the even functions.
        odd: (D, o) coefficients of sin 1..D of the odd functions.
        singular: (e + o,) root mean square on the arc of the function of a unit coefficient vector, at most sqrt 2:
            the singular values of the frame.
    """

    even: np.ndarray
    odd: np.ndarray
    singular: np.ndarray

    @property
    def rank(self) -> int:
        """Number of directions."""
        return self.even.shape[1] + self.odd.shape[1]

    def coefficients(self, amounts: np.ndarray) -> np.ndarray:
        """Frame coefficients (2D+1, q) of a combination ``amounts`` (rank, q) of the directions."""
        split = self.even.shape[1]
        return np.concatenate([self.even @ amounts[:split], self.odd @ amounts[split:]])

    def above(self, tolerance: float) -> Directions:
        """The directions whose singular value is above ``tolerance`` times the largest."""
        keep = self.singular > tolerance * self.singular.max()
        split = self.even.shape[1]
        return Directions(self.even[:, keep[:split]], self.odd[:, keep[split:]], self.singular[keep])


@functools.cache
def _panel_rule() -> tuple[np.ndarray, np.ndarray]:
    return leggauss(56)


@functools.lru_cache(maxsize=6)
def concentrated_directions(degree: int) -> Directions:
    """All directions of a frame of the given degree with singular values above 1e-13 of the largest.

    Source: Slepian, Bell System Technical Journal 57 (1978) 1371, for half bandwidth 1/4, where the commuting
    tridiagonal matrix has no diagonal. Even and odd sequences are found apart. The singular values below the plateau
    are measured by Gauss quadrature of the functions, since their squares drown in rounding.
    """
    d = np.arange(1, degree + 1, dtype=float)
    coupling = 0.5 * (degree + d) * (degree + 1.0 - d)
    doubled = coupling.copy()
    if degree:
        doubled[0] *= np.sqrt(2.0)
    # Number of singular values above 1e-13: half of the size plus a part that grows like a logarithm.
    wanted = degree + 1 + int(np.ceil(4.3 * np.log(2.0 * degree + 2.0) + 10.0))
    parts = []
    frame = FourierFrame(-0.5, 0.5, degree)
    # Gauss nodes in equal panels on half of the arc, each resolving the square of the highest frequency.
    panels = 1 + degree // 40
    nodes, weights = _panel_rule()
    time = (np.arange(panels)[:, None] + 0.5 * (nodes + 1.0)).ravel() * (0.5 / panels)
    quadrature = np.tile(weights / (2.0 * panels), panels)
    even, odd = np.empty((time.size, degree + 1)), np.empty((time.size, degree))
    frame._cosines_and_sines(time, 0, even, odd)
    for couplings, size, table, constant in ((doubled, degree + 1, even, True), (coupling[1:], degree, odd, False)):
        count = min(size, (wanted + 1) // 2)
        if count == 0:
            parts.append((np.zeros((size, 0)), np.zeros(0)))
            continue
        if size == 1:
            vectors = np.ones((1, 1))
        else:
            vectors = eigh_tridiagonal(np.zeros(size), couplings, lapack_driver="stevd")[1][:, : -count - 1 : -1]
        vectors = vectors * np.sqrt(2.0)
        if constant:
            vectors[0] /= np.sqrt(2.0)
        singular = np.full(count, np.sqrt(2.0))
        plunge = slice(max(0, degree // 2 - 20 - int(2.0 * np.log(degree + 1.0))), count)
        singular[plunge] = np.sqrt(quadrature @ (table @ vectors[:, plunge]) ** 2)
        keep = singular > 1e-13 * np.sqrt(2.0)  # rounding leaves nothing of smaller ones
        parts.append((vectors[:, keep] / singular[keep], singular[keep]))
    return Directions(parts[0][0], parts[1][0], np.concatenate([parts[0][1], parts[1][1]]))
