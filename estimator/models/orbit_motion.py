"""Equations of motion of a satellite: gravity and a list of further accelerations, each with its parameters.

An :class:`Acceleration` is declared once, as a pure CasADi function of a :class:`MotionSample` and its parameters;
propagation, fit and score test follow from it. Gravity's gradient is analytical, everything else is differentiated
automatically.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from estimator.models.earth_orientation import EARTH_ROTATION_RATE
from estimator.models.orbit_environment import SpaceEnvironment
from estimator.models.orbit_forces import (
    MOON_PARAMETER,
    SUN_PARAMETER,
    drag,
    orbital_axes,
    solar_pressure,
    third_body,
)
from estimator.models.orbit_gravity import GravityField, gravity
from estimator.models.orbit_integration import Inputs, VariationalStep
from estimator.models.rotations import Matrix


@dataclass(frozen=True)
class MotionSample:
    """What an acceleration may depend on; celestial axes (GCRS), SI.

    Attributes:
        time: s after the epoch of the orbit.
        position, velocity: of the satellite.
        sun, moon: geocentric positions.
        earth_fixed_from_celestial: rotation (3, 3).
        spin: angular velocity of the Earth.
        area_over_mass: m2/kg.
        thrust: commanded acceleration of burns, (3) radial, along-track, cross-track, m/s2; zero outside burns.
        field: coefficients of the gravity model.
    """

    time: Matrix
    position: Matrix
    velocity: Matrix
    sun: Matrix
    moon: Matrix
    earth_fixed_from_celestial: Matrix
    spin: Matrix
    area_over_mass: float
    thrust: Matrix
    field: GravityField


@dataclass(frozen=True)
class Acceleration:
    """One acceleration beyond the gravity field.

    Attributes:
        name: of the unknown that holds the parameters.
        size: number of parameters.
        function: ``(sample, p) -> acceleration`` (3), m/s2, celestial axes.
    """

    name: str
    size: int
    function: Callable[[MotionSample, Any], Any]


def _sun_and_moon(s: MotionSample, p: Matrix) -> Matrix:
    return p[0] * (third_body(s.position, s.sun, SUN_PARAMETER) + third_body(s.position, s.moon, MOON_PARAMETER))


def _sun(s: MotionSample, p: Matrix) -> Matrix:
    return third_body(s.position, s.sun, SUN_PARAMETER)


def _moon(s: MotionSample, p: Matrix) -> Matrix:
    return third_body(s.position, s.moon, MOON_PARAMETER)


def _pressure(s: MotionSample, p: Matrix) -> Matrix:
    return p[0] * solar_pressure(s.position, s.sun, s.area_over_mass)


def _oblique(s: MotionSample, p: Matrix) -> Matrix:
    pressure = solar_pressure(s.position, s.sun, s.area_over_mass)
    line = (s.sun - s.position) / ca.norm_2(s.sun - s.position)
    across = ca.vertcat(-line[1], line[0], 0.0)  # celestial pole x line to the Sun
    size = ca.dot(pressure, -line)
    return size * (p[0] * across + p[1] * ca.cross(line, across))


def _drag(s: MotionSample, p: Matrix) -> Matrix:
    return p[0] * drag(s.position, s.velocity, s.spin, s.area_over_mass)


def _celestial(s: MotionSample, p: Matrix) -> Matrix:
    return p[:3] + (p[3:6] * s.time if p.shape[0] == 6 else 0)


def _orbital(s: MotionSample, p: Matrix) -> Matrix:
    return ca.mtimes(orbital_axes(s.position, s.velocity), _celestial(s, p))


def _burn(s: MotionSample, p: Matrix) -> Matrix:
    return ca.mtimes(orbital_axes(s.position, s.velocity), s.thrust)


def _burn_scale(s: MotionSample, p: Matrix) -> Matrix:
    return p[0] * _burn(s, p)


def _burn_turned(s: MotionSample, p: Matrix) -> Matrix:
    # Two small angles turn the thrust about the two axes of the orbital frame that are not the radial one.
    turn = ca.vertcat(0.0, p[0], p[1])
    return ca.mtimes(orbital_axes(s.position, s.velocity), ca.cross(turn, s.thrust))


SUN = Acceleration("sun", 0, _sun)
MOON = Acceleration("moon", 0, _moon)
LUNI_SOLAR = Acceleration("luni-solar-gravity", 1, _sun_and_moon)
SOLAR_PRESSURE = Acceleration("solar-radiation-pressure", 1, _pressure)
OBLIQUE_PRESSURE = Acceleration("solar-radiation-pressure:oblique", 2, _oblique)
"""Pressure of sunlight at right angles to its line: towards celestial pole x Sun, and towards the pole's side; zero in
shadow. Panels that are not square to the Sun, and the body that turns with the Earth, push so."""
DRAG = Acceleration("drag", 1, _drag)
BURN = Acceleration("burn", 0, _burn)
BURN_SCALE = Acceleration("thrust-scale-error", 1, _burn_scale)
BURN_MISALIGNMENT = Acceleration("thrust-misalignment", 2, _burn_turned)


def constant_acceleration(name: str, *, linear: bool = False, orbital: bool = False) -> Acceleration:
    """An acceleration of constant (or linear in time, from the epoch) components in celestial or orbital axes."""
    return Acceleration(name, 6 if linear else 3, _orbital if orbital else _celestial)


THRUST = constant_acceleration("thrust", orbital=True)
"""Acceleration of a burn of finite length, on between its edges: :class:`estimator.orbit_signal.VelocityStep`."""


class _Extension:
    """Terms of a larger field beyond those of the model, scaled."""

    def __init__(self, larger: GravityField, degree: int):
        cosine, sine = larger.cosine.copy(), larger.sine.copy()
        cosine[: degree + 1, : degree + 1] = 0.0
        sine[: degree + 1, : degree + 1] = 0.0
        self.field = GravityField(
            f"{larger.name} above {degree}", larger.gravitational_parameter, larger.radius, cosine, sine
        )

    def __call__(self, s: MotionSample, p: Matrix) -> Matrix:
        acceleration, _ = gravity(ca.mtimes(s.earth_fixed_from_celestial, s.position), self.field)
        return p[0] * ca.mtimes(s.earth_fixed_from_celestial.T, acceleration)


def further_geopotential(name: str, larger: GravityField, degree: int) -> Acceleration:
    """The terms of ``larger`` above ``degree`` times one parameter whose nominal value is 1."""
    return Acceleration(name, 1, _Extension(larger, degree))


INPUTS = 9 + 3 + 3 + 1 + 3
"""Outside inputs of the motion: rotation of the Earth (by columns), Sun, Moon, time, commanded thrust."""


@dataclass(frozen=True)
class Burn:
    """A commanded burn: start and stop (s after the epoch) and acceleration (3), m/s2, orbital axes."""

    start: float
    stop: float
    acceleration: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Motion:
    """The compiled equations of motion of one set of accelerations.

    Attributes:
        step: compiled Runge-Kutta step with variational equations.
        accelerations: what acts beside the gravity field.
        slices: parameters of each acceleration in the parameter vector, by name.
        active: names of the accelerations whose parameters carry derivatives, in the order of the columns.
    """

    step: VariationalStep
    accelerations: tuple[Acceleration, ...]
    slices: dict[str, slice]
    active: tuple[str, ...]


_MOTIONS: dict[Any, Motion] = {}


def motion(
    field: GravityField, accelerations: Sequence[Acceleration], active: Sequence[str], area_over_mass: float
) -> Motion:
    """The equations of motion, compiled once per set.

    Args:
        field: gravity.
        accelerations: everything else.
        active: names of accelerations along whose parameters derivatives are wanted.
        area_over_mass: m2/kg.
    """
    key = (id(field), tuple(accelerations), tuple(active), area_over_mass)
    if key in _MOTIONS:
        return _MOTIONS[key]
    slices, at = {}, 0
    for a in accelerations:
        slices[a.name] = slice(at, at + a.size)
        at += a.size
    indices = tuple(i for name in active for i in range(slices[name].start, slices[name].stop))

    def derivative(x: ca.SX, p: ca.SX, u: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        rotation = ca.reshape(u[:9], 3, 3)
        sample = MotionSample(
            time=u[15],
            position=x[:3],
            velocity=x[3:],
            sun=u[9:12],
            moon=u[12:15],
            earth_fixed_from_celestial=rotation,
            spin=EARTH_ROTATION_RATE * rotation[2, :].T,
            area_over_mass=area_over_mass,
            thrust=u[16:19],
            field=field,
        )
        pull, gradient = gravity(ca.mtimes(rotation, x[:3]), field)
        other = ca.SX.zeros(3)
        for a in accelerations:
            other += a.function(sample, p[slices[a.name]])
        total = ca.mtimes(rotation.T, pull) + other
        along = ca.densify(ca.jacobian(other, x))
        along[:, :3] += ca.mtimes(ca.mtimes(rotation.T, gradient), rotation)
        along_x = ca.vertcat(ca.horzcat(ca.SX(3, 3), ca.SX.eye(3)), along)
        along_p = ca.vertcat(ca.SX(3, p.shape[0]), ca.jacobian(other, p))
        return ca.vertcat(x[3:], total), along_x, along_p

    made = Motion(
        VariationalStep("orbit", derivative, 6, at, INPUTS, indices), tuple(accelerations), slices, tuple(active)
    )
    _MOTIONS[key] = made
    return made


def motion_inputs(environment: SpaceEnvironment, burns: Sequence[Burn] = ()) -> Inputs:
    """The outside inputs (n, INPUTS) of :func:`motion` as a function of time (n,), s after the epoch."""

    def inputs(time: np.ndarray) -> np.ndarray:
        rotation, sun, moon = environment.driving(time)
        thrust = np.zeros((len(time), 3))
        for burn in burns:
            thrust[(time > burn.start) & (time < burn.stop)] += burn.acceleration
        return np.column_stack(
            [rotation.transpose(0, 2, 1).reshape(-1, 9), sun, moon, time, thrust]
        )

    return inputs
