"""The tracker's frame steps by a constant rotation at an unknown time."""

from __future__ import annotations

import functools

import casadi as ca

from estimator.effects.declaration import Effect, EffectInstance, Layout, Parameter, Sample, Search, axes, register
from estimator.models.rotations import Matrix

NAME = "tracker-frame-jump"
WIDTH = 0.05  # s over which the step rises: below a tracker's cycle, yet the time keeps a derivative
TRIALS = 48


def contribution(sample: Sample, p: Matrix) -> Matrix:
    """Rotation vector (3, rad, tracker axes) of the jump ``p[:3]``, full after the time ``p[3]`` (s), zero before."""
    return (1 + ca.tanh((sample.time - p[3]) / (2 * WIDTH))) / 2 * p[:3]


@functools.lru_cache(maxsize=64)  # equal instances on equal layouts: their kernels are built once
def _instances(layout: Layout) -> tuple[EffectInstance, ...]:
    first, last = layout.tracker_span
    if last <= first:
        return ()
    edge = (last - first) / (TRIALS + 1)
    time = Parameter("time", "s", edge, (first, last), search=Search(first + edge, last - edge, TRIALS, "linear"))
    return (EffectInstance(NAME, NAME, "star_tracker", (*axes("jump", "rad", 1e-4, 2e-2), time), contribution,
                           zero="jump = 0", reference="definition"),)


EFFECT = register(Effect(
    NAME, "star_tracker",
    "At an unknown time the tracker's frame turns by a constant rotation against the rest of the body (a thermal "
    "snap, a change of the star catalogue). The data determine its time to the samples between which it lies.",
    _instances, "jump from time on",
))
