"""The best stars of the real sky: which of the visible stars to sight, proven best or with a stated gap.

For an attitude, cameras and keep-out cones the candidates are the pairs (camera, star) that a camera can see. A choice
S has the information ``F = sum over S of M_i`` and the criterion ``trace(A F^-1)`` (A = I for K0, I - V V^T for K1),
which falls with every star added, so the best choice fills the quotas: ``count`` in all and a number per camera.

Lower bound. Let the choice be fractional, ``0 <= x_i <= 1``: the criterion is convex in ``F``, and at ANY positive
definite ``F`` its tangent gives

    trace(A F'^-1) >= 2 trace(A F^-1) - sum over S' of s_i,   s_i = trace(F^-1 A F^-1 M_i)

for every choice S' with information F'. The right side is least for the choice with the greatest scores s_i, which
sorting finds (the quotas are a laminar matroid, on which greedy sorting is exact). The bound holds without the
relaxation being solved exactly; solving it by an interior-point method (rank-6 structure: a few small matrices per
step) makes it tight.

Upper bound. The relaxation rounded and a greedy choice, both improved by exchanges (Fedorov): the best single
exchange is made until none helps.

Proof. A candidate whose forced presence or absence lifts the lower bound above the upper bound is settled. What is
left is enumerated if it has few subsets, else branched on (best bound first). If ``node_limit`` stops that, the gap
between the bounds is reported instead.
"""

from __future__ import annotations

import heapq
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import combinations
from math import comb
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.models.errors import QuaternionError, RequestError
from problems.readers.star_catalogue import StarCatalogue
from problems.star_configuration.criteria import Criteria, criteria_of_information, unit_vectors
from problems.star_configuration.optimal_directions import KeepOut

_ENUMERATED = 300
"""Subsets up to which enumeration is faster than a relaxation."""

_SAME = 1e-10
"""Relative difference of two values that counts as none."""

_SYMMETRIC = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))
"""Order in which the six entries of a symmetric 3 x 3 matrix are held."""

_DOUBLED = np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])


@dataclass(frozen=True)
class Camera:
    """A star camera with a circular field of view.

    Attributes:
        boresight: direction of its axis (3), body axes.
        half_angle: half of the field's width (rad).
        magnitude_limit: the faintest star it follows.
        stars: the most stars it follows at once; None for no limit of its own.
        sigma: total accuracy of a direction (rad, or 1 to have the criteria in units of its square).
        photon_sigma: total accuracy (unit of ``sigma``) that photon noise alone leaves at ``photon_magnitude``; it
            grows as the flux falls: ``sigma_total^2 = sigma^2 + photon_sigma^2 10^(0.4 (m - photon_magnitude))``.
        ratio: accuracy along the first measuring axis over that along the second (1: equal).
        first_axis: the first measuring axis (3), body axes, used where ``ratio`` is not 1.
        name: its name.
    """

    boresight: tuple[float, float, float]
    half_angle: float
    magnitude_limit: float = 5.0
    stars: int | None = None
    sigma: float = 1.0
    photon_sigma: float = 0.0
    photon_magnitude: float = 0.0
    ratio: float = 1.0
    first_axis: tuple[float, float, float] = (1.0, 0.0, 0.0)
    name: str = "camera"

    def __post_init__(self) -> None:
        where = f"camera {self.name}"
        for name in ("boresight", "first_axis"):
            unit = unit_vectors(getattr(self, name), f"{where}, {name}")[0]
            object.__setattr__(self, name, tuple(float(x) for x in unit))
        if not 0 < self.half_angle <= np.pi:
            raise RequestError(
                "the half-angle of a field of view is out of range",
                where=where,
                value=f"{self.half_angle} rad",
                limit="0 to pi",
                remedy="give it in radians",
            )
        if not (np.isfinite(self.sigma) and self.sigma > 0 and self.ratio > 0 and self.photon_sigma >= 0):
            raise RequestError("an accuracy is not a positive number", where=where, value=self.sigma, limit="above 0")
        if self.stars is not None and self.stars < 1:
            raise RequestError("a camera follows at least one star", where=where, value=self.stars, limit="1 or more")

    def accuracy(self, magnitude: np.ndarray) -> np.ndarray:
        """Total standard deviation of a direction to stars of these magnitudes."""
        return np.sqrt(self.sigma**2 + self.photon_sigma**2 * 10 ** (0.4 * (magnitude - self.photon_magnitude)))


@dataclass(frozen=True)
class Candidates:
    """Pairs of camera and star that can be sighted.

    Attributes:
        directions: (n x 3), unit, body axes.
        information: (n x 6) entries xx, yy, zz, yz, xz, xy of the information of each (see criteria.py).
        camera: (n) index of the camera; ``star``: (n) index in the catalogue; ``sigma``: (n) total accuracy.
        quotas: stars per camera (a large number where there is no limit).
    """

    directions: np.ndarray
    information: np.ndarray
    camera: np.ndarray
    star: np.ndarray
    sigma: np.ndarray
    quotas: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.star)


@dataclass(frozen=True)
class Selection:
    """The stars to sight.

    Attributes:
        status: "ok", or "unobservable" (fewer than two separate stars can be seen, or none with the quotas).
        why: the sentence: what was proven.
        chosen: indices into the candidates, ascending; ``candidates`` are these.
        criteria: K0, K1 and covariance of the choice (body axes).
        value: the criterion minimised; ``lower_bound``: no choice has less; ``gap``: (value - lower_bound) /
            lower_bound.
        proven: the choice is optimal (to 1e-10 of its value).
        nodes: branches looked at; 0 where enumeration or the first bound was enough.
        seconds: time taken.
    """

    status: str
    why: str
    chosen: np.ndarray
    candidates: Candidates = field(repr=False)
    criteria: Criteria
    value: float
    lower_bound: float
    gap: float
    proven: bool
    nodes: int
    seconds: float


def attitude(quaternion: Any) -> Rotation:
    """``inertial_from_body`` from a scalar-first quaternion (4) or a Rotation.

    Raises:
        QuaternionError: not four finite numbers of unit length (to 1e-3).
    """
    if isinstance(quaternion, Rotation):
        return quaternion
    q = np.asarray(quaternion, dtype=float)
    if q.shape != (4,) or not np.all(np.isfinite(q)):
        raise QuaternionError("an attitude is four finite numbers w x y z", where="attitude", value=quaternion)
    if abs(np.linalg.norm(q) - 1) > 1e-3:
        raise QuaternionError(
            "the quaternion is not of unit length",
            where="attitude",
            value=f"{np.linalg.norm(q):.6g}",
            limit="1 within 1e-3",
            remedy="normalise it, and check the order: scalar first",
        )
    return Rotation.from_quat(q, scalar_first=True)


class Sky:
    """A catalogue laid out for many attitudes: directions, brightest first, so that a sensitivity is a slice.

    Args:
        catalogue: the stars.
        years: Julian years after J2000, for proper motion.
    """

    def __init__(self, catalogue: StarCatalogue, years: float = 0.0):
        self.order = np.argsort(catalogue.magnitude, kind="stable")
        self.catalogue = catalogue
        self.magnitude = catalogue.magnitude[self.order]
        self.inertial = catalogue.directions(years)[self.order]

    def candidates(
        self, inertial_from_body: Any, cameras: Sequence[Camera], keep_outs: Sequence[KeepOut] = ()
    ) -> Candidates:
        """What the cameras can sight at an attitude.

        Args:
            inertial_from_body: quaternion (4, scalar first) or Rotation.
            cameras: one or more.
            keep_outs: cones in inertial axes that no sighted star may lie in.
        """
        if not cameras:
            raise RequestError("there is no camera", where="cameras", remedy="give at least one")
        rotation = attitude(inertial_from_body).as_matrix()
        parts = []
        for index, camera in enumerate(cameras):
            bright = int(np.searchsorted(self.magnitude, camera.magnitude_limit, side="right"))
            seen = np.flatnonzero(
                self.inertial[:bright] @ (rotation @ np.array(camera.boresight)) >= np.cos(camera.half_angle)
            )
            for cone in keep_outs:
                seen = seen[self.inertial[seen] @ np.array(cone.direction) <= np.cos(cone.half_angle)]
            body = self.inertial[seen] @ rotation
            sigma = camera.accuracy(self.magnitude[seen])
            parts.append(
                (body, _sighting_information(body, sigma, camera), np.full(len(seen), index), self.order[seen], sigma)
            )
        columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
        quotas = tuple(camera.stars if camera.stars is not None else len(self.order) for camera in cameras)
        return Candidates(columns[0], columns[1], columns[2], columns[3], columns[4], quotas)


def _sighting_information(directions: np.ndarray, sigma: np.ndarray, camera: Camera) -> np.ndarray:
    """Information (n x 6) of sightings: the formulas of criteria.py over arrays."""
    if camera.ratio == 1:
        outer = np.stack([directions[:, i] * directions[:, j] for i, j in _SYMMETRIC], axis=1)
        unit = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
        return (2 / sigma**2)[:, None] * (unit - outer)
    axis = np.array(camera.first_axis)
    first = axis - (directions @ axis)[:, None] * directions
    length = np.linalg.norm(first, axis=1)
    if np.any(length < 1e-6):
        raise RequestError(
            "the first measuring axis lies along a line of sight",
            where=f"camera {camera.name}, first_axis",
            value=camera.first_axis,
            remedy="choose it across the boresight",
        )
    first /= length[:, None]
    second = np.cross(directions, first)
    sigma_second = sigma / np.sqrt(1 + camera.ratio**2)
    sigma_first = camera.ratio * sigma_second
    return np.stack(
        [
            first[:, i] * first[:, j] / sigma_second**2 + second[:, i] * second[:, j] / sigma_first**2
            for i, j in _SYMMETRIC
        ],
        axis=1,
    )


def criterion_values(information: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """``trace(A F^-1)`` for many information matrices.

    Args:
        information: (..., 6) entries xx, yy, zz, yz, xz, xy.
        weight: (6) entries of A in the same order.

    Returns: (...), infinite where the matrix is not positive definite to rounding.
    """
    xx, yy, zz, yz, xz, xy = np.moveaxis(information, -1, 0)
    cxx, cyy, czz = yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy
    cyz, cxz, cxy = xz * xy - xx * yz, xy * yz - yy * xz, xz * yz - zz * xy
    determinant = xx * cxx + xy * cxy + xz * cxz
    top = (
        weight[0] * cxx + weight[1] * cyy + weight[2] * czz + 2 * (weight[3] * cyz + weight[4] * cxz + weight[5] * cxy)
    )
    small = 1e-13 * ((xx + yy + zz) / 3) ** 3
    good = determinant > small
    return np.where(good, top / np.where(good, determinant, 1.0), np.inf)


def _matrix(entries: np.ndarray) -> np.ndarray:
    """The symmetric matrix (3 x 3) of six entries."""
    xx, yy, zz, yz, xz, xy = entries
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _entries(matrix: np.ndarray) -> np.ndarray:
    """The six entries of a symmetric matrix (3 x 3)."""
    return np.array([matrix[i, j] for i, j in _SYMMETRIC])


class _Problem:
    """Choose ``count`` of the free candidates beside those already in, within the quotas."""

    def __init__(
        self,
        information: np.ndarray,
        camera: np.ndarray,
        quotas: np.ndarray,
        count: int,
        base: np.ndarray,
        weight: np.ndarray,
    ):
        self.information, self.camera, self.quotas = information, camera, quotas
        self.base, self.weight = base, weight
        available = np.minimum(np.bincount(camera, minlength=len(quotas)), quotas)
        self.count = min(count, int(available.sum()))
        self.binding = bool(np.any(np.bincount(camera, minlength=len(quotas)) > quotas))

    def best(self, scores: np.ndarray) -> np.ndarray:
        """Indices of the allowed choice with the greatest sum of scores (exact: greedy on a laminar matroid)."""
        if not self.binding:
            if self.count >= len(scores):
                return np.arange(len(scores))
            return np.argpartition(-scores, self.count - 1)[: self.count] if self.count else np.zeros(0, dtype=int)
        order = np.argsort(-scores, kind="stable")
        camera = self.camera[order]
        keep = np.zeros(len(order), dtype=bool)
        for c, quota in enumerate(self.quotas):
            keep[np.flatnonzero(camera == c)[:quota]] = True
        return order[keep][: self.count]

    def values(self, added: np.ndarray) -> np.ndarray:
        """Criterion of sums (..., 6) of information of free candidates."""
        return criterion_values(self.base + added, self.weight)

    def swaps_allowed(self, chosen: np.ndarray, others: np.ndarray) -> np.ndarray | None:
        """Mask (chosen x others) of exchanges within the quotas; None where all are."""
        if not self.binding:
            return None
        used = np.bincount(self.camera[chosen], minlength=len(self.quotas))
        room = used < self.quotas
        return (self.camera[chosen][:, None] == self.camera[others][None, :]) | room[self.camera[others]][None, :]


def _exchange(problem: _Problem, chosen: np.ndarray) -> tuple[np.ndarray, float]:
    """Make the best single exchange until none helps."""
    n = len(problem.information)
    inside = np.zeros(n, dtype=bool)
    inside[chosen] = True
    total = problem.information[inside].sum(axis=0)
    value = float(problem.values(total))
    while True:
        ins, outs = np.flatnonzero(inside), np.flatnonzero(~inside)
        if len(ins) == 0 or len(outs) == 0:
            return ins, value
        trial = problem.values(total - problem.information[ins][:, None, :] + problem.information[outs][None, :, :])
        allowed = problem.swaps_allowed(ins, outs)
        if allowed is not None:
            trial = np.where(allowed, trial, np.inf)
        k = int(np.argmin(trial))
        i, j = divmod(k, len(outs))
        if not trial[i, j] < value * (1 - 1e-12):
            return ins, value
        inside[ins[i]], inside[outs[j]] = False, True
        total = problem.information[inside].sum(axis=0)
        value = float(problem.values(total))


def _greedy(problem: _Problem) -> np.ndarray:
    """Add one star at a time, each the one that helps most; a small even information stands in at first."""
    n = len(problem.information)
    left = np.ones(n, dtype=bool)
    used = np.zeros(len(problem.quotas), dtype=int)
    chosen: list[int] = []
    small = 1e-3 * float(problem.information[:, :3].mean()) * np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    total = np.zeros(6)
    for _ in range(problem.count):
        free = np.flatnonzero(left & (used < problem.quotas)[problem.camera])
        if len(free) == 0:
            break
        j = int(free[int(np.argmin(problem.values(total + small + problem.information[free])))])
        chosen.append(j)
        left[j] = False
        used[problem.camera[j]] += 1
        total = total + problem.information[j]
    return np.array(chosen, dtype=int)


def _relaxation(problem: _Problem, target: float) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
    """Solve the fractional problem by an interior-point method and return the best bound on the way.

    Args:
        target: the search ends early when the bound reaches this value.

    Returns: (lower bound, its best choice, its scores (n), fractions x (n)).
    """
    sizes = np.bincount(problem.camera, minlength=len(problem.quotas))
    room = np.minimum(sizes, problem.quotas)
    inequality = room.sum() > problem.count
    # Where the quotas leave no choice between cameras, a camera with no more stars than its quota gives all of them.
    forced = np.zeros(len(problem.camera), dtype=bool) if inequality else (sizes <= problem.quotas)[problem.camera]
    m, camera = problem.information[~forced], problem.camera[~forced]
    base = problem.base + problem.information[forced].sum(axis=0)
    n = len(m)
    binding = [c for c in range(len(room)) if sizes[c] > problem.quotas[c]]
    rows = np.array([camera == c for c in binding], dtype=float).reshape(-1, n)
    # Without a choice between cameras each quota is filled exactly; else the total is, and the quotas are caps.
    equal = np.ones((1, n)) if inequality or not binding else rows
    capped = rows if inequality else np.zeros((0, n))
    caps = problem.quotas[binding].astype(float) if inequality else np.zeros(0)
    # Strictly feasible start: an even share of each camera's room.
    share = room * (problem.count / room.sum()) / np.maximum(sizes, 1)
    x = share[camera]
    # Taking every candidate is a bound too, poor but always there: the criterion falls with every star.
    everything = float(problem.values(problem.information.sum(axis=0)))
    best_bound = everything if np.isfinite(everything) else 0.0
    best_choice, best_scores = np.zeros(0, dtype=int), np.zeros(len(forced))
    best_x = np.ones(len(forced))
    weight = _matrix(problem.weight)
    low = high = cap = np.zeros(0)  # multipliers of x >= 0, x <= 1 and of the quotas
    try:
        with np.errstate(all="ignore"):
            for iteration in range(40):
                inverse = np.linalg.inv(_matrix(base + x @ m))
                middle = inverse @ weight @ inverse
                gradient6 = _entries(middle) * _DOUBLED
                value = float(np.sum(inverse * weight))
                scores = problem.information @ gradient6
                chosen = problem.best(scores)
                bound = 2 * value - float(gradient6 @ problem.base) - float(scores[chosen].sum())
                if np.isfinite(bound) and bound > best_bound:
                    best_bound, best_choice, best_scores = bound, chosen, scores
                    best_x[~forced] = x
                # No bound rises above the value: stop when the rest cannot matter to what is missing to the target.
                if best_bound >= target * (1 - _SAME) or value - best_bound <= max(
                    0.02 * (target - best_bound), 1e-9 * value
                ):
                    break
                slack = caps - capped @ x
                if iteration == 0:
                    barrier = (value - bound) / (2 * n)
                    low, high, cap = barrier / x, barrier / (1 - x), barrier / slack
                barrier = 0.15 * float(low @ x + high @ (1 - x) + cap @ slack) / (2 * n + len(caps))
                # Primal-dual Newton step: the matrix is diagonal plus rank six (plus one for each quota).
                gradient = -scores[~forced] - barrier / x + barrier / (1 - x) + capped.T @ (barrier / slack)
                diagonal = low / x + high / (1 - x)
                curvature = _curvature(inverse, middle)
                root = np.linalg.cholesky(curvature + 1e-13 * np.trace(curvature) * np.eye(6))
                low_rank = np.hstack((m @ root, capped.T * np.sqrt(cap / slack)))
                scaled = low_rank / diagonal[:, None]
                inner = np.eye(low_rank.shape[1]) + low_rank.T @ scaled
                solved = np.column_stack((-gradient, equal.T)) / diagonal[:, None]
                solved -= scaled @ np.linalg.solve(inner, low_rank.T @ solved)
                multiplier = np.linalg.solve(equal @ solved[:, 1:], equal @ solved[:, 0])
                step = solved[:, 0] - solved[:, 1:] @ multiplier
                step_low = barrier / x - low - low / x * step
                step_high = barrier / (1 - x) - high + high / (1 - x) * step
                pace = capped @ step
                step_cap = barrier / slack - cap + cap / slack * pace
                primal = min(_longest(x, step), _longest(1 - x, -step), _longest(slack, -pace))
                dual = min(_longest(low, step_low), _longest(high, step_high), _longest(cap, step_cap))
                x = x + primal * step
                low, high, cap = low + dual * step_low, high + dual * step_high, cap + dual * step_cap
                if float(min(x.min(), 1 - x.max())) < 1e-14:
                    break
    except np.linalg.LinAlgError:
        pass  # rounding has the last word: every bound met so far holds
    return best_bound, best_choice, best_scores, best_x


def _longest(value: np.ndarray, step: np.ndarray) -> float:
    """The longest step up to 1 that keeps ``value`` positive, with a margin."""
    falling = step < 0
    if not np.any(falling):
        return 1.0
    return min(1.0, 0.95 * float(np.min(-value[falling] / step[falling])))


_BASIS = np.zeros((6, 3, 3))
for _k, (_i, _j) in enumerate(_SYMMETRIC):
    _BASIS[_k, _i, _j] = _BASIS[_k, _j, _i] = 1.0


def _curvature(inverse: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Second derivative (6 x 6) of ``trace(A F^-1)`` in the six entries of F, from F^-1 and F^-1 A F^-1."""
    left = (_BASIS @ inverse).reshape(6, 9)
    right = (_BASIS @ middle).transpose(0, 2, 1).reshape(6, 9)
    half = left @ right.T
    return half + half.T


def _settled(
    problem: _Problem, bound: float, chosen: np.ndarray, scores: np.ndarray, upper: float
) -> tuple[np.ndarray, np.ndarray]:
    """Masks of candidates that must be in and that must be out of any choice better than ``upper``.

    The tangent bound with candidate i forced in is the bound plus what the sum of scores loses: i takes the place of
    the lowest score that it may replace (in its own camera if that is full). Likewise for one forced out.
    """
    n = len(scores)
    inside = np.zeros(n, dtype=bool)
    inside[chosen] = True
    limit = upper * (1 - _SAME)
    used = np.bincount(problem.camera[chosen], minlength=len(problem.quotas))
    full = used >= problem.quotas
    lowest = np.full(len(problem.quotas), float(scores[chosen].min()) if len(chosen) else 0.0)
    highest = np.full(len(problem.quotas), -np.inf)
    for c in range(len(problem.quotas)):
        here = problem.camera == c
        if full[c] and np.any(inside & here):
            lowest[c] = scores[inside & here].min()
        outside = ~inside & (here | ~full[problem.camera])
        if np.any(outside):
            highest[c] = scores[outside].max()
    must_out = ~inside & (bound + lowest[problem.camera] - scores > limit)
    must_in = inside & (bound + scores - highest[problem.camera] > limit)
    return must_in, must_out


@lru_cache(maxsize=64)
def _subsets(n: int, k: int) -> np.ndarray:
    """All subsets of ``k`` of ``n`` as rows of a matrix of zeros and ones."""
    rows = np.array(list(combinations(range(n), k)), dtype=int).reshape(-1, k)
    table = np.zeros((len(rows), n))
    np.put_along_axis(table, rows, 1.0, axis=1)
    return table


def _enumerate(problem: _Problem) -> tuple[float, np.ndarray]:
    """The best of all allowed choices, by looking at each."""
    table = _subsets(len(problem.information), problem.count)
    if problem.binding:
        for c, quota in enumerate(problem.quotas):
            table = table[table[:, problem.camera == c].sum(axis=1) <= quota]
    values = problem.values(table @ problem.information)
    k = int(np.argmin(values))
    return float(values[k]), np.flatnonzero(table[k])


def select(
    candidates: Candidates,
    count: int,
    *,
    criterion: str = "K0",
    axis: Any = (0.0, 0.0, 1.0),
    exact: bool = True,
    node_limit: int = 400,
) -> Selection:
    """Choose the stars to sight.

    Args:
        candidates: from :meth:`Sky.candidates`.
        count: stars in all; the quotas of the cameras may allow fewer.
        criterion: "K0" or "K1" of ``axis`` (3, body axes).
        exact: prove optimality by branching; without it the exchanged choice and the gap to the first bound are given.
        node_limit: branches after which the proof is given up and the gap stated.

    Raises:
        RequestError: an unknown criterion or a count below 1.
    """
    began = time.perf_counter()
    if criterion not in ("K0", "K1"):
        raise RequestError("unknown criterion", where="criterion", value=criterion, limit="K0 or K1")
    if count < 1:
        raise RequestError("the number of stars is out of range", where="count", value=count, limit="1 or more")
    v = unit_vectors(axis, "axis")[0]
    weight = _entries(np.eye(3) - (np.outer(v, v) if criterion == "K1" else 0.0))
    problem = _Problem(
        candidates.information, candidates.camera, np.array(candidates.quotas, dtype=int), count, np.zeros(6), weight
    )

    def answer(status: str, why: str, chosen: np.ndarray, lower: float, proven: bool, nodes: int) -> Selection:
        chosen = np.sort(chosen)
        total = candidates.information[chosen].sum(axis=0) if len(chosen) else np.zeros(6)
        found = (
            criteria_of_information(_matrix(total), v) if len(chosen) else Criteria(np.inf, np.inf, v, None, np.eye(3))
        )
        value = found.K0 if criterion == "K0" else found.K1
        lower = value if proven else min(lower, value)
        gap = 0.0 if proven else (value / lower - 1 if lower > 0 else np.inf)
        return Selection(
            status, why, chosen, candidates, found, value, lower, gap, proven, nodes, time.perf_counter() - began
        )

    if len(candidates) < 2 or problem.count < 2:
        seen = f"{len(candidates)} star{'' if len(candidates) == 1 else 's'} can be sighted and {count} asked for"
        return answer(
            "unobservable",
            f"{seen}: two stars are needed for an attitude; widen the field of view, raise the "
            "magnitude limit or turn away from the keep-out cones",
            np.arange(min(len(candidates), problem.count)),
            0.0,
            False,
            0,
        )
    if problem.count == len(candidates):
        result = answer(
            "ok",
            f"all {len(candidates)} visible stars are sighted: fewer are visible than asked for"
            if len(candidates) < count
            else f"all {len(candidates)} visible stars are sighted",
            np.arange(len(candidates)),
            0.0,
            True,
            0,
        )
    elif comb(len(candidates), problem.count) <= _ENUMERATED:
        _, chosen = _enumerate(problem)
        result = answer(
            "ok",
            f"best of all {comb(len(candidates), problem.count)} subsets of {len(candidates)} visible stars",
            chosen,
            0.0,
            True,
            0,
        )
    else:
        result = _search(problem, answer, exact, node_limit)
    if result.criteria.covariance is None:
        return answer(
            "unobservable",
            "the stars that can be sighted lie along one line: the rotation about it is not seen",
            result.chosen,
            0.0,
            False,
            result.nodes,
        )
    return result


def _search(problem: _Problem, answer: Any, exact: bool, node_limit: int) -> Selection:
    """Bounds, exchanges, and branch and bound for sets too large to enumerate."""
    n = len(problem.information)
    first, upper = _exchange(problem, _greedy(problem))
    bound, choice, scores, fractions = _relaxation(problem, upper)
    if bound < upper * (1 - _SAME):
        second, other = _exchange(problem, problem.best(fractions))
        if other < upper:
            first, upper = second, other
    incumbent = first
    if not exact:
        gap = max(upper / bound - 1, 0.0) if bound > 0 else np.inf
        return answer(
            "ok",
            f"greedy and exchange among {n} visible stars; at most {100 * gap:.3g} % above the optimum",
            incumbent,
            bound,
            gap <= _SAME,
            0,
        )
    # A node: its bound, and the masks of what is in and out. The heap holds the open ones, lowest bound first.
    everything = np.arange(n)
    heap: list[tuple[float, int, np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray, np.ndarray] | None]] = []
    serial = nodes = 0
    heapq.heappush(heap, (bound, serial, np.zeros(n, dtype=bool), np.zeros(n, dtype=bool), (choice, scores, fractions)))
    while heap and heap[0][0] < upper * (1 - _SAME) and nodes < node_limit:
        node_bound, _, inside, outside, ready = heapq.heappop(heap)
        nodes += 1
        pending = True
        while pending:
            full = np.bincount(problem.camera[inside], minlength=len(problem.quotas)) >= problem.quotas
            free = everything[~inside & ~outside & ~full[problem.camera]]
            part = _part(problem, inside, free)
            if part is None:
                break
            if part.count == 0 or part.count == len(free) or comb(len(free), part.count) <= _ENUMERATED:
                value, picked = _leaf(part)
                if value < upper * (1 - 1e-12):
                    upper, incumbent = value, np.concatenate((everything[inside], free[picked]))
                break
            if ready is None:
                new_bound, picked, part_scores, part_fractions = _relaxation(part, upper)
                node_bound = max(node_bound, new_bound)
                if node_bound >= upper * (1 - _SAME):
                    break
                rounded, value = _exchange(part, part.best(part_fractions))
                if value < upper * (1 - 1e-12):
                    upper, incumbent = value, np.concatenate((everything[inside], free[rounded]))
            else:
                picked, part_scores, part_fractions = ready
                new_bound, ready = node_bound, None
            must_in, must_out = _settled(part, new_bound, picked, part_scores, upper)
            if np.any(must_in) or np.any(must_out):
                inside, outside = inside.copy(), outside.copy()
                inside[free[must_in]] = True
                outside[free[must_out]] = True
                # Settling a few does not change the relaxation enough to solve it again before branching.
                if (
                    np.sum(must_in) + np.sum(must_out) >= max(2, len(free) // 8)
                    or comb(
                        len(free) - int(must_in.sum()) - int(must_out.sum()), max(part.count - int(must_in.sum()), 0)
                    )
                    <= _ENUMERATED
                ):
                    continue
                part_fractions = np.where(must_in | must_out, -1.0, part_fractions)
            branch = int(free[int(np.argmin(np.abs(part_fractions - 0.5)))])
            for taken in (True, False):
                child_in, child_out = inside.copy(), outside.copy()
                (child_in if taken else child_out)[branch] = True
                serial += 1
                heapq.heappush(heap, (node_bound, serial, child_in, child_out, None))
            pending = False
    lower = min(heap[0][0], upper) if heap else upper
    proven = lower >= upper * (1 - _SAME)
    gap = 0.0 if proven else upper / lower - 1 if lower > 0 else np.inf
    why = (
        f"proven best among {n} visible stars"
        if proven
        else f"at most {100 * gap:.3g} % above the optimum among {n} visible stars "
        f"(the proof stopped at {nodes} branches)"
    )
    return answer("ok", why, incumbent, lower, proven, nodes)


def _part(problem: _Problem, inside: np.ndarray, free: np.ndarray) -> _Problem | None:
    """The problem left when some candidates are in; None where no choice fills the count any more."""
    used = np.bincount(problem.camera[inside], minlength=len(problem.quotas))
    quotas = problem.quotas - used
    left = problem.count - int(inside.sum())
    if np.any(quotas < 0) or left < 0:
        return None
    part = _Problem(
        problem.information[free],
        problem.camera[free],
        quotas,
        left,
        problem.base + problem.information[inside].sum(axis=0),
        problem.weight,
    )
    return part if part.count == left else None


def _leaf(part: _Problem) -> tuple[float, np.ndarray]:
    """The best choice of a problem small enough to enumerate."""
    if part.count == 0:
        return float(part.values(np.zeros(6))), np.zeros(0, dtype=int)
    if part.count == len(part.information):
        return float(part.values(part.information.sum(axis=0))), np.arange(part.count)
    return _enumerate(part)


def measurement_covariance(selection: Selection) -> np.ndarray | None:
    """Attitude covariance (3 x 3, unit of the cameras' sigma squared, body axes) of a selection, None if singular."""
    return selection.criteria.covariance
