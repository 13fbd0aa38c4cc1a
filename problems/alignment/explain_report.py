"""The report of ``boresight explain``: one HTML page that stands for itself and can be sent on.

Everything is inside the page: styles, and figures as SVG. A content security policy forbids it to ask for anything.
"""

from __future__ import annotations

import html
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from estimator.discrepancy.dependence import Dependence
from estimator.discrepancy.empirical import EmpiricalTerm
from estimator.discrepancy.score import Score, on_rows, signature
from estimator.discrepancy.search import Finding, Workflow
from estimator.effects.declaration import EffectInstance
from estimator.estimate import Estimate
from estimator.models.files import written_atomically
from estimator.residuals import KernelResidual
from estimator.trajectory_residual import TrajectoryResidual
from problems.alignment.explain_answer import (
    Explanation,
    channels_of,
    next_measurement_sentence,
    number,
    parameters_of,
    physical,
    readable,
    three_sentences,
)

BINS = 200  # points of a curve, over all arcs of a channel
FEWEST_IN_BIN = 12  # samples behind a point of a curve, on average
CLOUD = 2500  # raw samples behind a curve
COMPONENT_COLOURS = ("#2166ac", "#d6604d", "#4d9221", "#8073ac", "#b8860b", "#35978f")
BEFORE, AFTER = "#b2182b", "#2166ac"
CHANNEL_TITLES = {"doppler": "Doppler shift", "star_tracker": "star tracker", "gnss": "positions"}
FORMS = {"constant": "one constant per arc", "smooth": "a smooth curve per arc", "periodic": "periodic, one phase",
         "periodic by arc": "periodic, a phase per arc"}
VERDICTS = {
    "quiet": ("quiet", "#1b7837", "nothing is missing"),
    "named": ("named", "#2166ac", "the missing effect has a name"),
    "ambiguous": ("ambiguous", "#b35806", "the data allow several names"),
    "unknown": ("unknown", "#b2182b", "the library holds no explanation"),
}


@dataclass(frozen=True, eq=False)
class Trace:
    """Residuals of one channel before and after an effect, arcs side by side.

    Attributes:
        channel, unit: of the values.
        place: (n,) position on the axis: minutes of data with the time between arcs taken out.
        arc: (n,) number of the arc.
        edges: (start, stop, name) of each arc on the axis.
        before, after: (n, m) residuals, decorrelated.
        fitted: (n,) True for the samples in the fit, False for those held out.
        floor: (m,) noise of each component.
    """

    channel: str
    unit: str
    place: np.ndarray
    arc: np.ndarray
    edges: tuple[tuple[float, float, str], ...]
    before: np.ndarray
    after: np.ndarray
    fitted: np.ndarray
    floor: np.ndarray

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the components."""
        count = self.before.shape[1]
        return tuple(f"beam {i}" for i in range(count)) if self.channel == "doppler" else ("x", "y", "z")[:count]

    @property
    def signature(self) -> np.ndarray:
        """(n, m) what the effect changed, everything else refitted."""
        return self.before - self.after


def trace(first: Estimate, second: Estimate, channel: str) -> Trace | None:
    """Residuals of a channel in two fits of the same data; None where the channel has none."""
    names: list[str] = []
    times, labels, before, after, fitted, sigma = [], [], [], [], [], []
    unit = ""
    for residual, one, two in zip(second.problem.residuals, _matched(first, second), second.parts, strict=True):
        if residual.channel != channel or one is None:
            continue
        if isinstance(residual, KernelResidual):
            times.append(residual.time)
            labels.append(residual.arc + len(names))
            names += list(residual.arc_names)
            fitted.append(np.ones(residual.samples, dtype=bool) if residual.accepted is None else residual.accepted)
            sigma.append(residual.standard_deviation)
        elif isinstance(residual, TrajectoryResidual):
            times.append(residual.time)
            labels.append(np.full(len(residual.time), len(names)))
            names.append("positions")
            fitted.append(residual.weights[:, 0] > 0)
            sigma.append(np.asarray(residual.standard_deviation))
        else:
            continue
        factor, unit = readable(1.0, residual.unit)
        before.append(_decorrelated(residual, one.residual) * factor)
        after.append(_decorrelated(residual, two.residual) * factor)
        sigma[-1] = sigma[-1] * factor
    if not times:
        return None
    time, label = np.concatenate(times), np.concatenate(labels)
    place, edges, start = np.zeros(len(time)), [], 0.0
    present = sorted(np.unique(label), key=lambda k: float(time[label == k][0]))
    for k in present:
        inside = label == k
        length = float(np.ptp(time[inside])) / 60
        place[inside] = start + (time[inside] - time[inside][0]) / 60
        edges.append((start, start + length, names[k]))
        start += length
    pause = 0.012 * start if len(edges) > 1 else 0.0
    for i, k in enumerate(present):
        place[label == k] += i * pause
        edges[i] = (edges[i][0] + i * pause, edges[i][1] + i * pause, edges[i][2])
    noise = np.sqrt(np.mean(np.concatenate(sigma) ** 2, axis=0))
    order = np.argsort(place, kind="stable")
    return Trace(channel, unit, place[order], label[order], tuple(edges), np.concatenate(before)[order],
                 np.concatenate(after)[order], np.concatenate(fitted)[order], noise)


def _decorrelated(residual: Any, raw: np.ndarray) -> np.ndarray:
    """Residuals with errors that the components share (the tracker's noise in every beam) weighted down.

    The symmetric root of the inverse covariance keeps each component what it is; the result has the size of the
    declared noise where there is nothing but noise.
    """
    factor = getattr(residual, "factor", None)
    if factor is None or raw.shape[1] == 1:
        return raw
    inverse = np.swapaxes(factor, 1, 2) @ factor
    if not np.any(inverse[:, ~np.eye(raw.shape[1], dtype=bool)]):
        return raw
    values, vectors = np.linalg.eigh(inverse)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    return np.asarray(np.einsum("nij,nj->ni", root, raw) * residual.standard_deviation)


def _matched(first: Estimate, second: Estimate) -> list[Any]:
    parts = {r.name: p for r, p in zip(first.problem.residuals, first.parts, strict=True)}
    return [parts.get(r.name) for r in second.problem.residuals]


def binned(item: Trace, values: np.ndarray, mask: np.ndarray, bins: int = BINS) -> tuple[np.ndarray, np.ndarray]:
    """Means in bins of time within arcs: places (k,) and values (k, m), a NaN between arcs so that lines break."""
    total = sum(stop - start for start, stop, _ in item.edges) or 1.0
    bins = min(bins, max(3 * len(item.edges), int(mask.sum()) // FEWEST_IN_BIN))
    places: list[np.ndarray] = []
    means: list[np.ndarray] = []
    for start, stop, _ in item.edges:
        inside = mask & (item.place >= start - 1e-9) & (item.place <= stop + 1e-9)
        if not inside.any():
            continue
        count = max(3, round(bins * (stop - start) / total))
        label = np.minimum(((item.place[inside] - start) / max(stop - start, 1e-12) * count).astype(int), count - 1)
        weight = np.bincount(label, minlength=count)
        # The mean of a handful of samples at a ragged end is noise that looks like a peak.
        filled = np.flatnonzero(weight >= min(FEWEST_IN_BIN // 3, int(weight.max())))
        weight = weight[filled]
        places += [np.bincount(label, item.place[inside], count)[filled] / weight, np.array([np.nan])]
        columns = [np.bincount(label, column, count)[filled] / weight for column in values[inside].T]
        means += [np.column_stack(columns), np.full((1, values.shape[1]), np.nan)]
    if not places:
        return np.zeros(0), np.zeros((0, values.shape[1]))
    return np.concatenate(places), np.concatenate(means)


# ---------------------------------------------------------------------------------------------------- figures


def _svg(figure: Any) -> str:
    import matplotlib.pyplot as plt

    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None},
                   bbox_inches="tight")
    plt.close(figure)
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def _style() -> Any:
    return {"font.size": 8.5, "axes.spines.top": False, "axes.spines.right": False, "axes.titlesize": 9.5,
            "axes.titlelocation": "left", "axes.edgecolor": "#888", "axes.labelcolor": "#333", "xtick.color": "#555",
            "ytick.color": "#555", "svg.hashsalt": "boresight", "figure.facecolor": "none", "axes.facecolor": "white",
            "savefig.facecolor": "none"}


def finding_figure(items: Sequence[Trace], held_out: dict[str, Any]) -> str:
    """Before, signature, after and held-out, one row a channel, as SVG."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    with plt.rc_context(_style()):
        figure, grid = plt.subplots(len(items), 4, figsize=(14.2, 2.9 * len(items)), squeeze=False,
                                    gridspec_kw={"width_ratios": [1, 1, 1, 1], "wspace": 0.24, "hspace": 0.5})
        for row, item in zip(grid, items, strict=True):
            _row(row, item, held_out.get(item.channel))
        return _svg(figure)


def _row(row: Sequence[Any], item: Trace, proof: dict[str, Any] | None) -> None:
    title = CHANNEL_TITLES.get(item.channel, item.channel)
    curves = [binned(item, values, item.fitted) for values in (item.before, item.signature, item.after)]
    finite = [np.nanmax(np.abs(values), initial=0.0) for _, values in curves]
    limit = 1.15 * max([*finite, 1e-12])
    draw = np.random.default_rng(0)
    shown = np.flatnonzero(item.fitted)
    shown = np.sort(draw.choice(shown, min(CLOUD, len(shown)), replace=False)) if len(shown) else shown
    words = (f"{title}: before", "signature of the effect", "after")
    for axes, (place, values), word, raw in zip(row[:3], curves, words, (item.before, None, item.after), strict=True):
        for k, name in enumerate(item.names):
            colour = COMPONENT_COLOURS[k % len(COMPONENT_COLOURS)]
            if raw is not None:
                axes.plot(item.place[shown], raw[shown, k], ",", color=colour, alpha=0.35, rasterized=True, zorder=1)
            axes.plot(place, values[:, k], "-", lw=1.1, color=colour, label=name, zorder=3)
        axes.set_ylim(-limit, limit)
        axes.set_title(word)
        _arcs(axes, item)
    row[0].set_ylabel(f"residual [{item.unit}]")
    row[0].legend(fontsize=7, frameon=False, ncols=len(item.names), loc="upper left", borderaxespad=0.1,
                  handlelength=1.2, columnspacing=0.9)
    _held_out(row[3], item, proof)


def _held_out(axes: Any, item: Trace, proof: dict[str, Any] | None) -> None:
    """Held-out samples of the component that the effect changes most."""
    mask = ~item.fitted
    axes.set_title("held out: nothing was kept from the fit")
    if not mask.any():
        return
    strongest = int(np.argmax(np.sum((item.signature / item.floor) ** 2, axis=0)))
    for values, colour, word in ((item.before, BEFORE, "before"), (item.after, AFTER, "after")):
        place, means = binned(item, values, mask, BINS)
        axes.plot(place, means[:, strongest], ".-", ms=2.5, lw=0.8, color=colour, label=word)
    axes.legend(fontsize=7, frameon=False, loc="upper left", ncols=2, borderaxespad=0.1, handlelength=1.2)
    low, high = axes.get_ylim()
    largest = 1.25 * max(abs(low), abs(high))
    axes.set_ylim(-largest, largest)
    axes.set_title(f"held out, {item.names[strongest]}")
    if proof is not None:
        axes.text(0.02, 0.02, f"all: {proof['before']:.3g} to {proof['after']:.3g} {proof['unit']}, "
                  f"floor {proof['floor']:.3g}", transform=axes.transAxes, fontsize=7, color="#333", va="bottom")
    _arcs(axes, item)


def _arcs(axes: Any, item: Trace) -> None:
    axes.axhline(0, color="#999", lw=0.6, zorder=0)
    for number_, (start, stop, _) in enumerate(item.edges):
        if number_ % 2 == 0 and len(item.edges) > 1:
            axes.axvspan(start, stop, color="#f2f2f2", zorder=-1, lw=0)
    axes.set_xlim(item.edges[0][0], item.edges[-1][1])
    axes.set_xlabel("minutes of data, arcs side by side" if len(item.edges) > 1 else "minutes of data")


def empirical_figure(term: EmpiricalTerm) -> str:
    """Residuals without and with an empirical term over the data and, where it repeats, over its period; as SVG."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    factor, unit = readable(1.0, term.unit)
    time, before, after = term.samples[:, 0], factor * term.samples[:, 1], factor * term.samples[:, 2]
    fitted = term.samples[:, 3] > 0
    step = float(np.median(np.diff(time)))
    arc = np.concatenate([[0], np.cumsum(np.diff(time) > 20 * step)])
    place, edges, start = np.zeros(len(time)), [], 0.0
    for k in range(int(arc[-1]) + 1):
        inside = arc == k
        place[inside] = start + (time[inside] - time[inside][0]) / 60
        edges.append((start, float(place[inside][-1]), ""))
        start = edges[-1][1] + 0.6 * step
    item = Trace(term.channel, unit, place, arc, tuple(edges), before[:, None], after[:, None], fitted,
                 np.array([factor * term.floor]))
    periodic = term.period is not None and term.form == "periodic"
    with plt.rc_context(_style()):
        figure, grid = plt.subplots(1, 3 if periodic else 2, figsize=(14.2 if periodic else 9.6, 2.9), squeeze=False,
                                    gridspec_kw={"wspace": 0.24})
        for axes, mask, word in ((grid[0, 0], fitted, "fitted"), (grid[0, 1], ~fitted, "held out")):
            axes.set_title(f"{word} samples")
            for values, colour, name in ((item.before, BEFORE, "as it is"), (item.after, AFTER, "with the term")):
                if word == "held out" and term.held_out_after is None and name == "with the term":
                    continue
                where, means = binned(item, values, mask)
                axes.plot(where, means[:, 0], ".-", ms=2.5, lw=0.8, color=colour, label=name)
            _arcs(axes, item)
        if periodic:
            assert term.period is not None
            axes = grid[0, 2]
            axes.set_title(f"all samples over {term.period:.4g} s")
            phase = (time / term.period) % 1.0
            label = np.minimum((phase * 24).astype(int), 23)
            middle = (np.arange(24) + 0.5) / 24 * term.period
            count = np.maximum(np.bincount(label, minlength=24), 1)
            for values, colour in ((before, BEFORE), (after, AFTER)):
                axes.errorbar(middle, np.bincount(label, values, 24) / count, factor * term.floor / np.sqrt(count),
                              fmt=".-", ms=3, lw=0.8, color=colour)
            axes.axhline(0, color="#999", lw=0.6, zorder=0)
            axes.set_xlabel("seconds within the period")
        grid[0, 0].set_ylabel(f"residual [{unit}]")
        low, high = grid[0, 0].get_ylim()
        grid[0, 0].set_ylim(low, high + 0.15 * (high - low))  # room for the legend
        grid[0, 0].legend(fontsize=7, frameon=False, loc="upper left", ncols=2, borderaxespad=0.1, handlelength=1.2)
        return _svg(figure)


def imitation(workflow: Workflow, most: int = 12) -> tuple[list[str], np.ndarray]:
    """How far one candidate can stand in for another at the plain fit.

    Returns:
        Names, and a matrix: part (0 to 1) of the size of the row's signature, at its expected size, that the column's
        effect copies once the calibration is refitted too.
    """
    here = workflow.round(())
    present = {u.name for u in here.problem.unknowns}
    chosen = [s for s in here.table if s.degrees > 0 and s.p_value < 1e-3]
    chosen = sorted(chosen, key=lambda s: -s.evidence)[:most]
    names: list[str] = []
    shapes: list[np.ndarray] = []
    spans: list[np.ndarray] = []
    for score in chosen:
        effect = workflow.library[score.name]
        made = None
        if any(p.search for p in effect.parameters):
            made = next((on_rows(s, here.stacked) for s in workflow.searched_signatures()
                         if s.effect.name == score.name and np.array_equal(s.setting, score.setting)), None)
        elif score.name in present:
            made = signature(here.stacked, here.problem, here.parts, effect, np.zeros(len(effect.parameters)))
        if made is None:
            continue
        columns = here.stacked.projected(made.columns)
        norms = np.linalg.norm(columns, axis=0)
        kept = norms > 1e-9 * max(float(norms.max(initial=0.0)), 1e-300)
        if not kept.any():
            continue
        left, singular, _ = np.linalg.svd(columns[:, kept] / norms[kept], full_matrices=False)
        basis = left[:, singular > 1e-4 * singular[0]]
        shape = basis @ (basis.T @ here.stacked.residual)
        size = float(np.linalg.norm(shape))
        if size > 0:
            names.append(score.name)
            shapes.append(shape / size)
            spans.append(basis)
    matrix = np.array([[float(np.linalg.norm(b.T @ s)) for b in spans] for s in shapes]).reshape(len(names), len(names))
    return names, matrix


def imitation_figure(names: Sequence[str], matrix: np.ndarray) -> str:
    """The imitation matrix as SVG."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    with plt.rc_context(_style()):
        side = 0.42 * len(names)
        figure, axes = plt.subplots(figsize=(side + 3.4, side + 0.6))
        axes.imshow(matrix, cmap="Blues", vmin=0, vmax=1.15)
        axes.set_xticks(range(len(names)), names, rotation=40, ha="right")
        axes.set_yticks(range(len(names)), names)
        for (i, j), value in np.ndenumerate(matrix):
            axes.text(j, i, f"{value:.2f}", ha="center", va="center", fontsize=7,
                      color="white" if value > 0.7 else "#333")
        axes.spines[:].set_visible(False)
        axes.tick_params(length=0)
        return _svg(figure)


# ---------------------------------------------------------------------------------------------------- the page

STYLE = """
:root { --ink:#1c2530; --soft:#5b6673; --line:#dfe4ea; --wash:#f5f7f9; }
* { box-sizing:border-box }
body { font:15px/1.5 system-ui,"Segoe UI",Roboto,"Helvetica Neue",Arial,sans-serif; color:var(--ink); margin:0;
  background:#fff }
main { max-width:1180px; margin:0 auto; padding:28px 32px 60px }
h1 { font-size:26px; margin:0 0 4px } h2 { font-size:19px; margin:44px 0 10px; padding-top:14px;
  border-top:1px solid var(--line) } h3 { font-size:15.5px; margin:26px 0 6px }
.soft { color:var(--soft) } .small { font-size:13px }
.verdict { display:inline-block; color:#fff; border-radius:4px; padding:2px 12px; font-weight:600; margin-right:10px }
.lead { background:var(--wash); border-left:5px solid var(--mark); padding:16px 22px; margin:18px 0 }
.lead p { margin:6px 0 } .lead b { display:inline-block; min-width:6.2em }
table { border-collapse:collapse; margin:8px 0 14px; width:100%; font-size:13.5px; font-variant-numeric:tabular-nums }
th { text-align:left; font-weight:600; color:var(--soft); border-bottom:1.5px solid #b9c2cc; padding:4px 10px 4px 0;
  vertical-align:bottom } td { border-bottom:1px solid var(--line); padding:4px 10px 4px 0; vertical-align:top }
td:first-child { white-space:nowrap }
td.n, th.n { text-align:right; white-space:nowrap } tr.found td { background:#eef4fb; font-weight:600 }
tr.dim td { color:var(--soft) } figure { margin:10px 0 4px; overflow-x:auto } figure svg { max-width:100%; height:auto }
figcaption { color:var(--soft); font-size:13px; margin-top:2px; max-width:1000px }
.facts { display:flex; gap:30px; flex-wrap:wrap; margin:10px 0 0 } .facts div { min-width:110px }
.facts b { display:block; font-size:19px } details summary { cursor:pointer; color:var(--soft); margin:6px 0 }
nav a { color:#2166ac; text-decoration:none; margin-right:18px } nav { margin:14px 0 0; font-size:14px }
@media print { main { padding:0; max-width:none } h2 { break-after:avoid } figure, tr { break-inside:avoid }
  nav { display:none } details > * { display:block } }
"""


def _e(text: object) -> str:
    return html.escape(str(text))


def _cell(text: object, numeric: bool = False) -> str:
    return f'<td class="n">{text}</td>' if numeric else f"<td>{text}</td>"


def _table(head: Sequence[tuple[str, bool]], rows: Sequence[tuple[str, Sequence[str]]]) -> str:
    top = "".join(f'<th{" class=n" if n else ""}>{_e(t)}</th>' for t, n in head)
    body = "".join(f'<tr{f" class={kind}" if kind else ""}>'
                   + "".join(_cell(c, n) for c, (_, n) in zip(cells, head, strict=True)) + "</tr>"
                   for kind, cells in rows)
    return f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"


def page_of(explanation: Explanation, source: str = "") -> str:
    """The whole page as text."""
    findings = explanation.findings
    campaign = explanation.subject.campaign
    word, colour, meaning = VERDICTS.get(findings.verdict, (findings.verdict, "#555", ""))
    where, what, proof = three_sentences(explanation)
    doppler = 0 if campaign.doppler is None else campaign.doppler.frequency_shift.size
    facts = [("positions", f"{len(campaign.gnss.time):,}"), ("attitudes", f"{len(campaign.star_tracker.time):,}"),
             ("Doppler shifts", f"{doppler:,}"), ("arcs", f"{len(campaign.arcs)}"),
             ("candidates", f"{len(explanation.workflow.library)}"), ("kept for the proof",
                                                                     f"{100 * explanation.subject.hold_out:.0f} %")]
    sections = [_findings_section(explanation), _where_section(explanation), _empirical_section(explanation),
                _scores_section(explanation), _imitation_section(explanation), _next_section(explanation),
                _reading_section(explanation)]
    empirical = '<a href="#empirical">Shape of the rest</a>' if 'id="empirical"' in "".join(sections) else ""
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'; img-src data:">
<title>{_e(findings.verdict)}: {_e(campaign.title or source)}</title><style>{STYLE}</style></head>
<body><main style="--mark:{colour}">
<h1>What the model of this campaign misses</h1>
<p class="soft">{" &middot; ".join(_e(t) for t in (campaign.title, source, "epoch " + campaign.epoch) if t)}</p>
<div class="lead"><p><span class="verdict" style="background:{colour}">{_e(word)}</span>{_e(meaning)}</p>
<p><b>Where</b> {_e(where)}</p><p><b>What</b> {_e(what)}</p><p><b>Proof</b> {_e(proof)}</p>
<p><b>Next</b> {_e(_sentence(next_measurement_sentence(explanation)))}</p></div>
<div class="facts">{"".join(f"<div><b>{v}</b><span class='soft small'>{_e(k)}</span></div>" for k, v in facts)}</div>
<nav><a href="#findings">Effects</a><a href="#where">Where</a>{empirical}<a href="#scores">Scores</a>
<a href="#alike">Look-alikes</a><a href="#next">Next measurement</a><a href="#reading">How to read</a></nav>
{"".join(sections)}
</main></body></html>
"""


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + ("" if text.endswith(".") else ".")


def _findings_section(explanation: Explanation) -> str:
    findings = explanation.findings
    parts = ['<h2 id="findings">Effects that were added</h2>']
    if not findings.findings:
        parts.append("<p>None: no effect of the library is significant after the search and pays on held-out data.</p>")
    order = explanation.accepted
    for k, finding in enumerate(findings.findings):
        parts.append(_finding_block(explanation, finding, order[:k], order[: k + 1]))
    if findings.rejected:
        parts.append(f"<p class='soft'>Significant in the fit and turned down because held-out data were predicted no "
                     f"better: {_e(', '.join(findings.rejected))}.</p>")
    return "".join(parts)


def _finding_block(explanation: Explanation, finding: Finding, before: Sequence[str], after: Sequence[str]) -> str:
    workflow, final = explanation.workflow, explanation.findings.final
    effect = explanation.instance(finding.name)
    first, second = workflow.fit(before).estimate, workflow.fit(after).estimate
    channels = [c for c in channels_of(second, finding.name) if c in finding.held_out_before]
    items = [t for t in (trace(first, second, c) for c in channels) if t is not None]
    held_out = physical(finding.held_out_before, finding.held_out_after, channels)
    block = [f"<h3>{len(before) + 1}. {_e(finding.name)}</h3>",
             f"<p>Sum of squares lower by {finding.score:.1f} with {finding.degrees} parameter"
             f"{'' if finding.degrees == 1 else 's'}; probability of such a find anywhere in the library without any "
             f"effect {_probability(finding.p_value_after_search)}."]
    if len(finding.group) > 1:
        block.append(f" These data explain as well: <b>{_e(', '.join(finding.group[1:]))}</b>.")
    block.append("</p>")
    if items:
        block.append(f"<figure>{finding_figure(items, held_out)}<figcaption>Dots: samples. Lines: means over short "
                     "stretches. Errors that all beams share are weighted down as in the fit. The signature is what "
                     "the effect changed after everything else was refitted. Right: samples that no fit used, in the "
                     "component that the effect changes most.</figcaption></figure>")
    fitted = parameters_of(final, effect)
    rows = []
    for i, p in enumerate(effect.parameters):
        got = fitted.get(p.name, {"value": float("nan"), "sigma": None})
        expected_sigma = finding.expected.sigma[i] if i < len(finding.expected.sigma) else np.nan
        rows.append(("", [_e(p.name), _e(number(got["value"], got["sigma"], p.unit)),
                          _e(number(float(finding.expected.size[i]), float(expected_sigma), p.unit))
                          if p.search is None else f"{finding.expected.size[i]:.4g} {_e(p.unit)} (tried)",
                          _range(p.plausible, p.unit),
                          "" if p.nominal is None else f"{p.nominal:g}"]))
    head = [("parameter", False), ("joint fit of all data", False), ("predicted by the score", False),
            ("plausible", False), ("demanded by physics", False)]
    if all(p.nominal is None for p in effect.parameters):
        head, rows = head[:-1], [(kind, cells[:-1]) for kind, cells in rows]
    block.append(_table(head, rows[:12]))
    if len(rows) > 12:
        block.append(f"<details><summary>{len(rows) - 12} more parameters</summary>{_table(head, rows[12:])}</details>")
    proof_rows = []
    inside = physical(finding.gap_before, finding.gap_after, list(finding.held_out_before))
    kept = physical(finding.held_out_before, finding.held_out_after, list(finding.held_out_before))
    for channel, v in kept.items():
        w = inside.get(channel, v)
        proof_rows.append(("" if channel in channels else "dim", [
            _e(CHANNEL_TITLES.get(channel, channel)), f"{w['before']:.4g}", f"{w['after']:.4g}", f"{v['before']:.4g}",
            f"{v['after']:.4g}", f"{v['floor']:.4g}", _e(v["unit"]), f"{v['ratio_before']:.3f} &rarr; "
            f"{v['ratio_after']:.3f}", f"{v['count']:,}"]))
    block.append(_table([("root mean square miss", False), ("fitted, before", True), ("after", True),
                         ("held out, before", True), ("after", True), ("floor", True), ("unit", False),
                         ("held out over floor", True), ("held-out values", True)], proof_rows))
    moved = [(n, s) for n, s in finding.moved.items() if s >= 0.1]
    if moved:
        block.append("<p>What the others moved by when it was added: " + ", ".join(
            f"{_e(n)} {s:.1f} sigma" for n, s in sorted(moved, key=lambda item: -item[1])) + ".</p>")
    else:
        block.append("<p>None of the other unknowns moved by a tenth of a sigma when it was added.</p>")
    block.append(f"<p class='soft small'>Zero when: {_e(effect.zero)}. Reference: {_e(effect.reference)}.</p>")
    return "".join(block)


def _range(limits: tuple[float, float], unit: str) -> str:
    low, shown = readable(limits[0], unit)
    return f"{low:.4g} to {readable(limits[1], unit)[0]:.4g} {_e('' if shown == '1' else shown)}"


def _probability(p: float) -> str:
    return "below 1e-12" if p < 1e-12 else f"{p:.1e}" if p < 0.001 else f"{p:.3f}"


def _where_section(explanation: Explanation) -> str:
    findings = explanation.findings
    parts = ['<h2 id="where">Where model and data disagree</h2>']
    for word, gap, depends_on in (("Before, with the plain model", findings.before, explanation.depends_on),
                                  ("Left, with the effects that were added", findings.after,
                                   explanation.left_depends_on)):
        parts.append(f"<h3>{word}</h3>")
        if word.startswith("Left") and gap.present and not findings.findings:
            parts.append("<p>All of it: no effect was added.</p>")
            continue
        if not gap.present:
            parts.append("<p>Nowhere: in every arc and component the residuals are noise"
                         f" (smallest probability over all places {_probability(gap.p_value)}).</p>")
        else:
            rows = []
            for p in gap.places:
                excess, unit = readable(p.excess, p.unit)
                many = f"{len(p.arcs)} arcs" if len(p.arcs) > 6 else ", ".join(p.arcs)
                rows.append(("", [_e(CHANNEL_TITLES.get(p.channel, p.channel)), _e(many),
                                  ", ".join(str(c) for c in p.components), f"{excess:.4g} {_e(unit)}",
                                  f"{readable(p.floor, p.unit)[0]:.4g} {_e(unit)}", f"{p.time_scale:.4g} s",
                                  _probability(p.p_value), _e(p.sentence)]))
            parts.append(_table([("channel", False), ("arcs", False), ("components", False), ("structure, RMS", True),
                                 ("noise", True), ("changes within", True), ("probability", True),
                                 ("in words", False)], rows))
            parts.append(_depends_on(depends_on))
        if gap.white:
            parts.append("<p>White noise above the declared one: " + ", ".join(
                f"{_e(name.replace('_', ' '))} {factor:.2f} times" for name, factor in gap.white) + ".</p>")
    return "".join(parts)


def _depends_on(depends_on: Sequence[Dependence]) -> str:
    """What the disagreement goes with, as a table."""
    if not depends_on:
        return ("<p>It goes with none of the covariates that were tried (time, orbit phase, sunlight, rate, look "
                "direction, frequency, housekeeping) more than chance and plain time inside the arcs allow.</p>")
    rows = []
    for d in depends_on:
        excess, unit = readable(d.excess, d.unit)
        slope = "" if d.slope is None else f"{readable(d.slope, d.unit)[0]:.4g} {unit}"
        slope += f" per {d.covariate_unit}" if slope and d.covariate_unit != "1" else ""
        rows.append(("", [_e(CHANNEL_TITLES.get(d.channel, d.channel)), ", ".join(str(c) for c in d.components),
                          f"<b>{_e(d.covariate)}</b>", _e(d.form), _e(slope), f"{excess:.4g} {_e(unit)}",
                          f"{100 * d.share:.0f} %", _probability(d.p_value), _e(", ".join(d.alike))]))
    return "<p>What it goes with:</p>" + _table(
        [("channel", False), ("components", False), ("covariate", False), ("form", False), ("slope", True),
         ("RMS", True), ("share of the excess", True), ("probability", True), ("as well with", False)], rows)


def _empirical_section(explanation: Explanation) -> str:
    """The shape of what no effect explains, and how far it carries the gap."""
    if explanation.findings.verdict != "unknown" or not explanation.findings.after.present:
        return ""
    parts = ['<h2 id="empirical">The shape of what is left</h2>',
             '<p><span class="verdict" style="background:#b35806">EMPIRICAL</span> not a name: these terms carry the '
             "structure that no effect of the library explains. They say how it looks, not what it is, and are not in "
             "the estimate.</p>"]
    if not explanation.empirical:
        return "".join([*parts, "<p>No constants, curves or periods are worth their parameters.</p>"])
    rows = []
    for t in explanation.empirical:
        unit = readable(1.0, t.unit)[1]

        def shown(value: float | None, given: str = t.unit) -> str:
            return "-" if value is None else f"{readable(value, given)[0]:.4g}"

        which = f"beam {t.component}" if t.channel == "doppler" else f"axis {'xyz'[t.component % 3]}"
        size = number(t.amplitude, t.sigma, t.unit)
        rows.append(("", [f"{_e(CHANNEL_TITLES.get(t.channel, t.channel))}, {_e(which)}", _e(FORMS[t.form]),
                          "" if t.period is None else f"{t.period:.5g} s", _e(size), shown(t.rms),
                          shown(t.fitted_before), shown(t.fitted_after), shown(t.held_out_before),
                          shown(t.held_out_after), shown(t.floor), _e(unit)]))
    parts.append(_table([("where", False), ("form", False), ("period", True), ("size", True), ("RMS", True),
                         ("fitted, before", True), ("after", True), ("held out, before", True), ("after", True),
                         ("noise", True), ("unit", False)], rows))
    if any(t.held_out_after is None and t.held_out_before is not None for t in explanation.empirical):
        parts.append('<p class="soft small">A dash: a curve of one arc cannot be carried on to the end of the arc that '
                     "was held out, so it is not proved there.</p>")
    for t in explanation.empirical:
        parts.append(f"<figure>{empirical_figure(t)}<figcaption>{_e(t.sentence)}.</figcaption></figure>")
        if t.refused:
            parts.append(f'<p class="soft small">Turned down in {_e(CHANNEL_TITLES.get(t.channel, t.channel))} because '
                         f"held-out data were predicted worse: {_e(', '.join(FORMS[f] for f in t.refused))}.</p>")
        parameters = [("", [_e(p.name), _e(number(p.value, p.sigma, p.unit))]) for p in t.parameters]
        parts.append(f"<details><summary>{len(parameters)} parameters of the term in "
                     f"{_e(CHANNEL_TITLES.get(t.channel, t.channel))}, component {t.component}</summary>"
                     + _table([("parameter", False), ("value", False)], parameters) + "</details>")
    return "".join(parts)


def _scores_section(explanation: Explanation) -> str:
    findings = explanation.findings
    table = findings.tables[0] if findings.tables else ()
    library = explanation.workflow.library
    accepted = set(explanation.accepted)
    seen = [s for s in table if s.degrees > 0]
    rows = [("found" if s.name in accepted else "", _score_row(s, library[s.name])) for s in seen]
    head = [("effect", False), ("score", True), ("degrees", True), ("p, this effect alone", True), ("log odds", True),
            ("power", True), ("expected size", False)]
    parts = ['<h2 id="scores">Every candidate at the plain model</h2>',
             "<p>Score: drop of the sum of squares that the effect would bring, the calibration refitted with it. "
             "Power: probability to see it here if it had its typical size. The search over the whole library amounts "
             f"to {findings.looks:.0f} independent names, each at the best of its settings.</p>",
             _table(head, rows[:10])]
    if len(rows) > 10:
        parts.append(f"<details><summary>{len(rows) - 10} more candidates</summary>{_table(head, rows[10:])}</details>")
    hidden = [s for s in table if s.degrees == 0 or s.absorbed_by]
    if hidden:
        parts.append("<h3>Hardly or not visible in these data</h3>")
        parts.append(_table([("effect", False), ("absorbed by", False), ("part left of its signature", True)],
                            [("", [_e(s.name), _e(", ".join(s.absorbed_by) or "no sample feels it"),
                                   f"{np.sqrt(max(s.visible, 0.0)):.1e}"]) for s in hidden]))
    return "".join(parts)


def _score_row(score: Score, effect: EffectInstance) -> list[str]:
    shown = [f"{p.name} {number(float(v), float(s), p.unit)}" if p.search is None else f"{p.name} {v:.4g} {p.unit}"
             for p, v, s in zip(effect.parameters, score.size, score.sigma, strict=True)]
    if len(shown) > 6:
        shown = [*shown[:6], f"{len(shown) - 6} more"]
    return [_e(score.name), f"{score.score:.1f}", str(score.degrees), _probability(score.p_value),
            f"{score.evidence:.1f}", f"{score.power:.2f}", f"<span class='small'>{_e('; '.join(shown))}</span>"]


def _imitation_section(explanation: Explanation) -> str:
    names, matrix = imitation(explanation.workflow)
    parts = ['<h2 id="alike">Look-alikes</h2>']
    if len(names) < 2:
        parts.append("<p>Fewer than two candidates are significant, so nothing can be mistaken for another.</p>")
        return "".join(parts)
    parts.append(f"<figure>{imitation_figure(names, matrix)}<figcaption>If the effect of the row were true, how much "
                 "of its signature the effect of the column would copy, the calibration refitted with it: 1 is a "
                 "perfect copy, which no data of this kind can tell apart.</figcaption></figure>")
    return "".join(parts)


def _next_section(explanation: Explanation) -> str:
    parts = ['<h2 id="next">Next measurement</h2>',
             f"<p>{_e(_sentence(next_measurement_sentence(explanation)))}</p>"]
    if explanation.advice is not None:
        rows = [("found" if i == 0 else "", [_e(p.option.words), f"{p.option.duration:.0f} s",
                                            f"{p.separation:.1f}"])
                for i, p in enumerate(explanation.advice.prospects[:12])]
        parts.append(_table([("what can be asked for", False), ("length", True), ("separation in sigma", True)], rows))
        parts.append(f"<p class='soft small'>Separation of {_e(', '.join(explanation.advice.group))} with this "
                     f"campaign and the arc together; this campaign alone: {explanation.advice.now:.1f} sigma.</p>")
    return "".join(parts)


def _reading_section(explanation: Explanation) -> str:
    return f"""<h2 id="reading">How to read this page</h2>
<p class="small">The last {100 * explanation.subject.hold_out:.0f} % of every arc and short blocks of the positions
were kept from all fits that decide what is named; they are the held-out data. An effect is added only if it is
significant after the search over the whole library (probability below 1 %) and predicts the held-out data better. Names
that explain the data about equally well form a group. The parameters come from one joint fit of all data, together with
the mounting, the inertia, the actuators and the trajectory; their sigmas are those of that fit. "Unknown" means that
structure is left that no effect of the library explains. The search took {explanation.seconds:.0f} s.</p>"""


def write_report(explanation: Explanation, path: Path, *, source: str = "") -> None:
    """Write the page; an interrupted write leaves nothing half done.

    Args:
        explanation: what to report.
        path: file to write.
        source: name of the campaign's file, for the head of the page.
    """
    text = page_of(explanation, source)
    with written_atomically(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
