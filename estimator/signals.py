"""What a residual sees of the unknowns at each sample: values and their derivatives along the unknowns.

A :class:`Signal` turns unknowns into one value per sample (the velocity on a fitted trajectory, the attitude carried
along an arc). It returns the values and their Jacobian in tangent coordinates; the residual chains that Jacobian with
the one of its small per-sample kernel, so that nothing long is ever differentiated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import casadi as ca
import numpy as np

from estimator.unknowns import Manifold, Unknown, Vector

Values = Mapping[str, np.ndarray]
"""Current ambient value of each unknown by name."""


class Signal(Protocol):
    """One value per sample that depends on some unknowns.

    Attributes:
        name: the kernel's input that it feeds.
        manifold: where each value lives.
        unknowns: what it depends on, in the order of the Jacobian's columns.
    """

    @property
    def name(self) -> str: ...

    @property
    def manifold(self) -> Manifold: ...

    @property
    def unknowns(self) -> tuple[Unknown, ...]: ...

    def evaluate(self, values: Values) -> tuple[np.ndarray, np.ndarray]:
        """Values (n, ambient) and Jacobian (n, tangent, sum of the unknowns' tangents)."""

    def symbolic(self, values: Mapping[str, ca.MX]) -> ca.MX:
        """The values as one CasADi expression (ambient, n), for solvers that differentiate by themselves."""

    def subset(self, keep: np.ndarray) -> Signal:
        """The same signal at the samples of the boolean mask ``keep`` (n,)."""


@dataclass(frozen=True, eq=False)
class LinearSignal:
    """A value that is linear in one vector unknown: ``offset[k] + matrix[k] @ unknown``.

    Attributes:
        offset: (n, size).
        matrix: (n, size, unknown's size).
    """

    name: str
    unknown: Unknown
    offset: np.ndarray
    matrix: np.ndarray

    @property
    def manifold(self) -> Manifold:
        return Vector(self.offset.shape[1])

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        return (self.unknown,)

    def evaluate(self, values: Values) -> tuple[np.ndarray, np.ndarray]:
        return self.offset + self.matrix @ values[self.unknown.name], self.matrix

    def symbolic(self, values: Mapping[str, ca.MX]) -> ca.MX:
        n, size, columns = self.matrix.shape
        flat = ca.mtimes(ca.DM(self.matrix.reshape(n * size, columns)), values[self.unknown.name])
        return ca.reshape(flat, size, n) + ca.DM(self.offset.T)

    def subset(self, keep: np.ndarray) -> LinearSignal:
        return LinearSignal(self.name, self.unknown, self.offset[keep], self.matrix[keep])
