"""A state carried along an arc by its equation of motion, with its derivatives along the unknowns.

The state and its sensitivities are advanced together by one compiled step function (fourth-order Runge-Kutta whose
right side is differentiated once, symbolically), accumulated over the nodes of the arc. Nothing is integrated
again per unknown, and nothing longer than a step is ever differentiated.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import casadi as ca
import numpy as np

from estimator.models.compiled import compiled
from estimator.models.loops import Stepped
from estimator.signals import Values
from estimator.unknowns import Manifold, UnitQuaternion, Unknown


@dataclass(frozen=True)
class Product:
    """A manifold made of others, their coordinates stacked."""

    parts: tuple[Manifold, ...]

    @property
    def ambient(self) -> int:
        return sum(p.ambient for p in self.parts)

    @property
    def tangent(self) -> int:
        return sum(p.tangent for p in self.parts)

    def _split(self, x: ca.SX, sizes: Sequence[int]) -> list[ca.SX]:
        ends = np.cumsum([0, *sizes])
        return [x[int(a) : int(b)] for a, b in pairwise(ends)]

    def retract(self, point: ca.SX, step: ca.SX) -> ca.SX:
        points = self._split(point, [p.ambient for p in self.parts])
        steps = self._split(step, [p.tangent for p in self.parts])
        return ca.vertcat(*(m.retract(x, d) for m, x, d in zip(self.parts, points, steps, strict=True)))

    def local(self, point: np.ndarray, other: np.ndarray) -> np.ndarray:
        pieces, a = [], 0
        for m in self.parts:
            pieces.append(m.local(point[a : a + m.ambient], other[a : a + m.ambient]))
            a += m.ambient
        return np.concatenate(pieces)

    def labels(self) -> tuple[str, ...]:
        return tuple(label for m in self.parts for label in m.labels())


def tangent_maps(manifold: Manifold, points: np.ndarray) -> np.ndarray:
    """Matrices (n, tangent, ambient) that take small ambient changes at ``points`` (n, ambient) to tangent coordinates.

    For vectors the identity. For unit quaternions twice the vector part of ``change o conjugate(point)``: a change
    along the quaternion itself is none.
    """
    n = len(points)
    result = np.zeros((n, manifold.tangent, manifold.ambient))
    row = column = 0
    for part in manifold.parts if isinstance(manifold, Product) else (manifold,):
        block = result[:, row : row + part.tangent, column : column + part.ambient]
        if isinstance(part, UnitQuaternion):
            w, x, y, z = (2 * points[:, column + i] for i in range(4))
            block[:] = np.stack([np.stack([-x, w, -z, y], -1), np.stack([-y, z, w, -x], -1),
                                 np.stack([-z, -y, x, w], -1)], 1)
        else:
            block[:] = np.eye(part.tangent)
        row += part.tangent
        column += part.ambient
    return result


class Flow:
    """The compiled step of an equation of motion, with sensitivities.

    One classical Runge-Kutta step is differentiated exactly: the right side and its Jacobians along the state and the
    unknowns are one function of small inputs, evaluated at the four stages, and the sensitivities are advanced by the
    same combination of stages as the state.

    Args:
        name: a C identifier.
        state: (name, manifold) of each part of the state; vectors and unit quaternions.
        initial: which parts start at an unknown of the arc; the others start at zero and are not estimated.
        shared: unknowns in the equation of motion, common to all arcs.
        inputs: number of per-node inputs that are interpolated linearly inside a step (the environment).
        held: number of per-step inputs that are constant inside a step (the commanded torque).
        derivative: ``(state dict, shared dict, inputs, held, step, fraction) -> ambient derivative`` as SX; ``step``
            is the length of the Runge-Kutta step (s) and ``fraction`` the stage's place in it (0, 1/2, 1).
        substeps: Runge-Kutta steps inside each step, for modes that are fast against the sampling.
    """

    def __init__(self, name: str, state: Sequence[tuple[str, Manifold]], initial: Sequence[str],
                 shared: Sequence[Unknown], inputs: int, held: int,
                 derivative: Callable[[dict[str, ca.SX], dict[str, ca.SX], ca.SX, ca.SX, ca.SX, ca.SX], ca.SX],
                 substeps: int = 1):
        self.state = tuple(state)
        self.manifold = Product(tuple(m for _, m in state))
        self.initial, self.shared = tuple(initial), tuple(shared)
        self._starts = {}
        column = row = 0
        for label, m in self.state:
            if label in self.initial:
                self._starts[label] = (column, row)
                column += m.tangent
            row += m.ambient
        self.initial_columns = column
        self.columns = column + int(sum(u.manifold.tangent for u in shared))
        self._name, self._sizes, self._substeps = name, (inputs, held), substeps
        self._derivative = derivative

    @cached_property
    def _evaluated(self) -> ca.Function:
        return self._right_side(f"{self._name}_right_side", *self._sizes, self._derivative)

    @cached_property
    def step(self) -> ca.Function:
        """One compiled step of the state and its sensitivities."""
        return compiled(self._step(f"{self._name}_sensitivity", self._evaluated, *self._sizes, self._substeps, True))

    @cached_property
    def _stepped(self) -> Stepped:
        return Stepped(self.step, 2, [f"p{i}" for i in range(len(self.shared))])

    @cached_property
    def plain(self) -> ca.Function:
        """One step of the state for solvers that differentiate by themselves: one list of scalar operations."""
        return self._step(self._name, self._evaluated, *self._sizes, self._substeps, False).expand()

    def _right_side(self, name: str, inputs: int, held: int, derivative: Callable[..., ca.SX]) -> ca.Function:
        """``(x, shared..., u, held, step, fraction) -> (x', dx'/dx, dx'/d(shared tangents))``."""
        x = ca.SX.sym("x", self.manifold.ambient)
        points = [ca.SX.sym("p", u.manifold.ambient) for u in self.shared]
        steps = [ca.SX.sym("d", u.manifold.tangent) for u in self.shared]
        u, h = ca.SX.sym("u", inputs), ca.SX.sym("h", held)
        step, fraction = ca.SX.sym("dt"), ca.SX.sym("f")
        parts, a = {}, 0
        for label, m in self.state:
            parts[label] = x[a : a + m.ambient]
            a += m.ambient

        def rate(moved: bool) -> ca.SX:
            theta = {k.name: k.manifold.retract(p, d) if moved else p
                     for k, p, d in zip(self.shared, points, steps, strict=True)}
            return derivative(parts, theta, u, h, step, fraction)

        plain = ca.densify(rate(False))
        slopes = ca.SX(self.manifold.ambient, 0)
        if steps:
            directions = ca.vertcat(*steps)
            slopes = ca.substitute(ca.jacobian(rate(True), directions), directions, ca.SX.zeros(directions.shape))
        # Dense outputs: CasADi then writes plain loops for the products with the sensitivities.
        outputs = [plain, ca.densify(ca.jacobian(plain, x)), ca.densify(slopes)]
        return ca.Function(name, [x, *points, u, h, step, fraction], outputs)

    def _step(self, name: str, right_side: ca.Function, inputs: int, held: int, substeps: int,
              sensitive: bool) -> ca.Function:
        x0 = ca.MX.sym("x", self.manifold.ambient)
        s0 = ca.MX.sym("S", self.manifold.ambient, self.columns)
        points = [ca.MX.sym("p", u.manifold.ambient) for u in self.shared]
        u0, u1, h = ca.MX.sym("u0", inputs), ca.MX.sym("u1", inputs), ca.MX.sym("h", held)
        duration = ca.MX.sym("dt")
        dt = duration / substeps
        unforced = ca.MX(self.manifold.ambient, self.initial_columns)

        def stage(x: ca.MX, s: ca.MX, within: float, fraction: float) -> tuple[ca.MX, ca.MX]:
            f, along_state, along_shared = right_side.call([x, *points, u0 + within * (u1 - u0), h, dt,
                                                            ca.MX(fraction)])
            return f, ca.mtimes(along_state, s) + ca.horzcat(unforced, along_shared) if sensitive else s

        x, s = x0, s0
        for k in range(substeps):
            f0, fm, f1 = k / substeps, (k + 0.5) / substeps, (k + 1) / substeps
            k1, g1 = stage(x, s, f0, 0.0)
            k2, g2 = stage(x + dt / 2 * k1, s + dt / 2 * g1 if sensitive else s, fm, 0.5)
            k3, g3 = stage(x + dt / 2 * k2, s + dt / 2 * g2 if sensitive else s, fm, 0.5)
            k4, g4 = stage(x + dt * k3, s + dt * g3 if sensitive else s, f1, 1.0)
            x = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            if sensitive:
                s = s + dt / 6 * (g1 + 2 * g2 + 2 * g3 + g4)
        pieces, a = [], 0
        for _, m in self.state:
            piece = x[a : a + m.ambient]
            pieces.append(piece / ca.sqrt(ca.sumsqr(piece)) if isinstance(m, UnitQuaternion) else piece)
            a += m.ambient
        after = ca.densify(ca.vertcat(*pieces))
        shared_names = [f"p{i}" for i in range(len(points))]
        if not sensitive:
            return ca.Function(name, [x0, *points, u0, u1, h, duration], [after],
                               ["x", *shared_names, "u0", "u1", "held", "dt"], ["x_next"])
        return ca.Function(name, [x0, s0, *points, u0, u1, h, duration], [after, ca.densify(s)],
                           ["x", "S", *shared_names, "u0", "u1", "held", "dt"], ["x_next", "S_next"])

    def initial_sensitivity(self, x0: np.ndarray) -> np.ndarray:
        """Sensitivity (ambient, columns) of the state ``x0`` at the start of the arc to the arc's own unknowns."""
        start = np.zeros((self.manifold.ambient, self.columns))
        for label, m in self.state:
            if label in self._starts:
                column, row = self._starts[label]
                block = start[row : row + m.ambient, column : column + m.tangent]
                if isinstance(m, UnitQuaternion):
                    block[:] = tangent_maps(m, x0[None, row : row + 4])[0].T / 4
                else:
                    block[:] = np.eye(m.tangent)
        return start

    def propagate(self, x0: np.ndarray, shared: Sequence[np.ndarray], inputs: np.ndarray, held: np.ndarray,
                  time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States (nodes, ambient) and sensitivities (nodes, ambient, columns) at the nodes ``time``."""
        given = {f"p{i}": p for i, p in enumerate(shared)}
        given |= {"u0": inputs[:-1], "u1": inputs[1:], "held": held, "dt": np.diff(time)}
        states, sensitivities = self._stepped(len(time) - 1, [x0, self.initial_sensitivity(x0)], given)
        shape = (len(time), self.columns, self.manifold.ambient)
        return states, sensitivities.reshape(shape).transpose(0, 2, 1)


@dataclass(frozen=True, eq=False)
class PropagatedSignal:
    """The state of one arc at the times of its samples.

    Attributes:
        name: the kernel input that it feeds.
        flow: the compiled equation of motion.
        starts: the unknowns of the arc that hold the initial parts, in the flow's order.
        node_time: (nodes,) s; the first is the start of the arc.
        inputs: (nodes, inputs) environment at the nodes.
        held: (nodes - 1, held) constants of each step.
        sample_nodes: (n,) node of each sample.
    """

    name: str
    flow: Flow
    starts: tuple[Unknown, ...]
    node_time: np.ndarray
    inputs: np.ndarray
    held: np.ndarray
    sample_nodes: np.ndarray
    _last: dict[str, tuple[bytes, tuple[np.ndarray, np.ndarray]]] = field(default_factory=dict, repr=False)

    @property
    def manifold(self) -> Manifold:
        return self.flow.manifold

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        return (*self.starts, *self.flow.shared)

    def initial_state(self, values: Values) -> np.ndarray:
        """Ambient state (ambient,) at the start of the arc."""
        pieces = []
        given = dict(zip(self.flow.initial, self.starts, strict=True))
        for label, m in self.flow.state:
            pieces.append(np.asarray(values[given[label].name]) if label in given else np.zeros(m.ambient))
        return np.concatenate(pieces)

    def key(self, values: Values) -> bytes:
        """Tells whether two sets of values give the same arc."""
        start = self.initial_state(values)
        return b"".join([start.tobytes(), *(np.asarray(values[u.name], float).tobytes() for u in self.flow.shared)])

    @property
    def nodes(self) -> int:
        """Number of nodes up to the last sample."""
        return int(self.sample_nodes[-1]) + 1 if len(self.sample_nodes) else 1

    def at_nodes(self, values: Values) -> tuple[np.ndarray, np.ndarray]:
        """States (nodes, ambient) and Jacobians (nodes, tangent, columns) at all nodes up to the last sample."""
        states, sensitivities = self._propagated(values)
        return states, tangent_maps(self.manifold, states) @ sensitivities

    def _propagated(self, values: Values) -> tuple[np.ndarray, np.ndarray]:
        shared = [np.asarray(values[u.name], dtype=float) for u in self.flow.shared]
        last = self.nodes
        return self.flow.propagate(self.initial_state(values), shared, self.inputs[:last], self.held[: last - 1],
                                   self.node_time[:last])

    def evaluate(self, values: Values) -> tuple[np.ndarray, np.ndarray]:
        # Solvers ask again at the point where they were; the last answer is kept.
        key = self.key(values)
        if self._last.get("answer", (b"",))[0] != key:
            states, sensitivities = (a[self.sample_nodes] for a in self._propagated(values))
            self._last["answer"] = key, (states, tangent_maps(self.manifold, states) @ sensitivities)
        return self._last["answer"][1]

    def symbolic(self, values: Mapping[str, ca.MX]) -> ca.MX:
        steps = len(self.node_time) - 1
        pieces = []
        given = dict(zip(self.flow.initial, self.starts, strict=True))
        for label, m in self.flow.state:
            pieces.append(values[given[label].name] if label in given else ca.MX.zeros(m.ambient))
        x0 = ca.vertcat(*pieces)
        accumulated = self.flow.plain.mapaccum("arc", steps, ["x"], ["x_next"])
        shared = [ca.repmat(values[u.name], 1, steps) for u in self.flow.shared]
        after = accumulated.call([x0, *shared, ca.DM(self.inputs[:-1].T), ca.DM(self.inputs[1:].T),
                                  ca.DM(self.held.T), ca.DM(np.diff(self.node_time)[None, :])])[0]
        return ca.horzcat(x0, after)[:, [int(i) for i in self.sample_nodes]]

    def subset(self, keep: np.ndarray) -> PropagatedSignal:
        return replace(self, sample_nodes=self.sample_nodes[keep], _last={})
