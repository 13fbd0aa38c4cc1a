"""Residuals: a small per-sample CasADi kernel, its data, its noise; whitening and loss are separate.

A :class:`KernelResidual` maps one kernel over many samples. The kernel gives ``r`` (measured minus predicted, in the
channel's unit) from the unknowns (ambient coordinates), signals, data and noise inputs of ONE sample; the kernel is
differentiated once and then mapped, and its Jacobian is chained with the signals' outside.

Noise inputs stand for measured quantities that enter the prediction (the attitude of an epoch inside a Doppler
residual). They are nuisance unknowns, one set per sample, and are eliminated: minimizing over a Gaussian noise input
``e`` of covariance P is, around any ``e0``, the same as whitening ``r(e0) - H e0`` with ``R + H P H'``, H being the
kernel's Jacobian along it at ``e0``. With ``e0`` at the minimum the elimination is exact: cost and gradient are those
of the joint problem in which every ``e`` is an unknown. Taken at ``e0 = 0`` instead, measurement noise would enter the
Jacobians and correlate with the residuals, which biases what is estimated (Boggs, Byrd, Schnabel 1987, A stable and
efficient algorithm for nonlinear orthogonal distance regression).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import casadi as ca
import numpy as np

from estimator.losses import Loss, Quadratic
from estimator.models.compiled import compiled
from estimator.models.loops import Mapped
from estimator.signals import Signal, Values
from estimator.unknowns import Manifold, Unknown

NOISE_ITERATIONS = 5  # re-estimates of the noise inputs; each gains the digits of a Newton step
NOISE_TOLERANCE = 1e-7  # sigma: change of a noise input below which its estimate stands
LARGEST_NOISE = 6.0  # sigma: an outlier must not turn the point of linearization without bound


@dataclass(frozen=True, eq=False)
class Linearization:
    """A residual and its Jacobian at one point.

    Attributes:
        residual: (n, m) in the unit of the channel, measured minus predicted.
        whitened: (n, m), unit variance where the model is right; not weighted by the loss.
        jacobian: (n, m, p) of the whitened residual along the tangent columns.
        columns: the unknowns of the p columns, in order.
        weight: (n,) weight of each sample from the loss and from rejections.
        cost: sum of the loss over the samples (twice the negative log-likelihood for the quadratic loss).
        measurements: number of scalar measurements behind it (rows may have been compressed).
    """

    residual: np.ndarray
    whitened: np.ndarray
    jacobian: np.ndarray
    columns: tuple[Unknown, ...]
    weight: np.ndarray
    cost: float
    measurements: float


class Residual(Protocol):
    """One channel's (or one arc's) part of the joint cost."""

    @property
    def name(self) -> str: ...

    @property
    def channel(self) -> str: ...

    @property
    def unit(self) -> str: ...

    @property
    def unknowns(self) -> tuple[Unknown, ...]: ...

    def linearize(self, values: Values, only: Collection[str] | None = None) -> Linearization:
        """The residual and its Jacobian; with ``only`` the columns of those unknowns, where that is cheaper."""

    def prepared(self, values: Values) -> Residual:
        """The same residual with whitening (and compressed robust weights) taken at ``values``."""

    def symbolic(self, values: Mapping[str, ca.MX]) -> ca.MX:
        """The whitened residual as one CasADi column, with whitening frozen as prepared."""


class Kernel:
    """A per-sample residual function with its Jacobians in tangent coordinates, compiled once.

    Args:
        name: a C identifier.
        unknowns: unknowns that enter directly, each an input of its name.
        signals: (name, manifold) of the signals that enter.
        data: (name, size) of per-sample data; (name, (rows, columns)) for matrices.
        noise: (name, size) of noise inputs; zero where a call does not give them.
        build: from a dict of input name to SX symbol to the residual (m) as SX.
    """

    def __init__(self, name: str, unknowns: Sequence[Unknown], signals: Sequence[tuple[str, Manifold]],
                 data: Sequence[tuple[str, int | tuple[int, int]]], noise: Sequence[tuple[str, int]], build: object):
        self.unknowns, self.signals, self.noise = tuple(unknowns), tuple(signals), tuple(noise)
        inputs: dict[str, ca.SX] = {}
        seen: dict[str, ca.SX] = {}
        steps: list[tuple[str, ca.SX]] = []
        for label, manifold in [*((u.name, u.manifold) for u in unknowns), *signals]:
            symbol = ca.SX.sym("x", manifold.ambient)
            step = ca.SX.sym("d", manifold.tangent)
            inputs[label] = symbol
            seen[label] = manifold.retract(symbol, step)
            steps.append((label, step))
        for label, size in data:
            inputs[label] = seen[label] = ca.SX.sym("u", *(size if isinstance(size, tuple) else (size, 1)))
        zeros = [step for _, step in steps]
        for label, size in noise:
            inputs[label], step = ca.SX.sym("e", size), ca.SX.sym("d", size)
            seen[label] = inputs[label] + step
            steps.append((label, step))
            zeros.append(step)
        residual = ca.densify(ca.SX(build(seen)))  # type: ignore[operator]
        self.size = residual.shape[0]
        stacked = ca.vertcat(*zeros)
        at_zero = ca.substitute([residual, *(ca.jacobian(residual, s) for _, s in steps)], [stacked],
                                [ca.SX.zeros(stacked.shape)])
        labels = list(inputs)
        outputs = [ca.densify(o) for o in at_zero]
        function = ca.Function(name, [inputs[k] for k in labels], outputs, [f"i{j}" for j in range(len(labels))],
                               ["residual", *(f"j{j}" for j in range(len(steps)))])
        self.labels = labels
        self.steps = [label for label, _ in steps]
        self.expression = function  # machine code cannot be differentiated again
        self.function = compiled(function)
        shared = tuple(f"i{labels.index(u.name)}" for u in unknowns)
        self.mapped = Mapped(self.function, shared)

    def __call__(self, samples: int, inputs: Mapping[str, np.ndarray]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Residual (n, m) and the Jacobian (n, m, tangent) along each unknown, signal and noise input."""
        absent = {label: np.zeros((samples, size)) for label, size in self.noise if label not in inputs}
        given = {**inputs, **absent}
        named = {f"i{j}": given[label] for j, label in enumerate(self.labels)}
        residual, *jacobians = self.mapped(samples, **named)
        shaped = {}
        for label, jacobian in zip(self.steps, jacobians, strict=True):
            shaped[label] = jacobian if jacobian.ndim == 3 else jacobian[:, :, None]
        return residual, shaped


@dataclass(frozen=True, eq=False)
class KernelResidual:
    """A kernel over ``n`` samples with their data and noise.

    Attributes:
        name: for reports ("doppler", "star_tracker:free-1").
        channel: the kind of measurement ("doppler", "star_tracker").
        unit: of the raw residual.
        kernel: the compiled kernel.
        signals: what feeds the kernel's signal inputs.
        data: per-sample arrays by input name.
        standard_deviation: (n, m) of the measurement, in ``unit``.
        noise: (n, size) standard deviation of each noise input.
        time: (n,) s.
        arc: (n,) index of the arc of each sample, into ``arc_names``.
        loss: robust loss.
        accepted: (n,) False for rejected samples, which keep their place and lose their weight.
        factor: (n, m, m) inverse symmetric root of the covariance, or None before :meth:`prepared`.
        estimated: (n, size) estimate of each noise input, around which the kernel is linearized; empty before
            :meth:`prepared`.
        offset: (n, m) part of the residual that the estimates explain, in ``unit``.
    """

    name: str
    channel: str
    unit: str
    kernel: Kernel
    signals: tuple[Signal, ...]
    data: Mapping[str, np.ndarray]
    standard_deviation: np.ndarray
    time: np.ndarray
    arc: np.ndarray
    arc_names: tuple[str, ...]
    noise: Mapping[str, np.ndarray] = field(default_factory=dict)
    loss: Loss = field(default_factory=Quadratic)
    accepted: np.ndarray | None = None
    factor: np.ndarray | None = None
    estimated: Mapping[str, np.ndarray] = field(default_factory=dict)
    offset: np.ndarray | None = None

    @property
    def samples(self) -> int:
        return len(self.time)

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        ordered = dict.fromkeys([*self.kernel.unknowns, *(u for s in self.signals for u in s.unknowns)])
        return tuple(ordered)

    def _inputs(self, values: Values) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Inputs of the kernel, and the Jacobian of each signal."""
        inputs: dict[str, np.ndarray] = {**self.data, **self.estimated}
        inputs.update({u.name: values[u.name] for u in self.kernel.unknowns})
        signal_jacobians = {}
        for signal in self.signals:
            inputs[signal.name], signal_jacobians[signal.name] = signal.evaluate(values)
        return inputs, signal_jacobians

    def _covariance(self, jacobians: Mapping[str, np.ndarray]) -> np.ndarray:
        n, m = self.standard_deviation.shape
        covariance = np.zeros((n, m, m))
        covariance[:, range(m), range(m)] = self.standard_deviation**2
        for label, sigma in self.noise.items():
            spread = jacobians[label] * sigma[:, None, :]
            covariance += spread @ spread.transpose(0, 2, 1)
        return covariance

    def prepared(self, values: Values) -> KernelResidual:
        """The residual with the noise inputs estimated and the whitening taken at ``values``."""
        if not self.noise:
            if self.factor is not None:
                return self
            n, m = self.standard_deviation.shape
            factor = np.zeros((n, m, m))
            factor[:, range(m), range(m)] = 1.0 / self.standard_deviation
            return replace(self, factor=factor)
        inputs, _ = self._inputs(values)
        estimated = {label: self.estimated.get(label, np.zeros_like(sigma)) for label, sigma in self.noise.items()}
        for iteration in range(NOISE_ITERATIONS):
            residual, jacobians = self.kernel(self.samples, {**inputs, **estimated})
            covariance = self._covariance(jacobians)
            offset = sum(np.einsum("nij,nj->ni", jacobians[label], e) for label, e in estimated.items())
            weighted = np.linalg.solve(covariance, (residual - offset)[:, :, None])[:, :, 0]
            found = {label: np.clip(-(sigma**2) * np.einsum("nij,ni->nj", jacobians[label], weighted),
                                    -LARGEST_NOISE * sigma, LARGEST_NOISE * sigma)
                     for label, sigma in self.noise.items()}
            change = max(float(np.max(np.abs(found[label] - estimated[label]) / sigma, initial=0.0))
                         for label, sigma in self.noise.items())
            if change < NOISE_TOLERANCE or iteration == NOISE_ITERATIONS - 1:
                break
            estimated = found
        # The symmetric root keeps each component of the whitened residual closest to the component it came from, so
        # that structure in one beam shows in that beam.
        eigenvalues, vectors = np.linalg.eigh(covariance)
        factor = (vectors / np.sqrt(eigenvalues)[:, None, :]) @ vectors.transpose(0, 2, 1)
        return replace(self, factor=factor, estimated=estimated, offset=np.asarray(offset))

    def linearize(self, values: Values, only: Collection[str] | None = None) -> Linearization:
        if self.factor is None:
            return self.prepared(values).linearize(values, only)
        factor = self.factor
        inputs, signal_jacobians = self._inputs(values)
        residual, jacobians = self.kernel(self.samples, inputs)
        if self.offset is not None:
            residual = residual - self.offset
        columns = tuple(u for u in self.unknowns if only is None or u.name in only)
        width = {u.name: u.manifold.tangent for u in columns}
        starts = dict(zip(width, np.cumsum([0, *width.values()]), strict=False))
        jacobian = np.empty((self.samples, self.kernel.size, sum(width.values())))
        written: set[str] = set()

        def add(unknown: Unknown, block: np.ndarray) -> None:
            place = jacobian[:, :, starts[unknown.name] : starts[unknown.name] + width[unknown.name]]
            if unknown.name in written:
                place += block
            else:
                place[:] = block
                written.add(unknown.name)

        for unknown in self.kernel.unknowns:
            if unknown.name in width:
                add(unknown, factor @ jacobians[unknown.name])
        for signal in self.signals:
            if not any(u.name in width for u in signal.unknowns):
                continue
            outer = factor @ jacobians[signal.name]
            chained = outer @ signal_jacobians[signal.name] if only is None else None
            position = 0
            for unknown in signal.unknowns:
                place = slice(position, position + unknown.manifold.tangent)
                position = place.stop
                if unknown.name in width:
                    add(unknown, chained[:, :, place] if chained is not None
                        else outer @ signal_jacobians[signal.name][:, :, place])
        whitened = np.einsum("nij,nj->ni", factor, residual)
        square = np.einsum("ni,ni->n", whitened, whitened)
        keep = np.ones(self.samples) if self.accepted is None else self.accepted.astype(float)
        return Linearization(
            residual=residual,
            whitened=whitened,
            jacobian=jacobian,
            columns=columns,
            weight=self.loss.weight(square) * keep,
            cost=float(np.sum(self.loss.value(square) * keep)),
            measurements=float(keep.sum() * self.kernel.size),
        )

    def symbolic(self, values: Mapping[str, ca.MX]) -> ca.MX:
        n, m = self.samples, self.kernel.size
        inputs: dict[str, ca.MX] = {}
        known = {**self.data, **self.estimated}
        for label in self.kernel.labels:
            if label in known:
                array = np.asarray(known[label], dtype=float)
                flat = array.reshape(n, -1) if array.ndim < 3 else None
                stacked = flat.T if flat is not None else np.concatenate(list(array), axis=1)
                inputs[label] = ca.MX(ca.DM(stacked))
        for unknown in self.kernel.unknowns:
            inputs[unknown.name] = ca.repmat(values[unknown.name], 1, n)
        for signal in self.signals:
            inputs[signal.name] = signal.symbolic(values)
        if self.factor is None:
            raise ValueError("prepare the residual before asking for its symbolic form")
        raw = self.kernel.expression.map(n).call([inputs[label] for label in self.kernel.labels])[0]
        if self.offset is not None:
            raw -= ca.MX(ca.DM(self.offset.T))
        rows = [ca.sum1(ca.DM(self.factor[:, i, :].T) * raw) for i in range(m)]
        return ca.vec(ca.vertcat(*rows))

    def subset(self, keep: np.ndarray) -> KernelResidual:
        """The residual of the samples of the boolean mask ``keep`` (n,)."""
        return replace(
            self,
            signals=tuple(s.subset(keep) for s in self.signals),
            data={k: np.asarray(v)[keep] for k, v in self.data.items()},
            standard_deviation=self.standard_deviation[keep],
            noise={k: v[keep] for k, v in self.noise.items()},
            time=self.time[keep],
            arc=self.arc[keep],
            accepted=None if self.accepted is None else self.accepted[keep],
            factor=None if self.factor is None else self.factor[keep],
            estimated={k: v[keep] for k, v in self.estimated.items()},
            offset=None if self.offset is None else self.offset[keep],
        )

    def with_data(self, **data: np.ndarray) -> KernelResidual:
        """The residual with some of its data replaced (a simulation draws new measurements)."""
        return replace(self, data={**self.data, **data})
