"""The residuals of a fit as series of one arc each, with the rows that they have in the stacked problem."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimator.discrepancy.gap import _marked
from estimator.discrepancy.score import Stack
from estimator.problem import Problem
from estimator.residuals import KernelResidual, Linearization
from estimator.trajectory_residual import TrajectoryResidual


@dataclass(frozen=True, eq=False)
class ArcSeries:
    """Whitened residuals of one arc, or of one stretch of positions.

    Attributes:
        channel: kind of measurement.
        unit: of ``noise``.
        residual: name of the residual in the problem.
        arc: name of the arc.
        samples: (n,) indices of the samples in the residual.
        time: (n,) s, rising.
        whitened: (n, m) residuals, unit variance where the model is right.
        noise: (m,) root mean square of the noise of each component, in ``unit``.
        fitted: (n,) True for the samples in the fit, False for those held out.
        rows: (n, m) rows of the values in the stack; None for positions, which the trajectory has compressed.
        response: (n, m, m) whitened residuals (second axis) to one ``unit`` more in each measured component (last);
            errors that the components share tie them together.
    """

    channel: str
    unit: str
    residual: str
    arc: str
    samples: np.ndarray
    time: np.ndarray
    whitened: np.ndarray
    noise: np.ndarray
    fitted: np.ndarray
    rows: np.ndarray | None
    response: np.ndarray

    def training(self) -> ArcSeries:
        """The samples in the fit alone."""
        return self._only(self.fitted)

    def _only(self, mask: np.ndarray) -> ArcSeries:
        return ArcSeries(self.channel, self.unit, self.residual, self.arc, self.samples[mask], self.time[mask],
                         self.whitened[mask], self.noise, self.fitted[mask],
                         None if self.rows is None else self.rows[mask], self.response[mask])

    def where(self, mask: np.ndarray) -> ArcSeries:
        """The samples of the boolean mask (n,)."""
        return self._only(mask)


def series_of(problem: Problem, parts: Sequence[Linearization], stacked: Stack, channel: str) -> list[ArcSeries]:
    """The arcs of a channel in order of time, samples in the fit and held-out ones.

    Args:
        problem: the accepted problem.
        parts: its linearizations at the fit.
        stacked: its rows at the fit.
        channel: kind of measurement.
    """
    found: list[ArcSeries] = []
    for residual, part in zip(problem.residuals, parts, strict=True):
        if residual.channel != channel:
            continue
        scale = stacked.scale[residual.name]
        if isinstance(residual, KernelResidual):
            width = part.whitened.shape[1]
            noise = np.sqrt(np.mean(residual.standard_deviation**2, axis=0)) * np.ones(width)
            response = residual.factor if residual.factor is not None else _diagonal(residual.standard_deviation, width)
            held = np.zeros(residual.samples, dtype=bool) if residual.accepted is None else ~residual.accepted
            for label, name in enumerate(residual.arc_names):
                inside = np.flatnonzero((residual.arc == label) & ((part.weight > 0) | held))
                inside = inside[np.argsort(residual.time[inside], kind="stable")]
                if len(inside) == 0:
                    continue
                rows = stacked.blocks[residual.name].start + inside[:, None] * width + np.arange(width)
                found.append(ArcSeries(channel, residual.unit, residual.name, name, inside, residual.time[inside],
                                       part.whitened[inside] / scale, noise, ~held[inside], rows,
                                       response[inside] / scale))
        elif isinstance(residual, TrajectoryResidual):
            used = residual.weights[:, 0] > 0
            noise = np.sqrt(np.mean(residual.standard_deviation**2, axis=0))
            whitened = part.residual / residual.standard_deviation
            # Held-out blocks lie between the samples of a stretch: each belongs to the stretch around it.
            places = np.flatnonzero(used)
            for name, inside in _marked(residual, used):
                first, last = places[inside[0]], places[inside[-1]]
                samples = np.arange(first, last + 1)
                found.append(ArcSeries(channel, residual.unit, residual.name, name, samples, residual.time[samples],
                                       whitened[samples], noise, used[samples], None,
                                       _diagonal(np.asarray(residual.standard_deviation)[samples], 3)))
    return sorted(found, key=lambda s: float(s.time[0]))


def _diagonal(standard_deviation: np.ndarray, width: int) -> np.ndarray:
    whole = np.zeros((len(standard_deviation), width, width))
    whole[:, range(width), range(width)] = 1.0 / standard_deviation
    return whole
