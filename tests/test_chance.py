"""Tails and quantiles against scipy.stats."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2, ncx2, norm

from estimator import chance


def test_numbers_are_those_of_scipy_stats() -> None:
    value, degrees = np.geomspace(1e-3, 2e3, 60)[:, None], np.array([1, 2, 3, 10, 36, 500, 30_000])
    np.testing.assert_allclose(chance.chi2_tail(value, degrees), chi2.sf(value, degrees), rtol=1e-13)
    assert chance.chi2_tail(-1.0, 3) == 1.0
    level = np.array([1e-5, 3e-5, 0.02, 0.5, 0.99, 1 - 1e-6])[:, None]
    np.testing.assert_allclose(chance.chi2_quantile(level, degrees), chi2.ppf(level, degrees), rtol=1e-12)
    np.testing.assert_allclose(chance.normal_tail(np.linspace(-6, 30, 40)), norm.sf(np.linspace(-6, 30, 40)),
                               rtol=1e-13)
    for shift in (0.0, 0.3, 5.0, 80.0, 1e4):
        found = chance.noncentral_chi2_below(chi2.ppf(0.99, degrees[:5]), degrees[:5], shift)
        np.testing.assert_allclose(found, ncx2.cdf(chi2.ppf(0.99, degrees[:5]), degrees[:5], shift), atol=1e-9)
