"""First-order lag between the commanded torque and the torque that acts.

The lagged command ``y`` obeys ``tau y' = u - y``. Three things ask for more than this equation: it is stiff for small
``tau``; at ``tau = 0``, where the score test differentiates, it is singular; and there the derivative of the torque
``-tau u'`` is a pulse at each switch of the command, which no sample inside the steps would see. So the
solution is used instead of the equation. Inside a step of length ``h``, where the command is constant,

    y - u = d exp(-t/tau),   d = y(start) - u,

and the contribution is the straight line in ``t`` that has the same impulse and the same first moment as this
exponential over the step, so that rate and attitude at the end of the step are those of the exact lag to the order
of the integrator, for every ratio ``tau/h`` from zero up. With ``theta = tau/h`` and ``E = exp(-1/theta)`` the two
moments are ``theta (1 - E)`` and ``theta (theta (1 - E) - E - (1 - E)/2)``: smooth at ``theta = 0``, where their
derivatives are 1 and -1/2, the impulse ``-tau du`` of a switch and its place at the start of the step. They are
continued to negative ``tau`` (a lead, which no actuator has) by smooth bounded functions with the same value, slope and
curvature at zero, so that zero is an inner point of the fit.

The state is ``y`` at the start of the step. Its exact change over the step is given as a derivative that is zero at the
start and the middle and six times the mean at the end of the step: a classical Runge-Kutta step then holds the state in
all its stages and adds exactly the change.
"""

from __future__ import annotations

import casadi as ca

from estimator.effects.declaration import Parameter, Sample, declare
from estimator.models.rotations import Matrix


def _change(theta: Matrix) -> Matrix:
    """``1 - exp(-1/|theta|)``, one with all its derivatives zero at ``theta = 0``."""
    size = ca.fabs(theta)
    return ca.if_else(size > 2e-3, -ca.expm1(-1 / ca.fmax(size, 2e-3)), 1)  # exp(-500) is zero beside 1


def contribution(sample: Sample, p: Matrix) -> Matrix:
    """Change of the command (3, N m, actuator axes): lagged minus commanded, see the module."""
    theta = p[0] / sample.step
    change = _change(theta)
    impulse = theta * change
    bracket = ca.if_else(theta > 0, theta * change - 1 + change / 2, -0.5 / (1 + 2 * theta + 4 * theta * theta))
    moment = theta * bracket
    return (sample.state - sample.command) * (impulse + 12 * moment * (sample.step_fraction - 0.5))


def state_derivative(sample: Sample, p: Matrix) -> Matrix:
    """Rate (3, N m/s) that a Runge-Kutta step turns into the exact change of the lagged command over the step."""
    change = (sample.command - sample.state) * _change(p[0] / sample.step)
    return 6 * sample.step_fraction * (2 * sample.step_fraction - 1) / sample.step * change


EFFECT = declare(
    "actuator-lag", "command", (Parameter("time_constant", "s", 1.0, (0.0, 30.0)),), contribution,
    summary="The torque follows its command with a first-order lag.",
    formula="y - u with tau y' = u - y, in closed form over each integration step",
    zero="time_constant = 0",
    reference="first-order lag; the closed form is derived in the file of the effect",
    state_size=3, state_derivative=state_derivative,
)
