"""Kernels and whitening: every kernel's Jacobian on the manifold, noise inputs against explicit nuisance unknowns."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from estimator.effects.declaration import Layout
from estimator.effects.library import load
from estimator.losses import Cauchy
from estimator.residuals import Kernel, KernelResidual
from estimator.signals import LinearSignal
from estimator.unknowns import UnitQuaternion, Unknown, Vector, retracted
from problems.alignment.kernels import (
    ENVIRONMENT_ROWS,
    attitude_kernel,
    doppler_kernel,
    position_effect_kernel,
)

LAYOUT = Layout(3, ((0.0, 60.0), (100.0, 160.0)), (0.0, 3600.0), 5900.0, (0.0, 3600.0),
                ((0.0, 0.3, 0.954), (0.26, -0.15, 0.954), (-0.26, -0.15, 0.954)))


def instances(*channels: str, families: tuple[str, ...] = ()):
    """One instance of every effect of the channels."""
    found = []
    for family in load().values():
        of_layout = family.instances(LAYOUT)
        if of_layout and of_layout[0].channel in channels and (not families or family.name in families):
            found.append(of_layout[0])
    return tuple(found)


def quaternion(rng):
    return Rotation.random(random_state=int(rng.integers(1 << 30))).as_quat(scalar_first=True)


def assert_jacobian(kernel: Kernel, point: dict[str, np.ndarray], samples: int, rtol: float = 2e-6) -> None:
    """Compare every Jacobian of the kernel with central differences on the manifold, block by block."""
    residual, jacobians = kernel(samples, point)
    assert np.isfinite(residual).all()
    manifolds = {u.name: u.manifold for u in kernel.unknowns} | dict(kernel.signals)
    for label, manifold in manifolds.items():
        x, d = ca.SX.sym("x", manifold.ambient), ca.SX.sym("d", manifold.tangent)
        move = ca.Function("m", [x, d], [manifold.retract(x, d)])
        per_sample = point[label].ndim == 2
        typical = {"velocity": 1.0}.get(label, 1e-6)
        for k in range(manifold.tangent):
            sides = []
            for sign in (1, -1):
                step = np.zeros(manifold.tangent)
                step[k] = sign * typical
                moved = (np.array([np.asarray(move(p, step)).ravel() for p in point[label]]) if per_sample
                         else np.asarray(move(point[label], step)).ravel())
                sides.append(kernel(samples, {**point, label: moved})[0])
            difference = (sides[0] - sides[1]) / (2 * typical)
            found = jacobians[label][:, :, k]
            scale = np.max(np.abs(jacobians[label])) + 1e-30
            largest = max(np.max(np.abs(v)) for v in point.values())
            rounding = 1e-15 * (np.max(np.abs(residual)) + 1e-3 * largest) / typical
            np.testing.assert_allclose(found, difference, rtol=rtol, atol=rtol * scale + rounding,
                                       err_msg=f"{kernel.function.name()}: block {label}, direction {k}")


def environment(rng, samples):
    """Rows of the environment table in the order of the declaration, of realistic size."""
    from estimator.effects.declaration import ENVIRONMENT
    from estimator.models.environment import environment_table

    time = np.sort(rng.uniform(0, 5000.0, samples))
    radius, speed = 7071e3, 7508.0
    angle = speed / radius * time
    position = radius * np.column_stack([np.cos(angle), 0.1 * np.sin(angle), 0.995 * np.sin(angle)])
    velocity = speed * np.column_stack([-np.sin(angle), 0.1 * np.cos(angle), 0.995 * np.cos(angle)])
    table = environment_table("2024-03-01T00:00:00Z", time, position, velocity, 1.0, 7.292115e-5)
    return np.column_stack([np.asarray(table[n]).reshape(samples, size) for n, size in ENVIRONMENT.items()]), velocity


def parameters(effects, rng):
    """Values of every effect's parameters, a tenth of a scale from zero (or inside the range where searched)."""
    return {e.name: np.array([p.search.at(0.4) if p.search
                              else 0.1 * p.scale * rng.uniform(0.5, 1.0) for p in e.parameters]) for e in effects}


@pytest.mark.parametrize("effects", [(), instances("doppler", "star_tracker")], ids=["plain", "every effect"])
def test_doppler_kernel(effects):
    rng = np.random.default_rng(1)
    n = 5
    table, velocity = environment(rng, n)
    kernel = doppler_kernel(3, effects)
    beams = np.array(LAYOUT.beam_directions)
    point = {
        "antenna_from_tracker": quaternion(rng), "velocity": velocity,
        "attitude": np.array([quaternion(rng) for _ in range(n)]), "earth_angle": rng.uniform(0, 6, (n, 1)),
        "beam_direction": np.broadcast_to(beams / np.linalg.norm(beams, axis=1)[:, None], (n, 3, 3)),
        "shift": rng.normal(0, 1e4, (n, 3)), "carrier": np.full((n, 1), 9.6e9),
        "environment": table, "rate": 1e-3 * rng.normal(size=(n, 3)), **parameters(effects, rng),
    }
    point = {k: v for k, v in point.items() if k in kernel.labels}
    assert_jacobian(kernel, point, n)


def test_noise_input_of_the_doppler_kernel_is_the_tracker_error():
    """The Jacobian along the noise input equals that of moving the attitude against the tracker's error."""
    rng = np.random.default_rng(2)
    n, h = 4, 1e-6
    _, velocity = environment(rng, n)
    kernel = doppler_kernel(2, ())
    point = {
        "antenna_from_tracker": quaternion(rng), "velocity": velocity,
        "attitude": np.array([quaternion(rng) for _ in range(n)]), "earth_angle": rng.uniform(0, 6, (n, 1)),
        "beam_direction": np.broadcast_to(np.array([[0, 0.3, 0.954], [0.6, 0, 0.8]]), (n, 2, 3)),
        "shift": np.zeros((n, 2)), "carrier": np.full((n, 1), 9.6e9)}
    jacobian = kernel(n, point)[1]["attitude_error"]
    for k in range(3):
        sides = []
        for sign in (1, -1):
            # measured = error o true, so the true attitude is the measured one turned back by the error
            turn = Rotation.from_rotvec(-sign * h * np.eye(3)[k])
            attitude = (turn * Rotation.from_quat(point["attitude"], scalar_first=True)).as_quat(scalar_first=True)
            sides.append(kernel(n, {**point, "attitude": attitude})[0])
        np.testing.assert_allclose(jacobian[:, :, k], (sides[0] - sides[1]) / (2 * h), rtol=1e-6,
                                   atol=1e-7 * np.abs(jacobian).max())


@pytest.mark.parametrize("effects", [(), instances("star_tracker")], ids=["plain", "every effect"])
def test_attitude_kernel(effects):
    rng = np.random.default_rng(3)
    n = 5
    table, _ = environment(rng, n)
    kernel = attitude_kernel((), effects)
    measured = np.array([quaternion(rng) for _ in range(n)])
    # Small and large differences; and a sign flip, which is no difference.
    turns = Rotation.from_rotvec(np.array([[1e-4, 0, 0], [0, -1e-3, 2e-3], [0.5, 0.2, -0.3], [0, 0, 2.5], [0, 0, 0]]))
    state = (turns * Rotation.from_quat(measured, scalar_first=True)).as_quat(scalar_first=True)
    state[1] *= -1
    point = {"state": np.column_stack([state, 0.01 * rng.normal(size=(n, 3))]), "measured": measured,
             "environment": table, **parameters(effects, rng)}
    point = {k: v for k, v in point.items() if k in kernel.labels}
    assert_jacobian(kernel, point, n)
    if not effects:
        # measured minus predicted, about the tracker axes, in rad
        residual = kernel(n, point)[0]
        np.testing.assert_allclose(residual, -turns.as_rotvec(), atol=1e-12)


def test_position_effect_kernel():
    rng = np.random.default_rng(4)
    n = 6
    table, _ = environment(rng, n)
    effects = instances("gnss")
    assert len(effects) >= 2
    kernel = position_effect_kernel(effects)
    point = {"environment": table, "attitude": np.array([quaternion(rng) for _ in range(n)]),
             "rate": 0.01 * rng.normal(size=(n, 3)), "inside_arc": np.ones((n, 1)), **parameters(effects, rng)}
    assert table.shape == (n, ENVIRONMENT_ROWS)
    assert_jacobian(kernel, point, n)


# --- whitening -------------------------------------------------------------------------------------------------------

ANGLE = Unknown("mount", UnitQuaternion(), "rad", 0.1)
SHIFT = Unknown("shift", Vector(2), "m", 1.0)


def _vector_kernel() -> Kernel:
    """A rotated and shifted direction, seen through a noisy angle: three measurements, one noise input of three."""
    from estimator.models import rotations

    def build(x):
        seen = rotations.rotate(rotations.exponential(x["angle_error"]), x["direction"])
        return x["measured"] - rotations.rotate(x["mount"], seen) - ca.vertcat(x["offset"], 0)

    return Kernel("noisy_direction", (ANGLE,), (("offset", Vector(2)),), (("direction", 3), ("measured", 3)),
                  (("angle_error", 3),), build)


def _noisy_directions(n=12, seed=5):
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(n, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    truth = quaternion(rng)
    sigma, noise = rng.uniform(0.5e-3, 2e-3, (n, 3)), rng.uniform(1e-3, 4e-3, (n, 3))
    rotated = Rotation.from_rotvec(noise * rng.normal(size=(n, 3))).apply(directions)
    measured = Rotation.from_quat(truth, scalar_first=True).apply(rotated) + sigma * rng.normal(size=(n, 3))
    gain = rng.normal(size=(n, 2, 2))
    shift = np.array([3e-3, -2e-3])
    measured[:, :2] += gain @ shift
    residual = KernelResidual(
        "directions", "directions", "m", _vector_kernel(), (LinearSignal("offset", SHIFT, np.zeros((n, 2)), gain),),
        {"direction": directions, "measured": measured}, sigma, np.arange(n, dtype=float), np.zeros(n, dtype=int),
        ("all",), noise={"angle_error": noise})
    return residual, truth


def test_whitening_with_noise_inputs_is_the_elimination_of_nuisance_unknowns():
    """Minimum and covariance agree with a problem that carries three angles of every epoch as unknowns."""
    from estimator.problem import Problem
    from estimator.solvers import Options, solve

    residual, truth = _noisy_directions()
    problem = Problem((ANGLE, SHIFT), (residual,), {"mount": truth, "shift": np.zeros(2)})
    estimate = solve(problem, Options(tolerance=1e-12))
    n = residual.samples
    directions, measured = residual.data["direction"], residual.data["measured"]
    sigma, noise, gain = residual.standard_deviation, residual.noise["angle_error"], residual.signals[0].matrix

    def enlarged(z):
        q = retracted(ANGLE, estimate.values["mount"], z[:3])
        turned = Rotation.from_rotvec(z[5:].reshape(n, 3)).apply(directions)
        r = measured - Rotation.from_quat(q, scalar_first=True).apply(turned)
        r[:, :2] -= gain @ z[3:5]
        return np.concatenate([(r / sigma).ravel(), z[5:] / noise.ravel()])

    start = np.zeros(5 + 3 * n)
    start[3:5] = estimate.values["shift"]
    solution = least_squares(enlarged, start, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    covariance = np.linalg.inv(solution.jac.T @ solution.jac)[:5, :5]
    np.testing.assert_allclose(estimate.covariance, covariance, rtol=2e-2, atol=2e-3 * np.abs(covariance).max())
    sigmas = np.sqrt(np.diag(covariance))
    difference = solution.x[:5] - np.concatenate([np.zeros(3), estimate.values["shift"]])
    assert np.max(np.abs(difference) / sigmas) < 1e-5
    assert 2 * solution.cost == pytest.approx(sum(p.cost for p in estimate.parts), rel=1e-9)


def test_linear_nuisances_are_eliminated_exactly():
    """Where all is linear, the minimum over the nuisances is the whitened sum of squares to rounding."""
    residual, truth = _noisy_directions(n=3)
    values = {"mount": truth, "shift": np.array([1e-3, 2e-3])}
    prepared = residual.prepared(values)
    inputs, _ = prepared._inputs(values)
    raw, jacobians = residual.kernel(residual.samples, inputs)
    h, p = jacobians["angle_error"], residual.noise["angle_error"]
    raw = raw - np.einsum("nij,nj->ni", h, prepared.estimated["angle_error"])
    whitened = prepared.linearize(values).whitened
    for k in range(3):
        rows = np.vstack([h[k] / residual.standard_deviation[k][:, None], np.diag(1 / p[k])])
        right = np.concatenate([-raw[k] / residual.standard_deviation[k], np.zeros(3)])
        least = np.linalg.lstsq(rows, right, rcond=None)
        assert least[1][0] == pytest.approx(float(whitened[k] @ whitened[k]), rel=1e-10)


def test_whitened_jacobian_and_symbolic_form():
    residual, truth = _noisy_directions()
    values = {"mount": retracted(ANGLE, truth, np.array([1e-3, 0, -1e-3])), "shift": np.array([1e-3, -1e-3])}
    prepared = residual.prepared(values)
    part = prepared.linearize(values)
    h = 1e-6
    for k, u in enumerate([ANGLE] * 3 + [SHIFT] * 2):
        step = np.zeros(u.manifold.tangent)
        step[k if u is ANGLE else k - 3] = h
        ahead = prepared.linearize({**values, u.name: retracted(u, values[u.name], step)}).whitened
        behind = prepared.linearize({**values, u.name: retracted(u, values[u.name], -step)}).whitened
        np.testing.assert_allclose(part.jacobian[:, :, k], (ahead - behind) / (2 * h), atol=1e-4, rtol=1e-6)
    symbols = {k: ca.MX(ca.DM(v)) for k, v in values.items()}
    symbolic = np.asarray(ca.evalf(prepared.symbolic(symbols))).reshape(residual.samples, 3)
    np.testing.assert_allclose(symbolic, part.whitened, rtol=1e-10, atol=1e-10)


def test_rejected_and_left_out_samples():
    residual, truth = _noisy_directions()
    values = {"mount": truth, "shift": np.zeros(2)}
    keep = np.arange(residual.samples) % 3 != 0
    from dataclasses import replace

    rejected = replace(residual, accepted=keep).prepared(values).linearize(values)
    subset = residual.subset(keep).prepared(values).linearize(values)
    assert rejected.cost == pytest.approx(subset.cost)
    assert rejected.measurements == subset.measurements == 3 * keep.sum()
    assert np.array_equal(rejected.weight > 0, keep)
    np.testing.assert_allclose(rejected.jacobian[keep], subset.jacobian)
    robust = replace(residual, loss=Cauchy(0.5)).prepared(values).linearize(values)
    assert robust.cost < residual.prepared(values).linearize(values).cost
    assert np.all(robust.weight < 1)


_SCRIPT = """
import numpy as np
from problems.alignment.simulator import preset, simulate
from problems.alignment.problem import alignment_model, alignment_problem
campaign, _ = simulate(preset("compact", duration=1800.0, doppler_sessions=2, session_duration=10.0, free_arcs=1,
                              free_duration=60.0, pulse_axes=(0,), pulse_duration=80.0), 3)
problem = alignment_problem(alignment_model(campaign))
parts = problem.prepared(problem.start).linearize(problem.start)
np.savez({path!r}, *[p.whitened for p in parts], *[p.jacobian for p in parts])
"""


def test_compiled_and_interpreted_kernels_agree(tmp_path: Path):
    from estimator.models.compiled import compiler

    if compiler() is None:
        pytest.skip("this machine has no C compiler: every kernel is interpreted anyway")
    results = []
    for choice in ("", "none"):
        path = tmp_path / f"{choice or 'compiled'}.npz"
        environment_variables = {**os.environ, "BORESIGHT_COMPILER": choice}
        subprocess.run([sys.executable, "-W", "error", "-c", _SCRIPT.format(path=str(path))], check=True,
                       env=environment_variables, cwd=Path(__file__).resolve().parents[1], timeout=300)
        with np.load(path) as file:
            results.append([file[k] for k in file.files])
    for a, b in zip(*results, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * np.max(np.abs(a)))
