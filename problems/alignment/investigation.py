"""The alignment campaign as a subject of the discrepancy workflow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from estimator.discrepancy.dependence import Covariate
from estimator.discrepancy.search import Findings, Say, explain
from estimator.effects.declaration import EffectInstance
from estimator.problem import Problem
from problems.alignment.campaign import Campaign
from problems.alignment.problem import AlignmentModel, alignment_model, alignment_problem
from problems.alignment.screening import screen
from problems.alignment.solution import kept


@dataclass(frozen=True, eq=False)
class AlignmentSubject:
    """A campaign under investigation.

    Attributes:
        campaign: checked flight data.
        hold_out: fraction of every arc that is kept for the proof.
        without: names or families of effects that are taken out of the library.
        effects_places: files or directories with effects of the user's own.
    """

    campaign: Campaign
    hold_out: float = 0.2
    without: tuple[str, ...] = ()
    effects_places: tuple[str, ...] = ()

    @cached_property
    def everything(self) -> AlignmentModel:
        """The campaign with all of its data in the fit."""
        return alignment_model(kept(self.campaign, screen(self.campaign)))

    @cached_property
    def training(self) -> AlignmentModel:
        """The same with a part of every arc held out."""
        full = self.everything
        return alignment_model(full.campaign, frame=full.frame, hold_out=self.hold_out)

    @cached_property
    def library(self) -> tuple[EffectInstance, ...]:
        """The instances of every effect that can act on this campaign."""
        from estimator.effects.library import load

        model = self.everything
        channels = {"gnss"}
        if len(model.doppler_epochs):
            channels |= {"doppler", "star_tracker"}
        if model.rotation_arcs:
            channels |= {"torque", "star_tracker"}
        if any(arc.kind == "torque_pulse" for arc, _ in model.rotation_arcs):
            channels.add("command")
        return tuple(e for effect in load(self.effects_places).values() for e in effect.instances(model.layout)
                     if e.channel in channels and e.name not in self.without and e.family not in self.without)

    def problem(self, effects: Sequence[str], candidates: Sequence[str], *, hold_out: bool) -> Problem:
        """See :class:`estimator.discrepancy.subject.Subject`."""
        return alignment_problem(self.training if hold_out else self.everything, effects, candidates=candidates)

    def covariates(self, channel: str, time: np.ndarray) -> Mapping[str, Covariate]:
        """See :func:`problems.alignment.covariates.campaign_covariates`."""
        from problems.alignment.covariates import campaign_covariates

        return campaign_covariates(self.everything, channel, time)


def explain_campaign(campaign: Campaign, *, hold_out: float = 0.2, without: Sequence[str] = (),
                     effects_places: Sequence[str] = (), say: Say | None = None) -> Findings:
    """Find what the plain model of a campaign misses; see :mod:`estimator.discrepancy.search`."""
    return explain(AlignmentSubject(campaign, hold_out, tuple(without), tuple(effects_places)), say)
