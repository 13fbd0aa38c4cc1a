"""What tracking data must satisfy before any orbit is fitted, and what a start tells about station and clock."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from estimator.models.earth import EQUATORIAL_RADIUS
from estimator.models.errors import GeometryError, NotFiniteError, UnitError
from estimator.models.station import east_north_up, station_position

if TYPE_CHECKING:
    from estimator.estimate import Estimate
    from problems.geo_orbit.problem import OrbitModel
    from problems.geo_orbit.tracking import Observations

FASTEST = 12e3  # m/s, more than any satellite's range changes
ALLOWANCE = 200e3  # m
LOWEST_RANGE = 100e3  # m, an orbit's height at the least
HIGHEST_RANGE = 1e9  # m, beyond the Moon
_LONGEST_SHIFT = 14 * 3600.0  # s, the largest difference of local time and UTC
_SHORT = 3 * 86400.0  # s, data over which the initial orbit is a place to start from
_FAR_STATION = 500e3  # m, off the starting orbit
_BELOW = np.radians(-5.0)  # rad, elevation that no refraction explains


def check_observations(model: OrbitModel) -> None:
    """Check every number by itself.

    Raises:
        NotFiniteError: a value is NaN or infinite.
        UnitError: a range below an orbit's height (kilometres for metres) or beyond the Moon, an angle out of range.
        GeometryError: a station that is not on the Earth, a range that no motion reaches.
    """
    s = model.settings
    _check_stations(model)
    legs = 2.0 if s.legs == "sum" else 1.0
    for o in model.tracking.observations:
        model.station(o.receiver)
        model.station(o.transmitter)
        place = f"{o.source or 'data'}: {o.name}"

        def at(row: int, o=o, place=place) -> str:  # type: ignore[no-untyped-def]
            return place if o.line is None else f"{place}, line {int(o.line[row])}"

        bad = ~np.isfinite(o.value).all(axis=1)
        if bad.any():
            raise NotFiniteError("a measurement is not finite", where=at(int(np.flatnonzero(bad)[0])))
        if o.kind == "range":
            one_way = (o.value[:, 0] - s.onboard_range_bias) / legs
            low, high = int(np.argmin(one_way)), int(np.argmax(one_way))
            if one_way[low] < LOWEST_RANGE:
                raise UnitError(
                    "a range is shorter than any orbit's height",
                    where=at(low),
                    value=f"{o.value[low, 0]:.6g} m",
                    limit=f"at least {LOWEST_RANGE * legs:.3g} m",
                    remedy="check the unit of the file (metres, kilometres, seconds, range units) and "
                    "whether ranges are half or the sum of both legs",
                )
            if one_way[high] > HIGHEST_RANGE:
                raise UnitError(
                    "a range is beyond the Moon",
                    where=at(high),
                    value=f"{o.value[high, 0]:.6g} m",
                    limit=f"{HIGHEST_RANGE:.3g} m",
                    remedy="check the unit of the file",
                )
            _check_jumps(model, o, one_way)
        if o.kind == "azimuth_elevation":
            off = np.abs(o.value[:, 1]) > np.pi / 2 + 1e-9
            wide = np.abs(o.value[:, 0]) > 2 * np.pi + 1e-9
            if (off | wide).any():
                row = int(np.flatnonzero(off | wide)[0])
                raise UnitError(
                    "an angle is out of its range",
                    where=at(row),
                    value=f"azimuth {np.degrees(o.value[row, 0]):.6g}, elevation "
                    f"{np.degrees(o.value[row, 1]):.6g} degrees",
                    limit="360 and 90 degrees",
                )
        if o.kind == "direction_cosines" and (np.sum(o.value**2, axis=1) > 1.02).any():
            raise UnitError("direction cosines exceed unit length", where=place)
    _check_ranges_together(model)


def _check_stations(model: OrbitModel) -> None:
    for name in dict.fromkeys(n for o in model.tracking.observations for n in (o.receiver, o.transmitter)):
        place = model.station(name)
        for what, value, low, high, unit in (
            ("latitude", np.degrees(place.latitude), -90.0, 90.0, "degrees"),
            ("longitude", np.degrees(place.longitude), -360.0, 360.0, "degrees"),
            ("altitude", place.altitude, -500.0, 9000.0, "m"),
        ):
            if not low <= value <= high:
                raise GeometryError(
                    f"the {what} of station {name} is nowhere on the Earth",
                    where=name,
                    value=f"{value:.6g} {unit}",
                    limit=f"{low:g} to {high:g} {unit}",
                    remedy="check order and units of latitude, longitude and altitude",
                )


def _check_jumps(model: OrbitModel, o: Observations, one_way: np.ndarray) -> None:
    """A range below the Earth's radius that no motion leads to from the measurement before or after it.

    Such ranges are real for a satellite near its perigee, so the length alone proves nothing.
    """
    time = model.seconds(o.time)
    where = np.flatnonzero(one_way < EQUATORIAL_RADIUS)
    for row in where:
        beside = [i for i in (row - 1, row + 1) if 0 <= i < len(time)]
        reach = [abs(one_way[i] - one_way[row]) - FASTEST * abs(time[i] - time[row]) for i in beside]
        if reach and min(reach) > ALLOWANCE:
            raise GeometryError(
                "a range is below the Earth's radius and out of reach of the measurements before and after it",
                where=f"{o.source or 'data'}: {o.name}" + ("" if o.line is None else f", line {int(o.line[row])}"),
                value=f"{one_way[row] / 1e3:.3f} km one way",
                limit=f"about {one_way[beside[0]] / 1e3:.1f} km as its neighbour",
                remedy="correct or remove this measurement",
            )


def _check_ranges_together(model: OrbitModel) -> None:
    """Ranges below the Earth's radius for a high satellite, and pairs of ranges that break the triangle inequality."""
    s = model.settings
    legs = 2.0 if s.legs == "sum" else 1.0
    ranges = [o for o in model.tracking.observations if o.kind == "range" and o.receiver == o.transmitter]
    allowance = 100e3 + 20e3  # m: biases of equipment and motion between neighbouring time tags
    for i, a in enumerate(ranges):
        for b in ranges[i + 1 :]:
            ta, tb = model.seconds(a.time), model.seconds(b.time)
            index = np.clip(np.searchsorted(tb, ta), 1, max(len(tb) - 1, 1)) - 1
            near = np.where(
                np.abs(tb[index] - ta) <= np.abs(tb[np.minimum(index + 1, len(tb) - 1)] - ta),
                index,
                np.minimum(index + 1, len(tb) - 1),
            )
            gap = np.abs(tb[near] - ta)
            change = np.abs(a.value[:, 0] - b.value[near, 0]) / legs
            p, q = model.station(a.receiver), model.station(b.receiver)
            apart = float(
                np.linalg.norm(
                    station_position(p.latitude, p.longitude, p.altitude)
                    - station_position(q.latitude, q.longitude, q.altitude)
                )
            )
            broken = (gap < 5.0) & (change > apart + allowance)
            if broken.mean() > 0.5 and broken.sum() >= 3:
                row = int(np.flatnonzero(broken)[0])
                raise GeometryError(
                    f"ranges of {a.receiver} and {b.receiver} at one time differ by more than the stations are apart",
                    where=a.source,
                    value=f"{change[row] / 1e3:.1f} km",
                    limit=f"{apart / 1e3:.1f} km",
                    remedy="check the coordinates of both stations and the legs of the ranges",
                )


def predicted_elevations(model: OrbitModel) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Times (n,) and elevations (n,) rad of the starting orbit at every station's time tags (central field only)."""
    result = {}
    for o in model.tracking.observations:
        time = model.seconds(o.time)
        state = kepler(model.position, model.velocity, time)
        fixed = model.environment.earth_fixed_state(time, state)[:, :3]
        station = model.station(o.receiver)
        line = fixed - station_position(station.latitude, station.longitude, station.altitude)
        local = line @ east_north_up(station.latitude, station.longitude).T
        result[f"{o.name}/{o.kind}"] = (time, np.arctan2(local[:, 2], np.hypot(local[:, 0], local[:, 1])))
    return result


def kepler(position: np.ndarray, velocity: np.ndarray, time: np.ndarray) -> np.ndarray:
    """States (n, 6) of the two-body orbit through a state at time zero, at times (n,) s (universal variables).

    Source: Battin (1999), section 4.5.
    """
    mu = 3.986004418e14  # m3/s2
    r0, v0 = np.asarray(position, dtype=float), np.asarray(velocity, dtype=float)
    radius = float(np.linalg.norm(r0))
    radial = float(r0 @ v0) / np.sqrt(mu)
    alpha = 2 / radius - float(v0 @ v0) / mu
    time = np.asarray(time, dtype=float)
    chi = np.sqrt(mu) * np.abs(alpha) * time
    for _ in range(200):
        z = alpha * chi * chi
        c2, c3 = _stumpff(z)
        r = chi * chi * c2 + radial * chi * (1 - z * c3) + radius * (1 - z * c2)
        error = (chi**3 * c3 + radial * chi**2 * c2 + radius * chi * (1 - z * c3)) - np.sqrt(mu) * time
        step = error / r
        chi = chi - step
        if np.max(np.abs(step), initial=0.0) < 1e-8 * max(1.0, float(np.max(np.abs(chi), initial=1.0))):
            break
    z = alpha * chi * chi
    c2, c3 = _stumpff(z)
    f, g = 1 - chi**2 / radius * c2, time - chi**3 / np.sqrt(mu) * c3
    place = f[:, None] * r0 + g[:, None] * v0
    r = np.linalg.norm(place, axis=1)
    df, dg = np.sqrt(mu) / (r * radius) * chi * (z * c3 - 1), 1 - chi**2 / r * c2
    return np.column_stack([place, df[:, None] * r0 + dg[:, None] * v0])


def _stumpff(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    root = np.sqrt(np.abs(z))
    small = np.abs(z) < 1e-3
    safe = np.where(small, 1.0, z)
    with np.errstate(over="ignore"):
        positive = (1 - np.cos(root)) / safe, (root - np.sin(root)) / np.where(small, 1.0, root**3)
        negative = (
            (1 - np.cosh(np.minimum(root, 300))) / safe,
            (np.sinh(np.minimum(root, 300)) - root) / np.where(small, 1.0, root**3),
        )
    c2 = np.where(small, 1 / 2 - z / 24 + z * z / 720, np.where(z > 0, positive[0], negative[0]))
    c3 = np.where(small, 1 / 6 - z / 120 + z * z / 5040, np.where(z > 0, positive[1], negative[1]))
    return c2, c3


def _check_legs(model: OrbitModel) -> None:
    """Ranges that are about twice, half, or otherwise far from those of the starting orbit."""
    legs = 2.0 if model.settings.legs == "sum" else 1.0
    ratios: list[np.ndarray] = []
    for o in model.tracking.observations:
        if o.kind != "range" or o.receiver != o.transmitter:
            continue
        time = model.seconds(o.time)
        fixed = model.environment.earth_fixed_state(time, kepler(model.position, model.velocity, time))[:, :3]
        station = model.station(o.receiver)
        line = fixed - station_position(station.latitude, station.longitude, station.altitude)
        ratios.append(o.value[:, 0] / legs / np.linalg.norm(line, axis=1))
    if not ratios:
        return
    ratio = float(np.median(np.concatenate(ratios)))
    if not 0.6 < ratio < 1.6:
        raise UnitError(
            "the ranges do not fit the initial orbit: their length over that of the orbit's is far from one",
            value=f"median ratio {ratio:.4g}",
            limit="0.6 to 1.6",
            remedy="check whether ranges are half or the sum of both legs (measurements.range), their unit, and the "
            "initial orbit",
        )


def _misfits(model: OrbitModel) -> dict[str, float]:
    """How far (m, median over its measurements) each station's ranges and angles are from the starting orbit.

    Angles count by the distance across that they mean at the satellite.
    """
    legs = 2.0 if model.settings.legs == "sum" else 1.0
    found: dict[str, list[float]] = {}
    for o in model.tracking.observations:
        if o.receiver != o.transmitter or o.kind not in ("range", "azimuth_elevation"):
            continue
        time = model.seconds(o.time)
        fixed = model.environment.earth_fixed_state(time, kepler(model.position, model.velocity, time))[:, :3]
        place = model.station(o.receiver)
        line = fixed - station_position(place.latitude, place.longitude, place.altitude)
        length = np.linalg.norm(line, axis=1)
        if o.kind == "range":
            gap = np.abs((o.value[:, 0] - model.settings.onboard_range_bias) / legs - length)
        else:
            local = line / length[:, None] @ east_north_up(place.latitude, place.longitude).T
            azimuth, elevation = o.value.T
            seen = np.column_stack(
                [np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)]
            )
            gap = np.linalg.norm(seen - local, axis=1) * length
        found.setdefault(o.receiver, []).append(float(np.median(gap)))
    return {name: max(gaps) for name, gaps in found.items()}


def _check_places(model: OrbitModel) -> None:
    """One station far from the starting orbit while all others are near it stands elsewhere, or its clock is wrong."""
    misfit = _misfits(model)
    if len(misfit) < 3:
        return
    worst = max(misfit, key=lambda name: misfit[name])
    others = max(gap for name, gap in misfit.items() if name != worst)
    if misfit[worst] > max(_FAR_STATION, 10.0 * others):
        place = model.station(worst)
        raise GeometryError(
            f"the measurements of {worst} do not fit the initial orbit, while those of all other stations do",
            where=worst,
            value=f"{misfit[worst] / 1e3:.0f} km off",
            limit=f"{others / 1e3:.0f} km, the largest of the others",
            remedy=f"check latitude {np.degrees(place.latitude):.4f} and longitude {np.degrees(place.longitude):.4f} "
            "degrees of the station (east positive), and its clock",
        )


def check_start(model: OrbitModel) -> None:
    """Compare the data with the initial orbit that the user gave.

    Raises:
        GeometryError: a station never sees the satellite of that orbit, while it reports measurements, or one station
            alone is far from that orbit.
        UnitError: ranges about twice or half as long as that orbit's.
    """
    _check_legs(model)
    for name, (_, elevation) in predicted_elevations(model).items():
        station = name.split("/")[0]
        if len(elevation) and np.mean(elevation < _BELOW) > 0.5:
            others = [n for n, (_, e) in predicted_elevations(model).items() if np.mean(e < _BELOW) <= 0.5]
            if others or len(model.tracking.observations) == 1:
                place = model.station(station.split(">")[-1])
                raise GeometryError(
                    f"the satellite of the initial orbit is below the horizon of {station} at most of its measurements",
                    where=name,
                    value=f"median elevation {np.degrees(np.median(elevation)):.1f} degrees",
                    limit="above -5 degrees",
                    remedy=f"check latitude {np.degrees(place.latitude):.4f} and longitude "
                    f"{np.degrees(place.longitude):.4f} degrees of the station (east positive), the initial "
                    "orbit and the scale of the times",
                )
            raise GeometryError(
                "the satellite of the initial orbit is below the horizon of every station at most of the measurements",
                value=f"median elevation {np.degrees(np.median(elevation)):.1f} degrees at {station}",
                limit="above -5 degrees",
                remedy="check the initial orbit, its epoch and the scale of the times",
            )
    _check_places(model)


def suspicious_stations(model: OrbitModel, estimate: Estimate) -> list[str]:
    """Sentences about stations without which the others agree with one orbit.

    Each station is left out in turn, the rest is solved again (from the initial orbit where the data are short), and
    the station is named where that lowers the others' mean square at least a hundredfold, with how far its own data
    then are from that orbit. A station at a wrong place, or with a wrong clock, shows so. At most eight stations are
    tried.
    """
    from estimator.solvers import Options, solve
    from problems.geo_orbit.problem import orbit_problem

    stations = list(dict.fromkeys(o.name for o in model.tracking.observations))
    if not 3 <= len(stations) <= 8:
        return []
    sentences = []
    problem = estimate.problem
    # what a wrong station spoilt is no place to start from; over weeks the initial orbit is none either
    short = max(abs(t) for t in model.span) < _SHORT
    start = orbit_problem(model, problem.effects).start if short else problem.start
    with_all = {r.name: float(np.mean(p.whitened**2)) for r, p in zip(problem.residuals, estimate.parts, strict=True)}
    best: tuple[float, str, str] | None = None
    for name in stations:
        kept = [r for r in problem.residuals if r.name.split("/")[0] != name]
        before = float(np.mean([with_all[r.name] for r in kept]))
        if before <= 100.0:
            continue
        free = {u.name for r in kept for u in r.unknowns}
        part = problem.with_residuals(kept).holding(*(u.name for u in problem.free if u.name not in free))
        again = solve(part.starting_at(start), Options(iterations=25))
        after = float(np.mean([np.mean(p.whitened**2) for p in again.parts]))
        if after < 0.01 * before and (best is None or after < best[0]):
            left = [r for r in problem.residuals if r.name.split("/")[0] == name]
            gaps = [
                f"{np.sqrt(np.mean(r.linearize(again.values).residual ** 2)):.4g} {r.unit} in {r.channel}" for r in left
            ]
            best = (after, name, " and ".join(gaps))
    if best is not None:
        place = model.station(best[1].split(">")[-1])
        sentences.append(
            f"the other stations agree with one orbit, from which {best[1]} is off by {best[2]}: check its latitude "
            f"({np.degrees(place.latitude):.4f} degrees), longitude ({np.degrees(place.longitude):.4f} degrees, east "
            "positive), clock and bias"
        )
    return sentences


def shifted_times(model: OrbitModel, position: np.ndarray, velocity: np.ndarray) -> str:
    """A sentence where the solution is the initial orbit with all times shifted; empty where it is not.

    A common error of all time tags by ``d`` turns the orbit about the Earth's axis by the Earth's rotation in that time
    and moves the satellite along it: ``R(d) kepler(initial, -d)``. The data cannot tell that from another orbit, a
    given initial orbit can as far as it is good itself: the shift is said where it explains most of the distance and
    is five times what the rest of the distance allows.

    Args:
        model: with an initial orbit that the user gave.
        position, velocity: of the solution at the model's epoch, GCRS, m and m/s.
    """
    from scipy.optimize import minimize_scalar

    from estimator.models.earth_orientation import EARTH_ROTATION_RATE

    radius, speed = float(np.linalg.norm(model.position)), float(np.linalg.norm(model.velocity))

    def gaps(shift: np.ndarray) -> np.ndarray:
        state = kepler(model.position, model.velocity, -shift).reshape(-1, 2, 3)
        c, s = np.cos(EARTH_ROTATION_RATE * shift)[:, None], np.sin(EARTH_ROTATION_RATE * shift)[:, None]
        x, y, z = state[..., 0], state[..., 1], state[..., 2]
        off = np.stack([c * x - s * y, s * x + c * y, z], axis=-1) - [position, velocity]
        size = np.linalg.norm(off, axis=-1)
        return np.asarray(np.hypot(size[:, 0], size[:, 1] * radius / speed))

    def gap(shift: float) -> float:
        return float(gaps(np.array([shift]))[0])

    tried = np.arange(-_LONGEST_SHIFT, _LONGEST_SHIFT + 1, 60.0)
    nearest = float(tried[int(np.argmin(gaps(tried)))])
    best = minimize_scalar(gap, bounds=(nearest - 60.0, nearest + 60.0), method="bounded", options={"xatol": 1e-3})
    without = gap(0.0)
    rate = abs(gap(best.x + 60.0) ** 2 - best.fun**2) ** 0.5 / 60.0
    if rate <= 0.0 or best.fun > 0.25 * without:
        return ""
    doubt = float(best.fun) / rate
    if abs(best.x) < max(5.0 * doubt, 1.0):
        return ""
    way = "earlier" if best.x > 0 else "later"
    return (
        f"the solution is {without / 1e3:.0f} km away from the initial orbit, and {best.fun / 1e3:.0f} km with all "
        f"times {abs(best.x):.0f} s {way} (known to about {doubt:.0f} s): check the scale of the times (UTC, TAI, GPS, "
        "local)"
    )
