"""The Earth's orientation, the Sun and the Moon as smooth tables over the span of an orbit.

Instants are seconds after an epoch (``numpy.datetime64`` in microseconds, TAI). The orientation follows the IERS
Conventions (2010), chapter 5, in its CIO-based form, from a bulletin that the user gives or from the one installed
with astropy; Sun and Moon are ERFA's analytical series (``epv00``, ``moon98``), good to some arc seconds.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from estimator.models.earth_orientation import EARTH_ROTATION_RATE
from estimator.models.errors import FileFormatError, InputError

_J2000 = np.datetime64("2000-01-01T12:00:00", "us")
_DAY = 86400.0  # [s]
_TT_MINUS_TAI = 32.184  # [s]
_MJD_OF_J2000 = 51544.5  # [day]
_ARC_SECOND = np.pi / 180 / 3600  # [rad]
_ASTRONOMICAL_UNIT = 1.495978707e11  # [m]


@dataclass(frozen=True, eq=False)
class EarthOrientation:
    """A table of Earth orientation parameters.

    Attributes:
        date: (n,) modified Julian date, UTC, increasing.
        ut1_minus_tai: (n,) s.
        pole_x, pole_y: (n,) rad.
        offset_x, offset_y: (n,) rad, of the celestial pole from IAU 2006/2000A.
        source: for messages.
    """

    date: np.ndarray
    ut1_minus_tai: np.ndarray
    pole_x: np.ndarray
    pole_y: np.ndarray
    offset_x: np.ndarray
    offset_y: np.ndarray
    source: str


def tai_minus_utc(mjd: np.ndarray) -> np.ndarray:
    """Leap seconds TAI - UTC (n,) s at modified Julian dates (UTC)."""
    import warnings

    import erfa

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", erfa.ErfaWarning)
        year, month, day, _ = erfa.jd2cal(2400000.5, np.asarray(mjd, dtype=float))
        return np.asarray(erfa.dat(year, month, day, 0.0))


def installed_orientation(first: float, last: float) -> EarthOrientation:
    """The installed IERS table between two modified Julian dates, with some days around.

    Raises:
        InputError: the table does not reach these dates.
    """
    from astropy.utils import iers

    with iers.conf.set_temp("auto_download", False):
        table = iers.IERS_A.open(iers.IERS_A_FILE)
    date = np.asarray(table["MJD"].value, dtype=float)
    known = np.isfinite(np.asarray(table["UT1_UTC"].value, dtype=float))
    chosen = known & (date >= first - 6) & (date <= last + 6)
    if chosen.sum() < 2 or date[chosen][0] > first or date[chosen][-1] < last:
        raise InputError(
            "the Earth's orientation is not known for these dates",
            value=f"modified Julian date {first:.1f} to {last:.1f}",
            limit=f"{date[known][0]:.0f} to {date[known][-1]:.0f}",
            remedy="give a bulletin that covers the data, or update the package astropy-iers-data",
        )
    date = date[chosen]

    def column(name: str, scale: float) -> np.ndarray:
        values = np.asarray(table[name].value, dtype=float)[chosen] * scale
        return np.where(np.isfinite(values), values, 0.0)

    import astropy.units as u

    unit = float(table["dX_2000A"].unit.to(u.arcsec))
    return EarthOrientation(
        date,
        column("UT1_UTC", 1.0) - tai_minus_utc(date),
        column("PM_x", _ARC_SECOND),
        column("PM_y", _ARC_SECOND),
        column("dX_2000A", unit * _ARC_SECOND),
        column("dY_2000A", unit * _ARC_SECOND),
        "installed IERS bulletin A",
    )


_ROW = re.compile(r"^\s*\d{4}\s+\d{1,2}\s+\d{1,2}\s+(\d{5})((?:\s+-?\d+\.\d+){5,})\s*$")


def read_bulletin_b(paths: Sequence[str | Path]) -> EarthOrientation:
    """The daily values (section 1) of IERS Bulletins B in their format since 2010; later files overrule earlier ones.

    Raises:
        FileFormatError: a file holds no such values.
    """
    rows: dict[float, tuple[float, ...]] = {}
    for path in paths:
        found = 0
        section = 0
        for line in Path(path).read_text(errors="replace").splitlines():
            heading = re.match(r"^\s*(\d)\s+-\s+[A-Z]", line)
            if heading:
                section = int(heading[1])
            match = _ROW.match(line)
            if section == 1 and match:
                rows[float(match[1])] = tuple(float(w) for w in match[2].split()[:5])
                found += 1
        if found == 0:
            raise FileFormatError(
                "no daily Earth orientation values found",
                where=str(path),
                limit="IERS Bulletin B in its format since 2010",
            )
    date = np.array(sorted(rows))
    values = np.array([rows[d] for d in date])
    mas = 1e-3 * _ARC_SECOND
    return EarthOrientation(
        date,
        values[:, 2] * 1e-3 - tai_minus_utc(date),
        values[:, 0] * mas,
        values[:, 1] * mas,
        values[:, 3] * mas,
        values[:, 4] * mas,
        ", ".join(Path(p).name for p in paths),
    )


def eme2000_from_gcrs() -> np.ndarray:
    """Rotation (3, 3) from GCRS to the mean equator and equinox of J2000 (the frame bias, 0.02 arc seconds)."""
    import erfa

    bias, _, _ = erfa.bp00(2451545.0, 0.0)
    return np.asarray(bias)


@dataclass(frozen=True, eq=False)
class SpaceEnvironment:
    """What drives an orbit from outside, at any time inside a span.

    Args:
        epoch: datetime64[us], TAI.
        start, stop: s after the epoch.
        orientation: Earth orientation; None takes the installed table.

    Raises:
        InputError: the Earth's orientation is not known for the span.
    """

    epoch: np.datetime64
    start: float
    stop: float
    orientation: EarthOrientation | None = None
    _tables: dict = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        import erfa

        day0 = float((self.epoch - _J2000) / np.timedelta64(1, "us")) * 1e-6 / _DAY  # TAI days after J2000
        first, last = day0 + self.start / _DAY - 0.5, day0 + self.stop / _DAY + 0.5
        mjd = np.array([first, last]) + _MJD_OF_J2000
        table = self.orientation or installed_orientation(float(mjd[0]), float(mjd[1]))
        leap = float(tai_minus_utc(mjd[:1])[0])
        if table.date[0] > mjd[0] + 0.5 or table.date[-1] < mjd[1] - 0.5 - leap / _DAY:
            raise InputError(
                "the Earth orientation bulletin does not cover the data",
                where=table.source,
                value=f"modified Julian date {mjd[0] + 0.5:.2f} to {mjd[1] - 0.5:.2f}",
                limit=f"{table.date[0]:.0f} to {table.date[-1]:.0f}",
                remedy="give the bulletin of the data's dates, or none to use the installed table; check "
                "that the times are in the scale and the day count that the settings say",
            )
        tai_of_table = table.date - _MJD_OF_J2000 + tai_minus_utc(table.date) / _DAY
        kind = CubicSpline if len(table.date) > 3 else _linear
        t = self._tables
        t["day0"] = day0
        for name in ("ut1_minus_tai", "pole_x", "pole_y", "offset_x", "offset_y"):
            t[name] = kind(tai_of_table, getattr(table, name))
        count = max(8, int(np.ceil((last - first) / 0.1)) + 1)
        days = np.linspace(first, last, count)
        tt = days + _TT_MINUS_TAI / _DAY
        x, y, s = erfa.xys06a(2451545.0, tt)
        t["days"] = days
        t["xys"] = CubicSpline(days, np.column_stack([x, y, s]))
        earth, _ = erfa.epv00(2451545.0, tt)
        t["sun"] = CubicSpline(days, -earth["p"] * _ASTRONOMICAL_UNIT)
        t["moon"] = CubicSpline(days, erfa.moon98(2451545.0, tt)["p"] * _ASTRONOMICAL_UNIT)

    def _days(self, time: np.ndarray) -> np.ndarray:
        return self._tables["day0"] + np.asarray(time, dtype=float) / _DAY

    def orientation_parts(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The three factors of ``earth_fixed_from_celestial = pole R3(angle) intermediate``.

        Args:
            time: (n,) s after the epoch.

        Returns:
            intermediate (n, 3, 3), Earth rotation angle (n,) rad, pole (n, 3, 3).
        """
        import erfa

        t, days = self._tables, self._days(time)
        xys = t["xys"](days)
        intermediate = erfa.c2ixys(xys[:, 0] + t["offset_x"](days), xys[:, 1] + t["offset_y"](days), xys[:, 2])
        angle = erfa.era00(2451545.0, days + t["ut1_minus_tai"](days) / _DAY)
        pole = erfa.pom00(t["pole_x"](days), t["pole_y"](days), erfa.sp00(2451545.0, days + _TT_MINUS_TAI / _DAY))
        return intermediate, np.asarray(angle), pole

    def earth_fixed_from_celestial(self, time: np.ndarray) -> np.ndarray:
        """Rotation matrices (n, 3, 3) from GCRS to ITRS."""
        intermediate, angle, pole = self.orientation_parts(time)
        return pole @ _about_z(angle) @ intermediate

    def sun(self, time: np.ndarray) -> np.ndarray:
        """Geocentric position (n, 3) of the Sun, GCRS, m."""
        return self._tables["sun"](self._days(time))

    def moon(self, time: np.ndarray) -> np.ndarray:
        """Geocentric position (n, 3) of the Moon, GCRS, m."""
        return self._tables["moon"](self._days(time))

    def driving(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rotation (n, 3, 3) from GCRS to ITRS, Sun and Moon (n, 3), m: what an integration asks for at every stage.

        One table of everything that varies slowly, made at the first call, in place of eight: the same to rounding, and
        several times as fast for the few times of one step.
        """
        import erfa

        t = self._tables
        if "driving" not in t:
            knots = (t["days"] - t["day0"]) * _DAY
            intermediate, _, pole = self.orientation_parts(knots)
            columns = [intermediate.reshape(-1, 9), pole.reshape(-1, 9), self.sun(knots), self.moon(knots),
                       np.reshape(t["ut1_minus_tai"](t["days"]), (-1, 1))]
            t["driving"] = CubicSpline(t["days"], np.column_stack(columns))
        days = self._days(time)
        row = t["driving"](days)
        angle = erfa.era00(2451545.0, days + row[:, 24] / _DAY)
        rotation = row[:, 9:18].reshape(-1, 3, 3) @ _about_z(np.asarray(angle)) @ row[:, :9].reshape(-1, 3, 3)
        return rotation, row[:, 18:21], row[:, 21:24]

    def earth_fixed_state(self, time: np.ndarray, state: np.ndarray) -> np.ndarray:
        """Earth-fixed position and velocity (n, 6) of celestial ones."""
        intermediate, angle, pole = self.orientation_parts(time)
        turned = np.einsum("nij,nj->ni", _about_z(angle) @ intermediate, state[:, :3])
        moved = np.einsum("nij,nj->ni", _about_z(angle) @ intermediate, state[:, 3:])
        moved = moved - np.cross([0.0, 0.0, EARTH_ROTATION_RATE], turned)
        return np.column_stack([np.einsum("nij,nj->ni", pole, turned), np.einsum("nij,nj->ni", pole, moved)])


def _linear(x: np.ndarray, y: np.ndarray):  # type: ignore[no-untyped-def]
    return lambda at: np.interp(at, x, y)


def _about_z(angle: np.ndarray) -> np.ndarray:
    """Frame rotation R3 by each angle (n, 3, 3)."""
    result = np.zeros((len(angle), 3, 3))
    c, s = np.cos(angle), np.sin(angle)
    result[:, 0, 0], result[:, 0, 1], result[:, 1, 0], result[:, 1, 1] = c, s, -s, c
    result[:, 2, 2] = 1.0
    return result
