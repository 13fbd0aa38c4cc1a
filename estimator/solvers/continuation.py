"""A solve that may start anywhere: short segments of the arcs first, the whole arcs last.

A state carried along a long arc with a wrong inertia tensor, a wrong torque or a wrong rate is wrong by whole turns at
its end, where the cost has many valleys; over a short time it has one. So every arc is cut into segments in which
little can go wrong, and each segment gets a state of its own (multiple shooting without the continuity). The states are
found one segment after another, the shared unknowns from all segments together; only then are the segments joined.
Where that does not explain the data, the inertia tensor is started as that of a sphere (a tensor at the edge of what
is physical turns small torques into large ones) and each quaternion that feeds the arcs from 24 turned places.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.estimate import Estimate
from estimator.problem import Problem, normal_equations
from estimator.propagation import PropagatedSignal
from estimator.residuals import KernelResidual, Residual
from estimator.signals import Signal
from estimator.solvers.gauss_newton import Options, solve
from estimator.unknowns import NormalizedInertia, UnitQuaternion, Unknown

SEGMENT_TURN = 0.5  # rad that the body turns in a segment, about
FEWEST_SAMPLES = 12  # of a segment, and of the first look at an arc
MOST_SEGMENTS = 12  # of an arc
FAR = 25.0  # mean whitened square above which a residual counts as far from its noise
THINNED = 150  # samples of a residual in the trial of turned quaternions
COARSE = Options(tolerance=1e-2, iterations=40, largest_step=10.0, damping=1e-4)
FIRST = Options(tolerance=1e-2, iterations=15, largest_step=30.0, damping=1e-4)

Values = Mapping[str, np.ndarray]


def solve_from_anywhere(problem: Problem, options: Options | None = None) -> Estimate:
    """Minimize the joint cost from a start that may be far from any solution.

    Args:
        problem: what to solve.
        options: of the last Gauss-Newton solve.

    Returns:
        The estimate from the given start when that explains the data, else the one of least cost of those tried.
    """
    options = options or Options()
    last = replace(options, largest_step=min(options.largest_step, 100.0))
    if not _far(problem, problem.start):
        return solve(problem, last)
    found = []
    for begin in _starts(problem):
        values = _joined(problem, begin)
        found.append(solve(problem.starting_at(values), last))
        if not _far(problem, found[-1].values):
            return found[-1]
    best = min(found, key=_cost)
    for name in _suspects(problem, best.values):
        turned = _turned(problem, best.values, name)
        best = min(best, solve(problem.starting_at(turned), last), key=_cost)
        if not _far(problem, best.values):
            break
    return best


def _starts(problem: Problem) -> list[Values]:
    """The given start, and the one with a spherical inertia tensor."""
    given = dict(problem.start)
    sphere = {u.name: np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]) / 3 for u in problem.free
              if isinstance(u.manifold, NormalizedInertia)}
    return [given, {**given, **sphere}] if sphere else [given]


def _cost(estimate: Estimate) -> float:
    total = sum(part.cost for part in estimate.parts)
    return total if np.isfinite(total) else np.inf


def _mean_squares(problem: Problem, values: Values) -> list[tuple[Residual, float]]:
    prepared = problem.prepared(values)
    return [(r, float(np.mean(p.whitened**2)) if isinstance(r, KernelResidual) else p.cost / max(p.measurements, 1.0))
            for r, p in zip(prepared.residuals, prepared.linearize(values), strict=True)]


def _is_far(mean_square: float) -> bool:
    return not np.isfinite(mean_square) or mean_square > FAR


def _far(problem: Problem, values: Values) -> bool:
    return any(_is_far(m) for _, m in _mean_squares(problem, values))


# --- segments --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Segment:
    """A stretch of one arc with a state of its own."""

    residual: KernelResidual
    signal: PropagatedSignal
    first: int  # node of the arc
    last: int  # node of the arc at which the next segment begins, or its last


def _arc_signal(residual: Residual) -> PropagatedSignal | None:
    if not isinstance(residual, KernelResidual):
        return None
    return next((s for s in residual.signals if isinstance(s, PropagatedSignal)), None)


def _segments(residual: KernelResidual, signal: PropagatedSignal, duration: float) -> list[_Segment]:
    """Cut an arc into segments of about ``duration`` (s); the first keeps the arc's own unknowns."""
    count = residual.samples
    elapsed = residual.time - residual.time[0]
    most = max(1, min(MOST_SEGMENTS, count // FEWEST_SAMPLES))
    duration = max(duration, float(elapsed[-1]) / most * (1 + 1e-9))
    label = np.floor(elapsed / duration).astype(int)
    # A segment with few samples (beside a gap, at the end) goes with the one before it.
    firsts = [0]
    for i in np.flatnonzero(np.diff(label)) + 1:
        if i - firsts[-1] >= FEWEST_SAMPLES and count - i >= FEWEST_SAMPLES:
            firsts.append(int(i))
    bounds = [*firsts, count]
    result = []
    for k, (a, b) in enumerate(pairwise(bounds)):
        node = int(signal.sample_nodes[a]) if k else 0
        end = int(signal.sample_nodes[b]) if b < count else int(signal.sample_nodes[-1])
        starts = signal.starts if k == 0 else tuple(replace(u, name=f"{u.name}@{k}") for u in signal.starts)
        piece = PropagatedSignal(signal.name, signal.flow, starts, signal.node_time[node : end + 1],
                                 signal.inputs[node : end + 1], signal.held[node:end],
                                 signal.sample_nodes[a:b] - node)
        keep = np.zeros(count, dtype=bool)
        keep[a:b] = True
        part = residual.subset(keep)
        signals: tuple[Signal, ...] = tuple(piece if s is signal else t
                                            for s, t in zip(residual.signals, part.signals, strict=True))
        result.append(_Segment(replace(part, name=f"{residual.name}@{k}", signals=signals), piece, node, end))
    return result


def _duration(signal: PropagatedSignal, values: Values) -> float:
    """Length (s) of a segment in which the body turns little, by the rate at the start of the arc."""
    speeds = [float(np.linalg.norm(values[u.name])) for u in signal.starts if u.unit == "rad/s"]
    return SEGMENT_TURN / max([*speeds, 1e-4])


def _fitted(residual: KernelResidual, problem: Problem, values: Values, free: tuple[Unknown, ...],
            options: Options) -> dict[str, np.ndarray]:
    """Values with the unknowns ``free`` fitted to one residual, all others held."""
    known = {u.name: u for u in (*problem.unknowns, *free)}
    needed = tuple(known[u.name] for u in residual.unknowns)
    held = frozenset(u.name for u in needed) - {u.name for u in free}
    small = Problem(needed, (residual,), {u.name: values[u.name] for u in needed}, held)
    return {**values, **{u.name: v for u in free if np.all(np.isfinite(v := solve(small, options).values[u.name]))}}


def _tracked(problem: Problem, values: Values) -> tuple[list[_Segment], dict[str, np.ndarray]]:
    """The arcs that are far from their noise cut into segments, the state at the start of each found one by one.

    Arcs that are near their noise stay whole, as one segment.
    """
    result: dict[str, np.ndarray] = dict(values)
    segments: list[_Segment] = []
    for residual, mean_square in _mean_squares(problem, values):
        signal = _arc_signal(residual)
        if signal is None or any(u.name in problem.held for u in signal.starts):
            continue
        assert isinstance(residual, KernelResidual)
        if not _is_far(mean_square):
            segments.append(_Segment(residual, signal, 0, len(signal.node_time) - 1))
            continue
        # A first look at the very beginning gives the rate, and with it the length of a segment.
        for samples in (FEWEST_SAMPLES, 2 * FEWEST_SAMPLES, 4 * FEWEST_SAMPLES):
            beginning = residual.subset(np.arange(residual.samples) < samples)
            result = _fitted(beginning, problem, result, signal.starts, FIRST)
        pieces = _segments(residual, signal, _duration(signal, result))
        for k, piece in enumerate(pieces):
            result = _fitted(piece.residual, problem, result, piece.signal.starts, FIRST)
            if k + 1 < len(pieces):
                result.update(_handed_over(piece, pieces[k + 1], result))
        segments += pieces
    return segments, result


def _handed_over(piece: _Segment, following: _Segment, values: Values) -> dict[str, np.ndarray]:
    """The state at the end of one segment as the start of the next."""
    states, _ = piece.signal.flow.propagate(
        piece.signal.initial_state(values), [values[u.name] for u in piece.signal.flow.shared], piece.signal.inputs,
        piece.signal.held, piece.signal.node_time)
    state, found, place = states[-1], {}, 0
    given = dict(zip(piece.signal.flow.initial, following.signal.starts, strict=True))
    for label, manifold in piece.signal.flow.state:
        if label in given:
            found[given[label].name] = state[place : place + manifold.ambient]
        place += manifold.ambient
    return found


def _segmented(problem: Problem, segments: list[_Segment], values: Values) -> Problem:
    """The problem of the segments alone: their states and the shared unknowns that they feel."""
    unknowns: dict[str, Unknown] = {}
    for segment in segments:
        for u in segment.residual.unknowns:
            unknowns.setdefault(u.name, u)
    return Problem(tuple(unknowns.values()), tuple(s.residual for s in segments), {n: values[n] for n in unknowns},
                   problem.held & set(unknowns))


def _joined(problem: Problem, begin: Values) -> Values:
    """Segments solved together, then whole arcs of growing length."""
    segments, values = _tracked(problem, begin)
    if not any("@" in s.residual.name for s in segments):
        return begin
    small = _segmented(problem, segments, values)
    return _lengthened(problem, {**values, **solve(small, COARSE).values})


def _lengthened(problem: Problem, values: Values) -> Values:
    """Whole arcs, in case the end of one is still far away first half of them."""
    values = {u.name: values[u.name] for u in problem.unknowns}
    for fraction in (0.25, 0.5):
        if not _far(problem, values):
            break
        residuals = [r.subset(r.time - r.time[0] <= fraction * (r.time[-1] - r.time[0]))
                     if isinstance(r, KernelResidual) and _arc_signal(r) else r for r in problem.residuals]
        values = solve(problem.with_residuals(residuals).starting_at(values), COARSE).values
    return values


# --- turned quaternions ----------------------------------------------------------------------------------------------


def _suspects(problem: Problem, values: Values) -> list[str]:
    """Shared quaternions that feed a residual far from its noise, in order."""
    far = [r for r, m in _mean_squares(problem, values) if _is_far(m)]
    return [u.name for u in problem.free if isinstance(u.manifold, UnitQuaternion) and not u.nuisance
            and any(u.name == v.name for r in far for v in r.unknowns)]


def _turned(problem: Problem, values: Values, name: str) -> Values:
    """The best of 24 turned starts of one quaternion, each polished on what it feeds, segments in the place of arcs."""
    segments, tracked = _tracked(problem, values)
    fed = [s for s in segments if any(u.name == name for u in s.residual.unknowns)]
    others = []
    for r in problem.residuals:
        if any(u.name == name for u in r.unknowns) and isinstance(r, KernelResidual) and _arc_signal(r) is None:
            stride = max(1, r.samples // THINNED)
            others.append(r.subset(np.arange(r.samples) % stride == 0))
    states = {u.name for s in fed for u in s.signal.starts}
    unknowns = {u.name: u for r in (*(s.residual for s in fed), *others) for u in r.unknowns}
    held = frozenset(unknowns) - states - {name}
    small = Problem(tuple(unknowns.values()), (*(s.residual for s in fed), *others),
                    {n: tracked[n] for n in unknowns}, held)
    best_cost, best = np.inf, dict(tracked)
    for turn in Rotation.create_group("O"):
        start = (turn * Rotation.from_quat(values[name], scalar_first=True)).as_quat(scalar_first=True)
        found = solve(small.starting_at({name: start}), FIRST)
        prepared = small.prepared(found.values)
        cost = normal_equations(prepared, found.values, prepared.linearize(found.values)).cost
        if cost < best_cost:
            best_cost, best = cost, {**tracked, **found.values}
    if segments:
        best = {**best, **solve(_segmented(problem, segments, best), COARSE).values}
    return _lengthened(problem, best)
