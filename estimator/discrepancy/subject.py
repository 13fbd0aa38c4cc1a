"""What the workflow needs from a problem: to be made with given effects, and to say which effects there are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable

import numpy as np

from estimator.discrepancy.dependence import Covariate
from estimator.effects.declaration import EffectInstance
from estimator.problem import Problem


class Subject(Protocol):
    """A system under investigation."""

    @property
    def library(self) -> tuple[EffectInstance, ...]:
        """Every effect that may be named, instances of a family one by one."""

    def problem(self, effects: Sequence[str], candidates: Sequence[str], *, hold_out: bool) -> Problem:
        """The joint problem with ``effects`` estimated and ``candidates`` in the kernels, held at zero.

        With ``hold_out`` a part of every arc is kept from the fit: its samples stay in the residuals with no weight.
        """


@runtime_checkable
class SubjectWithCovariates(Protocol):
    """A subject that can say what a disagreement may go with."""

    def covariates(self, channel: str, time: np.ndarray) -> Mapping[str, Covariate]:
        """Orbit phase, rate, look direction, housekeeping: everything known at rising times (n,) s of a channel.

        Values are NaN where they are not known; nothing is extrapolated.
        """
