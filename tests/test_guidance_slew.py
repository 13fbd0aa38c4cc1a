"""Slews: closed forms, the optimum against bounds and closed forms, limits between the nodes, infeasible requests."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import minimize_scalar

from estimator.models.errors import InfeasibleError
from guidance import kinematics as kin
from guidance.composition_slew import CompositionSlew, composition_slew
from guidance.eigenaxis_slew import eigenaxis_slew, s_curve_duration, s_curve_segments
from guidance.jerk_profile import JerkProfile, magnus_rotation
from guidance.rodrigues_slew import RodriguesSlew, rodrigues_slew
from guidance.slew import solve_slew
from guidance.slew_bounds import lower_bound
from guidance.slew_optimum import certificate, optimal_slew
from guidance.slew_request import Actuators, Boundary, KeepOut, Limits, SlewRequest
from guidance.slew_verification import integrate, verify

DEGREE = math.pi / 180
LIMITS = Limits(2.5 * DEGREE, 0.2 * DEGREE, 0.1 * DEGREE)


def random_request(random: np.random.Generator, *, angle: float, rate: float = 0.6, acceleration: float = 0.0,
                   limits: Limits = LIMITS) -> SlewRequest:
    """A turn by ``angle`` (deg) with rates (deg/s) and accelerations (deg/s2) up to the given ones at both ends."""

    def direction() -> np.ndarray:
        v = random.normal(size=3)
        return v / np.linalg.norm(v)

    q = random.normal(size=4)
    q /= np.linalg.norm(q)

    def end(attitude: np.ndarray) -> Boundary:
        return Boundary(attitude, direction() * random.uniform(0, rate) * DEGREE,
                        direction() * random.uniform(0, acceleration) * DEGREE)

    return SlewRequest(limits, end(q), end(kin.product(q, kin.exponential(direction() * angle * DEGREE))))


def assert_solved(request: SlewRequest, profile: JerkProfile) -> None:
    """Limits within 1e-6 on 10,000 points, terminal attitude within 0.01 arcsec, by the independent integration."""
    v = verify(profile, request)
    assert v.rate <= request.limits.rate * (1 + 1e-6)
    assert v.acceleration <= request.limits.acceleration * (1 + 1e-6)
    assert v.jerk <= request.limits.jerk * (1 + 1e-6)
    assert v.terminal_error <= 4.8e-8
    assert v.terminal_rate_error <= 1e-9
    assert v.terminal_acceleration_error <= 1e-9


# ------------------------------------------------------------------------------------------------- closed forms


@pytest.mark.parametrize("angle, expected", [(10, 16.2829), (30, 26.5764), (60, 38.5), (90, 50.5), (150, 74.5)])
def test_s_curve_has_the_known_durations(angle: float, expected: float) -> None:
    assert s_curve_duration(angle * DEGREE, LIMITS) == pytest.approx(expected, abs=1e-4)


def test_s_curve_arrives_at_rest_and_touches_its_limits() -> None:
    random = np.random.default_rng(0)
    for angle in (0.01, 1, 5, 20, 70, 175):
        request = random_request(random, angle=angle, rate=0)
        profile = eigenaxis_slew(request)
        assert profile is not None
        assert_solved(request, profile)
        assert profile.largest()[2] == pytest.approx(LIMITS.jerk)
    assert np.all(s_curve_segments(0.0, LIMITS) == 0)
    assert eigenaxis_slew(random_request(random, angle=20)) is None


def test_polynomial_laws_meet_their_ends_and_keep_their_limits() -> None:
    random = np.random.default_rng(1)
    request = random_request(random, angle=20, rate=0.3, acceleration=0.003)
    jerk = np.array([0.0002, -0.0001, 0.0003]) * DEGREE
    with_jerk = replace(request, stop=replace(request.stop, jerk=jerk))
    bound = lower_bound(request, LIMITS)
    laws = [rodrigues_slew(request, d, LIMITS, bound) for d in (5, 7, 9)]
    laws += [composition_slew(request, LIMITS, bound)]
    laws += [rodrigues_slew(with_jerk, d, LIMITS, bound) for d in (7, 9)] + [composition_slew(with_jerk, LIMITS, bound)]
    for i, law in enumerate(laws):
        assert law is not None
        t = np.linspace(0, law.duration, 10_001)
        m = law.motion(t)
        for limit, values in ((LIMITS.rate, m.rate), (LIMITS.acceleration, m.acceleration), (LIMITS.jerk, m.jerk)):
            assert np.max(kin.norm(values)) <= limit * (1 + 1e-6)
        ratio = max(np.max(kin.norm(m.rate)) / LIMITS.rate, np.max(kin.norm(m.acceleration)) / LIMITS.acceleration,
                    np.max(kin.norm(m.jerk)) / LIMITS.jerk)
        assert ratio > 1 - 1e-4  # the least time: something is at its limit
        for k, end in ((0, request.start), (-1, request.stop)):
            assert kin.angle_between(m.quaternion[k], end.quaternion) < 1e-12
            assert np.allclose(m.rate[k], end.rate, atol=1e-13)
            assert np.allclose(m.acceleration[k], end.acceleration, atol=1e-12)
        if i >= 4:
            assert np.allclose(m.jerk[-1], jerk, atol=1e-11)
        h = 1e-3
        rate = kin.logarithm(kin.product(kin.conjugate(law.motion(t[50:51] - h).quaternion),
                                         law.motion(t[50:51] + h).quaternion)) / (2 * h)
        assert np.allclose(rate, m.rate[50], atol=1e-9)


def test_rest_to_rest_extremes_of_the_polynomials() -> None:
    """Of small turns, degree 7: rate 2.1875, acceleration 7.513, jerk 52.5; degree 5: 1.875, 5.774, 60."""
    request = random_request(np.random.default_rng(2), angle=1e-3, rate=0)
    for degree, expected in ((7, (2.1875, 7.513, 52.5)), (5, (1.875, 5.774, 60.0))):
        m = RodriguesSlew.between(request, degree).motion(np.linspace(0, 1, 20_001))
        found = [float(np.max(kin.norm(v))) / (1e-3 * DEGREE) for v in (m.rate, m.acceleration, m.jerk)]
        assert found == pytest.approx(expected, rel=1e-4)
    m = CompositionSlew.between(request).motion(np.linspace(0, 1, 20_001))
    assert float(np.max(kin.norm(m.jerk))) / (1e-3 * DEGREE) == pytest.approx(52.5, rel=1e-4)


def test_lower_bound_is_the_s_curve_from_rest_to_rest_and_below_every_law() -> None:
    random = np.random.default_rng(3)
    for angle in (0.5, 8, 40, 130):
        request = random_request(random, angle=angle, rate=0)
        assert lower_bound(request, LIMITS) == pytest.approx(s_curve_duration(angle * DEGREE, LIMITS), rel=1e-9)
    compared = 0
    for _ in range(20):
        request = random_request(random, angle=random.uniform(0.1, 170), acceleration=0.02)
        bound = lower_bound(request, LIMITS)
        law = rodrigues_slew(request, 5, LIMITS, 0.2 * bound, accurate=False)
        if law is not None:  # a polynomial cannot always carry the accelerations of the ends
            compared += 1
            assert law.duration > bound
    assert compared >= 15


# --------------------------------------------------------------------------------------------- jerk profiles


def test_magnus_step_agrees_with_an_integration_and_has_order_six() -> None:
    random = np.random.default_rng(4)
    w, a, j = 0.3 * random.normal(size=(3, 3))
    errors = []
    for h in (1.0, 0.5):
        solution = solve_ivp(lambda t, q: kin.product(q, [0, *(w + a * t + j * t * t / 2)]) / 2, (0, h), [1, 0, 0, 0],
                             method="DOP853", rtol=1e-13, atol=1e-14)
        step = kin.exponential(magnus_rotation(w, a, j, np.array([h])))
        errors.append(float(kin.angle_between(solution.y[:, -1], step)))
    assert errors[0] < 1e-4
    assert errors[0] / errors[1] > 2**6  # seventh power of the step


def test_largest_values_of_a_profile_are_exact() -> None:
    random = np.random.default_rng(5)
    for _ in range(20):
        profile = JerkProfile(np.array([1.0, 0, 0, 0]), random.normal(size=3), random.normal(size=3),
                              random.uniform(0.1, 2, size=4), random.normal(size=(4, 3)))
        t = np.linspace(0, profile.duration, 4001)
        sampled = kin.norm(profile.motion(t, longest_step=1.0).rate)
        k = int(np.argmax(sampled))

        def negative(x: float, p: JerkProfile = profile) -> float:
            return -float(kin.norm(p.motion(np.array([x]), longest_step=1.0).rate)[0])

        inside = minimize_scalar(negative,
                                 bounds=(t[max(k - 1, 0)], t[min(k + 1, 4000)]), method="bounded",
                                 options={"xatol": 1e-10})
        assert profile.largest()[0] == pytest.approx(max(float(sampled.max()), -float(inside.fun)), rel=1e-9)


def test_dense_integration_agrees_with_the_profile_and_with_scipy() -> None:
    random = np.random.default_rng(6)
    profile = JerkProfile(np.array([1.0, 0, 0, 0]), 0.02 * random.normal(size=3), 0.002 * random.normal(size=3),
                          random.uniform(1, 5, size=5), 0.001 * random.normal(size=(5, 3)))
    grid, attitude, rate, _ = integrate(profile)
    m = profile.motion(grid)
    assert np.max(kin.angle_between(attitude, m.quaternion)) < 1e-11
    assert np.allclose(rate, m.rate, atol=1e-13)
    joints = np.concatenate([[0], np.cumsum(profile.durations)])
    q = np.array([1.0, 0, 0, 0])
    for k in range(5):
        solution = solve_ivp(
            lambda t, q: kin.product(q, [0, *profile.motion(np.array([t]), longest_step=9.0).rate[0]]) / 2,
            (joints[k], joints[k + 1] - 1e-12), q, method="DOP853", rtol=1e-12, atol=1e-13)
        q = solution.y[:, -1]
    assert kin.angle_between(q / np.linalg.norm(q), m.quaternion[-1]) < 1e-9


# ------------------------------------------------------------------------------------------------- the optimum


@pytest.mark.parametrize("angle", [2.0, 25.0, 60.0, 150.0])
@pytest.mark.parametrize("looser", [1.0, 4.0])
def test_rest_to_rest_optimum_is_the_s_curve_and_never_below_it(angle: float, looser: float) -> None:
    limits = replace(LIMITS, jerk=looser * LIMITS.jerk)
    request = random_request(np.random.default_rng(int(angle)), angle=angle, rate=0, limits=limits)
    optimum = optimal_slew(request)
    ratio = optimum.duration / s_curve_duration(angle * DEGREE, limits)
    assert 1 <= ratio < 1.001
    assert_solved(request, optimum.profile)


def test_random_slews_are_solved_within_limits_everywhere() -> None:
    random = np.random.default_rng(7)
    for i in range(16):
        limits = replace(LIMITS, jerk=LIMITS.jerk * (4 if i % 2 else 1))
        request = random_request(random, angle=random.uniform(2, 150), limits=limits)
        optimum = optimal_slew(request)
        assert_solved(request, optimum.profile)
        assert max(certificate(optimum.profile, limits).values()) <= 1e-6
        assert optimum.duration > lower_bound(request, limits)
        law = rodrigues_slew(request, 5, limits, lower_bound(request, limits), accurate=False)
        assert law is not None
        assert optimum.duration < law.duration


@pytest.mark.parametrize("case", ["accelerations", "opposite rates", "same attitude"])
def test_hard_slews_are_solved(case: str) -> None:
    random = np.random.default_rng(8)
    if case == "accelerations":
        request = random_request(random, angle=40, acceleration=0.18)
    else:
        request = random_request(random, angle=0.4 if case == "opposite rates" else 0.0)
        rate = 0.5 * DEGREE * np.array([0.6, -0.64, 0.48])
        request = replace(request, start=replace(request.start, rate=rate), stop=replace(request.stop, rate=-rate))
    optimum = optimal_slew(request)
    assert_solved(request, optimum.profile)


def test_near_half_a_turn_the_quicker_way_round_is_taken() -> None:
    """With rates towards the longer geodesic it is the quicker one, against a start from the other way."""
    limits = LIMITS
    axis = np.array([1.0, 0.0, 0.0])
    rate = -0.6 * DEGREE * axis
    stop = kin.exponential(179 * DEGREE * axis)
    request = SlewRequest(limits, Boundary(np.array([1.0, 0, 0, 0]), rate), Boundary(stop, rate))
    optimum = optimal_slew(request)
    assert optimum.long_way
    assert_solved(request, optimum.profile)
    assert optimum.duration < s_curve_duration(179 * DEGREE, limits)


def test_finer_mesh_gains_less_than_a_thousandth() -> None:
    """The optimum against the same problem on 160 even intervals, from the polynomial."""
    from guidance.slew_envelope import envelope_of
    from guidance.slew_optimum import _solve, _uniform_start

    request = random_request(np.random.default_rng(9), angle=35)
    limits, envelope = envelope_of(request)
    start = _uniform_start(request, limits, False, lower_bound(request, limits), 160)
    assert start is not None
    reference = _solve(request, limits, envelope, False, *start)
    assert reference.success
    assert optimal_slew(request).duration < reference.duration * 1.001


def test_replanning_from_a_neighbour_gives_the_same_answer_with_fewer_iterations() -> None:
    random = np.random.default_rng(10)
    first = random_request(random, angle=70)
    old = optimal_slew(first)
    nudge = kin.exponential(np.array([1e-4, -2e-4, 1e-4]))
    second = replace(first, stop=replace(first.stop, quaternion=kin.product(first.stop.quaternion, nudge)))
    cold, warm = optimal_slew(second), optimal_slew(second, near=old)
    assert_solved(second, warm.profile)
    assert warm.duration == pytest.approx(cold.duration, rel=1e-3)
    assert warm.iterations < cold.iterations


def test_jerk_asked_for_at_the_last_instant_is_there() -> None:
    request = random_request(np.random.default_rng(11), angle=30)
    jerk = np.array([0.05, -0.02, 0.04]) * DEGREE
    request = replace(request, stop=replace(request.stop, jerk=jerk))
    optimum = optimal_slew(request)
    assert_solved(request, optimum.profile)
    assert np.allclose(optimum.profile.jerks[-1], jerk)


def test_smoothest_slew_of_a_given_duration_needs_less_jerk() -> None:
    request = random_request(np.random.default_rng(12), angle=30)
    quickest = optimal_slew(request)
    smooth = optimal_slew(replace(request, objective="smoothness", duration=1.2 * quickest.duration))
    assert smooth.duration == pytest.approx(1.2 * quickest.duration, rel=1e-12)
    assert_solved(request, smooth.profile)

    def effort(p: JerkProfile) -> float:
        return float(np.sum(p.durations * kin.norm(p.jerks) ** 2))

    assert effort(smooth.profile) < 0.5 * effort(quickest.profile)


def test_telescope_keeps_out_of_the_cone_between_the_nodes_too() -> None:
    request = random_request(np.random.default_rng(13), angle=60)
    free = optimal_slew(request)
    axis = np.array([0.0, -1.0, 0.0])
    middle = free.profile.motion(np.array([free.duration / 2])).quaternion[0]
    cone = KeepOut("Sun", axis, kin.rotate(middle, axis), 0.15)
    kept = replace(request, keep_out=(cone,))
    optimum = optimal_slew(kept)
    assert_solved(kept, optimum.profile)
    m = optimum.profile.motion(np.linspace(0, optimum.duration, 5001))
    away = np.arccos(np.clip(kin.rotate(m.quaternion, axis) @ cone.direction, -1, 1))
    assert np.min(away) > 0.15 - 1e-6
    assert optimum.duration > free.duration


def test_actuators_keep_torque_and_momentum_inside_the_cluster() -> None:
    inertia = np.diag([812.0, 587.0, 910.0])
    request = random_request(np.random.default_rng(14), angle=40)
    actuators = Actuators(inertia, torque=np.array([3.0]), gyro_momentum=15.0)
    limited = replace(request, limits=Limits(math.inf, math.inf, LIMITS.jerk), actuators=actuators)
    optimum = optimal_slew(limited)
    m = optimum.profile.motion(np.linspace(0, optimum.duration, 5001))
    torque = kin.norm(m.acceleration @ inertia)
    h = -(m.rate @ inertia) / 15.0
    assert np.max(torque) <= 3.0 * (1 + 1e-6)
    assert np.max(np.abs(h[:, 1:])) <= 2 + 1e-6
    reach = np.sqrt(np.maximum(4 - h[:, 1] ** 2, 0)) + np.sqrt(np.maximum(4 - h[:, 2] ** 2, 0))
    assert np.max(np.abs(h[:, 0]) - reach) <= 1e-6
    assert max(np.max(torque) / 3.0, np.max(np.abs(h[:, 1:])) / 2) > 0.99  # something binds
    v = verify(optimum.profile, limited)
    assert v.terminal_error < 4.8e-8


# ------------------------------------------------------------------------------------------ what cannot be done


def test_too_short_a_duration_says_how_much_is_missing() -> None:
    request = random_request(np.random.default_rng(15), angle=60)
    quickest = optimal_slew(request).duration
    for part in (0.3, 0.98):  # below the lower bound, and between it and the optimum
        answer = solve_slew(replace(request, objective="smoothness", duration=part * quickest), compare=False)
        assert answer.status == "infeasible"
        assert answer.limit == "duration"
        assert answer.excess is not None
        assert answer.excess > 0
        assert "limit" in answer.why
    assert answer.excess == pytest.approx(0.02 * quickest, rel=1e-3)


def test_start_inside_a_cone_and_weak_actuators_are_named_before_the_solver() -> None:
    request = random_request(np.random.default_rng(16), angle=60)
    axis = np.array([1.0, 0.0, 0.0])
    cone = KeepOut("Sun", axis, kin.rotate(request.start.quaternion, axis), 0.2)
    with pytest.raises(InfeasibleError, match=r"start.*'Sun'.*11\.459") as caught:
        optimal_slew(replace(request, keep_out=(cone,)))
    assert caught.value.excess == pytest.approx(0.2, abs=1e-6)
    moving = replace(request, start=replace(request.start, rate=np.array([0.01, 0, 0])))
    weak = Actuators(np.diag([812.0, 587.0, 910.0]), momentum=np.array([4.0]))
    with pytest.raises(InfeasibleError, match="momentum") as caught:
        optimal_slew(replace(moving, actuators=weak))
    assert caught.value.excess == pytest.approx(8.12 / 4 - 1, rel=1e-6)


def test_whole_answer_has_every_key_and_stands_in_order() -> None:
    request = random_request(np.random.default_rng(17), angle=20, rate=0)
    answer = solve_slew(request).as_json()
    assert answer["status"] == "ok"
    durations = {name: law["duration_s"] for name, law in answer["closed_form"].items()}
    assert set(durations) == {"eigenaxis", "mrp5", "mrp7", "mrp9", "composition"}
    assert answer["lower_bound_s"] <= answer["duration_s"] * (1 + 1e-12)
    assert durations["eigenaxis"] <= answer["duration_s"] <= 1.001 * durations["eigenaxis"]
    assert durations["eigenaxis"] < durations["mrp5"] < durations["mrp7"] < durations["mrp9"]
    assert set(answer["largest"]) == {"rate", "acceleration", "jerk"}
    assert answer["terminal_error_rad"] < 4.8e-8
