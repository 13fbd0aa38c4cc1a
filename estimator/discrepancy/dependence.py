"""What a disagreement goes with: time, orbit phase, rate, look direction, frequency, housekeeping.

The residuals of every arc and component are projected on Legendre polynomials of the arc, as in
:mod:`estimator.discrepancy.gap`: one number per arc for its mean, one for its slope, one for its curvature, and a few
for what is faster. In each of these strata a relation with a covariate is a linear regression of the arcs' numbers on
those of a few functions of the covariate (a line or a parabola; one or two harmonics of an angle), with everything that
the fit absorbs projected out of both. Common to all arcs, a number of each stratum is free: what plain time inside the
arcs explains is credited to no covariate, nor is a constant.

A regression on noise alone would be judged by chi-square. Where there is structure, though, any covariate that differs
from arc to arc takes a part of it by chance; the scatter of the arcs about the regression says how much (an F test with
as many degrees of freedom as there are arcs to spare). A relation must hold by both: the larger of the two p-values
counts, times the number of covariates, functions, strata and components looked at. A covariate acts on one component
or on all; what the fit makes of that shows in every component, and all of them are regressed together.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.special import chdtrc, fdtrc

from estimator.discrepancy.gap import SMOOTH, _readable
from estimator.discrepancy.score import Stack
from estimator.discrepancy.series import ArcSeries, series_of
from estimator.problem import Problem
from estimator.residuals import Linearization

LEVEL = 0.005
"""Probability of a named covariate of a channel where there is no relation, over all that is looked at."""
STRATA = ((0, 1), (1, 2), (2, 3), (3, SMOOTH))  # orders of the Legendre polynomials: mean, slope, curvature, faster
ALIKE = 9.2  # drop of the sum of squares (100 to 1) below which two covariates explain the same equally well
ABSORBED = 1e-3  # part of a direction left beside the fit below which it carries nothing
MANY_ARCS = 16  # arcs from which on the correlation of neighbouring arcs can be told from the data
FEWEST_ARCS = 3  # arcs below which a relation is a coincidence
MOST = 4  # relations named of a channel
KNOWN = 0.6  # part of an arc's samples at which a covariate must be known
FEWEST_IN_PIECE = 4 * SMOOTH  # samples of an arc that takes part


@dataclass(frozen=True, eq=False)
class Covariate:
    """Something that a disagreement may go with, at the times of some samples.

    Attributes:
        values: (n,), or (n, m) where each component has its own (the off-nadir angle of each beam); a NaN where it is
            not known.
        unit: SI unit; "1" for a pure number.
        angle: whether it comes back to where it was after 2 pi rad (an orbit phase, an azimuth).
    """

    values: np.ndarray
    unit: str
    angle: bool = False


Covariates = Callable[[str, np.ndarray], Mapping[str, Covariate]]
"""Channel and times (n,) s to the covariates there."""


@dataclass(frozen=True)
class Dependence:
    """One relation between a disagreement and a covariate.

    Attributes:
        channel: kind of measurement.
        components: indices of the beams or axes that show it.
        covariate: its name.
        covariate_unit: its unit.
        form: "linear", "quadratic", "one harmonic" or "two harmonics".
        p_value: over all covariates, functions, strata and components of the channel.
        share: part of the channel's excess, about a constant and plain time inside the arcs, that goes with the
            covariate (0 to 1).
        excess: root mean square of what goes with the covariate, in ``unit``, about its mean, the other unknowns
            giving way.
        floor: root mean square of the noise there.
        unit: of the channel.
        slope: change per unit of the covariate where the form is linear, else None.
        alike: other covariates that explain it equally well in these data.
        sentence: all this in words.
    """

    channel: str
    components: tuple[int, ...]
    covariate: str
    covariate_unit: str
    form: str
    p_value: float
    share: float
    excess: float
    floor: float
    unit: str
    slope: float | None
    alike: tuple[str, ...]
    sentence: str


@dataclass(frozen=True, eq=False)
class _Reduced:
    """A channel as numbers of its arcs, one entry per stratum.

    Attributes:
        arcs: (a) the training series.
        smooth: per arc (n, SMOOTH) orthonormal polynomials.
        carried: per arc (SMOOTH, m, p) product of the polynomials with the fit's basis.
        roots: per stratum (r, a orders m) inverse root of the numbers' covariance under noise.
        numbers: per stratum (r,) whitened numbers.
        common: per stratum (r, c) orthonormal: what a curve that is the same in every arc leaves there.
    """

    arcs: Sequence[ArcSeries]
    smooth: Sequence[np.ndarray]
    carried: Sequence[np.ndarray]
    roots: Sequence[np.ndarray]
    numbers: Sequence[np.ndarray]
    common: Sequence[np.ndarray]


@dataclass(frozen=True, eq=False)
class _Relation:
    """A covariate that acts on some components, in one form."""

    reduced: _Reduced
    components: tuple[int, ...]
    name: str
    unit: str
    form: str
    p_value: float
    designs: Sequence[np.ndarray]
    spread: float

    @property
    def worth(self) -> float:
        """Drop of the sum of squares less the usual price of the functions."""
        count = sum(len(n) for n in self.reduced.numbers)
        return _drop(self.reduced.numbers, self.designs)[0] - self.designs[0].shape[1] * float(np.log(max(count, 2)))


def dependences(problem: Problem, parts: Sequence[Linearization], stacked: Stack, channel: str,
                covariates: Covariates) -> tuple[Dependence, ...]:
    """The covariates that the disagreement of a channel goes with, the most telling first.

    Args:
        problem: the accepted problem.
        parts: its linearizations at the fit.
        stacked: its rows at the fit.
        channel: kind of measurement.
        covariates: gives what the disagreement may go with.
    """
    arcs = [a for a in (s.training() for s in series_of(problem, parts, stacked, channel))
            if len(a.time) >= FEWEST_IN_PIECE and a.time[-1] > a.time[0]]
    if len(arcs) < FEWEST_ARCS:
        return ()
    time = np.concatenate([a.time for a in arcs])
    order = np.argsort(time, kind="stable")  # a trajectory is asked for at rising times
    back = np.argsort(order, kind="stable")
    edges = np.cumsum([0, *(len(a.time) for a in arcs)])
    width = arcs[0].whitened.shape[1]
    tried: list[_Relation] = []
    reduced: dict[bytes, _Reduced] = {}
    looks = 0
    for name, covariate in covariates(channel, time[order]).items():
        values = np.asarray(covariate.values, dtype=float)[back]
        values = values[:, None] * np.ones(width) if values.ndim == 1 else values
        known = np.isfinite(values).all(axis=1)
        masks = [known[a:b] for a, b in pairwise(edges)]
        chosen = [i for i, m in enumerate(masks) if m.sum() >= max(FEWEST_IN_PIECE, KNOWN * len(m))]
        if len(chosen) < FEWEST_ARCS:
            continue
        key = np.concatenate([masks[i] if i in chosen else np.zeros_like(masks[i]) for i in range(len(arcs))])
        if key.tobytes() not in reduced:
            reduced[key.tobytes()] = _reduced([arcs[i].where(masks[i]) for i in chosen], stacked)
        relations, tests = _relations(reduced[key.tobytes()], name, covariate, values[key], stacked)
        looks += tests
        tried += relations
    return _told(_named(tried, looks), channel, width, looks)


def _inverse_root(matrix: np.ndarray) -> np.ndarray:
    """(r, n) rows that whiten numbers of this covariance, directions that the fit absorbs left out."""
    values, vectors = np.linalg.eigh(matrix)
    kept = values > ABSORBED
    if kept.all():  # symmetric: a number stays that of its arc
        return (vectors / np.sqrt(values)) @ vectors.T
    return (vectors[:, kept] / np.sqrt(values[kept])).T


def _reduced(arcs: Sequence[ArcSeries], stacked: Stack) -> _Reduced:
    """The numbers of a channel's arcs."""
    smooth, carried, amounts = [], [], []
    width, size = arcs[0].whitened.shape[1], stacked.basis.shape[1]
    for a in arcs:
        phase = 2 * (a.time - a.time[0]) / max(float(a.time[-1] - a.time[0]), 1e-9) - 1
        q, r = np.linalg.qr(legvander(phase, SMOOTH - 1))
        q = q * np.where(np.diag(r) < 0, -1.0, 1.0)  # the same sign in every arc
        smooth.append(q)
        amounts.append(q.T @ a.whitened)
        if a.rows is None:
            carried.append(np.zeros((SMOOTH, width, size)))
        else:
            carried.append(np.stack([q.T @ stacked.basis[a.rows[:, c]] for c in range(width)], axis=1))
    left = stacked.basis.T @ stacked.residual  # nothing at a converged fit
    roots, numbers = [], []
    for low, high in STRATA:
        inner = np.concatenate([c[low:high].reshape(-1, size) for c in carried])
        value = np.concatenate([y[low:high].ravel() for y in amounts])
        root = _inverse_root(np.eye(len(inner)) - inner @ inner.T) if np.any(inner) else np.eye(len(inner))
        roots.append(root)
        numbers.append(root @ (value - inner @ left))
    plain = _Reduced(arcs, smooth, carried, roots, numbers, [np.zeros((len(r), 0)) for r in roots])
    # The same curve in every arc, in each component: a constant in all strata, beside it the stratum's own orders.
    curves = np.concatenate([q * np.sqrt(len(q)) for q in smooth])
    shared = [_designs(plain, c, curves, stacked) for c in range(width)]
    common = []
    for k, (low, high) in enumerate(STRATA):
        orders = [0, *range(max(low, 1), high)]
        common.append(_span(np.concatenate([s[k][:, orders] for s in shared], axis=1)))
    return replace(plain, common=common, numbers=[y - b @ (b.T @ y) for y, b in zip(numbers, common, strict=True)])


def _span(columns: np.ndarray) -> np.ndarray:
    """Orthonormal columns of the same span."""
    left, singular, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(left[:, singular > 1e-6 * max(float(singular.max(initial=0.0)), 1e-300)])


def _forms(covariate: Covariate, x: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """Functions (n, k) of a covariate (n,), the simplest first; none where it does not change."""
    if covariate.angle:
        first = np.column_stack([np.cos(x), np.sin(x)])
        if not np.ptp(first, axis=0).max() > 1e-6:
            return []
        return [("one harmonic", first), ("two harmonics", np.column_stack([first, np.cos(2 * x), np.sin(2 * x)]))]
    spread = float(np.std(x))
    if not spread > 1e-9 * max(float(np.abs(x).max()), 1e-300):
        return []
    scaled = (x - x.mean()) / spread
    square = scaled**2 - 1
    square = square - scaled * (scaled @ square) / (scaled @ scaled)
    forms = [("linear", scaled[:, None])]
    if np.sqrt(np.mean(square**2)) > 0.05:  # a flag of two values has no curvature
        forms.append(("quadratic", np.column_stack([scaled, square])))
    return forms


def _relations(reduced: _Reduced, name: str, covariate: Covariate, values: np.ndarray,
               stacked: Stack) -> tuple[list[_Relation], int]:
    """Every relation with a covariate (n, m), in each component and in all of them, and the number of tests made."""
    width = values.shape[1]
    forms = [dict(_forms(covariate, values[:, c])) for c in range(width)]
    found, tests = [], 0
    for form in dict.fromkeys(f for known in forms for f in known):
        able = [c for c in range(width) if form in forms[c]]
        designs = {c: _designs(reduced, c, forms[c][form], stacked) for c in able}
        groups = [(c,) for c in able] + ([tuple(able)] if len(able) > 1 else [])
        for group in groups:
            joined = [np.concatenate([designs[c][k] for c in group], axis=1) for k in range(len(STRATA))]
            smallest = 1.0
            for number, design, base, (low, high) in zip(reduced.numbers, joined, reduced.common, STRATA, strict=True):
                p, made = _tested(number, design, base.shape[1], len(reduced.arcs), (high - low) * width)
                tests += made
                smallest = min(smallest, p)
            found.append(_Relation(reduced, group, name, covariate.unit, form, smallest, joined,
                                   float(np.std(values[:, group[0]]))))
    return found, tests


def _designs(reduced: _Reduced, component: int, functions: np.ndarray, stacked: Stack) -> list[np.ndarray]:
    """Per stratum (r, k): the numbers that functions (n, k) in one component leave, the fit refitted."""
    edges = np.cumsum([0, *(len(a.time) for a in reduced.arcs)])
    pieces = [functions[a:b] for a, b in pairwise(edges)]
    felt = [a.response[:, :, component, None] * piece[:, None, :]
            for a, piece in zip(reduced.arcs, pieces, strict=True)]  # (n, m, k)
    absorbed = np.zeros((stacked.basis.shape[1], functions.shape[1]))
    for a, columns in zip(reduced.arcs, felt, strict=True):
        if a.rows is not None:
            absorbed += stacked.basis[a.rows.ravel()].T @ columns.reshape(-1, functions.shape[1])
    whole = [np.tensordot(q, columns, (0, 0)) - c @ absorbed
             for q, columns, c in zip(reduced.smooth, felt, reduced.carried, strict=True)]
    result = []
    for (low, high), root, base in zip(STRATA, reduced.roots, reduced.common, strict=True):
        design = root @ np.concatenate([b[low:high].reshape(-1, functions.shape[1]) for b in whole])
        result.append(design - base @ (base.T @ design))
    return result


def _tested(y: np.ndarray, x: np.ndarray, taken: int, arcs: int, each: int) -> tuple[float, int]:
    """p-value of a regression of the arcs' numbers in one stratum, and whether there was a test (0 or 1).

    Args:
        y: (r,) numbers, what is common to all arcs projected out.
        x: (r, k) functions likewise.
        taken: directions that were projected out.
        arcs: number of arcs.
        each: numbers of an arc in this stratum.
    """
    size = np.sqrt(np.sum(x * x, axis=0))
    if not np.all(size > 1e-6):
        return 1.0, 0
    left, singular, _ = np.linalg.svd(x / size, full_matrices=False)
    freedom = x.shape[1]
    # The numbers of one arc may go together, so that an arc counts once whatever the number of components.
    spare = min(arcs - taken / each - freedom, float(len(y) - taken - freedom))
    if singular[-1] < 1e-4 * singular[0] or spare < 1:
        return 1.0, 0
    if len(y) == arcs * each:
        part = np.sum(left.reshape(arcs, each * freedom) ** 2, axis=1)
        if freedom**2 < FEWEST_ARCS * np.sum(part**2):  # carried by one or two arcs: that is no relation
            return 1.0, 0
    amounts = left.T @ y
    explained = float(amounts @ amounts)
    rest = y - left @ amounts
    if arcs >= MANY_ARCS and len(y) == arcs * each:
        # Arcs side by side share what is slow: fewer independent numbers than arcs (Bartlett 1935).
        rows = rest.reshape(arcs, each)
        rho = float(np.sum(rows[1:] * rows[:-1]) / max(np.sum(rows**2), 1e-300))
        wave = left.reshape(arcs, each * freedom)
        own = float(np.sum(wave[1:] * wave[:-1]) / max(np.sum(wave**2), 1e-300))
        product = max(rho, 0.0) * max(own, 0.0)
        spare = max(1.0, spare * (1 - product) / (1 + product))
    scatter = max(float(rest @ rest) / spare, 1e-300)
    return max(float(fdtrc(freedom, spare, explained / freedom / scatter)), float(chdtrc(freedom, explained))), 1


def _drop(numbers: Sequence[np.ndarray], designs: Sequence[np.ndarray]) -> tuple[float, np.ndarray]:
    """Drop of the sum of squares of all strata by a common size of each function, and the sizes (k,)."""
    gram = sum(x.T @ x for x in designs)
    right = sum(x.T @ y for x, y in zip(designs, numbers, strict=True))
    size = np.linalg.lstsq(np.asarray(gram), np.asarray(right), rcond=1e-8)[0]
    return float(np.asarray(right) @ size), size


def _named(tried: Sequence[_Relation], looks: int) -> list[tuple[_Relation, tuple[str, ...]]]:
    """Relations that hold beside one another, each with the names of those that explain the same."""
    left = sorted((t for t in tried if t.p_value * looks < LEVEL), key=lambda t: -t.worth)
    named: list[tuple[_Relation, tuple[str, ...]]] = []
    while left and len(named) < MOST:
        best = [t for t in left if t.worth > left[0].worth - ALIKE]
        first = min(best, key=lambda t: t.designs[0].shape[1])  # the simplest of what explains it equally well
        alike = [t for t in best if t.name != first.name]
        named.append((first, tuple(dict.fromkeys(t.name for t in alike))))
        # What is told beyond that.
        left = [t for t in left if t.name != first.name and t not in best and _beyond(named, t) * looks < LEVEL]
    return named


def _beyond(named: Sequence[tuple[_Relation, tuple[str, ...]]], other: _Relation) -> float:
    """p-value of a relation beside those that are named already, in the stratum where it tells most."""
    best = 1.0
    for k, (low, high) in enumerate(STRATA):
        taken = [r.designs[k] for r, _ in named]
        number, design = other.reduced.numbers[k], other.designs[k]
        if any(len(t) != len(design) for t in taken):
            continue  # other samples: no comparison
        base = _span(np.concatenate(taken, axis=1))
        each = (high - low) * other.reduced.arcs[0].whitened.shape[1]
        # Of the arcs' numbers each function that is named already takes one.
        p, _ = _tested(number - base @ (base.T @ number), design - base @ (base.T @ design),
                       base.shape[1] * each + other.reduced.common[k].shape[1], len(other.reduced.arcs), each)
        best = min(best, p)
    return best


def _told(named: Sequence[tuple[_Relation, tuple[str, ...]]], channel: str, width: int,
          looks: int) -> tuple[Dependence, ...]:
    which = {"doppler": "beam", "star_tracker": "axis", "gnss": "axis"}.get(channel, "component")
    result = []
    for relation, alike in named:
        reduced = relation.reduced
        arcs, noise = reduced.arcs, reduced.arcs[0].noise
        unit, shown = arcs[0].unit, relation.components
        drop, size = _drop(reduced.numbers, relation.designs)
        total = sum(float(y @ y) - max(len(y) - b.shape[1], 0)
                    for y, b in zip(reduced.numbers, reduced.common, strict=True))
        share = float(np.clip((drop - len(size)) / max(total, 1e-12), 0.0, 1.0))
        # What shows in the data, the other unknowns giving way: a part that they take up has no size that is known.
        felt = sum(float(np.sum(a.response[:, :, list(shown)] ** 2)) for a in arcs)
        excess, floor = float(np.sqrt(drop / felt)), float(np.sqrt(np.mean(noise[list(shown)] ** 2)))
        slope = float(size[0]) / relation.spread if relation.form == "linear" and len(shown) == 1 else None
        verb = "varies with" if slope is None else "grows with" if slope > 0 else "falls with"
        parts = ("all " + ("beams" if which == "beam" else "axes") if len(shown) == width > 1 else
                 f"{which} " + ", ".join(str(c) for c in shown))
        value, least, word = _readable(excess, floor, unit)
        sentence = (f"{channel.replace('_', ' ')}, {parts}: {verb} {relation.name}: {value:.3g} {word} RMS over "
                    f"{least:.3g} {word}, {100 * share:.0f} % of the excess about its mean")
        if alike:
            sentence += f" (as well with {', '.join(alike)})"
        result.append(Dependence(channel, shown, relation.name, relation.unit, relation.form,
                                 min(1.0, relation.p_value * looks), share, excess, floor, unit, slope, alike,
                                 sentence))
    return tuple(result)
