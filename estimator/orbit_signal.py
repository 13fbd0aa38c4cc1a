"""An orbit as a signal of the engine: the state at the times of the samples, with derivatives along the unknowns.

An :class:`OrbitArc` holds the equations of motion, the unknowns that they depend on (position and velocity at the
epoch, force parameters, velocity steps) and propagates once for all signals that ask at the same values.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np

from estimator.models.errors import RequestError
from estimator.models.orbit_forces import orbital_axes
from estimator.models.orbit_integration import (
    DenseOrbit,
    Grid,
    Inputs,
    Tolerance,
    moved_grid,
    propagate,
    slope,
)
from estimator.models.orbit_motion import Motion
from estimator.signals import Values
from estimator.unknowns import Unknown, Vector

_SAME_GRID = 1e-3  # relative change of the state at a segment's start up to which its grid is kept
_EDGE = 3600.0  # s that the two ends of a segment may have moved together for its steps to be tried again
_LOOSE = 1.5e-5  # m of error allowed per step from which steps may be carried over
_GRIDS = 1024  # segments of which the steps are kept


_SHORTEST = 1.0  # s that a burn of finite length takes at the least


@dataclass(frozen=True)
class VelocityStep:
    """A manoeuvre, impulsive or of finite length.

    Attributes:
        unknown: holds (time s after the epoch of the arc's clock, radial, along-track, cross-track m/s), or the three
            velocities alone when ``time`` is given; with ``burning`` the burn's duration (s) comes last, the time is
            that of its middle, and the velocity is spread evenly over it in the turning orbital axes.
        time: s; None where the time is an unknown too.
        burning: whether the manoeuvre takes time. The arc must name the acceleration that its ``thrust`` is.
    """

    unknown: Unknown
    time: float | None = None
    burning: bool = False

    def at(self, values: Values) -> float:
        """Time of the step, or of the middle of the burn, s."""
        return float(values[self.unknown.name][0]) if self.time is None else self.time

    def velocity(self, values: Values) -> np.ndarray:
        """Radial, along-track and cross-track velocity (3,), m/s."""
        v = np.asarray(values[self.unknown.name])
        return v[1:4] if self.burning else v[-3:]

    def duration(self, values: Values) -> float:
        """Length of the burn, s; 0 for an impulse."""
        return max(float(values[self.unknown.name][4]), _SHORTEST) if self.burning else 0.0


def _stepped() -> tuple[ca.Function, ca.Function]:
    x, dv = ca.SX.sym("x", 6), ca.SX.sym("v", 3)
    turned = ca.mtimes(orbital_axes(x[:3], x[3:]), dv)
    after = ca.vertcat(x[:3], x[3:] + turned)
    return (ca.Function("after", [x, dv], [after]),
            ca.Function("slopes", [x, dv], [ca.densify(ca.jacobian(after, x)), ca.densify(ca.jacobian(after, dv))]))


_AFTER, _SLOPES = _stepped()


def before_step(after: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """State (6,) before a velocity step (3,), orbital axes of the state before it, from the state after."""
    x = np.array(after, dtype=float)
    for _ in range(8):
        x[3:] += after[3:] - np.asarray(_AFTER(x, velocity)).ravel()[3:]
    return x


def _near(x: np.ndarray, other: np.ndarray) -> bool:
    return bool(np.linalg.norm(x[:3] - other[:3]) < _SAME_GRID * np.linalg.norm(x[:3])
                and np.linalg.norm(x[3:] - other[3:]) < _SAME_GRID * np.linalg.norm(x[3:]))


@dataclass(frozen=True, eq=False)
class _Segment:
    orbit: DenseOrbit
    chain: np.ndarray  # (6, columns): derivative of the segment's initial state along the arc's unknowns
    low: float
    high: float
    thrusting: tuple[tuple[int, np.ndarray, float], ...] = ()  # first column, velocity, duration of burns that are on


@dataclass(frozen=True, eq=False)
class OrbitArc:
    """One arc of an orbit.

    Attributes:
        name: for reports.
        motion: equations of motion; its active accelerations are those of ``forces``.
        inputs: what drives the motion from outside.
        start: time of the initial state, s.
        span: (first, last) time that will be asked for, s.
        position, velocity: unknowns of the initial state (GCRS, m and m/s).
        forces: (unknown, name of the acceleration) of force parameters that carry derivatives, in the order of the
            motion's active accelerations.
        parameters: (parameters,) values of all force parameters where no unknown gives them.
        steps: velocity steps, in any order.
        breaks: further times at which the equations switch (edges of burns), s.
        thrust: name of the motion's last active acceleration, constant in orbital axes and with three parameters, which
            burns of finite length use; "" where there are none.
    """

    name: str
    motion: Motion
    inputs: Inputs
    start: float
    span: tuple[float, float]
    position: Unknown
    velocity: Unknown
    forces: tuple[tuple[Unknown, str], ...]
    parameters: np.ndarray
    steps: tuple[VelocityStep, ...] = ()
    breaks: tuple[float, ...] = ()
    thrust: str = ""
    tolerance: Tolerance = field(default_factory=Tolerance)
    _grids: dict = field(default_factory=dict, repr=False)
    _last: dict = field(default_factory=dict, repr=False)

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        return (self.position, self.velocity, *(u for u, _ in self.forces), *(s.unknown for s in self.steps))

    @property
    def columns(self) -> int:
        return sum(u.manifold.tangent for u in self.unknowns)

    def segments(self, values: Values) -> list[_Segment]:
        """The propagated orbit at ``values``, computed once for the same values."""
        key = tuple(np.asarray(values[u.name], dtype=float).tobytes() for u in self.unknowns)
        if self._last.get("key") != key:
            self._last.pop("states", None)
            self._last["segments"] = self._propagated(values)
            self._last["key"] = key
        return self._last["segments"]

    def _propagated(self, values: Values) -> list[_Segment]:
        parameters = np.array(self.parameters, dtype=float)
        for unknown, name in self.forces:
            parameters[self.motion.slices[name]] = values[unknown.name]
        x0 = np.concatenate([values[self.position.name], values[self.velocity.name]])
        chain0 = np.zeros((6, self.columns))
        chain0[:, :6] = np.eye(6)
        first, last = min(self.span[0], self.start), max(self.span[1], self.start)
        found: list[_Segment] = []
        for direction, end in ((1, last), (-1, first)):
            if (end - self.start) * direction > 0 or (direction == 1 and not found):
                found += self._one_way(x0, chain0, parameters, values, direction, end)
        return found

    def _one_way(self, x: np.ndarray, chain: np.ndarray, parameters: np.ndarray, values: Values, direction: int,
                 end: float) -> list[_Segment]:
        def ahead(t: float) -> bool:
            return (t - self.start) * direction > 0 and (end - t) * direction > 0

        step_columns, at = {}, self._force_width
        for s in self.steps:
            step_columns[s.unknown.name] = at
            at += s.unknown.manifold.tangent
        # A switch is (time, step, side): side 0 an impulse, -1 the ignition and +1 the cut-off of a burn.
        switches: list[tuple[float, VelocityStep | None, int]] = [(t, None, 0) for t in self.breaks if ahead(t)]
        burning: list[VelocityStep] = []
        for s in self.steps:
            half = 0.5 * s.duration(values)
            for side in (-1, 1) if s.burning else (0,):
                if ahead(s.at(values) + side * half):
                    switches.append((s.at(values) + side * half, s, side))
            if s.burning and abs(s.at(values) - self.start) < half:
                burning.append(s)
        switches.sort(key=lambda item: item[0] * direction)
        segments, t, width = [], self.start, 60.0
        known = dict(self._grids)
        for place, switch, side in [*switches, (end, None, 0)]:
            on = tuple((step_columns[s.unknown.name], s.velocity(values), s.duration(values)) for s in burning)
            if self.thrust:
                parameters = parameters.copy()
                parameters[self.motion.slices[self.thrust]] = sum((v / d for _, v, d in on), np.zeros(3))
            grid = self._grid(t, place, x, known)
            orbit, found = propagate(self.motion.step, self.motion.step.start(x), parameters, self.inputs,
                                     np.array([t, place]), grid=grid, tolerance=self.tolerance,
                                     first_step=width)
            # The next segment starts with the step that the orbit allows, not with a small one after every burn.
            if len(orbit.times) > 2:
                width = max(60.0, float(np.max(np.abs(np.diff(orbit.times[-3:])))))
            if grid is None:
                # Steps that were moved are not kept, so that none is ever far from those of the error control.
                self._keep(t, place, x, found)
            segments.append(_Segment(orbit, chain, min(t, place), max(t, place), on))
            x, carried = orbit.values[-1][:6], orbit.values[-1][6:].reshape(-1, 6).T
            chain = self._chained(carried, chain, on)
            if switch is not None and side != 0:
                # At its edges a burn changes the rate of the state, not the state.
                thrust = np.asarray(_SLOPES(x, np.zeros(3))[1]) @ (switch.velocity(values) / switch.duration(values))
                change = side * direction * thrust
                column = step_columns[switch.unknown.name]
                chain = chain.copy()
                chain[:, column] += change
                chain[:, column + 4] += 0.5 * side * change
                burning = [b for b in burning if b is not switch] if side == direction else [*burning, switch]
            elif switch is not None:
                velocity = switch.velocity(values)
                u = self.inputs(np.array([place]))[0]
                other = (np.asarray(_AFTER(x, velocity)).ravel() if direction == 1 else before_step(x, velocity))
                earlier, later = (x, other) if direction == 1 else (other, x)
                along_x, along_v = (np.asarray(m) for m in _SLOPES(earlier, velocity))
                rate = [slope(self.motion.step, self.motion.step.start(y), parameters, u) for y in (earlier, later)]
                by_time = along_x @ rate[0] - rate[1]
                column = step_columns[switch.unknown.name]
                if direction == -1:
                    along_x = np.linalg.inv(along_x)
                    along_v, by_time = -along_x @ along_v, -along_x @ by_time
                chain = along_x @ chain
                if switch.time is None:
                    chain[:, column] += by_time
                    column += 1
                chain[:, column : column + 3] += along_v
                x = other
            t = place
        return segments

    @property
    def _force_width(self) -> int:
        """Columns of the initial state and of the force parameters."""
        return 6 + sum(u.manifold.tangent for u, _ in self.forces)

    def _chained(self, carried: np.ndarray, chain: np.ndarray,
                 on: tuple[tuple[int, np.ndarray, float], ...]) -> np.ndarray:
        """Derivatives (..., 6, columns) along the arc's unknowns from those of a segment (..., 6, own columns)."""
        width = self._force_width
        result = carried[..., :6] @ chain
        result[..., 6:width] += carried[..., 6:width]
        for column, velocity, duration in on:
            thrust = carried[..., width : width + 3]
            result[..., column + 1 : column + 4] += thrust / duration
            result[..., column + 4] -= thrust @ (velocity / duration**2)
        return result

    def _grid(self, a: float, b: float, x: np.ndarray, known: dict) -> Grid | None:
        """Steps that were found between the same times, or times near them, from a state near ``x`` (6,)."""
        kept = known.get((a, b))
        if kept is not None:
            return kept[1] if _near(x, kept[0]) else None
        if self.tolerance.absolute[0] < _LOOSE:
            return None  # what is integrated to rounding has steps of its own
        close = [key for key in known if abs(key[0] - a) + abs(key[1] - b) < _EDGE and (key[1] - key[0]) * (b - a) > 0]
        for key in sorted(close, key=lambda key: abs(key[0] - a) + abs(key[1] - b))[:2]:
            made_for, grid = known[key]
            if _near(x, made_for):
                moved = moved_grid(grid, key, (a, b), self.inputs)
                if moved is not None:
                    return moved
        return None

    def _keep(self, a: float, b: float, x: np.ndarray, grid: Grid) -> None:
        if len(self._grids) > _GRIDS:
            self._grids.clear()
        self._grids[a, b] = (np.array(x), grid)

    def at(self, times: np.ndarray, values: Values) -> tuple[np.ndarray, np.ndarray]:
        """States (n, 6) and derivatives (n, 6, columns) at ``times`` (n,), s; the later side at a velocity step.

        Stations that measure at the same instants ask for the same states: what was computed at the same values is
        kept.
        """
        times = np.asarray(times, dtype=float)
        segments = sorted(self.segments(values), key=lambda s: s.low)
        known = self._last.get("states")
        fresh = times if known is None else times[~np.isin(times, known[0])]
        if known is None or len(fresh):
            added = np.unique(fresh)
            states, derivatives = self._evaluated(added, segments)
            if known is not None:
                added = np.concatenate([known[0], added])
                order = np.argsort(added)
                added = added[order]
                states = np.concatenate([known[1], states])[order]
                derivatives = np.concatenate([known[2], derivatives])[order]
            known = self._last["states"] = (added, states, derivatives)
        if np.array_equal(times, known[0]):
            return known[1], known[2]
        place = np.searchsorted(known[0], times)
        return known[1][place], known[2][place]

    def _evaluated(self, times: np.ndarray, segments: Sequence[_Segment]) -> tuple[np.ndarray, np.ndarray]:
        states, derivatives = np.empty((len(times), 6)), np.zeros((len(times), 6, self.columns))
        left = np.ones(len(times), dtype=bool)
        for number, segment in enumerate(segments):
            inside = left & (times < segment.high) if number + 1 < len(segments) else left
            if not inside.any():
                continue
            left = left & ~inside
            states[inside], local = segment.orbit.at(times[inside])
            derivatives[inside] = self._chained(local, segment.chain, segment.thrusting)
        return states, derivatives


@dataclass(frozen=True, eq=False)
class OrbitSignal:
    """The state (6) of an arc at the samples' times.

    Attributes:
        name: the kernel input that it feeds.
        arc: the orbit.
        times: (n,) s.
    """

    name: str
    arc: OrbitArc
    times: np.ndarray

    @property
    def manifold(self) -> Vector:
        return STATE

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        return self.arc.unknowns

    def evaluate(self, values: Values) -> tuple[np.ndarray, np.ndarray]:
        return self.arc.at(self.times, values)

    def symbolic(self, values: Mapping[str, ca.MX]) -> ca.MX:
        raise RequestError("an orbit is propagated with error control and has no single expression", where="solver",
                           remedy="use the Gauss-Newton solver")

    def subset(self, keep: np.ndarray) -> OrbitSignal:
        return replace(self, times=self.times[keep])


STATE = Vector(6, ("x", "y", "z", "vx", "vy", "vz"))
"""Manifold of a celestial position and velocity."""


def position_unknown(name: str = "position", sigma: Sequence[float] = (1e5, 1e5, 1e5)) -> Unknown:
    """Unknown of the initial position, GCRS."""
    return Unknown(name, Vector(3, ("x", "y", "z")), "m", tuple(sigma), frame="GCRS",
                   description="position at the epoch")


def velocity_unknown(name: str = "velocity", sigma: Sequence[float] = (10.0, 10.0, 10.0)) -> Unknown:
    """Unknown of the initial velocity, GCRS."""
    return Unknown(name, Vector(3, ("x", "y", "z")), "m/s", tuple(sigma), frame="GCRS",
                   description="velocity at the epoch")
