"""The best directions: the published minima, limits, cones, fixed sensors, families, and what cannot be had."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from scipy.optimize import minimize

from estimator.models.errors import InfeasibleError, RequestError
from problems.star_configuration import closed_form, criteria
from problems.star_configuration.optimal_directions import (
    KeepOut,
    Request,
    optimal_directions,
    random_directions,
    solve_from,
    total_information,
)
from problems.star_configuration.optimal_family import meets_limits, optimal_family, senses


def matrix_form(directions: np.ndarray) -> np.ndarray:
    return 0.5 * np.linalg.inv(len(directions) * np.eye(3) - directions.T @ directions)


@pytest.mark.parametrize("count", [2, 3, 4, 5, 6, 7, 8, 9, 10, 25, 50, 200])
def test_every_row_of_the_table_is_attained(count: int) -> None:
    best = optimal_directions(Request(count))
    assert best.status == "ok"
    np.testing.assert_allclose(np.linalg.norm(best.directions, axis=1), 1, atol=4e-16)
    K0 = float(np.trace(matrix_form(best.directions)))
    assert pytest.approx(best.K0, rel=1e-13) == K0
    target = 1.25 if count == 2 else 9 / (4 * count)
    assert -1e-14 < K0 - target < 1e-12
    if count >= 3:  # a tight frame: no axis is worse known than another
        np.testing.assert_allclose(best.directions.T @ best.directions, count / 3 * np.eye(3), atol=1e-6 * count)


@pytest.mark.parametrize("count", [2, 3, 4, 5, 10, 50])
def test_every_random_start_ends_at_the_minimum(count: int) -> None:
    """Ten starts each here; 100 each for all counts to 50 in benchmarks/star_configurations.py."""
    generator = np.random.default_rng(count)
    for _ in range(10):
        end = solve_from(Request(count), random_directions(count, generator), generator)
        assert end.converged
        assert end.value == pytest.approx(closed_form.least_K0(count), rel=1e-9)


def test_an_independent_optimiser_finds_nothing_better() -> None:
    """BFGS over free vectors, three starts, three and six directions with a fixed sensor and unequal accuracies."""
    generator = np.random.default_rng(4)
    for count in (3, 6):
        sigma = tuple(generator.uniform(0.5, 2.0, count))
        request = Request(count, sigma=sigma, fixed=((0.6, 0.0, 0.8),), fixed_sigma=0.7)
        best = optimal_directions(request)

        def objective(x: np.ndarray, request: Request = request, count: int = count) -> float:
            rows = x.reshape(count, 3)
            weights = 2 / np.concatenate((np.array(request.sigma), [request.fixed_sigma])) ** 2
            b = np.vstack((rows / np.linalg.norm(rows, axis=1)[:, None], request.fixed))
            return float(np.trace(np.linalg.inv(weights.sum() * np.eye(3) - b.T @ (weights[:, None] * b))))

        others = [minimize(objective, generator.standard_normal(3 * count), method="BFGS").fun for _ in range(3)]
        assert pytest.approx(min(others), rel=1e-7) == best.K0
        assert min(others) * (1 + 1e-10) >= best.K0


@pytest.mark.parametrize(
    "sigma", [(1, 1), (1, 0.3), (1, 1, 0.2), (1, 2, 0.5, 0.9), (0.1, 1, 1, 1, 1), (0.4, 0.5, 2, 2, 2)]
)
def test_unequal_accuracies_reach_the_majorization_bound(sigma: tuple[float, ...]) -> None:
    best = optimal_directions(Request(len(sigma), sigma=sigma))
    assert best.status == "ok"
    assert pytest.approx(closed_form.least_K0_unequal(np.array(sigma)), rel=1e-8) == best.K0


@pytest.mark.parametrize(
    ("fixed", "count"),
    [
        ([[0, 0, 1]], 2),
        ([[0, 0, 1]], 5),
        ([[0, 0, 1], [0, 0.1, 1], [0.1, 0, 1]], 3),
        ([[1, 0, 0], [0, 1, 0]], 1),
        ([[0.3, 0.4, 0.5]] * 4, 3),
    ],
)
def test_directions_beside_fixed_sensors_fill_the_poorest_axes(fixed: list[list[float]], count: int) -> None:
    best = optimal_directions(Request(count, fixed=tuple(tuple(f) for f in fixed)))
    rows = np.array(best.request.fixed)
    assert best.status == "ok"
    assert pytest.approx(closed_form.least_K0_beside_fixed(rows, count), rel=1e-8) == best.K0
    assert float(np.trace(matrix_form(np.vstack((rows, best.directions))))) == pytest.approx(best.K0, rel=1e-12)


@pytest.mark.parametrize("degrees", [10.0, 45.572996, 80.0])
@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (1.0, -2.0, 0.5)])
def test_two_stars_under_an_angle_limit_for_one_axis(degrees: float, axis: tuple[float, float, float]) -> None:
    request = Request(2, "K1", axis=axis, angle_limit=np.radians(degrees))
    best = optimal_directions(request)
    cosine = np.cos(np.radians(degrees))
    assert pytest.approx(closed_form.least_K1_two(cosine), rel=1e-9) == best.K1
    found = sorted(float(m[0] @ m[1]) for m in senses(request, best.directions))
    assert found == pytest.approx([-cosine, cosine], abs=1e-8)  # both signs
    for member in senses(request, best.directions):
        assert abs(closed_form.best_axis_two(*member) @ best.axis) == pytest.approx(1, abs=1e-8)
        assert pytest.approx(best.K1, rel=1e-10) == criteria.criteria_of(member, axis).K1


@pytest.mark.parametrize("count", [2, 3, 5, 12])
def test_one_axis_without_limits_comes_close_to_its_infimum_and_tells_the_price(count: int) -> None:
    best = optimal_directions(Request(count, "K1", axis=(0, 1, 1)))
    assert best.status == "ok"
    assert 0 < best.K1 * count - 1 < 1e-4
    assert "never attain" in best.why
    assert float(best.axis @ best.covariance @ best.axis) > 100 / count
    if count >= 3:  # evenly on the cone that is kept free
        assert pytest.approx(closed_form.ring_criteria(count, 0.01)[0], rel=1e-9) == best.K1


def test_limits_between_sensors_hold_and_cost() -> None:
    request = Request(4, minimum_angle=np.radians(50), maximum_angle=np.radians(80))
    best = optimal_directions(request)
    assert best.status == "ok" and meets_limits(request, best.directions, 1e-9)
    angles = [np.degrees(np.arccos(a @ b)) for a, b in combinations(best.directions, 2)]
    assert min(angles) > 50 - 1e-6 and max(angles) < 80 + 1e-6
    assert closed_form.least_K0(4) < best.K0
    assert optimal_directions(Request(4)).K0 < best.K0
    # The cube's diagonals meet a limit of 70 degrees between lines (they stand 70.53 apart), and nothing is lost.
    lines = optimal_directions(Request(4, angle_limit=np.radians(70)))
    assert pytest.approx(closed_form.least_K0(4), rel=1e-9) == lines.K0


def test_keep_out_cones_hold() -> None:
    cones = (KeepOut((0, 0, -1), np.radians(70), "Earth limb"), KeepOut((1, 0, 0.2), np.radians(40), "Sun"))
    request = Request(6, keep_outs=cones)
    best = optimal_directions(request)
    assert best.status == "ok" and meets_limits(request, best.directions, 1e-9)
    assert pytest.approx(closed_form.least_K0(6), rel=1e-9) == best.K0  # senses are free: nothing is lost
    # Only a cap of 20 degrees left: two stars stand as far apart as it lets them.
    cap = Request(2, keep_outs=(KeepOut((0, 0, -1), np.radians(160), "all but a cap"),))
    tight = optimal_directions(cap)
    assert np.degrees(np.arccos(tight.directions[0] @ tight.directions[1])) == pytest.approx(40, abs=1e-4)
    assert pytest.approx(closed_form.K0_two(np.cos(np.radians(40))), rel=1e-7) == tight.K0


def test_two_axis_sensors_share_out_their_turns() -> None:
    """Three sensors that see well along one axis only: best turned so that each body axis is seen alike."""
    pairs = ((1.0, 10.0),) * 3
    best = optimal_directions(Request(3, two_axis_sigma=pairs))
    assert best.status == "ok" and best.first_axes is not None
    np.testing.assert_allclose(np.sum(best.first_axes * best.directions, axis=1), 0, atol=1e-12)
    total = total_information(best.request, best.directions, best.first_axes)
    # The trace of the information is fixed, 3 (1 + 1/100): the best is an even share, if it can be had.
    np.testing.assert_allclose(np.linalg.eigvalsh(total), 1.01, rtol=1e-4)
    assert pytest.approx(3 / 1.01, rel=1e-8) == best.K0


@pytest.mark.parametrize(("count", "dimension"), [(2, 0), (3, 0), (4, 0), (5, 2), (6, 4), (9, 10)])
def test_the_family_of_tight_frames_has_its_dimension(count: int, dimension: int) -> None:
    family = optimal_family(Request(count), starts=6)
    assert family.dimension == dimension
    assert not family.local_optima
    assert (len(family.members) == 1) == (dimension == 0)
    for member in family.members:
        assert closed_form.K0_any(member @ member.T) == pytest.approx(closed_form.least_K0(count), rel=1e-9)


def test_a_limit_cuts_the_family_down_to_points() -> None:
    five = optimal_family(Request(5, angle_limit=np.radians(63.0)), starts=12)  # five lines stand 63.43 apart at most
    assert five.dimension < 2
    assert five.value > closed_form.least_K0(5) * (1 + 1e-6)


def test_senses_respect_the_limits() -> None:
    request = Request(3, maximum_angle=np.radians(100))
    b = np.eye(3)
    assert len(list(senses(request, b))) == 4  # eight, opposite ones counted once
    assert len(list(senses(Request(3, keep_outs=(KeepOut((0, 0, -1), 0.5),)), b))) == 4


def test_one_direction_is_said_to_be_too_few() -> None:
    best = optimal_directions(Request(1))
    assert best.status == "unobservable" and np.inf == best.K0 and "rotation about the line of sight" in best.why
    assert pytest.approx(1.25, rel=1e-9) == optimal_directions(Request(1, fixed=((1, 0, 0),))).K0


def test_limits_that_cannot_be_met_are_said_to_be_so_and_by_how_much() -> None:
    with pytest.raises(InfeasibleError, match="closest try") as raised:
        optimal_directions(Request(7, angle_limit=np.radians(80)), starts=2)
    # Seven lines stand at most 54.74 degrees apart.
    assert raised.value.excess == pytest.approx(np.cos(np.radians(54.7356)) - np.cos(np.radians(80)), abs=1e-4)
    cones = (KeepOut((0, 0, 1), np.radians(100)), KeepOut((0, 0, -1), np.radians(100)))
    with pytest.raises(InfeasibleError):
        optimal_directions(Request(2, keep_outs=cones), starts=2)
    with pytest.raises(InfeasibleError):
        optimal_directions(Request(1, keep_outs=cones))


@pytest.mark.parametrize(
    "values",
    [
        {"count": 0},
        {"count": 3, "criterion": "K2"},
        {"count": 3, "axis": (0, 0, 0)},
        {"count": 3, "sigma": (1, 1)},
        {"count": 3, "sigma": -1.0},
        {"count": 3, "angle_limit": 45.0},
        {"count": 2, "two_axis_sigma": ((1, 1),)},
    ],
)
def test_requests_without_meaning_are_refused(values: dict) -> None:
    with pytest.raises(RequestError):
        Request(**values)


def test_equal_seeds_give_equal_answers() -> None:
    first, second = optimal_directions(Request(6), seed=3), optimal_directions(Request(6), seed=3)
    np.testing.assert_array_equal(first.directions, second.directions)
