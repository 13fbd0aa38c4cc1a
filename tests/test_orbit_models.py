"""Orbit models against independent computations: gravity, propagation, light time, Earth orientation, closed forms."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq

from estimator.models import orbit_forces
from estimator.models.light_time import SPEED_OF_LIGHT, Earth, range_sum_rate, signal_path
from estimator.models.orbit_environment import SpaceEnvironment, eme2000_from_gcrs
from estimator.models.orbit_gravity import gravity, gravity_field
from estimator.models.orbit_integration import Tolerance, VariationalStep, propagate
from estimator.models.orbit_spherical import (
    cartesian_from_spherical,
    cartesian_rates,
    decay_of_interval,
    diffusion_of_interval,
    shaping_step,
    spherical_from_cartesian,
    spherical_rates,
    stationary_matrix,
    stationary_transition,
    thrust_transition,
)
from estimator.models.station import east_north_up, station_position
from estimator.models.troposphere import refraction, saastamoinen_delay

MU = 3.986004418e14  # m3/s2
RADIUS, RATE = 42164.17e3, 7.292115e-5  # m, rad/s


def compiled_number(expression, *symbols):  # type: ignore[no-untyped-def]
    """A CasADi expression as a function of numbers, interpreted."""
    return ca.Function("f", list(symbols), [expression])


def test_gravity_equals_an_independent_program() -> None:
    import brahe

    model = brahe.GravityModel.from_model_type(brahe.GravityModelType.EGM2008_120)
    field = gravity_field("EGM2008_120", 12)
    x = ca.SX.sym("x", 3)
    ours = compiled_number(gravity(x, field)[0], x)
    random = np.random.default_rng(1)
    for _ in range(20):
        p = random.standard_normal(3)
        p *= random.uniform(6.6e6, 4.3e7) / np.linalg.norm(p)
        theirs = model.compute_spherical_harmonics(p, 12, 12)
        assert np.asarray(ours(p)).ravel() == pytest.approx(theirs, rel=1e-12, abs=1e-15)


def test_gravity_gradient_is_the_derivative_and_traceless() -> None:
    field = gravity_field("EGM2008_120", 8)
    x = ca.SX.sym("x", 3)
    acceleration, gradient = gravity(x, field)
    both = ca.Function("g", [x], [gradient, ca.jacobian(acceleration, x)])
    closed, automatic = (np.asarray(m) for m in both(np.array([4.1e6, -3.3e6, 4.5e6])))
    assert closed == pytest.approx(automatic, rel=1e-11, abs=1e-16)
    assert abs(np.trace(closed)) < 1e-18


def test_geostationary_tesseral_acceleration_has_the_published_size() -> None:
    """J22 accelerates a stationary satellite along track by at most 5.6e-8 m/s2."""
    field = gravity_field("EGM2008_120", 2)
    x = ca.SX.sym("x", 3)
    f = compiled_number(gravity(x, field)[0], x)
    longitude = np.linspace(0, 2 * np.pi, 720)
    along = [
        float(np.asarray(f(RADIUS * np.array([np.cos(a), np.sin(a), 0]))).ravel() @ [-np.sin(a), np.cos(a), 0])
        for a in longitude
    ]
    assert 5.3e-8 < max(along) < 5.8e-8
    crossings = np.degrees(longitude[:-1][np.diff(np.sign(along)) != 0])
    assert sorted(np.round(crossings)) == pytest.approx([75, 165, 255, 345], abs=3)


def test_third_body_equals_the_difference_of_two_attractions() -> None:
    r, s = np.array([3e7, 2e7, -1e7]), np.array([2.5e8, 2.8e8, 9e7])
    exact = orbit_forces.MOON_PARAMETER * ((s - r) / np.linalg.norm(s - r) ** 3 - s / np.linalg.norm(s) ** 3)
    ours = np.asarray(orbit_forces.third_body(ca.DM(r), ca.DM(s), orbit_forces.MOON_PARAMETER)).ravel()
    assert ours == pytest.approx(exact, rel=1e-9)


def test_sunlight_is_off_in_the_umbra_and_on_beside_it() -> None:
    sun = ca.DM([1.496e11, 0, 0])
    assert float(orbit_forces.sunlit_fraction(ca.DM([-4.2e7, 0, 0]), sun)) == 0.0
    assert float(orbit_forces.sunlit_fraction(ca.DM([-4.2e7, 8e6, 0]), sun)) == 1.0
    assert float(orbit_forces.sunlit_fraction(ca.DM([4.2e7, 0, 0]), sun)) == 1.0
    edge = 6378137 - 4.2e7 * 0.0  # the middle of the penumbra is half lit
    half = float(orbit_forces.sunlit_fraction(ca.DM([-4.2e7, edge, 0]), sun))
    assert 0.4 < half < 0.6


def test_air_density_follows_the_standard_atmosphere() -> None:
    published = {150e3: 2.076e-9, 200e3: 2.541e-10, 300e3: 1.916e-11, 500e3: 5.215e-13, 800e3: 1.136e-14}
    for height, density in published.items():
        assert float(orbit_forces.air_density(ca.DM(height))) == pytest.approx(density, rel=0.1)


@pytest.fixture(scope="module")
def low_step() -> VariationalStep:
    field = gravity_field("EGM2008_120", 4)

    def derivative(x, p, u):  # type: ignore[no-untyped-def]
        pull, _ = gravity(x[:3], field)
        rate = ca.vertcat(x[3:], pull + p[0] * x[3:])
        return rate, None, None

    return VariationalStep("orbit_test", derivative, 6, 1, 1, (0,))


def nothing(time: np.ndarray) -> np.ndarray:
    """No outside inputs."""
    return np.zeros((len(time), 1))


START = np.array([-4.05e7, -9.9e6, 2e5, 759.0, -1476.0, 54.8])
"""A transfer orbit like that of W3B: the perigee at 200 km height is passed."""


def test_propagation_equals_scipy_through_a_low_perigee(low_step: VariationalStep) -> None:
    orbit, _ = propagate(low_step, low_step.start(START), np.array([0.0]), nothing, np.array([0.0, 57600.0]))
    field = gravity_field("EGM2008_120", 4)
    x = ca.SX.sym("x", 6)
    right = ca.Function("r", [x], [ca.vertcat(x[3:], gravity(x[:3], field)[0])])
    times = np.linspace(0, 57600.0, 200)
    reference = solve_ivp(
        lambda t, y: np.asarray(right(y)).ravel(),
        (0, 57600.0),
        START,
        method="DOP853",
        rtol=3e-14,
        atol=1e-7,
        t_eval=times,
    )
    state, _ = orbit.at(times)
    assert np.abs(state[:, :3] - reference.y[:3].T).max() < 0.02
    assert np.linalg.norm(state[:, :3], axis=1).min() < 6.7e6


def test_backward_undoes_forward(low_step: VariationalStep) -> None:
    there, _ = propagate(low_step, low_step.start(START), np.array([0.0]), nothing, np.array([0.0, 40000.0]))
    end = there.values[-1][:6]
    back, _ = propagate(low_step, low_step.start(end), np.array([0.0]), nothing, np.array([40000.0, 0.0]))
    assert np.abs(back.values[-1][:3] - START[:3]).max() < 0.05


def test_variational_equations_equal_finite_differences(low_step: VariationalStep) -> None:
    times = np.array([3600.0, 30000.0, 50000.0])
    orbit, grid = propagate(low_step, low_step.start(START), np.array([1e-9]), nothing, np.array([0.0, 50000.0]))
    _, derivative = orbit.at(times)
    steps = np.array([10.0, 10.0, 10.0, 0.01, 0.01, 0.01, 1e-11])
    for column, h in enumerate(steps):
        moved = []
        for sign in (1, -1):
            x, p = START.copy(), np.array([1e-9])
            if column < 6:
                x[column] += sign * h
            else:
                p[0] += sign * h
            again, _ = propagate(low_step, low_step.start(x), p, nothing, np.array([0.0, 50000.0]), grid=grid)
            moved.append(again.at(times)[0])
        numeric = (moved[0] - moved[1]) / (2 * h)
        scale = np.abs(numeric).max(axis=0)
        assert np.all(np.abs(numeric - derivative[:, :, column]) <= 2e-4 * scale)


def test_a_looser_tolerance_is_less_exact_and_cheaper(low_step: VariationalStep) -> None:
    span = np.array([0.0, 57600.0])
    tight, _ = propagate(low_step, low_step.start(START), np.array([0.0]), nothing, span)
    loose, _ = propagate(
        low_step,
        low_step.start(START),
        np.array([0.0]),
        nothing,
        span,
        tolerance=Tolerance(1e-9, (1.0,) * 3 + (1e-3,) * 3),
    )
    assert len(loose.times) < len(tight.times)
    assert 1e-3 < np.linalg.norm(loose.values[-1][:3] - tight.values[-1][:3]) < 1e4


def test_spherical_equals_cartesian_motion_below_a_millimetre_in_a_day() -> None:
    x, u = ca.SX.sym("x", 6), ca.SX.sym("u")
    spherical = ca.Function("s", [x, u], [spherical_rates(x, u)])
    cartesian = ca.Function("c", [x, u], [cartesian_rates(x, u)])
    to_cartesian = ca.Function("t", [x], [cartesian_from_spherical(x)])
    start = np.array([42.1e6, 1.7, 0.03, 12.0, RATE * 1.002, 2e-7])
    unit = np.array([1e7, 1, 1, 1e3, 1e-4, 1e-4])
    for thrust in (0.0, 1e-3):
        span = 86400.0 if thrust == 0.0 else 3600.0
        one = solve_ivp(
            lambda t, y, a=thrust: np.asarray(spherical(y * unit, a)).ravel() / unit,
            (0, span),
            start / unit,
            method="DOP853",
            rtol=1e-13,
            atol=1e-15,
        )
        two = solve_ivp(
            lambda t, y, a=thrust: np.asarray(cartesian(y, a)).ravel(),
            (0, span),
            np.asarray(to_cartesian(start)).ravel(),
            method="DOP853",
            rtol=1e-13,
            atol=1e-7,
        )
        gap = np.asarray(to_cartesian(one.y[:, -1] * unit)).ravel()[:3] - two.y[:3, -1]
        assert np.linalg.norm(gap) < 1e-3


def test_spherical_and_cartesian_states_are_inverse() -> None:
    random = np.random.default_rng(3)
    for _ in range(20):
        state = np.array([4.2e7, 0, 0, 0, 0, 0]) + random.uniform(-1, 1, 6) * [1e6, 3.0, 1.2, 100, 1e-4, 1e-4]
        back = spherical_from_cartesian(cartesian_from_spherical(ca.DM(state)))
        assert np.asarray(back).ravel() == pytest.approx(state, rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("interval", [5.0, 600.0, 43082.0, 86400.0])
def test_closed_form_transition_equals_the_matrix_exponential(interval: float) -> None:
    unit = np.array([RADIUS, 1, 1, RADIUS * RATE, RATE, RATE])
    closed = stationary_transition(RADIUS, RATE, interval) * unit / unit[:, None]
    exact = expm(stationary_matrix(RADIUS, RATE) * unit / unit[:, None] * interval)
    assert np.abs(closed - exact).max() < 1e-12 * max(1.0, np.abs(exact).max())
    assert np.linalg.det(closed) == pytest.approx(1.0, abs=1e-10)


@pytest.mark.parametrize("decay", [0.0, 1e-5, 6.4e-4])
def test_thrust_column_equals_the_matrix_exponential(decay: float) -> None:
    interval = 3600.0
    matrix = np.zeros((7, 7))
    matrix[:6, :6] = stationary_matrix(RADIUS, RATE)
    matrix[4, 6], matrix[6, 6] = 1 / RADIUS, -decay
    unit = np.array([RADIUS, 1, 1, RADIUS * RATE, RATE, RATE, RADIUS * RATE**2])
    exact = expm(matrix * unit / unit[:, None] * interval)[:6, 6]
    closed = thrust_transition(RADIUS, RATE, interval, decay) * unit[6] / unit[:6]
    assert closed == pytest.approx(exact, rel=1e-9, abs=1e-13)


def test_linearization_equals_finite_differences_of_the_motion() -> None:
    x = ca.SX.sym("x", 6)
    jacobian = ca.Function("j", [x], [ca.jacobian(spherical_rates(x), x)])
    rate = np.sqrt(MU / RADIUS**3)
    found = np.asarray(jacobian(np.array([RADIUS, 0.4, 0.0, 0.0, rate, 0.0])))
    assert found == pytest.approx(stationary_matrix(RADIUS, rate), rel=1e-12, abs=1e-18)


def test_shaping_filter_follows_the_ninety_nine_percent_rule() -> None:
    interval, sigma = 1000.0, 3.0
    assert decay_of_interval(interval) == pytest.approx(np.log(10) / interval)
    assert diffusion_of_interval(sigma, interval) == pytest.approx(2.1460 * sigma / np.sqrt(interval), rel=1e-4)
    factor, variance = shaping_step(sigma, interval, interval)
    assert variance == pytest.approx(0.99 * sigma**2)
    assert factor == pytest.approx(0.1)
    assert shaping_step(sigma, float("inf"), 5.0) == (1.0, 0.0)
    assert shaping_step(sigma, 1e-6, 5.0) == pytest.approx((0.0, sigma**2))
    with pytest.raises(ValueError, match="positive"):
        decay_of_interval(0.0)


def _geometry() -> tuple[np.ndarray, Earth, np.ndarray, np.ndarray]:
    state = np.array([RADIUS * 0.6, RADIUS * 0.79, 1e6, -2200.0, 1900.0, 60.0])
    c, s = np.cos(0.3), np.sin(0.3)
    pole = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]) * 0 + np.eye(3)
    earth = Earth(ca.DM.eye(3), ca.DM(0.7), ca.DM(pole))
    return state, earth, station_position(0.87, 0.1, 300.0), station_position(0.6, -0.3, 50.0)


def _places(t: float, state: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Satellite on its two-body orbit and station, computed independently."""
    from problems.geo_orbit.plausibility import kepler

    satellite = kepler(state[:3], state[3:], np.array([t]))[0, :3]
    angle = 0.7 + 7.292115146706979e-5 * t
    c, s = np.cos(angle), np.sin(angle)
    return satellite, np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ place


def _range_sum(t3: float, state: np.ndarray, sender: np.ndarray, receiver: np.ndarray) -> float:
    """Range by bisection of the light-time equations."""

    def down(t2: float) -> float:
        return np.linalg.norm(_places(t2, state, receiver)[0] - _places(t3, state, receiver)[1])

    t2 = brentq(lambda t: t3 - t - down(t) / SPEED_OF_LIGHT, t3 - 1, t3, xtol=1e-16, rtol=1e-15)
    bounce = _places(t2, state, sender)[0]

    def up(t1: float) -> float:
        return np.linalg.norm(bounce - _places(t1, state, sender)[1])

    t1 = brentq(lambda t: t2 - t - up(t) / SPEED_OF_LIGHT, t2 - 1, t2, xtol=1e-16, rtol=1e-15)
    return down(t2) + up(t1)


def test_light_time_equals_bisection_for_a_bistatic_pair() -> None:
    state, earth, sender, receiver = _geometry()
    path = signal_path(ca.DM(state), earth, ca.DM(sender), ca.DM(receiver))
    assert float(path.up + path.down) == pytest.approx(_range_sum(0.0, state, sender, receiver), abs=2e-6)
    assert 0.11 < -float(path.t2) < 0.14


def test_range_rate_equals_the_numerical_derivative_by_reception_time() -> None:
    state, earth, sender, receiver = _geometry()
    h = 20.0
    values = [_range_sum(k * h, state, sender, receiver) for k in (-2, -1, 1, 2)]
    numeric = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * h)
    path = signal_path(ca.DM(state), earth, ca.DM(sender), ca.DM(receiver))
    assert float(range_sum_rate(path)) == pytest.approx(numeric, abs=1e-6)


def test_the_three_time_tags_describe_one_signal() -> None:
    from problems.geo_orbit.plausibility import kepler

    state, earth, sender, receiver = _geometry()
    at_reception = signal_path(ca.DM(state), earth, ca.DM(sender), ca.DM(receiver))
    for tag, shift in (("bounce", float(at_reception.t2)), ("transmission", float(at_reception.t1))):
        moved = kepler(state[:3], state[3:], np.array([shift]))[0]
        turned = Earth(earth.intermediate, earth.angle + 7.292115146706979e-5 * shift, earth.pole)
        again = signal_path(ca.DM(moved), turned, ca.DM(sender), ca.DM(receiver), tag=tag)  # type: ignore[arg-type]
        assert float(again.up + again.down) == pytest.approx(float(at_reception.up + at_reception.down), abs=1e-5)


def test_without_light_time_the_range_is_that_of_one_instant() -> None:
    state, earth, sender, receiver = _geometry()
    path = signal_path(ca.DM(state), earth, ca.DM(sender), ca.DM(receiver), light_time=0.0)
    satellite, place = _places(0.0, state, receiver)
    assert float(path.down) == pytest.approx(np.linalg.norm(satellite - place), abs=1e-6)


def test_earth_orientation_equals_astropy() -> None:
    import astropy.units as u
    from astropy.coordinates import GCRS, ITRS, CartesianRepresentation
    from astropy.time import Time
    from astropy.utils import iers

    epoch = np.datetime64("2021-06-04T00:00:37", "us")  # TAI of midnight UTC
    environment = SpaceEnvironment(epoch, 0.0, 86400.0)
    station = station_position(0.7, 1.1, 500.0)
    with iers.conf.set_temp("auto_download", False):
        time = Time("2021-06-04T13:00:00", scale="utc")
        fixed = ITRS(CartesianRepresentation(*station, unit=u.m), obstime=time)
        theirs = fixed.transform_to(GCRS(obstime=time)).cartesian.xyz.to_value(u.m)
    ours = environment.earth_fixed_from_celestial(np.array([13 * 3600.0]))[0].T @ station
    assert np.linalg.norm(ours - theirs) < 0.05  # astropy interpolates UT1 linearly


def test_sun_and_moon_are_where_astropy_has_them() -> None:
    import astropy.units as u
    from astropy.coordinates import get_body_barycentric
    from astropy.time import Time

    epoch = np.datetime64("2021-06-04T00:00:37", "us")
    environment = SpaceEnvironment(epoch, 0.0, 86400.0)
    time = Time("2021-06-04T07:00:00", scale="utc")
    earth, sun, moon = (get_body_barycentric(b, time, "builtin").xyz.to_value(u.m) for b in ("earth", "sun", "moon"))
    seconds = np.array([7 * 3600.0])
    assert np.linalg.norm(environment.sun(seconds)[0] - (sun - earth)) < 1e6
    assert np.linalg.norm(environment.moon(seconds)[0] - (moon - earth)) < 1e4


def test_frame_bias_is_that_of_the_conventions() -> None:
    angle = np.arccos(np.clip((np.trace(eme2000_from_gcrs()) - 1) / 2, -1, 1))
    assert np.degrees(angle) * 3600 == pytest.approx(0.0235, abs=0.002)  # arc seconds


def test_station_coordinates_are_geodetic() -> None:
    assert station_position(0.0, 0.0, 0.0) == pytest.approx([6378137.0, 0, 0])
    assert station_position(np.pi / 2, 0.0, 0.0) == pytest.approx([0, 0, 6356752.3142], abs=1e-3)
    axes = east_north_up(0.8, -1.2)
    assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-15)
    step = station_position(0.8, -1.2, 1000.0) - station_position(0.8, -1.2, 0.0)
    assert axes @ step == pytest.approx([0, 0, 1000.0], abs=1e-6)


def test_troposphere_has_the_published_sizes() -> None:
    zenith = float(saastamoinen_delay(ca.DM(np.pi / 2), ca.DM(0.0)))
    assert 2.3 < zenith < 2.5  # m, 18 degrees Celsius, 50 % humidity
    assert float(saastamoinen_delay(ca.DM(np.radians(10)), ca.DM(0.0))) == pytest.approx(13.5, abs=0.5)
    assert float(saastamoinen_delay(ca.DM(np.pi / 2), ca.DM(2000.0))) < zenith - 0.4
    assert np.degrees(float(refraction(ca.DM(np.radians(10.0)), ca.DM(0.0)))) == pytest.approx(0.094, abs=0.006)
