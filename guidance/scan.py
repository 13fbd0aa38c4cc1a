"""One scan: a camera's footprint drawn along a geodesic of the Earth with a prescribed image motion.

Camera axes, in the body by the request: ``a`` the direction in which the image of the ground is scanned forward, ``l``
the line of sight, ``c = l x a`` along the line of detectors. Seen along a forward scan, ``+c`` is on the right.
With the range ``D`` from the camera to the point on the line of sight, the velocity ``v`` of that point over the
ground, and its part ``u`` perpendicular to the line of sight, the image moves at the rate ``|u| / D`` (velocity over
focal length). Three kinds of image motion:

- ``constant``: ``a`` is along ``u`` and ``|u| / D`` is the asked rate at every moment: no cross motion at the field's
  centre. The ground speed is ``rate * D / sin(angle between line of sight and geodesic)``.
- ``equalised``: the component along ``a`` has the asked rate at the centre, and the body turns about the line of sight
  so that the two ends of the detector line see the same longitudinal image velocity. The equality is a first-order
  differential equation for the angle about the line of sight; its starting value makes the mean square of the cross
  image velocities at the two ends least.
- ``along_track``: the line of sight keeps its pitch in the orbital frame, and the image runs by the orbital motion.

A reverse scan runs against the geodesic's sense with the body as in a forward one (the detector reversed), or with the
body turned by half a turn (reversal by yaw).

Times along the line, attitude and its derivatives are Chebyshev polynomials of nearly full precision; the attitude
handed out is the smooth spline of degree 7 in modified Rodrigues parameters through their values and three derivatives
at knots a few seconds apart.

Source: Somov, Butyrin, Makarov, sections 1 and 2; the formulas of image motion that the paper leaves out are derived
here from the motion of a ground point in the camera axes.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from estimator.models.errors import GeometryError, InfeasibleError
from guidance.ground_geometry import (
    GroundLine,
    geodesic_inverse,
    geodetic_from_earth_fixed,
    nearest_intersection,
    off_nadir_angle,
)
from guidance.kinematics import (
    Motion,
    conjugate,
    motion_from_rodrigues,
    product,
    rodrigues_from_quaternion,
    sign_continuous,
)
from guidance.orbit_propagation import Arc, chebyshev_values
from guidance.survey_request import CameraRequest
from guidance.vector_spline import VectorSpline

Array = NDArray[np.float64]

LARGEST_TURN = math.pi / 9  # rad, turn about the line of sight allowed for equalising (Somov et al., section 2)
KNOT_STEP = 6.0  # s, between the knots of the attitude spline


class Camera:
    """Axes and field of the camera in the body.

    Attributes:
        body_from_camera: (3, 3), columns a (along), l (line of sight), c = l x a (detector line), in body axes.
        half_field: tangent of half the field.
    """

    def __init__(self, request: CameraRequest):
        sight, along = np.array(request.line_of_sight), np.array(request.along)
        self.body_from_camera = np.stack([along, sight, np.cross(sight, along)], -1)
        self.field = request.field
        self.half_field = math.tan(request.field / 2)


@functools.lru_cache(maxsize=256)
def _tables(degree: int) -> tuple[Array, Array, Array, Array]:
    """Chebyshev points in [-1, 1], the matrix from values there to coefficients, the matrix from values to integrals
    from -1 to every point, and the weights of the whole integral."""
    index = np.arange(degree + 1)
    points = np.cos(np.pi * (index[::-1] + 0.5) / (degree + 1))
    weights = np.full(degree + 1, 2.0 / (degree + 1))
    weights[0] = 1.0 / (degree + 1)
    analysis = weights[:, None] * chebyshev.chebvander(points, degree).T
    antiderivative = chebyshev.chebint(analysis, lbnd=-1)
    integral = np.asarray(chebyshev.chebvander(points, degree + 1) @ antiderivative, float)
    return points, np.asarray(analysis, float), integral, np.asarray(antiderivative.sum(axis=0), float)


class _Polynomial:
    """Chebyshev polynomials on an interval, through values at the interval's Chebyshev points."""

    def __init__(self, low: float, high: float, degree: int):
        self.low, self.high, self.degree = low, high, degree
        self.unit, self.analysis, self._integral, self._whole = _tables(degree)
        self.half = 0.5 * (high - low)
        self.nodes = 0.5 * (low + high) + self.half * self.unit

    def fit(self, values: Array) -> Array:
        """Coefficients (degree + 1, ...) of the values at the nodes."""
        return np.tensordot(self.analysis, values, 1)

    def value(self, coefficients: Array, at: ArrayLike, order: int = 0) -> Array:
        """Value or derivative at points of the interval; components of the coefficients come last."""
        if order:
            coefficients = np.asarray(chebyshev.chebder(coefficients, order), float) / self.half**order
        x = (2 * np.asarray(at, float) - self.low - self.high) / (2 * self.half)
        return chebyshev_values(x, len(coefficients)) @ coefficients

    def integral(self, values: Array) -> Array:
        """Integral from the low end to every node of a function given at the nodes."""
        return self.half * (self._integral @ values)

    def whole(self, values: Array) -> float:
        """Integral over the interval of a function given at the nodes."""
        return float(self.half * (self._whole @ values))


@dataclass(frozen=True)
class Footprint:
    """Where the detector line meets the ground at some instants (Earth-fixed, m): centre, left and right end.

    Left and right are seen along the scan's motion over the ground.
    """

    center: Array
    left: Array
    right: Array


@dataclass(frozen=True)
class Scan:
    """One scan with its attitude.

    Attributes:
        start, stop: s from the epoch.
        line: the geodesic in its forward sense, with its zero anywhere.
        first, last: distances (m) along ``line`` at the start and at the stop; ``last < first`` in a reverse scan.
        kind_of_motion: ``constant``, ``equalised`` or ``along_track``.
        turned: the body is turned by half a turn about the line of sight against the geodesic's sense.
        reference: quaternion ``inertial_from_reference`` (4) to which the spline's parameters refer.
        spline: degree 7, modified Rodrigues parameters of ``reference_from_body``.
        arc: the orbit.
        camera: the camera.
    """

    start: float
    stop: float
    line: GroundLine
    first: float
    last: float
    kind_of_motion: str
    turned: bool
    reference: Array
    spline: VectorSpline
    arc: Arc
    camera: Camera
    progress: tuple[_Polynomial, Array]

    @property
    def duration(self) -> float:
        """s."""
        return self.stop - self.start

    @property
    def length(self) -> float:
        """Way of the field's centre over the ground, m."""
        return abs(self.last - self.first)

    @property
    def forward(self) -> bool:
        """Whether the centre runs in the sense of the geodesic."""
        return self.last > self.first

    def motion(self, times: ArrayLike) -> Motion:
        """Attitude (inertial from body), rate, acceleration and jerk at times (s from the epoch) inside the scan."""
        local = motion_from_rodrigues(*self.spline.derivatives(times))
        return Motion(product(self.reference, local.quaternion), local.rate, local.acceleration, local.jerk)

    def distance(self, times: ArrayLike) -> Array:
        """Distance (m) of the field's centre along the line at times inside the scan."""
        polynomial, coefficients = self.progress
        times = np.asarray(times, float)
        ways = np.interp(times, [self.start, self.stop], [self.first, self.last])
        low, high = min(self.first, self.last), max(self.first, self.last)
        for _ in range(30):
            error = polynomial.value(coefficients, ways) - times
            if np.max(np.abs(error), initial=0.0) < 1e-12 * max(1.0, abs(self.stop)):
                break
            ways = np.clip(ways - error / polynomial.value(coefficients, ways, 1), low, high)
        return ways

    def footprint(self, times: ArrayLike) -> Footprint:
        """The detector line on the ground at times inside the scan, from the attitude of the spline."""
        quaternion = self.motion(times).quaternion
        center, minus, plus = footprint_of_attitude(self.arc, self.camera, times, quaternion)
        right_is_plus = self.forward != self.turned
        return Footprint(center, minus if right_is_plus else plus, plus if right_is_plus else minus)

    @cached_property
    def corners(self) -> list[tuple[float, float]]:
        """Latitude and longitude (rad): start left, start right, stop right, stop left, seen along the scan."""
        ends = self.footprint(np.array([self.start, self.stop]))
        points = np.stack([ends.left[0], ends.right[0], ends.right[1], ends.left[1]])
        latitude, longitude, _ = geodetic_from_earth_fixed(points)
        return [(float(p), float(q)) for p, q in zip(latitude, longitude, strict=True)]

    @cached_property
    def middle(self) -> float:
        """Time (s from the epoch) at which half the length is done."""
        polynomial, coefficients = self.progress
        return float(polynomial.value(coefficients, 0.5 * (self.first + self.last)))

    @cached_property
    def center(self) -> tuple[float, float]:
        """Latitude and longitude (rad) of the field's centre at half the length."""
        latitude, longitude, _ = geodetic_from_earth_fixed(self.footprint(np.array([self.middle])).center)
        return float(latitude[0]), float(longitude[0])

    @cached_property
    def width(self) -> float:
        """Length (m) of the detector line on the ground at half the length."""
        line = self.footprint(np.array([self.middle]))
        a, b = geodetic_from_earth_fixed(line.left), geodetic_from_earth_fixed(line.right)
        return float(geodesic_inverse(a[0], a[1], b[0], b[1])[0][0])

    def largest_off_nadir(self, count: int = 25) -> float:
        """Greatest angle (rad) of the line of sight from the geodetic nadir."""
        times = np.linspace(self.start, self.stop, count)
        return float(np.max(off_nadir_of_attitude(self.arc, self.camera, times, self.motion(times).quaternion)))

    def image_rates(self, times: ArrayLike) -> Array:
        """Image velocity over focal length (n, 3, 2), rad/s: at the left end, centre and right end of the detector
        line; along the body's forward direction, and across it.

        From the motion of a ground point in the camera axes, with the attitude and rate of the spline.
        """
        times = np.asarray(times, float)
        motion = self.motion(times)
        position, velocity, turn = self.arc.earth_fixed(times)
        axes = turn @ _matrices(motion.quaternion) @ self.camera.body_from_camera
        spin = np.einsum("nji,nj->ni", axes, self.arc.earth.spin(times))
        rate = motion.rate @ self.camera.body_from_camera - spin
        speed = np.einsum("nji,nj->ni", axes, velocity)
        result = np.empty((times.size, 3, 2))
        order = (-1, 0, 1) if self.forward != self.turned else (1, 0, -1)
        for column, side in enumerate(order):
            tangent = side * self.camera.half_field
            direction = axes[:, :, 1] + tangent * axes[:, :, 2]
            point = nearest_intersection(position, direction)
            depth = np.einsum("ni,ni->n", point - position, axes[:, :, 1])
            ray = depth[:, None] * np.array([0.0, 1.0, tangent])
            moving = -speed + np.cross(rate, ray)  # the axes a, l, c are left-handed in this order
            result[:, column, 0] = moving[:, 0] / depth
            result[:, column, 1] = (moving[:, 2] - tangent * moving[:, 1]) / depth
        return result


def _matrices(quaternion: Array) -> Array:
    return Rotation.from_quat(quaternion, scalar_first=True).as_matrix()


def line_of_sight(arc: Arc, camera: Camera, times: ArrayLike, quaternion: Array) -> tuple[Array, Array, Array]:
    """Position (m) of the satellite, line of sight and detector-line axis, all (n, 3) in Earth-fixed axes."""
    position, _, turn = arc.earth_fixed(np.asarray(times, float))
    axes = turn @ _matrices(quaternion) @ camera.body_from_camera
    return position, axes[:, :, 1], axes[:, :, 2]


def footprint_of_attitude(arc: Arc, camera: Camera, times: ArrayLike, quaternion: Array) -> tuple[Array, Array, Array]:
    """Ground points (n, 3, m, Earth-fixed) of the field's centre and of the ends of the detector line at -c and +c."""
    position, sight, across = line_of_sight(arc, camera, times, quaternion)
    tangent = camera.half_field
    return (nearest_intersection(position, sight), nearest_intersection(position, sight - tangent * across),
            nearest_intersection(position, sight + tangent * across))


def off_nadir_of_attitude(arc: Arc, camera: Camera, times: ArrayLike, quaternion: Array) -> Array:
    """Angle (n,) in rad of the line of sight from the geodetic nadir."""
    position, sight, _ = line_of_sight(arc, camera, times, quaternion)
    return off_nadir_angle(position, sight)


def _camera_axes(sight: Array, tangent: Array) -> tuple[Array, Array]:
    """Unit line of sight l and the unit direction of the geodesic perpendicular to it, from range vectors (n, 3)."""
    distance = np.linalg.norm(sight, axis=-1, keepdims=True)
    unit = sight / distance
    across = tangent - np.sum(tangent * unit, -1, keepdims=True) * unit
    return unit, across / np.linalg.norm(across, axis=-1, keepdims=True)


def make_scan(arc: Arc, camera: Camera, line: GroundLine, first: float, last: float, start: float, rate: float, *,
              kind_of_motion: str = "constant", turned: bool = False) -> Scan:
    """The scan of a piece of a geodesic.

    Args:
        arc: the orbit around the scan.
        camera: axes and field.
        line: the geodesic; ``first`` and ``last`` (m) are distances along it.
        start: s from the epoch.
        rate: image velocity over focal length, rad/s (not used by ``along_track``).
        kind_of_motion: ``constant``, ``equalised`` or ``along_track``.
        turned: scan against the geodesic's sense with the body turned by half a turn instead of the detector reversed.

    Raises:
        GeometryError: a part of the line is below the horizon, or behind the arc's end.
        InfeasibleError: equalising would turn the camera by more than 20 degrees.
    """
    low, high = min(first, last), max(first, last)
    guess = (high - low) / 7000.0  # s
    degree = int(min(96, 20 + guess / 5))
    ways = _Polynomial(low, high, degree)
    ground, tangent = line.at(ways.nodes)
    up = ground / np.array([1.0, 1.0, 1 - 0.00669437999]) if ground.size else ground
    sense = 1.0 if last > first else -1.0

    def visible(position: Array) -> None:
        if np.any(np.sum((position - ground) * up, -1) <= 0):
            raise GeometryError("a part of the line is below the satellite's horizon", where="scan",
                                value=f"at {start:.1f} s from the epoch", remedy="scan at another time")

    if kind_of_motion == "along_track":
        times = _along_track_times(arc, line, first, last, start, ways)
        turns = None
    else:
        times, turns = _timed(arc, camera, ways, ground, tangent, start, rate, sense, turned,
                              kind_of_motion == "equalised", visible)
    coefficients = ways.fit(times)
    ends = ways.value(coefficients, np.array([first, last]))
    stop = float(ends[1])
    if stop <= start or stop > arc.stop or start < arc.start:
        raise GeometryError("the scan leaves the piece of orbit at hand", where="scan",
                            value=f"{start:.1f} to {stop:.1f} s", limit=f"{arc.start:.1f} to {arc.stop:.1f} s")
    return _with_attitude(arc, camera, line, first, last, start, stop, kind_of_motion, turned, ways, coefficients,
                          turns)


def _timed(arc: Arc, camera: Camera, ways: _Polynomial, ground: Array, tangent: Array, start: float, rate: float,
           sense: float, turned: bool, equalised: bool, visible: Callable[[Array], None],
           ) -> tuple[Array, tuple[_Polynomial, Array] | None]:
    """Times (s) at the nodes of the way, and for the equalised motion the turn about the line of sight over time.

    Fixed point: with times given, the satellite's positions, and from them the time that every element of the way
    takes. The slant range changes little while the times move, so that each round gains about two digits.
    """
    span = ways.high - ways.low
    from_first = ways.nodes - ways.low if sense > 0 else ways.high - ways.nodes
    times = start + from_first / 7000.0
    turns: tuple[_Polynomial, Array] | None = None
    rounds = 3 if equalised else 1
    for _ in range(rounds):
        previous = np.inf
        for _ in range(60):
            position, _, _ = arc.earth_fixed(times)
            visible(position)
            sight = ground - position
            distance = np.linalg.norm(sight, axis=-1)
            sine = np.linalg.norm(np.cross(sight, tangent), axis=-1) / distance
            slowness = sine / (rate * distance)
            if turns is not None:
                slowness = slowness * np.cos(turns[0].value(turns[1], np.clip(times, turns[0].low, turns[0].high)))
            total = ways.whole(slowness)
            passed = ways.integral(slowness)
            update = start + (passed if sense > 0 else total - passed)
            change = float(np.max(np.abs(update - times)))
            times = update
            if change < 1e-11 * max(1.0, abs(start)) or (change < 1e-9 and change >= previous):
                break
            previous = change
        if not np.all(np.isfinite(times)) or total > 3600.0:
            raise GeometryError("the scan does not end within an hour", where="scan", value=f"{span / 1e3:.0f} km",
                                remedy="ask for a shorter line or a faster image motion")
        if equalised:
            coefficients = ways.fit(times)
            turns = _equalising_turn(arc, camera, ways, coefficients, ground, tangent, start, start + total, sense,
                                     turned)
    return times, turns


def _way_at(ways: _Polynomial, coefficients: Array, times: Array) -> Array:
    """Distances along the line at given times, by Newton's method on the polynomial of the times."""
    ends = ways.value(coefficients, np.array([ways.low, ways.high]))
    way = ways.low + (times - ends[0]) / (ends[1] - ends[0]) * (ways.high - ways.low)
    for _ in range(30):
        error = ways.value(coefficients, way) - times
        if np.max(np.abs(error)) < 1e-12 * max(1.0, float(np.max(np.abs(times)))):
            break
        way = way - error / ways.value(coefficients, way, 1)
    return way


def _equalising_turn(arc: Arc, camera: Camera, ways: _Polynomial, coefficients: Array, ground: Array, tangent: Array,
                     start: float, stop: float, sense: float, turned: bool) -> tuple[_Polynomial, Array]:
    """Turn about the line of sight over time (rad) that equalises the ends' longitudinal image velocities.

    In camera axes relative to the Earth a point on the detector line at the tangent z has the longitudinal image rate
    ``-(v . a) / R - w . c + z w . l`` (v the camera's velocity, R the depth of the point), so that the ends are equal
    when ``w . l = (v . a) (1 / R+ - 1 / R-) / (2 z)``.
    """
    clock = _Polynomial(start, stop, ways.degree)
    way = _way_at(ways, coefficients, clock.nodes)
    point = ways.value(ways.fit(np.concatenate([ground, tangent], -1)), way)
    position, velocity, _ = arc.earth_fixed(clock.nodes)
    sight, along = _camera_axes(point[:, :3] - position, point[:, 3:])
    if turned:
        along = along * sense
    across = np.cross(sight, along)
    # Rate about the line of sight without the turn, relative to the Earth: (a' . c).
    plain = np.sum(clock.value(clock.fit(along), clock.nodes, 1) * across, -1)
    half = camera.half_field
    rate_across = -np.sum(clock.value(clock.fit(sight), clock.nodes, 1) * across, -1)  # w . a = -(l' . c)
    rate_along = np.sum(clock.value(clock.fit(sight), clock.nodes, 1) * along, -1)  # component along c: w . c = l' . a

    def depths(a: Array, c: Array) -> tuple[Array, Array]:
        plus = nearest_intersection(position, sight + half * c)
        minus = nearest_intersection(position, sight - half * c)
        return np.sum((plus - position) * sight, -1), np.sum((minus - position) * sight, -1)

    def turned_by(first: float, guess: Array) -> Array:
        angle = guess
        for _ in range(60):
            cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
            a, c = cosine * along + sine * across, cosine * across - sine * along
            plus, minus = depths(a, c)
            needed = np.sum(velocity * a, -1) * (1 / plus - 1 / minus) / (2 * half)
            update = first + clock.integral(needed - plain)
            change = float(np.max(np.abs(update - angle)))
            angle = np.clip(update, -1.2, 1.2)
            if change < 1e-13:
                break
        return angle

    def cross_motion(angle: Array) -> float:
        cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
        a, c = cosine * along + sine * across, cosine * across - sine * along
        plus, minus = depths(a, c)
        # w . a of the turned axes, from the two components of w perpendicular to the line of sight
        about_along = np.cos(angle) * rate_across + np.sin(angle) * rate_along
        total = 0.0
        for tangent_, depth in ((half, plus), (-half, minus)):
            cross = (-np.sum(velocity * c, -1) / depth + (1 + tangent_**2) * about_along
                     + tangent_ * np.sum(velocity * sight, -1) / depth)
            total += clock.whole(cross**2)
        return total

    first, step = 0.0, 0.02  # rad
    angle = turned_by(first, np.zeros_like(clock.nodes))
    for _ in range(6):
        middle = cross_motion(angle)
        high = cross_motion(turned_by(first + step, angle + step))
        low = cross_motion(turned_by(first - step, angle - step))
        curvature = high - 2 * middle + low
        shift = 0.5 * step * (low - high) / curvature if curvature > 0 else 0.0
        shift = max(-0.3, min(0.3, shift))
        first += shift
        angle = turned_by(first, angle + shift)
        if abs(shift) < 1e-8:
            break
        step = max(1e-3, min(0.02, abs(shift)))
    largest = float(np.max(np.abs(angle)))
    if largest > LARGEST_TURN:
        raise InfeasibleError(
            f"equalising the image motion turns the camera by {math.degrees(largest):.2f} deg about the line of sight, "
            f"limit {math.degrees(LARGEST_TURN):.0f} deg", limit="turn about the line of sight",
            excess=largest - LARGEST_TURN)
    return clock, clock.fit(angle)


def pitch_of(arc: Arc, times: Array, ground: Array) -> Array:
    """Pitch (rad) of the direction to Earth-fixed points in the orbital frame: forward of the nadir is positive."""
    position, _, turn = arc.earth_fixed(times)
    inertial = np.einsum("nji,nj->ni", turn, ground - position)
    local = np.einsum("nji,nj->ni", arc.orbital_axes(times), inertial)
    return np.arctan2(local[:, 0], -local[:, 1])


def _along_track_times(arc: Arc, line: GroundLine, first: float, last: float, start: float, ways: _Polynomial) -> Array:
    """Times (s) at which the points of the way are seen at the pitch of the first one at the start."""
    ground, _ = line.at(ways.nodes)
    origin, _ = line.at(np.array([first]))
    pitch = float(pitch_of(arc, np.array([start]), origin)[0])
    if abs(pitch) > 1.2:
        raise GeometryError("the start of the along-track scan is near the horizon", where="scan",
                            value=f"{math.degrees(pitch):.1f} deg of pitch")
    times = np.clip(start + (ways.nodes - first) * math.copysign(1, last - first) / 6800.0, arc.start + 1, arc.stop - 1)
    for _ in range(40):
        error = pitch_of(arc, times, ground) - pitch
        slope = (pitch_of(arc, times + 0.5, ground) - pitch_of(arc, times - 0.5, ground))
        step = -error / slope
        times = np.clip(times + np.clip(step, -60, 60), arc.start + 1, arc.stop - 1)
        if np.max(np.abs(step)) < 1e-11 * max(1.0, float(np.max(np.abs(times)))):
            break
    else:
        if np.max(np.abs(step)) > 1e-8:
            raise GeometryError("the line does not follow the ground track: it cannot be scanned along the track",
                                where="scan", remedy='leave azimuth_deg out, or choose image_motion = "constant"')
    progress = np.diff(times) if last > first else -np.diff(times)
    if np.any(progress <= 0):
        raise GeometryError("the line runs against the flight: it cannot be scanned along the track", where="scan",
                            remedy='leave azimuth_deg out, or choose image_motion = "constant"')
    return times


def _with_attitude(arc: Arc, camera: Camera, line: GroundLine, first: float, last: float, start: float, stop: float,
                   kind_of_motion: str, turned: bool, ways: _Polynomial, coefficients: Array,
                   turns: tuple[_Polynomial, Array] | None) -> Scan:
    """The scan with its attitude spline, from the times along the way."""
    clock = _Polynomial(start, stop, ways.degree + 4)
    way = _way_at(ways, coefficients, clock.nodes)
    ground, tangent = line.at(way)
    position, _, turn = arc.earth_fixed(clock.nodes)
    sight, along = _camera_axes(ground - position, tangent)
    if turned and last < first:
        along = -along
    across = np.cross(sight, along)
    if turns is not None:
        angle = turns[0].value(turns[1], np.clip(clock.nodes, turns[0].low, turns[0].high))[:, None]
        along, across = np.cos(angle) * along + np.sin(angle) * across, np.cos(angle) * across - np.sin(angle) * along
    fixed_from_camera = np.stack([along, sight, across], -1)
    inertial_from_body = np.swapaxes(turn, 1, 2) @ fixed_from_camera @ camera.body_from_camera.T
    quaternion = sign_continuous(Rotation.from_matrix(inertial_from_body).as_quat(scalar_first=True))
    reference = quaternion[len(quaternion) // 2]
    local = product(conjugate(reference), quaternion)
    local = local * np.sign(local[len(local) // 2, 0])
    parameters = clock.fit(rodrigues_from_quaternion(local, shortest=False))
    pieces = max(2, math.ceil((stop - start) / KNOT_STEP))
    knots = np.linspace(start, stop, pieces + 1)
    conditions = np.stack([clock.value(parameters, knots, order) for order in range(4)], 1)
    return Scan(start, stop, line, first, last, kind_of_motion, turned and last < first, np.array(reference),
                VectorSpline.through(knots, conditions), arc, camera, (ways, coefficients))
