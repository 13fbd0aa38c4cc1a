"""The Earth's rotation angle is off."""

from __future__ import annotations

from estimator.effects.declaration import Parameter, Sample, declare
from estimator.models.radar import beam_doppler
from estimator.models.rotations import Matrix, about_z, rotate
from estimator.models.two_way_doppler import velocity_in_antenna


def contribution(sample: Sample, p: Matrix) -> Matrix:
    """Change of the shifts (beams, Hz) with a true rotation angle larger by ``p`` (rad) than the campaign's.

    Positions are measured in Earth-fixed axes, so that the offset turns the velocity against the attitude, which is
    measured in inertial axes.
    """
    change = rotate(about_z(p[0]), sample.earth_fixed_velocity) - sample.earth_fixed_velocity
    velocity = velocity_in_antenna(change, sample.attitude, sample.antenna_from_tracker)
    return beam_doppler(sample.beam_direction, velocity, sample.carrier_frequency)


EFFECT = declare(
    "earth-rotation-offset", "doppler", (Parameter("offset", "rad", 1e-5, (-2e-2, 2e-2)),), contribution,
    summary="The Earth's rotation angle is larger by the offset than the campaign says (UT1, a wrong epoch).",
    formula="2 f/c beam . antenna_from_inertial (Rz(offset) - 1) v",
    zero="offset = 0",
    reference="rotation about the Earth's axis",
)
