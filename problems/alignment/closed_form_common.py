"""Formulas of Likhansky and Alekseev that hold as printed; both variants of the closed form use them.

S. G. Likhansky, S. B. Alekseev, "Alignment of a spacecraft and the complex of its on-board systems from large samples
of navigation data and radar measurements" (in Russian); equation numbers are the article's.

The article conjugates the other way round than this product: its number ``Q`` acts as ``v_s = Q* v_a Q`` (12), so that

- its ``Q_A/S`` of (11), (12), (18) is ``antenna_from_tracker`` here: ``v_antenna = Q v_tracker Q*``;
- its ``S(t)`` of (5) is ``tracker_from_inertial`` and its ``O(t)`` of (6) is ``inertial_from_earth_fixed``;
- its ``Q_I/S`` of (40) is ``principal_from_tracker`` and its ``Q_U/I`` of (47) is ``actuator_from_principal``.

Quaternions are scalar-first Hamilton. Vectors are imaginary quaternions where the article writes them so.
"""

from __future__ import annotations

import numpy as np
from scipy.constants import speed_of_light

from estimator.models.errors import GeometryError

COPLANAR = 1e-6  # |det| of three unit vectors below which they span no space


def multiply(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Hamilton product (..., 4) of quaternion arrays (..., 4)."""
    a, b, c, d = np.moveaxis(np.asarray(p, dtype=float), -1, 0)
    w, x, y, z = np.moveaxis(np.asarray(q, dtype=float), -1, 0)
    return np.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ],
        axis=-1,
    )


def conjugate(q: np.ndarray) -> np.ndarray:
    """Conjugate (..., 4)."""
    return np.asarray(q, dtype=float) * np.array([1.0, -1.0, -1.0, -1.0])


def imaginary(v: np.ndarray) -> np.ndarray:
    """The vectors (..., 3) as quaternions (..., 4) without scalar part."""
    v = np.asarray(v, dtype=float)
    return np.concatenate([np.zeros((*v.shape[:-1], 1)), v], axis=-1)


def conjugated(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """``q* v q`` (..., 3), the article's way to change axes: (3) to (5), (7), (8), (12)."""
    return multiply(multiply(conjugate(q), imaginary(v)), q)[..., 1:]


def rotated(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """``q v q*`` (..., 3), the inverse of :func:`conjugated`: (13), (36), (45)."""
    return multiply(multiply(q, imaginary(v)), conjugate(q))[..., 1:]


def matrix_of_conjugation(q: np.ndarray) -> np.ndarray:
    """(42): the matrix (3, 3) with ``matrix @ v == q* v q``; the transpose of the usual rotation matrix of ``q``."""
    w, x, y, z = np.asarray(q, dtype=float)
    u = np.array([x, y, z])
    cross = np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])
    return (2 * w * w - 1) * np.eye(3) + 2 * w * cross + 2 * np.outer(u, u)


def velocity_from_three_beams(
    direction: np.ndarray, frequency_shift: np.ndarray, carrier_frequency: float
) -> np.ndarray:
    """(2): velocity (n, 3) m/s in the axes of the beams, by quaternion products.

    ``v = -(c / 2f) Im(sum F_i n_j n_k) / Re(n_1 n_2 n_3)`` over cyclic i, j, k: the solution of (1). Right as printed:
    ``Re(n_1 n_2 n_3)`` is minus the determinant, and the two signs cancel.

    Args:
        direction: (3, 3), or (n, 3, 3) where it varies; row p is the unit vector of beam p.
        frequency_shift: (n, 3) Hz, positive when approaching along the beam.
        carrier_frequency: Hz.

    Raises:
        GeometryError: the three beams lie in a plane.
    """
    shift = np.asarray(frequency_shift, dtype=float)
    beams = np.broadcast_to(np.asarray(direction, dtype=float), (len(shift), 3, 3))
    n = [imaginary(beams[:, p]) for p in range(3)]
    scalar = multiply(multiply(n[0], n[1]), n[2])[:, 0]
    if np.any(np.abs(scalar) < COPLANAR):
        raise GeometryError(
            "the three beams lie in a plane and do not determine the velocity",
            where="doppler/beam_direction",
            value=f"|determinant| {np.min(np.abs(scalar)):.1e}",
            limit=f"{COPLANAR:.0e}",
            remedy="give three beams that span space, or use the joint estimate",
        )
    total = sum(shift[:, i, None] * multiply(n[j], n[k])[:, 1:] for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)))
    return np.asarray(-0.5 * speed_of_light / carrier_frequency * total / scalar[:, None])


def inertial_from_earth_fixed(time: np.ndarray, rate: float, angle_at_zero: float = 0.0) -> np.ndarray:
    """(6): ``O(t) = exp(k (angle_at_zero + rate t) / 2)`` (n, 4); (7) is ``v_earth_fixed = O* v_inertial O``.

    A pure change of axes. It does not turn an inertial velocity into one relative to the Earth: ``omega x r`` has to be
    taken off first (up to 516 m/s or 3.9 degrees in a low orbit) unless the velocity was derived from Earth-fixed
    positions, as in (24).
    """
    half = 0.5 * (angle_at_zero + rate * np.asarray(time, dtype=float))
    return np.stack([np.cos(half), np.zeros_like(half), np.zeros_like(half), np.sin(half)], axis=-1)


def velocity_in_tracker(velocity: np.ndarray, attitude: np.ndarray, earth: np.ndarray) -> np.ndarray:
    """(13): Earth-fixed velocity (n, 3) in tracker axes, ``S O v O* S*``.

    Args:
        velocity: (n, 3) m/s, Earth-fixed.
        attitude: (n, 4) ``S = tracker_from_inertial``.
        earth: (n, 4) ``O = inertial_from_earth_fixed``.
    """
    return rotated(multiply(attitude, earth), velocity)


def chain(antenna: np.ndarray, error: np.ndarray, tracker: np.ndarray) -> np.ndarray:
    """(11): ``Q_A/S = Q_A q_A/S Q_S*`` (4,), the antenna's orientation with its unknown error."""
    return multiply(multiply(antenna, error), conjugate(tracker))


def mounting_error(antenna: np.ndarray, total: np.ndarray, tracker: np.ndarray) -> np.ndarray:
    """(19): ``q_A/S = Q_A* Q_A/S Q_S`` (4,), the error itself."""
    return multiply(multiply(conjugate(antenna), total), tracker)


def chosen_instants(v_tracker: np.ndarray, v_antenna: np.ndarray, most: int = 1500) -> tuple[int, int]:
    """The two instants of section 2: the differences of the two velocities most nearly at right angles.

    Only instants where the difference is at least a quarter of the largest one over all times take part (the article
    prints the maximum over i for that over t).

    Args:
        v_tracker, v_antenna: (n, 3) m/s, the same velocity in tracker and in antenna axes.
        most: instants compared; of more, every second, third ... is taken.

    Raises:
        GeometryError: fewer than two usable instants, or all differences on one line.
    """
    difference = np.asarray(v_tracker) - np.asarray(v_antenna)
    size = np.linalg.norm(difference, axis=1)
    usable = np.flatnonzero(size >= 0.25 * np.max(size))
    usable = usable[:: int(np.ceil(len(usable) / most))]
    unit = difference[usable] / np.maximum(size[usable, None], 1e-300)
    cosine = np.abs(unit @ unit.T)
    first, second = np.unravel_index(int(np.argmin(cosine)), cosine.shape)
    sine = float(np.linalg.norm(np.cross(unit[first], unit[second])))
    if len(usable) < 2 or sine < 1e-9:
        raise GeometryError(
            "no two instants have velocity differences in different directions",
            where="doppler",
            value=f"largest sine {sine:.1e}",
            limit="1e-9",
            remedy="turn the spacecraft between Doppler sessions so that the velocity moves in its axes",
        )
    return int(usable[first]), int(usable[second])


def basis_change(antenna_from_tracker: np.ndarray) -> np.ndarray:
    """Section 2: a turn P (4,) of the antenna axes after which the geometric method is well conditioned.

    The article asks for ``|Im| >= 0.2`` and ``Re >= sqrt(2)/2`` of the design value and otherwise varies the antenna's
    basis. P is 1 where both hold; else ``P antenna_from_tracker`` turns by 60 degrees about the same axis. The result
    for the new axes is brought back with ``antenna_from_tracker = P* Q``.
    """
    q = np.asarray(antenna_from_tracker, dtype=float)
    q = q if q[0] >= 0 else -q
    size = float(np.linalg.norm(q[1:]))
    if size >= 0.2 and q[0] >= np.sqrt(0.5):
        return np.array([1.0, 0.0, 0.0, 0.0])
    axis = q[1:] / size if size > 1e-9 else np.ones(3) / np.sqrt(3)
    wanted = np.concatenate([[np.cos(np.pi / 6)], np.sin(np.pi / 6) * axis])
    return multiply(wanted, conjugate(q))


def rotation_axis(v_tracker: np.ndarray, v_antenna: np.ndarray) -> np.ndarray:
    """(15): unit axis (3,) of the rotation from the velocities (2, 3) in both axes; its sign is free.

    Undefined where the differences are collinear.
    """
    p = np.cross(v_tracker[0] - v_antenna[0], v_tracker[1] - v_antenna[1])
    return np.asarray(p / np.linalg.norm(p))


def perpendicular_pair(v_tracker: np.ndarray, v_antenna: np.ndarray, axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(16): unit vectors e (from antenna axes) and e_Q (from tracker axes) at right angles to the axis, each (3,).

    Undefined where the velocity at the first instant lies along the axis.
    """
    e, turned = np.cross(v_antenna, axis), np.cross(v_tracker, axis)
    return e / np.linalg.norm(e), turned / np.linalg.norm(turned)


def quaternion_about(axis: np.ndarray, angle: float) -> np.ndarray:
    """(18): ``cos(angle/2) + sin(angle/2) axis`` (4,)."""
    return np.concatenate([[np.cos(0.5 * angle)], np.sin(0.5 * angle) * np.asarray(axis)])


def energy_rows(rate: np.ndarray) -> np.ndarray:
    """(28): the rows (n, 6) of ``omega' G omega = 1`` in (g11, g22, g33, g12, g23, g31); rates (n, 3) rad/s.

    (26) prints ``2 J13 w1 w3 + 2 J31 w3 w1`` for ``2 J23 w2 w3 + 2 J31 w3 w1``; (28) is right. The unit of g is s2 and
    not 1/m2.
    """
    a, b, c = np.asarray(rate, dtype=float).T
    return np.stack([a * a, b * b, c * c, 2 * a * b, 2 * b * c, 2 * c * a], axis=-1)


def symmetric(entries: np.ndarray) -> np.ndarray:
    """(29): the matrix (3, 3) of (g11, g22, g33, g12, g23, g31)."""
    a, b, c, d, e, f = entries
    return np.array([[a, d, f], [d, b, e], [f, e, c]])


def traceless(tensor: np.ndarray) -> np.ndarray:
    """(30): ``G0 = G - (Tr G / 3) 1`` (3, 3)."""
    return np.asarray(tensor - np.trace(tensor) / 3 * np.eye(3))


def cubic_linear_coefficient(tensor: np.ndarray) -> float:
    """(32), first half: ``a`` of ``lambda^3 - a lambda = b`` for a traceless symmetric tensor."""
    return float(0.5 * np.sum(np.diag(tensor) ** 2) + tensor[0, 1] ** 2 + tensor[1, 2] ** 2 + tensor[2, 0] ** 2)


def euler_torque(moments: np.ndarray, rate: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
    """(44): torque (n, 3) over 2H in principal axes from the principal moments over 2H.

    Args:
        moments: (3,) over 2H, s2, or over any other constant.
        rate, acceleration: (n, 3) rad/s and rad/s2, principal axes.

    ``n_i = G_i w_i' + (G_k - G_j) w_j w_k`` for cyclic i, j, k. H is the energy of the *free* arc that gave the
    moments. Momentum wheels and the gravity gradient are not in it.
    """
    g = np.asarray(moments, dtype=float)
    w, dw = np.asarray(rate, dtype=float), np.asarray(acceleration, dtype=float)
    columns = [g[i] * dw[:, i] + (g[k] - g[j]) * w[:, j] * w[:, k] for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1))]
    return np.stack(columns, axis=-1)


def normalized_columns(torques: np.ndarray) -> np.ndarray:
    """(46): the torques (3, 3) of the three pulses, one in each column, divided by their lengths.

    The torques are those of (44), in principal axes; the article prints the superscript of the tracker axes, with which
    the result would already be the orientation against the tracker.
    """
    torques = np.asarray(torques, dtype=float)
    return np.asarray(torques / np.linalg.norm(torques, axis=0))
