"""The exact two-way shift in place of its first order."""

from __future__ import annotations

from estimator.effects.declaration import Parameter, Sample, declare
from estimator.models.radar import beam_doppler
from estimator.models.rotations import Matrix
from estimator.models.two_way_doppler import exact_beam_doppler, velocity_in_antenna


def contribution(sample: Sample, p: Matrix) -> Matrix:
    """Change of the shifts (beams, Hz): the scale times the exact minus the first-order shift."""
    velocity = velocity_in_antenna(sample.earth_fixed_velocity, sample.attitude, sample.antenna_from_tracker)
    arguments = (sample.beam_direction, velocity, sample.carrier_frequency)
    return p[0] * (exact_beam_doppler(*arguments) - beam_doppler(*arguments))


EFFECT = declare(
    "second-order-doppler", "doppler", (Parameter("scale", "1", 1.0, (0.0, 2.0), nominal=1.0),), contribution,
    summary="The radar's wave is shifted twice, before and after scattering; its size is known, a scale other than 1 "
            "refutes it.",
    formula="scale (2 f beta/(1 - beta) - 2 f beta), beta = beam . v_antenna / c",
    zero="scale = 0",
    reference="relativistic Doppler shift of a wave reflected by a moving body, f (1 + beta)/(1 - beta)",
)
