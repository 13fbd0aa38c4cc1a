"""The picture on the first screen of README.md: every method's error over the Cramer-Rao sigma on many campaigns.

    python -m benchmarks.method_comparison_figure [--campaigns 24] [--preset reference]

writes ``docs/figures/methods.png``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from problems.alignment.demonstration import Comparison, all_methods
from problems.alignment.figures import method_figure, save
from problems.alignment.simulator import preset, simulate

TARGET = Path(__file__).resolve().parents[1] / "docs" / "figures" / "methods.png"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--campaigns", type=int, default=24, help="number of campaigns, seeds 1, 2, ...")
    parser.add_argument("--preset", default="reference", help="preset of the simulator")
    parser.add_argument("--output", type=Path, default=TARGET)
    arguments = parser.parse_args()
    comparisons: list[Comparison] = []
    for seed in range(1, arguments.campaigns + 1):
        solution, comparison = all_methods(*simulate(preset(arguments.preset), seed))
        comparisons.append(comparison)
        ratios = "  ".join(f"{q.name} {q.ratio('joint') or 0:.2f}" for q in comparison.quantities)
        print(f"{seed:>3}  {solution.status}  {ratios}", flush=True)
    save(method_figure(comparisons), arguments.output)
    print(arguments.output)


if __name__ == "__main__":
    main()
