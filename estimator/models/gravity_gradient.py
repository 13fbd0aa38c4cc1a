"""Torque of a point mass's gravity field on an extended rigid body."""

from __future__ import annotations

import casadi as ca

from estimator.models.earth import GRAVITATIONAL_PARAMETER
from estimator.models.rotations import Matrix, rotate


def torque(position: Matrix, tracker_from_inertial: Matrix, inertia: Matrix) -> Matrix:
    """Gravity-gradient torque ``3 mu/r^5 r x (J r)`` (3, N m, tracker axes).

    Args:
        position: (3,) m, inertial, from the Earth's centre.
        tracker_from_inertial: quaternion (4).
        inertia: (3, 3) kg m2 about the centre of mass, tracker axes.

    Source: B. Wie, Space Vehicle Dynamics and Control, 2nd ed., equation (6.155).
    """
    r = rotate(tracker_from_inertial, position)
    square = ca.sumsqr(r)
    factor = 3 * GRAVITATIONAL_PARAMETER / (square * square * ca.sqrt(square))
    return factor * ca.cross(r, ca.mtimes(inertia, r))
