"""Propellant moves in its tank: inertia changes and energy is lost while the angular momentum is kept."""

from __future__ import annotations

import casadi as ca

from estimator.effects.declaration import Parameter, Sample, Search, declare
from estimator.models import propellant
from estimator.models.rotations import Matrix
from estimator.models.smooth import positive
from estimator.models.three_by_three import symmetric


def _reaction(sample: Sample, p: Matrix) -> propellant.Reaction:
    return propellant.reaction(sample.inertia, sample.rate, sample.other_torque, ca.reshape(sample.state[:9], 3, 3),
                               ca.reshape(sample.state[9:], 3, 3), symmetric(p), 2 * ca.pi * p[6], positive(p[7]))


def contribution(sample: Sample, p: Matrix) -> Matrix:
    """Torque (3, N m, tracker axes) of the propellant on the body, the coupled accelerations solved exactly."""
    return _reaction(sample, p).torque


def state_derivative(sample: Sample, p: Matrix) -> Matrix:
    """Derivative (18) of the displacement matrix (9, by columns) and its speed (9, 1/s)."""
    return ca.vertcat(sample.state[9:], ca.vec(_reaction(sample, p).acceleration))


EFFECT = declare(
    "propellant-slosh", "torque",
    (*(Parameter(f"moment_{axis}", "kg m2", 1.0, (0.0, 500.0)) for axis in ("xx", "yy", "zz")),
     *(Parameter(f"moment_{axis}", "kg m2", 1.0, (-500.0, 500.0)) for axis in ("xy", "xz", "yz")),
     Parameter("frequency", "Hz", 0.02, (0.003, 0.5), search=Search(0.01, 0.25, 24, "square-root")),
     Parameter("damping_ratio", "1", 0.05, (0.0, 1.0), search=Search(0.02, 0.2, 2, "logarithmic"))),
    contribution,
    summary="A mass m at b in the tank moves on three equal springs with damping. Its parameters are the entries of "
            "the second moment m b b^T about the centre of mass (several tanks of one frequency add up). The "
            "centrifugal acceleration drives it as well as the angular one. Other state-carrying torques are not in "
            "the acceleration that drives the mass. The size of the damping ratio counts, not its sign.",
    formula="-m r x a + m b x (w' x b + w x (w x b)), r = b + xi, a the acceleration of the mass",
    zero="moment = 0",
    reference="Dodge, The New Dynamic Behavior of Liquids in Moving Containers, chapter 3 (spring-mass model)",
    state_size=18, state_derivative=state_derivative, resolution=0.25,  # s
)
