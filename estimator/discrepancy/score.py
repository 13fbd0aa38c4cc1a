"""Which effect: score, expected size and sigma of everything in the library, calibration unknowns projected out.

For each candidate the columns B of the whitened Jacobian along its parameters, at the accepted fit, are its signature.
What the unknowns of the fit can absorb is projected out, ``B~ = B - A (A'A)^-1 A'B``. The score
``r'B~ (B~'B~)^-1 B~'r`` is chi-square with as many degrees of freedom as visible directions when the effect is absent.
Effects with a searched parameter (a jump's time, a mode's frequency) have one signature per value tried.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from estimator.chance import chi2_quantile, chi2_tail, noncentral_chi2_below
from estimator.effects.declaration import EffectInstance
from estimator.problem import Problem
from estimator.residuals import Linearization
from estimator.unknowns import Unknown, offsets

INVISIBLE = 1e-8
"""Part of a signature's squared size left after projection below which it carries no evidence (1e-4 of its size)."""


@dataclass(frozen=True, eq=False)
class Signature:
    """The columns of one candidate at one setting of its searched parameters.

    Attributes:
        effect: the candidate.
        setting: its start values (parameters,), searched ones at the value tried.
        ordinary: indices of the ordinary parameters, those of the columns.
        parts: of each residual that the effect touches, by name, its rows (n, ordinary) of the columns, whitened and
            weighted, scaled by the parameters' scales.
        blocks: rows of each residual by name.
    """

    effect: EffectInstance
    setting: np.ndarray
    ordinary: np.ndarray
    parts: Mapping[str, np.ndarray]
    blocks: Mapping[str, slice]

    @cached_property
    def columns(self) -> np.ndarray:
        """(rows, ordinary) the columns on all rows."""
        result = np.zeros((max((b.stop for b in self.blocks.values()), default=0), len(self.ordinary)))
        for name, part in self.parts.items():
            result[self.blocks[name]] = part
        return result


@dataclass(frozen=True, eq=False)
class Score:
    """One line of the score table.

    Attributes:
        name: of the effect's instance.
        setting: values of all parameters at which the signature was taken.
        score: drop of the sum of squares that the linearized effect would bring.
        degrees: visible directions.
        p_value: chi-square probability of such a score without the effect, before the search is accounted for.
        size: expected values of all parameters.
        sigma: their standard deviations (infinite where absorbed).
        visible: part of the signature's squared size that the calibration does not absorb.
        absorbed_by: names of the unknowns that absorb it most, where little is left.
        evidence: log odds for the effect against the accepted model, with the declared sizes as the prior.
        power: probability to see it at its typical size at the 1 % level.
    """

    name: str
    setting: np.ndarray
    score: float
    degrees: int
    p_value: float
    size: np.ndarray
    sigma: np.ndarray
    visible: float
    absorbed_by: tuple[str, ...]
    evidence: float
    power: float


@dataclass(frozen=True, eq=False)
class Piece:
    """The rows of one residual in a stack.

    Attributes:
        rows: where they are.
        felt: (f,) columns of the fit's Jacobian that these rows can feel; all others are zero here.
        jacobian: (n, f) those columns, scaled.
        span: (n, g) orthonormal columns of the same span.
        inner: (g, p) ``span @ inner`` are the rows of the stack's basis.
    """

    rows: slice
    felt: np.ndarray
    jacobian: np.ndarray
    span: np.ndarray
    inner: np.ndarray


@dataclass(frozen=True, eq=False)
class Stack:
    """All whitened rows of a problem at one point, with the fit's columns orthonormalized.

    An arc feels a dozen of the fit's hundreds of columns, so everything goes residual by residual.

    Attributes:
        residual: (rows,).
        pieces: the rows of each residual by name.
        columns: the unknowns of the fit.
        scale: factor by which each residual's noise exceeds the declared one (by name).
    """

    residual: np.ndarray
    pieces: Mapping[str, Piece]
    columns: tuple[Unknown, ...]
    scale: Mapping[str, float]

    @cached_property
    def blocks(self) -> Mapping[str, slice]:
        """Rows of each residual by name."""
        return {name: piece.rows for name, piece in self.pieces.items()}

    @cached_property
    def basis(self) -> np.ndarray:
        """(rows, p) orthonormal columns spanning the fit's Jacobian."""
        return np.concatenate([p.span @ p.inner for p in self.pieces.values()])

    @cached_property
    def jacobian(self) -> np.ndarray:
        """(rows, p) the fit's Jacobian, scaled."""
        result = np.zeros((len(self.residual), sum(u.manifold.tangent for u in self.columns)))
        for piece in self.pieces.values():
            result[piece.rows, piece.felt] = piece.jacobian
        return result

    @cached_property
    def gram(self) -> np.ndarray:
        """(p, p) the Jacobian's product with itself."""
        size = sum(u.manifold.tangent for u in self.columns)
        result = np.zeros((size, size))
        for piece in self.pieces.values():
            result[np.ix_(piece.felt, piece.felt)] += piece.jacobian.T @ piece.jacobian
        return result

    def along(self, candidate: Signature) -> np.ndarray:
        """Products (p, k) of the fit's Jacobian with the columns of a candidate."""
        result = np.zeros((sum(u.manifold.tangent for u in self.columns), len(candidate.ordinary)))
        for name, part in candidate.parts.items():
            result[self.pieces[name].felt] += self.pieces[name].jacobian.T @ part
        return result

    def carried(self, columns: np.ndarray) -> np.ndarray:
        """Products of the basis with ``columns`` (rows, ...)."""
        return np.asarray(sum(p.inner.T @ (p.span.T @ columns[p.rows]) for p in self.pieces.values()))

    def projected(self, columns: np.ndarray) -> np.ndarray:
        """The part of ``columns`` (rows, ...) that the fit does not absorb."""
        carried = self.carried(columns)
        result = np.empty_like(columns)
        for p in self.pieces.values():
            result[p.rows] = columns[p.rows] - p.span @ (p.inner @ carried)
        return result


def orthonormalized(residual: np.ndarray, jacobians: Mapping[str, tuple[np.ndarray, np.ndarray]],
                    columns: tuple[Unknown, ...], scale: Mapping[str, float]) -> Stack:
    """The stack of residuals with the fit's columns made orthonormal, directions that the data do not see left out.

    Args:
        residual: (rows,) of all residuals, one after the other.
        jacobians: of each residual by name, the columns (f,) that it feels and its scaled Jacobian (n, f) along them.
        columns: the unknowns of the fit.
        scale: see :class:`Stack`.
    """
    total = sum(u.manifold.tangent for u in columns)
    spans, triangles = [], []
    for felt, jacobian in jacobians.values():
        span, triangle = np.linalg.qr(jacobian)
        wide = np.zeros((len(triangle), total))
        wide[:, felt] = triangle
        spans.append(span)
        triangles.append(wide)
    # The triangles stand for the rows: a few hundred of them instead of tens of thousands.
    left, singular, _ = np.linalg.svd(np.concatenate(triangles), full_matrices=False)
    kept = singular**2 > max(1e-14 * float(np.max(singular, initial=0.0)) ** 2, 1e-12)
    pieces, start, row = {}, 0, 0
    for (name, (felt, jacobian)), span in zip(jacobians.items(), spans, strict=True):
        inner = left[row : row + span.shape[1], kept]
        row += span.shape[1]
        pieces[name] = Piece(slice(start, start + len(jacobian)), felt, jacobian, span, inner)
        start += len(jacobian)
    return Stack(residual, pieces, columns, scale)


def rows_of(part: Linearization, unknowns: Sequence[Unknown], scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Weighted residual rows (n m,) and Jacobian (n m, p) of one residual along ``unknowns``, in prior sigmas."""
    root = np.sqrt(part.weight) / scale
    residual = (part.whitened * root[:, None]).ravel()
    columns = offsets(unknowns)
    jacobian = np.zeros((len(residual), sum(u.manifold.tangent for u in unknowns)))
    position = 0
    for u in part.columns:
        width = u.manifold.tangent
        if u.name in columns:
            piece = part.jacobian[:, :, position : position + width] * root[:, None, None] * u.scales
            jacobian[:, columns[u.name]] = piece.reshape(len(residual), width)
        position += width
    return residual, jacobian


def white_noise_scale(part: Linearization) -> float:
    """Standard deviation of the whitened residual from successive differences, which smooth signatures hardly touch."""
    kept = part.weight > 0
    whitened = part.whitened[kept]
    if whitened.shape[1] == 1 or len(whitened) < 20:
        return 1.0
    second = whitened[2:] - 2 * whitened[1:-1] + whitened[:-2]
    centre = np.median(np.abs(second), axis=0) / 0.6745
    return float(np.sqrt(np.mean(centre**2) / 6.0))


def stack(problem: Problem, parts: Sequence[Linearization]) -> Stack:
    """Stack the residuals of ``problem`` linearized at its fit.

    Rows of a residual whose white noise clearly exceeds the declared one are divided by the excess, so that too small
    a declared noise is not taken for an effect.
    """
    unknowns = problem.free
    places = offsets(unknowns)
    residuals, jacobians, scales = [], {}, {}
    for residual, part in zip(problem.residuals, parts, strict=True):
        noise = white_noise_scale(part)
        count = max(int(np.sum(part.weight > 0)) * part.whitened.shape[1], 1)
        scale = noise if noise > 1 + 6 / np.sqrt(count) and unknowns else 1.0
        felt = tuple(u for u in unknowns if any(c.name == u.name for c in part.columns))
        r, j = rows_of(part, felt, scale)
        index = np.concatenate([np.zeros(0, dtype=int), *(np.arange(places[u.name].start, places[u.name].stop)
                                                          for u in felt)])
        residuals.append(r)
        jacobians[residual.name] = index, j
        scales[residual.name] = scale
    return orthonormalized(np.concatenate(residuals), jacobians, unknowns, scales)


def signature(stacked: Stack, problem: Problem, parts: Sequence[Linearization], effect: EffectInstance,
              setting: np.ndarray, *, whole: bool = False) -> Signature:
    """The columns of one candidate, on the rows of ``stacked``.

    Args:
        stacked: rows of the accepted fit.
        problem: a problem with the candidate in its kernels; residuals are matched by name and size.
        parts: its linearizations with the candidate at ``setting``.
        effect: the candidate.
        setting: start values of the candidate's parameters.
        whole: take the columns of the searched parameters too, which have a direction where the effect is not zero.
    """
    ordinary = np.array([i for i, p in enumerate(effect.parameters) if whole or p.search is None], dtype=int)
    unknown = problem.unknown(effect.name)
    typical = np.array([p.scale for p in effect.parameters]) / unknown.scales
    found = {}
    for residual, part in zip(problem.residuals, parts, strict=True):
        if all(u.name != effect.name for u in residual.unknowns) or residual.name not in stacked.blocks:
            continue
        rows = stacked.blocks[residual.name]
        _, block = rows_of(part, (unknown,), stacked.scale[residual.name])
        if rows.stop - rows.start == len(block):
            found[residual.name] = (block * typical)[:, ordinary]
    return Signature(effect, setting, ordinary, found, stacked.blocks)


def on_rows(candidate: Signature, stacked: Stack) -> Signature:
    """The same signature on the rows of another stack; residuals are matched by name."""
    parts = {name: part if stacked.scale[name] == 1 else part / stacked.scale[name]
             for name, part in candidate.parts.items() if name in stacked.blocks}
    return Signature(candidate.effect, candidate.setting, candidate.ordinary, parts, stacked.blocks)


@dataclass(frozen=True, eq=False)
class Products:
    """All that scores need of the columns of some signatures, one after the other.

    Attributes:
        places: the columns of each signature.
        raw: (m, m) products of the columns with each other.
        left: (m, m) the same of what the fit does not absorb of them.
        against: (m, k) products of what the fit does not absorb with the given rows.
    """

    places: tuple[slice, ...]
    raw: np.ndarray
    left: np.ndarray
    against: np.ndarray


def products(stacked: Stack, signatures: Sequence[Signature], right: np.ndarray,
             absorbed: np.ndarray | None = None) -> Products:
    """Products of signatures with each other and with ``right`` (rows, k), the fit's columns projected out.

    With Q the orthonormal columns of the fit, what is left of columns B has the products ``B'B - (Q'B)'(Q'B)``: a
    visible part of 1e-8 of the square is right to 1e-7. ``absorbed`` is ``Q'right`` where it is known already.
    """
    edges = np.cumsum([0, *(len(s.ordinary) for s in signatures)])
    raw, direct = np.zeros((edges[-1], edges[-1])), np.zeros((edges[-1], right.shape[1]))
    absorbed = stacked.carried(right) if absorbed is None else absorbed
    carried = np.zeros((len(absorbed), edges[-1]))
    for name, piece in stacked.pieces.items():
        touching = [(np.arange(a, b), s.parts[name]) for s, (a, b) in zip(signatures, pairwise(edges), strict=True)
                    if name in s.parts]
        if not touching:
            continue
        index = np.concatenate([place for place, _ in touching])
        columns = np.concatenate([part for _, part in touching], axis=1) if len(touching) > 1 else touching[0][1]
        raw[np.ix_(index, index)] += columns.T @ columns
        carried[:, index] += piece.inner.T @ (piece.span.T @ columns)
        direct[index] += columns.T @ right[piece.rows]
    places = tuple(slice(int(a), int(b)) for a, b in pairwise(edges))
    return Products(places, raw, raw - carried.T @ carried, direct - carried.T @ absorbed)


def scored(stacked: Stack, candidate: Signature) -> Score:
    """Score one candidate at one setting."""
    return score_of(stacked, candidate, products(stacked, (candidate,), stacked.residual[:, None]), 0)


def score_of(stacked: Stack, candidate: Signature, given: Products, number: int) -> Score:
    """Score a candidate, the columns of which are those with this number in products with the stack's residual."""
    place = given.places[number]
    raw, matrix, gradient = given.raw[place, place], given.left[place, place], given.against[place, 0]
    scales = np.array([candidate.effect.parameters[i].scale for i in candidate.ordinary])
    size_raw = np.sqrt(np.maximum(np.diag(raw), 1e-300))
    relative = matrix / np.outer(size_raw, size_raw)
    eigenvalues, vectors = np.linalg.eigh(relative)
    visible = (eigenvalues > INVISIBLE) & (eigenvalues > 0)
    # A direction whose whole signature at a typical size stays below a hundredth of a sigma carries nothing either.
    unit = (vectors / size_raw[:, None]).T
    strength = np.einsum("ki,ij,kj->k", unit, matrix, unit) / np.maximum(np.sum(unit**2, axis=1), 1e-300)
    visible &= strength > 1e-4
    degrees = int(visible.sum())
    size = np.array(candidate.setting, dtype=float)
    sigma = np.full(len(size), np.inf)
    if degrees == 0:
        return Score(candidate.effect.name, candidate.setting, 0.0, 0, 1.0, size, sigma, 0.0,
                     _absorbers(stacked, candidate), -np.inf, 0.0)
    back = vectors[:, visible] / size_raw[:, None]
    inverse = (back / eigenvalues[visible]) @ back.T
    step = -inverse @ gradient
    score = float(gradient @ inverse @ gradient)
    size[candidate.ordinary] += step * scales
    spread = np.sqrt(np.diag(inverse)) * scales
    hidden = vectors[:, ~visible]
    exposed = np.sum(hidden**2, axis=1) < 1e-6 if hidden.size else np.ones(len(spread), dtype=bool)
    sigma[candidate.ordinary] = np.where(exposed, spread, np.inf)
    share = float(np.trace(matrix) / max(np.trace(raw), 1e-300))
    evidence = log_evidence(candidate.effect, candidate.ordinary, matrix, -gradient)
    evidence -= float(np.log(len(settings(candidate.effect))))  # the best of so many settings is taken
    typical = float(np.trace(matrix)) / len(scales)
    power = float(1 - noncentral_chi2_below(chi2_quantile(0.99, degrees), degrees, min(typical, 1e4)))
    return Score(candidate.effect.name, candidate.setting, score, degrees, float(chi2_tail(score, degrees)), size,
                 sigma, share, _absorbers(stacked, candidate) if share < 1e-3 else (), evidence, power)


def log_evidence(effect: EffectInstance, ordinary: np.ndarray, information: np.ndarray, gradient: np.ndarray) -> float:
    """Log odds of the linear effect against none, Gaussian prior of the declared sizes, in units of scales.

    Args:
        effect: with its parameters' scales (prior sigma) and nominal values.
        ordinary: indices of the parameters of the columns.
        information: (k, k) projected information in units of scales.
        gradient: (k,) projected ``B~'(-r)``.
    """
    centre = np.array([(effect.parameters[i].nominal or 0.0) / effect.parameters[i].scale for i in ordinary])
    width = np.array([_prior_width(effect, int(i)) for i in ordinary])
    shifted = gradient - information @ centre
    fixed = float(gradient @ centre - 0.5 * centre @ information @ centre)
    inner = np.eye(len(width)) + information * np.outer(width, width)
    solved = np.linalg.solve(inner, width * shifted)
    _, determinant = np.linalg.slogdet(inner)
    return fixed + 0.5 * float((width * shifted) @ solved) - 0.5 * float(determinant)


def _prior_width(effect: EffectInstance, index: int) -> float:
    """Prior sigma of a parameter in units of its scale: a few per cent of a known size, a few typical sizes else."""
    parameter = effect.parameters[index]
    if parameter.nominal is not None:
        return 0.02 * abs(parameter.nominal) / parameter.scale
    return 3.0


def _absorbers(stacked: Stack, candidate: Signature) -> tuple[str, ...]:
    """Unknowns of the fit whose movement imitates the signature most, largest first."""
    gram = stacked.gram
    regular = gram + 1e-12 * np.trace(gram) / len(gram) * np.eye(len(gram))
    solution = np.linalg.solve(regular, stacked.along(candidate))
    moved = {u.name: float(np.sqrt(max(np.sum(solution[c] * (gram[c, c] @ solution[c])), 0.0)))
             for u, c in zip(stacked.columns, offsets(stacked.columns).values(), strict=True)}
    largest = max(moved.values(), default=0.0)
    return tuple(k for k, v in sorted(moved.items(), key=lambda item: -item[1]) if v > 0.1 * largest)[:4]


def settings(effect: EffectInstance) -> list[np.ndarray]:
    """Start values to try: one for an ordinary effect, the grid of the first searched parameter else.

    Further searched parameters (a mode's damping beside its frequency) shape a signature far less; they stay at the
    middle of their range until the refit.
    """
    grid: list[np.ndarray] = []
    first = True
    start = np.zeros(len(effect.parameters))
    values = np.zeros(1)
    index = None
    for i, p in enumerate(effect.parameters):
        if p.search is None:
            continue
        if first:
            values = p.search.values()
            index, first = i, False
        else:
            start[i] = p.search.middle()
    for value in values:
        setting = start.copy()
        if index is not None:
            setting[index] = value
        grid.append(setting)
    return grid
