"""A state carried along an arc by its equation of motion, with its derivatives along the unknowns.

The state and its sensitivities are advanced together by one compiled step function (fourth-order Runge-Kutta whose
derivative is taken once, symbolically, for ONE step), accumulated over the nodes of the arc. Nothing is integrated
again per unknown, and nothing longer than a step is ever differentiated.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from estimator.models.compiled import compiled
from estimator.signals import Values
from estimator.unknowns import Manifold, Unknown


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
        return [x[int(a) : int(b)] for a, b in zip(ends[:-1], ends[1:], strict=True)]

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


def _tangent_map(manifold: Manifold, point: ca.SX) -> ca.SX:
    """Matrix (tangent, ambient) that takes a small ambient change at ``point`` to tangent coordinates.

    It is the pseudo-inverse of the Jacobian of the retraction, which has orthogonal columns of equal length for
    vectors (1) and unit quaternions (1/2).
    """
    if isinstance(manifold, Product):
        rows, a = [], 0
        for part in manifold.parts:
            rows.append(_tangent_map(part, point[a : a + part.ambient]))
            a += part.ambient
        return ca.diagcat(*rows)
    step = ca.SX.sym("d", manifold.tangent)
    forward = ca.substitute(ca.jacobian(manifold.retract(point, step), step), step, ca.SX.zeros(manifold.tangent))
    return 4 * forward.T if manifold.ambient == 4 else forward.T


class Flow:
    """The compiled step of an equation of motion, with sensitivities.

    Args:
        name: a C identifier.
        state: (name, manifold) of each part of the state.
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
                 derivative: Callable[[dict[str, ca.SX], dict[str, ca.SX], ca.SX, ca.SX, ca.SX, float], ca.SX],
                 substeps: int = 1):
        self.state = tuple(state)
        self.manifold = Product(tuple(m for _, m in state))
        self.initial, self.shared = tuple(initial), tuple(shared)
        x = ca.SX.sym("x", self.manifold.ambient)
        shared_points = [ca.SX.sym("s", u.manifold.ambient) for u in shared]
        u0, u1, held_symbol = ca.SX.sym("u0", inputs), ca.SX.sym("u1", inputs), ca.SX.sym("h", held)
        duration = ca.SX.sym("dt")
        d_state = ca.SX.sym("ds", self.manifold.tangent)
        d_shared = [ca.SX.sym("dp", u.manifold.tangent) for u in shared]

        def rate(point: ca.SX, within: float, stage: float, theta: dict[str, ca.SX]) -> ca.SX:
            parts = {}
            a = 0
            for label, m in self.state:
                parts[label] = point[a : a + m.ambient]
                a += m.ambient
            return derivative(parts, theta, u0 + within * (u1 - u0), held_symbol, duration / substeps, stage)

        def advance(point: ca.SX, theta: dict[str, ca.SX]) -> ca.SX:
            h = duration / substeps
            for k in range(substeps):
                f0, fm, f1 = k / substeps, (k + 0.5) / substeps, (k + 1) / substeps
                k1 = rate(point, f0, 0.0, theta)
                k2 = rate(point + h / 2 * k1, fm, 0.5, theta)
                k3 = rate(point + h / 2 * k2, fm, 0.5, theta)
                k4 = rate(point + h * k3, f1, 1.0, theta)
                point = point + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            a, pieces = 0, []
            for _, m in self.state:
                piece = point[a : a + m.ambient]
                pieces.append(piece / ca.sqrt(ca.sumsqr(piece)) if m.ambient == 4 and m.tangent == 3 else piece)
                a += m.ambient
            return ca.vertcat(*pieces)

        theta = {u.name: p for u, p in zip(shared, shared_points, strict=True)}
        theta_moved = {u.name: u.manifold.retract(p, d)
                       for u, p, d in zip(shared, shared_points, d_shared, strict=True)}
        after = advance(x, theta)
        moved = advance(self.manifold.retract(x, d_state), theta_moved)
        directions = ca.vertcat(d_state, *d_shared)
        ambient_jacobian = ca.substitute(ca.jacobian(moved, directions), directions, ca.SX.zeros(directions.shape))
        local = ca.mtimes(_tangent_map(self.manifold, after), ambient_jacobian)
        t = self.manifold.tangent
        self._starts = {}
        columns = 0
        a = 0
        for label, m in self.state:
            if label in self.initial:
                self._starts[label] = (columns, a)
                columns += m.tangent
            a += m.tangent
        self.initial_columns = columns
        shared_columns = int(sum(u.manifold.tangent for u in shared))
        self.columns = columns + shared_columns
        sensitivity = ca.SX.sym("S", t, self.columns)
        forced = ca.horzcat(ca.SX.zeros(t, columns), local[:, t:])
        next_sensitivity = ca.densify(ca.mtimes(local[:, :t], sensitivity) + forced)
        arguments = [x, sensitivity, *shared_points, u0, u1, held_symbol, duration]
        names = ["x", "S", *(f"p{i}" for i in range(len(shared))), "u0", "u1", "held", "dt"]
        self.step = compiled(ca.Function(f"{name}_sensitivity", arguments, [ca.densify(after), next_sensitivity], names,
                                         ["x_next", "S_next"]))
        self.plain = compiled(ca.Function(name, [x, *shared_points, u0, u1, held_symbol, duration],
                                          [ca.densify(after)], ["x", *names[2:]], ["x_next"]))
        self._accumulated: dict[int, ca.Function] = {}

    def initial_sensitivity(self) -> np.ndarray:
        """Sensitivity (tangent, columns) of the state at the start of the arc."""
        start = np.zeros((self.manifold.tangent, self.columns))
        for label, m in self.state:
            if label in self._starts:
                column, row = self._starts[label]
                start[row : row + m.tangent, column : column + m.tangent] = np.eye(m.tangent)
        return start

    def propagate(self, x0: np.ndarray, shared: Sequence[np.ndarray], inputs: np.ndarray, held: np.ndarray,
                  time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States (nodes, ambient) and sensitivities (nodes, tangent, columns) at the nodes ``time``."""
        steps = len(time) - 1
        sensitivity0 = self.initial_sensitivity()
        states = np.empty((steps + 1, self.manifold.ambient))
        sensitivities = np.empty((steps + 1, self.manifold.tangent, self.columns))
        states[0], sensitivities[0] = x0, sensitivity0
        if steps == 0:
            return states, sensitivities
        if steps not in self._accumulated:
            if len(self._accumulated) > 16:
                self._accumulated.clear()
            self._accumulated[steps] = self.step.mapaccum("arc", steps, ["x", "S"], ["x_next", "S_next"])
        function = self._accumulated[steps]
        buffer, trigger = function.buffer()
        tiled = [np.ascontiguousarray(np.broadcast_to(np.asarray(p, dtype=float), (steps, len(p)))) for p in shared]
        arguments = [np.ascontiguousarray(x0, dtype=float), np.ascontiguousarray(sensitivity0.T), *tiled,
                     np.ascontiguousarray(inputs[:-1]), np.ascontiguousarray(inputs[1:]), np.ascontiguousarray(held),
                     np.ascontiguousarray(np.diff(time))]
        for i, argument in enumerate(arguments):
            buffer.set_arg(i, memoryview(argument) if argument.size else memoryview(np.zeros(1)))
        out_x = np.zeros((steps, self.manifold.ambient))
        out_s = np.zeros((steps, self.columns, self.manifold.tangent))
        buffer.set_res(0, memoryview(out_x))
        buffer.set_res(1, memoryview(out_s))
        trigger()
        states[1:] = out_x
        sensitivities[1:] = out_s.transpose(0, 2, 1)
        return states, sensitivities


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

    def evaluate(self, values: Values) -> tuple[np.ndarray, np.ndarray]:
        last = int(self.sample_nodes[-1]) + 1 if len(self.sample_nodes) else 1
        states, sensitivities = self.flow.propagate(
            self.initial_state(values), [values[u.name] for u in self.flow.shared],
            self.inputs[:last], self.held[: last - 1], self.node_time[:last],
        )
        return states[self.sample_nodes], sensitivities[self.sample_nodes]

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
        return replace(self, sample_nodes=self.sample_nodes[keep])
