"""Orbit of the satellite in inertial axes with the second zonal harmonic, and the orientation of the Earth.

Inertial axes are those of the GCRF. The osculating elements of a request refer to these axes. The force is the point
mass and J2 of the Earth about its true pole of the date. The Earth is turned by the IAU 2006/2000A precession and
nutation, the Earth rotation angle and the polar motion, with the UT1 and pole coordinates that astropy carries (IERS);
nothing is fetched from a network.

Times are seconds after the epoch of the request (UTC); a leap second inside an arc is not counted by the epoch's UTC
label, as all times are elapsed seconds.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray

from estimator.models.errors import GeometryError
from guidance.ground_geometry import (
    EQUATORIAL_RADIUS,
    geodesic_direct,
    geodesic_inverse,
    geodetic_from_earth_fixed,
    local_axes,
    wrapped,
)
from guidance.survey_request import OrbitRequest

Array = NDArray[np.float64]

GRAVITATIONAL_PARAMETER = 3.986004418e14  # m3/s2, EGM2008
SECOND_ZONAL_HARMONIC = 1.0826355e-3  # J2, EGM2008, unnormalized
GRAVITY_RADIUS = 6378136.3  # m, reference radius of EGM2008
EARTH_RATE = 7.2921150e-5  # rad/s

FORCE_MODEL = "point mass and J2 (EGM2008), about the true pole of date"
INERTIAL_FRAME = "GCRF"


class EarthOrientation:
    """Rotation of the Earth-fixed axes (ITRF) against the inertial ones (GCRF), in seconds from an epoch.

    Args:
        epoch: UTC.

    The precession-nutation matrix and the pole are taken at hourly knots and between them linearly (the error of this
    is below 1e-12 rad); the Earth rotation angle is exact.
    """

    knot = 3600.0  # s

    def __init__(self, epoch: datetime):
        self.epoch = epoch.replace(tzinfo=None)
        self._knots: dict[int, tuple[Array, Array, float]] = {}
        self.outside_table = False

    @cached_property
    def _table(self) -> Array:
        """Days around the epoch (n, 4): modified Julian date, pole x and y (arc seconds), UT1 - UTC (s).

        From the IERS file that astropy carries, as text: reading the whole of it as a table takes seconds. Values of
        bulletin B stand where there are any, otherwise those of bulletin A.
        """
        from astropy.utils import iers

        wanted = (self.epoch - datetime(1858, 11, 17)).total_seconds() / 86400.0
        rows: list[tuple[float, ...]] = []
        with Path(iers.IERS_A_FILE).open(encoding="ascii") as stream:
            for line in stream:
                if not line[58:68].strip():
                    break
                date = float(line[7:15])
                if rows and date > wanted + 30.0:
                    break
                if date >= wanted - 30.0 or not rows:
                    final = line[134:165].strip() != ""
                    fields = (line[134:144], line[144:154], line[154:165]) if final else (line[18:27], line[37:46],
                                                                                          line[58:68])
                    rows.append((date, *(float(f) for f in fields)))
                last = line
        if rows[-1][0] < wanted:
            rows.append((float(last[7:15]), *(float(f) for f in (last[18:27], last[37:46], last[58:68]))))
        return np.array(sorted(set(rows)))

    @property
    def name(self) -> str:
        """What the orientation is made of, for the output."""
        text = "astropy: IAU 2006/2000A precession-nutation (ERFA), UT1 and polar motion of IERS"
        return text + (", last known values (the date is outside the table)" if self.outside_table else "")

    def _at_knot(self, index: int) -> tuple[Array, Array, float]:
        """Celestial-to-intermediate matrix, polar motion matrix and Earth rotation angle at a knot."""
        if index not in self._knots:
            import erfa
            from astropy.time import Time, TimeDelta

            with warnings.catch_warnings():
                warnings.simplefilter("ignore", erfa.ErfaWarning)  # leap seconds of years to come are not known
                moment = Time(self.epoch, scale="utc") + TimeDelta(index * self.knot, format="sec")
                tt, utc = moment.tt, moment.utc
            table, day = self._table, float(utc.mjd)
            self.outside_table |= not table[0, 0] <= day <= table[-1, 0]
            x, y = (math.radians(float(np.interp(day, table[:, 0], table[:, k])) / 3600.0) for k in (1, 2))
            # UT1 - UTC jumps with a leap second: take it out before interpolating.
            steps = np.round(np.concatenate([[0.0], np.cumsum(np.round(np.diff(table[:, 3])))]))
            smooth = float(np.interp(day, table[:, 0], table[:, 3] - steps))
            ut1_minus_utc = smooth + float(steps[max(0, int(np.searchsorted(table[:, 0], day, side="right")) - 1)])
            intermediate = erfa.c2i06a(tt.jd1, tt.jd2)
            pole = erfa.pom00(x, y, erfa.sp00(tt.jd1, tt.jd2))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", erfa.ErfaWarning)
                ut1_1, ut1_2 = erfa.utcut1(utc.jd1, utc.jd2, ut1_minus_utc)
            self._knots[index] = (intermediate, pole, float(erfa.era00(ut1_1, ut1_2)))
        return self._knots[index]

    def fixed_from_inertial(self, times: ArrayLike) -> Array:
        """Matrices (..., 3, 3) that turn GCRF coordinates into Earth-fixed (ITRF) ones.

        Args:
            times: seconds from the epoch.
        """
        times = np.asarray(times, float)
        flat = times.reshape(-1)
        result = np.empty((flat.size, 3, 3))
        cells = np.floor(flat / self.knot).astype(int)
        for cell in np.unique(cells):
            chosen = cells == cell
            fraction = flat[chosen] / self.knot - cell
            low, high = self._at_knot(int(cell)), self._at_knot(int(cell) + 1)
            turn = (high[2] - low[2]) % (2 * math.pi)
            angle = low[2] + turn * fraction
            weight = fraction[:, None, None]
            intermediate = (1 - weight) * low[0] + weight * high[0]
            pole = (1 - weight) * low[1] + weight * high[1]
            cosine, sine, zero = np.cos(angle), np.sin(angle), np.zeros_like(angle)
            spin = np.stack([np.stack([cosine, sine, zero], -1), np.stack([-sine, cosine, zero], -1),
                             np.stack([zero, zero, zero + 1], -1)], -2)
            result[chosen] = pole @ spin @ intermediate
        return result.reshape(*times.shape, 3, 3)

    def pole(self, time: float) -> Array:
        """Unit vector (3) of the Earth's true pole in GCRF axes."""
        return np.array(self._at_knot(math.floor(time / self.knot))[0][2])

    def spin(self, times: ArrayLike) -> Array:
        """Angular velocity (..., 3) of the Earth, rad/s, in Earth-fixed axes.

        It is along the celestial pole, taken at the middle of the times: the pole moves by 1e-11 rad in an hour.
        """
        times = np.asarray(times, float)
        rate = 2 * math.pi * 1.00273781191135448 / 86400.0
        middle = float(times.mean()) if times.size else 0.0
        return np.broadcast_to(rate * self._at_knot(math.floor(middle / self.knot))[1][:, 2], (*times.shape, 3))


def state_from_elements(semi_major_axis: float, eccentricity: float, inclination: float, node: float,
                        argument_of_perigee: float, argument_of_latitude: float) -> tuple[Array, Array]:
    """Position (3, m) and velocity (3, m/s) of osculating elements (m, rad), in the axes of the elements."""
    anomaly = argument_of_latitude - argument_of_perigee
    parameter = semi_major_axis * (1 - eccentricity**2)
    radius = parameter / (1 + eccentricity * math.cos(anomaly))
    speed = math.sqrt(GRAVITATIONAL_PARAMETER / parameter)
    cn, sn, ci, si = math.cos(node), math.sin(node), math.cos(inclination), math.sin(inclination)
    ascending = np.array([cn, sn, 0.0])
    quarter = np.array([-sn * ci, cn * ci, si])
    cu, su = math.cos(argument_of_latitude), math.sin(argument_of_latitude)
    radial, transverse = cu * ascending + su * quarter, -su * ascending + cu * quarter
    velocity = speed * (eccentricity * math.sin(anomaly) * radial + (1 + eccentricity * math.cos(anomaly)) * transverse)
    return radius * radial, velocity


def chebyshev_values(x: Array, count: int) -> Array:
    """The first ``count`` Chebyshev polynomials (..., count) at points brought into [-1, 1]."""
    return np.cos(np.arccos(np.clip(x, -1.0, 1.0))[..., None] * np.arange(count))


class Arc:
    """A piece of the orbit as Chebyshev polynomials, with the Earth's orientation along it.

    Args:
        start, stop: seconds from the epoch.
        coefficients: Chebyshev coefficients of the position (degree + 1, 3), m.
        earth: orientation of the Earth.
    """

    def __init__(self, start: float, stop: float, coefficients: Array, earth: EarthOrientation):
        self.start, self.stop, self.earth = start, stop, earth
        half = 0.5 * (stop - start)
        velocity = np.zeros_like(coefficients)
        velocity[:-1] = chebyshev.chebder(coefficients) / half
        self._state = np.concatenate([coefficients, velocity], 1)

    def inertial(self, times: ArrayLike) -> tuple[Array, Array]:
        """Positions (..., 3, m) and velocities (..., 3, m/s) in GCRF axes; at the nearer end outside the arc."""
        x = (2 * np.asarray(times, float) - self.start - self.stop) / (self.stop - self.start)
        state = chebyshev_values(x, len(self._state)) @ self._state
        return state[..., :3], state[..., 3:]

    def earth_fixed(self, times: ArrayLike) -> tuple[Array, Array, Array]:
        """Positions (m), velocities relative to the Earth (m/s), both (..., 3) in ITRF axes, and ITRF from GCRF."""
        position, velocity = self.inertial(times)
        turn = self.earth.fixed_from_inertial(times)
        fixed = np.einsum("...ij,...j->...i", turn, position)
        relative = np.einsum("...ij,...j->...i", turn, velocity) - np.cross(self.earth.spin(times), fixed)
        return fixed, relative, turn

    def ground_track(self, times: ArrayLike) -> tuple[Array, Array, Array]:
        """Geodetic latitude, longitude and azimuth of motion (rad) of the point under the satellite."""
        position, velocity, _ = self.earth_fixed(times)
        latitude, longitude, _ = geodetic_from_earth_fixed(position)
        east, north, _ = local_axes(latitude, longitude)
        return latitude, longitude, np.arctan2(np.sum(velocity * east, -1), np.sum(velocity * north, -1))

    def orbital_axes(self, times: ArrayLike) -> Array:
        """GCRF from the orbital frame (..., 3, 3): columns x along the flight, y up, z = x cross y (right-handed)."""
        position, velocity = self.inertial(times)
        up = position / np.linalg.norm(position, axis=-1, keepdims=True)
        normal = np.cross(position, velocity)
        normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
        along = np.cross(normal, up)
        return np.stack([along, up, np.cross(along, up)], -1)


class Orbit:
    """The satellite's orbit from its state at the epoch, integrated on demand.

    Args:
        epoch: UTC.
        position, velocity: state at the epoch (3, m and 3, m/s) in GCRF axes.
        earth: orientation of the Earth from the same epoch.
    """

    def __init__(self, epoch: datetime, position: Array, velocity: Array, earth: EarthOrientation | None = None):
        self.epoch = epoch.replace(tzinfo=None)
        self.position, self.velocity = np.asarray(position, float), np.asarray(velocity, float)
        self.earth = earth or EarthOrientation(epoch)
        self._dense: dict[int, tuple[float, Any]] = {}

    @property
    def period(self) -> float:
        """Osculating period at the epoch, s."""
        energy = 0.5 * float(self.velocity @ self.velocity) - GRAVITATIONAL_PARAMETER / np.linalg.norm(self.position)
        return 2 * math.pi * math.sqrt((-GRAVITATIONAL_PARAMETER / (2 * energy)) ** 3 / GRAVITATIONAL_PARAMETER)

    def _derivative(self, time: float, state: Array) -> Array:
        r = state[:3]
        square = float(r @ r)
        radius = math.sqrt(square)
        pole = self._pole
        height = float(r @ pole)
        factor = 1.5 * SECOND_ZONAL_HARMONIC * GRAVITATIONAL_PARAMETER * GRAVITY_RADIUS**2 / radius**5
        acceleration = (-GRAVITATIONAL_PARAMETER / radius**3 * r
                        - factor * ((1 - 5 * height**2 / square) * r + 2 * height * pole))
        return np.concatenate([state[3:], acceleration])

    @cached_property
    def _pole(self) -> Array:
        return self.earth.pole(0.0)

    def states(self, times: ArrayLike) -> Array:
        """Positions and velocities (n, 6; m, m/s; GCRF) at seconds from the epoch, before or after it."""
        from scipy.integrate import solve_ivp

        times = np.atleast_1d(np.asarray(times, float))
        result = np.empty((times.size, 6))
        for sign in (1, -1):
            chosen = (times >= 0) if sign > 0 else (times < 0)
            if not chosen.any():
                continue
            reach = float(np.max(np.abs(times[chosen])))
            if sign not in self._dense or self._dense[sign][0] < reach:
                farther = max(reach + 60.0, 1.5 * self._dense[sign][0] if sign in self._dense else 0.0)
                solution = solve_ivp(self._derivative, (0.0, sign * farther),
                                     np.concatenate([self.position, self.velocity]), method="DOP853", rtol=1e-12,
                                     atol=1e-6, dense_output=True, max_step=120.0)
                self._dense[sign] = (farther, solution.sol)
            result[chosen] = self._dense[sign][1](times[chosen]).T
        return result

    def arc(self, start: float, stop: float) -> Arc:
        """The orbit between two times as one polynomial (seconds from the epoch; up to about half a turn)."""
        degree = int(min(120, 30 + 60 * (stop - start) / self.period))
        nodes = np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
        values = self.states(0.5 * (start + stop) + 0.5 * (stop - start) * nodes)[:, :3]
        return Arc(start, stop, np.asarray(chebyshev.chebfit(nodes, values, degree), float), self.earth)


@dataclass(frozen=True)
class Pass:
    """One pass over a point: time of the closest ground track, distance to it, and the sense of flight."""

    time: float  # s from the epoch
    distance: float  # m along the ellipsoid
    azimuth: float  # of the ground track there, rad
    ascending: bool


def passes_over(orbit: Orbit, latitude: float, longitude: float, start: float, stop: float, reach: float) -> list[Pass]:
    """Passes whose ground track comes within ``reach`` (m) of a point (rad), with their closest times, in order.

    Args:
        start, stop: the span searched, s from the epoch.
    """
    from scipy.optimize import minimize_scalar

    step = 20.0
    times = np.arange(start, stop + step, step)
    states = orbit.states(times)
    turn = orbit.earth.fixed_from_inertial(times)
    fixed = np.einsum("nij,nj->ni", turn, states[:, :3])
    target = np.array([math.cos(latitude) * math.cos(longitude), math.cos(latitude) * math.sin(longitude),
                       math.sin(latitude)])
    closeness = fixed @ target / np.linalg.norm(fixed, axis=1)
    peaks = np.flatnonzero((closeness[1:-1] >= closeness[:-2]) & (closeness[1:-1] > closeness[2:])) + 1
    found = []
    for index in peaks:
        if math.acos(min(1.0, closeness[index])) * EQUATORIAL_RADIUS > reach + 400e3:
            continue
        arc = orbit.arc(times[index] - 60.0, times[index] + 60.0)

        def separation(time: float, arc: Arc = arc) -> float:
            here = arc.ground_track(np.array(time))
            return float(geodesic_inverse(latitude, longitude, here[0], here[1])[0])

        best = minimize_scalar(separation, bounds=(times[index] - 45.0, times[index] + 45.0), method="bounded",
                               options={"xatol": 1e-4})
        if best.fun > reach:
            continue
        azimuth = float(arc.ground_track(np.array(best.x))[2])
        found.append(Pass(float(best.x), float(best.fun), azimuth, bool(states[index, 5] > 0)))
    return found


def orbit_of_request(request: OrbitRequest) -> Orbit:
    """The orbit that a request describes, by its elements or by the pass over a point.

    With ``overhead``, the node and the argument of latitude are solved so that at the epoch the ground track is at its
    closest to the point, at the distance ``offset``, with the track on the right of the point (seen along the
    flight) for a positive offset.

    Raises:
        GeometryError: no pass of this orbit comes so near to the point.
    """
    earth = EarthOrientation(request.epoch)
    if request.overhead is None:
        assert request.node is not None and request.argument_of_latitude is not None
        position, velocity = state_from_elements(request.semi_major_axis, request.eccentricity, request.inclination,
                                                 request.node, request.argument_of_perigee,
                                                 request.argument_of_latitude)
    else:
        position, velocity = _overhead_state(request, earth)
    return Orbit(request.epoch, position, velocity, earth)


def _overhead_state(request: OrbitRequest, earth: EarthOrientation) -> tuple[Array, Array]:
    assert request.overhead is not None
    latitude, longitude = request.overhead
    inclination = request.inclination
    ascending = request.ascending
    turn = earth.fixed_from_inertial(0.0)
    spin = earth.spin(np.array(0.0))
    up = turn.T @ np.array([math.cos(latitude) * math.cos(longitude), math.cos(latitude) * math.sin(longitude),
                            math.sin(latitude)])
    declination, right_ascension = math.asin(up[2]), math.atan2(up[1], up[0])
    # Angle of the point above the orbit plane (on the side of the angular momentum, the left of the flight).
    side = math.sin(request.offset / EQUATORIAL_RADIUS)
    denominator = math.cos(declination) * math.sin(inclination)
    ratio = (side - math.sin(declination) * math.cos(inclination)) / denominator if denominator else math.inf
    highest = min(inclination, math.pi - inclination)
    reachable = highest + abs(request.offset) / EQUATORIAL_RADIUS
    if abs(latitude) > reachable + 0.01:
        raise GeometryError("the orbit never passes so near to the point", where="[orbit] overhead",
                            value=f"latitude {math.degrees(latitude):.3f} deg",
                            limit=f"{math.degrees(highest):.3f} deg, the highest latitude of the ground track",
                            remedy="choose another inclination or offset_km")
    ratio = min(1.0, max(-1.0, ratio))

    def geometry(unknowns: Array) -> tuple[Array, Array, Array]:
        position, velocity = state_from_elements(request.semi_major_axis, request.eccentricity, inclination,
                                                 float(unknowns[0]), request.argument_of_perigee, float(unknowns[1]))
        fixed = turn @ position
        relative = turn @ velocity - np.cross(spin, fixed)
        lat, lon, _ = geodetic_from_earth_fixed(fixed)
        east, north, _ = local_axes(lat, lon)
        azimuth = math.atan2(float(relative @ east), float(relative @ north))
        seen = geodesic_direct(lat, lon, azimuth - math.pi / 2, request.offset)
        miss = np.array([float(seen[0]) - latitude, float(wrapped(seen[1] - longitude)) * math.cos(latitude)])
        return miss, position, velocity

    best: tuple[float, Array, Array, bool] | None = None
    for branch in (math.asin(ratio), math.pi - math.asin(ratio)):
        node = right_ascension + branch
        along = np.array([math.cos(node), math.sin(node), 0.0])
        quarter = np.array([-math.sin(node) * math.cos(inclination), math.cos(node) * math.cos(inclination),
                            math.sin(inclination)])
        unknowns = np.array([node, math.atan2(float(up @ quarter), float(up @ along))])
        miss = geometry(unknowns)[0]
        damping = 0.0
        for _ in range(100):
            if np.linalg.norm(miss) < 1e-15:
                break
            jacobian = np.empty((2, 2))
            for k in range(2):
                shift = np.zeros(2)
                shift[k] = 1e-6  # rad
                jacobian[:, k] = (geometry(unknowns + shift)[0] - geometry(unknowns - shift)[0]) / 2e-6
            normal = jacobian.T @ jacobian
            step = np.linalg.lstsq(normal + damping * np.eye(2), -jacobian.T @ miss, rcond=None)[0]
            step *= min(1.0, 0.1 / max(float(np.linalg.norm(step)), 1e-300))
            trial = geometry(unknowns + step)[0]
            if np.linalg.norm(trial) < np.linalg.norm(miss):
                unknowns, miss, damping = unknowns + step, trial, damping * 0.1
            else:
                damping = max(10 * damping, 1e-9)
                if damping > 1e3:
                    break
        _, position, velocity = geometry(unknowns)
        error = float(np.linalg.norm(miss))
        rising = bool(velocity[2] > 0)
        if best is None or (rising == ascending, -error) > (best[3] == ascending, -best[0]):
            best = (error, position, velocity, rising)
    assert best is not None
    if best[0] > 1e-9:
        raise GeometryError("no pass has its closest ground track at the asked distance from the point",
                            where="[orbit] overhead", value=f"{best[0] * EQUATORIAL_RADIUS / 1e3:.3f} km away",
                            limit="0.01 km", remedy="choose another offset_km, inclination or point")
    if best[3] != ascending:
        raise GeometryError(f"the pass over the point is {'ascending' if best[3] else 'descending'}",
                            where="[orbit] pass", value="ascending" if ascending else "descending",
                            remedy="ask for the other pass")
    return best[1], best[2]


def utc_after(epoch: datetime, seconds: float) -> datetime:
    """UTC label (to the microsecond) of a moment given in seconds after the epoch."""
    return epoch.replace(tzinfo=None) + timedelta(seconds=seconds)
