"""The true rotation of the rigid body in a free or torque arc.

State: the matrix ``inertial_from_tracker`` (9), the angular momentum in inertial axes (3), then the internal states of
effects. Without torque the momentum stays constant to the last bit, and the rate follows from it:
``w = J^-1 R' L``, ``R' = R [w x]``, ``L' = R torque``.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

RightSide = Callable[[float, np.ndarray, np.ndarray], np.ndarray]
"""(time, state (12 + internal), commanded torque (3) N m in actuator axes) to the derivative of the state."""


@dataclass(frozen=True)
class RotationArc:
    """The solution of one arc.

    Attributes:
        start, stop: s after the epoch.
        inertia: (3, 3) kg m2, tracker axes.
        pieces: (start, stop, dense output), in order; the command is constant inside a piece.
    """

    start: float
    stop: float
    inertia: np.ndarray
    pieces: tuple[tuple[float, float, Callable[[np.ndarray], np.ndarray]], ...]

    def state(self, time: np.ndarray) -> np.ndarray:
        """Whole state (n, 12 + internal) at ``time`` (n,), which may leave the arc by a little."""
        time = np.asarray(time, dtype=float)
        result = np.empty((len(time), len(self.pieces[0][2](np.array([self.start])))))
        for k, (start, stop, solution) in enumerate(self.pieces):
            inside = np.ones(len(time), dtype=bool)
            if k > 0:
                inside &= time >= start
            if k < len(self.pieces) - 1:
                inside &= time < stop
            if inside.any():
                result[inside] = solution(time[inside]).T
        return result

    def __call__(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """``tracker_from_inertial`` matrices (n, 3, 3) and rates (n, 3) rad/s of the body in tracker axes."""
        state = self.state(time)
        attitude = np.swapaxes(state[:, :9].reshape(-1, 3, 3), 1, 2)
        rate = np.linalg.solve(self.inertia, (attitude @ state[:, 9:12, None])[:, :, 0].T).T
        return attitude, rate


def integrate_arc(
    start: float,
    stop: float,
    inertial_from_tracker: np.ndarray,
    rate: np.ndarray,
    inertia: np.ndarray,
    segments: Sequence[tuple[float, float, np.ndarray]],
    right_side: RightSide,
    internal_states: int,
) -> RotationArc:
    """Integrate one arc, anew at every switch of the command.

    Args:
        start, stop: s after the epoch.
        inertial_from_tracker, rate: (3, 3) and (3) rad/s (tracker axes) at the start.
        inertia: (3, 3) kg m2.
        segments: (start, stop, command (3) N m in actuator axes), in order and apart.
        right_side: see :data:`RightSide`.
        internal_states: how many; they start at zero.
    """
    momentum = inertial_from_tracker @ inertia @ rate
    state = np.concatenate([inertial_from_tracker.ravel(), momentum, np.zeros(internal_states)])
    scale = max(float(np.linalg.norm(momentum)), float(np.trace(inertia)) * 1e-5)
    # A mode may swing hundreds of times: 1e-10 (rad) is still a hundred thousand times below a tracker's noise.
    relative = 1e-10 if internal_states else 1e-12
    absolute = relative * np.concatenate([np.ones(9), np.full(3, scale), np.ones(internal_states)])
    switches = [start, stop]
    for first, last, _ in segments:
        switches += [t for t in (first, last) if start < t < stop]
    switches = sorted(set(switches))
    pieces = []
    for first, last in itertools.pairwise(switches):
        middle = 0.5 * (first + last)
        command = sum((c for a, b, c in segments if a <= middle < b), np.zeros(3))
        solution = solve_ivp(right_side, (first, last), state, method="DOP853", rtol=relative, atol=absolute,
                             dense_output=True, args=(command,))
        if not solution.success:
            raise ArithmeticError(f"the rotation arc at {first:.1f} s could not be integrated: {solution.message}")
        pieces.append((first, last, solution.sol))
        state = solution.y[:, -1]
    return RotationArc(start, stop, inertia, tuple(pieces))


def moving_body(inertia: np.ndarray, spread: float, draw: np.random.Generator) -> np.ndarray:
    """A tensor (3, 3) kg m2 near ``inertia`` that is that of a body whatever the spread.

    The second moments of mass, ``trace(J)/2 - J``, are stretched by a random matrix near 1; they stay positive, so
    the new tensor keeps the triangle inequality.
    """
    moments = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    stretch = np.eye(3) + spread * draw.standard_normal((3, 3))
    moments = stretch @ moments @ stretch.T
    tensor = np.trace(moments) * np.eye(3) - moments
    return 0.5 * (tensor + tensor.T)
