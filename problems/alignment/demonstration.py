"""The main job where the truth is known: one simulated campaign, solved by every method, errors side by side.

:func:`compared` turns a solution and the truth into errors per quantity; :func:`demonstrate` is ``boresight demo``.

Five quantities are compared: rotations by the angle of the rotation that is left between estimate and truth, two
ratios of principal moments by their difference, the principal axes by the angle between both triads. The Cramer-Rao
bound of each is the root of the trace of the joint estimate's covariance of the same quantity, so a method at the bound
has errors of about one sigma. It is the bound of the joint model: the attitude of each Doppler epoch is known from the
star tracker's sample there and from nothing else.
"""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from estimator.models.errors import RequestError
from estimator.models.files import written_atomically
from estimator.models.inertia import entries_of, matrix_of
from problems.alignment.attitude_at_epochs import attitude_at_epochs
from problems.alignment.campaign import Campaign
from problems.alignment.closed_form import ClosedFormEstimate, closed_form
from problems.alignment.simulation.truth import Truth
from problems.alignment.solution import AlignmentSolution, solve_campaign
from problems.alignment.starting_point import earth_fixed_from_inertial, quaternion_of, velocity_from_beams, wahba
from problems.console import jsonable

ARCSECOND = np.pi / 648000.0  # rad
COPLANAR = 0.01  # reciprocal condition of three beams below which they give no velocity
ELLIPSOID_LEVEL = 0.9973  # probability inside three standard deviations of one normal variable

METHODS = {
    "joint": "joint estimate",
    "linear": "Wahba, momentum, polar",
    "closed_form": "closed form, corrected",
    "closed_form_literal": "closed form, as printed",
}
"""The methods by key and by what tables and figures call them."""


@dataclass(frozen=True)
class Quantity:
    """One compared quantity.

    Attributes:
        name: in words.
        unit: of the numbers.
        bound: Cramer-Rao standard deviation, or None where the joint estimate does not determine the quantity.
        errors: absolute error against the truth by method; None where the method gives nothing.
    """

    name: str
    unit: str
    bound: float | None
    errors: Mapping[str, float | None]

    def ratio(self, method: str) -> float | None:
        """Error over the bound."""
        error = self.errors.get(method)
        return None if error is None or not self.bound else error / self.bound


@dataclass(frozen=True)
class Block:
    """Whether the truth lies in the three-sigma ellipsoid of one unknown of the joint estimate.

    Attributes:
        name: of the unknown.
        labels, unit: of its tangent directions.
        deviation: (n,) truth minus estimate over sigma, one for each direction.
        chi2: squared distance of the truth in the metric of the covariance.
        limit: three-sigma limit of ``chi2`` for this number of directions.
    """

    name: str
    labels: tuple[str, ...]
    unit: str
    deviation: np.ndarray
    chi2: float
    limit: float

    @property
    def inside(self) -> bool:
        return self.chi2 <= self.limit


@dataclass(frozen=True)
class Comparison:
    """Errors of every method on one campaign: ``quantities`` of all methods, ``blocks`` of the joint estimate."""

    quantities: tuple[Quantity, ...]
    blocks: tuple[Block, ...]


def rotation_left(estimate: np.ndarray | None, truth: np.ndarray) -> float | None:
    """Angle (rad) of the rotation between two quaternions; None without a finite estimate."""
    if estimate is None or not np.all(np.isfinite(estimate)):
        return None
    a, b = (Rotation.from_quat(q, scalar_first=True) for q in (estimate, truth))
    return float((b * a.inv()).magnitude())


def moment_ratios(tensor: np.ndarray) -> np.ndarray:
    """Second and third principal moment over the largest (2,)."""
    moments = np.linalg.eigvalsh(tensor)
    return np.asarray(moments[1::-1] / moments[2])


def axes_left(tensor: np.ndarray, truth: np.ndarray) -> float:
    """Angle (rad) between the principal triads of two tensors, moments in order of size, signs of axes as they fit."""
    a, b = (np.linalg.eigh(t)[1] for t in (tensor, truth))
    angles = []
    for signs in itertools.product((1.0, -1.0), repeat=3):
        turned = a * signs
        if np.linalg.det(turned) * np.linalg.det(b) > 0:
            angles.append(Rotation.from_matrix(turned @ b.T).magnitude())
    return float(min(angles))


def inertia_bounds(tensor: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, float]:
    """Standard deviations of both moment ratios (2,) and of the axes (rad, all three together), to first order.

    Args:
        tensor: (3, 3) normalized inertia.
        covariance: (6, 6) of its entries (xx, yy, zz, xy, xz, yz).
    """
    moments, axes = np.linalg.eigh(tensor)
    slopes = np.zeros((5, 6))  # two ratios, then three small rotations of the principal axes
    for column in range(6):
        change = np.asarray(matrix_of(ca.DM(np.eye(6)[column])))
        inner = axes.T @ change @ axes
        for row, (i, k) in enumerate(((1, 2), (0, 2))):
            slopes[row, column] = inner[i, i] / moments[k] - moments[i] / moments[k] ** 2 * inner[k, k]
        for row, (i, j) in enumerate(((0, 1), (0, 2), (1, 2))):
            slopes[2 + row, column] = inner[i, j] / (moments[j] - moments[i])
    spread = slopes @ covariance @ slopes.T
    return np.sqrt(np.diag(spread)[:2]), float(np.sqrt(np.trace(spread[2:, 2:])))


def _chi2(solution: AlignmentSolution, name: str, truth: np.ndarray) -> Block | None:
    """How the truth of an unknown sits in the joint estimate's covariance; None where it is not determined."""
    unknown = next((u for u in solution.estimate.unknowns if u.name == name), None)
    if unknown is None or not np.all(np.isfinite(solution.estimate.sigma_of(name))):
        return None
    covariance = solution.estimate.covariance_of(name)
    error = unknown.manifold.local(np.asarray(solution.estimate.values[name]), truth)
    return Block(name, unknown.manifold.labels(), unknown.unit, error / np.sqrt(np.diag(covariance)),
                 float(error @ np.linalg.solve(covariance, error)), float(chi2.ppf(ELLIPSOID_LEVEL, len(error))))


def compared(solution: AlignmentSolution, truth: Truth,
             others: Mapping[str, LinearEstimate | ClosedFormEstimate]) -> Comparison:
    """Errors of the joint estimate and of other methods against the truth.

    Args:
        solution: the joint estimate.
        truth: of the same campaign.
        others: results of other methods by key, see ``METHODS``.
    """
    methods: dict[str, Any] = {"joint": solution, **others}
    estimate = solution.estimate
    quantities = []
    rotations = (("antenna", "antenna_from_tracker", truth.antenna_from_tracker),
                 ("actuator", "actuator_from_tracker", truth.actuator_from_tracker))
    blocks = [_chi2(solution, "antenna_from_tracker", truth.antenna_from_tracker),
              _chi2(solution, "normalized_inertia", entries_of(truth.normalized_inertia)),
              _chi2(solution, "actuator_from_tracker", truth.actuator_from_tracker)]
    determined = {b.name for b in blocks if b is not None}
    for words, name, value in rotations:
        bound = float(np.sqrt(np.trace(estimate.covariance_of(name)))) if name in determined else None
        left = {key: rotation_left(getattr(m, name), value) for key, m in methods.items()}
        quantities.append(Quantity(f"{words} rotation", "arcsec",
                                   None if bound is None else bound / ARCSECOND,
                                   {k: None if e is None else e / ARCSECOND for k, e in left.items()}))
    tensors = {k: t for k, m in methods.items() if (t := m.normalized_inertia) is not None and np.all(np.isfinite(t))}
    bounds: tuple[np.ndarray, float] | None = None
    covariance = solution.inertia_covariance()
    if covariance is not None and "normalized_inertia" in determined:
        bounds = inertia_bounds(tensors["joint"], covariance)
    true_ratios = moment_ratios(truth.normalized_inertia)
    inertia = []
    for i, name in enumerate(("moment ratio J2/J1", "moment ratio J3/J1")):
        left = {k: float(abs(moment_ratios(tensors[k])[i] - true_ratios[i])) if k in tensors else None for k in methods}
        inertia.append(Quantity(name, "1", None if bounds is None else float(bounds[0][i]), left))
    turned = {k: axes_left(tensors[k], truth.normalized_inertia) / ARCSECOND if k in tensors else None for k in methods}
    inertia.append(Quantity("principal axes", "arcsec",
                            None if bounds is None else bounds[1] / ARCSECOND, turned))
    return Comparison((quantities[0], *inertia, quantities[1]), tuple(b for b in blocks if b is not None))


def trajectory_errors(solution: AlignmentSolution, truth: Truth) -> tuple[float, float]:
    """RMS error of the estimated Earth-fixed position (m) and velocity (m/s), per axis, over the whole campaign."""
    residual = solution.estimate.problem.residuals[0]
    sampled = solution.model.campaign.gnss.time
    grid = np.linspace(sampled[0], sampled[-1], 2001)
    true = truth.trajectory(grid)
    errors = []
    for derivative in (0, 1):
        signal = residual.signal("values", grid, derivative)  # type: ignore[attr-defined]
        estimated, _ = signal.evaluate(solution.estimate.values)
        errors.append(float(np.sqrt(np.mean((estimated - true[derivative]) ** 2))))
    return errors[0], errors[1]


@dataclass(frozen=True)
class LinearEstimate:
    """What the linear methods give; None where the campaign has no data for it.

    Attributes:
        antenna_from_tracker: (4,) Wahba's solution over all Doppler epochs, equal weights, each with the attitude that
            was measured there.
        actuator_from_tracker: (4,) by polar decomposition of the map from command to torque.
        normalized_inertia: (3, 3) from the constancy of the angular momentum.
    """

    antenna_from_tracker: np.ndarray | None
    actuator_from_tracker: np.ndarray | None
    normalized_inertia: np.ndarray | None


def linear_estimate(solution: AlignmentSolution) -> LinearEstimate:
    """The linear methods on the campaign of a joint estimate.

    The antenna is not taken from the starting point of the joint estimate, because that smooths the attitude over a
    session: it knows more than the joint model, in which every epoch has an attitude of its own.
    """
    start, known = solution.model.start, solution
    return LinearEstimate(
        _wahba(solution) if known.antenna_from_tracker is not None else None,
        start.actuator_from_tracker if known.actuator_from_tracker is not None else None,
        start.normalized_inertia if known.normalized_inertia is not None else None,
    )


def _wahba(solution: AlignmentSolution) -> np.ndarray | None:
    campaign, index = solution.model.campaign, solution.model.doppler_epochs
    doppler = campaign.doppler
    if doppler is None or doppler.frequency_shift.shape[1] < 3:
        return None
    time = doppler.time[index]
    attitude = attitude_at_epochs(campaign.star_tracker, doppler.time).quaternion[index]
    fixed_from_inertial = earth_fixed_from_inertial(campaign, time)
    inertial = fixed_from_inertial.inv().apply(solution.model.velocity(time))
    in_tracker = Rotation.from_quat(attitude, scalar_first=True).apply(inertial)
    in_antenna, reciprocal = velocity_from_beams(doppler, index)
    good = np.all(np.isfinite(in_antenna), axis=1) & (reciprocal > COPLANAR)
    if np.sum(good) < 2:
        return None
    return quaternion_of(wahba(in_antenna[good], in_tracker[good], np.ones(int(np.sum(good)))))


def all_methods(campaign: Campaign, truth: Truth) -> tuple[AlignmentSolution, Comparison]:
    """The joint estimate of a campaign and the errors of every method."""
    solution = solve_campaign(campaign)
    return solution, compared(solution, truth, {
        "linear": linear_estimate(solution),
        "closed_form": closed_form(campaign, "corrected"),
        "closed_form_literal": closed_form(campaign, "literal"),
    })


def demonstrate(out: Path, *, seed: int = 7, preset_name: str = "reference",
                say: Callable[[str], None] = lambda what: None) -> tuple[dict[str, Any], str]:
    """Simulate a campaign, solve it by every method, and write campaign, truth, answer, table and plots into ``out``.

    Args:
        out: directory, made if need be.
        seed: of the simulated campaign.
        preset_name: of the simulator.
        say: told what is being done, five times.

    Returns:
        The machine-readable result and the table for people.

    Raises:
        RequestError: an unknown preset, a negative seed, or a directory that cannot be written.
    """
    from problems.alignment import figures
    from problems.alignment.simulator import preset, simulate
    from problems.readers.campaign_file import write_campaign

    began = time.perf_counter()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RequestError("the directory cannot be made", where="--out", value=str(out),
                           remedy="choose a directory that can be written") from error
    say("simulating")
    campaign, truth = simulate(preset(preset_name), seed)
    say("solving")
    solution, comparison = all_methods(campaign, truth)
    say("comparing")
    result = _result(solution, comparison, trajectory_errors(solution, truth))
    result["preset"], result["seed"] = preset_name, seed
    say("drawing")
    drawn = {
        "residuals.png": figures.residual_figure(solution),
        "errors_in_sigma.png": figures.deviation_figure(comparison),
        "methods.png": figures.method_figure([comparison]),
    }
    for name, figure in drawn.items():
        figures.save(figure, out / name)
    say("writing")
    write_campaign(campaign, out / "campaign.nc")
    table = _table(result, solution)
    texts = {
        "campaign.truth.json": json.dumps(jsonable(truth.to_json()), indent=1, allow_nan=False),
        "answer.json": json.dumps(jsonable(solution.as_dict()), indent=1, allow_nan=False),
        "table.txt": table,
    }
    for name, text in texts.items():
        with written_atomically(out / name) as temporary:
            temporary.write_text(text + "\n", encoding="utf-8")
    result["files"] = [str(out / name) for name in ("campaign.nc", *texts, *drawn)]
    result["seconds"] = time.perf_counter() - began
    return result, table + "\n\nwritten: " + ", ".join(result["files"])


def _result(solution: AlignmentSolution, comparison: Comparison, trajectory: tuple[float, float]) -> dict[str, Any]:
    outside = [b for b in comparison.blocks if not b.inside]
    status, why = str(solution.status), [solution.why]
    if outside:
        status = status if status == "not_converged" else "model_gap"
        why.append("the truth lies outside the three-sigma ellipsoid of "
                   + ", ".join(f"{b.name} (chi2 {b.chi2:.1f}, limit {b.limit:.1f})" for b in outside))
    elif comparison.blocks:
        why.append("the truth lies inside the three-sigma ellipsoid of "
                   + ", ".join(b.name for b in comparison.blocks))
    answer = solution.as_dict()
    return {
        "status": status,
        "why": "; ".join(why),
        "quantities": [
            {"name": q.name, "unit": q.unit, "cramer_rao_sigma": q.bound,
             **{key: {"error": q.errors[key], "error_over_sigma": q.ratio(key)} for key in METHODS}}
            for q in comparison.quantities
        ],
        "ellipsoids": {b.name: {"chi2": b.chi2, "degrees": len(b.deviation), "limit": b.limit, "inside": b.inside}
                       for b in comparison.blocks},
        "trajectory": {**answer["trajectory"], "position_error_m": trajectory[0], "velocity_error_m_s": trajectory[1]},
        "unobservable": answer["unobservable"],
        "residuals": answer["residuals"],
    }


def _number(value: float | None, width: int) -> str:
    return f"{'-' if value is None else format(value, '.3g'):>{width}}"


def _ratio(value: float | None) -> str:
    return " " * 10 if value is None else f"{f'({value:.2f})' if value < 1000 else f'({value:.1e})':>10}"


def _table(result: dict[str, Any], solution: AlignmentSolution) -> str:
    """Errors per quantity and method, the truth in the ellipsoids, the residuals per channel."""
    heads = ("joint", "linear", "closed form", "as printed")
    lines = [f"{result['status']}: {result['why']}", "",
             f"{'error against the truth':<24}{'unit':<8}{'sigma':>9}" + "".join(f"{h:>19}" for h in heads)]
    for q in result["quantities"]:
        cells = "".join(_number(q[key]["error"], 9) + _ratio(q[key]["error_over_sigma"]) for key in METHODS)
        lines.append(f"{q['name']:<24}{q['unit']:<8}{_number(q['cramer_rao_sigma'], 9)}{cells}")
    lines += ["in brackets: error over sigma, which is the Cramer-Rao bound; linear: Wahba, momentum, polar",
              "decomposition; closed form: the published formulas, corrected and as printed", "",
              f"{'truth in covariance':<24}{'degrees':>8}{'chi2':>9}{'limit (3 sigma)':>19}"]
    for name, block in result["ellipsoids"].items():
        lines.append(f"{name:<24}{block['degrees']:>8}{block['chi2']:>9.2f}{block['limit']:>19.2f}"
                     f"  {'inside' if block['inside'] else 'OUTSIDE'}")
    lines += ["", f"{'residuals, joint':<24}{'unit':<8}{'rms':>9}{'chi2/dof':>12}{'deviation':>17}"]
    for summary in solution.estimate.summaries:
        consistency = summary.consistency
        lines.append(f"{summary.name:<24}{summary.unit:<8}{_number(summary.rms, 9)}{consistency.ratio:>12.4f}"
                     f"{consistency.deviation:>+11.1f} sigma")
    trajectory = result["trajectory"]
    lines += ["", f"trajectory: degree {trajectory['degree']}, error {trajectory['position_error_m']:.3g} m and "
                  f"{trajectory['velocity_error_m_s']:.3g} m/s (RMS per axis)"]
    if result["unobservable"]:
        lines += ["", "not determined by the data:", *(f"  {u}" for u in result["unobservable"])]
    return "\n".join(lines)
