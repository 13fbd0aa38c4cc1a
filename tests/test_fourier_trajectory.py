"""The Fourier frame: derivatives, the frame property that the paper misses, singular directions, fast evaluation."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from estimator.models.errors import RequestError, ShapeError
from estimator.models.fourier_trajectory import FourierFrame, concentrated_directions


@pytest.mark.parametrize("derivative", [0, 1, 2, 3, 4, 5])
def test_symbolic_basis_equals_the_numeric_one(derivative: int) -> None:
    frame = FourierFrame(-3.0, 9.0, 7)
    time = ca.SX.sym("time")
    function = ca.Function("basis", [time], [frame.basis_symbolic(time, derivative)])
    at = np.linspace(-3.0, 9.0, 23)
    symbolic = np.column_stack([np.asarray(function(t)).ravel() for t in at]).T
    np.testing.assert_allclose(symbolic, frame.basis(at, derivative), atol=1e-12 * frame.frequencies[-1] ** derivative)


def test_symbolic_derivatives_are_those_of_automatic_differentiation() -> None:
    frame = FourierFrame(10.0, 70.0, 5)
    time = ca.MX.sym("time")
    expression = frame.basis_symbolic(time)
    for derivative in range(1, 5):
        expression = ca.jacobian(expression, time)
        function = ca.Function("difference", [time], [expression - frame.basis_symbolic(time, derivative)])
        for t in (10.0, 33.3, 70.0):
            assert float(ca.norm_inf(function(t))) < 1e-13


@pytest.mark.parametrize("derivative", [1, 2, 3])
def test_derivatives_against_finite_differences(derivative: int) -> None:
    frame = FourierFrame(0.0, 100.0, 9)
    time = np.linspace(1.0, 99.0, 41)
    step = 1e-3
    lower = derivative - 1
    difference = (8.0 * (frame.basis(time + step, lower) - frame.basis(time - step, lower))
                  - (frame.basis(time + 2.0 * step, lower) - frame.basis(time - 2.0 * step, lower))) / (12.0 * step)
    scale = frame.frequencies[-1] ** derivative
    np.testing.assert_allclose(frame.basis(time, derivative) / scale, difference / scale, atol=1e-8)


def test_columns_and_size() -> None:
    frame = FourierFrame(2.0, 6.0, 3)
    assert frame.size == 7
    assert frame.middle == 4.0
    row = frame.basis(np.array([5.0]))[0]  # a quarter of the arc from the middle: phase pi d / 4
    angle = 0.25 * np.pi * np.arange(1, 4)
    np.testing.assert_allclose(row, np.r_[1.0, np.cos(angle), np.sin(angle)], atol=1e-15)
    np.testing.assert_allclose(FourierFrame(0.0, 1.0, 0).basis(np.array([0.3])), [[1.0]])


@pytest.mark.parametrize(("start", "stop", "degree"), [(1.0, 1.0, 3), (2.0, 1.0, 3), (0.0, np.inf, 3), (0.0, 1.0, -1),
                                                       (0.0, 1.0, 2.5)])
def test_meaningless_frames_are_refused(start: float, stop: float, degree: float) -> None:
    with pytest.raises(RequestError):
        FourierFrame(start, stop, degree)  # type: ignore[arg-type]


def test_meaningless_requests_are_refused() -> None:
    frame = FourierFrame(0.0, 1.0, 2)
    with pytest.raises(RequestError):
        frame.basis(np.array([0.5]), -1)
    with pytest.raises(ShapeError):
        frame.basis(np.zeros((3, 2)))


def test_the_printed_projection_returns_twice_the_trajectory() -> None:
    """Equations (22), (23) with the printed basis: 2 x in the middle of the arc, about 1 x at its ends."""
    span = 2000.0
    time = (np.arange(20000) + 0.5) * (span / 20000)
    trajectory = 7.0e6 * np.cos(2.0 * np.pi * time / 5900.0 + 0.4)  # m
    frame = FourierFrame(0.0, span, 400)
    phase = np.exp(1j * np.outer(frame.frequencies, time - frame.middle)) / np.sqrt(span)
    coefficients = (phase.conj() @ trajectory) * (span / time.size)
    printed = (coefficients[0] * phase[0]).real + 2.0 * (coefficients[1:] @ phase[1:]).real
    ratio = printed / trajectory
    middle = (time > 0.3 * span) & (time < 0.7 * span) & (np.abs(trajectory) > 1e6)
    assert np.abs(ratio[middle] - 2.0).max() < 0.02
    assert abs(ratio[0] - 1.0) < 0.05
    assert abs(ratio[-1] - 1.0) < 0.05


@pytest.mark.parametrize("degree", [0, 1, 2, 5, 12, 40, 97])
def test_directions_are_the_singular_vectors_of_the_frame(degree: int) -> None:
    """Against a dense decomposition of the frame sampled at Gauss nodes."""
    frame = FourierFrame(-1.0, 1.0, degree)
    nodes, weights = np.polynomial.legendre.leggauss(2 * degree + 60)
    root = np.sqrt(0.5 * weights)[:, None]
    # Columns of equal norm: the constant counts once, cosines and sines by root two.
    tight = np.r_[1.0, np.full(2 * degree, np.sqrt(2.0))]
    dense = np.linalg.svd(root * frame.basis(nodes) * tight, compute_uv=False)
    directions = concentrated_directions(degree)
    found = np.sort(directions.singular)[::-1]
    assert found.size >= min(frame.size, (dense > 1e-12 * dense[0]).sum())
    np.testing.assert_allclose(found, dense[: found.size], atol=3e-13)

    safe = directions.above(1e-6)
    functions = root * frame.concentrated_basis(nodes, safe)
    np.testing.assert_allclose(functions.T @ functions, np.eye(safe.rank), atol=1e-8)
    np.testing.assert_allclose(functions, root * frame.basis(nodes) @ safe.coefficients(np.eye(safe.rank)), atol=1e-8)


def test_rank_is_far_below_the_number_of_coefficients() -> None:
    """About D + 20..40 of 2D+1 directions are above 1e-12: 85 of 121, 179 of 299, 332 of 597."""
    for degree, rank in ((60, 85), (149, 179), (298, 332)):
        assert abs(concentrated_directions(degree).above(1e-12).rank - rank) <= 1


@pytest.mark.parametrize("derivative", [0, 1, 2])
@pytest.mark.parametrize("sampling", ["regular", "irregular", "unordered"])
def test_evaluation_in_cells_equals_the_dense_product(derivative: int, sampling: str) -> None:
    generator = np.random.default_rng(4)
    frame = FourierFrame(0.0, 3000.0, 60)
    coefficients = generator.normal(size=(frame.size, 3))
    time = np.linspace(0.0, 3000.0, 30001)
    if sampling != "regular":
        time = generator.uniform(0.0, 3000.0, 30001)
        time[5000:8000] = 700.0  # repeated times leave cells empty and others full
    if sampling == "irregular":
        time = np.sort(time)
    fast = frame.evaluate(coefficients, time, derivative)
    assert time.size * frame.size > 3_000_000  # long enough for the cells to be used
    some = generator.integers(0, time.size, 500)
    dense = frame.basis(time[some], derivative) @ coefficients
    np.testing.assert_allclose(fast[some], dense, atol=1e-11 * np.abs(dense).max())
