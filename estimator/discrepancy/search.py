"""The workflow: where is the gap, which effect is it, add it, prove it, until nothing is left to explain.

Forward: score the whole library at the accepted fit, refit the few best jointly, and accept the one with the highest
evidence if it is significant after the search and pays on held-out data. Backward: after each addition, effects that
the others have made unnecessary leave, and each is compared with what could stand in its place, so that an early
wrong choice does not lock the right one out. At the end, names that explain the data equally well form one group.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy.stats import chi2

from estimator.discrepancy.false_alarm import after_search, effective_looks
from estimator.discrepancy.gap import Gap, find_gap
from estimator.discrepancy.proof import HeldOut, channels_of, misfit, pays, shifts
from estimator.discrepancy.score import Score, Signature, Stack, on_rows, scored, settings, signature, stack
from estimator.discrepancy.subject import Subject
from estimator.effects.declaration import EffectInstance
from estimator.estimate import Estimate
from estimator.problem import Problem
from estimator.residuals import Linearization
from estimator.solvers.gauss_newton import Options, solve
from estimator.solvers.summary import summarized

SIGNIFICANT = 0.005  # probability of a name where there is nothing, after the search
SHORTLIST = 6  # candidates that are refitted jointly
MOST_EFFECTS = 6
INDISTINGUISHABLE = 4.6  # log odds (100 to 1) below which two names explain the data equally well

Say = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Refit:
    """A joint fit of the training data with given effects.

    Attributes:
        effects: their names.
        estimate: the fit.
        cost: sum of the losses.
        evidence: log odds against the plain model, with the declared sizes as priors.
    """

    effects: tuple[str, ...]
    estimate: Estimate
    cost: float
    evidence: float


@dataclass(frozen=True, eq=False)
class Finding:
    """One effect that was added.

    Attributes:
        name: of the effect.
        group: names that explain the data equally well, its own first.
        score: drop of the sum of squares of the training data.
        degrees: number of its parameters that the data see.
        p_value_after_search: probability of such a score without any effect, after the search.
        gap_before, gap_after: per channel, misfit of the training data.
        held_out_before, held_out_after: per channel, misfit of the held-out data.
        expected: size and sigma that the score predicted before the refit.
        moved: shift of the other unknowns, in sigmas.
    """

    name: str
    group: tuple[str, ...]
    score: float
    degrees: int
    p_value_after_search: float
    gap_before: Mapping[str, HeldOut]
    gap_after: Mapping[str, HeldOut]
    held_out_before: Mapping[str, HeldOut]
    held_out_after: Mapping[str, HeldOut]
    expected: Score
    moved: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Findings:
    """What the workflow found.

    Attributes:
        verdict: "quiet", "named", "ambiguous" or "unknown".
        why: its sentence.
        before: the gap of the plain model.
        after: the gap that is left.
        findings: effects in the order in which they were added.
        tables: the score table of each round.
        plain, final: joint estimates of all data without and with the effects.
        rejected: names that were significant and did not pay on held-out data.
        looks: independent looks that one search of the library amounts to.
        seconds: wall time.
    """

    verdict: str
    why: str
    before: Gap
    after: Gap
    findings: tuple[Finding, ...]
    tables: tuple[tuple[Score, ...], ...]
    plain: Estimate
    final: Estimate
    rejected: tuple[str, ...]
    looks: float
    seconds: float
    correlation: Mapping[tuple[str, str], float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class _Round:
    """The library scored at one accepted fit."""

    fit: Refit
    problem: Problem
    parts: Sequence[Linearization]
    stacked: Stack
    table: tuple[Score, ...]
    looks: float
    gap: Gap


class Workflow:
    """One investigation of a subject; :func:`explain` runs it from start to end."""

    def __init__(self, subject: Subject, say: Say | None = None):
        self.subject = subject
        self.say = say or (lambda text: None)
        self.library = {e.name: e for e in subject.library}
        self._fits: dict[tuple[str, ...], Refit] = {}
        self._rounds: dict[tuple[str, ...], _Round] = {}
        self._searched: list[Signature] | None = None
        self._looks: float | None = None

    # ------------------------------------------------------------------------------------------------ fits

    def fit(self, effects: Sequence[str], start: Mapping[str, np.ndarray] | None = None) -> Refit:
        """The joint fit of the training data with these effects (kept once made).

        Args:
            effects: names.
            start: values of a neighbouring fit; then only the part of the problem that the newcomers touch is solved,
                the rest being at its optimum already.
        """
        key = tuple(sorted(effects))
        if key in self._fits:
            return self._fits[key]
        problem = self.subject.problem(key, (), hold_out=True)
        if start:
            names = {u.name for u in problem.unknowns}
            known = {n: v for n, v in start.items() if n in names and np.shape(v) == np.shape(problem.start[n])}
            changed = [u.name for u in problem.unknowns if u.name in key and u.name not in known]
            problem = problem.starting_at(known)
            values = _polished(problem, set(changed or key))
            prepared = problem.prepared(values)
            estimate = summarized(prepared, values, prepared.linearize(values), converged=True, reason="",
                                  iterations=0, solver="gauss-newton", seconds=0.0)
        else:
            estimate = solve(problem, Options(tolerance=1e-3, iterations=60))
        cost = float(sum(p.cost for p in estimate.parts))
        plain = self._fits.get(())
        evidence = 0.0 if plain is None else 0.5 * (plain.cost - cost) + self._occam(estimate, key)
        fit = Refit(key, estimate, cost, evidence)
        self._fits[key] = fit
        return fit

    def _occam(self, estimate: Estimate, effects: Sequence[str]) -> float:
        """Log of posterior over prior volume of the effects' parameters, and of the prior's density at their values."""
        total = 0.0
        for name in effects:
            effect = self.library[name]
            if all(u.name != name for u in estimate.unknowns):
                continue
            ordinary = [i for i, p in enumerate(effect.parameters) if p.search is None]
            width, centre = prior_of(effect)
            scaled = (estimate.covariance_of(name) / np.outer(width, width))[np.ix_(ordinary, ordinary)]
            values = ((np.asarray(estimate.values[name]) - centre) / width)[ordinary]
            # Directions that the data leave open have no posterior narrower than the prior and cost nothing.
            eigenvalues, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T))
            seen = eigenvalues > 1e-20
            total += 0.5 * float(np.sum(np.log(eigenvalues[seen] / (1 + eigenvalues[seen]))))
            along = vectors[:, seen].T @ values
            total -= 0.5 * float(np.sum(along**2 / (1 + eigenvalues[seen])))
            total -= float(np.log(len(settings(effect))))  # the best of so many settings was taken
        return total

    # ------------------------------------------------------------------------------------------------ scores

    def round(self, effects: Sequence[str]) -> _Round:
        """Score every other effect of the library at the fit with ``effects``."""
        key = tuple(sorted(effects))
        if key in self._rounds:
            return self._rounds[key]
        fit = self.fit(key)
        linear = [n for n, e in self.library.items() if not any(p.search for p in e.parameters)]
        problem = self.subject.problem(key, [n for n in linear if n not in key], hold_out=True)
        point = {**problem.start, **{n: v for n, v in fit.estimate.values.items() if n in problem.start}}
        problem = problem.prepared(point)
        parts = problem.linearize(point)
        stacked = stack(problem, parts)
        present = {u.name for u in problem.unknowns}
        signatures = [signature(stacked, problem, parts, self.library[n], np.zeros(len(self.library[n].parameters)))
                      for n in linear if n not in key and n in present]
        signatures += [on_rows(s, stacked) for s in self.searched_signatures() if s.effect.name not in key]
        widths = np.cumsum([0, *(s.columns.shape[1] for s in signatures)])
        together = stacked.projected(np.concatenate([s.columns for s in signatures], axis=1))
        projected = [together[:, a:b] for a, b in pairwise(widths)]
        scores = [scored(stacked, s, p) for s, p in zip(signatures, projected, strict=True)]
        if self._looks is None:
            self.say("rate of false alarms")
            self._looks = effective_looks(projected, [s.degrees for s in scores])
        best: dict[str, Score] = {}
        for s in scores:
            if s.name not in best or s.score > best[s.name].score:
                best[s.name] = s
        table = tuple(sorted(best.values(), key=lambda s: -s.evidence))
        result = _Round(fit, problem, parts, stacked, table, self._looks, find_gap(problem, stacked, parts))
        self._rounds[key] = result
        return result

    def searched_signatures(self) -> list[Signature]:
        """Signatures of the effects with searched parameters, one per setting, taken once at the plain fit.

        They depend on how the spacecraft turned, which the plain fit follows closely enough; refits are exact.
        """
        if self._searched is not None:
            return self._searched
        values = self.fit(()).estimate.values
        found: list[Signature] = []
        for name, effect in self.library.items():
            if not any(p.search for p in effect.parameters):
                continue
            self.say(f"signatures of {name}")
            problem = self.subject.problem((), (name,), hold_out=True)
            if all(u.name != name for u in problem.unknowns):
                continue
            point = {**problem.start, **{n: v for n, v in values.items() if n in problem.start}}
            problem = problem.prepared(point)
            touched = problem.with_residuals([r for r in problem.residuals if any(u.name == name for u in r.unknowns)])
            grid = settings(effect)
            stacked = stack(touched.holding(*(u.name for u in touched.unknowns)), touched.linearize(point))
            found += [signature(stacked, touched, touched.linearize({**point, name: g}, (name,)), effect, g)
                      for g in grid]
        self._searched = found
        return found

    def gap(self, effects: Sequence[str]) -> Gap:
        """Where the model with these effects and the data disagree."""
        return self.round(effects).gap

    def start_of(self, score: Score, fit: Refit) -> dict[str, np.ndarray]:
        """Start values of a refit: the accepted fit, and for a searched effect the best setting that was tried."""
        start = dict(fit.estimate.values)
        if any(p.search for p in self.library[score.name].parameters):
            start[score.name] = score.setting
        return start

    # ------------------------------------------------------------------------------------------------ search

    def best_addition(self, effects: tuple[str, ...], excluded: set[str]) -> tuple[Score, Refit, float] | None:
        """The significant candidate with the highest evidence after a joint refit, or None."""
        here = self.round(effects)
        open_ = [s for s in here.table if s.degrees > 0 and s.name not in excluded]
        significant = [s for s in open_ if after_search(s.p_value, here.looks) < SIGNIFICANT]
        if not significant:
            return None
        fitted = []
        best_gain = -np.inf
        for s in significant[:SHORTLIST]:
            if s.evidence < best_gain - 10 * INDISTINGUISHABLE:
                break  # its linear drop cannot catch up with a joint fit that is made
            self.say(f"refit with {s.name}")
            refit = self.fit((*effects, s.name), self.start_of(s, here.fit))
            sound = self.plausible(s.name, refit)
            fitted.append((refit.evidence if sound else refit.evidence - 1e9, s, refit))
            if sound:
                best_gain = max(best_gain, refit.evidence - here.fit.evidence)
        fitted.sort(key=lambda item: -item[0])
        for _, s, refit in fitted:
            drop = here.fit.cost - refit.cost
            p = after_search(float(chi2.sf(max(drop, 0.0), max(s.degrees, 1))), here.looks)
            if p < SIGNIFICANT and self.plausible(s.name, refit):
                return s, refit, p
        return None

    def plausible(self, name: str, refit: Refit) -> bool:
        """Whether the fitted size agrees with what the physics demands and an engineer would believe."""
        effect = self.library[name]
        if all(u.name != name for u in refit.estimate.unknowns):
            return False
        values = np.asarray(refit.estimate.values[name])
        sigma = refit.estimate.sigma_of(name)
        chi = max(1.0, float(np.sqrt(refit.estimate.chi_square_per_degree())))
        for p, v, s in zip(effect.parameters, values, sigma, strict=True):
            margin = 4 * (s if np.isfinite(s) else 0.0) * chi
            if p.nominal is not None and abs(v - p.nominal) > margin + 0.02 * abs(p.nominal):
                return False
            if v < p.plausible[0] - margin or v > p.plausible[1] + margin:
                return False
        return True

    def needed(self, effects: tuple[str, ...]) -> tuple[str, ...]:
        """The effects without those that the others have made unnecessary."""
        current = effects
        while len(current) > 1:
            full = self.fit(current)
            losses = []
            for name in current:
                rest = tuple(n for n in current if n != name)
                without = self.fit(rest, full.estimate.values)
                looks = self.round(rest).looks if rest in self._rounds else 30.0
                degrees = len([p for p in self.library[name].parameters if p.search is None])
                losses.append((after_search(float(chi2.sf(max(without.cost - full.cost, 0.0), degrees)), looks), name))
            worst, name = max(losses)
            if worst < SIGNIFICANT:
                break
            self.say(f"{name} is no longer needed")
            current = tuple(n for n in current if n != name)
        return current

    def swapped(self, effects: tuple[str, ...], excluded: set[str]) -> tuple[str, ...]:
        """The effects with one of them exchanged, where that explains the data better."""
        best = self.fit(effects)
        for name in effects:
            rest = tuple(n for n in effects if n != name)
            here = self.round(rest)
            mine = next((s for s in here.table if s.name == name), None)
            for s in [t for t in here.table if t.name not in (*rest, *excluded, name) and t.degrees > 0][:3]:
                if after_search(s.p_value, here.looks) >= SIGNIFICANT or (mine and _hopeless(s, mine)):
                    continue
                self.say(f"{s.name} in place of {name}?")
                other = self.fit((*rest, s.name), self.start_of(s, here.fit))
                if other.evidence > best.evidence + INDISTINGUISHABLE and self.plausible(s.name, other):
                    self.say(f"{s.name} in place of {name}")
                    best = other
        return best.effects

    def group(self, effects: tuple[str, ...], name: str) -> tuple[str, ...]:
        """Names that explain the data as well as ``name`` beside the other effects."""
        rest = tuple(n for n in effects if n != name)
        here = self.round(rest)
        reference = self.fit(effects).evidence
        alike = [name]
        mine = next((s for s in here.table if s.name == name), None)
        if mine is None:
            return (name,)
        for s in here.table:
            if s.name == name or s.degrees == 0 or s.score < 0.5 * mine.score - 20:
                continue
            if _hopeless(s, mine):
                continue
            self.say(f"{s.name} beside {name}?")
            other = self.fit((*rest, s.name), self.start_of(s, here.fit))
            if other.evidence > reference - INDISTINGUISHABLE and self.plausible(s.name, other):
                alike.append(s.name)
        return tuple(alike)

    def run(self) -> Findings:
        """Search, add, step back, prove; see :class:`Findings`."""
        began = time.perf_counter()
        self.say("fit of the plain model")
        self.fit(())
        self.say("scores of the library")
        before = self.gap(())
        accepted: tuple[str, ...] = ()
        excluded: set[str] = set()
        order: list[str] = []
        p_values: dict[str, float] = {}
        tables = []
        while len(accepted) < MOST_EFFECTS:
            self.say(f"search with {len(accepted)} effects in the model")
            tables.append(self.round(accepted).table)
            found = self.best_addition(accepted, excluded)
            if found is None:
                break
            score, refit, p = found
            if not self._pays(accepted, refit.effects, score.name):
                excluded.add(score.name)
                continue
            accepted = self.needed((*accepted, score.name))
            order.append(score.name)
            p_values[score.name] = p
            if len(accepted) > 1:
                exchanged = self.swapped(accepted, excluded)
                if set(exchanged) != set(accepted):
                    for newcomer in set(exchanged) - set(accepted):
                        order.append(newcomer)
                        p_values[newcomer] = p
                    accepted = self.needed(exchanged)
        ordered = tuple(n for n in dict.fromkeys(order) if n in accepted)
        findings = self._findings(ordered, p_values)
        after = self.gap(accepted)
        self.say("joint refit of all data")
        plain = solve(self.subject.problem((), (), hold_out=False))
        final = plain
        if accepted:
            problem = self.subject.problem(ordered, (), hold_out=False)
            last = self.fit(accepted).estimate.values
            names = {u.name for u in problem.unknowns}
            usable = {n: v for n, v in last.items() if n in names and n != "trajectory"}
            final = solve(problem.starting_at(usable))
        verdict, why = _verdict(findings, before, after)
        return Findings(verdict, why, before, after, findings, tuple(tables), plain, final, tuple(sorted(excluded)),
                        self.round(()).looks, time.perf_counter() - began)

    def _pays(self, before: Sequence[str], after: Sequence[str], name: str) -> bool:
        first, second = self.fit(before).estimate, self.fit(after).estimate
        return pays(first.problem, first.parts, second.problem, second.parts, channels_of(second.problem, name))

    def _findings(self, order: tuple[str, ...], p_values: Mapping[str, float]) -> tuple[Finding, ...]:
        findings = []
        for k, name in enumerate(order):
            first, second = self.fit(order[:k]), self.fit(order[: k + 1])
            rest = tuple(n for n in order if n != name)
            self.say(f"what explains the data as well as {name}")
            expected = next(s for s in self.round(order[:k]).table if s.name == name)
            one, two = first.estimate, second.estimate
            degrees = len([p for p in self.library[name].parameters if p.search is None])
            findings.append(Finding(
                name, self.group(order, name) if rest is not None else (name,), first.cost - second.cost, degrees,
                p_values.get(name, 0.0), misfit(one.problem, one.parts, held_out=False),
                misfit(two.problem, two.parts, held_out=False), misfit(one.problem, one.parts, held_out=True),
                misfit(two.problem, two.parts, held_out=True), expected, shifts(one, two)))
        return tuple(findings)


def _hopeless(candidate: Score, reference: Score) -> bool:
    """Whether a joint refit cannot be expected to lift ``candidate`` to ``reference``; big gaps get more benefit."""
    return candidate.evidence < reference.evidence - 3 * INDISTINGUISHABLE - 0.05 * reference.score


def _polished(problem: Problem, names: set[str]) -> dict[str, np.ndarray]:
    """Values with the named unknowns, and all that is connected to them through residuals, at their optimum."""
    free = {u.name for u in problem.free}
    reached = names & free
    growing = True
    while growing:
        touched = [r for r in problem.residuals if any(u.name in reached for u in r.unknowns)]
        grown = reached | {u.name for r in touched for u in r.unknowns if u.name in free}
        growing = grown != reached
        reached = grown
    part = problem.with_residuals(touched).holding(*(free - reached))
    estimate = solve(part, Options(tolerance=3e-2, iterations=12, largest_step=1e4))
    return dict(estimate.values)


def prior_of(effect: EffectInstance) -> tuple[np.ndarray, np.ndarray]:
    """Prior sigma and centre of each parameter, in its unit."""
    width, centre = [], []
    for p in effect.parameters:
        if p.search is not None:
            width.append(0.3 * (p.search[1] - p.search[0]))
            centre.append(0.5 * (p.search[0] + p.search[1]))
        elif p.nominal is not None:
            width.append(0.02 * abs(p.nominal))
            centre.append(p.nominal)
        else:
            width.append(3 * p.scale)
            centre.append(0.0)
    return np.array(width), np.array(centre)


def _verdict(findings: Sequence[Finding], before: Gap, after: Gap) -> tuple[str, str]:
    names = " and ".join(f.name if len(f.group) == 1 else "one of " + ", ".join(f.group) for f in findings)
    if after.present:
        left = "; ".join(p.sentence for p in after.places)
        if findings:
            return "unknown", f"{names} explains a part; the library holds no explanation of the rest: {left}"
        return "unknown", f"the library holds no explanation: {left}"
    if not findings:
        if after.white:
            noise = "; ".join(f"{name} by a factor {factor:.2f}" for name, factor in after.white)
            return "unknown", f"no structure, but white noise above the declared one in {noise}: declare it"
        return "quiet", "nothing is missing: the residuals are noise as declared"
    if any(len(f.group) > 1 for f in findings):
        return "ambiguous", f"the data cannot tell apart: {names}"
    return "named", f"missing was {names}"


def explain(subject: Subject, say: Say | None = None) -> Findings:
    """Find the gap, name the missing effects, add them and prove it; see the module."""
    return Workflow(subject, say).run()
