"""Units, signs and component orders of a campaign, checked against the physics that its own data must obey.

A file that says quaternion, hertz and radian but holds the scalar last, kilohertz and degrees passes every check of one
array at a time. Here the data are held against each other: the velocity from navigation turned by the attitude must be
the velocity that the beams see, angular momentum must be constant in free rotation, and a commanded torque must change
it by its impulse. A reading other than the declared one is named only where the declared one fails badly and the
other fits well; data that are merely noisy, biased or short pass, because explaining them is the estimator's work.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.models.errors import UnitError
from problems.alignment.campaign import Arc, Campaign, DopplerSeries, TrackerSeries

SPEED_OF_LIGHT = 299792458.0  # [m/s]

_FAILS, _FITS, _BETTER = 0.05, 0.02, 0.2
"""Relative misfit from which the declared reading is in doubt, below which another one fits, and their least ratio."""

_CONTRADICTS = 0.1
"""Median relative misfit of velocities that no sensor error and no mounting explains."""

_MOMENTUM_FAILS, _MOMENTUM_FITS, _MOMENTUM_BETTER = 0.1, 0.1, 0.15
"""Relative change of angular momentum; with a design inertia that is wrong by 20 % it may change by as much."""
_SPREAD = 0.05  # smallest singular value of the beams from which the velocity is seen in all directions
_MOUNT_FAILS, _MOUNT_FITS = np.deg2rad(20.0), np.deg2rad(8.0)  # of a design mounting from what the data say
_EPOCHS = 300  # of a series that are looked at

_READINGS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "scalar last (x, y, z, w)": lambda q: np.roll(q, 1, axis=-1),
    "conjugated (inertial_from_tracker)": lambda q: q * np.array([1.0, -1.0, -1.0, -1.0]),
    "scalar last and conjugated": lambda q: np.roll(q, 1, axis=-1) * np.array([1.0, -1.0, -1.0, -1.0]),
}


def check_plausibility(campaign: Campaign) -> None:
    """Refuse a campaign whose data contradict each other as declared and agree under another reading.

    Args:
        campaign: finite, ordered, with unit quaternions.

    Raises:
        UnitError: says the reading that would fit.
    """
    _check_tracker_accuracy(campaign.star_tracker)
    if campaign.doppler is not None:
        _check_doppler(campaign, campaign.doppler)
    _check_momentum(campaign)
    _check_actuators(campaign)


# ---------------------------------------------------------------------------------------------------------------- #
# Doppler against navigation and attitude


def earth_fixed_velocity(campaign: Campaign, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rough Earth-fixed velocity from position differences over about 20 s, and where it can be had.

    Args:
        campaign: the campaign.
        times: (n,) s.

    Returns:
        (n, 3) m/s, good to about 1 %, and (n,) bool.
    """
    t, p = campaign.gnss.time, campaign.gnss.position
    left = np.clip(np.searchsorted(t, times - 10.0, side="right") - 1, 0, t.size - 1)
    right = np.clip(np.searchsorted(t, times + 10.0), 0, t.size - 1)
    span = t[right] - t[left]
    usable = (span > 0) & (span < 200)
    # position differences give the velocity at the middle; the Earth's pull carries it to the asked time
    middle = (t[left] + t[right]) / 2
    gravity = -3.986004418e14 * p[left] / np.linalg.norm(p[left], axis=1)[:, None] ** 3  # [m/s2]
    velocity = (p[right] - p[left]) / np.where(usable, span, 1.0)[:, None] + gravity * (times - middle)[:, None]
    return velocity, usable & (np.abs(times - middle) < 100)


def _nearest(times: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index of the nearest time, and its distance."""
    right = np.clip(np.searchsorted(times, wanted), 1, times.size - 1)
    index = np.where(np.abs(times[right] - wanted) < np.abs(times[right - 1] - wanted), right, right - 1)
    return index, np.abs(times[index] - wanted)


def _wahba(target: np.ndarray, source: np.ndarray) -> tuple[Rotation, float]:
    """Rotation that brings the source vectors (n, 3) nearest to the target, and the median relative misfit."""
    left, _, right = np.linalg.svd(target.T @ source)
    sign = np.sign(np.linalg.det(left @ right))
    rotation = Rotation.from_matrix(left @ np.diag([1.0, 1.0, sign]) @ right)
    misfit = np.linalg.norm(target - rotation.apply(source), axis=1) / np.linalg.norm(source, axis=1)
    return rotation, float(np.median(misfit))


def _check_doppler(campaign: Campaign, doppler: DopplerSeries) -> None:
    rows = np.unique(np.linspace(0, doppler.time.size - 1, _EPOCHS).astype(int))
    velocity, usable = earth_fixed_velocity(campaign, doppler.time[rows])
    index, distance = _nearest(campaign.star_tracker.time, doppler.time[rows])
    keep = usable & (distance <= 2.0)
    rows, velocity, index = rows[keep], velocity[keep], index[keep]
    if rows.size < 3:
        return
    speed = np.linalg.norm(velocity, axis=1)
    shift = doppler.frequency_shift[rows] * SPEED_OF_LIGHT / (2 * doppler.carrier_frequency)  # [m/s] along each beam
    fastest = float(np.median(np.abs(shift).max(axis=1) / speed))
    if fastest > 1.2:
        raise UnitError(
            f"the Doppler shift exceeds what the spacecraft's speed can cause{_unit_hint(fastest)}",
            where="doppler/frequency_shift",
            value=f"{fastest:.3g} times the speed along a beam",
            limit="1",
            remedy="give the shift and the carrier in hertz",
        )
    attitude = campaign.star_tracker.quaternion[index]
    time = doppler.time[rows]
    beams = doppler.beam_direction[rows] if doppler.beam_direction.ndim == 3 else doppler.beam_direction[None]
    spread = np.linalg.svd(beams, compute_uv=False)
    if beams.shape[1] >= 3 and spread[:, 2].min() > _SPREAD:
        inverse = np.broadcast_to(np.linalg.pinv(beams), (rows.size, 3, beams.shape[1]))
        seen = np.einsum("nik,nk->ni", inverse, shift)
        amplification = float(np.median(1 / spread[:, 2]))
        ratio = float(np.median(np.linalg.norm(seen, axis=1) / speed))
        if not 0.5 <= ratio <= 2.0:
            raise UnitError(
                f"the speed that the beams see is not the speed of the spacecraft{_unit_hint(ratio)}",
                where="doppler/frequency_shift",
                value=f"{ratio:.3g} times the speed from navigation",
                limit="0.5 to 2",
                remedy="give the shift and the carrier in hertz, two-way",
            )
        deviation = (
            float(np.median(doppler.standard_deviation[rows])) * SPEED_OF_LIGHT / (2 * doppler.carrier_frequency)
        )
        noise = 2 * amplification * deviation / float(np.median(speed))
        rotation = _check_readings_by_wahba(campaign, seen, velocity, time, attitude, noise)
        _check_nominal(campaign.nominal.antenna_from_tracker, rotation, "nominal/antenna_from_tracker")
    else:
        _check_readings_by_design(campaign, doppler, rows, shift, velocity, time, attitude)


def _unit_hint(ratio: float) -> str:
    for factor, name in (
        (1e-3, "; it looks like kilohertz"),
        (1e-6, "; it looks like megahertz"),
        (1e3, "; it looks like millihertz"),
        (1e-9, "; it looks like gigahertz"),
    ):
        if 0.3 * factor <= ratio <= 3 * factor:
            return name
    return ""


def _tracker_velocity(
    campaign: Campaign, velocity: np.ndarray, time: np.ndarray, quaternion: np.ndarray, angle: float
) -> np.ndarray:
    turned = Rotation.from_rotvec(np.outer(angle + campaign.earth_rotation_rate * time, [0.0, 0.0, 1.0]))
    return (Rotation.from_quat(quaternion, scalar_first=True) * turned).apply(velocity)


def _alternatives(
    campaign: Campaign, velocity: np.ndarray, time: np.ndarray, quaternion: np.ndarray
) -> dict[str, tuple[str, np.ndarray]]:
    """For each other reading: where it would be wrong, and the velocity in tracker axes that it gives."""
    angle = campaign.earth_rotation_angle_at_epoch
    found = {
        f"the quaternions look like {name}": (
            "star_tracker/quaternion",
            _tracker_velocity(campaign, velocity, time, read(quaternion), angle),
        )
        for name, read in _READINGS.items()
    }
    found["the angle looks like degrees"] = (
        "earth_rotation_angle_at_epoch",
        _tracker_velocity(campaign, velocity, time, quaternion, np.deg2rad(angle)),
    )
    found["the Doppler shift looks like it had the opposite sign"] = (
        "doppler/frequency_shift",
        -_tracker_velocity(campaign, velocity, time, quaternion, angle),
    )
    return found


def _check_readings_by_wahba(
    campaign: Campaign, seen: np.ndarray, velocity: np.ndarray, time: np.ndarray, quaternion: np.ndarray, noise: float
) -> Rotation | None:
    """The mounting that explains the beams best as declared, where it fits; a reading that fits better is an error."""
    declared = _tracker_velocity(campaign, velocity, time, quaternion, campaign.earth_rotation_angle_at_epoch)
    rotation, misfit = _wahba(seen, declared)
    if misfit > _FAILS + noise:
        others = [
            (_wahba(seen, other)[1], what, where)
            for what, (where, other) in _alternatives(campaign, velocity, time, quaternion).items()
        ]
        _refuse_if_better(misfit, others, fits=_FITS + noise, contradicts=_CONTRADICTS + noise)
    spread = np.linalg.svd(declared / np.linalg.norm(declared, axis=1)[:, None], compute_uv=False)
    determined = spread[1] > 0.05 * spread[0]  # two directions at least
    return rotation if determined and misfit < _FITS else None


def _check_readings_by_design(
    campaign: Campaign,
    doppler: DopplerSeries,
    rows: np.ndarray,
    shift: np.ndarray,
    velocity: np.ndarray,
    time: np.ndarray,
    quaternion: np.ndarray,
) -> None:
    """Compare readings by the Doppler shift that the design mounting predicts."""
    beams = doppler.beam_direction[rows] if doppler.beam_direction.ndim == 3 else doppler.beam_direction[None]
    mount = Rotation.from_quat(campaign.nominal.antenna_from_tracker, scalar_first=True)
    speed = np.linalg.norm(velocity, axis=1)[:, None]

    def misfit(in_tracker: np.ndarray) -> float:
        predicted = np.einsum("nkj,nj->nk", np.broadcast_to(beams, (*shift.shape, 3)), mount.apply(in_tracker))
        return float(np.median(np.abs(shift - predicted) / speed))

    declared = misfit(_tracker_velocity(campaign, velocity, time, quaternion, campaign.earth_rotation_angle_at_epoch))
    if declared > 2 * _FAILS:
        _refuse_if_better(
            declared,
            [
                (misfit(other), what, where)
                for what, (where, other) in _alternatives(campaign, velocity, time, quaternion).items()
            ],
            fits=_FAILS,
            contradicts=np.inf,  # a design mounting that is badly wrong is no contradiction of the data
        )


def _refuse_if_better(
    declared: float, others: list[tuple[float, str, str]], *, fits: float, contradicts: float
) -> None:
    best, what, where = min(others)
    if best < fits and best < _BETTER * declared:
        raise UnitError(
            f"attitude, navigation and Doppler contradict each other as declared; {what}",
            where=where,
            value=f"velocity misfit {declared:.3g}, read otherwise {best:.3g}",
            limit=f"{_FAILS:g}",
            remedy="quaternions are tracker_from_inertial, scalar first; angles are in radians",
        )
    if declared > contradicts:
        raise UnitError(
            "attitude, navigation and Doppler contradict each other, and no other order of components, sign or "
            "unit that was tried makes them agree",
            where="doppler/frequency_shift",
            value=f"velocity misfit {declared:.3g} of the speed",
            limit=f"{contradicts:.3g}",
            remedy="check that the rows of each series belong to its times, and all frames",
        )


def _check_nominal(declared: np.ndarray, found: Rotation | None, where: str) -> None:
    """The design mounting is that of the data, or at least not another reading of it."""
    if found is None:
        return
    error = _angle(declared, found)
    if error <= _MOUNT_FAILS:
        return
    other, name = min((_angle(read(declared), found), name) for name, read in _READINGS.items())
    if other < _MOUNT_FITS:
        raise UnitError(
            f"the design quaternion contradicts the data as declared; it looks like {name.split(' (')[0]}",
            where=where,
            value=f"{np.rad2deg(error):.3g} deg from the data, read otherwise {np.rad2deg(other):.2g} deg",
            limit=f"{np.rad2deg(_MOUNT_FAILS):.0f} deg",
            remedy="store x_from_tracker, scalar first",
        )


def _angle(quaternion: np.ndarray, rotation: Rotation) -> float:
    return float((Rotation.from_quat(quaternion, scalar_first=True) * rotation.inv()).magnitude())


# ---------------------------------------------------------------------------------------------------------------- #
# the star tracker's accuracy against its own scatter


def _check_tracker_accuracy(tracker: TrackerSeries) -> None:
    """A declared accuracy of more than 0.001 rad that is 57 times the scatter of the data is in degrees."""
    declared = np.median(tracker.standard_deviation, axis=0)
    if declared.max() < 1e-3 or tracker.time.size < 50:
        return
    step = np.diff(tracker.time)
    rotation = Rotation.from_quat(tracker.quaternion, scalar_first=True)
    turn = (rotation[1:] * rotation[:-1].inv()).as_rotvec()
    even = (np.abs(step[1:-1] - step[:-2]) < 1e-3 * step[1:-1]) & (np.abs(step[2:] - step[1:-1]) < 1e-3 * step[1:-1])
    third = (turn[2:] - 2 * turn[1:-1] + turn[:-2])[even]
    if third.shape[0] < 30:
        return
    scatter = 1.4826 * np.median(np.abs(third - np.median(third, axis=0)), axis=0) / np.sqrt(20.0)
    ratio = declared / np.maximum(scatter, 1e-12)
    if ((ratio > 30) & (ratio < 110)).all():
        raise UnitError(
            "the accuracy of the star tracker looks like degrees: it is about 57 times the scatter of its data",
            where="star_tracker/quaternion.standard_deviation",
            value=f"{ratio.max():.3g} times the scatter",
            limit="30",
            remedy="give it in radians",
        )


# ---------------------------------------------------------------------------------------------------------------- #
# angular momentum


def _rates(tracker: TrackerSeries, quaternion: np.ndarray, arc: Arc) -> tuple[np.ndarray, np.ndarray, Rotation] | None:
    """Times, angular velocity (tracker axes, rad/s) and attitude at the middle of chords of about 5 s along an arc."""
    a, b = np.searchsorted(tracker.time, [arc.start - 1e-9, arc.stop + 1e-9])
    time = tracker.time[a:b]
    if time.size < 8:
        return None
    half = max(1, round(2.5 / float(np.median(np.diff(time)))))
    middle = np.arange(half, time.size - half)
    if middle.size < 3:
        return None
    middle = middle[:: max(1, middle.size // 100)]
    span = time[middle + half] - time[middle - half]
    rotation = Rotation.from_quat(quaternion[a:b], scalar_first=True)
    # tracker_from_inertial turns by exp(-w t) on its left: the chord is symmetric about the middle
    rate = -(rotation[middle + half] * rotation[middle - half].inv()).as_rotvec() / span[:, None]
    centred = (np.abs(time[middle + half] + time[middle - half] - 2 * time[middle]) < 0.1 * span) & (span < 30)
    chord = np.linalg.norm(rate, axis=1) * span < 1.0  # [rad]
    good = centred & chord
    return (time[middle][good], rate[good], rotation[middle][good]) if good.sum() >= 3 else None


def _momentum(
    tracker: TrackerSeries, quaternion: np.ndarray, arc: Arc, inertia: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Times and angular momentum in inertial axes along an arc, with the design inertia."""
    found = _rates(tracker, quaternion, arc)
    if found is None:
        return None
    time, rate, rotation = found
    return time, rotation.inv().apply(rate @ inertia)


def _check_momentum(campaign: Campaign) -> None:
    """In free rotation the direction and size of the angular momentum stay; under another reading they must not."""
    tracker, inertia = campaign.star_tracker, campaign.nominal.inertia

    def wander(quaternion: np.ndarray) -> float:
        changes = []
        for arc in campaign.arcs_of_kind("free_rotation"):
            found = _momentum(tracker, quaternion, arc, inertia)
            if found is not None:
                momentum = found[1]
                mean = momentum.mean(axis=0)
                size = np.sqrt(np.mean(np.sum(momentum**2, axis=1)))
                changes.append(float(np.sqrt(np.mean(np.sum((momentum - mean) ** 2, axis=1))) / size))
        return max(changes) if changes else 0.0

    declared = wander(tracker.quaternion)
    if declared < _MOMENTUM_FAILS:
        return
    other, name = min((wander(read(tracker.quaternion)), name) for name, read in _READINGS.items())
    if other < _MOMENTUM_FITS and other < _MOMENTUM_BETTER * declared:
        raise UnitError(
            f"angular momentum is not constant in free rotation as declared; the quaternions look like {name}",
            where="star_tracker/quaternion",
            value=f"relative change {declared:.2g}, read otherwise {other:.2g}",
            limit=f"{_MOMENTUM_FAILS:g}",
            remedy="store tracker_from_inertial, scalar first",
        )


def _check_actuators(campaign: Campaign) -> None:
    """Commanded torques change the angular momentum by their impulse, in the axes and the unit that are declared."""
    if campaign.torque is None or campaign.torque.start.size == 0:
        return
    torque, tracker = campaign.torque, campaign.star_tracker
    blocks, targets = [], []
    for arc in campaign.arcs_of_kind("torque_pulse"):
        found = _momentum(tracker, tracker.quaternion, arc, campaign.nominal.inertia)
        if found is None:
            continue
        time, momentum = found
        a, b = np.searchsorted(tracker.time, [arc.start - 1e-9, arc.stop + 1e-9])
        sample = tracker.time[a:b]
        inertial_from_tracker = Rotation.from_quat(tracker.quaternion[a:b], scalar_first=True).inv().as_matrix()
        active = ((sample[:, None] >= torque.start) & (sample[:, None] < torque.stop)).astype(float) @ torque.command
        # d(momentum)/dt = inertial_from_tracker @ M @ command, linear in the nine elements of M
        design = np.einsum("nij,nk->nijk", inertial_from_tracker, active).reshape(-1, 3, 9)
        step = np.diff(sample)[:, None, None]
        integral = np.concatenate([np.zeros((1, 3, 9)), np.cumsum((design[1:] + design[:-1]) / 2 * step, axis=0)])
        rows = integral[np.searchsorted(sample, time)]
        blocks.append((rows - rows.mean(axis=0)).reshape(-1, 9))
        targets.append((momentum - momentum.mean(axis=0)).reshape(-1))
    if not blocks:
        return
    matrix, target = np.concatenate(blocks), np.concatenate(targets)
    size = np.linalg.svd(matrix, compute_uv=False)
    if size[-1] < 1e-2 * size[0] or matrix.shape[0] < 30:  # commands about fewer than three axes
        return
    solution = np.linalg.lstsq(matrix, target, rcond=None)[0]
    misfit = np.linalg.norm(target - matrix @ solution) / max(float(np.linalg.norm(target)), 1e-300)
    if misfit > 0.5:
        return
    left, gains, right = np.linalg.svd(solution.reshape(3, 3))
    scale = float(np.exp(np.mean(np.log(np.maximum(gains, 1e-300)))))
    if not 0.05 <= scale <= 20:
        looks = ""
        for factor, name in (
            (1e-3, "the torque looks like millinewton metres or the inertia is a thousand times too small"),
            (1e3, "the torque looks like kilonewton metres or the inertia is a thousand times too large"),
            (1e4, "the inertia looks like kg cm2"),
            (1e7, "the inertia looks like g cm2"),
        ):
            if 0.4 <= scale / factor <= 2.5:
                looks = f"; {name}"
        raise UnitError(
            f"torque commands and inertia do not belong together{looks}",
            where="torque/command",
            value=f"the momentum changes by {scale:.3g} times the commanded impulse",
            limit="0.05 to 20",
            remedy="give torques in N m and the inertia in kg m2",
        )
    tracker_from_actuator = Rotation.from_matrix(left @ np.diag([1, 1, np.sign(np.linalg.det(left @ right))]) @ right)
    if gains[-1] > 0.3 * gains[0]:
        _check_nominal(
            campaign.nominal.actuator_from_tracker, tracker_from_actuator.inv(), "nominal/actuator_from_tracker"
        )
