"""The settings of an orbit determination: one TOML file, checked whole, with units in the names of its keys.

Example: ``examples/w3b.toml``. Every table is optional but ``[[stations]]``; what a tracking file says about itself
(the stations of a ``.in`` file, the legs of a ``.gmd`` range) is taken where the TOML is silent.
"""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from estimator.models.errors import FileFormatError, MissingDataError, RequestError, UnitError
from estimator.models.orbit_motion import Burn
from problems.geo_orbit.tracking import Station

_DEGREE = np.pi / 180  # [rad]
DEFAULT_SIGMA = {
    "range": 10.0,
    "range_rate": 0.01,
    "azimuth": 0.02 * _DEGREE,
    "elevation": 0.02 * _DEGREE,
    "cosine_north": 5e-4,
    "cosine_east": 5e-4,
}
"""Standard deviation by component where neither file nor settings give one, SI."""

_KEYS: dict[str, tuple[str, ...]] = {
    "": (
        "title",
        "satellite",
        "orbit",
        "forces",
        "earth_orientation",
        "measurements",
        "stations",
        "burns",
        "files",
        "manoeuvres",
    ),
    "satellite": ("mass_kg", "area_m2"),
    "orbit": ("epoch", "frame", "position_m", "velocity_m_s", "tle", "sigma_position_m", "sigma_velocity_m_s"),
    "forces": (
        "gravity",
        "degree",
        "order",
        "sun",
        "moon",
        "solar_radiation_pressure",
        "drag",
        "constant_acceleration",
    ),
    "forces.solar_radiation_pressure": ("coefficient", "estimated"),
    "forces.drag": ("coefficient", "estimated"),
    "forces.constant_acceleration": ("terms", "frame", "estimated"),
    "earth_orientation": ("bulletins",),
    "measurements": (
        "range",
        "time_tag",
        "time_scale",
        "start",
        "stop",
        "onboard_range_bias_m",
        "troposphere",
        "refraction",
        "light_time",
        "rejection_sigmas",
        "estimate_biases",
        "range_sigma_m",
        "range_rate_sigma_m_s",
        "azimuth_sigma_deg",
        "elevation_sigma_deg",
        "cosine_sigma",
    ),
    "manoeuvres": ("detect", "times", "sigma_m_s"),
    "files": ("measurements",),
    "stations": (
        "name",
        "latitude_deg",
        "longitude_deg",
        "altitude_m",
        "range_sigma_m",
        "range_rate_sigma_m_s",
        "azimuth_sigma_deg",
        "elevation_sigma_deg",
        "range_bias_m",
        "range_rate_bias_m_s",
        "azimuth_bias_deg",
        "elevation_bias_deg",
        "estimate_biases",
    ),
    "burns": ("start", "stop", "acceleration_m_s2"),
}


@dataclass(frozen=True)
class OrbitSettings:
    """Checked settings.

    Attributes:
        title: for reports.
        mass, area: kg, m2.
        epoch: UTC text of the initial state; None takes the first measurement's time.
        frame: "EME2000", "GCRF" or "ITRF" of the initial state and of the answer.
        position, velocity: m, m/s, or None: found from the data.
        tle: two lines that start the search for the orbit, or None.
        gravity, degree, order: the gravity field.
        sun, moon: third bodies.
        reflection, drag: (coefficient, estimated), or None where the force is not in the model.
        acceleration: (terms, "celestial" | "orbital", estimated), or None.
        bulletins: IERS Bulletins B; empty takes the installed table.
        legs, time_tag, troposphere, refraction, light_time: see :class:`estimator.models.ranging.Signalling`.
        onboard_range_bias: m, subtracted from every range.
        rejection: sigmas beyond which a measurement is left out; infinite for none.
        estimate_biases: components whose bias is estimated at every station that does not say itself.
        sigma: standard deviation by component, SI.
        stations: by name.
        burns: commanded burns with times as UTC text.
        manoeuvre_times: UTC texts of velocity steps that are estimated; ``detect`` looks for more.
        detect_manoeuvres: whether velocity steps are looked for.
    """

    title: str = ""
    mass: float = 1000.0
    area: float = 10.0
    epoch: str | None = None
    frame: str = "EME2000"
    position: tuple[float, float, float] | None = None
    velocity: tuple[float, float, float] | None = None
    tle: tuple[str, str] | None = None
    gravity: str = "EGM2008_120"
    degree: int = 20
    order: int = 20
    sun: bool = True
    moon: bool = True
    reflection: tuple[float, bool] | None = None
    drag: tuple[float, bool] | None = None
    acceleration: tuple[int, str, bool] | None = None
    bulletins: tuple[str, ...] = ()
    legs: str = "half"
    time_tag: str = "reception"
    troposphere: bool = True
    refraction: bool = True
    light_time: bool = True
    onboard_range_bias: float = 0.0
    rejection: float = 6.0
    estimate_biases: tuple[str, ...] = ()
    sigma: Mapping[str, float] = field(default_factory=lambda: dict(DEFAULT_SIGMA))
    stations: Mapping[str, Station] = field(default_factory=dict)
    burns: tuple[tuple[str, str, tuple[float, float, float]], ...] = ()
    manoeuvre_times: tuple[str, ...] = ()
    detect_manoeuvres: bool | None = None

    def burns_after(self, seconds: Any) -> tuple[Burn, ...]:
        """The burns with times as seconds; ``seconds`` turns a UTC text into them."""
        return tuple(Burn(seconds(a), seconds(b), c) for a, b, c in self.burns)


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a settings file; paths inside are taken relative to it.

    Raises:
        FileFormatError: the file does not exist or is not TOML.
    """
    try:
        tables = tomllib.loads(path.read_text())
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError("the settings cannot be read", where=str(path), value=str(error)) from error
    except tomllib.TOMLDecodeError as error:
        raise FileFormatError("this is not TOML", where=str(path), value=str(error)) from error

    def beside(name: str) -> str:
        return name if Path(name).is_absolute() or Path(name).exists() else str(path.parent / name)

    orientation = tables.get("earth_orientation")
    if isinstance(orientation, dict) and isinstance(orientation.get("bulletins"), list):
        orientation["bulletins"] = [beside(str(b)) for b in orientation["bulletins"]]
    files = tables.get("files")
    if isinstance(files, dict) and isinstance(files.get("measurements"), list):
        files["measurements"] = [beside(str(b)) for b in files["measurements"]]
    gravity = tables.get("forces", {}).get("gravity") if isinstance(tables.get("forces"), dict) else None
    if isinstance(gravity, str) and gravity.endswith(".gfc"):
        tables["forces"]["gravity"] = beside(gravity)
    return tables


def _checked_keys(table: Mapping[str, Any], place: str) -> None:
    known = _KEYS[place]
    for key in table:
        if key not in known:
            near = difflib.get_close_matches(key, known, 1)
            raise RequestError(
                f"no setting is named {key!r}",
                where=f"[{place}]" if place else "settings",
                remedy=(f"did you mean {near[0]!r}?" if near else "choose from " + ", ".join(known)),
            )


def _table(tables: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    value: Any = tables
    for part in name.split("."):
        value = value.get(part, {}) if isinstance(value, Mapping) else {}
    if not isinstance(value, Mapping):
        raise RequestError("this must be a table", where=f"[{name}]", value=value)
    _checked_keys(value, name)
    return value


def _number(
    table: Mapping[str, Any], key: str, default: float, where: str, low: float = -np.inf, high: float = np.inf
) -> float:
    value = table.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise RequestError("this must be a number", where=f"{where} {key}", value=value)
    if not low <= value <= high:
        raise RequestError(
            "this is out of its range", where=f"{where} {key}", value=value, limit=f"{low:g} to {high:g}"
        )
    return float(value)


def _vector(table: Mapping[str, Any], key: str, where: str) -> tuple[float, float, float] | None:
    value = table.get(key)
    if value is None:
        return None
    if (
        not isinstance(value, list | tuple)
        or len(value) != 3
        or not all(isinstance(v, int | float) and np.isfinite(v) for v in value)
    ):
        raise RequestError("this must be three numbers", where=f"{where} {key}", value=value)
    return float(value[0]), float(value[1]), float(value[2])


def _choice(table: Mapping[str, Any], key: str, default: str, choices: tuple[str, ...], where: str) -> str:
    value = table.get(key, default)
    if value not in choices:
        raise RequestError(
            "this is none of the choices", where=f"{where} {key}", value=value, limit=" or ".join(choices)
        )
    return str(value)


def _station(entry: Mapping[str, Any]) -> Station:
    _checked_keys(entry, "stations")
    name = str(entry.get("name", ""))
    if not name:
        raise MissingDataError("a station has no name", where="[[stations]]")
    where = f"station {name}"
    for key in ("latitude_deg", "longitude_deg", "altitude_m"):
        if key not in entry:
            raise MissingDataError(f"{key} is missing", where=where)
    sigma, bias = {}, {}
    for component, key, unit in (
        ("range", "range_sigma_m", 1.0),
        ("range_rate", "range_rate_sigma_m_s", 1.0),
        ("azimuth", "azimuth_sigma_deg", _DEGREE),
        ("elevation", "elevation_sigma_deg", _DEGREE),
    ):
        if key in entry:
            sigma[component] = unit * _number(entry, key, 0.0, where, low=1e-12)
    for component, key, unit in (
        ("range", "range_bias_m", 1.0),
        ("range_rate", "range_rate_bias_m_s", 1.0),
        ("azimuth", "azimuth_bias_deg", _DEGREE),
        ("elevation", "elevation_bias_deg", _DEGREE),
    ):
        if key in entry:
            bias[component] = unit * _number(entry, key, 0.0, where)
    return Station(
        name,
        _number(entry, "latitude_deg", 0.0, where, -90, 90) * _DEGREE,
        _number(entry, "longitude_deg", 0.0, where, -360, 360) * _DEGREE,
        _number(entry, "altitude_m", 0.0, where, -500, 9000),
        sigma,
        bias,
        _components(entry.get("estimate_biases", ()), where),
    )


def _components(value: Any, where: str) -> tuple[str, ...]:
    names: list[str] = []
    for v in value:
        if v == "angles":
            names += ["azimuth", "elevation"]
        elif v in DEFAULT_SIGMA:
            names.append(v)
        else:
            raise RequestError(
                "no measurement is named so",
                where=f"{where} estimate_biases",
                value=v,
                limit="range, range_rate, angles, cosine_north, cosine_east",
            )
    return tuple(names)


def settings_from(tables: Mapping[str, Any], stations: Mapping[str, Station]) -> OrbitSettings:
    """Check the tables of a settings file, merged with what the tracking files say.

    Args:
        tables: nested tables as TOML gives them.
        stations: of the tracking files; those of the tables overrule them.

    Raises:
        RequestError: an unknown key, a value of the wrong type or out of its range.
        MissingDataError: a station without name or coordinates.
        UnitError: an initial position in kilometres.
    """
    _checked_keys(tables, "")
    satellite, orbit, forces = _table(tables, "satellite"), _table(tables, "orbit"), _table(tables, "forces")
    measurements, manoeuvres = _table(tables, "measurements"), _table(tables, "manoeuvres")
    known = dict(stations)
    entries = tables.get("stations", [])
    if not isinstance(entries, list):
        raise RequestError("stations must be a list of tables", where="[[stations]]")
    for entry in entries:
        station = _station(entry)
        known[station.name] = station
    position, velocity = _vector(orbit, "position_m", "[orbit]"), _vector(orbit, "velocity_m_s", "[orbit]")
    if position is not None:
        radius = float(np.linalg.norm(position))
        if radius < 6.4e6:
            raise UnitError(
                "the initial position is inside the Earth",
                where="[orbit] position_m",
                value=f"{radius:.6g} m",
                limit="at least 6.4e6 m",
                remedy="give metres, not kilometres",
            )
        if velocity is None:
            raise MissingDataError("an initial position needs an initial velocity", where="[orbit] velocity_m_s")
        if not 100 < float(np.linalg.norm(velocity)) < 12e3:
            raise UnitError(
                "the initial speed is no orbit's",
                where="[orbit] velocity_m_s",
                value=f"{np.linalg.norm(velocity):.6g} m/s",
                limit="100 to 12000 m/s",
            )
        if "epoch" not in orbit:
            raise MissingDataError("an initial state needs its epoch", where="[orbit] epoch")
    pressure = _table(tables, "forces.solar_radiation_pressure") if "solar_radiation_pressure" in forces else None
    air = _table(tables, "forces.drag") if "drag" in forces else None
    constant = _table(tables, "forces.constant_acceleration") if "constant_acceleration" in forces else None
    degree = int(_number(forces, "degree", 20, "[forces]", 0, 360))
    sigma = dict(DEFAULT_SIGMA)
    for component, key, unit in (
        ("range", "range_sigma_m", 1.0),
        ("range_rate", "range_rate_sigma_m_s", 1.0),
        ("azimuth", "azimuth_sigma_deg", _DEGREE),
        ("elevation", "elevation_sigma_deg", _DEGREE),
        ("cosine_north", "cosine_sigma", 1.0),
        ("cosine_east", "cosine_sigma", 1.0),
    ):
        if key in measurements:
            sigma[component] = unit * _number(measurements, key, 0.0, "[measurements]", low=1e-12)
    burns = []
    for i, burn in enumerate(tables.get("burns", [])):
        _checked_keys(burn, "burns")
        acceleration = _vector(burn, "acceleration_m_s2", f"burn {i + 1}")
        if acceleration is None or "start" not in burn or "stop" not in burn:
            raise MissingDataError("a burn needs start, stop and acceleration_m_s2", where=f"burn {i + 1}")
        burns.append((str(burn["start"]), str(burn["stop"]), acceleration))
    tle = orbit.get("tle")
    lines: tuple[str, str] | None = None
    if tle is not None:
        if not isinstance(tle, list) or len(tle) != 2:
            raise RequestError("a two-line element set is a list of two lines", where="[orbit] tle")
        lines = (str(tle[0]), str(tle[1]))
    scale = _choice(measurements, "time_scale", "file", ("file", "UTC", "TAI", "GPS", "TT"), "[measurements]")
    del scale  # applied to the observations by the reader of the files
    return OrbitSettings(
        title=str(tables.get("title", "")),
        mass=_number(satellite, "mass_kg", 1000.0, "[satellite]", 1e-3, 1e6),
        area=_number(satellite, "area_m2", 10.0, "[satellite]", 0.0, 1e5),
        epoch=str(orbit["epoch"]) if "epoch" in orbit else None,
        frame=_choice(orbit, "frame", "EME2000", ("EME2000", "GCRF", "ITRF"), "[orbit]"),
        position=position,
        velocity=velocity,
        tle=lines,
        gravity=str(forces.get("gravity", "EGM2008_120")),
        degree=degree,
        order=int(_number(forces, "order", degree, "[forces]", 0, degree)),
        sun=bool(forces.get("sun", True)),
        moon=bool(forces.get("moon", True)),
        reflection=None
        if pressure is None
        else (
            _number(pressure, "coefficient", 1.5, "[forces.solar_radiation_pressure]"),
            bool(pressure.get("estimated", False)),
        ),
        drag=None
        if air is None
        else (_number(air, "coefficient", 2.0, "[forces.drag]"), bool(air.get("estimated", False))),
        acceleration=None
        if constant is None
        else (
            int(_number(constant, "terms", 1, "[forces.constant_acceleration]", 1, 2)),
            _choice(constant, "frame", "celestial", ("celestial", "orbital"), "[forces.constant_acceleration]"),
            bool(constant.get("estimated", True)),
        ),
        bulletins=tuple(str(b) for b in _table(tables, "earth_orientation").get("bulletins", ())),
        legs=_choice(measurements, "range", "half", ("half", "sum"), "[measurements]"),
        time_tag=_choice(
            measurements, "time_tag", "reception", ("reception", "bounce", "transmission"), "[measurements]"
        ),
        troposphere=bool(measurements.get("troposphere", True)),
        refraction=bool(measurements.get("refraction", True)),
        light_time=bool(measurements.get("light_time", True)),
        onboard_range_bias=_number(measurements, "onboard_range_bias_m", 0.0, "[measurements]"),
        rejection=_number(measurements, "rejection_sigmas", 6.0, "[measurements]", low=2.0),
        estimate_biases=_components(measurements.get("estimate_biases", ()), "[measurements]"),
        sigma=sigma,
        stations=known,
        burns=tuple(burns),
        manoeuvre_times=tuple(str(t) for t in manoeuvres.get("times", ())),
        detect_manoeuvres=manoeuvres.get("detect"),
    )
