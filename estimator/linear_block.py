"""The linear block of the joint problem: a trajectory's Fourier coefficients, eliminated once and exactly.

The positions y enter the joint problem only through  sum_k ||W_k^(1/2) (y_k - B_k c)||^2, linear in the coefficients c.
:func:`compress` turns the sum into  const + ||zeta||^2  with  c = c_0 + T zeta, a whitened coordinate of unit
information, once; whatever else depends on the trajectory (Doppler, effects in the position) is a function of zeta.
The cost of everything after that does not depend on the number of positions.

Way: samples are compressed to polynomials on short cells (:mod:`estimator.models._polynomial_cells`), the frame is
taken in the orthonormal functions that it concentrates on the arc (``concentrated_directions``), and one factorisation
of the small matrix left solves the problem: Cholesky's with a refinement where samples fill the arc and the matrix is
nearly orthogonal, Householder's elsewhere, with a singular value decomposition where gaps or few samples leave
directions undetermined. No normal equations of the frame, whose condition
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
    CELL_PHASE,
    MERGED_PHASE,
    Cells,
    Layout,
    compress_samples,
    gauss_rule,
    merge,
    merge_vectors,
    polynomial_size,
    project_on,
    safe_triangle,
)
from estimator.models.errors import NotFiniteError, RequestError, ShapeError, TooFewDataError
from estimator.models.fourier_trajectory import Directions, FourierFrame, concentrated_directions

_RELATIVE_TOLERANCE = 1e-12  # of the largest singular value
_SMALL_DEGREE = 100  # below which merging cells costs what it saves
_NEGLIGIBLE = 0.1  # standard deviations
# Length of the frame over that of the data, and largest degree: for arcs of few oscillations.
_STRETCHED = ((16.0, 6), (4.0, 12))
_FINEST_DEGREE = 1024  # that the first compression of the data for the choice of a degree can tell
_LARGEST_DEGREE = 2048  # tried without being asked for
_SMALLEST_SCALE = 0.01  # of the declared standard deviation, so that data without noise do not ask for every degree


@dataclass(frozen=True)
class _Solution:
    """The factorised least-squares problem of merged cells in the orthonormal functions of a frame.

    ``right`` maps zeta to amounts of the functions. Where the samples fill the arc, their design in these functions is
    nearly orthogonal and ``triangle`` is its Cholesky factor. Elsewhere ``design`` and ``tau`` hold Householder's
    orthogonal part Q, and where a decomposition in singular values was needed too, ``left`` takes the first rows
    of Q^T z to zeta.
    """

    directions: Directions
    design: np.ndarray
    right: np.ndarray
    triangle: np.ndarray | None = None
    tau: np.ndarray | None = None
    left: np.ndarray | None = None

    @property
    def rank(self) -> int:
        return self.right.shape[1]

    def coordinates(self, vectors: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """zeta (rank, q) of right-hand sides of the merged cells, and the sum of squares (q,) left over."""
        stacked = np.concatenate(vectors)
        if self.triangle is not None:
            return project_on(self.triangle, self.design.T, stacked)
        assert self.tau is not None
        turned = _apply(self.design, self.tau, stacked)
        columns = self.tau.size
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
    if factor < 2 or frame.degree < _SMALL_DEGREE:
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
    rows, columns = design.shape
    if rows >= columns:
        # Orthonormal functions on well-spread samples: the normal matrix is nearly diagonal, which is checked.
        easy = safe_triangle(design.T @ design)
        if easy is not None and float(np.abs(np.diag(easy)).min()) > 1e4 * weakest:
            return _Solution(directions, design, lapack.dtrtri(easy)[0], triangle=easy)
    householder, tau, _, _ = lapack.dgeqrf(design, lwork=64 * columns, overwrite_a=1)
    triangle = np.triu(householder[: min(rows, columns)])
    if rows >= columns:
        reciprocal, _ = lapack.dtrcon(triangle)
        largest = float(np.abs(triangle).sum(axis=0).max())
        if reciprocal > 1e-5 and reciprocal * largest > 10.0 * weakest:
            return _Solution(directions, householder, lapack.dtrtri(triangle)[0], tau=tau)
    # Weak directions are told by the size of their coefficients, not of their functions, which may live in the gaps:
    # this is the decomposition of the frame itself on these samples.
    u, singular, vt = np.linalg.svd(triangle * directions.singular, full_matrices=False)
    keep = singular > max(weakest, _RELATIVE_TOLERANCE * float(singular.max(initial=0.0)))
    right = directions.singular[:, None] * (vt[keep].T / singular[keep])
    return _Solution(directions, np.asfortranarray(householder[:, : tau.size]), right, tau=tau,
                     left=np.ascontiguousarray(u[:, keep].T))


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


@dataclass(frozen=True)
class DegreeTrial:
    """One frame tried by :func:`choose_degree`.

    Attributes:
        frame: the frame.
        parameters: determined directions over all axes, the effective number of parameters.
        sum_of_squares: whitened residual sum of squares over all axes.
        criterion: sum_of_squares / noise_scale^2 + 2 parameters, to be least.
    """

    frame: FourierFrame
    parameters: int
    sum_of_squares: float
    criterion: float


@dataclass(frozen=True)
class DegreeChoice:
    """The frame that :func:`choose_degree` takes, and why.

    Attributes:
        frame: the frame; longer than the data where these cover few oscillations.
        noise_scale: standard deviation of the noise found in the data over the declared one.
        explained: whether the residual of the frame is at the noise floor.
        trials: the frames tried, by number of parameters.
        why: the reason in one sentence.
    """

    frame: FourierFrame
    noise_scale: float
    explained: bool
    trials: tuple[DegreeTrial, ...]
    why: str


@dataclass(frozen=True)
class _Pyramid:
    """Data of axes with common weights, compressed to cells of doubling length: one compression for all degrees."""

    levels: tuple[Cells, ...]
    total_weight: float
    amplitude: float
    scale: np.ndarray

    def trial(self, frame: FourierFrame) -> tuple[int, float]:
        """Number of parameters and whitened residual sum of squares of a fit with this frame, over the axes."""
        frequency = float(frame.frequencies[-1])
        cells = next(c for c in reversed(self.levels) if frequency * c.half[0] <= 1.0001 * MERGED_PHASE
                     or c is self.levels[0])
        solution = _solve(frame, cells, self.total_weight, self.amplitude)
        left_over = solution.coordinates(cells.vectors)[1]
        return solution.rank * self.scale.size, float(self.scale**2 @ (cells.rest + left_over))


def choose_degree(time: np.ndarray, values: np.ndarray, standard_deviation: np.ndarray | float, *,
                  start: float | None = None, stop: float | None = None,
                  largest: int | None = None) -> DegreeChoice:
    """The Fourier frame that predicts best: the least unbiased estimate of the squared error of the fit.

    Args:
        time: (n,) s, in any order.
        values: (n, d) samples.
        standard_deviation: of the samples, a number, (d,) or (n, d); infinite for rejected samples.
        start, stop: the arc to be covered, s; by default that of the data.
        largest: no degree above this one is tried; by default 2048.

    The criterion is Mallows' C_p, residual sum of squares over noise variance plus twice the number of parameters, and
    that number is the rank of the fit, not 2D+1. The noise is what the data show above all trajectory
    frequencies: the residual of the polynomials to which the samples are compressed. Where there are too few samples
    for that, the declared noise counts, or the least residual variance found if that is larger. Degrees double
    until the residual is at the noise floor, then halve their steps around the least criterion. Among equals (within 2
    units) the least number of parameters wins.

    The spectrum of a trajectory ends abruptly. Where the residual falls on and on by a little more than its
    parameters cost, something other than a trajectory is in the data (multipath, a moving antenna), and a frame that
    follows it would hide it. So no frame is taken that has over 1.35 times the parameters of the one with the least
    Schwarz criterion, in which a parameter costs log(number of samples) instead of 2; ``explained`` may then be false.

    Arcs of few oscillations are fitted on a frame 4 or 16 times as long as they are: its low frequencies follow them
    with fewer parameters (in the limit they are polynomials), and the number of parameters can be set finely.

    Raises:
        as :func:`compress`; TooFewDataError for fewer than 4 usable samples on an axis.
    """
    time = np.asarray(time, dtype=float)
    values = np.asarray(values, dtype=float)
    deviation = np.asarray(standard_deviation, dtype=float)
    least = float(deviation.min()) if deviation.size else 1.0
    if not least > 0.0:
        raise RequestError("a standard deviation is not positive", where="choose_degree",
                           value=least, limit="> 0")
    if values.ndim != 2 or (deviation.ndim and deviation.shape not in (values.shape, values.shape[1:])):
        raise ShapeError("a standard deviation is a number, one an axis, or one a value", where="choose_degree",
                         value=deviation.shape, limit=f"() or {values.shape[1:]} or {values.shape}")
    weights = np.array(np.broadcast_to(1.0 / deviation**2, values.shape))
    if time.size == 0:
        raise TooFewDataError("there are no samples", where="choose_degree", value=0, limit=4)
    first = float(np.min(time)) if start is None else float(start)
    last = float(np.max(time)) if stop is None else float(stop)
    if not last > first:
        raise TooFewDataError("all samples are at one time", where="choose_degree", value=f"{first} s",
                              remedy="give samples over an arc")
    time, values, weights = _checked(FourierFrame(first, last, 0), time, values, weights)
    if weights.min() == 0.0:
        usable = weights.max(axis=1) > 0.0
        time, values, weights = time[usable], values[usable], weights[usable]
    fewest = min(int(np.count_nonzero(weights[:, a])) for a in range(values.shape[1]))
    if fewest < 4:
        raise TooFewDataError("too few samples for a trajectory", where="choose_degree", value=fewest, limit=4)
    if not (np.diff(time) >= 0.0).all():
        order = np.argsort(time, kind="stable")
        time, values, weights = time[order], values[order], weights[order]
    search = _Search(first, last, time, values, weights, fewest, largest)
    return search.run()


class _Search:
    """The search of :func:`choose_degree`: trials by degree, on data compressed once (or again, four times finer)."""

    def __init__(self, start: float, stop: float, time: np.ndarray, values: np.ndarray, weights: np.ndarray,
                 fewest: int, largest: int | None):
        self.start, self.stop, self.time, self.values, self.weights = start, stop, time, values, weights
        self.samples = sum(int(np.count_nonzero(weights[:, a])) for a in range(values.shape[1]))
        self.axes = values.shape[1]
        # Leave three tenths of few samples, half of many, as degrees of freedom.
        self.most_parameters = self.axes * max(3, min(int(0.7 * fewest), int(0.5 * fewest) + 20))
        self.largest = largest
        self.strict = max(2.0, float(np.log(self.samples)))  # price of a parameter in Schwarz' criterion
        self.trials: dict[tuple[float, int], tuple[FourierFrame, int, float]] = {}

    def compress(self, finest: int) -> None:
        """Compress the data so that frames up to degree ``finest`` can be tried, and take the noise from it."""
        self.finest = finest
        layout = Layout.of(self.time, np.pi * finest / (self.stop - self.start))
        groups, scale = _shared_weights(self.weights)
        self.pyramids = []
        rest, lost, rows = 0.0, 0, 0
        for members in groups:
            weight = np.ascontiguousarray(self.weights[:, members[0]])
            fine = compress_samples(layout, weight, _columns(self.values, members), polynomial_size(CELL_PHASE))
            levels = [fine]
            if len(fine.triangles) > 1:
                levels.append(merge(fine, int(MERGED_PHASE / CELL_PHASE), polynomial_size(MERGED_PHASE)))
            while len(levels[-1].triangles) > 1:
                levels.append(merge(levels[-1], 2, polynomial_size(MERGED_PHASE)))
            self.pyramids.append(_Pyramid(tuple(levels), float(weight.sum()),
                                          _amplitude(weight, self.values[:, members]), scale[members]))
            rest += float(scale[members] ** 2 @ fine.rest)
            lost += fine.rows_lost * len(members)
            rows += sum(t.shape[0] for t in fine.triangles) * len(members)
        lost -= self.values.size - self.samples
        self.floor, self.floor_rows = rest, rows
        self.scale = max(np.sqrt(rest / lost), _SMALLEST_SCALE) if lost >= 60 else None

    def frame(self, stretch: float, degree: int) -> FourierFrame:
        margin = 0.5 * (stretch - 1.0) * (self.stop - self.start)
        return FourierFrame(self.start - margin, self.stop + margin, degree)

    def attempt(self, stretch: float, degree: int) -> tuple[FourierFrame, int, float]:
        key = (stretch, degree)
        if key not in self.trials:
            frame = self.frame(stretch, degree)
            parts = [p.trial(frame) for p in self.pyramids]
            self.trials[key] = frame, sum(p[0] for p in parts), sum(p[1] for p in parts)
        return self.trials[key]

    def criterion(self, trial: tuple[FourierFrame, int, float], scale: float, price: float = 2.0) -> float:
        _, parameters, squares = trial
        if parameters > self.most_parameters:
            return np.inf
        return squares / scale**2 + price * parameters

    def excess(self, trial: tuple[FourierFrame, int, float], scale: float) -> tuple[float, float]:
        """What the residual holds beyond noise, in noise variances, and the standard deviation of that number."""
        _, parameters, squares = trial
        free = max(self.floor_rows - parameters, 1)
        return (squares - self.floor) / scale**2 - free, float(np.sqrt(2.0 * free))

    def run(self) -> DegreeChoice:
        upper = _LARGEST_DEGREE if self.largest is None else self.largest
        # Cells of 80 samples keep two thirds of them as a measure of the noise.
        room = max(8, self.most_parameters // self.axes)
        self.compress(min(_FINEST_DEGREE, room, max(8, int(2.0 / np.pi * CELL_PHASE * self.time.size / 80.0))))
        degree = min(8, upper)
        ratings = []
        while True:
            trial = self.attempt(1.0, degree)
            ratings.append(self.criterion(trial, self.scale or 1.0, self.strict))
            if len(ratings) > 2 and ratings[-3] < min(ratings[-2:]):
                break
            # More parameters pay only if what is left to explain is more than they cost.
            excess, spread = self.excess(trial, self.scale or 1.0)
            if excess + 2.0 * spread < self.axes * (degree + 20):
                break
            if trial[1] > self.most_parameters or degree >= upper:
                break
            degree = min(2 * degree, upper)
            if degree > self.finest:
                if self.finest >= room:
                    break
                self.trials.clear()
                self.compress(min(4 * self.finest, room))
        if degree <= 32:
            for stretch, most in _STRETCHED:
                for small in range(1, min(most, upper) + 1):
                    self.attempt(stretch, small)
        for _ in range(3):
            self.refine(self.noise())
        return self.choice(self.noise())

    def refine(self, scale: float) -> None:
        """Try the degrees half way (as ratios) between the best one so far and its neighbours."""
        known = sorted(d for s, d in self.trials if s == 1.0)
        best = min(known, key=lambda d: self.criterion(self.trials[1.0, d], scale, self.strict))
        i = known.index(best)
        sides = known[max(i - 1, 0) : i]
        if i + 1 < len(known):
            # Above, only if the step explained more than the noise that its parameters take up by chance.
            here, there = self.trials[1.0, best], self.trials[1.0, known[i + 1]]
            more = there[1] - here[1]
            if (here[2] - there[2]) / scale**2 > more + 3.0 * np.sqrt(2.0 * max(more, 0)):
                sides.append(known[i + 1])
        for neighbour in sides:
            middle = int(np.rint(np.sqrt(best * neighbour)))
            if middle not in known:
                self.attempt(1.0, middle)

    def noise(self) -> float:
        """Noise over declared noise: from the compression, or bounded below by the best of the trials."""
        if self.scale is not None:
            return self.scale
        variances = [squares / (self.samples - parameters) for _, parameters, squares in self.trials.values()
                     if parameters <= self.most_parameters and parameters < self.samples]
        return float(np.sqrt(max(1.0, min(variances, default=1.0))))

    def choice(self, scale: float) -> DegreeChoice:
        rated = sorted((DegreeTrial(*trial, self.criterion(trial, scale)) for trial in self.trials.values()),
                       key=lambda t: (t.parameters, t.criterion))
        knee = min(self.trials.values(), key=lambda trial: self.criterion(trial, scale, self.strict))[1]
        near = [t for t in rated if t.parameters <= max(1.35 * knee, knee + 4 * self.axes)]
        least = min(t.criterion for t in near)
        # Where no frame has few enough parameters (least is infinite), this is the smallest one.
        best = next(t for t in near if t.criterion <= least + 2.0)
        excess, spread = self.excess((best.frame, best.parameters, best.sum_of_squares), scale)
        freedom = self.samples - best.parameters
        explained = excess < 4.0 * spread
        why = (f"degree {best.frame.degree} with {best.parameters} effective parameters has the least estimated error "
               f"of {len(rated)} frames; residual variance is {best.sum_of_squares / max(freedom, 1):.3g} of the "
               f"declared one, noise {scale**2:.3g}")
        if not explained:
            why += "; the residual is still above the noise, higher degrees were not possible or did not pay"
        return DegreeChoice(best.frame, scale, bool(explained), tuple(rated), why)
