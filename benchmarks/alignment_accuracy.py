"""Accuracy of the joint alignment estimate and of the closed forms, by Monte Carlo against the Cramer-Rao bound.

    python -m benchmarks.alignment_accuracy [--campaigns N] [--settings base,good,...] [--workers N] [--records FILE]

Every campaign is drawn anew: orbit, mounting, inertia, motion and noise. Its error in each quantity is divided by the
bound of the same campaign, and "ratio" is the root mean square of that over the campaigns; "spread" is the standard
deviation of the ratio by the jackknife. The normalized estimation error squared (NEES) of each block is compared with
the 95 % band of its chi-square distribution for that many campaigns.

Campaigns are those of the simulator's presets with 2 hours of positions (6 in the presets) and free arcs of 10 minutes.
"gravity gradient" is the base setting with the gravity gradient in the truth, and in the joint model, held at its
physical value; its linear methods know it too, the closed form does not.

The bound is that of the joint model, in which the attitude of a Doppler epoch is known from the star tracker's sample
there and from nothing else.

Finished campaigns are kept in a file of records (in the cache directory of compiled kernels unless --records names
another), so that a run can be stopped and taken up again. Results go to benchmarks/results/alignment_accuracy.json.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import tempfile
import time
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from benchmarks.tables import write_result, write_tables
from estimator.models.compiled import cache_directory
from problems.alignment.closed_form import closed_form
from problems.alignment.demonstration import METHODS, LinearEstimate, compared, linear_estimate
from problems.alignment.problem import alignment_model, alignment_problem
from problems.alignment.screening import screen
from problems.alignment.simulator import preset, simulate
from problems.alignment.solution import concluded, kept, solve_campaign
from problems.alignment.starting_point import starting_point

GRAVITY = "gravity-gradient-torque"
SHORT: dict[str, Any] = {"duration": 7200.0, "free_duration": 600.0}  # s
SETTINGS: dict[str, tuple[str, bool]] = {
    "base": ("base", False),
    "good": ("good", False),
    "bad-short": ("bad-short", False),
    "small-slews": ("small-slews", False),
    "gravity gradient": ("base", True),
}
"""Preset, and whether the gravity gradient acts."""


def one(setting: str, seed: int) -> dict[str, Any]:
    """Errors of every method on one campaign, over the bound, and the squared errors of the blocks."""
    name, gravity = SETTINGS[setting]
    drawn = 10_000 * list(SETTINGS).index(setting) + seed  # no setting shares its draws with another
    campaign, truth = simulate(preset(name, **SHORT), drawn, effects={GRAVITY: 1.0} if gravity else None)
    began = time.process_time()
    if gravity:
        from estimator.solvers import solve

        found = screen(campaign)
        model = alignment_model(kept(campaign, found))
        problem = alignment_problem(model, [GRAVITY]).starting_at({GRAVITY: np.ones(1)}).holding(GRAVITY)
        solution = concluded(model, solve(problem), found, 0.0)
        start = starting_point(campaign, model.velocity, model.position, gravity_gradient=True)
        linear = LinearEstimate(linear_estimate(solution).antenna_from_tracker, start.actuator_from_tracker,
                                start.normalized_inertia)
    else:
        solution = solve_campaign(campaign)
        linear = linear_estimate(solution)
    seconds = time.process_time() - began
    comparison = compared(solution, truth, {"linear": linear, "closed_form": closed_form(campaign, "corrected"),
                                            "closed_form_literal": closed_form(campaign, "literal")})
    return {
        "setting": setting, "seed": seed, "key": key(setting), "status": str(solution.status), "seconds": seconds,
        "bound": {q.name: q.bound for q in comparison.quantities},
        "unit": {q.name: q.unit for q in comparison.quantities},
        "ratio": {q.name: {m: q.ratio(m) for m in METHODS} for q in comparison.quantities},
        "nees": {b.name: [b.chi2, len(b.labels)] for b in comparison.blocks},
        "chi2_per_dof": solution.estimate.chi_square_per_degree(),
    }


def key(setting: str) -> str:
    """What a record depends on besides the seed, so that records of other settings are not mixed in."""
    described = repr((list(SETTINGS).index(setting), SETTINGS[setting], preset(SETTINGS[setting][0], **SHORT)))
    return hashlib.sha256(described.encode()).hexdigest()[:16]


def _one(job: tuple[str, int]) -> dict[str, Any]:
    return one(*job)


def root_mean_square(values: Iterable[float]) -> tuple[float, float]:
    """Root mean square and its standard deviation by the jackknife."""
    squares = np.array(list(values), dtype=float) ** 2
    left_out = np.sqrt((squares.sum() - squares) / (len(squares) - 1))
    n = len(squares)
    return float(np.sqrt(squares.mean())), float(np.sqrt((n - 1) / n * np.sum((left_out - left_out.mean()) ** 2)))


def summarize(records: list[dict[str, Any]]) -> dict[str, Any]:
    """Ratios, bounds and NEES of every setting."""
    result: dict[str, Any] = {}
    for setting in SETTINGS:
        mine = [r for r in records if r["setting"] == setting]
        if len(mine) < 2:
            continue
        quantities: dict[str, Any] = {}
        for name in mine[0]["bound"]:
            methods = {}
            for method in METHODS:
                ratios = [r["ratio"][name][method] for r in mine if r["ratio"][name][method] is not None]
                if len(ratios) > 1:
                    ratio, spread = root_mean_square(ratios)
                    methods[method] = {"ratio": ratio, "spread": spread, "campaigns": len(ratios)}
            quantities[name] = {"unit": mine[0]["unit"][name], "methods": methods,
                                "bound": float(np.sqrt(np.mean([r["bound"][name] ** 2 for r in mine])))}
        nees = {}
        for name, (_, size) in mine[0]["nees"].items():
            total, degrees = sum(r["nees"][name][0] for r in mine), size * len(mine)
            low, high = chi2.ppf([0.025, 0.975], degrees) / degrees
            nees[name] = {"mean_per_direction": total / degrees, "low": low, "high": high,
                          "inside": bool(low <= total / degrees <= high)}
        words = [r["status"] for r in mine]
        result[setting] = {"campaigns": len(mine), "status": {w: words.count(w) for w in sorted(set(words))},
                           "chi2_per_dof": float(np.mean([r["chi2_per_dof"] for r in mine])),
                           "cpu_seconds_median": float(np.median([r["seconds"] for r in mine])),
                           "quantities": quantities, "nees": nees}
    return {"settings": result, "methods": METHODS}


def read_records(path: Path) -> list[dict[str, Any]]:
    """Finished campaigns of the present settings; a last line that was cut short is left out."""
    records = []
    if path.exists():
        for line in path.read_text(encoding="utf-8").splitlines():
            try:
                record = json.loads(line)
            except ValueError:
                continue
            if record["setting"] in SETTINGS and record["key"] == key(record["setting"]):
                records.append(record)
    return list({(r["setting"], r["seed"]): r for r in records}.values())


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--campaigns", type=int, default=200, help="for each setting")
    parser.add_argument("--settings", default=",".join(SETTINGS), help="names, separated by commas")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--records", type=Path, default=None, help="file of finished campaigns")
    parser.add_argument("--summary", action="store_true", help="only summarize the records there are")
    options = parser.parse_args(arguments)
    chosen = options.settings.split(",")
    if unknown := [s for s in chosen if s not in SETTINGS]:
        parser.error(f"no setting is named {unknown}; choose from {list(SETTINGS)}")
    base = cache_directory() or Path(tempfile.gettempdir())
    path = options.records or base / "alignment_accuracy.jsonl"
    done = {(r["setting"], r["seed"]) for r in read_records(path)}
    # Round by round over the settings, so that a run that is stopped has as many campaigns of each.
    jobs = [(s, seed) for seed in range(options.campaigns) for s in chosen if (s, seed) not in done]
    if options.summary:
        jobs = []
    began = time.perf_counter()
    with path.open("a", encoding="utf-8") as file:
        def keep(index: int, record: dict[str, Any]) -> None:
            file.write(json.dumps(record) + "\n")
            file.flush()
            left = (time.perf_counter() - began) / (index + 1) * (len(jobs) - index - 1)
            print(f"{index + 1} of {len(jobs)} campaigns, {left / 60:.0f} min left", end="\r", file=sys.stderr)

        if options.workers > 1:
            with ProcessPoolExecutor(options.workers) as pool:
                for i, record in enumerate(pool.map(_one, jobs)):
                    keep(i, record)
        else:
            for i, job in enumerate(jobs):
                keep(i, one(*job))
    write_result("alignment_accuracy", summarize(read_records(path)))
    print(write_tables())
    return 0


if __name__ == "__main__":
    sys.exit(main())
