"""What a campaign must satisfy before it is used: each defect has its own typed error, each oddity is put right.

Accepted, and put right where needed:

- gaps of any length in any series, irregular sampling, arcs in any order, several stretches of star tracker data;
- quaternions that flip their sign (made continuous) or miss unit length by at most ``QUATERNION_LIMIT`` (normalized);
- beam directions that miss unit length by at most the same limit (normalized);
- campaigns without torque commands, without free-rotation arcs, without Doppler data;
- fewer than three beams, where the geometry changes enough over the campaign.

Refused: everything else that would give a wrong answer in silence. Times that go backwards or repeat are refused and
not sorted: when only the times were shuffled and not the rows, sorting would make a consistent lie. Units and the order
of quaternion components are checked against physics (the radius and speed of an orbit, the Doppler shift that the
measured velocity must cause, the conservation of angular momentum), each time with the reading that would fit.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from itertools import pairwise

import numpy as np

from estimator.models.errors import (
    ArcError,
    GeometryError,
    InputError,
    MissingDataError,
    NotFiniteError,
    QuaternionError,
    ShapeError,
    TimeOrderError,
    TooFewDataError,
    UnitError,
)
from problems.alignment.campaign import (
    Arc,
    Campaign,
    DopplerSeries,
    GnssSeries,
    Nominal,
    TorqueCommands,
    TrackerSeries,
)

QUATERNION_LIMIT = 1e-5
"""Largest deviation of a quaternion's or a direction's length from 1 that is taken for rounding and normalized."""

_EXACT = 1e-12  # a length this close to 1 is left alone, so that reading what was written changes no bit
_EARTH_RATE = 7.292115e-5  # [rad/s]
_EARTH_PARAMETER = 3.986004418e14  # [m3/s2]
_RADIUS_LIMITS = (6.3e6, 1e9)  # [m] below the ground at the poles; beyond the Moon
_SINGULAR_VALUE_LIMIT = 1e-3  # of the matrix of unit beam directions
_FEWEST_POSITIONS = 8
_FEWEST_ATTITUDES = 4
_FEWEST_ATTITUDES_PER_ARC = 4
_UNCOVERED_FRACTION = 0.2  # of an arc's length that may stay without data at either end


class InertiaError(InputError):
    """An inertia tensor that no rigid body has: not symmetric, not positive definite, triangle inequality violated."""


def checked(campaign: Campaign) -> Campaign:
    """The campaign, checked, with unit quaternions of continuous sign; checking twice changes nothing.

    Args:
        campaign: what a reader or a simulator made.

    Returns:
        The same campaign where nothing had to be put right.

    Raises:
        ShapeError, NotFiniteError, TimeOrderError, QuaternionError, UnitError, InertiaError, GeometryError,
        TooFewDataError, ArcError, MissingDataError: see the module.
    """
    from problems.alignment.plausibility import check_plausibility

    _check_epoch(campaign)
    gnss = _checked_gnss(campaign.gnss)
    star_tracker = _checked_tracker(campaign.star_tracker)
    doppler = None if campaign.doppler is None else _checked_doppler(campaign.doppler)
    if campaign.torque is not None:
        _check_torque(campaign.torque)
    nominal = _checked_nominal(campaign.nominal)
    _check_arc_declarations(campaign.arcs)
    for name, covariate in campaign.housekeeping.items():
        where = f"housekeeping/{name}"
        _check_shape(covariate.values, covariate.time.shape, where)
        _check_times(covariate.time, "housekeeping/time", fewest=1)
        _check_finite(covariate.values, where)
    result = replace(campaign, gnss=gnss, star_tracker=star_tracker, doppler=doppler, nominal=nominal)
    _check_earth(result)
    _check_orbit(result)
    _check_coverage(result)
    check_plausibility(result)
    return result


def attitude_known(campaign: Campaign, times: np.ndarray, *, longest_gap: float | None = None) -> np.ndarray:
    """Whether the star tracker saw the attitude around each time.

    Args:
        campaign: the campaign.
        times: (n,) s after the epoch.
        longest_gap: s; a time between two samples further apart than this is unknown. Default: five times the median
            interval between samples, at least 1 s.

    Returns:
        (n,) bool.
    """
    return _bracketed(campaign.star_tracker.time, times, longest_gap)


def _bracketed(samples: np.ndarray, times: np.ndarray, longest_gap: float | None = None) -> np.ndarray:
    """Whether two samples at most ``longest_gap`` apart bracket each time (or one falls on it)."""
    limit = max(5 * _median_step(samples), 1.0) if longest_gap is None else longest_gap
    after = np.clip(np.searchsorted(samples, times), 0, samples.size - 1)
    before = np.clip(np.searchsorted(samples, times, side="right") - 1, 0, samples.size - 1)
    inside = (times >= samples[0] - 1e-6) & (times <= samples[-1] + 1e-6)
    return inside & (samples[after] - samples[before] <= limit)


def _median_step(times: np.ndarray) -> float:
    """Median interval between neighbours; of a long series, of 2000 intervals spread over it."""
    if times.size < 2:
        return 0.0
    first = np.arange(times.size - 1) if times.size < 2000 else np.linspace(0, times.size - 2, 2000).astype(int)
    return float(np.median(times[first + 1] - times[first]))


# ---------------------------------------------------------------------------------------------------------------- #
# one array at a time


def _check_shape(values: np.ndarray, shape: tuple[int, ...], where: str) -> None:
    if values.shape != shape:
        raise ShapeError("the array has the wrong shape", where=where, value=values.shape, limit=shape)


def _check_finite(values: np.ndarray, where: str) -> None:
    """No NaN and no infinity; a constant standard deviation is looked at once."""
    if values.ndim > 0 and values.shape[0] > 0 and values.strides[0] == 0:
        values = values[:1]
    bad = ~np.isfinite(values)
    if bad.any():
        first = tuple(int(i) for i in np.argwhere(bad)[0])
        index = ", ".join(map(str, first))
        raise NotFiniteError(
            "a value is NaN or infinite" if bad.sum() == 1 else f"{int(bad.sum())} values are NaN or infinite",
            where=f"{where}[{index}]",
            value=float(values[first]),
            limit="finite",
            remedy="leave the sample out; gaps are accepted",
        )


def _check_times(times: np.ndarray, where: str, *, fewest: int) -> None:
    if times.ndim != 1:
        raise ShapeError("the times must have one dimension", where=where, value=times.shape)
    if times.size < fewest:
        raise TooFewDataError(
            "there are too few samples",
            where=where,
            value=times.size,
            limit=f"at least {fewest}",
            remedy="use a longer stretch of data",
        )
    _check_finite(times, where)
    steps = np.diff(times)
    wrong = np.flatnonzero(steps <= 0)
    if wrong.size:
        k = int(wrong[0])
        repeated = steps[k] == 0
        what = "a time is duplicated" if repeated else "the times go backwards"
        more = f" ({wrong.size} places)" if wrong.size > 1 else ""
        remedy = "keep one row for each time" if repeated else "sort the rows by time, each row together with its time"
        raise TimeOrderError(
            what + more,
            where=f"{where}[{k + 1}]",
            value=f"{times[k + 1]:.6f} s after {times[k]:.6f} s",
            limit="strictly increasing",
            remedy=remedy,
        )


def _check_positive(deviation: np.ndarray, shape: tuple[int, ...], where: str) -> None:
    _check_shape(deviation, shape, where)
    _check_finite(deviation, where)
    one = deviation[:1] if deviation.shape[0] > 0 and deviation.strides[0] == 0 else deviation
    if one.size and not (one > 0).all():
        first = tuple(int(i) for i in np.argwhere(one <= 0)[0])
        raise UnitError(
            "a standard deviation is not positive",
            where=f"{where}[{', '.join(map(str, first))}]",
            value=float(one[first]),
            limit="> 0",
            remedy="state the accuracy of the sensor",
        )


def _unit(vectors: np.ndarray, where: str, what: str, error: type[InputError]) -> np.ndarray:
    """The vectors along the last axis with length 1, or an error where they are not nearly so."""
    lengths = np.sqrt(np.sum(vectors * vectors, axis=-1))
    deviation = np.abs(lengths - 1)
    if deviation.size and deviation.max() > QUATERNION_LIMIT:
        first = np.unravel_index(int(np.argmax(deviation > QUATERNION_LIMIT)), deviation.shape)
        count = int((deviation > QUATERNION_LIMIT).sum())
        index = f"[{', '.join(str(int(i)) for i in first)}]" if first else ""
        raise error(
            f"{what} is not of unit length" + (f" ({count} of {deviation.size})" if count > 1 else ""),
            where=where + index,
            value=f"length {float(lengths[first]):.9g}",
            limit=f"1 within {QUATERNION_LIMIT:g}",
            remedy="check the components and their storage; do not normalize corrupted values",
        )
    if deviation.size and deviation.max() > _EXACT:
        return vectors / lengths[..., None]
    return vectors


def _continuous(quaternion: np.ndarray) -> np.ndarray:
    """The same rotations with signs chosen so that neighbours lie on the same side; the first keeps its sign."""
    if quaternion.shape[0] < 2:
        return quaternion
    flips = np.einsum("ij,ij->i", quaternion[1:], quaternion[:-1]) < 0
    if not flips.any():
        return quaternion
    sign = np.concatenate([[1.0], np.where(np.cumsum(flips) % 2 == 1, -1.0, 1.0)])
    return quaternion * sign[:, None]


# ---------------------------------------------------------------------------------------------------------------- #
# one group at a time


def _check_epoch(campaign: Campaign) -> None:
    try:
        datetime.fromisoformat(campaign.epoch.strip().replace("Z", "+00:00"))
    except ValueError as error:
        raise InputError(
            "the epoch is not a date and time in ISO 8601",
            where="epoch",
            value=repr(campaign.epoch),
            limit="such as 2024-03-01T00:00:00Z",
        ) from error


def _check_earth(campaign: Campaign) -> None:
    for name in ("earth_rotation_angle_at_epoch", "earth_rotation_rate"):
        if not np.isfinite(getattr(campaign, name)):
            raise NotFiniteError("the value is NaN or infinite", where=name, value=getattr(campaign, name))
    angle = campaign.earth_rotation_angle_at_epoch
    if abs(angle) > 2 * np.pi * (1 + 1e-9):
        looks = "; it looks like degrees" if abs(angle) <= 360 else ""
        raise UnitError(
            f"the angle exceeds one turn{looks}",
            where="earth_rotation_angle_at_epoch",
            value=f"{angle:.6g}",
            limit="2 pi rad",
            remedy="give it in radians, reduced to one turn",
        )
    rate = campaign.earth_rotation_rate
    if abs(rate - _EARTH_RATE) > 0.01 * _EARTH_RATE:
        looks = ""
        if abs(np.deg2rad(rate) / _EARTH_RATE - 1) < 0.01:
            looks = "; it looks like degrees per second"
        elif abs(rate / 86400 / _EARTH_RATE - 1) < 0.01:
            looks = "; it looks like radians per day"
        raise UnitError(
            f"the rate is not that of the Earth{looks}",
            where="earth_rotation_rate",
            value=f"{rate:.6g} rad/s",
            limit=f"{_EARTH_RATE:g} rad/s within 1 %",
            remedy="give it in rad/s, positive towards the east",
        )


def _checked_gnss(gnss: GnssSeries) -> GnssSeries:
    _check_times(gnss.time, "gnss/time", fewest=_FEWEST_POSITIONS)
    _check_shape(gnss.position, (gnss.time.size, 3), "gnss/position")
    _check_finite(gnss.position, "gnss/position")
    _check_positive(gnss.standard_deviation, gnss.position.shape, "gnss/position.standard_deviation")
    radius = np.sqrt(np.einsum("ij,ij->i", gnss.position, gnss.position))
    low, high = _RADIUS_LIMITS
    bad = np.flatnonzero((radius < low) | (radius > high))
    if bad.size:
        k = int(bad[0])
        looks = ""
        if low <= 1e3 * radius[k] <= high and radius[k] < low:
            looks = "; it looks like kilometres"
        elif radius[k] > high and low <= 1e-3 * radius[k] <= high:
            looks = "; it looks like millimetres"
        side = "below the Earth's surface" if radius[k] < low else "beyond the Moon"
        count = f" ({bad.size} of {radius.size} samples)" if bad.size > 1 else ""
        raise UnitError(
            f"the position lies {side}{looks}{count}",
            where=f"gnss/position[{k}]",
            value=f"{radius[k]:.6g} m from the centre of the Earth",
            limit=f"{low:g} m" if radius[k] < low else f"{high:g} m",
            remedy="give positions in metres",
        )
    return gnss


def _checked_tracker(tracker: TrackerSeries) -> TrackerSeries:
    _check_times(tracker.time, "star_tracker/time", fewest=_FEWEST_ATTITUDES)
    _check_shape(tracker.quaternion, (tracker.time.size, 4), "star_tracker/quaternion")
    _check_finite(tracker.quaternion, "star_tracker/quaternion")
    where = "star_tracker/quaternion.standard_deviation"
    _check_positive(tracker.standard_deviation, (tracker.time.size, 3), where)
    largest = float(np.median(tracker.standard_deviation.max(axis=1)))
    if largest > 0.1:
        raise UnitError(
            "the accuracy of the star tracker is no angle in radians; it looks like degrees or arc seconds",
            where=where,
            value=f"{largest:.6g}",
            limit="0.1 rad",
            remedy="give it in radians",
        )
    quaternion = _continuous(_unit(tracker.quaternion, "star_tracker/quaternion", "the quaternion", QuaternionError))
    return tracker if quaternion is tracker.quaternion else replace(tracker, quaternion=quaternion)


def _checked_doppler(doppler: DopplerSeries) -> DopplerSeries:
    _check_times(doppler.time, "doppler/time", fewest=1)
    if doppler.frequency_shift.ndim != 2 or doppler.frequency_shift.shape[1] < 1:
        raise ShapeError(
            "the array has the wrong shape",
            where="doppler/frequency_shift",
            value=doppler.frequency_shift.shape,
            limit="(time, beam) with at least one beam",
        )
    shape = (doppler.time.size, doppler.frequency_shift.shape[1])
    _check_shape(doppler.frequency_shift, shape, "doppler/frequency_shift")
    _check_finite(doppler.frequency_shift, "doppler/frequency_shift")
    _check_positive(doppler.standard_deviation, shape, "doppler/frequency_shift.standard_deviation")
    if doppler.frequency_shift.size < 3:
        raise TooFewDataError(
            "there are too few Doppler measurements for the three angles of the antenna",
            where="doppler/frequency_shift",
            value=doppler.frequency_shift.size,
            limit="at least 3",
            remedy="use a longer session",
        )
    if not np.isfinite(doppler.carrier_frequency):
        raise NotFiniteError(
            "the value is NaN or infinite",
            where="doppler/frequency_shift.carrier_frequency",
            value=doppler.carrier_frequency,
        )
    if not 1e7 <= doppler.carrier_frequency <= 1e12:  # [Hz]
        looks = "; it looks like gigahertz or megahertz" if 0.01 <= doppler.carrier_frequency < 1e7 else ""
        raise UnitError(
            f"the carrier frequency is not that of a radar{looks}",
            where="doppler/frequency_shift.carrier_frequency",
            value=f"{doppler.carrier_frequency:g} Hz",
            limit="1e7 to 1e12 Hz",
            remedy="give it in hertz",
        )
    direction = doppler.beam_direction
    beams = shape[1]
    if direction.ndim == 3:
        _check_shape(direction, (*shape, 3), "doppler/beam_direction")
    else:
        _check_shape(direction, (beams, 3), "doppler/beam_direction")
    _check_finite(direction, "doppler/beam_direction")
    unit = _unit(direction, "doppler/beam_direction", "the beam direction", GeometryError)
    if unit.ndim == 2 and beams >= 3:
        smallest = float(np.linalg.svd(unit, compute_uv=False)[-1])
        if smallest < _SINGULAR_VALUE_LIMIT:
            raise GeometryError(
                "the beams are coplanar: they do not see the velocity across their plane",
                where="doppler/beam_direction",
                value=f"smallest singular value {smallest:.3g}",
                limit=f"{_SINGULAR_VALUE_LIMIT:g}",
                remedy="check the directions, or add a beam outside the plane",
            )
    return doppler if unit is direction else replace(doppler, beam_direction=unit)


def _check_torque(torque: TorqueCommands) -> None:
    _check_shape(torque.stop, torque.start.shape, "torque/stop")
    _check_shape(torque.command, (torque.start.size, 3), "torque/command")
    _check_finite(torque.start, "torque/start")
    _check_finite(torque.stop, "torque/stop")
    _check_finite(torque.command, "torque/command")
    reversed_ = np.flatnonzero(torque.stop <= torque.start)
    if reversed_.size:
        k = int(reversed_[0])
        raise ArcError(
            "the torque segment does not end after its start",
            where=f"torque/stop[{k}]",
            value=f"start {torque.start[k]:g} s, stop {torque.stop[k]:g} s",
            limit="start < stop",
        )
    order = np.argsort(torque.start, kind="stable")
    for i, j in pairwise(order):
        if torque.start[j] < torque.stop[i] - 1e-9:
            raise ArcError(
                "two torque segments overlap",
                where=f"torque/start[{int(j)}]",
                value=f"{torque.start[j]:g} s",
                limit=f"not before {torque.stop[i]:g} s, when segment {int(i)} stops",
                remedy="add the torques where two commands act together",
            )


def _checked_nominal(nominal: Nominal) -> Nominal:
    unit = {}
    for name in ("antenna_from_tracker", "actuator_from_tracker"):
        values = getattr(nominal, name)
        where = f"nominal/{name}"
        _check_shape(values, (4,), where)
        _check_finite(values, where)
        unit[name] = _unit(values, where, "the quaternion", QuaternionError)
    check_inertia(nominal.inertia, "nominal/inertia")
    if all(unit[name] is getattr(nominal, name) for name in unit):
        return nominal
    return replace(nominal, **unit)


def check_inertia(inertia: np.ndarray, where: str) -> None:
    """A rigid body can have this inertia tensor.

    Args:
        inertia: (3, 3) kg m2.
        where: what the error calls it.

    Raises:
        ShapeError, NotFiniteError: no finite 3 x 3 matrix.
        InertiaError: not symmetric, not positive definite, or one principal moment exceeds the sum of the others.
        UnitError: a size that no spacecraft has.
    """
    _check_shape(inertia, (3, 3), where)
    _check_finite(inertia, where)
    scale = float(np.abs(inertia).max())
    asymmetry = float(np.abs(inertia - inertia.T).max())
    if asymmetry > 1e-6 * scale:
        raise InertiaError(
            "the inertia tensor is not symmetric",
            where=where,
            value=f"{asymmetry:.6g} kg m2",
            limit=f"{1e-6 * scale:.3g} kg m2",
            remedy="check the signs of the products of inertia",
        )
    moments = np.linalg.eigvalsh((inertia + inertia.T) / 2)
    if moments[0] <= 1e-9 * scale:
        raise InertiaError(
            "the inertia tensor is not positive definite",
            where=where,
            value=f"smallest principal moment {moments[0]:.6g} kg m2",
            limit="> 0",
            remedy="check the tensor and its unit; products of inertia stand off the diagonal",
        )
    excess = moments[2] - moments[0] - moments[1]
    if excess > 1e-9 * scale:
        raise InertiaError(
            "no body has this inertia tensor: its largest principal moment exceeds the sum of the others",
            where=where,
            value=f"{moments[2]:.6g} kg m2",
            limit=f"{moments[0] + moments[1]:.6g} kg m2",
            remedy="check the tensor; a matrix of second moments of mass is not an inertia tensor",
        )
    if not 1e-4 <= moments.sum() <= 1e9:
        raise UnitError(
            "the inertia tensor is not that of a spacecraft",
            where=where,
            value=f"trace {moments.sum():.3g} kg m2",
            limit="1e-4 to 1e9 kg m2",
            remedy="give it in kg m2",
        )


def _check_arc_declarations(arcs: tuple[Arc, ...]) -> None:
    for k, arc in enumerate(arcs):
        where = f"arcs[{k}] ({arc.name})"
        if arc.kind not in ("doppler", "free_rotation", "torque_pulse"):
            raise ArcError(
                "the kind of arc is unknown",
                where=where,
                value=repr(arc.kind),
                limit="doppler, free_rotation or torque_pulse",
            )
        if not (np.isfinite(arc.start) and np.isfinite(arc.stop)):
            raise NotFiniteError(
                "the start or stop of the arc is NaN or infinite",
                where=where,
                value=f"{arc.start} to {arc.stop}",
                limit="finite",
            )
        if arc.stop <= arc.start:
            raise ArcError(
                "the arc is reversed or empty",
                where=where,
                value=f"start {arc.start:g} s, stop {arc.stop:g} s",
                limit="start < stop",
            )
    ordered = sorted(arcs, key=lambda arc: arc.start)
    for before, after in pairwise(ordered):
        if after.start < before.stop - 1e-9:
            raise ArcError(
                f"the arcs {before.name!r} and {after.name!r} overlap",
                where="arcs",
                value=f"start {after.start:g} s",
                limit=f"not before {before.stop:g} s",
                remedy="a sample belongs to one arc; split or shorten one of them",
            )


# ---------------------------------------------------------------------------------------------------------------- #
# the groups together


def _check_orbit(campaign: Campaign) -> None:
    """Position and time are those of an orbit: the inertial speed lies near that of a circular orbit of that radius."""
    time, position = campaign.gnss.time, campaign.gnss.position
    stride = max(1, round(10.0 / max(_median_step(time), 1e-9))) if _median_step(time) < 10 else 1
    first = np.unique(np.linspace(0, time.size - 1 - stride, 400).astype(int)) if time.size > stride else np.arange(0)
    steps = time[first + stride] - time[first]
    chord = np.linalg.norm(position[first + stride] - position[first], axis=1)
    usable = steps < 300  # [s] a chord is an arc only over a small part of an orbit
    if time.size and not usable.any():
        usable = chord < np.linalg.norm(position[first], axis=1)
    if not usable.any():
        return
    first, steps = first[usable], steps[usable]
    velocity = (position[first + stride] - position[first]) / steps[:, None]
    middle = (position[first + stride] + position[first]) / 2
    inertial = velocity + campaign.earth_rotation_rate * np.stack([-middle[:, 1], middle[:, 0], 0 * middle[:, 0]], 1)
    radius = np.linalg.norm(middle, axis=1)
    ratio = float(np.median(np.linalg.norm(inertial, axis=1) / np.sqrt(_EARTH_PARAMETER / radius)))
    if 0.1 <= ratio <= 1.45:
        return
    speed = float(np.median(np.linalg.norm(velocity, axis=1)))
    looks = ""
    for factor, name in (
        (60.0, "minutes"),
        (3600.0, "hours"),
        (86400.0, "days"),
        (1e-3, "milliseconds"),
        (1e-6, "microseconds"),
    ):
        if 0.7 <= ratio / factor <= 1.3 or (factor < 1 and ratio < 0.1 and factor == 1e-3):
            looks = f"; the times look like {name}"
            break
    raise UnitError(
        f"positions and times are not those of an orbit{looks}",
        where="gnss",
        value=f"speed {speed:.4g} m/s at {np.median(radius):.4g} m from the centre of the Earth",
        limit="0.1 to 1.45 times the circular speed",
        remedy="give times in seconds and positions in metres",
    )


def _check_coverage(campaign: Campaign) -> None:
    """Arcs, torque segments and Doppler epochs lie inside the data that they need."""
    tracker_time = campaign.star_tracker.time
    kinds = {arc.kind for arc in campaign.arcs}
    if "doppler" in kinds and campaign.doppler is None:
        raise MissingDataError(
            "there are Doppler arcs and no Doppler data: the group 'doppler' is missing",
            where="doppler",
            remedy="add the group, or take the Doppler arcs out",
        )
    if "torque_pulse" in kinds and campaign.torque is None:
        raise MissingDataError(
            "there are torque-pulse arcs and no torque commands: the group 'torque' is missing",
            where="torque",
            remedy="add the group, or take the torque-pulse arcs out",
        )
    everything = [campaign.gnss.time, tracker_time] + ([] if campaign.doppler is None else [campaign.doppler.time])
    first, last = min(t[0] for t in everything), max(t[-1] for t in everything)
    for arc in campaign.arcs:
        _check_arc_inside(arc, first, last)
        if arc.kind == "doppler" and campaign.doppler is not None:
            _check_arc_data(arc, campaign.doppler.time, "doppler/time", fewest=1)
        elif arc.kind != "doppler":
            _check_arc_data(arc, tracker_time, "star_tracker/time", fewest=_FEWEST_ATTITUDES_PER_ARC)
    if campaign.torque is not None:
        _check_torque_inside(campaign, campaign.torque)
    if campaign.doppler is not None:
        _check_doppler_covered(campaign, campaign.doppler)


def _check_arc_inside(arc: Arc, first: float, last: float) -> None:
    slack = 0.05 * (arc.stop - arc.start)
    if arc.start < first - slack or arc.stop > last + slack:
        raise ArcError(
            f"the arc {arc.name!r} leaves the data",
            where="arcs",
            value=f"{arc.start:g} to {arc.stop:g} s",
            limit=f"data from {first:g} to {last:g} s",
            remedy="shorten the arc, or add the data that it needs",
        )


def _check_arc_data(arc: Arc, times: np.ndarray, where: str, *, fewest: int) -> None:
    a, b = np.searchsorted(times, [arc.start - 1e-9, arc.stop + 1e-9])
    inside = times[a:b]
    if inside.size == 0:
        raise ArcError(
            f"the arc {arc.name!r} ({arc.kind}) lies where there are no samples",
            where=where,
            value=f"{arc.start:g} to {arc.stop:g} s",
            limit="inside the data",
            remedy="check the times of the arc, or take it out",
        )
    if inside.size < fewest:
        raise TooFewDataError(
            f"the arc {arc.name!r} ({arc.kind}) has too few samples",
            where=where,
            value=inside.size,
            limit=f"at least {fewest}",
            remedy="take the arc out, or add samples",
        )
    uncovered = max(inside[0] - arc.start, arc.stop - inside[-1])
    limit = max(_UNCOVERED_FRACTION * (arc.stop - arc.start), 2 * _median_step(times))
    if uncovered > limit:
        raise ArcError(
            f"the arc {arc.name!r} ({arc.kind}) leaves the data",
            where=where,
            value=f"{uncovered:g} s at one end without samples",
            limit=f"{limit:g} s",
            remedy="shorten the arc to where there are samples",
        )


def _check_torque_inside(campaign: Campaign, torque: TorqueCommands) -> None:
    times = campaign.star_tracker.time
    for k, (start, stop) in enumerate(zip(torque.start, torque.stop, strict=True)):
        where = f"torque/start[{k}]"
        if start < times[0] - 1e-6 or stop > times[-1] + 1e-6:
            raise ArcError(
                "the torque segment lies outside the star tracker data",
                where=where,
                value=f"{start:g} to {stop:g} s",
                limit=f"{times[0]:g} to {times[-1]:g} s",
                remedy="check the times of the segment, or take it out",
            )
        for arc in campaign.arcs:
            if (
                arc.kind == "free_rotation"
                and start < arc.stop - 1e-9
                and stop > arc.start + 1e-9
                and torque.command[k].any()
            ):
                raise ArcError(
                    f"a torque is commanded in the free-rotation arc {arc.name!r}",
                    where=where,
                    value=f"{start:g} to {stop:g} s",
                    limit="no command in a free-rotation arc",
                    remedy="declare the arc as torque_pulse, or correct the times",
                )
    for arc in campaign.arcs_of_kind("torque_pulse"):
        if not any(a < arc.stop and b > arc.start for a, b in zip(torque.start, torque.stop, strict=True)):
            raise ArcError(
                f"no torque is commanded in the torque-pulse arc {arc.name!r}",
                where="torque",
                value=f"{arc.start:g} to {arc.stop:g} s",
                limit="at least one segment",
                remedy="check the times of the segments, or declare the arc as free_rotation",
            )


def _check_doppler_covered(campaign: Campaign, doppler: DopplerSeries) -> None:
    gnss = campaign.gnss.time
    margin = 2 * _median_step(gnss)
    outside = np.flatnonzero((doppler.time < gnss[0] - margin) | (doppler.time > gnss[-1] + margin))
    if outside.size:
        k = int(outside[0])
        raise ArcError(
            "Doppler is measured outside the navigation data, where the velocity is unknown "
            f"({outside.size} of {doppler.time.size} epochs)",
            where=f"doppler/time[{k}]",
            value=f"{doppler.time[k]:g} s",
            limit=f"{gnss[0]:g} to {gnss[-1]:g} s",
            remedy="leave these epochs out, or add positions",
        )
    known = attitude_known(campaign, doppler.time)
    if not known.any():
        raise ArcError(
            "no Doppler epoch lies inside the star tracker data",
            where="doppler/time",
            value=f"{doppler.time[0]:g} to {doppler.time[-1]:g} s",
            limit=f"{campaign.star_tracker.time[0]:g} to {campaign.star_tracker.time[-1]:g} s",
            remedy="check both time series",
        )
    sessions = campaign.arcs_of_kind("doppler")
    for arc in sessions:
        inside = (doppler.time >= arc.start - 1e-9) & (doppler.time <= arc.stop + 1e-9)
        if inside.any() and not known[inside].any():
            raise ArcError(
                f"the Doppler arc {arc.name!r} lies outside the star tracker data",
                where="star_tracker/time",
                value=f"{arc.start:g} to {arc.stop:g} s",
                limit="attitude known in the arc",
                remedy="add attitudes, or take the arc out",
            )
