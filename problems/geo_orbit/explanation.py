"""The discrepancy workflow on an orbit: which effect separates the measurements from the model, with proof."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from estimator.discrepancy.gap import Gap
from estimator.discrepancy.proof import HeldOut
from estimator.discrepancy.search import Finding, Findings, Say, Workflow
from estimator.effects.declaration import EffectInstance
from estimator.estimate import Estimate
from estimator.problem import Problem
from estimator.residuals import KernelResidual
from problems.geo_orbit.effects import OrbitEffect, instances
from problems.geo_orbit.kept_orbit import KeptExplanation, explained_kept, period_of
from problems.geo_orbit.problem import OrbitModel, orbit_model, orbit_problem
from problems.geo_orbit.settings import OrbitSettings
from problems.geo_orbit.solution import solve_from_far
from problems.geo_orbit.tracking import Tracking

SIDEREAL_DAY = 86164.1  # s
_NEAR_STATIONARY = 0.02  # part by which the period of a satellite that is kept on station differs from a sidereal day
_BLOCKS = 25  # into which the samples of a residual are cut for holding some out


@dataclass(frozen=True, eq=False)
class OrbitSubject:
    """Tracking data under investigation.

    Attributes:
        model: the prepared data, started at the plain model's best orbit.
        hold_out: fraction of each station's data that is kept from the fits, in whole blocks.
        without: effects that are taken out of the library.
    """

    model: OrbitModel
    hold_out: float = 0.2
    without: tuple[str, ...] = ()

    @property
    def effects(self) -> tuple[OrbitEffect, ...]:
        """The library on these data."""
        return tuple(
            e for e in instances(self.model.layout) if e.name not in self.without and e.family not in self.without
        )

    @property
    def library(self) -> tuple[EffectInstance, ...]:
        """The same in the workflow's terms: name, parameters and reference are what it reads."""
        return self.effects  # type: ignore[return-value]

    def problem(self, effects: Sequence[str], candidates: Sequence[str], *, hold_out: bool) -> Problem:
        """See :class:`estimator.discrepancy.subject.Subject`."""
        problem = orbit_problem(self.model, effects, candidates=candidates)
        if not hold_out:
            return problem
        residuals = []
        for residual in problem.residuals:
            assert isinstance(residual, KernelResidual)
            residuals.append(replace(residual, accepted=~self._kept(residual.samples)))
        return problem.with_residuals(residuals)

    def _kept(self, samples: int) -> np.ndarray:
        """Mask (samples,) of what is held out: every so-many-th block."""
        block = max(1, samples // _BLOCKS)
        every = max(2, round(1 / self.hold_out))
        return (np.arange(samples) // block) % every == every // 2


@dataclass(frozen=True, eq=False)
class OrbitExplanation:
    """Findings on tracking data."""

    subject: OrbitSubject
    workflow: Workflow
    findings: Findings
    seconds: float

    def as_dict(self) -> dict[str, Any]:
        """The machine-readable answer of ``boresight orbit explain``."""
        f = self.findings
        return {
            "verdict": f.verdict,
            "why": f.why,
            "where": _places(f.before),
            "effects": [self._finding(e) for e in f.findings],
            "next_measurement": self._next(),
            "left": _places(f.after),
            "rejected": list(f.rejected),
            "seconds": self.seconds,
        }

    def _finding(self, finding: Finding) -> dict[str, Any]:
        final = f_estimate = self.findings.final
        effect = self.workflow.library[finding.name]
        channels = [r.channel for r in final.problem.residuals if any(u.name == finding.name for u in r.unknowns)]
        channels = list(dict.fromkeys(channels))
        return {
            "name": finding.name,
            "group": list(finding.group),
            "parameters": _parameters(f_estimate, effect),
            "score": finding.score,
            "p_value_after_search": finding.p_value_after_search,
            "gap_before": _ratio(finding.gap_before, channels),
            "gap_after": _ratio(finding.gap_after, channels),
            "held_out_before": _ratio(finding.held_out_before, channels),
            "held_out_after": _ratio(finding.held_out_after, channels),
            "held_out": {
                c: {
                    "before": finding.held_out_before[c].rms,
                    "after": finding.held_out_after[c].rms,
                    "unit": finding.held_out_after[c].unit,
                }
                for c in channels
                if c in finding.held_out_before and c in finding.held_out_after
            },
            "reference": effect.reference,
        }

    def _next(self) -> str:
        unsure = [f for f in self.findings.findings if len(f.group) > 1]
        if unsure:
            return (
                "angles or ranges from a station on another continent, over at least one more revolution, to separate "
                + " from ".join(unsure[0].group)
            )
        if self.findings.verdict == "unknown":
            return "more stations and a longer span around the times of the gap"
        return ""

    def __str__(self) -> str:
        f = self.findings
        lines = [f"{f.verdict}: {f.why}", ""]
        lines += [f"where: {p['sentence']}" for p in _places(f.before)]
        for e in f.findings:
            d = self._finding(e)
            lines += [
                "",
                f"{d['name']}"
                + (f" (or {', '.join(g for g in d['group'] if g != d['name'])})" if len(d["group"]) > 1 else ""),
            ]
            lines += [
                f"  {n} = {p['value']:.6g} +- {p['sigma'] if p['sigma'] is not None else float('nan'):.2g} {p['unit']}"
                for n, p in d["parameters"].items()
            ]
            if d["held_out_before"] is not None:
                lines.append(f"  held-out misfit over noise {d['held_out_before']:.4g} -> {d['held_out_after']:.4g}")
        return "\n".join(lines)


def _ratio(misfits: Any, channels: Sequence[str]) -> float | None:
    chosen: list[HeldOut] = [misfits[c] for c in channels if c in misfits and misfits[c].count]
    if not chosen:
        return None
    return float(np.sqrt(sum(h.square for h in chosen) / sum(h.count for h in chosen)))


def _parameters(estimate: Estimate, effect: EffectInstance) -> dict[str, Any]:
    if all(u.name != effect.name for u in estimate.unknowns):
        return {}
    values, sigma = estimate.values[effect.name], estimate.sigma_of(effect.name)
    return {
        p.name: {"value": float(v), "sigma": float(s) if np.isfinite(s) else None, "unit": p.unit}
        for p, v, s in zip(effect.parameters, values, sigma, strict=True)
    }


def _places(gap: Gap) -> list[dict[str, Any]]:
    return [
        {
            "channel": p.channel,
            "arcs": list(p.arcs),
            "time_scale_s": p.time_scale,
            "unit": p.unit,
            "excess": p.excess,
            "components": list(p.components),
            "p_value": p.p_value,
            "sentence": p.sentence,
        }
        for p in gap.places
    ]


def explained(
    tracking: Tracking,
    settings: OrbitSettings,
    *,
    hold_out: float = 0.2,
    without: Sequence[str] = (),
    say: Say | None = None,
) -> OrbitExplanation | KeptExplanation:
    """Find what the model of the settings misses in tracking data.

    A satellite near the stationary orbit is kept there: where the data are long enough to hold manoeuvres, these are
    looked for first (:mod:`problems.geo_orbit.kept_orbit`), and with none in the data the generic workflow does the
    rest. On any other orbit it is the other way round.

    Args:
        tracking: the observations.
        settings: checked settings; what they have in the model is the plain model.
        hold_out: fraction kept for the proof.
        without: effects that are taken out of the library.
        say: called with what is being done.

    Raises:
        InputError: data that cannot be used.
    """
    began = time.perf_counter()
    model = orbit_model(tracking, settings)
    state = np.concatenate([model.position, model.velocity])
    kept_on_station = abs(period_of(state) / SIDEREAL_DAY - 1) < _NEAR_STATIONARY
    if kept_on_station:
        kept = explained_kept(model, hold_out=hold_out, without=without, say=say)
        if kept is not None:
            return kept
    plain = solve_from_far(orbit_problem(model), model)
    model = replace(model, position=plain.values["position"], velocity=plain.values["velocity"])
    subject = OrbitSubject(model, hold_out, tuple(without))
    workflow = Workflow(subject, say)
    findings = workflow.run()
    if findings.verdict == "unknown" and not kept_on_station:
        kept = explained_kept(model, hold_out=hold_out, without=without, say=say)
        if kept is not None:
            return kept
    return OrbitExplanation(subject, workflow, findings, time.perf_counter() - began)
