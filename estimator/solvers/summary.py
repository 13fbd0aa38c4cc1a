"""From a converged point to an :class:`~estimator.estimate.Estimate`: covariance, consistency, status, sentence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from estimator.consistency import consistency
from estimator.estimate import Estimate, ResidualSummary, Status
from estimator.observability import weak_directions
from estimator.problem import NormalEquations, Problem, normal_equations
from estimator.residuals import Linearization, Residual

GAP_LEVEL = 1 - 6.3e-5
"""Two-sided level of the chi-square test of each residual (4 standard deviations)."""


def summarized(problem: Problem, values: Mapping[str, np.ndarray], parts: Sequence[Linearization], *, converged: bool,
               reason: str, iterations: int, solver: str, seconds: float,
               equations: NormalEquations | None = None) -> Estimate:
    """The estimate at ``values``, with everything that a user needs to trust it or not.

    Args:
        problem: what was solved, prepared at ``values``.
        values: the solution.
        parts: the linearizations at ``values``.
        converged: whether the solver met its tolerance.
        reason: the sentence when it did not.
        iterations, solver, seconds: for the record.
        equations: the normal equations at ``values`` where the solver has them.
    """
    free = problem.free
    equations = equations or normal_equations(problem, values, parts)
    scales = np.concatenate([np.zeros(0), *(u.scales for u in free)])
    weak = weak_directions(equations.matrix, free) if len(scales) else []
    covariance = _pseudo_inverse(equations.matrix, len(weak)) * np.outer(scales, scales)
    summaries = tuple(
        _summary(residual, part, covariance, share)
        for residual, part, share in zip(problem.residuals, parts, equations.shares, strict=True)
    )
    gaps = [s for s in summaries if s.consistency.verdict == "too large"]
    status, sentences = Status.OK, []
    if not converged:
        status = Status.NOT_CONVERGED
        sentences.append(reason)
    if gaps:
        status = max(status, Status.MODEL_GAP, key=lambda s: s.gravity)
        worst = sorted(gaps, key=lambda s: -s.consistency.ratio)
        named = ", ".join(f"{s.name} (chi2 per degree of freedom {s.consistency.ratio:.4g})" for s in worst[:6])
        sentences.append(f"the model does not explain the data in {named}")
    asked = [w for w in weak if any(not problem.unknown(n).nuisance for n in w.participation)]
    if asked:
        status = max(status, Status.UNOBSERVABLE, key=lambda s: s.gravity)
        sentences.append("the data do not determine " + "; ".join(w.sentence for w in asked))
    if not sentences:
        sentences.append(f"converged in {iterations} iterations; every residual agrees with its declared noise")
    return Estimate(problem, dict(values), covariance, tuple(weak), parts, summaries, status, ". ".join(sentences),
                    iterations, solver, seconds)


def _pseudo_inverse(matrix: np.ndarray, dropped: int) -> np.ndarray:
    if dropped == 0 and len(matrix):
        factor = np.linalg.inv(np.linalg.cholesky(matrix))
        return factor.T @ factor
    eigenvalues, vectors = np.linalg.eigh(matrix)
    kept = vectors[:, dropped:]
    return (kept / eigenvalues[dropped:]) @ kept.T


def _summary(residual: Residual, part: Linearization, covariance: np.ndarray,
             share: tuple[np.ndarray, np.ndarray] | None) -> ResidualSummary:
    used = 0.0
    if share is not None:
        place, matrix = share
        used = float(np.sum(matrix * covariance[np.ix_(place, place)]))
    total = float(np.sum(part.weight[:, None] * part.whitened**2))
    kept = part.weight > 0
    raw = part.residual
    mask = kept if len(kept) == len(raw) else np.ones(len(raw), dtype=bool)
    rms = float(np.sqrt(np.mean(raw[mask] ** 2))) if mask.any() else float("nan")
    rejected = int(len(raw) - mask.sum()) + int(getattr(residual, "rejected", 0))
    return ResidualSummary(residual.name, residual.channel, residual.unit, rms,
                           consistency(total, part.measurements - used, GAP_LEVEL), rejected)
