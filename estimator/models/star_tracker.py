"""What a star tracker measures, as pure CasADi functions."""

from __future__ import annotations

from estimator.models import rotations
from estimator.models.rotations import Matrix


def attitude_residual(measured: Matrix, tracker_from_inertial: Matrix, error: Matrix) -> Matrix:
    """Small rotation (3, rad, tracker axes) from the predicted to the measured attitude.

    Args:
        measured: ``tracker_from_inertial`` as measured (4).
        tracker_from_inertial: true attitude (4).
        error: systematic rotation vector (3, rad, tracker axes) that the instrument adds:
            measured = exponential(noise) o exponential(error) o true.
    """
    predicted = rotations.multiply(rotations.exponential(error), tracker_from_inertial)
    return rotations.logarithm(rotations.multiply(measured, rotations.conjugate(predicted)))


def true_attitude(measured: Matrix, error: Matrix, noise: Matrix) -> Matrix:
    """The attitude (4) behind a measured one with the systematic rotation ``error`` and the random one ``noise``."""
    without_noise = rotations.multiply(rotations.exponential(-noise), measured)
    return rotations.multiply(rotations.exponential(-error), without_noise)
