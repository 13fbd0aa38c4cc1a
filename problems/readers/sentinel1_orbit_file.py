"""Sentinel-1 orbit files (``.EOF``: precise, restituted or predicted orbit), read safely."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from estimator.models.earth_orientation import tai_from_utc
from estimator.models.errors import FileFormatError, InputError, MissingDataError, NotFiniteError


@dataclass(frozen=True)
class StateVectors:
    """Orbit state vectors.

    Attributes:
        time: (n,) datetime64[us], TAI, strictly increasing.
        position: (n, 3) m, Earth-fixed.
        velocity: (n, 3) m/s, Earth-fixed, relative to the rotating Earth.
    """

    time: np.ndarray
    position: np.ndarray
    velocity: np.ndarray


@dataclass(frozen=True)
class OrbitFile:
    """What an orbit file says.

    Attributes:
        path: where it was read.
        mission: ``S1A``, ``S1B``, ...
        kind: ``AUX_POEORB``, ``AUX_RESORB``, ``AUX_PREORB``.
        orbit: the state vectors of nominal quality.
    """

    path: Path
    mission: str
    kind: str
    orbit: StateVectors


def xml_root(path: Path) -> Any:
    """Root element of an XML file from a source that is not trusted.

    Raises:
        FileFormatError: no such file, no well-formed XML, or XML that defines or refers to entities.
    """
    from xml.etree.ElementTree import ParseError

    from defusedxml import DefusedXmlException
    from defusedxml.ElementTree import parse

    try:
        return parse(path, forbid_dtd=True).getroot()
    except DefusedXmlException as error:
        raise FileFormatError(
            f"the XML declares entities or a document type, which is refused ({type(error).__name__})",
            where=str(path),
            remedy="use the file as the data provider delivers it",
        ) from error
    except (ParseError, UnicodeDecodeError, LookupError, ValueError) as error:
        raise FileFormatError(
            f"the file is no well-formed XML ({error})", where=str(path), remedy="download it again"
        ) from error
    except OSError as error:
        raise FileFormatError(
            f"the file cannot be read ({error.strerror})", where=str(path), remedy="check the path"
        ) from error


def number(text: str | None, where: str) -> float:
    """A finite number from the text of an element."""
    try:
        value = float(text) if text is not None else None
    except ValueError as error:
        raise FileFormatError("this is no number", where=where, value=repr(text)) from error
    if value is None:
        raise MissingDataError("the element is missing", where=where)
    if not np.isfinite(value):
        raise NotFiniteError("the value is NaN or infinite", where=where, value=value)
    return value


def times(texts: list[str | None], where: str) -> np.ndarray:
    """Instants of a list of elements, which must exist and increase."""
    if any(text is None for text in texts):
        raise MissingDataError("an element with a time is missing", where=where)
    try:
        return tai_from_utc([text for text in texts if text is not None])
    except InputError as error:
        raise FileFormatError(error.what, where=where, value=error.value) from error


def read_orbit_file(path: str | os.PathLike[str]) -> OrbitFile:
    """Read an orbit file.

    Args:
        path: the ``.EOF`` file.

    Returns:
        The orbit; state vectors whose quality is degraded are left out, repeated ones count once.

    Raises:
        FileFormatError: no XML, not an orbit file, another frame or time scale.
        MissingDataError: elements are missing, or there are no state vectors.
        NotFiniteError: NaN or infinity.
    """
    path = Path(path)
    root = xml_root(path)
    if root.tag.rsplit("}", 1)[-1] != "Earth_Explorer_File":
        raise FileFormatError(
            "this is no orbit file", where=str(path), value=f"root element {root.tag!r}", limit="'Earth_Explorer_File'"
        )
    frame = (root.findtext(".//{*}Ref_Frame") or "EARTH_FIXED").strip()
    scale = (root.findtext(".//{*}Time_Reference") or "UTC").strip()
    if frame != "EARTH_FIXED" or scale != "UTC":
        raise FileFormatError(
            "the orbit file uses another frame or time scale",
            where=str(path),
            value=f"{frame}, {scale}",
            limit="EARTH_FIXED, UTC",
        )
    vectors = [v for v in root.findall(".//{*}OSV") if (v.findtext("{*}Quality") or "").strip() != "DEGRADED"]
    if not vectors:
        raise MissingDataError("the orbit file has no state vectors", where=str(path))
    where = f"{path.name}: OSV"
    time = times([v.findtext("{*}UTC") for v in vectors], where)
    position = np.array([[number(v.findtext(f"{{*}}{axis}"), where) for axis in ("X", "Y", "Z")] for v in vectors])
    velocity = np.array([[number(v.findtext(f"{{*}}{axis}"), where) for axis in ("VX", "VY", "VZ")] for v in vectors])
    mission = (root.findtext(".//{*}Mission") or "").strip()
    _, order = np.unique(time, return_index=True)
    return OrbitFile(
        path,
        mission.replace("Sentinel-", "S"),
        (root.findtext(".//{*}File_Type") or "").strip(),
        StateVectors(time[order], position[order], velocity[order]),
    )
