"""The free stream presses on the body off its centre of mass."""

from __future__ import annotations

import casadi as ca

from estimator.effects.declaration import Sample, axes, declare
from estimator.models.rotations import Matrix, rotate, safe_norm


def contribution(sample: Sample, p: Matrix) -> Matrix:
    """Torque (3, N m, tracker axes) of the drag at the centre of pressure.

    ``p`` (3, m3, tracker axes) is the arm from the centre of mass times area and drag coefficient; the air turns with
    the Earth.
    """
    wind = rotate(sample.attitude, sample.earth_fixed_velocity)
    return ca.cross(p, -sample.density / 2 * safe_norm(wind) * wind)


EFFECT = declare(
    "aerodynamic-torque", "torque", axes("arm_area", "m3", 1.0, 50.0), contribution,
    summary="Drag acts at a centre of pressure away from the centre of mass; the arm is multiplied by area and drag "
            "coefficient. The atmosphere is exponential with a scale height of 71 km about 700 km.",
    formula="arm_area x (-rho/2 |v| v), v against the turning atmosphere",
    zero="arm_area = 0",
    reference="Wertz, Spacecraft Attitude Determination and Control, section 17.2.3",
)
