"""The linear block of the joint problem: a trajectory's Fourier coefficients, eliminated once and exactly.

The positions y enter the joint problem only through  sum_k ||W_k^(1/2) (y_k - B_k c)||^2, linear in the coefficients c.
:func:`compress` turns the sum into  const + ||zeta||^2  with  c = c_0 + T zeta, a whitened coordinate of unit
information, once; whatever else depends on the trajectory (Doppler, effects in the position) is a function of zeta.
The cost of everything after that does not depend on the number of positions.

Way: samples are compressed to polynomials on short cells (:mod:`estimator.models._polynomial_cells`), the frame is
taken in the orthonormal functions that it concentrates on the arc (``concentrated_directions``), and one QR
factorisation of the small matrix left solves the problem, with a singular value decomposition in its place where gaps
or few samples leave directions undetermined. No normal equations of the frame, whose condition
number grows by (1 + sqrt 2)^4 with every degree, are formed anywhere.

This is equations (20) to (25) of Likhansky and Alekseev as a least-squares problem. They print a projection, (22) and
(23), which is right for an orthonormal basis only; the sign of the velocity (24) and the factor 2D+1 in its variance
(25) are wrong; see :mod:`estimator.models.fourier_trajectory`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import lapack

from estimator.models._polynomial_cells import (
    MERGED_PHASE,
    Cells,
    Layout,
    compress_samples,
    gauss_rule,
    merge,
    merge_vectors,
    polynomial_size,
)
from estimator.models.errors import NotFiniteError, RequestError, ShapeError, TooFewDataError
from estimator.models.fourier_trajectory import Directions, FourierFrame, concentrated_directions

_RELATIVE_TOLERANCE = 1e-12  # of the largest singular value
_NEGLIGIBLE = 0.1  # standard deviations


@dataclass(frozen=True)
class _Solution:
    """The factorised least-squares problem of merged cells in the orthonormal functions of a frame.

    ``householder`` and ``tau`` hold the orthogonal part Q of the QR factorisation of the design; ``right`` maps zeta to
    amounts of the functions; where a decomposition in singular values was needed, ``left`` takes the first rows of
    Q^T z to zeta.
    """

    directions: Directions
    householder: np.ndarray
    tau: np.ndarray
    right: np.ndarray
    left: np.ndarray | None

    @property
    def rank(self) -> int:
        return self.right.shape[1]

    def coordinates(self, vectors: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """zeta (rank, q) of right-hand sides of the merged cells, and the sum of squares (q,) left over."""
        turned = _apply(self.householder, self.tau, np.concatenate(vectors))
        columns = min(self.householder.shape)
        top, left_over = turned[:columns], (turned[columns:] ** 2).sum(axis=0)
        if self.left is None:
            return top, left_over
        zeta = self.left @ top
        return zeta, left_over + ((top - self.left.T @ zeta) ** 2).sum(axis=0)


@dataclass(frozen=True)
class _Factor:
    """The compressed samples and the solution that axes share whose weights are equal up to a constant."""

    solution: _Solution
    levels: tuple[Cells, ...]
    layout: Layout
    weight: np.ndarray
    order: np.ndarray | None

    def project(self, samples: np.ndarray) -> np.ndarray:
        """zeta (rank, q) of samples (n, q) in the caller's order."""
        if self.order is not None:
            samples = samples[self.order]
        vectors = compress_samples(self.layout, self.weight, samples, self.levels[0].size).vectors
        for level in self.levels[1:]:
            vectors = merge_vectors(level, vectors)
        return self.solution.coordinates(vectors)[0]


def _apply(householder: np.ndarray, tau: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Q^T columns."""
    if tau.size == 0 or columns.shape[1] == 0:
        return columns.copy()
    work = lapack.dormqr("L", "T", householder, tau, columns, -1)[1]
    return lapack.dormqr("L", "T", householder, tau, columns, int(work[0]))[0]


@dataclass(frozen=True)
class LinearBlock:
    """A compressed linear least-squares problem: cost(c_0 + T zeta) = sum of squares + ||zeta||^2 on every axis.

    Attributes:
        frame: the Fourier frame.
        coefficients: (size, d) least-squares coefficients c_0; frame directions that the data do not determine have no
            part in them.
        sum_of_squares: (d,) whitened residual sum of squares at c_0.
        degrees_of_freedom: (d,) samples of positive weight minus rank.
        ranks: (d,) number of determined directions on each axis.
    """

    frame: FourierFrame
    coefficients: np.ndarray
    sum_of_squares: np.ndarray
    degrees_of_freedom: np.ndarray
    ranks: np.ndarray
    _factors: tuple[_Factor, ...] = field(repr=False)
    _factor_of_axis: tuple[int, ...] = field(repr=False)
    _scale: np.ndarray = field(repr=False)  # square root of the axis' weight over that of its factor
    _time: np.ndarray = field(repr=False)
    _values: np.ndarray = field(repr=False)
    _memory: dict = field(default_factory=dict, repr=False, compare=False)

    @property
    def rank(self) -> int:
        """The number of determined directions, the largest over the axes."""
        return int(self.ranks.max())

    def transform(self, axis: int) -> np.ndarray:
        """T (size, rank) of c = c_0 + T zeta on one axis, in metres per standard deviation."""
        index = self._factor_of_axis[axis]
        if index not in self._memory:
            solution = self._factors[index].solution
            self._memory[index] = solution.directions.coefficients(solution.right)
        return self._memory[index] / self._scale[axis]

    def values(self, time: np.ndarray, derivative: int = 0) -> np.ndarray:
        """The fit, or its derivative, at any times (m,) s: (m, d)."""
        return self.frame.evaluate(self.coefficients, time, derivative)

    def sensitivity(self, time: np.ndarray, derivative: int, axis: int) -> np.ndarray:
        """Derivative (m, rank) of the fit with respect to zeta: basis times T."""
        solution = self._factors[self._factor_of_axis[axis]].solution
        time = np.atleast_1d(np.asarray(time, dtype=float))
        key = (self._factor_of_axis[axis], derivative, time.tobytes())
        if self._memory.get("sensitivity", (None,))[0] != key:
            functions = self.frame.concentrated_basis(time, solution.directions, derivative)
            self._memory["sensitivity"] = (key, functions @ solution.right)
        return self._memory["sensitivity"][1] / self._scale[axis]

    def standard_deviation(self, time: np.ndarray, derivative: int, axis: int) -> np.ndarray:
        """Standard deviation (m,) of the fit, or its derivative, on one axis.

        Replaces (21) and (25) of Likhansky and Alekseev, which count 2D+1 parameters of equal weight; the ends of the
        arc are several times worse than its middle.
        """
        solution = self._factors[self._factor_of_axis[axis]].solution
        time = np.atleast_1d(np.asarray(time, dtype=float))
        result = np.empty(time.size)
        step = 4096
        for first in range(0, time.size, step):
            functions = self.frame.concentrated_basis(time[first : first + step], solution.directions, derivative)
            rows = functions @ solution.right
            result[first : first + step] = np.sqrt(np.einsum("mr,mr->m", rows, rows))
        return result / self._scale[axis]

    def project(self, samples: np.ndarray, axis: int) -> np.ndarray:
        """U^T W^(1/2) samples: the part (rank, q) of extra columns (n, q) that the trajectory would take up.

        Samples are in the order of the times given to :func:`compress`. The part that no trajectory explains has the
        whitened sum of squares  sum W samples^2 - ||project||^2.
        """
        samples = np.asarray(samples, dtype=float)
        if samples.ndim != 2 or samples.shape[0] != self._time.size:
            raise ShapeError("extra columns have one row a sample", where="LinearBlock.project", value=samples.shape,
                             limit=f"({self._time.size}, q)")
        return self._scale[axis] * self._factors[self._factor_of_axis[axis]].project(samples)

    def residuals(self) -> np.ndarray:
        """Measured minus fitted, not whitened, (n, d)."""
        return self._values - self.values(self._time)


def compress(frame: FourierFrame, time: np.ndarray, values: np.ndarray, weights: np.ndarray) -> LinearBlock:
    """Solve and compress  minimize over c  sum_k weights_k (values_k - basis(time_k) c)^2  on every axis.

    Args:
        frame: the Fourier frame; all times lie on its arc.
        time: (n,) s, in any order.
        values: (n, d) samples, one column an axis.
        weights: (n, d) 1/variance; zero for rejected samples.

    Frame directions are left at zero if their singular value is below 1e-12 of the largest, or if even an amount as
    large as the data themselves would stay below 0.1 standard deviations of its estimate.

    Raises:
        ShapeError, NotFiniteError: arrays that do not fit or hold NaN (samples of zero weight may hold anything).
        RequestError: a negative weight, or a time off the arc.
        TooFewDataError: an axis without any sample of positive weight.
    """
    time, values, weights = _checked(frame, time, values, weights)
    order = None if bool((np.diff(time) >= 0.0).all()) else np.argsort(time, kind="stable")
    sorted_time = time if order is None else time[order]
    sorted_values = values if order is None else values[order]
    sorted_weights = weights if order is None else weights[order]

    axes = values.shape[1]
    groups, scale = _shared_weights(sorted_weights)
    layout = Layout.of(sorted_time, float(frame.frequencies[-1]))
    size = polynomial_size(float(frame.frequencies[-1] * layout.half[0]))
    coefficients = np.empty((frame.size, axes))
    sum_of_squares = np.empty(axes)
    ranks = np.empty(axes, dtype=int)
    factors: list[_Factor] = []
    factor_of_axis = [0] * axes
    for members in groups:
        weight = np.ascontiguousarray(sorted_weights[:, members[0]])
        fine = compress_samples(layout, weight, _columns(sorted_values, members), size)
        levels = _merged(frame, fine)
        solution = _solve(frame, levels[-1], float(weight.sum()), _amplitude(weight, sorted_values[:, members]))
        zeta, left_over = solution.coordinates(levels[-1].vectors)
        for position, axis in enumerate(members):
            factor_of_axis[axis] = len(factors)
            ranks[axis] = solution.rank
            coefficients[:, axis] = solution.directions.coefficients(solution.right @ zeta[:, position])
            sum_of_squares[axis] = scale[axis] ** 2 * (levels[-1].rest[position] + left_over[position])
        factors.append(_Factor(solution, levels, layout, weight, order))
    used = np.array([np.count_nonzero(weights[:, a]) for a in range(axes)])
    return LinearBlock(frame, coefficients, sum_of_squares, used - ranks, ranks, tuple(factors), tuple(factor_of_axis),
                       scale, time, values)


def _columns(values: np.ndarray, members: list[int]) -> np.ndarray:
    return values if len(members) == values.shape[1] else np.ascontiguousarray(values[:, members])


def _amplitude(weight: np.ndarray, values: np.ndarray) -> float:
    """Largest weighted root mean square of the columns."""
    total = weight.sum()
    return max(float(np.sqrt(np.dot(weight * column, column) / total)) for column in values.T)


def _checked(frame: FourierFrame, time: np.ndarray, values: np.ndarray, weights: np.ndarray
             ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    time = np.asarray(time, dtype=float)
    values = np.asarray(values, dtype=float)
    weights = np.asarray(weights, dtype=float)
    where = "compress"
    if time.ndim != 1 or time.size == 0:
        raise ShapeError("times are a vector with at least one element", where=where, value=time.shape, limit="(n,)")
    if values.ndim != 2 or values.shape[0] != time.size:
        raise ShapeError("values have one row a time", where=where, value=values.shape, limit=f"({time.size}, d)")
    if weights.shape != values.shape:
        raise ShapeError("weights have the shape of the values", where=where, value=weights.shape, limit=values.shape)
    if not np.isfinite(time).all():
        raise NotFiniteError("a time is not finite", where=f"{where}: time[{int(np.argmin(np.isfinite(time)))}]")
    least, most = float(weights.min()), float(weights.max())
    if not (np.isfinite(least) and np.isfinite(most)):
        raise NotFiniteError("a weight is not finite", where=where, remedy="give a positive standard deviation")
    if least < 0.0:
        raise RequestError("a weight is negative", where=where, value=least, limit=0.0)
    if not (np.isfinite(values.min()) and np.isfinite(values.max())):
        finite = np.isfinite(values)
        bad = ~finite & (weights > 0.0)
        if bad.any():
            row, column = (int(i) for i in np.argwhere(bad)[0])
            raise NotFiniteError("a value of positive weight is not finite", where=f"{where}: values[{row}, {column}]",
                                 value=float(values[row, column]), remedy="give it zero weight or leave it out")
        values = np.where(finite, values, 0.0)
    slack = 1e-9 * frame.span
    if time.min() < frame.start - slack or time.max() > frame.stop + slack:
        off = float(time.min() if time.min() < frame.start - slack else time.max())
        raise RequestError("a sample lies off the arc of the frame", where=where, value=f"{off} s",
                           limit=f"{frame.start} s to {frame.stop} s")
    for axis in range(values.shape[1]):
        if least == 0.0 and weights[:, axis].max() == 0.0:
            raise TooFewDataError("an axis has no sample of positive weight", where=where, value=f"axis {axis}",
                                  remedy="all samples were rejected; loosen the rejection or check the units")
    return time, values, weights


def _shared_weights(weights: np.ndarray) -> tuple[list[list[int]], np.ndarray]:
    """Axes grouped by weights equal up to a factor, and the square root of the factor to the first of each group."""
    groups: list[list[int]] = []
    scale = np.ones(weights.shape[1])
    for axis in range(weights.shape[1]):
        column = weights[:, axis]
        for group in groups:
            first = weights[:, group[0]]
            ratio = column.sum() / first.sum()
            if np.abs(column - ratio * first).max() <= 1e-12 * column.max():
                scale[axis] = np.sqrt(ratio)
                group.append(axis)
                break
        else:
            groups.append([axis])
    return groups, scale


def _merged(frame: FourierFrame, fine: Cells) -> tuple[Cells, ...]:
    """Fine cells, and the long cells made of them, where this saves rows."""
    frequency = float(frame.frequencies[-1])
    phase = frequency * float(fine.half[0])
    factor = int(MERGED_PHASE // phase) if phase > 0.0 else 1
    factor = min(factor, 1 + int(np.rint((fine.middle[-1] - fine.middle[0]) / (2.0 * fine.half[0]))))
    if factor < 2:
        return (fine,)
    return fine, merge(fine, factor, polynomial_size(factor * phase))


def _solve(frame: FourierFrame, cells: Cells, total_weight: float, amplitude: float) -> _Solution:
    """Factorise the design of merged cells; see :func:`compress` for the directions that are left at zero."""
    # An amount of the size of the data in a direction weaker than this stays below a tenth of a standard deviation.
    weakest = _NEGLIGIBLE / amplitude if amplitude > 0.0 else 0.0
    directions = concentrated_directions(frame.degree)
    directions = directions.above(max(_RELATIVE_TOLERANCE,
                                      weakest / (np.sqrt(total_weight) * float(directions.singular.max()))))
    design = _design(frame, cells, directions)
    householder, tau, _, _ = lapack.dgeqrf(design, lwork=64 * design.shape[1], overwrite_a=1)
    rows, columns = householder.shape
    triangle = np.triu(householder[: min(rows, columns)])
    if rows >= columns:
        reciprocal, _ = lapack.dtrcon(triangle)
        largest = float(np.abs(triangle).sum(axis=0).max())
        if reciprocal * largest > 10.0 * max(weakest, _RELATIVE_TOLERANCE * largest):
            return _Solution(directions, householder, tau, lapack.dtrtri(triangle)[0], None)
    u, singular, vt = np.linalg.svd(triangle, full_matrices=False)
    keep = singular > max(weakest, _RELATIVE_TOLERANCE * float(singular.max(initial=0.0)))
    return _Solution(directions, householder, tau, vt[keep].T / singular[keep], np.ascontiguousarray(u[:, keep].T))


def _design(frame: FourierFrame, cells: Cells, directions: Directions) -> np.ndarray:
    """Triangles of the cells times the orthonormal functions in Legendre coefficients: (rows, directions)."""
    nodes, to_coefficients = gauss_rule(cells.size)
    at = cells.middle[:, None] + cells.half[:, None] * nodes
    functions = frame.concentrated_basis(at.ravel(), directions).reshape(*at.shape, directions.rank)
    rows = [t.shape[0] for t in cells.triangles]
    design = np.empty((sum(rows), directions.rank), order="F")
    first = 0
    for cell, triangle in enumerate(cells.triangles):
        design[first : first + rows[cell]] = (triangle @ to_coefficients) @ functions[cell]
        first += rows[cell]
    return design
