"""Directions that the data do not determine: found where planted, named in the user's terms, left at the start."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from estimator.estimate import Status
from estimator.models import rotations
from estimator.observability import weak_directions
from estimator.problem import Problem
from estimator.residuals import Kernel, KernelResidual
from estimator.solvers import solve
from estimator.unknowns import UnitQuaternion, Unknown, Vector
from problems.alignment.simulator import preset, simulate
from problems.alignment.solution import solve_campaign

A = Unknown("a", Vector(2, ("x", "y")), "m", (2.0, 3.0))
B = Unknown("b", Vector(1, ("",)), "s", 0.5)
ANTENNA = Unknown("antenna_from_tracker", UnitQuaternion(), "rad", 0.1, frame="antenna")


@settings(max_examples=50)
@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3), st.floats(1.5, 1e6))
def test_planted_direction_is_found_with_its_ratio(direction, ratio):
    v = np.array(direction)
    if np.linalg.norm(v) < 0.1:
        return
    v /= np.linalg.norm(v)
    matrix = 1e6 * (np.eye(3) - np.outer(v, v)) + np.outer(v, v) / ratio**2
    found = weak_directions(matrix, [A, B])
    assert len(found) == 1
    assert abs(found[0].vector @ v) == pytest.approx(1.0, abs=1e-6)
    if ratio < 1e3:  # the eigenvalue itself is above rounding
        assert found[0].ratio == pytest.approx(ratio, rel=1e-2)
    shares = found[0].participation
    assert sum(shares.values()) == pytest.approx(1.0, abs=0.05)
    for name, value in (("a", v[0] ** 2 + v[1] ** 2), ("b", v[2] ** 2)):
        if value > 0.03:
            assert shares[name] == pytest.approx(value, abs=1e-5)
            assert name in found[0].sentence


def test_well_determined_directions_are_not_named():
    assert weak_directions(1.01 * np.eye(3), [A, B]) == []
    weak = weak_directions(np.diag([0.0, 4.0, 0.25]), [A, B])
    assert [w.ratio for w in weak] == [np.inf, 2.0]
    assert "carry nothing" in weak[0].sentence
    assert "a (" in weak[0].sentence and "x" in weak[0].sentence
    assert weak[1].sentence.startswith("b")


def _one_axis(axis, n=20, sigma=1e-3):
    """One direction seen again and again: the rotation about it cannot be known."""
    rng = np.random.default_rng(3)
    truth = Rotation.from_rotvec([0.1, 0.05, -0.2])
    measured = np.tile(axis, (n, 1)) + sigma * rng.normal(size=(n, 3))
    kernel = Kernel("axis", (ANTENNA,), (), (("direction", 3), ("measured", 3)), (),
                    lambda x: x["measured"] - rotations.rotate(x["antenna_from_tracker"], x["direction"]))
    residual = KernelResidual("axis", "axis", "1", kernel, (),
                              {"direction": truth.inv().apply(np.tile(axis, (n, 1))), "measured": measured},
                              np.full((n, 3), sigma), np.arange(n, dtype=float), np.zeros(n, dtype=int), ("all",))
    start = (Rotation.from_rotvec(0.03 * axis) * Rotation.from_rotvec([0.02, -0.03, 0.01]) * truth)
    return Problem((ANTENNA,), (residual,), {"antenna_from_tracker": start.as_quat(scalar_first=True)}), truth


@pytest.mark.parametrize("axis", [np.array([0.0, 0.0, 1.0]), np.array([0.6, 0.0, -0.8])])
def test_rotation_about_the_only_direction_seen(axis):
    problem, truth = _one_axis(axis)
    estimate = solve(problem)
    assert estimate.status is Status.UNOBSERVABLE
    assert len(estimate.weak) == 1
    named = axis if axis[np.argmax(np.abs(axis))] > 0 else -axis
    words = ", ".join(f"{x:.3f}" for x in named + 0.0)
    for part in words.replace("-0.000", "0.000").split(", "):
        assert part in estimate.weak[0].sentence.replace("-0.000", "0.000")
    assert "rotation of antenna_from_tracker about the antenna axis" in estimate.weak[0].sentence
    assert estimate.weak[0].sentence in estimate.why
    # The determined part is right, and nothing turned about the axis that cannot be seen.
    found = Rotation.from_quat(estimate.values["antenna_from_tracker"], scalar_first=True)
    start = Rotation.from_quat(problem.start["antenna_from_tracker"], scalar_first=True)
    assert np.linalg.norm((found * truth.inv()).apply(axis) - axis) < 5e-3 / np.sqrt(20)
    assert abs((found * start.inv()).as_rotvec() @ axis) < 2e-3  # second order in the step of 0.04 rad
    # Axes that take part have no sigma to report.
    sigma = estimate.sigma_of("antenna_from_tracker")
    assert np.array_equal(np.isinf(sigma), np.abs(axis) > 1e-2)


def test_one_beam_pair_in_one_short_session_leaves_a_rotation_open():
    """A campaign with two beams and no slews sees the direction of the velocity through two numbers only."""
    campaign, _ = simulate(preset("compact", beams=2, doppler_sessions=1, session_duration=4.0, free_arcs=0,
                                  pulse_axes=(), slew_amplitude=(0.0, 0.0, 0.0), doppler_noise=200.0,
                                  star_tracker_noise=(5e-3, 5e-3, 5e-3)), seed=2)
    solution = solve_campaign(campaign)
    assert solution.status is Status.UNOBSERVABLE
    assert any("antenna_from_tracker" in s for s in solution.unobservable)
    assert any("normalized_inertia" in s for s in solution.unobservable)
    assert any("actuator_from_tracker" in s for s in solution.unobservable)
