"""A torque against the rotation, proportional to the rate about each axis."""

from __future__ import annotations

import casadi as ca

from estimator.effects.declaration import Parameter, Sample, declare
from estimator.models.rotations import Matrix


def contribution(sample: Sample, p: Matrix) -> Matrix:
    """Torque (3, N m, tracker axes) ``-c w`` with one coefficient for each axis (3, N m s)."""
    return -ca.vertcat(*(p[i] * sample.rate[i] for i in range(3)))


EFFECT = declare(
    "viscous-damping", "torque",
    tuple(Parameter(f"damping_{axis}", "N m s", 1e-3, (0.0, 10.0)) for axis in "xyz"), contribution,
    summary="Energy is lost to a torque proportional to the rate (eddy currents, a damper); one coefficient for each "
            "tracker axis.",
    formula="-damping w",
    zero="damping = 0",
    reference="Hughes, Spacecraft Attitude Dynamics, chapter 5",
)
