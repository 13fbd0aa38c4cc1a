"""Gauss-Newton with Levenberg-Marquardt damping on the manifold.

Two loops. The outer one takes the whitening (which may depend on the unknowns through noise inputs) and compressed
robust weights at the current point; the inner one minimizes with them frozen. Both stop together when a whole outer
pass moves the answer by less than ``tolerance`` posterior sigmas.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from estimator.estimate import Estimate
from estimator.models.errors import InfeasibleError
from estimator.observability import UNDETERMINED, determined
from estimator.problem import NormalEquations, Problem, normal_equations
from estimator.residuals import Linearization
from estimator.solvers.summary import summarized


@dataclass(frozen=True)
class Options:
    """How to iterate.

    Attributes:
        tolerance: largest step, in posterior sigmas of the whole tangent vector, that counts as converged.
        largest_step: limit of one step in each scaled tangent coordinate (units of the unknowns' scales).
        iterations: limit of all inner iterations together.
        damping: first Levenberg-Marquardt factor.
        progress: called with (iteration, cost) after each accepted step.
    """

    tolerance: float = 1e-6
    largest_step: float = np.inf
    iterations: int = 200
    damping: float = 1e-9
    progress: Callable[[int, float], None] | None = None


def solve(problem: Problem, options: Options | None = None) -> Estimate:
    """Minimize the joint cost from the problem's start.

    Args:
        problem: what to solve.
        options: see :class:`Options`.

    Returns:
        The estimate; its ``status`` is ``not_converged`` when the iteration limit or the damping limit was met.
    """
    options = options or Options()
    began = time.perf_counter()
    values: Mapping[str, np.ndarray] = dict(problem.start)
    iterations, reason, converged = 0, "", False
    prepared = problem.prepared(values)
    parts = prepared.linearize(values)
    equations = normal_equations(prepared, values, parts)
    while iterations < options.iterations:
        at_entry = values
        values, parts, used, reason = _minimize(prepared, values, parts, equations, options, iterations)
        iterations += used
        renewed = problem.prepared(values)
        # What has no whitening to renew has been linearized here already.
        parts = [part if new is old else new.linearize(values)
                 for new, old, part in zip(renewed.residuals, prepared.residuals, parts, strict=True)]
        prepared = renewed
        equations = normal_equations(prepared, values, parts)
        moved = _sigmas(equations, prepared, at_entry, values)
        decrement = _decrement(equations)
        if decrement < options.tolerance or (moved < options.tolerance and not reason):
            converged, reason = True, ""
            break
        if reason:
            # The damping limit may only mean that the frozen whitening had nothing left to gain.
            converged = decrement < 1e-3
            break
    if not converged and not reason:
        reason = f"no convergence in {iterations} iterations; the start may be far from any solution"
    return summarized(prepared, values, parts, converged=converged, reason=reason, iterations=iterations,
                      solver="gauss-newton", seconds=time.perf_counter() - began, equations=equations)


def _minimize(problem: Problem, values: Mapping[str, np.ndarray], parts: list[Linearization],
              equations: NormalEquations, options: Options, done: int,
              ) -> tuple[Mapping[str, np.ndarray], list[Linearization], int, str]:
    """Damped Gauss-Newton steps with frozen whitening until the step is small; returns the reason if it gives up."""
    damping, growth, used = options.damping, 4.0, 0
    scales = np.concatenate([np.zeros(0), *(u.scales for u in problem.free)])
    while done + used < options.iterations:
        step = _damped_step(equations, damping)
        longest = float(np.max(np.abs(step), initial=0.0))
        if longest > options.largest_step:
            step = step * (options.largest_step / longest)
        predicted = -float(2 * equations.gradient @ step + step @ equations.matrix @ step)
        size = float(np.sqrt(max(step @ equations.matrix @ step, 0.0)))
        if size < options.tolerance * 0.1:
            return values, parts, used, ""
        trial = problem.moved(values, step * scales)
        trial_parts, trial_equations = parts, None
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"), suppress(InfeasibleError):
            # A step may lead where a state diverges or cannot be propagated; what follows rejects it.
            trial_parts = problem.linearize(trial)
            trial_equations = normal_equations(problem, trial, trial_parts)
        used += 1
        actual = -np.inf if trial_equations is None else equations.cost - trial_equations.cost
        rounding = 1e-13 * abs(equations.cost) * np.sqrt(len(parts) + 1)
        lower = np.isfinite(actual) and (actual > 0 or abs(actual) <= rounding)
        if trial_equations is not None and lower:
            gain = actual / predicted if predicted > 0 else 1.0
            values, parts, equations = trial, trial_parts, trial_equations
            damping = max(damping * max(1 / 10, 1 - (2 * gain - 1) ** 3), 1e-12) if gain > 0.25 else damping * 2
            growth = 4.0
            if options.progress:
                options.progress(done + used, equations.cost)
            if abs(actual) <= rounding:
                return values, parts, used, ""
        else:
            if predicted <= rounding:
                return values, parts, used, ""
            damping = max(damping, 1e-9) * growth
            growth *= 2
            if damping > 1e16:
                return values, parts, used, "no step lowers the cost: a kernel may be discontinuous at this point"
    return values, parts, used, ""


def _damped_step(equations: NormalEquations, damping: float) -> np.ndarray:
    """Step in scaled coordinates; directions that the data do not determine get none."""
    matrix = equations.matrix
    diagonal = np.diag(matrix)
    if determined(matrix):
        factor = cho_factor(matrix + damping * np.diag(diagonal), lower=True, check_finite=False)
        return np.asarray(-cho_solve(factor, equations.gradient, check_finite=False))
    eigenvalues, vectors = np.linalg.eigh(matrix)
    kept = eigenvalues >= 1.0 / UNDETERMINED**2
    basis = vectors[:, kept]
    reduced = np.diag(eigenvalues[kept]) + damping * (basis.T * diagonal) @ basis
    return -basis @ np.linalg.solve(reduced, basis.T @ equations.gradient)


def _decrement(equations: NormalEquations) -> float:
    """Length of the undamped step in posterior sigmas."""
    step = _damped_step(equations, 0.0)
    return float(np.sqrt(max(step @ equations.matrix @ step, 0.0)))


def _sigmas(equations: NormalEquations, problem: Problem, before: Mapping[str, np.ndarray],
            after: Mapping[str, np.ndarray]) -> float:
    """Distance between two points in posterior sigmas."""
    scales = np.concatenate([np.zeros(0), *(u.scales for u in problem.free)])
    step = problem.difference(before, after) / scales
    return float(np.sqrt(max(step @ equations.matrix @ step, 0.0)))
