"""Kinematics of a turning body as NumPy functions: quaternion, modified Rodrigues parameters, angles 312.

Quaternions are scalar-first Hamilton, ``inertial_from_body``, so that ``q' = q o w / 2`` with the rate ``w`` in body
axes; the acceleration is the derivative of the body-axis components of the rate, ``eps = w'``, and the jerk that of
the acceleration. Every function works on arrays with any leading axes: quaternions have shape (..., 4), vectors
(..., 3). Radians and seconds. The symbolic counterparts are in :mod:`estimator.models.rotations`.

Sources: Somov, Butyrin, Makarov, section 1 (kinematic model and modified Rodrigues parameters); the formulas of
the derivatives follow from differentiating them and are checked by finite differences in the tests.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from estimator.models.errors import NotFiniteError, QuaternionError

Array = np.ndarray


@dataclass(frozen=True)
class Motion:
    """Attitude and its derivatives at one or many instants.

    Attributes:
        quaternion: ``inertial_from_body`` (..., 4).
        rate: body axes (..., 3), rad/s.
        acceleration: derivative of the body-axis rate (..., 3), rad/s2.
        jerk: derivative of the acceleration (..., 3), rad/s3.
    """

    quaternion: Array
    rate: Array
    acceleration: Array
    jerk: Array


def dot(a: Array, b: Array) -> Array:
    """Scalar product over the last axis, which is kept with length 1."""
    return np.sum(a * b, axis=-1, keepdims=True)


_NEXT, _AFTER = [1, 2, 0], [2, 0, 1]


def cross(a: Array, b: Array) -> Array:
    """Vector product over the last axis (..., 3): ``numpy.cross`` without its overhead, which rules small arrays."""
    return a[..., _NEXT] * b[..., _AFTER] - a[..., _AFTER] * b[..., _NEXT]


def norm(a: Array) -> Array:
    """Euclidean length over the last axis, which is dropped."""
    return np.sqrt(np.sum(np.square(a), axis=-1))


def product(p: ArrayLike, q: ArrayLike) -> Array:
    """Hamilton product ``p o q`` (..., 4); the sign is kept as the factors give it."""
    p, q = np.asarray(p, dtype=float), np.asarray(q, dtype=float)
    p0, pv, q0, qv = p[..., :1], p[..., 1:], q[..., :1], q[..., 1:]
    return np.concatenate([p0 * q0 - dot(pv, qv), p0 * qv + q0 * pv + cross(pv, qv)], axis=-1)


def conjugate(q: ArrayLike) -> Array:
    """Conjugate (..., 4), the inverse of a unit quaternion."""
    return np.asarray(q, dtype=float) * np.array([1.0, -1.0, -1.0, -1.0])


def rotate(q: ArrayLike, v: ArrayLike) -> Array:
    """Coordinates ``q v q~`` (..., 3): with ``q = x_from_y``, from frame y into frame x."""
    q, v = np.asarray(q, dtype=float), np.asarray(v, dtype=float)
    u = q[..., 1:]
    t = 2.0 * cross(u, v)
    return v + q[..., :1] * t + cross(u, t)


def exponential(phi: ArrayLike) -> Array:
    """Unit quaternion (..., 4) of the rotation vector ``phi`` (..., 3), rad."""
    phi = np.asarray(phi, dtype=float)
    angle = norm(phi)[..., None]
    return np.concatenate([np.cos(angle / 2), 0.5 * np.sinc(angle / (2 * np.pi)) * phi], axis=-1)


def logarithm(q: ArrayLike) -> Array:
    """Rotation vector (..., 3) of length at most pi; ``q`` and ``-q`` give the same."""
    q = np.asarray(q, dtype=float)
    q = np.where(q[..., :1] < 0, -q, q)
    sine = norm(q[..., 1:])[..., None]
    half = np.arctan2(sine, q[..., :1])
    safe = np.where(sine > 1e-9, sine, 1.0)
    return np.where(sine > 1e-9, 2 * half / safe, 2.0) * q[..., 1:]


def angle_between(p: ArrayLike, q: ArrayLike) -> Array:
    """Angle (...,) of the rotation from ``p`` to ``q``, 0 to pi, accurate for small angles."""
    return norm(logarithm(product(conjugate(p), q)))


def sign_continuous(q: ArrayLike) -> Array:
    """The series ``q`` (n, 4) with signs chosen so that no neighbours have a negative scalar product."""
    q = np.array(q, dtype=float)
    if len(q) > 1:
        flips = np.where(np.sum(q[1:] * q[:-1], axis=-1) < 0, -1.0, 1.0)
        q[1:] *= np.cumprod(flips)[:, None]
    return q


def unit_quaternion(q: ArrayLike, *, where: str = "quaternion", tolerance: float = 1e-6) -> Array:
    """``q`` (..., 4) divided by its length.

    Raises:
        NotFiniteError: a component is NaN or infinite.
        QuaternionError: the length differs from 1 by more than ``tolerance``, or there are not four components.
    """
    q = np.asarray(q, dtype=float)
    if q.ndim == 0 or q.shape[-1] != 4:
        raise QuaternionError("a quaternion has four components, w x y z", where=where, value=f"shape {q.shape}")
    if not np.all(np.isfinite(q)):
        raise NotFiniteError("a component is not finite", where=where, remedy="give four finite numbers")
    length = norm(q)
    worst = float(np.max(np.abs(length - 1)))
    if worst > tolerance:
        raise QuaternionError("the quaternion is not of unit length", where=where,
                              value=f"length {float(length.ravel()[np.argmax(np.abs(length - 1).ravel())]):.9g}",
                              limit=f"1 within {tolerance:g}", remedy="divide it by its length")
    return q / length[..., None]


# ------------------------------------------------------------------------------- quaternion and its derivatives


def quaternion_derivatives(motion: Motion) -> tuple[Array, Array, Array, Array]:
    """``q, q', q'', q'''`` (each (..., 4)) of a motion.

    With W = (0, w): q' = q o W/2, q'' = q o (eps/2 - |w|^2/4), and once more for the third.
    """
    q, w, a, j = motion.quaternion, motion.rate, motion.acceleration, motion.jerk
    square = dot(w, w)
    inner1 = np.concatenate([np.zeros_like(square), w / 2], axis=-1)
    inner2 = np.concatenate([-square / 4, a / 2], axis=-1)
    inner3 = np.concatenate([-0.75 * dot(w, a), j / 2 + cross(w, a) / 4 - square * w / 8], axis=-1)
    return q, product(q, inner1), product(q, inner2), product(q, inner3)


def motion_from_quaternion_derivatives(q: Array, q1: Array, q2: Array, q3: Array) -> Motion:
    """The inverse of :func:`quaternion_derivatives`: body rate, acceleration and jerk (each (..., 3))."""
    inverse = conjugate(q)
    w = 2 * product(inverse, q1)[..., 1:]
    a = 2 * product(inverse, q2)[..., 1:]
    j = 2 * product(inverse, q3)[..., 1:] - cross(w, a) / 2 + dot(w, w) * w / 4
    return Motion(q, w, a, j)


def compose(first: Motion, second: Motion) -> Motion:
    """Motion of the product ``first.quaternion o second.quaternion`` (``a_from_c = a_from_b o b_from_c``)."""
    p, q = quaternion_derivatives(first), quaternion_derivatives(second)
    return motion_from_quaternion_derivatives(
        product(p[0], q[0]),
        product(p[1], q[0]) + product(p[0], q[1]),
        product(p[2], q[0]) + 2 * product(p[1], q[1]) + product(p[0], q[2]),
        product(p[3], q[0]) + 3 * product(p[2], q[1]) + 3 * product(p[1], q[2]) + product(p[0], q[3]),
    )


_TERMS = 40
_COSINE = np.array([(-1) ** n / (4.0**n * math.factorial(2 * n)) for n in range(_TERMS)])
_SINE = np.array([(-1) ** n / (2.0 * 4.0**n * math.factorial(2 * n + 1)) for n in range(_TERMS)])


def _series(coefficients: Array, s: Array) -> tuple[Array, Array, Array, Array]:
    """The power series and its first three derivatives at ``s``."""
    derived = [np.polynomial.polynomial.polyder(coefficients, k) if k else coefficients for k in range(4)]
    a, b, c, d = (np.polynomial.polynomial.polyval(s, c) for c in derived)
    return a, b, c, d


def exponential_motion(p: Array, p1: Array, p2: Array, p3: Array) -> Motion:
    """Motion of ``exp(p(t))`` from the rotation vector ``p`` and its three derivatives (each (..., 3)).

    Cosine and sine of half the angle are entire functions of ``|p|^2``, so that their power series serve at and away
    from zero alike; with 40 terms they are exact to rounding up to three turns.
    """
    s = dot(p, p)
    s1 = 2 * dot(p, p1)
    s2 = 2 * (dot(p1, p1) + dot(p, p2))
    s3 = 2 * (3 * dot(p1, p2) + dot(p, p3))

    def along(values: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        f, f1, f2, f3 = values
        return f, f1 * s1, f2 * s1**2 + f1 * s2, f3 * s1**3 + 3 * f2 * s1 * s2 + f1 * s3

    c, c1, c2, c3 = along(_series(_COSINE, s))
    k, k1, k2, k3 = along(_series(_SINE, s))
    return motion_from_quaternion_derivatives(
        np.concatenate([c, k * p], axis=-1),
        np.concatenate([c1, k1 * p + k * p1], axis=-1),
        np.concatenate([c2, k2 * p + 2 * k1 * p1 + k * p2], axis=-1),
        np.concatenate([c3, k3 * p + 3 * k2 * p1 + 3 * k1 * p2 + k * p3], axis=-1),
    )


# ------------------------------------------------------------------------------- modified Rodrigues parameters


def rodrigues_from_quaternion(q: ArrayLike, *, shortest: bool = True) -> Array:
    """Modified Rodrigues parameters ``sigma = e tan(Phi / 4) = lambda / (1 + lambda_0)`` (..., 3).

    Args:
        q: unit quaternions (..., 4).
        shortest: take the set with ``|sigma| <= 1``; otherwise the one of the sign of ``q`` as given, which is
            infinite at ``lambda_0 = -1``.
    """
    q = np.asarray(q, dtype=float)
    if shortest:
        q = np.where(q[..., :1] < 0, -q, q)
    return q[..., 1:] / (1 + q[..., :1])


def quaternion_from_rodrigues(sigma: ArrayLike) -> Array:
    """``lambda_0 = (1 - s2) / (1 + s2)``, ``lambda = 2 sigma / (1 + s2)`` (..., 4)."""
    sigma = np.asarray(sigma, dtype=float)
    s2 = dot(sigma, sigma)
    return np.concatenate([1 - s2, 2 * sigma], axis=-1) / (1 + s2)


def shadow(sigma: ArrayLike) -> Array:
    """The other set of parameters of the same attitude, ``-sigma / |sigma|^2`` (..., 3)."""
    sigma = np.asarray(sigma, dtype=float)
    return -sigma / dot(sigma, sigma)


def nearer_set(sigma: ArrayLike) -> Array:
    """``sigma``, or its shadow where ``|sigma| > 1`` (..., 3)."""
    sigma = np.asarray(sigma, dtype=float)
    outside = dot(sigma, sigma) > 1
    return np.where(outside, shadow(np.where(outside, sigma, 1.0)), sigma)


def rodrigues_derivatives(sigma: ArrayLike, rate: ArrayLike, acceleration: ArrayLike | None = None,
                          jerk: ArrayLike | None = None) -> tuple[Array, Array, Array]:
    """``sigma', sigma'', sigma'''`` (each (..., 3)) from body rate, acceleration and jerk (zero where not given).

    ``sigma' = B(sigma) w`` with ``B = ((1 - s2) I + 2 [sigma x] + 2 sigma sigma^t) / 4``, differentiated twice.
    """
    s, w = np.asarray(sigma, dtype=float), np.asarray(rate, dtype=float)
    a = np.zeros_like(w) if acceleration is None else np.asarray(acceleration, dtype=float)
    j = np.zeros_like(w) if jerk is None else np.asarray(jerk, dtype=float)
    s, w, a, j = np.broadcast_arrays(s, w, a, j)

    def form(x: Array, y: Array, w: Array) -> Array:
        """Symmetric part in (x, y) of the quadratic part of 4 B."""
        return -dot(x, y) * w + x * dot(y, w) + y * dot(x, w)

    s1 = (w + 2 * cross(s, w) + form(s, s, w)) / 4
    s2 = (a + 2 * cross(s1, w) + 2 * cross(s, a) + 2 * form(s, s1, w) + form(s, s, a)) / 4
    s3 = (j + 2 * cross(s2, w) + 4 * cross(s1, a) + 2 * cross(s, j)
          + 2 * form(s1, s1, w) + 2 * form(s, s2, w) + 4 * form(s, s1, a) + form(s, s, j)) / 4
    return s1, s2, s3


def motion_from_rodrigues(sigma: ArrayLike, sigma1: ArrayLike, sigma2: ArrayLike, sigma3: ArrayLike) -> Motion:
    """Quaternion, body rate, acceleration and jerk from the parameters and their three derivatives (each (..., 3)).

    ``w = B^-1 sigma'`` with ``B^-1 = 16 B^t / (1 + s2)^2``; acceleration and jerk by differentiating ``B w = sigma'``.
    """
    s, s1, s2, s3 = (np.asarray(x, dtype=float) for x in (sigma, sigma1, sigma2, sigma3))

    def form(x: Array, y: Array, w: Array) -> Array:
        return -dot(x, y) * w + x * dot(y, w) + y * dot(x, w)

    square = dot(s, s)

    def inverse(v: Array) -> Array:
        return 4 * ((1 - square) * v - 2 * cross(s, v) + 2 * s * dot(s, v)) / (1 + square) ** 2

    w = inverse(s1)
    a = inverse(s2 - (2 * cross(s1, w) + 2 * form(s, s1, w)) / 4)
    j = inverse(s3 - (2 * cross(s2, w) + 4 * cross(s1, a) + 2 * form(s1, s1, w) + 2 * form(s, s2, w)
                      + 4 * form(s, s1, a)) / 4)
    return Motion(quaternion_from_rodrigues(s), w, a, j)


# ------------------------------------------------------------------------------- orbital frame and angles 312


def inertial_from_orbital(position: ArrayLike, velocity: ArrayLike) -> Array:
    """Quaternion (..., 4) of the orbital frame: y up along the radius, x along the track, z against the orbit normal.

    Args:
        position: inertial (..., 3), m.
        velocity: inertial (..., 3), m/s.

    With x forward and y up a right-handed frame has z = x cross y, opposite to position cross velocity.
    """
    r, v = np.asarray(position, dtype=float), np.asarray(velocity, dtype=float)
    y = r / norm(r)[..., None]
    z = cross(v, r)
    z = z / norm(z)[..., None]
    matrix = np.stack([cross(y, z), y, z], axis=-1)
    q = Rotation.from_matrix(matrix.reshape(-1, 3, 3)).as_quat(scalar_first=True).reshape((*matrix.shape[:-2], 4))
    return sign_continuous(q) if q.ndim == 2 else q


def angles_312(orbital_from_body: ArrayLike) -> Array:
    """Roll phi1 (about x), yaw phi2 (about y), pitch phi3 (about z) of the sequence 312 (..., 3), rad.

    ``orbital_from_body = about_z(phi3) o about_x(phi1) o about_y(phi2)``; singular at a roll of a quarter turn.
    """
    q = np.asarray(orbital_from_body, dtype=float)
    w, x, y, z = (q[..., i] for i in range(4))
    roll = np.arcsin(np.clip(2 * (y * z + w * x), -1, 1))
    yaw = np.arctan2(2 * (w * y - x * z), 1 - 2 * (x * x + y * y))
    pitch = np.arctan2(2 * (w * z - x * y), 1 - 2 * (x * x + z * z))
    return np.stack([roll, yaw, pitch], axis=-1)


def quaternion_from_angles_312(angles: ArrayLike) -> Array:
    """``orbital_from_body`` (..., 4) of roll, yaw, pitch (..., 3), rad: the inverse of :func:`angles_312`."""
    half = np.asarray(angles, dtype=float) / 2
    c, s, zero = np.cos(half), np.sin(half), np.zeros_like(half[..., 0])
    about_x = np.stack([c[..., 0], s[..., 0], zero, zero], axis=-1)
    about_y = np.stack([c[..., 1], zero, s[..., 1], zero], axis=-1)
    about_z = np.stack([c[..., 2], zero, zero, s[..., 2]], axis=-1)
    return product(about_z, product(about_x, about_y))
