"""A solve that may start anywhere: horizons that grow along the arcs, and turned quaternions where that is not enough.

A state carried along a long arc with a wrong inertia tensor or a wrong rate is wrong by whole turns at its end, where
the cost has many valleys; over the first seconds it has one. So the arcs are first cut to a short horizon, solved
(directions that so little data leave open do not move), and lengthened step by step from the last answer. If some
residual still is far above its noise, the inertia tensor is tried from the spherical one, and each quaternion that
feeds it from turned starts on thinned data; the best is carried on.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.estimate import Estimate
from estimator.problem import Problem, normal_equations
from estimator.propagation import PropagatedSignal
from estimator.residuals import KernelResidual, Residual
from estimator.solvers.gauss_newton import Options, solve
from estimator.unknowns import NormalizedInertia, UnitQuaternion

GROWTH = 3.0  # from one horizon to the next
FIRST_SAMPLES = 12  # of an arc inside the first horizon
FAR = 25.0  # mean whitened square above which a residual counts as far from its noise
THINNED = 150  # samples of a residual in the trial of turned quaternions


def solve_from_anywhere(problem: Problem, options: Options | None = None) -> Estimate:
    """Minimize the joint cost from a start that may be far from any solution.

    Args:
        problem: what to solve.
        options: of the last Gauss-Newton solve.

    Returns:
        The estimate from the plain start when that explains the data, else the best of the continued ones.
    """
    options = options or Options()
    coarse = Options(tolerance=1e-2, iterations=60, largest_step=30.0, damping=1e-4)
    values: Mapping[str, np.ndarray] = dict(problem.start)
    if _far(problem, values):
        values = _grown(problem, values, coarse)
    best = solve(problem.starting_at(values), replace(options, largest_step=min(options.largest_step, 100.0)))
    if not _far(problem, best.values):
        return best
    for u in problem.free:
        if isinstance(u.manifold, NormalizedInertia):
            sphere = {**problem.start, u.name: np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]) / 3}
            again = solve(problem.starting_at(_grown(problem, sphere, coarse)), options)
            best = min(best, again, key=_cost)
    if not _far(problem, best.values):
        return best
    for name in _suspects(problem, best.values):
        turned = _turned(problem, best.values, name, coarse)
        again = solve(problem.starting_at(turned), options)
        best = min(best, again, key=_cost)
    return best


def _cost(estimate: Estimate) -> float:
    return sum(part.cost for part in estimate.parts)


def _mean_squares(problem: Problem, values: Mapping[str, np.ndarray]) -> list[tuple[Residual, float]]:
    prepared = problem.prepared(values)
    return [(r, float(np.mean(p.whitened**2)) if r.channel != "gnss" else p.cost / max(p.measurements, 1.0))
            for r, p in zip(prepared.residuals, prepared.linearize(values), strict=True)]


def _far(problem: Problem, values: Mapping[str, np.ndarray]) -> bool:
    return any(not np.isfinite(m) or m > FAR for _, m in _mean_squares(problem, values))


def _propagated(residual: Residual) -> bool:
    return isinstance(residual, KernelResidual) and any(isinstance(s, PropagatedSignal) for s in residual.signals)


def _grown(problem: Problem, values: Mapping[str, np.ndarray], coarse: Options) -> Mapping[str, np.ndarray]:
    """Solve on short horizons first, then on longer ones."""
    lengths: dict[str, np.ndarray] = {}
    for r in problem.residuals:
        if isinstance(r, KernelResidual) and _propagated(r):
            lengths[r.name] = r.time - r.time[0]
    if not lengths:
        return values
    longest = max(float(v[-1]) for v in lengths.values())
    horizon = max(float(np.median([v[min(FIRST_SAMPLES, len(v) - 1)] for v in lengths.values()])), 1e-6)
    while horizon < longest:
        residuals = [r.subset(lengths[r.name] <= horizon)
                     if isinstance(r, KernelResidual) and r.name in lengths else r for r in problem.residuals]
        values = solve(problem.with_residuals(residuals).starting_at(values), coarse).values
        horizon *= GROWTH
    return values


def _suspects(problem: Problem, values: Mapping[str, np.ndarray]) -> list[str]:
    """Shared quaternions that feed a residual far from its noise, in order."""
    far = [r for r, m in _mean_squares(problem, values) if m > FAR or not np.isfinite(m)]
    return [u.name for u in problem.free if isinstance(u.manifold, UnitQuaternion) and not u.nuisance
            and any(u.name == v.name for r in far for v in r.unknowns)]


def _turned(problem: Problem, values: Mapping[str, np.ndarray], name: str,
            coarse: Options) -> Mapping[str, np.ndarray]:
    """The best of 24 turned starts of one quaternion, each polished on thinned data of the residuals that it feeds."""
    residuals = []
    for r in problem.residuals:
        if any(u.name == name for u in r.unknowns) and isinstance(r, KernelResidual):
            stride = max(1, r.samples // THINNED)
            residuals.append(r.subset(np.arange(r.samples) % stride == 0))
    held = [u.name for u in problem.free if u.name != name]
    small = problem.with_residuals(residuals).holding(*held)
    best_cost, best = np.inf, values
    for turn in Rotation.create_group("O"):
        start = (turn * Rotation.from_quat(values[name], scalar_first=True)).as_quat(scalar_first=True)
        found = solve(small.starting_at({**values, name: start}), coarse)
        prepared = small.prepared(found.values)
        cost = normal_equations(prepared, found.values, prepared.linearize(found.values)).cost
        if cost < best_cost:
            best_cost, best = cost, {**values, name: found.values[name]}
    return _grown(problem, best, coarse)
