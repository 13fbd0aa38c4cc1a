"""Functions with corners, rounded off so that a fit can pass them."""

from __future__ import annotations

import casadi as ca

from estimator.models.rotations import Matrix

CORNER = 1e-5  # size below which the absolute value is rounded


def positive(value: Matrix) -> Matrix:
    """The absolute value, smooth at zero: for what is positive by nature and would be fitted below zero by noise."""
    return ca.sqrt(value * value + CORNER * CORNER)
