"""A rigid body with one lightly damped vibration mode, exact in the coupling.

A mode of modal coordinate ``eta`` and coupling vector ``d`` obeys ``eta'' + 2 z n eta' + n^2 eta = -d . w'`` and acts
on the body with the torque ``-d eta'' - w x (d eta')``. The coupling enters as ``d d^T`` alone. With ``eta = d . q``
the three components of ``q`` obey the same equation driven by ``-w'`` without ``d``, and the torque is linear in the
coupling matrix ``K = d d^T``: so ``K``, which has a direction at zero while ``d`` has none, is the parameter; a matrix
of higher rank is several modes of the same frequency. All vectors in body axes; the inertia tensor is that of the whole
body, mode at rest.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca

from estimator.models.rotations import Matrix
from estimator.models.three_by_three import solve


class Reaction(NamedTuple):
    """Torque (3, N m) of the mode on the body, and second derivative (3, rad/s2) of the modal displacement ``q``."""

    torque: Matrix
    acceleration: Matrix


def reaction(inertia: Matrix, rate: Matrix, other_torque: Matrix, displacement: Matrix, speed: Matrix,
             coupling: Matrix, frequency: Matrix, damping: Matrix) -> Reaction:
    """Solve body and mode together for both accelerations.

    Args:
        inertia: (3, 3) kg m2.
        rate: (3,) rad/s of the body.
        other_torque: (3,) N m, everything else on the right side of Euler's equation, the gyroscopic term included.
        displacement, speed: (3,) rad and rad/s of ``q``.
        coupling: (3, 3) kg m2.
        frequency: natural frequency of the mode with the body held, rad/s.
        damping: ratio to critical damping.
    """
    restoring = frequency * frequency * displacement + 2 * damping * frequency * speed
    drive = ca.mtimes(coupling, restoring) - ca.cross(rate, ca.mtimes(coupling, speed))
    body = solve(inertia - coupling, other_torque + drive)
    return Reaction(ca.mtimes(coupling, body) + drive, -restoring - body)


def momentum(inertia: Matrix, rate: Matrix, speed: Matrix, coupling: Matrix) -> Matrix:
    """Angular momentum (3, N m s) of body and mode, body axes: constant in inertial axes without outer torque."""
    return ca.mtimes(inertia, rate) + ca.mtimes(coupling, speed)


def energy(inertia: Matrix, rate: Matrix, displacement: Matrix, speed: Matrix, coupling: Matrix,
           frequency: Matrix) -> Matrix:
    """Energy (J) of body and mode; without outer torque it falls at ``2 z n q'^T K q'``."""
    moving = ca.mtimes([rate.T, inertia, rate]) / 2 + ca.mtimes([speed.T, coupling, rate + speed / 2])
    return moving + frequency * frequency * ca.mtimes([displacement.T, coupling, displacement]) / 2
