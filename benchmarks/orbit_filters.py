"""The book's study: every filter at one and three sigma, with and without a burn, and the joint batch at the bound.

Run ``python -m benchmarks.orbit_filters [--runs N] [--bound-runs N] [--step S] [--out FILE.json]``.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from estimator.solvers.recursive_filters import (
    FilterRun,
    extended_filter,
    iterated_smoother,
    linear_filter,
    schmidt_filter,
    square_root_filter,
    unscented_filter,
)
from problems.geo_orbit.book import SIZE, BookCase, BookSystem, Simulated, position_errors, simulate
from problems.geo_orbit.book_batch import batch_bound, batch_estimate, stacked


def _row(system: BookSystem, simulated: Simulated, run: FilterRun, seconds: float, at: int = -1) -> dict[str, Any]:
    scale = np.array([1.0, system.case.radius, system.case.radius])
    error = position_errors(system.case, simulated.truth, run.state)[:, at]
    sigma = np.linalg.norm(run.sigma[:, at, :3] * scale, axis=1)
    return {
        "filter": run.name,
        "error_km": float(np.median(error)) / 1e3,
        "sigma_km": float(np.median(sigma)) / 1e3,
        "error_over_sigma": float(np.median(error / sigma)),
        "diverged": int(run.diverged().sum()),
        "runs": len(error),
        "seconds": seconds,
    }


def _works(system: BookSystem, simulated: Simulated) -> dict[str, Callable[[], FilterRun]]:
    """Every filter on one set of realizations, by name."""
    case, z = system.case, simulated.measurements
    start, covariance = case.first_state, np.diag(case.prior**2)
    nominal, matrices = system.stationary_motion()
    others = range(6, SIZE)
    return {
        "linear": lambda: linear_filter(system, nominal, matrices, start, covariance, z),
        "extended": lambda: extended_filter(system, start, covariance, z),
        "inflated": lambda: extended_filter(BookSystem(case, 1e-8), start, covariance, z),
        "iterated": lambda: extended_filter(system, start, covariance, z, iterations=4),
        "square-root": lambda: square_root_filter(system, start, covariance, z, iterations=4),
        "schmidt": lambda: schmidt_filter(system, start, covariance, z, others),
        "schmidt-iterated": lambda: schmidt_filter(system, start, covariance, z, others, iterations=4),
        "unscented": lambda: unscented_filter(system, start, covariance, z),
        "smoother": lambda: iterated_smoother(system, start, covariance, z),
    }


def filters(runs: int, step: float, seed: int) -> list[dict[str, Any]]:
    """Every filter for each first deviation and with and without a burn."""
    rows = []
    for stationary in (False, True):
        for burn in ((0.0, 0.0), (20000.0, 23600.0)):
            for deviation in (1.0, 3.0):
                case = BookCase(step=step, burn=burn, stationary=stationary)
                system = BookSystem(case)
                simulated = simulate(system, runs, seed, deviation=deviation, kind="exact")
                tried = _works(system, simulated)
                for name, work in tried.items():
                    began = time.perf_counter()
                    row = _row(system, simulated, work(), time.perf_counter() - began)
                    row |= {
                        "filter": name,
                        "deviation_sigma": deviation,
                        "burn_s": burn[1] - burn[0],
                        "orbit": "stationary" if stationary else "book",
                    }
                    rows.append(row)
                    print(
                        f"{row['orbit']:<11}{row['deviation_sigma']:>4.0f} sigma  burn {row['burn_s']:>5.0f} s  "
                        f"{name:<18}error {row['error_km']:>11.3f} km  sigma {row['sigma_km']:>7.3f} km  ratio "
                        f"{row['error_over_sigma']:>9.2f}  diverged {row['diverged']}/{row['runs']}",
                        flush=True,
                    )
    return rows


def bound(runs: int, step: float, seed: int) -> dict[str, Any]:
    """Joint batch against the Cramer-Rao bound over many realizations: ratio of errors, mean of NEES."""
    case = BookCase(step=step, burn=(20000.0, 23600.0))
    system = BookSystem(case)
    simulated = simulate(system, runs, seed)
    ratios, squares = [], []
    for r in range(runs):
        estimate = batch_estimate(system, simulated.measurements[r])
        error = stacked(estimate) - simulated.truth[r, 0]
        limit = batch_bound(system, simulated.truth[r, 0])
        ratios.append(error**2 / np.diag(limit))
        scale = case.prior
        inner = estimate.covariance / np.outer(scale, scale)
        squares.append(float(error / scale @ np.linalg.solve(inner, error / scale)))
    return {
        "runs": runs,
        "ratio": float(np.sqrt(np.mean(ratios))),
        "ratio_per_component": np.sqrt(np.mean(ratios, axis=0)).tolist(),
        "nees_over_size": float(np.mean(squares)) / SIZE,
        "nees_sigma": float(np.sqrt(2 / (SIZE * runs))),
    }


def main() -> None:
    """Run both parts and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=8)
    parser.add_argument("--bound-runs", type=int, default=200)
    parser.add_argument("--step", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", choices=("filters", "bound"), default=None)
    parser.add_argument("--out", type=Path, default=None)
    arguments = parser.parse_args()
    result: dict[str, Any] = {}
    if arguments.only != "filters":
        result["bound"] = bound(arguments.bound_runs, arguments.step, arguments.seed)
        print(json.dumps(result["bound"]), flush=True)
    if arguments.only != "bound":
        result["filters"] = filters(arguments.runs, arguments.step, arguments.seed)
    if arguments.out:
        arguments.out.write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
