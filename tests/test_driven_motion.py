"""First-order motion under effects that are not in the equation of motion, against the equation that has them."""

import numpy as np
import pytest

from estimator.driven_motion import DrivenSignal
from estimator.propagation import PropagatedSignal
from estimator.unknowns import UnitQuaternion, Unknown, Vector
from problems.alignment.kernels import ACTUATOR, INERTIA, rotation_drive, rotation_flow, substeps_of

TRACE = 2300.0  # kg m2
ENTRIES = np.array([0.35, 0.26, 0.39, 0.01, -0.02, 0.015])
TORQUE = np.array([0.3, -0.2, 0.1])  # N m


def arc():
    """Times (s), environment and commanded torque of an arc with two switches of the torque."""
    from estimator.effects.declaration import ENVIRONMENT
    from estimator.models.environment import environment_table

    times = np.linspace(0.0, 90.0, 181)
    angle = 7508.0 / 7071e3 * times
    position = 7071e3 * np.column_stack([np.cos(angle), 0.1 * np.sin(angle), 0.995 * np.sin(angle)])
    velocity = 7508.0 * np.column_stack([-np.sin(angle), 0.1 * np.cos(angle), 0.995 * np.cos(angle)])
    table = environment_table("2024-03-01T00:00:00Z", times, position, velocity, 1.0, 7.292115e-5)
    inputs = np.column_stack([np.asarray(table[n]).reshape(len(times), s) for n, s in ENVIRONMENT.items()])
    held = np.zeros((180, 3))
    held[20:80], held[80:120] = TORQUE, -TORQUE
    return times, inputs, held


def turning_effects():
    from estimator.effects.declaration import Layout
    from estimator.effects.library import load

    layout = Layout(3, ((0.0, 60.0),), (0.0, 3600.0), 5900.0, (0.0, 3600.0))
    found = [e for f in load().values() for e in f.instances(layout) if e.channel in ("torque", "command")]
    assert len(found) >= 10
    return found


STARTS = (Unknown("attitude:a", UnitQuaternion(), "rad", 0.1), Unknown("rate:a", Vector(3), "rad/s", 0.01))


def values_of(effects):
    values = {"attitude:a": np.array([0.5, -0.5, 0.5, 0.5]), "rate:a": np.array([0.006, -0.009, 0.012]),
              INERTIA.name: ENTRIES / ENTRIES[:3].sum(), "inertia_trace": np.array([TRACE]),
              ACTUATOR.name: np.array([0.99, 0.05, -0.03, 0.02]) / np.linalg.norm([0.99, 0.05, -0.03, 0.02])}
    for e in effects:
        values[e.name] = np.array([p.search.middle() if p.search else 0.0 for p in e.parameters])
    return values


@pytest.mark.parametrize("commanded", [False, True], ids=["free", "commanded"])
def test_derivatives_are_those_of_the_equation_with_the_effect(commanded, monkeypatch):
    """Both at zero parameters; the drive takes no sensitivities of its own, the equation propagates all of them."""
    monkeypatch.setattr("estimator.propagation.compiled", lambda function: function)
    times, inputs, held = arc()
    held = held if commanded else np.zeros((180, 0))
    index = np.arange(0, 181, 5)
    for e in turning_effects():
        if e.channel == "command" and not commanded:
            continue
        substeps = substeps_of((e,), 0.5)
        assert substeps == (1 if not np.isfinite(e.resolution) else round(0.5 / e.resolution))
        flow = rotation_flow.__wrapped__(commanded, (e,), TRACE, substeps)
        exact = PropagatedSignal("state", flow, STARTS, times, inputs, held, index)
        bare = PropagatedSignal("state", rotation_flow(commanded, (), TRACE, 1), STARTS, times, np.zeros((181, 0)),
                                held, index)
        searched = np.array([p.search is not None for p in e.parameters])
        driven = DrivenSignal(bare, (rotation_drive(commanded, e, TRACE, substeps),), (searched,), inputs)
        values = values_of([e])
        states, jacobian = driven.evaluate(values)
        expected, full = exact.evaluate(values)
        np.testing.assert_allclose(states, expected[:, :7], atol=2e-12)
        for u in (*exact.unknowns,):
            there = sum(v.manifold.tangent for v in exact.unknowns[: exact.unknowns.index(u)])
            here = sum(v.manifold.tangent for v in driven.unknowns[: driven.unknowns.index(u)])
            width = u.manifold.tangent
            a, b = jacobian[:, :, here : here + width], full[:, :6, there : there + width]
            for k in range(width):
                # The drive takes the transition matrix as linear inside a step: 1e-4 of the largest change.
                tolerance = 2e-4 * float(np.max(np.abs(b[:, :3, k]))) + 1e-16
                np.testing.assert_allclose(a[:, :3, k], b[:, :3, k], atol=tolerance, rtol=0,
                                               err_msg=f"{e.name} {u.name} {k}")


def test_small_parameters_move_the_state_to_first_order():
    times, inputs, held = arc()
    e = next(e for e in turning_effects() if e.name == "constant-body-torque")
    bare = PropagatedSignal("state", rotation_flow(True, (), TRACE, 1), STARTS, times, np.zeros((181, 0)), held,
                            np.arange(181))
    driven = DrivenSignal(bare, (rotation_drive(True, e, TRACE, 1),), (np.zeros(3, dtype=bool),), inputs)
    values = values_of([e])
    states, jacobian = driven.evaluate(values)
    size = np.array([2e-6, -1e-6, 3e-6])  # N m
    moved, same = driven.evaluate({**values, e.name: size})
    np.testing.assert_array_equal(same, jacobian)
    first = sum(u.manifold.tangent for u in driven.unknowns[: driven.unknowns.index(
        next(u for u in driven.unknowns if u.name == e.name))])
    np.testing.assert_allclose(moved[:, 4:], states[:, 4:] + (jacobian[:, 3:, first : first + 3] @ size), atol=1e-15)
    assert 1e-8 < np.max(np.abs(moved - states)) < 1e-4
    keep = np.arange(181) % 9 == 0
    np.testing.assert_array_equal(driven.subset(keep).evaluate(values)[1], jacobian[keep])


def test_beside_a_mode_the_derivative_is_off_by_the_ratio_of_the_inertias():
    times, inputs, held = arc()
    mode = next(e for e in turning_effects() if e.name == "flexible-appendage")
    other = next(e for e in turning_effects() if e.name == "constant-body-torque")
    flow = rotation_flow.__wrapped__(True, (mode,), TRACE, 4)
    signal = PropagatedSignal("state", flow, STARTS, times, inputs, held, np.arange(181))
    driven = DrivenSignal(signal, (rotation_drive(True, other, TRACE, 1),), (np.zeros(3, dtype=bool),), inputs)
    both = rotation_flow.__wrapped__(True, (other, mode), TRACE, 4)
    exact = PropagatedSignal("state", both, STARTS, times, inputs, held, np.arange(181))
    values = values_of([mode, other])
    ratio = 0.03
    values[mode.name][:6] = ratio * 800.0 * np.array([1.0, 0.5, 0.8, 0.0, 0.0, 0.0])  # kg m2
    found, expected = driven.evaluate(values)[1], exact.evaluate(values)[1]
    here, there = (sum(u.manifold.tangent for u in unknowns[: [u.name for u in unknowns].index(other.name)])
                   for unknowns in (driven.unknowns, exact.unknowns))
    a, b = found[:, :3, here : here + 3], expected[:, :3, there : there + 3]
    assert np.linalg.norm(a - b) < 2 * ratio * np.linalg.norm(b)
