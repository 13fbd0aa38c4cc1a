"""A first orbit to start the joint fit, from two-line elements or from the data alone.

From the data: positions from range with azimuth and elevation of one station, else from three or more ranges at the
same time, else the stationary longitude that fits best; then the two-body orbit through the positions by least
squares over a horizon that grows from a part of a revolution to all data.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import least_squares

from estimator.models.errors import FileFormatError, TooFewDataError
from estimator.models.station import east_north_up, station_position
from problems.geo_orbit.plausibility import kepler

if TYPE_CHECKING:
    from problems.geo_orbit.problem import OrbitModel

_NEAR = 1200.0  # s between a range and the angles that it is joined with
_SAME = 30.0  # s between ranges that are taken as simultaneous
_STATIONARY = 42164.17e3  # m
_PARAMETER = 3.986004418e14  # m3/s2
_SPIN = 7.292115146706979e-5  # rad/s of the Earth


def initial_state(model: OrbitModel) -> tuple[np.ndarray, np.ndarray]:
    """Position and velocity (3 each), GCRS, at the model's epoch.

    Raises:
        TooFewDataError: neither two-line elements nor data that give an orbit.
    """
    if model.settings.tle is not None:
        return state_of_elements(model.settings.tle, model.epoch)
    found = _from_angles(model)
    if found is None:
        found = _from_ranges(model)
    if found is not None:
        state = _orbit_through(*found)
        if state is not None:
            return state[:3], state[3:]
    return _stationary(model)


def state_of_elements(lines: tuple[str, str], epoch: np.datetime64) -> tuple[np.ndarray, np.ndarray]:
    """GCRS position and velocity (m, m/s) of two-line elements (SGP4 as brahe carries it) at a TAI instant.

    Raises:
        FileFormatError: the lines are no element set.
    """
    import brahe
    import erfa

    if not brahe.get_global_eop_initialization():
        # Only the true equator frame of SGP4 is used here, which needs no UT1; brahe asks for it all the same.
        brahe.set_global_eop_provider(brahe.StaticEOPProvider.from_zero())
    try:
        propagator = brahe.SGPPropagator.from_tle(lines[0], lines[1], 60.0)
    except Exception as error:
        raise FileFormatError("this is no two-line element set", value=lines[0][:40]) from error
    text = str(epoch.astype("datetime64[us]"))
    date, clock = text.split("T")
    year, month, day = (int(w) for w in date.split("-"))
    hour, minute, second = clock.split(":")
    scale: Any = brahe.TimeSystem.TAI  # the stubs give the members as methods
    instant = brahe.Epoch.from_datetime(year, month, day, int(hour), int(minute), float(second), 0.0, scale)
    teme = np.asarray(propagator.state(instant))
    days = float((epoch - np.datetime64("2000-01-01T12:00:00", "us")) / np.timedelta64(1, "us")) / 86400e6
    tt = days + 32.184 / 86400  # day
    equinoxes = erfa.ee06a(2451545.0, tt)
    c, s = np.cos(-equinoxes), np.sin(-equinoxes)
    true_of_date = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    rotation = erfa.pnm06a(2451545.0, tt).T @ true_of_date
    return rotation @ teme[:3], rotation @ teme[3:]


def _from_angles(model: OrbitModel) -> tuple[np.ndarray, np.ndarray] | None:
    """Times and celestial positions where a station has a range and angles near in time."""
    legs = 2.0 if model.settings.legs == "sum" else 1.0
    times, places = [], []
    for o in model.tracking.observations:
        if o.kind != "range" or o.receiver != o.transmitter:
            continue
        angles = [
            a
            for a in model.tracking.observations
            if a.kind in ("azimuth_elevation", "direction_cosines") and a.receiver == o.receiver
        ]
        station = model.station(o.receiver)
        origin = station_position(station.latitude, station.longitude, station.altitude)
        axes = east_north_up(station.latitude, station.longitude)
        for a in angles:
            ta, to = model.seconds(a.time), model.seconds(o.time)
            if a.kind == "azimuth_elevation":
                north, east = np.cos(a.value[:, 0]), np.sin(a.value[:, 0])
                level = np.cos(a.value[:, 1])
                local = np.column_stack([east * level, north * level, np.sin(a.value[:, 1])])
            else:
                north, east = a.value[:, 0], a.value[:, 1]
                local = np.column_stack([east, north, np.sqrt(np.maximum(1 - north**2 - east**2, 0.0))])
            fixed = local @ axes
            index = np.clip(np.searchsorted(ta, to), 1, max(len(ta) - 1, 1))
            for row, t in enumerate(to):
                right = min(int(index[row]), len(ta) - 1)
                left = max(right - 1, 0)
                if min(abs(ta[left] - t), abs(ta[right] - t)) > _NEAR:
                    continue
                share = 0.0 if left == right else np.clip((t - ta[left]) / max(ta[right] - ta[left], 1e-9), -0.5, 1.5)
                if abs(ta[right] - ta[left]) > 3 * _NEAR:
                    share = 0.0 if abs(ta[left] - t) < abs(ta[right] - t) else 1.0
                direction = (1 - share) * fixed[left] + share * fixed[right]
                direction /= np.linalg.norm(direction)
                distance = (o.value[row, 0] - model.settings.onboard_range_bias) / legs - station.bias.get("range", 0.0)
                times.append(t)
                places.append(origin + distance * direction)
    if len(times) < 3:
        return None
    return _celestial(model, np.array(times), np.array(places))


def _celestial(model: OrbitModel, time: np.ndarray, fixed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    order = np.argsort(time)
    rotation = model.environment.earth_fixed_from_celestial(time[order])
    return time[order], np.einsum("nji,nj->ni", rotation, fixed[order])


def _from_ranges(model: OrbitModel) -> tuple[np.ndarray, np.ndarray] | None:
    """Times and celestial positions where three or more stations ranged at the same time."""
    legs = 2.0 if model.settings.legs == "sum" else 1.0
    rows = []
    for o in model.tracking.observations:
        if o.kind == "range" and o.receiver == o.transmitter:
            s = model.station(o.receiver)
            origin = station_position(s.latitude, s.longitude, s.altitude)
            bias = s.bias.get("range", 0.0)
            rows += [
                (t, *origin, (v - model.settings.onboard_range_bias) / legs - bias)
                for t, v in zip(model.seconds(o.time), o.value[:, 0], strict=True)
            ]
    if len(rows) < 9:
        return None
    table = np.array(sorted(rows))
    cuts = np.flatnonzero(np.diff(table[:, 0]) > _SAME) + 1
    times, places = [], []
    guess: np.ndarray | None = None
    for group in np.split(table, cuts)[:400]:
        if len({tuple(g[1:4]) for g in group}) < 3:
            continue
        origins, distances = group[:, 1:4], group[:, 4]
        middle = origins.mean(axis=0)
        starts = (
            [guess]
            if guess is not None
            else [
                middle + distances.mean() * _turned(middle / np.linalg.norm(middle), a, b)
                for a in np.radians([-50, -20, 0, 20, 50])
                for b in np.radians([-60, -20, 20, 60])
            ]
        )
        best = None
        for start in starts:
            answer = least_squares(
                lambda x, o=origins, d=distances: np.linalg.norm(x - o, axis=1) - d, start, x_scale=1e5
            )
            if best is None or answer.cost < best.cost:
                best = answer
        assert best is not None
        if np.sqrt(2 * best.cost / len(group)) < 50e3 and np.linalg.norm(best.x) > 6.5e6:
            times.append(float(group[:, 0].mean()))
            places.append(best.x)
            guess = best.x
    if len(times) < 3:
        return None
    return _celestial(model, np.array(times), np.array(places))


def _turned(direction: np.ndarray, north: float, east: float) -> np.ndarray:
    longitude = np.arctan2(direction[1], direction[0]) + east
    latitude = np.arcsin(direction[2]) + north - np.arcsin(direction[2])
    return np.array([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])


def _orbit_through(time: np.ndarray, places: np.ndarray) -> np.ndarray | None:
    """State (6) at time zero of the two-body orbit through positions, over a horizon that grows."""
    anchor = int(np.argmin(np.abs(time)))
    t0 = time[anchor]
    radius = float(np.median(np.linalg.norm(places, axis=1)))
    quarter = 0.2 * 2 * np.pi * np.sqrt(radius**3 / _PARAMETER)
    near = np.abs(time - t0) <= quarter
    if near.sum() < 3:
        near = np.argsort(np.abs(time - t0)) < 3
    degree = min(2, int(near.sum()) - 1)
    fits = [np.polynomial.Polynomial.fit(time[near] - t0, places[near, i], degree) for i in range(3)]
    state = np.array([*(f(0.0) for f in fits), *(f.deriv()(0.0) for f in fits)])
    speed = np.linalg.norm(state[3:])
    limit = np.sqrt(2 * _PARAMETER / np.linalg.norm(state[:3]))
    if speed >= 0.99 * limit:
        state[3:] *= 0.8 * limit / speed
    horizon, longest = quarter, float(np.max(np.abs(time - t0)))
    unit = np.array([1e5, 1e5, 1e5, 10.0, 10.0, 10.0])
    while True:
        inside = np.abs(time - t0) <= horizon
        if inside.sum() >= 3:

            def gap(x: np.ndarray, inside: np.ndarray = inside) -> np.ndarray:
                with np.errstate(all="ignore"):
                    r = (kepler(x[:3] * 1.0, x[3:], time[inside] - t0)[:, :3] - places[inside]).ravel() / 1e5
                return np.where(np.isfinite(r), r, 1e6)

            state = least_squares(gap, state, x_scale=unit, loss="soft_l1", max_nfev=60).x
        if horizon >= longest or horizon > 6 * quarter / 0.2:
            break
        horizon *= 2
    if not np.isfinite(state).all():
        return None
    return kepler(state[:3], state[3:], np.array([-t0]))[0]


def _stationary(model: OrbitModel) -> tuple[np.ndarray, np.ndarray]:
    """The stationary orbit at the longitude whose geometry is nearest to the data.

    Raises:
        TooFewDataError: the data hold neither ranges nor angles.
    """
    legs = 2.0 if model.settings.legs == "sum" else 1.0
    longitudes = np.radians(np.arange(0.0, 360.0, 0.5))
    places = _STATIONARY * np.column_stack([np.cos(longitudes), np.sin(longitudes), 0 * longitudes])
    cost, used = np.zeros(len(longitudes)), 0
    for o in model.tracking.observations:
        s = model.station(o.receiver)
        line = places - station_position(s.latitude, s.longitude, s.altitude)
        distance = np.linalg.norm(line, axis=1)
        local = line @ east_north_up(s.latitude, s.longitude).T / distance[:, None]
        if o.kind == "range":
            cost += len(o.time) * np.minimum(np.abs(distance - np.median(o.value) / legs) / 1e5, 100.0)
        elif o.kind == "azimuth_elevation":
            azimuth, elevation = np.median(o.value, axis=0)
            level = np.cos(elevation)
            seen = np.array([np.sin(azimuth) * level, np.cos(azimuth) * level, np.sin(elevation)])
            cost += len(o.time) * np.linalg.norm(local - seen, axis=1) * 100
        elif o.kind == "direction_cosines":
            north, east = np.median(o.value, axis=0)
            cost += len(o.time) * np.hypot(local[:, 1] - north, local[:, 0] - east) * 100
        else:
            continue
        cost += np.where(local[:, 2] < 0, 1e6, 0.0)
        used += 1
    if used == 0:
        raise TooFewDataError(
            "range rates alone do not tell where to start",
            where="[orbit]",
            remedy="give an initial orbit: position_m and velocity_m_s, or a tle",
        )
    best = places[int(np.argmin(cost))]
    rotation = model.environment.earth_fixed_from_celestial(np.zeros(1))[0]
    return rotation.T @ best, rotation.T @ np.cross([0.0, 0.0, _SPIN], best)
