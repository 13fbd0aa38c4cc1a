"""Proof on data that the fit never used: how far the prediction misses them, before and after an effect is added."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from estimator.discrepancy.gap import below_noise
from estimator.estimate import Estimate
from estimator.problem import Problem, normal_equations, offsets
from estimator.residuals import KernelResidual, Linearization, Residual
from estimator.trajectory_residual import TrajectoryResidual


@dataclass(frozen=True)
class HeldOut:
    """Misfit of one channel on held-out or on fitted samples.

    Attributes:
        channel: kind of measurement.
        unit: of ``rms`` and ``floor``.
        rms: root mean square of the prediction's miss, in the channel's unit, of whitened residuals times the noise.
        floor: root mean square of the noise of those samples.
        square: sum of whitened squares.
        count: number of scalar measurements.
    """

    channel: str
    unit: str
    rms: float
    floor: float
    square: float
    count: int

    @property
    def ratio(self) -> float:
        """Miss over noise: 1 where nothing but noise is left."""
        return float(np.sqrt(self.square / self.count)) if self.count else float("nan")


def misfit(problem: Problem, parts: Sequence[Linearization], *, held_out: bool) -> dict[str, HeldOut]:
    """Misfit per channel of the held-out samples, or of the fitted ones."""
    sums: dict[str, list[tuple[float, float, int, str]]] = {}
    for residual, part in zip(problem.residuals, parts, strict=True):
        whitened, sigma = _samples(residual, part, held_out)
        if whitened.size:
            square, noise = float(np.sum(whitened**2)), float(np.sum(sigma**2))
            sums.setdefault(residual.channel, []).append((square, noise, whitened.size, residual.unit))
    result = {}
    for channel, entries in sums.items():
        square = sum(e[0] for e in entries)
        count = sum(e[2] for e in entries)
        floor = float(np.sqrt(sum(e[1] for e in entries) / count))
        result[channel] = HeldOut(channel, entries[0][3], floor * float(np.sqrt(square / count)), floor, square, count)
    return result


def _samples(residual: Residual, part: Linearization, held_out: bool) -> tuple[np.ndarray, np.ndarray]:
    if isinstance(residual, KernelResidual):
        accepted = np.ones(residual.samples, dtype=bool) if residual.accepted is None else residual.accepted
        mask = ~accepted if held_out else accepted
        return part.whitened[mask], residual.standard_deviation[mask]
    if isinstance(residual, TrajectoryResidual):
        used = residual.weights[:, 0] > 0
        mask = ~used if held_out else used
        return (part.residual / residual.standard_deviation)[mask], residual.standard_deviation[mask]
    return np.zeros((0, 1)), np.zeros((0, 1))


@dataclass(frozen=True, eq=False)
class _Prediction:
    """Held-out samples as a fit predicts them, whitened by their noise alone.

    Attributes:
        miss: (n,) measured minus predicted.
        columns: (n, p) its derivative along the p free unknowns, in their scales.
        spread: (p, p) inverse of the information that training and held-out samples have together.
    """

    miss: np.ndarray
    columns: np.ndarray
    spread: np.ndarray

    def product(self, a: np.ndarray, b: np.ndarray) -> float:
        """``a' S^-1 b`` with S = 1 + H P H', the covariance of what the fit predicts (Woodbury's identity)."""
        return float(a @ b - (self.columns.T @ a) @ self.spread @ (self.columns.T @ b))


def _held_out(estimate: Estimate, channels: Collection[str], names: Collection[str]) -> np.ndarray:
    """Misses (n,) of the held-out samples of these channels and residuals, whitened by their noise."""
    return np.concatenate([np.zeros(0), *(
        _samples(r, p, True)[0].ravel() for r, p in zip(estimate.problem.residuals, estimate.parts, strict=True)
        if r.channel in channels and r.name in names)])


def _prediction(estimate: Estimate, channels: Collection[str], names: Collection[str]) -> _Prediction:
    free = estimate.problem.free
    places = offsets(free)
    scales = np.concatenate([np.zeros(0), *(u.scales for u in free)])
    blocks = [np.zeros((0, len(scales)))]
    for residual, part in zip(estimate.problem.residuals, estimate.parts, strict=True):
        if residual.channel not in channels or residual.name not in names:
            continue
        rows = np.zeros((_samples(residual, part, True)[0].size, len(scales)))
        if isinstance(residual, KernelResidual) and residual.accepted is not None:
            jacobian = part.jacobian[~residual.accepted].reshape(len(rows), part.jacobian.shape[-1])
            start = 0
            for u in part.columns:
                width = u.manifold.tangent
                if u.name in places:
                    rows[:, places[u.name]] = jacobian[:, start : start + width]
                start += width
        blocks.append(rows)
    columns = np.concatenate(blocks) * scales
    training = normal_equations(estimate.problem, estimate.values, estimate.parts).matrix
    eigenvalues, vectors = np.linalg.eigh(training + columns.T @ columns)
    kept = eigenvalues > 1e-14 * max(float(np.max(eigenvalues, initial=0.0)), 1e-300)
    basis = vectors[:, kept]
    return _Prediction(_held_out(estimate, channels, names), columns, (basis / eigenvalues[kept]) @ basis.T)


@dataclass(frozen=True)
class Proof:
    """What the held-out samples say about an effect.

    Attributes:
        drop: of their weighed sum of squares by the effect, at the size that the fit gave it.
        change: squared length of the change that the effect makes to them, in the same measure.
    """

    drop: float
    change: float

    @property
    def refuted(self) -> bool:
        """Whether the sum rises although that is improbable (0.1 %) if the effect is real.

        It then drops by ``change`` give or take twice its root. The fitted size errs: up to an eighth of the change of
        such error is allowed for, which takes a quarter of the drop.
        """
        return self.drop <= 0 and self.drop <= 0.75 * self.change - 3.09 * 2 * float(np.sqrt(self.change))


def proved(before: Estimate, after: Estimate, channels: Collection[str]) -> Proof:
    """What the held-out samples of the channels that an effect changes say about it.

    The misses are weighed by the covariance of the prediction without the effect, that of the noise and of the fit
    together: the state that is carried on to the held-out end of an arc may err by more than its samples' noise.
    """
    names = {r.name for r in before.problem.residuals} & {r.name for r in after.problem.residuals}
    first = _prediction(before, channels, names)
    missed = _held_out(after, channels, names)
    moved = first.miss - missed
    return Proof(first.product(first.miss, first.miss) - first.product(missed, missed),
                 max(first.product(moved, moved), 0.0))


def nothing_to_explain(estimate: Estimate, channels: Collection[str]) -> bool:
    """Whether the fitted samples of the channels stay clearly below their declared noise: an effect that lowers them
    further explains what was declared to be noise."""
    return below_noise(np.concatenate([np.zeros(0), *(
        _samples(r, p, False)[0].ravel() for r, p in zip(estimate.problem.residuals, estimate.parts, strict=True)
        if r.channel in channels)]))


def channels_of(problem: Problem, name: str) -> tuple[str, ...]:
    """The channels whose residuals depend on the unknown ``name``."""
    return tuple(dict.fromkeys(r.channel for r in problem.residuals if any(u.name == name for u in r.unknowns)))


def shifts(before: Estimate, after: Estimate) -> dict[str, float]:
    """How far each asked-for unknown moved, in sigmas of the estimate after (length over all its directions)."""
    moved = {}
    names = {u.name for u in before.unknowns}
    for u in after.unknowns:
        if u.name not in names or u.nuisance:
            continue
        step = u.manifold.local(np.asarray(before.values[u.name]), np.asarray(after.values[u.name]))
        covariance = after.covariance_of(u.name)
        solved = np.linalg.lstsq(covariance, step, rcond=1e-12)[0]
        moved[u.name] = float(np.sqrt(max(step @ solved, 0.0)))
    return moved
