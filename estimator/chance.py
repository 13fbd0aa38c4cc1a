"""Tails and quantiles of the distributions that tests of significance use.

From ``scipy.special`` alone: ``scipy.stats`` has the same numbers, takes half a second to import and a hundred times as
long for each one.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import special

# A number gives a number, an array an array.


def chi2_tail(value: Any, degrees: Any) -> Any:
    """Probability that chi-square of so many degrees of freedom exceeds ``value``."""
    return special.chdtrc(degrees, np.maximum(value, 0.0))


def chi2_quantile(probability: Any, degrees: Any) -> Any:
    """The value that chi-square of so many degrees of freedom stays below with this probability."""
    return 2 * special.gammaincinv(0.5 * np.asarray(degrees), probability)


def noncentral_chi2_below(value: Any, degrees: Any, shift: Any) -> Any:
    """Probability that chi-square of so many degrees of freedom, shifted by ``shift``, stays below ``value``."""
    return special.chndtr(value, degrees, shift)


def normal_tail(value: Any) -> Any:
    """Probability that a standard normal number exceeds ``value``."""
    return special.ndtr(-np.asarray(value))
