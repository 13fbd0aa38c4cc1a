"""The simulator: physics of its own equations, statistics of its noise, and the promises of its options.

Statistics name their sample size; bounds are four standard deviations of the statistic, or the wrong answer would be
one in thirty thousand.
"""

from __future__ import annotations

import ast
import dataclasses
import itertools
import json
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import legendre
from scipy.integrate import cumulative_simpson, solve_ivp
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

import problems.alignment.simulation
from estimator.effects.declaration import EffectInstance, Layout, Parameter, Sample
from estimator.models.errors import NotFiniteError, RequestError
from problems.alignment import simulator
from problems.alignment.checks import checked
from problems.alignment.simulation import orbit as orbit_module
from problems.alignment.simulation.effects import TorqueEffects, activate, argument_of_latitude
from problems.alignment.simulation.rotation import integrate_arc, moving_body
from problems.alignment.simulation.scenario import DEGREE
from problems.alignment.simulator import PRESETS, parse_effects, preset, simulate

DATA = Path(__file__).resolve().parents[1].parent / "shared" / "data"
LIGHT = 299792458.0  # [m/s]


def quiet(name="compact", **changes):
    """A scenario whose sensors are a million times better than real ones."""
    tiny = {"gnss_noise": 1e-6, "star_tracker_noise": (1e-11, 1e-11, 1e-11), "doppler_noise": 1e-8}
    return preset(name, **(tiny | changes))


def matrices(quaternions):
    return Rotation.from_quat(quaternions, scalar_first=True).as_matrix()


@pytest.fixture(scope="module")
def reference():
    return simulate(preset("reference"), seed=4)


# --------------------------------------------------------------------------------------------------------- dynamics


def test_free_rotation_conserves_energy_and_momentum(reference):
    campaign, truth = reference
    arcs = campaign.arcs_of_kind("free_rotation")
    assert len(arcs) == 3
    for arc in arcs:
        attitude, rate = truth.attitude(np.linspace(arc.start, arc.stop, 301))
        momentum = np.einsum("nji,nj->ni", matrices(attitude), rate @ truth.inertia)
        energy = 0.5 * np.einsum("ni,ij,nj->n", rate, truth.inertia, rate)
        assert np.max(np.abs(energy / energy[0] - 1.0)) < 1e-10
        assert np.max(np.linalg.norm(momentum - momentum[0], axis=1)) < 1e-10 * np.linalg.norm(momentum[0])
        # and the body does tumble: the rate is not constant in its own axes
        assert np.max(np.linalg.norm(rate - rate[0], axis=1)) > 1e-3


def test_free_rotation_obeys_euler_in_body_axes_with_another_integrator(reference):
    campaign, truth = reference
    arc = campaign.arcs_of_kind("free_rotation")[0]
    inverse = np.linalg.inv(truth.inertia)

    def euler(_t, state):
        q, w = state[:4], state[4:]
        quaternion = 0.5 * np.array([-w @ q[1:], *(q[0] * w + np.cross(q[1:], w))])  # inertial_from_body
        return np.concatenate([quaternion, -inverse @ np.cross(w, truth.inertia @ w)])

    state = truth.arc_states[arc.name]
    start = np.concatenate([state.attitude * [1, -1, -1, -1], state.rate])
    time = np.linspace(arc.start, arc.stop, 61)
    other = solve_ivp(euler, (arc.start, arc.stop), start, "Radau", time, rtol=1e-10, atol=1e-12).y
    attitude, rate = truth.attitude(time)
    apart = Rotation.from_quat(attitude, scalar_first=True) * Rotation.from_quat(other[:4].T, scalar_first=True)
    assert np.max(apart.magnitude()) < 1e-7  # [rad]
    np.testing.assert_allclose(rate, other[4:].T, atol=1e-9)


def test_attitude_and_rate_belong_together_in_every_arc(reference):
    campaign, truth = reference
    switches = np.concatenate([campaign.torque.start, campaign.torque.stop])
    for arc in campaign.arcs:
        time = np.linspace(arc.start + 0.2, arc.stop - 0.2, 25)
        time = time[np.min(np.abs(time[:, None] - switches), axis=1) > 0.1]
        step = 0.05  # [s]
        after, before = (Rotation.from_quat(truth.attitude(time + h)[0], scalar_first=True) for h in (step, -step))
        # tracker_from_inertial turns against the body
        measured = -(after * before.inv()).as_rotvec() / (2 * step)
        assert np.max(np.abs(measured - truth.attitude(time)[1])) < 5e-9


def test_pulse_changes_the_momentum_by_its_impulse(reference):
    campaign, truth = reference
    tracker_from_actuator = matrices(truth.actuator_from_tracker).T
    for arc in campaign.arcs_of_kind("torque_pulse"):
        inside = (campaign.torque.start >= arc.start) & (campaign.torque.stop <= arc.stop)
        edges = sorted({arc.start, arc.stop, *campaign.torque.start[inside], *campaign.torque.stop[inside]})
        assert len(edges) > 4
        for first, last in itertools.pairwise(edges):
            time = np.linspace(first, last - 1e-9, 401)
            attitude, rate = truth.attitude(time)
            inertial_from_tracker = np.swapaxes(matrices(attitude), 1, 2)
            momentum = np.einsum("nij,nj->ni", inertial_from_tracker, rate @ truth.inertia)
            middle = 0.5 * (first + last)
            on = inside & (campaign.torque.start <= middle) & (middle < campaign.torque.stop)
            torque = tracker_from_actuator @ campaign.torque.command[on].sum(axis=0)
            impulse = cumulative_simpson(inertial_from_tracker @ torque, x=time, axis=0, initial=0.0)[-1]
            np.testing.assert_allclose(momentum[-1] - momentum[0], impulse, atol=2e-8)  # [N m s]


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**31), st.floats(0.0, 0.5))
def test_any_drawn_inertia_is_that_of_a_body(seed, spread):
    nominal = np.array(preset("reference").inertia)
    moments = np.linalg.eigvalsh(moving_body(nominal, spread, np.random.default_rng(seed)))
    assert moments[0] > 0.0
    assert moments[2] < moments[0] + moments[1]


def test_integrator_starts_anew_at_each_switch():
    command = np.array([0.5, 0.0, 0.0])
    inertia = np.diag([1000.0, 800.0, 600.0])
    law = TorqueEffects((), None, inertia, np.array([1.0, 0.0, 0.0, 0.0])).right_side(0.0, 100.0)
    arc = integrate_arc(0.0, 100.0, np.eye(3), np.zeros(3), inertia, [(20.0, 50.0, command), (60.0, 70.0, -command)],
                        law, 0)
    _, rate = arc(np.array([20.0, 35.0, 50.0, 55.0, 65.0, 100.0]))
    expected = 0.5 / 1000.0 * np.array([0.0, 15.0, 30.0, 30.0, 25.0, 20.0])
    np.testing.assert_allclose(rate[:, 0], expected, atol=1e-14)
    assert np.max(np.abs(rate[:, 1:])) < 1e-14


# ------------------------------------------------------------------------------------------------------------ orbit


def zonal_potential(position, zonal):
    radius = np.linalg.norm(position)
    terms = np.zeros(len(zonal) + 2)
    terms[2:] = [-j * (orbit_module.EARTH_RADIUS / radius) ** n for n, j in enumerate(zonal, start=2)]
    terms[0] = 1.0
    return -orbit_module.GRAVITATIONAL_PARAMETER / radius * legendre.legval(position[2] / radius, terms)


def test_gravity_is_the_gradient_of_the_potential():
    draw = np.random.default_rng(0)
    zonal = (1.0826e-3, -2.5e-4, -1.6e-4, 3e-4)  # far larger than the Earth's, so that every term is seen
    for _ in range(5):
        position = 7.1e6 * Rotation.random(rng=draw).apply([1.0, 0.0, 0.0])
        h = 2000.0  # [m]
        slope = np.array([
            (8 * (zonal_potential(position + h * e, zonal) - zonal_potential(position - h * e, zonal))
             - (zonal_potential(position + 2 * h * e, zonal) - zonal_potential(position - 2 * h * e, zonal))) / (12 * h)
            for e in np.eye(3)
        ])
        np.testing.assert_allclose(orbit_module.acceleration(position[None], zonal)[0], -slope, atol=1e-8)


def test_orbit_conserves_energy_and_polar_momentum_and_its_node_drifts(reference):
    _, truth = reference
    scenario = truth.scenario
    time = np.linspace(0.0, scenario.duration, 400)
    position, velocity = truth.inertial_state(time)
    energy = 0.5 * np.sum(velocity**2, axis=1) + [zonal_potential(p, scenario.zonal_coefficients) for p in position]
    assert np.ptp(energy) < 1e-10 * abs(energy[0])
    normal = np.cross(position, velocity)
    assert np.ptp(normal[:, 2]) < 1e-10 * np.linalg.norm(normal[0])
    node = np.unwrap(np.arctan2(normal[:, 0], -normal[:, 1]))
    rate = np.polyfit(time, node, 1)[0]
    a, e = scenario.semi_major_axis, scenario.eccentricity
    motion = np.sqrt(orbit_module.GRAVITATIONAL_PARAMETER / a**3)
    secular = -1.5 * scenario.zonal_coefficients[0] * (orbit_module.EARTH_RADIUS / (a * (1 - e**2))) ** 2 \
        * motion * np.cos(scenario.inclination)
    # First-order theory with osculating elements, less than four revolutions: a few per cent.
    assert abs(rate / secular - 1.0) < 0.05
    assert abs(secular / (2 * np.pi / (365.2422 * 86400.0)) - 1.0) < 0.02  # it keeps up with the Sun


def test_trajectory_is_smooth_and_its_velocity_is_its_derivative(reference):
    _, truth = reference
    time = np.linspace(10.0, truth.scenario.duration - 10.0, 4000)
    h = 1.0  # [s]
    far, near = (truth.trajectory(time + k * h)[0] - truth.trajectory(time - k * h)[0] for k in (2, 1))
    assert np.max(np.abs((8 * near - far) / (12 * h) - truth.trajectory(time)[1])) < 5e-6  # [m/s]
    # the dense output between steps against steps that end there
    position, velocity = truth.inertial_state(np.array([0.0, 5000.37]))
    again = orbit_module.integrate_orbit(np.concatenate([position[0], velocity[0]]), (0.0, 5000.37),
                                         truth.scenario.zonal_coefficients, 0.0, 7.3e-5)
    assert np.linalg.norm(again.inertial(np.array([5000.37]))[0] - position[1]) < 1e-4  # [m]


def test_earth_turns_by_the_stated_angle(reference):
    campaign, truth = reference
    time = np.array([0.0, 777.0, 12345.6])
    position, velocity = truth.inertial_state(time)
    fixed, relative = truth.trajectory(time)
    angle = campaign.earth_rotation_angle_at_epoch + campaign.earth_rotation_rate * time
    turn = Rotation.from_rotvec(angle[:, None] * [0.0, 0.0, 1.0])
    np.testing.assert_allclose(turn.apply(fixed), position, atol=1e-6)
    carried = np.cross([0.0, 0.0, campaign.earth_rotation_rate], position)
    np.testing.assert_allclose(turn.apply(relative), velocity - carried, atol=1e-9)


def test_elements_come_back_from_the_initial_state():
    a, e, i, node, perigee, anomaly = 7.2e6, 0.02, 1.1, 0.7, 2.2, 4.0
    state = orbit_module.initial_state(a, e, i, node, perigee, anomaly)
    r, v = state[:3], state[3:]
    mu = orbit_module.GRAVITATIONAL_PARAMETER
    h = np.cross(r, v)
    towards_perigee = np.cross(v, h) / mu - r / np.linalg.norm(r)
    assert 1.0 / (2.0 / np.linalg.norm(r) - v @ v / mu) == pytest.approx(a)
    assert np.linalg.norm(towards_perigee) == pytest.approx(e)
    assert np.arccos(h[2] / np.linalg.norm(h)) == pytest.approx(i)
    assert np.mod(np.arctan2(h[0], -h[1]), 2 * np.pi) == pytest.approx(node)
    assert argument_of_latitude(r[None], v[None])[0] % (2 * np.pi) == pytest.approx((perigee + anomaly) % (2 * np.pi))


# ----------------------------------------------------------------------------------------------------- measurements


def test_doppler_is_the_rate_of_the_range_to_the_point_under_the_beam():
    campaign, truth = simulate(quiet(session_duration=20.0, doppler_sessions=4), seed=2)
    doppler = campaign.doppler
    pick = np.arange(3, len(doppler.time) - 3, 7)
    time = doppler.time[pick]
    attitude, _ = truth.attitude(time)
    inertial_from_antenna = (Rotation.from_quat(truth.antenna_from_tracker, scalar_first=True)
                             * Rotation.from_quat(attitude, scalar_first=True)).inv()
    angle = campaign.earth_rotation_angle_at_epoch + campaign.earth_rotation_rate * time
    fixed_from_inertial = Rotation.from_rotvec(-angle[:, None] * [0.0, 0.0, 1.0])
    position, _ = truth.trajectory(time)
    for beam, direction in enumerate(doppler.beam_direction):
        sight = (fixed_from_inertial * inertial_from_antenna).apply(direction)
        ground = position + 9.0e5 * sight  # [m] a point of the turning Earth, or of a tower on it

        def distance(shift, ground=ground):
            return np.linalg.norm(truth.trajectory(time + shift)[0] - ground, axis=1)

        h = 0.2  # [s]
        rate = (8 * (distance(h) - distance(-h)) - (distance(2 * h) - distance(-2 * h))) / (12 * h)
        expected = -2.0 * doppler.carrier_frequency / LIGHT * rate
        assert np.max(np.abs(doppler.frequency_shift[pick, beam] - expected)) < 1e-3  # [Hz]
    assert np.max(np.abs(doppler.frequency_shift)) > 1e4


@pytest.mark.parametrize("variation", [0.0, 1.5])
def test_noise_is_what_it_says(variation):
    campaign, truth = simulate(preset("reference", noise_variation=variation), seed=8)
    gnss = (campaign.gnss.position - truth.trajectory(campaign.gnss.time)[0]) / campaign.gnss.standard_deviation
    attitude, _ = truth.attitude(campaign.star_tracker.time)
    turned = Rotation.from_quat(campaign.star_tracker.quaternion, scalar_first=True) \
        * Rotation.from_quat(attitude, scalar_first=True).inv()
    tracker = turned.as_rotvec() / campaign.star_tracker.standard_deviation
    exact, _ = simulate(quiet("reference"), seed=8)
    doppler = (campaign.doppler.frequency_shift - exact.doppler.frequency_shift) / campaign.doppler.standard_deviation
    assert gnss.shape == (21601, 3)
    assert tracker.shape == (11538, 3)
    assert doppler.shape == (1452, 3)
    for whitened in (gnss, tracker, doppler):
        for column in whitened.T:
            count = len(column)
            assert abs(np.sum(column**2) - count) < 4 * np.sqrt(2 * count)
            assert abs(np.sum(column)) < 4 * np.sqrt(count)
            assert abs(np.sum(column[1:] * column[:-1])) < 4 * np.sqrt(count)
            assert kstest(column, "norm").pvalue > 1e-4
        across = whitened.T @ whitened / len(whitened)
        assert np.max(np.abs(across - np.diag(np.diag(across)))) < 4 / np.sqrt(len(whitened))
    spread = campaign.gnss.standard_deviation[:, 0] / truth.scenario.gnss_noise
    if variation:
        assert spread.min() < 0.45
        assert spread.max() > 2.2
    else:
        assert np.all(spread == 1.0)


def test_wrong_noise_level_is_wrong_by_the_factor_asked_for():
    scenario = preset("compact", gnss_noise_factor=2.0, star_tracker_noise_factor=3.0, doppler_noise_factor=0.5)
    campaign, truth = simulate(scenario, seed=1)
    gnss = (campaign.gnss.position - truth.trajectory(campaign.gnss.time)[0]) / campaign.gnss.standard_deviation
    exact, _ = simulate(quiet(), seed=1)
    doppler = (campaign.doppler.frequency_shift - exact.doppler.frequency_shift) / campaign.doppler.standard_deviation
    assert np.mean(gnss**2) == pytest.approx(4.0, rel=4 * np.sqrt(2 / gnss.size))
    assert np.mean(doppler**2) == pytest.approx(0.25, rel=4 * np.sqrt(2 / doppler.size))
    assert truth.noise["tracker"][0] == pytest.approx(3.0 * scenario.star_tracker_noise[0])


def test_gross_errors_are_as_many_and_as_large_as_asked():
    scenario = preset("compact", gnss_outlier_fraction=0.05, star_tracker_outlier_fraction=0.05,
                      doppler_outlier_fraction=0.05)
    campaign, truth = simulate(scenario, seed=3)
    clean, _ = simulate(preset("compact"), seed=3)
    moved = np.linalg.norm(campaign.gnss.position - clean.gnss.position, axis=1) / scenario.gnss_noise
    assert np.array_equal(np.flatnonzero(moved), truth.outliers["gnss"])
    assert len(truth.outliers["gnss"]) == round(0.05 * len(moved))
    assert moved[moved > 0].min() >= 20.0 - 1e-6
    assert moved.max() <= 1000.0 + 1e-6
    shifted = campaign.doppler.frequency_shift != clean.doppler.frequency_shift
    assert np.array_equal(np.argwhere(shifted), truth.outliers["doppler"])
    assert shifted.sum() == round(0.05 * shifted.size)
    turned = Rotation.from_quat(campaign.star_tracker.quaternion, scalar_first=True) \
        * Rotation.from_quat(clean.star_tracker.quaternion, scalar_first=True).inv()
    wrong = np.flatnonzero(turned.magnitude() > 10 * scenario.star_tracker_noise[0])
    assert np.array_equal(wrong, truth.outliers["star_tracker"])
    assert len(wrong) == round(0.05 * len(campaign.star_tracker.time))


def test_gaps_and_irregular_epochs():
    scenario = preset("compact", gnss_gaps=((500.0, 900.0),), gnss_jitter=0.9, star_tracker_jitter=0.8,
                      doppler_gaps=((0.0, 700.0),), star_tracker_gaps=((0.0, 200.0),))
    campaign, _ = simulate(scenario, seed=0)
    gnss, tracker, doppler = campaign.gnss.time, campaign.star_tracker.time, campaign.doppler.time
    assert np.all(np.diff(gnss) > 0)
    assert np.std(np.diff(gnss[gnss < 500])) > 0.2 * scenario.gnss_step
    assert not np.any((gnss >= 500) & (gnss <= 900))
    assert np.all(np.diff(tracker) > 0)
    assert tracker.min() > 200.0
    assert doppler.min() > 700.0
    assert np.all(np.isin(doppler, tracker))  # they share the scatter
    for arc in campaign.arcs:
        here = tracker[(tracker >= arc.start - 1) & (tracker <= arc.stop + 1)]
        assert np.all((here >= arc.start) & (here <= arc.stop))
    apart, _ = simulate(preset("compact", doppler_time_offset=0.13), seed=0)
    assert not np.any(np.isin(apart.doppler.time, apart.star_tracker.time))


# ------------------------------------------------------------------------------------------------- seeds and presets


def test_same_seed_same_campaign_and_each_purpose_its_own_stream():
    scenario = preset("compact")
    first, truth = simulate(scenario, seed=5)
    second, _ = simulate(scenario, seed=5)
    other, other_truth = simulate(scenario, seed=6)
    for part, name in (("gnss", "position"), ("star_tracker", "quaternion"), ("doppler", "frequency_shift")):
        assert np.array_equal(getattr(getattr(first, part), name), getattr(getattr(second, part), name))
        assert not np.array_equal(getattr(getattr(first, part), name), getattr(getattr(other, part), name))
    assert not np.allclose(truth.inertia, other_truth.inertia)
    # an effect in one channel leaves the noise of all others, and its own, as it was
    biased, _ = simulate(scenario, 5, {bias(): [3.0]})
    assert np.array_equal(biased.gnss.position, first.gnss.position)
    np.testing.assert_allclose(biased.doppler.frequency_shift - first.doppler.frequency_shift, 3.0, atol=1e-9)


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_presets_pass_the_checks_of_a_campaign_file(name):
    campaign, truth = simulate(preset(name), seed=1)
    assert checked(campaign) is not None
    kinds = {arc.kind for arc in campaign.arcs}
    assert ("torque_pulse" in kinds) == (campaign.torque is not None)
    assert np.all(np.isfinite(campaign.star_tracker.quaternion))
    if name == "full":
        assert campaign.gnss.time.shape == (864000,)
        assert [len(campaign.arcs_of_kind(k)) for k in ("doppler", "free_rotation", "torque_pulse")] == [20, 3, 3]
    angle = 2 * np.arccos(min(abs(truth.antenna_from_tracker @ campaign.nominal.antenna_from_tracker), 1.0))
    assert 0.0 < angle < 3.0 * DEGREE


def test_campaign_survives_the_file(tmp_path):
    from problems.readers.campaign_file import read_campaign, write_campaign

    campaign, _ = simulate(preset("compact", housekeeping=True, noise_variation=0.5), seed=2)
    write_campaign(campaign, tmp_path / "c.nc")
    again = read_campaign(tmp_path / "c.nc")
    assert np.array_equal(again.gnss.position, campaign.gnss.position)
    assert np.array_equal(again.doppler.frequency_shift, campaign.doppler.frequency_shift)
    assert np.array_equal(again.doppler.standard_deviation, campaign.doppler.standard_deviation)
    assert np.array_equal(again.torque.command, campaign.torque.command)
    assert again.arcs == campaign.arcs
    assert set(again.housekeeping) == {"antenna_temperature", "heater_current"}


def test_truth_is_plain_json(reference):
    campaign, truth = reference
    said = json.loads(json.dumps(truth.to_json(), allow_nan=False))
    np.testing.assert_allclose(said["inertia_tracker"], truth.inertia)
    np.testing.assert_allclose(np.array(said["torque_map_over_inertia_trace"]) * np.trace(truth.inertia),
                               matrices(truth.actuator_from_tracker).T, atol=1e-12)
    assert said["seed"] == 4
    assert set(said["arc_states"]) == {a.name for a in campaign.arcs if a.kind != "doppler"}
    assert said["scenario"]["carrier_frequency"] == campaign.doppler.carrier_frequency
    position, _ = truth.trajectory(np.array([600.0]))
    np.testing.assert_allclose(said["trajectory"]["position_earth_fixed_m"][10], position[0])
    outside = campaign.arcs[0].start - 10.0
    with pytest.raises(RequestError, match="inside arcs"):
        truth.attitude(np.array([outside]))


@pytest.mark.parametrize(("changes", "words"), [
    ({"duration": 1000.0}, "do not fit"),
    ({"gnss_noise": 0.0}, "gnss_noise"),
    ({"gnss_noise": float("nan")}, "gnss_noise"),
    ({"doppler_noise": "a"}, "wrong kind"),
    ({"beams": 2.5}, "beams"),
    ({"gnss_jitter": 1.0}, "gnss_jitter"),
    ({"doppler_outlier_fraction": 0.9}, "doppler_outlier_fraction"),
    ({"inertia": ((100.0, 0.0, 0.0), (0.0, 10.0, 0.0), (0.0, 0.0, 10.0))}, "not that of a body"),
    ({"pulse_axes": (3,)}, "actuator axis"),
    ({"pulse_segments": ((50.0, 40.0, 1.0),)}, "in order"),
    ({"semi_major_axis": 6.3e6}, "meets the Earth"),
    ({"colour": 3}, "no such number"),
])
def test_scenarios_that_cannot_be(changes, words):
    with pytest.raises(RequestError, match=words):
        simulate(preset("compact", **changes), seed=0)


def test_preset_and_seed_must_exist():
    with pytest.raises(RequestError, match="no preset"):
        preset("nothing")
    with pytest.raises(RequestError, match="seed"):
        simulate(preset("compact"), seed=-1)


# ---------------------------------------------------------------------------------------------------------- effects


def declared(channel, function, count=3, **more):
    parameters = tuple(Parameter(f"p{k}", "1", 1.0, (-1e9, 1e9)) for k in range(count))
    return EffectInstance(f"test-{channel}", f"test-{channel}", channel, parameters, function, "p = 0", "this test",
                          **more)


def bias():
    def contribution(sample: Sample, p):
        return p[0] * ca.DM.ones(3)

    return declared("doppler", contribution, 1)


def test_effects_act_where_their_channel_says():
    def tracker(sample: Sample, p):
        return p * (1 + 0 * sample.time)

    def gnss(sample: Sample, p):
        return p * sample.inside_arc * ca.norm_2(sample.attitude)

    scenario = quiet()
    plain, truth = simulate(scenario, 1)
    turn = np.array([1e-3, -2e-3, 3e-3])  # [rad]
    arm = np.array([10.0, -20.0, 30.0])  # [m]
    campaign, also = simulate(scenario, 1, {declared("star_tracker", tracker): turn, declared("gnss", gnss): arm})
    apart = Rotation.from_quat(campaign.star_tracker.quaternion, scalar_first=True) \
        * Rotation.from_quat(plain.star_tracker.quaternion, scalar_first=True).inv()
    np.testing.assert_allclose(apart.as_rotvec(), np.tile(turn, (len(apart), 1)), atol=1e-9)
    inside = np.zeros(len(plain.gnss.time), dtype=bool)
    for arc in plain.arcs:
        inside |= (plain.gnss.time >= arc.start) & (plain.gnss.time <= arc.stop)
    moved = campaign.gnss.position - plain.gnss.position
    np.testing.assert_allclose(moved[inside], np.tile(arm, (inside.sum(), 1)), atol=1e-8)
    assert inside.any()
    assert np.all(moved[~inside] == 0.0)
    # what is true about the motion has not changed
    assert np.array_equal(also.attitude(plain.star_tracker.time)[0], truth.attitude(plain.star_tracker.time)[0])
    assert also.effects["test-star_tracker"] == {"p0": 1e-3, "p1": -2e-3, "p2": 3e-3}


def test_torque_effect_changes_the_momentum_by_its_impulse():
    def torque(sample: Sample, p):
        return p * (1 + 1e-3 * sample.time) + 0.01 * ca.cross(sample.rate, p)

    p = np.array([0.01, -0.02, 0.015])
    campaign, truth = simulate(quiet(), 1, {declared("torque", torque): p})
    arc = campaign.arcs_of_kind("free_rotation")[0]
    time = np.linspace(arc.start, arc.stop, 2001)
    attitude, rate = truth.attitude(time)
    inertial_from_tracker = np.swapaxes(matrices(attitude), 1, 2)
    momentum = np.einsum("nij,nj->ni", inertial_from_tracker, rate @ truth.inertia)
    acting = p * (1 + 1e-3 * time[:, None]) + 0.01 * np.cross(rate, p)
    impulse = cumulative_simpson(np.einsum("nij,nj->ni", inertial_from_tracker, acting), x=time, axis=0, initial=0.0)
    np.testing.assert_allclose(momentum - momentum[0], impulse, atol=1e-7)
    assert np.linalg.norm(impulse[-1]) > 1.0


def test_command_effect_with_a_state_is_integrated():
    """A lag of time constant tau: the acting command is the exact exponential response."""
    tau = 2.0  # [s]

    def lag(sample: Sample, p):
        return sample.state - sample.command

    def change(sample: Sample, p):
        return (sample.command - sample.state) / p[0]

    effect = declared("command", lag, 1, state_size=3, state_derivative=change)
    campaign, truth = simulate(quiet(pulse_initial_rate=0.0), 1, {effect: tau})
    arc = campaign.arcs_of_kind("torque_pulse")[0]
    inside = (campaign.torque.start >= arc.start) & (campaign.torque.stop <= arc.stop)
    time = np.linspace(arc.start, arc.stop, 8001)
    acting = np.zeros_like(time)
    for start, stop, command in zip(campaign.torque.start[inside], campaign.torque.stop[inside],
                                    campaign.torque.command[inside], strict=True):
        for edge, sign in ((start, 1.0), (stop, -1.0)):
            acting += sign * np.abs(command).max() * np.sign(command.sum()) * np.where(
                time >= edge, 1.0 - np.exp(-np.maximum(time - edge, 0.0) / tau), 0.0)
    attitude, rate = truth.attitude(time)
    inertial_from_tracker = np.swapaxes(matrices(attitude), 1, 2)
    momentum = np.einsum("nij,nj->ni", inertial_from_tracker, rate @ truth.inertia)
    axis = matrices(truth.actuator_from_tracker).T[:, 0]
    impulse = cumulative_simpson(acting[:, None] * (inertial_from_tracker @ axis), x=time, axis=0, initial=0.0)
    np.testing.assert_allclose(momentum - momentum[0], impulse, atol=3e-5)  # [N m s], the quadrature's error at edges


def test_effect_of_the_library_written_for_one_step_is_taken_in_its_limit():
    """The library's actuator lag and a plain differential equation are the same world."""
    def lag(sample: Sample, p):
        return sample.state - sample.command

    def change(sample: Sample, p):
        return (sample.command - sample.state) / p[0]

    effect = declared("command", lag, 1, state_size=3, state_derivative=change)
    ours, _ = simulate(quiet(), 2, {effect: 1.5})
    library, truth = simulate(quiet(), 2, {"actuator-lag": 1.5})
    apart = Rotation.from_quat(ours.star_tracker.quaternion, scalar_first=True) \
        * Rotation.from_quat(library.star_tracker.quaternion, scalar_first=True).inv()
    assert np.max(apart.magnitude()) < 1e-7  # [rad], of degrees that the lag makes
    assert truth.effects == {"actuator-lag": {"time_constant": 1.5}}


def test_gravity_gradient_pulls_as_two_masses_would():
    campaign, truth = simulate(quiet(), 3, {"gravity-gradient-torque": 1.0})
    arc = campaign.arcs_of_kind("free_rotation")[1]
    time = np.linspace(arc.start, arc.stop, 2001)
    attitude, rate = truth.attitude(time)
    inertial_from_tracker = np.swapaxes(matrices(attitude), 1, 2)
    momentum = np.einsum("nij,nj->ni", inertial_from_tracker, rate @ truth.inertia)
    # Six point masses on the principal axes of the second moments make the same tensor; sum r x F over them.
    moments = 0.5 * np.trace(truth.inertia) * np.eye(3) - truth.inertia
    sizes, axes = np.linalg.eigh(moments)
    position, _ = truth.inertial_state(time)
    torque = np.zeros_like(position)
    for size, axis in zip(sizes, axes.T, strict=True):
        arm = inertial_from_tracker @ axis
        for side in (1.0, -1.0):
            place = position + side * 100.0 * arm  # [m] and the mass that makes the moment
            pull = -orbit_module.GRAVITATIONAL_PARAMETER * place / np.linalg.norm(place, axis=1, keepdims=True) ** 3
            torque += np.cross(side * 100.0 * arm, size / (2.0 * 100.0**2) * pull)
    impulse = cumulative_simpson(torque, x=time, axis=0, initial=0.0)
    assert np.linalg.norm(impulse[-1]) > 0.01
    np.testing.assert_allclose(momentum - momentum[0], impulse, atol=2e-4 * np.linalg.norm(impulse[-1]))


def test_dipole_turns_with_the_field_of_the_common_table():
    from estimator.models.environment import environment_table

    dipole = np.array([4.0, -3.0, 6.0])  # [A m2]
    campaign, truth = simulate(quiet(), 6, {"residual-magnetic-dipole": dipole})
    for arc in (campaign.arcs_of_kind("free_rotation")[1], campaign.arcs_of_kind("torque_pulse")[0]):
        time = np.linspace(arc.start, min(arc.stop, campaign.torque.start.min() - 1e-9) if arc.kind == "torque_pulse"
                           else arc.stop, 1501)
        attitude, rate = truth.attitude(time)
        inertial_from_tracker = np.swapaxes(matrices(attitude), 1, 2)
        momentum = np.einsum("nij,nj->ni", inertial_from_tracker, rate @ truth.inertia)
        position, velocity = truth.inertial_state(time)
        table = environment_table(campaign.epoch, time, position, velocity, campaign.earth_rotation_angle_at_epoch,
                                  campaign.earth_rotation_rate)
        torque = np.cross(inertial_from_tracker @ dipole, table["magnetic_field"])
        impulse = cumulative_simpson(torque, x=time, axis=0, initial=0.0)
        np.testing.assert_allclose(momentum - momentum[0], impulse, atol=1e-4 * np.linalg.norm(impulse[-1]))
        assert np.linalg.norm(impulse[-1]) > 1e-4


def test_sunlight_ends_at_the_shadow_in_a_rotation_arc():
    """A torque that acts in sunlight alone: the impulse is that over the sunlit part of the arc."""
    from estimator.models.environment import environment_table

    def torque(sample: Sample, p):
        return p * sample.sunlit

    scenario = quiet(free_duration=1500.0, free_arcs=1, duration=4000.0, doppler_sessions=3,
                     ascending_node=0.0)  # in March a plane through the Sun
    p = np.array([1e-2, 0.0, 0.0])
    crossed = 0
    for seed in range(5):
        campaign, truth = simulate(scenario, seed, {declared("torque", torque): p})
        arc = campaign.arcs_of_kind("free_rotation")[0]
        time = np.linspace(arc.start, arc.stop, 6001)
        position, velocity = truth.inertial_state(time)
        light = environment_table(campaign.epoch, time, position, velocity, campaign.earth_rotation_angle_at_epoch,
                                  campaign.earth_rotation_rate)["sunlit"]
        if light.min() == light.max():
            continue
        crossed += 1
        attitude, rate = truth.attitude(time)
        inertial_from_tracker = np.swapaxes(matrices(attitude), 1, 2)
        momentum = np.einsum("nij,nj->ni", inertial_from_tracker, rate @ truth.inertia)
        impulse = cumulative_simpson(light[:, None] * (inertial_from_tracker @ p), x=time, axis=0, initial=0.0)
        np.testing.assert_allclose(momentum - momentum[0], impulse, atol=1e-5)  # [N m s], a millisecond of 0.01 N m
    assert crossed >= 2


def test_state_carrying_torque_sees_the_other_torques():
    """A locked mode: a torque of minus all other torques plus the gyroscopic one holds the rate."""
    def torque(sample: Sample, p):
        return -p[0] * sample.other_torque + 0 * sample.state[0]

    def still(sample: Sample, p):
        return 0 * sample.state

    effect = declared("torque", torque, 1, state_size=1, state_derivative=still)
    campaign, truth = simulate(quiet(), 1, {effect: 1.0})
    arc = campaign.arcs_of_kind("torque_pulse")[1]
    _, rate = truth.attitude(np.linspace(arc.start, arc.stop, 50))
    # J w' + w x J w = command - (command - w x J w): so J w' = 0
    np.testing.assert_allclose(rate, np.tile(rate[0], (50, 1)), atol=1e-11)
    assert np.linalg.norm(rate[0]) > 1e-5


def test_flexible_mode_exchanges_momentum_and_loses_none():
    """Body and mode together keep R (J w + K q') while each part alone does not; without damping, energy as well."""
    inertia = np.array(preset("reference").inertia)
    coupling = np.array([30.0, 20.0, 10.0, 4.0, -3.0, 2.0])
    xx, yy, zz, xy, xz, yz = coupling
    matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    frequency = 0.1  # [Hz]
    layout = Layout(3, (), (0.0, 3600.0), 5900.0, (0.0, 3600.0))
    active = activate({"flexible-appendage": [*coupling, frequency, 0.0]}, layout)
    effects = TorqueEffects(active, None, inertia, np.array([1.0, 0.0, 0.0, 0.0]))
    rate = np.array([0.5, -0.4, 0.6]) * DEGREE
    command = np.array([0.5, 0.2, -0.3])
    arc = integrate_arc(0.0, 300.0, np.eye(3), rate, inertia, [(0.0, 10.0, command)], effects.right_side(0.0, 300.0),
                        effects.states)
    time = np.linspace(10.0, 300.0, 500)
    state = arc.state(time)
    turn = state[:, :9].reshape(-1, 3, 3)
    rate = np.einsum("ij,nkj,nk->ni", np.linalg.inv(inertia), turn, state[:, 9:12])
    displacement, speed = state[:, 12:15], state[:, 15:18]
    whole = state[:, 9:12] + np.einsum("nij,jk,nk->ni", turn, matrix, speed)
    assert np.max(np.abs(whole - whole[0])) < 1e-7 * np.linalg.norm(whole[0])
    assert np.ptp(state[:, 9]) > 1e3 * np.ptp(whole[:, 0])  # the body alone does exchange
    energy = 0.5 * np.einsum("ni,ij,nj->n", rate, inertia, rate) + np.einsum("ni,ij,nj->n", rate, matrix, speed) \
        + 0.5 * np.einsum("ni,ij,nj->n", speed, matrix, speed) \
        + 0.5 * (2 * np.pi * frequency) ** 2 * np.einsum("ni,ij,nj->n", displacement, matrix, displacement)
    assert np.ptp(energy) < 1e-7 * energy[0]


def test_torque_map_holds_gains_of_the_actuators():
    _, truth = simulate(preset("compact"), 1, {"torque-scale-error": [0.1, -0.05, 0.02]})
    plain = matrices(truth.actuator_from_tracker).T
    np.testing.assert_allclose(truth.torque_map_over_inertia_trace * np.trace(truth.inertia),
                               plain @ np.diag([1.1, 0.95, 1.02]), atol=1e-12)


def test_effects_as_text():
    assert parse_effects("") == {}
    expected = {"a": (1.0,), "b": (1.0, 2.0, -3e-4), "beam:1": (7.0, 8.0), "c": None}
    assert parse_effects("a=1, b=1:2:-3e-4 ,beam:1=7;8,c") == expected
    for text in ("a=1,a=2", "a=one", "a="):
        with pytest.raises(RequestError):
            parse_effects(text)


@pytest.mark.parametrize(("effects", "error", "words"), [
    ({"residual-magnetic-dipol": [1.0, 2.0, 3.0]}, RequestError, "residual-magnetic-dipole"),
    ({"residual-magnetic-dipole": [1.0]}, RequestError, "dipole_x"),
    ({"residual-magnetic-dipole": {"moment": 1.0}}, RequestError, "no such parameter"),
    ({"residual-magnetic-dipole": None}, RequestError, "needs values"),
    ({"residual-magnetic-dipole": [1.0, float("inf"), 3.0]}, NotFiniteError, "not finite"),
    ({"beam-mispointing": [1e-4, 0.0]}, RequestError, "which one"),
    ({"beam-mispointing:7": [1e-4, 0.0]}, RequestError, "beam-mispointing:0"),
])
def test_effects_that_cannot_be(effects, error, words):
    with pytest.raises(error, match=words):
        simulate(preset("compact"), 0, effects)


def test_orbit_phase_means_the_same_as_in_the_common_table():
    from estimator.models.environment import orbit_phase

    draw = np.random.default_rng(1)
    position, velocity = 7e6 * draw.standard_normal((50, 3)), 7e3 * draw.standard_normal((50, 3))
    np.testing.assert_allclose(argument_of_latitude(position, velocity), orbit_phase(position, velocity), atol=1e-12)


def test_simulator_shares_no_model_with_the_estimator():
    """Only declarations of effects, the common table of the environment, errors and array plumbing may be imported."""
    allowed = {"estimator.effects.declaration", "estimator.effects.library", "estimator.models.environment",
               "estimator.models.errors", "estimator.models.compiled", "estimator.models.loops"}
    files = [*Path(problems.alignment.simulation.__path__[0]).glob("*.py"), Path(simulator.__file__)]
    assert len(files) > 6
    for file in files:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module]
            for name in names:
                assert not name.startswith(("estimator", "guidance")) or name in allowed, f"{file.name}: {name}"


def test_arc_of_another_simulator_is_reproduced():
    """A free arc whose motion an independent spacecraft simulator made, with its true inertia: the noise is left."""
    file = DATA / "campaigns" / "campaign-01.nc"
    if not file.exists():
        pytest.skip(f"{file} is not here; the momentum tests above stand in for it")
    from problems.readers.campaign_file import read_campaign

    campaign = read_campaign(file)
    said = json.loads((DATA / "campaigns" / "truth" / "campaign-01.json").read_text(encoding="utf-8"))
    inertia = np.array(said["inertia_tracker"])
    arc = next(a for a in campaign.arcs if a.name == "torque-2")
    use = (campaign.star_tracker.time >= arc.start) & (campaign.star_tracker.time <= arc.stop)
    time = campaign.star_tracker.time[use]
    measured = Rotation.from_quat(campaign.star_tracker.quaternion[use], scalar_first=True)
    deviation = campaign.star_tracker.standard_deviation[use]
    inside = (campaign.torque.start >= arc.start) & (campaign.torque.stop <= arc.stop)
    segments = list(zip(campaign.torque.start[inside], campaign.torque.stop[inside],
                        campaign.torque.command[inside], strict=True))
    law = TorqueEffects((), None, inertia, np.array(said["actuator_from_tracker"])).right_side(arc.start, arc.stop)

    def residual(x):
        start = (Rotation.from_rotvec(x[:3]) * measured[0]).inv().as_matrix()
        solution = integrate_arc(arc.start, arc.stop, start, x[3:], inertia, segments, law, 0)
        model = Rotation.from_matrix(solution(time)[0])
        return ((measured * model.inv()).as_rotvec() / deviation).ravel()

    rate = -(measured[8] * measured[0].inv()).as_rotvec() / (time[8] - time[0])
    fit = least_squares(residual, np.concatenate([np.zeros(3), rate]), x_scale=np.repeat([1e-5, 1e-6], 3), method="lm",
                        diff_step=1e-5)
    degrees = fit.fun.size - 6
    # 3 x 481 samples; the file's torque is that of another integrator with a finite step
    assert abs(2 * fit.cost - degrees) < 4 * np.sqrt(2 * degrees)


# ----------------------------------------------------------------------------------------------------- command line


def test_command_writes_campaign_and_truth(tmp_path):
    import typer
    from typer.testing import CliRunner

    from problems.alignment.commands_simulate import simulate as command
    from problems.readers.campaign_file import read_campaign

    app = typer.Typer()
    app.command()(command)
    out = tmp_path / "made.nc"
    answer = CliRunner().invoke(app, [str(out), "--preset", "compact", "--seed", "9", "--json", "--gnss-step", "4",
                                      "--duration", "4000", "--set", "doppler_noise=5", "--outliers", "0.02",
                                      "--effects", "doppler-bias=12.5,gravity-gradient-torque"])
    assert answer.exit_code == 0, answer.output
    said = json.loads(answer.stdout)
    assert said["status"] == "ok"
    campaign = read_campaign(out)
    assert len(campaign.gnss.time) == said["samples"]["gnss"] == 1001
    assert campaign.doppler.standard_deviation[0, 0] == 5.0
    truth = json.loads((tmp_path / "made.truth.json").read_text(encoding="utf-8"))
    assert truth["effects"]["gravity-gradient-torque"] == {"scale": 1.0}
    assert list(truth["effects"]["doppler-bias"].values()) == [12.5]
    assert len(truth["outliers"]["gnss"]) == 20
    scenario = preset("compact", gnss_step=4.0, duration=4000.0, doppler_noise=5.0, gnss_outlier_fraction=0.02,
                      star_tracker_outlier_fraction=0.02, doppler_outlier_fraction=0.02)
    again, _ = simulate(scenario, 9, {"doppler-bias": 12.5, "gravity-gradient-torque": None})
    assert np.array_equal(again.doppler.frequency_shift, campaign.doppler.frequency_shift)
    assert dataclasses.asdict(scenario)["doppler_noise"] == truth["scenario"]["doppler_noise"]
    for wrong in (["--preset", "nothing"], ["--effects", "nothing=1"], ["--set", "x"], ["--set", "beams='a'"]):
        answer = CliRunner().invoke(app, [str(out), "--json", *wrong])
        assert answer.exit_code == 2, wrong
        assert json.loads(answer.stdout)["status"] == "bad_input"
    table = CliRunner().invoke(app, [str(tmp_path / "b.nc"), "--preset", "compact"])
    assert table.exit_code == 0
    assert "effects: none" in table.stdout
