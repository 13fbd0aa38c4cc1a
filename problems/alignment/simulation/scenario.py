"""Every number of a simulated campaign in one immutable object, and the named presets.

SI units and radians; angles in the presets are written in degrees or seconds of arc and converted here.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from estimator.models.errors import RequestError

DEGREE = math.pi / 180.0  # [rad]
ARCSECOND = DEGREE / 3600.0  # [rad]

Vector = tuple[float, float, float]
Matrix3 = tuple[Vector, Vector, Vector]
Quaternion = tuple[float, float, float, float]
Interval = tuple[float, float]


@dataclass(frozen=True)
class Scenario:
    """What a campaign is made of. ``dataclasses.replace`` gives a variant; :func:`preset` gives a named one.

    Attributes:
        title, epoch: of the campaign file; the epoch is UTC, ISO 8601.
        duration: s, span of the satellite navigation data.
        semi_major_axis: m, osculating at the epoch.
        eccentricity, inclination: 1, rad.
        ascending_node, argument_of_perigee, true_anomaly: rad, inertial; None draws each from the seed.
        zonal_coefficients: J2, J3, ... of the gravity field, 1.
        earth_rotation_angle_at_epoch: rad; None draws it from the seed.
        earth_rotation_rate: rad/s.
        gnss_step, gnss_noise: s; m per axis (standard deviation).
        star_tracker_step, star_tracker_noise: s; rad about the three tracker axes.
        doppler_step, doppler_noise, carrier_frequency: s; Hz; Hz.
        doppler_time_offset: s, of the Doppler epochs after the start of a session, so that they need not be epochs
            of the star tracker.
        beams, beam_cone: number; half angle in rad of the cone about antenna +z that the beams lie on.
        doppler_sessions, session_duration: number; s.
        look_angle: rad, roll of antenna +z away from nadir.
        pointing_spread: rad, standard deviation of the constant offset of a session about antenna x, y, z.
        slew_amplitude, slew_period: rad about antenna x, y, z; shortest and longest period in s. In a session each
            angle swings as a sine with a drawn phase.
        slew_profile: where not empty, the manoeuvre of every session instead of the sines: coefficients (at least 4
            rows of three, rad about antenna x, y, z) of cubic B-splines with uniform knots over the session, added to
            the look angle and the drawn offset.
        free_arcs, free_duration, free_rate, free_spacing: number; s; rad/s; s between arcs.
        free_axis_clearance: rad, least angle between the initial rate and every principal axis.
        free_initial_rates: where not empty, the rates (rad/s, tracker axes) at the start of the free arcs, one for
            each, instead of drawn ones.
        pulse_axes: one torque arc for each entry, on that actuator axis (0, 1, 2).
        pulse_duration, pulse_spacing: s.
        pulse_segments: (start, stop, torque) for each segment of a torque arc, s after its start and N m.
        pulse_directions: where not empty, direction (3, actuator axes) of the torque of each torque arc instead of
            its axis; the torque of a segment is its number times this vector.
        pulse_initial_rate: rad/s, standard deviation of each component of the rate at the start of a torque arc.
        antenna_from_tracker, actuator_from_tracker: nominal quaternions.
        mounting_spread: rad, standard deviation about each axis of the true mounting against the nominal one.
        inertia: nominal, kg m2, tracker axes.
        inertia_spread: 1, standard deviation of the relative change of the mass distribution; the true tensor is
            physical for any value.
        gnss_outlier_fraction, star_tracker_outlier_fraction, doppler_outlier_fraction: fraction of gross errors.
        outlier_size: smallest and largest size of a gross error in standard deviations (logarithmic draw).
        gnss_gaps, star_tracker_gaps, doppler_gaps: (start, stop) of missing data, s after the epoch.
        gnss_jitter, star_tracker_jitter, doppler_jitter: width of the uniform scatter of the epochs as a fraction of
            the step, below 1. Doppler epochs that are a subset of the tracker's follow the tracker's scatter.
        noise_variation: every sample has its own standard deviation, drawn between 1/(1 + v) and 1 + v times the
            nominal one; 0 gives one constant standard deviation.
        gnss_noise_factor, star_tracker_noise_factor, doppler_noise_factor: actual noise over declared noise.
        housekeeping: add telemetry (antenna temperature, orbit-periodic, and its heater current).
    """

    title: str = "simulated alignment campaign"
    epoch: str = "2024-03-01T00:00:00Z"
    duration: float = 21600.0
    semi_major_axis: float = 7071.0e3  # [m]
    eccentricity: float = 1.0e-3
    inclination: float = 98.18 * DEGREE
    ascending_node: float | None = None
    argument_of_perigee: float | None = None
    true_anomaly: float | None = None
    zonal_coefficients: tuple[float, ...] = (1.08262668e-3, -2.5326565e-6, -1.6196216e-6)
    earth_rotation_angle_at_epoch: float | None = None
    earth_rotation_rate: float = 7.292115e-5  # [rad/s]

    gnss_step: float = 1.0
    gnss_noise: float = 3.0
    star_tracker_step: float = 0.25
    star_tracker_noise: Vector = (8.0 * ARCSECOND, 8.0 * ARCSECOND, 40.0 * ARCSECOND)
    doppler_step: float = 0.5
    doppler_noise: float = 2.0
    carrier_frequency: float = 9.6e9
    doppler_time_offset: float = 0.0
    beams: int = 3
    beam_cone: float = 18.0 * DEGREE

    doppler_sessions: int = 12
    session_duration: float = 60.0
    look_angle: float = 35.0 * DEGREE
    pointing_spread: Vector = (15.0 * DEGREE, 8.0 * DEGREE, 10.0 * DEGREE)
    slew_amplitude: Vector = (8.0 * DEGREE, 5.0 * DEGREE, 5.0 * DEGREE)
    slew_period: Interval = (240.0, 480.0)
    slew_profile: tuple[Vector, ...] = ()

    free_arcs: int = 3
    free_duration: float = 600.0
    free_rate: float = 0.75 * DEGREE
    free_spacing: float = 200.0
    free_axis_clearance: float = 20.0 * DEGREE
    free_initial_rates: tuple[Vector, ...] = ()
    pulse_axes: tuple[int, ...] = (0, 1, 2)
    pulse_duration: float = 120.0
    pulse_spacing: float = 180.0
    pulse_segments: tuple[tuple[float, float, float], ...] = ((10.0, 40.0, 0.6), (40.0, 70.0, -0.6), (80.0, 100.0, 0.4))
    pulse_directions: tuple[Vector, ...] = ()
    pulse_initial_rate: float = 0.03 * DEGREE

    antenna_from_tracker: Quaternion = (0.970443150, -0.165623190, -0.123728550, -0.124500210)
    actuator_from_tracker: Quaternion = (0.883635489, -0.418486364, -0.195143396, -0.077308088)
    mounting_spread: float = 0.3 * DEGREE
    inertia: Matrix3 = ((828.3, -32.3, 18.4), (-32.3, 769.8, -150.3), (18.4, -150.3, 710.9))
    inertia_spread: float = 0.01

    gnss_outlier_fraction: float = 0.0
    star_tracker_outlier_fraction: float = 0.0
    doppler_outlier_fraction: float = 0.0
    outlier_size: Interval = (20.0, 1000.0)
    gnss_gaps: tuple[Interval, ...] = ()
    star_tracker_gaps: tuple[Interval, ...] = ()
    doppler_gaps: tuple[Interval, ...] = ()
    gnss_jitter: float = 0.0
    star_tracker_jitter: float = 0.0
    doppler_jitter: float = 0.0
    noise_variation: float = 0.0
    gnss_noise_factor: float = 1.0
    star_tracker_noise_factor: float = 1.0
    doppler_noise_factor: float = 1.0
    housekeeping: bool = False

    def __post_init__(self) -> None:
        for declared in dataclasses.fields(self):
            _require_kind(declared.name, getattr(self, declared.name), declared.default)
        for name in ("duration", "semi_major_axis", "gnss_step", "star_tracker_step", "doppler_step",
                     "carrier_frequency", "session_duration", "free_duration", "pulse_duration", "gnss_noise",
                     "doppler_noise"):
            _require(self, name, lambda x: x > 0.0, "more than 0")
        for name in ("doppler_sessions", "free_arcs", "mounting_spread", "inertia_spread", "noise_variation",
                     "doppler_time_offset", "free_rate", "pulse_initial_rate", "free_spacing", "pulse_spacing",
                     "gnss_noise_factor", "star_tracker_noise_factor", "doppler_noise_factor"):
            _require(self, name, lambda x: x >= 0.0, "at least 0")
        for name in ("gnss_outlier_fraction", "star_tracker_outlier_fraction", "doppler_outlier_fraction"):
            _require(self, name, lambda x: 0.0 <= x <= 0.5, "between 0 and 0.5")
        for name in ("gnss_jitter", "star_tracker_jitter", "doppler_jitter", "eccentricity"):
            _require(self, name, lambda x: 0.0 <= x < 1.0, "at least 0 and less than 1")
        _require(self, "free_axis_clearance", lambda x: 0.0 <= x <= 40.0 * DEGREE, "between 0 and 40 degrees")
        _require(self, "beams", lambda x: x >= 1, "at least 1")
        if min(self.star_tracker_noise) <= 0.0:
            raise RequestError("the noise must be more than 0", where="scenario.star_tracker_noise",
                               value=self.star_tracker_noise, remedy="give three standard deviations in rad")
        if any(axis not in (0, 1, 2) for axis in self.pulse_axes):
            raise RequestError("an actuator axis is 0, 1 or 2", where="scenario.pulse_axes", value=self.pulse_axes)
        if 0 < len(self.slew_profile) < 4:
            raise RequestError("a profile has too few coefficients", where="scenario.slew_profile",
                               value=len(self.slew_profile), limit="4 or more, or none")
        for name, arcs in (("free_initial_rates", self.free_arcs), ("pulse_directions", len(self.pulse_axes))):
            if getattr(self, name) and len(getattr(self, name)) != arcs:
                raise RequestError("each arc needs one", where=f"scenario.{name}", value=len(getattr(self, name)),
                                   limit=f"{arcs}, or none")
        previous = 0.0
        for start, stop, _ in self.pulse_segments:
            if not previous <= start < stop <= self.pulse_duration:
                raise RequestError("torque segments must be in order, apart, and inside the arc",
                                   where="scenario.pulse_segments", value=(start, stop),
                                   limit=f"{previous} to {self.pulse_duration} s")
            previous = stop
        moments = np.linalg.eigvalsh(np.array(self.inertia))
        if moments[0] <= 0.0 or moments[2] > moments[0] + moments[1]:
            raise RequestError("the inertia tensor is not that of a body", where="scenario.inertia",
                               value=tuple(float(m) for m in moments),
                               limit="positive principal moments, none above the sum of the others",
                               remedy="give the tensor in kg m2, tracker axes")


def _require(scenario: Scenario, name: str, holds: Callable[[float], bool], limit: str) -> None:
    value = getattr(scenario, name)
    if not (math.isfinite(value) and holds(value)):
        raise RequestError("the number cannot be used", where=f"scenario.{name}", value=value, limit=limit,
                           remedy="change it in the scenario")


def _require_kind(name: str, value: Any, default: Any) -> None:
    """A text where the default is a text, a whole number where it is one, finite numbers in a tuple, and so on."""
    number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    if isinstance(default, bool | str):
        good = isinstance(value, type(default))
    elif isinstance(default, int):
        good = number and value == int(value)
    elif isinstance(default, tuple):
        numbers = np.asarray(_flat(value) if isinstance(value, tuple) else [None], dtype=object)
        good = isinstance(value, tuple) and all(isinstance(x, int | float) and math.isfinite(x) for x in numbers)
        triples = name in ("pulse_segments", "slew_profile", "free_initial_rates", "pulse_directions")
        fixed = name not in ("zonal_coefficients", "pulse_axes") and not triples and not name.endswith("_gaps")
        good = good and (not fixed or np.shape(value) == np.shape(default))
        row = 3 if triples else 2
        if triples or name.endswith("_gaps"):
            good = good and all(isinstance(x, tuple) and len(x) == row for x in value)
    else:
        good = number or (default is None and value is None)
    if not good:
        raise RequestError("the value is of the wrong kind", where=f"scenario.{name}", value=repr(value),
                           limit=f"something like {default!r}", remedy="change it in the scenario")


def _flat(value: Any) -> list[Any]:
    return [x for part in value for x in _flat(part)] if isinstance(value, tuple) else [value]


def _tilted(moments: Vector, tilt_degrees: Vector) -> Matrix3:
    """Inertia tensor with principal axes turned by small angles about x, y, z (degrees)."""
    axes = np.eye(3)
    for axis, angle in enumerate(tilt_degrees):
        c, s = math.cos(angle * DEGREE), math.sin(angle * DEGREE)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        turn = np.eye(3)
        turn[i, i], turn[i, j], turn[j, i], turn[j, j] = c, -s, s, c
        axes = turn @ axes
    tensor = axes @ np.diag(moments) @ axes.T
    a, b, c_ = (tuple(float(x) for x in row) for row in 0.5 * (tensor + tensor.T))
    return (a, b, c_)  # type: ignore[return-value]


def _seconds_of_arc(across: float, about: float) -> Vector:
    return (across * ARCSECOND, across * ARCSECOND, about * ARCSECOND)


def _article(**changes: Any) -> Scenario:
    """The setting of the published experiment: one long Doppler session with slews, one free arc, three pulses."""
    base: dict[str, Any] = {
        "duration": 21600.0,
        "gnss_noise": 5.0,
        "star_tracker_step": 0.2,
        "doppler_step": 0.2,
        "star_tracker_noise": _seconds_of_arc(10.0, 60.0),
        "doppler_noise": 2.0,
        "beam_cone": 15.0 * DEGREE,
        "doppler_sessions": 1,
        "session_duration": 600.0,
        "pointing_spread": (0.0, 0.0, 0.0),
        "slew_amplitude": (30.0 * DEGREE, 10.0 * DEGREE, 10.0 * DEGREE),
        "slew_period": (300.0, 600.0),
        "free_arcs": 1,
        "free_duration": 1200.0,
        "free_rate": 0.44 * DEGREE,
        "pulse_duration": 100.0,
        "pulse_segments": ((20.0, 80.0, 0.1),),
        "inertia": _tilted((1200.0, 900.0, 500.0), (5.0, -3.0, 4.0)),
    }
    return Scenario(**(base | changes))


_COMPACT: dict[str, Any] = {
    "duration": 3600.0,
    "gnss_step": 2.0,
    "doppler_sessions": 6,
    "session_duration": 30.0,
    "free_arcs": 2,
    "free_duration": 300.0,
    "free_spacing": 60.0,
    "pulse_duration": 80.0,
    "pulse_spacing": 40.0,
    "pulse_segments": ((5.0, 25.0, 0.6), (25.0, 45.0, -0.6), (50.0, 65.0, 0.4)),
    "star_tracker_step": 0.5,
}

PRESETS: dict[str, Callable[[], Scenario]] = {
    "reference": Scenario,
    "compact": lambda: Scenario(**_COMPACT),
    "base": _article,
    "good": lambda: _article(
        doppler_noise=1.0, star_tracker_noise=_seconds_of_arc(5.0, 40.0), gnss_noise=1.5, star_tracker_step=0.1,
        doppler_step=0.1,
    ),
    "bad-short": lambda: _article(
        carrier_frequency=5.4e9, doppler_noise=5.0, star_tracker_noise=_seconds_of_arc(20.0, 100.0),
        gnss_noise=10.0, star_tracker_step=0.25, doppler_step=0.25, free_duration=600.0,
    ),
    "small-slews": lambda: _article(slew_amplitude=(5.0 * DEGREE, 2.0 * DEGREE, 2.0 * DEGREE)),
    "no-slews": lambda: _article(slew_amplitude=(0.0, 0.0, 0.0)),
    "slow": lambda: _article(free_rate=0.18 * DEGREE),
    "near-axisymmetric": lambda: _article(inertia=_tilted((1200.0, 1150.0, 500.0), (5.0, -3.0, 4.0))),
    "full": lambda: Scenario(duration=172799.8, gnss_step=0.2, doppler_sessions=20),
    "single-pulse": lambda: dataclasses.replace(Scenario(), pulse_axes=(0,)),
    "no-torque": lambda: dataclasses.replace(Scenario(), pulse_axes=()),
    "no-free-rotation": lambda: dataclasses.replace(Scenario(), free_arcs=0),
    "no-rotation": lambda: dataclasses.replace(Scenario(), free_arcs=0, pulse_axes=()),
}
"""Named scenarios: ``reference`` (6 h), ``compact`` (every channel, about 1 h), ``full`` (2 days at 0.2 s), the
settings of the published comparison (``base`` to ``near-axisymmetric``), and campaigns that lack a kind of arc."""


def preset(name: str, **changes: Any) -> Scenario:
    """A named scenario, with some of its numbers changed.

    Raises:
        RequestError: no preset of that name, no such number, or a number that cannot be used.
    """
    if name not in PRESETS:
        raise RequestError("there is no preset of this name", where="preset", value=name,
                           limit=", ".join(PRESETS), remedy="choose one of these")
    scenario = PRESETS[name]()
    known = {f.name for f in dataclasses.fields(Scenario)}
    if unknown := sorted(set(changes) - known):
        raise RequestError("a scenario has no such number", where="preset", value=unknown,
                           limit=", ".join(sorted(known)))
    return dataclasses.replace(scenario, **changes)
