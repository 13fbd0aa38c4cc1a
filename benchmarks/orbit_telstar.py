"""What separates the ranges of a kept geostationary satellite from the model of its orbit, measured on Telstar 11N.

Run ``python -m benchmarks.orbit_telstar FOLDER [--write]`` with the folder that holds the ranges (``*.gmd``) and the
two-line elements (``tle-*.txt``). It prints the tables of effects and the comparison with the two-line elements, which
no fit uses but to start; ``--write`` puts them into the results, the page ``docs/orbit.md`` and the figure. What the
longitude of the elements would say of scale and common bias, which lean on it, is stated to first order.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
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
from problems.geo_orbit.manoeuvres import FAMILY, Fit, common_error
from problems.readers.tracking_files import read_files

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "orbit.md"
FIGURE = ROOT / "docs" / "figures" / "telstar-residuals.png"
PICTURE = "![Residuals of Telstar 11N without and with manoeuvres](figures/telstar-residuals.png)"
SCALE = "range-scale-error"
LARGEST = 12  # manoeuvres in the table
MARKS = ("<!-- telstar table -->", "<!-- end of telstar table -->")


def element_sets(path: Path) -> list[tuple[np.datetime64, tuple[str, str]]]:
    """Epochs and lines of all element sets of a file."""
    found = []
    lines = path.read_text().splitlines()
    for one, two in pairwise(lines):
        if one.startswith("1 ") and two.startswith("2 "):
            start: np.datetime64 = np.datetime64(f"20{one[18:20]}-01-01T00:00:00", "us")
            found.append((start + np.timedelta64(round((float(one[20:32]) - 1) * 86400e6), "us"), (one, two)))
    return found


def against_elements(answer: KeptExplanation, path: Path) -> dict[str, float]:
    """Differences of the fitted orbits of all arcs from the two-line elements: see :func:`differences`."""
    return differences(answer, [p.fit for p in answer.arcs], path)


def differences(answer: KeptExplanation, fits: Sequence[Fit], path: Path) -> dict[str, float]:
    """Differences of fitted orbits from the two-line elements at their epochs: medians, deg and m."""
    model = answer.model
    rows = []
    for utc, lines in element_sets(path):
        tai = tai_from_utc([str(utc)])[0]
        seconds = float(model.seconds(np.array([tai]))[0])
        for fit in fits:
            residual = fit.problem.residuals[0]
            assert isinstance(residual, KernelResidual)
            signal = residual.signals[0]
            assert isinstance(signal, OrbitSignal)
            if signal.arc.span[0] < seconds < signal.arc.span[1]:
                break
        else:
            continue
        theirs = np.concatenate(state_of_elements(lines, tai))
        ours = signal.arc.at(np.array([seconds]), fit.values)[0][0]
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


def held_to_elements(answer: KeptExplanation, path: Path) -> dict[str, float]:
    """What the longitude of the two-line elements says of scale and common bias: to first order, longest arc."""
    fit = max((p.fit for p in answer.arcs), key=lambda f: f.rows)
    if all(u.name != SCALE for u in fit.unknowns):
        return {}
    there = differences(answer, [fit], path)
    covariance = fit.covariance() * max(1.0, fit.square / fit.degrees) * max(answer.found.shared, common_error(fit))
    x, y = fit.values["position"][:2]
    longitude = np.zeros(len(covariance))
    longitude[fit.columns("position")] = np.array([-y, x, 0.0]) / (x * x + y * y)
    spread = covariance @ longitude
    sigma = float(np.sqrt(longitude @ spread))
    turn = -np.radians(there["longitude_difference_deg"])
    step = spread / sigma**2 * turn
    rest = covariance - np.outer(spread, spread) / sigma**2
    scale = fit.columns(SCALE).start
    result = {
        "longitude_difference_deg": there["longitude_difference_deg"],
        "longitude_sigma_deg": float(np.degrees(sigma)),
        "scale_free": float(fit.values[SCALE][0]),
        "scale_free_sigma": float(np.sqrt(covariance[scale, scale])),
        "scale_held": float(fit.values[SCALE][0] + step[scale]),
        "scale_held_sigma": float(np.sqrt(max(rest[scale, scale], 0.0))),
    }
    biases = [u.name for u in fit.unknowns if u.name == "range-bias:each"]
    if biases:
        c = fit.columns(biases[0])
        mean = np.zeros(len(covariance))
        mean[c] = 1.0 / (c.stop - c.start)
        result |= {
            "common_bias_free_m": float(fit.values[biases[0]].mean()),
            "common_bias_free_sigma_m": float(np.sqrt(mean @ covariance @ mean)),
            "common_bias_held_m": float(fit.values[biases[0]].mean() + mean @ step),
            "common_bias_held_sigma_m": float(np.sqrt(max(mean @ rest @ mean, 0.0))),
        }
    return result


def kind(e: dict[str, Any]) -> str:
    """What a manoeuvre does, by its largest effect on the orbit."""
    p = e["parameters"]
    if abs(p["along"]["value"]) >= abs(p["cross"]["value"]):
        return "east-west"
    return "north" if p["cross"]["value"] > 0 else "south"


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
    result["scale_held_to_elements"] = held_to_elements(answer, elements[0])
    return answer, result


def _held(e: dict[str, Any]) -> str:
    return "; ".join(f"{h['before']:.4g} -> {h['after']:.4g}" for h in e["held_out"].values())


def _size(p: dict[str, Any], factor: float = 1.0) -> str:
    digits = max(0, min(6, 1 - int(np.floor(np.log10(max(factor * p["sigma"], 1e-9))))))
    return f"{factor * p['value']:.{digits}f} +- {factor * p['sigma']:.{digits}f}"


def table(result: dict[str, Any]) -> str:
    """The findings as Markdown: calibration one by one, manoeuvres by kind and the largest of them."""
    left, before = result["left"][0], next(iter(result["before"].values()))
    tle, held = result["two_line_elements"], result["scale_held_to_elements"]
    moves = [e for e in result["effects"] if e["name"].startswith(FAMILY)]
    lines = [
        f"One orbit without manoeuvres misses the ranges by {before['rms']:.4g} m RMS; with everything found "
        f"{left['rms']:.3g} m are left, {left['held_out_rms']:.3g} m in the passes that no fit has seen, "
        f"{left['held_out_over_expected']:.2f} times what noise and covariance let expect there. "
        f"{len(moves)} manoeuvres in {len(result['arcs'])} {'successive arcs' if len(result['arcs']) > 1 else 'arc'}; "
        f"{result['seconds']:.0f} s. "
        f"Verdict: {result['verdict']}: {result['why']}.",
        "",
        "| arc, UTC | ranges | manoeuvres | left, m RMS | held out, m RMS | over what is expected |",
        "|---|--:|--:|--:|--:|--:|",
    ]
    for a in sorted(result["arcs"], key=lambda a: a["from"]):
        rest = next(iter(a["left"].values()))
        lines.append(f"| {a['from'][:16]} to {a['to'][:16]} | {a['measurements']} | {a['manoeuvres']} "
                     f"| {rest['rms']:.3g} | {rest['held_out_rms']:.3g} | {rest['held_out_over_expected']:.2f} |")
    lines += ["", "| effect | size | held out, m, without -> with |", "|---|---|---|"]
    for e in result["effects"]:
        if not e["name"].startswith(FAMILY):
            size = ", ".join(
                f"{n} {p['value']:.5g} +- {p['sigma']:.1g} {p['unit']}" for n, p in e["parameters"].items()
            )
            lines.append(f"| {' or '.join(e['group'])} | {size} | {_held(e)} |")
    lines += ["", "| manoeuvres | count | mm/s, median (least to largest) | in all, m/s | burn, min, median |",
              "|---|--:|--:|--:|--:|"]
    for k in ("north", "south", "east-west"):
        own = [e for e in moves if kind(e) == k]
        if not own:
            continue
        total = np.array([np.sqrt(sum(e["parameters"][n]["value"] ** 2 for n in ("radial", "along", "cross")))
                          for e in own])
        burns = [e["parameters"]["duration"] for e in own if "duration" in e["parameters"]]
        sure = [b["value"] / 60 for b in burns if b["value"] > 5 * b["sigma"]]
        length = f"{np.median(sure):.0f} over {len(sure)}" if sure else "-"
        lines.append(f"| {k} | {len(own)} | {1e3 * np.median(total):.1f} ({1e3 * total.min():.1f} to "
                     f"{1e3 * total.max():.1f}) | {total.sum():.2f} | {length} |")
    lines += ["", f"The {min(LARGEST, len(moves))} with the largest scores; all are in "
              "`benchmarks/results/orbit_telstar.json`.", "",
              "| manoeuvre (UTC) | +- s | radial, along, cross, mm/s | burn, min | held out, m, without -> with |",
              "|---|--:|---|--:|---|"]
    for e in sorted(moves, key=lambda e: -e["score"])[:LARGEST]:
        p = e["parameters"]
        size = ", ".join(_size(p[k], 1e3) for k in ("radial", "along", "cross"))
        burn = f"{p['duration']['value'] / 60:.0f}" if "duration" in p else "-"
        lines.append(f"| {e['time_utc'][:19]} | {p['time']['sigma']:.0f} | {size} | {burn} | {_held(e)} |")
    lines += [
        "",
        f"Against {tle['element_sets']} two-line element sets: longitude {tle['longitude_deg']:.3f} degrees, "
        f"{tle['longitude_difference_deg']:+.4f} degrees from theirs (scatter {tle['longitude_scatter_deg']:.4f}); "
        f"planes {tle['orbit_planes_apart_deg']:.4f} degrees apart; radius {tle['radius_difference_m']:+.0f} m.",
    ]
    if held:
        lines += [
            "",
            "What ranges from Europe alone hardly tell is a turn of the orbit about the Earth's axis together with a "
            f"common bias and the scale: here the longitude is known to {held['longitude_sigma_deg']:.3f} degrees, the "
            f"scale is {held['scale_free']:.3e} +- {held['scale_free_sigma']:.1g} and the mean of the biases "
            f"{held['common_bias_free_m']:.0f} +- {held['common_bias_free_sigma_m']:.0f} m. Taking the elements' "
            f"longitude, {abs(held['longitude_difference_deg']) / held['longitude_sigma_deg']:.1f} sigmas away, would "
            f"make the scale {held['scale_held']:.3e} +- {held['scale_held_sigma']:.1g} and the mean bias "
            f"{held['common_bias_held_m']:.0f} +- {held['common_bias_held_sigma_m']:.0f} m; ranges computed with "
            "300000 km/s would have a scale of 6.923e-04.",
        ]
    if result["left_where"]:
        lines += ["", "Where most is left: " + "; ".join(w["sentence"] for w in result["left_where"]) + "."]
    if result["rejected"]:
        lines += ["", "Not believed: " + "; ".join(result["rejected"]) + "."]
    if result["undetermined"]:
        lines += ["", "Not determined by these data: " + "; ".join(result["undetermined"]) + "."]
    open_ = [f"{e['time_utc'][:16]}: {e['undetermined']}" for e in moves if "undetermined" in e]
    if open_:
        lines += ["", "Manoeuvres of which a direction is open: " + "; ".join(open_) + "."]
    return "\n".join(lines)


def draw(answer: KeptExplanation) -> None:
    """Residuals without and with the manoeuvres, and where these are."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (top, middle, bottom) = plt.subplots(
        3, 1, figsize=(9, 7.5), sharex=True, constrained_layout=True, height_ratios=(3, 3, 1.6)
    )
    day = 86400.0
    sizes = []
    for piece in answer.arcs:
        for axis, fit in ((top, piece.plain), (middle, piece.fit)):
            axis.set_prop_cycle(None)
            for residual, part in zip(fit.problem.residuals, fit.parts, strict=True):
                assert isinstance(residual, KernelResidual)
                value = part.residual[:, 0] * (1e-3 if axis is top else 1.0)
                station = residual.name.split("/")[0]
                label = f"station {station}" if piece is answer.arcs[0] and axis is top else None
                axis.plot(residual.time / day, value, ".", ms=2.0, label=label)
                if axis is middle:
                    sizes.append(np.abs(value))
        for axis in (top, middle, bottom):
            for end in (piece.found.low, piece.found.high):
                axis.axvline(end / day, color="0.6", lw=0.8, ls=":", zorder=0)
    limit = 1.5 * max(float(np.percentile(np.concatenate(sizes), 98)), 1.0)
    beyond = int(np.sum(np.concatenate(sizes) > limit))
    middle.set_ylim(-limit, limit)
    middle.axhline(0.0, color="0.5", lw=0.6)
    top.set_title("one orbit in each arc, without manoeuvres", fontsize=10)
    middle.set_title("with the manoeuvres and the calibration"
                     + (f" ({beyond} of {sum(map(len, sizes))} ranges are beyond the axis)" if beyond else ""),
                     fontsize=10)
    for color, along, text in (("tab:blue", False, "across the orbit's plane"), ("tab:red", True, "along the orbit")):
        own = [m for p in answer.arcs for m in p.found.manoeuvres
               if (abs(m.velocity[1]) >= abs(m.velocity[2])) == along]
        step = [1e3 * m.velocity[1 if along else 2] for m in own]
        when = [m.time / day for m in own]
        bottom.vlines(when, 0.0, step, color=color, lw=1.0)
        bottom.plot(when, step, "." if not along else "s", color=color, ms=4, label=text)
    bottom.axhline(0.0, color="0.5", lw=0.6)
    bottom.set_yscale("symlog", linthresh=10.0)
    bottom.set_yticks([-100.0, -10.0, 0.0, 10.0, 100.0])
    bottom.set_title("manoeuvres", fontsize=10)
    bottom.set_ylabel("mm/s")
    bottom.set_ylim(-1e3, 1e4)
    bottom.legend(fontsize=8, ncol=2, loc="upper center")
    top.set_ylabel("measured - predicted, km")
    middle.set_ylabel("measured - predicted, m")
    bottom.set_xlabel("days after the first range; dotted: ends of the arcs")
    figure.legend(*top.get_legend_handles_labels(), fontsize=8, ncol=7, loc="outside upper center", markerscale=4)
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
