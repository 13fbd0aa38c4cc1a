"""Sentinel-1 annotations as an alignment campaign: is the antenna where the attitude says it is?

The Doppler centroid of a SAR image says how far the beam really looks ahead of or behind the plane of zero Doppler. The
annotation carries it twice: predicted from orbit and attitude, and measured. Here the prediction is made again from
orbit, attitude and the Earth's orientation (:func:`geometry_doppler`), and the measurement becomes a campaign
(:func:`import_sentinel1`) in which the antenna's mounting is unknown.

How a campaign is laid out:

- ``tracker`` axes are the body axes of the annotated attitude, ``antenna`` axes coincide with them by design: y against
  the velocity (the antenna's long axis), the beams in the x-z plane about -z. The nominal mounting is the identity.
- ``inertial`` is the frame that coincides with the true Earth-fixed frame when turned by the campaign's plain rotation
  about +z: precession, nutation, polar motion and UT1 are put into the star tracker quaternions, sample by sample, so
  that the plain model of the campaign file loses nothing.
- one row of Doppler data is one estimate of one sub-swath (bursts of different sub-swaths have different times); its
  three beams are three slant ranges inside the sub-swath, the nodes of the Gauss-Legendre rule, where a polynomial of
  second degree fitted to evenly spaced values has uncorrelated errors. Beam directions therefore vary with time.
- the accuracy of a value is the annotated RMS of the radar data about the fit, undivided: the errors along range are
  correlated (0.6 from one fine estimate to the next), so that twenty fine estimates average no better than a few.
- the attitude at the Doppler epochs stands among the star tracker samples: turned at constant rate between the two
  neighbouring samples, or beyond the last two for at most ``LONGEST_EXTRAPOLATION``.
- one Doppler arc is one acquisition: all sub-swaths and slices that follow each other without a pause.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from estimator.models.earth_orientation import (
    EARTH_ROTATION_RATE,
    earth_fixed_from_celestial,
    earth_rotation_angle,
    utc_text,
)
from estimator.models.errors import GeometryError, MissingDataError, RequestError, TooFewDataError
from problems.alignment.campaign import Arc, Campaign, DopplerSeries, GnssSeries, Nominal, TrackerSeries
from problems.alignment.checks import checked
from problems.readers.sentinel1_annotation import Annotation, AttitudeVectors, DopplerEstimate, read_annotation
from problems.readers.sentinel1_orbit_file import OrbitFile, StateVectors, read_orbit_file

SPEED_OF_LIGHT = 299792458.0  # [m/s]
SEMI_MAJOR_AXIS = 6378137.0  # [m] WGS84
SEMI_MINOR_AXIS = 6356752.314245  # [m] WGS84

LONGEST_EXTRAPOLATION = 5.0
"""How far beyond the attitude list a Doppler estimate may lie, s; later ones are left out."""

POSITION_DEVIATION = 0.1
"""Standard deviation given to orbit state vectors, m per axis: the mission's requirement for its restituted orbit."""

ATTITUDE_DEVIATION = 15e-6
"""Standard deviation given to the attitude, rad per axis: 4 Hz of Doppler, the part of the scatter along track of
measured minus predicted Doppler that the sub-swaths of one scene have in common (2 to 8 Hz)."""

_LONGEST_PAUSE = np.timedelta64(30, "s")  # between slices of one acquisition
_ORBIT_MARGIN = np.timedelta64(100, "s")  # of state vectors from an orbit file, on both sides of an acquisition
_SAME_ESTIMATE = 0.5  # [s] the same estimate in two slices or polarisations
_SMALLEST_RMS = 1.0  # [Hz]
_NODES = np.polynomial.legendre.leggauss(3)[0]  # on -1 to 1
_NOMINAL_INERTIA = np.diag(
    [9000.0, 5000.0, 9000.0]
)  # [kg m2] size of a 2300 kg body; nothing in the data depends on it


def _seconds(times: np.ndarray, origin: np.datetime64) -> np.ndarray:
    return (times - origin) / np.timedelta64(1, "us") * 1e-6


def attitude_at(attitude: AttitudeVectors, times: np.ndarray) -> Rotation:
    """``celestial_from_body`` at given times, turning at constant rate between samples and beyond the ends.

    Args:
        attitude: at least two samples.
        times: (n,) datetime64[us], TAI.

    Raises:
        TooFewDataError: fewer than two samples.
    """
    if attitude.time.size < 2:
        raise TooFewDataError("the attitude list is too short", value=attitude.time.size, limit="at least 2 samples")
    samples = _seconds(attitude.time, attitude.time[0])
    wanted = _seconds(times, attitude.time[0])
    left = np.clip(np.searchsorted(samples, wanted) - 1, 0, samples.size - 2)
    rotation = Rotation.from_quat(attitude.celestial_from_body, scalar_first=True)
    turn = (rotation[left].inv() * rotation[left + 1]).as_rotvec()
    fraction = (wanted - samples[left]) / (samples[left + 1] - samples[left])
    return rotation[left] * Rotation.from_rotvec(turn * fraction[:, None])


def orbit_at(orbit: StateVectors, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Earth-fixed position (n, 3) m and velocity (n, 3) m/s at given times (cubic Hermite interpolation).

    Raises:
        MissingDataError: the state vectors do not cover the times.
    """
    outside = (times < orbit.time[0]) | (times > orbit.time[-1])
    if outside.any() or orbit.time.size < 2:
        when = times[outside][0] if outside.any() else times[0]
        raise MissingDataError(
            "the orbit does not cover this time",
            value=utc_text(when),
            limit=f"{utc_text(orbit.time[0])} to {utc_text(orbit.time[-1])}",
            remedy="add an orbit file of the acquisition",
        )
    origin = orbit.time[0]
    curve = CubicHermiteSpline(_seconds(orbit.time, origin), orbit.position, orbit.velocity)
    seconds = _seconds(times, origin)
    return curve(seconds), curve(seconds, 1)


def beam_directions(
    slant_time: np.ndarray, position: np.ndarray, earth_fixed_from_body: Rotation, height: np.ndarray
) -> np.ndarray:
    """Directions in the body x-z plane in which the radar sees the Earth at given slant ranges.

    Args:
        slant_time: (n, k) s, two-way.
        position: (n, 3) m, Earth-fixed.
        earth_fixed_from_body: n rotations.
        height: (n,) m, of the scene above the WGS84 ellipsoid.

    Returns:
        (n, k, 3) unit vectors in body axes, on the side of nadir where the antenna (body -z) looks.

    Raises:
        GeometryError: a slant range at which the x-z plane does not meet the Earth.
    """
    distance = SPEED_OF_LIGHT / 2 * slant_time
    matrix = earth_fixed_from_body.as_matrix()
    radius = np.linalg.norm(position, axis=1)
    down = -np.einsum("nji,nj->ni", matrix, position) / radius[:, None]
    nadir = np.arctan2(down[:, 0], -down[:, 2])
    axes = np.stack([SEMI_MAJOR_AXIS + height, SEMI_MAJOR_AXIS + height, SEMI_MINOR_AXIS + height], axis=1)
    ground = 1 / np.sqrt(np.sum((position / radius[:, None] / axes) ** 2, axis=1))
    cosine = (radius[:, None] ** 2 + distance**2 - ground[:, None] ** 2) / (2 * radius[:, None] * distance)
    with np.errstate(invalid="ignore"):
        angle = nadir[:, None] - np.sign(nadir)[:, None] * np.arccos(cosine)

    def miss(angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far the point at that angle lies off the ellipsoid (relative), and the derivative by the angle."""
        beam = np.stack([np.sin(angle), np.zeros_like(angle), -np.cos(angle)], axis=-1)
        slope = np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], axis=-1)
        scale = axes[:, None, :]
        point = (position[:, None, :] + distance[..., None] * np.einsum("nij,nkj->nki", matrix, beam)) / scale
        change = distance[..., None] * np.einsum("nij,nkj->nki", matrix, slope) / scale
        return np.sum(point**2, axis=-1) - 1, 2 * np.sum(point * change, axis=-1)

    for _ in range(8):  # Newton; the start from a sphere of the local radius is good to a few hundredths of a degree
        value, slope = miss(angle)
        angle = angle - value / slope
    bad = ~(np.abs(miss(angle)[0]) < 1e-9)
    if bad.any():
        row, column = (int(i) for i in np.argwhere(bad)[0])
        raise GeometryError(
            "no point of the Earth's surface lies at this slant range",
            where="slantRangeTime",
            value=f"{distance[row, column]:.6g} m",
            limit=f"height {radius[row] - ground[row]:.6g} m",
        )
    return np.stack([np.sin(angle), np.zeros_like(angle), -np.cos(angle)], axis=-1)


def scene_height(annotation: Annotation, times: np.ndarray) -> np.ndarray:
    """Mean height (n,) m of the scene at given times; zero where the annotation has none."""
    if annotation.terrain_time.size == 0:
        return np.zeros(times.size)
    origin = annotation.start
    order = np.argsort(annotation.terrain_time)
    return np.interp(
        _seconds(times, origin), _seconds(annotation.terrain_time[order], origin), annotation.terrain_height[order]
    )


def geometry_doppler(
    annotation: Annotation,
    times: np.ndarray,
    slant_time: np.ndarray,
    *,
    attitude: AttitudeVectors | None = None,
    orbit: StateVectors | None = None,
    as_processed: bool = False,
) -> np.ndarray:
    """Doppler centroid that orbit, attitude and the Earth's orientation predict for the annotated mounting.

    ``2 f / c * dot(beam, velocity)`` with the Earth-fixed velocity and the beam in the body x-z plane that reaches the
    scene at the slant range.

    Args:
        annotation: of the sub-swath.
        times: (n,) datetime64[us], TAI.
        slant_time: (n, k) s, two-way.
        attitude, orbit: in place of those of the annotation.
        as_processed: with the Earth's orientation as simple as the product's processor takes it: no polar motion, and
            UTC in the place of UT1 where the orbit came from the downlink. (Found from the annotated polynomials; what
            it leaves out is worth up to 1.8 Hz.)

    Returns:
        (n, k) Hz.
    """
    position, velocity = orbit_at(annotation.orbit if orbit is None else orbit, times)
    celestial_from_body = attitude_at(annotation.attitude if attitude is None else attitude, times)
    earth = earth_fixed_from_celestial(
        times, polar_motion=not as_processed, ut1=annotation.orbit_from_file or not as_processed
    )
    earth_fixed_from_body = Rotation.from_matrix(earth) * celestial_from_body
    beams = beam_directions(slant_time, position, earth_fixed_from_body, scene_height(annotation, times))
    body_velocity = earth_fixed_from_body.inv().apply(velocity)
    return 2 * annotation.radar_frequency / SPEED_OF_LIGHT * np.einsum("nkj,nj->nk", beams, body_velocity)


def slant_interval(annotation: Annotation, estimate: DopplerEstimate) -> tuple[float, float]:
    """First and last two-way slant range time (s) over which an estimate holds.

    Raises:
        MissingDataError: neither fine estimates nor the length of an image line say it.
    """
    if estimate.fine_slant_time.size >= 2:
        return float(estimate.fine_slant_time.min()), float(estimate.fine_slant_time.max())
    if annotation.samples > 1 and annotation.product_type == "SLC":
        return (
            annotation.slant_range_time,
            annotation.slant_range_time + (annotation.samples - 1) / annotation.range_sampling_rate,
        )
    raise MissingDataError(
        "the annotation does not say over which slant ranges its Doppler estimates hold",
        where=f"{annotation.path.name}: dcEstimate",
        remedy="use the SLC product of the scene",
    )


def polynomial_value(coefficients: np.ndarray, slant_time: np.ndarray, reference: float) -> np.ndarray:
    """Value (Hz) of an annotated polynomial at two-way slant range times (s)."""
    return np.polynomial.polynomial.polyval(slant_time - reference, coefficients)


@dataclass(frozen=True)
class GeometryComparison:
    """Our geometry Doppler beside the annotated one, at evenly spaced slant ranges of each estimate.

    Attributes:
        ours: (n, k) Hz, with the full orientation of the Earth.
        as_processed: (n, k) Hz, with that of the processor; see :func:`geometry_doppler`.
        annotated: (n, k) Hz.
        measured: (n, k) Hz, of the radar data; NaN where the product has none.
    """

    ours: np.ndarray
    as_processed: np.ndarray
    annotated: np.ndarray
    measured: np.ndarray


def compare_geometry(annotation: Annotation, *, points: int = 5) -> GeometryComparison:
    """Reproduce the ``geometryDcPolynomial`` of an annotation from its own orbit and attitude.

    Args:
        annotation: of one sub-swath.
        points: slant ranges per estimate.

    Raises:
        MissingDataError: no estimate has a geometry polynomial.
    """
    estimates = [e for e in annotation.estimates if e.geometry.size]
    if not estimates:
        raise MissingDataError("no Doppler estimate has a geometry polynomial", where=annotation.path.name)
    slant = np.array([np.linspace(*slant_interval(annotation, e), points) for e in estimates])
    times = np.array([e.time for e in estimates])
    annotated = np.array([polynomial_value(e.geometry, s, e.reference) for e, s in zip(estimates, slant, strict=True)])
    measured = np.array(
        [
            polynomial_value(e.measured, s, e.reference) if e.measured.size else np.full(points, np.nan)
            for e, s in zip(estimates, slant, strict=True)
        ]
    )
    ours = geometry_doppler(annotation, times, slant)
    as_processed = geometry_doppler(annotation, times, slant, as_processed=True)
    return GeometryComparison(ours, as_processed, annotated, measured)


# ---------------------------------------------------------------------------------------------------------------- #
# the campaign


def import_sentinel1(
    paths: Iterable[str | os.PathLike[str]], orbit_files: Iterable[str | os.PathLike[str]] = ()
) -> Campaign:
    """One campaign from the annotations of several sub-swaths, slices or scenes of one satellite.

    Args:
        paths: annotation files; polarisations that repeat an estimate, and slices that overlap, count once.
        orbit_files: orbit files; where one covers an acquisition it is used in place of the annotated orbit.

    Returns:
        The campaign, checked; see the module for its layout.

    Raises:
        RequestError: no annotation, several satellites or radar frequencies, an orbit file that covers none of them.
        TooFewDataError: no usable Doppler estimate.
        InputError: the other subclasses, from the readers.
    """
    annotations = sorted(
        (read_annotation(path) for path in paths), key=lambda a: (a.start, a.swath, a.polarisation[::-1])
    )
    return campaign_of(annotations, [read_orbit_file(path) for path in orbit_files])


def campaign_of(annotations: Sequence[Annotation], orbit_files: Sequence[OrbitFile] = ()) -> Campaign:
    """See :func:`import_sentinel1`; from files already read."""
    return campaign_with_swaths(annotations, orbit_files)[0]


def campaign_with_swaths(
    annotations: Sequence[Annotation], orbit_files: Sequence[OrbitFile] = ()
) -> tuple[Campaign, tuple[str, ...]]:
    """The campaign of :func:`campaign_of`, and the name of the sub-swath that each row of its Doppler data is from."""
    if not annotations:
        raise RequestError("there is no annotation to import", remedy="name at least one annotation XML file")
    for what, values in (
        ("satellites", {a.mission for a in annotations}),
        ("radar frequencies", {a.radar_frequency for a in annotations}),
    ):
        if len(values) > 1:
            raise RequestError(
                f"the annotations are of several {what}, each with its own antenna",
                value=", ".join(map(str, sorted(values))),
                limit="one",
                remedy="import each into its own campaign",
            )
    acquisitions = _acquisitions(annotations)
    used: set[int] = set()
    parts = [_acquisition_data(group, orbit_files, used) for group in acquisitions]
    parts = [part for part in parts if part.time.size]
    if not parts:
        raise TooFewDataError(
            "no Doppler estimate can be used (measured, trusted, with a known attitude)",
            value=0,
            limit="at least 1",
            where=", ".join(a.path.name for a in annotations[:3]),
        )
    for k, file in enumerate(orbit_files):
        if k not in used:
            raise RequestError(
                "the orbit file covers none of the acquisitions, or is of another satellite",
                where=file.path.name,
                value=f"{file.mission}, {utc_text(file.orbit.time[0])} to {utc_text(file.orbit.time[-1])}",
                limit=f"{annotations[0].mission}, {utc_text(annotations[0].start)}",
                remedy="leave it out, or add the annotation that it belongs to",
            )
    return checked(_assembled(annotations, parts)), tuple(swath for part in parts for swath in part.swaths)


@dataclass(frozen=True)
class _Part:
    """What one acquisition contributes; times are TAI, rows in order of time."""

    name: str
    orbit: StateVectors
    time: np.ndarray
    frequency: np.ndarray
    deviation: np.ndarray
    beams: np.ndarray
    attitude_time: np.ndarray
    celestial_from_body: Rotation
    swaths: tuple[str, ...]


def _acquisitions(annotations: Sequence[Annotation]) -> list[list[Annotation]]:
    """Annotations that follow each other without a pause."""
    groups: list[list[Annotation]] = []
    last: np.datetime64 | None = None
    for annotation in sorted(annotations, key=lambda a: a.start):
        if last is None or annotation.start - last > _LONGEST_PAUSE:
            groups.append([])
            last = annotation.stop
        groups[-1].append(annotation)
        last = max(last, annotation.stop)
    return groups


def _acquisition_data(group: list[Annotation], orbit_files: Sequence[OrbitFile], used: set[int]) -> _Part:
    attitude = _merged_attitude(group)
    chosen = _chosen_estimates(group, attitude)
    orbit = _orbit_of(group, orbit_files, used)
    chosen = [(a, e) for a, e in chosen if orbit.time[0] <= e.time <= orbit.time[-1]]
    stamp = utc_text(group[0].start)[:19].replace("-", "").replace(":", "")
    name = f"{group[0].mission.lower()}-{stamp.lower()}"
    times = np.array([e.time for _, e in chosen], dtype="datetime64[us]")
    for k in range(1, times.size):  # two sub-swaths may give one time; a microsecond is 8 mm of the orbit
        times[k] = max(times[k], times[k - 1] + np.timedelta64(1, "us"))
    if not chosen:
        none = np.zeros((0, 3))
        return _Part(name, orbit, times, none, none, np.zeros((0, 3, 3)), times, Rotation.identity(0), ())
    slant = np.empty((times.size, _NODES.size))
    frequency = np.empty_like(slant)
    deviation = np.empty_like(slant)
    for k, (annotation, estimate) in enumerate(chosen):
        first, last = slant_interval(annotation, estimate)
        slant[k] = (first + last) / 2 + (last - first) / 2 * _NODES
        frequency[k] = polynomial_value(estimate.measured, slant[k], estimate.reference)
        deviation[k] = max(estimate.rms, _SMALLEST_RMS)
    position, _ = orbit_at(orbit, times)
    body = attitude_at(attitude, times)
    height = np.array([scene_height(a, np.array([e.time]))[0] for a, e in chosen])
    beams = beam_directions(slant, position, Rotation.from_matrix(earth_fixed_from_celestial(times)) * body, height)
    apart = np.array([np.abs(_seconds(times, t)).min() > 1e-3 for t in attitude.time])
    sample = Rotation.from_quat(attitude.celestial_from_body[apart], scalar_first=True) if apart.any() else None
    attitude_time = np.concatenate([attitude.time[apart], times])
    rotation = body if sample is None else Rotation.concatenate([sample, body])
    order = np.argsort(attitude_time, kind="stable")
    swaths = tuple(annotation.swath for annotation, _ in chosen)
    return _Part(name, orbit, times, frequency, deviation, beams, attitude_time[order], rotation[order], swaths)


def _merged_attitude(group: list[Annotation]) -> AttitudeVectors:
    """The attitude lists of one acquisition as one: samples at times that are there already are left out."""
    time, quaternion = group[0].attitude.time, group[0].attitude.celestial_from_body
    for annotation in group[1:]:
        more = annotation.attitude
        new = np.array([np.abs(_seconds(time, t)).min() > 0.25 for t in more.time])
        time = np.concatenate([time, more.time[new]])
        quaternion = np.concatenate([quaternion, more.celestial_from_body[new]])
        order = np.argsort(time)
        time, quaternion = time[order], quaternion[order]
    return AttitudeVectors(time, quaternion)


def _chosen_estimates(group: list[Annotation], attitude: AttitudeVectors) -> list[tuple[Annotation, DopplerEstimate]]:
    """Measured, trusted estimates with a known attitude, each once, in order of time."""
    margin = np.timedelta64(int(LONGEST_EXTRAPOLATION * 1e6), "us")
    found: list[tuple[Annotation, DopplerEstimate]] = []
    seen: list[tuple[np.datetime64, float]] = []
    for annotation in group:
        for estimate in annotation.estimates:
            known = attitude.time[0] - margin <= estimate.time <= attitude.time[-1] + margin
            if not (known and estimate.trusted and estimate.measured.size):
                continue
            near = slant_interval(annotation, estimate)[0]
            if any(
                abs((estimate.time - t) / np.timedelta64(1, "s")) < _SAME_ESTIMATE and abs(near - s) < 2e-5
                for t, s in seen
            ):
                continue
            seen.append((estimate.time, near))
            found.append((annotation, estimate))
    return sorted(found, key=lambda pair: pair[1].time)


def _orbit_of(group: list[Annotation], orbit_files: Sequence[OrbitFile], used: set[int]) -> StateVectors:
    """State vectors around an acquisition: from an orbit file that covers it, else from the annotations."""
    first, last = min(a.start for a in group), max(a.stop for a in group)
    for k, file in enumerate(orbit_files):
        time = file.orbit.time
        inside = (time >= first - _ORBIT_MARGIN) & (time <= last + _ORBIT_MARGIN)
        covers = time[0] <= first and time[-1] >= last and inside.sum() >= 4
        if covers and file.mission in ("", group[0].mission):
            used.add(k)
            return StateVectors(time[inside], file.orbit.position[inside], file.orbit.velocity[inside])
    orbit = group[0].orbit
    for annotation in group[1:]:  # only beyond what is there: two solutions of one orbit must not interleave
        more = annotation.orbit
        half = (orbit.time[1] - orbit.time[0]) / 2 if orbit.time.size > 1 else np.timedelta64(0, "us")
        new = (more.time < orbit.time[0] - half) | (more.time > orbit.time[-1] + half)
        time = np.concatenate([orbit.time, more.time[new]])
        order = np.argsort(time)
        orbit = StateVectors(
            time[order],
            np.concatenate([orbit.position, more.position[new]])[order],
            np.concatenate([orbit.velocity, more.velocity[new]])[order],
        )
    return orbit


def _assembled(annotations: Sequence[Annotation], parts: list[_Part]) -> Campaign:
    origin = min(min(part.orbit.time[0], part.attitude_time[0]) for part in parts).astype("datetime64[us]")
    epoch = (origin - np.timedelta64(1, "s")).astype("datetime64[s]").astype("datetime64[us]")
    angle = earth_rotation_angle(epoch)
    attitude_time = np.concatenate([part.attitude_time for part in parts])
    body = Rotation.concatenate([part.celestial_from_body for part in parts])
    seconds = _seconds(attitude_time, epoch)
    plain = Rotation.from_rotvec(np.outer(angle + EARTH_ROTATION_RATE * seconds, [0.0, 0.0, 1.0]))
    # plain = inertial_from_earth_fixed of the campaign's model; the true Earth orientation goes into the quaternion
    inertial_from_body = plain * Rotation.from_matrix(earth_fixed_from_celestial(attitude_time)) * body
    quaternion = inertial_from_body.inv().as_quat(scalar_first=True)
    orbit_time = np.concatenate([part.orbit.time for part in parts])
    orbit_position = np.concatenate([part.orbit.position for part in parts])
    orbit_time, order = np.unique(orbit_time, return_index=True)
    position = orbit_position[order]
    doppler_time = _seconds(np.concatenate([part.time for part in parts]), epoch)
    arcs = tuple(
        Arc(
            part.name,
            "doppler",
            float(_seconds(part.time[0], epoch)) - 0.5,
            float(_seconds(part.time[-1], epoch)) + 0.5,
        )
        for part in parts
    )
    swaths = "+".join(sorted({a.swath for a in annotations}))
    dates = sorted({str(a.start.astype("datetime64[D]")) for a in annotations})
    when = dates[0] if len(dates) == 1 else f"{dates[0]} to {dates[-1]}"
    return Campaign(
        title=f"Sentinel-1 {annotations[0].mission} {swaths}, {when}, {len(parts)} acquisition"
        f"{'s' if len(parts) > 1 else ''} (contains modified Copernicus Sentinel data)",
        epoch=utc_text(epoch),
        earth_rotation_angle_at_epoch=angle,
        earth_rotation_rate=EARTH_ROTATION_RATE,
        gnss=GnssSeries(_seconds(orbit_time, epoch), position, np.broadcast_to(POSITION_DEVIATION, position.shape)),
        star_tracker=TrackerSeries(seconds, quaternion, np.broadcast_to(ATTITUDE_DEVIATION, (seconds.size, 3))),
        doppler=DopplerSeries(
            doppler_time,
            np.concatenate([part.frequency for part in parts]),
            np.concatenate([part.deviation for part in parts]),
            np.concatenate([part.beams for part in parts]),
            annotations[0].radar_frequency,
        ),
        torque=None,
        arcs=arcs,
        nominal=Nominal(np.array([1.0, 0, 0, 0]), np.array([1.0, 0, 0, 0]), _NOMINAL_INERTIA),
    )


def is_orbit_file(path: str | os.PathLike[str]) -> bool:
    """Whether the name says that a file is an orbit file and not an annotation."""
    return Path(path).suffix.lower() == ".eof"
