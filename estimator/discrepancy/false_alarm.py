"""The rate of false names after the search over the whole library.

Under the accepted model the projected gradients of all candidates, all settings of searched parameters included, are
jointly Gaussian with a covariance that is known from their signatures. Drawing them simulates the whole search without
simulating data: the distribution of the smallest p-value over the library gives the number of independent looks that
the search amounts to, and from it the probability of a name where there is nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from estimator.chance import chi2_tail

DRAWS = 4000


@dataclass(frozen=True)
class Looks:
    """How many independent looks a search over a library amounts to.

    The level is shared among the names, not among their settings: a mode that is tried at dozens of frequencies must
    not cost an effect that is tried once the power to be seen.

    Attributes:
        own: by name, looks among the settings of its searched parameter; 1 where a name is not listed.
        names: looks among the names, each at its best setting.
    """

    own: Mapping[str, float] = field(default_factory=dict)
    names: float = 1.0

    def after(self, p_value: float, name: str) -> float:
        """Probability that noise makes any name as improbable, at its best setting, as this one is with ``p_value``."""
        return float(after_search(after_search(p_value, self.own.get(name, 1.0)), self.names))


def counted_looks(gram: np.ndarray, degrees: Sequence[int], places: Sequence[slice], names: Sequence[str], *,
                  draws: int = DRAWS, seed: int = 20240301) -> Looks:
    """How many independent looks a search over these candidates amounts to.

    Args:
        gram: (m, m) products of the signature columns of all candidates and settings, calibration projected out.
        degrees: visible directions of each candidate.
        places: the columns of each.
        names: the effect of each; candidates of one name are its settings.
        draws: simulated searches.
        seed: of the draws.

    Returns:
        Numbers N such that the probability of a smallest p-value below p is ``1 - (1 - p)^N`` near the 1 % level.
    """
    chosen = [(p, d, n) for p, d, n in zip(places, degrees, names, strict=True) if d > 0]
    if not chosen:
        return Looks()
    norms = np.sqrt(np.maximum(np.diag(gram), 0.0))
    norms[norms == 0] = 1.0
    correlation = gram / np.outer(norms, norms)
    whitening = np.zeros((len(gram), sum(d for _, d, _ in chosen)))
    start = 0
    for place, degree, _ in chosen:
        eigenvalues, vectors = np.linalg.eigh(correlation[place, place])
        whitening[place, start : start + degree] = \
            vectors[:, -degree:] / np.sqrt(np.maximum(eigenvalues[-degree:], 1e-300))
        start += degree
    covariance = whitening.T @ correlation @ whitening
    eigenvalues, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(eigenvalues, 0.0))
    samples = np.random.default_rng(seed).standard_normal((draws, len(eigenvalues))) @ root.T
    smallest: dict[str, np.ndarray] = {}
    start = 0
    for _, degree, name in chosen:
        squares = np.sum(samples[:, start : start + degree] ** 2, axis=1)
        smallest[name] = np.minimum(smallest.get(name, 1.0), chi2_tail(squares, degree))
        start += degree
    own = {name: _looks(values) for name, values in smallest.items() if list(names).count(name) > 1}
    whole = np.ones(draws)
    for name, values in smallest.items():
        whole = np.minimum(whole, after_search(values, own.get(name, 1.0)))
    return Looks(own, _looks(whole))


def _looks(smallest: np.ndarray) -> float:
    level = float(np.quantile(smallest, 0.02))
    return float(max(1.0, np.log1p(-0.02) / np.log1p(-max(level, 1e-12))))


def after_search(p_value: Any, looks: float) -> Any:
    """Probability that the best of so many independent looks is as good without any effect."""
    return -np.expm1(looks * np.log1p(-np.minimum(p_value, 1 - 1e-16)))
