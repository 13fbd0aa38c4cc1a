"""One call from a campaign to its explanation: the search of the discrepancy workflow and the next measurement."""

from __future__ import annotations

import time
from collections.abc import Sequence

from estimator.discrepancy.dependence import Dependence, dependences
from estimator.discrepancy.empirical import EmpiricalTerm, empirical_terms
from estimator.discrepancy.gap import Gap
from estimator.discrepancy.search import Say, Workflow
from estimator.models.errors import RequestError
from problems.alignment.campaign import Campaign
from problems.alignment.explain_answer import Explanation
from problems.alignment.investigation import AlignmentSubject


def explained(campaign: Campaign, *, hold_out: float = 0.2, without: Sequence[str] = (),
              effects_places: Sequence[str] = (), say: Say | None = None) -> Explanation:
    """Find what the plain model of a campaign misses, and what to measure next.

    Args:
        campaign: checked flight data.
        hold_out: fraction of every arc that is kept for the proof.
        without: effects that are taken out of the library.
        effects_places: files or directories with effects of the user's own.
        say: called with what is being done.

    Raises:
        RequestError: an effect to be left out is not in the library.
        InputError: data that cannot be used.
    """
    began = time.perf_counter()
    say = say or (lambda text: None)
    subject = AlignmentSubject(campaign, hold_out, tuple(without), tuple(effects_places))
    _check(without, effects_places)
    workflow = Workflow(subject, say)
    findings = workflow.run()
    advice = None
    if findings.verdict == "ambiguous":
        from problems.alignment.next_measurement import advise

        say("which measurement would separate the group")
        group = max((f for f in findings.findings if len(f.group) > 1), key=lambda f: len(f.group))
        rest = [f.name for f in findings.findings if f.name != group.name]
        sizes = {name: workflow.fit((*rest, name)).estimate.values for name in group.group}
        advice = advise(subject.everything, group.group, rest, sizes)
    say("what the disagreement goes with")
    accepted = tuple(f.name for f in findings.findings)
    before = _depends_on(workflow, subject, (), findings.before)
    left = _depends_on(workflow, subject, accepted, findings.after) if accepted else before
    empirical: tuple[EmpiricalTerm, ...] = ()
    if findings.verdict == "unknown" and findings.after.present:
        say("the shape of what is left")
        here = workflow.round(accepted)
        empirical = empirical_terms(here.problem, here.parts, here.stacked, findings.after)
    return Explanation(subject, workflow, findings, advice, time.perf_counter() - began, before, left, empirical)


def _depends_on(workflow: Workflow, subject: AlignmentSubject, effects: Sequence[str], gap: Gap,
                ) -> tuple[Dependence, ...]:
    """What the disagreement of each channel of a gap goes with, beside the model with these effects."""
    if not gap.present:
        return ()
    here = workflow.round(effects)
    channels = dict.fromkeys(p.channel for p in gap.places)
    return tuple(d for c in channels
                 for d in dependences(here.problem, here.parts, here.stacked, c, subject.covariates))


def _check(without: Sequence[str], places: Sequence[str]) -> None:
    from estimator.effects.library import load

    known = load(places)
    for name in without:
        if name.split(":")[0] not in known:
            raise RequestError("no effect of this name is in the library", where="--without", value=name,
                               remedy="choose from " + ", ".join(known))
