"""Epochs, noise and gross errors of the sensors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation


def epochs(start: float, stop: float, step: float, jitter: float, draw: np.random.Generator) -> np.ndarray:
    """Increasing epochs (n,) from start to stop (s); ``jitter`` is the width of their scatter over the step."""
    count = int(np.floor((stop - start) / step + 1e-9)) + 1
    time = start + step * np.arange(count)
    if jitter > 0.0:
        time = np.clip(time + jitter * step * (draw.random(count) - 0.5), start, stop)
    return time


def outside(time: np.ndarray, gaps: Sequence[tuple[float, float]]) -> np.ndarray:
    """Mask (n,) of the epochs that lie in no gap (ends of a gap belong to it)."""
    keep = np.ones(len(time), dtype=bool)
    for start, stop in gaps:
        keep &= (time < start) | (time > stop)
    return keep


def standard_deviations(
    nominal: np.ndarray | float, shape: tuple[int, int], variation: float, draw: np.random.Generator
) -> np.ndarray:
    """Declared standard deviations (n, m): the nominal ones, each sample scaled by its own factor if asked."""
    constant = np.broadcast_to(np.asarray(nominal, dtype=float), shape)  # repeats a value without using memory
    if variation == 0.0:
        return constant
    return constant * (1.0 + variation) ** draw.uniform(-1.0, 1.0, (shape[0], 1))


def chosen(count: int, fraction: float, draw: np.random.Generator) -> np.ndarray:
    """Indices of the samples with a gross error: exactly the fraction asked for, rounded."""
    return np.sort(draw.choice(count, size=round(fraction * count), replace=False))


def sizes(count: int, limits: tuple[float, float], draw: np.random.Generator) -> np.ndarray:
    """Sizes of gross errors in standard deviations, logarithmic draw."""
    low, high = np.log(limits)
    return np.exp(draw.uniform(low, high, count))


def directions(count: int, draw: np.random.Generator) -> np.ndarray:
    """Unit vectors (count, 3), uniform on the sphere."""
    vectors = draw.standard_normal((count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def turned(attitude: np.ndarray, rotation_vector: np.ndarray) -> np.ndarray:
    """Matrices (n, 3, 3) turned further by rotation vectors (n, 3) rad (active, axes of the result)."""
    return Rotation.from_rotvec(rotation_vector).as_matrix() @ attitude


def quaternions(matrices: np.ndarray) -> np.ndarray:
    """Unit quaternions (n, 4), scalar first, of matrices (n, 3, 3) that take coordinates from y to x."""
    if len(matrices) == 0:
        return np.zeros((0, 4))
    return np.asarray(Rotation.from_matrix(matrices).as_quat(scalar_first=True))


def random_matrix(draw: np.random.Generator) -> np.ndarray:
    """A rotation matrix (3, 3), uniform."""
    first, second = directions(2, draw)
    third = np.cross(first, second)
    third /= np.linalg.norm(third)
    return np.stack([first, np.cross(third, first), third])
