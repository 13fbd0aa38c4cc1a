"""CCSDS Orbit Ephemeris Message (502.0-B), version 2, keyword = value notation; kilometres and kilometres a second."""

from __future__ import annotations

import os
from datetime import UTC, datetime

from estimator.models.files import written_atomically
from guidance.export.series import OrbitSeries, calendar


def write_oem(path: str | os.PathLike[str], series: OrbitSeries, *, comment: str = "") -> None:
    """Write an orbit file.

    Args:
        path: of the file.
        series: what to write.
        comment: one line at the top of the metadata.
    """
    instants = calendar(series.epoch, series.time_system, series.times)
    lines = ["CCSDS_OEM_VERS = 2.0", f"CREATION_DATE = {datetime.now(UTC).strftime('%Y-%m-%dT%H:%M:%S')}",
             "ORIGINATOR = BORESIGHT", "", "META_START"]
    if comment:
        lines.append(f"COMMENT {' '.join(comment.split())}")
    lines += [f"OBJECT_NAME = {series.object_name}", f"OBJECT_ID = {series.object_id}",
              f"CENTER_NAME = {series.center}", f"REF_FRAME = {series.reference_frame}",
              f"TIME_SYSTEM = {series.time_system}", f"START_TIME = {instants[0]}", f"STOP_TIME = {instants[-1]}",
              "INTERPOLATION = LAGRANGE", f"INTERPOLATION_DEGREE = {min(7, len(instants) - 1)}", "META_STOP", ""]
    for i, instant in enumerate(instants):
        lines.append(instant + "".join(f" {v / 1e3: .12f}" for v in series.position[i])
                     + "".join(f" {v / 1e3: .15f}" for v in series.velocity[i]))
    lines.append("")
    with written_atomically(path) as temporary:
        temporary.write_text("\n".join(lines), encoding="ascii")
