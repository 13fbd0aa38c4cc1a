"""The linear block against a dense decomposition, its statistics against Monte Carlo."""

from __future__ import annotations

import numpy as np

from estimator.linear_block import compress
from estimator.models.fourier_trajectory import FourierFrame


def test_agrees_with_a_dense_decomposition() -> None:
    generator = np.random.default_rng(3)
    time = np.sort(generator.uniform(0.0, 100.0, 800))
    frame = FourierFrame(0.0, 100.0, 6)
    values = np.stack([np.cos(0.05 * time), np.exp(0.01 * time)], 1) * 1e3 + generator.normal(size=(800, 2))
    weights = np.ones((800, 2)) * [1.0, 4.0]
    block = compress(frame, time, values, weights)
    dense, *_ = np.linalg.lstsq(frame.basis(time), values, rcond=None)
    np.testing.assert_allclose(block.values(time), frame.basis(time) @ dense, atol=1e-7)
