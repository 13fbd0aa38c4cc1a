"""The best attitude manoeuvre of a Doppler session: the antenna quaternion as well known as its minutes allow.

Doppler sees the antenna's axes only across the velocity, and each epoch carries the star tracker's own error: with
``G`` the slope of the beams' shifts along a small rotation of the antenna, ``H`` along the tracker's error and ``P``
its covariance, one epoch informs by ``G' W G`` with ``W = (sigma_F^2 I + H P H')^-1``. A session in which the velocity
stays in place in the body says nothing about the rotation about it; how fast that rotation becomes known depends on
where the velocity is led, against the tracker's poor roll axis. :func:`design_session` chooses the manoeuvre.

The profile is three angles about antenna x, y, z (roll last, as :mod:`problems.alignment.simulation.pointing`) about
the look direction of the orbit-fixed pointing: cubic B-splines on uniform knots. Angle, rate and acceleration of
such a spline stay within the hull of its own, its first and its second derivative's coefficients, so limits on these
(linear constraints) hold at every instant. IPOPT minimises the criterion from several starts; the least criterion
that any session within the same angles could have, however fast it turned, stands beside the answer as a bound.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import casadi as ca
import numpy as np

from estimator.models import rotations
from estimator.models.earth import GRAVITATIONAL_PARAMETER
from estimator.models.errors import NotFiniteError, RequestError, ShapeError
from estimator.models.inertia import inverse3
from estimator.models.rotations import Matrix
from problems.alignment.campaign import Campaign
from problems.alignment.campaign_design import (
    Criterion,
    best_shares,
    certified_bound,
    criterion_function,
    criterion_value,
    slope_of,
)
from problems.alignment.kernels import doppler_kernel
from problems.alignment.simulation.pointing import profile_spline
from problems.alignment.simulation.scenario import Scenario

SPLINE_DEGREE = 3
NODES_PER_COEFFICIENT = 5
VARIABLE = 0.1  # rad, unit of the optimiser's variables


def epoch_information(beams: int) -> ca.Function:
    """Information (3 x 3, 1/rad^2, antenna axes) that one Doppler epoch gives about ``antenna_from_tracker``.

    Inputs: ``tracker_from_reference`` (4), ``velocity`` (3, m/s, against the ground, reference axes),
    ``antenna_from_tracker`` (4), ``beam_direction`` (beams, 3), ``carrier`` (Hz), ``doppler_sigma`` (beams, Hz),
    ``tracker_sigma`` (3, rad about tracker axes). Differentiated from the joint problem's own Doppler kernel; the
    tracker's errors at the epoch are eliminated, which equals ``W = (sigma_F^2 I + H P H')^-1``.
    """
    return _epoch_information(beams)


@lru_cache(maxsize=8)
def _epoch_information(beams: int) -> ca.Function:
    kernel = doppler_kernel(beams, ())
    attitude, velocity, mounting = ca.SX.sym("attitude", 4), ca.SX.sym("velocity", 3), ca.SX.sym("mounting", 4)
    directions, carrier = ca.SX.sym("beams", beams, 3), ca.SX.sym("carrier")
    doppler_sigma, tracker_sigma = ca.SX.sym("doppler_sigma", beams), ca.SX.sym("tracker_sigma", 3)
    inputs = {"antenna_from_tracker": mounting, "velocity": velocity, "attitude": attitude, "earth_angle": ca.SX(0),
              "beam_direction": directions, "shift": ca.SX.zeros(beams), "carrier": carrier,
              "attitude_error": ca.SX.zeros(3)}
    outputs = kernel.expression.call([inputs[label] for label in kernel.labels])
    slopes = dict(zip(kernel.steps, outputs[1:], strict=True))
    along = slopes["antenna_from_tracker"] / ca.repmat(doppler_sigma, 1, 3)
    error = ca.mtimes(slopes["attitude_error"] / ca.repmat(doppler_sigma, 1, 3), ca.diag(tracker_sigma))
    inner = inverse3(ca.SX.eye(3) + ca.mtimes(error.T, error))
    cross = ca.mtimes(along.T, error)
    information = ca.mtimes(along.T, along) - ca.mtimes([cross, inner, cross.T])
    return ca.Function(
        "epoch_information", [attitude, velocity, mounting, directions, carrier, doppler_sigma, tracker_sigma],
        [ca.densify(0.5 * (information + information.T))],
        ["tracker_from_reference", "velocity", "antenna_from_tracker", "beam_direction", "carrier", "doppler_sigma",
         "tracker_sigma"], ["information"])


def antenna_from_orbit(angles: Matrix) -> Matrix:
    """Quaternion (4) from orbit axes (x forward, y against the orbit's normal, z down) to antenna axes.

    ``angles`` (3, rad) about antenna x, y, z: the axes are turned about z first, then y, then x.
    """
    quaternion: Matrix = ca.vertcat(1, 0, 0, 0)
    for axis in (2, 1, 0):
        part = [ca.cos(angles[axis] / 2), 0, 0, 0]
        part[1 + axis] = -ca.sin(angles[axis] / 2)
        quaternion = rotations.multiply(ca.vertcat(*part), quaternion)
    return quaternion


@dataclass(frozen=True)
class SlewLimits:
    """Largest size of each profile angle about antenna x, y, z, of its rate and of its acceleration.

    Attributes:
        angle, rate, acceleration: (3) rad, rad/s, rad/s2.
    """

    angle: tuple[float, float, float]
    rate: tuple[float, float, float]
    acceleration: tuple[float, float, float]

    def __post_init__(self) -> None:
        for name in ("angle", "rate", "acceleration"):
            value = np.asarray(getattr(self, name), dtype=float)
            if value.shape != (3,):
                raise ShapeError("a slew limit has one number for each axis", where=f"limits.{name}",
                                 value=f"shape {value.shape}", limit="3 numbers")
            if not np.all(np.isfinite(value)):
                raise NotFiniteError("a slew limit is not a number", where=f"limits.{name}", value=tuple(value),
                                     remedy="give three finite numbers")
            if np.any(value < 0):
                raise RequestError("a slew limit is negative", where=f"limits.{name}", value=tuple(value),
                                   limit="0 or more")
        if not np.any(self.movable):
            raise RequestError("the slew limits allow no motion at all", where="limits",
                               value=(self.angle, self.rate, self.acceleration),
                               remedy="allow an angle, its rate and its acceleration on at least one axis")
        if self.angle[1] >= np.pi / 2:
            raise RequestError("the angle about y reaches a right angle, where the other two become one",
                               where="limits.angle", value=self.angle[1], limit="below pi/2")

    @property
    def movable(self) -> np.ndarray:
        """Mask (3,) of the axes that may move."""
        return np.all(np.array([self.angle, self.rate, self.acceleration]) > 0, axis=0)

    @classmethod
    def of_sines(cls, amplitude: Sequence[float], period: float | Sequence[float]) -> SlewLimits:
        """The limits that sines of these amplitudes (3, rad) and periods (s, one or 3) reach and keep."""
        a = np.asarray(amplitude, dtype=float)
        w = 2 * np.pi / np.broadcast_to(np.asarray(period, dtype=float), (3,))
        angle, rate, acceleration = (tuple(float(x) for x in row) for row in (a, a * w, a * w * w))
        return cls(angle, rate, acceleration)  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class SessionRequest:
    """What is given of a Doppler session.

    Attributes:
        duration: s.
        limits: of the profile.
        antenna_from_tracker: (4) nominal.
        beam_direction: (b, 3) unit vectors, antenna axes.
        carrier_frequency, doppler_sigma: Hz; Hz (one number or (b,)).
        tracker_sigma: (3) rad about the tracker's axes.
        epoch_step: s between Doppler epochs, each with a tracker sample of its own.
        look_angles: (3) rad, constant part of the angles, outside of the limits.
        velocity: (3) or (n, 3) m/s against the ground in orbit axes, at n times spread evenly over the session.
        prior: (3, 3) 1/rad^2, antenna axes: what is known already.
        rest_to_rest: whether the profile starts and ends with rates of zero.
    """

    duration: float
    limits: SlewLimits
    antenna_from_tracker: np.ndarray
    beam_direction: np.ndarray
    carrier_frequency: float
    doppler_sigma: float | np.ndarray
    tracker_sigma: np.ndarray
    epoch_step: float
    look_angles: np.ndarray = field(default_factory=lambda: np.zeros(3))
    velocity: np.ndarray = field(default_factory=lambda: np.array([7500.0, 0.0, 0.0]))
    prior: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    rest_to_rest: bool = True

    def __post_init__(self) -> None:
        for name, shape in (("antenna_from_tracker", (4,)), ("tracker_sigma", (3,)), ("look_angles", (3,)),
                            ("prior", (3, 3))):
            value = np.asarray(getattr(self, name), dtype=float)
            if value.shape != shape:
                raise ShapeError("a part of the request has the wrong shape", where=name, value=f"shape {value.shape}",
                                 limit=str(shape))
            object.__setattr__(self, name, value)
        beams = np.asarray(self.beam_direction, dtype=float)
        if beams.ndim != 2 or beams.shape[1] != 3 or len(beams) == 0:
            raise ShapeError("beams are rows of three", where="beam_direction", value=f"shape {beams.shape}",
                             limit="(b, 3)")
        object.__setattr__(self, "beam_direction", beams)
        object.__setattr__(self, "velocity", np.atleast_2d(np.asarray(self.velocity, dtype=float)))
        sigma = np.broadcast_to(np.asarray(self.doppler_sigma, dtype=float), (len(beams),)).copy()
        object.__setattr__(self, "doppler_sigma", sigma)
        for name in ("duration", "carrier_frequency", "epoch_step", "doppler_sigma", "tracker_sigma"):
            value = np.asarray(getattr(self, name), dtype=float)
            if not (np.all(np.isfinite(value)) and np.all(value > 0)):
                raise RequestError("the number must be more than 0", where=name, value=value.tolist(),
                                   limit="more than 0")
        if self.velocity.shape[1] != 3 or not np.all(np.isfinite(self.velocity)) or \
                np.min(np.linalg.norm(self.velocity, axis=1)) < 1.0:
            raise RequestError("the velocity must be rows of three numbers, m/s", where="velocity",
                               value=self.velocity.tolist(), limit="1 m/s or more")

    @property
    def epochs(self) -> np.ndarray:
        """Times (n,) of the Doppler epochs, s after the start."""
        return self.epoch_step * np.arange(int(np.floor(self.duration / self.epoch_step + 1e-9)) + 1)

    def velocity_at(self, time: np.ndarray) -> np.ndarray:
        """Velocity (n, 3) at times (n,) s, interpolated."""
        given = self.velocity
        if len(given) == 1:
            return np.repeat(given, len(time), axis=0)
        places = np.linspace(0.0, self.duration, len(given))
        return np.column_stack([np.interp(time, places, given[:, i]) for i in range(3)])


def orbit_axes_velocity(semi_major_axis: float, inclination: float, argument_of_latitude: np.ndarray,
                        earth_rate: float = 7.292115e-5) -> np.ndarray:
    """Velocity (n, 3) m/s against the rotating ground of a circular orbit, in orbit axes x forward, y across, z down.

    Args:
        semi_major_axis, inclination: m, rad.
        argument_of_latitude: (n,) rad.
        earth_rate: rad/s.
    """
    u = np.atleast_1d(np.asarray(argument_of_latitude, dtype=float))
    speed = np.sqrt(GRAVITATIONAL_PARAMETER / semi_major_axis)
    # y is against the orbit's normal: minus the Earth's rotation about the pole, whose parts in orbit axes (forward, up
    # the normal) are cos u sin i and cos i.
    carried = earth_rate * semi_major_axis
    return np.column_stack([speed - carried * np.cos(inclination) + 0 * u,
                            -carried * np.sin(inclination) * np.cos(u), 0 * u])


def request_of(scenario: Scenario, limits: SlewLimits | None = None, *, duration: float | None = None,
               argument_of_latitude: float = 0.0) -> SessionRequest:
    """The request that belongs to the Doppler sessions of a simulated campaign.

    Args:
        scenario: of the campaign.
        limits: of the profile; default: those of the scenario's sines at their longest period, which every drawn
            session reaches.
        duration: s; default that of the scenario's sessions.
        argument_of_latitude: rad at the start of the session.
    """
    from problems.alignment.simulator import _beams

    length = scenario.session_duration if duration is None else duration
    motion = np.sqrt(GRAVITATIONAL_PARAMETER / scenario.semi_major_axis**3)
    u = argument_of_latitude + motion * np.linspace(0.0, length, 9)
    return SessionRequest(
        duration=length,
        limits=limits or SlewLimits.of_sines(scenario.slew_amplitude, scenario.slew_period[1]),
        antenna_from_tracker=np.asarray(scenario.antenna_from_tracker) / np.linalg.norm(scenario.antenna_from_tracker),
        beam_direction=_beams(scenario), carrier_frequency=scenario.carrier_frequency,
        doppler_sigma=scenario.doppler_noise, tracker_sigma=np.asarray(scenario.star_tracker_noise),
        epoch_step=max(scenario.doppler_step, scenario.star_tracker_step),
        look_angles=np.array([scenario.look_angle, 0.0, 0.0]),
        velocity=orbit_axes_velocity(scenario.semi_major_axis, scenario.inclination, u, scenario.earth_rotation_rate))


def request_of_campaign(campaign: Campaign, limits: SlewLimits, duration: float, *,
                        look_angles: np.ndarray | None = None,
                        antenna_from_tracker: np.ndarray | None = None,
                        prior: np.ndarray | None = None) -> SessionRequest:
    """The request for a further session of a campaign that exists: its sensors, beams, orbit and epochs.

    Args:
        campaign: with Doppler data.
        limits, duration: of the session to come; s.
        look_angles: (3) rad, constant part of the angles about antenna x, y, z.
        antenna_from_tracker: (4), as solved; default the nominal one.
        prior: (3, 3) 1/rad^2 information that the campaign has given already.

    Raises:
        RequestError: a campaign without Doppler data.
    """
    doppler, tracker, gnss = campaign.doppler, campaign.star_tracker, campaign.gnss
    if doppler is None or len(doppler.time) < 2 or len(tracker.time) < 2:
        raise RequestError("a Doppler session needs sensors to be designed for", where="campaign.doppler",
                           remedy="give a campaign with Doppler and star tracker data")
    # Earth-fixed positions and their differences: velocity against the ground in orbit axes, mean of the campaign.
    step = np.diff(gnss.time)
    near = step < 5 * np.median(step)
    velocity = (np.diff(gnss.position, axis=0) / step[:, None])[near]
    position = (0.5 * (gnss.position[1:] + gnss.position[:-1]))[near]
    inertial = velocity + np.cross([0.0, 0.0, campaign.earth_rotation_rate], position)
    down = -position / np.linalg.norm(position, axis=1, keepdims=True)
    across = np.cross(inertial, position)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    axes = np.stack([np.cross(across, down), across, down], axis=1)
    beams = doppler.beam_direction if doppler.beam_direction.ndim == 2 else doppler.beam_direction.mean(axis=0)
    mounting = campaign.nominal.antenna_from_tracker if antenna_from_tracker is None else antenna_from_tracker
    return SessionRequest(
        duration=duration, limits=limits, antenna_from_tracker=np.asarray(mounting),
        beam_direction=beams / np.linalg.norm(beams, axis=1, keepdims=True),
        carrier_frequency=doppler.carrier_frequency,
        doppler_sigma=np.median(np.broadcast_to(doppler.standard_deviation, doppler.frequency_shift.shape), axis=0),
        tracker_sigma=np.median(np.broadcast_to(tracker.standard_deviation, (len(tracker.time), 3)), axis=0),
        epoch_step=max(float(np.median(np.diff(doppler.time))), float(np.median(np.diff(tracker.time)))),
        look_angles=np.zeros(3) if look_angles is None else np.asarray(look_angles),
        velocity=np.einsum("nij,nj->ni", axes, velocity).mean(axis=0),
        prior=np.zeros((3, 3)) if prior is None else prior)


def derivative_maps(count: int, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """Matrices from ``count`` spline coefficients to those of its first (count - 1) and second derivative (count - 2).

    Every value of a spline lies between the least and the greatest of its coefficients.
    """
    knots = profile_spline(np.eye(count), duration).t
    first = np.zeros((count - 1, count))
    for i in range(count - 1):
        slope = SPLINE_DEGREE / (knots[i + SPLINE_DEGREE + 1] - knots[i + 1])
        first[i, i : i + 2] = -slope, slope
    second = np.zeros((count - 2, count - 1))
    for i in range(count - 2):
        slope = (SPLINE_DEGREE - 1) / (knots[i + SPLINE_DEGREE + 1] - knots[i + 2])
        second[i, i : i + 2] = -slope, slope
    return first, second @ first


def _sample(request: SessionRequest) -> ca.Function:
    """``(angles (3) rad, velocity (3) m/s) -> information of one epoch (3 x 3)``, all else of the request in it."""
    angles, velocity = ca.SX.sym("angles", 3), ca.SX.sym("velocity", 3)
    mounting = ca.DM(request.antenna_from_tracker)
    attitude = rotations.multiply(rotations.conjugate(mounting), antenna_from_orbit(angles + request.look_angles))
    value = epoch_information(len(request.beam_direction))(
        attitude, velocity, mounting, request.beam_direction, request.carrier_frequency, request.doppler_sigma,
        request.tracker_sigma)
    return ca.Function("session_sample", [angles, velocity], [value], ["angles", "velocity"], ["information"])


def session_information(request: SessionRequest, angles: np.ndarray) -> np.ndarray:
    """Information (3, 3) 1/rad^2, antenna axes, of a session with profile angles (n, 3) rad at ``request.epochs``.

    The prior of the request is part of it.
    """
    time_of = request.epochs
    angles = np.asarray(angles, dtype=float)
    if angles.shape != (len(time_of), 3):
        raise ShapeError("the profile needs three angles at every epoch", where="angles",
                         value=f"shape {angles.shape}", limit=f"({len(time_of)}, 3)")
    return request.prior + _summed(request, angles, request.velocity_at(time_of)).sum(axis=0)


def _summed(request: SessionRequest, angles: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Information (n, 3, 3) of single epochs with angles (n, 3) and velocities (n, 3)."""
    values = np.asarray(_sample(request).map(len(angles))(angles.T, velocity.T))
    return values.reshape(3, -1, 3).transpose(1, 0, 2)


@dataclass(frozen=True, eq=False)
class SessionDesign:
    """The best manoeuvre that was found.

    Attributes:
        request: what was asked for.
        criterion: A, D or E.
        coefficients: (m, 3) rad, of the B-splines of the angles about antenna x, y, z, without the look angles.
        information: (3, 3) 1/rad^2 about ``antenna_from_tracker``, antenna axes, prior included.
        value: the criterion of the session (rad^2; D: log of rad^6).
        bound: no session within the same angles has a smaller criterion, however fast it turns.
        starts: criterion reached from each start.
        seconds: wall time.
    """

    request: SessionRequest
    criterion: Criterion
    coefficients: np.ndarray
    information: np.ndarray
    value: float
    bound: float
    starts: tuple[float, ...]
    seconds: float

    @property
    def covariance(self) -> np.ndarray:
        """Covariance (3, 3) rad^2 of the antenna's small rotation, antenna axes."""
        return np.linalg.inv(self.information)

    @property
    def sigma(self) -> float:
        """Bound of the total (three axes) error, rad."""
        return float(np.sqrt(np.trace(self.covariance)))

    def profile(self, time_of: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Angles (n, 3) rad, rates rad/s and accelerations rad/s2 at times (n,) s after the start."""
        curve = profile_spline(self.coefficients, self.request.duration)
        return curve(time_of), curve.derivative(1)(time_of), curve.derivative(2)(time_of)

    @property
    def largest_excess(self) -> float:
        """Largest relative excess over any limit anywhere in the session; 0 or less where all are kept."""
        worst = -1.0
        limits = self.request.limits
        samples = self.profile(np.linspace(0.0, self.request.duration, 2001))
        for given, sample in zip((limits.angle, limits.rate, limits.acceleration), samples, strict=True):
            for axis in np.flatnonzero(limits.movable):
                worst = max(worst, float(np.max(np.abs(sample[:, axis])) / given[axis] - 1))
        return worst


def design_session(request: SessionRequest, criterion: Criterion = "A", *, coefficients: int = 20, starts: int = 6,
                   seed: int = 0) -> SessionDesign:
    """The profile that makes the antenna quaternion best known.

    Args:
        request: the session.
        criterion: A, D or E, see :mod:`problems.alignment.campaign_design`.
        coefficients: of the spline of each angle, 6 or more.
        starts: number of starts of IPOPT: half-cycles and cycles of sines first, random smooth profiles after them.
        seed: of the random starts.

    Raises:
        RequestError: too few coefficients or starts, or a motion that leaves the antenna undetermined.
    """
    began = time.perf_counter()
    if coefficients < 6 or starts < 1:
        raise RequestError("the design needs 6 coefficients and one start", where="coefficients, starts",
                           value=(coefficients, starts), limit="6 and 1")
    solver, lower, upper = _programme(request, criterion, coefficients)
    found: list[tuple[float, np.ndarray]] = []
    reached = []
    for start in _starts(request, coefficients, starts, seed):
        answer = solver(x0=start.T.ravel() / VARIABLE, lbg=lower, ubg=upper)
        # Rounding and IPOPT's tolerance aside, what it gives keeps the limits; the rest is scaled into them.
        candidate = _within(request, np.asarray(answer["x"]).reshape(3, coefficients).T * VARIABLE)
        value = criterion_value(criterion, session_information(
            request, profile_spline(candidate, request.duration)(request.epochs)))
        reached.append(value)
        if np.isfinite(value):
            found.append((value, candidate))
    if not found:
        raise RequestError("no motion within the limits determines the antenna", where="limits",
                           value=(request.limits.angle, request.limits.rate, request.limits.acceleration),
                           remedy="allow more, or make the session longer")
    value, best = min(found, key=lambda pair: pair[0])
    information = session_information(request, profile_spline(best, request.duration)(request.epochs))
    return SessionDesign(request, criterion, best, information, value, session_bound(request, criterion),
                         tuple(reached), time.perf_counter() - began)


def _programme(request: SessionRequest, criterion: Criterion,
               count: int) -> tuple[ca.Function, np.ndarray, np.ndarray]:
    """IPOPT on the coefficients over VARIABLE, and the bounds of its linear constraints."""
    nodes = NODES_PER_COEFFICIENT * count
    time_of = (np.arange(nodes) + 0.5) * request.duration / nodes
    basis = profile_spline(np.eye(count), request.duration)(time_of)
    x = ca.MX.sym("x", count, 3)
    angles = VARIABLE * ca.mtimes(ca.DM(basis), x)
    each = _sample(request).map(nodes)(angles.T, ca.DM(request.velocity_at(time_of).T))
    total = ca.MX.zeros(3, 3)
    for column in range(3):
        total[:, column] = ca.sum2(each[:, column::3])
    scale = len(request.epochs) / nodes
    unit = float(np.mean(request.tracker_sigma**2)) / len(request.epochs)
    objective = criterion_function(criterion, 3)(unit * (scale * total + ca.DM(request.prior)))
    first, second = derivative_maps(count, request.duration)
    limits = request.limits
    rows, lower, upper = [], [], []
    for axis in range(3):
        column = x[:, axis]
        moves = float(limits.movable[axis])
        for matrix, limit in ((np.eye(count), limits.angle), (first, limits.rate), (second, limits.acceleration)):
            unit_of_row = VARIABLE / max(limit[axis], 1e-12) if moves else 1.0
            rows.append(ca.mtimes(ca.DM(unit_of_row * matrix), column))
            size = np.full(len(matrix), moves)
            if matrix is first and request.rest_to_rest:
                size[[0, -1]] = 0.0
            lower.append(-size)
            upper.append(size)
            if not moves:
                break
    options = {"print_time": False, "ipopt": {
        "print_level": 0, "sb": "yes", "hessian_approximation": "limited-memory", "max_iter": 300, "tol": 1e-6,
        "acceptable_tol": 1e-5, "acceptable_iter": 8, "jac_c_constant": "yes", "jac_d_constant": "yes"}}
    solver = ca.nlpsol("session", "ipopt", {"x": ca.vec(x), "f": objective, "g": ca.vertcat(*rows)}, options)
    return solver, np.concatenate(lower), np.concatenate(upper)


def _within(request: SessionRequest, coefficients: np.ndarray) -> np.ndarray:
    """The profile scaled down per axis until every limit holds, ends brought to rest where that is asked for."""
    result = coefficients.copy()
    if request.rest_to_rest:
        result[1], result[-2] = result[0], result[-1]
    first, second = derivative_maps(len(result), request.duration)
    limits = request.limits
    for axis in range(3):
        if not limits.movable[axis]:
            result[:, axis] = 0.0
            continue
        excess = max(float(np.max(np.abs(matrix @ result[:, axis]))) / limit[axis] for matrix, limit in (
            (np.eye(len(result)), limits.angle), (first, limits.rate), (second, limits.acceleration)))
        if excess > 1.0:
            result[:, axis] /= excess
    return result


def _starts(request: SessionRequest, count: int, starts: int, seed: int) -> list[np.ndarray]:
    """Profiles (count, 3) within the limits: cosines of a half, one and one and a half cycles, then random ones."""
    draw = np.random.default_rng(seed)
    place = np.linspace(0.0, 1.0, count)
    angle = np.asarray(request.limits.angle)
    result = []
    for k in range(starts):
        if k < 4:
            cycles = (0.5, 1.0, 1.5, 2.0)[k]
            shape = np.cos(2 * np.pi * cycles * place)[:, None] * np.array([-1.0, 1.0, 1.0])
        else:
            harmonics = draw.standard_normal((4, 3)) / np.arange(1, 5)[:, None]
            shape = np.cos(np.pi * np.arange(1, 5)[None, :] * place[:, None]) @ harmonics
            shape /= np.max(np.abs(shape), axis=0)
        result.append(0.9 * _within(request, shape * angle))
    return result


def session_bound(request: SessionRequest, criterion: Criterion, grid: tuple[int, int, int] = (13, 7, 7)) -> float:
    """A criterion that no session within the same angles can go below, whatever its rates.

    The session may share its epochs among all attitudes of the angles' box, in each third of its time as it likes: a
    convex problem whose value is a bound for every profile. The box is searched on a grid of that many angles per axis,
    and the tangent plane of the answer on one twice as fine, so the bound is exact but for the grid's step.
    """
    movable = request.limits.movable

    def candidates(counts: Sequence[int]) -> np.ndarray:
        axes = [np.linspace(-a, a, n) if m else np.zeros(1)
                for a, n, m in zip(request.limits.angle, counts, movable, strict=True)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)

    middle = (np.arange(3) + 0.5) / 3 * request.duration
    epochs = len(request.epochs)

    def informations(angles: np.ndarray) -> np.ndarray:
        return epochs * np.stack([_summed(request, angles, np.repeat(v[None], len(angles), axis=0))
                                  for v in request.velocity_at(middle)])

    coarse = informations(candidates(grid))
    first = best_shares(coarse, criterion, request.prior, tolerance=5e-3, iterations=2000)
    # Only those attitudes of the finer grid that the answer could use, the most promising ones.
    fine = informations(candidates([2 * n - 1 for n in grid]))
    gain = np.einsum("bkij,ij->bk", fine, slope_of(criterion, first.information)).max(axis=0)
    useful = gain >= np.sort(gain)[-min(len(gain), 400)]
    refined = best_shares(fine[:, useful], criterion, request.prior, tolerance=1e-3, iterations=4000)
    return certified_bound(criterion, refined.information, fine, request.prior)
