"""The one joint nonlinear least-squares problem: unknowns, residuals, where to start, what is held.

A :class:`Problem` is immutable. ``held`` names the unknowns that keep their start value: an effect that is in the
kernels and not (yet) in the fit is a held unknown at zero, so its signature costs one linearization and no second
model. ``problem.freeing(...)``, ``problem.holding(...)``, ``problem.subset(...)`` and ``problem.with_effect(...)``
give new problems.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.residuals import Linearization, Residual
from estimator.unknowns import Unknown, offsets, retracted


@dataclass(frozen=True, eq=False)
class Problem:
    """Unknowns and residuals of one joint estimate.

    Attributes:
        unknowns: all unknowns, in the order of reports.
        residuals: all residuals.
        start: ambient start value of every unknown.
        held: names of the unknowns that are not estimated.
        rebuild: makes the problem again with other effects in the model; None where the problem takes none.
        effects: names of the effects whose unknowns are estimated.
    """

    unknowns: tuple[Unknown, ...]
    residuals: tuple[Residual, ...]
    start: Mapping[str, np.ndarray]
    held: frozenset[str] = frozenset()
    rebuild: Callable[[tuple[str, ...]], Problem] | None = None
    effects: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        names = [u.name for u in self.unknowns]
        if len(set(names)) != len(names):
            raise ValueError(f"two unknowns share a name: {sorted(n for n in names if names.count(n) > 1)}")
        missing = [n for n in names if n not in self.start]
        if missing:
            raise ValueError(f"no start value for {missing}")
        known = set(names)
        for residual in self.residuals:
            unknown_to_us = [u.name for u in residual.unknowns if u.name not in known]
            if unknown_to_us:
                raise ValueError(f"residual {residual.name!r} depends on {unknown_to_us}, which the problem lacks")

    @property
    def free(self) -> tuple[Unknown, ...]:
        """The unknowns that are estimated."""
        return tuple(u for u in self.unknowns if u.name not in self.held)

    def unknown(self, name: str) -> Unknown:
        """The unknown of that name.

        Raises:
            KeyError: there is none.
        """
        for u in self.unknowns:
            if u.name == name:
                return u
        raise KeyError(name)

    def holding(self, *names: str) -> Problem:
        """The same problem with these unknowns held at their start value."""
        return replace(self, held=self.held | set(names))

    def freeing(self, *names: str) -> Problem:
        """The same problem with these unknowns estimated."""
        return replace(self, held=self.held - set(names))

    def starting_at(self, values: Mapping[str, np.ndarray]) -> Problem:
        """The same problem started at ``values`` (others keep their start)."""
        return replace(self, start={**self.start, **values})

    def with_residuals(self, residuals: Iterable[Residual]) -> Problem:
        """The same unknowns with other residuals."""
        return replace(self, residuals=tuple(residuals))

    def with_effect(self, name: str) -> Problem:
        """The problem with the named effect in the model and its parameters estimated.

        Raises:
            ValueError: the problem takes no effects.
        """
        if name in self.effects:
            return self
        if self.rebuild is not None:  # a dormant effect may act to first order only
            return self.rebuild((*self.effects, name))
        if any(u.name == name for u in self.unknowns):
            return replace(self.freeing(name), effects=(*self.effects, name))
        raise ValueError(f"this problem takes no effects (asked for {name!r})")

    def prepared(self, values: Mapping[str, np.ndarray]) -> Problem:
        """The same problem with all whitening taken at ``values``."""
        return replace(self, residuals=tuple(r.prepared(values) for r in self.residuals))

    def linearize(self, values: Mapping[str, np.ndarray], only: Collection[str] | None = None) -> list[Linearization]:
        """Every residual and its Jacobian at ``values``, with ``only`` at least the columns of those unknowns."""
        return [r.linearize(values, only) for r in self.residuals]

    def moved(self, values: Mapping[str, np.ndarray], step: np.ndarray) -> dict[str, np.ndarray]:
        """``values`` moved by the stacked tangent ``step`` of the free unknowns."""
        result = dict(values)
        for unknown, columns in zip(self.free, offsets(self.free).values(), strict=True):
            result[unknown.name] = retracted(unknown, values[unknown.name], step[columns])
        return result

    def difference(self, values: Mapping[str, np.ndarray], other: Mapping[str, np.ndarray]) -> np.ndarray:
        """Stacked tangent step of the free unknowns from ``values`` to ``other``."""
        return np.concatenate([np.zeros(0), *(u.manifold.local(values[u.name], other[u.name]) for u in self.free)])

    def prior_terms(self, values: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Whitened deviation from the start of the free unknowns that carry a prior, and the mask of their columns."""
        columns = offsets(self.free)
        total = sum(u.manifold.tangent for u in self.free)
        deviation, active = np.zeros(total), np.zeros(total, dtype=bool)
        for u in self.free:
            if u.prior:
                deviation[columns[u.name]] = u.manifold.local(self.start[u.name], values[u.name]) / u.scales
                active[columns[u.name]] = True
        return deviation, active


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Gradient and Gauss-Newton matrix of the joint cost in scaled tangent coordinates.

    Coordinates are tangent steps over each unknown's scale, so an eigenvalue of ``matrix`` is the squared ratio of
    prior to posterior sigma along its direction.
    """

    matrix: np.ndarray
    gradient: np.ndarray
    cost: float
    shares: tuple[tuple[np.ndarray, np.ndarray] | None, ...] = ()
    """Of each residual: its columns, and its part of the matrix in physical coordinates."""


def weighted_rows(part: Linearization, pick: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Jacobian (n m, columns ``pick``) and whitened residual (n m) of a residual, weighted; copied where needed."""
    n, m, p = part.jacobian.shape
    rows = part.jacobian if np.array_equal(pick, np.arange(p)) else part.jacobian[:, :, pick]
    right = part.whitened
    if not (part.weight == 1.0).all():
        root = np.sqrt(part.weight)[:, None]
        rows, right = rows * root[:, :, None], right * root
    return rows.reshape(n * m, len(pick)), right.reshape(n * m)


def normal_equations(problem: Problem, values: Mapping[str, np.ndarray], parts: Sequence[Linearization],
                     unknowns: Sequence[Unknown] | None = None) -> NormalEquations:
    """Sum the residuals' contributions over ``unknowns`` (default: the free ones)."""
    chosen = tuple(problem.free if unknowns is None else unknowns)
    columns = offsets(chosen)
    scales = np.concatenate([np.zeros(0), *(u.scales for u in chosen)])
    total = len(scales)
    matrix, gradient, cost = np.zeros((total, total)), np.zeros(total), 0.0
    shares: list[tuple[np.ndarray, np.ndarray] | None] = []
    for part in parts:
        picks, index, position = [], [], 0
        for u in part.columns:
            width = u.manifold.tangent
            if u.name in columns:
                picks.append(np.arange(position, position + width))
                index.append(np.arange(columns[u.name].start, columns[u.name].stop))
            position += width
        cost += part.cost
        if not picks:
            shares.append(None)
            continue
        pick, place = np.concatenate(picks), np.concatenate(index)
        if not len(pick):
            shares.append(None)
            continue  # nothing else feels the trajectory: the positions have no columns
        rows, right = weighted_rows(part, pick)
        share = rows.T @ rows
        shares.append((place, share))
        matrix[np.ix_(place, place)] += share
        gradient[place] += rows.T @ right
    matrix *= np.outer(scales, scales)
    gradient *= scales
    deviation, active = problem.prior_terms(values)
    if unknowns is None:
        matrix[active, active] += 1.0
        gradient += np.where(active, deviation, 0.0)
    cost += float(np.sum(deviation**2))
    return NormalEquations(matrix, gradient, cost, tuple(shares))
