"""Pictures of an alignment estimate: residuals, errors in sigmas, and methods against each other.

Every function returns a Matplotlib figure without touching global state; :func:`save` writes it whole or not at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from estimator.models.files import written_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from problems.alignment.demonstration import Comparison
    from problems.alignment.solution import AlignmentSolution

MINUTE = 60.0  # s
ARCSECOND = np.pi / 648000.0  # rad
INK, GREY, BAND, LANE = "#1f2933", "#8a94a0", "#e4e9ee", "#f4f6f8"
COLOURS = ("#0b6e99", "#d9822b", "#5b8c3a")
METHOD_STYLE: dict[Any, Any] = {
    "joint": ("#0b6e99", "o"),
    "linear": ("#5b8c3a", "s"),
    "closed_form": ("#d9822b", "D"),
    "closed_form_literal": ("#b3261e", "^"),
}
STYLE: dict[Any, Any] = {
    "axes.edgecolor": GREY, "axes.labelcolor": INK, "text.color": INK, "xtick.color": INK, "ytick.color": INK,
    "axes.spines.top": False, "axes.spines.right": False, "font.size": 9.5, "axes.titlesize": 10.5,
    "axes.titlelocation": "left", "legend.frameon": False, "figure.dpi": 110,
}
DRAWN = 6000  # most points of one series in a picture


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def save(figure: Figure, path: Path) -> None:
    """Write the figure as the kind that the name of the file says (PNG, SVG, PDF)."""
    with written_atomically(path) as temporary:
        figure.savefig(temporary, format=path.suffix.lstrip(".").lower() or "png", dpi=150, facecolor="white")


def residual_figure(solution: AlignmentSolution) -> Figure:
    """Per channel: residuals over time, and the histogram of the whitened ones against the unit normal."""
    import matplotlib as mpl
    from scipy.stats import norm

    rows = _series(solution)
    with mpl.rc_context(STYLE):
        figure = _figure(10.0, 2.6 * len(rows) + 0.2)
        panels = figure.subplots(len(rows), 2, width_ratios=(2.6, 1.0), squeeze=False)
        for (left, right), row in zip(panels, rows, strict=True):
            place, cuts = _without_gaps(row.time)
            step = max(1, len(place) // DRAWN)
            spreads = np.nanstd(row.residual, axis=0)
            for column, wide in enumerate(spreads):
                left.plot(place[::step], row.residual[::step, column], ".", ms=2.2, alpha=0.5, mew=0,
                          color=COLOURS[column % len(COLOURS)], label=row.labels[column], rasterized=True,
                          zorder=2.0 - wide / np.max(spreads))  # the widest behind
            for cut in cuts:
                left.axvline(cut, color=GREY, lw=0.6, ls=":")
            spread = float(np.max(spreads))
            left.axhline(0.0, color=INK, lw=0.8)
            left.set_ylim(-4.6 * spread, 6.4 * spread)
            left.set_xlim(place[0], place[-1])
            left.set_title(f"{row.title}: measured minus estimated")
            left.set_ylabel(row.unit)
            left.set_xlabel("time, min" + (f" ({len(cuts)} gaps left out, dotted)" if len(cuts) else ""))
            left.legend(loc="upper right", ncols=len(spreads), markerscale=5, handletextpad=0.1, columnspacing=0.9,
                        borderaxespad=0.1)
            flat = row.whitened[np.isfinite(row.whitened)]
            edges = np.linspace(-5, 5, 51)
            right.hist(np.clip(flat, -5, 5), bins=edges, density=True, color="#a9c7d6", label=f"{len(flat):,} values")
            right.plot(edges, norm.pdf(edges), color=INK, lw=1.2, label="unit normal")
            right.set_title(f"whitened: RMS {np.sqrt(np.mean(flat**2)):.3f}")
            right.set_yticks([])
            right.spines["left"].set_visible(False)
            right.set_ylim(0, 0.58)
            right.set_xlabel("sigma")
            right.legend(loc="upper left", fontsize=8, handlelength=1.2, borderaxespad=0.1)
    return figure


@dataclass(frozen=True)
class _Row:
    """One channel: times (n,) s, residuals (n, m) in ``unit``, whitened residuals (n, m)."""

    title: str
    unit: str
    labels: tuple[str, ...]
    time: np.ndarray
    residual: np.ndarray
    whitened: np.ndarray


def _without_gaps(time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Minutes (n,) on an axis from which long gaps are cut, and the places of the cuts."""
    step = np.diff(time)
    usual = float(np.median(step))
    gaps = np.flatnonzero(step > max(20 * usual, 5.0))
    kept = step.copy()
    kept[gaps] = usual
    place = np.concatenate([[0.0], np.cumsum(kept)]) / MINUTE
    return place, 0.5 * (place[gaps] + place[gaps + 1])


def _series(solution: AlignmentSolution) -> list[_Row]:
    """The channels of the estimate."""
    gnss = solution.model.campaign.gnss
    position = solution.estimate.problem.residuals[0]
    fitted, _ = position.signal("values", gnss.time, 0).evaluate(solution.estimate.values)  # type: ignore[attr-defined]
    residual = gnss.position - fitted
    rows = [_Row("satellite navigation", "m", ("x", "y", "z"), gnss.time, residual,
                 residual / np.broadcast_to(gnss.standard_deviation, residual.shape))]
    by_channel: dict[str, list[tuple[Any, Any]]] = {}
    for item, part in zip(solution.estimate.problem.residuals, solution.estimate.parts, strict=True):
        by_channel.setdefault(item.channel, []).append((item, part))
    for channel, title, unit, scale in (("doppler", "Doppler (with the attitude noise in it)", "Hz", 1.0),
                                        ("star_tracker", "star tracker in rotation arcs", "arcsec", ARCSECOND)):
        if channel not in by_channel:
            continue
        items = sorted(by_channel[channel], key=lambda pair: float(pair[0].time[0]))
        values = np.concatenate([p.residual for _, p in items]) / scale
        labels = (("about x", "about y", "about z") if channel == "star_tracker"
                  else tuple(f"beam {b + 1}" for b in range(values.shape[1])))
        rows.append(_Row(title, unit, labels, np.concatenate([i.time for i, _ in items]), values,
                         np.concatenate([p.whitened for _, p in items])))
    return rows


def deviation_figure(comparison: Comparison) -> Figure:
    """Truth minus estimate of every component of the joint estimate in its own sigmas, over bands of one and three."""
    import matplotlib as mpl

    entries = [(f"{block.name}  {label}", value, colour)
               for block, colour in zip(comparison.blocks, COLOURS, strict=False)
               for label, value in zip(block.labels, block.deviation, strict=True)]
    with mpl.rc_context(STYLE):
        figure = _figure(7.6, 0.34 * max(len(entries), 2) + 1.2)
        panel = figure.subplots()
        panel.axvspan(-3, 3, color=BAND, lw=0)
        panel.axvspan(-1, 1, color="#cdd6df", lw=0)
        panel.axvline(0.0, color=INK, lw=0.8)
        for row, (_, value, colour) in enumerate(entries):
            panel.errorbar(value, row, xerr=1.0, fmt="o", ms=5, lw=1.4, capsize=2.5, color=colour)
        panel.set_yticks(range(len(entries)), [name for name, _, _ in entries])
        panel.set_ylim(len(entries) - 0.4, -0.6)
        reach = max([4.0, *(abs(v) + 1.3 for _, v, _ in entries)])
        panel.set_xlim(-reach, reach)
        panel.set_xlabel("truth minus estimate, sigma (bars and dark band: one sigma; light band: three)")
        panel.set_title("The joint estimate against the truth" if entries
                        else "The joint estimate determines no rotation and no inertia here")
    return figure


def method_figure(comparisons: Sequence[Comparison], title: str = "") -> Figure:
    """Error over Cramer-Rao sigma of every method, one row for each quantity, one mark for each campaign.

    Args:
        comparisons: of one campaign or of several; of several the root mean square is drawn as a large mark.
        title: above the picture.
    """
    import matplotlib as mpl

    from problems.alignment.demonstration import METHODS

    quantities = comparisons[0].quantities
    several = len(comparisons) > 1
    with mpl.rc_context(STYLE):
        figure = _figure(9.0, 4.6)
        panel = figure.subplots()
        panel.axvline(1.0, color=INK, lw=1.2, zorder=1)
        for row, quantity in enumerate(quantities):
            panel.axhspan(row - 0.46, row + 0.46, color=LANE, lw=0, zorder=0)
            for lane, key in enumerate(METHODS):
                ratios = [c.quantities[row].ratio(key) for c in comparisons]
                known = np.array([r for r in ratios if r is not None and r > 0])
                colour, marker = METHOD_STYLE[key]
                height = row + (lane - 1.5) * 0.21
                if len(known) == 0:
                    if quantity.bound:
                        panel.annotate(f"{METHODS[key]}: no answer", (1.0, height), xytext=(9, 0), va="center",
                                       textcoords="offset points", fontsize=8.5, color=colour)
                    continue
                if several:
                    panel.plot(known, np.full(len(known), height), marker, ms=3.2, alpha=0.35, mew=0, color=colour)
                centre = float(np.sqrt(np.mean(known**2)))
                panel.plot(centre, height, marker, ms=8.5, color=colour, mec="white", mew=0.8, zorder=3)
                panel.annotate(_short(centre), (centre, height), xytext=(9, 0), textcoords="offset points", va="center",
                               fontsize=8.5, color=colour, zorder=4,
                               bbox={"facecolor": LANE, "lw": 0, "pad": 0.6})
            if not quantity.bound:
                panel.annotate("not determined by this campaign", (1.0, row), xytext=(9, 0), va="center",
                               textcoords="offset points", color=GREY)
        names = [_named(q.name, [c.quantities[row].bound for c in comparisons], q.unit)
                 for row, q in enumerate(quantities)]
        panel.set_yticks(range(len(names)), names)
        panel.set_ylim(len(names) - 0.4, -0.6)
        panel.set_xscale("log")
        low, high = panel.get_xlim()
        panel.set_xlim(min(low, 0.1), max(high * 3, 30))
        panel.tick_params(axis="y", length=0)
        what = f": RMS over {len(comparisons)} campaigns (large) and each of them (small)" if several else ""
        panel.set_xlabel(f"error over Cramer-Rao sigma{what}; the line is the bound")
        for key, words in METHODS.items():
            colour, marker = METHOD_STYLE[key]
            panel.plot([], [], marker, ms=8, color=colour, label=words)
        panel.legend(loc="lower center", bbox_to_anchor=(0.4, 1.0), ncols=4, handletextpad=0.1, columnspacing=1.2)
        if title:
            figure.suptitle(title, x=0.01, ha="left", fontsize=11)
    return figure


def _named(name: str, bounds: Sequence[float | None], unit: str) -> str:
    known = [b for b in bounds if b]
    if not known:
        return name
    size = f"{np.median(known):.2g}" + ("" if unit == "1" else f" {unit}")
    return f"{name}\nsigma {size}"


def _short(value: float) -> str:
    return f"{value:.2f}" if value < 10 else f"{float(f'{value:.2g}'):,.0f}".replace(",", " ")
