"""Process noise in the joint batch: the answer of the iterated smoother by another algorithm, and its statistics."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from estimator.models.errors import RequestError
from estimator.solvers import Options
from estimator.solvers import recursive_filters as filters
from problems.geo_orbit.book import SIZE, BookCase, BookSystem, simulate
from problems.geo_orbit.book_batch import (
    DrivenMotion,
    batch_estimate,
    batch_problem,
    noise_root,
    stacked,
)

HOUR = 3600.0  # s
CASE = BookCase(step=900.0, burn=(20000.0, 23600.0), interval=4 * HOUR)


def smoother(system: BookSystem, measurements: np.ndarray) -> filters.FilterRun:
    """The iterated smoother, run until it stands."""
    case = system.case
    return filters.iterated_smoother(
        system, case.first_state, np.diag(case.prior**2), measurements, passes=40, tolerance=1e-9
    )


@pytest.mark.parametrize(("inflation", "step"), [(0.0, 900.0), (1e-10, 1800.0)])
def test_joint_batch_equals_the_smoother_along_the_whole_motion(inflation: float, step: float) -> None:
    system = BookSystem(replace(CASE, step=step), inflation)
    runs = 2
    simulated = simulate(system, runs, 5)
    recursive = smoother(system, simulated.measurements)
    for r in range(runs):
        estimate = batch_estimate(system, simulated.measurements[r], Options(tolerance=1e-8))
        sigma = recursive.sigma[r]
        assert (np.abs(stacked(estimate) - recursive.state[r, 0]) < 1e-5 * sigma[0]).all()
        unit = CASE.prior
        first = estimate.covariance[:SIZE, :SIZE] / np.outer(unit, unit)
        assert first == pytest.approx(recursive.covariance[r] / np.outer(unit, unit), rel=1e-5, abs=1e-9)
        motion, slope = estimate.problem.residuals[0].signals[0].evaluate(estimate.values)
        assert (np.abs(motion - recursive.state[r, 1:]) < 1e-5 * sigma[1:]).all()
        along = np.sqrt(np.einsum("nia,ab,nib->ni", slope, estimate.covariance, slope))
        assert along == pytest.approx(sigma[1:], rel=1e-5)


def test_joint_batch_with_process_noise_is_consistent() -> None:
    system = BookSystem(CASE)
    runs = 20
    simulated = simulate(system, runs, 8)
    squares, increments = [], []
    for r in range(runs):
        estimate = batch_estimate(system, simulated.measurements[r])
        error = (stacked(estimate) - simulated.truth[r, 0]) / CASE.prior
        covariance = estimate.covariance[:SIZE, :SIZE] / np.outer(CASE.prior, CASE.prior)
        squares.append(error @ np.linalg.solve(covariance, error))
        assert estimate.status == "ok", estimate.why
        increments.append(estimate.chi_square_per_degree())
    # 280 normal numbers: 4 sigma of their mean square
    assert np.mean(squares) / SIZE == pytest.approx(1.0, abs=4 * np.sqrt(2 / (SIZE * runs)))
    assert np.mean(increments) == pytest.approx(1.0, abs=0.1)


def test_noise_that_is_ignored_is_missed_and_noise_that_is_modelled_is_not() -> None:
    quick = BookSystem(replace(CASE, interval=2 * HOUR))
    simulated = simulate(quick, 3, 21)
    constant = BookSystem(replace(CASE, interval=float("inf")))
    for r in range(3):
        assert batch_estimate(constant, simulated.measurements[r]).status == "model_gap"
        assert batch_estimate(quick, simulated.measurements[r]).status == "ok"


def test_slow_noise_is_the_constant() -> None:
    slow, constant = (BookSystem(replace(CASE, interval=i)) for i in (1e15, float("inf")))
    z = simulate(constant, 1, 3).measurements[0]
    one, two = (batch_estimate(s, z, Options(tolerance=1e-8)) for s in (slow, constant))
    sigma = np.sqrt(np.diag(two.covariance))
    assert (np.abs(stacked(one) - stacked(two)) < 1e-3 * sigma).all()
    assert np.sqrt(np.diag(one.covariance)[:SIZE]) == pytest.approx(sigma, rel=1e-3)


def test_pieces_of_two_steps_cost_half_the_unknowns_and_little_accuracy() -> None:
    system = BookSystem(CASE)
    z = simulate(system, 1, 6).measurements[0]
    fine, coarse = (batch_estimate(system, z, piece=p) for p in (1, 2))
    assert len(fine.covariance) - SIZE == 2 * (len(coarse.covariance) - SIZE)
    sigma = np.sqrt(np.diag(fine.covariance)[:SIZE])
    assert (np.abs(stacked(fine) - stacked(coarse)) < 0.5 * sigma).all()
    assert np.sqrt(np.diag(coarse.covariance)[:SIZE]) == pytest.approx(sigma, rel=0.25)


def test_noise_root_is_a_root_of_the_noise_of_several_steps() -> None:
    system = BookSystem(CASE, 1e-10)
    phi = np.diag([1.0] * 6 + [system.shaping_factors[0], 1, 1, 1, *system.shaping_factors[1:]])
    q = system.process_noise(0)
    shaped = [6, 10, 11, 12, 13]
    three = q + phi @ q @ phi + phi @ phi @ q @ phi @ phi
    root = noise_root(system, 3)
    assert (root @ root.T)[shaped, shaped] == pytest.approx(three[shaped, shaped], rel=1e-12)
    one = noise_root(system)
    scale = np.sqrt(np.maximum(np.diag(q), 1e-300))
    assert one @ one.T / np.outer(scale, scale) == pytest.approx(q / np.outer(scale, scale), abs=1e-12)


def test_driven_motion_has_the_derivatives_of_its_differences_and_one_symbolic_form() -> None:
    problem = batch_problem(BookSystem(replace(CASE, span=8 * HOUR), 1e-10), np.zeros((32, 4)))
    signal = problem.residuals[0].signals[0]
    assert isinstance(signal, DrivenMotion)
    signal = signal.subset(np.arange(32) % 5 == 4)
    random = np.random.default_rng(2)
    size = problem.unknown("increments").manifold.ambient
    values = {**problem.start, "increments": random.standard_normal(size)}
    state, slope = signal.evaluate(values)
    step = random.standard_normal(slope.shape[2])
    step[:SIZE] *= CASE.prior
    names = [u.name for u in signal.unknowns]
    ends = np.cumsum([0, *(len(values[n]) for n in names)])

    def moved(factor: float) -> np.ndarray:
        there = {n: values[n] + factor * step[a:b] for n, a, b in zip(names, ends, ends[1:], strict=False)}
        return signal.evaluate(there)[0]

    numeric = (moved(1e-4) - moved(-1e-4)) / 2e-4
    exact = slope @ step
    assert numeric == pytest.approx(exact, rel=1e-5, abs=1e-9)
    symbols = {n: ca.MX.sym(n, len(values[n])) for n in names}
    expression = ca.Function("motion", list(symbols.values()), [signal.symbolic(symbols)])
    found = np.asarray(expression(*(values[n] for n in names))).T
    assert found == pytest.approx(state, rel=1e-12, abs=1e-12)


def test_too_much_process_noise_is_refused_with_the_remedy() -> None:
    fine = BookSystem(replace(CASE, step=5.0))
    with pytest.raises(RequestError, match="at least 15 steps"):
        batch_problem(fine, np.zeros((fine.steps, 4)))
    with pytest.raises(RequestError, match="no steps"):
        batch_problem(BookSystem(CASE), np.zeros((96, 4)), piece=0)
