"""From a campaign to the answer: screen, start, solve jointly, and say it in the user's terms.

:func:`solve_campaign` is what ``boresight solve`` calls; :class:`AlignmentSolution` holds the estimate and turns it
into the machine-readable answer and into a table.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import casadi as ca
import numpy as np

from estimator.effect_uncertainty import sigma_of
from estimator.estimate import Estimate, Status
from estimator.losses import Loss
from estimator.models.errors import RequestError
from estimator.models.inertia import matrix_of
from estimator.residuals import KernelResidual
from estimator.solvers import Options, solve, solve_with_ipopt
from estimator.unknowns import NormalizedInertia
from problems.alignment.campaign import Campaign
from problems.alignment.determined_rotation import DeterminedTurn, determined_turns, squint
from problems.alignment.problem import AlignmentModel, alignment_model, alignment_problem
from problems.alignment.screening import Screening, isolated_outliers, screen

Solver = Literal["gauss-newton", "ipopt"]
SCREENING_ROUNDS = 5
"""Most solves in which samples that stand apart from the fitted model are left out of the next one."""


@dataclass(frozen=True, eq=False)
class AlignmentSolution:
    """The joint estimate of one campaign.

    Attributes:
        model: the prepared campaign.
        estimate: the engine's answer.
        screening: gross outliers that were left out.
        status: the gravest word that applies, the campaign's own limits included.
        why: its sentence.
        unobservable: what the data do not determine, in the user's terms.
        seconds: wall time from the campaign in memory to the answer.
    """

    model: AlignmentModel
    estimate: Estimate
    screening: Screening
    status: Status
    why: str
    unobservable: tuple[str, ...]
    seconds: float

    @property
    def antenna_from_tracker(self) -> np.ndarray | None:
        """Unit quaternion (4), or None where no Doppler data determine it."""
        return self._quaternion("antenna_from_tracker")

    @property
    def actuator_from_tracker(self) -> np.ndarray | None:
        """Unit quaternion (4), or None where no commanded torque determines it."""
        return self._quaternion("actuator_from_tracker")

    @property
    def normalized_inertia(self) -> np.ndarray | None:
        """Inertia tensor over its trace (3, 3), tracker axes, or None without a rotation arc."""
        if not self._estimated("normalized_inertia"):
            return None
        return np.asarray(matrix_of(ca.DM(self.estimate.values["normalized_inertia"])))

    def _estimated(self, name: str) -> bool:
        return any(u.name == name for u in self.estimate.unknowns)

    def _quaternion(self, name: str) -> np.ndarray | None:
        if not self._estimated(name):
            return None
        q = np.asarray(self.estimate.values[name])
        return q if q[0] >= 0 else -q

    def inertia_covariance(self) -> np.ndarray | None:
        """Covariance (6, 6) of the entries (xx, yy, zz, xy, xz, yz) of the normalized inertia."""
        if not self._estimated("normalized_inertia"):
            return None
        point, step = ca.SX.sym("x", 6), ca.SX.sym("d", 5)
        slope = ca.Function("slope", [point, step], [ca.jacobian(NormalizedInertia().retract(point, step), step)])
        jacobian = np.asarray(slope(self.estimate.values["normalized_inertia"], np.zeros(5)))
        return jacobian @ self.estimate.covariance_of("normalized_inertia") @ jacobian.T

    def as_dict(self) -> dict[str, Any]:
        """The machine-readable answer."""
        residuals: dict[str, dict[str, Any]] = {}
        for channel in dict.fromkeys(s.channel for s in self.estimate.summaries):
            of_channel = [s for s in self.estimate.summaries if s.channel == channel]
            total = sum(s.consistency.total for s in of_channel)
            degrees = sum(s.consistency.degrees for s in of_channel)
            rms = float(np.sqrt(np.mean([s.rms**2 for s in of_channel])))
            entry = {"unit": of_channel[0].unit, "rms": rms, "chi2_per_dof": total / degrees if degrees > 0 else None,
                     "degrees_of_freedom": degrees}
            residuals[channel] = entry
            if len(of_channel) > 1 or of_channel[0].name != channel:
                for s in of_channel:
                    residuals[s.name] = {"unit": s.unit, "rms": s.rms, "chi2_per_dof": s.consistency.ratio,
                                         "degrees_of_freedom": s.consistency.degrees}
        inertia, covariance = self.normalized_inertia, self.inertia_covariance()
        sigma = None
        if covariance is not None:
            e = np.sqrt(np.maximum(np.diag(covariance), 0.0))
            if np.isinf(self.estimate.sigma_of("normalized_inertia")).any():
                e = np.full(6, np.inf)
            sigma = [[e[0], e[3], e[4]], [e[3], e[1], e[5]], [e[4], e[5], e[2]]]
        answer: dict[str, Any] = {
            "status": str(self.status),
            "why": self.why,
            "chi2_per_dof": self.estimate.chi_square_per_degree(),
            "antenna_from_tracker": self._rotation("antenna_from_tracker", "antenna"),
            "actuator_from_tracker": self._rotation("actuator_from_tracker", "actuator"),
            "normalized_inertia": {"matrix": inertia, "sigma": sigma},
        }
        if self._estimated("inertia_trace"):
            answer["inertia_trace"] = {"value": float(self.estimate.values["inertia_trace"][0]),
                                       "sigma": float(self.estimate.sigma_of("inertia_trace")[0]), "unit": "kg m2"}
        gnss = next(s for s in self.estimate.summaries if s.channel == "gnss")
        answer |= {
            "trajectory": {"degree": self.model.frame.degree, "rms_m": gnss.rms},
            "effects": self._effects(),
            "unobservable": list(self.unobservable),
            "residuals": residuals,
            "rejected": self.screening.rejected(),
            "solver": self.estimate.solver,
            "iterations": self.estimate.iterations,
            "seconds": self.seconds,
        }
        return answer

    def _rotation(self, name: str, axes: str) -> dict[str, Any]:
        quaternion = self._quaternion(name)
        if quaternion is None:
            return {"quaternion": None, "sigma_rad": None}
        answer = {"quaternion": quaternion, "sigma_rad": self.estimate.sigma_of(name), "sigma_axes": axes,
                  "covariance_rad2": self.estimate.covariance_of(name)}
        turns = determined_turns(self.estimate, name, getattr(self.model.campaign.nominal, name))
        if turns:
            answer["determined"] = [turn.as_dict() for turn in turns]
            if name == "antenna_from_tracker" and (found := beam_squint(self.model, self.estimate)) is not None:
                answer["squint"] = found.as_dict()
        return answer

    def _effects(self) -> list[dict[str, Any]]:
        described = []
        for instance in self.model.effect_instances(self.estimate.problem.effects):
            if not self._estimated(instance.name):
                described.append({"name": instance.name, "parameters": {}})
                continue
            values = self.estimate.values[instance.name]
            sigma = sigma_of(self.estimate, instance)
            described.append({"name": instance.name, "parameters": {
                p.name: {"value": float(v), "sigma": float(s), "unit": p.unit}
                for p, v, s in zip(instance.parameters, values, sigma, strict=True)}})
        return described

    def __str__(self) -> str:
        lines = [f"{self.model.campaign.title or 'alignment campaign'}", "", f"{self.status}: {self.why}"]
        body = str(self.estimate).split("\n", 1)[1]
        return "\n".join(lines) + "\n" + body + f"\n\ntrajectory degree {self.model.frame.degree}, {self.seconds:.2f} s"


def beam_squint(model: AlignmentModel, estimate: Estimate) -> DeterminedTurn | None:
    """How far the beams look ahead of where they would by design; None where that is not determined."""
    doppler = model.campaign.doppler
    assert doppler is not None
    index = model.doppler_epochs
    beams = doppler.beam_direction
    beams = beams[index] if beams.ndim == 3 else np.broadcast_to(beams, (len(index), *beams.shape))
    velocity = model.tracker_velocity(estimate.values["antenna_from_tracker"])
    return squint(estimate, "antenna_from_tracker", model.campaign.nominal.antenna_from_tracker,
                  beams / np.linalg.norm(beams, axis=2, keepdims=True), velocity)


def kept(campaign: Campaign, screening: Screening) -> Campaign:
    """The campaign without the samples that the screening rejects."""
    gnss, tracker, doppler = campaign.gnss, campaign.star_tracker, campaign.doppler
    changes: dict[str, Any] = {}
    if not screening.gnss.all():
        m = screening.gnss
        changes["gnss"] = replace(gnss, time=gnss.time[m], position=gnss.position[m],
                                  standard_deviation=_rows(gnss.standard_deviation, m))
    if not screening.star_tracker.all():
        m = screening.star_tracker
        changes["star_tracker"] = replace(tracker, time=tracker.time[m], quaternion=tracker.quaternion[m],
                                          standard_deviation=_rows(tracker.standard_deviation, m))
    if doppler is not None and not screening.doppler.all():
        m = screening.doppler
        beams = doppler.beam_direction
        changes["doppler"] = replace(doppler, time=doppler.time[m], frequency_shift=doppler.frequency_shift[m],
                                     standard_deviation=_rows(doppler.standard_deviation, m),
                                     beam_direction=beams[m] if beams.ndim == 3 else beams)
    return replace(campaign, **changes) if changes else campaign


def _rows(array: np.ndarray, mask: np.ndarray) -> np.ndarray:
    return array[mask] if np.ndim(array) > 1 and len(array) == len(mask) else array


def solve_campaign(campaign: Campaign, *, solver: Solver = "gauss-newton", effects: Sequence[str] = (),
                   loss: Loss | None = None, degree: int | None = None, screening: bool = True,
                   options: Options | None = None) -> AlignmentSolution:
    """Solve the joint problem of a campaign.

    Args:
        campaign: checked flight data.
        solver: "gauss-newton", or "ipopt" on the same expressions as an independent check.
        effects: names of effects to estimate with everything else.
        loss: robust loss; default quadratic.
        degree: degree of the Fourier trajectory; None chooses it from the data.
        screening: whether gross outliers are looked for and left out.
        options: of the Gauss-Newton solver.

    Raises:
        InputError: data that cannot be used; see :mod:`estimator.models.errors`.
    """
    began = time.perf_counter()
    if solver not in ("gauss-newton", "ipopt"):
        raise RequestError(f"no solver is named {solver!r}", where="--solver", limit="gauss-newton or ipopt")
    found = screen(campaign) if screening else _everything(campaign)
    for _ in range(SCREENING_ROUNDS):
        model = alignment_model(kept(campaign, found), loss=loss, degree=degree)
        problem = alignment_problem(model, effects)
        estimate = solve(problem, options) if solver == "gauss-newton" else solve_with_ipopt(problem)
        further = _screened_further(found, model, estimate) if screening else found
        if further is found:
            break
        found = further
    return concluded(model, estimate, found, time.perf_counter() - began)


def _screened_further(found: Screening, model: AlignmentModel, estimate: Estimate) -> Screening:
    """The screening without the samples that stand apart from the fitted model; ``found`` itself if there are none."""
    doppler, tracker = found.doppler.copy(), found.star_tracker.copy()
    doppler_index, tracker_index = np.flatnonzero(doppler), np.flatnonzero(tracker)
    places = {f"star_tracker:{arc.name}": index for arc, index in model.rotation_arcs}
    for residual, part in zip(estimate.problem.residuals, estimate.parts, strict=True):
        if not isinstance(residual, KernelResidual):
            continue
        wrong = isolated_outliers(part.whitened, residual.arc)
        if residual.channel == "doppler":
            doppler[doppler_index[model.doppler_epochs[wrong]]] = False
        elif residual.name in places:
            tracker[tracker_index[places[residual.name][wrong]]] = False
    if doppler.sum() == found.doppler.sum() and tracker.sum() == found.star_tracker.sum():
        return found
    return Screening(found.gnss, doppler, tracker)


def _everything(campaign: Campaign) -> Screening:
    doppler = 0 if campaign.doppler is None else len(campaign.doppler.time)
    return Screening(np.ones(len(campaign.gnss.time), dtype=bool), np.ones(doppler, dtype=bool),
                     np.ones(len(campaign.star_tracker.time), dtype=bool))


def concluded(model: AlignmentModel, estimate: Estimate, screening: Screening, seconds: float) -> AlignmentSolution:
    """Add to the engine's verdict what the campaign itself leaves open."""
    missing = []
    names = {u.name for u in estimate.unknowns}
    if "antenna_from_tracker" not in names:
        missing.append("antenna_from_tracker: the campaign has no Doppler epoch with a star tracker attitude")
    if "normalized_inertia" not in names:
        missing.append("normalized_inertia: the campaign has no free-rotation or torque-pulse arc")
    if "actuator_from_tracker" not in names:
        missing.append("actuator_from_tracker: the campaign has no arc with a commanded torque")
    weak = [w.sentence for w in estimate.weak if any(not estimate.problem.unknown(n).nuisance for n in w.participation)]
    status, why = estimate.status, [estimate.why]
    if missing:
        if status is Status.OK:
            why = []
        status = max(status, Status.UNOBSERVABLE, key=lambda s: s.gravity)
        why.append("this campaign cannot determine " + "; ".join(m.replace(": ", " (", 1) + ")" for m in missing))
    if "antenna_from_tracker" in names and determined_turns(
            estimate, "antenna_from_tracker", model.campaign.nominal.antenna_from_tracker):
        found = beam_squint(model, estimate)
        if found is not None:
            milli = 1e3 * np.rad2deg(1.0)
            why.append(f"the squint of the beams is determined: {milli * found.angle:+.3g} millidegrees, sigma "
                       f"{milli * found.sigma:.2g} from the declared noise, {milli * found.scatter:.2g} from the "
                       "scatter of the residuals along the sessions")
    if screening.rejected():
        why.append(screening.sentence())
    why += model.left_out
    if model.skipped_arcs:
        why.append("too few star tracker samples in " + ", ".join(model.skipped_arcs))
    return AlignmentSolution(model, estimate, screening, status, ". ".join(why), (*missing, *weak), seconds)
