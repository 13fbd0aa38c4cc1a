"""The tables of docs/benchmarks.md from the JSON files of the alignment benchmarks.

    python -m benchmarks.tables

Every benchmark writes its numbers to benchmarks/results/<name>.json and calls :func:`write_tables`, so the page never
says anything that was not measured.
"""

from __future__ import annotations

import json
import platform
import sys
from pathlib import Path
from typing import Any

from estimator.models.files import written_atomically

RESULTS = Path(__file__).parent / "results"
PAGE = Path(__file__).parents[1] / "docs" / "benchmarks.md"


def write_result(name: str, result: dict[str, Any]) -> None:
    """Write the numbers of a benchmark to its JSON file, with the machine they were measured on."""
    result = {**result, "python": platform.python_version(), "machine": platform.machine()}
    with written_atomically(RESULTS / f"{name}.json") as temporary:
        temporary.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


def _read(name: str) -> dict[str, Any] | None:
    path = RESULTS / f"{name}.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.3g}" if abs(value) < 1e5 else f"{value:.1e}"


def accuracy_page(result: dict[str, Any]) -> str:
    """Errors over the bound, and the consistency of the joint estimate."""
    methods = result["methods"]
    rows, consistency = [], []
    for setting, part in result["settings"].items():
        for name, quantity in part["quantities"].items():
            joint = quantity["methods"]["joint"]
            cells = [f"{joint['ratio']:.3f} ± {joint['spread']:.3f}"]
            cells += [_number(quantity["methods"].get(m, {}).get("ratio")) for m in methods if m != "joint"]
            rows.append([setting, str(part["campaigns"]), name, f"{_number(quantity['bound'])} {quantity['unit']}",
                         *cells])
        for name, nees in part["nees"].items():
            consistency.append([setting, name, f"{nees['mean_per_direction']:.3f}",
                                f"{nees['low']:.3f} to {nees['high']:.3f}", "yes" if nees["inside"] else "no"])
    words = [label for m, label in methods.items() if m != "joint"]
    return "\n".join([
        "## Accuracy against the Cramer-Rao bound", "",
        "Root mean square error over the bound, campaigns with orbit, mounting, inertia, motion and noise drawn anew "
        "(`python -m benchmarks.alignment_accuracy`). The bound is that of the joint model; 1 cannot be beaten by an "
        "unbiased estimate, and the spread of the number itself is given for the joint estimate.", "",
        _table(["setting", "campaigns", "quantity", "bound", methods["joint"], *words], rows), "",
        "Normalized estimation error squared of the joint estimate, per direction, and its 95 % band:", "",
        _table(["setting", "unknown", "mean", "95 % band", "inside"], consistency), ""])


def starts_page(result: dict[str, Any]) -> str:
    """How many random starts end in the same optimum."""
    rows = [[name, str(part["starts"]), str(part["same"]), _number(part["largest_distance"]),
             _number(part["seconds_median"]), _number(part["seconds_largest"])]
            for name, part in result["blocks"].items()]
    return "\n".join([
        "## Random starts", "",
        "One block starts anywhere, the others where the built-in starting point puts them "
        "(`python -m benchmarks.random_starts`). \"Same\" counts starts that end within 0.01 standard deviations of "
        "the optimum that the built-in start gives.", "",
        _table(["block", "starts", "same", "largest distance, sigma", "median CPU s", "largest CPU s"], rows), ""])


def speed_page(result: dict[str, Any]) -> str:
    """Full size against the floor, growth with the number of positions, and rivals."""
    full = result["full"]
    lines = [
        "## Speed and memory", "",
        f"Full size: {full['positions']} positions, degree {full['degree']}, {full['sessions']} Doppler sessions, "
        f"{full['star_tracker_samples']} star tracker samples on {full['arcs']} rotation arcs; campaign file to "
        "answer, medians, against three zero-padded real FFTs of that length in the same process "
        "(`python -m benchmarks.alignment_speed`).", "",
        _table(["quantity", "value"], [
            ["floor (3 padded FFTs)", f"{full['floor_cpu_seconds']:.3f} s CPU, {full['floor_seconds']:.3f} s elapsed"],
            ["reading and joint solve", f"{full['cpu_seconds']:.2f} s CPU, {full['seconds']:.2f} s elapsed"],
            ["ratio to the floor", f"{full['ratio_cpu']:.1f} (CPU), {full['ratio']:.1f} (elapsed)"],
            ["peak memory of the process", f"{full['peak_gigabytes']:.2f} GB"],
            ["position error over noise alone", f"{full['position_over_noise']:.3f}"],
            ["velocity error over that of a QR solution", f"{full['velocity_over_qr']:.3f}"],
            ["load of the machine", f"{full['load']:.1f}"],
        ]), ""]
    rows = [[str(r["positions"]), str(r["degree"]), f"{r['cpu_seconds']:.2f}", f"{1e3 * r['iteration_seconds']:.0f}",
             f"{r['peak_gigabytes']:.2f}"] for r in result.get("growth", [])]
    if rows:
        lines += ["Growth, with the same sessions and arcs:", "",
                  _table(["positions", "degree", "CPU s, all", "CPU ms, one iteration", "peak GB"], rows), ""]
    if "rivals" not in result:
        return "\n".join(lines)
    rows = [[r["name"], r["seconds_text"], r["ratio_text"], r["note"]] for r in result["rivals"]]
    lines += [f"Rivals at {result['rival_size']['positions']} positions, degree {result['rival_size']['degree']}, the "
              "same residuals and whitening, from our starting point (not charged to them); CPU time in one run:", "",
              _table(["solver", "CPU s", "times ours", "note"], rows), ""]
    return "\n".join(lines)


def page() -> str:
    """The whole page from the results that exist."""
    parts = ["# Benchmarks of the alignment estimate", "",
             "Every number comes from a file in `benchmarks/results`; `python -m benchmarks.tables` writes this page.",
             ""]
    for name, render in (("alignment_accuracy", accuracy_page), ("random_starts", starts_page),
                         ("alignment_speed", speed_page)):
        result = _read(name)
        if result is not None:
            parts.append(render(result))
    return "\n".join(parts).rstrip() + "\n"


def write_tables() -> str:
    """Write docs/benchmarks.md and return it."""
    text = page()
    PAGE.parent.mkdir(exist_ok=True)
    with written_atomically(PAGE) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return text


if __name__ == "__main__":
    print(write_tables())
    sys.exit(0)
