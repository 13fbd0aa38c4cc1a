"""The closed form of Likhansky and Alekseev on a whole campaign, as printed or corrected, to compare with.

The formulas are in :mod:`problems.alignment.closed_form_common` (right as printed),
:mod:`problems.alignment.closed_form_literal` and :mod:`problems.alignment.closed_form_corrected`. What is wrong in
print is wrong by so much that a chain of it would show only its first error: here every printed formula gets the inputs
that the right formulas give it, except where the article leaves no choice ((27) feeds (28), and (28) all of sections 4
and 5). ``velocity="printed"`` runs (22) to (24) into (13) all the same.

The article's ``Q_A/S`` is ``antenna_from_tracker``; ``actuator_from_tracker`` is its ``Q_U/I Q_I/S``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import Any, Literal

import numpy as np
from scipy.constants import speed_of_light
from scipy.spatial.transform import Rotation

from estimator.linear_block import LinearBlock, choose_degree, compress
from estimator.models.errors import BoresightError
from problems.alignment import closed_form_common as common
from problems.alignment import closed_form_corrected as corrected
from problems.alignment import closed_form_literal as literal
from problems.alignment.attitude_at_epochs import attitude_at_epochs
from problems.alignment.campaign import Arc, Campaign
from problems.alignment.starting_point import nearest_physical

Variant = Literal["literal", "corrected"]

EARTH_GRAVITY = 3.986004418e14  # m3/s2
EARTH_RADIUS = 6378137.0  # m
J2 = 1.08262668e-3  # of the Earth's gravity field
END_SHARE = 0.04  # of a fit, at each end, where its derivatives are not used
ILL_CONDITIONED = 3e-3  # last but one over first singular value below which more than the scale is open


@dataclass(frozen=True, eq=False)
class ClosedFormEstimate:
    """What the closed form makes of a campaign; None where the campaign has no data for it.

    Attributes:
        variant: "literal" or "corrected".
        antenna_from_tracker: (4,) unit quaternion, the article's Q_A/S of (18).
        actuator_from_tracker: (4,) quaternion, Q_U/I Q_I/S of (40) and (48); the printed one need not be of unit
            length.
        normalized_inertia: (3, 3), trace 1, tracker axes; from (28) it need not be physical.
        principal_moments: (3,) of it, largest first, from (34) and (37).
        principal_from_tracker: (4,) Q_I/S of (41).
        degree: D of the Fourier series (20).
        position_standard_deviation: (21), m for each coordinate.
        velocity_standard_deviation: (25), m/s for each coordinate.
        instants: the two Doppler epochs of (14), s.
        trajectory_rms: m, GNSS positions against the series that was used.
        doppler_residuals: (n, b) Hz, measured minus predicted; empty without an antenna estimate.
        doppler_deviation: (n, b) Hz, what noise alone would give.
        notes: what is ill-conditioned, missing, or wrong in print.
    """

    variant: Variant
    antenna_from_tracker: np.ndarray | None
    actuator_from_tracker: np.ndarray | None
    normalized_inertia: np.ndarray | None
    principal_moments: np.ndarray | None
    principal_from_tracker: np.ndarray | None
    degree: int
    position_standard_deviation: float
    velocity_standard_deviation: float
    instants: tuple[float, float] | None
    trajectory_rms: float
    doppler_residuals: np.ndarray
    doppler_deviation: np.ndarray
    notes: tuple[str, ...]


def closed_form(
    campaign: Campaign,
    variant: Variant = "corrected",
    *,
    velocity: Literal["least-squares", "printed"] = "least-squares",
) -> ClosedFormEstimate:
    """The closed form on a campaign.

    Args:
        campaign: the measured data.
        variant: "literal" for the printed formulas, "corrected" for the right ones.
        velocity: whose velocity goes into (13): that of the least-squares fit, or (literal only) that of (22) and (24).

    Nothing in the article is robust: gross outliers go through, and the choice of instants even looks for them.
    """
    notes: list[str] = []
    block = _trajectory(campaign)
    series = _series(campaign, block, variant, notes)
    speed = series.velocity if variant == "literal" and velocity == "printed" else lambda t: block.values(t, 1)
    antenna, instants, residuals, deviation = _antenna(campaign, speed, variant, notes)
    inertia = _inertia(campaign, variant, notes)
    actuator = _actuator(campaign, inertia, variant, notes)
    return ClosedFormEstimate(
        variant=variant,
        antenna_from_tracker=antenna,
        actuator_from_tracker=actuator,
        normalized_inertia=None if inertia is None else inertia.tensor,
        principal_moments=None if inertia is None else inertia.moments,
        principal_from_tracker=None if inertia is None else inertia.principal_from_tracker,
        degree=series.degree,
        position_standard_deviation=series.position_deviation,
        velocity_standard_deviation=series.velocity_deviation,
        instants=instants,
        trajectory_rms=series.rms,
        doppler_residuals=residuals,
        doppler_deviation=deviation,
        notes=tuple(notes),
    )


def closed_form_answer(campaign: Campaign, *, literal: bool) -> tuple[dict[str, Any], Callable[[], object]]:
    """The answer of ``boresight solve --method closed-form[-literal]``: JSON contract, and the text for people."""
    import time

    begin = time.perf_counter()
    estimate = closed_form(campaign, "literal" if literal else "corrected")
    answer = _as_dict(campaign, estimate)
    answer["seconds"] = time.perf_counter() - begin
    return answer, lambda: _as_text(answer, estimate)


# --- section 3: trajectory -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Series:
    """The Fourier series that a variant chooses, and its accuracy by (21) and (25)."""

    degree: int
    position_deviation: float
    velocity_deviation: float
    rms: float
    velocity: Callable[[np.ndarray], np.ndarray]


def _trajectory(campaign: Campaign) -> LinearBlock:
    """(20) by truncated least squares over the positions, of a degree chosen from the data, Doppler epochs included."""
    gnss = campaign.gnss
    choice = choose_degree(gnss.time, gnss.position, gnss.standard_deviation)
    return compress(choice.frame, gnss.time, gnss.position, 1 / gnss.standard_deviation**2)


def _series(campaign: Campaign, block: LinearBlock, variant: Variant, notes: list[str]) -> _Series:
    gnss = campaign.gnss
    if variant == "corrected":
        inside = np.linspace(gnss.time[0], gnss.time[-1], 201)[20:-20]
        deviations = [
            float(np.sqrt(np.mean([np.mean(block.standard_deviation(inside, d, axis) ** 2) for axis in range(3)])))
            for d in (0, 1)
        ]
        rms = float(np.sqrt(np.mean(block.residuals() ** 2)))
        return _Series(block.frame.degree, deviations[0], deviations[1], rms, lambda t: block.values(t, 1))
    span = float(gnss.time[-1] - gnss.time[0])
    count = len(gnss.time) - 1
    sigma = float(np.sqrt(np.mean(gnss.standard_deviation**2)))
    truncation, model_time, model_position, model_velocity = _modelled_truncation(campaign, block)
    degree = literal.optimal_degree(truncation, sigma, count)
    fit = corrected.fourier_fit(model_time, model_position, degree)
    slope_truncation = float(np.sqrt(np.mean((fit.values(model_time, 1) - model_velocity) ** 2)))
    even = np.linspace(gnss.time[0], gnss.time[-1], count + 1)
    position = gnss.position
    if np.max(np.abs(even - gnss.time)) > 1e-6 * span / count:
        notes.append("(22) needs evenly spaced positions; they were interpolated linearly")
        position = np.stack([np.interp(even, gnss.time, gnss.position[:, i]) for i in range(3)], axis=1)
    coefficients = literal.projection_coefficients(position, span, degree)
    middle = float(gnss.time[0]) + 0.5 * span
    shown = np.linspace(gnss.time[0], gnss.time[-1], 2000)
    printed, fitted = literal.projected_position(coefficients, span, shown - middle), block.values(shown)
    inner = slice(500, 1500)
    ratio = float(np.sum(printed[inner] * fitted[inner]) / np.sum(fitted[inner] ** 2))
    printed_speed = literal.projected_velocity(coefficients, span, shown - middle)[inner]
    right_speed = block.values(shown[inner], 1)
    slope_ratio = float(np.sum(printed_speed * right_speed) / np.sum(right_speed**2))
    notes.append(
        f"(20) to (24): in the middle half of the arc the printed series gives {ratio:+.4f} times the position and "
        f"{slope_ratio:+.4f} times the velocity, since its basis is a frame with bound 2 and (24) has the wrong sign"
    )
    return _Series(
        degree,
        float(literal.position_deviation(truncation[degree : degree + 1], np.array([degree]), sigma, count)[0]),
        literal.velocity_deviation(slope_truncation, degree, span, sigma, count),
        float(np.sqrt(np.mean((printed - fitted) ** 2))),
        lambda t: literal.projected_velocity(coefficients, span, np.asarray(t) - middle),
    )


def _modelled_truncation(
    campaign: Campaign, block: LinearBlock
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """``delta(T, D)`` (m) for D = 0, 1, ... from a modelled trajectory, as section 3.2 has it, and that trajectory.

    The model is an orbit under the central field and J2 from the position and velocity in the middle of the campaign.
    """
    from scipy.integrate import solve_ivp

    begin, end = float(campaign.gnss.time[0]), float(campaign.gnss.time[-1])
    middle = 0.5 * (begin + end)
    spin = np.array([0.0, 0.0, campaign.earth_rotation_rate])

    def to_inertial(t: np.ndarray) -> Rotation:
        angle = campaign.earth_rotation_angle_at_epoch + campaign.earth_rotation_rate * np.atleast_1d(t)
        return Rotation.from_rotvec(angle[:, None] * np.array([0.0, 0.0, 1.0]))

    r0, v0 = block.values(np.array([middle])), block.values(np.array([middle]), 1)
    turn = to_inertial(np.array([middle]))
    state = np.concatenate([turn.apply(r0)[0], turn.apply(v0 + np.cross(spin, r0))[0]])

    def slope(_: float, y: np.ndarray) -> np.ndarray:
        r = y[:3]
        distance = np.linalg.norm(r)
        factor = 1.5 * J2 * (EARTH_RADIUS / distance) ** 2
        z2 = 5 * (r[2] / distance) ** 2
        oblate = 1 + factor * (np.array([1.0, 1.0, 3.0]) - z2)
        return np.concatenate([y[3:], -EARTH_GRAVITY / distance**3 * r * oblate])

    period = 2 * np.pi * np.sqrt(np.linalg.norm(state[:3]) ** 3 / EARTH_GRAVITY)
    most = int(np.clip(16 * (end - begin) / period + 32, 8, (len(campaign.gnss.time) - 1) // 4))
    time = np.linspace(begin, end, max(4 * most + 1, 257))
    halves = []
    for stop, part in ((begin, time[time <= middle][::-1]), (end, time[time > middle])):
        solution = solve_ivp(slope, (middle, stop), state, method="DOP853", t_eval=part, rtol=1e-9, atol=1e-3)
        halves.append(solution.y.T)
    inertial = np.concatenate([halves[0][::-1], halves[1]])
    back = to_inertial(time).inv()
    position = back.apply(inertial[:, :3])
    velocity = back.apply(inertial[:, 3:]) - np.cross(spin, position)
    squares = corrected.residuals_by_degree(time, position, most)
    return np.sqrt(np.mean(squares, axis=1) / len(time)), time, position, velocity


# --- sections 1 and 2: antenna ---------------------------------------------------------------------------------------


def _antenna(
    campaign: Campaign, speed: Callable[[np.ndarray], np.ndarray], variant: Variant, notes: list[str]
) -> tuple[np.ndarray | None, tuple[float, float] | None, np.ndarray, np.ndarray]:
    """(1), (2), (13) to (18); with the Doppler residuals (n, b) Hz and their deviation by noise alone."""
    nothing = (None, None, np.zeros((0, 0)), np.zeros((0, 0)))
    doppler = campaign.doppler
    if doppler is None or len(doppler.time) < 2:
        notes.append("antenna: there are no Doppler data")
        return nothing
    if doppler.frequency_shift.shape[1] < 3:
        notes.append("antenna: (2) needs three beams; the joint estimate does with fewer")
        return nothing
    try:
        attitude = attitude_at_epochs(campaign.star_tracker, doppler.time)
    except BoresightError as error:
        notes.append(f"antenna: {error}")
        return nothing
    inside = (doppler.time >= campaign.gnss.time[0]) & (doppler.time <= campaign.gnss.time[-1])
    used = np.flatnonzero(attitude.covered & inside)
    if len(used) < 2:
        notes.append("antenna: fewer than two Doppler epochs have attitude and velocity")
        return nothing
    beams = doppler.beam_direction if doppler.beam_direction.ndim == 3 else doppler.beam_direction[None]
    beams = np.repeat(beams, len(doppler.time), axis=0)[used] if len(beams) == 1 else beams[used]
    three = _widest_three(beams)
    shift = doppler.frequency_shift[used]
    time = doppler.time[used]
    earth = common.inertial_from_earth_fixed(time, campaign.earth_rotation_rate, campaign.earth_rotation_angle_at_epoch)
    v_tracker = common.velocity_in_tracker(speed(time), attitude.quaternion[used], earth)
    change = common.basis_change(campaign.nominal.antenna_from_tracker)
    try:
        v_antenna = common.velocity_from_three_beams(beams[:, three], shift[:, three], doppler.carrier_frequency)
        v_changed = common.rotated(change, v_antenna)
        instants = common.chosen_instants(v_tracker, v_changed)
    except BoresightError as error:
        notes.append(f"antenna: {error}")
        return nothing
    pair = np.array(instants)
    axis = common.rotation_axis(v_tracker[pair], v_changed[pair])
    e, turned = common.perpendicular_pair(v_tracker[pair[0]], v_changed[pair[0]], axis)
    formula = literal.rotation_angle if variant == "literal" else corrected.rotation_angle
    angle = formula(e, turned, axis)
    quaternion = common.multiply(common.conjugate(change), common.quaternion_about(axis, angle))
    quaternion = quaternion if quaternion[0] >= 0 else -quaternion
    if variant == "literal":
        notes.append(
            f"(17): the printed factor 2 turns the antenna by {np.degrees(abs(angle)):.1f} degrees, twice too much"
        )
    direction = np.linalg.norm(np.cross(v_tracker[pair[0]], v_tracker[pair[1]])) / (
        np.linalg.norm(v_tracker[pair[0]]) * np.linalg.norm(v_tracker[pair[1]])
    )
    moved = np.degrees(np.arcsin(min(1.0, float(direction))))
    notes.append(
        f"(15): two of {len(used)} instants are used; the velocity moves by {moved:.1f} degrees in tracker axes "
        "between them"
    )
    gain = 2 * doppler.carrier_frequency / speed_of_light
    predicted = gain * np.einsum("nbi,ni->nb", beams, common.rotated(quaternion, v_tracker))
    in_tracker = common.conjugated(quaternion, beams.reshape(-1, 3)).reshape(beams.shape)
    lever = np.cross(v_tracker[:, None], in_tracker) * attitude.standard_deviation[used][:, None]
    deviation = np.sqrt(doppler.standard_deviation[used] ** 2 + gain**2 * np.sum(lever**2, axis=2))
    return quaternion, (float(time[pair[0]]), float(time[pair[1]])), shift - predicted, deviation


def _widest_three(beams: np.ndarray) -> list[int]:
    """The three beams that span the most space, for (2); beams (n, b, 3)."""
    triples = [list(t) for t in combinations(range(beams.shape[1]), 3)]
    return triples[int(np.argmax([np.min(np.abs(np.linalg.det(beams[:, t]))) for t in triples]))]


# --- section 4: inertia ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Inertia:
    """Tensor of trace 1, its moments, axes and Q_I/S."""

    tensor: np.ndarray
    moments: np.ndarray
    principal_from_tracker: np.ndarray


def _stretches(campaign: Campaign, start: float, stop: float, fewest: int) -> list[slice]:
    """Runs of star-tracker samples between two times without long gaps."""
    time = campaign.star_tracker.time
    first, last = np.searchsorted(time, [start - 1e-9, stop + 1e-9])
    if last - first < fewest:
        return []
    steps = np.diff(time[first:last])
    cuts = first + 1 + np.flatnonzero(steps > 3.5 * np.median(steps))
    bounds = [int(first), *(int(c) for c in cuts), int(last)]
    return [slice(a, b) for a, b in pairwise(bounds) if b - a >= fewest]


def _orientation(campaign: Campaign, part: slice) -> np.ndarray:
    """Measured matrices (n, 3, 3) ``inertial_from_tracker``: (42) of the article's S(t)."""
    rotation = Rotation.from_quat(campaign.star_tracker.quaternion[part], scalar_first=True)
    return np.asarray(rotation.inv().as_matrix())


def _smoothed(campaign: Campaign, part: slice, most: int | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fourier smoothing of section 4.1: orientation (n, 3, 3), rate and acceleration (n, 3) away from the ends."""
    time, matrices = campaign.star_tracker.time[part], _orientation(campaign, part)
    if most is None:
        turns = float(np.sum(Rotation.from_matrix(matrices[1:] @ np.swapaxes(matrices[:-1], 1, 2)).magnitude()))
        # Noise lengthens the path of every step; the straight count over every tenth sample does not suffer from it.
        coarse = matrices[::10]
        turns = min(turns, float(np.sum(Rotation.from_matrix(coarse[1:] @ np.swapaxes(coarse[:-1], 1, 2)).magnitude())))
        most = int(6 * turns / (2 * np.pi) + 16)
    most = max(1, min(most, (len(time) - 4) // 6))
    flat = matrices.reshape(-1, 9)
    squares = np.sum(corrected.residuals_by_degree(time, flat, most), axis=1)
    freedom = np.maximum(len(time) - corrected.numerical_rank(np.arange(most + 1)), 1)
    # Generalized cross-validation: the accuracy of the star tracker need not be known.
    degree = int(np.argmin(squares / freedom**2))
    fit = corrected.fourier_fit(time, flat, degree)
    skip = max(1, int(END_SHARE * len(time)))
    inner = time[skip : len(time) - skip]
    value, first, second = (fit.values(inner, d).reshape(-1, 3, 3) for d in (0, 1, 2))
    orientation = Rotation.from_matrix(value).as_matrix()
    rate = corrected.vector_of_skew(corrected.rate_matrix(value, first))
    acceleration = corrected.vector_of_skew(corrected.acceleration_matrix(value, first, second))
    return orientation, rate, acceleration


def _inertia(campaign: Campaign, variant: Variant, notes: list[str]) -> _Inertia | None:
    """(26) to (41) on the free arcs."""
    parts = [(arc, part) for arc in campaign.arcs_of_kind("free_rotation") for part in _free_parts(campaign, arc)]
    if not parts:
        notes.append("inertia: there is no free-rotation arc with enough attitude data")
        return None
    return _printed_inertia(campaign, parts, notes) if variant == "literal" else _right_inertia(campaign, parts, notes)


def _free_parts(campaign: Campaign, arc: Arc) -> list[slice]:
    return _stretches(campaign, arc.start, arc.stop, 40)


def _printed_inertia(campaign: Campaign, parts: list[tuple[Arc, slice]], notes: list[str]) -> _Inertia | None:
    """(27) to (41) as printed, on the longest arc: every arc has an energy of its own."""
    arc, part = max(parts, key=lambda p: p[1].stop - p[1].start)
    matrices = _orientation(campaign, part)
    step = float(np.median(np.diff(campaign.star_tracker.time[part])))
    g = literal.inertia_over_energy(literal.rate_from_difference(matrices, step))
    trace = float(np.trace(g))
    family = corrected.inertia_over_energy(_smoothed(campaign, part)[1])
    notes.append(
        f"(28) leaves one direction undetermined: on arc {arc.name} its least singular value is "
        f"{family.singular_values[5] / family.singular_values[0]:.1e} of the largest on smoothed rates; "
        "any J + s (L^2 J - 2H J^2) keeps the energy as well"
    )
    tensor = g / trace
    if trace <= 0 or np.linalg.eigvalsh(tensor)[0] <= 0:
        notes.append("(29): the printed solution is not positive definite")
    centred = common.traceless(tensor)
    a, b = common.cubic_linear_coefficient(centred), literal.cubic_constant(centred)
    first = literal.largest_root(a, b)
    roots = np.array([first, *literal.other_roots(first, b)])
    moments = roots + 1 / 3
    exact = np.sort(np.linalg.eigvalsh(tensor))[::-1]
    if not np.allclose(moments, exact, rtol=0, atol=1e-6):
        notes.append("(33): the sign of the determinant is lost, and the printed moments are not the eigenvalues")
    if not np.all(np.isfinite(roots)):
        notes.append("(37): the printed discriminant is negative; there are no principal axes")
        return _Inertia(tensor, moments, np.full(4, np.nan))
    axes = np.stack([literal.principal_axis(centred, root) for root in roots], axis=1)
    if np.all(np.isfinite(axes)) and np.linalg.det(axes) < 0:
        axes[:, 2] *= -1
    # (41) as printed gives no unit quaternion; that is a misprint of (48), which is used.
    return _Inertia(tensor, moments, literal.quaternion_of_actuator_axes(axes))


def _right_inertia(campaign: Campaign, parts: list[tuple[Arc, slice]], notes: list[str]) -> _Inertia:
    """Momentum form on all free arcs, then (30) to (41) corrected."""
    rates, matrices = [], []
    for _, part in parts:
        orientation, rate, _ = _smoothed(campaign, part)
        thin = max(1, len(rate) // 400)
        rates.append(rate[::thin])
        matrices.append(orientation[::thin])
    solution = corrected.inertia_from_momentum(rates, matrices)
    ratio = float(solution.singular_values[4] / solution.singular_values[0])
    notes.append(
        "(28) alone leaves one direction undetermined on any number of arcs; S J w = const takes its place "
        f"(last but one singular value {ratio:.1e} of the largest)"
    )
    if ratio < ILL_CONDITIONED:
        notes.append("inertia: the free arcs hardly move the rate in the body; the inertia ratios are ill-conditioned")
    tensor = solution.tensor
    if np.linalg.eigvalsh(tensor)[0] <= 0:
        notes.append("inertia: the solution is not positive definite")
    design = nearest_physical(campaign.nominal.inertia / np.trace(campaign.nominal.inertia))
    axes = corrected.principal_axes(tensor, corrected.principal_axes(design))
    return _Inertia(tensor, corrected.principal_moments(tensor), corrected.quaternion_of_matrix(axes))


# --- section 5: actuators --------------------------------------------------------------------------------------------


def _actuator(campaign: Campaign, inertia: _Inertia | None, variant: Variant, notes: list[str]) -> np.ndarray | None:
    """(43) to (48) and the product ``Q_U/I Q_I/S``."""
    torque = campaign.torque
    if torque is None or len(torque.start) == 0:
        notes.append("actuator: no torque was commanded")
        return None
    if inertia is None:
        notes.append("actuator: (44) needs the inertia tensor, and there is none")
        return None
    if not np.all(np.isfinite(inertia.principal_from_tracker)):
        notes.append(
            "(39), (41): the printed axes are not orthogonal, and there is no quaternion; nor one of the actuators"
        )
        return None
    torques, commands = [], []
    for start, stop, command in zip(torque.start, torque.stop, torque.command, strict=True):
        for part in _stretches(campaign, float(start), float(stop), 12):
            # Inside a segment the torque is constant and a low degree is enough; a jump would need a very high one.
            _, rate, acceleration = _smoothed(campaign, part, most=3)
            turned = [common.rotated(inertia.principal_from_tracker, x) for x in (rate, acceleration)]
            series = common.euler_torque(inertia.moments, *turned)
            torques.append(series[len(series) // 2] if variant == "literal" else np.mean(series, axis=0))
            commands.append(command)
    if not torques:
        notes.append("actuator: no commanded segment has enough attitude data")
        return None
    if variant == "literal":
        return _printed_actuator(np.array(torques), np.array(commands), inertia, notes)
    matrix, singular = corrected.torque_map(np.array(torques), np.array(commands))
    if singular[2] < 1e-3 * singular[0]:
        notes.append("actuator: the commands do not span three axes")
        return None
    rotation, right_handed = corrected.nearest_rotation(matrix)
    if not right_handed:
        notes.append("actuator: the torques form a left-handed set; the sign of one commanded axis may be reversed")
    actuator_from_principal = corrected.quaternion_of_matrix(rotation)
    return common.multiply(actuator_from_principal, inertia.principal_from_tracker)


def _printed_actuator(
    torques: np.ndarray, commands: np.ndarray, inertia: _Inertia, notes: list[str]
) -> np.ndarray | None:
    """(46), (48) as printed: one instant of one pulse on each axis."""
    columns = []
    for axis in range(3):
        alone = [i for i, c in enumerate(commands) if c[axis] != 0 and np.count_nonzero(c) == 1]
        if not alone:
            notes.append(f"(46): no pulse acts on actuator axis {axis + 1} alone")
            return None
        columns.append(torques[alone[0]] * np.sign(commands[alone[0], axis]))
    matrix = common.normalized_columns(np.stack(columns, axis=1))
    oblique = float(np.max(np.abs(matrix.T @ matrix - np.eye(3))))
    notes.append(f"(46): the printed matrix is orthogonal to {oblique:.1e} only, and (48) takes it as it is")
    return common.multiply(literal.quaternion_of_actuator_axes(matrix), inertia.principal_from_tracker)


# --- the answer ------------------------------------------------------------------------------------------------------


def _as_dict(campaign: Campaign, estimate: ClosedFormEstimate) -> dict[str, Any]:
    """The machine-readable answer; the closed form has no covariance, so that sigmas are null."""
    missing = [
        words
        for words, value in (
            ("the rotation of the antenna against the star tracker", estimate.antenna_from_tracker),
            ("the rotation of the actuators against the star tracker", estimate.actuator_from_tracker),
            ("the inertia tensor", estimate.normalized_inertia),
        )
        if value is None or not np.all(np.isfinite(value))
    ]
    residuals: dict[str, dict[str, Any]] = {
        "gnss": {
            "rms": estimate.trajectory_rms,
            "unit": "m",
            "chi2_per_dof": estimate.trajectory_rms**2 / float(np.mean(campaign.gnss.standard_deviation**2)),
        }
    }
    if estimate.doppler_residuals.size:
        whitened = estimate.doppler_residuals / estimate.doppler_deviation
        residuals["doppler"] = {
            "rms": float(np.sqrt(np.mean(estimate.doppler_residuals**2))),
            "unit": "Hz",
            "chi2_per_dof": float(np.mean(whitened**2)),
        }
    worst = max(r["chi2_per_dof"] for r in residuals.values())
    if worst > 1.5:
        status = "model_gap"
        channel = max(residuals, key=lambda c: residuals[c]["chi2_per_dof"])
        why = f"the closed form leaves {channel} residuals {np.sqrt(worst):.3g} times the noise; use the joint estimate"
    elif missing:
        status, why = "unobservable", "the closed form does not determine " + "; ".join(missing)
    else:
        status, why = "ok", "all quantities were computed; the closed form gives no covariance"

    def rotation(value: np.ndarray | None) -> dict[str, Any]:
        known = value is not None and bool(np.all(np.isfinite(value)))
        return {"quaternion": [float(x) for x in value] if known and value is not None else None, "sigma_rad": None}

    inertia = estimate.normalized_inertia
    return {
        "status": status,
        "why": why,
        "chi2_per_dof": worst,
        "method": "closed-form-literal" if estimate.variant == "literal" else "closed-form",
        "antenna_from_tracker": rotation(estimate.antenna_from_tracker),
        "actuator_from_tracker": rotation(estimate.actuator_from_tracker),
        "normalized_inertia": {
            "matrix": [[float(x) for x in row] for row in inertia] if inertia is not None else None,
            "sigma": None,
        },
        "trajectory": {
            "degree": estimate.degree,
            "rms_m": estimate.trajectory_rms,
            "position_sigma_m": estimate.position_standard_deviation,
            "velocity_sigma_m_s": estimate.velocity_standard_deviation,
        },
        "effects": [],
        "unobservable": missing,
        "residuals": residuals,
        "notes": list(estimate.notes),
    }


def _as_text(answer: dict[str, Any], estimate: ClosedFormEstimate) -> str:
    """A few lines for people."""

    def words(value: np.ndarray | None) -> str:
        return "not determined" if value is None else np.array2string(value, precision=6, suppress_small=True)

    lines = [
        f"closed form, {estimate.variant}: {answer['status']} ({answer['why']})",
        f"antenna_from_tracker   {words(estimate.antenna_from_tracker)}",
        f"actuator_from_tracker  {words(estimate.actuator_from_tracker)}",
        f"normalized_inertia\n{words(estimate.normalized_inertia)}",
        f"trajectory             degree {estimate.degree}, rms {estimate.trajectory_rms:.3g} m",
    ]
    lines += [f"{name:<22} rms {r['rms']:.4g} {r['unit']}" for name, r in answer["residuals"].items()]
    return "\n".join([*lines, *(f"- {note}" for note in estimate.notes)])
