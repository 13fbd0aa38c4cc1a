"""Is a sum of squares what its number of terms says? A verdict with bounds and sample size, never a bare ratio."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from estimator.chance import chi2_quantile

ENOUGH = 35  # degrees of freedom below which a normalized sum of squares has little power


@dataclass(frozen=True)
class Consistency:
    """A normalized sum of squares (NIS of residuals, NEES of errors) against its chi-square distribution.

    Attributes:
        total: sum of squares.
        degrees: degrees of freedom.
        low, high: bounds of ``total / degrees`` at the stated level.
        level: probability inside the bounds.
        verdict: "consistent", "too large" (the model does not explain the data, or the sigmas are too small),
            "too small" (the sigmas are too large), or "not enough data".
    """

    total: float
    degrees: float
    low: float
    high: float
    level: float
    verdict: Literal["consistent", "too large", "too small", "not enough data"]

    @property
    def ratio(self) -> float:
        """Sum of squares per degree of freedom; NaN without any."""
        return self.total / self.degrees if self.degrees > 0 else float("nan")

    @property
    def deviation(self) -> float:
        """How many standard deviations ``total`` is away from ``degrees`` (normal approximation of Wilson-Hilferty)."""
        if self.degrees <= 0:
            return 0.0
        k = self.degrees
        return float(((self.total / k) ** (1 / 3) - (1 - 2 / (9 * k))) / np.sqrt(2 / (9 * k)))


def consistency(total: float, degrees: float, level: float = 0.9999) -> Consistency:
    """The verdict on a sum of squares of ``degrees`` unit normals.

    Args:
        total: the sum of squares.
        degrees: degrees of freedom; fewer than ``ENOUGH`` can only be found too large.
        level: probability inside the bounds for a consistent sum.
    """
    if degrees < 1:
        return Consistency(total, degrees, 0.0, float("inf"), level, "not enough data")
    low = float(chi2_quantile((1 - level) / 2, degrees) / degrees)
    high = float(chi2_quantile((1 + level) / 2, degrees) / degrees)
    ratio = total / degrees
    verdict: Literal["consistent", "too large", "too small", "not enough data"] = "consistent"
    if ratio > high:
        verdict = "too large"
    elif degrees < ENOUGH:
        verdict = "not enough data"
    elif ratio < low:
        verdict = "too small"
    return Consistency(total, degrees, low, high, level, verdict)
