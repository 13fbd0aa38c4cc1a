"""The radar's carrier is not at its nominal frequency: every shift is scaled."""

from __future__ import annotations

from estimator.effects.declaration import Parameter, Sample, declare
from estimator.models.radar import beam_doppler
from estimator.models.rotations import Matrix
from estimator.models.two_way_doppler import velocity_in_antenna


def contribution(sample: Sample, p: Matrix) -> Matrix:
    """Change of the shifts (beams, Hz): the relative offset times the shift."""
    velocity = velocity_in_antenna(sample.earth_fixed_velocity, sample.attitude, sample.antenna_from_tracker)
    return p[0] * beam_doppler(sample.beam_direction, velocity, sample.carrier_frequency)


EFFECT = declare(
    "carrier-frequency-offset", "doppler", (Parameter("relative_offset", "1", 1e-6, (-1e-3, 1e-3)),), contribution,
    summary="The carrier's frequency is (1 + relative_offset) times the nominal one.",
    formula="relative_offset 2 f/c beam . v_antenna",
    zero="relative_offset = 0",
    reference="two-way Doppler shift is proportional to the carrier's frequency",
)
