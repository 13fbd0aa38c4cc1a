"""A part that spins inside the body: the gyrostat."""

from __future__ import annotations

import casadi as ca

from estimator.effects.declaration import Sample, axes, declare
from estimator.models.rotations import Matrix


def contribution(sample: Sample, p: Matrix) -> Matrix:
    """Torque (3, N m, tracker axes) ``-w x h`` of the constant internal momentum ``h`` (3, N m s, tracker axes)."""
    return -ca.cross(sample.rate, p)


EFFECT = declare(
    "internal-momentum", "torque", axes("momentum", "N m s", 1e-2, 50.0), contribution,
    summary="A wheel or rotor keeps a constant angular momentum relative to the body (a gyrostat).",
    formula="-w x momentum",
    zero="momentum = 0",
    reference="Wie, Space Vehicle Dynamics and Control, section 6.8",
)
