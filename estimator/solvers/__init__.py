"""Solvers of one :class:`estimator.problem.Problem`: Gauss-Newton on the manifold, and IPOPT as a check."""

from estimator.solvers.gauss_newton import Options, solve
from estimator.solvers.interior_point import solve_with_ipopt

__all__ = ["Options", "solve", "solve_with_ipopt"]
