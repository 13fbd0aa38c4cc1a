"""The book's study: every filter at one and three sigma, with and without a burn, and the joint batch at the bound.

Run ``python -m benchmarks.orbit_filters [--runs N] [--bound-runs N] [--step S] [--only PART] [--write]``; with
``--write`` the numbers go to ``benchmarks/results/orbit_filters.json``, the tables to ``docs/orbit.md`` and the book's
figures 3.3 and 3.4 to ``docs/figures``. Parts that are not run keep their numbers.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from benchmarks.orbit_filter_figures import write_figures
from benchmarks.tables import RESULTS, write_result
from estimator.models.files import written_atomically
from estimator.solvers.recursive_filters import (
    FilterRun,
    extended_filter,
    iterated_smoother,
    linear_filter,
    schmidt_filter,
    smoothed,
    square_root_filter,
    unscented_filter,
)
from problems.geo_orbit.book import SIZE, BookCase, BookSystem, Simulated, position_errors, simulate
from problems.geo_orbit.book_batch import batch_bound, batch_estimate, stacked

ORBIT = 6  # components of motion, the first of the state
BURN = (20000.0, 23600.0)  # s
PAGE = Path(__file__).parents[1] / "docs" / "orbit.md"
MARKS = ("<!-- filter tables -->", "<!-- end of filter tables -->")
TITLES = {
    "linear": "linear, about the stationary orbit",
    "extended": "extended",
    "inflated": "extended, noise added",
    "iterated": "iterated extended",
    "square-root": "square-root, iterated",
    "schmidt": "Schmidt, rest considered",
    "schmidt-iterated": "Schmidt, iterated",
    "unscented": "unscented",
    "rts": "smoother of the extended",
    "smoother": "iterated smoother",
    "batch": "joint batch",
}


@dataclass(frozen=True, eq=False)
class Answer:
    """What one method says of all realizations.

    Attributes:
        state, sigma: (runs, 14) at the end of the day.
        checked: (runs, 14) estimate whose covariance is ``covariance`` (runs, 14, 14): at the end for filters, at the
            start for smoothers and the batch.
        at: step of ``checked``.
        diverged: (runs,) whether the method itself says that it is not to be trusted.
    """

    state: np.ndarray
    sigma: np.ndarray
    checked: np.ndarray
    covariance: np.ndarray
    at: int
    diverged: np.ndarray


def _of(run: FilterRun, *, smoother: bool = False) -> Answer:
    at = 0 if smoother else -1
    return Answer(run.state[:, -1], run.sigma[:, -1], run.state[:, at], run.covariance, at, run.diverged())


def _batch(system: BookSystem, measurements: np.ndarray) -> Answer:
    """The joint batch of each realization, carried to the end of the day."""
    states, covariances, ends, sigmas, bad = [], [], [], [], []
    for z in measurements:
        estimate = batch_estimate(system, z)
        # a thrust error that no burn shows is held at zero and keeps its prior
        full = np.diag(system.case.prior**2)
        place = np.arange(SIZE) if len(estimate.covariance) == SIZE else np.delete(np.arange(SIZE), ORBIT)
        full[np.ix_(place, place)] = estimate.covariance
        x, phi = stacked(estimate)[None], np.eye(SIZE)
        states.append(x[0])
        for k in range(system.steps):
            x, step = system.propagate(k, x)
            phi = step[0] @ phi
        covariances.append(full)
        ends.append(x[0])
        sigmas.append(np.sqrt(np.einsum("ij,jk,ik->i", phi, full, phi)))
        bad.append(estimate.status != "ok")
    return Answer(np.array(ends), np.array(sigmas), np.array(states), np.array(covariances), 0, np.array(bad))


def normalized_square(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Squared errors (runs,) of the six components of motion in units of their covariance, per component."""
    c = covariance[:, :ORBIT, :ORBIT]
    scale = np.sqrt(np.maximum(np.diagonal(c, axis1=1, axis2=2), 1e-300))
    e = error[:, :ORBIT] / scale
    inner = c / (scale[:, :, None] * scale[:, None, :])
    return np.asarray(np.einsum("ri,ri->r", e, np.linalg.solve(inner, e[..., None])[..., 0]) / ORBIT)


def _row(system: BookSystem, simulated: Simulated, answer: Answer) -> dict[str, Any]:
    scale = np.array([1.0, system.case.radius, system.case.radius])
    error = position_errors(system.case, simulated.truth[:, -1], answer.state)
    sigma = np.linalg.norm(answer.sigma[:, :3] * scale, axis=1)
    squares = normalized_square(answer.checked - simulated.truth[:, answer.at], answer.covariance)
    degrees = ORBIT * len(error)
    low, high = (float(chi2.ppf(p, degrees) / degrees) for p in (0.025, 0.975))
    mean = float(np.mean(squares))
    return {
        "error_km": float(np.median(error)) / 1e3,
        "sigma_km": float(np.median(sigma)) / 1e3,
        "error_over_sigma": float(np.median(error / sigma)),
        "nees": mean,
        "nees_band": [low, high],
        "nees_inside": low <= mean <= high,
        "diverged": int(answer.diverged.sum()),
        "runs": len(error),
    }


def _works(system: BookSystem, simulated: Simulated) -> dict[str, Callable[[], Answer]]:
    """Every method on one set of realizations, by name."""
    case, z = system.case, simulated.measurements
    start, covariance = case.first_state, np.diag(case.prior**2)
    nominal, matrices = system.stationary_motion()
    others = range(ORBIT, SIZE)
    return {
        "linear": lambda: _of(linear_filter(system, nominal, matrices, start, covariance, z)),
        "extended": lambda: _of(extended_filter(system, start, covariance, z)),
        "inflated": lambda: _of(extended_filter(BookSystem(case, 1e-8), start, covariance, z)),
        "iterated": lambda: _of(extended_filter(system, start, covariance, z, iterations=4)),
        "square-root": lambda: _of(square_root_filter(system, start, covariance, z, iterations=4)),
        "schmidt": lambda: _of(schmidt_filter(system, start, covariance, z, others)),
        "schmidt-iterated": lambda: _of(schmidt_filter(system, start, covariance, z, others, iterations=4)),
        "unscented": lambda: _of(unscented_filter(system, start, covariance, z)),
        "rts": lambda: _of(smoothed(extended_filter(system, start, covariance, z, keep=True)), smoother=True),
        "smoother": lambda: _of(iterated_smoother(system, start, covariance, z, passes=12), smoother=True),
        "batch": lambda: _batch(system, z),
    }


def filters(runs: int, step: float, seed: int) -> list[dict[str, Any]]:
    """Every method for each first deviation and with and without a burn."""
    rows = []
    for stationary, burn, deviation in product((False, True), ((0.0, 0.0), BURN), (1.0, 3.0)):
        system = BookSystem(BookCase(step=step, burn=burn, stationary=stationary))
        simulated = simulate(system, runs, seed, deviation=deviation, kind="exact")
        for name, work in _works(system, simulated).items():
            began = time.process_time()
            with np.errstate(all="ignore"):  # a filter that diverges may overflow, which its row then says
                row = _row(system, simulated, work())
            row |= {
                "filter": name,
                "deviation_sigma": deviation,
                "burn_s": burn[1] - burn[0],
                "orbit": "stationary" if stationary else "book",
                "step_s": step,
                "cpu_seconds": time.process_time() - began,
            }
            rows.append(row)
            print(
                f"{row['orbit']:<11}{deviation:>4.0f} sigma  burn {row['burn_s']:>5.0f} s  {name:<18}"
                f"error {row['error_km']:>11.3f} km  sigma {row['sigma_km']:>7.3f} km  ratio "
                f"{row['error_over_sigma']:>9.2f}  NEES {row['nees']:>10.3g}  diverged {row['diverged']}/{row['runs']}"
                f"  {row['cpu_seconds']:.1f} s",
                flush=True,
            )
    return rows


def _over_bound(errors: np.ndarray, bounds: np.ndarray, covariances: np.ndarray, unit: np.ndarray) -> dict[str, Any]:
    """Root mean square of errors (runs, 14) over the bound's sigmas, with its standard error, and the NEES."""
    ratios = errors**2 / bounds
    each = ratios.mean(axis=1)
    ratio = float(np.sqrt(each.mean()))
    inner = covariances / np.outer(unit, unit)
    squares = np.einsum("ri,ri->r", errors / unit, np.linalg.solve(inner, (errors / unit)[..., None])[..., 0])
    degrees = SIZE * len(errors)
    return {
        "runs": len(errors),
        "ratio": ratio,
        "ratio_sigma": float(each.std(ddof=1) / np.sqrt(len(each)) / (2 * ratio)),
        "ratio_per_component": np.sqrt(ratios.mean(axis=0)).tolist(),
        "nees": float(squares.mean() / SIZE),
        "nees_band": [float(chi2.ppf(p, degrees) / degrees) for p in (0.025, 0.975)],
    }


def _chunks(total: int, size: int) -> Iterator[slice]:
    for first in range(0, total, size):
        yield slice(first, min(first + size, total))


def bound(runs: int, step: float, seed: int) -> dict[str, Any]:
    """Joint batch and iterated smoother against the Cramer-Rao bound of the first state over many realizations."""
    case = BookCase(step=step, burn=BURN)
    system = BookSystem(case)
    simulated = simulate(system, runs, seed)
    truth = simulated.truth[:, 0]
    limits = np.array([np.diag(batch_bound(system, x)) for x in truth])
    began = time.process_time()
    found = [batch_estimate(system, z) for z in simulated.measurements]
    seconds = (time.process_time() - began) / runs
    batch_state, batch_covariance = np.array([stacked(e) for e in found]), np.array([e.covariance for e in found])
    prior = np.diag(case.prior**2)
    pieces = [
        iterated_smoother(system, case.first_state, prior, simulated.measurements[part], passes=12, tolerance=1e-4)
        for part in _chunks(runs, 20)  # a smoother keeps the covariances of every step
    ]
    state, covariance = (
        np.concatenate([p.state[:, 0] for p in pieces]),
        np.concatenate([p.covariance for p in pieces]),
    )
    gap = np.abs(state - batch_state) / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return {
        "step_s": step,
        "batch": _over_bound(batch_state - truth, limits, batch_covariance, case.prior),
        "smoother": _over_bound(state - truth, limits, covariance, case.prior),
        "largest_gap_sigma": float(gap.max()),
        "batch_cpu_seconds": seconds,
        "not_ok": sum(e.status != "ok" for e in found),
    }


def process_noise(runs: int, step: float, seed: int) -> dict[str, Any]:
    """The joint batch with the increments of all shaping filters as unknowns, beside the iterated smoother."""
    case = BookCase(step=step, burn=BURN, interval=4 * 3600.0)
    system = BookSystem(case)
    simulated = simulate(system, runs, seed)
    prior = np.diag(case.prior**2)
    recursive = iterated_smoother(system, case.first_state, prior, simulated.measurements, passes=20, tolerance=1e-6)
    began = time.process_time()
    found = [batch_estimate(system, z) for z in simulated.measurements]
    seconds = (time.process_time() - began) / runs
    state = np.array([stacked(e) for e in found])
    covariance = np.array([e.covariance[:SIZE, :SIZE] for e in found])
    limit = np.diagonal(covariance, axis1=1, axis2=2)
    result = _over_bound(state - simulated.truth[:, 0], limit, covariance, case.prior)
    result["unknowns"] = len(found[0].covariance)
    result["largest_gap_sigma"] = float((np.abs(state - recursive.state[:, 0]) / recursive.sigma[:, 0]).max())
    result["cpu_seconds"] = seconds
    result["step_s"] = step
    result["interval_s"] = case.interval
    return result


def _short(value: float) -> str:
    """Three digits, thousands written out."""
    if value >= 1e6:
        return f"{value:.1e}".replace("e+0", "e").replace("e+", "e")
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def tables(result: dict[str, Any]) -> str:
    """The tables of the page."""
    lines = []
    if "filters" in result:
        rows = result["filters"]
        low, high = rows[0]["nees_band"]
        lines += [
            f"{rows[0]['runs']} realizations, a measurement every {rows[0]['step_s']:.0f} s. Error of position after "
            "24 h, the method's own sigma of it, and their ratio: medians. NEES: normalized estimation error squared "
            "of the six components of motion, per component, mean of all realizations, at the end for filters and at "
            f"the start for smoothers and batch; its 95 % band is {low:.2f} to {high:.2f} (**bold** inside). Said: "
            "realizations in which the method itself says that it is not to be trusted; the batch says so too where "
            "the prior is missed by three sigma in all components at once.",
            "",
        ]
        for orbit, deviation in dict.fromkeys((r["orbit"], r["deviation_sigma"]) for r in rows):
            words = "book's orbit (e 0.005, i 0.03 rad)" if orbit == "book" else "exactly stationary orbit"
            head = ("error, km", "sigma, km", "ratio", "NEES", "said")
            lines += [
                f"**First deviation of {deviation:.0f} sigma, {words}.** Left no burn, right a burn of 1 h with an "
                "error.",
                "",
                "| method | " + " | ".join(head) + " | " + " | ".join(head) + " |",
                "|---|" + "--:|" * (2 * len(head)),
            ]
            part = [r for r in rows if (r["orbit"], r["deviation_sigma"]) == (orbit, deviation)]
            for name in dict.fromkeys(r["filter"] for r in part):
                cells = []
                for r in (r for r in part if r["filter"] == name):
                    nees = _short(r["nees"])
                    cells += [_short(r["error_km"]), _short(r["sigma_km"]), _short(r["error_over_sigma"])]
                    cells += [f"**{nees}**" if r["nees_inside"] else nees, f"{r['diverged']}/{r['runs']}"]
                lines.append(f"| {TITLES[name]} | " + " | ".join(cells) + " |")
            lines.append("")
    if "bound" in result:
        b = result["bound"]
        lines += [
            f"Root mean square error of the 14 components of the first state over the Cramer-Rao bound, "
            f"{b['batch']['runs']} realizations drawn from the prior, burn of 1 h, a measurement every "
            f"{b['step_s']:.0f} s. Largest distance of the two estimates from each other: "
            f"{b['largest_gap_sigma']:.1g} sigma.",
            "",
            "| method | error over bound | NEES per component | its 95 % band |",
            "|---|---|---|---|",
        ]
        for name in ("batch", "smoother"):
            r = b[name]
            low, high = r["nees_band"]
            lines.append(
                f"| {TITLES[name]} | {r['ratio']:.3f} ± {r['ratio_sigma']:.3f} | {r['nees']:.3f} | "
                f"{low:.3f} to {high:.3f} |"
            )
        lines.append("")
    if "process_noise" in result:
        r = result["process_noise"]
        low, high = r["nees_band"]
        lines += [
            f"With process noise (shaping filters of {r['interval_s'] / 3600:.0f} h in thrust and all four systematic "
            f"errors, {r['unknowns']} unknowns, {r['runs']} realizations, {r['step_s']:.0f} s): error over the batch's "
            f"own sigma {r['ratio']:.3f} ± {r['ratio_sigma']:.3f}, NEES per component {r['nees']:.3f} (95 % band "
            f"{low:.3f} to {high:.3f}), largest distance from the iterated smoother {r['largest_gap_sigma']:.1g} "
            "sigma.",
            "",
        ]
    return "\n".join(lines).rstrip()


def write_page(result: dict[str, Any]) -> None:
    """Put the tables between their marks in docs/orbit.md."""
    text = PAGE.read_text(encoding="utf-8")
    pattern = re.compile(re.escape(MARKS[0]) + ".*?" + re.escape(MARKS[1]), re.DOTALL)
    fresh = f"{MARKS[0]}\n{tables(result)}\n{MARKS[1]}"
    with written_atomically(PAGE) as temporary:
        temporary.write_text(pattern.sub(lambda _: fresh, text), encoding="utf-8")


def main() -> None:
    """Run the parts and write what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--bound-runs", type=int, default=200)
    parser.add_argument("--noise-runs", type=int, default=60)
    parser.add_argument("--step", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", choices=("filters", "bound", "process_noise", "figures", "page"), default=None)
    parser.add_argument("--write", action="store_true")
    arguments = parser.parse_args()
    stored = RESULTS / "orbit_filters.json"
    result: dict[str, Any] = json.loads(stored.read_text()) if stored.exists() else {}
    work: dict[str, Callable[[], Any]] = {
        "bound": lambda: bound(arguments.bound_runs, arguments.step, arguments.seed),
        "process_noise": lambda: process_noise(arguments.noise_runs, 900.0, arguments.seed),
        "filters": lambda: filters(arguments.runs, arguments.step, arguments.seed),
    }
    for name, part in work.items():
        if arguments.only in (None, name):
            result[name] = part()
            if name != "filters":
                print(json.dumps(result[name]), flush=True)
            if arguments.write:
                write_result("orbit_filters", {**result, "load": os.getloadavg()[0]})
                write_page(result)
    if arguments.only == "page":
        write_page(result)
    if arguments.write and arguments.only in (None, "figures"):
        for path in write_figures():
            print(path)


if __name__ == "__main__":
    main()
