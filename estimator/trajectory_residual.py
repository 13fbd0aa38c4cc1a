"""The positions of a whole campaign as a handful of rows: the linear block, eliminated exactly.

The trajectory is linear in its coefficients, and the position residual alone determines them. Their least-squares
problem is compressed once (:mod:`estimator.linear_block`) into whitened coordinates zeta with unit information, so
that the cost of all positions is a constant plus ``|zeta|^2``. Other residuals see the trajectory only through its
values at their own epochs; the directions of zeta that these can feel are few (of order a hundred) and become the
unknown ``trajectory``; all other directions stay at their own optimum and cost nothing. The size of the joint
problem, and the cost of an iteration, no longer depend on the number of positions.

Effects in the position residual (a lever arm, a clock) are seen through their projections on and off the block's
span, which is exact as well.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import casadi as ca
import numpy as np

from estimator.linear_block import LinearBlock
from estimator.residuals import Kernel, Linearization
from estimator.signals import LinearSignal, Values
from estimator.stretched_block import StretchedBlock
from estimator.unknowns import Unknown, Vector

NEGLIGIBLE = 1e-7
"""Sensitivity, relative to the largest, below which a direction of the block is not felt by the other residuals."""


CHUNK = 20_000_000
"""Entries of a sensitivity matrix that are formed at once."""


def felt_directions(block: LinearBlock | StretchedBlock,
                    epochs: Sequence[tuple[np.ndarray, int]]) -> tuple[np.ndarray, ...]:
    """Per axis, the orthonormal directions (rank, felt) of zeta that values at ``epochs`` depend on.

    Args:
        block: the compressed positions.
        epochs: (times, order of the derivative) of every value that another residual uses.
    """
    result: list[np.ndarray] = []
    previous = np.zeros((0, 0))
    for axis in range(block.coefficients.shape[1]):
        stacked = []
        for times, derivative in epochs:
            if len(times):
                sensitivity = block.sensitivity(times, derivative, axis)
                largest = float(np.max(np.abs(sensitivity), initial=0.0))
                stacked.append(sensitivity / (largest or 1.0))
        if not stacked:
            result.append(np.zeros((int(block.ranks[axis]), 0)))
            continue
        rows = np.concatenate(stacked)
        # Axes that are measured alike feel alike.
        alike = result and rows.shape == previous.shape and float(np.max(np.abs(rows - previous))) < 1e-12
        result.append(result[-1] if alike else _row_space(rows))
        previous = rows
    return tuple(result)


def _row_space(rows: np.ndarray) -> np.ndarray:
    """Orthonormal directions (columns, r) along which ``rows`` have singular values that are not negligible.

    A few sessions feel a small part of a long trajectory: the space is first caught by products with more random
    vectors than it has dimensions, and decomposed inside that.
    """
    most, columns = min(rows.shape), rows.shape[1]
    draw = np.random.default_rng(0)
    size = 128
    while 2 * size < most:
        caught = np.linalg.qr(rows.T @ draw.standard_normal((len(rows), size)))[0]
        inside = rows @ caught
        _, singular, vectors = np.linalg.svd(np.linalg.qr(inside, mode="r"), full_matrices=False)
        kept = singular > NEGLIGIBLE * singular[0]
        if kept.sum() < 0.8 * size:
            return np.asarray(caught @ vectors[kept].T)
        size *= 2
    if len(rows) > columns:
        rows = np.asarray(np.linalg.qr(rows, mode="r"))
    _, singular, vectors = np.linalg.svd(rows, full_matrices=False)
    return np.asarray(vectors[singular > NEGLIGIBLE * singular[0]].T)


@dataclass(frozen=True, eq=False)
class TrajectoryResidual:
    """Measured minus fitted positions of a whole campaign.

    Attributes:
        name, channel, unit: for reports.
        trajectory: the unknown (Vector) of the felt directions, all axes stacked.
        block: the compressed positions.
        directions: per axis (rank, felt), from :func:`felt_directions`.
        time: (n,) s.
        values: (n, axes) measured positions.
        weights: (n, axes) inverse variances (times robust weights), zero for rejected samples.
        standard_deviation: (n, axes) declared noise of every sample, those of zero weight too.
        effect_kernel: per-sample contribution of effects (axes), or None.
        effect_data: per-sample inputs of ``effect_kernel``.
    """

    name: str
    channel: str
    unit: str
    trajectory: Unknown
    block: LinearBlock | StretchedBlock
    directions: tuple[np.ndarray, ...]
    time: np.ndarray
    values: np.ndarray
    weights: np.ndarray
    standard_deviation: np.ndarray
    effect_kernel: Kernel | None = None
    effect_data: Mapping[str, np.ndarray] = field(default_factory=dict)

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        return (self.trajectory, *(self.effect_kernel.unknowns if self.effect_kernel else ()))

    @property
    def rejected(self) -> int:
        """Number of samples of zero weight."""
        return int(np.sum(self.weights[:, 0] == 0))

    def signal(self, name: str, times: np.ndarray, derivative: int) -> LinearSignal:
        """The trajectory's values (or derivatives) at ``times`` as an input of another residual."""
        axes = self.block.coefficients.shape[1]
        sizes = [d.shape[1] for d in self.directions]
        matrix = np.zeros((len(times), axes, sum(sizes)))
        start = 0
        for axis, (d, size) in enumerate(zip(self.directions, sizes, strict=True)):
            matrix[:, axis, start : start + size] = self.block.sensitivity(times, derivative, axis) @ d
            start += size
        return LinearSignal(name, self.trajectory, self.block.values(times, derivative), matrix)

    @cached_property
    def _fit_residual(self) -> np.ndarray:
        return self.block.residuals()

    def _felt(self) -> int:
        return sum(d.shape[1] for d in self.directions)

    def _ranks(self) -> int:
        return sum(d.shape[0] for d in self.directions)

    def linearize(self, values: Values, only: Collection[str] | None = None) -> Linearization:
        zeta = np.asarray(values[self.trajectory.name], dtype=float)
        felt = self._felt()
        counted = float(np.count_nonzero(self.weights)) - (self._ranks() - felt)
        if self.effect_kernel is None:
            whitened = np.concatenate([zeta, [np.sqrt(float(np.sum(self.block.sum_of_squares)))]])
            jacobian = np.zeros((felt + 1, 1, felt))
            jacobian[range(felt), 0, range(felt)] = 1.0
            residual = self._fit_residual
        else:
            whitened, jacobian, residual = self._with_effects(zeta, values)
        return Linearization(residual=residual, whitened=whitened[:, None], jacobian=jacobian, columns=self.unknowns,
                             weight=np.ones(len(whitened)), cost=float(whitened @ whitened), measurements=counted)

    def _with_effects(self, zeta: np.ndarray, values: Values) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        kernel = self.effect_kernel
        assert kernel is not None
        inputs = {**self.effect_data, **{u.name: values[u.name] for u in kernel.unknowns}}
        contribution, jacobians = kernel(len(self.time), inputs)
        slopes = np.concatenate([jacobians[u.name] for u in kernel.unknowns], axis=2)
        columns = slopes.shape[2]
        fit = self._fit_residual
        rows, row_jacobians = [], []
        gram = np.zeros((columns + 1, columns + 1))
        residual = fit - contribution
        start = 0
        for axis, directions in enumerate(self.directions):
            signature = np.column_stack([contribution[:, axis], slopes[:, axis, :]])
            projected = self.block.project(signature, axis)
            residual[:, axis] += self._taken_up(projected[:, 0], axis)
            felt = directions.T @ projected
            size = directions.shape[1]
            # The trajectory has to take up what the effects leave: measured = trajectory + contribution.
            rows.append(zeta[start : start + size] + felt[:, 0])
            row_jacobians.append((start, felt[:, 1:]))
            start += size
            weight = self.weights[:, axis]
            outside = np.column_stack([fit[:, axis] - signature[:, 0], -signature[:, 1:]])
            inside = np.column_stack([-projected[:, 0], -projected[:, 1:]])
            gram += (outside * weight[:, None]).T @ outside - inside.T @ inside
        scale = np.sqrt(np.maximum(np.diag(gram), 0.0))
        scale[scale == 0] = 1.0
        eigenvalues, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
        # Triangular, the residual first: its row is the same whatever effects are beside it, so that rows of problems
        # with different effects can be compared.
        root = np.asarray(np.linalg.qr((vectors * np.sqrt(np.maximum(eigenvalues, 0.0))).T, mode="r")) * scale
        root *= np.where(np.diag(root) < 0, -1.0, 1.0)[:, None]
        total = start + columns + 1
        jacobian = np.zeros((total, 1, start + columns))
        jacobian[range(start), 0, range(start)] = 1.0
        for first, slope in row_jacobians:
            jacobian[first : first + len(slope), 0, start:] = slope
        jacobian[start:, 0, start:] = root[:, 1:]
        return np.concatenate([*rows, root[:, 0]]), jacobian, residual

    def _taken_up(self, projected: np.ndarray, axis: int) -> np.ndarray:
        """What the trajectory takes up of an effect at every sample (n,), from its projection (rank,)."""
        if not np.any(projected):
            return np.zeros(len(self.time))
        chunks = np.array_split(self.time, max(1, len(self.time) * len(projected) // CHUNK))
        return np.concatenate([self.block.sensitivity(t, 0, axis) @ projected for t in chunks])

    def prepared(self, values: Values) -> TrajectoryResidual:
        """The residual itself: its weights were settled when the positions were compressed."""
        return self

    def symbolic(self, values: Mapping[str, ca.MX]) -> ca.MX:
        zeta = values[self.trajectory.name]
        rest = np.sqrt(float(np.sum(self.block.sum_of_squares)))
        if self.effect_kernel is not None:
            raise ValueError("the symbolic form of the position residual takes no effects")
        return ca.vertcat(zeta, rest)


def trajectory_unknown(directions: Sequence[np.ndarray], *, displaced: bool = False) -> Unknown:
    """The unknown of the felt directions: unit information from the positions, so a scale far above one.

    Args:
        directions: per axis (rank, felt).
        displaced: whether an effect displaces the positions. A wrong clock moves the trajectory by kilometres, which
            the positions alone would never allow: the yardstick of what is determined must leave room for it.
    """
    size = sum(d.shape[1] for d in directions)
    return Unknown("trajectory", Vector(size), "1", 1e6 if displaced else 100.0, nuisance=True,
                   description="Fourier coefficients of the trajectory, in the directions that other data feel")
