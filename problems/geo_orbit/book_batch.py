"""The book's 14 unknowns in one joint least-squares problem of the engine: orbit, thrust error, station, systematic
errors.

The measurement functions are those of the filters, and the estimate is the maximum of the posterior. Without process
noise (an infinite correlation interval) 14 numbers are unknown and the covariance reaches the Cramer-Rao bound. With
process noise (shaping filters of a finite interval, accelerations not modelled) the noise of every step, or of every
piece of some steps, is unknown too: increments of unit variance, each a residual of its own, so that the estimate is
that of the iterated smoother, by another algorithm.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

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
from estimator.signals import Values
from estimator.solvers import Options, solve
from estimator.unknowns import Manifold, Unknown, Vector
from problems.geo_orbit.book import OUTPUTS, SIZE, BookSystem, measurement, move_expression

GROUPS: tuple[tuple[str, slice, tuple[str, ...], str], ...] = (
    ("orbit", slice(0, 6), STATE_NAMES, "m, rad, m/s, rad/s"),
    ("thrust_error", slice(6, 7), ("acceleration",), "m/s2"),
    ("station", slice(7, 10), ("longitude", "latitude", "altitude"), "rad, m"),
    ("systematic_errors", slice(10, 14), ("range", "range rate", "north cosine", "east cosine"), "m, m/s, 1"),
)
"""The unknowns as groups of the 14 components: name, components, labels, unit."""

MOST_INCREMENTS = 6000
"""Increments of process noise in one problem; the solver's time grows with the cube of their number."""


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


@lru_cache(maxsize=1)
def _driven_kernel() -> Kernel:
    return Kernel(
        "book_driven_measurement",
        [],
        [("state", Vector(SIZE))],
        [("measured", OUTPUTS), ("angle", 1)],
        [],
        lambda seen: seen["measured"] - measurement(seen["state"], seen["angle"]),
    )


@dataclass(frozen=True, eq=False)
class DrivenMotion:
    """The 14 components after each step, driven by unknown increments: a signal of the engine.

    ``state[k+1] = f_k(state[k]) + L w_p`` at the last step of each piece, with the filters' own ``f_k``; ``L L'`` is
    the process noise of the piece; ``w_p`` has unit variance.

    Attributes:
        name: the kernel's input.
        system: the case with its process noise.
        starts: the unknowns of the first state, in the order of :data:`GROUPS`.
        increments: the unknown of all increments, piece by piece.
        piece: steps in one piece; 1 is the filters' model exactly. A longer piece lets the noise of all its steps
            (exact for the shaping filters) act at its end.
        samples: (n,) step after which each sample is taken, ascending.
    """

    name: str
    system: BookSystem
    starts: tuple[Unknown, ...]
    increments: Unknown
    piece: int
    samples: np.ndarray
    _last: dict[str, tuple[bytes, tuple[np.ndarray, np.ndarray]]] = field(default_factory=dict, repr=False)

    @property
    def manifold(self) -> Manifold:
        return Vector(SIZE)

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        return (*self.starts, self.increments)

    @cached_property
    def root(self) -> np.ndarray:
        """``L`` (14, rank)."""
        return noise_root(self.system, self.piece)

    def evaluate(self, values: Values) -> tuple[np.ndarray, np.ndarray]:
        key = b"".join(np.asarray(values[u.name], dtype=float).tobytes() for u in self.unknowns)
        if self._last.get("answer", (b"",))[0] != key:  # solvers ask again at the point where they were
            self._last["answer"] = key, self._carried(values)
        return self._last["answer"][1]

    def _carried(self, values: Values) -> tuple[np.ndarray, np.ndarray]:
        rank = self.root.shape[1]
        steps = int(self.samples[-1]) + 1 if len(self.samples) else 0
        w = np.asarray(values[self.increments.name]).reshape(-1, rank)
        x = np.concatenate([values[u.name] for u in self.starts])[None]
        slope = np.zeros((SIZE, SIZE + w.size))
        slope[:, :SIZE] = np.eye(SIZE)
        states, slopes = np.empty((len(self.samples), SIZE)), np.zeros((len(self.samples), *slope.shape))
        used, row = SIZE, 0
        for k in range(steps):
            x, phi = self.system.propagate(k, x)
            slope[:, :used] = phi[0] @ slope[:, :used]
            if (k + 1) % self.piece == 0:
                p = k // self.piece
                x = x + self.root @ w[p]
                slope[:, used : used + rank] = self.root
                used += rank
            while row < len(self.samples) and self.samples[row] == k:
                states[row], slopes[row, :, :used] = x[0], slope[:, :used]
                row += 1
        return states, slopes

    def symbolic(self, values: Mapping[str, ca.MX]) -> ca.MX:
        case, rank = self.system.case, self.root.shape[1]
        x = ca.vertcat(*(values[u.name] for u in self.starts))
        w = values[self.increments.name]
        columns, wanted = [], {int(k) for k in self.samples}
        for k in range(int(self.samples[-1]) + 1):
            on = 1.0 if self.system.burning(k) else 0.0
            x = move_expression()(x, on * case.thrust, on, case.step, ca.DM(self.system.shaping_factors))
            if (k + 1) % self.piece == 0:
                first = (k // self.piece) * rank
                x = x + ca.mtimes(ca.DM(self.root), w[first : first + rank])
            if k in wanted:
                columns.append(x)
        return ca.horzcat(*columns)

    def subset(self, keep: np.ndarray) -> DrivenMotion:
        return replace(self, samples=self.samples[keep], _last={})


def noise_root(system: BookSystem, piece: int = 1) -> np.ndarray:
    """A root ``L`` (14, rank) of the process noise of ``piece`` steps together, ``L L' = Q``."""
    whole = BookSystem(replace(system.case, step=piece * system.case.step), system.inflation)
    q = whole.process_noise(0)
    scale = np.sqrt(np.diag(q))
    alive = np.flatnonzero(scale)
    values, vectors = np.linalg.eigh(q[np.ix_(alive, alive)] / np.outer(scale[alive], scale[alive]))
    kept = values > 1e-12 * values.max(initial=0.0)
    root = np.zeros((SIZE, int(kept.sum())))
    root[alive] = scale[alive, None] * vectors[:, kept] * np.sqrt(values[kept])
    return root


def batch_problem(
    system: BookSystem,
    measurements: np.ndarray,
    *,
    with_prior: bool = True,
    loss: Loss | None = None,
    piece: int = 1,
) -> Problem:
    """The joint problem of one realization.

    Args:
        system: the case. With process noise (a finite correlation interval, or inflation) the noise is an unknown of
            its own, "increments", with unit variance; see :class:`DrivenMotion`.
        measurements: (steps, 4).
        with_prior: whether the prior of :class:`problems.geo_orbit.book.BookCase` enters the cost; without it the
            problem says which directions the data alone leave open. Increments always have theirs.
        loss: robust loss.
        piece: steps that share one increment of process noise.

    Raises:
        RequestError: ``piece`` is below one or leaves more than :data:`MOST_INCREMENTS` increments.
    """
    case = system.case
    unknowns = _unknowns(case.prior, with_prior)
    time = np.arange(system.steps + 1) * case.step
    on = np.array([1.0 if system.burning(k) else 0.0 for k in range(system.steps)])
    angle = case.greenwich + EARTH_ROTATION_RATE * time[1:]
    first = case.first_state
    start = {name: first[part] for name, part, _, _ in GROUPS}
    signal: PropagatedSignal | DrivenMotion
    if np.isfinite(case.interval) or system.inflation:
        increments = _increments(system, piece)
        signal = DrivenMotion("state", system, tuple(unknowns.values()), increments, piece, np.arange(system.steps))
        kernel = _driven_kernel()
        unknowns[increments.name] = increments
        start[increments.name] = np.zeros(increments.manifold.ambient)
    else:
        signal = PropagatedSignal(
            "state",
            _flow(unknowns["thrust_error"]),
            (unknowns["orbit"],),
            time,
            np.zeros((len(time), 0)),
            np.column_stack([case.thrust * on, on]),
            np.arange(1, len(time)),
        )
        kernel = _kernel(unknowns["station"], unknowns["systematic_errors"])
    residual = KernelResidual(
        "station",
        "tracking",
        "m, m/s, 1",
        kernel,
        (signal,),
        {"measured": measurements, "angle": angle[:, None]},
        np.tile(case.sigma_noise, (system.steps, 1)),
        time[1:],
        np.zeros(system.steps, dtype=int),
        ("station",),
        loss=loss or Quadratic(),
    )
    held = frozenset() if on.any() else frozenset({"thrust_error"})
    return Problem(tuple(unknowns.values()), (residual,), start, held)


def _increments(system: BookSystem, piece: int) -> Unknown:
    if piece < 1:
        raise RequestError("a piece of process noise has no steps", where="piece", value=piece, limit="at least 1")
    number = system.steps // piece * noise_root(system, piece).shape[1]
    if number > MOST_INCREMENTS:
        raise RequestError(
            "process noise has too many increments for one joint problem",
            where="piece",
            value=f"{number} increments",
            limit=str(MOST_INCREMENTS),
            remedy=f"share one increment between at least {-(-piece * number // MOST_INCREMENTS)} steps, or use the "
            "iterated smoother, which estimates the same",
        )
    return Unknown("increments", Vector(number), "1", 1.0, prior=True, nuisance=True, description="process noise")


def batch_estimate(
    system: BookSystem, measurements: np.ndarray, options: Options | None = None, *, piece: int = 1
) -> Estimate:
    """Solve :func:`batch_problem` from the prior's mean, over a horizon that grows from an hour to the whole span.

    A prior of hundreds of kilometres is beyond the reach of a direct solve over a day in one run of fifteen.

    Raises:
        RequestError: see :func:`batch_problem`.
    """
    problem = batch_problem(system, measurements, piece=piece)
    residual = problem.residuals[0]
    assert isinstance(residual, KernelResidual)
    values = dict(problem.start)
    horizon = 3600.0  # s
    while horizon < system.case.span:
        if "increments" in problem.start:  # the increments after the horizon only cost time
            steps = int(horizon / system.case.step)
            short = BookSystem(replace(system.case, span=steps * system.case.step), system.inflation)
            part = batch_problem(short, measurements[:steps], piece=piece)
        else:
            part = problem.with_residuals([residual.subset(residual.time <= horizon)])
        values.update(_from(part, values, Options(tolerance=1e-2, iterations=60)).values)
        horizon *= 2.5
    return _from(problem, values, options or Options(tolerance=1e-4))


def _from(problem: Problem, values: dict[str, np.ndarray], options: Options) -> Estimate:
    """Solve from ``values`` while the prior stays centred at the problem's own start.

    Increments start at zero, where their prior is, so theirs needs no residual.
    """
    near = {u.name: values[u.name] for u in problem.unknowns if not u.nuisance}
    return solve(with_prior_residuals(problem).starting_at(near), options)


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

    Every prior that enters the cost becomes one measurement of its unknown by its start value; nuisance unknowns keep
    theirs as it is.
    """
    free = {u.name for u in problem.free}
    unknowns, residuals = [], list(problem.residuals)
    for u in problem.unknowns:
        if u.nuisance:
            unknowns.append(u)
            continue
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
    """Cramer-Rao bound (14, 14) at a true first state (14,): the information of data and prior, linearized there.

    With process noise the linearization is about the motion without it.
    """
    problem = batch_problem(system, np.zeros((system.steps, OUTPUTS)))
    problem = problem.freeing("thrust_error")
    values = {**problem.start, **{name: np.asarray(truth[part]) for name, part, _, _ in GROUPS}}
    equations = normal_equations(problem, values, problem.linearize(values))
    scales = np.concatenate([u.scales for u in problem.free])
    return np.asarray((np.linalg.inv(equations.matrix) * np.outer(scales, scales))[:SIZE, :SIZE])
