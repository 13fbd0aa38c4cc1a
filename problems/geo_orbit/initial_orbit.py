"""A first orbit from two-line elements or from the data alone, to start the joint fit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from estimator.models.errors import MissingDataError

if TYPE_CHECKING:
    from problems.geo_orbit.problem import OrbitModel


def initial_state(model: OrbitModel) -> tuple[np.ndarray, np.ndarray]:
    """Position and velocity (GCRS) at the epoch."""
    raise MissingDataError("no initial orbit")
