"""The tracking files of the W3B case: ``.aer`` (ranges, azimuth and elevation) and its ``.in`` key = value settings.

A line of the first is ``UTC RANGE station km`` or ``UTC AZ_EL station azimuth elevation`` (degrees); the second holds
orbit, force models and stations as ``key [index] = value``.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from estimator.models.earth_orientation import tai_from_utc
from estimator.models.errors import FileFormatError
from problems.geo_orbit.tracking import Observations, Station, Tracking

_DEGREE = np.pi / 180  # [rad]


def read_aer(path: Path) -> Tracking:
    """Observations of an ``.aer`` file.

    Raises:
        FileFormatError: a line is neither of the two.
    """
    rows: dict[tuple[str, str], list[tuple[str, tuple[float, ...], int]]] = {}
    for number, line in enumerate(path.read_text(errors="replace").splitlines(), 1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        sizes = {"RANGE": 1, "AZ_EL": 2}
        try:
            kind, station, values = words[1], words[2], tuple(float(w) for w in words[3:])
            if len(values) != sizes[kind]:
                raise ValueError(kind)
        except (IndexError, ValueError, KeyError) as error:
            raise FileFormatError(
                "this line is neither a RANGE (km) nor an AZ_EL (degrees) record",
                where=f"{path}:{number}",
                value=line.strip()[:80],
            ) from error
        rows.setdefault((kind, station), []).append((words[0], values, number))
    if not rows:
        raise FileFormatError("the file holds no measurements", where=str(path))
    observations = []
    for (kind, station), entries in rows.items():
        try:
            time = tai_from_utc([e[0] for e in entries])
        except FileFormatError as error:
            raise FileFormatError(error.what, where=str(path), value=error.value, limit=error.limit) from error
        scale = 1e3 if kind == "RANGE" else _DEGREE
        order = np.argsort(time, kind="stable")
        observations.append(
            Observations(
                "range" if kind == "RANGE" else "azimuth_elevation",
                station,
                station,
                time[order],
                scale * np.array([e[1] for e in entries])[order],
                path.name,
                np.array([e[2] for e in entries])[order],
            )
        )
    return Tracking(tuple(observations))


def read_orbit_determination_input(path: Path) -> Tracking:
    """Stations and settings of an ``.in`` file; measurement files and bulletins beside it are named in the settings.

    Raises:
        FileFormatError: a line is not ``key = value``, or a number cannot be read.
    """
    single: dict[str, str] = {}
    lists: dict[str, dict[int, str]] = {}
    for number, line in enumerate(path.read_text(errors="replace").splitlines(), 1):
        text = line.split("#", 1)[0].strip().rstrip(";")
        if not text:
            continue
        found = re.fullmatch(r"([\w.]+)\s*(?:\[(\d+)\])?\s*=\s*(.*)", text)
        if found is None:
            raise FileFormatError("this line is not key = value", where=f"{path}:{number}", value=text[:80])
        key, index, value = found[1].lower().replace("_", "."), found[2], found[3].strip()
        if index is None:
            single[key] = value
        else:
            lists.setdefault(key, {})[int(index)] = value
    if "orbit.date" not in single or "ground.station.name" not in lists:
        raise FileFormatError(
            "no orbit.date or no ground.station.name: this is no orbit determination input", where=str(path)
        )

    def number_of(key: str, default: float = 0.0, index: int | None = None) -> float:
        text = single.get(key) if index is None else lists.get(key, {}).get(index)
        if text is None:
            return default
        try:
            return float(text)
        except ValueError as error:
            raise FileFormatError("this is no number", where=f"{path}: {key}", value=text) from error

    def true(key: str, index: int | None = None) -> bool:
        text = single.get(key, "false") if index is None else lists.get(key, {}).get(index, "false")
        return text.lower() == "true"

    stations: dict[str, Station] = {}
    for i, name in sorted(lists["ground.station.name"].items()):
        g = "ground.station."
        biases = (["range"] if true(g + "range.bias.estimated", i) else []) + (
            ["azimuth", "elevation"] if true(g + "az.el.biases.estimated", i) else []
        )
        stations[name] = Station(
            name,
            number_of(g + "latitude", index=i) * _DEGREE,
            number_of(g + "longitude", index=i) * _DEGREE,
            number_of(g + "altitude", index=i),
            {
                "range": number_of(g + "range.sigma", 20.0, i),
                "azimuth": number_of(g + "azimuth.sigma", 0.02, i) * _DEGREE,
                "elevation": number_of(g + "elevation.sigma", 0.02, i) * _DEGREE,
            },
            {
                "range": number_of(g + "range.bias", index=i),
                "azimuth": number_of(g + "azimuth.bias", index=i) * _DEGREE,
                "elevation": number_of(g + "elevation.bias", index=i) * _DEGREE,
            },
            tuple(biases),
        )
    first = min(stations, key=lambda n: list(stations).index(n))
    index = next(i for i, n in lists["ground.station.name"].items() if n == first)
    forces: dict[str, Any] = {
        "degree": int(number_of("central.body.degree", 0)),
        "order": int(number_of("central.body.order", 0)),
        "sun": true("third.body.sun"),
        "moon": true("third.body.moon"),
    }
    if true("solar.radiation.pressure"):
        forces["solar_radiation_pressure"] = {
            "coefficient": number_of("solar.radiation.pressure.cr", 2.0),
            "estimated": true("solar.radiation.pressure.cr.estimated"),
        }
    if true("drag"):
        forces["drag"] = {"coefficient": number_of("drag.cd", 2.0), "estimated": true("drag.cd.estimated")}
    polynomials = lists.get("polynomial.acceleration.name", {})
    if polynomials:
        terms = max(len(c.split(",")) for c in lists["polynomial.acceleration.coefficients"].values())
        forces["constant_acceleration"] = {
            "terms": min(terms, 2),
            "frame": "celestial",
            "estimated": any(v.lower() == "true" for v in lists.get("polynomial.acceleration.estimated", {}).values()),
        }
    settings: dict[str, Any] = {
        "satellite": {
            "mass_kg": number_of("mass", 1000.0),
            "area_m2": number_of("solar.radiation.pressure.area", number_of("drag.area", 10.0)),
        },
        "forces": forces,
        "orbit": {
            "epoch": single["orbit.date"],
            "frame": single.get("inertial.frame", "EME2000"),
            "position_m": [number_of(f"orbit.cartesian.p{a}") for a in "xyz"],
            "velocity_m_s": [number_of(f"orbit.cartesian.v{a}") for a in "xyz"],
        },
        "measurements": {
            "range": "half",
            "time_tag": "reception",
            "onboard_range_bias_m": number_of("onboard.range.bias"),
            "troposphere": true("ground.station.range.tropospheric.correction", index),
            "refraction": true("ground.station.elevation.refraction.correction", index),
            "rejection_sigmas": number_of("range.outlier.rejection.multiplier", 6.0),
        },
    }
    bulletins = sorted(path.parent.glob("bulletinb-*.txt"))
    if bulletins:
        settings["earth_orientation"] = {"bulletins": [str(b) for b in bulletins]}
    files = [w.strip() for w in single.get("measurements.files", "").split(",") if w.strip()]
    settings["files"] = {"measurements": [str(path.parent / f) for f in files]}
    return Tracking((), stations, settings)
