"""A slew as its piecewise constant jerk: acceleration and rate are polynomials, and their extremes are exact."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from guidance.kinematics import Motion, cross, exponential, norm, product

Array = np.ndarray


def magnus_rotation(w: Array, a: Array, j: Array, h: Array) -> Array:
    """Rotation vector (..., 3) of a step with rate ``w + a t + j t^2 / 2``, from the sixth-order Magnus expansion.

    Args:
        w, a, j: rate, acceleration and jerk at the start of the step, body axes (..., 3).
        h: length of the step (..., 1), s.

    The expansion is that of Blanes, Casas, Oteo and Ros for ``Y' = A Y``, with the signs turned for ``q' = q o w / 2``.
    """
    middle1 = h * (w + a * h / 2 + j * h * h / 8)
    middle2 = h * h * (a + j * h / 2)
    middle3 = h * h * h * j / 2
    c1 = cross(middle1, middle2)
    c2 = cross(middle1, 2 * middle3 - c1) / 60
    return middle1 + middle3 / 12 + cross(20 * middle1 + middle3 + c1, middle2 + c2) / 240


def running_products(q: Array) -> Array:
    """``q0, q0 o q1, q0 o q1 o q2, ...`` of quaternions (n, 4), by doubling: the work of log2(n) array operations."""
    result = np.array(q, dtype=float)
    step = 1
    while step < len(result):
        result[step:] = product(result[:-step], result[step:])
        step *= 2
    return result / norm(result)[:, None]


@dataclass(frozen=True)
class JerkProfile:
    """Attitude and motion at the start, and the jerk after it.

    Attributes:
        quaternion: ``inertial_from_body`` at the start (4,).
        rate, acceleration: body axes at the start (3,).
        durations: of the pieces (n,), s, none negative.
        jerks: body axes (n, 3), rad/s3.
    """

    quaternion: Array
    rate: Array
    acceleration: Array
    durations: Array
    jerks: Array

    @property
    def duration(self) -> float:
        """Length of the slew, s."""
        return float(np.sum(self.durations))

    def nodes(self) -> tuple[Array, Array, Array]:
        """Times (n + 1,), rates (n + 1, 3) and accelerations (n + 1, 3) at the joints of the pieces."""
        h = self.durations[:, None]
        times = np.concatenate([[0.0], np.cumsum(self.durations)])
        accelerations = np.concatenate([self.acceleration[None], self.acceleration + np.cumsum(h * self.jerks, axis=0)])
        steps = h * accelerations[:-1] + h * h / 2 * self.jerks
        rates = np.concatenate([self.rate[None], self.rate + np.cumsum(steps, axis=0)])
        return times, rates, accelerations

    def motion(self, times: Array, *, longest_step: float = 0.05) -> Motion:
        """Attitude, rate, acceleration and jerk at ``times`` (m,), s, increasing, within the slew.

        Rate and acceleration are exact; the attitude comes from sixth-order Magnus steps no longer than
        ``longest_step`` (s) and never across a joint.
        """
        times = np.asarray(times, dtype=float)
        joints, rates, accelerations = self.nodes()
        longest_step = max(longest_step, 1e-5 * joints[-1])
        count = int(np.ceil(joints[-1] / longest_step)) + 1
        grid = np.unique(np.concatenate([joints, np.linspace(0, joints[-1], count), np.clip(times, 0, joints[-1])]))

        def at(t: Array, piece: Array) -> tuple[Array, Array, Array]:
            s = (t - joints[piece])[:, None]
            j = self.jerks[piece]
            a = accelerations[piece] + s * j
            return rates[piece] + s * accelerations[piece] + s * s / 2 * j, a, j

        def piece_of(t: Array) -> Array:
            return np.clip(np.searchsorted(joints, t, side="right") - 1, 0, len(self.durations) - 1)

        left = grid[:-1]
        w, a, j = at(left, piece_of(left))
        steps = exponential(magnus_rotation(w, a, j, np.diff(grid)[:, None]))
        attitude = running_products(np.concatenate([self.quaternion[None], steps]))
        index = np.clip(np.searchsorted(grid, times), 0, len(grid) - 1)
        return Motion(attitude[index], *at(times, piece_of(times)))

    def final(self) -> tuple[Array, Array, Array]:
        """Quaternion, rate and acceleration at the end."""
        m = self.motion(np.array([self.duration]), longest_step=0.5)
        return m.quaternion[0], m.rate[0], m.acceleration[0]

    def largest(self) -> tuple[float, float, float]:
        """Exact largest norms of rate, acceleration and jerk.

        The jerk is constant and the acceleration linear in a piece; the square of the rate is a quartic, whose
        extremes are the real roots of a cubic.
        """
        _, rates, accelerations = self.nodes()
        w, a, j = rates[:-1], accelerations[:-1], self.jerks
        highest = float(np.max(norm(rates)))
        h = self.durations[:, None]
        # The rate lies in the hull of its control points: only pieces whose hull reaches higher are looked into.
        hull = np.maximum(norm(w + h * a / 2), norm(rates[1:]))
        for k in np.flatnonzero((hull > highest) & (self.durations > 0)):
            # (|w + a s + j s^2 / 2|^2)' / 2 = w.a + (a.a + w.j) s + 3/2 a.j s^2 + 1/2 j.j s^3
            length = self.durations[k]
            cubic = np.array([j[k] @ j[k] / 2 * length**3, 1.5 * (a[k] @ j[k]) * length**2,
                              (a[k] @ a[k] + w[k] @ j[k]) * length, w[k] @ a[k]])
            roots = np.roots(cubic)
            s = roots.real[(np.abs(roots.imag) < 1e-6) & (roots.real > 0) & (roots.real < 1)][:, None] * length
            if len(s):
                highest = max(highest, float(np.max(norm(w[k] + s * a[k] + s * s / 2 * j[k]))))
        used = self.durations > 0
        jerk = norm(self.jerks[used])
        return highest, float(np.max(norm(accelerations))), float(np.max(jerk, initial=0.0))
