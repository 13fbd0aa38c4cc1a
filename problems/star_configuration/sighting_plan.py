"""Which stars to follow along an orbit: good at every moment, with few changes of star.

At every step the best choice is found (catalogue_selection.py). Changing stars costs an acquisition, so the stars
already followed stay while the criterion is within ``tolerance`` of the best; when it is not, stars are exchanged one
at a time, each time the exchange that helps most, until it is. Stars that stay in view for ``dwell`` seconds are
acquired first; a more fleeting one only where those do not reach the tolerance.

Sun, Moon and Earth limb are keep-out cones that move; their directions come from astropy (built-in ephemeris, no file
and no network), corrected for the position of the spacecraft.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.models.errors import FileFormatError, NotFiniteError, RequestError, ShapeError, TimeOrderError
from problems.star_configuration.catalogue_selection import (
    Camera,
    Candidates,
    Selection,
    Sky,
    _entries,
    attitude,
    criterion_values,
    select,
)
from problems.star_configuration.criteria import Criteria, criteria_of_information, unit_vectors
from problems.star_configuration.optimal_directions import KeepOut

EARTH_RADIUS = 6378137.0  # m
EARTH_GRAVITATIONAL_PARAMETER = 3.986004418e14  # m3/s2


@dataclass(frozen=True)
class SightingArc:
    """One star followed by one camera from ``start`` to ``end`` (s after the epoch of the plan)."""

    identifier: str
    name: str
    camera: str
    magnitude: float
    start: float
    end: float


@dataclass(frozen=True)
class SightingPlan:
    """A plan of sightings.

    Attributes:
        status: "ok", or "unobservable" if there are times without an attitude; ``why`` is the sentence.
        times: (T) s.
        followed: T tuples of (camera index, catalogue index).
        K0, K1: (T) criteria of the plan; ``best``: (T) the least value of the criterion asked for at that time.
        lower_bound: (T) no choice has less.
        arcs: what to follow and when, by start.
        acquisitions: stars taken up after the first step.
        axis_sigma: (T x 3) standard deviation about each body axis (unit of the cameras' sigma).
        dark: intervals (start, end) without an attitude.
    """

    status: str
    why: str
    times: np.ndarray
    followed: tuple[tuple[tuple[int, int], ...], ...] = field(repr=False)
    K0: np.ndarray
    K1: np.ndarray
    best: np.ndarray
    lower_bound: np.ndarray
    arcs: tuple[SightingArc, ...]
    acquisitions: int
    axis_sigma: np.ndarray
    dark: tuple[tuple[float, float], ...]

    def __str__(self) -> str:
        rows = [
            f"{a.camera:12s} {a.identifier:>8s} {a.name:16s} {a.magnitude:6.2f} {a.start:10.1f} {a.end:10.1f}"
            for a in self.arcs
        ]
        return "\n".join(
            [f"{self.status}: {self.why}", "camera           star name                mag  from [s]     to [s]", *rows]
        )


def circular_orbit(
    seconds: np.ndarray, *, altitude: float, inclination: float, node: float = 0.0, argument: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Position (T x 3, m) and velocity (T x 3, m/s), inertial, on a circular two-body orbit.

    Args:
        seconds: (T) after the epoch.
        altitude: above the equatorial radius (m).
        inclination, node: of the orbit (rad); ``argument``: angle from the node at the epoch (rad).

    Raises:
        RequestError: an altitude below 100 km or above 1e9 m.
    """
    if not 1e5 <= altitude <= 1e9:
        raise RequestError(
            "the altitude is out of range",
            where="altitude",
            value=f"{altitude:.6g} m",
            limit="1e5 to 1e9 m",
            remedy="give it in metres above the equatorial radius",
        )
    radius = EARTH_RADIUS + altitude
    rate = np.sqrt(EARTH_GRAVITATIONAL_PARAMETER / radius**3)
    u = argument + rate * np.asarray(seconds, dtype=float)
    plane = Rotation.from_euler("ZX", [node, inclination]).as_matrix()
    flat = np.column_stack((np.cos(u), np.sin(u), np.zeros_like(u)))
    along = np.column_stack((-np.sin(u), np.cos(u), np.zeros_like(u)))
    return radius * flat @ plane.T, radius * rate * along @ plane.T


def nadir_attitude(position: np.ndarray, velocity: np.ndarray) -> Rotation:
    """``inertial_from_body`` (T) with body z to the Earth's centre, y against the orbit normal, x forward."""
    z = -position / np.linalg.norm(position, axis=1)[:, None]
    y = -np.cross(position, velocity)
    y /= np.linalg.norm(y, axis=1)[:, None]
    return Rotation.from_matrix(np.stack((np.cross(y, z), y, z), axis=2))


def keep_outs_at(
    epoch: str,
    seconds: np.ndarray,
    position: np.ndarray,
    *,
    sun: float | None = np.radians(30.0),
    moon: float | None = np.radians(15.0),
    earth_margin: float | None = np.radians(10.0),
) -> list[tuple[KeepOut, ...]]:
    """The moving cones in inertial axes, for each time.

    Args:
        epoch: UTC in ISO form; ``seconds`` (T) after it.
        position: (T x 3, m) of the spacecraft, inertial axes at the Earth's centre.
        sun, moon: half-angles (rad) about them; None to leave out. ``earth_margin``: angle (rad) kept free above the
            Earth's limb; None to leave the Earth out.

    Raises:
        RequestError: an epoch that cannot be read, or a position inside the Earth.
    """
    cones: list[list[KeepOut]] = [[] for _ in seconds]
    distance = np.linalg.norm(position, axis=1)
    if earth_margin is not None:
        if np.any(distance <= EARTH_RADIUS):
            raise RequestError(
                "the position is inside the Earth",
                where="position",
                value=f"{distance.min():.6g} m",
                limit=f"{EARTH_RADIUS:.6g} m",
                remedy="give metres from the Earth's centre",
            )
        half = np.minimum(np.arcsin(EARTH_RADIUS / distance) + earth_margin, np.pi - 1e-6)
        for k in range(len(seconds)):
            cones[k].append(KeepOut(tuple(-position[k]), float(half[k]), "Earth limb"))
    for name, half_angle in (("sun", sun), ("moon", moon)):
        if half_angle is None:
            continue
        for k, direction in enumerate(_body_direction(name, epoch, np.asarray(seconds, dtype=float), position)):
            cones[k].append(KeepOut(tuple(direction), half_angle, name.capitalize()))
    return [tuple(c) for c in cones]


def _body_direction(body: str, epoch: str, seconds: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Directions (T x 3) from the spacecraft to the Sun or the Moon, GCRS axes."""
    import warnings

    from astropy.coordinates import get_body, solar_system_ephemeris
    from astropy.time import Time, TimeDelta
    from astropy.utils import iers

    try:
        start = Time(epoch, scale="utc")
    except ValueError as error:
        raise RequestError(
            f"the epoch cannot be read ({error})",
            where="epoch",
            value=epoch,
            remedy="write it in UTC as 2025-03-20T09:00:00",
        ) from None
    with warnings.catch_warnings(), iers.conf.set_temp("auto_download", False), solar_system_ephemeris.set("builtin"):
        # Years ahead of the last announced leap second are "dubious" to ERFA: a second does not move the Sun here.
        warnings.simplefilter("ignore")
        where = get_body(body, start + TimeDelta(seconds, format="sec")).cartesian.xyz.to_value("m").T
    line = where - position
    return line / np.linalg.norm(line, axis=1)[:, None]


def plan_sightings(
    sky: Sky,
    times: Any,
    inertial_from_body: Any,
    cameras: Sequence[Camera],
    count: int,
    *,
    keep_outs: Sequence[Sequence[KeepOut]] | None = None,
    criterion: str = "K0",
    axis: Any = (0.0, 0.0, 1.0),
    tolerance: float = 0.1,
    dwell: float = 0.0,
) -> SightingPlan:
    """Plan which stars to follow.

    Args:
        sky: the catalogue.
        times: (T) s, ascending.
        inertial_from_body: attitudes, Rotation of length T or quaternions (T x 4, scalar first).
        cameras, count: as in :func:`select`.
        keep_outs: T groups of cones in inertial axes; None for none.
        criterion, axis: as in :func:`select`.
        tolerance: the plan's criterion may exceed the best by this share before stars are changed; 0 follows the best.
        dwell: time (s) that a star should stay in view to be acquired; a wish, given up where the tolerance needs it.

    Raises:
        ShapeError, TimeOrderError, RequestError: arrays of different length, times not ascending, a negative tolerance.
    """
    t = np.asarray(times, dtype=float)
    if t.ndim != 1 or len(t) == 0:
        raise ShapeError(
            "times are one row of seconds", where="times", value=f"shape {t.shape}", limit="(T,), T at least 1"
        )
    if not np.all(np.isfinite(t)):
        raise NotFiniteError("a time is not finite", where="times")
    if np.any(np.diff(t) <= 0):
        raise TimeOrderError(
            "times do not ascend", where=f"times[{int(np.argmin(np.diff(t))) + 1}]", limit="strictly ascending"
        )
    if tolerance < 0 or dwell < 0:
        raise RequestError(
            "tolerance and dwell are not negative", where="plan", value=(tolerance, dwell), limit="0 or more"
        )
    rotations = (
        inertial_from_body
        if isinstance(inertial_from_body, Rotation)
        else Rotation.concatenate([attitude(q) for q in inertial_from_body])
    )
    if len(rotations) != len(t) or (keep_outs is not None and len(keep_outs) != len(t)):
        raise ShapeError(
            "one attitude and one group of cones are needed for each time",
            where="plan",
            value=f"{len(rotations)} attitudes",
            limit=f"{len(t)} times",
        )
    v = unit_vectors(axis, "axis")[0]
    weight = _entries(np.eye(3) - (np.outer(v, v) if criterion == "K1" else 0.0))
    seen = [sky.candidates(rotations[k], cameras, keep_outs[k] if keep_outs is not None else ()) for k in range(len(t))]
    keys = [list(zip(c.camera.tolist(), c.star.tolist(), strict=True)) for c in seen]
    last = _last_in_view(t, keys)

    followed: list[tuple[tuple[int, int], ...]] = []
    criteria: list[Criteria] = []
    best = np.full(len(t), np.inf)
    bound = np.full(len(t), np.inf)
    acquisitions = 0
    for k, candidates in enumerate(seen):
        optimum = select(candidates, count, criterion=criterion, axis=v)
        best[k], bound[k] = optimum.value, optimum.lower_bound
        # A star must stay until the dwell is over or the plan ends.
        until = min(t[k] + dwell, t[-1])
        lasting = np.array([last[k][key] >= until - 1e-9 for key in keys[k]], dtype=bool)
        before = set(followed[-1]) if followed else set()
        chosen = _follow(candidates, keys[k], before, optimum, count, weight, tolerance, lasting)
        now = tuple(keys[k][i] for i in chosen)
        acquisitions += len(set(now) - before) if k else 0
        followed.append(now)
        total = candidates.information[chosen].sum(axis=0) if len(chosen) else np.zeros(6)
        matrix = np.array(
            [[total[0], total[5], total[4]], [total[5], total[1], total[3]], [total[4], total[3], total[2]]]
        )
        criteria.append(criteria_of_information(matrix, v))
    K0 = np.array([c.K0 for c in criteria])
    K1 = np.array([c.K1 for c in criteria])
    sigma = np.array(
        [np.sqrt(np.diag(c.covariance)) if c.covariance is not None else np.full(3, np.inf) for c in criteria]
    )
    dark = _intervals(t, np.array([c.covariance is None for c in criteria]))
    arcs = _arcs(sky, cameras, t, followed)
    status = "unobservable" if dark else "ok"
    if dark:
        lost = ", ".join(f"{a:.6g} to {b:.6g} s" for a, b in dark[:5])
        lost += " and later" if len(dark) > 5 else ""
        why = f"no attitude from stars at {lost}: fewer than two separate stars are in view"
    else:
        value = K0 if criterion == "K0" else K1
        why = (
            f"{len(arcs)} arcs, {acquisitions} acquisitions after the first step; {criterion} is "
            f"{np.max(value / best) - 1:.3g} above "
            f"the best choice of the moment at most, {np.mean(value / best) - 1:.3g} on average"
        )
    return SightingPlan(status, why, t, tuple(followed), K0, K1, best, bound, arcs, acquisitions, sigma, dark)


def _last_in_view(t: np.ndarray, keys: list[list[tuple[int, int]]]) -> list[dict[tuple[int, int], float]]:
    """For each time and star in view then, the time until which it stays in view without a break."""
    result: list[dict[tuple[int, int], float]] = [{} for _ in keys]
    later: dict[tuple[int, int], float] = {}
    for k in range(len(keys) - 1, -1, -1):
        result[k] = {key: later.get(key, float(t[k])) for key in keys[k]}
        later = result[k]
    return result


def _follow(
    candidates: Candidates,
    keys: list[tuple[int, int]],
    before: set[tuple[int, int]],
    optimum: Selection,
    count: int,
    weight: np.ndarray,
    tolerance: float,
    lasting: np.ndarray,
) -> np.ndarray:
    """Indices to follow: keep what is good enough, change as little as the tolerance needs."""
    n = len(keys)
    quotas = np.array(candidates.quotas)
    size = len(optimum.chosen)
    old = np.array([key in before for key in keys], dtype=bool) if n else np.zeros(0, dtype=bool)
    if size < 2 or (not old.any() and bool(np.all(lasting[optimum.chosen]))):
        return optimum.chosen
    information = candidates.information
    inside = old.copy()
    usable = old | lasting
    small = 1e-3 * float(information[:, :3].mean()) * np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    for allowed in (usable, np.ones(n, dtype=bool)):  # the fleeting ones only where the lasting ones do not suffice
        while inside.sum() < size:
            room = np.bincount(candidates.camera[inside], minlength=len(quotas)) < quotas
            free = np.flatnonzero(~inside & allowed & room[candidates.camera])
            if len(free) == 0:
                break
            total = information[inside].sum(axis=0) + small
            inside[free[int(np.argmin(criterion_values(total + information[free], weight)))]] = True
    limit = optimum.value * (1 + tolerance)
    for allowed in (usable, np.ones(n, dtype=bool)):
        for _ in range(4 * count):
            total = information[inside].sum(axis=0)
            value = float(criterion_values(total, weight))
            if value <= limit * (1 + 1e-12):
                return np.flatnonzero(inside)
            ins, outs = np.flatnonzero(inside), np.flatnonzero(~inside & allowed)
            if len(outs) == 0:
                break
            trial = criterion_values(total - information[ins][:, None, :] + information[outs][None, :, :], weight)
            room = np.bincount(candidates.camera[inside], minlength=len(quotas)) < quotas
            same = candidates.camera[ins][:, None] == candidates.camera[outs][None, :]
            trial = np.where(same | room[candidates.camera[outs]][None, :], trial, np.inf)
            i, j = divmod(int(np.argmin(trial)), len(outs))
            if not trial[i, j] < value * (1 - 1e-12):
                break
            inside[ins[i]], inside[outs[j]] = False, True
    total = information[inside].sum(axis=0)
    if float(criterion_values(total, weight)) <= limit * (1 + 1e-12):
        return np.flatnonzero(inside)
    return optimum.chosen


def _intervals(t: np.ndarray, mask: np.ndarray) -> tuple[tuple[float, float], ...]:
    """Start and end times of the runs where ``mask`` holds."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], mask.astype(int), [0]))))
    return tuple((float(t[a]), float(t[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True))


def _arcs(
    sky: Sky, cameras: Sequence[Camera], t: np.ndarray, followed: list[tuple[tuple[int, int], ...]]
) -> tuple[SightingArc, ...]:
    """The runs of each followed star."""
    catalogue = sky.catalogue
    arcs = []
    for camera, star in sorted({key for step in followed for key in step}):
        mask = np.array([(camera, star) in step for step in followed])
        for start, end in _intervals(t, mask):
            until = float(
                t[min(int(np.searchsorted(t, end)) + 1, len(t) - 1)]
            )  # followed until the next step takes over
            arcs.append(
                SightingArc(
                    str(catalogue.identifier[star]),
                    str(catalogue.name[star]),
                    cameras[camera].name,
                    float(catalogue.magnitude[star]),
                    start,
                    until,
                )
            )
    return tuple(sorted(arcs, key=lambda a: (a.start, a.camera, a.identifier)))


def read_plan_request(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a plan request (TOML): orbit, duration, cameras; see docs/stars.md for the keys.

    Raises:
        FileFormatError: not there or not TOML. RequestError: an unknown or missing key.
    """
    file = Path(path)
    try:
        content = tomllib.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise FileFormatError("there is no such file", where=str(file)) from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise FileFormatError(f"not a TOML file ({error})", where=str(file)) from None
    known = {
        "epoch",
        "altitude_km",
        "inclination_deg",
        "node_deg",
        "argument_deg",
        "duration_s",
        "step_s",
        "attitude",
        "sun_deg",
        "moon_deg",
        "earth_margin_deg",
        "tolerance",
        "dwell_s",
        "camera",
    }
    for name in content:
        if name not in known:
            raise RequestError("unknown key", where=f"{file}, {name}", limit=", ".join(sorted(known)))
    for name in ("epoch", "altitude_km", "inclination_deg", "camera"):
        if name not in content:
            raise RequestError("a key is missing", where=f"{file}", value=name, remedy="add it")
    return content


def plan_from_request(
    sky: Sky, request: dict[str, Any], count: int, *, criterion: str = "K0", axis: Any = (0.0, 0.0, 1.0)
) -> tuple[SightingPlan, tuple[Camera, ...]]:
    """The plan of a request of :func:`read_plan_request` (units in the names of its keys)."""
    radius = (EARTH_RADIUS + 1e3 * float(request["altitude_km"])) if float(request["altitude_km"]) > 0 else EARTH_RADIUS
    period = 2 * np.pi * np.sqrt(radius**3 / EARTH_GRAVITATIONAL_PARAMETER)
    duration, step = float(request.get("duration_s", period)), float(request.get("step_s", 30.0))
    if not (duration > 0 and step > 0 and duration / step <= 100_000):
        raise RequestError(
            "duration and step are out of range",
            where="duration_s, step_s",
            value=(duration, step),
            limit="positive, at most 100000 steps",
        )
    seconds = np.arange(0.0, duration + 1e-9 * step, step)
    position, velocity = circular_orbit(
        seconds,
        altitude=1e3 * float(request["altitude_km"]),
        inclination=np.radians(float(request["inclination_deg"])),
        node=np.radians(float(request.get("node_deg", 0.0))),
        argument=np.radians(float(request.get("argument_deg", 0.0))),
    )
    wish = request.get("attitude", "nadir")
    rotations = (
        nadir_attitude(position, velocity) if wish == "nadir" else Rotation.concatenate([attitude(wish)] * len(seconds))
    )
    cameras = tuple(
        Camera(
            tuple(c["boresight"]),
            np.radians(float(c.get("field_of_view_deg", 20.0))) / 2,
            float(c.get("magnitude_limit", 5.0)),
            c.get("stars"),
            name=str(c.get("name", f"camera {i + 1}")),
        )
        for i, c in enumerate(request["camera"])
    )

    def radians(name: str, default: float) -> float:
        return float(np.radians(float(request.get(name, default))))

    cones = keep_outs_at(
        str(request["epoch"]),
        seconds,
        position,
        sun=radians("sun_deg", 30.0),
        moon=radians("moon_deg", 15.0),
        earth_margin=radians("earth_margin_deg", 10.0),
    )
    plan = plan_sightings(
        sky,
        seconds,
        rotations,
        cameras,
        count,
        keep_outs=cones,
        criterion=criterion,
        axis=axis,
        tolerance=float(request.get("tolerance", 0.1)),
        dwell=float(request.get("dwell_s", 0.0)),
    )
    return plan, cameras
