"""Bad starts and bad data: any start ends in the same optimum, gross outliers do not carry the answer away."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.estimate import Status
from estimator.losses import Barron, Cauchy, Huber
from estimator.solvers import Options, solve
from estimator.solvers.continuation import solve_from_anywhere
from problems.alignment.problem import alignment_model, alignment_problem
from problems.alignment.simulator import preset, simulate
from problems.alignment.solution import solve_campaign

SHORT = {"duration": 3000.0, "gnss_step": 4.0, "doppler_sessions": 4, "session_duration": 20.0, "doppler_step": 1.0,
         "star_tracker_step": 1.0}


@cache
def optimum():
    problem = alignment_problem(alignment_model(simulate(preset("compact", **SHORT), seed=0)[0]))
    return problem, solve(problem, Options(tolerance=1e-9))


def thin_rod():
    """A body nearly all of whose mass is on one oblique line: next to the edge of what is physical."""
    axes = Rotation.from_rotvec([0.7, -0.4, 1.1]).as_matrix()
    second = axes @ np.diag([0.0004, 0.001, 0.4986]) @ axes.T
    t = np.trace(second) * np.eye(3) - second
    return np.array([t[0, 0], t[1, 1], t[2, 2], t[0, 1], t[0, 2], t[1, 2]])


def half_turn(name):
    best = optimum()[1]
    turned = Rotation.from_rotvec([0.0, np.pi, 0.0]) * Rotation.from_quat(best.values[name], scalar_first=True)
    return {name: turned.as_quat(scalar_first=True)}


def wrong_rates():
    problem, _ = optimum()
    factors = np.random.default_rng(0).choice([0.5, 1.5], (len(problem.start), 3))
    return {n: np.asarray(problem.start[n]) * f for n, f in zip(problem.start, factors, strict=True)
            if n.startswith("rate:")}


STARTS = {
    "antenna half a turn off": lambda: half_turn("antenna_from_tracker"),
    "actuator half a turn off": lambda: half_turn("actuator_from_tracker"),
    "inertia of a thin rod": lambda: {"normalized_inertia": thin_rod()},
    "rates off by half": wrong_rates,
}


@pytest.mark.parametrize("start", STARTS)
def test_hard_starts_end_in_the_same_optimum(start):
    problem, best = optimum()
    found = solve_from_anywhere(problem.starting_at(STARTS[start]()))
    assert found.status is Status.OK, found.why
    step = problem.difference(best.values, found.values)
    assert np.sqrt(step @ np.linalg.solve(best.covariance, step)) < 0.01  # standard deviations


def test_a_good_start_is_solved_as_it_is():
    problem, best = optimum()
    found = solve_from_anywhere(problem)
    assert found.iterations <= best.iterations + 1
    step = problem.difference(best.values, found.values)
    assert np.sqrt(step @ np.linalg.solve(best.covariance, step)) < 1e-3


OUTLIERS = {"gnss_outlier_fraction": 0.05, "star_tracker_outlier_fraction": 0.05, "doppler_outlier_fraction": 0.05}
SEEDS = range(6)


@cache
def campaign(seed, spoiled):
    return simulate(preset("compact", **SHORT, **(OUTLIERS if spoiled else {})), seed=seed)


def total_errors(solution, truth):
    """Squared error of antenna, inertia and actuator together, in the covariance of the clean solution."""
    j = truth.inertia / np.trace(truth.inertia)
    true = {"antenna_from_tracker": truth.antenna_from_tracker, "actuator_from_tracker": truth.actuator_from_tracker,
            "normalized_inertia": np.array([j[0, 0], j[1, 1], j[2, 2], j[0, 1], j[0, 2], j[1, 2]])}
    problem, values = solution.estimate.problem, solution.estimate.values
    return {n: problem.unknown(n).manifold.local(values[n], v) for n, v in true.items()}


@cache
def clean():
    return {seed: solve_campaign(campaign(seed, False)[0]) for seed in SEEDS}


@pytest.mark.parametrize("loss, screening", [(None, True), (Huber(), True), (Cauchy(), False), (Barron(-1.0), False)],
                         ids=["screening", "screening and huber", "cauchy alone", "barron alone"])
def test_gross_outliers_in_every_channel(loss, screening):
    """6 campaigns with 5 percent of gross errors in each channel: the error stays within 1.2 of the clean one."""
    with_outliers = without = 0.0
    for seed in SEEDS:
        spoiled, truth = campaign(seed, True)
        solution = solve_campaign(spoiled, loss=loss, screening=screening)
        assert solution.estimate.status is not Status.NOT_CONVERGED, solution.why
        reference = clean()[seed]
        for (name, a), b in zip(total_errors(solution, truth).items(), total_errors(reference, truth).values(),
                                strict=True):
            information = np.linalg.inv(reference.estimate.covariance_of(name))
            with_outliers += a @ information @ a
            without += b @ information @ b
    assert np.sqrt(with_outliers / without) < 1.2


def test_screening_finds_the_planted_outliers_and_nothing_else():
    spoiled, truth = campaign(0, True)
    solution = solve_campaign(spoiled)
    rejected = solution.screening
    wrong = np.zeros(len(spoiled.gnss.time), dtype=bool)
    wrong[truth.outliers["gnss"]] = True
    assert np.mean(rejected.gnss[wrong]) < 0.02  # kept although wrong
    assert np.mean(~rejected.gnss[~wrong]) < 0.002  # left out although right
    assert solution.screening.rejected()["star_tracker"] >= 0.9 * len(truth.outliers["star_tracker"])
    assert "gross outliers left out of gnss" in solution.why
    untouched = clean()[0]
    assert untouched.screening.rejected() == {}
