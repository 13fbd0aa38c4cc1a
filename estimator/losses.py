"""Robust losses: how much a large whitened residual may cost, separate from the residual and from its whitening.

With ``s`` the squared whitened norm of one sample, the cost is ``rho(s) / 2`` and the weight of the sample in
iteratively reweighted least squares is ``rho'(s)``; near zero every loss is ``rho(s) = s``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np


class Loss(Protocol):
    """A loss as two functions of the squared whitened norm."""

    def value(self, square: np.ndarray) -> np.ndarray:
        """``rho(s)``, same shape."""

    def weight(self, square: np.ndarray) -> np.ndarray:
        """``rho'(s)``, same shape, in (0, 1]."""


@dataclass(frozen=True)
class Quadratic:
    """Plain least squares, ``rho(s) = s``."""

    def value(self, square: np.ndarray) -> np.ndarray:
        return np.asarray(square, dtype=float)

    def weight(self, square: np.ndarray) -> np.ndarray:
        return np.ones_like(square, dtype=float)


@dataclass(frozen=True)
class Huber:
    """Quadratic up to ``threshold`` sigma, linear beyond (Huber 1964)."""

    threshold: float = 2.5

    def value(self, square: np.ndarray) -> np.ndarray:
        k = self.threshold
        return np.where(square <= k * k, square, 2 * k * np.sqrt(np.maximum(square, 1e-300)) - k * k)

    def weight(self, square: np.ndarray) -> np.ndarray:
        return np.minimum(1.0, self.threshold / np.sqrt(np.maximum(square, 1e-300)))


@dataclass(frozen=True)
class Cauchy:
    """Logarithmic beyond ``threshold`` sigma: gross outliers lose all influence."""

    threshold: float = 3.0

    def value(self, square: np.ndarray) -> np.ndarray:
        c2 = self.threshold**2
        return c2 * np.log1p(square / c2)

    def weight(self, square: np.ndarray) -> np.ndarray:
        return 1.0 / (1.0 + square / self.threshold**2)


@dataclass(frozen=True)
class Barron:
    """The one-parameter family that holds the others (Barron, CVPR 2019, arXiv:1701.03077).

    ``shape`` 2 is quadratic, 1 a smooth Huber, 0 Cauchy, -2 Geman-McClure; ``threshold`` in sigma.
    """

    shape: float = 0.0
    threshold: float = 3.0

    def value(self, square: np.ndarray) -> np.ndarray:
        s = square / self.threshold**2
        c2 = self.threshold**2
        if self.shape == 2:
            return c2 * s
        if self.shape == 0:
            return 2 * c2 * np.log1p(s / 2)
        gap = abs(self.shape - 2)
        return 2 * c2 * gap / self.shape * np.expm1(self.shape / 2 * np.log1p(s / gap))

    def weight(self, square: np.ndarray) -> np.ndarray:
        s = square / self.threshold**2
        if self.shape == 2:
            return np.ones_like(s)
        if self.shape == 0:
            return 1.0 / (1.0 + s / 2)
        gap = abs(self.shape - 2)
        return (s / gap + 1) ** (self.shape / 2 - 1)


LOSSES: dict[str, Loss] = {"quadratic": Quadratic(), "huber": Huber(), "cauchy": Cauchy(), "barron": Barron()}
"""The losses by the name that the command line takes."""
