"""Orbit determination of W3B: seconds and distance from the published solution, cold and warm.

Run ``python -m benchmarks.orbit_w3b FOLDER [--repeat N] [--out FILE.json]`` with the folder of the tracking data.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from problems.geo_orbit.solution import solve_tracking
from problems.readers.tracking_files import read_files

PUBLISHED = np.array([-40541446.236, -9905357.943, 206777.082, 759.0685, -1476.5156, 54.7931])  # m, m/s, EME2000
ACCELERATION = 8.005e-6  # m/s2, norm of the constant term


def measured(folder: Path, repeat: int) -> dict[str, Any]:
    """Solve ``repeat`` times; the first time compiles and loads what is not in the cache."""
    seconds = []
    for _ in range(repeat):
        began = time.perf_counter()
        tracking, settings = read_files([folder / "W3B.aer", folder / "od_test_W3.in"])
        solution = solve_tracking(tracking, settings)
        seconds.append(time.perf_counter() - began)
    rows = solution.residuals()
    acceleration = float(np.linalg.norm(solution.estimate.values["constant-acceleration:linear"][:3]))
    return {
        "status": str(solution.status),
        "seconds_first": seconds[0],
        "seconds_warm": min(seconds),
        "position_m": float(np.linalg.norm(solution.position - PUBLISHED[:3])),
        "velocity_m_s": float(np.linalg.norm(solution.velocity - PUBLISHED[3:])),
        "acceleration_relative": acceleration / ACCELERATION - 1,
        "range_m": rows["all/range"]["standard_deviation"],
        "azimuth_deg": rows["all/azimuth"]["standard_deviation"],
        "elevation_deg": rows["all/elevation"]["standard_deviation"],
    }


def main() -> None:
    """Print the numbers and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--out", type=Path, default=None)
    arguments = parser.parse_args()
    result = measured(arguments.folder, arguments.repeat)
    for name, value in result.items():
        print(f"{name:<34}{value}")
    if arguments.out:
        arguments.out.write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
