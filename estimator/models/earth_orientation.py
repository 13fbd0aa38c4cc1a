"""Time scales and the orientation of the Earth: IERS Conventions 2010 with the Earth orientation that is installed.

Instants are ``numpy.datetime64`` in microseconds on the uniform scale TAI, so that differences are exact seconds also
across a leap second; UTC stands only in text. Nothing is downloaded: the IERS bulletin that comes with
``astropy-iers-data`` is read (from 1992 to about one year after the package's date).

Source: IERS Conventions (2010), chapter 5: precession and nutation IAU 2006/2000A, Earth rotation angle, polar motion
(through ``erfa.c2t06a``). ``celestial`` is GCRS, which differs from the mean equator and equinox of J2000 by the frame
bias of 0.02 arc seconds (0.1 microradian).
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import lru_cache

import numpy as np

from estimator.models.errors import FileFormatError, InputError

EARTH_ROTATION_RATE = 7.292115146706979e-5
"""Derivative of the Earth rotation angle by UT1, rad/s (IERS Conventions 2010, equation 5.15)."""

_J2000 = np.datetime64("2000-01-01T12:00:00", "us")
_J2000_JULIAN_DATE = 2451545.0  # [day]
_TT_MINUS_TAI = 32.184  # [s]
_DAY = 86400.0  # [s]
_HELD = 400.0  # [day] how long the last known Earth orientation is held beyond the bulletin

_UTC = re.compile(r"(?:UTC=)?\s*(\d{4})-(\d{2})-(\d{2})[T ](\d{2}):(\d{2}):(\d{2}(?:\.\d*)?)\s*Z?")


def tai_from_utc(texts: Iterable[str]) -> np.ndarray:
    """Instants from UTC texts in ISO 8601 (``2016-12-31T23:59:60.5``, ``Z`` and ``UTC=`` are allowed).

    Args:
        texts: n texts.

    Returns:
        (n,) datetime64[us], TAI.

    Raises:
        FileFormatError: a text is no date and time.
    """
    import erfa

    whole, seconds, offsets = [], [], []
    known: dict[tuple[int, int, int], float] = {}
    for text in texts:
        found = _UTC.fullmatch(text.strip())
        if found is None:
            raise FileFormatError(
                "this is no UTC date and time", value=repr(text), limit="such as 2021-06-04T08:22:13.5"
            )
        year, month, day, hour, minute = (int(found[i]) for i in range(1, 6))
        try:
            date = np.datetime64(f"{year:04d}-{month:02d}-{day:02d}T{hour:02d}:{minute:02d}", "us")
        except ValueError as error:
            raise FileFormatError("this is no UTC date and time", value=repr(text)) from error
        key = (year, month, day)
        if key not in known:
            with _future_allowed():
                known[key] = float(erfa.dat(year, month, day, 0.0))
        whole.append(date)
        seconds.append(float(found[6]))
        offsets.append(known[key])
    micro = np.round((np.array(seconds) + np.array(offsets)) * 1e6).astype("timedelta64[us]")
    return np.array(whole, dtype="datetime64[us]") + micro


def utc_text(tai: np.datetime64) -> str:
    """The UTC text of one instant, in ISO 8601 with microseconds where there are any, and a trailing Z."""
    import erfa

    days, fraction = _julian_date(np.array([tai]))
    with _future_allowed():
        year, month, day, clock = erfa.d2dtf("UTC", 6, *erfa.taiutc(days, fraction))
    h, m, s, f = (int(clock[name][0]) for name in ("h", "m", "s", "f"))
    text = f"{int(year[0]):04d}-{int(month[0]):02d}-{int(day[0]):02d}T{h:02d}:{m:02d}:{s:02d}"
    return f"{text}.{f:06d}Z" if f else f"{text}Z"


def _julian_date(tai: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two-part TAI Julian date."""
    days = (tai.astype("datetime64[us]") - _J2000) / np.timedelta64(1, "us") / 1e6 / _DAY
    return np.full(days.shape, _J2000_JULIAN_DATE), days


@contextmanager
def _future_allowed() -> Iterator[None]:
    """Without the warning that leap seconds of years to come are not known."""
    import erfa

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", erfa.ErfaWarning)
        yield


@lru_cache(maxsize=1)
def _bulletin() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Modified Julian date (UTC), UT1 minus TAI (s), and the pole (rad) of the installed IERS bulletin A."""
    import erfa
    from astropy.utils import iers

    table = iers.IERS_A.open(iers.IERS_A_FILE)
    date = np.asarray(table["MJD"].value, dtype=float)
    known = np.isfinite(np.asarray(table["UT1_UTC"].value, dtype=float))
    date = date[known]
    year, month, day, _ = erfa.jd2cal(2400000.5, date)
    with _future_allowed():
        offset = erfa.dat(year, month, day, 0.0)
    arc_second = np.pi / 180 / 3600  # [rad]
    return (
        date,
        np.asarray(table["UT1_UTC"].value, dtype=float)[known] - offset,
        np.asarray(table["PM_x"].value, dtype=float)[known] * arc_second,
        np.asarray(table["PM_y"].value, dtype=float)[known] * arc_second,
    )


def _orientation(tai: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """UT1 minus TAI (s) and the pole (rad)."""
    import erfa

    date, offset, x, y = _bulletin()
    with _future_allowed():
        one, two = erfa.taiutc(*_julian_date(tai))
    when = (one - 2400000.5) + two
    if when.size and (when.min() < date[0] or when.max() > date[-1] + _HELD):
        worst = when.min() if when.min() < date[0] else when.max()
        raise InputError(
            "the Earth's orientation is not known for this date",
            value=f"modified Julian date {worst:.1f}",
            limit=f"{date[0]:.0f} to {date[-1] + _HELD:.0f}",
            remedy="update the package astropy-iers-data",
        )
    return np.interp(when, date, offset), np.interp(when, date, x), np.interp(when, date, y)


def earth_fixed_from_celestial(tai: np.ndarray, *, polar_motion: bool = True, ut1: bool = True) -> np.ndarray:
    """Rotation matrices from GCRS to the terrestrial frame (ITRS).

    Args:
        tai: (n,) datetime64[us], TAI.
        polar_motion: False leaves it out (up to 2 microradians), as simpler processors do.
        ut1: False takes UTC in its place (up to 0.9 s or 66 microradians), as simpler processors do.

    Returns:
        (n, 3, 3), with ``v_earth_fixed = matrix @ v_celestial`` (directions; the Earth's rotation is not in it).

    Raises:
        InputError: the installed bulletin does not reach the date.
    """
    import erfa

    ut1_minus_tai, x, y = _orientation(tai)
    days, fraction = _julian_date(tai)
    if not ut1:  # UTC lies a whole number of seconds behind TAI
        with _future_allowed():
            one, two = erfa.taiutc(days, fraction)
        ut1_minus_tai = np.round(((one - days) + (two - fraction)) * _DAY)
    if not polar_motion:
        x, y = np.zeros_like(x), np.zeros_like(y)
    return erfa.c2t06a(days, fraction + _TT_MINUS_TAI / _DAY, days, fraction + ut1_minus_tai / _DAY, x, y)


def earth_rotation_angle(tai: np.datetime64) -> float:
    """Earth rotation angle (rad, 0 to 2 pi) at one instant (IERS Conventions 2010, equation 5.15)."""
    import erfa

    instant = np.array([tai])
    days, fraction = _julian_date(instant)
    return float(erfa.era00(days, fraction + _orientation(instant)[0] / _DAY)[0])
