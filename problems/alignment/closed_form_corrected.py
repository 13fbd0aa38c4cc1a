"""The closed form of Likhansky and Alekseev with its errors put right.

Only what differs from the print is here; formulas that hold as printed are in
:mod:`problems.alignment.closed_form_common`, the printed forms of those below in
:mod:`problems.alignment.closed_form_literal`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.constants import speed_of_light
from scipy.linalg import qr
from scipy.spatial.transform import Rotation

from problems.alignment.closed_form_common import cubic_linear_coefficient, energy_rows, symmetric

FRAME_TOLERANCE = 1e-12  # singular values of the Fourier frame below this share of the largest carry no information


def closing_speed(frequency_shift: np.ndarray, carrier_frequency: float) -> np.ndarray:
    """(1) with all orders: speed along the beam ``c F / (2 f + F)`` m/s of a two-way shift ``2 f beta / (1 - beta)``.

    Campaign files define their shifts to first order, for which the printed form is exact; this one is for shifts as a
    radar measures them.
    """
    shift = np.asarray(frequency_shift, dtype=float)
    return np.asarray(speed_of_light * shift / (2 * carrier_frequency + shift))


def rotation_angle(e: np.ndarray, turned: np.ndarray, axis: np.ndarray) -> float:
    """(17) corrected: ``alpha = atan2(-m . (e x e_Q), e . e_Q)``, rad, for any angle and smooth at zero.

    For a positive angle the triple e, e_Q, m is left-handed, not right-handed as the text says.
    """
    return float(np.arctan2(-np.dot(axis, np.cross(e, turned)), np.dot(e, turned)))


# --- section 3: trajectory -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FourierFit:
    """Least squares in the frame ``1, cos(pi d t/T), sin(pi d t/T)``, d = 1 .. degree, on one arc.

    Attributes:
        middle: s, where the phases count from.
        span: T, s.
        degree: D.
        coefficients: (2 D + 1, c), ordered 1, cosines, sines.
        root: (2 D + 1, rank) R, with R R' the covariance of the coefficients of one column for unit noise. The product
            itself would lose all digits: its entries are up to 1e24 times the variance of the fit.
        rank: number of directions that the data determine.
    """

    middle: float
    span: float
    degree: int
    coefficients: np.ndarray
    root: np.ndarray
    rank: int

    def values(self, time: np.ndarray, derivative: int = 0) -> np.ndarray:
        """(23) and (24) corrected, with higher derivatives: (n, c) at the times (n) s.

        The derivative of (24) with its right sign: ``v = -2 sum k d Im(c_d omega_d)``.
        """
        return frame(np.asarray(time) - self.middle, self.span, self.degree, derivative) @ self.coefficients

    def standard_deviation(self, time: np.ndarray, sigma: float, derivative: int = 0) -> np.ndarray:
        """(21) and (25) corrected: standard deviation (n,) of each column for white noise ``sigma``.

        ``sigma^2 diag(B (A'A)^+ B')`` with the frame or its derivative in B. It shows the ends of the arc, several
        times worse than its middle, which (21) and (25) hide. Truncation is not in it.
        """
        rows = frame(np.asarray(time) - self.middle, self.span, self.degree, derivative)
        return np.asarray(sigma * np.linalg.norm(rows @ self.root, axis=1))


def frame(time: np.ndarray, span: float, degree: int, derivative: int = 0) -> np.ndarray:
    """The frame of (20) in real form (n, 2 D + 1), or a derivative, at times (n) s from the middle of the arc."""
    k = np.pi / span * np.arange(1, degree + 1)
    # Each differentiation turns the phase by a quarter and multiplies by the frequency.
    phase = np.multiply.outer(np.asarray(time, dtype=float), k) + 0.5 * np.pi * derivative
    constant = np.full((len(time), 1), 1.0 if derivative == 0 else 0.0)
    return np.concatenate([constant, k**derivative * np.cos(phase), k**derivative * np.sin(phase)], axis=1)


def fourier_fit(time: np.ndarray, values: np.ndarray, degree: int, span: float | None = None) -> FourierFit:
    """(20) to (22) corrected: truncated least squares instead of a projection.

    Args:
        time: (n,) s, any sampling.
        values: (n, c).
        degree: D.
        span: length T of the arc, s; the default is what the times cover.
    """
    time, values = np.asarray(time, dtype=float), np.asarray(values, dtype=float)
    middle = 0.5 * (float(time[0]) + float(time[-1]))
    span = float(time[-1] - time[0]) if span is None else span
    u, s, vt = np.linalg.svd(frame(time - middle, span, degree), full_matrices=False)
    keep = s > FRAME_TOLERANCE * s[0]
    inverse = vt[keep].T / s[keep]
    return FourierFit(middle, span, degree, inverse @ (u[:, keep].T @ values), inverse, int(np.sum(keep)))


def residuals_by_degree(time: np.ndarray, values: np.ndarray, most: int, span: float | None = None) -> np.ndarray:
    """Sum of squared residuals (most + 1, c) of the least-squares fits of degree 0, 1, ..., from one factorisation.

    The columns are ordered by degree, so that the fit of degree D uses the first 2 D + 1 of them. Applied to a modelled
    trajectory it is N times the square of the article's ``delta(T, D)``; applied to data it serves to choose D.
    """
    time, values = np.asarray(time, dtype=float), np.asarray(values, dtype=float)
    span = float(time[-1] - time[0]) if span is None else span
    columns = frame(time - 0.5 * (time[0] + time[-1]), span, most)
    order = np.concatenate([[0], np.stack([np.arange(1, most + 1), np.arange(most + 1, 2 * most + 1)], axis=1).ravel()])
    q, _ = qr(columns[:, order], mode="economic")
    # Residuals by subtraction, column after column: differences of large sums of squares would lose them.
    left = values.copy()
    result = np.empty((most + 1, values.shape[1]))
    for degree in range(most + 1):
        part = q[:, :1] if degree == 0 else q[:, 2 * degree - 1 : 2 * degree + 1]
        left = left - part @ (part.T @ left)
        result[degree] = np.sum(left * left, axis=0)
    return result


def numerical_rank(degree: np.ndarray) -> np.ndarray:
    """Directions of the frame of degree D that double precision can tell apart: all 2 D + 1 of them, or D + 25."""
    return np.minimum(2 * np.asarray(degree) + 1, np.asarray(degree) + 25)


def position_deviation(truncation: np.ndarray, degree: np.ndarray, sigma: float, count: int) -> np.ndarray:
    """(21) corrected: ``sqrt(delta^2 + sigma^2 rank(D)/N)`` m, the numerical rank in place of 2 D + 1."""
    return np.asarray(np.sqrt(np.asarray(truncation) ** 2 + sigma**2 * numerical_rank(degree) / count))


def optimal_degree(truncation: np.ndarray, sigma: float, count: int) -> int:
    """Section 3.2 with (21) corrected: the degree at which the deviation is least, tried one by one."""
    return int(np.argmin(position_deviation(truncation, np.arange(len(truncation)), sigma, count)))


def velocity_deviation(truncation: float, degree: int, span: float, sigma: float, count: int) -> float:
    """(25) corrected: ``sqrt(delta1^2 + (2 k^2 sigma^2/N) sum d^2)`` m/s, for an orthonormal basis, k = 2 pi/T.

    For the frame of frequency pi/T, :meth:`FourierFit.standard_deviation` is the exact expression.
    """
    squares = degree * (degree + 1) * (2 * degree + 1) / 6
    return float(np.sqrt(truncation**2 + 2 * (2 * np.pi / span) ** 2 * sigma**2 * squares / count))


# --- section 4: inertia ----------------------------------------------------------------------------------------------


def rate_from_difference(orientation: np.ndarray, step: float) -> np.ndarray:
    """(27) corrected: rates (n - 1, 3) rad/s at the middle of each step, ``log(S_k' S_k+1) / dt``.

    The matrices (n, 3, 3) are ``inertial_from_tracker``; the rate is in tracker axes.
    """
    s = np.asarray(orientation, dtype=float)
    return np.asarray(Rotation.from_matrix(np.swapaxes(s[:-1], 1, 2) @ s[1:]).as_rotvec() / step)


def rate_matrix(orientation: np.ndarray, derivative: np.ndarray) -> np.ndarray:
    """After (27), corrected: the skew part of ``S_F* S_F'`` (n, 3, 3)."""
    product = np.swapaxes(orientation, 1, 2) @ derivative
    return 0.5 * (product - np.swapaxes(product, 1, 2))


def acceleration_matrix(orientation: np.ndarray, derivative: np.ndarray, second: np.ndarray) -> np.ndarray:
    """After (27), corrected: the skew part of ``S'* S' + S* S''`` (n, 3, 3)."""
    product = np.swapaxes(derivative, 1, 2) @ derivative + np.swapaxes(orientation, 1, 2) @ second
    return 0.5 * (product - np.swapaxes(product, 1, 2))


def vector_of_skew(matrix: np.ndarray) -> np.ndarray:
    """The vectors (n, 3) of the skew matrices (n, 3, 3) of (27)."""
    return np.stack([matrix[:, 2, 1], matrix[:, 0, 2], matrix[:, 1, 0]], axis=-1)


@dataclass(frozen=True)
class EnergyFamily:
    """All tensors that keep the energy of one arc: ``particular + s * direction`` for every s (3, 3), s2.

    ``singular_values`` (6,) of (28), largest first, for rows divided by the mean square rate.
    """

    particular: np.ndarray
    direction: np.ndarray
    singular_values: np.ndarray


def inertia_over_energy(rate: np.ndarray) -> EnergyFamily:
    """(28), (29) corrected: what the constancy of energy does determine, a line of tensors and not one.

    The direction left open is ``L^2 J - 2H J^2``. Use :func:`inertia_from_momentum` or :func:`inertia_from_euler` for
    the tensor.
    """
    rows = energy_rows(rate)
    size = float(np.mean(np.sum(np.asarray(rate) ** 2, axis=1)))
    u, s, vt = np.linalg.svd(rows / size, full_matrices=False)
    particular = vt[:5].T @ ((u[:, :5].T @ np.ones(len(rows))) / s[:5]) / size
    return EnergyFamily(symmetric(particular), symmetric(vt[5]), s)


def _times_vector(vector: np.ndarray) -> np.ndarray:
    """Matrices (n, 3, 6) with ``matrix @ (j11, j22, j33, j12, j23, j31) == J vector``."""
    x, y, z = np.asarray(vector, dtype=float).T
    zero = np.zeros_like(x)
    return np.stack(
        [
            np.stack([x, zero, zero, y, zero, z], axis=-1),
            np.stack([zero, y, zero, x, z, zero], axis=-1),
            np.stack([zero, zero, z, zero, y, x], axis=-1),
        ],
        axis=-2,
    )


@dataclass(frozen=True)
class LinearInertia:
    """Inertia tensor up to scale from a homogeneous linear system.

    Attributes:
        tensor: (3, 3), trace 1.
        singular_values: of the system (after elimination of other unknowns), largest first; the last belongs to the
            tensor, and a small last but one means that more than the scale is open.
    """

    tensor: np.ndarray
    singular_values: np.ndarray


def inertia_from_euler(rate: np.ndarray, acceleration: np.ndarray) -> LinearInertia:
    """In place of (28): Euler's equations ``J w' + w x J w = 0`` as a homogeneous system; determines J up to scale.

    Args:
        rate, acceleration: (n, 3) rad/s and rad/s2, tracker axes, of one or more free arcs.
    """
    size = float(np.sqrt(np.mean(np.sum(np.asarray(rate) ** 2, axis=1))))
    w = np.asarray(rate) / size
    cross = np.zeros((len(w), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -w[:, 2], w[:, 1], -w[:, 0]
    cross = cross - np.swapaxes(cross, 1, 2)
    rows = _times_vector(np.asarray(acceleration) / size**2) + cross @ _times_vector(w)
    return _smallest(rows.reshape(-1, 6))


def inertia_from_momentum(rate: list[np.ndarray], orientation: list[np.ndarray]) -> LinearInertia:
    """In place of (28): ``S(t) J w(t) = L`` with one unknown L for each free arc; determines J up to scale on one arc.

    Eliminating L leaves the deviations of ``S J w`` from its mean over the arc.

    Args:
        rate: for each arc (n, 3) rad/s, tracker axes.
        orientation: for each arc (n, 3, 3) ``inertial_from_tracker``.
    """
    blocks = []
    for w, s in zip(rate, orientation, strict=True):
        size = float(np.sqrt(np.mean(np.sum(np.asarray(w) ** 2, axis=1))))
        rows = s @ _times_vector(np.asarray(w) / size)
        blocks.append((rows - np.mean(rows, axis=0)).reshape(-1, 6))
    return _smallest(np.concatenate(blocks))


def _smallest(rows: np.ndarray) -> LinearInertia:
    """The right singular vector of the least singular value as a tensor of trace 1."""
    _, s, vt = np.linalg.svd(rows, full_matrices=False)
    tensor = symmetric(vt[-1])
    return LinearInertia(tensor / np.trace(tensor), s / np.sqrt(len(rows)))


def cubic_constant(tensor: np.ndarray) -> float:
    """(32) corrected: ``b = -Re(g1 g2 g3) = det G0``."""
    g = np.asarray(tensor, dtype=float)
    return float(np.dot(g[:, 0], np.cross(g[:, 1], g[:, 2])))


def largest_root(a: float, b: float) -> float:
    """(33) corrected: ``2 sqrt(a/3) cos(arccos((b/2) sqrt(27/a^3)) / 3)``; b keeps its sign."""
    if a <= 0:
        return 0.0
    argument = float(np.clip(0.5 * b * np.sqrt(27 / a**3), -1.0, 1.0))
    return float(2 * np.sqrt(a / 3) * np.cos(np.arccos(argument) / 3))


def other_roots(largest: float, b: float) -> tuple[float, float]:
    """(37) corrected: ``(-lambda +- sqrt(lambda^2 - 4 b / lambda)) / 2`` with b = det G0, lambda the largest root."""
    if largest == 0:
        return 0.0, 0.0
    root = float(np.sqrt(max(largest**2 - 4 * b / largest, 0.0)))
    return 0.5 * (-largest + root), 0.5 * (-largest - root)


def principal_moments(tensor: np.ndarray) -> np.ndarray:
    """(30) to (34) and (37) corrected: the principal moments (3,), largest first."""
    mean = np.trace(tensor) / 3
    centred = tensor - mean * np.eye(3)
    b = cubic_constant(centred)
    first = largest_root(cubic_linear_coefficient(centred), b)
    return np.array([first, *other_roots(first, b)]) + mean


def principal_axis(tensor: np.ndarray, root: float) -> np.ndarray:
    """(35), (38) corrected: unit vector (3,) along the longest of the three column products of ``G0 - lambda 1``."""
    shifted = tensor - root * np.eye(3)
    products = np.cross(shifted.T, np.roll(shifted.T, -1, axis=0))
    sizes = np.linalg.norm(products, axis=1)
    best = int(np.argmax(sizes))
    return np.asarray(products[best] / sizes[best]) if sizes[best] > 0 else np.full(3, np.nan)


def principal_axes(tensor: np.ndarray, design_axes: np.ndarray | None = None) -> np.ndarray:
    """(39) corrected: matrix (3, 3) with the principal axes in its columns, largest moment first, right-handed.

    Of the four sets of signs the one nearest to ``design_axes`` (3, 3) is taken, else the one nearest to the tracker
    axes. The first and third axes follow from (35) and (38), the second from the product; where two moments coincide
    their axes are arbitrary.
    """
    centred = tensor - np.trace(tensor) / 3 * np.eye(3)
    roots = principal_moments(tensor) - np.trace(tensor) / 3
    # The two axes whose roots are further apart from the middle one are the safer ones to compute.
    if roots[0] - roots[1] >= roots[1] - roots[2]:
        m1 = principal_axis(centred, roots[0])
        m2 = principal_axis(centred, roots[1]) if roots[1] - roots[2] > 1e-12 * abs(roots[0]) else _any_normal(m1)
        m2 = m2 - m1 * np.dot(m1, m2)
        m2 = m2 / np.linalg.norm(m2)
        m3 = np.cross(m1, m2)
    else:
        m3 = principal_axis(centred, roots[2])
        m2 = principal_axis(centred, roots[1]) if roots[0] - roots[1] > 1e-12 * abs(roots[0]) else _any_normal(m3)
        m2 = m2 - m3 * np.dot(m3, m2)
        m2 = m2 / np.linalg.norm(m2)
        m1 = np.cross(m2, m3)
    axes = np.stack([m1, m2, m3], axis=1)
    reference = np.eye(3) if design_axes is None else design_axes
    signs = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    return np.asarray(axes * signs[int(np.argmax([np.sum(reference * axes * s) for s in signs]))])


def _any_normal(vector: np.ndarray) -> np.ndarray:
    """Some unit vector at right angles to a unit vector."""
    other = np.cross(vector, np.eye(3)[int(np.argmin(np.abs(vector)))])
    return np.asarray(other / np.linalg.norm(other))


def quaternion_of_matrix(matrix: np.ndarray) -> np.ndarray:
    """(41), (48) corrected: the unit quaternion (4,) with ``matrix v = q* v q``, scalar part not negative.

    The printed division by ``q0`` fails at half a turn; the largest component is used instead (SciPy's choice).
    """
    return np.asarray(Rotation.from_matrix(np.asarray(matrix).T).as_quat(canonical=True, scalar_first=True))


# --- section 5: actuators --------------------------------------------------------------------------------------------


def torque_map(torques: np.ndarray, commands: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """In place of (46): the matrix B (3, 3) with ``torque = B command`` by least squares over all pulses.

    Args:
        torques: (n, 3) mean torque of each segment, over any constant, in the axes wanted.
        commands: (n, 3) N m, actuator axes; on one axis or several at once.

    Returns:
        The matrix, and the singular values (3,) of the commands, largest first.
    """
    singular = np.linalg.svd(commands, compute_uv=False)
    return np.linalg.lstsq(commands, torques, rcond=None)[0].T, np.concatenate([singular, np.zeros(3 - len(singular))])


def nearest_rotation(matrix: np.ndarray) -> tuple[np.ndarray, bool]:
    """In place of (48) on a matrix that noise made oblique: the nearest rotation (polar decomposition).

    Returns:
        The rotation (3, 3), and whether the matrix was right-handed; a left-handed one means a reversed command.
    """
    u, _, vt = np.linalg.svd(matrix)
    sign = float(np.sign(np.linalg.det(u) * np.linalg.det(vt)))
    return np.asarray(u @ np.diag([1.0, 1.0, sign]) @ vt), sign > 0
