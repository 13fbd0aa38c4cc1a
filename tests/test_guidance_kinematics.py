"""Kinematics and splines: finite differences on the manifold, round trips, independent formulas."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import BPoly
from scipy.spatial.transform import Rotation

from estimator.models.errors import NotFiniteError, QuaternionError, ShapeError, TimeOrderError
from guidance import kinematics as kin
from guidance.vector_spline import VectorSpline, hermite_matrix

RANDOM = np.random.default_rng(11)


def smooth_motion(times: np.ndarray) -> kin.Motion:
    """A motion through several turns, from a rotation vector that is a polynomial of time."""
    c = np.array([[0.3, -0.2, 0.5], [0.2, 0.4, -0.3], [-0.1, 0.15, 0.2], [0.05, -0.04, 0.03]])
    p = [np.polynomial.polynomial.polyval(times, np.polynomial.polynomial.polyder(c, k) if k else c).T
         for k in range(4)]
    return kin.exponential_motion(*p)


def test_rate_acceleration_and_jerk_are_derivatives_of_the_attitude() -> None:
    t, h = np.linspace(-2, 3, 21), 1e-4
    here, before, after = (smooth_motion(t + d) for d in (0, -h, h))
    rate = kin.logarithm(kin.product(kin.conjugate(before.quaternion), after.quaternion)) / (2 * h)
    assert np.allclose(rate, here.rate, atol=2e-7)
    assert np.allclose((after.rate - before.rate) / (2 * h), here.acceleration, atol=2e-7)
    assert np.allclose((after.acceleration - before.acceleration) / (2 * h), here.jerk, atol=2e-6)


def test_quaternion_derivatives_and_their_inverse() -> None:
    m = smooth_motion(np.linspace(-1, 1, 7))
    back = kin.motion_from_quaternion_derivatives(*kin.quaternion_derivatives(m))
    for a, b in zip((m.rate, m.acceleration, m.jerk), (back.rate, back.acceleration, back.jerk), strict=True):
        assert np.allclose(a, b, atol=1e-12)


def test_rodrigues_parameters_carry_the_same_motion_as_the_quaternion() -> None:
    m = smooth_motion(np.linspace(-2, 2, 15))
    sigma = kin.rodrigues_from_quaternion(m.quaternion, shortest=False)
    derivatives = kin.rodrigues_derivatives(sigma, m.rate, m.acceleration, m.jerk)
    back = kin.motion_from_rodrigues(sigma, *derivatives)
    assert np.allclose(back.quaternion, m.quaternion, atol=1e-14)
    assert np.allclose(back.rate, m.rate, atol=1e-12)
    assert np.allclose(back.acceleration, m.acceleration, atol=1e-11)
    assert np.allclose(back.jerk, m.jerk, atol=1e-10)
    h = 1e-5
    q = [smooth_motion(np.linspace(-2, 2, 15) + d).quaternion for d in (-h, h)]
    numeric = np.diff([kin.rodrigues_from_quaternion(x, shortest=False) for x in q], axis=0)[0] / (2 * h)
    assert np.allclose(numeric, derivatives[0], atol=1e-7)


def test_shadow_set_is_the_same_attitude_and_the_nearer_set_is_inside_the_unit_ball() -> None:
    sigma = RANDOM.normal(size=(50, 3)) * 2
    q, other = kin.quaternion_from_rodrigues(sigma), kin.quaternion_from_rodrigues(kin.shadow(sigma))
    assert np.allclose(q, -other, atol=1e-14)
    assert np.all(kin.norm(kin.nearer_set(sigma)) <= 1)
    angle = 2 * np.arctan2(kin.norm(q[:, 1:]), q[:, 0])
    assert np.allclose(np.tan(angle / 4), kin.norm(sigma))


def test_composition_turns_rates_as_the_recursion_of_elementary_rotations() -> None:
    t = np.linspace(0, 1, 5)
    a, b = smooth_motion(t), smooth_motion(1.5 - t)
    b = kin.Motion(b.quaternion, -b.rate, b.acceleration, -b.jerk)
    both = kin.compose(a, b)
    assert np.allclose(both.rate, kin.rotate(kin.conjugate(b.quaternion), a.rate) + b.rate, atol=1e-12)


def test_algebra_agrees_with_scipy() -> None:
    p, q = (Rotation.random(20, rng=RANDOM) for _ in range(2))
    pq = kin.product(p.as_quat(scalar_first=True), q.as_quat(scalar_first=True))
    assert np.allclose(Rotation.from_quat(pq, scalar_first=True).as_matrix(), (p * q).as_matrix())
    v = RANDOM.normal(size=(20, 3))
    assert np.allclose(kin.rotate(p.as_quat(scalar_first=True), v), p.apply(v))
    assert np.allclose(kin.logarithm(p.as_quat(scalar_first=True)), p.as_rotvec())
    assert np.allclose(kin.exponential(p.as_rotvec())[:, :], p.as_quat(scalar_first=True, canonical=True))
    assert np.allclose(kin.logarithm(kin.exponential(np.array([1e-12, 0, 0]))), [1e-12, 0, 0], atol=1e-25)


def test_angles_312_are_pitch_then_roll_then_yaw() -> None:
    angles = RANDOM.uniform(-1.2, 1.2, size=(30, 3))
    q = kin.quaternion_from_angles_312(angles)
    assert np.allclose(kin.angles_312(q), angles)
    roll, yaw, pitch = angles.T
    independent = Rotation.from_euler("ZXY", np.stack([pitch, roll, yaw], axis=-1))
    assert np.allclose(Rotation.from_quat(q, scalar_first=True).as_matrix(), independent.as_matrix())


def test_orbital_frame_has_y_up_and_x_along_the_track() -> None:
    r, v = np.array([[7e6, 1e5, 2e5]]), np.array([[100.0, 5e3, 5.6e3]])
    q = kin.inertial_from_orbital(r, v)
    x, y = kin.rotate(q, [1.0, 0, 0]), kin.rotate(q, [0, 1.0, 0])
    assert np.allclose(y, r / np.linalg.norm(r))
    assert float(np.sum(x * v)) > 0.99 * np.linalg.norm(v)
    assert abs(float(np.sum(x * r))) < 1e-6


def test_sign_continuity() -> None:
    m = smooth_motion(np.linspace(-4, 4, 500)).quaternion
    broken = m * np.where(RANDOM.random(500) < 0.5, -1, 1)[:, None]
    repaired = kin.sign_continuous(broken)
    assert np.all(np.sum(repaired[1:] * repaired[:-1], axis=1) > 0)


@pytest.mark.parametrize("bad, error", [([1, 0, 0], QuaternionError), ([1, 0.1, 0, 0], QuaternionError),
                                        ([np.nan, 0, 0, 0], NotFiniteError)])
def test_a_bad_quaternion_is_refused(bad: list[float], error: type[Exception]) -> None:
    with pytest.raises(error):
        kin.unit_quaternion(bad)


@pytest.mark.parametrize("conditions", [3, 4, 5])
def test_spline_agrees_with_scipy_and_meets_its_conditions(conditions: int) -> None:
    knots = np.array([1.0, 2.5, 3.0, 7.0])
    values = RANDOM.normal(size=(4, conditions, 3))
    spline = VectorSpline.through(knots, values)
    assert spline.degree == 2 * conditions - 1
    other = BPoly.from_derivatives(knots, values)
    t = np.linspace(1, 7, 101)
    for order in range(conditions):
        assert np.allclose(spline(t, order), other(t, order), atol=1e-7, rtol=1e-9)
        assert np.allclose(spline(knots[:-1], order), values[:-1, order], atol=1e-10)
        assert np.allclose(spline(knots[1:] - 1e-12, order), values[1:, order], atol=1e-6)


def test_hermite_matrix_is_the_exact_inverse() -> None:
    assert np.array_equal(hermite_matrix(2), [[1, 0, 0, 0], [0, 1, 0, 0], [-3, -2, 3, -1], [2, 1, -2, 1]])


def test_spline_refuses_bad_input() -> None:
    with pytest.raises(TimeOrderError):
        VectorSpline.through([0.0, 0.0], np.zeros((2, 3, 3)))
    with pytest.raises(ShapeError):
        VectorSpline.through([0.0, 1.0], np.zeros((3, 3, 3)))
    with pytest.raises(NotFiniteError):
        VectorSpline.through([0.0, 1.0], np.full((2, 3, 3), np.nan))
