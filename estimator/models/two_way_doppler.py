"""Doppler shift of a radar that moves with the spacecraft against a scatterer that rests on the Earth."""

from __future__ import annotations

from typing import Any

import casadi as ca

from estimator.models.rotations import Matrix, rotate

SPEED_OF_LIGHT = 299792458.0  # m/s, exact by definition of the metre


def velocity_in_antenna(velocity: Matrix, tracker_from_inertial: Matrix, antenna_from_tracker: Matrix) -> Matrix:
    """Velocity (3, m/s) in antenna axes from the same velocity in inertial axes."""
    return rotate(antenna_from_tracker, rotate(tracker_from_inertial, velocity))


def shift(carrier_frequency: Matrix, beam_direction: Matrix, velocity: Matrix) -> Matrix:
    """First-order two-way shift ``2 f/c dot(beam, v)`` (beams, Hz), positive when moving along the beam.

    Args:
        carrier_frequency: Hz.
        beam_direction: (beams, 3) unit vectors in antenna axes.
        velocity: (3,) m/s against the rotating Earth, antenna axes.
    """
    return 2 * carrier_frequency / SPEED_OF_LIGHT * ca.mtimes(beam_direction, velocity)


def exact_shift(carrier_frequency: Matrix, beam_direction: Matrix, velocity: Matrix) -> Any:
    """Exact two-way shift ``2 f beta/(1 - beta)`` (beams, Hz): ``f (1 + beta)/(1 - beta) - f``; arguments as
    :func:`shift`."""
    beta: Matrix = ca.mtimes(beam_direction, velocity) / SPEED_OF_LIGHT
    return 2 * carrier_frequency * beta / (1 - beta)
