"""One campaign of flight data in memory: what was measured, when, how well, and the design values.

Times are float64 seconds after ``epoch`` (UTC), on a uniform scale. Quaternions are scalar-first Hamilton and
``x_from_y`` maps coordinates from y to x. Frames: ``inertial`` (GCRF); ``earth_fixed``, turned about +z by
``earth_rotation_angle_at_epoch + earth_rotation_rate * t`` from inertial; ``tracker``, the star tracker's own axes, in
which everything rigid is expressed; ``antenna``; ``actuator``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

ArcKind = Literal["doppler", "free_rotation", "torque_pulse"]


@dataclass(frozen=True)
class GnssSeries:
    """Earth-fixed positions from the satellite navigation receiver.

    Attributes:
        time: (n,) s after the epoch, strictly increasing.
        position: (n, 3) m, Earth-fixed.
        standard_deviation: (n, 3) m, per axis.
    """

    time: np.ndarray
    position: np.ndarray
    standard_deviation: np.ndarray


@dataclass(frozen=True)
class TrackerSeries:
    """Attitude from the star tracker.

    Attributes:
        time: (n,) s after the epoch, strictly increasing, usually in several stretches.
        quaternion: (n, 4) ``tracker_from_inertial``, unit, sign free.
        standard_deviation: (n, 3) rad, small angles about the tracker axes.
    """

    time: np.ndarray
    quaternion: np.ndarray
    standard_deviation: np.ndarray


@dataclass(frozen=True)
class DopplerSeries:
    """Doppler shift of each beam of the radar.

    Attributes:
        time: (n,) s after the epoch, strictly increasing.
        frequency_shift: (n, b) Hz, positive when the spacecraft moves along the beam.
        standard_deviation: (n, b) Hz.
        beam_direction: (b, 3), or (n, b, 3) where it varies with time; unit vectors in antenna axes.
        carrier_frequency: Hz.
    """

    time: np.ndarray
    frequency_shift: np.ndarray
    standard_deviation: np.ndarray
    beam_direction: np.ndarray
    carrier_frequency: float


@dataclass(frozen=True)
class TorqueCommands:
    """Commanded torque, constant inside a segment and zero outside.

    Attributes:
        start, stop: (s,) s after the epoch.
        command: (s, 3) N m, actuator axes.
    """

    start: np.ndarray
    stop: np.ndarray
    command: np.ndarray


@dataclass(frozen=True)
class Arc:
    """A stretch of the campaign with one purpose, ``start <= t <= stop`` in s after the epoch."""

    name: str
    kind: ArcKind
    start: float
    stop: float


@dataclass(frozen=True)
class Nominal:
    """Design values: the prior and the starting point.

    Attributes:
        antenna_from_tracker, actuator_from_tracker: (4,) unit quaternions.
        inertia: (3, 3) kg m2, tracker axes.
    """

    antenna_from_tracker: np.ndarray
    actuator_from_tracker: np.ndarray
    inertia: np.ndarray


@dataclass(frozen=True)
class Covariate:
    """Housekeeping telemetry that an effect may depend on: ``time`` (n,) s, ``values`` (n,), ``unit``."""

    time: np.ndarray
    values: np.ndarray
    unit: str


@dataclass(frozen=True)
class Campaign:
    """Everything measured in one alignment campaign; the parts that a campaign does not have are None or empty."""

    title: str
    epoch: str
    earth_rotation_angle_at_epoch: float
    earth_rotation_rate: float
    gnss: GnssSeries
    star_tracker: TrackerSeries
    doppler: DopplerSeries | None
    torque: TorqueCommands | None
    arcs: tuple[Arc, ...]
    nominal: Nominal
    housekeeping: Mapping[str, Covariate] = field(default_factory=dict)

    def arcs_of_kind(self, kind: ArcKind) -> tuple[Arc, ...]:
        """The arcs of one kind, in order of time."""
        return tuple(sorted((a for a in self.arcs if a.kind == kind), key=lambda a: a.start))
