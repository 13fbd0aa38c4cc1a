"""Keep-out cones and actuators of a slew: isotropic limits to plan with, and the rows that the solver keeps."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import casadi as ca
import numpy as np

from estimator.models.errors import InfeasibleError
from guidance.jerk_profile import JerkProfile
from guidance.kinematics import conjugate, rodrigues_from_quaternion, rotate
from guidance.slew_problem import Extras, extra_rows
from guidance.slew_request import Actuators, Boundary, KeepOut, Limits, SlewRequest

Array = np.ndarray


@functools.cache
def _rows_function(extras: Extras) -> ca.Function:
    sigma, w, a = (ca.SX.sym(n, 3) for n in ("sigma", "w", "a"))
    e = ca.SX.sym("e", extras.parameters)
    return ca.Function("slew_extra_rows", [sigma, w, a, e], [extra_rows(extras, sigma, w, a, e)])


@dataclass(frozen=True)
class Envelope:
    """The additional rows of a request.

    Attributes:
        extras: which rows.
        cones: keep-out cones.
        actuators: or None.
    """

    extras: Extras
    cones: tuple[KeepOut, ...]
    actuators: Actuators | None

    @property
    def names(self) -> list[str]:
        """What each row keeps, with the names of the request."""
        return [f"keep-out cone {c.name!r}" for c in self.cones] + self.extras.names[len(self.cones):]

    def parameters(self, reference: Array, margin: Array | float = 0.0) -> Array:
        """Numbers of :func:`guidance.slew_problem.extra_rows`, directions seen from the reference attitude (4,).

        Args:
            reference: ``inertial_from_reference``.
            margin: by how much each row is tightened: cosine of a cone, relative square of the others.
        """
        margins = np.broadcast_to(np.asarray(margin, dtype=float), (self.extras.rows,))
        inverse = conjugate(reference)
        values: list[Array] = []
        for cone, m in zip(self.cones, margins, strict=False):
            values.append(np.concatenate([rotate(inverse, cone.direction), cone.axis,
                                          [math.cos(cone.angle) - float(m)]]))
        if self.extras.torque or self.extras.momentum:
            act = self.actuators
            assert act is not None
            rest = margins[len(self.cones):]
            torque, momentum = np.ones(3), np.ones(3)
            if act.torque is not None:
                shrink = np.sqrt(np.maximum(1 - rest[:self.extras.torque], 0.01))
                torque[:] = act.torque * (shrink if len(act.torque) == 3 else shrink[0])
            rest = rest[self.extras.torque:]
            if act.gyro_momentum is not None:
                momentum[:] = act.gyro_momentum * (1 - min(float(np.max(rest)), 0.5))
            elif act.momentum is not None:
                shrink = np.sqrt(np.maximum(1 - rest, 0.01))
                momentum[:] = act.momentum * (shrink if len(act.momentum) == 3 else shrink[0])
            values += [act.inertia.ravel(order="F"), rotate(inverse, act.total_momentum), torque, momentum]
        return np.concatenate(values) if values else np.zeros(0)

    def rows(self, quaternion: Array, rate: Array, acceleration: Array) -> Array:
        """The rows, at most zero where they hold, at many instants: (m, rows)."""
        if not self.extras.rows:
            return np.zeros((len(quaternion), 0))
        function = _rows_function(self.extras)
        sigma = rodrigues_from_quaternion(quaternion)
        parameters = self.parameters(np.array([1.0, 0.0, 0.0, 0.0]))
        values = function.map(len(sigma))(sigma.T, rate.T, acceleration.T,
                                          np.repeat(parameters[:, None], len(sigma), axis=1))
        return values.full().T

    def largest(self, profile: JerkProfile, samples: int = 2001) -> Array:
        """Largest value of each row along a slew, on a dense sampling."""
        m = profile.motion(np.linspace(0, profile.duration, samples))
        return np.max(self.rows(m.quaternion, m.rate, m.acceleration), axis=0)

    def check_ends(self, request: SlewRequest) -> None:
        """Raise where an end of the request already breaks a row.

        Raises:
            InfeasibleError: which limit, at which end, and by how much.
        """
        for where, end in (("start", request.start), ("stop", request.stop)):
            self._check_end(where, end)

    def _check_end(self, where: str, end: Boundary) -> None:
        for cone in self.cones:
            away = math.acos(max(-1.0, min(1.0, float(rotate(end.quaternion, cone.axis) @ cone.direction))))
            if away < cone.angle:
                raise InfeasibleError(
                    f"at the {where} the axis is {math.degrees(away):.3f} deg from the centre of the keep-out cone "
                    f"{cone.name!r}, {math.degrees(cone.angle - away):.3f} deg inside its half angle of "
                    f"{math.degrees(cone.angle):.3f} deg", limit=f"keep-out cone {cone.name!r}",
                    excess=cone.angle - away)
        values = self.rows(end.quaternion[None], end.rate[None], end.acceleration[None])[0]
        for name, value in list(zip(self.names, values, strict=True))[len(self.cones):]:
            if value > 1e-9:
                excess = math.sqrt(1 + value) - 1
                raise InfeasibleError(f"the motion at the {where} needs a {name} {excess:.3%} above what the actuators "
                                      "give", limit=name, excess=excess)


def envelope_of(request: SlewRequest) -> tuple[Limits, Envelope]:
    """Finite isotropic limits for the solver, and the additional rows.

    Where the request has no limit on rate or acceleration, the one used is so large that the actuators bind first.
    """
    limits, act = request.limits, request.actuators
    torque = momentum = 0
    if act is not None:
        torque = 0 if act.torque is None else len(act.torque)
        momentum = 4 if act.gyro_momentum is not None else 0 if act.momentum is None else len(act.momentum)
        outer = outer_limits(request)
        limits = Limits(min(limits.rate, outer.rate), min(limits.acceleration, outer.acceleration), limits.jerk)
    return limits, Envelope(Extras(len(request.keep_out), torque, momentum), request.keep_out, act)


def _norms(act: Actuators, *, inner: bool) -> tuple[float, float]:
    """Radius of the largest ball in (inner), or the smallest about, the envelopes of momentum and torque."""
    def radius(limit: Array | None) -> float:
        if limit is None:
            return math.inf
        if len(limit) == 1:
            return float(limit[0])
        return float(np.min(limit)) if inner else float(np.linalg.norm(limit))

    momentum = radius(act.momentum)
    if act.gyro_momentum is not None:
        momentum = act.gyro_momentum * (2.0 if inner else 4.0)
    return momentum, radius(act.torque)


def outer_limits(request: SlewRequest) -> Limits:
    """Isotropic limits that every feasible motion keeps: what the actuators can do at the very best."""
    act, limits = request.actuators, request.limits
    if act is None:
        return limits
    momentum, torque = _norms(act, inner=False)
    least = float(np.linalg.eigvalsh(act.inertia)[0])
    total = float(np.linalg.norm(act.total_momentum))
    rate = min(limits.rate, (momentum + total) / least, 1.0)
    acceleration = min(limits.acceleration, (torque + rate * total) / least, 1.0)
    return Limits(rate, acceleration, limits.jerk)


def inner_limits(request: SlewRequest) -> Limits | None:
    """Isotropic limits under which the actuators are never exceeded, for the closed forms; None if there are none."""
    act, limits = request.actuators, request.limits
    if act is None:
        return limits
    momentum, torque = _norms(act, inner=True)
    largest = float(np.linalg.eigvalsh(act.inertia)[2])
    total = float(np.linalg.norm(act.total_momentum))
    rate = min(limits.rate, (momentum - total) / largest)
    acceleration = min(limits.acceleration, (torque - max(rate, 0) * total) / largest)
    if rate <= 0 or acceleration <= 0:
        return None
    return Limits(min(rate, 1.0), min(acceleration, 1.0), limits.jerk)
