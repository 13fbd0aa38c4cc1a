"""CCSDS Tracking Data Messages (503.0-B) and Orbit Ephemeris Messages (502.0-B) in key = value notation, read and
written.

TDM: RANGE (km, s, or RU where the transponder's conversion is not needed is refused), DOPPLER_INSTANTANEOUS and
DOPPLER_INTEGRATED (km/s), ANGLE_1 and ANGLE_2 (AZEL, degrees). A range of a path ``1,2,1`` is taken as the file's
one-way-equivalent or round trip value according to the settings (``measurements.range``); the standard's RANGE is the
round trip for two-way paths. OEM: states, and covariance blocks are passed over.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estimator.models.earth_orientation import tai_from_utc, utc_text
from estimator.models.errors import FileFormatError, RequestError, TimeOrderError
from estimator.models.files import written_atomically
from estimator.models.ranging import Kind
from problems.geo_orbit.tracking import Observations, Tracking

_DEGREE = np.pi / 180  # [rad]
_LIGHT = 299792458.0  # [m/s]
_TAI_MINUS = {"TAI": 0.0, "GPS": 19.0, "TT": -32.184}  # [s] to add to a reading of that scale
_ORDINAL = re.compile(r"(\d{4})-(\d{3})T(.*)")


def tai_from_text(texts: list[str], scale: str, where: str) -> np.ndarray:
    """datetime64[us] TAI of CCSDS times (calendar or day of year) in a time scale.

    Raises:
        FileFormatError: a text is no time.
        RequestError: the scale is not known.
    """
    plain = []
    for text in texts:
        found = _ORDINAL.fullmatch(text.rstrip("Z"))
        if found:
            day = np.datetime64(f"{found[1]}-01-01") + np.timedelta64(int(found[2]) - 1, "D")
            text = f"{day}T{found[3]}"
        plain.append(text.rstrip("Z"))
    if scale == "UTC":
        try:
            return tai_from_utc(plain)
        except FileFormatError as error:
            raise FileFormatError(error.what, where=where, value=error.value, limit=error.limit) from error
    if scale not in _TAI_MINUS:
        raise RequestError(
            "the scale of the times is not known",
            where=where,
            value=scale or "none",
            limit="UTC, TAI, GPS or TT",
            remedy="state TIME_SYSTEM in the file",
        )
    try:
        times = np.array([np.datetime64(t, "us") for t in plain])
    except ValueError as error:
        raise FileFormatError("this is no date and time", where=where, value=str(error)) from error
    return times + np.round(np.full(len(times), _TAI_MINUS[scale]) * 1e6).astype("timedelta64[us]")


@dataclass
class _Block:
    meta: dict[str, str]
    rows: list[tuple[int, str]]


def _blocks(path: Path, version: str) -> tuple[dict[str, str], list[_Block]]:
    """Header and (metadata, data lines) of a key = value message."""
    header: dict[str, str] = {}
    blocks: list[_Block] = []
    inside = ""
    try:
        lines = path.read_text(errors="replace").splitlines()
    except OSError as error:
        raise FileFormatError("the file cannot be read", where=str(path), value=str(error)) from error
    for number, raw in enumerate(lines, 1):
        line = raw.strip()
        if not line or line.startswith("COMMENT"):
            continue
        if line in ("META_START", "DATA_START", "COVARIANCE_START"):
            inside = line
            if line == "META_START":
                blocks.append(_Block({}, []))
            continue
        if line in ("META_STOP", "DATA_STOP", "COVARIANCE_STOP"):
            inside = "STATES" if line == "META_STOP" else ""
            continue
        if inside == "META_START" or not blocks:
            key, mark, value = line.partition("=")
            if not mark:
                raise FileFormatError("this line is not key = value", where=f"{path}:{number}", value=line[:60])
            (blocks[-1].meta if inside == "META_START" else header)[key.strip()] = value.strip()
        elif inside != "COVARIANCE_START":
            blocks[-1].rows.append((number, line))
    if version not in header:
        raise FileFormatError(f"{version} is missing: this is no such message", where=str(path))
    if not blocks:
        raise FileFormatError("the message has no segment", where=str(path))
    return header, blocks


_KINDS: dict[str, Kind] = {"RANGE": "range", "DOPPLER_INSTANTANEOUS": "range_rate", "DOPPLER_INTEGRATED": "range_rate"}


def read_tdm(path: Path) -> Tracking:
    """Observations of a TDM.

    Raises:
        FileFormatError: a line or key is not as the standard says, or nothing in the file can be used.
        RequestError: a time scale or range unit that is not known.
    """
    _, blocks = _blocks(path, "CCSDS_TDM_VERS")
    observations: list[Observations] = []
    satellite, tags, legs = "", set(), set()
    for block in blocks:
        meta = block.meta
        scale = meta.get("TIME_SYSTEM", "")
        participants = {k.split("_")[1]: v for k, v in meta.items() if re.fullmatch(r"PARTICIPANT_\d", k)}
        path_text = meta.get("PATH") or meta.get("PATH_1") or "2,1"
        hops = [w.strip() for w in path_text.split(",")]
        ends = [participants.get(h, h) for h in hops]
        if len(hops) == 3:
            transmitter, satellite, receiver = ends
        elif len(hops) == 2:
            satellite, receiver = ends
            transmitter = receiver
            if any(line.split("=")[0].strip() in _KINDS for _, line in block.rows):
                raise RequestError(
                    "one-way ranges and Doppler are not supported",
                    where=str(path),
                    value=path_text,
                    limit="PATH such as 1,2,1",
                )
        else:
            raise FileFormatError("this signal path is not known", where=str(path), value=path_text, limit="1,2,1")
        tags.add(
            {"TRANSMIT": "transmission", "RECEIVE": "reception"}.get(meta.get("TIMETAG_REF", "RECEIVE"), "reception")
        )
        angles = meta.get("ANGLE_TYPE", "AZEL")
        unit = meta.get("RANGE_UNITS", "km")
        found: dict[str, list[tuple[str, float, int]]] = {}
        for number, line in block.rows:
            key, _, rest = line.partition("=")
            words = rest.split()
            key = key.strip()
            if key not in (*_KINDS, "ANGLE_1", "ANGLE_2"):
                continue
            try:
                found.setdefault(key, []).append((words[0], float(words[1]), number))
            except (IndexError, ValueError) as error:
                raise FileFormatError(
                    "this data line is not 'KEY = time value'", where=f"{path}:{number}", value=line[:60]
                ) from error
        for key, kind in _KINDS.items():
            rows = found.get(key)
            if not rows:
                continue
            if kind == "range":
                factors = {"km": 1e3, "s": _LIGHT}
                if unit not in factors:
                    raise RequestError(
                        "this unit of range is not known",
                        where=f"{path}: RANGE_UNITS",
                        value=unit,
                        limit="km or s",
                        remedy="convert range units with the transponder's constants",
                    )
                factor = factors[unit]
                legs.add("sum")
            else:
                factor = 1e3
            time = tai_from_text([r[0] for r in rows], scale, str(path))
            order = np.argsort(time, kind="stable")
            observations.append(
                Observations(
                    kind,
                    receiver,
                    transmitter,
                    time[order],
                    factor * np.array([[r[1]] for r in rows])[order],
                    path.name,
                    np.array([r[2] for r in rows])[order],
                )
            )
        if "ANGLE_1" in found:
            if angles != "AZEL":
                raise RequestError(
                    "this kind of angles is not known", where=f"{path}: ANGLE_TYPE", value=angles, limit="AZEL"
                )
            first, second = found["ANGLE_1"], {r[0]: r[1] for r in found.get("ANGLE_2", [])}
            paired = [r for r in first if r[0] in second]
            if not paired:
                raise FileFormatError("no ANGLE_2 belongs to the ANGLE_1 lines", where=str(path))
            time = tai_from_text([r[0] for r in paired], scale, str(path))
            order = np.argsort(time, kind="stable")
            value = _DEGREE * np.array([[r[1], second[r[0]]] for r in paired])
            observations.append(
                Observations(
                    "azimuth_elevation",
                    receiver,
                    receiver,
                    time[order],
                    value[order],
                    path.name,
                    np.array([r[2] for r in paired])[order],
                )
            )
    if not observations:
        raise FileFormatError("the message holds no RANGE, DOPPLER or ANGLE lines", where=str(path))
    if len(tags) > 1:
        raise RequestError("segments with different TIMETAG_REF cannot be mixed", where=str(path))
    settings = {"measurements": {"time_tag": tags.pop()}}
    if legs:
        settings["measurements"]["range"] = "sum"
    together = Tracking((), settings=settings, satellite=satellite)
    for o in observations:
        together = together.merged(Tracking((o,)))
    return together


def write_tdm(path: Path, tracking: Tracking, *, time_tag: str = "reception", originator: str = "BORESIGHT") -> None:
    """Write two-way and bistatic ranges (km, round trip as given), range rates (km/s) and angles, UTC.

    Args:
        path: the file.
        tracking: the observations; ranges are written as they are.
        time_tag: "reception" or "transmission".
        originator: of the header.

    Raises:
        RequestError: a kind that the format does not carry, or a tag at the bounce.
    """
    if time_tag not in ("reception", "transmission"):
        raise RequestError("a TDM tags reception or transmission", where="time_tag", value=time_tag)
    satellite = tracking.satellite or "SATELLITE"
    stamp = utc_text(max(o.time.max() for o in tracking.observations)).rstrip("Z")
    lines = ["CCSDS_TDM_VERS = 2.0", f"CREATION_DATE = {stamp}", f"ORIGINATOR = {originator}", ""]
    for o in tracking.observations:
        if o.kind == "direction_cosines":
            raise RequestError("a TDM does not carry direction cosines of the local north and east", where=o.name)
        lines += ["META_START", "TIME_SYSTEM = UTC", f"PARTICIPANT_1 = {o.transmitter}", f"PARTICIPANT_2 = {satellite}"]
        hops = "1,2,1"
        if o.receiver != o.transmitter:
            lines.append(f"PARTICIPANT_3 = {o.receiver}")
            hops = "1,2,3"
        lines += [
            "MODE = SEQUENTIAL",
            f"PATH = {hops}",
            f"TIMETAG_REF = {'RECEIVE' if time_tag == 'reception' else 'TRANSMIT'}",
        ]
        if o.kind == "azimuth_elevation":
            lines.append("ANGLE_TYPE = AZEL")
        if o.kind == "range":
            lines.append("RANGE_UNITS = km")
        lines += ["META_STOP", "", "DATA_START"]
        for t, value in zip(o.time, o.value, strict=True):
            text = utc_text(t).rstrip("Z")
            if o.kind == "range":
                lines.append(f"RANGE = {text} {value[0] * 1e-3:.9f}")
            elif o.kind == "range_rate":
                lines.append(f"DOPPLER_INSTANTANEOUS = {text} {value[0] * 1e-3:.12f}")
            else:
                lines.append(f"ANGLE_1 = {text} {value[0] / _DEGREE:.12f}")
                lines.append(f"ANGLE_2 = {text} {value[1] / _DEGREE:.12f}")
        lines += ["DATA_STOP", ""]
    with written_atomically(path) as temporary:
        temporary.write_text("\n".join(lines))


@dataclass(frozen=True, eq=False)
class Ephemeris:
    """States of a satellite.

    Attributes:
        name, identifier: of the satellite.
        frame: "EME2000", "GCRF" or "ITRF".
        time: (n,) datetime64[us], TAI, increasing.
        state: (n, 6) m and m/s.
    """

    name: str
    identifier: str
    frame: str
    time: np.ndarray
    state: np.ndarray


_FRAMES = {"EME2000": "EME2000", "J2000": "EME2000", "GCRF": "GCRF", "ICRF": "GCRF"}


def read_oem(path: Path) -> Ephemeris:
    """The states of all segments of an OEM.

    Raises:
        FileFormatError: a line or key is not as the standard says.
        RequestError: a centre, frame or time scale that is not known.
        TimeOrderError: the times do not increase.
    """
    _, blocks = _blocks(path, "CCSDS_OEM_VERS")
    times, states = [], []
    for block in blocks:
        meta = block.meta
        for key in ("OBJECT_NAME", "OBJECT_ID", "CENTER_NAME", "REF_FRAME", "TIME_SYSTEM"):
            if key not in meta:
                raise FileFormatError(f"{key} is missing", where=str(path))
        if meta["CENTER_NAME"].upper() != "EARTH":
            raise RequestError(
                "only orbits about the Earth are known", where=f"{path}: CENTER_NAME", value=meta["CENTER_NAME"]
            )
        frame = "ITRF" if meta["REF_FRAME"].startswith("ITRF") else _FRAMES.get(meta["REF_FRAME"], "")
        if not frame:
            raise RequestError(
                "this frame is not known",
                where=f"{path}: REF_FRAME",
                value=meta["REF_FRAME"],
                limit=", ".join([*_FRAMES, "ITRF*"]),
            )
        texts, rows = [], []
        for number, line in block.rows:
            words = line.split()
            try:
                values = [float(w) for w in words[1:7]]
                if len(values) != 6 or not np.isfinite(values).all():
                    raise ValueError(line)
            except ValueError as error:
                raise FileFormatError(
                    "this line is no state: time and six finite numbers", where=f"{path}:{number}", value=line[:60]
                ) from error
            texts.append(words[0])
            rows.append(values)
        if rows:
            times.append(tai_from_text(texts, meta["TIME_SYSTEM"], str(path)))
            states.append(1e3 * np.array(rows))
    if not times:
        raise FileFormatError("the message holds no states", where=str(path))
    time = np.concatenate(times)
    if (np.diff(time) < np.timedelta64(0, "us")).any():
        raise TimeOrderError("the states are not in the order of time", where=str(path))
    first = blocks[0].meta
    return Ephemeris(first["OBJECT_NAME"], first["OBJECT_ID"], frame, time, np.concatenate(states))


def write_oem(path: Path, ephemeris: Ephemeris, *, originator: str = "BORESIGHT", degree: int = 7) -> None:
    """Write states as an OEM 2.0 in UTC, kilometres and kilometres per second.

    Raises:
        TimeOrderError: the times do not strictly increase.
        RequestError: a state is not finite, or the frame is not known.
    """
    if (np.diff(ephemeris.time) <= np.timedelta64(0, "us")).any():
        raise TimeOrderError("the times of an ephemeris must strictly increase", where="ephemeris/time")
    if not np.isfinite(ephemeris.state).all():
        raise RequestError("a state is not finite", where="ephemeris/state")
    if ephemeris.frame not in ("EME2000", "GCRF", "ITRF"):
        raise RequestError("this frame is not known", where="ephemeris/frame", value=ephemeris.frame)
    texts = [utc_text(t).rstrip("Z") for t in ephemeris.time]
    frame = "ITRF2014" if ephemeris.frame == "ITRF" else ephemeris.frame
    lines = [
        "CCSDS_OEM_VERS = 2.0",
        f"CREATION_DATE = {texts[-1]}",
        f"ORIGINATOR = {originator}",
        "",
        "META_START",
        f"OBJECT_NAME = {ephemeris.name}",
        f"OBJECT_ID = {ephemeris.identifier}",
        "CENTER_NAME = EARTH",
        f"REF_FRAME = {frame}",
        "TIME_SYSTEM = UTC",
        f"START_TIME = {texts[0]}",
        f"STOP_TIME = {texts[-1]}",
        "INTERPOLATION = LAGRANGE",
        f"INTERPOLATION_DEGREE = {min(degree, len(texts) - 1)}",
        "META_STOP",
        "",
    ]
    for text, row in zip(texts, ephemeris.state, strict=True):
        lines.append(
            text + "".join(f" {v:.9f}" for v in row[:3] * 1e-3) + "".join(f" {v:.12f}" for v in row[3:] * 1e-3)
        )
    with written_atomically(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n")
