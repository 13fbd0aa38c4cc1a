"""GMAT measurement data (``.gmd``): ``day Range 9002 station satellite value`` records.

The day count is the modified Julian date less 30000 (UTC), or the modified Julian date itself; the value of a two-way
range is the sum of both legs in kilometres.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from estimator.models.errors import FileFormatError
from problems.geo_orbit.tracking import Observations, Tracking

_MJD_LESS = 30000.0  # [day]
_SPAN = (36000.0, 80000.0)  # [day] modified Julian dates of the space age


def read_gmd(path: Path) -> Tracking:
    """Observations of a ``.gmd`` file.

    Raises:
        FileFormatError: a record cannot be read, or its day is outside the space age.
    """
    rows: dict[tuple[str, str], list[tuple[float, float, int]]] = {}
    satellites = set()
    for number, line in enumerate(path.read_text(errors="replace").splitlines(), 1):
        words = line.split("#", 1)[0].split("%", 1)[0].split()
        if not words:
            continue
        try:
            day, kind, station, satellite, value = float(words[0]), words[1], words[3], words[4], float(words[5])
        except (IndexError, ValueError) as error:
            raise FileFormatError(
                "this is no record 'day Range 9002 station satellite km'",
                where=f"{path}:{number}",
                value=line.strip()[:80],
            ) from error
        if kind.lower() not in ("range", "range_km", "gn_range"):
            raise FileFormatError(
                "this kind of record is not known", where=f"{path}:{number}", value=kind, limit="Range"
            )
        satellites.add(satellite)
        rows.setdefault((station, satellite), []).append((day, value, number))
    if not rows:
        raise FileFormatError("the file holds no measurements", where=str(path))
    if len(satellites) > 1:
        raise FileFormatError(
            "the file holds more than one satellite",
            where=str(path),
            value=", ".join(sorted(satellites)),
            remedy="split it by satellite",
        )
    observations = []
    for (station, _), entries in rows.items():
        days = np.array([e[0] for e in entries])
        mjd = days + _MJD_LESS if np.median(days) < _SPAN[0] else days
        if mjd.min() < _SPAN[0] or mjd.max() > _SPAN[1]:
            raise FileFormatError(
                "this day count is no modified Julian date (less 30000)",
                where=str(path),
                value=f"{days.min():.3f} to {days.max():.3f}",
                limit=f"{_SPAN[0]:.0f} to {_SPAN[1]:.0f}",
            )
        order = np.argsort(mjd, kind="stable")
        observations.append(
            Observations(
                "range",
                station,
                station,
                tai_from_mjd(mjd)[order],
                1e3 * np.array([[e[1]] for e in entries])[order],
                path.name,
                np.array([e[2] for e in entries])[order],
            )
        )
    return Tracking(tuple(observations), settings={"measurements": {"range": "sum"}}, satellite=next(iter(satellites)))


def tai_from_mjd(mjd: np.ndarray) -> np.ndarray:
    """datetime64[us] TAI of modified Julian dates (UTC)."""
    from estimator.models.orbit_environment import tai_minus_utc

    whole = np.floor(mjd)
    micro = np.round((mjd - whole) * 86400e6 + tai_minus_utc(whole) * 1e6).astype("timedelta64[us]")
    start = np.datetime64("1858-11-17T00:00:00", "us")
    return start + whole.astype(int).astype("timedelta64[D]").astype("timedelta64[us]") + micro
