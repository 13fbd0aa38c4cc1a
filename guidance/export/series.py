"""What an attitude or an orbit file holds, checked before a line is written."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from estimator.models.errors import NotFiniteError, RequestError, ShapeError, TimeOrderError
from guidance.kinematics import Motion, sign_continuous, unit_quaternion

Array = np.ndarray

TIME_SYSTEMS = ("UTC", "TAI", "TT", "TDB", "GPS")


def _check_times(times: Array, where: str) -> None:
    if times.ndim != 1 or len(times) < 2:
        raise ShapeError("at least two instants are wanted", where=f"{where}/times", value=f"shape {times.shape}")
    if not np.all(np.isfinite(times)):
        raise NotFiniteError("a time is not finite", where=f"{where}/times")
    step = float(np.min(np.diff(times)))
    if step < 1e-9:
        raise TimeOrderError("the times do not increase by a nanosecond or more", where=f"{where}/times",
                             value=f"step {step:g} s", limit="1e-9 s")


def _check_system(name: str) -> None:
    if name not in TIME_SYSTEMS:
        raise RequestError("unknown time system", where="time_system", value=name,
                           remedy="known ones are " + ", ".join(TIME_SYSTEMS))


@dataclass(frozen=True)
class AttitudeSeries:
    """Attitude of a body over time.

    Attributes:
        times: (n,), s from the epoch, increasing.
        quaternion: ``inertial_from_body`` (n, 4), scalar first, made sign-continuous.
        rate: body axes (n, 3), rad/s.
        acceleration: body axes (n, 3), rad/s2, or None.
        epoch: calendar date and time, ISO 8601, in ``time_system``.
        time_system: UTC, TAI, TT, TDB or GPS.
        reference_frame: name of the inertial frame (EME2000, ICRF, GCRF).
        object_name, object_id: of the spacecraft.

    Raises:
        ShapeError, NotFiniteError, TimeOrderError, QuaternionError, RequestError: readers take many broken files
            without a word, so that they are refused here.
    """

    times: Array
    quaternion: Array
    rate: Array
    acceleration: Array | None = None
    epoch: str = "2000-01-01T12:00:00"
    time_system: str = "UTC"
    reference_frame: str = "EME2000"
    object_name: str = "SPACECRAFT"
    object_id: str = "2000-001A"

    def __post_init__(self) -> None:
        times = np.asarray(self.times, dtype=float)
        _check_times(times, "attitude")
        _check_system(self.time_system)
        for name, width in (("quaternion", 4), ("rate", 3), ("acceleration", 3)):
            value = getattr(self, name)
            if value is None:
                continue
            array = np.asarray(value, dtype=float)
            if array.shape != (len(times), width):
                raise ShapeError(f"one row of {width} numbers per instant is wanted", where=f"attitude/{name}",
                                 value=f"shape {array.shape}")
            if not np.all(np.isfinite(array)):
                raise NotFiniteError("a value is not finite", where=f"attitude/{name}")
            object.__setattr__(self, name, array)
        quaternion = unit_quaternion(self.quaternion, where="attitude/quaternion", tolerance=1e-9)
        object.__setattr__(self, "quaternion", sign_continuous(quaternion))
        object.__setattr__(self, "times", times)


@dataclass(frozen=True)
class OrbitSeries:
    """Position and velocity over time.

    Attributes:
        times: (n,), s from the epoch, increasing.
        position: (n, 3), m, in ``reference_frame``.
        velocity: (n, 3), m/s.
        epoch, time_system, reference_frame, object_name, object_id: as in :class:`AttitudeSeries`.
        center: name of the central body.
    """

    times: Array
    position: Array
    velocity: Array
    epoch: str = "2000-01-01T12:00:00"
    time_system: str = "UTC"
    reference_frame: str = "EME2000"
    object_name: str = "SPACECRAFT"
    object_id: str = "2000-001A"
    center: str = "EARTH"

    def __post_init__(self) -> None:
        times = np.asarray(self.times, dtype=float)
        _check_times(times, "orbit")
        _check_system(self.time_system)
        object.__setattr__(self, "times", times)
        for name in ("position", "velocity"):
            array = np.asarray(getattr(self, name), dtype=float)
            if array.shape != (len(times), 3):
                raise ShapeError("one row of 3 numbers per instant is wanted", where=f"orbit/{name}",
                                 value=f"shape {array.shape}")
            if not np.all(np.isfinite(array)):
                raise NotFiniteError("a value is not finite", where=f"orbit/{name}")
            object.__setattr__(self, name, array)


def sampling_times(duration: float, step: float) -> Array:
    """Every ``step`` seconds (to the nanosecond) from 0, and the end itself, so that no file stops short of it."""
    count = math.floor(duration / step + 1e-9)
    times = np.round(np.arange(count + 1) * step, 9)
    end = math.floor(duration * 1e9) / 1e9
    if end - times[-1] > 1e-6:
        times = np.append(times, end)
    elif len(times) > 1 or end > times[-1]:
        times[-1] = min(times[-1], end)
    return times if len(times) > 1 else np.array([0.0, max(end, 1e-6)])


def series_of(times: Array, motion: Motion, **names: str) -> AttitudeSeries:
    """The series of a motion at ``times``; ``names`` are those of :class:`AttitudeSeries` (epoch, frame, object)."""
    return AttitudeSeries(times, motion.quaternion, motion.rate, motion.acceleration, **names)


def calendar(epoch: str, time_system: str, times: Array) -> list[str]:
    """Calendar instants to the nanosecond of ``times`` (s after ``epoch``), leap seconds of UTC included."""
    from astropy.time import Time, TimeDelta

    scale = {"UTC": "utc", "TAI": "tai", "TT": "tt", "TDB": "tdb", "GPS": "tai"}[time_system]
    try:
        begin = Time(epoch, scale=scale, format="isot")
    except ValueError as error:
        raise RequestError("the epoch is not a date and time", where="epoch", value=epoch,
                           remedy="write it as 2025-06-21T08:30:00") from error
    if scale == "utc":
        moments = (begin.tai + TimeDelta(times, format="sec", scale="tai")).utc
    else:
        moments = begin + TimeDelta(times, format="sec", scale=scale)
    moments.precision = 9
    return [str(v) for v in moments.isot]
