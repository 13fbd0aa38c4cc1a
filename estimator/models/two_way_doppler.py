"""A radar's shift beyond its first order, and the velocity that makes it."""

from __future__ import annotations

import casadi as ca

from estimator.models.radar import SPEED_OF_LIGHT
from estimator.models.rotations import Matrix, rotate


def velocity_in_antenna(velocity: Matrix, tracker_from_inertial: Matrix, antenna_from_tracker: Matrix) -> Matrix:
    """Velocity (3, m/s) in antenna axes from the same velocity in inertial axes."""
    return rotate(antenna_from_tracker, rotate(tracker_from_inertial, velocity))


def exact_beam_doppler(beams: Matrix, velocity: Matrix, carrier_frequency: Matrix) -> Matrix:
    """Exact two-way shift ``f (1 + beta)/(1 - beta) - f = 2 f beta/(1 - beta)`` of each beam (b, Hz).

    Args:
        beams: (b, 3) unit vectors.
        velocity: (3, m/s) relative to the ground, in the axes of the beams.
        carrier_frequency: Hz.
    """
    beta: Matrix = ca.mtimes(beams, velocity / SPEED_OF_LIGHT)
    return 2 * carrier_frequency * beta / (1 - beta)
