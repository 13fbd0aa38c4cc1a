"""Which measurements to make: criteria on an information matrix, and the best share of time for each candidate.

The joint problem's information matrix is a sum over what is measured, so a campaign can be judged before it is flown.
Three criteria, all to be made small, on the covariance ``C = (information)^-1`` of the unknowns in question:

    A   trace of C                 mean square error
    D   log det C                  volume of the error ellipsoid, whatever the units
    E   largest eigenvalue of C    error of the worst direction

They are pure CasADi functions here, so that a smooth design (an attitude profile) goes to IPOPT. For designs that are a
choice among candidates (arcs), :func:`best_shares` finds the shares of the total time, a convex problem, with a bound
that no other choice among the same candidates can beat (the equivalence theorem of Kiefer and Wolfowitz, 1960).

``E`` is not smooth where two eigenvalues meet: the optimisers use ``(trace C^p)^(1/p)``, which is above the largest
eigenvalue by at most the factor ``n^(1/p)``; values that are reported are exact.

Sessions of Doppler measurements are designed in :mod:`problems.alignment.campaign_design_session`, free rotations and
torque pulses in :mod:`problems.alignment.campaign_design_rotation`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, get_args

import casadi as ca
import numpy as np

from estimator.models.errors import RequestError, ShapeError
from estimator.models.rotations import Matrix

Criterion = Literal["A", "D", "E"]
EXPONENT = 16  # of the smooth stand-in for the largest eigenvalue, a power of two
SINGULAR = 1e-12  # smallest over largest eigenvalue of an information matrix that counts as invertible
MEANING = {"A": "trace of the covariance", "D": "log determinant of the covariance",
           "E": "largest eigenvalue of the covariance"}


def checked_criterion(name: str) -> Criterion:
    """``name`` as a criterion, in capitals.

    Raises:
        RequestError: it is none.
    """
    for known in get_args(Criterion):
        if name.upper() == known:
            return known
    raise RequestError(f"no criterion is named {name!r}", where="criterion", limit="A, D or E",
                       remedy="; ".join(f"{k}: {v}" for k, v in MEANING.items()))


def smooth_criterion(criterion: Criterion, information: Matrix, exponent: int = EXPONENT) -> Matrix:
    """Logarithm of A, D itself, or the logarithm of the smooth stand-in for E, of an information matrix (n x n).

    An SX expression (or numbers); logarithms make the value independent of the unit of the unknowns but for a constant.
    """
    size = information.shape[0]
    if criterion == "D":
        factor = ca.chol(information)
        return -2 * ca.sum1(ca.log(ca.diag(factor)))
    covariance = ca.solve(information, type(information).eye(size))
    if criterion == "A":
        return ca.log(ca.trace(covariance))
    scale = ca.trace(covariance)
    power, times = covariance / scale, exponent
    while times > 1:
        power, times = ca.mtimes(power, power), times // 2
    return ca.log(scale) + ca.log(ca.trace(power)) / exponent


@lru_cache(maxsize=16)
def criterion_function(criterion: Criterion, size: int) -> ca.Function:
    """CasADi function (information size x size) -> :func:`smooth_criterion`, to be called in any expression."""
    matrix = ca.SX.sym("information", size, size)
    return ca.Function(f"criterion_{criterion}", [matrix], [smooth_criterion(criterion, matrix)], ["information"],
                       ["value"])


def criterion_value(criterion: Criterion, information: np.ndarray) -> float:
    """The exact value of a criterion; infinite where the information (n, n) is singular."""
    matrix = np.asarray(information, dtype=float)
    # The units of the unknowns may differ by orders of magnitude: judged on the matrix with a unit diagonal.
    diagonal = np.diag(matrix)
    if np.any(diagonal <= 0):
        return np.inf
    root = np.sqrt(diagonal)
    balanced = np.linalg.eigvalsh(matrix / np.outer(root, root))
    if balanced[0] < SINGULAR * balanced[-1]:
        return np.inf
    if criterion == "D":
        return float(-np.linalg.slogdet(matrix)[1])
    values = np.linalg.eigvalsh(np.linalg.inv(matrix))
    return float(values.sum() if criterion == "A" else values[-1])


def efficiency(criterion: Criterion, information: np.ndarray, reference: np.ndarray) -> float:
    """How many times as long the ``reference`` would have to be measured to be as good as ``information``.

    Both are information matrices (n, n) of equal durations. Information grows with time, so this is the ratio of the
    criterion for A and E, and the n-th root of the ratio of determinants for D.
    """
    ours, theirs = criterion_value(criterion, information), criterion_value(criterion, reference)
    if criterion == "D":
        return float(np.exp((theirs - ours) / len(information)))
    return theirs / ours


def _value_and_slope(criterion: Criterion, matrix: np.ndarray, interest: np.ndarray) -> tuple[float, np.ndarray]:
    """The smooth criterion (not its logarithm for A and E) of ``interest``; minus its slope along the information."""
    reach = np.linalg.solve(matrix, interest.T)
    covariance = interest @ reach
    covariance = 0.5 * (covariance + covariance.T)
    if criterion == "A":
        return float(np.trace(covariance)), reach @ reach.T
    if criterion == "D":
        return float(np.linalg.slogdet(covariance)[1]), reach @ np.linalg.solve(covariance, reach.T)
    values, vectors = np.linalg.eigh(covariance)
    top = values[-1]
    relative = values / top
    total = float(np.sum(relative**EXPONENT))
    weight = (vectors * relative ** (EXPONENT - 1)) @ vectors.T
    return float(top * total ** (1 / EXPONENT)), total ** (1 / EXPONENT - 1) * reach @ weight @ reach.T


def information_about(interest: np.ndarray, information: np.ndarray) -> np.ndarray:
    """Information (m, m) about ``interest @ unknowns`` (m, n), all else unknown; zero where the matrix is singular."""
    if not np.isfinite(criterion_value("D", information)):
        return np.zeros((len(interest), len(interest)))
    # Balanced by its diagonal: the units of the unknowns differ by orders of magnitude.
    root = 1 / np.sqrt(np.diag(information))
    inverse = np.linalg.inv(information * np.outer(root, root)) * np.outer(root, root)
    about = np.linalg.inv(interest @ inverse @ interest.T)
    return 0.5 * (about + about.T)


def slope_of(criterion: Criterion, information: np.ndarray, interest: np.ndarray | None = None) -> np.ndarray:
    """Minus the derivative (n, n) of the (smooth) criterion along the information (n, n): what more of it brings."""
    wanted = np.eye(len(information)) if interest is None else interest
    return _value_and_slope(criterion, information, wanted)[1]


def certified_bound(criterion: Criterion, information: np.ndarray, candidates: np.ndarray,
                    prior: np.ndarray | None = None, interest: np.ndarray | None = None) -> float:
    """What no shares of the candidates can go below: the tangent plane at one design, whichever it is.

    Args:
        criterion: A, D or E.
        information: (n, n) of a design, prior included; the better the design, the closer the bound.
        candidates, prior, interest: as for :func:`best_shares`.
    """
    stack = candidates[None] if candidates.ndim == 3 else candidates
    known = np.zeros_like(information) if prior is None else prior
    wanted = np.eye(len(information)) if interest is None else interest
    value, slope = _value_and_slope(criterion, information, wanted)
    if criterion == "E":
        # The largest eigenvalue is at least any weighted mean of them: a criterion like A, with a tangent of its own.
        covariance = np.linalg.inv(information_about(wanted, information))
        values, vectors = np.linalg.eigh(covariance)
        relative = (values / values[-1]) ** (EXPONENT - 1)
        mean = (vectors * (relative / relative.sum())) @ vectors.T
        reach = np.linalg.solve(information, wanted.T)
        value, slope = float(np.sum(mean * covariance)), reach @ mean @ reach.T
    gain = np.einsum("bkij,ij->bk", stack, slope)
    return value + float(np.sum(slope * (information - known))) - float(np.mean(gain.max(axis=1)))


@dataclass(frozen=True)
class Shares:
    """The best share of the total for each candidate.

    Attributes:
        weights: (b, k) share of each of k candidates in each of b blocks; every block adds up to its given share.
        information: (n, n) of the whole design.
        value: the criterion of that design, exact.
        bound: no design made of these candidates has a smaller criterion.
    """

    weights: np.ndarray
    information: np.ndarray
    value: float
    bound: float


def best_shares(candidates: np.ndarray, criterion: Criterion, prior: np.ndarray | None = None,
                interest: np.ndarray | None = None, tolerance: float = 1e-3, iterations: int = 5000) -> Shares:
    """The shares of the candidates that make the criterion least, and the bound that proves it.

    Minimises the criterion of ``prior + sum_bk w_bk candidates_bk`` under ``w >= 0`` and ``sum_k w_bk = 1/b`` by the
    multiplicative algorithm (Silvey, Titterington and Torsney 1978). The bound is the tangent plane at the answer,
    below the criterion everywhere since the criterion is convex.

    Args:
        candidates: (b, k, n, n) or (k, n, n) information of each candidate if it had the whole time; blocks hold
            shares of their own (parts of the time in which conditions differ).
        criterion: A, D or E.
        prior: (n, n) what is known already.
        interest: (m, n) the combinations of the unknowns that the criterion is about; default: each unknown.
        tolerance: relative distance of value and bound at which to stop (for D: absolute over n).
        iterations: most steps; the bound holds wherever the iteration stops.

    Raises:
        ShapeError: not square matrices.
        RequestError: all candidates together leave something undetermined.
    """
    stack = np.asarray(candidates, dtype=float)
    if stack.ndim == 3:
        stack = stack[None]
    if stack.ndim != 4 or stack.shape[2] != stack.shape[3]:
        raise ShapeError("the information of candidates must be square matrices", where="candidates",
                         value=f"shape {stack.shape}", limit="(k, n, n)")
    blocks, count, size, _ = stack.shape
    known = np.zeros((size, size)) if prior is None else np.asarray(prior, dtype=float)
    wanted = np.eye(size) if interest is None else np.asarray(interest, dtype=float)
    flat = stack.reshape(blocks, count, size * size)
    weights = np.full((blocks, count), 1.0 / (blocks * count))
    matrix = known + np.einsum("bk,bkm->m", weights, flat).reshape(size, size)
    if not np.isfinite(criterion_value("D", matrix)):
        raise RequestError("the candidates together leave a direction undetermined", where="candidates",
                           remedy="allow more motion, or give what is known already")
    bound, power = -np.inf, 0.5
    value, slope = _value_and_slope(criterion, matrix, wanted)
    for _ in range(iterations):
        gain = flat @ slope.ravel()
        lowest = value + float(np.sum(slope * (matrix - known))) - float(np.mean(gain.max(axis=1)))
        bound = max(bound, lowest)
        if value - bound <= tolerance * (len(wanted) if criterion == "D" else abs(value)):
            break
        # A small enough power always improves (Yu 2010); a larger one, while it does, is faster.
        while True:
            grown = weights * (np.maximum(gain, 0.0) / gain.max(axis=1, keepdims=True)) ** power
            trial = grown / (blocks * grown.sum(axis=1, keepdims=True))
            trial_matrix = known + np.einsum("bk,bkm->m", trial, flat).reshape(size, size)
            trial_value, trial_slope = _value_and_slope(criterion, trial_matrix, wanted)
            if trial_value <= value or power < 1 / (2 * EXPONENT):
                break
            power /= 2
        weights, matrix, value, slope = trial, trial_matrix, trial_value, trial_slope
        power = min(1.2 * power, 4.0)
    exact = criterion_value(criterion, information_about(wanted, matrix))
    if criterion == "E":
        bound = certified_bound("E", matrix, stack, known, wanted)
    return Shares(weights, matrix, exact, min(bound, exact))
