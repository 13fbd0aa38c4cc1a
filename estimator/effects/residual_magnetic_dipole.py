"""A magnetic moment of the spacecraft in the Earth's field."""

from __future__ import annotations

import casadi as ca

from estimator.effects.declaration import Sample, axes, declare
from estimator.models.rotations import Matrix, rotate


def contribution(sample: Sample, p: Matrix) -> Matrix:
    """Torque (3, N m, tracker axes) ``m x B`` of the dipole ``m`` (3, A m2, tracker axes)."""
    return ca.cross(p, rotate(sample.attitude, sample.magnetic_field))


EFFECT = declare(
    "residual-magnetic-dipole", "torque", axes("dipole", "A m2", 1.0, 20.0), contribution,
    summary="The spacecraft's own magnetic moment is turned by the geomagnetic field (IGRF).",
    formula="m x B, B in tracker axes",
    zero="dipole = 0",
    reference="Wertz, Spacecraft Attitude Determination and Control, section 17.2; field: IGRF-14",
)
