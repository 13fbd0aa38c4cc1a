"""The rate of false names after the search over the whole library.

Under the accepted model the projected gradients of all candidates, all settings of searched parameters included, are
jointly Gaussian with a covariance that is known from their signatures. Drawing them simulates the whole search without
simulating data: the distribution of the smallest p-value over the library gives the number of independent looks that
the search amounts to, and from it the probability of a name where there is nothing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimator.chance import chi2_tail

DRAWS = 4000


def effective_looks(gram: np.ndarray, degrees: Sequence[int], places: Sequence[slice], *, draws: int = DRAWS,
                    seed: int = 20240301) -> float:
    """How many independent looks a search over these candidates amounts to.

    Args:
        gram: (m, m) products of the signature columns of all candidates and settings, calibration projected out.
        degrees: visible directions of each candidate.
        places: the columns of each.
        draws: simulated searches.
        seed: of the draws.

    Returns:
        N such that the probability of a smallest p-value below p is ``1 - (1 - p)^N`` near the 1 % level.
    """
    chosen = [(p, d) for p, d in zip(places, degrees, strict=True) if d > 0]
    if not chosen:
        return 1.0
    norms = np.sqrt(np.maximum(np.diag(gram), 0.0))
    norms[norms == 0] = 1.0
    correlation = gram / np.outer(norms, norms)
    whitening = np.zeros((len(gram), sum(d for _, d in chosen)))
    start = 0
    for place, degree in chosen:
        eigenvalues, vectors = np.linalg.eigh(correlation[place, place])
        whitening[place, start : start + degree] = \
            vectors[:, -degree:] / np.sqrt(np.maximum(eigenvalues[-degree:], 1e-300))
        start += degree
    covariance = whitening.T @ correlation @ whitening
    eigenvalues, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(eigenvalues, 0.0))
    samples = np.random.default_rng(seed).standard_normal((draws, len(eigenvalues))) @ root.T
    smallest = np.ones(draws)
    start = 0
    for _, degree in chosen:
        squares = np.sum(samples[:, start : start + degree] ** 2, axis=1)
        smallest = np.minimum(smallest, chi2_tail(squares, degree))
        start += degree
    level = float(np.quantile(smallest, 0.02))
    return float(max(1.0, np.log1p(-0.02) / np.log1p(-max(level, 1e-12))))


def after_search(p_value: float, looks: float) -> float:
    """Probability that the best of the whole library looks this good without any effect."""
    return float(-np.expm1(looks * np.log1p(-min(p_value, 1 - 1e-16))))
