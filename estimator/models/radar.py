"""Doppler shift of a radar beam, as pure CasADi functions."""

from __future__ import annotations

import casadi as ca

from estimator.models.rotations import Matrix

SPEED_OF_LIGHT = 299_792_458.0  # m/s


def beam_doppler(beams: Matrix, velocity: Matrix, carrier_frequency: Matrix) -> Matrix:
    """Doppler shift of each beam (b, Hz): ``2 f/c n.v``, positive when the spacecraft moves along the beam.

    Args:
        beams: (b, 3) unit vectors.
        velocity: (3, m/s) relative to the ground, in the axes of the beams.
        carrier_frequency: Hz.

    The paper's (1), to first order in v/c; the second-order term is the effect ``second-order-doppler``.
    """
    return 2 * carrier_frequency / SPEED_OF_LIGHT * ca.mtimes(beams, velocity)
