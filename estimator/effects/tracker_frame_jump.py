"""The tracker's frame steps by a constant rotation at an unknown time."""

from __future__ import annotations

import functools

import casadi as ca

from estimator.effects.declaration import Effect, EffectInstance, Layout, Parameter, Sample, Search, axes, register
from estimator.models.rotations import Matrix

NAME = "tracker-frame-jump"
TRIALS = 48  # where the stretches of data are not known
BETWEEN = 8.0  # s between times inside a stretch of data that are tried first: the state of an arc hides the others
INSIDE = (4, 24)  # fewest and most of them


def contribution(sample: Sample, p: Matrix) -> Matrix:
    """Rotation vector (3, rad, tracker axes) of the jump ``p[:3]``, full after the time ``p[3]`` (s), zero before.

    The time has no derivative: samples say between which two of them it lies, and a fit that followed the slope of a
    softened step would run from there. The search finds it.
    """
    return ca.if_else(sample.time >= p[3], 1.0, 0.0) * p[:3]


def _times(stretches: tuple[tuple[float, float], ...]) -> list[float]:
    """Times to try: all that lie between the same two stretches are one to the data, inside a stretch they are not."""
    found: list[float] = []
    for number, (start, stop) in enumerate(stretches):
        if number:
            found.append(0.5 * (stretches[number - 1][1] + start))
        count = min(max(round((stop - start) / BETWEEN), INSIDE[0]), INSIDE[1])
        found += [start + (k + 0.5) / count * (stop - start) for k in range(count)]
    return sorted(set(found))


@functools.lru_cache(maxsize=64)  # equal instances on equal layouts: their kernels are built once
def _instances(layout: Layout) -> tuple[EffectInstance, ...]:
    first, last = layout.tracker_span
    if last <= first:
        return ()
    edge = (last - first) / (TRIALS + 1)
    search = Search(first + edge, last - edge, TRIALS, "linear")
    if layout.tracker_stretches:
        search = Search.of(_times(layout.tracker_stretches))
    time = Parameter("time", "s", edge, (first, last), search=search)
    return (EffectInstance(NAME, NAME, "star_tracker", (*axes("jump", "rad", 1e-4, 2e-2), time), contribution,
                           zero="jump = 0", reference="definition"),)


EFFECT = register(Effect(
    NAME, "star_tracker",
    "At an unknown time the tracker's frame turns by a constant rotation against the rest of the body (a thermal "
    "snap, a change of the star catalogue). The data determine its time to the samples between which it lies.",
    _instances, "jump from time on",
))
