"""Signals between stations on the turning Earth and a satellite: light time by iteration, range, its rate, directions.

Everything is a pure CasADi function for ONE measurement. The satellite's state is known at the time tag; within the
light time it moves on by a Taylor series with the central acceleration (error below a micrometre for a tenth of a
second at any altitude), a station turns with the Earth exactly. The iteration is that of the book: t2 from t3, then
t1 from t2; each pass gains a factor of velocity over the speed of light, so four passes reach rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import casadi as ca

from estimator.models.earth import GRAVITATIONAL_PARAMETER
from estimator.models.earth_orientation import EARTH_ROTATION_RATE
from estimator.models.rotations import Matrix

SPEED_OF_LIGHT = 299792458.0  # m/s
PASSES = 4
TimeTag = Literal["reception", "bounce", "transmission"]


def moved(state: Matrix, dt: Matrix) -> tuple[Matrix, Matrix]:
    """Position and velocity (3 each) of a satellite a fraction of a second after ``state`` (6)."""
    r, v = state[:3], state[3:6]
    radius = ca.sqrt(ca.sumsqr(r))
    a = -GRAVITATIONAL_PARAMETER / radius**3 * r
    jerk = -GRAVITATIONAL_PARAMETER / radius**3 * (v - 3 * r * ca.dot(r, v) / radius**2)
    return r + dt * (v + dt / 2 * (a + dt / 3 * jerk)), v + dt * (a + dt / 2 * jerk)


def about_z(angle: Matrix) -> Matrix:
    """Frame rotation R3 (3, 3)."""
    c, s = ca.cos(angle), ca.sin(angle)
    return ca.vertcat(ca.horzcat(c, s, 0), ca.horzcat(-s, c, 0), ca.horzcat(0, 0, 1))


@dataclass(frozen=True)
class Earth:
    """The Earth's orientation at the time tag.

    Attributes:
        intermediate: (3, 3) intermediate frame from celestial.
        angle: Earth rotation angle, rad.
        pole: (3, 3) Earth-fixed from terrestrial intermediate.
    """

    intermediate: Matrix
    angle: Matrix
    pole: Matrix

    def station(self, earth_fixed: Matrix, dt: Matrix) -> tuple[Matrix, Matrix]:
        """Celestial position and velocity (3 each) of a station ``dt`` after the time tag."""
        turned = ca.mtimes(about_z(self.angle + EARTH_ROTATION_RATE * dt).T, ca.mtimes(self.pole.T, earth_fixed))
        spin = ca.vertcat(0, 0, EARTH_ROTATION_RATE)
        return ca.mtimes(self.intermediate.T, turned), ca.mtimes(self.intermediate.T, ca.cross(spin, turned))

    def celestial_from_fixed(self, dt: Matrix) -> Matrix:
        """Rotation (3, 3) ``dt`` after the time tag."""
        return ca.mtimes(ca.mtimes(self.intermediate.T, about_z(self.angle + EARTH_ROTATION_RATE * dt).T), self.pole.T)


def length(v: Matrix) -> Matrix:
    """Euclidean length."""
    return ca.sqrt(ca.sumsqr(v))


@dataclass(frozen=True)
class Path:
    """One signal: transmitter at t1, satellite at t2, receiver at t3 (s after the time tag).

    Attributes:
        t1, t2, t3: s after the time tag.
        up, down: lengths of the two legs, m.
        transmitter, satellite, receiver: celestial position and velocity at their times.
    """

    t1: Matrix
    t2: Matrix
    t3: Matrix
    up: Matrix
    down: Matrix
    transmitter: tuple[Matrix, Matrix]
    satellite: tuple[Matrix, Matrix]
    receiver: tuple[Matrix, Matrix]


def signal_path(
    state: Matrix,
    earth: Earth,
    transmitter: Matrix,
    receiver: Matrix,
    *,
    tag: TimeTag = "reception",
    offset: Matrix = 0.0,
    light_time: Matrix = 1.0,
) -> Path:
    """Solve the light-time equations of a signal from a station to the satellite and on to a station.

    Args:
        state: (6) of the satellite at the time tag, celestial, m and m/s.
        earth: orientation at the time tag.
        transmitter, receiver: (3) Earth-fixed, m; the same station for two-way ranging, two for a bistatic pair.
        tag: which instant carries the time tag.
        offset: s to add to the time tag.
        light_time: 1 for the physics, 0 for the geometry of one instant.
    """
    slow = light_time / SPEED_OF_LIGHT
    t3: Matrix = offset
    t2: Matrix = offset
    t1: Matrix = offset
    for _ in range(PASSES):
        if tag == "reception":
            t2 = t3 - slow * length(earth.station(receiver, t3)[0] - moved(state, t2)[0])
        elif tag == "transmission":
            t2 = t1 + slow * length(earth.station(transmitter, t1)[0] - moved(state, t2)[0])
    satellite = moved(state, t2)
    for _ in range(PASSES):
        if tag != "transmission":
            t1 = t2 - slow * length(earth.station(transmitter, t1)[0] - satellite[0])
        if tag != "reception":
            t3 = t2 + slow * length(earth.station(receiver, t3)[0] - satellite[0])
    sender, receptor = earth.station(transmitter, t1), earth.station(receiver, t3)
    return Path(
        t1, t2, t3, length(satellite[0] - sender[0]), length(receptor[0] - satellite[0]), sender, satellite, receptor
    )


def range_sum_rate(path: Path) -> Matrix:
    """Derivative by the time of reception of the sum of both legs, m/s, exact.

    Differentiating the two light-time equations gives
    ``down' = (p - q)/(1 + p/c)`` with ``p = n.v2, q = n.v3`` (n from satellite to receiver, both turned outward), the
    rate of t2 by t3, ``1 - down'/c``, and likewise for the leg up by t2.
    """
    c = SPEED_OF_LIGHT
    down_direction = (path.satellite[0] - path.receiver[0]) / path.down
    p, q = ca.dot(down_direction, path.satellite[1]), ca.dot(down_direction, path.receiver[1])
    down_rate = (p - q) / (1 + p / c)
    up_direction = (path.satellite[0] - path.transmitter[0]) / path.up
    p1, q1 = ca.dot(up_direction, path.satellite[1]), ca.dot(up_direction, path.transmitter[1])
    up_rate = (p1 - q1) / (1 - q1 / c)
    return down_rate + up_rate * (1 - down_rate / c)


def local_direction(path: Path, earth: Earth, east_north_up: Matrix) -> Matrix:
    """Unit vector (3) from the receiver at t3 to the satellite at t2, east, north and up components.

    Args:
        path: the signal.
        earth: orientation at the time tag.
        east_north_up: (3, 3) local from Earth-fixed axes of the receiver.
    """
    line = (path.satellite[0] - path.receiver[0]) / path.down
    return ca.mtimes(east_north_up, ca.mtimes(earth.celestial_from_fixed(path.t3).T, line))
