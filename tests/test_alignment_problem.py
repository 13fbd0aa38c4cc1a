"""The joint alignment problem on simulated campaigns: statistics, missing parts, bookkeeping, the answer's contract."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from estimator.estimate import Status
from estimator.models.errors import RequestError, TooFewDataError
from estimator.solvers import solve
from problems import console
from problems.alignment.attitude_at_epochs import attitude_at_epochs
from problems.alignment.campaign import Arc, GnssSeries
from problems.alignment.problem import _nodes, alignment_model, alignment_problem
from problems.alignment.simulator import preset, simulate
from problems.alignment.solution import solve_campaign

SMALL = {"duration": 2400.0, "gnss_step": 4.0, "doppler_sessions": 4, "session_duration": 15.0, "doppler_step": 1.0,
         "free_arcs": 1, "free_duration": 200.0, "star_tracker_step": 1.0, "free_rate": 0.02, "pulse_duration": 80.0,
         "pulse_spacing": 20.0}


@cache
def small(seed=1, **changes):
    return simulate(preset("compact", **{**SMALL, **changes}), seed=seed)


def errors(solution, truth):
    """Tangent error of antenna, inertia and actuator, from the estimate to the truth."""
    problem, values = solution.estimate.problem, solution.estimate.values
    j = truth.inertia / np.trace(truth.inertia)
    true = {"antenna_from_tracker": truth.antenna_from_tracker, "actuator_from_tracker": truth.actuator_from_tracker,
            "normalized_inertia": np.array([j[0, 0], j[1, 1], j[2, 2], j[0, 1], j[0, 2], j[1, 2]]),
            "inertia_trace": np.array([np.trace(truth.inertia)])}
    return {n: problem.unknown(n).manifold.local(values[n], v) for n, v in true.items()}


def test_errors_follow_the_covariance():
    """12 campaigns: the normalized squared error of each block, and the residuals, inside a 99.98 percent band."""
    draws = 12
    blocks = ("antenna_from_tracker", "normalized_inertia", "actuator_from_tracker", "inertia_trace")
    totals = dict.fromkeys(blocks, 0.0)
    size = dict.fromkeys(totals, 0)
    squares = degrees = 0.0
    for seed in range(draws):
        campaign, truth = small(seed)
        solution = solve_campaign(campaign)
        assert solution.status is Status.OK, solution.why
        for name, error in errors(solution, truth).items():
            totals[name] += error @ np.linalg.solve(solution.estimate.covariance_of(name), error)
            size[name] = len(error) * draws
        squares += sum(s.consistency.total for s in solution.estimate.summaries)
        degrees += sum(s.consistency.degrees for s in solution.estimate.summaries)
    for name, total in totals.items():
        low, high = chi2.ppf([1e-4, 1 - 1e-4], size[name])
        assert low < total < high, name
    low, high = chi2.ppf([1e-4, 1 - 1e-4], degrees)
    assert low < squares < high


def test_irregular_sampling_gaps_varying_noise_and_sign_flips():
    campaign, truth = small(3, gnss_jitter=0.8, star_tracker_jitter=0.5, doppler_jitter=0.5, noise_variation=1.0,
                            doppler_time_offset=0.37, gnss_gaps=((500.0, 620.0),))
    flips = np.where(np.random.default_rng(0).random(len(campaign.star_tracker.time)) < 0.5, -1.0, 1.0)
    flipped = replace(campaign, star_tracker=replace(campaign.star_tracker,
                                                     quaternion=campaign.star_tracker.quaternion * flips[:, None]))
    solution = solve_campaign(flipped)
    assert solution.status is Status.OK, solution.why
    for name, error in errors(solution, truth).items():
        covariance = solution.estimate.covariance_of(name)
        assert error @ np.linalg.solve(covariance, error) < chi2.ppf(1 - 1e-4, len(error)), name
    plain = solve_campaign(campaign)
    for u in plain.estimate.unknowns:
        step = u.manifold.local(plain.estimate.values[u.name], solution.estimate.values[u.name])
        assert np.all(np.abs(step) < 1e-4 * plain.estimate.sigma_of(u.name)), u.name


def test_beam_directions_that_depend_on_time():
    campaign, _ = small()
    doppler = campaign.doppler
    many = np.broadcast_to(doppler.beam_direction, (len(doppler.time), *doppler.beam_direction.shape)).copy()
    a = solve(alignment_problem(alignment_model(campaign)))
    b = solve(alignment_problem(alignment_model(replace(campaign, doppler=replace(doppler, beam_direction=many)))))
    np.testing.assert_allclose(a.values["antenna_from_tracker"], b.values["antenna_from_tracker"], atol=1e-12)


@pytest.mark.parametrize("changes, missing, present", [
    ({"pulse_axes": ()}, ["actuator_from_tracker"], ["antenna_from_tracker", "normalized_inertia"]),
    ({"free_arcs": 0}, [], ["antenna_from_tracker", "normalized_inertia", "actuator_from_tracker"]),
    ({"free_arcs": 0, "pulse_axes": ()}, ["actuator_from_tracker", "normalized_inertia"], ["antenna_from_tracker"]),
    ({"doppler_sessions": 0}, ["antenna_from_tracker"], ["normalized_inertia", "actuator_from_tracker"]),
], ids=["no torque", "no free rotation", "no rotation", "no doppler"])
def test_what_a_campaign_lacks_is_said_and_the_rest_estimated(changes, missing, present):
    campaign, truth = small(2, **changes)
    solution = solve_campaign(campaign)
    answer = console_json(solution)
    for name in missing:
        assert any(s.startswith(name) for s in solution.unobservable), name
        assert (answer[name].get("quaternion") or answer[name].get("matrix")) is None
    if missing:
        assert solution.status is Status.UNOBSERVABLE
        assert "this campaign cannot determine" in solution.why
    error = errors(solution, truth) if not missing else {}
    for name in present:
        assert np.all(np.isfinite(solution.estimate.sigma_of(name))), name
        if error:
            e = error[name]
            assert e @ np.linalg.solve(solution.estimate.covariance_of(name), e) < chi2.ppf(1 - 1e-4, len(e))


def console_json(solution):
    """The answer as a reader of the standard output gets it."""
    return json.loads(json.dumps(console.jsonable(solution.as_dict())))


def test_answer_has_the_contract():
    campaign, truth = small()
    solution = solve_campaign(campaign)
    answer = console_json(solution)
    for key in ("antenna_from_tracker", "actuator_from_tracker"):
        assert np.linalg.norm(answer[key]["quaternion"]) == pytest.approx(1.0)
        assert answer[key]["quaternion"][0] >= 0
        assert len(answer[key]["sigma_rad"]) == 3
        np.testing.assert_allclose(np.sqrt(np.diag(answer[key]["covariance_rad2"])), answer[key]["sigma_rad"])
    matrix, sigma = np.array(answer["normalized_inertia"]["matrix"]), np.array(answer["normalized_inertia"]["sigma"])
    assert np.trace(matrix) == pytest.approx(1.0)
    assert matrix.shape == sigma.shape == (3, 3)
    assert np.array_equal(matrix, matrix.T) and np.array_equal(sigma, sigma.T) and np.all(sigma > 0)
    assert answer["trajectory"]["degree"] == solution.model.frame.degree
    assert 0.9 < answer["trajectory"]["rms_m"] / truth.scenario.gnss_noise < 1.1
    assert answer["status"] == "ok" and answer["why"] and answer["effects"] == [] and answer["unobservable"] == []
    assert {"gnss", "doppler", "star_tracker", "star_tracker:free-1"} <= set(answer["residuals"])
    for entry in answer["residuals"].values():
        assert {"rms", "unit", "chi2_per_dof"} <= set(entry)
    assert answer["seconds"] > 0
    assert "antenna_from_tracker" in str(solution) and "trajectory degree" in str(solution)


def test_trace_of_the_inertia_covariance():
    """The six entries have unit trace, so the covariance has no part along it."""
    solution = solve_campaign(small()[0])
    covariance = solution.inertia_covariance()
    trace = np.array([1.0, 1, 1, 0, 0, 0])
    assert abs(trace @ covariance @ trace) < 1e-12 * np.trace(covariance)
    assert np.linalg.matrix_rank(covariance, tol=1e-9 * np.trace(covariance)) == 5


def test_dormant_effects_change_nothing_and_can_be_freed():
    campaign, _ = small(4)
    model = alignment_model(campaign)
    plain = solve(alignment_problem(model))
    dormant = alignment_problem(model, candidates=["doppler-bias", "gravity-gradient-torque"])
    held = solve(dormant)
    assert "gravity-gradient-torque" in dormant.held
    for u in plain.unknowns:
        step = u.manifold.local(plain.values[u.name], held.values[u.name])
        assert np.all(np.abs(step) < 1e-3 * plain.sigma_of(u.name)), u.name
    freed = dormant.with_effect("gravity-gradient-torque")
    assert freed.effects == ("gravity-gradient-torque",)
    estimate = solve(freed)
    found, sigma = estimate.values["gravity-gradient-torque"][0], estimate.sigma_of("gravity-gradient-torque")[0]
    assert abs(found) < 4 * sigma  # it is not in the data
    rebuilt = alignment_problem(model).with_effect("gravity-gradient-torque")
    again = solve(rebuilt).values["gravity-gradient-torque"][0]
    assert again == pytest.approx(found, abs=1e-3 * sigma)


def test_an_effect_in_the_data_is_noticed_and_estimated():
    campaign, _ = simulate(preset("compact", **SMALL), seed=5, effects={"gravity-gradient-torque": 1.0})
    gap = solve_campaign(campaign)
    assert gap.status is Status.MODEL_GAP
    assert "star_tracker:free-1" in gap.why
    closed = solve_campaign(campaign, effects=["gravity-gradient-torque"])
    assert closed.status is Status.OK, closed.why
    effect = closed.as_dict()["effects"][0]
    (parameter,) = effect["parameters"].values()
    assert abs(parameter["value"] - 1.0) < 4 * parameter["sigma"]


def test_a_wrong_clock_of_the_receiver_may_move_the_trajectory():
    """1.5 s are 11 km along the orbit: nothing that the positions alone would ever allow."""
    campaign, _ = simulate(preset("compact", **SMALL), seed=6, effects={"gnss-timetag-offset": 1.5})
    closed = solve_campaign(campaign, effects=["gnss-timetag-offset"])
    (parameter,) = closed.as_dict()["effects"][0]["parameters"].values()
    assert 1e-3 < parameter["sigma"] < 0.3
    assert abs(parameter["value"] - 1.5) < 4 * parameter["sigma"]


def test_held_out_data_are_left_out():
    campaign, _ = small()
    whole = alignment_model(campaign)
    part = alignment_model(campaign, hold_out=0.25)
    assert whole.used_positions.all()
    assert part.used_positions.mean() == pytest.approx(0.75, abs=0.05)
    residuals = {r.name: r for r in alignment_problem(part).residuals}
    for name in ("doppler", "star_tracker:free-1"):
        assert residuals[name].accepted.mean() == pytest.approx(0.75, abs=0.1)
    with pytest.raises(RequestError, match="held-out"):
        alignment_model(campaign, hold_out=0.95)


def test_environment_of_the_same_times_is_looked_up_once():
    campaign, _ = small()
    model = alignment_model(campaign)
    time = np.linspace(10.0, 400.0, 40)
    table = model.environment(time)
    assert model.environment(time.copy()) is table
    assert not table.flags.writeable
    np.testing.assert_array_equal(model.environment(time[::2]).shape, (20, table.shape[1]))
    np.testing.assert_array_equal(alignment_model(campaign).environment(time), table)


def test_nodes_hold_every_sample_and_switch():
    rng = np.random.default_rng(0)
    samples = np.sort(rng.uniform(3.0, 40.0, 50))
    switches = np.array([5.0, samples[10], 31.123])
    nodes, index = _nodes(0.0, samples, switches, 0.5)
    np.testing.assert_allclose(nodes[index], samples, atol=2e-9)
    assert nodes[0] == 0.0 and np.all(np.diff(nodes) > 0) and np.max(np.diff(nodes)) <= 0.5 + 1e-12
    assert all(np.min(np.abs(nodes - s)) < 2e-9 for s in switches)


def test_attitude_between_samples():
    """Interpolated attitudes of a smooth rotation are right to a fraction of an arcsecond, with their own noise."""
    _, truth = small()
    arc = next(iter(truth.arc_states))
    start = {a.name: a for a in small()[0].arcs}[arc].start
    time = start + np.arange(0.0, 100.0, 1.0)
    quaternion, _ = truth.attitude(time)
    tracker = replace(small()[0].star_tracker, time=time, quaternion=quaternion,
                      standard_deviation=np.full((100, 3), 1e-5))
    epochs = start + np.array([0.0, 0.5, 10.25, 50.0, 98.9])
    found = attitude_at_epochs(tracker, epochs)
    expected, rates = truth.attitude(epochs)
    turn = Rotation.from_quat(found.quaternion, scalar_first=True) * Rotation.from_quat(expected,
                                                                                        scalar_first=True).inv()
    assert np.max(turn.magnitude()) < 1e-7
    np.testing.assert_allclose(found.rate, rates, atol=2e-6)
    np.testing.assert_allclose(found.standard_deviation[[0, 3]], 1e-5)  # epochs of samples
    assert np.all(found.standard_deviation[[2]] < 1e-5)  # a mean of neighbours in the middle
    beyond = attitude_at_epochs(tracker, np.append(epochs, start + 300.0))
    assert list(beyond.covered) == [True] * 5 + [False]


def test_requests_that_make_no_sense():
    campaign, _ = small()
    with pytest.raises(RequestError, match="no solver is named"):
        solve_campaign(campaign, solver="guess")  # type: ignore[arg-type]
    with pytest.raises(RequestError, match="no effect is named"):
        solve_campaign(campaign, effects=["phlogiston"])
    few = replace(campaign, gnss=GnssSeries(campaign.gnss.time[:3], campaign.gnss.position[:3],
                                            campaign.gnss.standard_deviation[:3]))
    with pytest.raises(TooFewDataError):
        alignment_model(few)


def test_arc_with_too_few_samples_is_left_out_and_named():
    campaign, _ = small()
    last = campaign.star_tracker.time[-1]
    tail = Arc("free-9", "free_rotation", float(last) + 5.0, float(last) + 60.0)
    solution = solve_campaign(replace(campaign, arcs=(*campaign.arcs, tail)))
    assert "free-9" in solution.why
    assert solution.status is Status.OK
