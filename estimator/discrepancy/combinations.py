"""Which effects together: the data as a linear model of the whole library around one fit, and a search over sets.

Around a fit the whitened residuals are linear in the parameters of every effect. With the unknowns of the plain problem
projected out, all that a set of effects can explain follows from one Gram matrix of the signatures and their products
with the residuals, so that thousands of sets are compared in the time of one refit and no early choice has to stand.

The worth of a set is half the drop of the sum of squares, less what a free parameter explains of pure noise: a fixed
price for each visible direction, the logarithm of the number of settings of a searched parameter, and a price for each
name. No guess of a typical size enters, so that two names that fit alike are worth alike; a size must stay in its
plausible range, which is the width of a prior and a limit. An effect whose size physics fixes has no free direction: it
is taken at that size.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from estimator.discrepancy.score import INVISIBLE, settings
from estimator.effects.declaration import EffectInstance

PER_DIRECTION = 1.5
"""Price of a free visible direction: noise explains more in 8 % of the cases for one, 0.6 % for six. Whether an effect
is there at all is for its significance after the search to say; the price only weighs names against each other."""
PER_NAME = 2.0
COLLINEAR = 1e-7  # relative eigenvalue below which directions of a set are one
MARGIN = 4.0  # sigma beyond the plausible range that a size may have, a quarter of half the range at most
PAIRED = 16  # strongest names beside a set that are tried two at a time
CURVED = 0.1  # part of a size that the linear model may be wrong by


@dataclass(frozen=True, eq=False)
class Candidate:
    """One effect at one setting of its searched parameters, as columns of the linear model.

    Attributes:
        effect: the declaration.
        setting: values of all parameters at which the columns were taken.
        parameters: indices of the parameters of the columns.
        columns: place in the Gram matrix.
        visible: (columns, degrees) orthonormal visible directions: ``visible' G visible`` is the unit matrix.
        nominal: (columns,) parameters in their scales where physics fixes them, else None.
    """

    effect: EffectInstance
    setting: np.ndarray
    parameters: np.ndarray
    columns: np.ndarray
    visible: np.ndarray
    nominal: np.ndarray | None

    @property
    def name(self) -> str:
        return self.effect.name

    @property
    def degrees(self) -> int:
        """Number of visible directions."""
        return int(self.visible.shape[1])

    @property
    def scales(self) -> np.ndarray:
        return np.array([self.effect.parameters[i].scale for i in self.parameters])


def _half_range(candidate: Candidate) -> np.ndarray:
    """Half the plausible range of each column's parameter, in its scale."""
    parameters = [candidate.effect.parameters[k] for k in candidate.parameters]
    return np.array([max(p.plausible[1] - p.plausible[0], abs(p.plausible[0]), abs(p.plausible[1])) / 2 / p.scale
                     for p in parameters])


def price(effect: EffectInstance, degrees: int) -> float:
    """What a set pays for holding this effect with so many visible directions."""
    free = 0 if any(p.nominal is not None for p in effect.parameters) else degrees
    return PER_NAME + PER_DIRECTION * free + float(np.log(len(settings(effect))))


def visible_directions(raw: np.ndarray, projected: np.ndarray) -> np.ndarray:
    """Visible directions (k, degrees) of columns with Gram matrix ``raw`` before and ``projected`` after projection."""
    size = np.sqrt(np.maximum(np.diag(raw), 1e-300))
    eigenvalues, vectors = np.linalg.eigh(projected / np.outer(size, size))
    directions = vectors / size[:, None]
    strength = eigenvalues / np.maximum(np.sum(directions**2, axis=0), 1e-300)
    # What the calibration absorbs, and what at a typical size stays below a hundredth of a sigma, is not seen.
    kept = (eigenvalues > max(INVISIBLE, 1e-14)) & (strength > 1e-4)
    return np.asarray(directions[:, kept] / np.sqrt(eigenvalues[kept]))


@dataclass(frozen=True)
class Explained:
    """What a set of candidates explains.

    Attributes:
        drop: of the sum of squares.
        worth: half of it, less the prices.
        sizes: per candidate the values of its parameters.
        plausible: whether all sizes are.
    """

    drop: float
    worth: float
    sizes: tuple[np.ndarray, ...]
    plausible: bool


@dataclass(frozen=True, eq=False)
class _Solution:
    """The linear solution of a set: the candidates with free sizes and those that physics fixes, half the drop, the
    worth, and the eigenvalues, eigenvectors and products with them of the free ones' visible directions."""

    free: list[int]
    fixed: list[int]
    half: float
    worth: float
    eigenvalues: np.ndarray
    vectors: np.ndarray
    along: np.ndarray


class _Limits:
    """Scales (k,) of a candidate's columns, and which of them are ordinary parameters, with their plausible range."""

    def __init__(self, candidate: Candidate):
        parameters = candidate.effect.parameters
        self.scales = candidate.scales
        self.ordinary = np.array([parameters[k].search is None for k in candidate.parameters], dtype=bool)
        self.parameters = np.asarray(candidate.parameters, dtype=int)[self.ordinary]
        self.low, self.high = (np.array([parameters[k].plausible[end] for k in self.parameters]) for end in (0, 1))


class LinearLibrary:
    """The residuals around one fit as a linear model of the library.

    Args:
        candidates: all effects and settings.
        gram: (m, m) of the signatures, calibration projected out, parameters in their scales.
        right: (m,) minus the products of the signatures with the residuals.
    """

    def __init__(self, candidates: Sequence[Candidate], gram: np.ndarray, right: np.ndarray):
        self.candidates = tuple(candidates)
        self._gram, self._right = gram, right
        self._limits = [_Limits(c) for c in self.candidates]
        self._prices = [price(c.effect, c.degrees) for c in self.candidates]
        total = sum(c.degrees for c in candidates)
        change = np.zeros((len(gram), total))
        self._places: list[np.ndarray] = []
        start = 0
        for c in candidates:
            place = np.arange(start, start + c.degrees)
            change[np.ix_(c.columns, place)] = c.visible
            self._places.append(place)
            start += c.degrees
        self._regular = change.T @ gram @ change
        self._product = change.T @ right
        self._across = gram @ change
        # The plausible range as a prior: a direction that only an impossible size would make visible explains nothing.
        for c, place in zip(candidates, self._places, strict=True):
            self._regular[np.ix_(place, place)] += c.visible.T @ (c.visible / _half_range(c)[:, None] ** 2)

    def indices(self, name: str) -> list[int]:
        """Candidates of that name."""
        return [i for i, c in enumerate(self.candidates) if c.name == name]

    def _solved(self, chosen: Sequence[int]) -> _Solution:
        """The amounts of the visible directions of a set that lower the sum of squares most."""
        fixed = [i for i in chosen if self.candidates[i].nominal is not None]
        free = [i for i in chosen if self.candidates[i].nominal is None]
        half = 0.0
        place = np.concatenate([self._places[i] for i in free]) if free else np.zeros(0, dtype=int)
        product = self._product[place]
        if fixed:
            columns = np.concatenate([self.candidates[i].columns for i in fixed])
            amounts = np.concatenate([self.candidates[i].nominal for i in fixed])
            half += float(self._right[columns] @ amounts)
            half -= 0.5 * float(amounts @ self._gram[np.ix_(columns, columns)] @ amounts)
            product = product - self._across[np.ix_(columns, place)].T @ amounts
        eigenvalues, vectors = np.zeros(0), np.zeros((len(place), 0))
        if len(place):
            eigenvalues, vectors = np.linalg.eigh(self._regular[place[:, None], place])
            if eigenvalues[0] <= COLLINEAR:
                kept = eigenvalues > COLLINEAR
                eigenvalues, vectors = eigenvalues[kept], vectors[:, kept]
        along = vectors.T @ product
        half += 0.5 * float(np.sum(along**2 / eigenvalues))
        return _Solution(free, fixed, half, half - sum(self._prices[i] for i in chosen), eigenvalues, vectors, along)

    def explained(self, chosen: Collection[int]) -> Explained:
        """What the candidates ``chosen`` (indices) explain together."""
        chosen = list(chosen)
        return self._told(chosen, self._solved(chosen)) if chosen else Explained(0.0, 0.0, (), True)

    def _told(self, chosen: Sequence[int], solution: _Solution) -> Explained:
        steps = solution.vectors @ (solution.along / solution.eigenvalues)
        spread = (solution.vectors / solution.eigenvalues) @ solution.vectors.T
        sizes, plausible = {}, True
        start = 0
        for i in solution.free:
            c, limits = self.candidates[i], self._limits[i]
            inside = slice(start, start + c.degrees)
            start += c.degrees
            moved = ((c.visible @ steps[inside]) * limits.scales)[limits.ordinary]
            variance = np.diag(c.visible @ spread[inside, inside] @ c.visible.T)
            sigma = (np.sqrt(np.maximum(variance, 0.0)) * limits.scales)[limits.ordinary]
            room = np.minimum(MARGIN * sigma, 0.125 * (limits.high - limits.low)) + CURVED * np.abs(moved)
            plausible &= bool(np.all((moved >= limits.low - room) & (moved <= limits.high + room)))
            value = np.array(c.setting, dtype=float)
            value[limits.parameters] = moved
            sizes[i] = value
        for i in solution.fixed:
            sizes[i] = np.array([p.nominal or 0.0 for p in self.candidates[i].effect.parameters])
        return Explained(2 * solution.half, solution.worth, tuple(sizes[i] for i in chosen), plausible)

    def worth(self, chosen: Collection[int], above: float = -np.inf) -> float:
        """Worth of a set; minus infinity where a size is implausible.

        Whether sizes are plausible is looked at only where the worth is more than ``above``.
        """
        chosen = list(chosen)
        if not chosen:
            return 0.0
        solution = self._solved(chosen)
        if solution.worth > above and not self._told(chosen, solution).plausible:
            return -np.inf
        return solution.worth

    def best_setting(self, chosen: Collection[int], name: str) -> int | None:
        """The candidate of that name that explains most beside ``chosen``, of equals the last; None where none is
        visible.

        Times of a jump in the held-out end of an arc and after it are equals: the last one lies beyond the arc.
        """
        own = [i for i in self.indices(name) if self.candidates[i].degrees]
        if not own:
            return None
        if len(own) == 1:
            return own[0]
        return max(own, key=lambda i: (round(self._solved((*chosen, i)).half, 2), i))

    def names(self) -> list[str]:
        """Names with a visible candidate, in order."""
        return list(dict.fromkeys(c.name for c in self.candidates if c.degrees))

    def best(self, start: Collection[int], excluded: Collection[str], most: int,
             refused: Collection[frozenset[str]] = ()) -> list[int]:
        """The set of at most ``most`` candidates of the highest worth that steps from ``start`` and from nothing reach.

        A step adds a name, takes one away or exchanges one; where no such step is worth it, one name (or none) makes
        place for two: a rich name imitates two simple ones that only together are worth more.

        Args:
            start: indices of a set to begin with.
            excluded: names that may not be taken.
            most: size of the largest set.
            refused: sets of names that may not be returned.
        """
        refused = set(refused)
        names = [n for n in self.names() if n not in excluded]
        best: list[int] = []
        best_worth = 0.0
        for begin in dict.fromkeys((tuple(start), ())):
            here, worth = list(begin), self.worth(begin)
            while True:
                reached = self._step(here, worth, names, most, refused)
                if reached is None:
                    break
                here, worth = reached
            if worth > best_worth + 1e-9 and self._names(here) not in refused:
                best, best_worth = here, worth
        return best

    def copied(self, mine: int, size: np.ndarray, other: int) -> float:
        """Part (0 to 1) of the squared signature of candidate ``mine`` at ``size`` (all its parameters) that ``other``
        imitates."""
        c = self.candidates[mine]
        amounts = np.array([0.0 if c.effect.parameters[k].search else size[k] for k in c.parameters]) / c.scales
        whole = float(amounts @ self._gram[np.ix_(c.columns, c.columns)] @ amounts)
        along = self._across[np.ix_(c.columns, self._places[other])].T @ amounts
        return float(along @ along) / whole if whole > 0 else 0.0

    def exchanged(self, chosen: Sequence[int], forbidden: Collection[str]) -> list[int]:
        """The set of the highest worth that keeps the last candidate of ``chosen`` and has another name for any others.

        Look-alikes come in pairs: the best company of one name is not always that of the other.

        Args:
            chosen: indices; the last one stays.
            forbidden: names that may not be taken.
        """
        best, worth = list(chosen), self.worth(chosen)
        growing = True
        while growing:
            growing = False
            for k in range(len(best) - 1):
                kept = [*best[:k], *best[k + 1 :]]
                present = self._names(best)
                for name in self.names():
                    if name in present or name in forbidden:
                        continue
                    setting = self.best_setting(kept, name)
                    if setting is None:
                        continue
                    value = self.worth([setting, *kept], above=worth)
                    if value > worth + 1e-6:
                        best, worth, growing = [setting, *kept], value, True
                        break
                if growing:
                    break
        return best

    def _names(self, chosen: Iterable[int]) -> frozenset[str]:
        return frozenset(self.candidates[i].name for i in chosen)

    def _step(self, here: list[int], worth: float, names: Sequence[str], most: int,
              refused: Collection[frozenset[str]]) -> tuple[list[int], float] | None:
        """The best set one step away that is worth more than ``here``, or None."""
        best, best_worth = None, worth + 1e-6

        def look(chosen: list[int]) -> None:
            nonlocal best, best_worth
            value = self.worth(chosen, above=best_worth)
            if value > best_worth and self._names(chosen) not in refused:
                best, best_worth = chosen, value

        present = self._names(here)
        for k in range(len(here)):
            look([*here[:k], *here[k + 1 :]])
        kept_sets = [here] if len(here) < most else []
        kept_sets += [[*here[:k], *here[k + 1 :]] for k in range(len(here))]
        for kept in kept_sets:
            for name in names:
                if name in present:
                    continue
                setting = self.best_setting(kept, name)
                if setting is not None:
                    look([*kept, setting])
        if best is not None:
            return best, best_worth
        for kept in kept_sets:
            if len(kept) + 2 > most:
                continue
            alone = {name: i for name in names if name not in present
                     and (i := self.best_setting(kept, name)) is not None}
            strongest = sorted(alone.values(), key=lambda i: -self.explained((*kept, i)).drop)[:PAIRED]
            for a, b in combinations(strongest, 2):
                look([*kept, a, b])
        return None if best is None else (best, best_worth)
