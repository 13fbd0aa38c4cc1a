"""Each actuator axis gives its own multiple of the commanded torque."""

from __future__ import annotations

import casadi as ca

from estimator.effects.declaration import Sample, axes, declare
from estimator.models.rotations import Matrix


def contribution(sample: Sample, p: Matrix) -> Matrix:
    """Change of the command (3, N m, actuator axes): gain error of each axis times its command."""
    return ca.vertcat(*(p[i] * sample.command[i] for i in range(3)))


EFFECT = declare(
    "torque-scale-error", "command", axes("gain_error", "1", 1e-2, 0.5), contribution,
    summary="The gain of each actuator axis differs from 1. A common factor of the three is the scale of the inertia "
            "tensor: what the data determine is the map from command to torque over inertia.",
    formula="diag(gain_error) command",
    zero="gain_error = 0",
    reference="definition",
)
