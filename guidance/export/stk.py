"""Attitude file of STK (extension .a): times from the scenario's epoch, quaternion with the scalar last."""

from __future__ import annotations

import os

import numpy as np

from estimator.models.errors import RequestError
from estimator.models.files import written_atomically
from guidance.export.series import AttitudeSeries

_AXES = {"EME2000": "J2000", "J2000": "J2000", "ICRF": "ICRF", "GCRF": "ICRF"}
_MONTHS = ("Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec")


def write_stk(path: str | os.PathLike[str], series: AttitudeSeries) -> None:
    """Write an attitude file whose quaternion takes the named inertial axes to the body.

    Raises:
        RequestError: the reference frame has no name in STK.
    """
    if series.reference_frame not in _AXES:
        raise RequestError("the frame has no name in STK", where="reference_frame", value=series.reference_frame,
                           remedy="use one of " + ", ".join(_AXES))
    date, clock = _utc(series).split("T")
    year, month, day = date.split("-")
    lines = ["stk.v.11.0", "BEGIN Attitude", f"NumberOfAttitudePoints {len(series.times)}",
             f"ScenarioEpoch {int(day)} {_MONTHS[int(month) - 1]} {year} {clock}", "BlockingFactor 20",
             "InterpolationOrder 1", "CentralBody Earth", f"CoordinateAxes {_AXES[series.reference_frame]}",
             "AttitudeTimeQuaternions"]
    last = np.concatenate([series.quaternion[:, 1:], series.quaternion[:, :1]], axis=1)
    for t, q in zip(series.times, last, strict=True):
        lines.append(f"{t:.9f}" + "".join(f" {v: .16f}" for v in q))
    lines += ["END Attitude", ""]
    with written_atomically(path) as temporary:
        temporary.write_text("\n".join(lines), encoding="ascii")


def _utc(series: AttitudeSeries) -> str:
    """The epoch in UTC, to the nanosecond."""
    from astropy.time import Time, TimeDelta

    if series.time_system == "GPS":
        moment = (Time(series.epoch, scale="tai") + TimeDelta(19.0, format="sec", scale="tai")).utc
    else:
        moment = Time(series.epoch, scale=series.time_system.lower()).utc
    moment.precision = 9
    return str(moment.isot)
