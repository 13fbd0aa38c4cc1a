"""The three actuator axes are not at right angles."""

from __future__ import annotations

import casadi as ca

from estimator.effects.declaration import Parameter, Sample, declare
from estimator.models.rotations import Matrix


def contribution(sample: Sample, p: Matrix) -> Matrix:
    """Change of the command (3, N m, actuator axes).

    Of each pair of axes each leans half the angle ``p`` (xy, xz, yz, rad) towards the other. The opposite, common
    turn of the axes is a rotation of the actuator frame and belongs to its unknown.
    """
    xy, xz, yz = p[0] / 2, p[1] / 2, p[2] / 2
    x, y, z = sample.command[0], sample.command[1], sample.command[2]
    return ca.vertcat(xy * y + xz * z, xy * x + yz * z, xz * x + yz * y)


EFFECT = declare(
    "actuator-axis-nonorthogonality", "command",
    tuple(Parameter(f"angle_{pair}", "rad", 5e-3, (-0.3, 0.3)) for pair in ("xy", "xz", "yz")), contribution,
    summary="Each pair of actuator axes encloses a right angle minus the parameter; the frame is the one against which "
            "both lean half of it.",
    formula="symmetric matrix with the half angles off its diagonal, times the command",
    zero="all angles = 0",
    reference="symmetric part of the misalignment matrix; the antisymmetric part is the frame's rotation",
)
