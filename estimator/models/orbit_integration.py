"""An orbit and its derivatives along initial state and parameters, by an embedded Runge-Kutta formula of order 8.

One compiled function advances the state and its variational equations together through one step of Dormand and
Prince's 8(5,3) (Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, section II.5; the
coefficients are those of ``scipy.integrate.DOP853``), with error estimate and continuous output. What drives the
motion from outside (the orientation of the Earth, the Sun, the Moon) enters as numbers at the stages' times, so the
equations of motion are differentiated once, symbolically, and nothing is integrated again per unknown.

The grid of steps is found by error control and then kept while the orbit stays close to the one that made it, which
makes the map from unknowns to states smooth across iterations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import casadi as ca
import numpy as np
from scipy.integrate import DOP853

from estimator.models.compiled import compiled
from estimator.models.errors import InfeasibleError

_MAIN = DOP853.n_stages  # 12
_STAGES = _MAIN + 1 + len(DOP853.C_EXTRA)  # 16
STAGE_TIMES = np.concatenate([DOP853.C, [1.0], DOP853.C_EXTRA])
"""Place of each stage inside its step, (16,)."""

Inputs = Callable[[np.ndarray], np.ndarray]
"""From times (n,) to the outside inputs (n, inputs)."""


Derivative = Callable[[ca.SX, ca.SX, ca.SX], tuple[ca.SX, ca.SX | None, ca.SX | None]]


class VariationalStep:
    """The compiled step.

    Args:
        name: a C identifier.
        derivative: ``(x, p, u) -> (dx/dt, its Jacobian along x, its Jacobian along p)`` as SX; None for a Jacobian
            asks for it by automatic differentiation.
        state: size of x.
        parameters: size of p.
        inputs: size of u.
        active: indices of the parameters along which derivatives are carried.

    The stacked vector is ``[x; vec(S)]``, S (state, state + active) being the derivative of the state along the initial
    state and the active parameters.
    """

    def __init__(
        self, name: str, derivative: Derivative, state: int, parameters: int, inputs: int, active: tuple[int, ...]
    ):
        self.state, self.parameters, self.inputs, self.active = state, parameters, inputs, active
        x, p, u = ca.SX.sym("x", state), ca.SX.sym("p", parameters), ca.SX.sym("u", inputs)
        self.columns = state + len(active)
        sensitivity = ca.SX.sym("S", state, self.columns)
        rate, along_x, along_p = derivative(x, p, u)
        rate = ca.densify(rate)
        along_x = ca.jacobian(rate, x) if along_x is None else along_x
        forced = ca.SX.zeros(state, self.columns)
        if active:
            along_p = ca.jacobian(rate, p) if along_p is None else along_p
            for column, index in enumerate(active):
                forced[:, state + column] = along_p[:, index]
        moved = ca.mtimes(along_x, sensitivity) + forced
        self.size = state * (1 + self.columns)
        stacked = ca.vertcat(x, ca.vec(sensitivity))
        right = ca.Function("right", [stacked, p, u], [ca.vertcat(rate, ca.vec(ca.densify(moved)))])
        self.step = compiled(_step_function(f"{name}_step", right, self.size, state, parameters, inputs))

    def start(self, x: np.ndarray) -> np.ndarray:
        """Stacked vector at the start: the state and the identity."""
        sensitivity = np.zeros((self.state, self.columns))
        sensitivity[:, : self.state] = np.eye(self.state)
        return np.concatenate([x, sensitivity.ravel(order="F")])


def _step_function(name: str, right: ca.Function, size: int, state: int, parameters: int, inputs: int) -> ca.Function:
    y, k0, p = ca.MX.sym("y", size), ca.MX.sym("k", size), ca.MX.sym("p", parameters)
    table, h = ca.MX.sym("u", inputs, _STAGES), ca.MX.sym("h")
    slopes = [k0]

    def weighted(weights: np.ndarray) -> ca.MX:
        total = ca.MX.zeros(size)
        for w, k in zip(weights, slopes, strict=False):
            if w != 0.0:
                total += float(w) * k
        return total

    for i in range(1, _MAIN):
        slopes.append(right(y + h * weighted(DOP853.A[i, :i]), p, table[:, i]))
    after = y + h * weighted(DOP853.B)
    slopes.append(right(after, p, table[:, _MAIN]))
    fifth, third = weighted(DOP853.E5)[:state], weighted(DOP853.E3)[:state]
    for i, row in enumerate(DOP853.A_EXTRA):
        slopes.append(right(y + h * weighted(row[: _MAIN + 1 + i]), p, table[:, _MAIN + 1 + i]))
    change = after - y
    dense = [change, h * k0 - change, 2 * change - h * (slopes[_MAIN] + k0), *(h * weighted(row) for row in DOP853.D)]
    return ca.Function(
        name,
        [y, k0, p, table, h],
        [after, slopes[_MAIN], ca.horzcat(*dense), h * fifth, h * third],
        ["y", "k", "p", "u", "h"],
        ["y_next", "k_next", "dense", "fifth", "third"],
    )


@dataclass(frozen=True, eq=False)
class DenseOrbit:
    """A propagated orbit that can be asked at any time inside its span.

    Attributes:
        times: (steps + 1,) s; steps may run backward.
        values: (steps + 1, size) stacked vector at the nodes .
        starts: (steps, size) stacked vector at the start of each step.
        dense: (steps, 7, size) coefficients of the continuous output.
        state, columns: sizes of x and of the derivative.
    """

    times: np.ndarray
    values: np.ndarray
    starts: np.ndarray
    dense: np.ndarray
    state: int
    columns: int

    def at(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States (n, state) and derivatives (n, state, columns) at ``times`` (n,), s.

        Raises:
            ValueError: a time is outside the span.
        """
        times = np.asarray(times, dtype=float)
        forward = self.times[-1] >= self.times[0]
        nodes, wanted = (self.times, times) if forward else (-self.times, -times)
        if len(times) and (wanted.min() < nodes[0] - 1e-6 or wanted.max() > nodes[-1] + 1e-6):
            raise ValueError(
                f"time outside the propagated span: {times.min()} to {times.max()} s against "
                f"{self.times[0]} to {self.times[-1]} s"
            )
        if len(self.dense) == 0:
            stacked = np.broadcast_to(self.values[0], (len(times), self.values.shape[1]))
        else:
            index = np.clip(np.searchsorted(nodes, wanted, side="right") - 1, 0, len(self.dense) - 1)
            width = (self.times[1:] - self.times[:-1])[index]
            x = ((times - self.times[:-1][index]) / width)[:, None]
            stacked = np.zeros((len(times), self.values.shape[1]))
            for j in range(6, -1, -1):
                stacked += self.dense[index, j]
                stacked *= x if (6 - j) % 2 == 0 else 1 - x
            stacked += self.starts[index]
        shaped = stacked[:, self.state :].reshape(len(times), self.columns, self.state).transpose(0, 2, 1)
        return stacked[:, : self.state], shaped


_MOVED = 0.2  # of a step by which its ends may move before steps are sought again


@dataclass(frozen=True)
class Tolerance:
    """Error allowed per step of the state: ``absolute + relative |x|``, one pair for positions and one for
    velocities."""

    relative: float = 1e-13
    absolute: tuple[float, ...] = (1e-5, 1e-5, 1e-5, 1e-8, 1e-8, 1e-8)


def propagate(
    step: VariationalStep,
    start: np.ndarray,
    parameters: np.ndarray,
    inputs: Inputs,
    breaks: np.ndarray,
    *,
    grid: Grid | None = None,
    tolerance: Tolerance | None = None,
    first_step: float = 60.0,
    longest_step: float = np.inf,
) -> tuple[DenseOrbit, Grid]:
    """Propagate from ``breaks[0]`` to ``breaks[-1]``, stopping at every break (the edge of a burn).

    Args:
        step: the compiled step.
        start: stacked vector at ``breaks[0]``.
        parameters: (parameters,).
        inputs: outside inputs as a function of time; asked strictly inside each interval between breaks, so they may be
            discontinuous at a break.
        breaks: (n,) s, monotonic, n >= 2.
        grid: steps found before, to be used again; None finds them by error control.
        tolerance: of the error control.
        first_step, longest_step: s.

    Raises:
        InfeasibleError: the step size collapses (the orbit meets the Earth's centre, or is not finite).
    """
    tolerance = tolerance or Tolerance()
    runner = _Runner(step, parameters)
    y = np.array(start, dtype=float)
    times, values, starts, dense = [float(breaks[0])], [y], [], []
    found: list[tuple[np.ndarray, np.ndarray]] = []
    direction = 1.0 if breaks[-1] >= breaks[0] else -1.0
    h = first_step
    for number, (a, b) in enumerate(pairwise(breaks)):
        if grid is not None:
            steps, tables = grid.segments[number]
        else:
            steps, tables = None, None
        if b == a:
            found.append((np.zeros(0), np.zeros((0, step.inputs, _STAGES))))
            continue
        inside = _inside(inputs, float(a), float(b))
        if steps is not None and tables is not None:
            k = runner.slope(y, tables[0][:, 0])
            t = float(a)
            for width, table in zip(steps, tables, strict=True):
                after, k_after, coefficients, _, _ = runner.advance(y, k, table, width)
                starts.append(y)
                dense.append(coefficients)
                t += width
                y, k = after, k_after
                times.append(t)
                values.append(y)
            times[-1] = float(b)
            found.append((steps, tables))
            continue
        t, new_steps, new_tables = float(a), [], []
        k = runner.slope(y, inside(np.array([t]))[0])
        rejected = False
        while (b - t) * direction > 0:
            left = abs(b - t)
            width = min(h, left, longest_step)
            if left - width < 1e-3 * width:
                width = left
            signed = direction * width
            table = np.ascontiguousarray(inside(t + signed * STAGE_TIMES).T)
            after, k_after, coefficients, fifth, third = runner.advance(y, k, table, signed)
            scale = np.asarray(tolerance.absolute) + tolerance.relative * np.maximum(
                np.abs(y[: step.state]), np.abs(after[: step.state])
            )
            e5, e3 = float(np.sum((fifth / scale) ** 2)), float(np.sum((third / scale) ** 2))
            error = 0.0 if e5 == 0 and e3 == 0 else e5 / np.sqrt((e5 + 0.01 * e3) * step.state)
            if not np.isfinite(error):
                h = 0.1 * width
                rejected = True
            elif error < 1:
                growth = 10.0 if error == 0 else min(10.0, 0.9 * error ** (-1 / 8))
                starts.append(y)
                dense.append(coefficients)
                new_steps.append(signed)
                new_tables.append(table)
                t = float(b) if width == left else t + signed
                y, k = after, k_after
                times.append(t)
                values.append(y)
                if width == h or growth < 1:
                    h = width * (min(1.0, growth) if rejected else growth)
                rejected = False
            else:
                h = width * max(0.2, 0.9 * error ** (-1 / 8))
                rejected = True
            if h < 1e-6 * max(1.0, abs(t) * 1e-9):
                raise InfeasibleError(
                    "the orbit cannot be propagated: it comes too near the Earth's centre or is not finite",
                    limit="step of the integration",
                )
        found.append((np.array(new_steps), np.array(new_tables)))
    size = step.size
    orbit = DenseOrbit(
        np.array(times),
        np.array(values),
        np.array(starts).reshape(-1, size),
        np.array(dense).reshape(-1, 7, size),
        step.state,
        step.columns,
    )
    return orbit, Grid(tuple(found))


def slope(step: VariationalStep, stacked: np.ndarray, parameters: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """Time derivative (state,) of the state in ``stacked`` with outside inputs (inputs,)."""
    return _Runner(step, parameters).slope(np.ascontiguousarray(stacked), inputs)[: step.state]


@dataclass(frozen=True, eq=False)
class Grid:
    """Steps and inputs at their stages, per interval between breaks."""

    segments: tuple[tuple[np.ndarray, np.ndarray], ...]


def moved_grid(grid: Grid, before: tuple[float, float], after: tuple[float, float], inputs: Inputs) -> Grid | None:
    """The steps between two times for two others near them, so that they need not be found again.

    Args:
        grid: of one interval; before: its ends, s.
        after: the ends that are asked for, s.
        inputs: outside inputs, asked once for all stages.

    Returns:
        None where an end has moved by more than a fifth of a step beside it: the error of the steps would no longer be
        the controlled one.
    """
    steps, _ = grid.segments[0]
    if len(steps) < 2 or (after[1] - after[0]) * (before[1] - before[0]) <= 0:
        return None
    ratio = (after[1] - after[0]) / (before[1] - before[0])
    ends = before[0] + np.concatenate([[0.0], np.cumsum(steps)])
    shift = np.abs(after[0] + ratio * (ends - before[0]) - ends)
    # The last step is what was left of the interval: shorter than its error asks for.
    local = np.abs(steps[:-1])
    far = np.any(np.maximum(shift[:-2], shift[1:-1]) > _MOVED * local) or shift[-1] > _MOVED * local[-1]
    if far or ratio > 1 + _MOVED:
        return None
    widths = steps * ratio
    begins = after[0] + np.concatenate([[0.0], np.cumsum(widths)[:-1]])
    stages = (begins[:, None] + widths[:, None] * STAGE_TIMES).ravel()
    table = _inside(inputs, *after)(stages).reshape(len(widths), len(STAGE_TIMES), -1)
    return Grid(((widths, np.ascontiguousarray(table.transpose(0, 2, 1))),))


def _inside(inputs: Inputs, a: float, b: float) -> Inputs:
    """The inputs with times clamped into the open interval, so that a switch at a break is on the right side."""
    low, high = min(a, b), max(a, b)
    margin = min(1e-6, 1e-6 * (high - low))

    def clamped(times: np.ndarray) -> np.ndarray:
        return inputs(np.clip(times, low + margin, high - margin))

    return clamped


class _Runner:
    """The step through CasADi's buffer interface, without copies."""

    def __init__(self, step: VariationalStep, parameters: np.ndarray):
        self.size, self.state = step.size, step.state
        self.parameters = np.ascontiguousarray(parameters, dtype=float) if step.parameters else np.zeros(1)
        self.buffer, self.trigger = step.step.buffer()
        self.buffer.set_arg(2, self.parameters.data)

    def slope(self, y: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Right side of the equations: what a step of length zero ends with."""
        return self.advance(y, np.zeros(self.size), np.repeat(np.asarray(u)[:, None], _STAGES, axis=1), 0.0)[1]

    def advance(
        self, y: np.ndarray, k: np.ndarray, table: np.ndarray, h: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        after, slope, dense = np.empty(self.size), np.empty(self.size), np.empty((7, self.size))
        fifth, third = np.empty(self.state), np.empty(self.state)
        columns = np.ascontiguousarray(table.T)
        width = np.array([h])
        self.buffer.set_arg(0, y.data)
        self.buffer.set_arg(1, k.data)
        self.buffer.set_arg(3, (columns if columns.size else np.zeros(1)).data)
        self.buffer.set_arg(4, width.data)
        for i, out in enumerate((after, slope, dense, fifth, third)):
            self.buffer.set_res(i, out.data)
        self.trigger()
        return after, slope, dense, fifth, third
