"""Attitude and orbit of a survey plan as files: the attitude every 0.1 s from the first scan to the last, the orbit
every second around it. A plan of several passes becomes one file with a segment for each pass where the format knows
segments (AEM, OEM), and one file for each pass otherwise.
"""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from estimator.models.files import written_atomically
from guidance.export.by_suffix import checked_suffix, write_attitude
from guidance.export.oem import write_oem
from guidance.export.series import AttitudeSeries, OrbitSeries
from guidance.orbit_propagation import FORCE_MODEL, INERTIAL_FRAME
from guidance.survey_plan import PlannedPass, SurveyPlan

ATTITUDE_STEP = 0.1  # s
ORBIT_STEP = 1.0  # s
ORBIT_MARGIN = 10.0  # s of orbit before and after the attitude


def attitude_series(plan: SurveyPlan, planned: PlannedPass) -> AttitudeSeries:
    """Attitude of one pass, every 0.1 s from its first scan's start and at its last scan's stop."""
    count = math.ceil((planned.stop - planned.start) / ATTITUDE_STEP - 1e-6)
    times = planned.start + ATTITUDE_STEP * np.arange(count + 1)
    times[-1] = planned.stop
    motion = planned.motion(times)
    return AttitudeSeries(times, motion.quaternion, motion.rate, motion.acceleration,
                          epoch=plan.request.orbit.epoch.isoformat(), reference_frame=INERTIAL_FRAME)


def orbit_series(plan: SurveyPlan, planned: PlannedPass) -> OrbitSeries:
    """Orbit around one pass, at whole seconds from the epoch."""
    first, last = math.floor(planned.start - ORBIT_MARGIN), math.ceil(planned.stop + ORBIT_MARGIN)
    times = np.arange(first, last + ORBIT_STEP, ORBIT_STEP)
    states = plan.orbit.states(times)
    return OrbitSeries(times, states[:, :3], states[:, 3:], epoch=plan.request.orbit.epoch.isoformat(),
                       reference_frame=INERTIAL_FRAME)


def save_attitude_and_orbit(plan: SurveyPlan, path: str | os.PathLike[str]) -> list[Path]:
    """Write the attitude in the format of the name's ending, and the orbit as OEM beside it.

    Returns:
        The files written.

    Raises:
        RequestError: no format has this ending.
    """
    target = Path(path)
    suffix = checked_suffix(target)
    attitudes = [attitude_series(plan, p) for p in plan.passes]
    comment = "Survey attitude, quaternion inertial to body; " + plan.orbit.earth.name
    written: list[Path] = []
    if len(attitudes) == 1:
        written += write_attitude(target, attitudes[0], comment=comment)
    elif suffix == ".aem":
        _segments(target, [partial(write_attitude, series=s, comment=comment) for s in attitudes])
        written.append(target)
    else:
        for number, series in enumerate(attitudes, 1):
            written += write_attitude(target.with_name(f"{target.stem}-pass-{number}{target.suffix}"), series)
    orbit = target.with_suffix(".oem")
    _segments(orbit, [partial(write_oem, series=orbit_series(plan, p), comment=FORCE_MODEL) for p in plan.passes])
    return [*written, orbit]


def _segments(target: Path, writers: list[Callable[[Path], object]]) -> None:
    """One file of several segments: the head of the first, then every segment."""
    parts: list[str] = []
    with tempfile.TemporaryDirectory(prefix="boresight-") as folder:
        for number, write in enumerate(writers):
            piece = Path(folder) / f"{number}{target.suffix}"
            write(piece)
            text = piece.read_text(encoding="ascii")
            parts.append(text if number == 0 else text[text.index("META_START"):])
    with written_atomically(target) as temporary:
        temporary.write_text("\n".join(parts), encoding="ascii")
