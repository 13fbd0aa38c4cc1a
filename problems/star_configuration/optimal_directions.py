"""The best directions for the whole attitude (K0) or for one axis (K1), by CasADi and IPOPT from several starts.

The problem is written with one small block per direction, so that its cost grows linearly with their number:

    minimise    trace(A P),  P = (L L^T)^-1,  A = I for K0 and I - V V^T for K1
    over        directions b_i (3 each), lower triangular L (3 x 3, positive diagonal)
    subject to  L L^T = (1/N) sum_i M_i(b_i) + fixed,   |b_i| = 1
                cos(maximum angle) <= b_i . b_j <= cos(minimum angle)   between sensors, fixed ones included
                |b_i . b_j| <= cos(angle limit)                         the paper's bound, on the angle of the lines
                b_i . k <= cos(half angle)                              keep-out cones (Sun, Earth, Moon, structure)
                |b_i . V| <= cos(axis clearance)                        distance from the axis of K1, both sides

Holding the information as ``L L^T`` keeps it positive definite along the whole iteration. Rotations that leave the
problem as it is are fixed: for K0 without fixed sensors and cones the first direction is +z and the second lies in the
x-z plane; for K1 without them the first direction lies in one half-plane through the axis.

K1 has no minimum where directions may come as close to the axis as they like: it falls to 1/N while the turn about the
axis is lost. Without any limit that keeps them apart the axis clearance is ``DEFAULT_AXIS_CLEARANCE``.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import combinations
from typing import Any

import casadi as ca
import numpy as np

from estimator.models.errors import InfeasibleError, RequestError
from problems.star_configuration import criteria
from problems.star_configuration.closed_form import least_K0_beside_fixed, least_K0_unequal, limit_K1

DEFAULT_AXIS_CLEARANCE = 0.01  # rad
"""Half-angle of the cone about the axis that K1 keeps free where no limit keeps the directions apart."""

_PROVEN = 1e-11
"""Relative distance to a bound at which a value counts as having reached it."""

LARGEST_COUNT = 2000
"""Directions in one problem; a larger number is a slip of the keyboard."""

_OPTIONS: dict[str, Any] = {
    "print_time": False,
    "error_on_fail": False,
    "ipopt": {
        "print_level": 0,
        "sb": "yes",
        "tol": 1e-11,
        "constr_viol_tol": 1e-12,
        "acceptable_tol": 1e-9,
        "max_iter": 300,
        "mu_strategy": "monotone",
        "bound_relax_factor": 0.0,
    },
}


@dataclass(frozen=True)
class KeepOut:
    """A cone that no sensor may look into.

    Attributes:
        direction: axis of the cone (3, unit), in the frame of its user (body axes for directions on board, inertial
            axes for the real sky).
        half_angle: half-angle (rad); above pi/2 the cone is more than half of the sphere (the Earth from a low orbit).
        name: what it is: "Sun", "Earth limb", "Moon", "solar array".
    """

    direction: tuple[float, float, float]
    half_angle: float
    name: str = "cone"

    def __post_init__(self) -> None:
        unit = criteria.unit_vectors(self.direction, f"keep-out {self.name}")[0]
        object.__setattr__(self, "direction", tuple(float(x) for x in unit))
        if not 0 <= self.half_angle < np.pi:
            raise RequestError(
                "the half-angle of a keep-out cone is out of range",
                where=f"keep-out {self.name}",
                value=f"{self.half_angle} rad",
                limit="0 to pi",
                remedy="give it in radians",
            )


def _tuples(value: Any) -> Any:
    """Lists and arrays as tuples all the way down, so that a request can be hashed."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    return tuple(_tuples(v) for v in value) if isinstance(value, list | tuple) else value


@dataclass(frozen=True)
class Request:
    """What is asked for.

    Attributes:
        count: number of directions to find.
        criterion: "K0" or "K1".
        axis: body axis of K1 (3).
        sigma: total accuracy of a direction, one number or one per direction (any unit: the criteria are in its
            square).
        two_axis_sigma: instead of ``sigma``, standard deviations (count x 2) along the two axes of each sensor; the
            turn of the sensor about its line of sight is then optimised too.
        minimum_angle, maximum_angle: limits (rad) on the angle between any two sensors.
        angle_limit: least angle (rad) between any two LINES of sight: ``|c_ij| <= cos(angle_limit)``.
        keep_outs: cones in body axes.
        fixed: directions (m x 3) of sensors already on board, and ``fixed_sigma`` their total accuracy.
        axis_clearance: least angle (rad) of a direction from the axis line, for K1; None for the default.
    """

    count: int
    criterion: str = "K0"
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    sigma: float | tuple[float, ...] = 1.0
    two_axis_sigma: tuple[tuple[float, float], ...] | None = None
    minimum_angle: float | None = None
    maximum_angle: float | None = None
    angle_limit: float | None = None
    keep_outs: tuple[KeepOut, ...] = ()
    fixed: tuple[tuple[float, float, float], ...] = ()
    fixed_sigma: float | tuple[float, ...] = 1.0
    axis_clearance: float | None = None

    def __post_init__(self) -> None:
        for name in ("sigma", "fixed_sigma", "two_axis_sigma", "keep_outs", "fixed"):
            object.__setattr__(self, name, _tuples(getattr(self, name)))
        if not 1 <= self.count <= LARGEST_COUNT:
            raise RequestError(
                "the number of directions is out of range", where="N", value=self.count, limit=f"1 to {LARGEST_COUNT}"
            )
        if self.criterion not in ("K0", "K1"):
            raise RequestError("unknown criterion", where="criterion", value=self.criterion, limit="K0 or K1")
        axis = criteria.unit_vectors(self.axis, "axis")
        if len(axis) != 1:
            raise RequestError("one axis is needed", where="axis", value=f"{len(axis)} vectors", limit="1")
        object.__setattr__(self, "axis", tuple(float(x) for x in axis[0]))
        if len(self.fixed):
            rows = criteria.unit_vectors(self.fixed, "fixed")
            object.__setattr__(self, "fixed", tuple(tuple(float(x) for x in row) for row in rows))
        for name in ("minimum_angle", "maximum_angle", "angle_limit", "axis_clearance"):
            value = getattr(self, name)
            top = np.pi if name.startswith("m") else np.pi / 2
            if value is not None and not 0 <= value <= top:
                raise RequestError(
                    "an angle is out of range",
                    where=name,
                    value=f"{value} rad",
                    limit=f"0 to {top:.4f} rad",
                    remedy="angles are in radians here",
                )
        for name, number in (("sigma", self.count), ("fixed_sigma", len(self.fixed))):
            values = np.atleast_1d(np.asarray(getattr(self, name), dtype=float))
            if values.size not in (1, number) or not np.all(np.isfinite(values)) or np.any(values <= 0):
                raise RequestError(
                    "accuracies are positive numbers, one for all or one for each",
                    where=name,
                    value=getattr(self, name),
                    limit=f"1 or {number} values above 0",
                )
        if self.two_axis_sigma is not None:
            pairs = np.asarray(self.two_axis_sigma, dtype=float)
            if pairs.shape != (self.count, 2) or not np.all(np.isfinite(pairs)) or np.any(pairs <= 0):
                raise RequestError(
                    "two positive accuracies are needed for each direction",
                    where="two_axis_sigma",
                    value=f"shape {pairs.shape}",
                    limit=f"({self.count}, 2)",
                )

    @property
    def clearance(self) -> float:
        """The axis clearance in force (rad): zero for K0 and where the angle limit already keeps directions apart."""
        if self.criterion == "K0":
            return 0.0
        if self.axis_clearance is not None:
            return self.axis_clearance
        return 0.0 if self.angle_limit else DEFAULT_AXIS_CLEARANCE

    @property
    def isotropic(self) -> bool:
        """No fixed sensor and no cone singles out a direction."""
        return not self.fixed and not self.keep_outs


@dataclass(frozen=True)
class Configuration:
    """An answer: directions and what they tell about the attitude.

    Attributes:
        status: "ok", "unobservable" or "not_converged"; ``why`` is the sentence.
        directions: (count x 3), unit, body axes; without the fixed sensors.
        first_axes: (count x 3) first measuring axes of two-axis sensors, else None.
        K0, K1: criteria of all sensors, the fixed ones included, in units of sigma squared; infinite if undetermined.
        covariance: attitude covariance (3 x 3), None if singular.
        unobservable: body axes (k x 3) about which a rotation is not seen.
        value: the criterion that was minimised.
        starts, converged, agreeing: number of starts, of those that converged, and of those that reached the same least
            value (to 1e-9 of it).
        seconds: time taken.
    """

    status: str
    why: str
    directions: np.ndarray
    first_axes: np.ndarray | None
    K0: float
    K1: float
    axis: np.ndarray
    covariance: np.ndarray | None
    unobservable: np.ndarray
    value: float
    starts: int
    converged: int
    agreeing: int
    seconds: float
    request: Request = field(repr=False)

    def __str__(self) -> str:
        head = f"{self.request.criterion}: {self.status}. {self.why}\n"
        head += f"K0 = {self.K0:.12g}  K1 = {self.K1:.12g}  (sigma = 1)"
        rows = [f"{i + 1:4d}  {x:+.12f}  {y:+.12f}  {z:+.12f}" for i, (x, y, z) in enumerate(self.directions)]
        return "\n".join([head, "   #        x                y                z", *rows])


def _two_axis(request: Request) -> np.ndarray | None:
    """Accuracy pairs (count x 2) where a sensor really has two different ones, else None."""
    if request.two_axis_sigma is None:
        return None
    pairs = np.asarray(request.two_axis_sigma, dtype=float)
    return pairs if np.any(pairs[:, 0] != pairs[:, 1]) else None


def _sigmas(request: Request) -> np.ndarray:
    """Total accuracy (count) of each direction."""
    if request.two_axis_sigma is not None:
        return np.linalg.norm(np.asarray(request.two_axis_sigma, dtype=float), axis=1)
    return np.broadcast_to(np.asarray(request.sigma, dtype=float), (request.count,)).copy()


def _fixed_information(request: Request) -> np.ndarray:
    """Information (3 x 3) of the sensors already on board."""
    if not request.fixed:
        return np.zeros((3, 3))
    sigma = np.broadcast_to(np.asarray(request.fixed_sigma, dtype=float), (len(request.fixed),))
    return np.array(ca.DM(criteria.information(ca.DM(np.array(request.fixed).T), ca.DM(sigma))))


def total_information(request: Request, directions: np.ndarray, first_axes: np.ndarray | None = None) -> np.ndarray:
    """Information (3 x 3) of the directions (count x 3) with the fixed sensors of the request."""
    total = _fixed_information(request)
    pairs = _two_axis(request)
    if pairs is None or first_axes is None:
        new = criteria.information(ca.DM(directions.T), ca.DM(_sigmas(request)))
        return total + np.array(ca.DM(new))
    for b, u, (first, second) in zip(directions, first_axes, pairs, strict=True):
        total = total + np.array(ca.DM(criteria.two_axis_information(ca.DM(b), ca.DM(u), first, second)))
    return total


@dataclass(frozen=True)
class _Program:
    """The nonlinear program of a request: solver, bounds, and how a start is laid into its variables."""

    solver: ca.Function
    lower: np.ndarray
    upper: np.ndarray
    constraint_lower: np.ndarray
    constraint_upper: np.ndarray
    scale: float


def _frame_of_axis(axis: np.ndarray) -> np.ndarray:
    """Rows (3 x 3): two unit vectors across ``axis`` and the axis."""
    helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
    first = np.cross(helper, axis)
    first /= np.linalg.norm(first)
    return np.vstack((first, np.cross(axis, first), axis))


def _cosine_limits(request: Request) -> tuple[float, float]:
    """Least and greatest cosine allowed between two directions."""
    most = 1.0 if request.minimum_angle is None else float(np.cos(request.minimum_angle))
    least = -1.0 if request.maximum_angle is None else float(np.cos(request.maximum_angle))
    if request.angle_limit is not None:
        most = min(most, float(np.cos(request.angle_limit)))
        least = max(least, -float(np.cos(request.angle_limit)))
    return least, most


def _all_pairs(request: Request) -> tuple[tuple[int, int], ...]:
    """Every pair of directions, and every pair of a direction and a fixed sensor."""
    total = request.count + len(request.fixed)
    return tuple((i, j) for i, j in combinations(range(total), 2) if i < request.count)


@lru_cache(maxsize=16)
def _program(request: Request, *, elastic: bool = False) -> _Program:
    """Build the nonlinear program; with ``elastic`` the least violation of its limits is minimised instead."""
    count = request.count
    pairs = _two_axis(request)
    sigmas = _sigmas(request)
    fixed = np.array(request.fixed).reshape(-1, 3)
    axis = np.array(request.axis)
    scale = float(np.mean(1 / sigmas**2)) * (count + len(fixed))

    b = ca.SX.sym("b", 3, count)
    u = ca.SX.sym("u", 3, count if pairs is not None else 0)
    diagonal = ca.SX.sym("d", 3)
    below = ca.SX.sym("l", 3)
    slack = ca.SX.sym("t", 1 if elastic else 0)
    margin = slack if elastic else 0

    if pairs is None:
        gathered = criteria.information(b, ca.DM(sigmas))
    else:
        gathered = ca.SX.zeros(3, 3)
        for i in range(count):
            gathered += criteria.two_axis_information(b[:, i], u[:, i], pairs[i, 0], pairs[i, 1])
    mean = (gathered + ca.DM(_fixed_information(request))) / scale

    rows: list[ca.SX] = []
    low: list[float] = []
    high: list[float] = []

    def require(expression: ca.SX, least: float, most: float) -> None:
        rows.append(expression)
        low.append(least)
        high.append(most)

    for i in range(count):
        require(ca.sumsqr(b[:, i]), 1, 1)
        if pairs is not None:
            require(ca.sumsqr(u[:, i]), 1, 1)
            require(ca.dot(u[:, i], b[:, i]), 0, 0)
    if not elastic:
        factor = ca.blockcat([[diagonal[0], 0, 0], [below[0], diagonal[1], 0], [below[1], below[2], diagonal[2]]])
        difference = factor @ factor.T - mean
        for i, j in ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2)):
            require(difference[i, j], 0, 0)

    least, most = _cosine_limits(request)

    def within(cosine: ca.SX, bottom: float, top: float) -> None:
        if top < 1:
            require(cosine - margin, -np.inf, top)
        if bottom > -1:
            require(cosine + margin, bottom, np.inf)

    if most < 1 or least > -1:
        known = [b[:, i] for i in range(count)] + [ca.DM(direction) for direction in fixed]
        for i, j in _all_pairs(request):
            within(ca.dot(known[i], known[j]), least, most)
    for cone in request.keep_outs:
        for i in range(count):
            within(ca.dot(b[:, i], ca.DM(cone.direction)), -1.0, float(np.cos(cone.half_angle)))
    if request.clearance > 0:
        bound = float(np.cos(request.clearance))
        for i in range(count):
            within(ca.dot(b[:, i], ca.DM(axis)), -bound, bound)

    turned = request.isotropic
    if turned and request.criterion == "K1":
        across = _frame_of_axis(axis)
        require(ca.dot(b[:, 0], ca.DM(across[1])), 0, 0)
        require(ca.dot(b[:, 0], ca.DM(across[0])), 0, np.inf)

    if elastic:
        objective = slack
    else:
        d0, d1, d2 = diagonal[0], diagonal[1], diagonal[2]
        inverse = ca.blockcat(
            [
                [1 / d0, 0, 0],
                [-below[0] / (d0 * d1), 1 / d1, 0],
                [(below[0] * below[2] - below[1] * d1) / (d0 * d1 * d2), -below[2] / (d1 * d2), 1 / d2],
            ]
        )
        objective = ca.sumsqr(inverse)
        if request.criterion == "K1":
            objective -= ca.sumsqr(inverse @ ca.DM(axis))

    parts = [ca.vec(b), ca.vec(u)] + ([slack] if elastic else [diagonal, below])
    variables = ca.vertcat(*parts)
    lower = np.full(variables.numel(), -np.inf)
    upper = np.full(variables.numel(), np.inf)
    lower[: 3 * count], upper[: 3 * count] = -1.5, 1.5
    if turned and request.criterion == "K0":
        lower[:2] = upper[:2] = 0
        lower[2] = 0
        if count > 1:
            lower[4] = upper[4] = 0
            lower[3] = 0
    if not elastic:
        lower[-6:-3] = 1e-6
    solver = ca.nlpsol("star_directions", "ipopt", {"x": variables, "f": objective, "g": ca.vertcat(*rows)}, _OPTIONS)
    return _Program(solver, lower, upper, np.array(low), np.array(high), scale)


def random_directions(count: int, generator: np.random.Generator) -> np.ndarray:
    """Directions (count x 3) spread evenly at random over the sphere."""
    rows = generator.standard_normal((count, 3))
    return rows / np.linalg.norm(rows, axis=1)[:, None]


def _fix_rotation(request: Request, directions: np.ndarray) -> np.ndarray:
    """Turn a start so that it meets the conditions that fix the symmetry."""
    if not request.isotropic:
        return directions
    if request.criterion == "K0":
        frame = _frame_of_axis(directions[0])
        turned = directions @ frame.T
        if len(turned) > 1:
            angle = np.arctan2(turned[1, 1], turned[1, 0])
            c, s = np.cos(angle), np.sin(angle)
            turned = turned @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]).T
        return turned
    frame = _frame_of_axis(np.array(request.axis))
    local = directions @ frame.T
    angle = np.arctan2(local[0, 1], local[0, 0])
    c, s = np.cos(angle), np.sin(angle)
    return local @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]).T @ frame


def _start(request: Request, program: _Program, directions: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Lay directions (count x 3) into the variables of the program."""
    turned = _fix_rotation(request, directions)
    pieces = [turned.reshape(-1)]
    axes = None
    if _two_axis(request) is not None:
        axes = np.cross(turned, random_directions(request.count, generator))
        axes /= np.linalg.norm(axes, axis=1)[:, None]
        pieces.append(axes.reshape(-1))
    mean = total_information(request, turned, axes) / program.scale
    factor = np.linalg.cholesky(mean + 1e-6 * np.eye(3))
    pieces += [np.diag(factor), factor[[1, 2, 2], [0, 0, 1]]]
    return np.concatenate(pieces)


@dataclass(frozen=True)
class LocalOptimum:
    """Where one start ended.

    Attributes:
        directions: (count x 3), unit; ``first_axes`` as in :class:`Configuration`.
        value: the criterion, recomputed from the directions.
        converged: the solver says so and every limit holds to 1e-8, or the value attains a proven bound; ``word`` is
            what the solver said.
        variables, multipliers, constraints: the solver's point, for second-order analysis.
    """

    directions: np.ndarray
    first_axes: np.ndarray | None
    value: float
    converged: bool
    word: str
    variables: np.ndarray
    multipliers: np.ndarray
    constraints: np.ndarray


def solve_from(request: Request, directions: np.ndarray, generator: np.random.Generator | None = None) -> LocalOptimum:
    """Minimise the criterion of a request from one start (count x 3); no second chance is taken."""
    program = _program(request)
    generator = generator or np.random.default_rng(0)
    start = _start(request, program, directions, generator)
    answer = program.solver(
        x0=start, lbx=program.lower, ubx=program.upper, lbg=program.constraint_lower, ubg=program.constraint_upper
    )
    statistics = program.solver.stats()
    x = np.array(answer["x"]).reshape(-1)
    rows = x[: 3 * request.count].reshape(-1, 3)
    length = np.linalg.norm(rows, axis=1)
    usable = bool(np.all(np.isfinite(x)) and np.all(length > 0.5))
    first_axes = None
    if usable:
        rows = rows / length[:, None]
        if _two_axis(request) is not None:
            first_axes = x[3 * request.count : 6 * request.count].reshape(-1, 3)
            first_axes = first_axes - np.sum(first_axes * rows, axis=1)[:, None] * rows
            first_axes /= np.linalg.norm(first_axes, axis=1)[:, None]
        found = criteria.criteria_of_information(total_information(request, rows, first_axes), request.axis)
        value = found.K0 if request.criterion == "K0" else found.K1
    else:
        value = np.inf
    # IPOPT may stop where rounding hides further progress; that point counts if every limit holds there.
    residual = np.array(answer["g"]).reshape(-1)
    violation = max(
        float(np.max(program.constraint_lower - residual, initial=0)),
        float(np.max(residual - program.constraint_upper, initial=0)),
    )
    word = str(statistics["return_status"])
    good = word in ("Solve_Succeeded", "Solved_To_Acceptable_Level") or (
        word == "Search_Direction_Becomes_Too_Small" and violation < 1e-9
    )
    good = bool(good and usable and violation < 1e-8)
    # On a flat family IPOPT may wander without end; directions that meet the limits and attain the bound are optimal
    # whatever the solver says.
    if usable and not good and value <= _bound(request) * (1 + _PROVEN):
        good = meets_limits(request, rows, 1e-9)
    return LocalOptimum(
        rows,
        first_axes,
        value,
        good,
        word,
        x,
        np.array(answer["lam_g"]).reshape(-1),
        residual,
    )


def _infeasibility(request: Request, generator: np.random.Generator, starts: int = 6) -> float:
    """Least excess (in the cosine) by which the limits of the request must be broken; zero if they can be met."""
    program = _program(request, elastic=True)
    least = np.inf
    for _ in range(starts):
        turned = _fix_rotation(request, random_directions(request.count, generator))
        pieces = [turned.reshape(-1)]
        if _two_axis(request) is not None:
            axes = np.cross(turned, random_directions(request.count, generator))
            pieces.append((axes / np.linalg.norm(axes, axis=1)[:, None]).reshape(-1))
        answer = program.solver(
            x0=np.concatenate([*pieces, [1.0]]),
            lbx=program.lower,
            ubx=program.upper,
            lbg=program.constraint_lower,
            ubg=program.constraint_upper,
        )
        if program.solver.stats()["success"]:
            least = min(least, float(answer["f"]))
        if least <= 0:
            return 0.0
    return least


def _starts(request: Request, number: int, generator: np.random.Generator) -> list[np.ndarray]:
    """Starts: at random for K0; for K1 packed lattices about the axis, then at random near it and anywhere."""
    found: list[np.ndarray] = []
    limit = request.angle_limit or request.minimum_angle
    if request.criterion == "K1" and limit:
        found = [_packed(request, limit, offset, generator) for offset in range(min(3, number))]
    for k in range(number - len(found)):
        rows = random_directions(request.count, generator)
        if request.criterion == "K1" and k % 2 == 0:
            # Near the axis, in both senses, as wide as the limits need.
            spread = max(request.clearance, (limit or 0) * np.sqrt(request.count) / 2, 0.02)
            rows = np.array(request.axis) + np.tan(min(spread, 1.2)) * rows
            rows /= np.linalg.norm(rows, axis=1)[:, None]
            if request.minimum_angle is not None or k % 4 == 0:
                rows *= generator.choice([-1.0, 1.0], size=request.count)[:, None]
        found.append(rows)
    return found


def _packed(request: Request, limit: float, offset: int, generator: np.random.Generator) -> np.ndarray:
    """A triangular lattice of spacing ``limit`` (rad) about the axis: the densest packing, slightly shaken.

    The three offsets put a lattice point, the middle of an edge, or the middle of a triangle on the axis. Where only
    the angle between directions counts, not that between lines, the two senses of the axis share the directions.
    """
    both = request.angle_limit is None and request.maximum_angle is None
    sides = [request.count - request.count // 2, request.count // 2] if both else [request.count]
    reach = int(np.sqrt(request.count)) + 3
    i, j = (a.reshape(-1) for a in np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1)))
    origin = np.array([(0.0, 0.0), (0.5, 0.0), (0.5, 0.5 / np.sqrt(3))][offset])
    points = np.column_stack((i + 0.5 * j, np.sqrt(0.75) * j)) - origin
    points = points[np.argsort(np.sum(points**2, axis=1), kind="stable")]
    across = _frame_of_axis(np.array(request.axis))
    rows = []
    for side, number in zip((1.0, -1.0), sides, strict=False):
        flat = 1.02 * limit * points[:number] + 0.02 * limit * generator.standard_normal((number, 2))
        angle = np.minimum(np.linalg.norm(flat, axis=1), 1.5)
        unit = flat / np.maximum(np.linalg.norm(flat, axis=1), 1e-12)[:, None]
        rows.append(side * np.cos(angle)[:, None] * across[2] + (np.sin(angle)[:, None] * unit) @ across[:2])
    return np.vstack(rows)


def _bound(request: Request) -> float:
    """A value that K0 cannot fall below, whatever the limits; zero where none is known."""
    if request.criterion != "K0" or _two_axis(request) is not None:
        return 0.0
    sigmas = _sigmas(request)
    if not request.fixed:
        return least_K0_unequal(sigmas)
    fixed = np.broadcast_to(np.asarray(request.fixed_sigma, dtype=float), (len(request.fixed),))
    if np.ptp(np.concatenate((sigmas, fixed))) == 0:
        return float(sigmas[0]) ** 2 * least_K0_beside_fixed(np.array(request.fixed), request.count)
    return 0.0


def meets_limits(request: Request, directions: np.ndarray, tolerance: float = 1e-7) -> bool:
    """Whether directions (count x 3) meet every limit of the request, to ``tolerance`` in the cosines."""
    cosines = directions @ directions.T
    first, second = np.triu_indices(len(directions), 1)
    pairs = cosines[first, second]
    if request.fixed:
        pairs = np.concatenate((pairs, (directions @ np.array(request.fixed).T).reshape(-1)))
    if request.minimum_angle is not None and np.any(pairs > np.cos(request.minimum_angle) + tolerance):
        return False
    if request.maximum_angle is not None and np.any(pairs < np.cos(request.maximum_angle) - tolerance):
        return False
    if request.angle_limit is not None and np.any(np.abs(pairs) > np.cos(request.angle_limit) + tolerance):
        return False
    if request.clearance > 0 and np.any(
        np.abs(directions @ np.array(request.axis)) > np.cos(request.clearance) + tolerance
    ):
        return False
    return all(
        np.all(directions @ np.array(c.direction) <= np.cos(c.half_angle) + tolerance) for c in request.keep_outs
    )


def _default_starts(request: Request) -> int:
    """Three where no worse local optimum is known to exist (K0 of plain sensors without limits), more elsewhere."""
    limits = (request.angle_limit, request.minimum_angle, request.maximum_angle)
    plain = request.isotropic and all(limit is None for limit in limits) and _two_axis(request) is None
    if request.criterion == "K0" and plain:
        return 3
    return 12 if request.count <= 30 else 6


def optimal_directions(request: Request, *, starts: int | None = None, seed: int = 0) -> Configuration:
    """The best directions of a request, the best of several starts.

    Args:
        request: see :class:`Request`.
        starts: number of starts; None for 3 for K0 without limits and 12 (6 above 30 directions) elsewhere, fewer once
            a start attains a bound below which nothing lies.
        seed: of the random starts; equal seeds give equal answers.

    Raises:
        InfeasibleError: the limits cannot be met; says by how much they miss.

    Example:
        >>> best = optimal_directions(Request(4))
        >>> best.status, abs(best.K0 - 9 / 16) < 1e-12
        ('ok', True)
    """
    began = time.perf_counter()
    axis = np.array(request.axis)
    if request.count + len(request.fixed) == 1:
        b = axis[None, :]
        if request.keep_outs:
            b = _free_direction(request)[None, :]
        found = criteria.criteria_of_information(total_information(request, b), axis)
        why = (
            "one direction does not determine the attitude: the rotation about the line of sight "
            f"({', '.join(f'{x:.6g}' for x in b[0])}) is not seen; sight two stars or more"
        )
        return Configuration(
            "unobservable",
            why,
            b,
            None,
            found.K0,
            found.K1,
            axis,
            None,
            found.unobservable,
            np.inf,
            0,
            0,
            0,
            time.perf_counter() - began,
            request,
        )
    number = starts if starts is not None else _default_starts(request)
    generator = np.random.default_rng(seed)
    bound = _bound(request)
    results: list[LocalOptimum] = []
    for start in _starts(request, number, generator):
        results.append(solve_from(request, start, generator))
        if starts is None and results[-1].converged and results[-1].value <= bound * (1 + _PROVEN):
            break  # no other start can do better
    number = len(results)
    good = [r for r in results if r.converged]
    if not good:
        excess = _infeasibility(request, generator)
        if excess > 1e-7:
            raise InfeasibleError(
                f"no {request.count} directions meet the limits: the closest try breaks one by {excess:.3g} in the "
                "cosine of an angle; relax the angle limits or the keep-out cones, or ask for fewer directions",
                limit="angles",
                excess=excess,
            )
        best = min(results, key=lambda r: r.value)
    else:
        best = min(good, key=lambda r: r.value)
    agreeing = sum(r.value <= best.value * (1 + 1e-9) for r in good)
    found = criteria.criteria_of_information(total_information(request, best.directions, best.first_axes), axis)
    status = "ok" if best.converged else "not_converged"
    if found.covariance is None:
        status = "unobservable"
    return Configuration(
        status,
        _sentence(request, status, best, len(good), number, agreeing, found),
        best.directions,
        best.first_axes,
        found.K0,
        found.K1,
        axis,
        found.covariance,
        found.unobservable,
        best.value,
        number,
        len(good),
        agreeing,
        time.perf_counter() - began,
        request,
    )


def _sentence(
    request: Request,
    status: str,
    best: LocalOptimum,
    converged: int,
    starts: int,
    agreeing: int,
    found: criteria.Criteria,
) -> str:
    """What happened, for the user."""
    if status == "not_converged":
        return (
            f"none of {starts} starts converged (the last word of the solver on the best: {best.word}); "
            "the directions are the best point that was reached"
        )
    if status == "unobservable":
        return "the directions allowed by the limits do not determine the attitude: a rotation about them is not seen"
    text = f"{agreeing} of {starts} start{'' if starts == 1 else 's'} reached this value"
    if best.value <= _bound(request) * (1 + _PROVEN):
        text += ", and no directions can have less (bound by majorization)"
    if converged < starts:
        text += f" ({starts - converged} did not converge)"
    if (
        request.criterion == "K1"
        and not request.fixed
        and len(set(np.atleast_1d(request.sigma))) == 1
        and request.two_axis_sigma is None
    ):
        sigma = float(np.atleast_1d(request.sigma)[0])
        limit = limit_K1(request.count) * sigma**2
        about = (
            float(np.array(request.axis) @ found.covariance @ np.array(request.axis))
            if found.covariance is not None
            else np.inf
        )
        text += (
            f"; K1 is {found.K1 / limit - 1:.3g} above its limit sigma^2/N = {limit:.6g}, which directions along the "
            f"axis approach and never attain; its price is a variance of {about:.6g} about the axis"
        )
        if request.clearance > 0:
            text += f" (directions kept {np.degrees(request.clearance):.4g} deg away from the axis)"
    return text


def _free_direction(request: Request) -> np.ndarray:
    """One direction (3) outside the keep-out cones, by the least violation.

    Raises:
        InfeasibleError: the cones cover the sphere.
    """
    generator = np.random.default_rng(0)
    rows = np.vstack((np.array(request.axis), random_directions(2000, generator)))
    margin = np.min([np.cos(c.half_angle) - rows @ np.array(c.direction) for c in request.keep_outs], axis=0)
    if margin.max() < 0:
        raise InfeasibleError(
            "the keep-out cones leave no direction free", limit="keep-out cones", excess=float(-margin.max())
        )
    return rows[0] if margin[0] >= 0 else rows[int(np.argmax(margin))]
