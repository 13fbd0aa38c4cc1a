"""K0, K1 and the covariance of sighted directions: against finite differences, closed forms, Wahba and Monte Carlo."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from estimator.models.errors import NotFiniteError, RequestError, ShapeError
from problems.star_configuration import closed_form, criteria


def random_directions(count: int, seed: int) -> np.ndarray:
    rows = np.random.default_rng(seed).standard_normal((count, 3))
    return rows / np.linalg.norm(rows, axis=1)[:, None]


def matrix_form(directions: np.ndarray) -> np.ndarray:
    """Formula (3) with sigma = 1, written out by hand."""
    return 0.5 * np.linalg.inv(len(directions) * np.eye(3) - directions.T @ directions)


@pytest.mark.parametrize("count", [2, 3, 4, 7, 20, 50])
def test_criteria_are_the_matrix_form(count: int) -> None:
    for seed in range(5):
        b = random_directions(count, 100 * count + seed)
        axis = random_directions(1, seed)[0]
        p = matrix_form(b)
        found = criteria.criteria_of(b, axis)
        assert pytest.approx(np.trace(p), rel=1e-12) == found.K0
        assert pytest.approx(axis @ (np.trace(p) * np.eye(3) - p) @ axis, rel=1e-12) == found.K1
        np.testing.assert_allclose(found.covariance, p, rtol=0, atol=1e-12 * np.trace(p))


def test_casadi_function_gives_the_same_and_its_gradient_is_right() -> None:
    function = criteria.criteria_function(4)
    b, sigma, axis = random_directions(4, 1), np.array([1.0, 0.7, 2.0, 1.3]), random_directions(1, 2)[0]
    found = criteria.criteria_of(b, axis, sigma)
    K0, K1, p = function(b.T, sigma, axis)
    assert float(K0) == pytest.approx(found.K0, rel=1e-13)
    assert float(K1) == pytest.approx(found.K1, rel=1e-13)
    np.testing.assert_allclose(np.array(p), found.covariance, rtol=1e-12, atol=1e-14)
    x = ca.SX.sym("x", 3, 4)
    for index in (0, 1):
        gradient = ca.Function("g", [x], [ca.gradient(function(x, sigma, axis)[index], x)])
        exact = np.array(gradient(b.T))
        step = 1e-6
        for i in range(3):
            for j in range(4):
                forward, back = b.T.copy(), b.T.copy()
                forward[i, j] += step
                back[i, j] -= step
                difference = (
                    float(function(forward, sigma, axis)[index]) - float(function(back, sigma, axis)[index])
                ) / (2 * step)
                assert exact[i, j] == pytest.approx(difference, rel=1e-6, abs=1e-7)


def test_information_of_a_sighting_is_the_squared_jacobian_of_the_measured_direction() -> None:
    b = random_directions(1, 5)[0]
    u = np.cross(b, [0.3, -0.2, 0.9])
    u /= np.linalg.norm(u)
    v = np.cross(b, u)
    step = 1e-6
    jacobian = np.zeros((2, 3))
    for k in range(3):
        turn = Rotation.from_rotvec(step * np.eye(3)[k])
        moved = (turn.inv().apply(b) - turn.apply(b)) / (2 * step)  # body axes turn by e: coordinates move by b x e
        jacobian[:, k] = u @ moved, v @ moved
    weight = np.diag([1 / 0.4**2, 1 / 1.7**2])
    found = np.array(criteria.two_axis_information(ca.DM(b), ca.DM(u), 0.4, 1.7))
    np.testing.assert_allclose(found, jacobian.T @ weight @ jacobian, atol=1e-8)


def test_equal_axes_make_the_two_axis_sensor_the_plain_one_whatever_its_turn() -> None:
    b = random_directions(1, 6)[0]
    for seed in range(4):
        u = np.cross(b, random_directions(1, seed)[0])
        u /= np.linalg.norm(u)
        two = np.array(criteria.two_axis_information(ca.DM(b), ca.DM(u), 0.5, 0.5))
        np.testing.assert_allclose(two, np.array(criteria.direction_information(ca.DM(b), np.sqrt(0.5))), atol=1e-14)


def test_unequal_accuracies_are_repeated_sightings() -> None:
    b = random_directions(3, 7)
    once = criteria.criteria_of(np.vstack((b, b[:1], b[:1], b[:1])))
    weighted = criteria.criteria_of(b, sigma=[0.5, 1, 1])
    assert pytest.approx(once.K0, rel=1e-13) == weighted.K0
    np.testing.assert_allclose(weighted.covariance, once.covariance, rtol=1e-12, atol=1e-14)


@given(seed=st.integers(0, 10**6), count=st.integers(2, 50))
@settings(max_examples=40, deadline=None)
def test_closed_forms_equal_the_matrix_form(seed: int, count: int) -> None:
    b = random_directions(count, seed)
    p = matrix_form(b)
    # Rounding of the matrix inverse grows with its condition: near-parallel pairs are not asked for 1e-12.
    slack = 1e-12 * max(1.0, np.linalg.cond(p) / 100)
    assert closed_form.K0_any(b @ b.T) == pytest.approx(np.trace(p), rel=slack)
    axis = random_directions(1, seed + 1)[0]
    K1 = float(axis @ (np.trace(p) * np.eye(3) - p) @ axis)
    assert closed_form.K1_from_eigenvalues(p, axis) == pytest.approx(K1, rel=slack)
    least, best = closed_form.least_K1_over_axes(p)
    assert least == pytest.approx(best @ (np.trace(p) * np.eye(3) - p) @ best, rel=slack)
    assert least <= K1 * (1 + 1e-12)
    assert closed_form.least_K1_from_moments(b) == pytest.approx(least, rel=slack)
    departures = closed_form.departures_from_axis(b)
    assert closed_form.K1_near_axis(count, departures) == pytest.approx(least, rel=slack)
    assert departures.sum() == pytest.approx(0, abs=1e-12 * count)
    assert departures[2] > 0 and max(departures[:2]) < 1e-12 * count


def test_special_cases_of_the_general_formula() -> None:
    for seed in range(20):
        b = random_directions(3, seed)
        c = b @ b.T
        assert closed_form.K0_two(c[0, 1]) == pytest.approx(closed_form.K0_any(c[:2, :2]), rel=1e-12)
        assert closed_form.K0_three(c[0, 1], c[0, 2], c[1, 2]) == pytest.approx(closed_form.K0_any(c), rel=1e-12)
    assert closed_form.K0_two(0.0) == closed_form.least_K0(2) == 1.25
    assert closed_form.K0_three(0, 0, 0) == closed_form.least_K0(3) == 0.75


@pytest.mark.parametrize("count", range(2, 11))
def test_the_published_table_attains_the_minimum_only_in_the_right_reading(count: int) -> None:
    b = closed_form.published_directions(count)
    excess = closed_form.K0_any(b @ b.T) / closed_form.least_K0(count) - 1
    # The table is printed to five figures: an error of 1e-5 rad leaves about its square. Row 5 has 1.1e-9.
    assert -1e-14 < excess < 2e-9
    latitude, longitude = (np.radians(np.array(a, dtype=float)) for a in closed_form.PUBLISHED_TABLE[count])
    wrong = np.column_stack(
        (np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude))
    )
    if count >= 4:
        assert closed_form.K0_any(wrong @ wrong.T) / closed_form.least_K0(count) - 1 > 0.01


@pytest.mark.parametrize("cosine", [0.7, -0.7, 0.05, -0.05, 0.95, -0.95])
def test_the_best_axis_of_two_stars_is_the_sum_or_the_difference_bisector(cosine: float) -> None:
    first, second = np.array([0.0, 0.0, 1.0]), np.array([np.sqrt(1 - cosine**2), 0.0, cosine])
    best = closed_form.best_axis_two(first, second)
    assert pytest.approx(closed_form.least_K1_two(cosine), rel=1e-12) == criteria.criteria_of([first, second], best).K1
    other = first - second if cosine > 0 else first + second
    # With the other bisector the sign of c changes: (1/2)(1/2 + 1/(1 - |c|)).
    wrong = 0.5 * (0.5 + 1 / (1 - abs(cosine)))
    assert pytest.approx(wrong, rel=1e-12) == criteria.criteria_of([first, second], other).K1
    if abs(cosine) == 0.7:
        assert closed_form.least_K1_two(cosine) == pytest.approx(0.5441, abs=5e-5)
        assert wrong == pytest.approx(1.9167, abs=5e-5)
    # No axis of a fine grid is better.
    angle = np.linspace(0, np.pi, 181)
    p = matrix_form(np.array([first, second]))
    grid = np.column_stack((np.sin(angle), 0 * angle, np.cos(angle)))
    assert min(np.trace(p) - v @ p @ v for v in grid) >= closed_form.least_K1_two(cosine) - 1e-12


def test_the_limit_along_the_axis_and_its_price() -> None:
    """Ratios to 1/N and variances about the axis for four stars evenly on cones of 0.3, 0.1 and 0.01 rad."""
    for cone, ratio, roll in ((0.3, 1.0457, 1.4), (0.1, 1.0050, 12.5), (0.01, 1.00005, 1250.0)):
        azimuth = np.arange(4) * np.pi / 2
        b = np.column_stack((np.sin(cone) * np.cos(azimuth), np.sin(cone) * np.sin(azimuth), np.full(4, np.cos(cone))))
        found = criteria.criteria_of(b, [0, 0, 1])
        assert (found.K1, found.covariance[2, 2]) == pytest.approx(closed_form.ring_criteria(4, cone), rel=1e-9)
        assert pytest.approx(ratio, rel=1e-4) == found.K1 * 4
        assert found.covariance[2, 2] == pytest.approx(roll, rel=0.03)
        assert closed_form.limit_K1(4) < found.K1


def test_what_one_direction_leaves_open_is_named() -> None:
    found = criteria.criteria_of([[0, 0, 2.0]], [0, 0, 1])
    assert np.inf == found.K0 and found.covariance is None
    np.testing.assert_allclose(np.abs(found.unobservable), [[0, 0, 1]], atol=1e-12)
    assert pytest.approx(1.0) == found.K1  # the axis itself is seen
    assert np.inf == criteria.criteria_of([[0, 0, 1], [0, 0, -1]], [1, 0, 0]).K1  # an axis that the unseen turn moves


@pytest.mark.parametrize(
    ("value", "error"), [([[1, 2]], ShapeError), ([[0, 0, 0]], RequestError), ([[np.nan, 0, 1]], NotFiniteError)]
)
def test_bad_directions_are_refused(value: list[list[float]], error: type[Exception]) -> None:
    with pytest.raises(error):
        criteria.criteria_of(value)


def test_accuracies_must_be_positive() -> None:
    with pytest.raises(RequestError, match="sigma"), np.errstate(divide="ignore"):
        criteria.criteria_of(np.eye(3), sigma=0.0)


def quest_covariance(directions: np.ndarray, sigma_axis: np.ndarray) -> np.ndarray:
    """Shuster and Oh's covariance, accuracies per axis."""
    total = 1 / np.sum(1 / sigma_axis**2)
    a = total / sigma_axis**2
    return total * np.linalg.inv(np.eye(3) - np.einsum("n,ni,nj->ij", a, directions, directions))


def wahba_errors(
    directions: np.ndarray,
    noise_first: np.ndarray,
    noise_second: np.ndarray,
    first: np.ndarray,
    weights: np.ndarray,
    samples: int,
    seed: int,
) -> np.ndarray:
    """Attitude errors (samples x 3, body axes) of Wahba's solution by SVD, noise along two axes of each direction."""
    generator = np.random.default_rng(seed)
    second = np.cross(directions, first)
    shape = (samples, len(directions), 1)
    measured = (
        directions
        + noise_first[:, None] * generator.standard_normal(shape) * first
        + noise_second[:, None] * generator.standard_normal(shape) * second
    )
    measured /= np.linalg.norm(measured, axis=2)[:, :, None]
    u, _, vt = np.linalg.svd(np.einsum("n,sni,nj->sij", weights, measured, directions))
    sign = np.linalg.det(u) * np.linalg.det(vt)
    u[:, :, 2] *= sign[:, None]
    return Rotation.from_matrix(u @ vt).as_rotvec()


def assert_covariance(errors: np.ndarray, expected: np.ndarray) -> None:
    """Every entry of the sample covariance lies within five standard errors of the expected one."""
    sample = errors.T @ errors / len(errors)
    standard_error = np.sqrt((expected**2 + np.outer(np.diag(expected), np.diag(expected))) / len(errors))
    assert np.max(np.abs(sample - expected) / standard_error) < 5


@pytest.mark.parametrize("equal", [True, False])
def test_wahba_and_quest_have_this_covariance(equal: bool) -> None:
    """40,000 samples: the standard error of a variance is 0.7 %."""
    b = random_directions(4, 11)
    sigma = 1e-4 * (np.ones(4) if equal else np.array([1.0, 0.4, 2.0, 0.8]))  # rad, total
    expected = criteria.criteria_of(b, sigma=sigma).covariance
    np.testing.assert_allclose(expected, quest_covariance(b, sigma / np.sqrt(2)), rtol=1e-11, atol=1e-20)
    first = np.cross(b, [0.1, 0.9, 0.2])
    first /= np.linalg.norm(first, axis=1)[:, None]
    errors = wahba_errors(b, sigma / np.sqrt(2), sigma / np.sqrt(2), first, 1 / sigma**2, 40_000, 3)
    assert_covariance(errors, expected)
    trace = np.mean(np.sum(errors**2, axis=1))
    assert trace == pytest.approx(criteria.criteria_of(b, sigma=sigma).K0, rel=0.03)
    v = random_directions(1, 12)[0]
    moved = np.mean(np.sum(np.cross(errors, v) ** 2, axis=1))
    assert moved == pytest.approx(criteria.criteria_of(b, v, sigma).K1, rel=0.03)


def test_two_axis_sensors_weighted_least_squares_attains_the_covariance_and_wahba_does_not() -> None:
    """40,000 samples, accuracies 10 to 1 between the axes of each sensor."""
    b = random_directions(3, 21)
    first = np.cross(b, [0.4, -0.3, 0.8])
    first /= np.linalg.norm(first, axis=1)[:, None]
    second = np.cross(b, first)
    fine, coarse = np.full(3, 1e-5), np.full(3, 1e-4)
    information = sum(
        np.array(criteria.two_axis_information(ca.DM(b[i]), ca.DM(first[i]), fine[i], coarse[i])) for i in range(3)
    )
    expected = np.linalg.inv(information)
    generator = np.random.default_rng(5)
    samples = 40_000
    noise = generator.standard_normal((samples, 6)) * np.concatenate((fine, coarse))
    # A rotation e of the body moves the direction by b x e: along u that is e.(u x b), along v e.(v x b).
    design = np.vstack((np.cross(first, b), np.cross(second, b)))
    weights = np.concatenate((1 / fine**2, 1 / coarse**2))
    errors = noise @ (np.linalg.solve(design.T @ (weights[:, None] * design), design.T * weights)).T
    assert_covariance(errors, expected)
    wahba = wahba_errors(b, fine, coarse, first, np.ones(3), samples, 6)
    assert np.mean(np.sum(wahba**2, axis=1)) > 1.5 * np.trace(expected)
