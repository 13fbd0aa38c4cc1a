"""The antenna frame turns against the tracker once an orbit."""

from __future__ import annotations

import casadi as ca

from estimator.effects.declaration import Sample, axes, declare
from estimator.models.radar import beam_doppler
from estimator.models.rotations import Matrix, exponential, rotate
from estimator.models.two_way_doppler import velocity_in_antenna


def contribution(sample: Sample, p: Matrix) -> Matrix:
    """Change of the shifts (beams, Hz) by a rotation of the antenna frame.

    The true ``antenna_from_tracker`` is ``exponential(turn) o antenna_from_tracker`` with
    ``turn = sine sin(u) + cosine cos(u)`` (rad, antenna axes).
    """
    turn = ca.sin(sample.orbit_phase) * p[:3] + ca.cos(sample.orbit_phase) * p[3:]
    velocity = velocity_in_antenna(sample.earth_fixed_velocity, sample.attitude, sample.antenna_from_tracker)
    return beam_doppler(sample.beam_direction, rotate(exponential(turn), velocity) - velocity, sample.carrier_frequency)


EFFECT = declare(
    "antenna-thermal-deformation", "doppler",
    (*axes("sine", "rad", 5e-5, 1e-2), *axes("cosine", "rad", 5e-5, 1e-2)), contribution,
    summary="Heating bends the structure between tracker and antenna with the period of the orbit.",
    formula="2 f/c beam . (R(turn) - 1) v_antenna, turn = sine sin(u) + cosine cos(u)",
    zero="sine = cosine = 0",
    reference="first harmonic of the orbit's phase from the ascending node",
)
