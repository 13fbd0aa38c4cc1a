"""The joint problem: bookkeeping, normal equations, and the compressed trajectory against every coefficient at once."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from estimator.problem import Problem, normal_equations
from estimator.residuals import KernelResidual
from estimator.signals import LinearSignal
from estimator.solvers import Options, solve
from estimator.trajectory_residual import TrajectoryResidual, felt_directions
from estimator.unknowns import Unknown, Vector, retracted
from problems.alignment.problem import alignment_model, alignment_problem
from problems.alignment.simulator import preset, simulate


@cache
def small():
    """A short campaign with Doppler sessions alone, whose uncompressed problem is dense and small."""
    scenario = preset("compact", duration=2400.0, gnss_step=4.0, doppler_sessions=3, session_duration=12.0, free_arcs=0,
                      pulse_axes=(), doppler_step=1.0, doppler_jitter=0.3, gnss_gaps=((700.0, 760.0),),
                      noise_variation=0.5)
    campaign, truth = simulate(scenario, seed=4)
    return alignment_model(campaign, degree=9), truth


def uncompressed(model, problem):
    """Residual function of three angles and all Fourier coefficients, with the whitening of ``problem``.

    The coefficients are taken in combinations that the triangle of a QR decomposition gives, axis by axis: without
    that, a dense solver stalls on the condition number of the frame.
    """
    gnss = model.campaign.gnss
    doppler = problem.residuals[1]
    assert isinstance(doppler, KernelResidual) and doppler.factor is not None
    basis = model.frame.basis(gnss.time)
    inverses = [np.linalg.inv(np.linalg.qr(basis / s[:, None], mode="r")) for s in gnss.standard_deviation.T]
    slope = model.frame.evaluate(np.eye(model.frame.size), doppler.time, 1)
    antenna, at = problem.unknown("antenna_from_tracker"), problem.start["antenna_from_tracker"]

    def coefficients(z):
        return np.column_stack([r @ y for r, y in zip(inverses, z[3:].reshape(3, -1), strict=True)])

    def residuals(z):
        c = coefficients(z)
        positions = (gnss.position - basis @ c) / gnss.standard_deviation
        inputs = {**doppler.data, **doppler.estimated, "velocity": slope @ c,
                  "antenna_from_tracker": retracted(antenna, at, z[:3])}
        raw = doppler.kernel(doppler.samples, inputs)[0] - doppler.offset
        return np.concatenate([positions.ravel(), np.einsum("nij,nj->ni", doppler.factor, raw).ravel()])

    return residuals, lambda z: slope @ coefficients(z), 3 + 3 * model.frame.size


def _linearized(function, at):
    """Design and right-hand side of one Gauss-Newton step; the residual is linear in all but three unknowns."""
    base = function(at)
    columns = [function(at + h) - base for h in np.eye(len(at))]
    columns[:3] = [(function(at + 1e-6 * h) - base) / 1e-6 for h in np.eye(len(at))[:3]]
    return np.column_stack(columns), -base


def test_compressed_trajectory_is_the_joint_problem_with_every_coefficient():
    model, _ = small()
    problem = alignment_problem(model)
    estimate = solve(problem, Options(tolerance=1e-10))
    at_solution = problem.starting_at(estimate.values).prepared(estimate.values)
    function, velocity, size = uncompressed(model, at_solution)
    x = np.zeros(size)
    for _ in range(5):
        design, right = _linearized(function, x)
        x = x + np.linalg.lstsq(design, right, rcond=None)[0]
    sigma = np.sqrt(np.diag(estimate.covariance_of("antenna_from_tracker")))
    # The minimum of the whole cost, its place, and the covariance of the angles.
    assert np.sum(function(x) ** 2) == pytest.approx(sum(p.cost for p in estimate.parts), rel=1e-8)
    assert np.max(np.abs(x[:3]) / sigma) < 1e-3
    covariance = np.linalg.inv(np.linalg.qr(design, mode="r"))
    np.testing.assert_allclose(estimate.covariance_of("antenna_from_tracker"), covariance[:3] @ covariance[:3].T,
                               rtol=1e-5, atol=1e-5 * sigma.max() ** 2)
    # The velocity that the Doppler residual saw.
    seen, _ = at_solution.residuals[1].signals[0].evaluate(estimate.values)
    np.testing.assert_allclose(seen, velocity(x), atol=1e-6)  # m/s


def test_felt_directions_are_all_that_other_data_feel():
    model, _ = small()
    times = model.campaign.doppler.time
    directions = felt_directions(model.block, [(times, 1)])
    for axis, d in enumerate(directions):
        np.testing.assert_allclose(d.T @ d, np.eye(d.shape[1]), atol=1e-12)
        sensitivity = model.block.sensitivity(times, 1, axis)
        missed = sensitivity - sensitivity @ d @ d.T
        assert np.max(np.abs(missed)) < 1e-5 * np.max(np.abs(sensitivity))
        assert d.shape[1] < d.shape[0]  # a few sessions feel a part of the orbit only


def test_effects_in_the_positions_are_exact():
    """Cost and gradient of the compressed positions with a lever arm and a clock offset against all samples."""
    model, _ = small()
    problem = alignment_problem(model, ["gnss-lever-arm", "gnss-timetag-offset"])
    positions = problem.residuals[0]
    assert isinstance(positions, TrajectoryResidual) and positions.effect_kernel is not None
    rng = np.random.default_rng(0)
    values = dict(problem.start)
    for u in positions.effect_kernel.unknowns:
        values[u.name] = 0.5 * u.scales * rng.normal(size=u.manifold.tangent)
    values["trajectory"] = rng.normal(size=len(values["trajectory"]))
    part = positions.linearize(values)
    inputs = {**positions.effect_data, **{u.name: values[u.name] for u in positions.effect_kernel.unknowns}}
    contribution, jacobians = positions.effect_kernel(len(positions.time), inputs)
    # Whole least squares over every coefficient with the felt directions held: what the compression says it solves.
    gnss = model.campaign.gnss
    first = 0
    expected, gradient = 0.0, []
    for axis, d in enumerate(positions.directions):
        size = d.shape[1]
        zeta = values["trajectory"][first : first + size]
        transform = model.block.transform(axis)
        sigma = gnss.standard_deviation[:, axis]
        design = (model.frame.basis(gnss.time) @ transform) / sigma[:, None]
        data = (gnss.position[:, axis] - contribution[:, axis]
                - model.frame.basis(gnss.time) @ model.block.coefficients[:, axis]) / sigma - design @ d @ zeta
        complement = np.linalg.svd(d, full_matrices=True)[0][:, size:]
        free = design @ complement
        rest = data - free @ np.linalg.lstsq(free, data, rcond=None)[0]
        expected += rest @ rest
        gradient.append(np.concatenate([
            -(design @ d).T @ rest,
            *[-(jacobians[u.name][:, axis, :] / sigma[:, None]).T @ rest for u in positions.effect_kernel.unknowns]]))
        first += size
    assert part.cost == pytest.approx(expected, rel=1e-9)
    found = np.einsum("nmp,nm->p", part.jacobian, part.whitened)
    sizes = [d.shape[1] for d in positions.directions]
    joined = np.concatenate([*(g[:s] for g, s in zip(gradient, sizes, strict=True)),
                             sum(g[s:] for g, s in zip(gradient, sizes, strict=True))])
    np.testing.assert_allclose(found, joined, rtol=1e-6, atol=1e-7 * np.abs(joined).max())


# --- bookkeeping -----------------------------------------------------------------------------------------------------


def line(n=30, seed=0, prior=False):
    """A straight line with noise: slope and offset, one signal each; solved by hand as well."""
    from estimator.residuals import Kernel

    rng = np.random.default_rng(seed)
    offset = Unknown("offset", Vector(1, ("",)), "m", 2.0, prior=prior)
    slope = Unknown("slope", Vector(1, ("",)), "m/s", 3.0)
    t = np.linspace(0, 1, n)
    sigma = rng.uniform(0.1, 0.3, (n, 1))
    y = 1.5 + 0.7 * t[:, None] + sigma * rng.normal(size=(n, 1))
    kernel = Kernel("line", (offset,), (("climb", Vector(1)),), (("y", 1),), (),
                    lambda x: x["y"] - x["offset"] - x["climb"])
    residual = KernelResidual("line", "line", "m", kernel,
                              (LinearSignal("climb", slope, np.zeros((n, 1)), t[:, None, None]),), {"y": y}, sigma, t,
                              np.zeros(n, dtype=int), ("all",))
    problem = Problem((offset, slope), (residual,), {"offset": np.zeros(1), "slope": np.zeros(1)})
    return problem, np.column_stack([np.ones(n), t]) / sigma, (y / sigma).ravel()


def test_linear_problem_is_solved_as_by_hand():
    problem, design, right = line()
    estimate = solve(problem)
    expected, squares, *_ = np.linalg.lstsq(design, right, rcond=None)
    found = np.concatenate([estimate.values["offset"], estimate.values["slope"]])
    np.testing.assert_allclose(found, expected, rtol=1e-7)
    np.testing.assert_allclose(estimate.covariance, np.linalg.inv(design.T @ design), rtol=1e-10)
    assert estimate.summaries[0].consistency.total == pytest.approx(squares[0])
    assert estimate.summaries[0].consistency.degrees == pytest.approx(30 - 2)
    assert estimate.iterations <= 3


def test_prior_enters_as_a_measurement_of_the_start():
    problem, design, right = line(prior=True)
    estimate = solve(problem)
    design = np.vstack([design, [1 / 2.0, 0]])
    np.testing.assert_allclose(np.concatenate([estimate.values["offset"], estimate.values["slope"]]),
                               np.linalg.lstsq(design, np.append(right, 0.0), rcond=None)[0], rtol=1e-7)
    np.testing.assert_allclose(estimate.covariance, np.linalg.inv(design.T @ design), rtol=1e-9)


def test_holding_and_freeing():
    problem, design, right = line()
    held = problem.starting_at({"slope": np.array([0.4])}).holding("slope")
    assert [u.name for u in held.free] == ["offset"]
    estimate = solve(held)
    assert estimate.values["slope"] == 0.4
    expected = np.linalg.lstsq(design[:, :1], right - 0.4 * design[:, 1], rcond=None)[0]
    np.testing.assert_allclose(estimate.values["offset"], expected, rtol=1e-7)
    assert estimate.covariance.shape == (1, 1)
    again = solve(held.freeing("slope"))
    np.testing.assert_allclose(again.values["slope"], solve(problem).values["slope"], rtol=1e-7)


def test_gradient_and_matrix_are_those_of_the_cost():
    problem, _ = small()[0], None
    joint = alignment_problem(problem)
    rng = np.random.default_rng(1)
    scales = np.concatenate([u.scales for u in joint.free])
    values = joint.moved(joint.start, 1e-3 * scales * rng.normal(size=len(scales)))
    prepared = joint.prepared(values)
    equations = normal_equations(prepared, values, prepared.linearize(values))
    for _ in range(4):
        direction = rng.normal(size=len(scales))
        direction /= np.sqrt(direction @ equations.matrix @ direction)
        cost = [sum(p.cost for p in prepared.linearize(prepared.moved(values, h * scales * direction)))
                for h in (-1e-2, 0.0, 1e-2)]
        slope = (cost[2] - cost[0]) / 2e-2
        curvature = (cost[2] - 2 * cost[1] + cost[0]) / 1e-4
        assert slope == pytest.approx(2 * equations.gradient @ direction, rel=1e-4, abs=1e-4)
        assert curvature == pytest.approx(2.0, rel=0.02)  # nearly linear: the Gauss-Newton matrix is the curvature


def test_difference_is_the_inverse_of_moved():
    joint = alignment_problem(small()[0])
    step = 1e-2 * np.concatenate([u.scales for u in joint.free]) * np.random.default_rng(2).normal(
        size=sum(u.manifold.tangent for u in joint.free))
    moved = joint.moved(joint.start, step)
    np.testing.assert_allclose(joint.difference(joint.start, moved), step, atol=1e-10)


def test_mistakes_are_refused():
    problem, _, _ = line()
    with pytest.raises(ValueError, match="share a name"):
        Problem((*problem.unknowns, problem.unknowns[0]), problem.residuals, problem.start)
    with pytest.raises(ValueError, match="no start value"):
        Problem(problem.unknowns, problem.residuals, {"offset": np.zeros(1)})
    with pytest.raises(ValueError, match="which the problem lacks"):
        Problem(problem.unknowns[:1], problem.residuals, problem.start)
    with pytest.raises(ValueError, match="takes no effects"):
        problem.with_effect("anything")
    with pytest.raises(KeyError):
        problem.unknown("nobody")
    assert replace(problem, effects=("x",)).with_effect("x").effects == ("x",)


def test_doppler_residuals_are_noise_however_coarse_the_star_tracker_is():
    """With a star tracker 20 times coarser, the angles of an epoch reach a degree: terms of second order in its error
    are larger than the Doppler noise, unless the kernel is taken at the estimated attitude."""
    scenario = preset("compact")
    scenario = replace(scenario, star_tracker_noise=tuple(20 * s for s in scenario.star_tracker_noise))
    campaign, _ = simulate(scenario, seed=3)
    estimate = solve(alignment_problem(alignment_model(campaign)))
    assert estimate.status == "ok"
    doppler = next(p for r, p in zip(estimate.problem.residuals, estimate.parts, strict=True) if r.name == "doppler")
    spread = np.sqrt(2 * doppler.measurements)
    assert abs(doppler.cost - doppler.measurements) < 4 * spread
