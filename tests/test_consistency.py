"""Verdicts on sums of squares: right level, power where there is some, and "not enough data" where there is none."""

from __future__ import annotations

import math

import numpy as np
import pytest

from estimator.consistency import ENOUGH, consistency


def test_level_over_many_draws():
    """3000 draws of 50 unit normals: 5 percent of consistent sums fall outside the 95 percent band."""
    totals = np.random.default_rng(0).chisquare(50, 3_000)
    outside = np.mean([consistency(t, 50, 0.95).verdict != "consistent" for t in totals])
    assert outside == pytest.approx(0.05, abs=4 * math.sqrt(0.05 * 0.95 / 3_000))


def test_verdicts():
    assert consistency(100.0, 100).verdict == "consistent"
    assert consistency(200.0, 100).verdict == "too large"
    assert consistency(40.0, 100).verdict == "too small"
    # Few degrees can only be found too large.
    assert consistency(200.0, ENOUGH - 5).verdict == "too large"
    assert consistency(5.0, ENOUGH - 5).verdict == "not enough data"
    nothing = consistency(0.0, 0.0)
    assert nothing.verdict == "not enough data"
    assert math.isnan(nothing.ratio)
    assert nothing.deviation == 0.0


def test_deviation_counts_standard_deviations():
    rng = np.random.default_rng(1)
    for k in (5, 50, 5000):
        deviations = [consistency(t, k).deviation for t in rng.chisquare(k, 1500)]
        assert np.mean(deviations) == pytest.approx(0.0, abs=0.12)
        assert np.std(deviations) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("verdict_band", [0.9, 0.99, 0.9999])
def test_band_holds_one_and_widens_with_the_level(verdict_band):
    c = consistency(80.0, 80, verdict_band)
    assert c.low < 1 < c.high
    wider = consistency(80.0, 80, (1 + verdict_band) / 2)
    assert wider.low < c.low and wider.high > c.high
