"""A leak or a thruster plume: a torque fixed in the body."""

from __future__ import annotations

from estimator.effects.declaration import Sample, axes, declare
from estimator.models.rotations import Matrix


def contribution(sample: Sample, p: Matrix) -> Matrix:
    """The torque ``p`` itself (3, N m, tracker axes)."""
    return p


EFFECT = declare(
    "constant-body-torque", "torque", axes("torque", "N m", 1e-5, 1e-1), contribution,
    summary="A torque that is constant in the body's axes: a leak, a plume.",
    formula="torque",
    zero="torque = 0",
    reference="definition",
)
