"""Rotations as pure CasADi functions: one convention, stated here and checked in ``tests/test_rotations.py``.

Quaternions are scalar-first Hamilton, ``q = (w, x, y, z)`` with ``i j = k``. ``x_from_y`` maps the coordinates of a
vector from frame y into frame x, ``v_x = q v_y q*``, and products chain by equal inner names:
``x_from_z = x_from_y * y_from_z``. A rotation vector ``phi`` (rad) is the axis times the angle;
``exponential(phi)`` is the quaternion of that active rotation.

Rates: with ``q = inertial_from_body`` and the angular velocity ``w`` of the body in body axes, ``q' = q o w / 2``;
with ``q = body_from_inertial``, ``q' = -w o q / 2``.

Every function takes and returns ``casadi`` matrices (SX, MX or DM); NumPy arrays are accepted where CasADi takes them.
For arrays of measured quaternions use ``scipy.spatial.transform.Rotation`` with ``scalar_first=True``.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

Matrix = Any
"""A CasADi matrix (SX, MX, DM) or an array that CasADi takes in its place."""


def multiply(p: Matrix, q: Matrix) -> Matrix:
    """Hamilton product ``p o q`` of two quaternions (4)."""
    return ca.vertcat(
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    )


def conjugate(q: Matrix) -> Matrix:
    """The conjugate (4), which is the inverse of a unit quaternion: ``y_from_x`` of ``x_from_y``."""
    return ca.vertcat(q[0], -q[1], -q[2], -q[3])


def rotate(q: Matrix, v: Matrix) -> Matrix:
    """Coordinates ``q v q*`` (3) of the vector ``v``: with ``q = x_from_y``, from frame y into frame x."""
    u = ca.vertcat(q[1], q[2], q[3])
    t = 2 * ca.cross(u, v)
    return v + q[0] * t + ca.cross(u, t)


def matrix(q: Matrix) -> Matrix:
    """Rotation matrix (3 x 3) with ``matrix(q) @ v == rotate(q, v)``."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return ca.blockcat(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def skew(v: Matrix) -> Matrix:
    """The matrix (3 x 3) with ``skew(v) @ a == cross(v, a)``."""
    return ca.skew(v)


def safe_norm(v: Matrix, floor: float = 1e-150) -> Matrix:
    """Euclidean norm whose gradient at zero is zero (the gradient of ``norm_2`` there is NaN)."""
    square = ca.sumsqr(v)
    return ca.if_else(square > floor, ca.sqrt(ca.fmax(square, floor)), 0)


def exponential(phi: Matrix) -> Matrix:
    """Unit quaternion (4) of the rotation vector ``phi`` (3, rad), smooth at zero.

    Below an angle of about 1e-2 rad the two trigonometric factors are their Taylor polynomials up to the term in
    the eighth power, whose truncation error is far below the rounding error; above it, sine and cosine.
    """
    square = ca.sumsqr(phi)
    small = square < 1e-4  # rad2
    safe = ca.if_else(small, 1, square)
    angle = ca.sqrt(safe)
    cosine = ca.if_else(small, 1 - square / 8 * (1 - square / 48 * (1 - square / 120 * (1 - square / 224))),
                        ca.cos(angle / 2))
    sine = ca.if_else(small, 0.5 * (1 - square / 24 * (1 - square / 80 * (1 - square / 168 * (1 - square / 288)))),
                      ca.sin(angle / 2) / angle)
    return ca.vertcat(cosine, sine * phi)


def logarithm(q: Matrix) -> Matrix:
    """Rotation vector (3, rad) of the unit quaternion ``q``, of length at most pi; ``q`` and ``-q`` give the same.

    Smooth except at the half turn, where the direction of the vector is ambiguous.
    """
    sign = ca.if_else(q[0] < 0, -1, 1)
    w = sign * q[0]
    u = sign * ca.vertcat(q[1], q[2], q[3])
    square = ca.sumsqr(u)
    small = square < 1e-5  # (half angle)2
    safe = ca.if_else(small, 1, square)
    sine = ca.sqrt(safe)
    ratio = square / (w * w)
    series = (2 / w) * (1 - ratio * (1 / 3 - ratio * (1 / 5 - ratio * (1 / 7 - ratio / 9))))
    return ca.if_else(small, series, 2 * ca.atan2(sine, w) / sine) * u


def normalize(q: Matrix) -> Matrix:
    """``q`` divided by its length."""
    return q / ca.sqrt(ca.sumsqr(q))


def inertial_from_body_derivative(q: Matrix, w: Matrix) -> Matrix:
    """``q' = q o w / 2`` for ``q = inertial_from_body`` and the body rate ``w`` (3, rad/s, body axes)."""
    return 0.5 * multiply(q, ca.vertcat(0, w))


def body_from_inertial_derivative(q: Matrix, w: Matrix) -> Matrix:
    """``q' = -w o q / 2`` for ``q = body_from_inertial`` and the body rate ``w`` (3, rad/s, body axes)."""
    return -0.5 * multiply(ca.vertcat(0, w), q)


def about_z(angle: Matrix) -> Matrix:
    """Quaternion of the active rotation about +z by ``angle`` (rad).

    A frame that turns about +z by ``angle`` against the inertial one has ``inertial_from_frame = about_z(angle)``.
    """
    return ca.vertcat(ca.cos(angle / 2), 0, 0, ca.sin(angle / 2))
