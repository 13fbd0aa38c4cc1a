"""Sentinel-1: which effect closes the gap between the measured Doppler centroid and the one that geometry predicts?

    python -m benchmarks.sentinel1_explain [FOLDER]

For each scene, and for all scenes of one satellite together, every model is fitted on one part of the Doppler estimates
and held against another that it never saw:

- ``second half``: fitted on the first half of each acquisition along track, proven on the second;
- ``third sub-swath``: fitted on IW1 and IW2, proven on IW3;
- ``both``: fitted on IW1 and IW2 of the first half, proven on IW3 of the second.

Models: none (geometry alone), a constant mounting, and the mounting with one named effect of the library. An addition
is proposed by the fitted part alone (chi-square that falls by more than chance would make it), and accepted when the
held-out part falls as well; then the rest of the library is tried again on top of it. What remains is described:
how much of it is common to the sub-swaths, its time scale along track, its drift, and its pattern along range; two
empirical terms show on data they never saw how much of it these carry. Writes
``benchmarks/results/sentinel1_explain.json`` and ``docs/sentinel1_explain.md``.
"""

from __future__ import annotations

import argparse
import json
import sys
import textwrap
import time as clock
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from benchmarks.sentinel1_geometry import DATA, HERE, acquisitions
from estimator.models.files import written_atomically
from estimator.residuals import KernelResidual
from estimator.solvers import solve
from problems.alignment.investigation import explain_campaign
from problems.alignment.problem import AlignmentModel, alignment_model, alignment_problem
from problems.alignment.sentinel1_import import SPEED_OF_LIGHT, campaign_with_swaths
from problems.readers.sentinel1_annotation import Annotation, read_annotation

RESULTS = HERE / "results" / "sentinel1_explain.json"
PAGE = HERE.parent / "docs" / "sentinel1_explain.md"

SESSION = "pointing-offset-per-session"
LIBRARY = (SESSION, "doppler-timetag-offset", "tracker-timetag-offset", "antenna-thermal-deformation", "doppler-bias",
           "carrier-frequency-offset", "tracker-low-frequency-error")
SPLITS = ("second half", "third sub-swath", "both")
CHANCE = 1e-3
"""Probability that an addition is proposed although it means nothing."""
TOGETHER = 3.0
"""Values along range that count as one: errors of one estimate go together, so chi-square falls three times as far."""
BURST = 2.76  # [s] from one estimate of a sub-swath to the next


@dataclass(frozen=True, eq=False)
class Case:
    """One scene, or all scenes of a satellite, with the sub-swath of each Doppler row."""

    name: str
    annotations: list[Annotation]

    @cached_property
    def _imported(self) -> tuple[AlignmentModel, np.ndarray]:
        campaign, swaths = campaign_with_swaths(self.annotations)
        model = alignment_model(campaign)
        return model, np.array(swaths)[model.doppler_epochs]

    @property
    def model(self) -> AlignmentModel:
        return self._imported[0]

    @property
    def swath(self) -> np.ndarray:
        """(n,) name of the sub-swath of each row."""
        return self._imported[1]

    @cached_property
    def time(self) -> np.ndarray:
        """(n,) s."""
        assert self.model.campaign.doppler is not None
        return self.model.campaign.doppler.time[self.model.doppler_epochs]

    @cached_property
    def session(self) -> np.ndarray:
        """(n,) index of the acquisition of each row."""
        return self.model.session_of_epoch[0]

    @cached_property
    def early(self) -> np.ndarray:
        """(n,) whether a row is in the first half of its acquisition."""
        result = np.zeros(len(self.time), dtype=bool)
        for k in np.unique(self.session):
            inside = self.session == k
            span = self.time[inside]
            result[inside] = span <= 0.5 * (span[0] + span[-1])
        return result

    def split(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Masks (n,) of the fitted and of the held-out rows; the latter is empty where the case has no such part."""
        third = self.swath == "IW3"
        if name == "second half":
            return self.early, ~self.early
        if name == "third sub-swath":
            return ~third, third
        return self.early & ~third, ~self.early & third

    @cached_property
    def deviation(self) -> np.ndarray:
        """(n, b) Hz, declared noise of each value."""
        doppler = self.model.campaign.doppler
        assert doppler is not None
        return np.broadcast_to(doppler.standard_deviation, doppler.frequency_shift.shape)[self.model.doppler_epochs]


@dataclass(frozen=True)
class Fit:
    """A model fitted on some rows.

    Attributes:
        residual: (n, b) Hz of all rows, measured minus modelled.
        square: sum of whitened squares of the fitted rows.
        parameters: number of determined directions among antenna and effects.
        values: value of each effect's parameters, with sigma and unit.
    """

    residual: np.ndarray
    square: float
    parameters: int
    values: dict[str, dict[str, Any]]


def fitted(case: Case, used: np.ndarray, effects: Sequence[str], mounting: bool = True) -> Fit:
    """Fit mounting and effects on the rows ``used`` (n,), from the design value."""
    problem = alignment_problem(case.model, effects)
    problem = problem.starting_at({"antenna_from_tracker": case.model.campaign.nominal.antenna_from_tracker})
    place = next(i for i, r in enumerate(problem.residuals) if r.name == "doppler")
    doppler = problem.residuals[place]
    assert isinstance(doppler, KernelResidual)
    problem = problem.with_residuals(replace(r, accepted=used) if r is doppler else r for r in problem.residuals)
    if not mounting:
        problem = problem.holding("antenna_from_tracker")
    estimate = solve(problem)
    part = estimate.parts[place]
    named = [u for u in estimate.unknowns if not u.nuisance]
    weak = sum(1 for w in estimate.weak if sum(v for k, v in w.participation.items() if k != "trajectory") > 0.5)
    values: dict[str, dict[str, Any]] = {}
    for instance in case.model.effect_instances(effects):
        sigma, value = estimate.sigma_of(instance.name), estimate.values[instance.name]
        values[instance.name] = {
            p.name: {"value": float(v), "sigma": float(s) if np.isfinite(s) else None, "unit": p.unit}
            for p, v, s in zip(instance.parameters, value, sigma, strict=True)}
    square = float(np.sum(part.whitened[used] ** 2))
    return Fit(part.residual, square, sum(u.manifold.tangent for u in named) - weak, values)


def rms(values: np.ndarray) -> float:
    """Root mean square of all entries."""
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def floor(case: Case, residual: np.ndarray, rows: np.ndarray) -> float:
    """White part (Hz) of the scatter of single values: differences of successive estimates of a sub-swath, over sqrt 2.

    What varies slowly along track is not in it; only pairs of rows that both lie in ``rows`` (n,) count.
    """
    differences = []
    for k in np.unique(case.session):
        for swath in np.unique(case.swath):
            mine = np.flatnonzero(rows & (case.session == k) & (case.swath == swath))
            pairs = np.flatnonzero(np.diff(case.time[mine]) < 1.5 * BURST)
            differences.append(residual[mine[pairs + 1]] - residual[mine[pairs]])
    return rms(np.concatenate(differences)) / np.sqrt(2)


def explained(case: Case, split: str) -> dict[str, Any] | None:
    """All models on one split, and the additions that are accepted; None where the case has no such part."""
    used, held = case.split(split)
    if not (used.any() and held.any()):
        return None
    geometry = fitted(case, used, (), mounting=False)
    current = fitted(case, used, ())
    library = [name for name in LIBRARY if name != SESSION or len(np.unique(case.session)) > 1]
    rows: dict[str, Any] = {
        "fitted_rows": int(used.sum()), "held_out_rows": int(held.sum()),
        "geometry": _row(geometry, used, held), "mounting": _row(current, used, held),
        "floor_hz": floor(case, geometry.residual, held), "annotated_rms_hz": rms(case.deviation[held]),
    }
    singles: dict[str, Any] = {}
    steps: list[dict[str, Any]] = []
    accepted: list[str] = []
    gain = rows["mounting"]["held_out_hz"] < rows["geometry"]["held_out_hz"]
    rows["mounting_accepted"] = bool(gain)
    while True:
        trials = {name: fitted(case, used, (*accepted, name)) for name in library if name not in accepted}
        scores = {name: _score(current, fit, used) for name, fit in trials.items()}
        if not accepted:
            singles = {name: {**_row(fit, used, held), **scores[name], "parameters": fit.values.get(name, {})}
                       for name, fit in trials.items()}
        proposals = sorted((n for n in trials if scores[n]["proposed"]), key=lambda n: scores[n]["p_value"])
        taken = None
        for name in proposals:
            before, after = rms(current.residual[held]), rms(trials[name].residual[held])
            steps.append({"name": name, "on_top_of": list(accepted), "p_value": scores[name]["p_value"],
                          "held_out_before_hz": before, "held_out_after_hz": after, "accepted": after < before})
            if after < before:
                taken = name
                break
        if taken is None:
            break
        accepted.append(taken)
        current = trials[taken]
    rows |= {"single_effects": singles, "steps": steps, "accepted": accepted, "final": _row(current, used, held)}
    return rows


def _row(fit: Fit, used: np.ndarray, held: np.ndarray) -> dict[str, float]:
    return {"fitted_hz": rms(fit.residual[used]), "held_out_hz": rms(fit.residual[held])}


def _score(before: Fit, after: Fit, used: np.ndarray) -> dict[str, Any]:
    """Whether the fitted part alone proposes an addition: fall of chi-square against what chance does."""
    added = after.parameters - before.parameters
    values = 3 * int(used.sum())
    scale = max(before.square / max(values - before.parameters, 1), 1.0) * TOGETHER
    fall = max(before.square - after.square, 0.0) / scale
    p_value = float(chi2.sf(fall, added)) if added > 0 else 1.0
    return {"added_parameters": added, "p_value": p_value, "proposed": bool(p_value < CHANCE)}


# ---------------------------------------------------------------------------------------------------------------- #
# what remains


def structure(case: Case) -> dict[str, Any]:
    """Shape of what a constant mounting leaves, from all rows: along track and along range."""
    everything = np.ones(len(case.time), dtype=bool)
    effects = (SESSION,) if len(np.unique(case.session)) > 1 else ()
    residual = fitted(case, everything, effects).residual
    mean = residual.mean(axis=1)
    drifts, common = [], []
    lags: dict[int, list[tuple[float, float]]] = {}
    for k in np.unique(case.session):
        inside = case.session == k
        half = 0.5 * float(np.ptp(case.time[inside]))
        late = inside & ~case.early
        drifts.append(float(mean[late].mean() - mean[inside & case.early].mean()))
        for swath in np.unique(case.swath[inside]):
            mine = np.flatnonzero(inside & (case.swath == swath))
            series = mean[mine]
            for i in range(len(mine)):
                for j in range(i, len(mine)):
                    step = round((case.time[mine[j]] - case.time[mine[i]]) / BURST)
                    lags.setdefault(step, []).append((series[i] * series[j], 0.5 * (series[i] ** 2 + series[j] ** 2)))
            for other in np.unique(case.swath[inside]):
                if other > swath:
                    theirs = np.flatnonzero(inside & (case.swath == other))
                    carried = np.interp(case.time[mine], case.time[theirs], mean[theirs])
                    if len(mine) > 3:
                        common.append(float(np.corrcoef(series, carried)[0, 1]))
        assert half > 0
    correlation = [(lag * BURST, sum(a for a, _ in v) / sum(b for _, b in v)) for lag, v in sorted(lags.items())
                   if len(v) >= 5]
    velocity = 7.5e3  # [m/s] of the spacecraft, to a per cent
    carrier = case.model.campaign.doppler.carrier_frequency if case.model.campaign.doppler else 0.0
    per_millidegree = 2 * carrier / SPEED_OF_LIGHT * velocity * np.deg2rad(1e-3)
    return {
        "rms_hz": rms(residual),
        "rms_of_estimate_means_hz": rms(mean),
        "rms_along_range_hz": rms(residual - mean[:, None]),
        "drift_hz": float(np.sqrt(np.mean(np.square(drifts)))) if len(drifts) > 1 else drifts[0],
        "drift_millidegrees": float(np.sqrt(np.mean(np.square(drifts)))
                                    if len(drifts) > 1 else drifts[0]) / per_millidegree,
        "correlation_between_sub_swaths": float(np.median(common)) if common else None,
        "time_scale_s": _time_scale(correlation),
        "autocorrelation": [{"lag_s": a, "value": b} for a, b in correlation],
    }


def _time_scale(correlation: list[tuple[float, float]]) -> float:
    """First lag (s) at which the autocorrelation is below 1/e, interpolated."""
    for (a, high), (b, low) in pairwise(correlation):
        if low < np.exp(-1) <= high:
            return float(a + (b - a) * (high - np.exp(-1)) / (high - low))
    return float("nan")


def along_track_term(case: Case) -> dict[str, float] | None:
    """A pointing that varies along track: mean of the IW1 and IW2 residuals within one burst, taken off IW3.

    Only the share of it that IW1 and IW2 have in common is taken, as the covariance of their two series says.
    """
    used, held = case.split("third sub-swath")
    if not (used.any() and held.any()):
        return None
    residual = fitted(case, used, (SESSION,) if len(np.unique(case.session)) > 1 else ()).residual
    mean = residual.mean(axis=1)
    taken = np.zeros(len(mean))
    share = _common_share(case, mean, used)
    for row in np.flatnonzero(held):
        near = used & (np.abs(case.time - case.time[row]) <= BURST)
        taken[row] = mean[near].mean() if near.any() else 0.0
    after = residual - share * taken[:, None]
    return {"held_out_before_hz": rms(residual[held]), "held_out_after_hz": rms(after[held]), "share": share}


def _common_share(case: Case, mean: np.ndarray, rows: np.ndarray) -> float:
    """Part of the mean of two sub-swaths' series that is common to both: covariance over variance of the mean."""
    covariance = variance = 0.0
    for k in np.unique(case.session):
        swaths = [np.flatnonzero(rows & (case.session == k) & (case.swath == s)) for s in ("IW1", "IW2")]
        if min(map(len, swaths)) < 3:
            continue
        first, second = mean[swaths[0]], np.interp(case.time[swaths[0]], case.time[swaths[1]], mean[swaths[1]])
        covariance += float(np.mean(first * second))
        variance += float(np.mean((0.5 * (first + second)) ** 2))
    return max(0.0, min(1.0, covariance / variance)) if variance > 0 else 0.0


def range_terms(cases: Sequence[Case]) -> dict[str, dict[str, float]]:
    """A pattern along range: mean residual of each value of each sub-swath over the other scenes, taken off a scene.

    The mounting of every scene is its own, fitted on all of its rows.
    """
    residuals = [fitted(c, np.ones(len(c.time), dtype=bool), ()).residual for c in cases]
    full = [i for i, c in enumerate(cases) if len(np.unique(c.swath)) == 3]
    result = {}
    for i in full:
        after = residuals[i].copy()
        for swath in np.unique(cases[i].swath):
            others = [residuals[j][cases[j].swath == swath].mean(axis=0) for j in full if j != i]
            if others:
                after[cases[i].swath == swath] -= np.mean(others, axis=0)
        result[cases[i].name] = {"before_hz": rms(residuals[i]), "after_hz": rms(after)}
    return result


# ---------------------------------------------------------------------------------------------------------------- #
# the page

PAGE_TEXT = """\
# Sentinel-1: what is between the measured Doppler and the geometry?

Generated by `python -m benchmarks.sentinel1_explain`; contains modified Copernicus Sentinel data. Import, model and
squints are those of [the page on Sentinel-1](sentinel1.md).

Every model is fitted on one part of the Doppler estimates and held against another that it never saw. An addition to
the model is proposed by the fitted part alone: the fall of chi-square, scaled by the misfit before it and by
{together:g} because the three values of an estimate err together, must have a probability below {chance:g} by chance.
It is accepted if the held-out part falls as well. Numbers are root mean squares in Hz of measured minus modelled;
10 Hz are 2.1 millidegrees of squint. *Floor* is the white part of the scatter of single values, from differences of
successive estimates of a sub-swath; *annotated* is the RMS of the radar data about each estimate, as the product says.

## In one paragraph

{verdict}

## Each scene

### Fitted on the first half along track, proven on the second

{second_half}

### Fitted on IW1 and IW2, proven on IW3

{third}

*Largest single effect* is the named effect that, added to the mounting, lowers or raises the held-out part most
favourably; the number is given whether it was proposed or not, so that nobody needs to wonder whether the rule hides
one. The additions under *accepted* passed both tests.

## All scenes of Sentinel-1A together

{together_table}

{steps}

## What `boresight explain` says

The workflow as it is for any campaign, with its own test, search and proof (it holds out the last fifth of each arc, in
whitened units, and takes errors of successive estimates for independent):

{workflow}

A name that holds for one scene alone, and neither for its neighbours nor for all together, stands for the drift along
that scene and not for physics.

## What remains

{structure}

*Time scale*: lag at which the autocorrelation of the estimates' means along track falls below 1/e. *Sub-swaths*: median
correlation of the series of two sub-swaths. *Drift*: second half minus first half. *Along range*: part that varies
inside an estimate.

Two empirical terms, each held against data that it never saw: the course of IW1 and IW2 along track, taken off IW3; and
the mean pattern along range of all other scenes of the satellite, taken off a scene.

{empirical}
"""


def _cells(*cells: object) -> str:
    return "| " + " | ".join(str(c) for c in cells) + " |"


def _scene_table(scenes: dict[str, Any], split: str) -> str:
    lines = [_cells("scene", "geometry", "mounting", "largest single effect", "held-out with it", "accepted", "final",
                    "floor", "annotated"), "|---|---|---|---|---|---|---|---|---|"]
    for name, scene in scenes.items():
        found = scene["splits"][split]
        if found is None:
            continue
        best = min(found["single_effects"], key=lambda n: found["single_effects"][n]["held_out_hz"])
        accepted = (["mounting"] if found["mounting_accepted"] else []) + found["accepted"]
        final = found["final"] if found["mounting_accepted"] or found["accepted"] else found["geometry"]
        lines.append(_cells(name, f"{found['geometry']['held_out_hz']:.1f}", f"{found['mounting']['held_out_hz']:.1f}",
                            best, f"{found['single_effects'][best]['held_out_hz']:.1f}", ", ".join(accepted) or "none",
                            f"{final['held_out_hz']:.1f}", f"{found['floor_hz']:.1f}",
                            f"{found['annotated_rms_hz']:.1f}"))
    return "\n".join(lines)


def _together_table(together: dict[str, Any]) -> str:
    splits = [s for s in SPLITS if together["splits"][s]]
    lines = [_cells("model", *(f"{s}: fitted, held out" for s in splits), "proposed by the fitted part"),
             "|---|" + "---|" * (len(splits) + 1)]
    parts = {s: together["splits"][s] for s in splits}

    def row(label: str, pick: Any, proposed: str) -> str:
        return _cells(label, *(f"{pick(p)['fitted_hz']:.2f}, {pick(p)['held_out_hz']:.2f}" for p in parts.values()),
                      proposed)

    lines += [row("geometry", lambda p: p["geometry"], ""), row("mounting", lambda p: p["mounting"], "")]
    for name in LIBRARY:
        said = ", ".join(s for s in splits if parts[s]["single_effects"][name]["proposed"]) or "no"
        if not any(parts[s]["single_effects"][name]["added_parameters"] for s in splits):
            said = "no: not determined to its usual size beside the mounting"
        lines.append(row(f"mounting, {name}", lambda p, n=name: p["single_effects"][n], said))
    lines.append(row("all that is accepted", lambda p: p["final"], ""))
    lines.append(_cells("floor", *(f"{p['floor_hz']:.2f}" for p in parts.values()), ""))
    lines.append(_cells("annotated", *(f"{p['annotated_rms_hz']:.2f}" for p in parts.values()), ""))
    return "\n".join(lines)


def _steps(together: dict[str, Any]) -> str:
    lines = []
    for split in SPLITS:
        found = together["splits"][split]
        if not found:
            continue
        words = [f"{s['name']} {'accepted' if s['accepted'] else 'rejected'} ({s['held_out_before_hz']:.2f} to "
                 f"{s['held_out_after_hz']:.2f} Hz)" for s in found["steps"]]
        lines.append(f"- {split}: " + ("; ".join(words) or "nothing proposed"))
    return "Proposals in their order, with the held-out part before and after:\n\n" + "\n".join(lines)


def _workflow_table(result: dict[str, Any]) -> str:
    lines = [_cells("scene", "verdict", "why"), "|---|---|---|"]
    for name, found in result["workflow"].items():
        lines.append(_cells(name, found["verdict"], found["why"].replace("|", "/")))
    return "\n".join(lines)


def _structure_table(scenes: dict[str, Any]) -> str:
    lines = [_cells("scene", "RMS left", "along track", "along range", "drift", "time scale, s", "sub-swaths"),
             "|---|---|---|---|---|---|---|"]
    for name, scene in scenes.items():
        s = scene["structure"]
        correlation = s["correlation_between_sub_swaths"]
        lines.append(_cells(name, f"{s['rms_hz']:.1f}", f"{s['rms_of_estimate_means_hz']:.1f}",
                            f"{s['rms_along_range_hz']:.1f}", f"{s['drift_hz']:+.1f}", f"{s['time_scale_s']:.1f}",
                            "" if correlation is None else f"{correlation:+.2f}"))
    return "\n".join(lines)


def _empirical_table(scenes: dict[str, Any]) -> str:
    lines = [_cells("scene", "IW3 before", "with the course of IW1 and IW2", "scene before",
                    "with the pattern of other scenes"), "|---|---|---|---|---|"]
    for name, scene in scenes.items():
        track, along = scene["along_track_term"], scene["range_term"]
        if track is None:
            continue
        cells = [f"{track['held_out_before_hz']:.1f}", f"{track['held_out_after_hz']:.1f}"]
        cells += [f"{along['before_hz']:.1f}", f"{along['after_hz']:.1f}"] if along else ["", ""]
        lines.append(_cells(name, *cells))
    return "\n".join(lines)


def _ratio(scenes: dict[str, Any], split: str) -> float:
    """Pooled held-out RMS of geometry over that of the constant mounting."""
    pairs = [(s["splits"][split]["geometry"]["held_out_hz"], s["splits"][split]["mounting"]["held_out_hz"],
              s["splits"][split]["held_out_rows"]) for s in scenes.values() if s["splits"][split]]
    weights = np.array([p[2] for p in pairs], dtype=float)
    return float(np.sqrt(np.sum(weights * np.array([p[0] for p in pairs]) ** 2)
                         / np.sum(weights * np.array([p[1] for p in pairs]) ** 2)))


def verdict(result: dict[str, Any]) -> str:
    """The paragraph, from the numbers."""
    scenes, together = result["scenes"], result["together"]
    half, third = together["splits"]["second half"], together["splits"]["third sub-swath"]
    counted = [s["splits"]["second half"] for s in scenes.values()]
    better = sum(1 for c in counted if c["mounting_accepted"])
    added = sum(1 for c in counted if c["accepted"])
    tracks = [s["along_track_term"] for s in scenes.values() if s["along_track_term"]]
    lower = sum(1 for t in tracks if t["held_out_after_hz"] < t["held_out_before_hz"])
    patterns = [s["range_term"] for s in scenes.values() if s["range_term"]]
    fewer = sum(1 for p in patterns if p["after_hz"] < p["before_hz"])
    before = np.sqrt(np.mean([t["held_out_before_hz"] ** 2 for t in tracks]))
    after = np.sqrt(np.mean([t["held_out_after_hz"] ** 2 for t in tracks]))
    scales = [s["structure"]["time_scale_s"] for s in scenes.values()]

    alike = [c for s in scenes.values() if (c := s["structure"]["correlation_between_sub_swaths"]) is not None]
    agree = sum(1 for c in alike if c > 0.5)

    phase = ("antenna-thermal-deformation", "tracker-low-frequency-error")
    periodic = ("(a function of the orbit's phase is proposed as well)"
                if any(p["single_effects"][n]["proposed"] for p in together["splits"].values() for n in phase)
                else "(no function of the orbit's phase is proposed in its place)")

    def said(part: dict[str, Any]) -> str:
        return ", ".join(["mounting"] * part["mounting_accepted"] + part["accepted"]) or "nothing"

    pooled = {split: _ratio(scenes, split) for split in ("second half", "third sub-swath")}
    texts = [
        f"A constant mounting fitted on the first half of a scene lowers the second half {pooled['second half']:.2f}",
        f"times (it is lower in {better} of {len(counted)} scenes), and one fitted on IW1 and IW2 lowers IW3",
        f"{pooled['third sub-swath']:.2f} times. Inside single scenes a further named effect is accepted in {added}",
        f"of {len(counted)}. Over all scenes of Sentinel-1A together the accepted model is, for the second half,",
        f"{said(half)} ({half['geometry']['held_out_hz']:.1f} Hz with geometry alone,",
        f"{half['mounting']['held_out_hz']:.1f} with one mounting, {half['final']['held_out_hz']:.1f} at the end,",
        f"floor {half['floor_hz']:.1f}), and for IW3 {said(third)} ({third['geometry']['held_out_hz']:.1f},",
        f"{third['mounting']['held_out_hz']:.1f}, {third['final']['held_out_hz']:.1f}, floor {third['floor_hz']:.1f}):",
        "the pointing differs from one acquisition to the next, which in one scene is the same as a mounting",
        f"{periodic}. What is left above the floor has no name in the library:",
        "`unknown`, in the Doppler channel, in most acquisitions. Its shape: it varies along track with a time scale",
        f"of {np.nanmin(scales):.0f} to {np.nanmax(scales):.0f} s (median {np.nanmedian(scales):.0f} s). Where the",
        f"sub-swaths see the same course (correlation above 0.5, {agree} of {len(alike)} scenes) it is common to all",
        "ranges, as a motion of the beam or an error of the annotated attitude would be; elsewhere it differs from",
        "sub-swath to sub-swath, as what depends on the imaged ground would. The common course of IW1 and IW2",
        f"taken off IW3 lowers it in {lower} of {len(tracks)} scenes ({before:.1f} to {after:.1f} Hz over all); the",
        f"mean pattern of other scenes along range lowers a scene in {fewer} of {len(patterns)}"
        + (": there is no fixed pattern along range beyond the turn of the mounting." if 2 * fewer <= len(patterns)
           else "."),
    ]
    return "\n".join(textwrap.wrap(" ".join(texts), 118))


def page(result: dict[str, Any]) -> str:
    """The documentation page."""
    scenes = result["scenes"]
    return PAGE_TEXT.format(
        chance=CHANCE, together=TOGETHER, verdict=verdict(result), second_half=_scene_table(scenes, "second half"),
        third=_scene_table(scenes, "third sub-swath"), together_table=_together_table(result["together"]),
        steps=_steps(result["together"]), workflow=_workflow_table(result),
        structure=_structure_table(scenes), empirical=_empirical_table(scenes))


def measured(annotations: list[Annotation]) -> dict[str, Any]:
    """Everything that the page says."""
    began = clock.perf_counter()
    cases = []
    for group in acquisitions(annotations):
        case = Case("", group)
        cases.append(replace(case, name=case.model.campaign.arcs[0].name))
    scenes: dict[str, Any] = {}
    patterns: dict[str, dict[str, float]] = {}
    for mission in sorted({a.mission for a in annotations}):
        patterns |= range_terms([c for c in cases if c.annotations[0].mission == mission])
    for case in cases:
        print(f"{case.name} ({clock.perf_counter() - began:.0f} s)", file=sys.stderr)
        pattern = patterns.get(case.name)
        scenes[case.name] = {"splits": {s: explained(case, s) for s in SPLITS}, "structure": structure(case),
                             "along_track_term": along_track_term(case),
                             "range_term": pattern if pattern and pattern["before_hz"] != pattern["after_hz"] else None}
    largest = max({a.mission for a in annotations}, key=lambda m: sum(a.mission == m for a in annotations))
    together = Case(f"all scenes of {largest}", [a for a in annotations if a.mission == largest])
    print(f"{together.name} ({clock.perf_counter() - began:.0f} s)", file=sys.stderr)
    workflow = {}
    for case in (*cases, together):
        findings = explain_campaign(campaign_with_swaths(case.annotations)[0])
        workflow[case.name] = {"verdict": findings.verdict, "why": findings.why}
    return {"scenes": scenes, "workflow": workflow,
            "together": {"name": together.name, "splits": {s: explained(together, s) for s in SPLITS},
                         "structure": structure(together), "along_track_term": along_track_term(together)},
            "seconds": clock.perf_counter() - began}


def main(arguments: list[str] | None = None) -> int:
    """Run over a folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=DATA)
    folder = parser.parse_args(arguments).folder
    files = sorted(folder.glob("*.xml"))
    if not files:
        print(f"no annotations in {folder}: nothing is measured", file=sys.stderr)
        return 2
    result = measured([read_annotation(path) for path in files])
    with written_atomically(RESULTS) as path:
        path.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    text = page(result)
    with written_atomically(PAGE) as path:
        path.write_text(text, encoding="utf-8")
    print(text)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
