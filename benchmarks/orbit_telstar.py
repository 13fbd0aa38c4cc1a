"""What separates the ranges of a kept geostationary satellite from the model of its orbit, measured on Telstar 11N.

Run ``python -m benchmarks.orbit_telstar FOLDER [--write]`` with the folder that holds the ranges (``*.gmd``) and the
two-line elements (``tle-*.txt``). It prints the table of effects and the comparison with the two-line elements, which
no fit uses but to start; ``--write`` puts them into the results, the page ``docs/orbit.md`` and the figure.
"""

from __future__ import annotations

import argparse
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.tables import write_result
from estimator.models.earth_orientation import tai_from_utc
from estimator.models.files import written_atomically
from estimator.orbit_signal import OrbitSignal
from estimator.residuals import KernelResidual
from problems.geo_orbit.explanation import explained
from problems.geo_orbit.initial_orbit import state_of_elements
from problems.geo_orbit.kept_orbit import KeptExplanation
from problems.geo_orbit.manoeuvres import FAMILY
from problems.readers.tracking_files import read_files

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "orbit.md"
FIGURE = ROOT / "docs" / "figures" / "telstar-residuals.png"
PICTURE = "![Residuals of Telstar 11N without and with manoeuvres](figures/telstar-residuals.png)"
MARKS = ("<!-- telstar table -->", "<!-- end of telstar table -->")


def element_sets(path: Path) -> list[tuple[np.datetime64, tuple[str, str]]]:
    """Epochs and lines of all element sets of a file."""
    found = []
    lines = path.read_text().splitlines()
    for one, two in pairwise(lines):
        if one.startswith("1 ") and two.startswith("2 "):
            start = np.datetime64(f"20{one[18:20]}-01-01T00:00:00", "us")
            found.append((start + np.timedelta64(round((float(one[20:32]) - 1) * 86400e6), "us"), (one, two)))
    return found


def against_elements(answer: KeptExplanation, path: Path) -> dict[str, float]:
    """Differences of the fitted orbit from the two-line elements at their epochs: medians, deg and m."""
    model = answer.model
    rows = []
    for utc, lines in element_sets(path):
        tai = tai_from_utc([str(utc)])[0]
        seconds = float(model.seconds(np.array([tai]))[0])
        for piece in answer.arcs:
            residual = piece.fit.problem.residuals[0]
            assert isinstance(residual, KernelResidual)
            signal = residual.signals[0]
            assert isinstance(signal, OrbitSignal)
            if signal.arc.span[0] < seconds < signal.arc.span[1]:
                break
        else:
            continue
        theirs = np.concatenate(state_of_elements(lines, tai))
        ours = signal.arc.at(np.array([seconds]), piece.fit.values)[0][0]
        places = model.environment.earth_fixed_state(np.full(2, seconds), np.vstack([ours, theirs]))
        longitude = np.degrees(np.arctan2(places[:, 1], places[:, 0]))
        poles = [np.cross(x[:3], x[3:]) / np.linalg.norm(np.cross(x[:3], x[3:])) for x in (ours, theirs)]
        apart = np.degrees(np.arcsin(np.linalg.norm(np.cross(*poles))))
        rows.append((longitude[0] - longitude[1], apart, np.linalg.norm(places[0, :3]) - np.linalg.norm(places[1, :3]),
                     longitude[0]))
    table = np.array(rows)
    return {
        "element_sets": len(table),
        "longitude_deg": float(np.median(table[:, 3])),
        "longitude_difference_deg": float(np.median(table[:, 0])),
        "longitude_scatter_deg": float(1.4826 * np.median(np.abs(table[:, 0] - np.median(table[:, 0])))),
        "orbit_planes_apart_deg": float(np.median(table[:, 1])),
        "radius_difference_m": float(np.median(table[:, 2])),
    }


def measured(folder: Path) -> tuple[KeptExplanation, dict[str, Any]]:
    """The answer and everything of it that is written."""
    ranges, elements = sorted(folder.glob("*.gmd")), sorted(folder.glob("tle-*.txt"))
    tracking, settings = read_files([*ranges, *elements], ROOT / "examples" / "telstar11n.toml")
    answer = explained(tracking, settings, say=print)
    if not isinstance(answer, KeptExplanation):
        raise SystemExit("no manoeuvre was found in these data")
    result = answer.as_dict()
    result["before"] = {c: {"rms": a, "held_out_rms": b, "unit": u} for c, (a, b, u) in answer.before.items()}
    result["two_line_elements"] = against_elements(answer, elements[0])
    return answer, result


def table(result: dict[str, Any]) -> str:
    """The findings as Markdown: calibration one by one, manoeuvres in the order of time."""
    left, before = result["left"][0], next(iter(result["before"].values()))
    tle = result["two_line_elements"]
    moves = sorted((e for e in result["effects"] if e["name"].startswith(FAMILY)), key=lambda e: e["time_utc"])
    lines = [
        f"One orbit without manoeuvres misses the ranges by {before['rms']:.4g} m RMS; with everything found "
        f"{left['rms']:.3g} m are left, {left['held_out_rms']:.3g} m in the passes that no fit has seen. "
        f"{len(moves)} manoeuvres; verdict: {result['verdict']}; {result['seconds']:.0f} s.",
        "",
        "| effect | size | held out, m, without -> with |",
        "|---|---|---|",
    ]
    for e in result["effects"]:
        if not e["name"].startswith(FAMILY):
            size = ", ".join(
                f"{n} {p['value']:.5g} +- {p['sigma']:.1g} {p['unit']}" for n, p in e["parameters"].items()
            )
            held = "; ".join(f"{h['before']:.4g} -> {h['after']:.3g}" for h in e["held_out"].values())
            name = " or ".join(e["group"])
            lines.append(f"| {name} | {size} | {held} |")
    lines += ["", "| manoeuvre (UTC) | s | radial, along, cross, mm/s | burn, min | held out, m, without |",
              "|---|---|---|---|---|"]
    for e in moves:
        p = e["parameters"]
        size = ", ".join(
            f"{1e3 * p[k]['value']:.2f} +- {1e3 * p[k]['sigma']:.2f}" for k in ("radial", "along", "cross")
        )
        burn = f"{p['duration']['value'] / 60:.0f}" if "duration" in p else "-"
        held = "; ".join(f"{h['before']:.4g}" for h in e["held_out"].values())
        lines.append(f"| {e['time_utc'][:19]} | {p['time']['sigma']:.0f} | {size} | {burn} | {held} |")
    lines += [
        "",
        f"Against {tle['element_sets']} two-line element sets: longitude {tle['longitude_deg']:.3f} degrees, "
        f"{tle['longitude_difference_deg']:+.4f} degrees from theirs (scatter {tle['longitude_scatter_deg']:.4f}); "
        f"planes {tle['orbit_planes_apart_deg']:.4f} degrees apart; radius {tle['radius_difference_m']:+.0f} m.",
    ]
    if result["undetermined"]:
        lines += ["", "Not determined by these data: " + "; ".join(result["undetermined"]) + "."]
    return "\n".join(lines)


def draw(answer: KeptExplanation) -> None:
    """Residuals without and with the manoeuvres, and where these are."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (top, bottom) = plt.subplots(2, 1, figsize=(9, 6), sharex=True, constrained_layout=True)
    fits = [(top, p.plain, "without manoeuvres") for p in answer.arcs]
    fits += [(bottom, p.fit, "with the manoeuvres and the calibration") for p in answer.arcs]
    for axis, fit, title in fits:
        axis.set_prop_cycle(None)
        for residual, part in zip(fit.problem.residuals, fit.parts, strict=True):
            assert isinstance(residual, KernelResidual)
            day = residual.time / 86400.0
            scale = 1e-3 if axis is top else 1.0
            label = f"station {residual.name.split('/')[0]}" if fit is answer.arcs[0].fit else None
            axis.plot(day, scale * part.residual[:, 0], ".", ms=1.5, label=label)
        axis.set_title(title, fontsize=10)
    size = float(np.percentile(np.abs(np.concatenate([q.residual[q.weight > 0, 0]
                                                      for p in answer.arcs for q in p.fit.parts])), 99.5))
    bottom.set_ylim(-3 * size, 3 * size)
    for m in (m for p in answer.arcs for m in p.found.manoeuvres):
        north = abs(m.velocity[2]) > abs(m.velocity[1])
        bottom.axvline(m.time / 86400.0, color="0.8" if north else "tab:red", lw=0.6, zorder=0)
    top.set_ylabel("measured - predicted, km")
    bottom.set_ylabel("measured - predicted, m")
    bottom.set_xlabel("days after the first range; lines: burns, red where mostly along the orbit")
    bottom.legend(fontsize=6, ncol=7, loc="lower left", markerscale=4)
    figure.savefig(FIGURE, dpi=130)
    plt.close(figure)


def main() -> None:
    """Print the table; with ``--write`` keep it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--write", action="store_true", help="write results, page and figure")
    arguments = parser.parse_args()
    answer, result = measured(arguments.folder)
    if arguments.write:
        write_result("orbit_telstar", result)
    text = table(result)
    print(text)
    if arguments.write:
        draw(answer)
        page = PAGE.read_text()
        if MARKS[0] in page:
            start, rest = page.split(MARKS[0])
            _, end = rest.split(MARKS[1])
            with written_atomically(PAGE) as temporary:
                temporary.write_text(f"{start}{MARKS[0]}\n{PICTURE}\n\n{text}\n{MARKS[1]}{end}")


if __name__ == "__main__":
    main()
