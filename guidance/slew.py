"""The whole answer to one slew: the optimum, the closed forms beside it, the lower bound, and a dense check."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from estimator.models.errors import InfeasibleError
from guidance.composition_slew import composition_slew
from guidance.eigenaxis_slew import eigenaxis_slew, turn
from guidance.kinematics import Motion
from guidance.least_time import ClosedForm
from guidance.rodrigues_slew import rodrigues_slew
from guidance.slew_bounds import lower_bound
from guidance.slew_envelope import inner_limits, outer_limits
from guidance.slew_optimum import Optimum, optimal_slew
from guidance.slew_request import SlewRequest
from guidance.slew_verification import Verification, verify

Array = np.ndarray

CLOSED_FORMS = ("eigenaxis", "mrp5", "mrp7", "mrp9", "composition")


@dataclass(frozen=True)
class Slew:
    """Answer to a request.

    Attributes:
        request: what was asked.
        status: "ok", "infeasible" or "not_converged".
        why: the sentence that goes with it.
        optimum: the solved slew, None where there is none.
        lower_bound: no slew is shorter, s.
        closed_forms: name to law (None where the law cannot meet the request).
        verification: of the optimum, by dense integration.
        limit, excess: which limit an infeasible request breaks, and by how much, where known.
    """

    request: SlewRequest
    status: str
    why: str
    optimum: Optimum | None
    lower_bound: float
    closed_forms: dict[str, ClosedForm | None] = field(repr=False, default_factory=dict)
    verification: Verification | None = None
    limit: str = ""
    excess: float | None = None

    @property
    def duration(self) -> float:
        """Of the optimum, s; NaN where there is none."""
        return self.optimum.duration if self.optimum else math.nan

    def motion(self, times: Array) -> Motion:
        """Attitude ``inertial_from_body``, rate, acceleration, jerk of the optimum at increasing ``times`` (m,), s.

        Raises:
            InfeasibleError: there is no optimum.
        """
        if self.optimum is None:
            raise InfeasibleError(self.why, limit=self.limit, excess=self.excess)
        return self.optimum.profile.motion(np.asarray(times, dtype=float))

    def as_json(self) -> dict[str, Any]:
        """The machine-readable answer of the command line."""
        v, o = self.verification, self.optimum
        return {
            "status": self.status, "why": self.why,
            "duration_s": o.duration if o else None,
            "lower_bound_s": self.lower_bound,
            "closed_form": {name: {"duration_s": law.duration} for name, law in self.closed_forms.items()
                            if law is not None},
            "largest": {"rate": v.rate, "acceleration": v.acceleration, "jerk": v.jerk} if v else None,
            "terminal_error_rad": v.terminal_error if v else None,
            "seconds": o.seconds if o else None,
            "angle_rad": float(np.linalg.norm(turn(self.request, bool(o and o.long_way)))),
            "long_way": o.long_way if o else None,
            "solver": o.solver if o else None,
            "iterations": o.iterations if o else None,
            "steps": list(o.steps) if o else [],
            "limit": self.limit or None,
            "excess": self.excess,
        }


def closed_forms(request: SlewRequest) -> dict[str, ClosedForm | None]:
    """Every closed-form slew in its least feasible time, the quicker of both ways round; None where it has none.

    Under actuators the isotropic limits are the largest balls inside their envelopes.
    """
    limits = inner_limits(request)
    if limits is None:
        return dict.fromkeys(CLOSED_FORMS)
    laws: dict[str, ClosedForm | None] = {"eigenaxis": eigenaxis_slew(request, limits)}
    bounds = {way: max(lower_bound(request, limits, long_way=way), 1e-3) for way in (False, True)}

    def quicker(make: Any) -> ClosedForm | None:
        best: ClosedForm | None = None
        for way, bound in bounds.items():
            if best is not None and bound >= best.duration:
                continue
            law = make(way, bound)
            if law is not None and (best is None or law.duration < best.duration):
                best = law
        return best

    for degree in (5, 7, 9):
        laws[f"mrp{degree}"] = quicker(
            lambda way, bound, degree=degree: rodrigues_slew(request, degree, limits, bound, long_way=way))
    laws["composition"] = quicker(lambda way, bound: composition_slew(request, limits, bound, long_way=way))
    return laws


def solve_slew(request: SlewRequest, *, near: Slew | Optimum | None = None, compare: bool = True,
               points: int = 10_000) -> Slew:
    """Answer a request.

    Args:
        request: the slew.
        near: the answer to a neighbouring request, to start from.
        compare: also find the closed forms in their least feasible times.
        points: of the dense check.

    An infeasible request comes back with its status and the reason; only bad input raises.
    """
    bound = lower_bound(request, outer_limits(request))
    laws = closed_forms(request) if compare else {}
    start = near.optimum if isinstance(near, Slew) else near
    try:
        if request.objective == "smoothness" and request.duration is not None and request.duration < bound:
            ratio = bound / request.duration
            raise InfeasibleError(
                f"the duration {request.duration:.6g} s is below the least possible {bound:.6g} s; it would need a "
                f"rate limit up to {ratio:.4g}, an acceleration limit up to {ratio**2:.4g} and a jerk limit up to "
                f"{ratio**3:.4g} times the present one", limit="duration", excess=bound - request.duration)
        optimum = optimal_slew(request, near=start)
    except InfeasibleError as error:
        return Slew(request, "infeasible", error.why, None, bound, laws, None, error.limit, error.excess)
    check = verify(optimum.profile, request, points)
    text = "the smoothest slew of the duration asked for" if request.objective == "smoothness" else "the quickest slew"
    why = f"{text}, {'the long way round' if optimum.long_way else 'the short way round'}, keeps every limit everywhere"
    eigenaxis = laws.get("eigenaxis")
    if eigenaxis is not None and request.objective == "time" and request.actuators is None and not request.keep_out:
        why += f"; {optimum.duration / eigenaxis.duration - 1:+.1e} of the S-curve from rest to rest"
    return Slew(request, "ok", why, optimum, bound, laws, check)
