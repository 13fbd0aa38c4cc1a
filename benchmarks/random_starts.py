"""Random starts of one block at a time: how many end in the optimum that the built-in start gives.

    python -m benchmarks.random_starts [--starts N] [--blocks antenna,actuator,inertia,rates] [--campaigns N]

Blocks: the antenna's and the actuators' mounting anywhere among all rotations; any physical inertia tensor (second
moments drawn evenly from all distributions over the axes, turned at random); the rate at the start of every arc wrong
by up to half of itself in each component. The other blocks start where the built-in starting point puts them. The
solve is :func:`estimator.solvers.continuation.solve_from_anywhere`.

The distance is the difference from the optimum in the metric of its covariance, over all unknowns that are asked for.
Results go to benchmarks/results/random_starts.json, and finished starts to a file of records, so that a run can be
taken up again.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.tables import write_result, write_tables
from estimator.estimate import Estimate
from estimator.models.compiled import cache_directory
from estimator.problem import Problem
from estimator.solvers import Options, solve
from estimator.solvers.continuation import solve_from_anywhere
from problems.alignment.problem import alignment_model, alignment_problem
from problems.alignment.simulator import preset, simulate

BLOCKS = ("antenna", "actuator", "inertia", "rates")
SCENARIO: dict[str, Any] = {"duration": 3000.0, "gnss_step": 4.0, "doppler_sessions": 4, "session_duration": 20.0,
                            "doppler_step": 1.0, "star_tracker_step": 1.0}
SAME = 0.01  # standard deviations


@cache
def optimum(campaign: int) -> tuple[Problem, Estimate]:
    """The problem of a compact campaign, and its optimum from the built-in start."""
    problem = alignment_problem(alignment_model(simulate(preset("compact", **SCENARIO), campaign)[0]))
    return problem, solve(problem, Options(tolerance=1e-9))


def random_start(problem: Problem, block: str, draw: np.random.Generator) -> dict[str, np.ndarray]:
    """The built-in start with one block drawn at random."""
    start = {k: np.asarray(v) for k, v in problem.start.items()}
    rotation = Rotation.random(random_state=int(draw.integers(1 << 31))).as_quat(scalar_first=True)
    if block in ("antenna", "actuator"):
        start[f"{block}_from_tracker"] = rotation
    elif block == "inertia":
        axes = Rotation.from_quat(rotation, scalar_first=True).as_matrix()
        second = axes @ np.diag(0.5 * draw.dirichlet(np.ones(3))) @ axes.T
        t = np.trace(second) * np.eye(3) - second
        start["normalized_inertia"] = np.array([t[0, 0], t[1, 1], t[2, 2], t[0, 1], t[0, 2], t[1, 2]])
    elif block == "rates":
        for name in start:
            if name.startswith("rate:"):
                start[name] = start[name] * (1.0 + draw.uniform(-0.5, 0.5, 3))
    return start


def one(block: str, index: int, campaigns: int) -> dict[str, Any]:
    """One random start: the distance from the optimum and the time it took."""
    campaign = index % campaigns
    problem, best = optimum(campaign)
    draw = np.random.default_rng([index, BLOCKS.index(block)])
    began = time.process_time()
    found = solve_from_anywhere(problem.starting_at(random_start(problem, block, draw)))
    seconds = time.process_time() - began
    names = [u.name for u in best.unknowns if not u.nuisance]
    columns = np.concatenate([np.arange(best.columns(n).start, best.columns(n).stop) for n in names])
    step = problem.difference(best.values, found.values)[columns]
    distance = float(np.sqrt(step @ np.linalg.solve(best.covariance[np.ix_(columns, columns)], step)))
    return {"block": block, "index": index, "campaigns": campaigns, "distance": distance, "seconds": seconds,
            "status": str(found.status)}


def summarize(records: list[dict[str, Any]]) -> dict[str, Any]:
    """Counts by block."""
    blocks = {}
    for block in BLOCKS:
        mine = [r for r in records if r["block"] == block]
        if mine:
            distances, seconds = np.array([r["distance"] for r in mine]), [r["seconds"] for r in mine]
            blocks[block] = {"starts": len(mine), "same": int(np.sum(distances < SAME)),
                             "largest_distance": float(distances.max()), "seconds_median": float(np.median(seconds)),
                             "seconds_largest": float(np.max(seconds)),
                             "failed": [r["index"] for r in mine if not r["distance"] < SAME]}
    return {"blocks": blocks, "same_below_sigma": SAME, "scenario": {"preset": "compact", **SCENARIO}}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--starts", type=int, default=1000, help="for each block")
    parser.add_argument("--blocks", default=",".join(BLOCKS), help="names, separated by commas")
    parser.add_argument("--campaigns", type=int, default=5, help="compact campaigns that the starts are spread over")
    parser.add_argument("--records", type=Path, default=None, help="file of finished starts")
    options = parser.parse_args(arguments)
    chosen = options.blocks.split(",")
    if unknown := [b for b in chosen if b not in BLOCKS]:
        parser.error(f"no block is named {unknown}; choose from {BLOCKS}")
    path = options.records or (cache_directory() or Path(tempfile.gettempdir())) / "random_starts.jsonl"
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    records = [r for r in map(json.loads, lines) if r["campaigns"] == options.campaigns]
    done = {(r["block"], r["index"]) for r in records}
    jobs = [(b, i) for i in range(options.starts) for b in chosen if (b, i) not in done]
    with path.open("a", encoding="utf-8") as file:
        for k, (block, index) in enumerate(jobs):
            record = one(block, index, options.campaigns)
            records.append(record)
            file.write(json.dumps(record) + "\n")
            file.flush()
            if not record["distance"] < SAME:
                print(f"\n{block} {index}: {record['distance']:.3g} sigma, {record['status']}", file=sys.stderr)
            print(f"{k + 1} of {len(jobs)} starts", end="\r", file=sys.stderr)
    write_result("random_starts", summarize(records))
    print(write_tables())
    return 0


if __name__ == "__main__":
    sys.exit(main())
