"""Inertia tensors as six entries (Jxx, Jyy, Jzz, Jxy, Jxz, Jyz), and what makes one physical.

An inertia tensor of a body with mass is symmetric and positive definite, and each principal moment is less than the
sum of the other two (the triangle inequality). Both hold exactly when the second-moment matrix
``P = I tr(J)/2 - J`` is positive definite. The normalized tensor has trace 1: what free rotation determines.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from estimator.models.rotations import Matrix


def matrix_of(entries: Matrix) -> Matrix:
    """The symmetric matrix (3 x 3) of the six entries."""
    xx, yy, zz, xy, xz, yz = (entries[i] for i in range(6))
    return ca.vertcat(ca.horzcat(xx, xy, xz), ca.horzcat(xy, yy, yz), ca.horzcat(xz, yz, zz))


def normalized_entries(tensor: Matrix) -> Matrix:
    """The six entries (6) of a symmetric matrix, divided by its trace."""
    trace = tensor[0, 0] + tensor[1, 1] + tensor[2, 2]
    return ca.vertcat(tensor[0, 0], tensor[1, 1], tensor[2, 2], tensor[0, 1], tensor[0, 2], tensor[1, 2]) / trace


def entries_of(tensor: np.ndarray) -> np.ndarray:
    """The six entries of a 3 x 3 array, as an array, without scaling."""
    a = np.asarray(tensor, dtype=float)
    return np.array([a[0, 0], a[1, 1], a[2, 2], a[0, 1], a[0, 2], a[1, 2]])


def smallest_second_moment(tensor: np.ndarray) -> float:
    """Smallest eigenvalue of ``I tr(J)/2 - J`` over the trace: positive exactly for a physical tensor."""
    a = np.asarray(tensor, dtype=float)
    trace = float(np.trace(a))
    return float(np.linalg.eigvalsh(0.5 * trace * np.eye(3) - a)[0] / trace)


def euler_acceleration(inertia: Matrix, rate: Matrix, torque: Matrix) -> Matrix:
    """Angular acceleration ``J^-1 (N - w x J w)`` of a rigid body (3, rad/s2, body axes).

    Args:
        inertia: (3, 3), in the unit of ``torque`` over rad/s2; both may be divided by the same number.
        rate: angular velocity against inertial space (3, rad/s, body axes).
        torque: (3), body axes.

    Euler's equations, the paper's (43).
    """
    right = torque - ca.cross(rate, ca.mtimes(inertia, rate))
    return ca.mtimes(inverse3(inertia), right)


def inverse3(a: Matrix) -> Matrix:
    """Inverse of a 3 x 3 matrix by cofactors (small symbolic graphs)."""
    r0, r1, r2 = a[0, :].T, a[1, :].T, a[2, :].T
    c0, c1, c2 = ca.cross(r1, r2), ca.cross(r2, r0), ca.cross(r0, r1)
    return ca.horzcat(c0, c1, c2) / ca.dot(r0, c0)
