"""Sunlight presses on the body off its centre of mass."""

from __future__ import annotations

import casadi as ca

from estimator.effects.declaration import Sample, axes, declare
from estimator.models.rotations import Matrix, rotate

SOLAR_PRESSURE = 4.54e-6  # N/m2 on an absorbing surface at one astronomical unit


def contribution(sample: Sample, p: Matrix) -> Matrix:
    """Torque (3, N m, tracker axes) of the sunlight, zero in the Earth's shadow.

    ``p`` (3, m3, tracker axes) is the arm from the centre of mass times area and reflectivity coefficient.
    """
    return ca.cross(p, -SOLAR_PRESSURE * sample.sunlit * rotate(sample.attitude, sample.sun))


EFFECT = declare(
    "solar-radiation-torque", "torque", axes("arm_area", "m3", 1.0, 100.0), contribution,
    summary="Radiation pressure acts at a centre of pressure away from the centre of mass; off in eclipse.",
    formula="sunlit arm_area x (-P s), s the unit vector to the Sun",
    zero="arm_area = 0",
    reference="Wertz, Spacecraft Attitude Determination and Control, section 17.2.2",
)
