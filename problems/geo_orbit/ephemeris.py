"""The estimated orbit as an ephemeris over the span of the data."""

from __future__ import annotations

import numpy as np

from estimator.orbit_signal import OrbitSignal
from estimator.residuals import KernelResidual
from problems.geo_orbit.solution import OrbitSolution
from problems.readers.tracking_ccsds import Ephemeris


def ephemeris_of(solution: OrbitSolution, step: float = 120.0) -> Ephemeris:
    """States every ``step`` seconds over the span of the data, in the frame of the answer."""
    model, estimate = solution.model, solution.estimate
    a, b = min(model.span[0], 0.0), max(model.span[1], 0.0)
    time = np.unique(np.append(np.arange(np.ceil(a), b, step), b))
    residual = estimate.problem.residuals[0]
    assert isinstance(residual, KernelResidual)
    signal = residual.signals[0]
    assert isinstance(signal, OrbitSignal)
    state, _ = signal.arc.at(time, estimate.values)
    turn = np.kron(np.eye(2), solution._turn())
    tai = model.epoch + np.round(time * 1e6).astype("timedelta64[us]")
    name = model.tracking.satellite or "SATELLITE"
    return Ephemeris(name, name, solution.frame, tai, state @ turn.T)
