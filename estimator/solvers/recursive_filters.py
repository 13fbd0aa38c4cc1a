"""Recursive filters over one discrete system: linear, extended, iterated, unscented, Schmidt, square-root, and
smoothers.

Every function runs many realizations at once: states are (runs, size), measurements (runs, steps, outputs). The system
gives its propagation and its measurement with their Jacobians, from the same kernels as the batch. A filter says when
it diverges: the mean square of its normalized innovations, or of some of its components, leaves what chance allows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.stats import chi2


class DiscreteSystem(Protocol):
    """A state that moves in steps and is measured after each.

    ``measured`` tells whether step ``k`` ends with a measurement.
    """

    @property
    def size(self) -> int: ...

    @property
    def steps(self) -> int: ...

    def propagate(self, k: int, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States (runs, size) after step ``k`` and their Jacobians (runs, size, size)."""

    def process_noise(self, k: int) -> np.ndarray:
        """Covariance (size, size) of the noise added in step ``k``."""

    def observe(self, k: int, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Predicted measurements (runs, outputs) after step ``k`` and their Jacobians (runs, outputs, size)."""

    @property
    def measurement_covariance(self) -> np.ndarray:
        """Covariance (outputs, outputs)."""


@dataclass(frozen=True, eq=False)
class FilterRun:
    """What a filter gives.

    Attributes:
        name: of the filter.
        state: (runs, steps + 1, size) estimates, the prior first.
        sigma: (runs, steps + 1, size) posterior standard deviations.
        covariance: (runs, size, size) at the end.
        innovation_square: (runs, steps) normalized squared innovations.
        outputs: numbers in one measurement.
        history: covariances, predictions and Jacobians where a smoother needs them.
    """

    name: str
    state: np.ndarray
    sigma: np.ndarray
    covariance: np.ndarray
    innovation_square: np.ndarray
    outputs: int
    history: dict[str, np.ndarray] | None = None

    def diverged(self, level: float = 1e-6) -> np.ndarray:
        """(runs,) whether the innovations of the run are larger than chance allows at ``level``.

        The mean of the normalized squared innovations, whole and in its last quarter, is chi-square distributed with
        ``steps x outputs`` degrees of freedom where the filter's covariance is true.
        """
        steps = self.innovation_square.shape[1]
        found = np.zeros(len(self.state), dtype=bool)
        for part in (slice(0, steps), slice(steps - max(steps // 4, 1), steps)):
            values = self.innovation_square[:, part]
            degrees = values.shape[1] * self.outputs
            with np.errstate(invalid="ignore"):
                total = values.sum(axis=1)
            found |= ~np.isfinite(total) | (total > chi2.ppf(1 - level, degrees))
        return found

    def sentence(self) -> str:
        """Whether the filter is to be trusted, in words."""
        bad = int(self.diverged().sum())
        runs = len(self.state)
        if bad == 0:
            return f"{self.name}: the innovations agree with the filter's covariance in all {runs} runs"
        ratio = float(np.nanmedian(self.innovation_square.mean(axis=1)[self.diverged()] / self.outputs))
        return (
            f"{self.name}: diverged in {bad} of {runs} runs (innovations {np.sqrt(ratio):.3g} times the filter's own "
            "sigma): its errors grow while its covariance shrinks"
        )


def _symmetric(matrix: np.ndarray) -> np.ndarray:
    return 0.5 * (matrix + np.swapaxes(matrix, -1, -2))


def _start(
    system: DiscreteSystem, state: np.ndarray, covariance: np.ndarray, measurements: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    runs = len(measurements)
    x = np.broadcast_to(state, (runs, system.size)).copy()
    p = np.broadcast_to(covariance, (runs, system.size, system.size)).copy()
    states, sigmas = np.empty((runs, system.steps + 1, system.size)), np.empty((runs, system.steps + 1, system.size))
    states[:, 0], sigmas[:, 0] = x, np.sqrt(np.diagonal(p, axis1=1, axis2=2))
    return x, p, states, sigmas, np.zeros((runs, system.steps))


def _gain(p: np.ndarray, h: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gain and innovation covariance."""
    ph = p @ np.swapaxes(h, -1, -2)
    s = _symmetric(h @ ph + r)
    return np.swapaxes(np.linalg.solve(s, np.swapaxes(ph, -1, -2)), -1, -2), s


def _joseph(p: np.ndarray, k: np.ndarray, h: np.ndarray, r: np.ndarray) -> np.ndarray:
    left = np.eye(p.shape[-1]) - k @ h
    return _symmetric(left @ p @ np.swapaxes(left, -1, -2) + k @ r @ np.swapaxes(k, -1, -2))


def _square(innovation: np.ndarray, s: np.ndarray) -> np.ndarray:
    return np.einsum("ri,ri->r", innovation, np.linalg.solve(s, innovation[..., None])[..., 0])


def linear_filter(
    system: DiscreteSystem,
    nominal: np.ndarray,
    transition: Sequence[np.ndarray] | np.ndarray,
    state: np.ndarray,
    covariance: np.ndarray,
    measurements: np.ndarray,
) -> FilterRun:
    """Kalman's filter of the deviation from a nominal motion that is never corrected.

    Args:
        system: gives the measurement and its Jacobian at the nominal motion.
        nominal: (steps + 1, size).
        transition: (steps, size, size) or one matrix for all steps.
        state: (size,) or (runs, size) first estimate; covariance: (size, size).
        measurements: (runs, steps, outputs).
    """
    x, p, states, sigmas, squares = _start(system, state, covariance, measurements)
    p = p[:1]
    deviation = x - nominal[0]
    r = system.measurement_covariance
    matrices = np.asarray(transition)
    for k in range(system.steps):
        phi = matrices if matrices.ndim == 2 else matrices[k]
        deviation = deviation @ phi.T
        p = _symmetric(phi @ p @ phi.T + system.process_noise(k))
        predicted, h = system.observe(k, nominal[k + 1 : k + 2])
        gain, s = _gain(p, h, r)
        innovation = measurements[:, k] - predicted - deviation @ h[0].T
        squares[:, k] = _square(innovation, np.broadcast_to(s, (len(innovation), *s.shape[1:])))
        deviation = deviation + innovation @ gain[0].T
        p = _joseph(p, gain, h, r)
        states[:, k + 1] = nominal[k + 1] + deviation
        sigmas[:, k + 1] = np.sqrt(np.diagonal(p, axis1=1, axis2=2))
    return FilterRun(
        "linear", states, sigmas, np.broadcast_to(p, (len(x), *p.shape[1:])).copy(), squares, measurements.shape[2]
    )


def extended_filter(
    system: DiscreteSystem,
    state: np.ndarray,
    covariance: np.ndarray,
    measurements: np.ndarray,
    *,
    iterations: int = 1,
    keep: bool = False,
    about: np.ndarray | None = None,
) -> FilterRun:
    """The extended filter, and with ``iterations`` above one the iterated one (Gauss-Newton steps in each update).

    Args:
        system, state, covariance, measurements: see :func:`linear_filter`.
        iterations: linearizations of the measurement in each update.
        keep: keep what a smoother needs.
        about: (runs, steps + 1, size) motion to linearize about instead of the estimates (an iterated smoother's pass).
    """
    x, p, states, sigmas, squares = _start(system, state, covariance, measurements)
    r = system.measurement_covariance
    history: dict[str, list[np.ndarray]] = {"covariance": [p], "predicted": [], "predicted_covariance": [], "phi": []}
    for k in range(system.steps):
        if about is None:
            x, phi = system.propagate(k, x)
        else:
            moved, phi = system.propagate(k, about[:, k])
            x = moved + np.einsum("rij,rj->ri", phi, x - about[:, k])
        p = _symmetric(phi @ p @ np.swapaxes(phi, -1, -2) + system.process_noise(k))
        if keep:
            history["predicted"].append(x)
            history["predicted_covariance"].append(p)
            history["phi"].append(phi)
        point = x if about is None else about[:, k + 1]
        for i in range(iterations if about is None else 1):
            predicted, h = system.observe(k, point)
            gain, s = _gain(p, h, r)
            innovation = measurements[:, k] - predicted - np.einsum("rij,rj->ri", h, x - point)
            if i == 0:
                squares[:, k] = _square(innovation, s)
            point = x + np.einsum("rij,rj->ri", gain, innovation)
        x = point
        p = _joseph(p, gain, h, r)
        states[:, k + 1] = x
        sigmas[:, k + 1] = np.sqrt(np.diagonal(p, axis1=1, axis2=2))
        if keep:
            history["covariance"].append(p)
    kept = {name: np.stack(values, axis=1) for name, values in history.items()} if keep else None
    name = "extended" if iterations == 1 else f"iterated extended ({iterations})"
    return FilterRun(name, states, sigmas, p, squares, measurements.shape[2], kept)


def schmidt_filter(
    system: DiscreteSystem,
    state: np.ndarray,
    covariance: np.ndarray,
    measurements: np.ndarray,
    considered: Sequence[int],
    *,
    iterations: int = 1,
) -> FilterRun:
    """Schmidt's filter: the components ``considered`` widen the covariance and are not estimated."""
    x, p, states, sigmas, squares = _start(system, state, covariance, measurements)
    r = system.measurement_covariance
    rows = np.ones(system.size)
    rows[list(considered)] = 0.0
    for k in range(system.steps):
        x, phi = system.propagate(k, x)
        p = _symmetric(phi @ p @ np.swapaxes(phi, -1, -2) + system.process_noise(k))
        point = x
        for i in range(iterations):
            predicted, h = system.observe(k, point)
            gain, s = _gain(p, h, r)
            gain = gain * rows[:, None]
            innovation = measurements[:, k] - predicted - np.einsum("rij,rj->ri", h, x - point)
            if i == 0:
                squares[:, k] = _square(innovation, s)
            point = x + np.einsum("rij,rj->ri", gain, innovation)
        x = point
        p = _joseph(p, gain, h, r)
        states[:, k + 1] = x
        sigmas[:, k + 1] = np.sqrt(np.diagonal(p, axis1=1, axis2=2))
    return FilterRun("Schmidt", states, sigmas, p, squares, measurements.shape[2])


def square_root_filter(
    system: DiscreteSystem, state: np.ndarray, covariance: np.ndarray, measurements: np.ndarray, *, iterations: int = 1
) -> FilterRun:
    """The extended filter with a triangular factor of the covariance, by orthogonal transformations (Kaminski 1971).

    The factor cannot lose symmetry or positive definiteness, and carries twice the digits of the covariance. The
    prior and the process noise may be singular.
    """
    x, _, states, sigmas, squares = _start(system, state, covariance, measurements)
    runs, size = len(x), system.size
    outputs = measurements.shape[2]
    scale = np.sqrt(np.maximum(np.diag(covariance if covariance.ndim == 2 else covariance[0]), 1e-300))
    root = np.broadcast_to(_root(covariance, scale), (runs, size, size)).copy()
    noise_root = np.linalg.cholesky(system.measurement_covariance)
    for k in range(system.steps):
        x, phi = system.propagate(k, x)
        q = system.process_noise(k)
        stacked = np.swapaxes(phi @ root, -1, -2)
        if q.any():
            extra = np.broadcast_to(_root(q, scale).T, (runs, size, size))
            stacked = np.concatenate([stacked, extra], axis=1)
        root = np.swapaxes(np.linalg.qr(stacked / scale, mode="r"), -1, -2) * scale[:, None]
        point = x
        for i in range(iterations):
            predicted, h = system.observe(k, point)
            pre = np.zeros((runs, outputs + size, outputs + size))
            pre[:, :outputs, :outputs] = noise_root.T
            pre[:, outputs:, :outputs] = np.swapaxes(h @ root, -1, -2)
            pre[:, outputs:, outputs:] = np.swapaxes(root, -1, -2)
            post: np.ndarray = np.asarray(np.linalg.qr(pre, mode="r"))
            s_root, cross = (
                np.swapaxes(post[:, :outputs, :outputs], -1, -2),
                np.swapaxes(post[:, :outputs, outputs:], -1, -2),
            )
            innovation = measurements[:, k] - predicted - np.einsum("rij,rj->ri", h, x - point)
            white = np.linalg.solve(s_root, innovation[..., None])[..., 0]
            if i == 0:
                squares[:, k] = np.einsum("ri,ri->r", white, white)
            point = x + np.einsum("rij,rj->ri", cross, white)
        x = point
        root = np.swapaxes(post[:, outputs:, outputs:], -1, -2)
        states[:, k + 1] = x
        sigmas[:, k + 1] = np.sqrt(np.sum(root**2, axis=2))
    return FilterRun("square-root", states, sigmas, root @ np.swapaxes(root, -1, -2), squares, outputs)


def _root(matrix: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """A square root of a symmetric matrix that may be singular, computed in scaled coordinates."""
    scaled = matrix / np.outer(scale, scale)
    values, vectors = np.linalg.eigh(_symmetric(scaled))
    return scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))


def unscented_filter(
    system: DiscreteSystem,
    state: np.ndarray,
    covariance: np.ndarray,
    measurements: np.ndarray,
    *,
    spread: float = 1.0,
    fourth: float = 2.0,
    excess: float | None = None,
) -> FilterRun:
    """The unscented filter (Julier and Uhlmann 1997, scaled form of Wan and van der Merwe 2000).

    Args:
        spread, fourth, excess: alpha, beta and kappa of the scaled transformation; kappa is 3 - size by default with
            spread 1, which keeps the weight of the centre as published for Gaussian priors.
    """
    x, p, states, sigmas, squares = _start(system, state, covariance, measurements)
    runs, size, outputs = len(x), system.size, measurements.shape[2]
    excess = max(3.0 - size, 1.0 - size + 1e-3) if excess is None else excess
    excess = max(excess, 0.0) if spread == 1.0 else excess
    total = spread**2 * (size + excess)
    mean_weight = np.full(2 * size + 1, 0.5 / total)
    mean_weight[0] = 1 - size / total
    weight = mean_weight.copy()
    weight[0] += 1 - spread**2 + fourth
    scale = np.sqrt(np.maximum(np.diag(covariance if covariance.ndim == 2 else covariance[0]), 1e-300))
    r = system.measurement_covariance

    def points(x: np.ndarray, p: np.ndarray) -> np.ndarray:
        scaled = _symmetric(p / np.outer(scale, scale))
        values, vectors = np.linalg.eigh(scaled)
        root = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :] * np.sqrt(total)
        columns = np.swapaxes(root, -1, -2)
        return np.concatenate([x[:, None], x[:, None] + columns, x[:, None] - columns], axis=1)

    def mapped(function, k: int, cloud: np.ndarray) -> np.ndarray:  # type: ignore[no-untyped-def]
        flat = function(k, cloud.reshape(-1, size))[0]
        return flat.reshape(runs, 2 * size + 1, -1)

    for k in range(system.steps):
        cloud = mapped(system.propagate, k, points(x, p))
        x = np.einsum("j,rji->ri", mean_weight, cloud)
        away = cloud - x[:, None]
        p = _symmetric(np.einsum("j,rja,rjb->rab", weight, away, away) + system.process_noise(k))
        cloud = points(x, p)
        seen = mapped(system.observe, k, cloud)
        predicted = np.einsum("j,rji->ri", mean_weight, seen)
        spread_seen, away = seen - predicted[:, None], cloud - x[:, None]
        s = _symmetric(np.einsum("j,rja,rjb->rab", weight, spread_seen, spread_seen) + r)
        cross = np.einsum("j,rja,rjb->rab", weight, away, spread_seen)
        gain = np.swapaxes(np.linalg.solve(s, np.swapaxes(cross, -1, -2)), -1, -2)
        innovation = measurements[:, k] - predicted
        squares[:, k] = _square(innovation, s)
        x = x + np.einsum("rij,rj->ri", gain, innovation)
        p = _symmetric(p - gain @ s @ np.swapaxes(gain, -1, -2))
        states[:, k + 1] = x
        sigmas[:, k + 1] = np.sqrt(np.maximum(np.diagonal(p, axis1=1, axis2=2), 0.0))
    return FilterRun("unscented", states, sigmas, p, squares, outputs)


def smoothed(run: FilterRun) -> FilterRun:
    """The fixed-interval smoother of Rauch, Tung and Striebel over a filter run that kept its history.

    Raises:
        ValueError: the run kept no history.
    """
    if run.history is None:
        raise ValueError("run the filter with keep=True to smooth it")
    h = run.history
    state, covariance = run.state.copy(), h["covariance"].copy()
    for k in range(state.shape[1] - 2, -1, -1):
        before = h["covariance"][:, k] @ np.swapaxes(h["phi"][:, k], -1, -2)
        scale = np.sqrt(np.maximum(np.diagonal(h["predicted_covariance"][:, k], axis1=1, axis2=2), 1e-300))
        inner = h["predicted_covariance"][:, k] / (scale[:, :, None] * scale[:, None, :])
        gain = (
            np.swapaxes(np.linalg.solve(inner, np.swapaxes(before / scale[:, None, :], -1, -2)), -1, -2)
            / scale[:, None, :]
        )
        state[:, k] = run.state[:, k] + np.einsum("rij,rj->ri", gain, state[:, k + 1] - h["predicted"][:, k])
        covariance[:, k] = _symmetric(
            h["covariance"][:, k]
            + gain @ (covariance[:, k + 1] - h["predicted_covariance"][:, k]) @ np.swapaxes(gain, -1, -2)
        )
    sigma = np.sqrt(np.maximum(np.diagonal(covariance, axis1=2, axis2=3), 0.0))
    return FilterRun(f"smoother of {run.name}", state, sigma, covariance[:, 0], run.innovation_square, run.outputs)


def iterated_smoother(
    system: DiscreteSystem,
    state: np.ndarray,
    covariance: np.ndarray,
    measurements: np.ndarray,
    *,
    passes: int = 5,
    tolerance: float = 1e-3,
) -> FilterRun:
    """Smoothing passes, each linearized about the last smoothed motion, until it moves by less than ``tolerance``
    sigma.

    Its fixed point is the maximum of the posterior, the same as the joint batch's (Bell 1994).
    """
    run = smoothed(extended_filter(system, state, covariance, measurements, iterations=4, keep=True))
    for _ in range(passes):
        again = smoothed(extended_filter(system, state, covariance, measurements, keep=True, about=run.state))
        moved = float(np.max(np.abs(again.state - run.state) / np.maximum(again.sigma, 1e-300)))
        run = again
        if moved < tolerance:
            break
    return FilterRun("iterated smoother", run.state, run.sigma, run.covariance, run.innovation_square, run.outputs)
