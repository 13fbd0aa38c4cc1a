"""The published formulas of Sukhovilov (2007), as an independent computation in NumPy: no matrix is inverted here.

All in units of ``sigma^2`` with ``sigma`` the total standard deviation of a direction (see criteria.py). The scan of
the paper is damaged; the formulas below are the ones that agree with the matrix form (3) to rounding:

    (8)   K0 = (1/2) (1/2 + 2 / (1 - c^2))                                             two directions
    (11)  K0 = (1/2) (12 - s) / (8 - 2 s - 2 c12 c13 c23),  s = c12^2 + c13^2 + c23^2    three directions
    (16)  K0 = (1/2) (N^2 + a2) / (N a2 - a3)                                          N directions
          a2 = sum over pairs of (1 - c_ij^2)
          a3 = sum over triples of (1 + 2 c_ij c_jk c_ik - c_ij^2 - c_ik^2 - c_jk^2)
    (17)  K1 = V^T psi diag(d2 + d3, d1 + d3, d1 + d2) psi^T V,  d, psi: eigenvalues and -vectors of P
    (18)  min over V of K1 = d2 + d3,  d1 the largest
    (19)  min over V of K1 = trace P - (1/2) / xi3,  xi3 the least eigenvalue of f = N I - B B^T
    (20)  xi = (N + D1, N + D2, D3),  D1 + D2 + D3 = 0,  D3 > 0: directions near the axis

Corrections to the text: the least K0 is 9 / (4 N) for N >= 3 only, at N = 2 it is 5/4; the bound for two directions is
on ``|c|``, the best axis is the SUM bisector for c > 0 and the DIFFERENCE bisector for c < 0; (19) for two directions
is ``(1/2) (1/2 + 1 / (1 + |c|))``; the limit ``sigma^2 / N`` of K1 is an infimum that no configuration attains with a
determined attitude.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

PUBLISHED_TABLE: dict[int, tuple[tuple[float, ...], tuple[float, ...]]] = {
    2: ((0, 0), (0, 90)),
    3: ((0, 0, 90), (0, 90, 90)),
    4: ((0, 0, 120, 60), (0, 109.47, 109.47, 250.53)),
    5: ((0, 0, 125.02, 28.558, 74.875), (0, 66.549, 90.484, 131.53, 254.8)),
    6: ((0, 0, 95.822, 44.059, 88.033, 0), (0, 90.299, 77.271, 159.42, 269.14, 74.134)),
    7: ((0, 0, 120.83, 39.022, 90.837, -0.002, 69.135), (0, 94.767, 75.248, 141.47, 290.72, 61.399, 57.085)),
    8: ((0, 0, 129.15, 25.322, 94.901, 0, 52.939, 77.674), (0, 54.722, 91.954, 106.81, 280.78, 117.26, 10.54, 78.911)),
    9: (
        (0, 0, 121.49, 122.2, 77.072, 0, 10.429, 56.201, 53.911),
        (0, 98.15, 105.21, 112.76, 282.17, 108.32, -26.298, 55.796, 45.085),
    ),
    10: (
        (0, 0, 133.62, 157.45, 43.587, -0.018, -53.68, 60.277, 71.009, 95.382),
        (0, 135.69, 116.13, 117.58, 294.92, 115.1, 54.842, 65.609, 73.114, 46.774),
    ),
}
"""The published configurations: for each N the two angles (deg). They are called latitude and longitude there and are
in fact azimuth (first) and polar angle (second): only so does each row attain the minimum."""


def published_directions(count: int) -> np.ndarray:
    """Directions (count x 3) of the published table, 2 to 10, read as azimuth and polar angle."""
    azimuth, polar = (np.radians(np.array(angles, dtype=float)) for angles in PUBLISHED_TABLE[count])
    return np.column_stack((np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)))


def least_K0(count: int) -> float:
    """Least K0 of ``count`` equal directions: 5/4 for two, 9/(4 N) from three on, infinite for one."""
    if count < 2:
        return float("inf")
    return 1.25 if count == 2 else 9 / (4 * count)


def K0_two(c: float) -> float:
    """(8): K0 of two directions with cosine ``c`` between them."""
    return 0.5 * (0.5 + 2 / (1 - c * c))


def K0_three(c12: float, c13: float, c23: float) -> float:
    """(11): K0 of three directions from the cosines between them."""
    squares = c12**2 + c13**2 + c23**2
    return 0.5 * (12 - squares) / (8 - 2 * squares - 2 * c12 * c13 * c23)


def K0_any(cosines: np.ndarray) -> float:
    """(16): K0 of N directions from the matrix (N x N) of cosines between them."""
    count = len(cosines)
    first, second = np.triu_indices(count, 1)
    a2 = float(np.sum(1 - cosines[first, second] ** 2))
    a3 = 0.0
    if count >= 3:
        i, j, k = np.array(list(combinations(range(count), 3))).T
        a, b, c = cosines[i, j], cosines[j, k], cosines[i, k]
        a3 = float(np.sum(1 + 2 * a * b * c - a**2 - b**2 - c**2))
    return 0.5 * (count**2 + a2) / (count * a2 - a3)


def K1_from_eigenvalues(covariance: np.ndarray, axis: np.ndarray) -> float:
    """(17): K1 of the unit ``axis`` (3) from eigenvalues and eigenvectors of the covariance (3 x 3)."""
    d, psi = np.linalg.eigh(covariance)
    return float(((psi.T @ axis) ** 2) @ (d.sum() - d))


def least_K1_over_axes(covariance: np.ndarray) -> tuple[float, np.ndarray]:
    """(18): the least K1 over all axes, the sum of the two smaller eigenvalues, and the axis (3) that has it."""
    d, psi = np.linalg.eigh(covariance)
    return float(d[0] + d[1]), psi[:, 2]


def least_K1_from_moments(directions: np.ndarray) -> float:
    """(19): the least K1 over all axes for directions (N x 3), from the eigenvalues of ``f = N I - B B^T``.

    In mechanics ``f`` is the inertia matrix of unit masses at the ends of the directions: the best axis is the one of
    least moment.
    """
    xi = np.linalg.eigvalsh(len(directions) * np.eye(3) - directions.T @ directions)
    return float(0.5 * np.sum(1 / xi) - 0.5 / xi[0])


def least_K1_two(c: float) -> float:
    """(19) for two directions with cosine ``c``: ``(1/2) (1/2 + 1 / (1 + |c|))``; see :func:`best_axis_two`."""
    return 0.5 * (0.5 + 1 / (1 + abs(c)))


def best_axis_two(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """The axis (3) with the least K1 for two directions: sum bisector for c > 0, difference bisector for c < 0."""
    bisector = first + second if first @ second >= 0 else first - second
    return bisector / np.linalg.norm(bisector)


def limit_K1(count: int) -> float:
    """Infimum of K1 of ``count`` directions, all along the axis: 1/N. Not attained: the turn about the axis is lost."""
    return 1 / count


def departures_from_axis(directions: np.ndarray) -> np.ndarray:
    """(20): the three departures D (ascending, sum zero) of the eigenvalues of ``f`` from (N, N, 0)."""
    count = len(directions)
    xi = np.sort(np.linalg.eigvalsh(count * np.eye(3) - directions.T @ directions))[::-1]
    return xi - np.array([count, count, 0.0])


def K1_near_axis(count: int, departures: np.ndarray) -> float:
    """(18) with (20): ``(1/2) (1/(N + D1) + 1/(N + D2))``, which tends to 1/N as the departures vanish."""
    return float(0.5 * (1 / (count + departures[0]) + 1 / (count + departures[1])))


def ring_criteria(count: int, cone: float) -> tuple[float, float]:
    """K1 of the cone axis and variance about it for ``count`` >= 3 directions evenly on a cone of half-angle ``cone``.

    The price of the limit 1/N: K1 = 1 / (N (1 - sin^2/2)), variance about the axis = 1 / (2 N sin^2).
    """
    square = np.sin(cone) ** 2
    return float(1 / (count * (1 - square / 2))), float(1 / (2 * count * square))


def least_K0_unequal(sigmas: np.ndarray) -> float:
    """Least K0 of directions of unequal total accuracies ``sigmas`` (N >= 2): by majorization, without optimisation.

    With weights ``w = 1/sigma^2`` (sum W) the eigenvalues of ``sum w b b^T`` may be any triple that majorizes the
    weights (Schur-Horn), and the most even one is best: W/3 each, unless one weight is larger than its share; that one
    stands alone on its axis and the rest is shared by the others (fundamental inequality of weighted tight frames).
    """
    weights = np.sort(1 / np.asarray(sigmas, dtype=float) ** 2)[::-1]
    total = weights.sum()
    eigenvalues = []
    rest, axes = total, 3
    for weight in weights:
        if axes and weight > rest / axes:
            eigenvalues.append(weight)
            rest -= weight
            axes -= 1
        else:
            break
    eigenvalues += [rest / axes] * axes
    return float(0.5 * np.sum(1 / (total - np.array(eigenvalues))))


def least_K0_beside_fixed(fixed: np.ndarray, count: int) -> float:
    """Least K0 when ``count`` equal directions join ``fixed`` ones (m x 3): by filling the poorest axes first.

    Any positive semidefinite matrix of trace ``count`` and rank up to ``count`` is a sum of ``count`` projections on
    unit vectors, so the added moments pour like water into the eigenvalues of the fixed moments until the level is
    even. For ``count`` below the number of axes that the water reaches the value is a lower bound.
    """
    moments = np.sort(np.linalg.eigvalsh(fixed.T @ fixed)) if len(fixed) else np.zeros(3)
    total = len(fixed) + count
    for filled in (1, 2, 3):
        level = (count + moments[:filled].sum()) / filled
        if filled == 3 or level <= moments[filled]:
            break
    moments[:filled] = level
    return float(0.5 * np.sum(1 / (total - moments)))
