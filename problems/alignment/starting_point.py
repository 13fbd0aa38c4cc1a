"""Where the joint estimate starts: cheap linear solutions that need no guess from the user.

- Antenna: Wahba's problem over all Doppler epochs, where three beams give the velocity in antenna axes; polished, or
  for fewer beams found, by Gauss-Newton on the three angles with the design value as a weak prior.
- Inertia and torques: constancy of the inertial angular momentum. On a rotation arc
  ``A(t)' J w(t) = L + integral of A' N``, with ``A = tracker_from_inertial``, is linear in the inertia tensor, in the
  matrix from command to torque and in the momentum of each arc; all arcs are solved together. Unlike the constancy of
  the energy it determines the inertia ratios on a single arc.
- Actuator: polar decomposition (a weighted Wahba problem) of the matrix from command to torque over trace; its
  size is the reciprocal of the inertia's trace, since commands are in N m.
- State of each arc at its start: the smoothed attitude, and the rate that the momentum of the whole arc asks for;
  then both, with the map from command to torque, are refined on the raw quaternions with the inertia held.

What the data leave open stays at the design value and is named in ``notes``. Frames, signs and units are those of
:mod:`problems.alignment.campaign`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy.constants import speed_of_light
from scipy.spatial.transform import Rotation

from problems.alignment.attitude_curve import AttitudeCurve, attitude_curves
from problems.alignment.campaign import Arc, Campaign, DopplerSeries

EARTH_GRAVITY = 3.986004418e14  # m3/s2
ANTENNA_PRIOR = 0.02  # rad, wide against what data determine: only what they leave open follows the design value
INERTIA_PRIOR = 0.1  # of the trace
TORQUE_PRIOR = 1.0  # of the design map from command to torque
LARGEST_PRINCIPAL_MOMENT = 0.499  # of the trace; the triangle inequality allows less than one half
SMALLEST_PRINCIPAL_MOMENT = 0.002  # of the trace
REFINEMENT_WINDOW = 120.0  # s
REFINEMENT_WINDOW_OF_PULSES = 600.0  # s
UNDETERMINED = 0.5  # posterior over prior standard deviation above which a direction counts as undetermined

TimeFunction = Callable[[np.ndarray], np.ndarray]

# Traceless symmetric tensors of unit Frobenius norm: the five directions in which a tensor of trace 1 can vary.
TRACELESS = np.array(
    [
        np.diag([1.0, -1.0, 0.0]) / np.sqrt(2),
        np.diag([1.0, 1.0, -2.0]) / np.sqrt(6),
        np.array([[0, 1.0, 0], [1, 0, 0], [0, 0, 0]]) / np.sqrt(2),
        np.array([[0, 0, 1.0], [0, 0, 0], [1, 0, 0]]) / np.sqrt(2),
        np.array([[0, 0, 0], [0, 0, 1.0], [0, 1, 0]]) / np.sqrt(2),
    ]
)


TENSOR_ENTRIES = {"Jxx": (0, 0), "Jyy": (1, 1), "Jzz": (2, 2), "Jxy": (0, 1), "Jxz": (0, 2), "Jyz": (1, 2)}


@dataclass(frozen=True)
class Quality:
    """How well one part of the starting point is determined.

    Attributes:
        residual: robust standard deviation of its whitened residuals; about 1 where the model explains the data.
        condition: largest over smallest singular value of the whitened information about it; infinite where nothing
            was measured.
    """

    residual: float
    condition: float


@dataclass(frozen=True)
class StartingPoint:
    """Starting values of the joint problem.

    Attributes:
        antenna_from_tracker, actuator_from_tracker: (4,) unit quaternions.
        normalized_inertia: (3, 3), trace 1, tracker axes, physical.
        inertia_trace: kg m2.
        arc_states: for each rotation arc with star-tracker data, ``tracker_from_inertial`` (4,) and the angular rate
            (3,) rad/s in tracker axes, both at the arc's start. Arcs without usable samples are left out and named in
            ``notes``.
        quality: of "antenna", "inertia", "actuator" and of each arc's name.
        notes: what stayed at the design value, and why.
    """

    antenna_from_tracker: np.ndarray
    actuator_from_tracker: np.ndarray
    normalized_inertia: np.ndarray
    inertia_trace: float
    arc_states: Mapping[str, tuple[np.ndarray, np.ndarray]]
    quality: Mapping[str, Quality] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def starting_point(
    campaign: Campaign, velocity: TimeFunction, position: TimeFunction | None = None, *, gravity_gradient: bool = False
) -> StartingPoint:
    """Starting values for every unknown of the joint problem.

    Args:
        campaign: the measured data.
        velocity: (n,) s to the Earth-fixed velocity (n, 3) m/s, as seen in the rotating frame.
        position: (n,) s to the Earth-fixed position (n, 3) m; needed for the gravity gradient only.
        gravity_gradient: whether the rotation arcs are taken to feel the gravity-gradient torque.
    """
    notes: list[str] = []
    quality: dict[str, Quality] = {}
    antenna, quality["antenna"] = _antenna(campaign, velocity, notes)
    rotation = rotation_solution(campaign, position if gravity_gradient else None)
    notes.extend(rotation.notes)
    quality.update(rotation.quality)
    return StartingPoint(
        antenna_from_tracker=antenna,
        actuator_from_tracker=rotation.actuator_from_tracker,
        normalized_inertia=rotation.normalized_inertia,
        inertia_trace=rotation.inertia_trace,
        arc_states=rotation.arc_states,
        quality=quality,
        notes=tuple(notes),
    )


# --- frames ----------------------------------------------------------------------------------------------------------


def earth_fixed_from_inertial(campaign: Campaign, time: np.ndarray) -> Rotation:
    """``earth_fixed_from_inertial`` at the times (n) s: the turn about +z that the campaign's epoch and rate give."""
    angle = campaign.earth_rotation_angle_at_epoch + campaign.earth_rotation_rate * np.asarray(time, dtype=float)
    return Rotation.from_rotvec(-angle[:, None] * np.array([0.0, 0.0, 1.0]))


def quaternion_of(rotation: Rotation) -> np.ndarray:
    """Scalar-first quaternion (4,) with a scalar part that is not negative."""
    return np.asarray(rotation.as_quat(canonical=True, scalar_first=True))


# --- antenna ---------------------------------------------------------------------------------------------------------


def attitude_at_doppler(campaign: Campaign) -> tuple[np.ndarray, Rotation, np.ndarray]:
    """Doppler epochs that have an attitude, and the smoothed ``tracker_from_inertial`` there.

    Returns:
        Indices (m,) into the Doppler series, m rotations, and their standard deviations (m, 3) rad about the tracker
        axes.
    """
    assert campaign.doppler is not None
    epochs, tracker = campaign.doppler.time, campaign.star_tracker
    found = np.zeros(len(epochs), dtype=bool)
    quaternion = np.tile([1.0, 0.0, 0.0, 0.0], (len(epochs), 1))
    sigma = np.zeros((len(epochs), 3))
    step = float(np.median(np.diff(tracker.time))) if len(tracker.time) > 1 else 0.0
    margin = max(2.0, 4 * step)  # s
    for session in np.split(np.arange(len(epochs)), np.flatnonzero(np.diff(epochs) > 30 * max(step, 1.0)) + 1):
        if len(session) == 0:
            continue
        near = slice(*np.searchsorted(tracker.time, [epochs[session[0]] - margin, epochs[session[-1]] + margin]))
        curves = attitude_curves(tracker.time[near], tracker.quaternion[near], tracker.standard_deviation[near])
        for curve in curves:
            reach = (epochs[session] >= curve.start - 0.5 * step) & (epochs[session] <= curve.stop + 0.5 * step)
            covered = session[reach]
            quaternion[covered] = curve.quaternion(np.clip(epochs[covered], curve.start, curve.stop))
            sigma[covered] = curve.quaternion_standard_deviation(epochs[covered])
            found[covered] = True
    if not np.all(found) and len(tracker.time):
        # A lone tracker sample at the epoch itself serves as well.
        nearest = np.clip(np.searchsorted(tracker.time, epochs - 1e-3), 0, len(tracker.time) - 1)
        same = ~found & (np.abs(tracker.time[nearest] - epochs) < 2e-3)
        quaternion[same] = tracker.quaternion[nearest[same]]
        sigma[same] = tracker.standard_deviation[nearest[same]]
        found |= same
    index = np.flatnonzero(found)
    return index, Rotation.from_quat(quaternion[index], scalar_first=True), sigma[index]


def velocity_from_beams(doppler: DopplerSeries, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Velocity in antenna axes (m, 3) m/s by weighted least squares over the beams of each epoch.

    Returns:
        The velocities and the reciprocal condition number (m,) of the beam directions; NaN where they are coplanar.
    """
    direction = beam_directions(doppler, index)
    singular = np.linalg.svd(direction, compute_uv=False)
    reciprocal = singular[:, -1] / singular[:, 0] if direction.shape[1] >= 3 else np.zeros(len(index))
    result = np.full((len(index), 3), np.nan)
    good = reciprocal > 0.01
    if np.any(good):
        weight = 1 / doppler.standard_deviation[index][good] ** 2
        rows = direction[good]
        normal = np.einsum("nbi,nb,nbj->nij", rows, weight, rows)
        scale = speed_of_light / (2 * doppler.carrier_frequency)
        right = np.einsum("nbi,nb,nb->ni", rows, weight, scale * doppler.frequency_shift[index][good])
        result[good] = np.linalg.solve(normal, right[..., None])[..., 0]
    return result, reciprocal


def beam_directions(doppler: DopplerSeries, index: np.ndarray) -> np.ndarray:
    """Beam directions (m, b, 3) at the epochs ``index``, whether they depend on time or not."""
    direction = doppler.beam_direction
    if direction.ndim == 3:
        return direction[index]
    return np.repeat(direction[None], len(index), axis=0)


def wahba(to: np.ndarray, of: np.ndarray, weight: np.ndarray) -> Rotation:
    """The rotation R that minimizes ``sum weight |to - R of|^2`` (Wahba's problem, by singular values).

    Args:
        to, of: (n, 3) vectors.
        weight: (n,) or, to weigh directions, already multiplied into ``to``.
    """
    u, _, vt = np.linalg.svd(np.einsum("n,ni,nj->ij", weight, to, of))
    return Rotation.from_matrix(u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt)


def robust_wahba(to: np.ndarray, of: np.ndarray, iterations: int = 20) -> Rotation:
    """Wahba's solution with gross outliers given no weight (biweight on the residual's length, iterated)."""
    # Lengths must agree whatever the rotation is: a first look that needs no rotation.
    mismatch = np.abs(np.linalg.norm(to, axis=1) - np.linalg.norm(of, axis=1))
    weight = _biweight(mismatch)
    rotation = wahba(to, of, weight)
    for _ in range(iterations):
        previous = rotation
        rotation = wahba(to, of, _biweight(np.linalg.norm(to - rotation.apply(of), axis=1)))
        if (rotation * previous.inv()).magnitude() < 1e-9:
            break
    return rotation


def _biweight(size: np.ndarray) -> np.ndarray:
    """Tukey weights of non-negative sizes, scaled by their median."""
    limit = 6 * max(float(np.median(size)), 1e-12)
    return np.where(size < limit, (1 - np.minimum(size / limit, 1.0) ** 2) ** 2, 0.0)


def _antenna(campaign: Campaign, velocity: TimeFunction, notes: list[str]) -> tuple[np.ndarray, Quality]:
    """``antenna_from_tracker`` (4,) from all Doppler epochs, and its quality."""
    nominal = Rotation.from_quat(campaign.nominal.antenna_from_tracker, scalar_first=True)
    if campaign.doppler is None or len(campaign.doppler.time) == 0:
        notes.append("antenna: no Doppler data; the design value is kept")
        return quaternion_of(nominal), Quality(np.nan, np.inf)
    index, attitude, sigma = attitude_at_doppler(campaign)
    if len(index) == 0:
        notes.append("antenna: no Doppler epoch has a star-tracker attitude; the design value is kept")
        return quaternion_of(nominal), Quality(np.nan, np.inf)
    time = campaign.doppler.time[index]
    v_tracker = attitude.apply(earth_fixed_from_inertial(campaign, time).inv().apply(velocity(time)))
    candidates = [nominal]
    v_antenna, reciprocal = velocity_from_beams(campaign.doppler, index)
    good = np.all(np.isfinite(v_antenna), axis=1) & (reciprocal > 0.01)
    if np.sum(good) >= 2:
        candidates.insert(0, robust_wahba(v_antenna[good], v_tracker[good]))
    fits = [_fit_antenna(campaign, index, v_tracker, sigma, nominal, start) for start in candidates]
    if len(candidates) == 1 and fits[0][1].residual > 5:
        # The design value may be far off where there are too few beams for Wahba's solution.
        steps = 0.3 * np.array(np.meshgrid([-1, 0, 1], [-1, 0, 1], [-1, 0, 1])).reshape(3, -1).T  # rad
        fits += [
            _fit_antenna(campaign, index, v_tracker, sigma, nominal, Rotation.from_rotvec(s) * nominal) for s in steps
        ]
    rotation, quality, open_axes = min(fits, key=lambda f: f[1].residual)
    for _ in range(3):
        # What the data leave open must not follow their noise: fitted again with the design value kept there.
        if not open_axes:
            break
        kept = np.array(open_axes)
        rotation = _kept_at_design(rotation, nominal, kept)
        rotation, quality, open_axes = _fit_antenna(campaign, index, v_tracker, sigma, nominal, rotation, kept)
        rotation = _kept_at_design(rotation, nominal, kept)
    for axis in open_axes:
        words = ", ".join(f"{x:+.2f}" for x in axis)
        notes.append(
            f"antenna: the rotation about ({words}) in antenna axes is not determined; the design value is kept"
        )
    return quaternion_of(rotation), quality


def _kept_at_design(rotation: Rotation, nominal: Rotation, axes: np.ndarray) -> Rotation:
    """The rotation without its turns away from the design value about given axes (k, 3), orthonormal."""
    offset = (rotation * nominal.inv()).as_rotvec()
    return Rotation.from_rotvec(offset - axes.T @ (axes @ offset)) * nominal


def _fit_antenna(
    campaign: Campaign,
    index: np.ndarray,
    v_tracker: np.ndarray,
    tracker_sigma: np.ndarray,
    nominal: Rotation,
    start: Rotation,
    kept: np.ndarray | None = None,
) -> tuple[Rotation, Quality, list[np.ndarray]]:
    """Robust Gauss-Newton on the three angles from ``start``, with the design value as a weak prior.

    Steps have no part along the axes ``kept`` (k, 3), orthonormal in antenna axes.
    """
    free = np.eye(3) if kept is None else np.linalg.svd(kept)[2][len(kept) :].T
    doppler = campaign.doppler
    assert doppler is not None
    gain = 2 * doppler.carrier_frequency / speed_of_light
    direction, measured = beam_directions(doppler, index), doppler.frequency_shift[index]
    rotation = start
    scale, previous_scale = np.inf, np.inf
    information = np.eye(3)
    for _ in range(25):
        v = rotation.apply(v_tracker)
        residual = measured - gain * np.einsum("nbi,ni->nb", direction, v)
        beam = rotation.inv().apply(direction.reshape(-1, 3)).reshape(direction.shape)
        lever = np.cross(v_tracker[:, None], beam) * tracker_sigma[:, None]
        variance = doppler.standard_deviation[index] ** 2 + gain**2 * np.sum(lever**2, axis=2)
        whitened = (residual / np.sqrt(variance)).ravel()
        jacobian = (gain * np.cross(v[:, None], direction) / np.sqrt(variance)[..., None]).reshape(-1, 3)
        scale = max(float(np.median(np.abs(whitened))) / 0.6745, 1e-6)
        weight = 1 / (1 + (whitened / (2.4 * max(scale, 1.0))) ** 2)
        information = jacobian.T @ (weight[:, None] * jacobian)
        prior = np.eye(3) / ANTENNA_PRIOR**2
        offset = (rotation * nominal.inv()).as_rotvec()
        right = jacobian.T @ (weight * whitened) - prior @ offset
        step = free @ np.linalg.solve(free.T @ (information + prior) @ free, free.T @ right)
        length = float(np.linalg.norm(step))
        rotation = Rotation.from_rotvec(step * min(1.0, 0.5 / max(length, 1e-15))) * rotation
        if length < 1e-9 or (length < 1e-6 and abs(scale - previous_scale) < 1e-6):
            break
        previous_scale = scale
    values, vectors = np.linalg.eigh(information)
    condition = float(np.sqrt(max(values[-1], 0.0) / values[0])) if values[0] > 0 else np.inf
    posterior = 1 / np.sqrt(1 + np.maximum(values, 0) * ANTENNA_PRIOR**2)
    open_axes = [vectors[:, i] for i in range(3) if posterior[i] > UNDETERMINED]
    return rotation, Quality(scale, condition), open_axes


# --- rotation arcs ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RotationSolution:
    """What the rotation arcs give by themselves.

    Attributes:
        normalized_inertia: (3, 3), trace 1, tracker axes.
        inertia_trace: kg m2 (the design value where no torque was commanded).
        actuator_from_tracker: (4,) unit quaternion.
        torque_map: (3, 3) 1/(kg m2): torque in tracker axes over inertia trace, per commanded N m.
        arc_states: attitude and rate of each arc at its start.
        quality: of "inertia", "actuator" and each arc.
        notes: what stayed at the design value.
    """

    normalized_inertia: np.ndarray
    inertia_trace: float
    actuator_from_tracker: np.ndarray
    torque_map: np.ndarray
    arc_states: dict[str, tuple[np.ndarray, np.ndarray]]
    quality: dict[str, Quality]
    notes: list[str]


@dataclass(frozen=True)
class _Piece:
    """One smoothed stretch of an arc, sampled: what the momentum equation needs."""

    arc: str
    momentum: int  # which unknown momentum vector
    curve: AttitudeCurve
    time: np.ndarray  # (m,)
    rate: np.ndarray  # (m, 3)
    rate_covariance: np.ndarray  # (m, 3, 3)
    attitude: np.ndarray  # (m, 3, 3) tracker_from_inertial
    command: np.ndarray  # (m, 3, 9) integral of A' c since the momentum's reference time; columns command by command
    gravity: np.ndarray  # (m, 3, 9) integral of A' tau(J) for each element of J, row by row


def rotation_arcs(campaign: Campaign) -> tuple[Arc, ...]:
    """The arcs on which the rotation is governed by the inertia and the commanded torque, in order of time."""
    arcs = (*campaign.arcs_of_kind("free_rotation"), *campaign.arcs_of_kind("torque_pulse"))
    return tuple(sorted(arcs, key=lambda a: a.start))


def torque_edges(campaign: Campaign) -> np.ndarray:
    """Times (s) at which the commanded torque jumps, increasing."""
    if campaign.torque is None:
        return np.zeros(0)
    return np.unique(np.concatenate([campaign.torque.start, campaign.torque.stop]))


def command_at(campaign: Campaign, time: np.ndarray) -> np.ndarray:
    """Commanded torque (n, 3) N m in actuator axes at the times (n) s."""
    time = np.asarray(time, dtype=float)
    result = np.zeros((len(time), 3))
    torque = campaign.torque
    if torque is not None:
        for start, stop, command in zip(torque.start, torque.stop, torque.command, strict=True):
            result[(time >= start) & (time < stop)] += command
    return result


def arc_curves(campaign: Campaign, arc: Arc) -> list[AttitudeCurve]:
    """Smoothed attitude of one arc."""
    tracker = campaign.star_tracker
    inside = slice(
        int(np.searchsorted(tracker.time, arc.start - 1e-9)), int(np.searchsorted(tracker.time, arc.stop + 1e-9))
    )
    return attitude_curves(
        tracker.time[inside],
        tracker.quaternion[inside],
        tracker.standard_deviation[inside],
        [float(e) for e in torque_edges(campaign) if arc.start < e < arc.stop],
    )


def rotation_solution(campaign: Campaign, position: TimeFunction | None = None) -> RotationSolution:
    """Inertia, map from command to torque and arc states from the constancy of angular momentum, by linear algebra.

    Args:
        campaign: the measured data.
        position: (n,) s to Earth-fixed position (n, 3) m where the gravity-gradient torque is to be counted, else None.
    """
    notes: list[str] = []
    quality: dict[str, Quality] = {}
    nominal_inertia = nearest_physical(campaign.nominal.inertia / np.trace(campaign.nominal.inertia))
    nominal_trace = float(np.trace(campaign.nominal.inertia))
    tracker_from_actuator = (
        Rotation.from_quat(campaign.nominal.actuator_from_tracker, scalar_first=True).inv().as_matrix()
    )
    pieces: list[_Piece] = []
    momenta = 0
    for arc in rotation_arcs(campaign):
        curves = arc_curves(campaign, arc)
        if not curves:
            notes.append(f"arc {arc.name}: fewer than three usable star-tracker samples; no state, no inertia")
            continue
        new, momenta = _pieces(campaign, arc.name, curves, momenta, position)
        pieces.extend(new)
    if not pieces:
        notes.append("inertia: no rotation arc with attitude data; the design value is kept")
        notes.append("actuator: no torque pulse with attitude data; the design value is kept")
        quality["inertia"] = quality["actuator"] = Quality(np.nan, np.inf)
        return RotationSolution(
            nominal_inertia,
            nominal_trace,
            quaternion_of(Rotation.from_matrix(tracker_from_actuator).inv()),
            tracker_from_actuator / nominal_trace,
            {},
            quality,
            notes,
        )
    inertia, torque_map, information, residual = _momentum_fit(
        pieces, momenta, nominal_inertia, tracker_from_actuator / nominal_trace
    )
    values, vectors = np.linalg.eigh(information)
    posterior = 1 / np.sqrt(1 + np.maximum(values, 0) * INERTIA_PRIOR**2)
    quality["inertia"] = Quality(residual, float(np.sqrt(values[-1] / values[0])) if values[0] > 0 else np.inf)
    for i in range(5):
        if posterior[i] > UNDETERMINED:
            change = np.einsum("k,kij->ij", vectors[:, i], TRACELESS)
            notes.append(
                "inertia: the change "
                + ", ".join(
                    f"{name} {change[place]:+.2f}" for name, place in TENSOR_ENTRIES.items() if abs(change[place]) > 0.1
                )
                + " (of the trace) is not determined; the design value is kept"
            )
    dynamics = _Dynamics(campaign, inertia, position)
    arcs, peaks, states = [], [], []
    for arc in rotation_arcs(campaign):
        own = [p for p in pieces if p.arc == arc.name]
        if own:
            state, quality[arc.name] = _arc_state(arc, own, torque_map, dynamics)
            arcs.append(arc)
            peaks.append(max(float(np.max(np.linalg.norm(p.rate, axis=1))) for p in own))
            states.append(state)
    states, torque_map = _refined(dynamics, arcs, peaks, states, torque_map, tracker_from_actuator / nominal_trace)
    actuator, trace, quality["actuator"] = _actuator(
        campaign, pieces, torque_map, tracker_from_actuator, nominal_trace, residual, notes
    )
    return RotationSolution(
        inertia,
        trace,
        quaternion_of(actuator),
        torque_map,
        {arc.name: state for arc, state in zip(arcs, states, strict=True)},
        quality,
        notes,
    )


def _pieces(
    campaign: Campaign, arc: str, curves: list[AttitudeCurve], momenta: int, position: TimeFunction | None
) -> tuple[list[_Piece], int]:
    """Sample the curves of one arc and integrate the torques along them."""
    pieces: list[_Piece] = []
    total = np.zeros((3, 18))
    previous_stop: float | None = None
    edges = torque_edges(campaign)
    for curve in curves:
        count = len(curve.spline.t) - curve.spline.k - 1
        time = np.linspace(curve.start, curve.stop, 2 * count + 1)[1::2]
        if previous_stop is not None:
            # Torques that act while the attitude is unknown cannot be integrated: a new momentum vector begins.
            within = edges[(edges > previous_stop) & (edges < curve.start)]
            bounds = np.concatenate([[previous_stop], within, [curve.start]])
            commanded = np.any(command_at(campaign, 0.5 * (bounds[:-1] + bounds[1:])) != 0)
            if commanded or (position is not None and curve.start - previous_stop > 2.0):
                momenta += 1
                total = np.zeros((3, 18))
        inside = edges[(edges > curve.start) & (edges < curve.stop)]
        grid = np.unique(np.concatenate([[curve.start, curve.stop], time, inside]))
        cumulative = _cumulative(campaign, curve, grid, position)
        at_time = total + cumulative[np.searchsorted(grid, time)]
        total = total + cumulative[-1]
        previous_stop = curve.stop
        pieces.append(
            _Piece(
                arc=arc,
                momentum=momenta,
                curve=curve,
                time=time,
                rate=curve.rate(time),
                rate_covariance=curve.rate_covariance(time),
                attitude=curve.rotation(time).as_matrix(),
                command=at_time[:, :, :9],
                gravity=at_time[:, :, 9:],
            )
        )
    return pieces, momenta + 1


def _cumulative(
    campaign: Campaign, curve: AttitudeCurve, grid: np.ndarray, position: TimeFunction | None
) -> np.ndarray:
    """Integrals (g, 3, 18) from ``grid[0]`` of ``A' e_k c_l`` (column 3 l + k) and of the gravity gradient per J_ij."""
    node, weight = np.polynomial.legendre.leggauss(4)
    half = 0.5 * np.diff(grid)
    time = (grid[:-1] + half)[:, None] + half[:, None] * node
    flat = time.ravel()
    inertial_from_tracker = np.swapaxes(curve.rotation(flat).as_matrix(), 1, 2)
    # Inside a cell the command is constant; its middle says which.
    command = np.repeat(command_at(campaign, grid[:-1] + half), len(node), axis=0)
    integrand = np.zeros((len(flat), 3, 18))
    integrand[:, :, :9] = np.einsum("nik,nl->nilk", inertial_from_tracker, command).reshape(len(flat), 3, 9)
    if position is not None:
        inertial = earth_fixed_from_inertial(campaign, flat).inv().apply(position(flat))
        distance = np.linalg.norm(inertial, axis=1)
        up = np.einsum("nki,nk->ni", inertial_from_tracker, inertial / distance[:, None])
        # tau = 3 mu / r^3  up x (J up): column 3 i + j is up x e_i up_j.
        cross = np.cross(up[:, None, :], np.eye(3)[None])
        torque = np.einsum("nik,nj->nkij", cross, up).reshape(len(flat), 3, 9)
        integrand[:, :, 9:] = (3 * EARTH_GRAVITY / distance**3)[:, None, None] * (inertial_from_tracker @ torque)
    cells = np.einsum("cqij,q,c->cij", integrand.reshape(len(half), len(node), 3, 18), weight, half)
    return np.concatenate([np.zeros((1, 3, 18)), np.cumsum(cells, axis=0)])


def _momentum_fit(
    pieces: list[_Piece], momenta: int, nominal_inertia: np.ndarray, nominal_map: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Least squares for inertia (trace 1), torque map and momenta; the tensor is kept physical.

    Returns:
        Inertia (3, 3), torque map (3, 3), information (5, 5) about the inertia alone, robust residual.
    """
    rows = sum(len(p.time) for p in pieces)
    # Rows in tracker axes: J w - A L - A (integral of the torques) = 0, one 3-vector for each sample.
    on_inertia = np.zeros((rows, 3, 5))
    constant = np.zeros((rows, 3))
    on_map, on_momentum = np.zeros((rows, 3, 9)), np.zeros((rows, 3, 3 * momenta))
    at = 0
    for p in pieces:
        s = slice(at, at + len(p.time))
        at += len(p.time)
        gravity = np.einsum("nij,njk->nik", p.attitude, p.gravity).reshape(-1, 3, 3, 3)
        on_inertia[s] = np.einsum("kij,nj->nik", TRACELESS, p.rate) - np.einsum("nrij,kij->nrk", gravity, TRACELESS)
        constant[s] = p.rate @ nominal_inertia.T - np.einsum("nrij,ij->nr", gravity, nominal_inertia)
        on_map[s] = -np.einsum("nij,njk->nik", p.attitude, p.command)
        on_momentum[s, :, 3 * p.momentum : 3 * p.momentum + 3] = -p.attitude
    covariance = np.concatenate([p.rate_covariance for p in pieces])
    design = np.concatenate([on_inertia, on_map, on_momentum], axis=2)
    map_scale = TORQUE_PRIOR * np.linalg.norm(nominal_map) / np.sqrt(3)
    start = np.concatenate([np.zeros(5), nominal_map.T.ravel(), np.zeros(3 * momenta)])
    weight = np.ones(rows)
    inertia, prior_sigma = nominal_inertia, INERTIA_PRIOR
    solution = start
    information, residual = np.zeros((5, 5)), np.nan
    for _ in range(12):
        spread = inertia @ covariance @ inertia
        floor = 1e-12 * np.trace(spread, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        whitener = np.linalg.inv(np.linalg.cholesky(spread + floor))
        a = (whitener @ design).reshape(-1, design.shape[2])
        b = -np.einsum("nij,nj->ni", whitener, constant).ravel()
        w = np.repeat(weight, 3)
        normal = a.T @ (w[:, None] * a)
        prior = np.zeros(len(normal))
        prior[:5], prior[5:14] = prior_sigma**-2, map_scale**-2
        # Scaling by the diagonal keeps momenta (1e-2) and torques (1e-4) solvable together.
        size = 1 / np.sqrt(np.diag(normal) + prior + 1e-300)
        system = (normal + np.diag(prior)) * size[:, None] * size
        solution = size * np.linalg.lstsq(system, size * (a.T @ (w * b) + prior * start), rcond=1e-15)[0]
        candidate = nominal_inertia + np.einsum("k,kij->ij", solution[:5], TRACELESS)
        if not is_physical(candidate):
            # Undetermined directions give way first when the prior is tightened.
            prior_sigma *= 0.3
            continue
        left = (a @ solution - b).reshape(-1, 3)
        size_of_row = np.linalg.norm(left, axis=1)
        residual = float(np.median(np.abs(left))) / 0.6745
        weight = np.where(size_of_row < 6 * max(residual, 1.0) * np.sqrt(3), 1.0, 0.1)
        rest = normal[5:, 5:] + np.diag(prior[5:])
        information = normal[:5, :5] - normal[:5, 5:] @ np.linalg.pinv(rest, hermitian=True) @ normal[5:, :5]
        change = float(np.max(np.abs(candidate - inertia)))
        inertia = candidate
        if change < 1e-7:
            break
    return inertia, solution[5:14].reshape(3, 3).T, information, residual


def is_physical(inertia: np.ndarray) -> bool:
    """Whether a tensor of trace 1 keeps clear of the limits of a body with mass (positive, triangle inequality)."""
    values = np.linalg.eigvalsh(inertia)
    return bool(values[0] > SMALLEST_PRINCIPAL_MOMENT and values[-1] < LARGEST_PRINCIPAL_MOMENT)


def nearest_physical(inertia: np.ndarray) -> np.ndarray:
    """The tensor of trace 1 (3, 3) with the same axes and principal moments drawn towards the sphere until physical."""
    symmetric = 0.5 * (inertia + inertia.T) / np.trace(inertia)
    share = 1.0
    while not is_physical(np.eye(3) / 3 + share * (symmetric - np.eye(3) / 3)):
        share *= 0.98
    return np.eye(3) / 3 + share * (symmetric - np.eye(3) / 3)


def _actuator(
    campaign: Campaign,
    pieces: list[_Piece],
    torque_map: np.ndarray,
    tracker_from_actuator: np.ndarray,
    nominal_trace: float,
    residual: float,
    notes: list[str],
) -> tuple[Rotation, float, Quality]:
    """``actuator_from_tracker`` and the inertia trace from the map between command and torque over trace."""
    nominal = Rotation.from_matrix(tracker_from_actuator).inv()
    gram = np.zeros((3, 3))
    torque = campaign.torque
    if torque is not None:
        for start, stop, command in zip(torque.start, torque.stop, torque.command, strict=True):
            length = sum(max(0.0, min(stop, p.curve.stop) - max(start, p.curve.start)) for p in pieces)
            gram += length * np.outer(command, command)
    values, vectors = np.linalg.eigh(gram)
    if values[-1] <= 0:
        notes.append("actuator: no torque pulse with attitude data; the design axes and inertia trace are kept")
        return nominal, nominal_trace, Quality(np.nan, np.inf)
    share = values / values[-1]
    excited = [i for i in range(3) if share[i] > 1e-4]
    sizes = np.array([np.linalg.norm(torque_map @ vectors[:, i]) for i in excited])
    scale = float(np.sum(share[excited] * sizes) / np.sum(share[excited]))
    if scale <= 0 or not np.isfinite(scale):
        notes.append("actuator: the pulses left no trace in the attitude; the design values are kept")
        return nominal, nominal_trace, Quality(residual, np.inf)
    # The commanded directions in actuator axes and what they became in tracker axes; the design rotation decides, with
    # little weight, about directions that were never commanded.
    pairs_to = [vectors[:, i] for i in excited]
    pairs_of = [torque_map @ vectors[:, i] / scale for i in excited]
    weights = [float(share[i]) for i in excited]
    if len(excited) < 3:
        pairs_to += list(np.eye(3))
        pairs_of += list(tracker_from_actuator.T)
        weights += [1e-3 * max(weights)] * 3
    elif np.linalg.det(torque_map) < 0:
        notes.append("actuator: the torques form a left-handed set; the sign of one commanded axis may be reversed")
    rotation = wahba(np.array(pairs_to), np.array(pairs_of), np.array(weights))
    if len(excited) == 1:
        words = ", ".join(f"{x:+.2f}" for x in vectors[:, excited[0]])
        notes.append(f"actuator: only the direction ({words}) was commanded; the design rotation about it is kept")
    condition = float(np.sqrt(1 / share[0])) if share[0] > 0 else np.inf
    return rotation, 1 / scale, Quality(residual, condition)


def _arc_state(
    arc: Arc,
    pieces: list[_Piece],
    torque_map: np.ndarray,
    dynamics: _Dynamics,
) -> tuple[tuple[np.ndarray, np.ndarray], Quality]:
    """Attitude (4,) and rate (3,) at the arc's start: from the momentum of its first pieces, then refined."""
    inertia = dynamics.inertia
    first = [p for p in pieces if p.momentum == pieces[0].momentum]
    time = np.concatenate([p.time for p in first])
    attitude = np.concatenate([p.attitude for p in first])
    rate = np.concatenate([p.rate for p in first])
    covariance = np.concatenate([p.rate_covariance for p in first])
    applied = np.concatenate([p.command @ torque_map.T.ravel() + p.gravity @ inertia.ravel() for p in first])
    momentum = np.einsum("nji,nj->ni", attitude, rate @ inertia) - applied
    spread = np.swapaxes(attitude, 1, 2) @ (inertia @ covariance @ inertia) @ attitude
    start = first[0].curve.start
    value, residual, condition = _momentum_at_start(time - start, momentum, spread)
    rotation = first[0].curve.rotation(np.array([start]))
    w = np.linalg.solve(inertia, rotation.as_matrix()[0] @ value)
    q = quaternion_of(rotation[0])
    if start > arc.start + 1e-9:
        back = dynamics.nodes(start, arc.start, float(np.linalg.norm(w)))
        attitudes, rates = dynamics.run(q[None], w[None], back, torque_map)
        q, w = attitudes[-1, 0], rates[-1, 0]
    return (q, w), Quality(residual, condition)


def _momentum_at_start(
    time: np.ndarray, momentum: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, float, float]:
    """Inertial momentum (3,) at time 0: constant where the data agree, a low polynomial where torques were left out."""
    whitener = np.linalg.inv(np.linalg.cholesky(covariance))
    length = max(float(time[-1]), 1e-9)
    best: tuple[np.ndarray, float, float] | None = None
    for degree in range(min(5, len(time) // 3 + 1)):
        powers = (time[:, None] / length) ** np.arange(degree + 1)
        design = np.einsum("nij,np->nipj", whitener, powers).reshape(3 * len(time), -1)
        target = np.einsum("nij,nj->ni", whitener, momentum).ravel()
        weight = np.ones(len(target))
        solution = np.zeros(design.shape[1])
        for _ in range(3):
            solution = np.linalg.lstsq(design * weight[:, None], target * weight, rcond=None)[0]
            left = np.abs(design @ solution - target)
            limit = 3 * max(1.0, float(np.median(left)) / 0.6745)
            weight = np.sqrt(np.minimum(1.0, limit / np.maximum(left, 1e-12)))
        freedom = max(1, len(target) - design.shape[1])
        residual = float(np.linalg.norm((design @ solution - target) * weight) / np.sqrt(freedom))
        if best is None or residual < 0.8 * best[1]:
            best = (solution[:3], residual, float(np.linalg.cond(design)))
        if residual < 1.5:
            break
    assert best is not None
    return best


@dataclass(frozen=True)
class _Dynamics:
    """Euler's equations with the estimated inertia and torques, for several trajectories at once."""

    campaign: Campaign
    inertia: np.ndarray
    position: TimeFunction | None

    def nodes(self, begin: float, end: float, rate: float) -> np.ndarray:
        """Times (n,) from ``begin`` to ``end`` (either direction), torque edges among them, 0.1 rad apart at most."""
        edges = torque_edges(self.campaign)
        low, high = min(begin, end), max(begin, end)
        bounds = np.concatenate([[low], edges[(edges > low) & (edges < high)], [high]])
        step = min(0.1 / max(rate, 1e-6), 5.0)  # s
        cells = [np.linspace(a, b, int(np.ceil((b - a) / step)) + 1)[:-1] for a, b in pairwise(bounds)]
        times = np.concatenate([*cells, [high]])
        return times if end >= begin else times[::-1]

    def run(
        self, q: np.ndarray, w: np.ndarray, times: np.ndarray, torque_map: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Attitudes (n, m, 4) and rates (n, m, 3) at ``times`` (n) from m states at ``times[0]`` (Runge-Kutta 4).

        ``torque_map`` is (3, 3) or (m, 3, 3), from command to torque over inertia trace.
        """
        command = np.einsum("...ij,nj->n...i", torque_map, command_at(self.campaign, 0.5 * (times[:-1] + times[1:])))
        if self.position is not None:
            thirds = np.stack([times[:-1], 0.5 * (times[:-1] + times[1:]), times[1:]], axis=1).ravel()
            inertial = earth_fixed_from_inertial(self.campaign, thirds).inv().apply(self.position(thirds))
            upward = (inertial / np.linalg.norm(inertial, axis=1, keepdims=True)).reshape(-1, 3, 3)
            strength = (3 * EARTH_GRAVITY / np.linalg.norm(inertial, axis=1) ** 3).reshape(-1, 3)
        inverse = np.linalg.inv(self.inertia).T
        attitudes, rates = [q], [w]
        for k, (now, following) in enumerate(pairwise(times)):
            h = following - now

            def slope(q: np.ndarray, w: np.ndarray, stage: int, k: int = k) -> tuple[np.ndarray, np.ndarray]:
                torque = command[k] - _cross(w, w @ self.inertia)
                if self.position is not None:
                    up = _rotate(q, upward[k, stage])
                    torque = torque + strength[k, stage] * _cross(up, up @ self.inertia)
                return _attitude_slope(q, w), torque @ inverse

            a1, b1 = slope(q, w, 0)
            a2, b2 = slope(q + 0.5 * h * a1, w + 0.5 * h * b1, 1)
            a3, b3 = slope(q + 0.5 * h * a2, w + 0.5 * h * b2, 1)
            a4, b4 = slope(q + h * a3, w + h * b3, 2)
            q = q + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
            w = w + h / 6 * (b1 + 2 * b2 + 2 * b3 + b4)
            q = q / np.linalg.norm(q, axis=-1, keepdims=True)
            attitudes.append(q)
            rates.append(w)
        return np.array(attitudes), np.array(rates)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products along the last axis; several times faster than NumPy's own on a handful of vectors."""
    x, y, z = a[..., 0], a[..., 1], a[..., 2]
    u, v, w = b[..., 0], b[..., 1], b[..., 2]
    result = np.empty(np.broadcast_shapes(a.shape, b.shape))
    np.subtract(y * w, z * v, out=result[..., 0])
    np.subtract(z * u, x * w, out=result[..., 1])
    np.subtract(x * v, y * u, out=result[..., 2])
    return result


def _attitude_slope(q: np.ndarray, w: np.ndarray) -> np.ndarray:
    """``q' = -w o q / 2`` along the last axis."""
    slope = np.empty(np.broadcast_shapes(q.shape, (*w.shape[:-1], 4)))
    a, b, c, d = (0.5 * q[..., i] for i in range(4))
    x, y, z = w[..., 0], w[..., 1], w[..., 2]
    slope[..., 0] = x * b + y * c + z * d
    slope[..., 1] = z * c - a * x - y * d
    slope[..., 2] = x * d - a * y - z * b
    slope[..., 3] = y * b - a * z - x * c
    return slope


def _rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """``q v q*`` (m, 3) of one vector by m unit quaternions."""
    t = 2 * _cross(q[..., 1:], v)
    return v + q[..., :1] * t + _cross(q[..., 1:], t)


@dataclass(frozen=True)
class _Window:
    """The raw quaternions of one arc that its refinement uses, and the nodes of the integration."""

    time: np.ndarray  # (n,)
    measured: np.ndarray  # (n, 4)
    sigma: np.ndarray  # (n, 3)
    nodes: np.ndarray
    pulsed: bool  # whether torque is commanded inside


def _window(dynamics: _Dynamics, arc: Arc, peak: float) -> _Window:
    """The samples from the arc's start on: all of an arc with pulses, the first minutes of one without."""
    tracker = dynamics.campaign.star_tracker
    first = int(np.searchsorted(tracker.time, arc.start - 1e-9))
    last = int(np.searchsorted(tracker.time, arc.stop + 1e-9))
    edges = torque_edges(dynamics.campaign)
    bounds = np.concatenate([[arc.start], edges[(edges > arc.start) & (edges < arc.stop)], [arc.stop]])
    pulsed = bool(np.any(command_at(dynamics.campaign, 0.5 * (bounds[:-1] + bounds[1:])) != 0))
    length = REFINEMENT_WINDOW_OF_PULSES if pulsed else REFINEMENT_WINDOW
    length = max(length, float(tracker.time[min(first + 60, last - 1)] - arc.start))
    last = min(last, int(np.searchsorted(tracker.time, arc.start + length + 1e-9)))
    time = tracker.time[first:last]
    nodes = dynamics.nodes(arc.start, max(float(time[-1]), arc.start + 1e-3), peak)
    return _Window(time, tracker.quaternion[first:last], tracker.standard_deviation[first:last], nodes, pulsed)


def _errors(
    dynamics: _Dynamics, window: _Window, q: np.ndarray, w: np.ndarray, torque_map: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Whitened attitude errors of the first of m states, and their changes with the others.

    Returns:
        Measured against predicted (n, 3), and the turns of the other trajectories against the first (n, m - 1, 3).
    """
    q, w = dynamics.run(q, w, window.nodes, torque_map)
    slope = _attitude_slope(q, w)
    cell = np.clip(np.searchsorted(window.nodes, window.time, side="right") - 1, 0, len(window.nodes) - 2)
    width = window.nodes[cell + 1] - window.nodes[cell]
    x, h = ((window.time - window.nodes[cell]) / width)[:, None, None], width[:, None, None]
    predicted = (1 + 2 * x) * (1 - x) ** 2 * q[cell] + x * (1 - x) ** 2 * h * slope[cell]
    predicted += x**2 * (3 - 2 * x) * q[cell + 1] + x**2 * (x - 1) * h * slope[cell + 1]
    base = Rotation.from_quat(predicted[:, 0], scalar_first=True)
    error = (Rotation.from_quat(window.measured, scalar_first=True) * base.inv()).as_rotvec() / window.sigma
    # The moves are of 1e-5 rad: twice the vector part of other o first* is the turn between them.
    other, first = predicted[:, 1:], predicted[:, :1]
    turn = first[..., :1] * other[..., 1:] - other[..., :1] * first[..., 1:] - _cross(other[..., 1:], first[..., 1:])
    return error, 2 * turn / window.sigma[:, None]


def _refined(
    dynamics: _Dynamics,
    arcs: list[Arc],
    peaks: list[float],
    states: list[tuple[np.ndarray, np.ndarray]],
    torque_map: np.ndarray,
    nominal_map: np.ndarray,
) -> tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray]:
    """States at the arcs' starts and the torque map by robust Gauss-Newton on raw quaternions, the inertia held.

    The equations of motion know where the torque jumps, which a smooth curve does not. The windows are short enough
    that torques left out of the dynamics do little harm; an arc is refined only where that fits its samples better.
    """
    windows = [_window(dynamics, arc, peak) for arc, peak in zip(arcs, peaks, strict=True)]
    pulsed = [i for i, window in enumerate(windows) if window.pulsed and len(window.time) >= 4]
    groups = [[i] for i, window in enumerate(windows) if not window.pulsed and len(window.time) >= 4]
    result = list(states)
    for group in groups + ([pulsed] if pulsed else []):
        shared = 9 if group is pulsed else 0
        new_states, new_map = _refine_group(
            dynamics, [windows[i] for i in group], [states[i] for i in group], torque_map, nominal_map, shared
        )
        for i, state in zip(group, new_states, strict=True):
            result[i] = state
        if shared:
            torque_map = new_map
    return result, torque_map


def _refine_group(
    dynamics: _Dynamics,
    windows: list[_Window],
    states: list[tuple[np.ndarray, np.ndarray]],
    torque_map: np.ndarray,
    nominal_map: np.ndarray,
    shared: int,
) -> tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray]:
    """Gauss-Newton for six numbers of each window's state and, where ``shared`` is 9, the torque map of them all."""
    size = float(np.linalg.norm(nominal_map)) / np.sqrt(3)
    scaling = np.concatenate(
        [np.full(3, 1e-5), np.full(3, 1e-7), np.full(shared, 1e-3 * size)]
    )  # rad, rad/s, 1/(kg m2)
    moves = np.diag(scaling)
    best: tuple[float, list[tuple[np.ndarray, np.ndarray]], np.ndarray] = (np.inf, states, torque_map)
    for iteration in range(3):
        # The last round only judges the step before it: one trajectory for each window.
        count = len(scaling) if iteration < 2 else 0
        targets, jacobians = [], []
        for window, (q, w) in zip(windows, states, strict=True):
            maps = np.repeat(torque_map[None], 1 + count, axis=0)
            if shared:
                maps[1:] += moves[:count, 6:].reshape(-1, 3, 3)
            tilts = Rotation.from_rotvec(np.concatenate([np.zeros((1, 3)), moves[:count, :3]]))
            starts = (tilts * Rotation.from_quat(q, scalar_first=True)).as_quat(scalar_first=True)
            error, turns = _errors(
                dynamics, window, starts, w + np.concatenate([np.zeros((1, 3)), moves[:count, 3:6]]), maps
            )
            targets.append(error.ravel())
            jacobians.append(np.moveaxis(turns, 1, 2).reshape(3 * len(window.time), count))
        scale = float(np.median(np.abs(np.concatenate(targets)))) / 0.6745
        if scale < best[0]:
            best = (scale, states, torque_map)
        if iteration == 2 or scale > 2 * best[0]:
            break
        step = _robust_step(
            targets, jacobians, shared, (nominal_map - torque_map).ravel() / scaling[6:] if shared else None
        )
        states = [
            (
                quaternion_of(
                    Rotation.from_rotvec(scaling[:3] * step[6 * i : 6 * i + 3])
                    * Rotation.from_quat(q, scalar_first=True)
                ),
                w + scaling[3:6] * step[6 * i + 3 : 6 * i + 6],
            )
            for i, (q, w) in enumerate(states)
        ]
        if shared:
            torque_map = torque_map + (scaling[6:] * step[-9:]).reshape(3, 3)
    return best[1], best[2]


def _robust_step(
    targets: list[np.ndarray], jacobians: list[np.ndarray], shared: int, prior: np.ndarray | None
) -> np.ndarray:
    """Least squares with Cauchy weights: six unknowns for each window, then the shared ones with a weak prior."""
    size = 6 * len(targets) + shared
    step = np.zeros(size)
    places = [
        np.concatenate([np.arange(6 * i, 6 * i + 6), np.arange(size - shared, size)]) for i in range(len(targets))
    ]
    for _ in range(6):
        normal, right = np.zeros((size, size)), np.zeros(size)
        for place, target, jacobian in zip(places, targets, jacobians, strict=True):
            left = target - jacobian @ step[place]
            spread = max(1.0, float(np.median(np.abs(left))) / 0.6745)
            weight = 1 / (1 + (left / (2.4 * spread)) ** 2) / spread**2
            normal[np.ix_(place, place)] += jacobian.T @ (weight[:, None] * jacobian)
            right[place] += jacobian.T @ (weight * target)
        if prior is not None:
            # A column that was never commanded stays at its design value; the scale of the step is 1e-3 of the map.
            precision = (1e-3 / TORQUE_PRIOR) ** 2
            normal[np.arange(size - shared, size), np.arange(size - shared, size)] += precision
            right[size - shared :] += precision * prior
        diagonal = 1 / np.sqrt(np.diag(normal) + 1e-300)
        step = diagonal * np.linalg.lstsq(normal * diagonal[:, None] * diagonal, diagonal * right, rcond=1e-13)[0]
    return step
