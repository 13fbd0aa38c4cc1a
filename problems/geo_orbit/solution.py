"""From tracking data to the answer: check, start, solve jointly, leave gross outliers out, say it in the user's
terms."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from estimator.estimate import Estimate, Status
from estimator.losses import Loss
from estimator.models.earth_orientation import utc_text
from estimator.models.errors import GeometryError, InfeasibleError
from estimator.models.orbit_environment import eme2000_from_gcrs
from estimator.models.ranging import COMPONENTS
from estimator.problem import Problem
from estimator.residuals import KernelResidual
from estimator.solvers import Options, solve
from problems.geo_orbit.effects import chosen
from problems.geo_orbit.plausibility import shifted_times, suspicious_stations
from problems.geo_orbit.problem import OrbitModel, orbit_model, orbit_problem
from problems.geo_orbit.settings import OrbitSettings
from problems.geo_orbit.tracking import Tracking

_FAR = 25.0  # mean whitened square above which a fit counts as far from the noise
_LONG = 3.0  # revolutions over which a satellite may have manoeuvred
_DISTURBED = 5.0  # median size over the noise beyond which the model misses long data, rather than single measurements
_PATIENCE = 20  # iterations over long data that end far from the noise
_SHOWN = {"rad": (np.degrees(1.0), "deg")}


@dataclass(frozen=True, eq=False)
class OrbitSolution:
    """The joint estimate of one set of tracking data.

    Attributes:
        model: the prepared data.
        estimate: the engine's answer.
        rejected: number of measurements left out as outliers, by residual.
        status, why: the gravest word and its sentence.
        seconds: wall time.
    """

    model: OrbitModel
    estimate: Estimate
    rejected: dict[str, int]
    status: Status
    why: str
    seconds: float

    def _turn(self) -> np.ndarray:
        """Answer's frame from GCRS (3, 3)."""
        return np.eye(3) if self.model.settings.frame == "GCRF" else eme2000_from_gcrs()

    @property
    def frame(self) -> str:
        """Name of the answer's frame: EME2000 unless the settings say GCRF."""
        return "GCRF" if self.model.settings.frame == "GCRF" else "EME2000"

    @property
    def position(self) -> np.ndarray:
        """Position (3,) at the epoch, m."""
        return self._turn() @ self.estimate.values["position"]

    @property
    def velocity(self) -> np.ndarray:
        """Velocity (3,) at the epoch, m/s."""
        return self._turn() @ self.estimate.values["velocity"]

    @property
    def covariance(self) -> np.ndarray:
        """Covariance (6, 6) of position and velocity, m and m/s."""
        turn = np.kron(np.eye(2), self._turn())
        return turn @ self.estimate.covariance[:6, :6] @ turn.T

    def residuals(self) -> dict[str, dict[str, Any]]:
        """Count, root mean square, mean and standard deviation per station and component, and over all stations."""
        groups: dict[str, list[np.ndarray]] = {}
        units: dict[str, str] = {}
        for part, residual in zip(self.estimate.parts, self.estimate.problem.residuals, strict=True):
            kept = part.weight > 0
            for column, component in enumerate(COMPONENTS[residual.channel]):
                factor, unit = _SHOWN.get(residual.unit, (1.0, residual.unit))
                values = factor * part.residual[kept, column]
                for name in (f"{residual.name.split('/')[0]}/{component}", f"all/{component}"):
                    groups.setdefault(name, []).append(values)
                    units[name] = unit
        answer = {}
        for name, pieces in sorted(groups.items()):
            v = np.concatenate(pieces)
            answer[name] = {
                "count": len(v),
                "rms": float(np.sqrt(np.mean(v**2))) if len(v) else None,
                "unit": units[name],
                "mean": float(v.mean()) if len(v) else None,
                "standard_deviation": float(v.std()) if len(v) else None,
            }
        return answer

    def parameters(self) -> dict[str, dict[str, Any]]:
        """Every estimated number beside the state, with sigma and unit."""
        answer: dict[str, dict[str, Any]] = {}
        for u in self.estimate.unknowns:
            if u.name in ("position", "velocity"):
                continue
            values, sigma = self.estimate.values[u.name], self.estimate.sigma_of(u.name)
            units = _units(u.unit, len(values))
            for label, value, s, unit in zip(u.manifold.labels(), values, sigma, units, strict=True):
                name = u.name if len(values) == 1 else f"{u.name} {label}"
                answer[name] = {"value": float(value), "sigma": float(s), "unit": unit}
        return answer

    def effects(self) -> list[dict[str, Any]]:
        """The effects that were asked for, with their parameters."""
        found = []
        for e in chosen(self.model.layout, self.estimate.problem.effects):
            values, sigma = self.estimate.values[e.name], self.estimate.sigma_of(e.name)
            found.append(
                {
                    "name": e.name,
                    "parameters": {
                        p.name: {"value": float(v), "sigma": float(s), "unit": p.unit}
                        for p, v, s in zip(e.parameters, values, sigma, strict=True)
                    },
                }
            )
        return found

    def as_dict(self) -> dict[str, Any]:
        """The machine-readable answer."""
        return {
            "status": str(self.status),
            "why": self.why,
            "epoch": utc_text(self.model.epoch),
            "time_scale": "UTC",
            "frame": self.frame,
            "position_m": self.position,
            "velocity_m_s": self.velocity,
            "covariance": self.covariance,
            "parameters": self.parameters(),
            "residuals": self.residuals(),
            "effects": self.effects(),
            "chi2_per_dof": self.estimate.chi_square_per_degree(),
            "unobservable": [w.sentence for w in self.estimate.weak],
            "rejected": self.rejected,
            "iterations": self.estimate.iterations,
            "seconds": self.seconds,
        }

    def __str__(self) -> str:
        lines = [
            self.model.settings.title or self.model.tracking.satellite or "orbit",
            "",
            f"{self.status}: {self.why}",
            "",
            f"epoch {utc_text(self.model.epoch)}, {self.frame}",
        ]
        sigma = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        for label, v, s, unit in zip(
            ("x", "y", "z", "vx", "vy", "vz"),
            [*self.position, *self.velocity],
            sigma,
            ["m"] * 3 + ["m/s"] * 3,
            strict=True,
        ):
            lines.append(f"  {label:<4}{v:>20.4f}{s:>14.4g}  {unit}")
        lines += ["", f"{'parameter':<44}{'value':>16}{'sigma':>12}  unit"]
        lines += [f"{n:<44}{p['value']:>16.8g}{p['sigma']:>12.3g}  {p['unit']}" for n, p in self.parameters().items()]
        lines += ["", f"{'residual':<44}{'count':>8}{'rms':>14}  unit"]
        lines += [
            f"{n:<44}{r['count']:>8}{r['rms']:>14.6g}  {r['unit']}"
            for n, r in self.residuals().items()
            if r["rms"] is not None
        ]
        return "\n".join([*lines, "", f"{self.seconds:.2f} s"])


def _units(unit: str, size: int) -> list[str]:
    """One unit per number of an unknown whose unit text may list two kinds ("s, m/s")."""
    parts = [p.strip() for p in unit.split(",")]
    if len(parts) == 1:
        return parts * size
    if parts[0] == "s":
        return [parts[0]] + parts[1:] * (size - 1)
    half = size // len(parts)
    return [p for p in parts for _ in range(half)]


def mean_square(estimate: Estimate) -> float:
    """Mean whitened square of the measurements that carry weight."""
    total = sum(float(np.sum(p.weight[:, None] * p.whitened**2)) for p in estimate.parts)
    count = sum(p.measurements for p in estimate.parts)
    return total / max(count, 1.0)


def _horizon_of(model: OrbitModel, revolutions: float) -> float:
    """Time of some circular revolutions at the distance of the first position, s."""
    radius = float(np.linalg.norm(model.position))
    return revolutions * 2 * np.pi * float(np.sqrt(radius**3 / 3.986004418e14))  # m3/s2 of the Earth


def _disturbed(model: OrbitModel, estimate: Estimate) -> bool:
    """Whether the data span revolutions and most of them, not single ones, are far from the orbit."""
    if model.span[1] - model.span[0] < _horizon_of(model, _LONG):
        return False
    sizes = [np.abs(p.whitened[p.weight > 0]).ravel() for p in estimate.parts]
    size = float(np.median(np.concatenate(sizes)))
    return not size < _DISTURBED


def _within(problem: Problem, horizon: float) -> Problem:
    """The problem of the data up to ``horizon`` (s) from the epoch."""
    residuals = []
    for r in problem.residuals:
        assert isinstance(r, KernelResidual)
        keep = np.abs(r.time) <= horizon
        if keep.any():
            residuals.append(r.subset(keep))
    return problem.with_residuals(residuals)


def solve_from_far(problem: Problem, model: OrbitModel, options: Options | None = None) -> Estimate:
    """Solve from a start that may be far: directly, and where that ends far from the noise, over a growing horizon.

    Raises:
        GeometryError: the start itself meets the Earth.
    """
    options = options or Options()
    longest = max(abs(model.span[0]), abs(model.span[1]))
    patience = min(options.iterations, 60 if longest < _horizon_of(model, _LONG) else _PATIENCE)
    try:
        best = solve(problem, replace(options, iterations=patience))
    except InfeasibleError as error:
        given = model.settings.position is not None or model.settings.tle is not None
        raise GeometryError(
            f"the {'initial orbit' if given else 'first orbit that was found in the data'} meets the Earth",
            remedy="check the initial orbit and the scale of the times"
            if given
            else "check whether ranges are half or the sum of both legs (measurements.range), units, coordinates of "
            "stations and scale of times, or give an initial orbit",
        ) from error
    if best.status is not Status.NOT_CONVERGED and mean_square(best) < _FAR:
        return best
    horizon = _horizon_of(model, 0.1)
    values = dict(problem.start)
    while horizon < longest:
        part = _within(problem, horizon)
        if sum(r.samples * r.kernel.size for r in part.residuals if isinstance(r, KernelResidual)) >= 6:
            found = solve(part.starting_at(values), Options(tolerance=1e-3, iterations=25, largest_step=20.0))
            values = dict(found.values)
            if horizon > _horizon_of(model, _LONG) and _disturbed(model, found):
                # What a few revolutions do not fit, more of them will not: something happened to the orbit.
                return best
        horizon *= 2.5
    again = solve(problem.starting_at(values), replace(options, iterations=patience))
    return min(best, again, key=lambda e: sum(p.cost for p in e.parts))


def without_outliers(problem: Problem, estimate: Estimate, sigmas: float) -> tuple[Problem, dict[str, int]]:
    """The problem without samples beyond ``sigmas`` of the larger of declared and robustly measured spread."""
    residuals, rejected = [], {}
    for residual, part in zip(problem.residuals, estimate.parts, strict=True):
        assert isinstance(residual, KernelResidual)
        size = np.abs(part.whitened)
        spread = np.maximum(1.0, 1.4826 * np.median(size, axis=0))
        accepted = (size <= sigmas * spread).all(axis=1)
        if not accepted.all():
            rejected[residual.name] = int((~accepted).sum())
        residuals.append(replace(residual, accepted=accepted))
    return problem.with_residuals(residuals), rejected


def solve_tracking(
    tracking: Tracking,
    settings: OrbitSettings,
    *,
    effects: Sequence[str] = (),
    loss: Loss | None = None,
    options: Options | None = None,
) -> OrbitSolution:
    """Solve the joint problem of tracking data.

    Args:
        tracking: the observations.
        settings: checked settings.
        effects: names of effects to estimate with everything else.
        loss: robust loss; default quadratic.
        options: of the Gauss-Newton solver.

    Raises:
        InputError: data that cannot be used; see :mod:`estimator.models.errors`.
    """
    began = time.perf_counter()
    model = orbit_model(tracking, settings, loss=loss)
    problem = orbit_problem(model, effects)
    estimate = solve_from_far(problem, model, options)
    rejected: dict[str, int] = {}
    for _ in range(4):
        if not np.isfinite(settings.rejection) or _disturbed(model, estimate):
            break
        screened, found = without_outliers(problem, estimate, settings.rejection)
        if found == rejected:
            break
        rejected = found
        estimate = solve(screened.starting_at(estimate.values), options)
    return concluded(model, estimate, rejected, time.perf_counter() - began)


def concluded(model: OrbitModel, estimate: Estimate, rejected: dict[str, int], seconds: float) -> OrbitSolution:
    """Add to the engine's verdict what the orbit itself tells: below the ground, a station that does not fit."""
    status, why = estimate.status, [estimate.why]
    position, velocity = estimate.values["position"], estimate.values["velocity"]
    radius, speed = float(np.linalg.norm(position)), float(np.linalg.norm(velocity))
    energy = speed**2 / 2 - 3.986004418e14 / radius  # m2/s2, with m3/s2 of the Earth
    if energy >= 0:
        status = max(status, Status.MODEL_GAP, key=lambda s: s.gravity)
        why.append("the solution is no closed orbit: check stations, units and time scale")
    elif model.settings.position is not None or model.settings.tle is not None:
        shift = shifted_times(model, position, velocity)
        if shift:
            status = max(status, Status.MODEL_GAP, key=lambda s: s.gravity)
            why.append(shift)
    if status in (Status.MODEL_GAP, Status.NOT_CONVERGED) and status is estimate.status:
        suspected = estimate
        if _disturbed(model, estimate):
            # Over weeks manoeuvres hide a station at a wrong place; a few revolutions show it, and sooner.
            early = _within(estimate.problem.starting_at(orbit_problem(model, estimate.problem.effects).start),
                            _horizon_of(model, _LONG))
            suspected = solve(early, Options(iterations=_PATIENCE))
        why += suspicious_stations(model, suspected)
    if status in (Status.MODEL_GAP, Status.NOT_CONVERGED) and energy < 0 and not estimate.problem.effects:
        axis = -3.986004418e14 / (2 * energy)
        turns = (model.span[1] - model.span[0]) / (2 * np.pi * np.sqrt(axis**3 / 3.986004418e14))
        if turns > 3.0:
            why.append(
                f"the data span {turns:.0f} revolutions, in which the satellite may have manoeuvred: "
                "boresight orbit explain looks for manoeuvres and for everything else that the model misses"
            )
    if rejected:
        total = sum(rejected.values())
        why.append(
            f"{total} measurements lie far from all others and were left out ("
            + ", ".join(f"{n}: {c}" for n, c in rejected.items())
            + ")"
        )
        measured = sum(r.samples for r in estimate.problem.residuals if isinstance(r, KernelResidual))
        if total > 0.2 * measured:
            status = max(status, Status.MODEL_GAP, key=lambda s: s.gravity)
    return OrbitSolution(model, estimate, rejected, status, ". ".join(w for w in why if w), seconds)
