"""The starting point of the joint estimate: errors against known truth, with bad data and with parts missing."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from problems.alignment.attitude_curve import attitude_curves
from problems.alignment.campaign import Campaign, DopplerSeries, Nominal
from problems.alignment.simulator import preset, simulate
from problems.alignment.starting_point import (
    StartingPoint,
    is_physical,
    nearest_physical,
    robust_wahba,
    starting_point,
    wahba,
)

SHARED_CAMPAIGNS = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "campaigns"


def angle(a: np.ndarray, b: np.ndarray) -> float:
    """Angle (rad) between two rotations given as quaternions."""
    difference = Rotation.from_quat(a, scalar_first=True) * Rotation.from_quat(b, scalar_first=True).inv()
    return float(difference.magnitude())


def start_of(campaign: Campaign, truth) -> StartingPoint:
    return starting_point(campaign, lambda t: truth.trajectory(t)[1], lambda t: truth.trajectory(t)[0])


def check(point: StartingPoint, truth, *, inertia: float = 1e-3, actuator: float = 4e-3, rate: float = 1e-5) -> None:
    assert angle(point.antenna_from_tracker, truth.antenna_from_tracker) < 1e-4  # rad
    assert np.max(np.abs(point.normalized_inertia - truth.normalized_inertia)) < inertia
    assert np.trace(point.normalized_inertia) == pytest.approx(1.0)
    assert angle(point.actuator_from_tracker, truth.actuator_from_tracker) < actuator  # rad
    assert point.inertia_trace == pytest.approx(np.trace(truth.inertia), rel=2e-3)
    assert set(point.arc_states) == set(truth.arc_states)
    for name, (attitude, w) in point.arc_states.items():
        assert angle(attitude, truth.arc_states[name].attitude) < 3e-4, name  # rad
        assert np.linalg.norm(w - truth.arc_states[name].rate) < rate, name  # rad/s


# Gaps: at the arc's start, short, long (the rotation across it cannot be counted), and inside a pulse.
GAPS = ((2459.0, 2472.0), (2560.0, 2590.0), (2660.0, 2750.0), (3200.0, 3207.0))

CASES = {
    "as designed": {},
    "gross outliers": {"star_tracker_outlier_fraction": 0.05, "doppler_outlier_fraction": 0.05},
    "gaps": {"star_tracker_gaps": GAPS, "star_tracker_step": 0.25},
    "gaps and outliers": {
        "star_tracker_gaps": GAPS,
        "star_tracker_step": 0.25,
        "star_tracker_outlier_fraction": 0.05,
        "doppler_outlier_fraction": 0.05,
    },
    "irregular sampling": {"star_tracker_jitter": 0.8, "doppler_jitter": 0.8},
    "accuracy that varies": {"noise_variation": 2.0},
    "Doppler between tracker epochs": {"doppler_time_offset": 0.13},
    "four degrees a second": {"free_rate": 0.07, "star_tracker_step": 0.25},
    "short pulses": {"pulse_segments": ((5.0, 8.0, 0.6), (10.0, 12.0, -0.6), (14.0, 20.0, 0.4))},
    "two beams": {"beams": 2},
}


@pytest.mark.parametrize("case", CASES)
def test_truth_is_found(case: str) -> None:
    campaign, truth = simulate(preset("compact", **CASES[case]), seed=1 + list(CASES).index(case))
    # Three seconds of torque at 2 Hz leave little to tell the rate before them from the torque itself.
    check(start_of(campaign, truth), truth, rate=3e-5 if case == "short pulses" else 1e-5)


def test_design_values_far_from_the_truth_do_no_harm() -> None:
    campaign, truth = simulate(preset("compact"), seed=3)
    far = Nominal(
        antenna_from_tracker=np.array([0.0, 0.6, 0.0, 0.8]),
        actuator_from_tracker=np.array([0.0, 0.0, 1.0, 0.0]),
        inertia=np.diag([300.0, 300.0, 100.0]),
    )
    check(start_of(dataclasses.replace(campaign, nominal=far), truth), truth)


def test_pulses_alone_determine_the_inertia() -> None:
    campaign, truth = simulate(preset("no-free-rotation"), seed=1)
    check(start_of(campaign, truth), truth, inertia=3e-3)


def test_slow_rotation_stays_usable_and_physical() -> None:
    campaign, truth = simulate(preset("compact", free_rate=3.5e-4, free_arcs=1), seed=1)
    point = start_of(campaign, truth)
    check(point, truth, inertia=1.5e-2)
    assert is_physical(point.normalized_inertia)


def test_missing_arcs_keep_the_design_value_and_say_so() -> None:
    campaign, truth = simulate(preset("compact", free_arcs=0, pulse_axes=()), seed=1)
    point = start_of(campaign, truth)
    nominal = campaign.nominal
    assert angle(point.actuator_from_tracker, nominal.actuator_from_tracker) < 1e-12
    assert point.normalized_inertia == pytest.approx(nominal.inertia / np.trace(nominal.inertia))
    assert point.inertia_trace == pytest.approx(np.trace(nominal.inertia))
    assert not point.arc_states
    assert {note.split(":")[0] for note in point.notes} == {"inertia", "actuator"}
    without = start_of(dataclasses.replace(campaign, doppler=None), truth)
    assert angle(without.antenna_from_tracker, nominal.antenna_from_tracker) < 1e-12
    assert any(note.startswith("antenna") for note in without.notes)


def test_one_commanded_axis_leaves_the_rotation_about_it_to_the_design() -> None:
    campaign, truth = simulate(preset("compact", pulse_axes=(0,)), seed=1)
    point = start_of(campaign, truth)
    axis = np.array([1.0, 0.0, 0.0])
    estimated = Rotation.from_quat(point.actuator_from_tracker, scalar_first=True).inv().apply(axis)
    true = Rotation.from_quat(truth.actuator_from_tracker, scalar_first=True).inv().apply(axis)
    assert np.linalg.norm(estimated - true) < 2e-3
    assert any("(+1.00, +0.00, +0.00)" in note for note in point.notes)
    assert angle(point.actuator_from_tracker, campaign.nominal.actuator_from_tracker) < 0.05


def test_command_on_several_axes_at_once() -> None:
    """Each pulse is commanded along a slanted direction: the same torques in a turned actuator frame."""
    campaign, truth = simulate(preset("compact"), seed=4)
    turn = Rotation.from_rotvec([0.7, -0.5, 0.4])
    campaign = dataclasses.replace(
        campaign, torque=dataclasses.replace(campaign.torque, command=turn.apply(campaign.torque.command))
    )
    point = start_of(campaign, truth)
    expected = (turn * Rotation.from_quat(truth.actuator_from_tracker, scalar_first=True)).as_quat(scalar_first=True)
    assert angle(point.actuator_from_tracker, expected) < 2e-3


def test_one_beam_determines_two_angles_and_names_the_third() -> None:
    campaign, truth = simulate(preset("compact", beams=1), seed=2)
    point = start_of(campaign, truth)
    beam = campaign.doppler.beam_direction[0]
    estimated = Rotation.from_quat(point.antenna_from_tracker, scalar_first=True).inv().apply(beam)
    true = Rotation.from_quat(truth.antenna_from_tracker, scalar_first=True).inv().apply(beam)
    assert np.linalg.norm(estimated - true) < 1e-4
    assert any(note.startswith("antenna") for note in point.notes)


def test_beam_directions_that_vary_with_time() -> None:
    """Beams of each epoch turned by a known rotation of the antenna axes, the shifts left as they are."""
    campaign, truth = simulate(preset("compact"), seed=5)
    doppler = campaign.doppler
    assert isinstance(doppler, DopplerSeries)
    steady = starting_point(campaign, lambda t: truth.trajectory(t)[1])
    repeated = np.repeat(doppler.beam_direction[None], len(doppler.time), axis=0)
    varying = dataclasses.replace(campaign, doppler=dataclasses.replace(doppler, beam_direction=repeated))
    point = starting_point(varying, lambda t: truth.trajectory(t)[1])
    assert angle(point.antenna_from_tracker, steady.antenna_from_tracker) < 1e-9
    turn = Rotation.from_rotvec([0.02, -0.01, 0.03])
    turned = turn.apply(repeated.reshape(-1, 3)).reshape(repeated.shape)
    turned_campaign = dataclasses.replace(campaign, doppler=dataclasses.replace(doppler, beam_direction=turned))
    expected = (turn * Rotation.from_quat(truth.antenna_from_tracker, scalar_first=True)).as_quat(scalar_first=True)
    point = starting_point(turned_campaign, lambda t: truth.trajectory(t)[1])
    assert angle(point.antenna_from_tracker, expected) < 1e-4


def test_gravity_gradient_is_counted_where_asked_for() -> None:
    effects = {"gravity-gradient-torque": None}
    campaign, truth = simulate(preset("compact", free_duration=400.0), seed=1, effects=effects)
    plain = starting_point(campaign, lambda t: truth.trajectory(t)[1])
    counted = starting_point(
        campaign, lambda t: truth.trajectory(t)[1], lambda t: truth.trajectory(t)[0], gravity_gradient=True
    )
    check(counted, truth)
    assert plain.quality["inertia"].residual > 1.5 > counted.quality["inertia"].residual
    assert np.max(np.abs(plain.normalized_inertia - truth.normalized_inertia)) < 1e-2


def test_an_arc_without_attitude_is_named_and_left_out() -> None:
    campaign, truth = simulate(preset("compact"), seed=1)
    arc = campaign.arcs_of_kind("free_rotation")[0]
    tracker = campaign.star_tracker
    keep = (tracker.time < arc.start) | (tracker.time > arc.stop)
    cut = dataclasses.replace(
        tracker,
        time=tracker.time[keep],
        quaternion=tracker.quaternion[keep],
        standard_deviation=tracker.standard_deviation[keep],
    )
    point = start_of(dataclasses.replace(campaign, star_tracker=cut), truth)
    assert arc.name not in point.arc_states
    assert any(arc.name in note for note in point.notes)
    assert np.max(np.abs(point.normalized_inertia - truth.normalized_inertia)) < 2e-3


def test_sign_of_the_quaternions_is_free() -> None:
    campaign, truth = simulate(preset("compact"), seed=1)
    signs = np.where(np.random.default_rng(0).random(len(campaign.star_tracker.time)) < 0.5, -1.0, 1.0)[:, None]
    flipped = dataclasses.replace(campaign.star_tracker, quaternion=campaign.star_tracker.quaternion * signs)
    a, b = start_of(campaign, truth), start_of(dataclasses.replace(campaign, star_tracker=flipped), truth)
    assert angle(a.antenna_from_tracker, b.antenna_from_tracker) < 1e-9
    assert a.normalized_inertia == pytest.approx(b.normalized_inertia, abs=1e-9)


@pytest.mark.parametrize("number", [1, 2, 3, 4, 5])
def test_shared_campaigns(number: int) -> None:
    """Attitude motion of another simulator; campaigns 2 to 5 hide an effect that the starting point does not model."""
    path = SHARED_CAMPAIGNS / f"campaign-0{number}.nc"
    if not path.exists():
        pytest.skip(f"the shared campaigns are not here ({path.name}); the generated ones above stand in")
    from scipy.interpolate import make_lsq_spline

    from problems.readers.campaign_file import read_campaign

    campaign = read_campaign(path)
    truth = json.loads((SHARED_CAMPAIGNS / "truth" / f"campaign-0{number}.json").read_text())
    time = campaign.gnss.time
    inner = np.arange(time[0] + 200, time[-1] - 100, 200.0)
    knots = np.concatenate([[time[0]] * 6, inner, [time[-1]] * 6])
    trajectory = make_lsq_spline(time, campaign.gnss.position, knots, 5)
    point = starting_point(campaign, trajectory.derivative(), trajectory)
    inertia = np.array(truth["inertia_tracker"])
    assert angle(point.antenna_from_tracker, np.array(truth["antenna_from_tracker"])) < 1e-3
    assert np.max(np.abs(point.normalized_inertia - inertia / np.trace(inertia))) < 1e-2
    assert angle(point.actuator_from_tracker, np.array(truth["actuator_from_tracker"])) < 1e-2
    assert point.inertia_trace == pytest.approx(np.trace(inertia), rel=1e-2)


# --- parts -----------------------------------------------------------------------------------------------------------


def torque_free(inertia: np.ndarray, rate: np.ndarray, time: np.ndarray) -> tuple[Rotation, np.ndarray]:
    """Independent integration with rotation matrices: tracker_from_inertial and rates of a free body."""

    def slope(_: float, y: np.ndarray) -> np.ndarray:
        a, w = y[:9].reshape(3, 3), y[9:]
        turning = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        return np.concatenate([(-turning @ a).ravel(), np.linalg.solve(inertia, -np.cross(w, inertia @ w))])

    start = np.concatenate([Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix().ravel(), rate])
    solution = solve_ivp(slope, (time[0], time[-1]), start, method="DOP853", t_eval=time, rtol=1e-12, atol=1e-13)
    return Rotation.from_matrix(solution.y[:9].T.reshape(-1, 3, 3)), solution.y[9:].T


def test_attitude_curve_gives_rate_acceleration_and_their_accuracy() -> None:
    inertia = np.diag([0.42, 0.35, 0.23])
    time = np.arange(0.0, 300.0, 0.25)
    attitude, rate = torque_free(inertia, np.array([0.006, -0.009, 0.007]), time)
    acceleration = np.linalg.solve(inertia, -np.cross(rate, rate @ inertia).T).T
    generator = np.random.default_rng(1)
    sigma = np.tile([4e-5, 4e-5, 2e-4], (len(time), 1))  # rad
    squares = []
    inside = slice(100, -100, 40)
    for _ in range(12):
        noisy = Rotation.from_rotvec(generator.normal(size=sigma.shape) * sigma) * attitude
        (curve,) = attitude_curves(time, noisy.as_quat(scalar_first=True), sigma)
        error = curve.rate(time[inside]) - rate[inside]
        covariance = curve.rate_covariance(time[inside])
        squares.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error))
        assert np.max(np.abs(error)) < 1e-5  # rad/s
        assert np.max(np.abs(curve.acceleration(time[inside]) - acceleration[inside])) < 5e-6  # rad/s2
        tilt = (curve.rotation(time[inside]) * attitude[inside].inv()).as_rotvec()
        assert np.max(np.abs(tilt) / curve.quaternion_standard_deviation(time[inside])) < 5.5
        assert curve.residual == pytest.approx(1.0, abs=0.1)
    # 12 x 25 instants of three components, neighbours correlated over a knot interval: the mean square is 3.
    assert np.mean(squares) == pytest.approx(3.0, abs=0.6)


def test_attitude_curve_rejects_outliers_and_splits_at_gaps() -> None:
    time = np.concatenate([np.arange(0.0, 100.0, 0.5), np.arange(400.0, 500.0, 0.5)])
    attitude, rate = torque_free(np.diag([0.42, 0.35, 0.23]), np.array([0.006, -0.009, 0.007]), time)
    generator = np.random.default_rng(2)
    sigma = np.full((len(time), 3), 5e-5)
    noisy = Rotation.from_rotvec(generator.normal(size=sigma.shape) * sigma) * attitude
    quaternion = noisy.as_quat(scalar_first=True)
    wrong = generator.choice(len(time), len(time) // 20, replace=False)
    quaternion[wrong] = Rotation.random(len(wrong), random_state=3).as_quat(scalar_first=True)
    curves = attitude_curves(time, quaternion, sigma)
    assert len(curves) == 2
    assert sum(c.rejected for c in curves) >= len(wrong)
    for curve in curves:
        inside = np.arange(curve.start + 10, curve.stop - 10, 5.0)
        index = np.searchsorted(time, inside)
        assert np.max(np.abs(curve.rate(time[index]) - rate[index])) < 2e-5  # rad/s


def test_wahba_recovers_a_rotation_and_resists_outliers() -> None:
    generator = np.random.default_rng(4)
    rotation = Rotation.from_rotvec([1.0, -2.0, 0.5])
    of = generator.normal(size=(60, 3))
    to = rotation.apply(of)
    assert (wahba(to, of, np.ones(60)) * rotation.inv()).magnitude() < 1e-12
    noisy = to + 1e-4 * generator.normal(size=to.shape)
    noisy[::10] = generator.normal(size=(6, 3))
    assert (robust_wahba(noisy, of) * rotation.inv()).magnitude() < 2e-4
    # A reflection must not be returned even where it fits better.
    assert np.linalg.det(wahba(of * [1, 1, -1], of, np.ones(60)).as_matrix()) == pytest.approx(1.0)


def test_nearest_physical_keeps_axes_and_obeys_the_triangle_inequality() -> None:
    axes = Rotation.from_rotvec([0.2, 0.5, -0.3]).as_matrix()
    lopsided = axes @ np.diag([0.8, 0.15, 0.05]) @ axes.T
    tensor = nearest_physical(lopsided)
    assert is_physical(tensor)
    assert np.trace(tensor) == pytest.approx(1.0)
    assert np.max(np.abs(tensor @ lopsided - lopsided @ tensor)) < 1e-12
    physical = np.diag([0.4, 0.35, 0.25])
    assert nearest_physical(physical) == pytest.approx(physical)
