"""All optima of a request, not one: how many dimensions the family has, its members, and the senses they allow.

Neither criterion sees the sense of a direction (``b`` and ``-b`` are one), and none sees the order of equal sensors.
Beyond that, optima of K0 without limits are exactly the tight frames ``B B^T = (N/3) I``: for N >= 5 they form a family
of dimension ``2 N - 8`` after rotations are removed (2 N angles, 5 conditions, 3 rotations), for N = 3 and 4 they
stand alone (three perpendicular lines; the four diagonals of a cube). Limits cut the family down or make it a set of
separate points, as with K1 for two stars, where the axis is the sum bisector or, with one star reversed, the
difference bisector.

The dimension is measured, not assumed: it is the number of directions, inside the active limits, in which the
Hessian of the Lagrangian is flat. Members come from many starts and are grouped by a signature that no rotation,
reordering or reversal changes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.linalg import null_space

from problems.star_configuration.optimal_directions import (
    LocalOptimum,
    Request,
    _program,
    meets_limits,
    optimal_directions,
    random_directions,
    solve_from,
)

_ACTIVE = 1e-7
"""A limit (on a cosine) counts as active when it is closer than this."""

_FLAT = 1e-5
"""A curvature below this share of the largest is flat; the curved directions of known families lie above 1e-2."""


@dataclass(frozen=True)
class OptimalFamily:
    """All optima that were found.

    Attributes:
        value: the least criterion.
        dimension: dimension of the family through the best member, rotations that change nothing not counted; 0 means
            that the member stands alone.
        members: configurations (each count x 3) with this value to 1e-9 of it, no two alike up to rotation, order and
            sense (as many as were found if the family is continuous).
        local_optima: values of the other, worse local optima, ascending, each once.
        starts: number of starts; ``reached`` of them ended at the least value.
        why: what this means, in a sentence.
    """

    value: float
    dimension: int
    members: tuple[np.ndarray, ...]
    local_optima: tuple[float, ...]
    starts: int
    reached: int
    why: str


def signature(request: Request, directions: np.ndarray) -> np.ndarray:
    """Numbers that do not change with a rotation that leaves the request alike, with order, or with sense.

    Sorted moduli of the cosines between the directions, and sorted by direction the moduli to the axis of K1, the fixed
    sensors and the keep-out cones.
    """
    first, second = np.triu_indices(len(directions), 1)
    parts = [np.sort(np.abs((directions @ directions.T)[first, second]))]
    parts += [np.sort(np.abs(directions @ mark)) for mark in _marks(request)]
    return np.concatenate(parts)


def family_dimension(request: Request, optimum: LocalOptimum) -> int:
    """Number of independent moves from ``optimum`` that keep the limits and the criterion, to second order."""
    program = _program(request)
    x, multipliers = optimum.variables, optimum.multipliers
    jacobian = np.array(program.solver.get_function("nlp_jac_g")(x, [])[1].full())
    hessian = np.array(program.solver.get_function("nlp_hess_l")(x, [], 1.0, multipliers).full())
    hessian = np.triu(hessian) + np.triu(hessian, 1).T
    low, high = program.constraint_lower, program.constraint_upper
    value = optimum.constraints
    active = (value - low < _ACTIVE) | (high - value < _ACTIVE)
    fixed = np.eye(len(x))[program.lower == program.upper]
    rows = np.vstack((jacobian[active], fixed))
    rows = rows / np.maximum(np.linalg.norm(rows, axis=1), 1e-300)[:, None]
    free = null_space(rows, rcond=1e-7)
    if free.shape[1] == 0:
        return 0
    curvature = np.linalg.eigvalsh(free.T @ hessian @ free)
    flat = int(np.sum(np.abs(curvature) < _FLAT * max(float(np.max(np.abs(hessian))), 1.0)))
    return max(0, flat - _unfixed_rotations(request))


def _unfixed_rotations(request: Request) -> int:
    """Rotations that leave the request alike and that its program does not fix: one if all its marks share a line."""
    if request.isotropic:
        return 0
    marks = _marks(request)
    return int(np.linalg.matrix_rank(np.array(marks), tol=1e-9) == 1)


def _marks(request: Request) -> list[np.ndarray]:
    """Everything in the request that singles out a direction: fixed sensors, cones, the axis of K1."""
    marks = [np.array(f) for f in request.fixed] + [np.array(c.direction) for c in request.keep_outs]
    return [*marks, np.array(request.axis)] if request.criterion == "K1" else marks


def optimal_family(request: Request, *, starts: int = 40, seed: int = 0) -> OptimalFamily:
    """Find the optima of a request from many starts and measure the dimension of their family.

    Raises:
        InfeasibleError: the limits cannot be met.

    Example:
        >>> optimal_family(Request(4), starts=8).dimension
        0
    """
    best = optimal_directions(request, starts=starts, seed=seed)
    if best.status != "ok":
        return OptimalFamily(best.value, 0, (best.directions,), (), starts, 0, best.why)
    generator = np.random.default_rng(seed + 1)
    optima: list[LocalOptimum] = [solve_from(request, best.directions, generator)]
    optima += [solve_from(request, random_directions(request.count, generator), generator) for _ in range(starts)]
    optima = [o for o in optima if o.converged]
    value = min([best.value] + [o.value for o in optima])
    tolerance = 1e-9 * value
    members: list[np.ndarray] = []
    known: list[np.ndarray] = []
    reached = 0
    for o in optima:
        if o.value > value + tolerance:
            continue
        reached += 1
        mark = signature(request, o.directions)
        # Flat in second order: a value within 1e-9 leaves about 1e-5 of room in the angles.
        if all(np.max(np.abs(mark - other), initial=0) > 1e-4 for other in known):
            known.append(mark)
            members.append(o.directions)
    worse: list[float] = []
    for o in sorted((o for o in optima if o.value > value + max(tolerance, 1e-6 * value)), key=lambda o: o.value):
        if not worse or o.value > worse[-1] * (1 + 1e-6):
            worse.append(o.value)
    sound = [o for o in optima if o.value <= value + tolerance and o.word == "Solve_Succeeded"]
    lowest = min(sound, key=lambda o: o.value, default=None)
    dimension = family_dimension(request, lowest) if lowest is not None else 0
    if dimension:
        why = (
            f"the optima form a family of {dimension} dimensions; {len(members)} different members of it were found "
            f"from {starts} starts, and every direction may be reversed where the limits allow it"
        )
    else:
        why = (
            f"{len(members)} separate optimum{'' if len(members) == 1 else 's'} up to rotation, order and sense; "
            "every direction may be reversed where the limits allow it"
        )
    return OptimalFamily(value, dimension, tuple(members), tuple(worse), starts, reached, why)


def senses(request: Request, directions: np.ndarray, tolerance: float = 1e-7) -> Iterator[np.ndarray]:
    """All reversals of single directions of a configuration that the limits of the request allow, itself first.

    One of each pair of opposite configurations is given when nothing in the request tells them apart.
    """
    alike = request.isotropic
    for signs in product((1.0, -1.0), repeat=len(directions)):
        if alike and signs[0] < 0:
            return
        turned = directions * np.array(signs)[:, None]
        if meets_limits(request, turned, tolerance):
            yield turned
