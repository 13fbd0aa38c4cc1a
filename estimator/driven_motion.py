"""What an effect that is not in the equation of motion would do to an arc, to first order in its parameters.

A torque that is zero leaves the motion as it is: the internal states of its effect (a mode, a lag) then only follow
the motion of the arc, and what a small parameter changes is the solution of the arc's own linearized equation with the
derivative of the effect as its drive. With ``Phi`` the transition matrix of the arc, which the propagation of the
plain model gives anyway, that is a sum along the arc,

    change(t) = Phi(t) * integral of Phi(s)^-1 B(s) ds,

``B`` being the derivative of the right side along the parameters. One small kernel per effect is compiled, for
any combination of effects in the model, and a mode is tried at another frequency for the price of its own few states.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np

from estimator.models.compiled import compiled
from estimator.models.loops import Mapped, Stepped
from estimator.propagation import Product, PropagatedSignal, tangent_maps
from estimator.signals import Values
from estimator.unknowns import Manifold, UnitQuaternion, Unknown

RightSide = Callable[[dict[str, ca.SX], dict[str, ca.SX], ca.SX, ca.SX, ca.SX, ca.SX], ca.SX]


class Drive:
    """The derivative of an equation of motion along the parameters of an effect, over the steps of an arc.

    Args:
        name: a C identifier.
        state: (name, manifold) of the parts of the state, those of the arc without the effect first, then the internal
            states of the effect (vectors).
        outer: number of parts that the arc has without the effect.
        shared: unknowns of the equation without the effect.
        effect: the unknown of the effect's parameters.
        inputs, held: sizes of the per-node and per-step inputs, as in :class:`estimator.propagation.Flow`.
        derivative: right side with the effect in it, as in :class:`estimator.propagation.Flow`.
        substeps: Runge-Kutta steps inside each step, for modes that are fast against the nodes.
    """

    def __init__(self, name: str, state: Sequence[tuple[str, Manifold]], outer: int, shared: Sequence[Unknown],
                 effect: Unknown, inputs: int, held: int, derivative: RightSide, substeps: int = 1):
        self.state, self.effect, self.shared = tuple(state), effect, tuple(shared)
        self.outer = Product(tuple(m for _, m in self.state[:outer]))
        self.internal = sum(m.ambient for _, m in self.state[outer:])
        self.parameters = effect.manifold.tangent
        function = compiled(self._step(name, inputs, held, derivative, substeps))
        same = (*(f"p{i}" for i in range(len(shared))), "p")  # for all steps of an arc
        self._mapped = None if self.internal else Mapped(function, same)
        self._stepped = Stepped(function, 1, same) if self.internal else None

    def _stage(self, name: str, inputs: int, held: int, derivative: RightSide) -> ca.Function:
        """``(outer state, internal state, shared, p, u, held, step, fraction) -> (B, internal derivative)``."""
        x, z = ca.SX.sym("x", self.outer.ambient), ca.SX.sym("z", self.internal)
        points = [ca.SX.sym("q", u.manifold.ambient) for u in self.shared]
        p = ca.SX.sym("p", self.parameters)
        u, h, step, fraction = ca.SX.sym("u", inputs), ca.SX.sym("h", held), ca.SX.sym("dt"), ca.SX.sym("f")
        both, parts, a = ca.vertcat(x, z), {}, 0
        for label, m in self.state:
            parts[label] = both[a : a + m.ambient]
            a += m.ambient
        theta = {k.name: q for k, q in zip(self.shared, points, strict=True)}
        rate = ca.densify(derivative(parts, {**theta, self.effect.name: p}, u, h, step, fraction))
        slope = ca.densify(ca.jacobian(rate[: self.outer.ambient], p))
        return ca.Function(name, [x, z, *points, p, u, h, step, fraction], [slope, rate[self.outer.ambient :]])

    def _step(self, name: str, inputs: int, held: int, derivative: RightSide, substeps: int) -> ca.Function:
        """One step: internal state after it, and the moments of ``B`` over it against 1 - s and s, s from 0 to 1."""
        stage = self._stage(f"{name}_stage", inputs, held, derivative)
        z0 = ca.MX.sym("z", self.internal)
        x0, x1 = ca.MX.sym("x0", self.outer.ambient), ca.MX.sym("x1", self.outer.ambient)
        points = [ca.MX.sym("q", u.manifold.ambient) for u in self.shared]
        p = ca.MX.sym("p", self.parameters)
        u0, u1, h, duration = ca.MX.sym("u0", inputs), ca.MX.sym("u1", inputs), ca.MX.sym("h", held), ca.MX.sym("dt")
        dt = duration / substeps

        def at(z: ca.MX, within: float, fraction: float) -> tuple[ca.MX, ca.MX]:
            blend = x0 + within * (x1 - x0)
            pieces, a = [], 0
            for m in self.outer.parts:
                piece = blend[a : a + m.ambient]
                pieces.append(piece / ca.sqrt(ca.sumsqr(piece)) if isinstance(m, UnitQuaternion) else piece)
                a += m.ambient
            slope, rate = stage.call([ca.vertcat(*pieces), z, *points, p, u0 + within * (u1 - u0), h, dt,
                                      ca.MX(fraction)])
            return slope, rate

        z = z0
        early = late = ca.MX.zeros(self.outer.ambient, self.parameters)
        for k in range(substeps):
            f0, fm, f1 = k / substeps, (k + 0.5) / substeps, (k + 1) / substeps
            b1, k1 = at(z, f0, 0.0)
            b2, k2 = at(z + dt / 2 * k1, fm, 0.5)
            b3, k3 = at(z + dt / 2 * k2, fm, 0.5)
            b4, k4 = at(z + dt * k3, f1, 1.0)
            z = z + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            for b, within, weight in ((b1, f0, 1.0), (b2, fm, 2.0), (b3, fm, 2.0), (b4, f1, 1.0)):
                early = early + dt / 6 * weight * (1 - within) * b
                late = late + dt / 6 * weight * within * b
        ends = [ca.densify(early), ca.densify(late)]
        shared = [f"p{i}" for i in range(len(points))]
        if not self.internal:
            return ca.Function(name, [x0, x1, *points, p, u0, u1, h, duration], ends,
                               ["x0", "x1", *shared, "p", "u0", "u1", "held", "dt"], ["early", "late"])
        return ca.Function(name, [z0, x0, x1, *points, p, u0, u1, h, duration], [ca.densify(z), *ends],
                           ["z", "x0", "x1", *shared, "p", "u0", "u1", "held", "dt"], ["z_next", "early", "late"])

    def moments(self, states: np.ndarray, shared: Sequence[np.ndarray], parameters: np.ndarray, inputs: np.ndarray,
                held: np.ndarray, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Moments of ``B`` against 1 - s and s over every step of the arc, (steps, ambient, parameters) each.

        Args:
            states: (nodes, ambient) of the arc.
            shared: values of the shared unknowns.
            parameters: of the effect; the ordinary ones zero.
            inputs: (nodes, inputs).
            held: (nodes - 1, held).
            time: (nodes,) s.
        """
        steps = len(time) - 1
        given = {f"p{i}": q for i, q in enumerate(shared)}
        given |= {"x0": states[:-1], "x1": states[1:], "p": parameters, "u0": inputs[:-1], "u1": inputs[1:],
                  "held": held, "dt": np.diff(time)[:, None]}
        if self._mapped is not None:
            early, late = (m.reshape(steps, self.outer.ambient, self.parameters) for m in self._mapped(steps, **given))
            return early, late
        assert self._stepped is not None
        _, early, late = self._stepped(steps, [np.zeros(self.internal)], given)
        shape = (steps, self.parameters, self.outer.ambient)
        return early.reshape(shape).transpose(0, 2, 1), late.reshape(shape).transpose(0, 2, 1)


@dataclass(frozen=True, eq=False)
class DrivenSignal:
    """The state of an arc with effects that are not in its equation of motion, to first order in their parameters.

    Exact where their ordinary parameters are zero, values and derivatives both; that is where signatures are taken.
    Where the arc has internal states of its own (a mode is in the model), these are taken not to answer to the drive:
    the derivatives are then off by about the ratio of the mode's inertia to the body's.

    Attributes:
        plain: the arc without these effects; its first parts start at unknowns of the arc, in order.
        drives: one per effect.
        searched: per effect, mask of the parameters that shape it and have no zero.
        inputs: (nodes, inputs) environment at the nodes, as the drives take it.
    """

    plain: PropagatedSignal
    drives: tuple[Drive, ...]
    searched: tuple[np.ndarray, ...]
    inputs: np.ndarray
    _last: dict[str, tuple[bytes, object]] = field(default_factory=dict, repr=False)

    @property
    def name(self) -> str:
        return self.plain.name

    @property
    def manifold(self) -> Manifold:
        return self.plain.manifold

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        known = dict.fromkeys((*self.plain.unknowns, *(u for d in self.drives for u in (*d.shared, d.effect))))
        return tuple(known)

    def _arc(self, values: Values) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """States at the nodes, transition matrices to there, and their inverses times the tangent maps."""
        key = self.plain.key(values)
        if self._last.get("arc", (b"",))[0] != key:
            states, jacobian = self.plain.at_nodes(values)
            outer = self.drives[0].outer
            states = states[:, : outer.ambient]
            forth = jacobian[:, : outer.tangent, : self.plain.flow.initial_columns]
            self._last["arc"] = key, (states, forth, np.linalg.solve(forth, tangent_maps(outer, states)))
        return self._last["arc"][1]  # type: ignore[return-value]

    def _along(self, drive: Drive, parameters: np.ndarray, values: Values) -> np.ndarray:
        """Derivative (samples, tangent, parameters) of the state along one effect's parameters."""
        states, forth, back = self._arc(values)
        shared = [np.asarray(values[u.name], dtype=float) for u in drive.shared]
        key = b"".join([self.plain.key(values), parameters.tobytes(), *(q.tobytes() for q in shared)])
        if self._last.get(drive.effect.name, (b"",))[0] != key:
            last = self.plain.nodes
            index = self.plain.sample_nodes
            gathered = np.zeros((last, drive.outer.tangent, drive.parameters))
            if last > 1:
                early, late = drive.moments(states, shared, parameters, self.inputs[:last],
                                            self.plain.held[: last - 1], self.plain.node_time[:last])
                gathered[1:] = np.cumsum(back[:-1] @ early + back[1:] @ late, axis=0)
            moved = np.zeros((len(index), self.manifold.tangent, drive.parameters))
            moved[:, : drive.outer.tangent] = forth[index] @ gathered[index]
            self._last[drive.effect.name] = key, moved
        return self._last[drive.effect.name][1]  # type: ignore[return-value]

    def evaluate(self, values: Values) -> tuple[np.ndarray, np.ndarray]:
        states, jacobian = self.plain.evaluate(values)
        known = [u.name for u in self.plain.unknowns]
        others = [u for u in self.unknowns if u.name not in known]
        starts, position = {}, jacobian.shape[2]
        for u in others:
            starts[u.name] = position
            position += u.manifold.tangent
        whole = np.zeros((len(states), jacobian.shape[1], position))
        whole[:, :, : jacobian.shape[2]] = jacobian
        change = np.zeros((len(states), jacobian.shape[1]))
        for drive, searched in zip(self.drives, self.searched, strict=True):
            given = np.asarray(values[drive.effect.name], dtype=float)
            along = self._along(drive, np.where(searched, given, 0.0), values)
            first = starts[drive.effect.name]
            whole[:, :, first : first + drive.parameters] = np.where(searched, 0.0, along)
            change += along @ np.where(searched, 0.0, given)
        if np.any(change):
            retract = ca.Function("retract", [x := ca.SX.sym("x", self.manifold.ambient),
                                              d := ca.SX.sym("d", self.manifold.tangent)],
                                  [self.manifold.retract(x, d)])
            states = np.asarray(retract(states.T, change.T)).T
        return states, whole

    def symbolic(self, values: Mapping[str, ca.MX]) -> ca.MX:
        """That of the arc without the effects: they are held at zero wherever this is asked for."""
        return self.plain.symbolic(values)

    def subset(self, keep: np.ndarray) -> DrivenSignal:
        return replace(self, plain=self.plain.subset(keep), _last={})
