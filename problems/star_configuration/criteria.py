"""The covariance of an attitude from sighted directions, and the two criteria K0 and K1, as pure CasADi functions.

A sensor that sights a star in the body direction ``b`` measures the error of that direction across ``b``. A small
rotation ``e`` of the body moves the direction by ``b x e``, so the star informs about ``e`` through

    M = (2 / sigma^2) (I - b b^T)                                equal accuracy in both axes, sigma total
    M = u u^T / sigma_v^2 + v v^T / sigma_u^2,  v = b x u        a sensor with accuracies sigma_u, sigma_v along u, v

(an error along ``u`` is a rotation about ``v``). The sum over the stars is the information ``F``; ``P = F^-1`` is the
covariance of the attitude. For N equal sensors this is ``P = (sigma^2 / 2) (N I - B B^T)^-1``, formula (3) of
Sukhovilov (2007) with ``sigma`` the TOTAL standard deviation of a direction (both axes): for a standard deviation per
axis all criteria double.

    K0 = trace P                                                  (1)
    K1 = V^T (trace(P) I - P) V = E |dV|^2                        (2)

K1 is the second moment of the length of the error of the unit vector ``V``, not a variance of that length.

Relation to Wahba's problem: with weights ``1 / sigma_i^2`` the minimiser of Wahba's loss (QUEST, SVD, q-method) is the
maximum-likelihood attitude for isotropic direction errors, and its covariance by Shuster and Oh (1981),
``P = s^2 (I - sum a_i w_i w_i^T)^-1`` with ``1/s^2 = sum 1/s_i^2`` and ``a_i = s^2/s_i^2`` (``s_i`` per axis), is the
same matrix. With two-axis accuracies Wahba's weights are not optimal, and ``P`` here is the covariance of weighted
least squares (the Cramer-Rao bound), which Wahba's solution does not reach.

Shapes: directions (3 x N), one unit vector a column; sigmas (N) or a scalar. Every function takes and returns CasADi
matrices (SX, MX, DM) or NumPy arrays that CasADi accepts.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from estimator.models.errors import NotFiniteError, RequestError, ShapeError

Matrix = Any
"""A CasADi matrix (SX, MX, DM) or an array that CasADi takes in its place."""


def direction_information(direction: Matrix, sigma: Matrix) -> Matrix:
    """Information (3 x 3, 1/rad^2) that one sighted ``direction`` (3, unit) of total accuracy ``sigma`` (rad) gives."""
    return 2 / sigma**2 * (ca.sumsqr(direction) * ca.DM.eye(3) - direction @ direction.T)


def two_axis_information(direction: Matrix, first_axis: Matrix, sigma_first: Matrix, sigma_second: Matrix) -> Matrix:
    """Information (3 x 3, 1/rad^2) of one sighting by a sensor whose two axes differ in accuracy.

    Args:
        direction: line of sight (3, unit).
        first_axis: the sensor's first measuring axis (3, unit, across the direction); the second is
            ``direction x first_axis``.
        sigma_first, sigma_second: standard deviation (rad) of the measured direction along each of the two axes.
    """
    second_axis = ca.cross(direction, first_axis)
    return first_axis @ first_axis.T / sigma_second**2 + second_axis @ second_axis.T / sigma_first**2


def information(directions: Matrix, sigma: Matrix = 1.0) -> Matrix:
    """Information (3 x 3, 1/rad^2) of all directions (3 x N); ``sigma`` (rad, total) is a scalar or has N entries."""
    count = directions.shape[1]
    row: Matrix = ca.reshape(sigma, 1, -1)
    weight = 2 / row**2
    if weight.shape[1] == 1:
        weight = ca.repmat(weight, 1, count)
    weighted = directions * ca.repmat(weight, 3, 1)
    return ca.dot(weighted, directions) * ca.DM.eye(3) - weighted @ directions.T


def covariance(attitude_information: Matrix) -> Matrix:
    """The inverse of a symmetric information matrix (3 x 3) by its cofactors: the attitude covariance (rad^2)."""
    return adjugate(attitude_information) / determinant(attitude_information)


def adjugate(f: Matrix) -> Matrix:
    """Adjugate (3 x 3) of a symmetric matrix (3 x 3): determinant times inverse."""
    xy = f[0, 2] * f[1, 2] - f[0, 1] * f[2, 2]
    xz = f[0, 1] * f[1, 2] - f[0, 2] * f[1, 1]
    yz = f[0, 1] * f[0, 2] - f[0, 0] * f[1, 2]
    return ca.blockcat(
        [
            [f[1, 1] * f[2, 2] - f[1, 2] ** 2, xy, xz],
            [xy, f[0, 0] * f[2, 2] - f[0, 2] ** 2, yz],
            [xz, yz, f[0, 0] * f[1, 1] - f[0, 1] ** 2],
        ]
    )


def determinant(f: Matrix) -> Matrix:
    """Determinant of a symmetric matrix (3 x 3)."""
    return (
        f[0, 0] * (f[1, 1] * f[2, 2] - f[1, 2] ** 2)
        - f[0, 1] * (f[0, 1] * f[2, 2] - f[1, 2] * f[0, 2])
        + f[0, 2] * (f[0, 1] * f[1, 2] - f[1, 1] * f[0, 2])
    )


def K0(attitude_covariance: Matrix) -> Matrix:
    """Variance of the whole attitude (rad^2): the trace of its covariance (3 x 3); formula (1)."""
    return ca.trace(attitude_covariance)


def K1(attitude_covariance: Matrix, axis: Matrix) -> Matrix:
    """Mean square error (rad^2) of the body axis ``axis`` (3, unit): formula (2)."""
    return ca.trace(attitude_covariance) * ca.sumsqr(axis) - ca.bilin(attitude_covariance, axis, axis)


def criteria_function(count: int) -> ca.Function:
    """CasADi function (directions 3 x count, sigma count, axis 3) -> (K0, K1, covariance 3 x 3)."""
    directions, sigma, axis = ca.SX.sym("directions", 3, count), ca.SX.sym("sigma", count), ca.SX.sym("axis", 3)
    p = covariance(information(directions, sigma))
    return ca.Function(
        "star_criteria",
        [directions, sigma, axis],
        [K0(p), K1(p, axis), p],
        ["directions", "sigma", "axis"],
        ["K0", "K1", "covariance"],
    )


@dataclass(frozen=True)
class Criteria:
    """What a set of sighted directions tells about the attitude.

    Attributes:
        K0: variance of the whole attitude (rad^2, or units of sigma^2); infinite where it is not determined.
        K1: mean square error of ``axis``; finite where the axis is determined even if the turn about it is not.
        axis: body axis of K1 (3, unit).
        covariance: attitude covariance (3 x 3), body axes; None where the information is singular.
        unobservable: body axes (k x 3, unit) about which a rotation is not seen; empty if the attitude is determined.
    """

    K0: float
    K1: float
    axis: np.ndarray
    covariance: np.ndarray | None
    unobservable: np.ndarray


def unit_vectors(directions: Any, where: str = "directions") -> np.ndarray:
    """``directions`` (N x 3) as float unit vectors.

    Raises:
        ShapeError: not N rows of three.
        NotFiniteError: NaN or infinity.
        RequestError: a vector of length zero.
    """
    rows = np.atleast_2d(np.asarray(directions, dtype=float))
    if rows.ndim != 2 or rows.shape[1] != 3:
        raise ShapeError("a direction has three components", where=where, value=f"shape {rows.shape}", limit="(N, 3)")
    if not np.all(np.isfinite(rows)):
        raise NotFiniteError("a direction is not a finite vector", where=where, remedy="give three numbers for each")
    length = np.linalg.norm(rows, axis=1)
    if np.any(length < 1e-12):
        raise RequestError(
            "a direction has length zero",
            where=f"{where}[{int(np.argmin(length))}]",
            value=float(length.min()),
            limit="above 0",
            remedy="give a vector that points somewhere",
        )
    return rows / length[:, None]


def criteria_of(directions: Any, axis: Any = (0.0, 0.0, 1.0), sigma: Any = 1.0) -> Criteria:
    """K0, K1 and the covariance of directions, with what they leave undetermined.

    Args:
        directions: (N x 3), body axes; normalised.
        axis: body axis of K1 (3); normalised.
        sigma: total accuracy of a direction (rad or 1), scalar or N.

    Example:
        >>> round(criteria_of([[1, 0, 0], [0, 1, 0], [0, 0, 1]]).K0, 12)
        0.75
    """
    b = unit_vectors(directions)
    weights = 2 / np.broadcast_to(np.asarray(sigma, dtype=float), (len(b),)) ** 2
    if not np.all(np.isfinite(weights)):
        raise RequestError("an accuracy is not a positive number", where="sigma", value=sigma, limit="above 0")
    matrix = np.array(ca.DM(information(ca.DM(b.T), ca.DM(np.sqrt(2 / weights)))))
    return criteria_of_information(matrix, axis)


def criteria_of_information(matrix: np.ndarray, axis: Any = (0.0, 0.0, 1.0)) -> Criteria:
    """K0, K1 and the covariance for an information matrix (3 x 3, 1/rad^2); see :func:`criteria_of`."""
    v = unit_vectors(axis, "axis")[0]
    values, vectors = np.linalg.eigh(matrix)
    blind = values < 1e-13 * max(values[-1], 1e-300)
    if np.any(blind):
        # The axis is still determined where each unseen rotation leaves it in place: a turn about the axis itself.
        seen = 1 / np.where(blind, np.inf, values)
        moved = blind & (1 - (vectors.T @ v) ** 2 > 1e-12)
        p_axis = float(np.sum(seen * (1 - (vectors.T @ v) ** 2)))
        return Criteria(np.inf, np.inf if np.any(moved) else p_axis, v, None, vectors.T[blind])
    least, of_axis, p = _of_matrix()(matrix, v)
    return Criteria(float(least), float(of_axis), v, np.array(p), np.zeros((0, 3)))


@lru_cache(maxsize=1)
def _of_matrix() -> ca.Function:
    """CasADi function (information 3 x 3, axis 3) -> (K0, K1, covariance 3 x 3)."""
    matrix, axis = ca.SX.sym("information", 3, 3), ca.SX.sym("axis", 3)
    p = covariance(matrix)
    return ca.Function("star_criteria_of_information", [matrix, axis], [K0(p), K1(p, axis), p])
