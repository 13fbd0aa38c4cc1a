"""The radar's clock is off."""

from __future__ import annotations

import casadi as ca

from estimator.effects.declaration import Parameter, Sample, declare
from estimator.models.earth import ROTATION_RATE
from estimator.models.radar import beam_doppler
from estimator.models.rotations import Matrix, exponential, multiply
from estimator.models.two_way_doppler import velocity_in_antenna


def contribution(sample: Sample, p: Matrix) -> Matrix:
    """Change of the shifts (beams, Hz): that of ``t + p`` minus that of the tag ``t``.

    The body turns with its rate and the velocity changes with its acceleration, both held over the offset.
    """
    turned = multiply(exponential(-p[0] * sample.rate), sample.attitude)
    # the velocity against the turning Earth is v - e x r: its derivative in inertial axes is a - e x v
    frame = ROTATION_RATE * ca.vertcat(-sample.velocity[1], sample.velocity[0], 0)
    later = sample.earth_fixed_velocity + p[0] * (sample.acceleration - frame)
    change = velocity_in_antenna(later, turned, sample.antenna_from_tracker) - velocity_in_antenna(
        sample.earth_fixed_velocity, sample.attitude, sample.antenna_from_tracker)
    return beam_doppler(sample.beam_direction, change, sample.carrier_frequency)


EFFECT = declare(
    "doppler-timetag-offset", "doppler", (Parameter("offset", "s", 1e-3, (-2.0, 2.0)),), contribution,
    summary="A Doppler sample tagged t was taken at t + offset.",
    formula="shift(t + offset) - shift(t), rate and acceleration held",
    zero="offset = 0",
    reference="kinematics of attitude and orbit over the offset",
)
