"""What is unknown: a name, the manifold that it lives on, its unit, and how well it is known beforehand.

A manifold gives the step ``retract(x, d)`` from a point ``x`` (ambient coordinates) by a small tangent vector ``d``,
with ``retract(x, 0) == x``. Solvers, covariances and score tests work in tangent coordinates at the current point;
models see ambient coordinates alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import casadi as ca
import numpy as np

from estimator.models import rotations
from estimator.models.inertia import matrix_of, normalized_entries
from estimator.models.rotations import Matrix


class Manifold(Protocol):
    """A smooth set with ``ambient`` coordinates and ``tangent`` directions of freedom."""

    @property
    def ambient(self) -> int:
        """Number of coordinates of a point."""

    @property
    def tangent(self) -> int:
        """Number of directions of freedom."""

    def retract(self, point: Matrix, step: Matrix) -> Matrix:
        """The point reached from ``point`` by the tangent ``step`` (CasADi expression)."""

    def local(self, point: np.ndarray, other: np.ndarray) -> np.ndarray:
        """The tangent step from ``point`` to ``other``: ``retract(point, local(point, other)) == other``."""

    def labels(self) -> tuple[str, ...]:
        """A name for each tangent direction, for reports."""


@dataclass(frozen=True)
class Vector:
    """Euclidean space of ``size`` coordinates; ``names`` label them in reports."""

    size: int
    names: tuple[str, ...] = ()

    @property
    def ambient(self) -> int:
        return self.size

    @property
    def tangent(self) -> int:
        return self.size

    def retract(self, point: Matrix, step: Matrix) -> Matrix:
        return point + step

    def local(self, point: np.ndarray, other: np.ndarray) -> np.ndarray:
        return np.asarray(other, dtype=float) - point

    def labels(self) -> tuple[str, ...]:
        return self.names or tuple(str(i) for i in range(self.size))


@dataclass(frozen=True)
class UnitQuaternion:
    """Rotation ``x_from_y`` as a unit quaternion; the step is a rotation vector (rad) about the axes of x.

    ``retract(q, d) = exponential(d) o q``, so a covariance of the tangent is that of the small rotation about the
    axes of the frame named first ("antenna" for ``antenna_from_tracker``).
    """

    axes: tuple[str, str, str] = ("about x", "about y", "about z")

    @property
    def ambient(self) -> int:
        return 4

    @property
    def tangent(self) -> int:
        return 3

    def retract(self, point: Matrix, step: Matrix) -> Matrix:
        return rotations.normalize(rotations.multiply(rotations.exponential(step), point))

    def local(self, point: np.ndarray, other: np.ndarray) -> np.ndarray:
        change = rotations.multiply(ca.DM(other), rotations.conjugate(ca.DM(point)))
        return np.asarray(rotations.logarithm(change)).ravel()

    def labels(self) -> tuple[str, ...]:
        return self.axes


@dataclass(frozen=True)
class NormalizedInertia:
    """Inertia tensor of unit trace: symmetric, positive definite, and within the triangle inequality.

    Ambient coordinates are the six entries (Jxx, Jyy, Jzz, Jxy, Jxz, Jyz). A tensor is physical exactly when its
    second-moment matrix ``P = I tr(J)/2 - J`` is positive definite, so the step is taken there: with the Cholesky
    factor ``P = L L'`` and a symmetric traceless ``D`` of five entries, ``L (I + D/2)^2 L'``, scaled to trace 1/2.
    Every step, however long, gives a physical tensor.
    """

    @property
    def ambient(self) -> int:
        return 6

    @property
    def tangent(self) -> int:
        return 5

    def retract(self, point: Matrix, step: Matrix) -> Matrix:
        factor = _cholesky3(0.5 * ca.DM.eye(3) - matrix_of(point))
        half = 0.5 * ca.vertcat(
            ca.horzcat(step[0], step[2], step[3]),
            ca.horzcat(step[2], step[1], step[4]),
            ca.horzcat(step[3], step[4], -step[0] - step[1]),
        )
        root = ca.mtimes(factor, ca.DM.eye(3) + half)
        moved = ca.mtimes(root, root.T)
        scaled = 0.5 * moved / ca.trace(moved)
        return normalized_entries(0.5 * ca.DM.eye(3) - scaled)

    def local(self, point: np.ndarray, other: np.ndarray) -> np.ndarray:
        here = 0.5 * np.eye(3) - np.asarray(matrix_of(ca.DM(point)))
        there = 0.5 * np.eye(3) - np.asarray(matrix_of(ca.DM(other)))
        factor = np.linalg.cholesky(here)
        inner = np.linalg.solve(factor, np.linalg.solve(factor, there).T)
        eigenvalues, vectors = np.linalg.eigh(0.5 * (inner + inner.T))
        root = (vectors * np.sqrt(eigenvalues)) @ vectors.T
        step = 2 * (3 * root / np.trace(root) - np.eye(3))
        return np.array([step[0, 0], step[1, 1], step[0, 1], step[0, 2], step[1, 2]])

    def labels(self) -> tuple[str, ...]:
        return ("xx", "yy", "xy", "xz", "yz")


def _cholesky3(a: Matrix) -> Matrix:
    """Lower Cholesky factor of a symmetric positive definite 3 x 3 matrix, written out for symbolic use."""
    l00 = ca.sqrt(a[0, 0])
    l10, l20 = a[1, 0] / l00, a[2, 0] / l00
    l11 = ca.sqrt(a[1, 1] - l10 * l10)
    l21 = (a[2, 1] - l20 * l10) / l11
    l22 = ca.sqrt(a[2, 2] - l20 * l20 - l21 * l21)
    return ca.vertcat(ca.horzcat(l00, 0, 0), ca.horzcat(l10, l11, 0), ca.horzcat(l20, l21, l22))


@dataclass(frozen=True)
class Unknown:
    """One unknown of a problem.

    Attributes:
        name: how the user and the reports call it.
        manifold: where it lives.
        unit: of its tangent directions ("rad", "rad/s", "1", "N m").
        scale: prior sigma of each tangent direction in ``unit`` (one number or one per direction). It is the unit of
            the solver's steps and the yardstick of observability (posterior over prior sigma), and is *not* added
            to the cost unless ``prior`` says so.
        prior: True where the scale is real knowledge that enters the cost as a residual about the start value.
        nuisance: True for unknowns that the user did not ask for (the state at the start of an arc, the trajectory).
        description: what it is, in the user's words.
    """

    name: str
    manifold: Manifold
    unit: str
    scale: float | tuple[float, ...]
    prior: bool = False
    nuisance: bool = False
    description: str = ""
    frame: str = field(default="")

    @property
    def scales(self) -> np.ndarray:
        """Prior sigma per tangent direction (tangent,)."""
        return np.broadcast_to(np.asarray(self.scale, dtype=float), (self.manifold.tangent,)).copy()

    def direction_names(self) -> tuple[str, ...]:
        """User-readable name of each tangent direction."""
        return tuple(f"{self.name} {label}" for label in self.manifold.labels())


_RETRACTIONS: dict[Manifold, ca.Function] = {}


def retracted(unknown: Unknown, point: np.ndarray, step: np.ndarray) -> np.ndarray:
    """The point of ``unknown`` reached from ``point`` by ``step``, as numbers."""
    manifold = unknown.manifold
    if isinstance(manifold, Vector):
        return np.asarray(point, dtype=float) + step
    if manifold not in _RETRACTIONS:
        x, d = ca.SX.sym("x", manifold.ambient), ca.SX.sym("d", manifold.tangent)
        _RETRACTIONS[manifold] = ca.Function("retract", [x, d], [manifold.retract(x, d)])
    return np.asarray(_RETRACTIONS[manifold](point, step)).ravel()


def offsets(unknowns: Sequence[Unknown]) -> dict[str, slice]:
    """Columns of each unknown in the stacked tangent vector."""
    result, start = {}, 0
    for unknown in unknowns:
        result[unknown.name] = slice(start, start + unknown.manifold.tangent)
        start += unknown.manifold.tangent
    return result
