"""Which directions the data determine, in the user's terms.

The yardstick is dimensionless: the ratio of posterior to prior sigma along a direction, the prior sigma being the
scale declared with each unknown. A direction whose ratio exceeds the threshold is one that the data do not determine;
it is named by the unknowns that take part in it, and its value is left where it started.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtri

from estimator.unknowns import UnitQuaternion, Unknown, offsets

UNDETERMINED = 1.001
"""Posterior over prior sigma above which a direction counts as not determined.

A little above one: where a prior enters the cost, a direction that the data leave alone has a ratio of exactly one, and
is determined by that prior; rounding must not decide."""


@dataclass(frozen=True)
class WeakDirection:
    """One direction that the data do not determine.

    Attributes:
        ratio: posterior over prior sigma (infinite where the data carry nothing at all).
        sentence: the direction in the user's terms.
        participation: share of each unknown in the direction, by name, largest first; the shares sum to 1.
        vector: the direction in scaled tangent coordinates of the free unknowns (unit length).
    """

    ratio: float
    sentence: str
    participation: dict[str, float]
    vector: np.ndarray


def determined(matrix: np.ndarray, threshold: float = UNDETERMINED) -> bool:
    """Whether the data determine every direction: a cheap bound first, the spectrum only where that cannot tell.

    Args:
        matrix: Gauss-Newton matrix in scaled tangent coordinates.
        threshold: ratio of posterior to prior sigma.
    """
    if not len(matrix):
        return True
    factor, failed = dpotrf(matrix, lower=1)
    if failed:
        return False
    inverse, failed = dtrtri(factor, lower=1)
    if failed:
        return False
    # The sum of all variances bounds the largest.
    size = float(np.linalg.norm(inverse))
    return size < threshold or (size < threshold * np.sqrt(len(matrix))
                                and float(np.linalg.norm(inverse, 2)) < threshold)


def weak_directions(matrix: np.ndarray, unknowns: Sequence[Unknown],
                    threshold: float = UNDETERMINED) -> list[WeakDirection]:
    """Directions whose posterior sigma exceeds ``threshold`` prior sigmas, weakest first.

    Args:
        matrix: Gauss-Newton matrix in scaled tangent coordinates.
        unknowns: the free unknowns, in the order of the columns.
        threshold: ratio of posterior to prior sigma.
    """
    if determined(matrix, threshold):
        return []
    eigenvalues, vectors = np.linalg.eigh(matrix)
    found = []
    floor = np.finfo(float).eps * max(float(eigenvalues[-1]), 1.0) * len(eigenvalues)
    for value, vector in zip(eigenvalues, vectors.T, strict=True):
        if value >= 1.0 / threshold**2:
            break
        ratio = float("inf") if value <= floor * 1e-3 or value <= 0 else float(1 / np.sqrt(value))
        found.append(WeakDirection(ratio, *_described(vector, unknowns, ratio), vector))
    return found


def _described(vector: np.ndarray, unknowns: Sequence[Unknown], ratio: float) -> tuple[str, dict[str, float]]:
    columns = offsets(unknowns)
    shares = {u.name: float(np.sum(vector[columns[u.name]] ** 2)) for u in unknowns}
    ordered = dict(sorted(((k, v) for k, v in shares.items() if v > 0.02), key=lambda item: -item[1]))
    phrases = []
    for name in ordered:
        unknown = next(u for u in unknowns if u.name == name)
        part = vector[columns[name]] * unknown.scales
        length = float(np.linalg.norm(part))
        if length == 0:
            continue
        if isinstance(unknown.manifold, UnitQuaternion):
            axis = part / length
            axis = axis if axis[np.argmax(np.abs(axis))] > 0 else -axis
            frame = unknown.frame or name.split("_from_")[0]
            phrases.append(f"rotation of {name} about the {frame} axis ({axis[0]:.3f}, {axis[1]:.3f}, {axis[2]:.3f})")
        elif unknown.manifold.tangent == 1:
            phrases.append(name)
        else:
            weights = part / length
            terms = [f"{w:+.2f} {label}" for w, label in zip(weights, unknown.manifold.labels(), strict=True)
                     if abs(w) > 0.2]
            phrases.append(f"{name} ({' '.join(terms)})")
    size = "the data carry nothing about it" if not np.isfinite(ratio) else f"posterior over prior sigma {ratio:.2g}"
    joined = " together with ".join(phrases)
    return f"{joined}: {size}", ordered
