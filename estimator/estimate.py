"""What a solver returns: values, covariance, residuals, a status with its sentence, and what the data do not determine.

Covariance. Residuals are whitened by the declared noise, so the covariance is absolute: the inverse of the
Gauss-Newton matrix, not rescaled by the residuals. Along directions that the data do not determine (posterior over
prior sigma above one) the variance is infinite, and sigmas of unknowns that take part in such a direction are
reported as infinite rather than filled from a prior. Where ``chi2_per_dof`` says that the model does not explain the
data, the covariance is what it would be if it did: the status is then ``model_gap``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from estimator.consistency import Consistency
from estimator.observability import WeakDirection
from estimator.problem import Problem
from estimator.residuals import Linearization
from estimator.unknowns import Unknown, offsets


class Status(StrEnum):
    """How far an answer can be trusted, in rising gravity."""

    OK = "ok"
    UNOBSERVABLE = "unobservable"
    MODEL_GAP = "model_gap"
    NOT_CONVERGED = "not_converged"
    INFEASIBLE = "infeasible"
    BAD_INPUT = "bad_input"

    @property
    def gravity(self) -> int:
        return list(Status).index(self)


class EstimateError(RuntimeError):
    """Raised by :meth:`Estimate.raise_for_status` with the estimate's sentence."""


@dataclass(frozen=True, eq=False)
class ResidualSummary:
    """One residual after the fit: RMS in its unit and its consistency with the declared noise."""

    name: str
    channel: str
    unit: str
    rms: float
    consistency: Consistency
    rejected: int


@dataclass(frozen=True, eq=False)
class Estimate:
    """The answer of a solver.

    Attributes:
        problem: what was solved.
        values: ambient value of every unknown (held ones too).
        covariance: (p, p) of the stacked tangent of the free unknowns, physical units; directions that the data do
            not determine are projected out of it (see ``weak``).
        weak: directions that the data do not determine.
        parts: the linearization of each residual at the solution.
        summaries: one per residual.
        status, why: one word and its sentence.
        iterations: Gauss-Newton or interior-point iterations.
        solver: name of the solver.
        seconds: wall time.
    """

    problem: Problem
    values: Mapping[str, np.ndarray]
    covariance: np.ndarray
    weak: tuple[WeakDirection, ...]
    parts: Sequence[Linearization]
    summaries: tuple[ResidualSummary, ...]
    status: Status
    why: str
    iterations: int
    solver: str
    seconds: float

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        """The free unknowns, in the order of the covariance."""
        return self.problem.free

    def columns(self, name: str) -> slice:
        """Columns of an unknown in the covariance.

        Raises:
            KeyError: the unknown is held or does not exist.
        """
        return offsets(self.unknowns)[name]

    def covariance_of(self, name: str) -> np.ndarray:
        """Covariance (tangent, tangent) of one unknown, physical units; see the module on weak directions."""
        columns = self.columns(name)
        return self.covariance[columns, columns]

    def sigma_of(self, name: str) -> np.ndarray:
        """Standard deviation (tangent,) of one unknown; infinite where it takes part in an undetermined direction."""
        columns = self.columns(name)
        sigma = np.sqrt(np.maximum(np.diag(self.covariance)[columns], 0.0))
        for direction in self.weak:
            part = direction.vector[columns] ** 2
            sigma = np.where(part > 1e-4, np.inf, sigma)
        return sigma

    def chi_square_per_degree(self) -> float:
        """Sum of all whitened squares over all degrees of freedom."""
        total = sum(s.consistency.total for s in self.summaries)
        degrees = sum(s.consistency.degrees for s in self.summaries)
        return total / degrees if degrees > 0 else float("nan")

    def raise_for_status(self) -> Estimate:
        """The estimate itself when its status is ok.

        Raises:
            EstimateError: the status is anything else; the message is the estimate's sentence.
        """
        if self.status is not Status.OK:
            raise EstimateError(f"{self.status}: {self.why}")
        return self

    def __str__(self) -> str:
        lines = [f"{self.status}: {self.why}", "", f"{'unknown':<34}{'value':>18}{'sigma':>14}  unit"]
        for unknown in self.unknowns:
            if unknown.nuisance:
                continue
            sigma = self.sigma_of(unknown.name)
            value = np.asarray(self.values[unknown.name])
            if unknown.manifold.ambient == unknown.manifold.tangent:
                for label, v, s in zip(unknown.manifold.labels(), value, sigma, strict=True):
                    lines.append(f"{unknown.name + ' ' + label:<34}{v:>18.9g}{s:>14.3g}  {unknown.unit}")
            else:
                lines.append(f"{unknown.name:<34}" + " ".join(f"{v:.9f}" for v in value))
                for label, s in zip(unknown.manifold.labels(), sigma, strict=True):
                    lines.append(f"{'  ' + label:<34}{'':>18}{s:>14.3g}  {unknown.unit}")
        lines += ["", f"{'residual':<34}{'rms':>18}{'chi2/dof':>14}  unit"]
        for s in self.summaries:
            lines.append(f"{s.name:<34}{s.rms:>18.6g}{s.consistency.ratio:>14.4f}  {s.unit}")
        if self.weak:
            lines += ["", "not determined by the data:", *(f"  {w.sentence}" for w in self.weak)]
        return "\n".join(lines)
