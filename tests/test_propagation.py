"""Flows: states and sensitivities along an arc against an adaptive integrator of higher order, and conservation."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from estimator.propagation import Flow, PropagatedSignal
from estimator.unknowns import UnitQuaternion, Unknown, Vector, retracted
from problems.alignment.kernels import ACTUATOR, ENVIRONMENT_ROWS, INERTIA, rotation_flow

TRACE = 2300.0  # kg m2
ENTRIES = np.array([0.36, 0.33, 0.31, -0.015, 0.005, -0.066])
MOUNT = np.array([0.8836, -0.4185, -0.1951, -0.0773]) / np.linalg.norm([0.8836, -0.4185, -0.1951, -0.0773])
START = (Rotation.from_rotvec([0.4, -1.2, 2.0]).as_quat(scalar_first=True), np.array([0.008, -0.006, 0.009]))
TORQUE = np.array([0.12, -0.06, 0.04])  # N m, actuator axes


def tensor(entries):
    a, b, c, d, e, f = entries
    return np.array([[a, d, e], [d, b, f], [e, f, c]])


def truth(attitude, rate, entries, trace, mount, command, times):
    """Attitude matrix and rate by an eighth-order adaptive method, in matrices, from Euler's equation."""
    j = trace * tensor(entries)
    torque = Rotation.from_quat(mount, scalar_first=True).as_matrix().T @ command

    def slope(t, y):
        a, w = y[:9].reshape(3, 3), y[9:]
        cross = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        return np.concatenate([(-cross @ a).ravel(), np.linalg.solve(j, torque - np.cross(w, j @ w))])

    y0 = np.concatenate([Rotation.from_quat(attitude, scalar_first=True).as_matrix().ravel(), rate])
    y = solve_ivp(slope, (times[0], times[-1]), y0, method="DOP853", rtol=1e-13, atol=1e-15, t_eval=times).y.T
    return y[:, :9].reshape(-1, 3, 3), y[:, 9:]


def difference(found, matrix, rate):
    """Tangent difference (n, 6) from the flow's states to the integrator's."""
    turn = Rotation.from_matrix(matrix) * Rotation.from_quat(found[:, :4], scalar_first=True).inv()
    return np.column_stack([turn.as_rotvec(), rate - found[:, 4:7]])


def signal_and_values(commanded: bool, times: np.ndarray, substeps: int = 1):
    flow = rotation_flow(commanded, (), TRACE, substeps)
    starts = (Unknown("attitude:a", UnitQuaternion(), "rad", 0.1), Unknown("rate:a", Vector(3), "rad/s", 0.01))
    held = np.tile(TORQUE, (len(times) - 1, 1)) if commanded else np.zeros((len(times) - 1, 0))
    signal = PropagatedSignal("state", flow, starts, times, np.zeros((len(times), 0)), held, np.arange(len(times)))
    values = {"attitude:a": START[0], "rate:a": START[1], INERTIA.name: ENTRIES, "inertia_trace": np.array([TRACE]),
              ACTUATOR.name: MOUNT}
    return signal, values


def moved_truth(unknown, step, values, commanded, times):
    moved = dict(values)
    moved[unknown.name] = retracted(unknown, values[unknown.name], step)
    return truth(moved["attitude:a"], moved["rate:a"], moved[INERTIA.name], moved["inertia_trace"][0],
                 moved[ACTUATOR.name], TORQUE if commanded else np.zeros(3), times)


@pytest.mark.parametrize("commanded", [False, True], ids=["free", "commanded"])
def test_states_and_sensitivities_along_an_arc(commanded):
    times = np.linspace(0.0, 120.0, 241)
    signal, values = signal_and_values(commanded, times)
    states, jacobian = signal.evaluate(values)
    matrix, rate = truth(*START, ENTRIES, TRACE, MOUNT, TORQUE if commanded else np.zeros(3), times)
    assert np.max(np.abs(difference(states, matrix, rate))) < 1e-9  # rad, rad/s
    column = 0
    for unknown in signal.unknowns:
        typical = {"rate:a": 1e-5, "inertia_trace": 1.0}.get(unknown.name, 1e-4)
        for k in range(unknown.manifold.tangent):
            step = np.zeros(unknown.manifold.tangent)
            step[k] = typical
            ahead = difference(states, *moved_truth(unknown, step, values, commanded, times))
            behind = difference(states, *moved_truth(unknown, -step, values, commanded, times))
            expected = (ahead - behind) / (2 * typical)
            # The attitude and the rate have units of their own.
            for rows in (slice(0, 3), slice(3, 6)):
                limit = 3e-6 * np.max(np.abs(expected[:, rows])) + 1e-15 / typical
                np.testing.assert_allclose(jacobian[:, rows, column], expected[:, rows], atol=limit, rtol=0,
                                           err_msg=f"{unknown.name} direction {k}")
            column += 1
    assert column == jacobian.shape[2]


def test_error_of_a_step_falls_with_its_fourth_power():
    end = []
    for steps in (30, 60):
        times = np.linspace(0.0, 120.0, steps + 1)
        signal, values = signal_and_values(False, times)
        states = signal.evaluate({**values, "rate:a": 10 * START[1]})[0][-1:]
        matrix, rate = truth(START[0], 10 * START[1], ENTRIES, TRACE, MOUNT, np.zeros(3), times[[0, -1]])
        end.append(np.max(np.abs(difference(states, matrix[-1:], rate[-1:]))))
    assert 12 < end[0] / end[1] < 45  # 16 for fourth order, up to 32 for the attitude's error


def test_substeps_are_steps():
    coarse, values = signal_and_values(True, np.linspace(0.0, 40.0, 21), substeps=4)
    fine, _ = signal_and_values(True, np.linspace(0.0, 40.0, 81))
    a, ja = coarse.evaluate(values)
    b, jb = fine.evaluate(values)
    np.testing.assert_allclose(a, b[::4], atol=1e-13)
    np.testing.assert_allclose(ja, jb[::4], rtol=1e-9, atol=1e-12 * np.abs(jb).max())


def test_free_rotation_keeps_momentum_energy_and_unit_quaternions():
    times = np.linspace(0.0, 600.0, 2401)
    signal, values = signal_and_values(False, times)
    states, _ = signal.evaluate(values)
    attitude, rate = Rotation.from_quat(states[:, :4], scalar_first=True), states[:, 4:]
    momentum = attitude.inv().apply(rate @ tensor(ENTRIES))
    energy = np.einsum("ni,ij,nj->n", rate, tensor(ENTRIES), rate)
    size = np.linalg.norm(momentum[0])
    assert np.max(np.abs(momentum - momentum[0])) < 1e-9 * size
    assert np.ptp(energy) < 1e-10 * energy[0]
    np.testing.assert_allclose(np.linalg.norm(states[:, :4], axis=1), 1.0, atol=1e-14)


def test_symbolic_form_and_subset_are_the_same_curve():
    times = np.linspace(0.0, 30.0, 61)
    signal, values = signal_and_values(True, times)
    states, jacobian = signal.evaluate(values)
    symbolic = signal.symbolic({k: ca.MX(ca.DM(v)) for k, v in values.items()})
    np.testing.assert_allclose(np.asarray(ca.evalf(symbolic)).T, states, atol=1e-13)
    keep = np.arange(61) % 7 == 0
    few = signal.subset(keep)
    np.testing.assert_array_equal(few.evaluate(values)[0], states[keep])
    np.testing.assert_array_equal(few.evaluate(values)[1], jacobian[keep])


def test_driven_oscillator_with_interpolated_input_and_a_state_from_zero():
    """A flow of a different kind: two states, one of them from zero, an input linear inside steps: known solution."""
    stiffness = Unknown("stiffness", Vector(1), "1/s2", 1.0)
    speed = Unknown("speed", Vector(1), "m/s", 1.0)
    flow = Flow("oscillator", (("x", Vector(1)), ("v", Vector(1))), ("v",), (stiffness,), 1, 0,
                lambda x, theta, u, h, dt, f: ca.vertcat(x["v"], u - theta["stiffness"] * x["x"]))
    times = np.linspace(0.0, 10.0, 1001)
    signal = PropagatedSignal("state", flow, (speed,), times, 0.3 * times[:, None], np.zeros((1000, 0)),
                              np.arange(1001))
    k, v0 = 2.0, 0.7
    states, jacobian = signal.evaluate({"stiffness": np.array([k]), "speed": np.array([v0])})

    def exact(k, v0):  # x'' = 0.3 t - k x, x(0) = 0, x'(0) = v0
        w = np.sqrt(k)
        return 0.3 * times / k + (v0 - 0.3 / k) / w * np.sin(w * times)

    np.testing.assert_allclose(states[:, 0], exact(k, v0), atol=1e-9)
    h = 1e-5
    np.testing.assert_allclose(jacobian[:, 0, 0], (exact(k, v0 + h) - exact(k, v0 - h)) / (2 * h), atol=1e-7)
    np.testing.assert_allclose(jacobian[:, 0, 1], (exact(k + h, v0) - exact(k - h, v0)) / (2 * h), atol=1e-7)


def test_every_torque_effect_has_the_sensitivity_of_its_flow(monkeypatch):
    """Sensitivities along the parameters of every effect that turns the body, against differences of the flow."""
    from estimator.effects.declaration import ENVIRONMENT, Layout
    from estimator.effects.library import load
    from estimator.models.environment import environment_table

    layout = Layout(3, ((0.0, 60.0),), (0.0, 3600.0), 5900.0, (0.0, 3600.0))
    times = np.linspace(0.0, 60.0, 121)
    angle = 7508.0 / 7071e3 * times
    position = 7071e3 * np.column_stack([np.cos(angle), 0.1 * np.sin(angle), 0.995 * np.sin(angle)])
    velocity = 7508.0 * np.column_stack([-np.sin(angle), 0.1 * np.cos(angle), 0.995 * np.cos(angle)])
    table = environment_table("2024-03-01T00:00:00Z", times, position, velocity, 1.0, 7.292115e-5)
    inputs = np.column_stack([np.asarray(table[n]).reshape(len(times), s) for n, s in ENVIRONMENT.items()])
    assert inputs.shape[1] == ENVIRONMENT_ROWS
    chosen = [f.instances(layout)[0] for f in load().values() if f.instances(layout)]
    chosen = [e for e in chosen if e.channel in ("torque", "command")]
    assert len(chosen) >= 5
    # All effects at once are a large kernel: interpreted here, compiling it would take a minute.
    monkeypatch.setattr("estimator.propagation.compiled", lambda function: function)
    flow = rotation_flow.__wrapped__(True, tuple(chosen), TRACE, 1)
    values = {"attitude:a": START[0], "rate:a": START[1], INERTIA.name: ENTRIES, "inertia_trace": np.array([TRACE]),
              ACTUATOR.name: MOUNT}
    scales = {}
    for e in chosen:
        values[e.name] = np.array([p.search.middle() if p.search else 0.2 * p.scale
                                   for p in e.parameters])
        scales[e.name] = np.array([p.scale for p in e.parameters])
    starts = (Unknown("attitude:a", UnitQuaternion(), "rad", 0.1), Unknown("rate:a", Vector(3), "rad/s", 0.01))
    signal = PropagatedSignal("state", flow, starts, times, inputs, np.tile(TORQUE, (120, 1)), np.arange(121))
    jacobian = signal.evaluate(values)[1]
    symbols = {name: ca.MX.sym(name, len(value)) for name, value in values.items()}
    curve = ca.Function("curve", list(symbols.values()), [signal.symbolic(symbols)[:4, :]])
    tangents = [u.manifold.tangent for u in signal.unknowns]
    for u, first in zip(signal.unknowns, np.cumsum([0, *tangents[:-1]]), strict=True):
        if u.name not in scales:
            continue
        for k in range(u.manifold.tangent):
            h = 1e-3 * min(scales[u.name][k], abs(values[u.name][k]) or np.inf)
            sides = []
            for sign in (1, -1):
                step = np.zeros(u.manifold.tangent)
                step[k] = sign * h
                sides.append(np.asarray(curve(*{**values, u.name: values[u.name] + step}.values())).T)
            turn = (Rotation.from_quat(sides[0], scalar_first=True)
                    * Rotation.from_quat(sides[1], scalar_first=True).inv())
            expected = turn.as_rotvec() / (2 * h)
            limit = 1e-4 * np.max(np.abs(expected)) + 3e-15 / h  # truncation of the difference, and rounding
            np.testing.assert_allclose(jacobian[:, :3, first + k], expected, atol=limit, rtol=0,
                                       err_msg=f"{u.name} parameter {k}")
