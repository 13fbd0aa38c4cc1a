"""Kernels in loops of C against the same kernels interpreted and against a plain loop of Python."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from estimator.models.compiled import compiled, compiler, library_of
from estimator.models.loops import Mapped, NativeLoop, Stepped

DRAW = np.random.default_rng(4)


def step_function() -> ca.Function:
    """A state and a matrix that are carried along, a shared matrix, a value per step, nothing, and one more output."""
    x, s, p = ca.MX.sym("x", 3), ca.MX.sym("S", 3, 2), ca.MX.sym("p", 3, 3)
    u, none = ca.MX.sym("u", 2), ca.MX.sym("none", 0)
    after = ca.sin(ca.mtimes(p, x)) + u[0]
    return ca.Function("carry", [x, s, p, u, none], [after, ca.mtimes(p, s) * u[1], ca.vertcat(x[0] * u[1], after[2])],
                       ["x", "S", "p", "u", "none"], ["x_next", "S_next", "seen"])


@pytest.mark.parametrize("native", [True, False])
def test_steps_are_those_of_a_plain_loop(native: bool):
    if native and compiler() is None:
        pytest.skip("this machine has no C compiler")
    function = compiled(step_function()) if native else step_function()
    assert (library_of(function) is not None) is native and (NativeLoop.of(function) is not None) is native
    x, s, p, u = DRAW.normal(size=3), DRAW.normal(size=(3, 2)), DRAW.normal(size=(3, 3)), DRAW.normal(size=(7, 2))
    given = {"p": p.T, "u": u, "none": np.zeros((7, 0))}  # blocks column by column
    stepped = Stepped(function, 2, ["p"])
    states, carried, seen = stepped(7, [x, s], given)
    assert states.shape == (8, 3) and carried.shape == (8, 2, 3) and seen.shape == (7, 2)
    np.testing.assert_array_equal(states[0], x)
    np.testing.assert_array_equal(carried[0], s.T)
    for k in range(7):
        after, block = np.sin(p @ states[k]) + u[k, 0], p @ carried[k].T * u[k, 1]
        np.testing.assert_allclose(states[k + 1], after, rtol=1e-13)
        np.testing.assert_allclose(carried[k + 1], block.T, rtol=1e-12)
        np.testing.assert_allclose(seen[k], [states[k, 0] * u[k, 1], after[2]], rtol=1e-13)
    short = stepped(0, [x, s], {"p": p.T, "u": u[:0], "none": np.zeros((0, 0))})
    assert [r.shape for r in short] == [(1, 3), (1, 2, 3), (0, 2)]


@pytest.mark.parametrize("native", [True, False])
def test_map_takes_blocks_and_views(native: bool):
    if native and compiler() is None:
        pytest.skip("this machine has no C compiler")
    a, b, c = ca.SX.sym("a", 2, 3), ca.SX.sym("b", 3), ca.SX.sym("c")
    kernel = ca.Function("product", [a, b, c], [ca.mtimes(a, b) * c, a * c], ["a", "b", "c"], ["v", "m"])
    mapped = Mapped(compiled(kernel) if native else kernel, ("b",))
    blocks, vector = DRAW.normal(size=(5, 3, 2)).transpose(0, 2, 1), DRAW.normal(size=3)
    factor = DRAW.normal(size=(9, 1))
    vectors, matrices = mapped(5, a=blocks, b=vector, c=factor[::2])
    np.testing.assert_allclose(vectors, blocks @ vector * factor[::2], rtol=1e-14)
    np.testing.assert_allclose(matrices, blocks * factor[::2, :, None], rtol=1e-14)
    assert [r.shape for r in mapped(0, a=blocks[:0], b=vector, c=factor[:0])] == [(0, 2), (0, 2, 3)]


def test_outputs_with_structural_zeros_are_made_dense():
    x = ca.SX.sym("x", 2)
    kernel = compiled(ca.Function("diagonal", [x], [ca.diag(x)], ["x"], ["d"]))
    assert NativeLoop.of(kernel) is None
    np.testing.assert_array_equal(Mapped(kernel)(2, x=np.array([[1.0, 2.0], [3.0, 4.0]]))[0],
                                  [[[1, 0], [0, 2]], [[3, 0], [0, 4]]])
