"""An attitude error of the tracker that repeats with the orbit."""

from __future__ import annotations

import casadi as ca

from estimator.effects.declaration import Sample, axes, declare
from estimator.models.rotations import Matrix


def contribution(sample: Sample, p: Matrix) -> Matrix:
    """Rotation vector (3, rad, tracker axes): sine and cosine of the orbit's phase about each axis."""
    return ca.sin(sample.orbit_phase) * p[:3] + ca.cos(sample.orbit_phase) * p[3:]


EFFECT = declare(
    "tracker-low-frequency-error", "star_tracker",
    (*axes("sine", "rad", 5e-5, 5e-3), *axes("cosine", "rad", 5e-5, 5e-3)), contribution,
    summary="The tracker's attitude is off by an angle about each of its axes that varies once an orbit (heating, "
            "straylight).",
    formula="sine sin(u) + cosine cos(u), u the angle from the ascending node",
    zero="sine = cosine = 0",
    reference="ECSS-E-ST-60-20C, low frequency errors of star sensors, first harmonic of the orbit",
)
