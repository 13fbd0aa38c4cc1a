"""Designed campaigns: the information against the joint problem's own, known optima, bounds that hold, limits kept."""

from __future__ import annotations

import json
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import typer
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from estimator.models.errors import InputError, RequestError, ShapeError
from problems.alignment import campaign_design_rotation as rotation
from problems.alignment import campaign_design_session as session
from problems.alignment.campaign_design import (
    best_shares,
    certified_bound,
    checked_criterion,
    criterion_function,
    criterion_value,
    efficiency,
    information_about,
    slope_of,
    smooth_criterion,
)
from problems.alignment.commands_design import design
from problems.alignment.simulation.pointing import orbit_frame, profile_spline
from problems.alignment.simulation.scenario import DEGREE
from problems.alignment.simulator import preset, simulate
from problems.alignment.solution import solve_campaign

LIGHT = 299792458.0  # [m/s]


def spread(draw: np.random.Generator, size: int) -> np.ndarray:
    """A random positive definite matrix (size, size)."""
    root = draw.standard_normal((size, size + 2))
    return root @ root.T


def drawn_angles(scenario, request, draw):
    """A session of sines as the simulator draws them."""
    period, phase = draw.uniform(*scenario.slew_period, 3), draw.uniform(0, 2 * np.pi, 3)
    return np.asarray(scenario.slew_amplitude) * np.sin(2 * np.pi * request.epochs[:, None] / period + phase)


@pytest.fixture(scope="module")
def base():
    scenario = preset("base", free_arcs=0, pulse_axes=(), duration=3600.0, doppler_step=1.0, star_tracker_step=1.0)
    request = session.request_of(scenario)
    return scenario, request, session.design_session(request, "A", coefficients=14, starts=2)


# --------------------------------------------------------------------------------------------------------- criteria


@pytest.mark.parametrize("size", [3, 6])
def test_criteria_are_those_of_the_eigenvalues(size):
    draw = np.random.default_rng(size)
    for _ in range(20):
        information = spread(draw, size)
        values = 1 / np.linalg.eigvalsh(information)
        assert criterion_value("A", information) == pytest.approx(values.sum(), rel=1e-9)
        assert criterion_value("D", information) == pytest.approx(np.log(values).sum(), rel=1e-9, abs=1e-9)
        assert criterion_value("E", information) == pytest.approx(values.max(), rel=1e-9)
        assert float(criterion_function("A", size)(information)) == pytest.approx(np.log(values.sum()), abs=1e-8)
        assert float(criterion_function("D", size)(information)) == pytest.approx(np.log(values).sum(), abs=1e-8)
        smooth = np.exp(float(criterion_function("E", size)(information)))
        assert values.max() * (1 - 1e-9) <= smooth <= values.max() * size ** (1 / 16) * (1 + 1e-9)


@pytest.mark.parametrize("criterion", ["A", "D", "E"])
def test_slope_is_the_derivative_of_the_smooth_criterion(criterion):
    draw = np.random.default_rng(3)
    information, step = spread(draw, 4), spread(draw, 4)
    interest = draw.standard_normal((2, 4))

    def value(t):
        moved = information_about(interest, information + t * step)
        smooth = float(smooth_criterion(criterion, ca.DM(moved)))
        return smooth if criterion == "D" else np.exp(smooth)

    difference = (value(1e-5) - value(-1e-5)) / 2e-5
    assert -np.sum(slope_of(criterion, information, interest) * step) == pytest.approx(difference, rel=1e-6)


def test_information_about_part_of_the_unknowns_is_the_schur_complement():
    draw = np.random.default_rng(8)
    matrix = spread(draw, 5)
    schur = matrix[:2, :2] - matrix[:2, 2:] @ np.linalg.solve(matrix[2:, 2:], matrix[2:, :2])
    assert information_about(np.eye(5)[:2], matrix) == pytest.approx(schur, rel=1e-9)
    singular = np.outer(np.ones(5), np.ones(5))
    assert not information_about(np.eye(5)[:2], singular).any()
    assert criterion_value("D", np.zeros((2, 2))) == np.inf


def test_efficiency_is_a_ratio_of_durations():
    matrix = spread(np.random.default_rng(1), 3)
    for criterion in ("A", "D", "E"):
        assert efficiency(criterion, 2.5 * matrix, matrix) == pytest.approx(2.5, rel=1e-9)


def test_shares_of_quadratic_regression_are_the_published_ones():
    """Quadratic regression on [-1, 1]: D puts a third on -1, 0, 1; A a quarter, a half, a quarter (Pukelsheim)."""
    x = np.linspace(-1, 1, 41)
    rows = np.column_stack([np.ones_like(x), x, x * x])
    candidates = rows[:, :, None] * rows[:, None, :]
    for criterion, expected in (("D", (1 / 3, 1 / 3, 1 / 3)), ("A", (0.25, 0.5, 0.25))):
        shares = best_shares(candidates, criterion, tolerance=1e-4)
        found = [shares.weights[0, np.abs(x - c) < 0.11].sum() for c in (-1, 0, 1)]
        assert found == pytest.approx(expected, abs=0.01)
        assert shares.value - shares.bound < 1e-3
    # The value of the A-optimal design is 8, of the D-optimal one the determinant 4/27.
    assert best_shares(candidates, "A").value == pytest.approx(8.0, rel=2e-3)
    assert best_shares(candidates, "D").value == pytest.approx(-np.log(4 / 27), abs=5e-3)


@pytest.mark.parametrize("criterion", ["A", "D", "E"])
def test_no_shares_go_below_the_bound(criterion):
    draw = np.random.default_rng(5)
    candidates = np.array([[np.outer(v, v) for v in draw.standard_normal((12, 3))] for _ in range(2)])
    shares = best_shares(candidates, criterion, prior=0.01 * np.eye(3))
    assert shares.weights.sum(axis=1) == pytest.approx([0.5, 0.5])
    assert shares.bound <= shares.value
    assert shares.value - shares.bound < 0.02 * max(abs(shares.value), 1)
    for _ in range(300):
        weights = draw.dirichlet(np.full(12, 0.3), 2) / 2
        other = 0.01 * np.eye(3) + np.einsum("bk,bkij->ij", weights, candidates)
        assert criterion_value(criterion, other) >= shares.bound
        # The tangent plane at any design, however poor, is a bound too.
        assert certified_bound(criterion, other, candidates, 0.01 * np.eye(3)) <= shares.value * (1 + 1e-9) + 1e-9


def test_candidates_that_leave_a_direction_open_are_refused():
    with pytest.raises(RequestError, match="undetermined"):
        best_shares(np.diag([1.0, 1.0, 0.0])[None], "A")
    with pytest.raises(ShapeError):
        best_shares(np.ones((2, 3)), "A")


# ---------------------------------------------------------------------------------------------------------- session


def test_one_epoch_informs_as_the_weighted_least_squares_formula_says():
    """W = (sigma_F^2 I + H P H')^-1 with G and H by differences of a model of its own."""
    draw = np.random.default_rng(2)
    for beams in (1, 3, 5):
        tracker, antenna = Rotation.random(2, random_state=beams)
        velocity = 7500 * np.array([0.9, 0.3, -0.2])
        directions = draw.standard_normal((beams, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        sigma, tracker_sigma = draw.uniform(0.5, 5, beams), np.array([5e-5, 4e-5, 3e-4])

        def shift(turn, error, parts=(tracker, antenna, velocity, directions)):
            attitude, mounting, v, n = parts
            # The true attitude is the measured one with its error taken back.
            true = Rotation.from_rotvec(-error) * attitude
            return 2 * 9.6e9 / LIGHT * n @ (Rotation.from_rotvec(turn) * mounting * true).apply(v)

        step = 1e-5
        along, error = (np.column_stack([(shift(*a) - shift(*b)) / (2 * step) for a, b in pairs]) for pairs in (
            [((step * e, 0 * e), (-step * e, 0 * e)) for e in np.eye(3)],
            [((0 * e, step * e), (0 * e, -step * e)) for e in np.eye(3)]))
        weight = np.linalg.inv(np.diag(sigma**2) + error @ np.diag(tracker_sigma**2) @ error.T)
        expected = along.T @ weight @ along
        found = np.asarray(session.epoch_information(beams)(
            tracker.as_quat(scalar_first=True), velocity, antenna.as_quat(scalar_first=True), directions, 9.6e9, sigma,
            tracker_sigma))
        assert found == pytest.approx(expected, rel=1e-5, abs=1e-5 * np.abs(expected).max())
        # Nothing about the rotation about the velocity.
        axis = (antenna * tracker).apply(velocity / np.linalg.norm(velocity))
        assert axis @ found @ axis < 1e-6 * np.abs(found).max()


def test_spline_derivatives_and_hull():
    draw = np.random.default_rng(4)
    coefficients = draw.standard_normal((11, 3))
    curve = profile_spline(coefficients, 600.0)
    time_of = np.linspace(0, 600, 1501)
    first, second = session.derivative_maps(11, 600.0)
    for order, matrix in ((0, np.eye(11)), (1, first), (2, second)):
        hull = matrix @ coefficients
        values = curve.derivative(order)(time_of) if order else curve(time_of)
        assert np.all(values <= hull.max(axis=0) + 1e-12) and np.all(values >= hull.min(axis=0) - 1e-12)
        # The ends of a clamped spline are its outer coefficients.
        assert values[[0, -1]] == pytest.approx(hull[[0, -1]], rel=1e-9, abs=1e-12)


def test_simulated_attitude_follows_the_profile_and_its_rate(base):
    scenario, request, found = base
    flown = replace(scenario, slew_profile=tuple(map(tuple, found.coefficients.tolist())))
    campaign, truth = simulate(flown, 3)
    (arc,) = campaign.arcs
    time_of = np.linspace(arc.start, arc.stop, 50)
    quaternion, rate = truth.attitude(time_of)
    angles = found.profile(time_of - arc.start)[0] + request.look_angles

    class State:
        """The true orbit, as the pointing module asks for it."""

        def inertial(self, t):
            return truth.inertial_state(t)

        def acceleration(self, position):
            return 0 * position

    frame, _ = orbit_frame(State(), time_of)
    for k in range(50):
        antenna = Rotation.from_quat(np.asarray(session.antenna_from_orbit(ca.DM(angles[k]))).ravel(),
                                     scalar_first=True)
        nominal = Rotation.from_quat(request.antenna_from_tracker, scalar_first=True)
        expected = nominal.inv() * antenna * Rotation.from_matrix(frame[k])
        assert (expected * Rotation.from_quat(quaternion[k], scalar_first=True).inv()).magnitude() < 1e-9
    # Rate by differences of the attitude: tracker_from_inertial turns with minus the rate.
    ends = [Rotation.from_quat(truth.attitude(time_of[1:-1] + d)[0], scalar_first=True) for d in (-0.05, 0.05)]
    assert -(ends[1] * ends[0].inv()).as_rotvec() / 0.1 == pytest.approx(rate[1:-1], abs=1e-7)


def test_predicted_covariance_is_that_of_the_joint_estimate(base):
    """The bound of the design against the covariance of a simulated campaign that is solved; the orbit differs."""
    scenario, request, found = base
    flown = replace(scenario, slew_profile=tuple(map(tuple, found.coefficients.tolist())))
    campaign, truth = simulate(flown, 11)
    solution = solve_campaign(campaign)
    covariance = solution.estimate.covariance_of("antenna_from_tracker")
    predicted = np.linalg.inv(session.session_information(request, found.profile(request.epochs)[0]))
    assert np.sqrt(np.diag(covariance)) == pytest.approx(np.sqrt(np.diag(predicted)), rel=0.15)
    error = Rotation.from_quat(solution.antenna_from_tracker, scalar_first=True) * Rotation.from_quat(
        truth.antenna_from_tracker, scalar_first=True).inv()
    squared = error.as_rotvec() @ np.linalg.solve(covariance, error.as_rotvec())
    assert squared < 30  # chi-square of 3 degrees: one in a million


def test_information_of_the_flown_attitude_is_that_of_the_joint_problem(base):
    """The same sum over the true velocity and attitude: nothing but the trajectory's uncertainty lies between."""
    scenario, request, found = base
    campaign, truth = simulate(replace(scenario, slew_profile=tuple(map(tuple, found.coefficients.tolist()))), 5)
    time_of = campaign.doppler.time
    (arc,) = campaign.arcs
    position, velocity = truth.inertial_state(time_of)
    frame, _ = orbit_frame(type("State", (), {"inertial": lambda _, t: truth.inertial_state(t),
                                              "acceleration": lambda _, p: 0 * p})(), time_of)
    relative = velocity - np.cross([0, 0, scenario.earth_rotation_rate], position)
    there = replace(request, velocity=np.einsum("nij,nj->ni", frame, relative),
                    antenna_from_tracker=truth.antenna_from_tracker, duration=float(time_of[-1] - arc.start))
    # The attitude control believes in the nominal mounting, the information is that of the true one.
    believed = Rotation.from_quat(truth.antenna_from_tracker, scalar_first=True) * Rotation.from_quat(
        request.antenna_from_tracker, scalar_first=True).inv()
    assert believed.magnitude() < 2 * DEGREE
    found_here = session.session_information(there, found.profile(there.epochs)[0])
    solution = solve_campaign(campaign)
    joint = np.linalg.inv(solution.estimate.covariance_of("antenna_from_tracker"))
    assert np.trace(np.linalg.inv(joint)) == pytest.approx(np.trace(np.linalg.inv(found_here)), rel=0.08)


def test_designed_session_beats_every_drawn_one_within_the_same_limits(base):
    scenario, request, found = base
    draw = np.random.default_rng(0)
    drawn = [criterion_value("A", session.session_information(request, drawn_angles(scenario, request, draw)))
             for _ in range(40)]
    assert found.value < 0.85 * min(drawn)
    assert found.value < 0.6 * np.mean(drawn)
    assert found.bound <= found.value < 1.15 * found.bound
    assert all(value >= found.bound for value in drawn)
    assert found.largest_excess <= 1e-9
    ends = found.profile(np.array([0.0, request.duration]))[1]
    assert np.abs(ends).max() < 1e-12
    assert found.value == criterion_value("A", found.information) == min(found.starts)
    assert found.sigma == pytest.approx(np.sqrt(found.value))


@pytest.mark.parametrize("criterion", ["D", "E"])
def test_each_criterion_is_best_served_by_its_own_design(base, criterion):
    _, request, by_trace = base
    found = session.design_session(request, criterion, coefficients=14, starts=2)
    assert found.value <= criterion_value(criterion, by_trace.information) + 2e-3 * abs(found.value)
    assert found.bound <= found.value
    assert criterion_value("A", by_trace.information) <= criterion_value("A", found.information) * 1.002


def test_more_freedom_and_more_time_never_hurt(base):
    scenario, request, found = base
    free = replace(request, limits=session.SlewLimits.of_sines(scenario.slew_amplitude, 300.0), rest_to_rest=False)
    assert session.design_session(free, coefficients=14, starts=2).value < found.value
    # Shared between the unknown and what is known already, the session does less for the total than alone.
    known = replace(request, prior=np.diag([1e13, 0.0, 0.0]))
    assert session.design_session(known, coefficients=10, starts=1).value < found.value


def test_axes_that_may_not_move_stay(base):
    _, request, found = base
    limits = request.limits
    held = replace(request, limits=session.SlewLimits(limits.angle, (0.0, *limits.rate[1:]), limits.acceleration))
    one = session.design_session(held, coefficients=10, starts=1)
    assert not one.coefficients[:, 0].any()
    assert found.value <= one.value * 1.01


def test_orbit_velocity_is_that_of_the_simulated_orbit():
    """Circular formula against the simulated orbit of eccentricity 0.001: within two thousandths."""
    scenario = preset("base", doppler_sessions=0, free_arcs=0, pulse_axes=(), duration=6000.0, gnss_step=60.0,
                      argument_of_perigee=0.0, true_anomaly=0.0)
    _, truth = simulate(scenario, 0)
    time_of = np.linspace(0, 6000, 40)
    position, velocity = truth.inertial_state(time_of)
    frame, _ = orbit_frame(type("State", (), {"inertial": lambda _, t: truth.inertial_state(t),
                                              "acceleration": lambda _, p: 0 * p})(), time_of)
    relative = np.einsum("nij,nj->ni", frame, velocity - np.cross([0, 0, scenario.earth_rotation_rate], position))
    node = np.cross([0, 0, 1], np.cross(position[0], velocity[0]))
    normal = np.cross(position, velocity)
    latitude = np.arctan2(np.einsum("ni,ni->n", np.cross(np.broadcast_to(node, position.shape), position),
                                    normal / np.linalg.norm(normal, axis=1, keepdims=True)), position @ node)
    expected = session.orbit_axes_velocity(scenario.semi_major_axis, scenario.inclination, latitude)
    assert np.abs(relative - expected).max() < 2e-3 * 7500


def test_request_of_a_campaign_is_that_of_its_scenario(base):
    scenario, request, _ = base
    campaign, _ = simulate(replace(scenario, duration=6000.0, gnss_step=5.0), 2)
    found = session.request_of_campaign(campaign, request.limits, 600.0, look_angles=request.look_angles)
    assert found.beam_direction == pytest.approx(request.beam_direction)
    assert found.doppler_sigma == pytest.approx(request.doppler_sigma)
    assert found.tracker_sigma == pytest.approx(request.tracker_sigma)
    assert found.epoch_step == pytest.approx(request.epoch_step)
    assert found.velocity[0, 0] == pytest.approx(request.velocity[:, 0].mean(), rel=5e-3)
    with pytest.raises(RequestError):
        session.request_of_campaign(replace(campaign, doppler=None), request.limits, 600.0)


@pytest.mark.parametrize("change", [
    {"duration": 0.0}, {"doppler_sigma": -1.0}, {"tracker_sigma": np.zeros(3)}, {"epoch_step": np.nan},
    {"velocity": np.zeros(3)}, {"beam_direction": np.zeros((0, 3))}, {"prior": np.eye(2)},
])
def test_a_bad_request_is_refused(base, change):
    with pytest.raises(InputError):
        replace(base[1], **change)


@pytest.mark.parametrize("limits", [
    ((0.1, 0.1, 0.1), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), ((0.1, 0.1), (1.0, 1.0, 1.0), (1.0, 1.0, 1.0)),
    ((0.1, -0.1, 0.1), (1.0, 1.0, 1.0), (1.0, 1.0, 1.0)), ((0.1, np.nan, 0.1), (1.0, 1.0, 1.0), (1.0, 1.0, 1.0)),
    ((0.1, 1.6, 0.1), (1.0, 1.0, 1.0), (1.0, 1.0, 1.0)),
])
def test_bad_limits_are_refused(limits):
    with pytest.raises(InputError):
        session.SlewLimits(*limits)


def test_bad_designs_are_refused(base):
    with pytest.raises(RequestError):
        session.design_session(base[1], coefficients=4)
    with pytest.raises(ShapeError):
        session.session_information(base[1], np.zeros((3, 3)))
    with pytest.raises(RequestError):
        checked_criterion("F")
    assert checked_criterion("a") == "A"


# --------------------------------------------------------------------------------------------------------- rotation


@pytest.fixture(scope="module")
def arcs():
    scenario = preset("base", doppler_sessions=0, gnss_step=10.0, duration=2400.0, free_duration=300.0,
                      star_tracker_step=0.5, doppler_step=0.5, mounting_spread=0.0, inertia_spread=0.0,
                      pulse_initial_rate=0.0, pulse_spacing=50.0)
    return scenario, rotation.rotation_request_of(scenario, more_shapes=False)


@pytest.fixture(scope="module")
def designed(arcs):
    return rotation.design_rotation(arcs[1])


def test_information_of_arcs_is_that_of_the_joint_estimate(arcs, designed):
    """Covariance of the actuator quaternion of a campaign that flies the designed arcs, solved, to a hundredth."""
    scenario, _ = arcs
    flown = replace(scenario, free_initial_rates=tuple(map(tuple, designed.free_rates.tolist())),
                    pulse_segments=designed.pulse_shape,
                    pulse_directions=tuple(map(tuple, designed.pulse_torques.tolist())))
    campaign, truth = simulate(flown, 1)
    assert truth.arc_states["free-1"].rate == pytest.approx(designed.free_rates[0])
    assert campaign.torque.command == pytest.approx(designed.pulse_torques)
    solution = solve_campaign(campaign)
    joint = solution.estimate.covariance_of("actuator_from_tracker")
    assert joint == pytest.approx(designed.covariance[3:, 3:], rel=0.03, abs=0.01 * np.trace(joint))
    # The tensor's own covariance gives that of its principal axes by the perturbation of a symmetric matrix.
    entries = solution.inertia_covariance()
    moments, axes = np.linalg.eigh(solution.normalized_inertia)
    rows = []
    for k in range(3):
        a, b = axes[:, (k + 1) % 3], axes[:, (k + 2) % 3]
        both = np.outer(a, b) + np.outer(b, a)
        gap = moments[(k + 1) % 3] - moments[(k + 2) % 3]
        rows.append(np.array([*(np.diag(both) / 2), both[0, 1], both[0, 2], both[1, 2]]) / gap)
    principal = np.array(rows) @ entries @ np.array(rows).T
    assert np.diag(principal) == pytest.approx(np.diag(designed.covariance)[:3], rel=0.03)


def test_designed_arcs_beat_drawn_ones_within_the_same_limits(arcs, designed):
    scenario, request = arcs
    draw = np.random.default_rng(2)
    _, axes = np.linalg.eigh(request.inertia)
    values = []
    while len(values) < 10:
        direction = draw.standard_normal(3)
        direction /= np.linalg.norm(direction)
        if np.abs(direction @ axes).max() > np.cos(scenario.free_axis_clearance):
            continue
        values.append(criterion_value("A", rotation.rotation_information(
            request, direction * request.rate_limit, request.pulse_shapes[0], request.torque_limit * np.eye(3))))
    assert designed.value < min(values)
    assert designed.value < 0.8 * np.mean(values)
    assert np.linalg.norm(designed.free_rates, axis=1) == pytest.approx([request.rate_limit])
    assert np.abs(designed.pulse_torques).max() <= request.torque_limit * (1 + 1e-9)
    worst = max(rotation._Arcs(request).fastest(designed.pulse_shape, t) for t in designed.pulse_torques)
    assert worst <= request.pulse_rate_limit * (1 + 1e-5)
    assert all(factor > 1 for *_, factor in designed.arc_values) and len(designed.arc_values) == 4
    assert designed.minutes == pytest.approx((300 + 3 * 100) / 60)


def test_choice_is_not_below_its_bound_and_refinement_improves(arcs, designed):
    chosen = rotation.design_rotation(arcs[1], refine=False)
    assert chosen.bound <= chosen.value
    assert designed.value <= chosen.value
    assert designed.bound == pytest.approx(chosen.bound)


def test_spin_about_a_principal_axis_leaves_the_axes_open(arcs):
    """A spin about a principal axis stays there: with one free arc and no pulse that tilts it, ratios remain open."""
    _, request = arcs
    _, axes = np.linalg.eigh(request.inertia)
    info = rotation._Arcs(request).information(300.0, request.rate_limit * axes[:, 2])
    tumbling = rotation._Arcs(request).information(300.0, request.rate_limit * axes @ [0.6, 0.5, 0.6])
    ranks = [int(np.sum(np.linalg.eigvalsh(m[:5, :5]) > 1e-8 * np.linalg.eigvalsh(m[:5, :5])[-1]))
             for m in (info, tumbling)]
    assert ranks[0] < ranks[1] == 5


def test_bad_rotation_requests_are_refused(arcs):
    _, request = arcs
    for change in ({"inertia": np.diag([1.0, 1.0, 3.0])}, {"inertia": np.diag([1000.0, 1000.0, 500.0])},
                   {"rate_limit": 0.0}, {"pulse_arcs": 0}, {"pulse_shapes": (((0.0, 10.0, 1.5),),)},
                   {"tracker_sigma": np.ones(2)}):
        with pytest.raises(InputError):
            replace(request, **change)


# ------------------------------------------------------------------------------------------ simulator and command


def test_a_given_profile_changes_nothing_but_the_attitude(base):
    """A profile of zeros is a session without slews; noise and orbit of the seed stay."""
    scenario, _, _ = base
    still, _ = simulate(replace(scenario, slew_amplitude=(0.0, 0.0, 0.0)), 4)
    flat, _ = simulate(replace(scenario, slew_profile=((0.0, 0.0, 0.0),) * 4), 4)
    assert np.array_equal(still.gnss.position, flat.gnss.position)
    assert flat.doppler.frequency_shift == pytest.approx(still.doppler.frequency_shift, abs=1e-6)
    assert flat.star_tracker.quaternion == pytest.approx(still.star_tracker.quaternion, abs=1e-12)


@pytest.mark.parametrize("change", [
    {"slew_profile": ((0.0, 0.0, 0.0),)}, {"slew_profile": ((0.0, 0.0),) * 5}, {"slew_profile": (0.1,) * 6},
    {"free_initial_rates": ((0.0, 0.0, 0.01),) * 2}, {"pulse_directions": ((1.0, 0.0, 0.0),)},
    {"pulse_directions": "x"},
])
def test_bad_scenarios_are_refused(change):
    with pytest.raises(RequestError):
        preset("base", **change)


def test_the_command_answers_in_json(tmp_path):
    application = typer.Typer()
    application.command()(design)
    runner, out = CliRunner(), tmp_path / "design.json"
    answer = runner.invoke(application, ["--json", "--starts", "1", "--minutes", "5", "--angle-limit", "20", "8", "8",
                                         "--out", str(out)])
    assert answer.exit_code == 0, answer.output
    found = json.loads(answer.stdout)
    assert found["status"] == "ok" and found["criterion"] == "A"
    told = found["session"]
    assert told["no_session_below"] <= told["value"] < told["reference_rms_rad"] ** 2
    assert len(told["profile"]["time_s"]) == 301
    assert np.all(np.abs(told["profile"]["angles_rad"]).max(axis=0) <= np.radians([20, 8, 8]) * (1 + 1e-9))
    assert json.loads(out.read_text())["session"]["minutes"] == 5
    # The answer's scenario goes to the simulator as it is.
    preset("base", slew_profile=tuple(map(tuple, told["scenario"]["slew_profile"])))
    for arguments in (["--part", "pulse"], ["--criterion", "F"], ["--minutes", "-1"], ["--period", "0"],
                      ["--angle-limit", "0", "0", "0"], ["--preset", "none"]):
        bad = runner.invoke(application, ["--json", *arguments])
        assert bad.exit_code == 2
        assert json.loads(bad.stdout)["status"] == "bad_input"
