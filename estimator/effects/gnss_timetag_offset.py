"""The navigation receiver's clock is off."""

from __future__ import annotations

import casadi as ca

from estimator.effects.declaration import Parameter, Sample, declare
from estimator.models.earth import ROTATION_RATE
from estimator.models.rotations import Matrix, about_z, conjugate, rotate


def contribution(sample: Sample, p: Matrix) -> Matrix:
    """Change of the measured position (3, m, Earth-fixed): that of ``t + p`` minus that of the tag ``t``.

    To second order in the offset. The second derivative in the turning frame is ``a - 2 e x v' - e x (e x r)``, e the
    Earth's rotation.
    """
    spin = ca.DM([0, 0, ROTATION_RATE])
    acceleration = (sample.acceleration - 2 * ca.cross(spin, sample.earth_fixed_velocity)
                    - ca.cross(spin, ca.cross(spin, sample.position)))
    moved = p[0] * sample.earth_fixed_velocity + p[0] * p[0] / 2 * acceleration
    return rotate(conjugate(about_z(sample.earth_angle)), moved)


EFFECT = declare(
    "gnss-timetag-offset", "gnss", (Parameter("offset", "s", 1e-3, (-10.0, 10.0)),), contribution,
    summary="A position tagged t was taken at t + offset.",
    formula="position(t + offset) - position(t), to second order in the offset",
    zero="offset = 0",
    reference="kinematics in a turning frame",
)
