"""The workflow: where is the gap, which effects are it, add them, prove them, until nothing is left to explain.

At the accepted fit the whole library is one linear model of the residuals
(:mod:`estimator.discrepancy.combinations`). The set of effects worth most in it is refitted jointly; at that fit the
library is linearized again and the search goes on from there and from nothing, until no set is worth more than the
accepted one. Effects may leave and be exchanged at every turn, so an early wrong choice locks nothing out. What stays
must be significant after the search and pay on held-out data. At the end, names that explain the data equally well, by
joint fits of their own, form one group.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from estimator.chance import chi2_tail
from estimator.discrepancy.combinations import Candidate, LinearLibrary, price, visible_directions
from estimator.discrepancy.false_alarm import Looks, counted_looks
from estimator.discrepancy.gap import Gap, find_gap
from estimator.discrepancy.proof import HeldOut, channels_of, misfit, nothing_to_explain, proved, shifts
from estimator.discrepancy.score import (
    Score,
    Signature,
    Stack,
    on_rows,
    products,
    score_of,
    settings,
    signature,
    stack,
)
from estimator.discrepancy.subject import Subject
from estimator.estimate import Estimate
from estimator.problem import Problem
from estimator.residuals import Linearization, Residual
from estimator.solvers.gauss_newton import Options, solve
from estimator.solvers.summary import summarized

SIGNIFICANT = 0.008  # probability of a name where there is nothing, after the search
BEYOND_DOUBT = 1e-5  # the same where the residuals stay below a noise that was declared too large
MOST_EFFECTS = 6
INDISTINGUISHABLE = 4.6  # log odds (100 to 1) below which two names explain the data equally well
TRIED_SETTINGS = 6  # settings of a searched parameter that take part in sets
REFINEMENTS = 12  # halvings of the step between settings of a searched parameter, at most
WORTH_HALVING = 0.05  # rise of the score by two halvings below which there are no more
WORTH_REFINING = 0.5  # probability after the search below which settings between those of the grid are tried
RIVALS = 5  # names that are refitted in the place of an accepted one
TURNS = 16  # sets that are refitted before the search stops
ALIKE = 0.5  # part of an effect's squared signature that a name must copy for others to change with it
REFUSALS = 4  # sets in a row that a joint fit did not bear out before the search stops
ANSWERS = (-1, -2, -3.5, -5)  # steps between settings by which a mode may be seen above its own frequency
SHORT_OF = 0.85  # part of the drop that the linear model promises below which a mode is started elsewhere too
LINEAR = 0.03  # part of a drop that the linear model may be wrong by

Say = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Refit:
    """A joint fit of the training data with given effects.

    Attributes:
        effects: their names.
        estimate: the fit.
        cost: sum of the losses, each residual's over the square of the factor by which its noise exceeds the declared.
    """

    effects: tuple[str, ...]
    estimate: Estimate
    cost: float


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
        looks: independent names that one search of the library amounts to, each at the best of its settings.
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


@dataclass(frozen=True, eq=False)
class _Round:
    """The library around one accepted fit.

    Attributes:
        fit: the accepted fit.
        problem, parts, stacked: its problem with all candidates at zero, linearized; the fit's rows and columns.
        table: score of every other effect beside the accepted ones.
        gap: where model and data disagree.
        library: the linear model of all effects, the accepted ones among them.
        members: candidates of the library that stand for the accepted effects.
    """

    fit: Refit
    problem: Problem
    parts: Sequence[Linearization]
    stacked: Stack
    table: tuple[Score, ...]
    gap: Gap
    library: LinearLibrary
    members: tuple[int, ...]


class Workflow:
    """One investigation of a subject; :func:`explain` runs it from start to end."""

    def __init__(self, subject: Subject, say: Say | None = None):
        self.subject = subject
        self.say = say or (lambda text: None)
        self.library = {e.name: e for e in subject.library}
        self.looks = Looks()
        self._fits: dict[tuple[str, ...], Refit] = {}
        self._rounds: dict[tuple[str, ...], _Round] = {}
        self._searched: list[Signature] | None = None
        self._trials: dict[str, tuple[Problem, dict[str, np.ndarray], Stack]] = {}
        self._noise: dict[str, float] = {}
        self._degrees: dict[str, int] = {}

    # ------------------------------------------------------------------------------------------------ fits

    def fit(self, effects: Sequence[str], near: Refit | None = None,
            sizes: Mapping[str, np.ndarray] | None = None, promised: float | None = None) -> Refit:
        """The joint fit of the training data with these effects (kept once made).

        Args:
            effects: names.
            near: a neighbouring fit to start from, the plain one without. Where it lacks some of the effects and has no
                others, only the part of the problem that the newcomers touch is solved, the rest being at its optimum.
            sizes: where to start the parameters of newcomers.
            promised: drop of the sum of squares from the plain fit that the linear model expects; where the fit falls
                short of it, modes are started elsewhere too.
        """
        key = tuple(sorted(effects))
        if key in self._fits:
            return self._fits[key]
        problem = self.subject.problem(key, (), hold_out=True)
        near = near or self._fits.get(())
        if near is None:
            estimate = solve(problem, Options(tolerance=1e-3, iterations=60))
        else:
            start = {**near.estimate.values, **(sizes or {})}
            known = {n: np.asarray(start[n]) for n, v in problem.start.items()
                     if n in start and np.shape(start[n]) == np.shape(v)}
            problem = problem.starting_at(known)
            newcomers, gone = set(key) - set(near.effects), set(near.effects) - set(key)
            names = {u.name for u in problem.unknowns} if gone else newcomers
            values = _polished(problem, names)
            if promised is not None and self.fit(()).cost - self._cost(problem, values) < SHORT_OF * promised:
                again = self._answering(problem, newcomers)
                if again is not problem:
                    other = _polished(again, names)
                    values = min(values, other, key=lambda v: self._cost(problem, v))
            prepared = problem.prepared(values)
            estimate = summarized(prepared, values, prepared.linearize(values), converged=True, reason="",
                                  iterations=0, solver="gauss-newton", seconds=0.0)
        if not self._fits:
            self._noise = dict(stack(estimate.problem, estimate.parts).scale)
        fit = Refit(key, estimate, self._sum_of(estimate.problem, estimate.parts))
        self._fits[key] = fit
        return fit

    def _sum_of(self, problem: Problem, parts: Sequence[Linearization]) -> float:
        return float(sum(p.cost / self._noise.get(r.name, 1.0) ** 2
                         for r, p in zip(problem.residuals, parts, strict=True)))

    def _cost(self, problem: Problem, values: Mapping[str, np.ndarray]) -> float:
        """Sum of the losses, as that of a :class:`Refit`, at values that need not be a minimum."""
        prepared = problem.prepared(values)
        return self._sum_of(prepared, prepared.linearize(values, ()))

    def _answering(self, problem: Problem, newcomers: Collection[str]) -> Problem:
        """The problem started where an effect with internal states answers best.

        A mode that carries much of the inertia is seen well above its own frequency, and its signature, which is that
        of a small mode, knows only where it is seen: the searched parameter is moved by steps of its grid.
        """
        for name in sorted(newcomers):
            effect = self.library[name]
            index = next((i for i, p in enumerate(effect.parameters) if p.search is not None), None)
            if not effect.state_size or index is None or all(u.name != name for u in problem.unknowns):
                continue
            parameter = effect.parameters[index]
            assert parameter.search is not None
            touched = problem.with_residuals([r for r in problem.residuals if any(u.name == name for u in r.unknowns)])
            found = []
            for steps in ANSWERS:
                setting = np.array(problem.start[name], dtype=float)
                setting[index] = np.clip(parameter.search.moved(setting[index], steps), *parameter.plausible)
                values = _polished(touched.starting_at({name: setting}), {name}, iterations=2)
                cost = sum(p.cost for p in touched.prepared(values).linearize(values, ()))
                found.append((cost, setting))
            problem = problem.starting_at({name: min(found, key=lambda f: f[0])[1]})
        return problem

    def worth(self, fit: Refit) -> float:
        """Half the drop of the sum of squares from the plain fit, less the prices of the effects.

        A size that physics fixes was fitted to refute it: what its freedom gained is taken back.
        """
        total = 0.5 * (self.fit(()).cost - fit.cost)
        for name in fit.effects:
            effect = self.library[name]
            total -= price(effect, self._degrees.get(name, len(effect.parameters)))
            if all(u.name != name for u in fit.estimate.unknowns):
                continue
            values, sigma = fit.estimate.values[name], fit.estimate.sigma_of(name)
            for p, v, s in zip(effect.parameters, values, sigma, strict=True):
                if p.nominal is not None and np.isfinite(s) and s > 0:
                    total -= 0.5 * ((float(v) - p.nominal) / float(s)) ** 2
        return float(total)

    # ------------------------------------------------------------------------------------------------ library

    def round(self, effects: Sequence[str]) -> _Round:
        """The whole library around the fit with ``effects``."""
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
        base = stack(problem.holding(*(n for n in key if n in present)), parts) if key else stacked
        signatures = [signature(base, problem, parts, self.library[n], np.zeros(len(self.library[n].parameters)))
                      for n in linear if n not in key and n in present]
        if not self._rounds:
            self._count_looks(base, [*signatures, *(on_rows(s, base) for s in self.searched_signatures())])
        self._refine(base, stacked, key)
        signatures += [on_rows(s, base) for s in self.searched_signatures()]
        mine = [signature(base, problem, parts, self.library[n], np.asarray(point[n], dtype=float), whole=True)
                for n in key if n in present]
        signatures = _promising(base, stacked, signatures, mine)
        library, members, chosen = self._linear_model(base, stacked, signatures, mine)
        candidates = [signatures[i] for i in chosen if signatures[i].effect.name not in key]
        beside = products(stacked, candidates, stacked.residual[:, None])
        scores = [score_of(stacked, s, beside, i) for i, s in enumerate(candidates)]
        best: dict[str, Score] = {}
        for s in scores:
            if s.name not in best or s.score > best[s.name].score:
                best[s.name] = s
        table = tuple(sorted(best.values(), key=lambda s: -s.evidence))
        result = _Round(fit, problem, parts, stacked, table, find_gap(problem, stacked, parts), library, members)
        self._rounds[key] = result
        return result

    def _count_looks(self, base: Stack, signatures: Sequence[Signature]) -> None:
        """How many independent looks the search of this library amounts to."""
        self.say("rate of false alarms")
        found = products(base, signatures, base.residual[:, None])
        degrees = [visible_directions(found.raw[p, p], found.left[p, p]).shape[1] for p in found.places]
        self.looks = counted_looks(found.left, degrees, found.places, [s.effect.name for s in signatures])

    def _linear_model(self, base: Stack, stacked: Stack, signatures: Sequence[Signature], mine: Sequence[Signature],
                      ) -> tuple[LinearLibrary, tuple[int, ...], list[int]]:
        """The linear library, the indices of the accepted effects in it, and the signatures whose setting takes
        part."""
        everything = [*signatures, *mine]
        now = stacked.projected(stacked.residual)
        found = products(base, everything, np.column_stack([base.residual, now]))
        places = found.places
        known = np.zeros(len(found.raw))  # what the accepted effects have explained already
        for s, place in zip(mine, places[len(signatures) :], strict=True):
            known[place] = _amounts(s)
        right = found.left @ known - found.against[:, 0]
        blocks, strength = [], []
        for s, place in zip(everything, places, strict=True):
            seen = visible_directions(found.raw[place, place], found.left[place, place])
            blocks.append(seen)
            strength.append((float(np.sum((seen.T @ right[place]) ** 2)),
                             float(np.sum((seen.T @ found.against[place, 1]) ** 2))))
            self._degrees[s.effect.name] = max(self._degrees.get(s.effect.name, 0), seen.shape[1])
        chosen: set[int] = set()
        for name in dict.fromkeys(s.effect.name for s in signatures):
            own = [i for i, s in enumerate(signatures) if s.effect.name == name]
            for k in (0, 1):
                chosen |= set(sorted(own, key=lambda i: (round(strength[i][k], 2), i))[-TRIED_SETTINGS:])
        kept = sorted(chosen) + list(range(len(signatures), len(everything)))
        columns = np.concatenate([np.zeros(0, dtype=int), *(np.arange(places[i].start, places[i].stop) for i in kept)])
        gram = found.left[np.ix_(columns, columns)]
        candidates, start = [], 0
        for i in kept:
            s = everything[i]
            width = len(s.ordinary)
            nominal = None
            if any(p.nominal is not None for p in s.effect.parameters):
                nominal = np.array([(s.effect.parameters[k].nominal or 0.0) / s.effect.parameters[k].scale
                                    for k in s.ordinary])
            candidates.append(Candidate(s.effect, s.setting, s.ordinary, np.arange(start, start + width), blocks[i],
                                        nominal if blocks[i].shape[1] else None))
            start += width
        members = tuple(range(len(candidates) - len(mine), len(candidates)))
        return LinearLibrary(candidates, gram, right[columns]), members, sorted(chosen)

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
            self._trials[name] = touched, point, stacked
            found += [self._trial(name, g) for g in grid]
        self._searched = found
        return found

    def _trial(self, name: str, setting: np.ndarray) -> Signature:
        """The signature of an effect at one setting of its searched parameters, on the rows that it touches."""
        touched, point, stacked = self._trials[name]
        return signature(stacked, touched, touched.linearize({**point, name: setting}, (name,)), self.library[name],
                         setting)

    def _refine(self, base: Stack, stacked: Stack, skipped: Collection[str]) -> None:
        """Add settings between those of the grid where the residuals speak for an effect: a lightly damped mode or a
        jump is seen only close to its frequency or time."""
        now = stacked.projected(stacked.residual)[:, None]
        absorbed = base.carried(now)

        def drop(trial: Signature) -> tuple[float, int]:
            found = products(base, (on_rows(trial, base),), now, absorbed)
            seen = visible_directions(found.raw, found.left)
            return float(np.sum((seen.T @ found.against) ** 2)), seen.shape[1]

        for name in self._trials:
            own = [s for s in self.searched_signatures() if s.effect.name == name]
            if name in skipped or not own:
                continue
            found = [drop(s) for s in own]
            best = int(np.argmax([d for d, _ in found]))
            value, degrees = found[best]
            if degrees == 0 or self.looks.after(float(chi2_tail(value, degrees)), name) > WORTH_REFINING:
                continue
            setting = own[best].setting
            for index, parameter in enumerate(self.library[name].parameters):
                if parameter.search is None:
                    continue
                step = 0.5
                before = [-np.inf, -np.inf, value]
                for _ in range(REFINEMENTS):
                    if value - before[-3] < WORTH_HALVING:
                        break
                    for sign in (-1, 1):
                        moved = setting.copy()
                        moved[index] = np.clip(parameter.search.moved(moved[index], sign * step), *parameter.plausible)
                        trial = self._trial(name, moved)
                        better, _ = drop(trial)
                        if better > value + 1e-3:  # between two stretches of data all times are the same
                            value, setting = better, moved
                            self.searched_signatures().append(trial)
                    step /= 2
                    before.append(value)

    def gap(self, effects: Sequence[str]) -> Gap:
        """Where the model with these effects and the data disagree."""
        return self.round(effects).gap

    def sizes_of(self, here: _Round, chosen: Sequence[int]) -> dict[str, np.ndarray]:
        """Start values of newcomers: the size that the linear model expects."""
        start: dict[str, np.ndarray] = {}
        for i, size in zip(chosen, here.library.explained(chosen).sizes, strict=True):
            effect = here.library.candidates[i].effect
            if effect.name in here.fit.effects:
                continue
            low = np.array([p.plausible[0] for p in effect.parameters])
            high = np.array([p.plausible[1] for p in effect.parameters])
            searched = np.array([p.search is not None for p in effect.parameters])
            start[effect.name] = np.where(searched, here.library.candidates[i].setting, np.clip(size, low, high))
        return start

    # ------------------------------------------------------------------------------------------------ search

    def significant(self, drop: float, name: str) -> float:
        """Probability after the search that noise lowers the sum of squares by ``drop`` through this effect."""
        degrees = max(self._degrees.get(name, 1), 1)
        return self.looks.after(float(chi2_tail(max(drop, 0.0), degrees)), name)

    def pruned(self, here: _Round, chosen: Sequence[int]) -> list[int]:
        """The set without what is not significant beside the rest, the weakest leaving first.

        A newcomer whose part is below the error of the linear model is left for the turn after the refit.
        """
        library = here.library
        current = list(chosen)
        doubt = LINEAR * max(library.explained(current).drop - library.explained(here.members).drop, 0.0)
        while current:
            whole = library.explained(current).drop
            losses = []
            for i in current:
                drop = whole - library.explained([j for j in current if j != i]).drop
                name = library.candidates[i].name
                known = name in here.fit.effects or len(current) == 1
                losses.append((self.significant(drop if known else drop - doubt, name), i))
            worst, index = max(losses)
            if worst < SIGNIFICANT:
                break
            current.remove(index)
        return current

    def best_set(self, accepted: tuple[str, ...], excluded: Collection[str]) -> tuple[str, ...]:
        """The set of effects worth most, reached from ``accepted`` by joint refits."""
        refused: set[frozenset[str]] = set()
        in_a_row = 0
        out_of_place = set(excluded)  # with names whose size came out implausible beside the accepted ones
        for _ in range(TURNS):
            here = self.round(accepted)
            library = here.library
            found = library.best(here.members, out_of_place, MOST_EFFECTS, refused)
            chosen = self.pruned(here, found)
            names = frozenset(library.candidates[i].name for i in chosen)
            if names == set(accepted) or in_a_row == REFUSALS:
                return accepted
            if names in refused:  # what was pruned led back there: look elsewhere
                refused.add(frozenset(library.candidates[i].name for i in found))
                in_a_row += 1
                continue
            self.say("joint fit with " + (", ".join(sorted(names)) or "nothing"))
            refit = self.fit(sorted(names), here.fit, self.sizes_of(here, chosen), library.explained(chosen).drop)
            implausible = {n for n in names if not self.plausible(n, refit)}
            if not implausible and self.worth(refit) > self.worth(here.fit) + 1e-3:
                accepted, in_a_row, out_of_place = refit.effects, 0, set(excluded)
            else:
                refused.add(names)
                in_a_row += 1
                out_of_place |= implausible - set(accepted)
        return accepted

    def needed(self, effects: tuple[str, ...]) -> tuple[str, ...]:
        """The effects without those that are not significant beside the others, by joint fits."""
        current = effects
        while current:
            losses = [(self.loss(current, name)[1], name) for name in current]
            worst, name = max(losses)
            if worst < SIGNIFICANT:
                break
            self.say(f"{name} is not needed")
            current = tuple(n for n in current if n != name)
        return current

    def loss(self, effects: Sequence[str], name: str) -> tuple[float, float]:
        """Rise of the sum of squares without one of the effects, and how probable that is by noise after the search."""
        full = self.fit(effects)
        without = self.fit([n for n in effects if n != name], full)
        drop = without.cost - full.cost
        return drop, self.significant(drop, name)

    def rivals(self, effects: tuple[str, ...], name: str, excluded: Collection[str]) -> list[tuple[str, Refit]]:
        """Joint fits with another effect in the place of ``name``, of all that could be worth as much.

        The others may change with it: look-alikes come in pairs.
        """
        here = self.round(effects)
        library = here.library
        rest = [i for i in here.members if library.candidates[i].name != name]
        full = library.explained(here.members)
        loss, _ = self.loss(effects, name)
        room = 3 * INDISTINGUISHABLE + 0.05 * loss
        mine, size = next((i, s) for i, s in zip(here.members, full.sizes, strict=True)
                          if library.candidates[i].name == name)
        found = []
        for other in library.names():
            if other in effects or other in excluded:
                continue
            i = library.best_setting(rest, other)
            if i is None:
                continue
            chosen = [*rest, i]
            if rest and library.worth(chosen) <= full.worth - INDISTINGUISHABLE and \
                    library.copied(mine, size, i) > ALIKE:
                chosen = library.exchanged(chosen, {name, *excluded})
            tried = library.explained(chosen)
            if tried.plausible and tried.worth > full.worth - room and \
                    self.significant(loss + tried.drop - full.drop, other) < SIGNIFICANT:
                found.append((tried.worth, other, chosen, tried.drop))
        fits = []
        for _, other, chosen, drop in sorted(found, reverse=True)[:RIVALS]:
            self.say(f"{other} in place of {name}?")
            refit = self.fit([library.candidates[i].name for i in chosen], here.fit, self.sizes_of(here, chosen), drop)
            if all(self.plausible(n, refit) for n in refit.effects if n not in effects):
                fits.append((other, refit))
        return fits

    def exchanged(self, effects: tuple[str, ...], excluded: Collection[str]) -> tuple[str, ...]:
        """The effects with one of them exchanged where a joint fit shows that another is worth more."""
        best, worth = effects, self.worth(self.fit(effects))
        for name in effects:
            for _, refit in self.rivals(effects, name, excluded):
                if self.worth(refit) > worth + 1e-3:
                    best, worth = refit.effects, self.worth(refit)
        return best

    def groups(self, effects: tuple[str, ...], excluded: Collection[str] = ()) -> dict[str, tuple[str, ...]]:
        """For each of the effects the names that explain the data as well in its place, its own first.

        A richer name can copy a simpler one: it must come closer in worth to be held for as likely. Where a set that
        is worth as much differs in more than one name, each new name goes to the place of the one that it copies best.
        """
        full = self.fit(effects)
        worth = self.worth(full)
        alike = {name: [name] for name in effects}
        for name in effects:
            without = self.fit([n for n in effects if n != name], full)
            for other, refit in self.rivals(effects, name, excluded):
                room = INDISTINGUISHABLE / (1 if self._freedom(refit.effects) <= self._freedom(effects) else 2)
                if self.worth(refit) <= worth - room or \
                        self.significant(without.cost - refit.cost, other) >= SIGNIFICANT:
                    continue
                for place, newcomer in self._places(effects, refit.effects):
                    if newcomer not in alike[place]:
                        alike[place].append(newcomer)
        return {name: tuple(group) for name, group in alike.items()}

    def _freedom(self, effects: Collection[str]) -> int:
        """Visible directions of all the effects."""
        return sum(self._degrees.get(name, 1) for name in effects)

    def _places(self, effects: tuple[str, ...], others: tuple[str, ...]) -> list[tuple[str, str]]:
        """Which of the accepted effects each name of another set stands for."""
        gone = [n for n in effects if n not in others]
        new = [n for n in others if n not in effects]
        if len(gone) == len(new) == 1:
            return [(gone[0], new[0])]
        here = self.round(effects)
        library = here.library
        sizes = dict(zip(here.members, library.explained(here.members).sizes, strict=True))
        member = {library.candidates[i].name: i for i in here.members}
        likeness = np.array([[max((library.copied(member[g], sizes[member[g]], i) for i in library.indices(n)),
                                  default=0.0) for n in new] for g in gone])
        rows, columns = linear_sum_assignment(-likeness)
        return [(gone[r], new[c]) for r, c in zip(rows, columns, strict=True)]

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

    def run(self) -> Findings:
        """Search, add, step back, prove; see :class:`Findings`."""
        began = time.perf_counter()
        self.say("fit of the plain model")
        self.fit(())
        self.say("signatures of the library")
        before = self.gap(())
        accepted: tuple[str, ...] = ()
        excluded: set[str] = set()
        tables = [self.round(()).table]
        for _ in range(TURNS):
            at_entry = accepted
            accepted = self.needed(self.best_set(accepted, excluded))
            accepted = self.needed(self.exchanged(accepted, excluded))
            ordered = self.ordered(accepted)
            unpaid = next((n for n in reversed(ordered) if not self._pays(ordered, n)), None)
            if unpaid is not None:
                self.say(f"{unpaid} does not pay on held-out data")
                excluded.add(unpaid)
                accepted = tuple(n for n in accepted if n != unpaid)
            elif set(accepted) == set(at_entry):
                break
        ordered = self.ordered(accepted)
        tables += [self._rounds[key].table for key in (tuple(sorted(ordered[: k + 1])) for k in range(len(ordered)))
                   if key in self._rounds]
        findings = self._findings(ordered, excluded)
        after = self.gap(accepted)
        self.say("joint fit of all data")
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
                        self.looks.names, time.perf_counter() - began)

    def ordered(self, effects: Collection[str]) -> tuple[str, ...]:
        """The effects: the one that explains most by itself, then the one that explains most beside it, and so on."""
        if len(effects) < 2:
            return tuple(effects)
        here = self.round(tuple(effects))
        left = list(here.members)
        order: list[int] = []
        while left:
            best = max(left, key=lambda i: here.library.explained([*order, i]).drop)
            order.append(best)
            left.remove(best)
        return tuple(here.library.candidates[i].name for i in order)

    def _pays(self, effects: tuple[str, ...], name: str) -> bool:
        """Whether held-out data bear out one of the effects beside the others.

        What they take back of the evidence must leave it significant.
        """
        second = self.fit(effects)
        first = self.fit([n for n in effects if n != name], second)
        channels = channels_of(second.estimate.problem, name)
        proof = proved(first.estimate, second.estimate, channels)
        drop = first.cost - second.cost + min(proof.drop, 0.0)
        level = BEYOND_DOUBT if nothing_to_explain(first.estimate, channels) else SIGNIFICANT
        return not proof.refuted and self.significant(drop, name) < level

    def _findings(self, order: tuple[str, ...], excluded: Collection[str]) -> tuple[Finding, ...]:
        findings = []
        self.say("what explains the data as well")
        groups = self.groups(order, excluded) if order else {}
        for k, name in enumerate(order):
            second, first = (self.fit(order[:j], self.fit(order)) for j in (k + 1, k))
            expected = next((s for s in self.round(order[:k]).table if s.name == name), None)
            assert expected is not None
            one, two = first.estimate, second.estimate
            findings.append(Finding(
                name, groups[name], first.cost - second.cost, self._degrees.get(name, 1),
                self.loss(order, name)[1], misfit(one.problem, one.parts, held_out=False),
                misfit(two.problem, two.parts, held_out=False), misfit(one.problem, one.parts, held_out=True),
                misfit(two.problem, two.parts, held_out=True), expected, shifts(one, two)))
        return tuple(findings)


def _amounts(accepted: Signature) -> np.ndarray:
    """Sizes of an accepted effect in the scales of its columns."""
    ordinary = np.array([p.search is None for p in accepted.effect.parameters])
    scales = np.array([p.scale for p in accepted.effect.parameters])
    return np.where(ordinary, accepted.setting / scales, 0.0)


def _promising(base: Stack, stacked: Stack, signatures: Sequence[Signature], mine: Sequence[Signature],
               ) -> list[Signature]:
    """The signatures but those settings of a name that explain least, both beside the accepted effects and without
    them: the products of all settings with each other are many and needless."""
    bare = base.residual.copy()
    for s in mine:
        for name, part in s.parts.items():
            bare[base.pieces[name].rows] -= part @ _amounts(s)
    right = np.column_stack([bare, stacked.projected(stacked.residual)])
    absorbed = base.carried(right)

    def strength(s: Signature) -> np.ndarray:
        found = products(base, (s,), right, absorbed)
        return np.asarray(np.sum((visible_directions(found.raw, found.left).T @ found.against) ** 2, axis=0))

    kept: list[Signature] = []
    for effect in dict.fromkeys(s.effect.name for s in signatures):
        own = [s for s in signatures if s.effect.name == effect]
        if len(own) > 2 * TRIED_SETTINGS:
            drops = np.array([strength(s) for s in own])
            best = {int(i) for column in drops.T
                    for i in np.argsort(np.round(column, 2), kind="stable")[-TRIED_SETTINGS:]}
            own = [own[i] for i in sorted(best)]
        kept += own
    return kept


def _polished(problem: Problem, names: set[str], iterations: int = 12) -> dict[str, np.ndarray]:
    """Values with the named unknowns, and all that is connected to them through residuals, at their optimum."""
    free = {u.name for u in problem.free}
    reached = names & free
    touched: list[Residual] = []
    growing = True
    while growing:
        touched = [r for r in problem.residuals if any(u.name in reached for u in r.unknowns)]
        grown = reached | {u.name for r in touched for u in r.unknowns if u.name in free}
        growing = grown != reached
        reached = grown
    part = problem.with_residuals(touched).holding(*(free - reached))
    estimate = solve(part, Options(tolerance=3e-2, iterations=iterations, largest_step=1e4))
    return dict(estimate.values)


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
