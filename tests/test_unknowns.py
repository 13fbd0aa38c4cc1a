"""Laws of the manifolds: steps that come back, steps near half turns and sign flips, tensors that stay physical."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from estimator.propagation import Product
from estimator.unknowns import NormalizedInertia, UnitQuaternion, Unknown, Vector, offsets, retracted

QUATERNION = Unknown("q", UnitQuaternion(), "rad", 0.1)
INERTIA = Unknown("J", NormalizedInertia(), "1", 0.1)
VECTOR = Unknown("v", Vector(3, ("x", "y", "z")), "m", (1.0, 2.0, 3.0))

numbers = st.floats(-1.0, 1.0, allow_subnormal=False)


@st.composite
def unit_quaternions(draw):
    """Any rotation; often one of the hard ones: none, its negative, half turns, almost half turns."""
    hard = draw(st.sampled_from([None, (1.0, 0, 0, 0), (-1.0, 0, 0, 0), (0, 1.0, 0, 0), (0, 0, -1.0, 0), (0, 0, 0, 1.0),
                                 (1e-9, 1.0, 0, 0), (-1e-9, 0, 0.6, 0.8)]))
    q = np.array(hard) if hard else np.array([draw(numbers) for _ in range(4)])
    assume(np.linalg.norm(q) > 1e-3)
    return q / np.linalg.norm(q)


@st.composite
def rotation_vectors(draw, longest=np.pi - 1e-6):
    v = np.array([draw(numbers) for _ in range(3)])
    assume(np.linalg.norm(v) > 1e-6)
    length = draw(st.one_of(st.floats(0.0, longest), st.sampled_from([0.0, 1e-12, 1e-6, longest])))
    return v / np.linalg.norm(v) * length


@st.composite
def inertia_tensors(draw):
    """Any physical tensor of unit trace (entries), down to nearly flat and nearly rod-like bodies."""
    masses = np.array([draw(st.floats(1e-4, 1.0)) for _ in range(3)])  # second moments along the principal axes
    axes = Rotation.from_quat(draw(unit_quaternions()), scalar_first=True).as_matrix()
    second = axes @ np.diag(masses / masses.sum() / 2) @ axes.T
    tensor = np.trace(second) * np.eye(3) - second
    return np.array([tensor[0, 0], tensor[1, 1], tensor[2, 2], tensor[0, 1], tensor[0, 2], tensor[1, 2]])


def tensor_of(entries):
    a, b, c, d, e, f = entries
    return np.array([[a, d, e], [d, b, f], [e, f, c]])


def same_rotation(a, b):
    # Twice the chord, insensitive to sign and accurate for small angles.
    return 2 * min(np.linalg.norm(a - b), np.linalg.norm(a + b))


@given(unit_quaternions())
def test_no_step_leaves_a_rotation_where_it_is(q):
    assert same_rotation(retracted(QUATERNION, q, np.zeros(3)), q) < 1e-14
    assert np.linalg.norm(UnitQuaternion().local(q, q)) < 1e-14
    assert np.linalg.norm(UnitQuaternion().local(q, -q)) < 1e-14  # the same rotation


@given(unit_quaternions(), rotation_vectors(), st.booleans())
@example(np.array([1.0, 0, 0, 0]), np.array([np.pi - 1e-6, 0, 0]), True)
def test_step_between_rotations_comes_back(q, step, flip):
    moved = retracted(QUATERNION, q, step)
    assert np.linalg.norm(moved) == pytest.approx(1.0, abs=1e-15)
    found = UnitQuaternion().local(q, -moved if flip else moved)
    np.testing.assert_allclose(found, step, atol=1e-9)


@given(unit_quaternions(), rotation_vectors())
def test_step_is_a_rotation_about_the_axes_of_the_first_frame(q, step):
    # An independent library: x_from_y turned by a rotation vector in x.
    expected = Rotation.from_rotvec(step) * Rotation.from_quat(q, scalar_first=True)
    found = Rotation.from_quat(retracted(QUATERNION, q, step), scalar_first=True)
    assert (found * expected.inv()).magnitude() < 1e-13


@given(unit_quaternions())
def test_half_turns_have_a_step_of_length_pi(q):
    turned = (Rotation.from_rotvec([0.0, np.pi, 0.0]) * Rotation.from_quat(q, scalar_first=True)).as_quat(
        scalar_first=True)
    step = UnitQuaternion().local(q, turned)
    assert np.linalg.norm(step) == pytest.approx(np.pi, abs=1e-9)
    assert same_rotation(retracted(QUATERNION, q, step), turned) < 1e-9


@given(inertia_tensors())
def test_no_step_leaves_a_tensor_where_it_is(point):
    np.testing.assert_allclose(retracted(INERTIA, point, np.zeros(5)), point, atol=1e-14)
    np.testing.assert_allclose(NormalizedInertia().local(point, point), 0.0, atol=1e-9)


@given(inertia_tensors(), inertia_tensors())
def test_any_tensor_is_reached_from_any_other(point, other):
    step = NormalizedInertia().local(point, other)
    np.testing.assert_allclose(retracted(INERTIA, point, step), other, atol=1e-10)


@given(inertia_tensors(), st.lists(st.floats(-0.5, 0.5), min_size=5, max_size=5))
def test_small_steps_of_a_tensor_come_back(point, step):
    # Within half a unit, I + D/2 stays positive definite and the root is the principal one.
    step = np.array(step)
    assume(np.max(np.abs(np.linalg.eigvalsh(tensor_of([step[0], step[1], -step[0] - step[1], *step[2:]])))) < 1.9)
    found = NormalizedInertia().local(point, retracted(INERTIA, point, step))
    np.testing.assert_allclose(found, step, atol=1e-7)


@settings(max_examples=200)
@given(inertia_tensors(), st.lists(st.floats(-30.0, 30.0), min_size=5, max_size=5))
def test_every_step_of_a_tensor_is_physical(point, step):
    moved = tensor_of(retracted(INERTIA, point, np.array(step)))
    moments = np.linalg.eigvalsh(moved)
    assert np.trace(moved) == pytest.approx(1.0, abs=1e-12)
    assert moments[0] > -1e-12  # steps through the boundary of a flat body touch it to rounding
    assert moments[2] <= moments[0] + moments[1] + 1e-12


def test_tangent_directions_of_a_tensor_are_independent_and_keep_the_trace():
    point = np.array([0.36, 0.33, 0.31, -0.02, 0.01, -0.07])
    x, d = ca.SX.sym("x", 6), ca.SX.sym("d", 5)
    jacobian = ca.jacobian(NormalizedInertia().retract(x, d), d)
    slope = np.asarray(ca.Function("s", [x, d], [jacobian])(point, np.zeros(5)))
    assert np.linalg.matrix_rank(slope) == 5
    np.testing.assert_allclose(slope[:3].sum(axis=0), 0.0, atol=1e-14)


@given(st.lists(numbers, min_size=3, max_size=3), unit_quaternions(), rotation_vectors(longest=3.0))
def test_product_of_manifolds_moves_part_by_part(vector, q, step):
    product = Product((UnitQuaternion(), Vector(3)))
    x, d = ca.SX.sym("x", product.ambient), ca.SX.sym("d", product.tangent)
    move = ca.Function("m", [x, d], [product.retract(x, d)])
    point, change = np.concatenate([q, vector]), np.concatenate([step, [1.0, 2.0, 3.0]])
    moved = np.asarray(move(point, change)).ravel()
    np.testing.assert_allclose(moved[:4], retracted(QUATERNION, q, step), atol=1e-14)
    np.testing.assert_allclose(moved[4:], np.add(vector, change[3:]), atol=1e-14)
    np.testing.assert_allclose(product.local(point, moved), change, atol=1e-9)
    assert len(product.labels()) == product.tangent


def test_columns_names_and_scales_line_up():
    columns = offsets([QUATERNION, INERTIA, VECTOR])
    assert columns == {"q": slice(0, 3), "J": slice(3, 8), "v": slice(8, 11)}
    assert VECTOR.direction_names() == ("v x", "v y", "v z")
    np.testing.assert_array_equal(VECTOR.scales, [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(QUATERNION.scales, [0.1, 0.1, 0.1])
    for unknown in (QUATERNION, INERTIA, VECTOR):
        assert len(unknown.manifold.labels()) == unknown.manifold.tangent
