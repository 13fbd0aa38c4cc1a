"""CCSDS Attitude Ephemeris Message (504.0-B), keyword = value notation.

Frame A is the inertial one, frame B the body (``SC_BODY_1``); in this order the quaternion of the message, written
with the scalar last, is the Hamilton ``inertial_from_body``. Version 2 carries the angular velocity of the body in body
axes, deg/s; version 1, on request, the quaternion alone.
"""

from __future__ import annotations

import os
from datetime import UTC, datetime

import numpy as np

from estimator.models.errors import RequestError
from estimator.models.files import written_atomically
from guidance.export.series import AttitudeSeries, calendar

BODY_FRAME = "SC_BODY_1"


def write_aem(path: str | os.PathLike[str], series: AttitudeSeries, *, version: int = 2,
              comment: str = "") -> None:
    """Write an attitude file.

    Args:
        path: of the file.
        series: what to write.
        version: 2, or 1 for old readers.
        comment: one line at the top of the metadata.

    Raises:
        RequestError: another version is asked for.
    """
    if version not in (1, 2):
        raise RequestError("no such version of the attitude ephemeris message", where="version", value=version,
                           limit="1 or 2")
    instants = calendar(series.epoch, series.time_system, series.times)
    lines = [f"CCSDS_AEM_VERS = {version}.0",
             f"CREATION_DATE = {datetime.now(UTC).strftime('%Y-%m-%dT%H:%M:%S')}",
             "ORIGINATOR = BORESIGHT", "", "META_START"]
    if comment:
        lines.append(f"COMMENT {' '.join(comment.split())}")
    lines += [f"OBJECT_NAME = {series.object_name}", f"OBJECT_ID = {series.object_id}", "CENTER_NAME = EARTH",
              f"REF_FRAME_A = {series.reference_frame}", f"REF_FRAME_B = {BODY_FRAME}"]
    if version == 1:
        lines.append("ATTITUDE_DIR = A2B")
    lines += [f"TIME_SYSTEM = {series.time_system}", f"START_TIME = {instants[0]}", f"STOP_TIME = {instants[-1]}"]
    if version == 2:
        lines += ["ATTITUDE_TYPE = QUATERNION/ANGVEL", f"ANGVEL_FRAME = {BODY_FRAME}"]
    else:
        lines += ["ATTITUDE_TYPE = QUATERNION", "QUATERNION_TYPE = LAST"]
    lines += ["INTERPOLATION_METHOD = LAGRANGE", f"INTERPOLATION_DEGREE = {min(7, len(instants) - 1)}", "META_STOP",
              "", "DATA_START"]
    last = np.concatenate([series.quaternion[:, 1:], series.quaternion[:, :1]], axis=1)
    rates = np.degrees(series.rate)
    for i, instant in enumerate(instants):
        row = instant + "".join(f" {v: .16f}" for v in last[i])
        if version == 2:
            row += "".join(f" {v: .15e}" for v in rates[i])
        lines.append(row)
    lines += ["DATA_STOP", ""]
    with written_atomically(path) as temporary:
        temporary.write_text("\n".join(lines), encoding="ascii")
