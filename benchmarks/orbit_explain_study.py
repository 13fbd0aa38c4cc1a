"""How often ``boresight orbit explain`` is right: hidden effects of known size in the tracking of random orbits.

    python -m benchmarks.orbit_explain_study [--out FILE.jsonl] [--workers 2] [--seeds 3] [--sizes 8,15] [--quiet 60]
    python -m benchmarks.orbit_explain_study --report [--out FILE.jsonl]

Every case has its own orbit (geostationary, transfer, medium or low), phase and noise, ranged and pointed at by six
stations over the globe. The size of a hidden effect is the root of the sum of squares that its signature has on the
samples of the fit, orbit projected out; a case whose size no engineer would believe is left out. Cases go to a file of
JSON lines as they come, and an interrupted study goes on where it stopped.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
import traceback
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.explain_study import RESULTS, results_of, strength, summary

ORBITS = {  # semi-major axis m, eccentricity, inclination deg, hours of data, s between measurements
    "geostationary": (42_164_170.0, 2e-4, 0.05, 36.0, 900.0),
    "transfer": (24_400_000.0, 0.72, 7.0, 14.0, 300.0),
    "medium": (29_600_000.0, 1e-3, 56.0, 20.0, 420.0),
    "low": (7_250_000.0, 2e-3, 98.0, 12.0, 30.0),
}
STATIONS = (("Kiruna", 67.9, 21.0, 400.0), ("Perth", -31.8, 115.9, 30.0), ("Santiago", -33.1, -70.7, 720.0),
            ("Hawaii", 19.0, -155.7, 370.0), ("Hartebeesthoek", -25.9, 27.7, 1560.0), ("Madrid", 40.4, -4.2, 830.0))


@dataclass(frozen=True)
class Case:
    """One satellite's tracking."""

    kind: str
    orbit: str
    seed: int
    effects: tuple[str, ...] = ()
    size: float = 0.0

    @property
    def key(self) -> str:
        """Names the case in the file of results."""
        return f"{self.orbit}|{'+'.join(self.effects)}|{self.size:g}|{self.seed}"


def settings_of(case: Case) -> Any:
    """Settings with the random orbit of a case: 8 x 8 gravity, Sun and Moon."""
    from guidance.orbit_propagation import state_from_elements
    from problems.geo_orbit.settings import settings_from
    from problems.geo_orbit.tracking import Station

    draw = np.random.default_rng([case.seed, 5])
    a, e, inclination = ORBITS[case.orbit][0], ORBITS[case.orbit][1], np.radians(ORBITS[case.orbit][2])
    node, perigee, anomaly = draw.uniform(0, 2 * np.pi, 3)
    if case.orbit == "transfer":
        anomaly = draw.uniform(0.5 * np.pi, 1.5 * np.pi)  # away from a perigee that no station sees
    position, velocity = state_from_elements(a, e, inclination, node, perigee, perigee + anomaly)
    tables = {
        "satellite": {"mass_kg": 2000.0, "area_m2": 30.0},
        "orbit": {"epoch": "2023-03-10T00:00:00", "frame": "GCRF", "position_m": position.tolist(),
                  "velocity_m_s": velocity.tolist()},
        "forces": {"degree": 8},
        "measurements": {"range_sigma_m": 5.0, "azimuth_sigma_deg": 0.01, "elevation_sigma_deg": 0.01},
    }
    stations = {n: Station(n, np.radians(b), np.radians(c), h) for n, b, c, h in STATIONS}
    return settings_from(tables, stations)


def cases(arguments: argparse.Namespace) -> list[Case]:
    """Every case asked for, shuffled by a fixed seed so that a part of the study is a fair sample of it."""
    from problems.geo_orbit.effects import instances
    from problems.geo_orbit.problem import orbit_model
    from problems.geo_orbit.simulator import simulated_tracking

    result = []
    for number, orbit in enumerate(ORBITS):
        plain = Case("quiet", orbit, 1000 * number)
        hours, step = ORBITS[orbit][3:]
        result += [Case("quiet", orbit, 1000 * number + k) for k in range(arguments.quiet // len(ORBITS))]
        chosen = settings_of(plain)
        layout = orbit_model(simulated_tracking(chosen, hours=hours, step=step, seed=1), chosen).layout
        seen = sorted(name for name, _ in layout.stations)
        families = [e.name for e in instances(layout) if e.name.split(":")[-1] in (seen[0], e.name)
                    or e.name.split(":")[-1] not in [n for n, *_ in STATIONS]]
        for i, name in enumerate(families):
            result += [Case("one", orbit, 100_000 * (number + 1) + 100 * i + k, (name,), float(size))
                       for size in arguments.sizes.split(",") for k in range(arguments.seeds)]
    order = np.random.default_rng(3).permutation(len(result))
    return [result[i] for i in order]


def run(case: Case) -> dict[str, Any]:
    """Do one case; an error is a result too."""
    began, cpu = time.perf_counter(), time.process_time()
    result: dict[str, Any] = {"key": case.key, **asdict(case)}
    try:
        from problems.geo_orbit.effects import instances
        from problems.geo_orbit.explanation import OrbitExplanation, OrbitSubject, explained
        from problems.geo_orbit.problem import orbit_model
        from problems.geo_orbit.simulator import simulated_tracking

        chosen = settings_of(case)
        hours, step = ORBITS[case.orbit][3:]
        effects: dict[str, np.ndarray] = {}
        if case.effects:
            name = case.effects[0]
            model = orbit_model(simulated_tracking(chosen, hours=hours, step=step, seed=case.seed + 1), chosen)
            effect = next((e for e in instances(model.layout) if e.name == name), None)
            if effect is None:  # the station does not see this orbit
                return {**result, "verdict": "not visible"}
            draw = np.random.default_rng([case.seed, 9])
            values = np.array([p.nominal if p.nominal is not None else
                               p.search.at(draw.uniform(0.2, 0.8)) if p.search else p.scale * draw.standard_normal()
                               for p in effect.parameters], dtype=float)
            sigma = strength(OrbitSubject(model), name, values)
            ordinary = np.array([p.search is None and p.nominal is None for p in effect.parameters])
            if not sigma > 0 or (not ordinary.any() and sigma < case.size):
                return {**result, "verdict": "not visible"}
            values = np.where(ordinary, values * case.size / sigma, values)
            if any(not p.plausible[0] <= v <= p.plausible[1]
                   for p, v in zip(effect.parameters, values, strict=True)):
                return {**result, "verdict": "not visible"}
            effects[name] = values
        tracking = simulated_tracking(chosen, hours=hours, step=step, effects=effects, seed=case.seed + 2)
        answer = explained(tracking, chosen)
        if not isinstance(answer, OrbitExplanation):
            told = answer.as_dict()
            return {**result, "verdict": told["verdict"], "truth": {k: v.tolist() for k, v in effects.items()},
                    "why": told["why"], "found": [{"name": e["name"], "group": [e["name"]]} for e in told["effects"]],
                    "cpu_seconds": time.process_time() - cpu}
        findings = answer.findings
        result |= {"truth": {k: v.tolist() for k, v in effects.items()}, "verdict": findings.verdict,
                   "why": findings.why, "rejected": list(findings.rejected), "looks": findings.looks,
                   "found": [{"name": f.name, "group": list(f.group)} for f in findings.findings],
                   "truth_ahead": _ahead(answer, case, findings)}
        for name, values in effects.items():
            if any(u.name == name for u in findings.final.unknowns):
                off = (findings.final.values[name] - values) / findings.final.sigma_of(name)
                result["off_in_sigma"] = np.round(off, 2).tolist()
    except Exception as error:
        result |= {"verdict": "error", "why": f"{type(error).__name__}: {error}",
                   "trace": traceback.format_exc()[-1500:]}
    result["seconds"] = time.perf_counter() - began
    result["cpu_seconds"] = time.process_time() - cpu
    return result


def _ahead(answer: Any, case: Case, findings: Any) -> float | None:
    """By how much the truth lowers the sum of squares beyond what was named instead of it, on the same data."""
    if not case.effects or not findings.findings or any(case.effects[0] in f.group for f in findings.findings):
        return None
    workflow = answer.workflow
    named = workflow.fit([f.name for f in findings.findings]).cost
    return float(named - workflow.fit(case.effects).cost)


def report(out: Path) -> None:
    """Numbers to standard output and to the results; what was wrong, case by case."""
    from benchmarks.explain_study import _look_alike, right
    from estimator.models.files import written_atomically

    entries = list(results_of(out).values())
    result = summary(entries)
    result["not_visible"] = sum(e["verdict"] == "not visible" for e in entries)
    done = [e for e in entries if "found" in e and e["effects"]]
    result["by_orbit"] = {o: f"{sum(right(e) for e in done if e['orbit'] == o)} of "
                             f"{sum(e['orbit'] == o for e in done)}" for o in ORBITS}
    RESULTS.mkdir(exist_ok=True)
    with written_atomically(RESULTS / "orbit_explain_study.json") as temporary:
        temporary.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result, indent=1))
    for e in done:
        if not right(e) and e["found"]:
            print(e["key"], e["verdict"], [f["group"] for f in e["found"]], "look-alike" if _look_alike(e) else "WRONG")


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of the study."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=RESULTS / "orbit_explain_study.jsonl")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--sizes", default="8,15")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--quiet", type=int, default=60)
    parser.add_argument("--minutes", type=float, default=1e6, help="start no case after this long")
    parser.add_argument("--report", action="store_true")
    chosen = parser.parse_args(arguments)
    if not chosen.report:
        from rich.progress import track

        from problems.console import jsonable

        done = results_of(chosen.out)
        remaining = [c for c in cases(chosen) if c.key not in done]
        chosen.out.parent.mkdir(parents=True, exist_ok=True)
        deadline = time.monotonic() + 60 * chosen.minutes
        with ProcessPoolExecutor(chosen.workers, mp_context=get_context("spawn")) as pool, chosen.out.open("a") as file:
            for start in range(0, len(remaining), 8 * chosen.workers):
                if time.monotonic() > deadline:
                    break
                batch = [pool.submit(run, c) for c in remaining[start : start + 8 * chosen.workers]]
                for future in track(as_completed(batch), total=len(batch),
                                    description=f"{start + len(done)} of {len(remaining) + len(done)} cases"):
                    file.write(json.dumps(jsonable(future.result())) + "\n")
                    file.flush()
    report(chosen.out)


if __name__ == "__main__":
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    sys.exit(main())
