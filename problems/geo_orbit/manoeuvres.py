"""How many manoeuvres are in a long set of tracking data, when, how large, how long: found from the data alone.

A kept satellite leaves the orbit that one set of initial conditions gives every few days or hours, and nothing of
metres can be seen before these velocity steps are in the model. :func:`find_manoeuvres` finds them:

1. Short stretches of data are fitted one by one; the quietest gives the noise and is where the search starts.
2. The fitted stretch grows, forward and then backward in time, a part of a revolution at a time. After a velocity step
   at time u the state differs by ``Phi(t, u) B dv``, Phi being the transition matrix of the orbit's own variational
   equations, so for every u the likelihood ratio of a step is one linear problem with three unknowns (generalized
   likelihood ratio test, Willsky and Jones 1976). Where the best u is significant, the step's time and velocity are
   refined with everything else, and so is the length of the burn. A step of the wrong time is moved before a second
   one is added.
3. One joint fit: one orbit, all manoeuvres with their times, the calibration of the stations, extended from the quiet
   stretch as far as one orbit fits. What is not significant there leaves, and the probability of a false name after all
   places that were tried is stated.

One continuous orbit is fitted rather than independent arcs: a manoeuvre changes the velocity only, so that each costs
four numbers instead of six and the positions before and after bind each other. Between steps the model of the forces is
that of the settings.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import solve_triangular
from scipy.stats import chi2, f

from estimator.discrepancy.score import rows_of
from estimator.models.errors import InfeasibleError, TooFewDataError
from estimator.models.orbit_integration import Tolerance
from estimator.orbit_signal import OrbitArc, OrbitSignal, VelocityStep
from estimator.problem import Problem
from estimator.residuals import KernelResidual, Linearization
from estimator.unknowns import Unknown, Vector
from problems.geo_orbit.engine import Engine, engine_of

Say = Callable[[str], None]
Values = dict[str, np.ndarray]

FAMILY = "impulsive-manoeuvre"
LEVEL = 1e-3  # probability of a manoeuvre where there is none, over the whole search
_LOOSE = Tolerance(1e-12, (1e-3, 1e-3, 1e-3, 1e-7, 1e-7, 1e-7))  # m, m/s: below tracking noise over some revolutions
_TIGHT = Tolerance(1e-14, (2e-5, 2e-5, 2e-5, 1e-9, 1e-9, 1e-9))  # what 1e-7 m/s make in a month is a metre
MONTHS = 14.0  # revolutions from which data tell what turns the orbit against Sun and Moon
_SHORTLY = 4.0  # revolutions over which the loose one does
_KEPT = 3.0  # revolutions of data that the growing stretch keeps
_GROWTH = 0.5  # revolutions by which it grows
_GRID = 48  # tried edges of a burn per revolution
_DOUBT = 1e-7  # p-value of a burn near the growing edge below which it is fitted
_MOST_PER_GROWTH = 4
_AFTER = 0.3  # revolutions of data after the first sign of a step that are used to place it
_INFLATED = 3.0  # factor on the sigmas of the calibration that the quiet data tell
_BACK = 0.4  # revolutions before the first sign of a step in which it is looked for
_JOINED = 6.0  # revolutions by which the joint fit is extended
_LONGER = 0.3  # or by this part of what it spans
_NEEDED = 1.1  # growth of what is left that tells that what was dropped was needed
_LOUD = 2.0  # mean square over the usual one where more is looked for
_MOST_COMPLETED = 12
_PASSES = 3
_ALIKE = 0.1  # relative difference of lengths that is none
_GROWN = 1.3  # growth of what is left, by an extension, that something in it explains
_BESIDE = 1.6  # revolutions on both sides of a manoeuvre that are fitted to tell what it is
_BROKEN = 16.0  # mean square over that of quiet data beyond which one orbit does not fit
_EDGE_STEP = 3600.0  # s that an edge of a burn moves in the first step of a fit
_FASTEST = 50.0  # m/s, prior sigma of a velocity step
_LONGEST = 0.25  # revolutions, prior sigma of the duration of a burn
_ROUGHEST = 4.0  # mean square over that of quiet data that growing fits may make the measure of the joint fit
_SURE = 3.0  # sigmas
_CURVED = 1e3  # growth of the cost in a step that may be curvature alone
_LARGEST_TURN = 0.1  # rad of a step that turns the orbit
_SHORT = 0.005  # revolutions that a burn of an engine takes, below which it is an impulse
_NOISIER = 1.5  # factor on the noise of all data that the quiet stretches of a part of them may reach


@dataclass(frozen=True, eq=False)
class Manoeuvre:
    """One found manoeuvre.

    Attributes:
        time: of the impulse or the middle of the burn, s after the epoch.
        velocity: (3,) radial, along-track, cross-track, m/s.
        duration: s; 0 for an impulse.
    """

    time: float
    velocity: np.ndarray
    duration: float = 0.0

    @property
    def burning(self) -> bool:
        """Whether it takes time."""
        return self.duration > 0

    def unknown(self, name: str) -> Unknown:
        """The unknown that holds it: time, three velocities and, for a burn, the duration."""
        if self.burning:
            return Unknown(name, Vector(5, ("time", "radial", "along", "cross", "duration")), "s, m/s, m/s, m/s, s",
                           (600.0, 0.1, 0.1, 0.1, 600.0))
        return Unknown(name, Vector(4, ("time", "radial", "along", "cross")), "s, m/s", (600.0, 0.1, 0.1, 0.1))

    @property
    def start(self) -> np.ndarray:
        """Values of :meth:`unknown`."""
        return np.array([self.time, *self.velocity, *([self.duration] if self.burning else [])])

    @staticmethod
    def of(values: np.ndarray) -> Manoeuvre:
        """From the values of :meth:`unknown`."""
        return Manoeuvre(float(values[0]), np.array(values[1:4]), float(values[4]) if len(values) == 5 else 0.0)


@dataclass(frozen=True, eq=False)
class Prior:
    """Gaussian knowledge of some unknowns: ``root (value - mean)`` is noise of size one.

    Attributes:
        names: of the unknowns, in the order of ``mean`` (n,) and of the columns of ``root`` (k, n).
    """

    names: tuple[str, ...]
    mean: np.ndarray
    root: np.ndarray

    @staticmethod
    def of(name: str, mean: np.ndarray, sigma: np.ndarray) -> Prior:
        """Independent numbers of one unknown."""
        return Prior((name,), np.asarray(mean, dtype=float), np.diag(1.0 / np.asarray(sigma, dtype=float)))


@dataclass(frozen=True, eq=False)
class Fit:
    """A Gauss-Newton fit of a stretch of data.

    Attributes:
        problem, values, parts: what was fitted and where it ended.
        unknowns: in the order of the columns.
        residual: (n,) rows over their noise; jacobian: (n, p) in units of the unknowns' scales.
        prior: (k, p) rows of the priors in the same units; off: (k,) their residuals.
        time: (n,) s of the rows.
        square: sum of squares of ``residual``.
    """

    problem: Problem
    values: Values
    parts: Sequence[Linearization]
    unknowns: tuple[Unknown, ...]
    residual: np.ndarray
    jacobian: np.ndarray
    prior: np.ndarray
    off: np.ndarray
    time: np.ndarray

    @property
    def square(self) -> float:
        """Sum of squares of the fitted rows."""
        return float(self.residual @ self.residual)

    @property
    def rows(self) -> int:
        """Number of fitted rows."""
        return len(self.residual)

    @property
    def degrees(self) -> int:
        """Rows less fitted numbers that the rows determine."""
        return max(self.rows - min(self.jacobian.shape[1], self.rows - 1), 1)

    @property
    def scales(self) -> np.ndarray:
        """Scale of every column."""
        return np.concatenate([np.broadcast_to(u.scales, u.manifold.tangent) for u in self.unknowns])

    def columns(self, name: str) -> slice:
        """Columns of an unknown."""
        at = 0
        for u in self.unknowns:
            if u.name == name:
                return slice(at, at + u.manifold.tangent)
            at += u.manifold.tangent
        raise KeyError(name)

    def knowledge(self, names: Sequence[str], factor: float) -> Prior:
        """What the fit knows of some unknowns, all others being free, with sigmas ``factor`` times as large."""
        rest = np.ones(self.jacobian.shape[1], dtype=bool)
        for n in names:
            rest[self.columns(n)] = False
        order = np.concatenate([np.flatnonzero(rest), np.flatnonzero(~rest)])
        upper = np.asarray(np.linalg.qr(np.vstack([self.jacobian, self.prior])[:, order], mode="r"))
        k = int(rest.sum())
        kept = tuple(u.name for u in self.unknowns if u.name in names)
        mean = np.concatenate([np.atleast_1d(self.values[n]) for n in kept])
        # Columns in the order of the unknowns, which is that of ``kept``.
        return Prior(kept, mean, upper[k:, k:] / self.scales[~rest] / factor)

    def covariance(self) -> np.ndarray:
        """Posterior covariance (p, p) in the unknowns' units."""
        r = np.linalg.qr(np.vstack([self.jacobian, self.prior]), mode="r")
        inverse = solve_triangular(r, np.eye(len(r)))
        root = inverse * self.scales[:, None]
        return root @ root.T

    def absorbed(self) -> tuple[np.ndarray, np.ndarray]:
        """See :attr:`_absorbed`."""
        return self._absorbed

    @cached_property
    def _absorbed(self) -> tuple[np.ndarray, np.ndarray]:
        """Orthonormal columns (n, p) of what the fit absorbs, and the residual (n,) that it would end with.

        Both to first order, so that the fit need not be at its optimum.
        """
        basis = np.linalg.qr(np.vstack([self.jacobian, self.prior]))[0]
        everything = np.concatenate([self.residual, self.off])
        left = everything - basis @ (basis.T @ everything)
        return basis[: self.rows], left[: self.rows]


def gauss_newton(problem: Problem, values: Mapping[str, np.ndarray], priors: Sequence[Prior],
                 noise: Mapping[str, float], *, iterations: int = 12, tolerance: float = 0.05, enough: float = 1e-5,
                 only: Sequence[str] | None = None) -> Fit:
    """Fit a stretch of data with Gaussian priors, halving steps that make it worse.

    Args:
        problem: residuals; rejected samples count nothing.
        values: start.
        priors: of unknowns of the problem; others are passed over.
        noise: factor on the declared noise by channel.
        iterations: at most.
        tolerance: length of the step, in sigmas of all unknowns together, that ends the iteration.
        enough: relative drop of the cost that ends the iteration.
        only: names of the unknowns that move; all free ones by default.
    """
    unknowns = tuple(u for u in problem.free if only is None or u.name in only)
    scales = np.concatenate([np.broadcast_to(u.scales, u.manifold.tangent) for u in unknowns])
    places, at = {}, 0
    for u in unknowns:
        places[u.name] = slice(at, at + u.manifold.tangent)
        at += u.manifold.tangent
    blocks, means = [np.zeros((0, at))], [np.zeros(0)]
    for prior in priors:
        if all(n in places for n in prior.names):
            block = np.zeros((len(prior.root), at))
            block[:, np.concatenate([np.arange(at)[places[n]] for n in prior.names])] = prior.root
            blocks.append(block)
            means.append(prior.root @ prior.mean)
    root, target = np.vstack(blocks), np.concatenate(means)
    inverse = root * scales

    def rows(v: Mapping[str, np.ndarray]) -> tuple[Sequence[Linearization], np.ndarray, np.ndarray, np.ndarray]:
        parts = problem.linearize(v)
        rs, js, ts = [], [], []
        for residual, part in zip(problem.residuals, parts, strict=True):
            assert isinstance(residual, KernelResidual)
            r, j = rows_of(part, unknowns, noise.get(residual.channel, 1.0))
            kept = np.repeat(part.weight > 0, residual.kernel.size)
            rs.append(r[kept])
            js.append(j[kept])
            ts.append(np.repeat(residual.time, residual.kernel.size)[kept])
        return parts, np.concatenate(rs), np.concatenate(js), np.concatenate(ts)

    def flat(v: Mapping[str, np.ndarray]) -> np.ndarray:
        return np.concatenate([np.atleast_1d(v[u.name]) for u in unknowns])

    def tried(v: Values, step: np.ndarray) -> tuple[Values, Any, np.ndarray, float]:
        """The point after a step, its rows, the residuals of its priors, and its cost."""
        trial = dict(v)
        for u in unknowns:
            trial[u.name] = v[u.name] + (step * scales)[places[u.name]]
            if u.name.startswith(FAMILY) and u.manifold.tangent == 5:
                # A duration is positive, and no step halves it more than once.
                trial[u.name][4] = max(trial[u.name][4], 0.5 * v[u.name][4], 10.0)
        if "position" in places and "velocity" in places:
            trial["position"], trial["velocity"] = turned(
                v["position"], v["velocity"], *((step * scales)[places[n]] for n in ("position", "velocity")))
        off = root @ flat(trial) - target
        try:
            with np.errstate(all="ignore"):
                new = rows(trial)
            lowered = float(new[1] @ new[1] + off @ off)
        except (InfeasibleError, ValueError):
            return trial, None, off, np.inf
        return trial, new, off, lowered

    current: Values = {k: np.array(v, dtype=float) for k, v in values.items()}
    parts, r, j, time = rows(current)
    off = root @ flat(current) - target
    cost = float(r @ r + off @ off)
    # Edges of burns act on data only once they pass them, so that their steps are held to a length that proves right.
    edges = np.array([places[u.name].start + k for u in unknowns if u.name.startswith(FAMILY)
                      for k in (0, 4)[: u.manifold.tangent - 3]], dtype=int)
    longest, shrunk = _EDGE_STEP, 1.0
    for _ in range(iterations):
        stacked, right = np.vstack([j, inverse]), -np.concatenate([r, off])
        full = _least_squares(stacked, right)
        length = float(np.linalg.norm(stacked @ full))
        if length < tolerance:
            break
        for attempt in range(5):
            step = shrunk * _held(stacked, right, full, edges, longest / scales[edges])
            trial, new, off_new, lowered = tried(current, step)
            if attempt == 0 and cost * (1 + 1e-12) < lowered < _CURVED * cost:
                # Along what the data hardly tell (longitude against scale and biases) a step of kilometres leaves
                # metres of curvature, which the next one takes away.
                right_new = -np.concatenate([new[1], off_new])
                rows_new = np.vstack([new[2], inverse])
                second = _held(rows_new, right_new, _least_squares(rows_new, right_new), edges, longest / scales[edges])
                again = tried(trial, second)
                if again[3] <= cost:
                    trial, new, off_new, lowered = again
            if np.isfinite(lowered) and lowered <= cost * (1 + 1e-12):
                longest *= 2.0
                shrunk = min(1.0, 2.0 * shrunk)
                break
            moved = np.max(np.abs(step * scales)[edges], initial=0.0)
            longest = 0.25 * min(longest, moved) if len(edges) else longest
            shrunk = shrunk if len(edges) and moved > 20.0 else 0.3 * shrunk
        else:
            break
        drop = cost - lowered
        current, (parts, r, j, time), off, cost = trial, new, off_new, lowered
        if drop < 1e-3 + enough * cost:
            break
    return Fit(problem, current, parts, unknowns, r, j, inverse, off, time)


def turned(position: np.ndarray, velocity: np.ndarray, by: np.ndarray, faster: np.ndarray,
           ) -> tuple[np.ndarray, np.ndarray]:
    """A state (3,), (3,) after a step (3,), (3,): the sum, but that what turns it about the Earth's axis does so.

    Ranges from one continent hardly tell the longitude, so that steps turn the orbit by tenths of a degree: a hundred
    kilometres along a straight line would change its radius by hundreds of metres.
    """
    x, y = position[:2]
    angle = float((x * by[1] - y * by[0]) / max(x * x + y * y, 1e-300))
    if abs(angle) > _LARGEST_TURN:
        return position + by, velocity + faster
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    straight = angle * np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    return turn @ position + by - straight @ position, turn @ velocity + faster - straight @ velocity


def _least_squares(rows: np.ndarray, right: np.ndarray) -> np.ndarray:
    # With the right side as a further column there is no need of the orthonormal rows themselves.
    upper = np.asarray(np.linalg.qr(np.column_stack([rows, right]), mode="r"))
    n = rows.shape[1]
    size = np.linalg.norm(upper[:, :n], axis=0)
    if len(upper) < n or np.any(np.abs(np.diag(upper)[:n]) <= 1e-14 * size):
        # What the rows do not tell gets no step.
        return np.asarray(np.linalg.lstsq(upper[:, :n], upper[:, n], rcond=None)[0])
    return np.asarray(solve_triangular(upper[:n, :n], upper[:n, n]))


def _held(rows: np.ndarray, right: np.ndarray, full: np.ndarray, edges: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """The least-squares step with the numbers ``edges`` within ``limit`` of zero, all others free."""
    clipped = np.clip(full[edges], -limit, limit)
    over = np.abs(full[edges]) > limit
    if not over.any():
        return full
    fixed = edges[over]
    free = np.setdiff1d(np.arange(len(full)), fixed)
    step = np.empty(len(full))
    step[fixed] = clipped[over]
    step[free] = _least_squares(rows[:, free], right - rows[:, fixed] @ step[fixed])
    step[edges] = np.clip(step[edges], -2 * limit, 2 * limit)
    return step


@dataclass(frozen=True, eq=False)
class BurnTest:
    """The likelihood ratio of one more burn with every pair of edges that was tried.

    Attributes:
        start, stop: (m,) s; gain: (m,) drop of the sum of squares; velocity: (m, 3) m/s in orbital axes.
        p_value: of the best one, F test with the scatter that is left, times the number of pairs tried.
    """

    start: np.ndarray
    stop: np.ndarray
    gain: np.ndarray
    velocity: np.ndarray
    p_value: float

    @property
    def best(self) -> Manoeuvre:
        """The most likely burn."""
        k = int(np.argmax(self.gain))
        a, b = self.start[k], self.stop[k]
        return Manoeuvre(0.5 * (a + b), self.velocity[k], float(b - a))


def common_error(fit: Fit) -> float:
    """By how much errors that rows share make sums of squares of slow signatures larger than independent noise would.

    Stations that range at the same instant share the satellite's delay and the model's error, and neighbouring instants
    share slow errors: the variance of the sum over an instant against that of its rows, times (1 + r)/(1 - r) with r
    the correlation of neighbouring instants. One for independent rows.
    """
    left = fit.absorbed()[1]
    times, index = np.unique(np.round(fit.time, 1), return_inverse=True)
    sums = np.bincount(index, left)
    counts = np.bincount(index)
    within = float(np.mean(sums**2 / counts)) / max(float(np.mean(left**2)), 1e-300)
    scaled = sums / np.sqrt(counts)
    correlation = float(np.sum(scaled[1:] * scaled[:-1]) / max(np.sum(scaled**2), 1e-300)) if len(times) > 4 else 0.0
    correlation = float(np.clip(correlation, 0.0, 0.8))
    return max(1.0, within) * (1 + correlation) / (1 - correlation)


def burn_test(fit: Fit, arc: OrbitArc, nodes: np.ndarray, longest: float, shared: float = 1.0,
              engine: Engine | None = None) -> BurnTest:
    """Test a fit for one more burn between any two of ``nodes``, linearly, without another integration.

    With ``K(t)`` the integral of ``Phi(u)^-1 B(u)`` up to t, a burn from a to b changes the state at t by
    ``Phi(t) (K(min(t, b)) - K(min(t, a))) dv / (b - a)``: columns, Gram matrices and gradients of all pairs are
    differences of those of single nodes.

    Args:
        fit: at its optimum, or near enough for it to be reached to first order.
        arc: its orbit.
        nodes: (m,) s, increasing, inside the span of the arc.
        longest: s between the edges.
        shared: of :func:`common_error`.
        engine: the likelihood of a burn across the orbit's plane includes that of its length.
    """
    order = np.argsort(fit.time, kind="stable")
    basis, r = (a[order] for a in fit.absorbed())
    when, scales = fit.time[order], fit.scales
    along = np.column_stack([fit.jacobian[order][:, fit.columns(u.name)] / scales[fit.columns(u.name)]
                             for u in (arc.position, arc.velocity)])
    m = len(nodes)
    if m < 2:
        return BurnTest(np.zeros(0), np.zeros(0), np.zeros(0), np.zeros((0, 3)), 1.0)
    state, chain = arc.at(nodes, fit.values)
    turn = np.zeros((m, 6, 3))
    turn[:, 3:] = [_axes(x) for x in state]
    integral = CubicSpline(nodes, np.linalg.solve(chain[:, :, :6], turn)).antiderivative()
    inside = np.clip(when[:, None], nodes[0], nodes[None, :])  # (n, m)
    columns = np.empty((len(when), m, 3))
    for k in range(m):
        columns[:, k] = np.einsum("ni,nij->nj", along, integral(inside[:, k]))
    flat = columns.reshape(len(when), -1)
    gradient = (r @ flat).reshape(m, 3)
    projected = (basis.T @ flat).reshape(-1, m, 3)
    gram = (flat.T @ flat).reshape(m, 3, m, 3)
    first, second = np.nonzero(np.triu(np.ones((m, m), dtype=bool), 1) & (nodes[None, :] - nodes[:, None] <= longest))
    width = (nodes[second] - nodes[first])[:, None, None]
    full = (gram[second, :, second] + gram[first, :, first] - gram[first, :, second]
            - gram[second, :, first]) / width**2
    moved = (projected[:, second] - projected[:, first]).transpose(1, 0, 2) / width
    matrix = full - moved.transpose(0, 2, 1) @ moved
    g = (gradient[second] - gradient[first]) / width[:, 0]
    size = np.sqrt(np.maximum(np.einsum("kii->ki", full), 1e-300))
    eigenvalues, vectors = np.linalg.eigh(matrix / (size[:, :, None] * size[:, None, :]))
    amounts = np.einsum("kij,ki->kj", vectors, g / size)
    seen = eigenvalues > 1e-6
    gain = np.sum(np.where(seen, amounts**2 / np.where(seen, eigenvalues, 1.0), 0.0), axis=1)
    velocity = -np.einsum("kij,kj->ki", vectors, np.where(seen, amounts / np.where(seen, eigenvalues, 1.0), 0.0)) / size
    possible = np.linalg.norm(velocity, axis=1) < _FASTEST
    gain = np.where(possible, gain, 0.0)
    if engine is not None:
        apart = engine.misfit(velocity, width[:, 0, 0], float(np.diff(nodes).max()))
        across = (np.abs(velocity[:, 2]) > np.abs(velocity[:, 1])) & (np.linalg.norm(velocity, axis=1) > engine.least)
        noise = max(1.0, (float(r @ r) - float(gain.max(initial=0.0))) / max(fit.degrees, 1)) * shared
        gain = np.maximum(gain - np.where(across, apart, 0.0) * noise, 0.0)
    best = float(gain.max(initial=0.0))
    degrees = max(fit.degrees - 5, 1)
    scatter = max((float(r @ r) - best) / degrees, 0.5)
    p = float(f.sf(best / 3 / scatter / shared, 3, max(degrees / shared, 3.0)))
    return BurnTest(nodes[first], nodes[second], gain, velocity, min(1.0, p * len(first)))


def _axes(state: np.ndarray) -> np.ndarray:
    """Columns: radial, along-track and cross-track unit vectors of a state (6,)."""
    radial = state[:3] / np.linalg.norm(state[:3])
    cross = np.cross(state[:3], state[3:])
    cross /= np.linalg.norm(cross)
    return np.column_stack([radial, np.cross(cross, radial), cross])


@dataclass(frozen=True, eq=False)
class Found:
    """What the search ended with.

    Attributes:
        fit, arc: the joint fit of the data that were not held out, and its orbit.
        low, high: what of the data one orbit fits, s.
        names, manoeuvres: in the order of time.
        noise: factor of the measured noise on the declared one by channel; shared: of :func:`common_error`.
        looks: number of places where growth was tested.
        search: what found it.
    """

    fit: Fit
    arc: OrbitArc
    low: float
    high: float
    names: tuple[str, ...]
    manoeuvres: tuple[Manoeuvre, ...]
    noise: dict[str, float]
    shared: float
    looks: int
    search: Search


@dataclass(eq=False)
class Search:
    """The search on one problem without manoeuvres; see the module.

    Attributes:
        problem: the joint problem whose arc carries derivatives along a thrust; rejected samples are not looked at.
        priors: of unknowns other than the state.
        period: of the orbit, s.
        say: called with what is being done.
        engine: what burns across the orbit's plane, once enough of them have told their length.
        known: noise by channel that the quiet stretches of a longer span have told, as a factor on the declared one:
            where burns leave no quiet stretch, a fit that misses them must not pass for noise.
        slow: unknowns that only long stretches tell; shorter ones hold them.
    """

    problem: Problem
    priors: tuple[Prior, ...]
    period: float
    say: Say = lambda text: None
    known: Mapping[str, float] = field(default_factory=dict)
    noise: dict[str, float] = field(default_factory=dict)
    looks: int = 0
    level: float = 1.0
    shared: float = 1.0
    calibrated: bool = False
    engine: Engine | None = None
    slow: tuple[str, ...] = ()
    lengths: dict[str, tuple[np.ndarray, float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        first = self.problem.residuals[0]
        assert isinstance(first, KernelResidual)
        signal = first.signals[0]
        assert isinstance(signal, OrbitSignal)
        self.arc = signal.arc
        times = [r.time[r.accepted] if r.accepted is not None else r.time for r in self._residuals]
        self.times = np.unique(np.concatenate(times))
        self._names = 0
        self._grids: dict[Any, Any] = {}  # steps of the integration, shared by all short stretches
        self._long_grids: dict[Any, Any] = {}  # and by all long ones, which are integrated to another tolerance

    @property
    def _residuals(self) -> list[KernelResidual]:
        return [r for r in self.problem.residuals if isinstance(r, KernelResidual)]

    def stretch(self, low: float, high: float, start: float, steps: Mapping[str, Manoeuvre], *,
                everything: bool = False) -> tuple[Problem, OrbitArc]:
        """The problem of the data between two times, with the state at ``start`` and velocity steps by name."""
        made = tuple(VelocityStep(m.unknown(n), burning=m.burning) for n, m in steps.items())
        short = high - low < _SHORTLY * self.period
        arc = replace(self.arc, start=start, span=(low, high), steps=made, tolerance=_LOOSE if short else _TIGHT,
                      _grids=self._grids if short else self._long_grids, _last={})
        residuals = []
        for r in self._residuals:
            keep = (r.time >= low) & (r.time <= high)
            if keep.any():
                part = r if everything else r.subset(keep)
                signals = tuple(replace(s, arc=arc) if isinstance(s, OrbitSignal) else s for s in part.signals)
                residuals.append(replace(part, signals=signals))
        needed = {u.name for r in residuals for u in r.unknowns}
        unknowns = {u.name: u for u in (*self.problem.unknowns, *(s.unknown for s in made)) if u.name in needed}
        values = {n: self.problem.start[n] for n in unknowns if n in self.problem.start}
        values.update({n: m.start for n, m in steps.items()})
        held = set(self.problem.held)
        if high - low < MONTHS * self.period:
            held |= set(self.slow)
        return Problem(tuple(unknowns.values()), tuple(residuals), values, frozenset(held & set(unknowns))), arc

    def fit(self, low: float, high: float, start: float, state: np.ndarray, values: Mapping[str, np.ndarray],
            steps: Mapping[str, Manoeuvre], **options: Any) -> tuple[Fit, OrbitArc]:
        """Fit the data between two times from a state (6,) at ``start`` and values of the calibration."""
        problem, arc = self.stretch(low, high, start, steps)
        point = {**problem.start, **{n: v for n, v in values.items() if n in problem.start and n not in steps}}
        point[arc.position.name], point[arc.velocity.name] = state[:3], state[3:]
        priors = list(self.priors)
        for n, m in steps.items():
            priors.append(self.prior_of(n, m))
        return gauss_newton(problem, point, priors, self.noise, **options), arc

    def prior_of(self, name: str, m: Manoeuvre) -> Prior:
        """What is known of a manoeuvre before the fit: about when, and how long where others told."""
        mean, sigma = [m.time, 0.0, 0.0, 0.0], [self.period / 8, _FASTEST, _FASTEST, _FASTEST]
        if m.burning:
            mean.append(m.duration)
            sigma.append(_LONGEST * self.period)
        prior = Prior.of(name, np.array(mean), np.array(sigma))
        if self.engine is None or not m.burning or not self.engine.made(m.velocity):
            return prior
        # Length and size are tied; neither is known.
        root = prior.root.copy()
        root[4] = [0.0, *self.engine.row(m.velocity)]
        return Prior((name,), np.array([m.time, 0.0, 0.0, 0.0, 0.0]), root)

    # ------------------------------------------------------------------------------------------------ quiet stretches

    def quiet(self, state: np.ndarray, at: float) -> tuple[float, float, Fit]:
        """The quietest stretch (low, high) and its fit; sets the noise.

        Args:
            state: (6,) near the orbit at the time ``at``.
        """
        length = 1.5 * self.period
        first, last = float(self.times[0]), float(self.times[-1])
        stride = length * (0.5 if last - first < 40 * self.period else 0.75)
        count = max(1, int((last - first) / stride))
        lows = [first + k * stride for k in range(count)] if last - first > length else [first]
        found: list[tuple[float, float, float, Fit]] = []
        values: Mapping[str, np.ndarray] = self.problem.start
        here, state = at, np.asarray(state, dtype=float)
        for low in lows:
            self.say(f"quiet stretches, day {(low - first) / 86400:.1f}")
            high = min(low + length, last)
            inside = (self.times >= low) & (self.times <= high)
            if inside.sum() < 4:
                continue
            start = float(self.times[inside][0])
            _, arc = self.stretch(min(here, start), max(here, start), here, {})
            point = {**self.problem.start, **values, arc.position.name: state[:3], arc.velocity.name: state[3:]}
            moved = arc.at(np.array([start]), point)[0][0]
            fit, arc = self.fit(low, high, start, moved, values, {}, iterations=15, enough=0.01)
            if fit.rows < fit.jacobian.shape[1] + 4:
                continue
            found.append((fit.square / fit.degrees, low, high, fit))
            here, state = start, np.concatenate([fit.values[arc.position.name], fit.values[arc.velocity.name]])
        if not found:
            raise TooFewDataError("no stretch of the data is long enough for an orbit")
        found.sort(key=lambda item: item[0])
        quarter = found[: max(1, len(found) // 4)]
        for channel in dict.fromkeys(r.channel for r in self._residuals):
            squares = []
            for _, _, _, fit in quarter:
                rows = np.concatenate([p.whitened[p.weight > 0].ravel() for r, p
                                       in zip(fit.problem.residuals, fit.parts, strict=True)
                                       if isinstance(r, KernelResidual) and r.channel == channel] or [np.zeros(0)])
                if len(rows):
                    squares.append(float(np.mean(rows**2)) * fit.rows / fit.degrees)
            measured = float(np.sqrt(np.median(squares))) if squares else 1.0
            self.noise[channel] = min(measured, _NOISIER * self.known.get(channel, np.inf))
        self.shared = float(np.median([common_error(item[3]) for item in quarter]))
        return found[0][1], found[0][2], found[0][3]

    # ------------------------------------------------------------------------------------------------ growth

    def grow(self, low: float, high: float, fit: Fit, direction: int) -> tuple[dict[str, Manoeuvre], float]:
        """Grow a quiet stretch to one end of the data, or until nothing helps; manoeuvres by name, and the end."""
        first, last = float(self.times[0]), float(self.times[-1])
        steps: dict[str, Manoeuvre] = {}
        done: dict[str, Manoeuvre] = {}
        arc = _arc_of(fit)
        start = arc.start
        state = np.concatenate([fit.values[arc.position.name], fit.values[arc.velocity.name]])
        values: Mapping[str, np.ndarray] = fit.values
        edge = high if direction == 1 else low  # of the data in the stretch
        other = low if direction == 1 else high
        good = edge
        while (edge < last) if direction == 1 else (edge > first):
            new = edge + direction * _GROWTH * self.period
            while True:
                fresh = (self.times - edge) * direction > 0
                fresh &= (self.times - new) * direction <= 0
                if fresh.sum() >= 3 or new > last or new < first:
                    break
                new += direction * _GROWTH * self.period
            new = min(max(new, first), last)
            self.say(f"day {(new - first) / 86400:.1f}, {len(done) + len(steps)} manoeuvres")
            kept = new - direction * _KEPT * self.period
            if (kept - other) * direction > 0:
                inside = self.times[(self.times - kept) * direction >= 0]
                begin = float(inside[0] if direction == 1 else inside[-1])
                # The state moves to the new start; what lies behind it is done.
                trimmed, arc = self.stretch(min(begin, start), max(begin, start), start, steps)
                point = {**trimmed.start, **values, arc.position.name: state[:3], arc.velocity.name: state[3:]}
                point.update({n: m.start for n, m in steps.items()})
                state = arc.at(np.array([begin]), point)[0][0]
                for n in [n for n, m in steps.items() if (m.time - begin) * direction < 0.5 * m.duration]:
                    done[n] = steps.pop(n)
                start, other = begin, kept
            # Not refitted yet: a step that the model lacks would bend everything else.
            ends = (other, new) if direction == 1 else (new, other)
            fit, arc = self.fit(*ends, start, state, values, steps, iterations=0)
            met = self._first_met(fit, arc, edge, new, direction)
            if met is not None and not self.calibrated:
                # One orbit through quiet data tells the calibration; a few hours between burns would not.
                before, _ = self.fit(min(other, edge), max(other, edge), start, state, values, steps)
                names = [u.name for u in before.unknowns if u.name not in (arc.position.name, arc.velocity.name)
                         and not u.name.startswith(FAMILY)]
                self.priors = (before.knowledge(names, _INFLATED),)
                self.calibrated, values = True, before.values
                state = _state(before, arc)
            if met is not None:
                # Enough data after the step to tell its time, and few enough for no other to be among them.
                new = min(max(met + direction * _AFTER * self.period, first), last)
                ends = (other, new) if direction == 1 else (new, other)
                fit, arc = self.fit(*ends, start, state, values, steps, iterations=0)
            fit, arc, steps = self._settled(fit, arc, steps, *ends, edge if met is None else met, direction)
            state = np.concatenate([fit.values[arc.position.name], fit.values[arc.velocity.name]])
            values, edge = fit.values, new
            good = edge if fit.square / fit.degrees < _BROKEN * self.level else good
            if abs(edge - good) > 2 * self.period:
                break
        met_before = {n: m for n, m in {**done, **steps}.items() if (good - m.time) * direction > 0}
        return met_before, good

    def _nodes(self, low: float, high: float) -> np.ndarray:
        return np.linspace(low, high, max(8, int((high - low) / self.period * _GRID)))

    def _first_met(self, fit: Fit, arc: OrbitArc, edge: float, new: float, direction: int) -> float | None:
        """The first time beyond ``edge`` whose data, and all before, speak for a step; None where none does."""
        fresh = np.unique(fit.time[((fit.time - edge) * direction > 0)])[::direction]
        if len(fresh) > 12:
            fresh = fresh[np.linspace(0, len(fresh) - 1, 13).astype(int)[1:]]
        low, high = arc.span
        for stop in fresh:
            mask = (fit.time - stop) * direction <= 0
            part = replace(fit, residual=fit.residual[mask], jacobian=fit.jacobian[mask], time=fit.time[mask])
            back = edge - direction * _BACK * self.period
            a, b = max(min(back, stop), low), min(max(back, stop), high)
            self.looks += 1
            if burn_test(part, arc, self._nodes(a, b), _LONGEST * self.period, self.shared).p_value < _DOUBT:
                return float(stop)
        return None

    def _settled(self, fit: Fit, arc: OrbitArc, steps: dict[str, Manoeuvre], low: float, high: float, edge: float,
                 direction: int) -> tuple[Fit, OrbitArc, dict[str, Manoeuvre]]:
        """Add or move manoeuvres near the growing edge until none is significant.

        The first test is made before anything is fitted to the new data: a step that the model lacks would bend all.
        """
        near = edge - direction * _BACK * self.period
        new = high if direction == 1 else low
        near, new = max(min(near, new), low), min(max(near, new), high)
        nodes = self._nodes(near, new)
        fitted = False
        for _ in range(_MOST_PER_GROWTH):
            test = burn_test(fit, arc, nodes, _LONGEST * self.period, self.shared, self.engine)
            self.looks += 1
            if test.p_value > _DOUBT and fitted:
                break
            if test.p_value > _DOUBT:
                here = _state(fit, arc)
                fit, arc = self.fit(low, high, arc.start, here, fit.values, steps, iterations=2, enough=1e-3)
                break
            plain = _criterion(fit, self.shared)
            self._names += 1
            tried = _steps_of(fit, steps)
            tried[f"{FAMILY}:{self._names}"] = self.engined(test.best)
            options = [self._scored(tried, fit, arc, low, high)]
            close = options[0][1].square / options[0][1].degrees < 2.0 * self.level
            late = [n for n, m in steps.items() if near - 0.2 * self.period < m.time < new + 0.2 * self.period]
            if late and not close:
                name = max(late, key=lambda n: steps[n].time * direction)
                rest = {n: m for n, m in _steps_of(fit, steps).items() if n != name}
                without, arc2 = self.fit(low, high, arc.start, _state(fit, arc), fit.values, rest, iterations=0)
                moved = burn_test(without, arc2, nodes, _LONGEST * self.period, self.shared,
                                  self.engine)
                if moved.gain.max(initial=0.0) > 0:
                    options.append(self._scored({**rest, name: self.engined(moved.best)}, without, arc2, low, high))
            best = min(options, key=lambda o: o[0])
            if best[0] > plain - 10.0:
                if not fitted:
                    fit, arc = self._scored(steps, fit, arc, low, high)[1:]
                break
            fitted = True
            fit, arc = best[1:]
            steps = {s.unknown.name: Manoeuvre.of(fit.values[s.unknown.name]) for s in arc.steps}
        fit, arc, steps = self._pruned(fit, arc, _steps_of(fit, steps), low, high)
        self._learned(fit, steps)
        # Growth goes on over what it does not fit yet; the joint fit, which is stricter, has the last word.
        self.level = max(1.0, 0.5 * self.level + 0.5 * min(fit.square / fit.degrees, 2 * self.level))
        return fit, arc, steps

    def _pruned(self, fit: Fit, arc: OrbitArc, steps: dict[str, Manoeuvre], low: float, high: float,
                ) -> tuple[Fit, OrbitArc, dict[str, Manoeuvre]]:
        """Without the steps that the others have made unnecessary."""
        while steps:
            covariance = fit.covariance()
            size = {}
            for n in steps:
                c = fit.columns(n)
                v = fit.values[n][1:4]
                size[n] = float(v @ np.linalg.solve(covariance[c, c][1:4, 1:4], v))
            name = min(size, key=lambda n: size[n])
            rest = {n: m for n, m in steps.items() if n != name}
            if size[name] > 200.0 * self.shared:
                break
            score, again, arc2 = self._scored(rest, fit, arc, low, high)
            if score > _criterion(fit, self.shared):
                break
            fit, arc, steps = again, arc2, _steps_of(again, rest)
        return fit, arc, steps

    # ------------------------------------------------------------------------------------------------ all data

    def run(self, state: np.ndarray, at: float) -> Found:
        """The whole search; see the module.

        Args:
            state: (6,) near the orbit at the time ``at``, s.
        """
        declared = self.priors
        low, high, quiet = self.quiet(state, at)
        after, until = self.grow(low, high, quiet, 1)
        before, since = self.grow(low, high, quiet, -1)
        steps = {**after, **before}
        self.priors = declared
        fit, arc, steps, since, until = self._joined(quiet, steps, low, high, since, until)
        fit, arc, steps = self._alike(fit, arc, steps, since, until)
        for _ in range(_PASSES):
            count = len(steps)
            fit, arc, steps = self._completed(fit, arc, steps, since, until)
            if len(steps) == count:
                break
        fit, arc, steps = self._thinned(fit, arc, steps, since, until)
        fit, arc, steps = self._parted(fit, arc, steps, since, until)
        fit, arc, steps = self._thinned(fit, arc, steps, since, until)
        ordered = sorted(steps.items(), key=lambda item: item[1].time)
        return Found(fit, arc, since, until, tuple(n for n, _ in ordered), tuple(m for _, m in ordered),
                     dict(self.noise), self.shared, self.looks, self)

    def _joined(self, quiet: Fit, steps: dict[str, Manoeuvre], low: float, high: float, since: float, until: float,
                ) -> tuple[Fit, OrbitArc, dict[str, Manoeuvre], float, float]:
        """One orbit through all data between two times, or through as much around the quiet stretch as one fits."""
        fit, arc = quiet, _arc_of(quiet)
        steps = dict(steps)
        taken: dict[str, Manoeuvre] = {}
        a, b = low, high
        ends = {-1: since, 1: until}
        while a > ends[-1] or b < ends[1]:
            for direction in (1, -1):
                edge = b if direction == 1 else a
                new = edge + direction * max(_JOINED * self.period, _LONGER * (b - a))
                new = min(new, ends[1]) if direction == 1 else max(new, ends[-1])
                if new == edge:
                    continue
                tried = (a, new) if direction == 1 else (new, b)
                inside = {n: m for n, m in {**steps, **taken}.items() if tried[0] < m.time < tried[1]}
                self.say(f"one orbit over {(tried[1] - tried[0]) / 86400:.1f} days, {len(inside)} manoeuvres")
                again, new_arc = self.fit(*tried, arc.start, _state(fit, arc), fit.values, inside, iterations=12,
                                          enough=1e-2)
                if again.square / again.degrees > _BROKEN * min(self.level, _ROUGHEST):
                    ends[direction] = edge
                    continue
                grown = again.square / again.degrees / (fit.square / fit.degrees)
                fit, arc, taken = again, new_arc, _steps_of(again, inside)
                a, b = tried
                if grown > _GROWN and b - a > MONTHS * self.period:
                    # What is wrong in the new part is put right before more is built on it.
                    fit, arc, taken = self._completed(fit, arc, taken, a, b)
        return fit, arc, taken, a, b

    def _learned(self, fit: Fit, steps: Mapping[str, Manoeuvre]) -> None:
        """What the burns of a fit tell of the engine."""
        sigma = self._sigmas(fit, [n for n, m in steps.items() if m.burning and _northward(m)])
        for n, s in sigma.items():
            m = steps[n]
            if self.engine is not None:
                # What the engine said of the length is not told twice.
                known = self.engine.spread * m.duration
                s = np.append(s[:4], 1.0 / np.sqrt(max(s[4] ** -2 - known**-2, 1e-12)))
            self.lengths[n] = (m.velocity, m.duration, float(s[4]))
        if self.lengths:
            # What was said before is not forgotten where the burns of now say nothing.
            self.engine = engine_of(*zip(*self.lengths.values(), strict=True)) or self.engine

    def _alike(self, fit: Fit, arc: OrbitArc, steps: dict[str, Manoeuvre], low: float, high: float,
               ) -> tuple[Fit, OrbitArc, dict[str, Manoeuvre]]:
        """Give burns across the orbit's plane the length that the engine takes for their size.

        The orbit feels the square of a burn's length, so that a fit that has come to a short one is stuck there.
        """
        self._learned(fit, steps)
        if self.engine is None:
            return fit, arc, steps
        self.say(f"engine of {1e3 * self.engine.acceleration:.4f} mm/s2 from {self.engine.burns} burns")
        alike = {n: self.engined(m) for n, m in steps.items()}
        if all(abs(alike[n].duration - m.duration) < _ALIKE * alike[n].duration or alike[n] is m
               for n, m in steps.items()):
            return fit, arc, steps
        again, new_arc = self.fit(low, high, arc.start, _state(fit, arc), fit.values, alike, iterations=12, enough=5e-3)
        return again, new_arc, _steps_of(again, alike)

    def engined(self, m: Manoeuvre) -> Manoeuvre:
        """A manoeuvre with the length that the engine takes for it, where it has one."""
        if self.engine is None or not self.engine.made(m.velocity):
            return m
        length = self.engine.duration(m.velocity)
        return replace(m, duration=length) if length > _SHORT * self.period else m

    def _sigmas(self, fit: Fit, names: Iterable[str]) -> dict[str, np.ndarray]:
        """Sigmas of the numbers of each manoeuvre, with the scatter and the shared errors that the fit shows."""
        spread = np.sqrt(np.diag(fit.covariance()) * max(1.0, fit.square / fit.degrees) * self.shared)
        return {n: spread[fit.columns(n)] for n in names}

    def _thinned(self, fit: Fit, arc: OrbitArc, steps: dict[str, Manoeuvre], low: float, high: float,
                 ) -> tuple[Fit, OrbitArc, dict[str, Manoeuvre]]:
        """Without the manoeuvres that are not significant together with all others, impulses where length is open."""
        for _ in range(_PASSES):
            weak = self._weak(fit, steps)
            kept = _steps_of(fit, steps)
            before = dict(kept)
            for n, m in weak.items():
                if m is not None:
                    kept[n] = m
                    continue
                # Whether it was needed the revolutions around it tell.
                again = self._around(fit, arc, kept, kept[n].time, low, high)
                rest = {k: v for k, v in kept.items() if k != n}
                if _criterion(again(rest)[0], self.shared) < _criterion(again(kept)[0], self.shared):
                    kept = rest
            if kept == before:
                break
            joint, new_arc = self.fit(low, high, arc.start, _state(fit, arc), fit.values, kept, iterations=10,
                                      enough=5e-3)
            if joint.square / joint.degrees > _NEEDED * fit.square / fit.degrees:
                break  # it was needed after all
            fit, arc, steps = joint, new_arc, _steps_of(joint, kept)
        return fit, arc, steps

    def _around(self, fit: Fit, arc: OrbitArc, steps: Mapping[str, Manoeuvre], time: float, low: float, high: float,
                ) -> Callable[[Mapping[str, Manoeuvre]], tuple[Fit, OrbitArc]]:
        """A fit of a few revolutions around a time with other manoeuvres, the calibration held at that of ``fit``."""
        a, b = max(low, time - _BESIDE * self.period), min(high, time + _BESIDE * self.period)
        inside = self.times[(self.times >= a) & (self.times <= b)]
        start = float(inside[0])
        state = arc.at(np.array([start]), fit.values)[0][0]

        def again(others: Mapping[str, Manoeuvre]) -> tuple[Fit, OrbitArc]:
            chosen = {n: m for n, m in others.items() if a - m.duration / 2 < m.time < b + m.duration / 2}
            return self.fit(a, b, start, state, fit.values, chosen, iterations=8, enough=3e-3,
                            only=[arc.position.name, arc.velocity.name, *chosen])

        return again

    def _parted(self, fit: Fit, arc: OrbitArc, steps: dict[str, Manoeuvre], low: float, high: float,
                ) -> tuple[Fit, OrbitArc, dict[str, Manoeuvre]]:
        """One manoeuvre in place of neighbours that the data cannot tell apart, where one explains as much."""
        steps, before = _steps_of(fit, steps), set(steps)
        sigma = self._sigmas(fit, steps)
        # Of two that are both sure in some direction each is needed, however near they are.
        unsure = {n for n, m in steps.items() if np.all(np.abs(m.velocity) < _SURE * sigma[n][1:4])}
        for pair in neighbours(steps, {n: float(s[0]) for n, s in sigma.items()}, self.times):
            if not unsure & set(pair) or not set(pair) <= set(steps):
                continue
            again = self._around(fit, arc, steps, steps[pair[0]].time, low, high)
            best, kept = _criterion(again(steps)[0], self.shared), steps
            total = sum((steps[n].velocity for n in pair), np.zeros(3))
            for n in pair:
                # The one may stand where either of them stood.
                rest = {k: m for k, m in steps.items() if k not in pair}
                rest[n] = self.engined(replace(steps[n], velocity=total))
                one = again(rest)[0]
                if _criterion(one, self.shared) < best:
                    best, kept = _criterion(one, self.shared), {**rest, n: Manoeuvre.of(one.values[n])}
            steps = kept
        if set(steps) == before:
            return fit, arc, steps
        again_, new_arc = self.fit(low, high, arc.start, _state(fit, arc), fit.values, steps, iterations=12,
                                   enough=1e-3)
        return again_, new_arc, _steps_of(again_, steps)

    def _completed(self, fit: Fit, arc: OrbitArc, steps: dict[str, Manoeuvre], low: float, high: float,
                   ) -> tuple[Fit, OrbitArc, dict[str, Manoeuvre]]:
        """With the manoeuvres that show only beside others: a burn that was taken for a part of another one.

        Where the joint fit leaves much more than elsewhere, the growth's test is made once more, with the orbit on
        both sides known.
        """
        steps, before = _steps_of(fit, steps), set(steps)
        turn = np.floor((fit.time - low) / (0.5 * self.period)).astype(int)
        square = np.bincount(turn, fit.residual**2) / np.maximum(np.bincount(turn), 1)
        usual = float(np.median(square[square > 0]))
        # Below the noise of quiet data there is no manoeuvre to be found.
        limit = _LOUD * max(usual, 1.0)
        loud = [k for k in np.argsort(-square) if square[k] > limit][:_MOST_COMPLETED]
        places: list[tuple[float, str]] = [(low + (k + 0.5) * 0.5 * self.period, "") for k in loud]
        if self.engine is not None:
            merged = [n for n, m in steps.items() if self.engine.made(m.velocity) and self.engine.leaves(m.velocity)]
            places = [*((steps[n].time, n) for n in merged), *places]
        for middle, left in places:
            again = self._around(fit, arc, steps, middle, low, high)
            local, local_arc = again(steps)
            plain, alone = _criterion(local, self.shared), steps
            now = {**steps, **_steps_of(local, {n: steps[n] for n in steps if n in local.values})}
            if left:
                assert self.engine is not None
                axis = self.engine.axis(steps[left].velocity)
                assert axis is not None
                # The part that points where the nozzle does, and then whatever else there was.
                alone = {**now, left: self.engined(replace(now[left], velocity=(now[left].velocity @ axis) * axis))}
                local, local_arc = again(alone)
                now = {**alone, **_steps_of(local, {n: alone[n] for n in alone if n in local.values})}
            nodes = self._nodes(max(middle - 0.75 * self.period, local_arc.span[0]),
                                min(middle + 0.75 * self.period, local_arc.span[1]))
            test = burn_test(local, local_arc, nodes, _LONGEST * self.period, self.shared, self.engine)
            if test.p_value > _DOUBT:
                continue
            self._names += 1
            name = f"{FAMILY}:{self._names}"
            best = self.engined(test.best)
            more = again({**now, name: best})[0]
            if _criterion(more, self.shared) < plain - 10.0:
                steps = _steps_of(more, {**now, name: best})
        if set(steps) == before:
            return fit, arc, steps
        again_, new_arc = self.fit(low, high, arc.start, _state(fit, arc), fit.values, steps, iterations=12,
                                   enough=1e-3)
        if again_.square > fit.square:
            return fit, arc, {n: m for n, m in steps.items() if n in before}
        return again_, new_arc, _steps_of(again_, steps)

    def p_values(self, fit: Fit, names: Sequence[str]) -> dict[str, float]:
        """Probability of each manoeuvre's velocity without one, over all places where the search looked."""
        covariance = fit.covariance()
        scale = max(1.0, fit.square / fit.degrees) * self.shared
        places = (self.times[-1] - self.times[0]) / self.period * _GRID
        answer = {}
        for n in names:
            c = fit.columns(n)
            v = fit.values[n][1:4]
            statistic = float(v @ np.linalg.solve(covariance[c, c][1:4, 1:4], v)) / scale
            answer[n] = float(min(1.0, chi2.sf(statistic, 3) * places))
        return answer

    def _weak(self, fit: Fit, steps: Mapping[str, Manoeuvre]) -> dict[str, Manoeuvre | None]:
        """Manoeuvres to drop (None) or to call impulses, a third of the drops at a time: they lean on each other."""
        found: dict[str, Manoeuvre | None] = {}
        p = self.p_values(fit, list(steps))
        drop = sorted((n for n in steps if p[n] > LEVEL), key=lambda n: -p[n])
        for n in drop[: max(1, (len(drop) + 1) // 2)]:
            found[n] = None
        covariance = np.diag(fit.covariance())
        scale = max(1.0, fit.square / fit.degrees) * self.shared
        # Of an orbit that does not fit yet no length of a burn can be told.
        fitted = fit.square / fit.degrees < 25.0 * self.level
        for n, m in steps.items():
            if not (fitted and m.burning) or n in found or (self.engine is not None and self.engine.made(m.velocity)):
                continue
            if m.duration < 3 * np.sqrt(covariance[fit.columns(n)][4] * scale):
                found[n] = replace(m, duration=0.0)
        return found

    def _scored(self, steps: Mapping[str, Manoeuvre], fit: Fit, arc: OrbitArc, low: float, high: float,
                ) -> tuple[float, Fit, OrbitArc]:
        again, new_arc = self.fit(low, high, arc.start, _state(fit, arc), fit.values, steps, iterations=8, enough=1e-3)
        return _criterion(again, self.shared), again, new_arc


def _northward(m: Manoeuvre) -> bool:
    """Whether a manoeuvre turns the orbit's plane more than it changes its period."""
    return abs(m.velocity[2]) > abs(m.velocity[1])


def neighbours(steps: Mapping[str, Manoeuvre], sigma: Mapping[str, float], times: np.ndarray) -> list[tuple[str, str]]:
    """Pairs of successive manoeuvres that the data cannot tell apart.

    Args:
        steps: by name.
        sigma: of their times, s.
        times: (n,) of the measurements, s, increasing.

    Returns:
        Names of two manoeuvres without a measurement between them, or nearer to each other than two sigmas of the
        times, in the order of time.
    """
    found = []
    for (a, first), (b, second) in pairwise(sorted(steps.items(), key=lambda item: item[1].time)):
        apart = second.time - first.time
        between = np.searchsorted(times, second.time) - np.searchsorted(times, first.time)
        if between == 0 or apart < 2.0 * float(np.hypot(sigma[a], sigma[b])):
            found.append((a, b))
    return found


def _criterion(fit: Fit, shared: float) -> float:
    """Schwarz's criterion with unknown noise, which is never taken below half the measured one."""
    left = fit.absorbed()[1]
    n = fit.rows / shared
    return n * float(np.log(max(float(left @ left) / fit.rows, 0.5))) + fit.jacobian.shape[1] * float(np.log(n))


def _arc_of(fit: Fit) -> OrbitArc:
    residual = fit.problem.residuals[0]
    assert isinstance(residual, KernelResidual)
    signal = residual.signals[0]
    assert isinstance(signal, OrbitSignal)
    return signal.arc


def _state(fit: Fit, arc: OrbitArc) -> np.ndarray:
    return np.concatenate([fit.values[arc.position.name], fit.values[arc.velocity.name]])


def _steps_of(fit: Fit, steps: Mapping[str, Manoeuvre]) -> dict[str, Manoeuvre]:
    """The manoeuvres at the values of a fit."""
    return {n: Manoeuvre.of(fit.values[n]) if n in fit.values else m for n, m in steps.items()}
