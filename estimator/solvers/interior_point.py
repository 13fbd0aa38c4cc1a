"""IPOPT on the same expressions, as an independent check of Gauss-Newton.

Gauss-Newton chains Jacobians by hand: kernel by kernel, signal by signal, sensitivities carried along the arcs. Here
the same kernels and step functions are put together into ONE CasADi expression of the whole cost, which CasADi's
algorithmic differentiation treats as it likes; nothing of the hand-made chain is used. The coordinates are tangent
steps from the start, turned and scaled by the Gauss-Newton matrix there, so that IPOPT's quasi-Newton iterations see
a cost whose curvature is near the identity.
"""

from __future__ import annotations

import time

import casadi as ca
import numpy as np

from estimator.estimate import Estimate
from estimator.losses import Quadratic
from estimator.observability import UNDETERMINED
from estimator.problem import Problem, normal_equations
from estimator.solvers.summary import summarized
from estimator.unknowns import offsets

ROUNDS = 6
"""Whitening is frozen inside one IPOPT run and renewed between runs, at most this many times."""


def solve_with_ipopt(problem: Problem, *, tolerance: float = 1e-9) -> Estimate:
    """Minimize the joint cost with IPOPT from the problem's start.

    Args:
        problem: what to solve; every loss must be quadratic and the position residual without effects.
        tolerance: IPOPT's ``tol``, in posterior sigmas.

    Raises:
        ValueError: a residual has a robust loss.
    """
    if any(not isinstance(getattr(r, "loss", Quadratic()), Quadratic) for r in problem.residuals):
        raise ValueError("the check by IPOPT takes quadratic losses alone")
    began = time.perf_counter()
    values = dict(problem.start)
    free = problem.free
    columns = offsets(free)
    scales = np.concatenate([np.zeros(0), *(u.scales for u in free)])
    iterations, status, moved = 0, "", np.inf
    for _ in range(ROUNDS):
        prepared = problem.prepared(values)
        equations = normal_equations(prepared, values, prepared.linearize(values))
        eigenvalues, vectors = np.linalg.eigh(equations.matrix)
        kept = eigenvalues >= 1.0 / UNDETERMINED**2
        whitening = scales[:, None] * vectors[:, kept] / np.sqrt(eigenvalues[kept])
        y = ca.MX.sym("y", int(kept.sum()))
        step = ca.mtimes(ca.DM(whitening), y)
        symbols = {}
        for u in problem.unknowns:
            point = ca.DM(np.asarray(values[u.name], dtype=float))
            symbols[u.name] = u.manifold.retract(point, step[columns[u.name]]) if u.name in columns else ca.MX(point)
        cost = sum((0.5 * ca.sumsqr(r.symbolic(symbols)) for r in prepared.residuals), ca.MX(0))
        deviation, active = problem.prior_terms(values)
        if active.any():
            cost += 0.5 * ca.sumsqr((ca.DM(deviation) + step / ca.DM(scales))[np.flatnonzero(active).tolist()])
        reference = 0.5 * equations.cost
        solver = ca.nlpsol("joint", "ipopt", {"x": y, "f": cost - reference}, {
            "print_time": False,
            "ipopt": {"print_level": 0, "sb": "yes", "hessian_approximation": "limited-memory",
                      "limited_memory_max_history": 30, "tol": tolerance, "acceptable_iter": 0, "max_iter": 300,
                      "nlp_scaling_method": "none"},
        })
        solution = solver(x0=np.zeros(y.shape[0]))
        stats = solver.stats()
        iterations += int(stats["iter_count"])
        status = str(stats["return_status"])
        optimum = np.asarray(solution["x"]).ravel()
        values = prepared.moved(values, whitening @ optimum)
        moved = float(np.linalg.norm(optimum))
        if moved < 1e-5:
            break
    prepared = problem.prepared(values)
    return summarized(prepared, values, prepared.linearize(values), converged=moved < 1e-3,
                      reason=f"IPOPT stopped with {status} after {iterations} iterations", iterations=iterations,
                      solver="ipopt", seconds=time.perf_counter() - began)
