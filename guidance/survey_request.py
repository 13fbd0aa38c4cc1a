"""The request of a survey: what a TOML file may say, its defaults, and the checks on every value.

Inside, everything is in SI and radians; the keys of the file carry their units (``_m``, ``_km``, ``_deg``). Defaults
are those of the worked example: a sun-synchronous satellite at 720 km and an agile camera of 3.55 degrees.
"""

from __future__ import annotations

import difflib
import math
import os
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any

from estimator.models.errors import FileFormatError, NotFiniteError, RequestError

EARTH_RADIUS = 6378137.0  # m, equatorial
Point = tuple[float, float]
"""Geodetic latitude and longitude, rad."""
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class OrbitRequest:
    """Osculating elements at the epoch, in GCRF axes, or the pass over a point in place of two of them.

    Attributes:
        epoch: UTC, without a time zone.
        semi_major_axis: m.
        eccentricity: below 1.
        inclination, argument_of_perigee: rad.
        node, argument_of_latitude: rad; None where ``overhead`` gives the pass.
        overhead: the point near which the closest ground track passes at the epoch.
        ascending: the sense of flight of that pass.
        offset: distance of the track from the point, m; positive where the track is on the point's right.
    """

    epoch: datetime
    semi_major_axis: float = 7098137.0
    eccentricity: float = 0.0
    inclination: float = math.radians(98.27)
    argument_of_perigee: float = 0.0
    node: float | None = None
    argument_of_latitude: float | None = None
    overhead: Point | None = None
    ascending: bool = True
    offset: float = 0.0


@dataclass(frozen=True)
class CameraRequest:
    """The camera: full field across the scan (rad), and in body axes its line of sight and forward image direction."""

    field: float = math.radians(3.55)
    line_of_sight: Vector = (0.0, -1.0, 0.0)
    along: Vector = (1.0, 0.0, 0.0)


@dataclass(frozen=True)
class LimitsRequest:
    """Greatest lengths of rate (rad/s), acceleration (rad/s2), jerk (rad/s3); greatest angle off the nadir (rad)."""

    rate: float = math.radians(2.5)
    acceleration: float = math.radians(0.2)
    jerk: float = math.radians(0.1)
    off_nadir: float = math.radians(40.0)


@dataclass(frozen=True)
class AreaRequest:
    """A rectangle in the azimuthal equidistant plane of its centre (m, rad); ``scans`` None means as few as needed."""

    center: Point
    length: float
    width: float
    name: str = "area"
    azimuth: float | None = None
    overlap: float = 0.05
    scans: int | None = None
    image_motion: str = "constant"
    reversal: str = "detector"


@dataclass(frozen=True)
class RouteRequest:
    """A single scan of given start, length (m) and azimuth (rad; None: that of the ground track)."""

    name: str
    start: Point
    length: float
    azimuth: float | None = None
    when: str = "before"
    image_motion: str = "constant"


@dataclass(frozen=True)
class SurveyRequest:
    """Everything that a survey is planned from."""

    orbit: OrbitRequest
    camera: CameraRequest = field(default_factory=CameraRequest)
    limits: LimitsRequest = field(default_factory=LimitsRequest)
    image_rate: float = 9.3e-3  # rad/s, longitudinal image velocity over focal length
    areas: tuple[AreaRequest, ...] = ()
    routes: tuple[RouteRequest, ...] = ()


class _Table:
    """One table of the file: takes values out with checks, then complains about what is left."""

    def __init__(self, values: object, where: str):
        if not isinstance(values, Mapping):
            raise RequestError("a table is expected", where=where, value=type(values).__name__,
                               remedy=f"write {where} on a line of its own, then its keys")
        self.values, self.where, self.known = dict(values), where, list[str]()

    def has(self, key: str) -> bool:
        return key in self.values

    def place(self, key: str) -> str:
        return f"{self.where} {key}"

    def take(self, key: str, default: Any = None, *, required: bool = False) -> Any:
        self.known.append(key)
        if key in self.values:
            return self.values[key]
        if required:
            raise RequestError("a key is missing", where=self.place(key), remedy=f"add {key} = ... under {self.where}")
        return default

    def number(self, key: str, default: float | None = None, *, above: float | None = None, least: float | None = None,
               most: float | None = None, below: float | None = None, unit: str = "") -> float:
        value = self.take(key, default, required=default is None)
        return _number(value, self.place(key), above=above, least=least, most=most, below=below, unit=unit)

    def word(self, key: str, default: str | None, choices: tuple[str, ...] | None = None) -> str:
        value = self.take(key, default, required=default is None)
        if not isinstance(value, str) or not value.strip():
            raise RequestError("a word is expected", where=self.place(key), value=repr(value))
        if choices and value not in choices:
            raise RequestError("not one of the possible words", where=self.place(key), value=repr(value),
                               limit=" | ".join(choices), remedy=_nearest(value, choices))
        return value

    def point(self, key: str) -> Point:
        value = self.take(key, required=True)
        if not isinstance(value, list | tuple) or len(value) != 2:
            raise RequestError("a point is [latitude, longitude] in degrees", where=self.place(key), value=repr(value))
        latitude = _number(value[0], self.place(key) + "[0]", least=-90, most=90, unit="deg")
        longitude = _number(value[1], self.place(key) + "[1]", least=-360, most=360, unit="deg")
        if abs(latitude) > 89.99:
            raise RequestError("the poles have no azimuth", where=self.place(key) + "[0]", value=f"{latitude} deg",
                               limit="89.99 deg", remedy="move the point a kilometre off the pole")
        return math.radians(latitude), math.remainder(math.radians(longitude), 2 * math.pi)

    def vector(self, key: str, default: Vector) -> Vector:
        value = self.take(key, list(default))
        if not isinstance(value, list | tuple) or len(value) != 3:
            raise RequestError("a direction has three components", where=self.place(key), value=repr(value))
        x, y, z = (_number(v, f"{self.place(key)}[{i}]") for i, v in enumerate(value))
        length = math.sqrt(x * x + y * y + z * z)
        if length < 1e-9:
            raise RequestError("the direction has no length", where=self.place(key), value=repr(value), limit="above 0")
        return x / length, y / length, z / length

    def finish(self) -> None:
        for key in self.values:
            if key not in self.known:
                raise RequestError("unknown key", where=self.place(key), remedy=_nearest(key, tuple(self.known)))


def _nearest(word: str, choices: tuple[str, ...]) -> str:
    close = difflib.get_close_matches(word, choices, 1)
    return f"did you mean {close[0]}?" if close else "possible are " + ", ".join(choices)


def _number(value: object, where: str, *, above: float | None = None, least: float | None = None,
            most: float | None = None, below: float | None = None, unit: str = "") -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise RequestError("a number is expected", where=where, value=repr(value))
    number = float(value)
    if not math.isfinite(number):
        raise NotFiniteError("the number is not finite", where=where, value=value)
    shown = f"{number:g} {unit}".strip()
    for broken, words, limit in ((above is not None and number <= above, "above", above),
                                 (least is not None and number < least, "at least", least),
                                 (most is not None and number > most, "at most", most),
                                 (below is not None and number >= below, "below", below)):
        if broken:
            raise RequestError("the value is out of its range", where=where, value=shown,
                               limit=f"{words} {limit:g} {unit}".strip())
    return number


def _epoch(value: object, where: str) -> datetime:
    if isinstance(value, str):
        try:
            value = datetime.fromisoformat(value.strip())
        except ValueError:
            raise RequestError("the time is not of the form 2025-06-21T08:30:00Z", where=where,
                               value=repr(value)) from None
    if isinstance(value, date) and not isinstance(value, datetime):
        value = datetime(value.year, value.month, value.day)
    if not isinstance(value, datetime):
        raise RequestError("a UTC time is expected", where=where, value=repr(value),
                           remedy='write epoch = "2025-06-21T08:30:00Z"')
    if value.tzinfo is not None:
        value = value.astimezone(UTC).replace(tzinfo=None)
    if not 1972 <= value.year <= 2100:
        raise RequestError("UTC is known from 1972 on, the Earth's orientation for some years ahead", where=where,
                           value=value.isoformat(), limit="1972 to 2100")
    return value


def _orbit(table: _Table) -> OrbitRequest:
    epoch = _epoch(table.take("epoch", required=True), table.place("epoch"))
    axis = table.number("semi_major_axis_m", 7098137.0, least=6.4e6, most=5e7, unit="m")
    eccentricity = table.number("eccentricity", 0.0, least=0.0, below=1.0)
    perigee = axis * (1 - eccentricity) - EARTH_RADIUS
    if perigee < 100e3:
        raise RequestError("the perigee is inside the atmosphere or the Earth", where=table.place("eccentricity"),
                           value=f"{perigee / 1e3:.1f} km", limit="100 km above the equatorial radius",
                           remedy="raise semi_major_axis_m or lower eccentricity")
    inclination = math.radians(table.number("inclination_deg", 98.27, above=0.0, below=180.0, unit="deg"))
    perigee_argument = math.radians(table.number("argument_of_perigee_deg", 0.0, least=-360, most=360, unit="deg"))
    names = ("raan_deg", "argument_of_latitude_deg", "overhead", "pass", "offset_km")
    by_elements = [n for n in names[:2] if table.has(n)]
    by_pass = [n for n in names[2:] if table.has(n)]
    if by_elements and by_pass:
        raise RequestError("the pass is given twice", where=table.where, value=" and ".join(by_elements + by_pass),
                           remedy="give raan_deg with argument_of_latitude_deg, or overhead with pass")
    if by_elements:
        node = math.radians(table.number("raan_deg", least=-360, most=360, unit="deg"))
        latitude = math.radians(table.number("argument_of_latitude_deg", least=-360, most=360, unit="deg"))
        table.known.extend(names[2:])
        table.finish()
        return OrbitRequest(epoch, axis, eccentricity, inclination, perigee_argument, node, latitude)
    table.known.extend(names[:2])
    if "overhead" not in by_pass:
        raise RequestError("the pass is not given", where=table.where,
                           remedy="give raan_deg with argument_of_latitude_deg, or overhead = [lat, lon] with pass")
    point = table.point("overhead")
    sense = table.word("pass", "ascending", ("ascending", "descending"))
    offset = 1e3 * table.number("offset_km", 0.0, least=-3000, most=3000, unit="km")
    table.finish()
    return OrbitRequest(epoch, axis, eccentricity, inclination, perigee_argument, overhead=point,
                        ascending=sense == "ascending", offset=offset)


def _camera(table: _Table) -> CameraRequest:
    angle = math.radians(table.number("field_deg", 3.55, above=0.0, most=60.0, unit="deg"))
    sight, along = table.vector("line_of_sight", (0.0, -1.0, 0.0)), table.vector("along", (1.0, 0.0, 0.0))
    table.finish()
    lean = sum(a * b for a, b in zip(sight, along, strict=True))
    if abs(lean) > 1e-3:
        raise RequestError("along is not perpendicular to line_of_sight", where=table.place("along"),
                           value=f"{math.degrees(math.acos(max(-1, min(1, lean)))):.3f} deg", limit="90 deg",
                           remedy="give the body direction of the image's forward motion in the focal plane")
    rest = tuple(a - lean * s for a, s in zip(along, sight, strict=True))
    length = math.sqrt(sum(r * r for r in rest))
    return CameraRequest(angle, sight, (rest[0] / length, rest[1] / length, rest[2] / length))


def _limits(table: _Table) -> LimitsRequest:
    rate = table.number("rate_deg_s", 2.5, above=0.0, most=360.0, unit="deg/s")
    acceleration = table.number("acceleration_deg_s2", 0.2, above=0.0, most=360.0, unit="deg/s2")
    jerk = table.number("jerk_deg_s3", 0.1, above=0.0, most=3600.0, unit="deg/s3")
    off_nadir = table.number("off_nadir_deg", 40.0, above=0.0, below=75.0, unit="deg")
    table.finish()
    return LimitsRequest(*(math.radians(v) for v in (rate, acceleration, jerk, off_nadir)))


def _azimuth(table: _Table) -> float | None:
    if not table.has("azimuth_deg"):
        table.known.append("azimuth_deg")
        return None
    return math.radians(table.number("azimuth_deg", least=-360, most=360, unit="deg"))


def _area(table: _Table, default_name: str) -> AreaRequest:
    name = table.word("name", default_name)
    center = table.point("center")
    length = 1e3 * table.number("length_km", above=0.0, most=10000, unit="km")
    width = 1e3 * table.number("width_km", above=0.0, most=10000, unit="km")
    azimuth = _azimuth(table)
    overlap = 0.01 * table.number("overlap_percent", 5.0, least=0.0, most=60.0, unit="%")
    scans = table.take("scans", "auto")
    if scans == "auto":
        count = None
    elif isinstance(scans, int) and not isinstance(scans, bool) and 1 <= scans <= 100:
        count = scans
    else:
        raise RequestError('scans is "auto" or a number', where=table.place("scans"), value=repr(scans),
                           limit='"auto" or 1 to 100')
    motion = table.word("image_motion", "constant", ("constant", "equalised"))
    reversal = table.word("reversal", "detector", ("detector", "yaw"))
    table.finish()
    return AreaRequest(center, length, width, name, azimuth, overlap, count, motion, reversal)


def _route(table: _Table, default_name: str) -> RouteRequest:
    name = table.word("name", default_name)
    start = table.point("start")
    length = 1e3 * table.number("length_km", above=0.0, most=10000, unit="km")
    azimuth = _azimuth(table)
    when = table.word("when", "before", ("before", "after"))
    motion = table.word("image_motion", "constant", ("constant", "equalised", "along_track"))
    table.finish()
    return RouteRequest(name, start, length, azimuth, when, motion)


def survey_request(values: Mapping[str, Any], where: str = "request") -> SurveyRequest:
    """The checked request from the tables of a TOML file (or the same as dictionaries).

    Args:
        values: tables ``orbit``, ``camera``, ``limits``, ``image_motion`` and lists ``area``, ``route``.
        where: name of the file for messages.

    Raises:
        RequestError, NotFiniteError: a key is missing, unknown, of a wrong kind or out of its range.
    """
    tables = ("orbit", "camera", "limits", "image_motion", "area", "route")
    for key in values:
        if key not in tables:
            raise RequestError("unknown table", where=f"{where} [{key}]", remedy=_nearest(str(key), tables))
    if "orbit" not in values:
        raise RequestError("a table is missing", where=f"{where} [orbit]", remedy="add [orbit] with the epoch")

    def rows(key: str) -> list[object]:
        found = values.get(key, [])
        return list(found) if isinstance(found, list | tuple) else [found]

    def listed(key: str, read: Callable[[_Table, str], Any]) -> tuple[Any, ...]:
        found = rows(key)
        return tuple(read(_Table(row, f"{where} [[{key}]]" + (f" {i + 1}" if len(found) > 1 else "")),
                          key if len(found) == 1 else f"{key} {i + 1}") for i, row in enumerate(found))

    motion = _Table(values.get("image_motion", {}), f"{where} [image_motion]")
    rate = motion.number("rate_rad_s", 9.3e-3, above=0.0, most=1.0, unit="rad/s")
    motion.finish()
    request = SurveyRequest(_orbit(_Table(values["orbit"], f"{where} [orbit]")),
                            _camera(_Table(values.get("camera", {}), f"{where} [camera]")),
                            _limits(_Table(values.get("limits", {}), f"{where} [limits]")), rate,
                            listed("area", _area), listed("route", _route))
    if not request.areas and not request.routes:
        raise RequestError("nothing to survey", where=where, remedy="add an [[area]] or a [[route]]")
    return request


def read_survey_request(path: str | os.PathLike[str]) -> SurveyRequest:
    """The request in a TOML file.

    Raises:
        FileFormatError: the file is missing or no TOML.
        RequestError, NotFiniteError: see :func:`survey_request`.
    """
    file = Path(path)
    try:
        values = tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise FileFormatError("the request cannot be read", where=str(file), value=error.strerror or error) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise FileFormatError(f"the request is no TOML: {error}", where=str(file)) from None
    return survey_request(values, file.name)
