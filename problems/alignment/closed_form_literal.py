"""The closed form of Likhansky and Alekseev as printed, where the print is wrong; kept to show what it gives.

Formulas that hold as printed are in :mod:`problems.alignment.closed_form_common`; the right ones for those below in
:mod:`problems.alignment.closed_form_corrected`. Each function says what is wrong with it.
"""

from __future__ import annotations

import numpy as np
from scipy.constants import speed_of_light

from problems.alignment.closed_form_common import energy_rows, imaginary, multiply, symmetric


def closing_speed(frequency_shift: np.ndarray, carrier_frequency: float) -> np.ndarray:
    """(1): speed along the beam, ``(c / 2f) F`` m/s for a shift F in Hz.

    First order only: the two-way shift is ``2 f beta / (1 - beta)``, and the term left out amounts to 0.05, 0.85,
    5.3 Hz for 0.5, 2, 5 km/s along the beam at 9.6 GHz. Campaign files hold shifts of first order by definition.
    """
    return np.asarray(0.5 * speed_of_light / carrier_frequency * np.asarray(frequency_shift, dtype=float))


def rotation_angle(e: np.ndarray, turned: np.ndarray, axis: np.ndarray) -> float:
    """(17): ``alpha = 2 arcsin |e x e_Q| sign(-m . (e x e_Q))``, rad.

    Wrong: the sine of the angle itself is ``|e x e_Q|``, so the factor 2 doubles the angle and the result is off by the
    angle itself; beyond 90 degrees the arcsine folds. At zero it is 0/0, given here as 0.
    """
    product = np.cross(e, turned)
    size = min(1.0, float(np.linalg.norm(product)))
    if size == 0.0:
        return 0.0
    return float(2 * np.arcsin(size) * np.sign(-np.dot(axis, product)))


# --- section 3: trajectory -------------------------------------------------------------------------------------------


def basis_function(degree: int | np.ndarray, time: np.ndarray, span: float) -> np.ndarray:
    """Section 3.1: ``sqrt(1/T) exp(j (pi/T) d t)`` (n,) or (n, d), time counted from the middle of the span T (s).

    Said to be orthonormal on the span. The period is 2T: it is a tight frame with bound 2, and the inner product of two
    functions is ``sin(pi k/2)/(pi k/2)`` for the difference k of their degrees.
    """
    return np.asarray(
        np.exp(1j * np.pi / span * np.multiply.outer(np.asarray(time, dtype=float), degree)) / np.sqrt(span)
    )


def projection_coefficients(position: np.ndarray, span: float, degree: int) -> np.ndarray:
    """(22): complex coefficients (degree + 1, 3) for d = 0 .. degree of N + 1 positions (N + 1, 3) m, evenly spaced.

    ``c_d = sum Theta_n conj(omega_d(n dt)) dt`` with dt = T/N over all N + 1 nodes. Wrong twice: the functions are no
    orthonormal basis, so a projection is not the least-squares fit; and both end nodes have full weight.
    """
    position = np.asarray(position, dtype=float)
    count = len(position) - 1
    # At the nodes the conjugate function is exp(-2 pi j d n / 2N) exp(j pi d / 2): a Fourier transform of length 2N.
    transform = np.fft.rfft(position, n=2 * count, axis=0)[: degree + 1]
    quarter_turns = np.exp(0.5j * np.pi * np.arange(degree + 1))
    return np.asarray(transform * quarter_turns[:, None] * (span / count) / np.sqrt(span))


def projected_position(coefficients: np.ndarray, span: float, time: np.ndarray) -> np.ndarray:
    """(23): position (n, 3) m at times (n) s from the middle of the span.

    Gives twice the trajectory inside the span and once the trajectory at its ends.
    """
    c = np.asarray(coefficients)
    basis = basis_function(np.arange(1, len(c)), time, span)
    return np.asarray(c[0].real / np.sqrt(span) + 2 * np.real(basis @ c[1:]))


def projected_velocity(coefficients: np.ndarray, span: float, time: np.ndarray) -> np.ndarray:
    """(24): velocity (n, 3) m/s, ``+2 sum (pi/T) d Im(c_d omega_d)``.

    Wrong sign: the derivative of ``Re(c exp(jkdt))`` is ``-k d Im(c exp(jkdt))``; with (22) it is minus twice the
    velocity.
    """
    c = np.asarray(coefficients)
    d = np.arange(1, len(c))
    basis = basis_function(d, time, span)
    return np.asarray(2 * np.imag(basis @ (np.pi / span * d[:, None] * c[1:])))


def position_deviation(truncation: np.ndarray, degree: np.ndarray, sigma: float, count: int) -> np.ndarray:
    """(21): ``sqrt(delta^2(T, D) + sigma^2 (2D + 1)/N)`` m for truncation errors delta (d,) m at the degrees (d,).

    Holds for a full-rank fit, as a mean over the arc and for each coordinate. The frame has a numerical rank of about
    D + 20 to 40 instead of 2D + 1.
    """
    return np.asarray(np.sqrt(np.asarray(truncation) ** 2 + sigma**2 * (2 * np.asarray(degree) + 1) / count))


def optimal_degree(truncation: np.ndarray, sigma: float, count: int) -> int:
    """Section 3.2: the degree at which (21) is least, tried one by one; ``truncation`` (d,) m for D = 0, 1, ..."""
    return int(np.argmin(position_deviation(truncation, np.arange(len(truncation)), sigma, count)))


def velocity_deviation(truncation: float, degree: int, span: float, sigma: float, count: int) -> float:
    """(25): ``sqrt(delta1^2 + 2 pi^2/T^2 sum d^2 sigma^2 (2D + 1)/N)`` m/s.

    Wrong: the factor 2D + 1 is one too many, since the sum over d already counts the coefficients; and the variance of
    a coefficient is that of an orthonormal basis, which this is not.
    """
    squares = degree * (degree + 1) * (2 * degree + 1) / 6
    return float(np.sqrt(truncation**2 + 2 * np.pi**2 / span**2 * squares * sigma**2 * (2 * degree + 1) / count))


# --- section 4: inertia ----------------------------------------------------------------------------------------------


def rate_from_difference(orientation: np.ndarray, step: float) -> np.ndarray:
    """(27): rates (n - 1, 3) rad/s from matrices (n, 3, 3), ``S*(t) (S(t + dt) - S(t)) / dt``.

    The matrices are ``inertial_from_tracker``; with the transposed ones the formula gives the rate in inertial axes
    with the other sign. A one-sided difference belongs to the middle of the step and is not skew; the elements are
    taken where (27) shows them. With 10 arc seconds at 4 Hz the noise is 2.7e-4 rad/s.
    """
    s = np.asarray(orientation, dtype=float)
    omega = np.swapaxes(s[:-1], 1, 2) @ (s[1:] - s[:-1]) / step
    return np.stack([omega[:, 2, 1], omega[:, 0, 2], omega[:, 1, 0]], axis=-1)


def rate_matrix(orientation: np.ndarray, derivative: np.ndarray) -> np.ndarray:
    """After (27): ``S*_F S'*_F`` (n, 3, 3), both factors transposed, as printed; no rate, not skew."""
    return np.swapaxes(orientation, 1, 2) @ np.swapaxes(derivative, 1, 2)


def acceleration_matrix(derivative: np.ndarray, second: np.ndarray) -> np.ndarray:
    """After (27): ``S'* S''* + S''* S'*`` (n, 3, 3), as printed; no angular acceleration (not even its unit)."""
    a, b = np.swapaxes(derivative, 1, 2), np.swapaxes(second, 1, 2)
    return a @ b + b @ a


def inertia_over_energy(rate: np.ndarray) -> np.ndarray:
    """(28), (29): least squares for ``G = J/2H`` (3, 3) s2 from rates (n, 3) rad/s of one free arc.

    Rank 5 on any arc: the rates also keep ``omega' J^2 omega = L^2``, so every ``a J/2H + b J^2/L^2`` with a + b = 1
    fits. Without noise the solution of least norm is returned, with noise the last direction follows the noise; it need
    be neither positive definite nor in the right order.
    """
    # Columns of equal size keep the rank decision free of the unit of the rates.
    rows = energy_rows(rate)
    size = float(np.mean(np.sum(np.asarray(rate) ** 2, axis=1)))
    return symmetric(np.linalg.lstsq(rows / size, np.ones(len(rows)), rcond=1e-12)[0] / size)


def cubic_constant(tensor: np.ndarray) -> float:
    """(32), second half: ``b = Re(g1 g2 g3)`` of the columns as quaternions, that is minus the determinant."""
    g = [imaginary(tensor[:, i]) for i in range(3)]
    return float(multiply(multiply(g[0], g[1]), g[2])[0])


def largest_root(a: float, b: float) -> float:
    """(33): ``2 sqrt(a/3) cos(arccos(sqrt(27 b^2 / 4 a^3)) / 3)``.

    The square root loses the sign of b: right for a positive determinant only. With a negative one (two large moments,
    one small) it gives the negative of the smallest root.
    """
    return float(2 * np.sqrt(a / 3) * np.cos(np.arccos(min(1.0, np.sqrt(27 * b * b / (4 * a**3)))) / 3))


def other_roots(largest: float, b: float) -> tuple[float, float]:
    """(37): ``(-lambda +- sqrt(lambda^2 + 4 b / lambda)) / 2`` with the b of (32), that is minus the determinant.

    Consistent with the sign of (32); right together with (33) for a positive determinant. NaN where the root is not
    real.
    """
    under = largest**2 + 4 * b / largest
    root = float(np.sqrt(under)) if under >= 0 else float("nan")
    return 0.5 * (-largest + root), 0.5 * (-largest - root)


def principal_axis(tensor: np.ndarray, root: float) -> np.ndarray:
    """(35), (38): unit vector (3,) along ``(g1 - lambda e1) x (g2 - lambda e2)``; the sign is free.

    The product is proportional to the third component of the axis: zero for the first two axes of a body whose
    principal axes are those of the tracker. NaN where it is zero exactly.
    """
    p = np.cross(tensor[:, 0] - root * np.eye(3)[0], tensor[:, 1] - root * np.eye(3)[1])
    size = float(np.linalg.norm(p))
    return p / size if size > 0 else np.full(3, np.nan)


def quaternion_of_principal_axes(matrix: np.ndarray) -> np.ndarray:
    """(41): quaternion (4,) of an orthogonal matrix (39), with ``q0 = 0.5 sqrt(Tr M) + 1`` as printed.

    The 1 belongs under the root, as (48) has it; the print also names the matrix of (46) instead of (39).
    """
    first = 0.5 * np.sqrt(max(float(np.trace(matrix)), 0.0)) + 1
    return _quaternion(matrix, first)


# --- section 5: actuators --------------------------------------------------------------------------------------------


def quaternion_of_actuator_axes(matrix: np.ndarray) -> np.ndarray:
    """(48): quaternion (4,) of the matrix (46), ``q0 = 0.5 sqrt(Tr M + 1)``, ``q_i = (M_jk - M_kj) / (4 q0)``.

    Consistent with (42) for an orthogonal matrix, and undefined for half a turn. Under noise, or with skew axes, the
    matrix is not orthogonal and the quaternion not of unit length; a reversed torque goes unnoticed.
    """
    under = float(np.trace(matrix)) + 1
    return _quaternion(matrix, 0.5 * np.sqrt(under) if under > 0 else float("nan"))


def _quaternion(matrix: np.ndarray, first: float) -> np.ndarray:
    """The vector part of (41) and (48) for a given scalar part."""
    m = np.asarray(matrix, dtype=float)
    odd = np.array([m[1, 2] - m[2, 1], m[2, 0] - m[0, 2], m[0, 1] - m[1, 0]])
    return np.concatenate([[first], 0.25 * odd / first])
