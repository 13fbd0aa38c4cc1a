"""Propellant that moves in its tank as a mass on three equal springs, exact in the displacement.

A mass at ``b + xi`` in body axes obeys ``xi'' + 2 w x xi' + (w' x + w x w x)(b + xi) + 2 z n xi' + n^2 xi = 0``, which
is linear in ``xi``: ``xi = X b`` with a matrix ``X`` (3 x 3) that the rate alone drives. Its torque on the body is then
linear in the second moment ``M = sum m b b^T`` of the moving masses: ``M`` is the parameter, for one tank or several
of equal frequency. ``m`` is the mass reduced for the motion of the centre of mass. The inertia tensor is that of the
whole body, masses at rest.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca

from estimator.models.rotations import Matrix, skew
from estimator.models.three_by_three import axial, solve


class Reaction(NamedTuple):
    """Torque (3, N m) of the propellant on the body, and second derivative (3 x 3, 1/s2) of the displacement."""

    torque: Matrix
    acceleration: Matrix


def _inertia(moment: Matrix) -> Matrix:
    trace: Matrix = ca.trace(moment)
    return trace * ca.DM.eye(3) - moment


def reaction(inertia: Matrix, rate: Matrix, other_torque: Matrix, displacement: Matrix, speed: Matrix, moment: Matrix,
             frequency: Matrix, damping: Matrix) -> Reaction:
    """Solve body and propellant together for both accelerations.

    Args:
        inertia: (3, 3) kg m2.
        rate: (3,) rad/s of the body.
        other_torque: (3,) N m, everything else on the right side of Euler's equation, the gyroscopic term included.
        displacement, speed: (3, 3) and (3, 3) 1/s, the matrix ``X`` and its derivative.
        moment: (3, 3) kg m2, second moment of the moving masses about the centre of mass.
        frequency: natural frequency with the body held, rad/s.
        damping: ratio to critical damping.
    """
    force: Matrix = frequency * frequency * displacement + 2 * damping * frequency * speed
    place = ca.DM.eye(3) + displacement
    at_rest = _inertia(moment)
    drive = axial(ca.mtimes([place, moment, force.T])) + ca.cross(rate, ca.mtimes(at_rest, rate))
    body = solve(inertia - at_rest, other_torque + drive)
    turn = skew(rate)
    coriolis: Matrix = ca.mtimes(turn, speed)
    acceleration = -force - 2 * coriolis - ca.mtimes(skew(body) + ca.mtimes(turn, turn), place)
    return Reaction(ca.mtimes(at_rest, body) + drive, acceleration)


def momentum(inertia: Matrix, rate: Matrix, displacement: Matrix, speed: Matrix, moment: Matrix) -> Matrix:
    """Angular momentum (3, N m s) of body and propellant, body axes: constant in inertial axes without outer torque."""
    place = ca.DM.eye(3) + displacement
    now = _inertia(ca.mtimes([place, moment, place.T]))
    return ca.mtimes(inertia - _inertia(moment) + now, rate) + axial(ca.mtimes([place, moment, speed.T]))


def energy(inertia: Matrix, rate: Matrix, displacement: Matrix, speed: Matrix, moment: Matrix,
           frequency: Matrix) -> Matrix:
    """Energy (J) of body and propellant; without outer torque it falls at ``2 z n tr(X' M X'^T)``."""
    velocity = speed + ca.mtimes(skew(rate), ca.DM.eye(3) + displacement)
    moving = ca.trace(ca.mtimes([velocity, moment, velocity.T])) / 2
    spring = frequency * frequency * ca.trace(ca.mtimes([displacement, moment, displacement.T])) / 2
    return ca.mtimes([rate.T, inertia - _inertia(moment), rate]) / 2 + moving + spring
