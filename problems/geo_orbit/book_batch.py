"""The book's 14 unknowns in one joint least-squares problem of the engine: orbit, thrust error, station, systematic
errors.

The measurement functions are those of the filters. Without process noise (an infinite correlation interval) its
estimate is the maximum of the posterior, and its covariance reaches the Cramer-Rao bound.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np

from estimator.estimate import Estimate
from estimator.losses import Loss, Quadratic
from estimator.models.earth_orientation import EARTH_ROTATION_RATE
from estimator.models.errors import RequestError
from estimator.models.orbit_spherical import STATE_NAMES, spherical_rates
from estimator.problem import Problem, normal_equations
from estimator.propagation import Flow, PropagatedSignal
from estimator.residuals import Kernel, KernelResidual
from estimator.solvers import Options, solve
from estimator.unknowns import Unknown, Vector
from problems.geo_orbit.book import OUTPUTS, BookSystem, measurement

GROUPS: tuple[tuple[str, slice, tuple[str, ...], str], ...] = (
    ("orbit", slice(0, 6), STATE_NAMES, "m, rad, m/s, rad/s"),
    ("thrust_error", slice(6, 7), ("acceleration",), "m/s2"),
    ("station", slice(7, 10), ("longitude", "latitude", "altitude"), "rad, m"),
    ("systematic_errors", slice(10, 14), ("range", "range rate", "north cosine", "east cosine"), "m, m/s, 1"),
)
"""The unknowns as groups of the 14 components: name, components, labels, unit."""


def _unknowns(prior: np.ndarray, with_prior: bool) -> dict[str, Unknown]:
    return {
        name: Unknown(name, Vector(len(labels), labels), unit, tuple(prior[part]), prior=with_prior)
        for name, part, labels, unit in GROUPS
    }


@lru_cache(maxsize=8)
def _flow(thrust_error: Unknown) -> Flow:
    def derivative(state, shared, inputs, held, step, fraction):  # type: ignore[no-untyped-def]
        return spherical_rates(state["orbit"], held[0] + held[1] * shared["thrust_error"])

    return Flow("book_flow", [("orbit", Vector(6))], ["orbit"], [thrust_error], 0, 2, derivative)


@lru_cache(maxsize=8)
def _kernel(station: Unknown, errors: Unknown) -> Kernel:
    def build(seen: dict[str, ca.SX]) -> ca.SX:
        x = ca.vertcat(seen["state"], 0, seen["station"], seen["systematic_errors"])
        return seen["measured"] - measurement(x, seen["angle"])

    return Kernel(
        "book_measurement", [station, errors], [("state", Vector(6))], [("measured", OUTPUTS), ("angle", 1)], [], build
    )


def batch_problem(
    system: BookSystem, measurements: np.ndarray, *, with_prior: bool = True, loss: Loss | None = None
) -> Problem:
    """The joint problem of one realization.

    Args:
        system: the case; its shaping filters must be formal (an infinite correlation interval).
        measurements: (steps, 4).
        with_prior: whether the prior of :class:`problems.geo_orbit.book.BookCase` enters the cost; without it the
            problem says which directions the data alone leave open.
        loss: robust loss.

    Raises:
        RequestError: the case has process noise.
    """
    case = system.case
    if np.isfinite(case.interval) or system.inflation:
        raise RequestError(
            "the joint batch takes systematic errors as constants",
            where="interval",
            value=case.interval,
            limit="infinite",
            remedy="use the iterated smoother, which estimates the same with process noise",
        )
    unknowns = _unknowns(case.prior, with_prior)
    time = np.arange(system.steps + 1) * case.step
    on = np.array([1.0 if system.burning(k) else 0.0 for k in range(system.steps)])
    flow = _flow(unknowns["thrust_error"])
    signal = PropagatedSignal(
        "state",
        flow,
        (unknowns["orbit"],),
        time,
        np.zeros((len(time), 0)),
        np.column_stack([case.thrust * on, on]),
        np.arange(1, len(time)),
    )
    angle = case.greenwich + EARTH_ROTATION_RATE * time[1:]
    residual = KernelResidual(
        "station",
        "tracking",
        "m, m/s, 1",
        _kernel(unknowns["station"], unknowns["systematic_errors"]),
        (signal,),
        {"measured": measurements, "angle": angle[:, None]},
        np.tile(case.sigma_noise, (system.steps, 1)),
        time[1:],
        np.zeros(system.steps, dtype=int),
        ("station",),
        loss=loss or Quadratic(),
    )
    first = case.first_state
    start = {name: first[part] for name, part, _, _ in GROUPS}
    held = frozenset() if on.any() else frozenset({"thrust_error"})
    return Problem(tuple(unknowns.values()), (residual,), start, held)


def batch_estimate(system: BookSystem, measurements: np.ndarray, options: Options | None = None) -> Estimate:
    """Solve :func:`batch_problem` from the prior's mean, over a horizon that grows from an hour to the whole span.

    A prior of hundreds of kilometres is beyond the reach of a direct solve over a day in one run of fifteen.
    """
    problem = batch_problem(system, measurements)
    residual = problem.residuals[0]
    assert isinstance(residual, KernelResidual)
    values = dict(problem.start)
    horizon = 3600.0  # s
    while horizon < system.case.span:
        part = problem.with_residuals([residual.subset(residual.time <= horizon)])
        values = dict(_from(part, values, Options(tolerance=1e-2, iterations=60)).values)
        horizon *= 2.5
    return _from(problem, values, options or Options(tolerance=1e-4))


def _from(problem: Problem, values: dict[str, np.ndarray], options: Options) -> Estimate:
    """Solve from ``values`` while the prior stays centred at the problem's own start."""
    return solve(with_prior_residuals(problem).starting_at(values), options)


@lru_cache(maxsize=8)
def _prior_kernel(unknown: Unknown) -> Kernel:
    return Kernel(
        f"prior_{unknown.name}",
        [unknown],
        [],
        [("measured", unknown.manifold.tangent)],
        [],
        lambda seen: seen["measured"] - seen[unknown.name],
    )


def with_prior_residuals(problem: Problem) -> Problem:
    """The same problem with the priors as residuals of their own, so that it may start anywhere.

    Every prior that enters the cost becomes one measurement of its unknown by its start value.
    """
    free = {u.name for u in problem.free}
    unknowns, residuals = [], list(problem.residuals)
    for u in problem.unknowns:
        plain = replace(u, prior=False)
        unknowns.append(plain)
        if u.prior and u.name in free:
            residuals.append(
                KernelResidual(
                    f"prior of {u.name}",
                    "prior",
                    u.unit,
                    _prior_kernel(plain),
                    (),
                    {"measured": np.asarray(problem.start[u.name])[None, :]},
                    u.scales[None, :],
                    np.zeros(1),
                    np.zeros(1, dtype=int),
                    ("prior",),
                )
            )
    return replace(problem, unknowns=tuple(unknowns), residuals=tuple(residuals))


def stacked(estimate: Estimate) -> np.ndarray:
    """The estimate's 14 components."""
    return np.concatenate([estimate.values[name] for name, *_ in GROUPS])


def batch_bound(system: BookSystem, truth: np.ndarray) -> np.ndarray:
    """Cramer-Rao bound (14, 14) at a true first state (14,): the information of data and prior, linearized there."""
    problem = batch_problem(system, np.zeros((system.steps, OUTPUTS)))
    problem = problem.freeing("thrust_error")
    values = {name: np.asarray(truth[part]) for name, part, _, _ in GROUPS}
    equations = normal_equations(problem, values, problem.linearize(values))
    scales = np.concatenate([u.scales for u in problem.free])
    return np.linalg.inv(equations.matrix) * np.outer(scales, scales)
