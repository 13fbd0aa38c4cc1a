"""Exact compression of samples of smooth functions to polynomials on short cells, kept as square roots.

On a cell of half length h the fastest function of a Fourier frame has phase range kappa = pi D h / T, and Legendre
polynomials of degree a little above kappa carry it to rounding. A weighted least-squares problem in all samples of
a cell is then the same problem in a triangle of that many rows; cells are merged, triangle by triangle, into longer
ones. Nothing here squares a condition number that matters: where a cell's normal matrix is used, it is one of Legendre
polynomials on samples that fill the cell, whose condition is checked, and Householder's method takes over elsewhere.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy.linalg import lapack
from scipy.special import spherical_jn

if TYPE_CHECKING:
    from estimator.models.fourier_trajectory import FourierFrame

CELL_PHASE = 4.0  # rad, phase range of the finest cells
MERGED_PHASE = 32.0  # rad, phase range of cells after merging: long cells waste fewer rows, short ones less work


@functools.lru_cache(maxsize=256)
def polynomial_size(phase: float) -> int:
    """Number of Legendre polynomials that carry exp(j phase u), |u| <= 1, to 1e-16."""
    upper = int(phase + 6.0 * (phase + 1.0) ** (1.0 / 3.0)) + 40
    degree = np.arange(upper)
    size = np.abs(spherical_jn(degree, phase)) * np.sqrt(2.0 * degree + 1.0)
    return int(np.flatnonzero(size > 1e-16)[-1]) + 2


def legendre(u: np.ndarray, count: int) -> np.ndarray:
    """Legendre polynomials of degree 0..count-1 with mean square 1 on (-1, 1): (count, n)."""
    table = np.empty((count, u.size))
    table[0] = 1.0
    if count > 1:
        table[1] = u
    scratch = np.empty_like(u)
    for n in range(1, count - 1):
        np.multiply(u, table[n], out=scratch)
        scratch *= (2 * n + 1) / (n + 1)
        np.multiply(table[n - 1], -n / (n + 1), out=table[n + 1])
        table[n + 1] += scratch
    table *= np.sqrt(2.0 * np.arange(count) + 1.0)[:, None]
    return table


@functools.lru_cache(maxsize=64)
def gauss_rule(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss nodes u (count,) and the matrix (count, count) from values there to Legendre coefficients."""
    nodes, weights = leggauss(count)
    return nodes, legendre(nodes, count) * (0.5 * weights)


@dataclass
class Cells:
    """A least-squares problem in Legendre coefficients, cell by cell: minimise sum ||triangle a - vector||^2 + rest.

    Attributes:
        middle: (m,) middle of each cell, s.
        half: (m,) half length of each cell, s.
        size: number of polynomials in a cell.
        triangles: per cell (rows, size), triangular where the cell had more samples than polynomials.
        vectors: per cell (rows, q) right-hand sides.
        rest: (q,) sum of squares that no polynomial explains.
        rows_lost: number of samples minus number of rows kept: the degrees of freedom of ``rest``.
        turns: per cell the orthonormal columns that merging applied (rows of the finer cells, rows), or None.
        groups: per cell the finer cells it was merged from.
    """

    middle: np.ndarray
    half: np.ndarray
    size: int
    triangles: list[np.ndarray]
    vectors: list[np.ndarray]
    rest: np.ndarray
    rows_lost: int
    turns: list[np.ndarray | None]
    groups: list[slice]


@dataclass(frozen=True)
class Layout:
    """How samples fall into cells: sorted times and, per cell, its middle, half length and samples."""

    time: np.ndarray
    middle: np.ndarray
    half: np.ndarray
    samples: list[slice]
    regular: int  # samples of each full cell of a regular grid, 0 where the sampling is irregular

    @staticmethod
    def of(time: np.ndarray, phase_per_second: float, phase: float = CELL_PHASE) -> Layout:
        """Cut sorted times into equal cells of at most ``phase`` rad of the fastest function.

        Args:
            time: (n,) s, ascending.
            phase_per_second: angular frequency of the fastest function, rad/s.
            phase: half of the phase that it runs through in a cell, rad.
        """
        n = time.size
        first, last = float(time[0]), float(time[-1])
        longest = 2.0 * phase / phase_per_second if phase_per_second > 0.0 else np.inf
        step = (last - first) / (n - 1) if n > 1 else 0.0
        if n > 2 and step > 0.0:
            allowed = max(8.0 * np.finfo(float).eps * max(abs(first), abs(last)), 1e-9 * step)
            per_cell = n if longest >= n * step else int(longest / step)
            if per_cell >= 64 and _is_grid(time, first, step, allowed):
                count = -(-n // per_cell)
                per_cell = -(-n // count)
                starts = np.arange(count) * per_cell
                middle = first + (starts + 0.5 * (per_cell - 1)) * step
                samples = [slice(int(s), min(int(s) + per_cell, n)) for s in starts]
                return Layout(time, middle, np.full(count, 0.5 * per_cell * step), samples, per_cell)
        span = last - first
        count = max(1, int(np.ceil(span / longest))) if np.isfinite(longest) else 1
        half = 0.5 * span / count if span > 0.0 else 1.0
        edges = first + 2.0 * half * np.arange(1, count)
        bounds = np.concatenate([[0], np.searchsorted(time, edges), [n]])
        filled = np.flatnonzero(np.diff(bounds) > 0)
        return Layout(time, first + half * (2.0 * filled + 1.0), np.full(filled.size, half),
                      [slice(int(bounds[i]), int(bounds[i + 1])) for i in filled], 0)

    def local(self, cell: int) -> np.ndarray:
        """Times of one cell's samples as numbers between -1 and 1."""
        if self.regular:
            part = self.samples[cell]
            return (2.0 * np.arange(part.stop - part.start) + 1.0 - self.regular) / self.regular
        return (self.time[self.samples[cell]] - self.middle[cell]) / self.half[cell]


def _is_grid(time: np.ndarray, first: float, step: float, allowed: float) -> bool:
    for start in range(0, time.size, 65536):
        part = time[start : start + 65536]
        if np.abs(part - (first + step * np.arange(start, start + part.size))).max() > allowed:
            return False
    return True


@functools.lru_cache(maxsize=64)
def _joint(size: int, factor: int, offset: int, longer: int) -> np.ndarray:
    """Legendre coefficients on one of ``factor`` equal cells of the polynomials of the cell they make up."""
    nodes, to_coefficients = gauss_rule(size)
    return to_coefficients @ legendre((nodes + 2.0 * offset + 1.0 - factor) / factor, longer).T


def compress_samples(layout: Layout, weight: np.ndarray, values: np.ndarray, size: int) -> Cells:
    """Compress weighted samples to one triangle a cell.

    Args:
        layout: times and cells.
        weight: (n,) weights, 1/variance.
        values: (n, q) samples in the order of the layout's times.
        size: number of polynomials.
    """
    triangles, vectors = [], []
    rest = np.zeros(values.shape[1])
    lost = 0
    grid_table: np.ndarray | None = None
    grid_triangle: np.ndarray | None = None
    for cell, part in enumerate(layout.samples):
        count = part.stop - part.start
        w, y = weight[part], values[part]
        full = layout.regular == count
        if full and grid_table is not None:
            table = grid_table
        else:
            table = legendre(layout.local(cell), size)
            if full:
                grid_table = table
        if count <= size:
            root = np.sqrt(w)
            triangles.append((table * root).T)
            vectors.append(root[:, None] * y)
            continue
        lost += count - size
        level = float(w[0])
        if full and level > 0.0 and (w == level).all():
            # All such cells of a grid have the same triangle but for the weight.
            if grid_triangle is None:
                grid_triangle = safe_triangle(table @ table.T)
            if grid_triangle is not None:
                scale = np.sqrt(level)
                vector, remainder = project_on(grid_triangle, table, y)
                triangles.append(scale * grid_triangle)
                vectors.append(scale * vector)
                rest += level * remainder
                continue
        root = np.sqrt(w)
        table = table * root
        y = root[:, None] * y
        triangle = safe_triangle(table @ table.T)
        if triangle is not None:
            vector, remainder = project_on(triangle, table, y)
        else:
            turn, triangle = np.linalg.qr(table.T)
            vector = turn.T @ y
            remainder = ((y - turn @ vector) ** 2).sum(axis=0)
        triangles.append(triangle)
        vectors.append(vector)
        rest += remainder
    count = len(layout.samples)
    return Cells(layout.middle, layout.half, size, triangles, vectors, rest, lost, [None] * count,
                 [slice(i, i + 1) for i in range(count)])


def safe_triangle(gram: np.ndarray) -> np.ndarray | None:
    """Upper Cholesky factor of a well-conditioned matrix, None for any other."""
    factor, failed = lapack.dpotrf(gram, lower=0, clean=1)
    if failed:
        return None
    reciprocal, _ = lapack.dtrcon(factor)
    return factor if reciprocal > 1e-3 else None


def project_on(triangle: np.ndarray, table: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates of y in the orthonormal basis (triangle^-T table), and the sum of squares outside of it.

    One step of refinement takes the rounding of the normal equations away.
    """
    vector = lapack.dtrtrs(triangle, table @ y, trans=1)[0]
    remainder = y - table.T @ lapack.dtrtrs(triangle, vector)[0]
    correction = lapack.dtrtrs(triangle, table @ remainder, trans=1)[0]
    outside = np.maximum(np.einsum("nq,nq->q", remainder, remainder) - (correction**2).sum(axis=0), 0.0)
    return vector + correction, outside


def merge(cells: Cells, factor: int, size: int) -> Cells:
    """Join runs of ``factor`` neighbouring cells to cells with ``size`` polynomials.

    Exact for functions that ``size`` polynomials carry on the longer cells.
    """
    half = factor * cells.half[0]
    # Cells of equal length on one raster; where samples are missing, some places of the raster are empty.
    place = np.rint((cells.middle - cells.middle[0]) / (2.0 * cells.half[0])).astype(int)
    group_of = place // factor
    bounds = np.concatenate([[0], np.flatnonzero(np.diff(group_of)) + 1, [group_of.size]])
    triangles, vectors = [], []
    turns: list[np.ndarray | None] = []
    groups = []
    rest = cells.rest.copy()
    lost = cells.rows_lost
    middle = np.empty(bounds.size - 1)
    for i, (a, b) in enumerate(itertools.pairwise(bounds)):
        block = np.concatenate([cells.triangles[c] @ _joint(cells.size, factor, int(place[c] % factor), size)
                                for c in range(a, b)])
        vector = np.concatenate([cells.vectors[c] for c in range(a, b)])
        middle[i] = cells.middle[0] + cells.half[0] * (2.0 * group_of[a] * factor + factor - 1.0)
        groups.append(slice(int(a), int(b)))
        if block.shape[0] <= size:
            turns.append(None)
        else:
            turn, triangle = np.linalg.qr(block)
            projected = turn.T @ vector
            rest += ((vector - turn @ projected) ** 2).sum(axis=0)
            lost += block.shape[0] - size
            block, vector = triangle, projected
            turns.append(turn)
        triangles.append(block)
        vectors.append(vector)
    return Cells(middle, np.full(middle.size, half), size, triangles, vectors, rest, lost, turns, groups)


def merge_vectors(cells: Cells, vectors: list[np.ndarray]) -> list[np.ndarray]:
    """Take other right-hand sides of the finer cells through the same merge."""
    result = []
    for group, turn in zip(cells.groups, cells.turns, strict=True):
        joined = np.concatenate(vectors[group])
        result.append(joined if turn is None else turn.T @ joined)
    return result


def evaluate_in_cells(frame: FourierFrame, coefficients: np.ndarray, time: np.ndarray, derivative: int) -> np.ndarray:
    """The series of a frame at many times through Legendre polynomials on cells; see FourierFrame.evaluate."""
    ordered = bool((np.diff(time) >= 0.0).all())
    order = None if ordered else np.argsort(time, kind="stable")
    layout = Layout.of(time if order is None else time[order], float(frame.frequencies[-1]))
    size = polynomial_size(float(frame.frequencies[-1] * layout.half[0]))
    nodes, to_coefficients = gauss_rule(size)
    at = (layout.middle[:, None] + layout.half[:, None] * nodes).ravel()
    values = np.empty((at.size, coefficients.shape[1]))
    step = max(1, 2_000_000 // frame.size)
    for first in range(0, at.size, step):
        values[first : first + step] = frame.basis(at[first : first + step], derivative) @ coefficients
    series = np.matmul(to_coefficients, values.reshape(layout.middle.size, size, -1))
    result = np.empty((time.size, coefficients.shape[1]))
    grid_table = legendre(layout.local(0), size) if layout.regular else None
    for cell, part in enumerate(layout.samples):
        full = grid_table is not None and layout.regular == part.stop - part.start
        table = grid_table if full and grid_table is not None else legendre(layout.local(cell), size)
        np.matmul(table.T, series[cell], out=result[part])
    if order is not None:
        unordered = np.empty_like(result)
        unordered[order] = result
        return unordered
    return result
