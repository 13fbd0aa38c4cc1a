"""Small symmetric matrices written out, so that symbols stay short and derivatives cheap."""

from __future__ import annotations

import casadi as ca

from estimator.models.rotations import Matrix


def symmetric(entries: Matrix) -> Matrix:
    """The matrix (3 x 3) of its entries (6) in the order xx, yy, zz, xy, xz, yz."""
    xx, yy, zz, xy, xz, yz = (entries[i] for i in range(6))
    return ca.blockcat([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def solve(matrix: Matrix, right: Matrix) -> Matrix:
    """The solution (3) of ``matrix x = right`` by Cramer's rule."""
    a, b, c = (matrix[:, i] for i in range(3))
    determinant = ca.dot(a, ca.cross(b, c))
    return ca.vertcat(ca.dot(right, ca.cross(b, c)), ca.dot(right, ca.cross(c, a)),
                      ca.dot(right, ca.cross(a, b))) / determinant


def axial(matrix: Matrix) -> Matrix:
    """The vector (3) ``sum_jk epsilon_ijk matrix_jk``: of ``a b^T`` it is ``a x b``."""
    return ca.vertcat(matrix[1, 2] - matrix[2, 1], matrix[2, 0] - matrix[0, 2], matrix[0, 1] - matrix[1, 0])
