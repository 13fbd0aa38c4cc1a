"""The system of the book: 14 components, its simulation scheme (figure 3.2) and its numbers.

Which question: how well does each filter follow a satellite near the stationary orbit from one station's total
range, its rate and two direction cosines, with the thrust's error, the station's place and four systematic errors
unknown too?

State (14): distance, right ascension, declination and their rates; error of the thrust acceleration; station longitude,
latitude and altitude; systematic errors of range, range rate and the cosines to north and east. Sigmas that the book
lost are engineering values, all of them fields of :class:`BookCase`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal

import casadi as ca
import numpy as np

from estimator.models.compiled import compiled
from estimator.models.earth import GRAVITATIONAL_PARAMETER
from estimator.models.earth_orientation import EARTH_ROTATION_RATE
from estimator.models.light_time import Earth
from estimator.models.loops import Mapped
from estimator.models.orbit_spherical import (
    cartesian_from_spherical,
    shaping_step,
    spherical_from_cartesian,
    spherical_rates,
    stationary_transition,
    thrust_transition,
)
from estimator.models.ranging import Antenna, Corrections, Signalling, predicted
from estimator.models.rotations import Matrix
from estimator.models.station import earth_fixed_position

SIZE, OUTPUTS = 14, 4
NAMES = (
    "distance",
    "right ascension",
    "declination",
    "distance rate",
    "right ascension rate",
    "declination rate",
    "thrust error",
    "longitude",
    "latitude",
    "altitude",
    "range error",
    "range rate error",
    "north cosine error",
    "east cosine error",
)
PERIOD = 86164.0  # s, the book's


@dataclass(frozen=True)
class BookCase:
    """The numbers of the simulation.

    Attributes:
        eccentricity, inclination, node, latitude_argument, true_anomaly: the book's orbit. It prints the angles without
            a unit: radians, since all fit one turn; with ``inclination_in_degrees`` the inclination alone is in degrees
            (a satellite kept near the stationary orbit), with ``angles_in_degrees`` all of them.
        perigee_argument: reads the book's "argument of latitude" 0.4 as that of perigee; else it is the argument of
            latitude itself (perigee plus true anomaly), and the perigee follows from the anomaly.
        station: longitude, latitude (rad), altitude (m).
        sigma_state: prior of the six orbit components; the book gives 850 s of the period.
        sigma_thrust: m/s2; sigma_station: longitude, latitude (rad), altitude (m).
        sigma_noise: of the four measurements, equal to that of their systematic errors.
        thrust: nominal acceleration of the burn (m/s2) and burn: its start and stop (s); equal times for none.
        step, span: s.
        interval: correlation interval of thrust and systematic errors, s.
        stationary: start on the exactly stationary orbit instead.
    """

    eccentricity: float = 0.005
    inclination: float = 0.03
    inclination_in_degrees: bool = False
    angles_in_degrees: bool = False
    node: float = 1.3
    latitude_argument: float = 0.4
    true_anomaly: float = 4.3
    perigee_argument: bool = True
    station: tuple[float, float, float] = (float(np.radians(60.0)), float(np.radians(50.0)), 200.0)
    sigma_state: tuple[float, ...] = (30e3, 0.01, 0.01, 10.0, 2.162e-7, 2.2e-7)
    sigma_thrust: float = 5e-5
    sigma_station: tuple[float, float, float] = (30 / 6.378e6, 30 / 6.378e6, 30.0)
    sigma_noise: tuple[float, float, float, float] = (30.0, 0.05, 5e-4, 5e-4)
    thrust: float = 1e-3
    burn: tuple[float, float] = (0.0, 0.0)
    step: float = 5.0
    span: float = 86400.0
    interval: float = float("inf")
    stationary: bool = False

    @property
    def radius(self) -> float:
        """Semi-major axis of the period, m."""
        return float((GRAVITATIONAL_PARAMETER * (PERIOD / (2 * np.pi)) ** 2) ** (1 / 3))

    @property
    def rate(self) -> float:
        """Mean motion, rad/s."""
        return 2 * np.pi / PERIOD

    @property
    def prior(self) -> np.ndarray:
        """Prior standard deviations (14,)."""
        return np.array([*self.sigma_state, self.sigma_thrust, *self.sigma_station, *self.sigma_noise])

    @property
    def angles(self) -> tuple[float, float, float, float]:
        """Inclination, right ascension of the node, argument of perigee and true anomaly, rad, as they are read."""
        unit = np.pi / 180 if self.angles_in_degrees else 1.0
        tilt = np.pi / 180 if self.angles_in_degrees or self.inclination_in_degrees else 1.0
        argument, anomaly = self.latitude_argument * unit, self.true_anomaly * unit
        perigee = argument if self.perigee_argument else argument - anomaly
        return self.inclination * tilt, self.node * unit, perigee, anomaly

    @cached_property
    def first_state(self) -> np.ndarray:
        """Expected first state (14,), not to be written to."""
        i, node, perigee, nu = self.angles
        e = 0.0 if self.stationary else self.eccentricity
        i = 0.0 if self.stationary else i
        u = perigee + nu
        p = self.radius * (1 - e * e)
        r = p / (1 + e * np.cos(nu))
        speed = np.sqrt(GRAVITATIONAL_PARAMETER / p)
        ci, si = np.cos(i), np.sin(i)
        radial = np.array(
            [
                np.cos(node) * np.cos(u) - np.sin(node) * np.sin(u) * ci,
                np.sin(node) * np.cos(u) + np.cos(node) * np.sin(u) * ci,
                np.sin(u) * si,
            ]
        )
        along = np.array(
            [
                -np.cos(node) * np.sin(u) - np.sin(node) * np.cos(u) * ci,
                -np.sin(node) * np.sin(u) + np.cos(node) * np.cos(u) * ci,
                np.cos(u) * si,
            ]
        )
        velocity = speed * e * np.sin(nu) * radial + speed * (1 + e * np.cos(nu)) * along
        spherical = np.asarray(ca.DM(spherical_from_cartesian(ca.DM(np.concatenate([r * radial, velocity]))))).ravel()
        state = np.array([*spherical, 0.0, *self.station, 0.0, 0.0, 0.0, 0.0])
        state.setflags(write=False)
        return state

    @property
    def greenwich(self) -> float:
        """Right ascension of Greenwich at the start: the satellite stands 20 degrees east of the station."""
        return float(self.first_state[1] - self.station[0] - np.radians(20.0))


def measurement(x: Matrix, greenwich: Matrix) -> Matrix:
    """The four measurements (4) at reception, the same functions as the batch's kernels."""
    state = cartesian_from_spherical(x[:6])
    earth = Earth(ca.DM.eye(3), greenwich, ca.DM.eye(3))
    place = earth_fixed_position(x[8], x[7], x[9])
    sb, cb, sl, cl = ca.sin(x[8]), ca.cos(x[8]), ca.sin(x[7]), ca.cos(x[7])
    axes = ca.vertcat(ca.horzcat(-sl, cl, 0), ca.horzcat(-sb * cl, -sb * sl, cb), ca.horzcat(cb * cl, cb * sl, sb))
    antenna = Antenna(place, axes, x[9])
    how = Signalling("reception", "sum", troposphere=False, bending=False)
    none = Corrections()
    values = [
        predicted(kind, state, earth, antenna, antenna, how, none, same=True)
        for kind in ("range", "range_rate", "direction_cosines")
    ]
    return ca.vertcat(*values) + x[10:14]


@lru_cache(maxsize=1)
def move_expression() -> ca.Function:
    """One Runge-Kutta step ``(state, nominal thrust, engine on, step, shaping factors (5)) -> state``, no noise.

    The factors are those of the thrust error and of the four systematic errors, see
    :func:`estimator.models.orbit_spherical.shaping_step`.
    """
    x, t, factor = ca.SX.sym("x", SIZE), ca.SX.sym("t"), ca.SX.sym("f", 5)
    nominal, on = ca.SX.sym("n"), ca.SX.sym("o")
    thrust = nominal + on * x[6]  # the thrust error acts only while the engine runs
    y = x[:6]
    k1 = spherical_rates(y, thrust)
    k2 = spherical_rates(y + t / 2 * k1, thrust)
    k3 = spherical_rates(y + t / 2 * k2, thrust)
    k4 = spherical_rates(y + t * k3, thrust)
    after = ca.vertcat(y + t / 6 * (k1 + 2 * k2 + 2 * k3 + k4), factor[0] * x[6], x[7:10], factor[1:5] * x[10:14])
    return ca.Function("book_step", [x, nominal, on, t, factor], [after])


@lru_cache(maxsize=1)
def _kernels() -> tuple[Mapped, Mapped]:
    x, t, factor = ca.SX.sym("x", SIZE), ca.SX.sym("t"), ca.SX.sym("f", 5)
    nominal, on = ca.SX.sym("n"), ca.SX.sym("o")
    after = move_expression()(x, nominal, on, t, factor)
    move = compiled(
        ca.Function(
            "book_move",
            [x, nominal, on, t, factor],
            [after, ca.densify(ca.jacobian(after, x))],
            ["x", "n", "o", "t", "f"],
            ["y", "phi"],
        )
    )
    angle = ca.SX.sym("s")
    seen = measurement(x, angle)
    look = compiled(
        ca.Function("book_look", [x, angle], [seen, ca.densify(ca.jacobian(seen, x))], ["x", "s"], ["z", "h"])
    )
    return Mapped(move, ("n", "o", "t", "f")), Mapped(look, ("s",))


@dataclass(frozen=True)
class BookSystem:
    """The book's system as a :class:`estimator.solvers.recursive_filters.DiscreteSystem`.

    Attributes:
        case: the numbers.
        inflation: variance density added to the three accelerations, (m/s2)2 s; 0 for none.
    """

    case: BookCase
    inflation: float = 0.0

    @property
    def size(self) -> int:
        return SIZE

    @property
    def steps(self) -> int:
        return round(self.case.span / self.case.step)

    @cached_property
    def _shaping(self) -> tuple[np.ndarray, np.ndarray]:
        c = self.case
        pairs = [shaping_step(s, c.interval, c.step) for s in (c.sigma_thrust, *c.sigma_noise)]
        return np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])

    def burning(self, k: int) -> bool:
        """Whether the engine runs in step ``k``."""
        middle = (k + 0.5) * self.case.step
        return self.case.burn[0] < middle < self.case.burn[1]

    @property
    def shaping_factors(self) -> np.ndarray:
        """Factors (5) by which thrust error and systematic errors shrink in one step."""
        return self._shaping[0]

    def propagate(self, k: int, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        on = 1.0 if self.burning(k) else 0.0
        y, phi = _kernels()[0](
            len(state),
            x=state,
            n=np.array([on * self.case.thrust]),
            o=np.array([on]),
            t=np.array([self.case.step]),
            f=self._shaping[0],
        )
        return y, phi

    def process_noise(self, k: int) -> np.ndarray:
        q = np.zeros((SIZE, SIZE))
        q[range(6, 7), range(6, 7)] = self._shaping[1][:1]
        q[range(10, 14), range(10, 14)] = self._shaping[1][1:]
        if self.inflation:
            t, r = self.case.step, self.case.radius
            for i, unit in ((0, 1.0), (1, 1 / r), (2, 1 / r)):
                block = self.inflation * unit**2 * np.array([[t**3 / 3, t**2 / 2], [t**2 / 2, t]])
                q[np.ix_([i, i + 3], [i, i + 3])] += block
        return q

    def observe(self, k: int, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        angle = self.case.greenwich + EARTH_ROTATION_RATE * (k + 1) * self.case.step
        z, h = _kernels()[1](len(state), x=state, s=np.array([angle]))
        return z, h

    @property
    def measurement_covariance(self) -> np.ndarray:
        return np.diag(np.square(self.case.sigma_noise))

    def stationary_motion(self) -> tuple[np.ndarray, np.ndarray]:
        """Nominal stationary motion (steps + 1, 14) and the closed-form transition matrices (steps, 14, 14)."""
        c = self.case
        first = c.first_state
        nominal = np.tile(first, (self.steps + 1, 1))
        time = np.arange(self.steps + 1) * c.step
        nominal[:, 0], nominal[:, 1], nominal[:, 2] = c.radius, first[1] + c.rate * time, 0.0
        nominal[:, 3], nominal[:, 4], nominal[:, 5] = 0.0, c.rate, 0.0
        matrices = np.zeros((self.steps, SIZE, SIZE))
        matrices[:] = np.diag([0.0] * 6 + [self._shaping[0][0], 1, 1, 1, *self._shaping[0][1:]])
        matrices[:, :6, :6] = stationary_transition(c.radius, c.rate, c.step)
        decay = -np.log(self._shaping[0][0]) / c.step
        column = thrust_transition(c.radius, c.rate, c.step, float(decay))
        for k in range(self.steps):
            if self.burning(k):
                matrices[k, :6, 6] = column
        return nominal, matrices


@dataclass(frozen=True, eq=False)
class Simulated:
    """True motion (runs, steps + 1, 14) and measurements (runs, steps, 4)."""

    truth: np.ndarray
    measurements: np.ndarray


def simulate(
    system: BookSystem, runs: int, seed: int, *, deviation: float = 1.0, kind: Literal["random", "exact"] = "random"
) -> Simulated:
    """Draw realizations: first state, shaping filters, measurement noise.

    Args:
        system: the case.
        runs: realizations.
        seed: of the random numbers.
        deviation: factor of the prior sigmas in the draw of the first state (the filters are not told).
        kind: "random" draws every component; "exact" sets each orbit component ``deviation`` sigma away, sign by
            chance, which is what the book's figures show.
    """
    random = np.random.default_rng(seed)
    case = system.case
    draw = random.standard_normal((runs, SIZE))
    if kind == "exact":
        draw[:, :6] = np.where(draw[:, :6] > 0, 1.0, -1.0)
    draw[:, :7] *= deviation
    x = case.first_state + draw * case.prior
    truth = np.empty((runs, system.steps + 1, SIZE))
    truth[:, 0] = x
    noise = random.standard_normal((runs, system.steps, OUTPUTS)) * np.array(case.sigma_noise)
    measurements = np.empty((runs, system.steps, OUTPUTS))
    spread = np.sqrt(np.diag(BookSystem(case).process_noise(0)))
    for k in range(system.steps):
        x, _ = system.propagate(k, x)
        if spread.any():
            x = x + random.standard_normal((runs, SIZE)) * spread
        truth[:, k + 1] = x
        measurements[:, k] = system.observe(k, x)[0] + noise[:, k]
    return Simulated(truth, measurements)


def position_errors(case: BookCase, truth: np.ndarray, state: np.ndarray) -> np.ndarray:
    """Distance (m) between true and estimated positions, arrays (..., 14)."""

    def place(x: np.ndarray) -> np.ndarray:
        r, a, d = x[..., 0], x[..., 1], x[..., 2]
        return np.stack([r * np.cos(d) * np.cos(a), r * np.cos(d) * np.sin(a), r * np.sin(d)], axis=-1)

    return np.linalg.norm(place(truth) - place(state), axis=-1)


def cramer_rao(system: BookSystem, truth: np.ndarray) -> np.ndarray:
    """Bound (14, 14) on the covariance of the first state at one true motion (steps + 1, 14), prior included.

    Without process noise: the inverse of the prior's information plus the data's, in scaled coordinates.
    """
    prior = system.case.prior
    weight = 1 / np.sqrt(np.diag(system.measurement_covariance))
    information = np.eye(SIZE)
    phi = np.diag(prior)
    for k in range(system.steps):
        _, step = system.propagate(k, truth[k : k + 1])
        phi = step[0] @ phi
        _, h = system.observe(k, truth[k + 1 : k + 2])
        rows = weight[:, None] * (h[0] @ phi)
        information += rows.T @ rows
    return np.linalg.inv(information) * np.outer(prior, prior)
