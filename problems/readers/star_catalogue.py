"""Star catalogues: the Yale Bright Star Catalogue as JSON, and CSV or JSON tables of that kind.

A record needs a position and a magnitude; an identifier, a name and proper motions are read where they are. Column
names are recognised without regard to case:

    identifier       hr, hip, id, star, source_id, number
    name             n, name, proper
    right ascension  ra, raj2000, ra_deg, rightascension, right_ascension, _raj2000, ra_icrs; rarad, ra_rad in radians;
                     ra_hours, ra_h in hours
    declination      dec, dej2000, decj2000, dec_deg, de, declination, _dej2000, de_icrs; decrad, dec_rad in radians
    magnitude        v, vmag, mag, magnitude, phot_g_mean_mag
    proper motion    pmra, pm_ra and pmdec, pm_dec, pmde (mas/yr, right ascension times cosine of the declination)

A right ascension in sexagesimal text is in hours, minutes and seconds (``00h 05m 09.9s``, ``00:05:09.9``); a number is
in degrees unless its column says otherwise or the caller does. Records without a position (the Yale numbers that are
no stars) are left out and counted.
"""

from __future__ import annotations

import csv
import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from estimator.models.errors import FileFormatError, MissingDataError, NotFiniteError, RequestError, UnitError

_COLUMNS: dict[str, tuple[str, ...]] = {
    "identifier": ("hr", "hip", "id", "star", "source_id", "number"),
    "name": ("n", "name", "proper"),
    "right_ascension": (
        "ra",
        "raj2000",
        "ra_deg",
        "rightascension",
        "right_ascension",
        "_raj2000",
        "ra_icrs",
        "ra_hours",
        "ra_h",
        "rarad",
        "ra_rad",
    ),
    "declination": (
        "dec",
        "dej2000",
        "decj2000",
        "dec_deg",
        "de",
        "declination",
        "_dej2000",
        "de_icrs",
        "decrad",
        "dec_rad",
    ),
    "magnitude": ("v", "vmag", "mag", "magnitude", "phot_g_mean_mag"),
    "motion_right_ascension": ("pmra", "pm_ra"),
    "motion_declination": ("pmdec", "pm_dec", "pmde"),
}
_IN_RADIANS = {"rarad", "ra_rad", "decrad", "dec_rad"}
_IN_HOURS = {"ra_hours", "ra_h"}
_MAS_PER_YEAR = np.radians(1 / 3.6e6)  # rad/yr
_NUMBERS = re.compile(r"\d+(?:\.\d*)?|\.\d+")
_MISSING = {"", "null", "none", "nan", "-", "--"}


@dataclass(frozen=True)
class StarCatalogue:
    """Stars with position and magnitude, in the order of the file.

    Attributes:
        identifier: text of each star's number in its catalogue (n).
        name: proper name or "" (n).
        right_ascension, declination: (n, rad), inertial axes of J2000/ICRS (they differ by 0.02 arcsec).
        magnitude: (n), V or what the file has in its place.
        motion: proper motion (n x 2, rad per Julian year) in right ascension times cosine and in declination; zero
            where the file has none.
        skipped: records without a position or magnitude that were left out.
        source: the file.
    """

    identifier: np.ndarray
    name: np.ndarray
    right_ascension: np.ndarray
    declination: np.ndarray
    magnitude: np.ndarray
    motion: np.ndarray
    skipped: int = 0
    source: str = ""

    def __len__(self) -> int:
        return len(self.magnitude)

    def directions(self, years: float = 0.0) -> np.ndarray:
        """Unit vectors (n x 3) to the stars in inertial axes, ``years`` (Julian) after J2000.

        Proper motion where the catalogue has it; aberration (20 arcsec at most) and parallax are not applied: they do
        not matter to the choice of stars.
        """
        ra, dec = self.right_ascension, self.declination
        radial = np.column_stack((np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)))
        if years and np.any(self.motion):
            east = np.column_stack((-np.sin(ra), np.cos(ra), np.zeros_like(ra)))
            north = np.column_stack((-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)))
            radial = radial + years * (self.motion[:, :1] * east + self.motion[:, 1:] * north)
            radial /= np.linalg.norm(radial, axis=1)[:, None]
        return radial

    def where(self, keep: np.ndarray) -> StarCatalogue:
        """The stars of a mask or of indices."""
        return StarCatalogue(
            self.identifier[keep],
            self.name[keep],
            self.right_ascension[keep],
            self.declination[keep],
            self.magnitude[keep],
            self.motion[keep],
            self.skipped,
            self.source,
        )

    def brighter_than(self, magnitude: float) -> StarCatalogue:
        """The stars of this magnitude or brighter."""
        return self.where(self.magnitude <= magnitude)

    def without_blends(self, angle: float) -> StarCatalogue:
        """Without the stars that stand within ``angle`` (rad) of a brighter one: a sensor sees both as one spot."""
        from scipy.spatial import cKDTree

        pairs = cKDTree(self.directions()).query_pairs(2 * np.sin(angle / 2), output_type="ndarray")
        keep = np.ones(len(self), dtype=bool)
        first_fainter = self.magnitude[pairs[:, 0]] > self.magnitude[pairs[:, 1]]
        keep[np.where(first_fainter, pairs[:, 0], pairs[:, 1])] = False
        return self.where(keep)


def read_star_catalogue(path: str | os.PathLike[str], *, right_ascension_unit: str | None = None) -> StarCatalogue:
    """Read a catalogue (``.json``, or a table with a header line: CSV, semicolons or tabs).

    Args:
        path: the file. JSON is a list of records, an object of columns, or an object with one list of records.
        right_ascension_unit: "deg", "hour" or "rad" for numeric right ascensions; None to take it from the column name.

    Raises:
        FileFormatError: not there, not readable, not such a table.
        MissingDataError: no column of right ascension, declination or magnitude; no star left.
        UnitError: an angle out of range, or right ascensions that look like hours.
        NotFiniteError: an infinite value.
    """
    if right_ascension_unit not in (None, "deg", "hour", "rad"):
        raise RequestError(
            "unknown unit", where="right_ascension_unit", value=right_ascension_unit, limit="deg, hour or rad"
        )
    file = Path(path)
    try:
        text = file.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise FileFormatError(
            "there is no such file", where=str(file), remedy="give the path of a star catalogue"
        ) from None
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(
            f"the file cannot be read ({error})", where=str(file), remedy="a catalogue is a text file in UTF-8"
        ) from None
    parse = _json_records if text.lstrip()[:1] in ("[", "{") else _table_records
    return _catalogue(parse(text, file), file, right_ascension_unit)


def _json_records(text: str, file: Path) -> list[Mapping[str, Any]]:
    try:
        content = json.loads(text)
    except json.JSONDecodeError as error:
        raise FileFormatError(
            f"not valid JSON: {error.msg}",
            where=f"{file}, line {error.lineno}",
            remedy="the file may be truncated: fetch it again",
        ) from None
    if isinstance(content, dict):
        lists = {k: v for k, v in content.items() if isinstance(v, list)}
        tables = [v for v in lists.values() if v and isinstance(v[0], dict)]
        if len(tables) == 1:
            content = tables[0]
        elif lists:
            lengths = {len(v) for v in lists.values()}
            if len(lengths) != 1:
                raise FileFormatError("the columns differ in length", where=str(file), value=sorted(lengths))
            content = [dict(zip(lists, row, strict=True)) for row in zip(*lists.values(), strict=True)]
    if not isinstance(content, list) or not all(isinstance(r, dict) for r in content):
        raise FileFormatError(
            "no list of star records",
            where=str(file),
            remedy='write [{"HR": "1", "RA": "00h 05m 09.9s", "Dec": "+45° 13′ 45″", "V": "6.70"}, ...]',
        )
    return content


def _table_records(text: str, file: Path) -> list[Mapping[str, Any]]:
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if len(lines) < 2:
        raise FileFormatError(
            "no table with a header line", where=str(file), remedy="give columns such as id,ra,dec,mag"
        )
    delimiter = max(",;\t|", key=lines[0].count)
    if lines[0].count(delimiter) == 0:
        raise FileFormatError(
            "the header line has one column only",
            where=str(file),
            value=lines[0][:60],
            remedy="separate columns by commas, semicolons or tabs",
        )
    rows = csv.reader(lines, delimiter=delimiter)
    header = [h.strip() for h in next(rows)]
    records: list[Mapping[str, Any]] = []
    for number, row in enumerate(rows, start=2):
        if len(row) < len(header):
            raise FileFormatError(
                "a row is short",
                where=f"{file}, row {number}",
                value=f"{len(row)} columns",
                limit=f"{len(header)} columns",
                remedy="the file may be truncated: fetch it again",
            )
        records.append(dict(zip(header, row, strict=False)))
    return records


def _column(names: Sequence[str], kind: str) -> str | None:
    """The first column of the file that holds ``kind``, in the order of preference of the aliases."""
    lowered = {name.strip().lower(): name for name in names}
    # A column that states its unit goes before one that leaves it open.
    aliases = sorted(_COLUMNS[kind], key=lambda a: a not in _IN_RADIANS | _IN_HOURS and not a.endswith("_deg"))
    return next((lowered[a] for a in aliases if a in lowered), None)


def _fullest_identifier(records: list[Mapping[str, Any]], names: Sequence[str]) -> str | None:
    """The identifier column that the most records fill; the order of preference decides a tie."""
    lowered = {name.strip().lower(): name for name in names}
    present = [lowered[a] for a in _COLUMNS["identifier"] if a in lowered]
    return max(present, key=lambda c: sum(not _missing(r.get(c)) for r in records), default=None)


def _catalogue(records: list[Mapping[str, Any]], file: Path, unit: str | None) -> StarCatalogue:
    names = list(dict.fromkeys(key for record in records for key in record))
    columns = {kind: _column(names, kind) for kind in _COLUMNS}
    columns["identifier"] = _fullest_identifier(records, names)
    for kind in ("right_ascension", "declination", "magnitude"):
        if columns[kind] is None:
            raise MissingDataError(
                f"no column of {kind.replace('_', ' ')}",
                where=str(file),
                value=", ".join(names[:12]),
                limit=", ".join(_COLUMNS[kind]),
                remedy="rename the column",
            )
    identifiers, labels, places, magnitudes, motions = [], [], [], [], []
    decimal = skipped = 0
    for row, record in enumerate(records, start=1):
        cells = {kind: record.get(column) for kind, column in columns.items() if column is not None}
        if any(_missing(cells[kind]) for kind in ("right_ascension", "declination", "magnitude")):
            skipped += 1
            continue
        where = f"{file}, record {row}"
        numeric = _is_number(cells["right_ascension"])
        decimal += numeric
        ra = _angle(cells["right_ascension"], columns["right_ascension"] or "", unit, hours=True, where=where)
        dec = _angle(cells["declination"], columns["declination"] or "", None, hours=False, where=where)
        magnitude = _number(cells["magnitude"], f"{where}, {columns['magnitude']}")
        if not -1e-9 <= ra <= 2 * np.pi + 1e-9:
            raise UnitError(
                "a right ascension is out of range",
                where=where,
                value=cells["right_ascension"],
                limit="0 to 360 deg, 0 to 24 h",
                remedy="state the unit: right_ascension_unit",
            )
        if abs(dec) > np.pi / 2 + 1e-9:
            raise UnitError(
                "a declination is out of range", where=where, value=cells["declination"], limit="-90 to +90 deg"
            )
        if not -30 < magnitude < 30:
            raise UnitError("a magnitude is out of range", where=where, value=magnitude, limit="-30 to 30")
        places.append((ra, dec))
        magnitudes.append(magnitude)
        identifiers.append(str(cells.get("identifier") or row))
        labels.append("" if _missing(cells.get("name")) else str(cells["name"]))
        motions.append(
            [
                0.0 if _missing(cells.get(k)) else _number(cells[k], where) * _MAS_PER_YEAR
                for k in ("motion_right_ascension", "motion_declination")
            ]
        )
    if not places:
        raise MissingDataError("no star with a position and a magnitude", where=str(file), value=f"{skipped} records")
    position = np.array(places)
    stated = unit is not None or (columns["right_ascension"] or "").lower() not in (
        "ra",
        "rightascension",
        "right_ascension",
    )
    if not stated and decimal > 200 and np.degrees(position[:, 0].max()) <= 24:
        raise UnitError(
            "the right ascensions look like hours",
            where=str(file),
            value=f"largest of {decimal}: {np.degrees(position[:, 0].max()):.6g}",
            limit="360 deg",
            remedy='say right_ascension_unit="hour" (or "deg" if the field is that narrow)',
        )
    return StarCatalogue(
        np.array(identifiers),
        np.array(labels),
        position[:, 0],
        position[:, 1],
        np.array(magnitudes),
        np.array(motions),
        skipped,
        str(file),
    )


def _missing(value: Any) -> bool:
    return value is None or (isinstance(value, str) and value.strip().lower() in _MISSING)


def _is_number(value: Any) -> bool:
    if isinstance(value, int | float):
        return True
    try:
        float(value)
    except (TypeError, ValueError):
        return False
    return True


def _number(value: Any, where: str) -> float:
    if not _is_number(value):
        raise FileFormatError("not a number", where=where, value=repr(value))
    number = float(value)
    if not np.isfinite(number):
        raise NotFiniteError("a value is not finite", where=where, value=value)
    return number


def _angle(value: Any, column: str, unit: str | None, *, hours: bool, where: str) -> float:
    """An angle (rad) from a number or from sexagesimal text."""
    if _is_number(value):
        number = _number(value, f"{where}, {column}")
        lowered = column.lower()
        if unit == "rad" or (unit is None and lowered in _IN_RADIANS):
            return number
        if unit == "hour" or (unit is None and lowered in _IN_HOURS):
            return float(np.radians(15 * number))
        return float(np.radians(number))
    text = str(value).strip().replace("−", "-")
    parts = [float(x) for x in _NUMBERS.findall(text)]
    if not 2 <= len(parts) <= 3 or any(x >= 60 for x in parts[1:]) or "-" in text[1:]:
        raise FileFormatError(
            "not an angle",
            where=f"{where}, {column}",
            value=repr(value),
            remedy='write "00h 05m 09.9s" and "+45° 13′ 45″", or numbers in degrees',
        )
    angle = sum(x / 60**k for k, x in enumerate(parts))
    if text.startswith("-"):
        angle = -angle
    in_hours = hours and "°" not in text and "d" not in text.lower()
    return float(np.radians(15 * angle if in_hours else angle))
