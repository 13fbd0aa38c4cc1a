"""The star tracker's clock is off."""

from __future__ import annotations

from estimator.effects.declaration import Parameter, Sample, declare
from estimator.models.rotations import Matrix


def contribution(sample: Sample, p: Matrix) -> Matrix:
    """Rotation vector (3, rad, tracker axes) of the body's turn ``-w p`` in the offset, the rate held over it.

    The sample tagged ``t`` was taken at ``t + p``: ``tracker_from_inertial`` turns with the opposite of the rate.
    """
    return -p[0] * sample.rate


EFFECT = declare(
    "tracker-timetag-offset", "star_tracker", (Parameter("offset", "s", 1e-3, (-2.0, 2.0)),), contribution,
    summary="A star tracker sample tagged t was taken at t + offset.",
    formula="-offset w",
    zero="offset = 0",
    reference="kinematics of the attitude over the offset, rate constant",
)
