"""A smooth curve through star-tracker quaternions, with its rate and the covariance of the rate.

The four components of a unit quaternion are smooth functions of time wherever the torque is, so they are fitted
together by least-squares B-splines of degree five. The fit is linear: the error of a sample about the tracker axes is
``2 vec(q q_measured*)``, linear in ``q``, and is weighted with the tracker's own noise about each axis. The knots are
as far apart as the rotation allows; where the torque jumps, the curve keeps only a continuous rate. Gross outliers lose
their weight (Tukey's biweight, iterated). Long gaps cut the data into several curves, since the rotation across them
cannot be counted.

Quaternions are scalar-first ``tracker_from_inertial``; rates are those of the tracker in tracker axes, rad/s:
``q' = -w o q / 2``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

DEGREE = 5
ANGLE_PER_INTERVAL = 0.7  # rad turned between knots: truncation of the spline stays below a tracker's noise
ANGLE_PER_GAP = 1.0  # rad turned in a gap before the two sides are kept apart
FEWEST_SAMPLES_PER_INTERVAL = 6
MOST_INTERVALS = 48  # of one curve; longer stretches are cut, to keep the dense algebra small
TUKEY = 5.5  # rejection threshold of the whitened three-axis residual, in standard deviations


@dataclass(frozen=True)
class AttitudeCurve:
    """Smoothed attitude between ``start`` and ``stop`` (s).

    Attributes:
        start, stop: first and last sample time, s.
        spline: four quaternion components over time, not exactly of unit length.
        covariance: (4 c, 4 c) of the spline coefficients, ordered component by component.
        residual: robust standard deviation of the whitened residuals (1 where noise and model are right).
        rejected: number of samples without weight.
        samples: number of samples.
    """

    start: float
    stop: float
    spline: BSpline
    covariance: np.ndarray
    residual: float
    rejected: int
    samples: int

    def quaternion(self, time: np.ndarray) -> np.ndarray:
        """``tracker_from_inertial`` (n, 4), unit, at the times (n) s."""
        value = self.spline(np.asarray(time, dtype=float))
        return value / np.linalg.norm(value, axis=-1, keepdims=True)

    def rotation(self, time: np.ndarray) -> Rotation:
        """``tracker_from_inertial`` at the times (n) s as SciPy rotations."""
        return Rotation.from_quat(self.quaternion(time), scalar_first=True)

    def rate(self, time: np.ndarray) -> np.ndarray:
        """Angular rate (n, 3) rad/s, tracker axes, at the times (n) s: ``w = -2 vec(q' q*) / |q|^2``."""
        q, derivative = self.spline(np.asarray(time, dtype=float)), self.spline(np.asarray(time, dtype=float), 1)
        return -2 * _vector_of_product_with_conjugate(derivative, q) / np.sum(q * q, axis=-1, keepdims=True)

    def acceleration(self, time: np.ndarray) -> np.ndarray:
        """Angular acceleration (n, 3) rad/s2, tracker axes, at the times (n) s: ``-2 vec(q'' q*) / |q|^2``.

        The term ``q' q'*`` of the derivative is a scalar and drops out; the length of ``q`` is constant to second
        order.
        """
        q, second = self.spline(np.asarray(time, dtype=float)), self.spline(np.asarray(time, dtype=float), 2)
        return -2 * _vector_of_product_with_conjugate(second, q) / np.sum(q * q, axis=-1, keepdims=True)

    def rate_covariance(self, time: np.ndarray) -> np.ndarray:
        """Covariance (n, 3, 3) of the rate, rad2/s2, at the times (n) s."""
        time = np.asarray(time, dtype=float)
        q, derivative = self.spline(time), self.spline(time, 1)
        values = _basis(self.spline.t, self.spline.k, time)
        slopes = _basis_derivative(self.spline.t, self.spline.k, time)
        # vec(a b*) is bilinear: the rows below are its Jacobians in a and in b.
        in_derivative = _vector_rows(q)
        in_value = _vector_rows_in_second(derivative)
        slopes, values = slopes[:, None, None, :], values[:, None, None, :]
        jacobian = -2 * (in_derivative[..., None] * slopes + in_value[..., None] * values)
        flat = jacobian.reshape(len(time), 3, -1)
        return flat @ self.covariance @ np.swapaxes(flat, 1, 2)

    def quaternion_standard_deviation(self, time: np.ndarray) -> np.ndarray:
        """Standard deviation (n, 3) rad of the smoothed attitude about the tracker axes at the times (n) s."""
        time = np.asarray(time, dtype=float)
        values = _basis(self.spline.t, self.spline.k, time)
        flat = (2 * _vector_rows(self.quaternion(time))[..., None] * values[:, None, None, :]).reshape(len(time), 3, -1)
        return np.sqrt(np.einsum("nij,jk,nik->ni", flat, self.covariance, flat))


def attitude_curves(
    time: np.ndarray, quaternion: np.ndarray, standard_deviation: np.ndarray, torque_edges: Sequence[float] = ()
) -> list[AttitudeCurve]:
    """Smooth curves through star-tracker samples; several where gaps are too long to count the rotation across them.

    Args:
        time: (n,) s, increasing.
        quaternion: (n, 4) ``tracker_from_inertial``, unit, any signs.
        standard_deviation: (n, 3) rad about the tracker axes.
        torque_edges: times (s) at which the torque jumps; the curve has a continuous rate there and no more.

    Returns:
        The curves in order of time; pieces with fewer than three usable samples are left out.
    """
    time = np.asarray(time, dtype=float)
    if len(time) < 3:
        return []
    keep, rate = _plausible(time, quaternion, standard_deviation)
    time, quaternion, sigma = time[keep], quaternion[keep], standard_deviation[keep]
    rejected = int(np.sum(~keep))
    if len(time) < 3:
        return []
    steps = np.diff(time)
    limit = max(ANGLE_PER_GAP / max(rate, 1e-9), 2.5 * float(np.median(steps)))
    curves: list[AttitudeCurve] = []
    for piece in np.split(np.arange(len(time)), np.flatnonzero(steps > limit) + 1):
        if len(piece) < 3:
            continue
        length = (time[piece[-1]] - time[piece[0]]) * rate / ANGLE_PER_INTERVAL
        parts = min(max(1, int(np.ceil(length / MOST_INTERVALS))), max(1, len(piece) // 40))
        for part in np.array_split(piece, parts):
            curves.append(_fit(time[part], _same_signs(quaternion[part]), sigma[part], torque_edges, rate, rejected))
            rejected = 0
    return curves


def _plausible(time: np.ndarray, quaternion: np.ndarray, sigma: np.ndarray) -> tuple[np.ndarray, float]:
    """Mask of the samples that most of their neighbours can be reached from, and the typical rate (rad/s)."""
    n = len(time)
    step = float(np.median(np.diff(time)))

    def turns(shift: int) -> np.ndarray:
        """Angles between samples ``shift`` apart, right to 1e-8 rad."""
        cosine = np.abs(np.einsum("ni,ni->n", quaternion[shift:], quaternion[:-shift]))
        return np.asarray(2.0 * np.arccos(np.minimum(cosine, 1.0)))

    lag = min(max(1, int(np.ceil(2.0 / step))), n - 1)
    noise = float(np.median(np.linalg.norm(sigma, axis=1)))
    far = turns(lag) / (time[lag:] - time[:-lag])
    near = np.median(turns(1) / np.diff(time))
    # Outliers raise a difference as often as twice their share, so that the 75 % quantile is still clean.
    rate = min(float(np.quantile(far, 0.75)), 4 * float(near))
    votes, good = np.zeros(n), np.zeros(n)
    for shift in range(1, min(4, n)):
        angle = turns(shift)
        fine = angle < 4 * rate * (time[shift:] - time[:-shift]) + 15 * noise
        for part in (slice(None, n - shift), slice(shift, None)):
            votes[part] += 1
            good[part] += fine
    keep = good >= 0.5 * votes
    return keep, max(rate, 1e-7)


def _same_signs(quaternion: np.ndarray) -> np.ndarray:
    """The quaternions with the signs that make neighbours agree."""
    flips = np.where(np.sum(quaternion[1:] * quaternion[:-1], axis=1) < 0, -1.0, 1.0)
    return quaternion * np.concatenate([[1.0], np.cumprod(flips)])[:, None]


def _fit(
    time: np.ndarray,
    quaternion: np.ndarray,
    sigma: np.ndarray,
    torque_edges: Sequence[float],
    rate: float,
    rejected: int,
) -> AttitudeCurve:
    """The curve with the widest knots that the data do not contradict."""
    spacing = ANGLE_PER_INTERVAL / rate
    best = _fit_with_spacing(time, quaternion, sigma, torque_edges, spacing, rejected)
    while best.residual > 1.1:
        spacing /= 2
        finer = _fit_with_spacing(time, quaternion, sigma, torque_edges, spacing, rejected)
        if len(finer.spline.t) == len(best.spline.t):
            break
        # Knots are worth having while they reduce the residuals by clearly more than their number.
        if finer.residual > 0.97 * best.residual:
            break
        best = finer
    return best


def _knots(time: np.ndarray, torque_edges: Sequence[float], spacing: float) -> tuple[np.ndarray, int]:
    """Knot vector and degree: every interval holds enough samples; torque edges are knots that repeat."""
    n = len(time)
    degree = int(min(DEGREE, max(1, n // 4)))
    edges = [time[0]]
    for edge in sorted(set(torque_edges)):
        between, beyond = np.sum((time > edges[-1]) & (time <= edge)), np.sum(time > edge)
        if min(between, beyond) >= FEWEST_SAMPLES_PER_INTERVAL:
            edges.append(edge)
    edges.append(time[-1])
    inner: list[float] = []
    for first, last in pairwise(edges):
        count = int(max(1, np.ceil((last - first) / spacing)))
        inside = time[(time >= first) & (time <= last)]
        count = min(count, max(1, len(inside) // FEWEST_SAMPLES_PER_INTERVAL))
        previous = first
        for candidate in np.linspace(first, last, count + 1)[1:-1]:
            enough = np.sum((inside > previous) & (inside <= candidate)) >= FEWEST_SAMPLES_PER_INTERVAL
            if enough and np.sum(inside > candidate) >= FEWEST_SAMPLES_PER_INTERVAL:
                inner.append(float(candidate))
                previous = candidate
        if last < time[-1]:
            inner.extend([float(last)] * max(1, degree - 1))
    return np.concatenate([[time[0]] * (degree + 1), inner, [time[-1]] * (degree + 1)]), degree


def _fit_with_spacing(
    time: np.ndarray,
    quaternion: np.ndarray,
    sigma: np.ndarray,
    torque_edges: Sequence[float],
    spacing: float,
    rejected: int,
) -> AttitudeCurve:
    """Iteratively reweighted least squares for the knots that belong to ``spacing`` (s)."""
    knots, degree = _knots(time, torque_edges, spacing)
    design = _basis(knots, degree, time)
    count = design.shape[1]
    start = _start(time, quaternion, knots, degree)
    # Rows of q -> 2 vec(q q_measured*) and of q -> 2 (q . q_measured), each divided by its standard deviation; the
    # last one only fixes the length of q.
    rows = np.concatenate([_vector_rows(quaternion), quaternion[:, None, :]], axis=1)
    precision = 4 / np.concatenate([sigma, np.min(sigma, axis=1, keepdims=True)], axis=1) ** 2
    information = np.einsum("nra,nr,nrb->nab", rows, precision, rows)
    target = np.einsum("nab,nb->na", information, quaternion)
    weight = np.ones(len(time))
    scale = 1.0
    coefficients = np.zeros((count, 4))
    factor = None
    for _ in range(12):
        normal = np.empty((4, count, 4, count))
        for a in range(4):
            for b in range(a, 4):
                block = design.T @ ((weight * information[:, a, b])[:, None] * design)
                normal[a, :, b, :] = block
                normal[b, :, a, :] = block.T
        matrix = normal.reshape(4 * count, 4 * count)
        # A knot interval whose samples were all rejected must not make the matrix singular.
        ridge = 1e-9 * np.trace(matrix) / len(matrix)
        matrix[np.diag_indices_from(matrix)] += ridge
        right = (design.T @ (weight[:, None] * target) + ridge * start).T.ravel()
        factor = cho_factor(matrix)
        previous = coefficients
        coefficients = cho_solve(factor, right).reshape(4, count).T
        whitened = 2 * np.einsum("nra,na->nr", rows[:, :3], design @ coefficients) / sigma
        # The median of the absolute residual over 0.6745 is the standard deviation of a normal sample.
        scale = float(np.median(np.abs(whitened))) / 0.6745 * np.sqrt(3 * len(time) / max(1, 3 * len(time) - 3 * count))
        ratio = np.linalg.norm(whitened, axis=1) / (TUKEY * max(scale, 1e-12))
        weight = np.where(ratio < 1, (1 - ratio**2) ** 2, 0.0)
        if np.max(np.abs(coefficients - previous)) < 0.01 * np.min(sigma):
            break
    assert factor is not None
    covariance = cho_solve(factor, np.eye(4 * count)) * max(scale, 1e-12) ** 2
    spline = BSpline(knots, coefficients, degree)
    return AttitudeCurve(
        start=float(time[0]),
        stop=float(time[-1]),
        spline=spline,
        covariance=covariance,
        residual=scale,
        rejected=rejected + int(np.sum(weight == 0)),
        samples=len(time),
    )


def _start(time: np.ndarray, quaternion: np.ndarray, knots: np.ndarray, degree: int) -> np.ndarray:
    """Coefficients (c, 4) near the data: the nearest sample at each Greville abscissa."""
    places = np.array([np.mean(knots[i + 1 : i + degree + 1]) for i in range(len(knots) - degree - 1)])
    return quaternion[np.clip(np.searchsorted(time, places), 0, len(time) - 1)]


def _basis(knots: np.ndarray, degree: int, time: np.ndarray) -> np.ndarray:
    """Values (n, c) of the basis splines; times outside the knots are taken at the nearer end."""
    inside = np.clip(time, knots[0], knots[-1])
    return BSpline.design_matrix(inside, knots, degree).toarray()


def _basis_derivative(knots: np.ndarray, degree: int, time: np.ndarray) -> np.ndarray:
    """First derivatives (n, c) of the basis splines, 1/s."""
    count = len(knots) - degree - 1
    inside = np.clip(time, knots[0], knots[-1])
    return np.asarray(BSpline(knots, np.eye(count), degree)(inside, 1))


def _vector_of_product_with_conjugate(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Vector part (n, 3) of ``a o b*`` for quaternions (n, 4)."""
    return b[..., :1] * a[..., 1:] - a[..., :1] * b[..., 1:] - np.cross(a[..., 1:], b[..., 1:])


def _vector_rows(b: np.ndarray) -> np.ndarray:
    """Matrices (n, 3, 4) with ``rows @ a == vec(a o b*)``."""
    w, x, y, z = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            np.stack([-x, w, -z, y], axis=-1),
            np.stack([-y, z, w, -x], axis=-1),
            np.stack([-z, -y, x, w], axis=-1),
        ],
        axis=-2,
    )


def _vector_rows_in_second(a: np.ndarray) -> np.ndarray:
    """Matrices (n, 3, 4) with ``rows @ b == vec(a o b*)``; ``vec(a o b*) == -vec(b o a*)``."""
    return -_vector_rows(a)
