"""A star tracker that did not correct the aberration of starlight."""

from __future__ import annotations

import functools

import casadi as ca

from estimator.effects.declaration import Effect, EffectInstance, Layout, Parameter, Sample, register
from estimator.models.radar import SPEED_OF_LIGHT
from estimator.models.rotations import Matrix, rotate

NAME = "stellar-aberration"


def rotation_of_field(boresight: Matrix, velocity: Matrix) -> Matrix:
    """Rotation vector (3, rad) of the measured attitude of a tracker that looks along ``boresight``.

    All stars of a narrow field move towards the velocity together, by the turn of the boresight's own direction
    ``b`` to ``b'``: the vector is ``b x b'`` with the special-relativistic ``b'`` (its length is the sine of an angle
    below 2e-4 rad, equal to the angle to 1e-12). Over the whole sky the shifts would cancel: no rotation fits them.

    Args:
        boresight: (3,) unit vector.
        velocity: (3,) m/s against the solar system's barycentre, same axes.
    """
    beta = velocity / SPEED_OF_LIGHT
    along = ca.dot(boresight, beta)
    gamma = 1 / ca.sqrt(1 - ca.sumsqr(beta))
    return ca.cross(boresight, beta) * (1 + gamma / (1 + gamma) * along) / (1 + along)


@functools.lru_cache(maxsize=64)  # equal instances on equal layouts: their kernels are built once
def _instances(layout: Layout) -> tuple[EffectInstance, ...]:
    boresight = ca.DM(layout.tracker_boresight)

    def contribution(sample: Sample, p: Matrix) -> Matrix:
        velocity = rotate(sample.attitude, sample.velocity + sample.earth_velocity)
        return p[0] * rotation_of_field(boresight, velocity)

    return (EffectInstance(
        NAME, NAME, "star_tracker", (Parameter("scale", "1", 1.0, (0.0, 2.0), nominal=1.0),), contribution,
        zero="scale = 0",
        reference="Shuster, Stellar Aberration and Parallax: A Tutorial, J. Astronautical Sciences 51(4), 2003",
    ),)


EFFECT = register(Effect(
    NAME, "star_tracker",
    "The tracker's stars appear shifted towards the velocity of the spacecraft (orbital and annual part), "
    "which turns the measured attitude about the axis perpendicular to boresight and velocity; its size is known, a "
    "scale other than 1 refutes it.",
    _instances, "scale b x v/c, b the tracker's boresight (+z of its axes unless the layout says otherwise)",
))
