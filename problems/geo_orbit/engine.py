"""One engine behind the burns of a kept satellite: thrust, mass and mounting change little, so that size tells length.

Ranges every two hours show few burns at work, and the length of the others is open; taken as impulses, they leave
metres in the ranges around them and tens of metres in those that fall into the burn. But the burns that do show their
length all have one acceleration, and this holds for the others too: :func:`engine_of` measures it from those, and
:meth:`Engine.row` makes it knowledge of a burn, its size still free. Each of the two nozzles, for burns to the north
and to the south, points where it is mounted: a burn that leaves this direction is one with a step beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

_FEWEST = 4  # burns of known length that tell of an engine
_TELLING = 0.15  # relative sigma of a length that is worth averaging
_LEAST = 0.02  # relative spread below which no two burns of an engine are taken to be alike
_MOST = 0.15  # and beyond which they are not of one engine
_TURNED = 0.03  # rad, sigma of a burn's direction about that of the others
_SMALL = 0.25  # of the usual size, below which a manoeuvre is something else
_SHORTEST = 30.0  # s that starting and stopping may take
_LEFT = 4.0  # of these sigmas beyond which it is not the nozzle's alone


@dataclass(frozen=True)
class Engine:
    """A constant acceleration.

    Attributes:
        acceleration: m/s2, with its sigma.
        sigma: m/s2.
        spread: of single burns about it, relative.
        burns: number of burns that told.
        north, south: (3,) radial, along, cross, unit vectors of burns with a positive and a negative cross-track part;
            None where the burns do not tell of one.
        least: m/s below which a manoeuvre is taken for something else.
    """

    acceleration: float
    sigma: float
    spread: float
    burns: int
    north: np.ndarray | None = None
    south: np.ndarray | None = None
    least: float = 0.0

    def made(self, velocity: np.ndarray) -> bool:
        """Whether a velocity (3,) is a burn of this engine: across the orbit's plane, and not a small one."""
        return bool(abs(velocity[2]) > abs(velocity[1]) and np.linalg.norm(velocity) > self.least)

    def duration(self, velocity: np.ndarray) -> float:
        """Length of a burn (s) of a velocity (3,), m/s."""
        return float(np.linalg.norm(velocity)) / self.acceleration

    def misfit(self, velocity: np.ndarray, duration: np.ndarray, doubt: float = 0.0) -> np.ndarray:
        """Square of the distance (n,) of burns from this engine, in sigmas.

        Args:
            velocity: (n, 3) m/s; duration: (n,) s.
            doubt: further sigma of the durations, s.
        """
        expected = np.linalg.norm(velocity, axis=1) / self.acceleration
        return np.asarray((duration - expected) ** 2 / ((self.spread * expected) ** 2 + doubt**2 + _SHORTEST**2))

    def axis(self, velocity: np.ndarray) -> np.ndarray | None:
        """Direction (3,) of the nozzle that burns to the side of a velocity (3,)."""
        return self.north if velocity[2] > 0 else self.south

    def leaves(self, velocity: np.ndarray) -> bool:
        """Whether a burn does not point where its nozzle does."""
        axis = self.axis(velocity)
        if axis is None:
            return False
        off = velocity - (velocity @ axis) * axis
        return float(np.linalg.norm(off)) > _LEFT * _TURNED * float(np.linalg.norm(velocity))

    def row(self, velocity: np.ndarray) -> np.ndarray:
        """Row (4,) over three velocities and the duration of a burn that is noise of size one near ``velocity``."""
        size = max(float(np.linalg.norm(velocity)), 1e-12)
        sigma = float(np.hypot(self.spread * size / self.acceleration, _SHORTEST))
        return np.array([*(-velocity / size / self.acceleration / sigma), 1.0 / sigma])


def engine_of(velocity: Sequence[np.ndarray], duration: Sequence[float], sigma: Sequence[float]) -> Engine | None:
    """The engine of burns, or None where they do not tell of one.

    Args:
        velocity: (3,) of each, m/s.
        duration, sigma: of each, s.
    """
    told = [(float(np.linalg.norm(v)) / d, s / d) for v, d, s in zip(velocity, duration, sigma, strict=True)
            if d > 0 and s < _TELLING * d]
    if len(told) < _FEWEST:
        return None
    value, relative = np.array(told).T
    middle = float(np.median(value))
    weight = 1.0 / (relative**2 + _LEAST**2)
    # A burn that is two, or one with a step beside it, has the acceleration of no engine.
    near = np.abs(value / middle - 1.0) < 3.0 * np.sqrt(relative**2 + _MOST**2 / 9.0)
    if near.sum() < max(_FEWEST, 0.6 * len(value)):
        return None
    mean = float(np.sum((weight * value)[near]) / np.sum(weight[near]))
    excess = (value[near] / mean - 1.0) ** 2 - relative[near] ** 2
    spread = max(_LEAST, float(np.sqrt(max(np.median(excess) / 0.455, 0.0))))
    if spread > _MOST:
        return None
    sigma_ = mean * float(np.sqrt(1.0 / np.sum(1.0 / (relative[near] ** 2 + spread**2))))
    return Engine(mean, sigma_, spread, int(near.sum()), _axis(velocity, 1.0), _axis(velocity, -1.0),
                  _SMALL * float(np.median([np.linalg.norm(v) for v in velocity])))


def _axis(velocity: Sequence[np.ndarray], side: float) -> np.ndarray | None:
    """The common direction (3,) of the burns on one side of the orbit's plane; None where they have none."""
    units = np.array([v / np.linalg.norm(v) for v in velocity if side * v[2] > 0])
    if len(units) < _FEWEST:
        return None
    middle = np.median(units, axis=0)
    middle /= np.linalg.norm(middle)
    apart = np.linalg.norm(units - middle, axis=1)
    return middle if np.median(apart) < 2 * _TURNED else None
