"""Gauss-Newton: known minima, statistics of what it claims, robust losses, hard starts; IPOPT as a second opinion."""

from __future__ import annotations

from functools import cache

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from estimator.estimate import EstimateError, Status
from estimator.losses import Barron, Cauchy, Huber
from estimator.models import rotations
from estimator.problem import Problem
from estimator.residuals import Kernel, KernelResidual
from estimator.solvers import Options, solve, solve_with_ipopt
from estimator.unknowns import UnitQuaternion, Unknown, Vector, retracted
from problems.alignment.problem import alignment_model, alignment_problem
from problems.alignment.simulator import preset, simulate

TURN = Unknown("turn", UnitQuaternion(), "rad", 0.5)
GAIN = Unknown("gain", Vector(1, ("",)), "1", 1.0)


@cache
def _kernel() -> Kernel:
    return Kernel("scaled_direction", (TURN, GAIN), (), (("direction", 3), ("measured", 3)), (),
                  lambda x: x["measured"] - x["gain"] * rotations.rotate(x["turn"], x["direction"]))


def directions(n=40, seed=0, sigma=1e-2, loss=None, accepted=None):
    """Vectors seen through a rotation and a gain, which the noise makes uncertain; the truth beside it."""
    rng = np.random.default_rng(seed)
    d = rng.normal(size=(n, 3))
    truth = {"turn": Rotation.random(random_state=seed).as_quat(scalar_first=True), "gain": np.array([1.3])}
    sigmas = sigma * rng.uniform(0.5, 2.0, (n, 3))
    measured = 1.3 * Rotation.from_quat(truth["turn"], scalar_first=True).apply(d) + sigmas * rng.normal(size=(n, 3))
    more = {"loss": loss} if loss else {}
    residual = KernelResidual("directions", "directions", "m", _kernel(), (), {"direction": d, "measured": measured},
                              sigmas, np.arange(n, dtype=float), np.zeros(n, dtype=int), ("all",), accepted=accepted,
                              **more)
    return Problem((TURN, GAIN), (residual,), {"turn": np.array([1.0, 0, 0, 0]), "gain": np.array([1.0])}), truth


def test_statistics_of_what_is_claimed():
    """150 draws: chi-square of the errors in the claimed covariance, and of the residuals in the claimed freedom."""
    draws = 150
    errors, totals, degrees = [], [], []
    for seed in range(draws):
        problem, truth = directions(n=20, seed=seed)
        estimate = solve(problem.starting_at(truth))
        e = problem.difference(estimate.values, truth)
        errors.append(e @ np.linalg.solve(estimate.covariance, e))
        totals.append(estimate.summaries[0].consistency.total)
        degrees.append(estimate.summaries[0].consistency.degrees)
    np.testing.assert_allclose(degrees, 60 - 4, rtol=1e-6)
    low, high = chi2.ppf([1e-4, 1 - 1e-4], 4 * draws)
    assert low < np.sum(errors) < high
    low, high = chi2.ppf([1e-4, 1 - 1e-4], 56 * draws)
    assert low < np.sum(totals) < high


def test_freedom_by_leverage_of_two_channels():
    """The degrees of each channel, not of the sum alone, match the mean of its sum of squares over 200 draws."""
    totals, claimed = [], None
    for seed in range(200):
        problem, truth = directions(n=12, seed=seed, sigma=5e-3)
        residual = problem.residuals[0]
        few = residual.subset(np.arange(12) < 3)
        many = residual.subset(np.arange(12) >= 3)
        # The same measurement noise, but different geometry: only the mean over draws can agree.
        estimate = solve(problem.with_residuals([few, many]).starting_at(truth))
        totals.append([s.consistency.total for s in estimate.summaries])
        claimed = np.add(0 if claimed is None else claimed, [s.consistency.degrees for s in estimate.summaries])
    claimed = claimed / 200
    assert claimed.sum() == pytest.approx(36 - 4)
    assert 5 < claimed[0] < 9 - 0.5  # three samples pay for more than a quarter of the unknowns at least in part
    spread = np.sqrt(2 * claimed / 200)
    assert np.all(np.abs(np.mean(totals, axis=0) - claimed) < 4 * spread)


@pytest.mark.parametrize("seed", range(5))
def test_any_rotation_is_found_from_none(seed):
    problem, truth = directions(seed=seed)
    estimate = solve(problem)
    assert estimate.status is Status.OK, estimate.why
    difference = problem.difference(estimate.values, truth)
    assert np.all(np.abs(difference) < 5 * np.sqrt(np.diag(estimate.covariance)))


@pytest.mark.parametrize("loss", [Huber(1.5), Cauchy(2.0), Barron(-1.0, 2.0)], ids=["huber", "cauchy", "barron"])
def test_robust_minimum_is_that_of_the_loss(loss):
    """A general minimizer on the sum of the losses, in tangent coordinates, finds nothing lower and no other place."""
    problem, truth = directions(n=60, seed=3, loss=loss)
    rng = np.random.default_rng(1)
    measured = problem.residuals[0].data["measured"].copy()
    wrong = rng.choice(60, 8, replace=False)
    measured[wrong] += rng.normal(0, 0.5, (8, 3))
    problem = problem.with_residuals([problem.residuals[0].with_data(measured=measured)]).starting_at(truth)
    estimate = solve(problem, Options(tolerance=1e-9))
    d, s = problem.residuals[0].data["direction"], problem.residuals[0].standard_deviation
    sigma = np.sqrt(np.diag(estimate.covariance))

    def cost(z):
        z = z * sigma
        q = Rotation.from_quat(retracted(TURN, estimate.values["turn"], z[:3]), scalar_first=True)
        w = (measured - (estimate.values["gain"] + z[3]) * q.apply(d)) / s
        return np.sum(loss.value(np.sum(w**2, axis=1)))

    lowest = minimize(cost, np.full(4, 0.3), method="BFGS", options={"gtol": 1e-7})
    assert sum(p.cost for p in estimate.parts) == pytest.approx(lowest.fun, rel=1e-9)
    assert np.max(np.abs(lowest.x)) < 1e-3
    clean = solve(directions(n=60, seed=3)[0].starting_at(truth))
    robust, plain = (np.linalg.norm(problem.difference(e.values, truth) / sigma)
                     for e in (estimate, solve(directions(n=60, seed=3)[0].with_residuals(
                         [directions(n=60, seed=3)[0].residuals[0].with_data(measured=measured)]).starting_at(truth))))
    assert robust < 0.3 * plain
    assert np.all(np.abs(problem.difference(estimate.values, clean.values)) < 2 * sigma)


def test_rejected_samples_do_not_count():
    problem, _ = directions(n=30, seed=2, accepted=np.arange(30) < 20)
    estimate = solve(problem)
    assert estimate.summaries[0].rejected == 10
    assert estimate.summaries[0].consistency.degrees == pytest.approx(3 * 20 - 4)
    alone = solve(problem.with_residuals([problem.residuals[0].subset(np.arange(30) < 20)]))
    np.testing.assert_allclose(estimate.covariance, alone.covariance, rtol=1e-6)


def test_limits_are_told():
    problem, _ = directions()
    estimate = solve(problem, Options(iterations=1))
    assert estimate.status is Status.NOT_CONVERGED
    assert "1 iterations" in estimate.why
    with pytest.raises(EstimateError, match="not_converged"):
        estimate.raise_for_status()
    steps = []
    assert solve(problem, Options(progress=lambda i, c: steps.append((i, c)))).raise_for_status()
    costs = [c for _, c in steps]
    assert len(costs) > 2 and costs == sorted(costs, reverse=True)


def test_narrow_curved_valley():
    """Rosenbrock's valley as two residuals: Gauss-Newton steps must be damped, and the minimum is exact."""
    xy = Unknown("xy", Vector(2, ("x", "y")), "1", 100.0)
    kernel = Kernel("valley", (xy,), (), (("target", 2),), (),
                    lambda v: v["target"] - ca.vertcat(10 * (v["xy"][1] - v["xy"][0] ** 2), v["xy"][0]))
    residual = KernelResidual("valley", "valley", "1", kernel, (), {"target": np.array([[0.0, 1.0]])}, np.ones((1, 2)),
                              np.zeros(1), np.zeros(1, dtype=int), ("all",))
    estimate = solve(Problem((xy,), (residual,), {"xy": np.array([-1.2, 1.0])}))
    np.testing.assert_allclose(estimate.values["xy"], [1.0, 1.0], atol=1e-8)
    assert estimate.iterations < 60


@cache
def reduced():
    """Every channel, few samples: what IPOPT can solve in seconds."""
    scenario = preset("compact", duration=1800.0, gnss_step=5.0, doppler_sessions=3, session_duration=15.0,
                      doppler_step=1.0, free_arcs=1, free_duration=150.0, star_tracker_step=1.0, free_rate=0.02,
                      pulse_duration=50.0, pulse_spacing=20.0, pulse_segments=((2.0, 15.0, 0.6), (15.0, 28.0, -0.6)))
    return alignment_problem(alignment_model(simulate(scenario, seed=5)[0]))


def test_gauss_newton_and_ipopt_find_the_same_minimum():
    problem = reduced()
    ours = solve(problem, Options(tolerance=1e-9))
    theirs = solve_with_ipopt(problem)
    assert ours.status is Status.OK, ours.why
    assert theirs.status is Status.OK, theirs.why
    assert {u.name for u in problem.free} >= {"antenna_from_tracker", "actuator_from_tracker", "normalized_inertia",
                                              "inertia_trace", "trajectory"}
    for u in problem.free:
        step = u.manifold.local(ours.values[u.name], theirs.values[u.name])
        if u.unit == "rad":
            assert np.max(np.abs(step)) < 1e-8, u.name
        elif u.name != "trajectory":
            assert np.max(np.abs(step)) < 1e-8 * np.linalg.norm(ours.values[u.name]), u.name
        else:
            assert np.max(np.abs(step)) < 1e-4  # standard deviations
    assert sum(p.cost for p in theirs.parts) == pytest.approx(sum(p.cost for p in ours.parts), rel=1e-12)
    sigma = np.sqrt(np.diag(ours.covariance))
    np.testing.assert_allclose(theirs.covariance, ours.covariance, atol=1e-6 * np.outer(sigma, sigma).max(), rtol=1e-4)


def test_ipopt_finds_it_from_a_displaced_start():
    problem = reduced()
    ours = solve(problem, Options(tolerance=1e-9))
    displaced = dict(problem.start)
    displaced["antenna_from_tracker"] = retracted(problem.unknown("antenna_from_tracker"),
                                                  problem.start["antenna_from_tracker"], np.array([0.02, -0.03, 0.01]))
    theirs = solve_with_ipopt(problem.starting_at(displaced))
    step = UnitQuaternion().local(ours.values["antenna_from_tracker"], theirs.values["antenna_from_tracker"])
    assert np.max(np.abs(step)) < 1e-8


def test_ipopt_refuses_robust_losses():
    with pytest.raises(ValueError, match="quadratic"):
        solve_with_ipopt(directions(loss=Huber())[0])
