"""SPICE C-kernel (type 3, with angular velocity) with its spacecraft clock and frame kernels.

The quaternion of SPICE turns inertial coordinates into those of the body (the C-matrix), so that it is the conjugate of
``inertial_from_body``; the angular velocity is written in the inertial frame. The clock counts seconds of ephemeris
time from the first instant and ticks of 1/65536 s after the point. Ephemeris time is that of SPICE's own formula for
TDB - TT, so that ``str2et`` of a reader finds the same instants.
"""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from estimator.models.errors import MissingDataError, RequestError
from estimator.models.files import written_atomically
from guidance.export.series import AttitudeSeries
from guidance.kinematics import conjugate, rotate

Array = np.ndarray

TICKS = 65536  # per second
_FRAMES = {"EME2000": "J2000", "J2000": "J2000", "ICRF": "J2000", "GCRF": "J2000"}


def ephemeris_time(epoch: str, time_system: str) -> float:
    """Seconds of ephemeris time past J2000 of a calendar instant, by SPICE's formula for TDB - TT."""
    from astropy.time import Time

    if time_system == "TDB":
        begin = Time(epoch, scale="tdb")
        return float((begin - Time("2000-01-01T12:00:00", scale="tdb")).sec)
    if time_system == "GPS":
        tt = float((Time(epoch, scale="tai") - Time("2000-01-01T12:00:00", scale="tai")).sec) + 19.0 + 32.184
    else:
        tt = float((Time(epoch, scale=time_system.lower()).tt - Time("2000-01-01T12:00:00", scale="tt")).sec)
    et = tt
    for _ in range(3):
        anomaly = 6.239996 + 1.99096871e-7 * et  # rad, rad/s: mean anomaly of the Earth in the leap second kernel
        et = tt + 1.657e-3 * math.sin(anomaly + 1.671e-2 * math.sin(anomaly))  # s
    return et


def write_spice_ck(path: str | os.PathLike[str], series: AttitudeSeries, *, spacecraft: int = -999,
                   frame_name: str = "") -> dict[str, Path]:
    """Write ``path`` (CK), and beside it the clock (.tsc) and the frame (.tf) that it needs.

    Args:
        path: of the C-kernel; its suffix is replaced for the other two.
        series: what to write.
        spacecraft: negative NAIF number of the spacecraft; the frame's is a thousand times it.
        frame_name: of the body frame; the object's name with _BODY by default.

    Returns:
        The paths under "ck", "sclk", "fk".

    Raises:
        MissingDataError: spiceypy is not installed.
        RequestError: the reference frame has no name in SPICE, or the number is not negative.
    """
    try:
        import spiceypy
    except ImportError as error:
        raise MissingDataError("SPICE kernels need the package spiceypy", where="export",
                               remedy="install boresight[spice]") from error
    if series.reference_frame not in _FRAMES:
        raise RequestError("the frame has no name in SPICE", where="reference_frame", value=series.reference_frame,
                           remedy="use one of " + ", ".join(_FRAMES))
    if spacecraft >= 0:
        raise RequestError("the number of a spacecraft is negative in SPICE", where="spacecraft", value=spacecraft)
    ck = Path(path)
    files = {"ck": ck, "sclk": ck.with_suffix(".tsc"), "fk": ck.with_suffix(".tf")}
    if len(set(files.values())) < 3:
        raise RequestError("the C-kernel must not end in .tsc or .tf", where="path", value=str(path))
    frame = 1000 * spacecraft
    name = frame_name or "".join(c if c.isalnum() else "_" for c in series.object_name.upper()) + "_BODY"
    begin = ephemeris_time(series.epoch, series.time_system) + float(series.times[0])
    _write_clock(files["sclk"], spacecraft, begin)
    _write_frame(files["fk"], spacecraft, frame, name)
    elapsed = series.times - series.times[0]
    ticks = elapsed * TICKS
    inertial_rate = rotate(series.quaternion, series.rate)
    with written_atomically(ck) as temporary:
        temporary.unlink()
        _write_segment(spiceypy, temporary, ticks, frame, name, conjugate(series.quaternion), inertial_rate,
                       _FRAMES[series.reference_frame])
    return files


def _write_segment(spiceypy: Any, path: Path, ticks: Array, frame: int, name: str, quaternions: Array,
                   rates: Array, reference: str) -> None:
    handle = spiceypy.ckopn(str(path), "boresight attitude", 0)
    try:
        spiceypy.ckw03(handle, float(ticks[0]), float(ticks[-1]), frame, reference, True, name[:40], len(ticks),
                       ticks, np.ascontiguousarray(quaternions), np.ascontiguousarray(rates), 1, [float(ticks[0])])
    finally:
        spiceypy.ckcls(handle)


def _write_clock(path: Path, spacecraft: int, begin: float) -> None:
    """A clock of one partition that runs with ephemeris time from ``begin`` (s past J2000)."""
    n = -spacecraft
    text = f"""KPL/SCLK

Clock that counts seconds of ephemeris time from the first instant of the attitude.

\\begindata

SCLK_KERNEL_ID             = ( @2000-01-01/12:00:00 )
SCLK_DATA_TYPE_{n}         = ( 1 )
SCLK01_TIME_SYSTEM_{n}     = ( 1 )
SCLK01_N_FIELDS_{n}        = ( 2 )
SCLK01_MODULI_{n}          = ( 4294967296 {TICKS} )
SCLK01_OFFSETS_{n}         = ( 0 0 )
SCLK01_OUTPUT_DELIM_{n}    = ( 1 )
SCLK_PARTITION_START_{n}   = ( 0.0000000000000E+00 )
SCLK_PARTITION_END_{n}     = ( 2.8147497671065E+14 )
SCLK01_COEFFICIENTS_{n}    = ( 0.0000000000000E+00 {begin:.17E} 1.0000000000000E+00 )

\\begintext
"""
    with written_atomically(path) as temporary:
        temporary.write_text(text, encoding="ascii")


def _write_frame(path: Path, spacecraft: int, frame: int, name: str) -> None:
    """A frame whose orientation comes from the C-kernel."""
    text = f"""KPL/FK

Body frame of the spacecraft {spacecraft}, oriented by a C-kernel.

\\begindata

FRAME_{name} = {frame}
FRAME_{frame}_NAME = '{name}'
FRAME_{frame}_CLASS = 3
FRAME_{frame}_CLASS_ID = {frame}
FRAME_{frame}_CENTER = {spacecraft}
CK_{frame}_SCLK = {spacecraft}
CK_{frame}_SPK = {spacecraft}

\\begintext
"""
    with written_atomically(path) as temporary:
        temporary.write_text(text, encoding="ascii")
