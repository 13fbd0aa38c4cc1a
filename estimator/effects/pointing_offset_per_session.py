"""The attitude is off by a constant in each Doppler session, another one in each."""

from __future__ import annotations

import functools

import casadi as ca

from estimator.effects.declaration import Effect, EffectInstance, Layout, Parameter, Sample, axes, register
from estimator.models.radar import SPEED_OF_LIGHT
from estimator.models.rotations import Matrix, exponential, rotate

NAME = "pointing-offset-per-session"
MARGIN = 1e-6  # s, so that a sample at the border of its session belongs to it


@functools.lru_cache(maxsize=64)  # equal instances on equal layouts: their kernels are built once
def _instances(layout: Layout) -> tuple[EffectInstance, ...]:
    if not layout.sessions:
        return ()

    def contribution(sample: Sample, p: Matrix) -> Matrix:
        offset = ca.DM.zeros(3)
        for k, (start, stop) in enumerate(layout.sessions):
            inside = (sample.time >= start - MARGIN) * (sample.time <= stop + MARGIN)
            offset = offset + inside * p[3 * k : 3 * k + 3]
        nominal = rotate(sample.attitude, sample.earth_fixed_velocity)
        change = rotate(sample.antenna_from_tracker, rotate(exponential(offset), nominal) - nominal)
        return 2 * sample.carrier_frequency / SPEED_OF_LIGHT * ca.mtimes(sample.beam_direction, change)

    parameters: tuple[Parameter, ...] = ()
    for k in range(len(layout.sessions)):
        parameters += axes(f"session_{k + 1}", "rad", 1e-4, 2e-2)
    return (EffectInstance(NAME, NAME, "doppler", parameters, contribution, zero="all offsets = 0",
                           reference="definition"),)


EFFECT = register(Effect(
    NAME, "doppler",
    "In each Doppler session the true attitude is turned by a constant against the measured one, another one in each "
    "session (rotation vector in tracker axes). It can copy simpler effects: those win unless the data demand more.",
    _instances, "2 f/c beam . antenna_from_tracker (R(offset) - 1) v_tracker",
))
