"""Robust losses: the weight is the slope, small residuals are untouched, large ones are bounded as each loss says."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.losses import LOSSES, Barron, Cauchy, Huber, Quadratic

EVERY = {**LOSSES, "Geman-McClure": Barron(-2.0, 2.0), "smooth Huber": Barron(1.0, 1.5), "Barron 2": Barron(2.0)}
SQUARES = np.concatenate([np.logspace(-6, 6, 61), [2.4**2, 2.6**2]])


@pytest.mark.parametrize("loss", EVERY.values(), ids=EVERY)
def test_weight_is_the_slope_of_the_loss(loss):
    h = 1e-5 * SQUARES
    slope = (loss.value(SQUARES + h) - loss.value(SQUARES - h)) / (2 * h)
    np.testing.assert_allclose(loss.weight(SQUARES), slope, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("loss", EVERY.values(), ids=EVERY)
def test_small_residuals_count_in_full(loss):
    assert loss.value(np.zeros(1))[0] == pytest.approx(0.0, abs=1e-12)
    small = np.array([1e-6])
    np.testing.assert_allclose(loss.value(small), small, rtol=1e-5)
    np.testing.assert_allclose(loss.weight(small), 1.0, rtol=1e-5)


@pytest.mark.parametrize("loss", EVERY.values(), ids=EVERY)
def test_loss_rises_and_weight_falls(loss):
    assert np.all(np.diff(loss.value(np.sort(SQUARES))) > 0)
    assert np.all(np.diff(loss.weight(np.sort(SQUARES))) <= 1e-15)
    assert np.all((loss.weight(SQUARES) > 0) & (loss.weight(SQUARES) <= 1.0))


def test_influence_of_a_gross_outlier():
    # Influence = weight times whitened residual: grows, levels off, or vanishes.
    far = np.array([1e8])  # (10^4 sigma)^2
    assert Quadratic().weight(far) * np.sqrt(far) == pytest.approx(1e4)
    assert Huber(2.5).weight(far) * np.sqrt(far) == pytest.approx(2.5)
    assert Cauchy(3.0).weight(far) * np.sqrt(far) == pytest.approx(9e-4, rel=1e-3)
    assert Barron(-2.0).value(far) == pytest.approx(4 * 9.0, rel=1e-3)  # Geman-McClure saturates


def test_family_holds_its_members():
    s = SQUARES
    np.testing.assert_allclose(Barron(2.0, 3.0).value(s), Quadratic().value(s))
    # Shape 0 is the limit of small shapes, and Cauchy's loss with sqrt(2) times the threshold.
    np.testing.assert_allclose(Barron(1e-6, 3.0).value(s), Barron(0.0, 3.0).value(s), rtol=1e-4)
    np.testing.assert_allclose(Barron(0.0, 3.0).value(s), Cauchy(3.0 * np.sqrt(2)).value(s))
    np.testing.assert_allclose(Barron(-2.0, 3.0).value(s), 4 * 9 * (s / 9) / (s / 9 + 4), rtol=1e-12)
    np.testing.assert_allclose(Barron(1.0, 3.0).value(s), 2 * 9 * (np.sqrt(s / 9 + 1) - 1), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(Barron(2 - 1e-9, 3.0).value(s), s, rtol=1e-4)
