"""Any tracking file by its content: one call reads all files of a command, whatever their kinds.

Known: ``.aer`` and ``.in`` of the W3B case, GMAT ``.gmd``, CCSDS TDM and OEM (key = value), IERS Bulletin B, two-line
elements, TOML settings. An OEM or two-line elements give the initial orbit.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from estimator.models.earth_orientation import tai_from_utc, utc_text
from estimator.models.errors import FileFormatError, RequestError
from problems.geo_orbit.settings import OrbitSettings, read_toml, settings_from
from problems.geo_orbit.tracking import Observations, Tracking, deep_merged
from problems.readers.tracking_ccsds import read_oem, read_tdm
from problems.readers.tracking_gmd import read_gmd
from problems.readers.tracking_w3b import read_aer, read_orbit_determination_input


def kind_of(path: Path) -> str:
    """What a file is: "aer", "in", "gmd", "tdm", "oem", "bulletin", "tle" or "toml".

    Raises:
        FileFormatError: the file does not exist or is none of these.
    """
    try:
        head = path.read_bytes()[:20000].decode(errors="replace")
    except OSError as error:
        raise FileFormatError("the file cannot be read", where=str(path), value=error.strerror) from error
    if path.suffix == ".toml":
        return "toml"
    if "CCSDS_TDM_VERS" in head:
        return "tdm"
    if "CCSDS_OEM_VERS" in head:
        return "oem"
    if "BULLETIN B" in head:
        return "bulletin"
    if re.search(r"^ground\.station\.", head, re.MULTILINE) or re.search(r"^orbit\.", head, re.MULTILINE):
        return "in"
    rows = [line for line in head.splitlines() if line.strip() and not line.lstrip().startswith(("#", "%"))]
    if any(re.match(r"^1 [ \d]{5}[A-Z ] ", line) for line in rows) and any(line.startswith("2 ") for line in rows):
        return "tle"
    words = rows[0].split() if rows else []
    if len(words) >= 4 and words[1] in ("RANGE", "AZ_EL"):
        return "aer"
    if len(words) >= 6 and re.fullmatch(r"[\d.]+", words[0]) and words[2].isdigit():
        return "gmd"
    raise FileFormatError(
        "this is no tracking file of a known kind",
        where=str(path),
        value=(rows or [""])[0][:60],
        limit=".aer, .gmd, CCSDS TDM; with .in, .toml, CCSDS OEM, two-line elements, IERS Bulletin B",
    )


def read_files(paths: Sequence[Path], settings_file: Path | None = None) -> tuple[Tracking, OrbitSettings]:
    """Observations and settings of the files of a command.

    The settings are, in rising order: what tracking files say, ``.in`` files, TOML files among ``paths``, and
    ``settings_file``. Where no file has a station and one ``.in`` file beside a data file names it, that file is taken.

    Raises:
        InputError: a file that cannot be used, or settings that make no sense.
    """
    tracking = Tracking(())
    tables: dict[str, Any] = {}
    elements: list[tuple[Path, str]] = []
    bulletins: list[str] = []
    read: set[Path] = set()
    waiting = list(paths)
    if not waiting and settings_file is None:
        raise RequestError("no file to read", where="FILES")
    named: list[Path] = []
    while waiting:
        path = Path(waiting.pop(0))
        if path.resolve() in read:
            continue
        read.add(path.resolve())
        kind = kind_of(path)
        if kind == "toml":
            tables = deep_merged(tables, read_toml(path))
            named += [Path(p) for p in tables.get("files", {}).get("measurements", [])]
        elif kind == "bulletin":
            bulletins.append(str(path))
        elif kind in ("oem", "tle"):
            elements.append((path, kind))
        else:
            reader = {"aer": read_aer, "in": read_orbit_determination_input, "gmd": read_gmd, "tdm": read_tdm}[kind]
            found = reader(path)
            named += [Path(p) for p in found.settings.pop("files", {}).get("measurements", [])]
            tracking = tracking.merged(found)
        if not waiting and not tracking.observations:
            waiting += [p for p in named if p.resolve() not in read]
            named = []
    if settings_file is not None:
        tables = deep_merged(tables, read_toml(settings_file))
        if not tracking.observations:
            for name in tables.get("files", {}).get("measurements", []):
                more, _ = read_files([Path(name)])
                tracking = tracking.merged(more)
    if not tracking.observations:
        raise RequestError(
            "none of the files holds measurements",
            where="FILES",
            remedy="give a tracking file: .aer, .gmd or CCSDS TDM",
        )
    if not tracking.stations and not tables.get("stations"):
        beside = _settings_beside(paths)
        if beside is not None:
            found = read_orbit_determination_input(beside)
            found.settings.pop("files", None)
            tracking = found.merged(tracking)
    merged = deep_merged(tracking.settings, tables)
    scale = merged.get("measurements", {}).get("time_scale", "file")
    if scale not in ("file", "UTC"):
        tracking = _rescaled(tracking, str(scale))
    tracking = _within(tracking, merged.get("measurements", {}))
    if bulletins:
        merged = deep_merged(merged, {"earth_orientation": {"bulletins": bulletins}})
    if elements and "orbit" not in tables:
        merged["orbit"] = _orbit_table(elements[-1], min(o.time.min() for o in tracking.observations))
    return tracking, settings_from(merged, tracking.stations)


def _settings_beside(paths: Sequence[Path]) -> Path | None:
    for path in paths:
        for candidate in sorted(Path(path).parent.glob("*.in")):
            if kind_of(candidate) == "in" and Path(path).name in candidate.read_text(errors="replace"):
                return candidate
    return None


def _within(tracking: Tracking, measurements: Mapping[str, Any]) -> Tracking:
    """The observations between ``start`` and ``stop`` (UTC texts) of the settings.

    Raises:
        RequestError: none is left.
    """
    first, last = measurements.get("start"), measurements.get("stop")
    if first is None and last is None:
        return tracking
    low = tai_from_utc([str(first)])[0] if first is not None else np.datetime64("1950-01-01", "us")
    high = tai_from_utc([str(last)])[0] if last is not None else np.datetime64("2150-01-01", "us")
    kept = [o.subset((o.time >= low) & (o.time <= high)) for o in tracking.observations]
    kept = [o for o in kept if len(o.time)]
    if not kept:
        raise RequestError(
            "no measurement lies between start and stop", where="[measurements]", value=f"{first} to {last}"
        )
    return replace(tracking, observations=tuple(kept))


def _rescaled(tracking: Tracking, scale: str) -> Tracking:
    """Readings that the file gave as UTC, taken in another scale."""
    from problems.readers.tracking_ccsds import tai_from_text

    observations = []
    for o in tracking.observations:
        texts = [utc_text(t) for t in o.time]
        observations.append(
            Observations(
                o.kind, o.receiver, o.transmitter, tai_from_text(texts, scale, o.source), o.value, o.source, o.line
            )
        )
    return Tracking(tuple(observations), tracking.stations, tracking.settings, tracking.satellite)


def _orbit_table(element: tuple[Path, str], first: np.datetime64) -> dict[str, Any]:
    path, kind = element
    if kind == "oem":
        ephemeris = read_oem(path)
        index = int(np.argmin(np.abs((ephemeris.time - first) / np.timedelta64(1, "us"))))
        return {
            "epoch": utc_text(ephemeris.time[index]),
            "frame": ephemeris.frame,
            "position_m": ephemeris.state[index, :3].tolist(),
            "velocity_m_s": ephemeris.state[index, 3:].tolist(),
        }
    return {"tle": list(nearest_elements(path, first))}


def nearest_elements(path: Path, instant: np.datetime64) -> tuple[str, str]:
    """The element set of a file whose epoch is nearest to a TAI instant.

    Raises:
        FileFormatError: the file holds no element set.
    """
    lines = [line.rstrip() for line in path.read_text(errors="replace").splitlines()]
    best: tuple[float, tuple[str, str]] | None = None
    for one, two in pairwise(lines):
        if one.startswith("1 ") and two.startswith("2 "):
            try:
                year, day = int(one[18:20]), float(one[20:32])
            except ValueError as error:
                raise FileFormatError(
                    "the epoch of an element set cannot be read", where=str(path), value=one[:40]
                ) from error
            year += 2000 if year < 57 else 1900
            epoch = np.datetime64(f"{year}-01-01T00:00:00", "us") + np.timedelta64(round((day - 1) * 86400e6), "us")
            gap = abs(float((epoch - instant) / np.timedelta64(1, "us")))
            if best is None or gap < best[0]:
                best = gap, (one, two)
    if best is None:
        raise FileFormatError("the file holds no two-line element set", where=str(path))
    return best[1]
