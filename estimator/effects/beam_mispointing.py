"""One beam of the radar leaves its direction in the antenna frame."""

from __future__ import annotations

import functools

import casadi as ca

from estimator.effects.declaration import Effect, EffectInstance, Layout, Parameter, Sample, register
from estimator.models.radar import SPEED_OF_LIGHT
from estimator.models.rotations import Matrix, exponential, rotate
from estimator.models.two_way_doppler import velocity_in_antenna

NAME = "beam-mispointing"


def turning_axes(direction: tuple[float, float, float]) -> tuple[int, int]:
    """The two antenna axes most nearly perpendicular to a beam: its mispointing is a rotation about these."""
    along = max(range(3), key=lambda axis: abs(direction[axis]))
    first, second = (axis for axis in range(3) if axis != along)
    return first, second


def _instance(layout: Layout, beam: int) -> EffectInstance:
    direction = layout.beam_directions[beam] if layout.beam_directions else (0.0, 0.0, 1.0)
    turned = turning_axes(direction)

    def contribution(sample: Sample, p: Matrix) -> Matrix:
        angles = [0, 0, 0]
        for i, axis in enumerate(turned):
            angles[axis] = p[i]
        nominal = sample.beam_direction[beam, :].T
        moved = rotate(exponential(ca.vertcat(*angles)), nominal)
        velocity = velocity_in_antenna(sample.earth_fixed_velocity, sample.attitude, sample.antenna_from_tracker)
        change = 2 * sample.carrier_frequency / SPEED_OF_LIGHT * ca.dot(moved - nominal, velocity)
        return ca.vertcat(*(change if b == beam else 0 for b in range(layout.beams)))

    # rad; 0.01 degree is a typical error of one beam's direction
    parameters = tuple(Parameter(f"angle_{'xyz'[axis]}", "rad", 2e-4, (-2e-2, 2e-2)) for axis in turned)
    return EffectInstance(f"{NAME}:{beam}", NAME, "doppler", parameters, contribution,
                          zero="both angles = 0", reference="rotation of one beam's unit vector in antenna axes")


@functools.lru_cache(maxsize=64)  # equal instances on equal layouts: their kernels are built once
def _instances(layout: Layout) -> tuple[EffectInstance, ...]:
    return tuple(_instance(layout, beam) for beam in range(layout.beams))


EFFECT = register(Effect(
    NAME, "doppler",
    "One beam (counted from 0 in the file's order) is turned away from its direction in the antenna frame, about the "
    "two antenna axes most nearly perpendicular to it; a turn about the beam itself has no effect.",
    _instances, "2 f/c ((R(angles) - 1) beam) . v_antenna on that beam",
))
