"""A lightly damped mode of a boom or an array, coupled to the body."""

from __future__ import annotations

import casadi as ca

from estimator.effects.declaration import Parameter, Sample, Search, declare
from estimator.models import flexible_mode
from estimator.models.rotations import Matrix
from estimator.models.smooth import positive
from estimator.models.three_by_three import symmetric


def _reaction(sample: Sample, p: Matrix) -> flexible_mode.Reaction:
    return flexible_mode.reaction(sample.inertia, sample.rate, sample.other_torque, sample.state[:3],
                                  sample.state[3:], symmetric(p), 2 * ca.pi * p[6], positive(p[7]))


def contribution(sample: Sample, p: Matrix) -> Matrix:
    """Torque (3, N m, tracker axes) of the mode on the body, the coupled accelerations solved exactly."""
    return _reaction(sample, p).torque


def state_derivative(sample: Sample, p: Matrix) -> Matrix:
    """Derivative (6) of modal displacement (3, rad) and speed (3, rad/s)."""
    return ca.vertcat(sample.state[3:], _reaction(sample, p).acceleration)


EFFECT = declare(
    "flexible-appendage", "torque",
    (*(Parameter(f"coupling_{axis}", "kg m2", 1.0, (0.0, 500.0)) for axis in ("xx", "yy", "zz")),
     *(Parameter(f"coupling_{axis}", "kg m2", 1.0, (-500.0, 500.0)) for axis in ("xy", "xz", "yz")),
     Parameter("frequency", "Hz", 0.05, (0.005, 1.0), search=Search(0.01, 0.6, 48, "square-root")),
     Parameter("damping_ratio", "1", 0.01, (0.0, 0.3), search=Search(0.005, 0.05, 2, "logarithmic"))),
    contribution,
    summary="A vibration mode exchanges momentum with the body. A mode of coupling vector d (kg^1/2 m) has the "
            "coupling matrix d d^T; its six entries are the parameters because d itself has no direction at zero, and "
            "the principal vector of the matrix is d. Other state-carrying torques are not in the acceleration "
            "that drives the mode. The size of the damping ratio counts, not its sign.",
    formula="-K q'' - w x (K q'), q'' + 2 z n q' + n^2 q = -w', K = d d^T",
    zero="coupling = 0",
    reference="Likins, Dynamics and Control of Flexible Space Vehicles, JPL TR 32-1329, 1970 (hybrid coordinates)",
    state_size=6, state_derivative=state_derivative, resolution=0.125,  # s
)
