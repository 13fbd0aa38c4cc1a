"""An empirical term for structure that no effect of the library explains: its shape and size, and no name.

For each component of each place where structure is left, a few forms are fitted to the residuals together with
everything that the fit absorbs: one constant per arc, a smooth curve per arc (Legendre polynomials of the arc), a
periodic term with one phase for all arcs, and one with a phase of its own in each arc; periodic ones with up to three
harmonics. The form worth most wins: half the drop of the sum of squares, less the price of its parameters and of the
frequencies looked at. A form that says something about the held-out samples must predict them better than nothing; a
curve of one arc says nothing about the end of the arc that was held out, and is marked so.

It is the reduced-dynamic way of orbit determination (Beutler, Jaeggi, Hugentobler, Mervart, J. Geodesy 80:353, 2006):
it carries the gap, it explains nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.polynomial.legendre import legvander

from estimator.discrepancy.gap import Gap, Place, _readable
from estimator.discrepancy.score import Stack, rows_of
from estimator.discrepancy.series import ArcSeries, series_of
from estimator.problem import Problem
from estimator.residuals import KernelResidual, Linearization

DEGREES = (1, 2, 3, 5, 7)  # of the curve of an arc
HARMONICS = 3
UNDETERMINED = 1e-2  # part of a function's square beside the fit below which its size is not determined
SIMPLER = 4.6  # log odds (100 to 1) by which a form that predicts nothing must be worth more than one that predicts
FEWEST = 16  # samples of an arc that takes part
CHUNK = 2_000_000  # values of a table of waves at a time
_WORDS = {"constant": "one constant per arc", "smooth": "a smooth curve of each arc", "periodic": "a periodic term",
          "periodic by arc": "a periodic term with a phase of its own in each arc"}


@dataclass(frozen=True)
class EmpiricalParameter:
    """One fitted number: ``name``, ``value`` and ``sigma`` in ``unit``; sigma is infinite where not determined."""

    name: str
    value: float
    sigma: float
    unit: str


@dataclass(frozen=True)
class EmpiricalTerm:
    """The shape of what is left in one component of a channel. EMPIRICAL: not a name.

    Attributes:
        channel: kind of measurement.
        component: index of the beam or axis.
        arcs: names of the arcs that it is fitted in.
        form: "constant", "smooth", "periodic" or "periodic by arc".
        period: s, of the periodic forms, else None.
        unit: of the numbers below.
        amplitude: of the fundamental, its root mean square over arcs where each has its own; of the other forms the
            root mean square of the constants and the largest size of the curves.
        sigma: standard deviation of the amplitude under the declared noise.
        rms: root mean square over the fitted samples of what the term changes, the other unknowns giving way.
        worth: log odds against no term.
        parameters: every fitted number.
        floor: root mean square of the noise of the component.
        fitted_before, fitted_after: root mean square miss of the fitted samples of the component without and with it.
        held_out_before, held_out_after: the same of held-out samples; ``after`` is None where the form does not
            reach them, both where there are none.
        refused: forms worth more in the fit that predicted the held-out samples worse than nothing.
        sentence: all this in words.
        samples: (n, 4) time (s), residual of the component without the term and with it (decorrelated, in ``unit``),
            and 1 for a fitted sample, 0 for one held out.
    """

    channel: str
    component: int
    arcs: tuple[str, ...]
    form: str
    period: float | None
    unit: str
    amplitude: float
    sigma: float
    rms: float
    worth: float
    parameters: tuple[EmpiricalParameter, ...]
    floor: float
    fitted_before: float
    fitted_after: float
    held_out_before: float | None
    held_out_after: float | None
    refused: tuple[str, ...]
    sentence: str
    samples: np.ndarray = field(compare=False, repr=False)


@dataclass(frozen=True, eq=False)
class _Form:
    """Functions of time of each arc; ``shared`` columns mean the same in every arc, others belong to one arc."""

    name: str
    functions: tuple[np.ndarray, ...]
    labels: tuple[str, ...]
    shared: bool
    looks: int = 1
    period: float | None = None


@dataclass(frozen=True, eq=False)
class _Fit:
    form: _Form
    size: np.ndarray
    covariance: np.ndarray
    worth: float
    signal: tuple[np.ndarray, ...]
    after: tuple[np.ndarray, ...]
    reaches: bool
    held_out_drop: float


class _Bench:
    """One component of a channel with all that is needed to fit forms to it."""

    def __init__(self, problem: Problem, parts: Sequence[Linearization], stacked: Stack, arcs: Sequence[ArcSeries],
                 component: int):
        self.arcs, self.component, self.stacked = arcs, component, stacked
        self.positions = arcs[0].rows is None
        residuals = {r.name: (r, p) for r, p in zip(problem.residuals, parts, strict=True)}
        self.spread = [a.response[:, :, component] for a in arcs]
        self.jacobian = []  # (n, m, p) of held-out and fitted samples alike
        for a in arcs:
            residual, part = residuals[a.residual]
            width = a.whitened.shape[1]
            if isinstance(residual, KernelResidual):
                whole = rows_of(replace(part, weight=np.ones(len(part.whitened))), stacked.columns,
                                stacked.scale[a.residual])[1]
                self.jacobian.append(whole[a.samples[:, None] * width + np.arange(width)])
            else:
                self.jacobian.append(np.zeros((len(a.samples), width, 0)))
        gram = stacked.gram
        self.inverse = np.linalg.pinv(gram, rcond=1e-13, hermitian=True) if len(gram) else gram

    def fit(self, form: _Form) -> _Fit:
        """The form's sizes beside everything that the fit absorbs."""
        per_arc = form.functions[0].shape[1]
        total = per_arc if form.shared else per_arc * len(self.arcs)
        columns = []  # per arc (n, m, k) and the place of its k columns
        gram, right = np.zeros((total, total)), np.zeros(total)
        carried = np.zeros((self.stacked.basis.shape[1], total))
        taken = np.zeros((self.stacked.jacobian.shape[1], total))
        left = self.stacked.basis.T @ self.stacked.residual
        for i, (a, spread, functions) in enumerate(zip(self.arcs, self.spread, form.functions, strict=True)):
            place = slice(0, total) if form.shared else slice(i * per_arc, (i + 1) * per_arc)
            whole = spread[:, :, None] * functions[:, None, :]
            columns.append((place, whole))
            own = whole[a.fitted].reshape(-1, per_arc)
            gram[place, place] += own.T @ own
            right[place] += own.T @ a.whitened[a.fitted].ravel()
            if a.rows is not None:
                rows = a.rows[a.fitted].ravel()
                carried[:, place] += self.stacked.basis[rows].T @ own
                taken[:, place] += self.stacked.jacobian[rows].T @ own
        alone = np.diag(gram).copy()
        gram -= carried.T @ carried
        right -= carried.T @ left
        norms = np.sqrt(np.maximum(alone, 1e-300))
        values, vectors = np.linalg.eigh(gram / np.outer(norms, norms))
        seen = values > UNDETERMINED
        inverse = (vectors[:, seen] / values[seen]) @ vectors[:, seen].T / np.outer(norms, norms)
        size = inverse @ right
        covariance = inverse.copy()
        for j in np.flatnonzero(np.sum(vectors[:, ~seen] ** 2, axis=1) > 1e-3):
            covariance[j, j] = np.inf
        # What the other unknowns give way by, felt in held-out samples too.
        step = self.inverse @ (taken @ size)
        signal, after, drop, reaches = [], [], 0.0, False
        for (place, whole), a, jacobian, functions in zip(columns, self.arcs, self.jacobian, form.functions,
                                                          strict=True):
            change = whole @ size[place]
            if jacobian.shape[2]:
                change = change - jacobian @ step
            signal.append(functions @ size[place])
            after.append(a.whitened - change)
            held = ~a.fitted
            if held.any():
                inside = a.time[held].max() <= a.time[a.fitted].max()  # between fitted samples
                reaches |= form.name != "smooth" or bool(inside)
                drop += float(np.sum(a.whitened[held] ** 2) - np.sum(after[-1][held] ** 2))
        count = sum(int(a.fitted.sum()) for a in self.arcs)
        worth = 0.5 * float(right @ size) - 0.5 * int(seen.sum()) * float(np.log(count)) - float(np.log(form.looks))
        return _Fit(form, size, covariance, worth, tuple(signal), tuple(after), reaches, drop)


def empirical_terms(problem: Problem, parts: Sequence[Linearization], stacked: Stack, gap: Gap,
                    ) -> tuple[EmpiricalTerm, ...]:
    """The term that carries what is left, for every component of every place; none where no form is worth its price.

    Args:
        problem: the accepted problem.
        parts: its linearizations at the fit.
        stacked: its rows at the fit.
        gap: what is left there.
    """
    found = []
    for place in gap.places:
        everything = [a for a in series_of(problem, parts, stacked, place.channel) if a.fitted.sum() >= FEWEST]
        if not everything:
            continue
        named = {a.arc for a in everything if a.arc in place.arcs}
        left = list(place.components)
        while left:
            # Structure of one component shows in others through what they share in the fit: the component in which
            # the term is worth most comes first, the others carry what that leaves.
            fits = []
            for component in left:
                for arcs in (everything, [a for a in everything if a.arc in named]):
                    if arcs and (arcs is everything or len(arcs) < len(everything)):
                        bench, fit, refused = _best(_Bench(problem, parts, stacked, arcs, component))
                        if fit is not None:
                            fits.append((component, bench, fit, refused))
            if not fits:
                break
            component, bench, fit, refused = max(fits, key=lambda item: item[2].worth)
            found.append(_told(bench, place, fit, refused))
            changed = {id(a): after for a, after in zip(bench.arcs, fit.after, strict=True)}
            everything = [replace(a, whitened=changed.get(id(a), a.whitened)) for a in everything]
            left.remove(component)
    return tuple(found)


def _best(bench: _Bench) -> tuple[_Bench, _Fit | None, tuple[str, ...]]:
    """The form worth most, None where none is worth its price, and the forms that held-out samples refused."""
    fits = [bench.fit(form) for form in _forms(bench)]
    fits = [f for f in fits if f.worth > 0]
    held_out = any((~a.fitted).any() for a in bench.arcs)
    refused = [f for f in fits if held_out and f.reaches and f.held_out_drop <= 0]
    fits = [f for f in fits if f not in refused]
    if not fits:
        return bench, None, ()
    best = max(fits, key=lambda f: f.worth)
    predicting = [f for f in fits if f.reaches]
    if not best.reaches and predicting:
        other = max(predicting, key=lambda f: f.worth)
        best = other if other.worth > best.worth - SIMPLER else best
    return bench, best, tuple(dict.fromkeys(f.form.name for f in refused if f.worth > best.worth))


def _forms(bench: _Bench) -> list[_Form]:
    arcs = bench.arcs
    forms = [_Form("constant", tuple(np.ones((len(a.time), 1)) for a in arcs), ("level",), False)]
    for degree in DEGREES:
        if all(a.fitted.sum() > 2 * (degree + 1) for a in arcs):
            forms.append(_Form("smooth", tuple(legvander(_phase(a), degree) for a in arcs),
                               tuple(f"order {k}" for k in range(degree + 1)), False))
    found = _frequency(bench)
    if found is None:
        return forms
    by_arc, together, looks, nyquist = found
    for harmonics in range(1, HARMONICS + 1):
        for name, frequency in (("periodic", together), ("periodic by arc", by_arc)):
            if harmonics * frequency > nyquist or (name == "periodic by arc" and len(arcs) < 2):
                continue
            waves = tuple(_waves(a.time, frequency, harmonics) for a in arcs)
            labels = tuple(f"{part} {h}" for h in range(1, harmonics + 1) for part in ("cosine", "sine"))
            forms.append(_Form(name, waves, labels, name == "periodic", looks, 1.0 / frequency))
    return forms


def _phase(arc: ArcSeries) -> np.ndarray:
    used = arc.time[arc.fitted]
    return np.asarray(2 * (arc.time - used[0]) / max(float(used[-1] - used[0]), 1e-9) - 1)


def _waves(time: np.ndarray, frequency: float, harmonics: int) -> np.ndarray:
    angle = 2 * np.pi * frequency * time[:, None] * np.arange(1, harmonics + 1)
    return np.stack([np.cos(angle), np.sin(angle)], axis=2).reshape(len(time), -1)


def _frequency(bench: _Bench) -> tuple[float, float, int, float] | None:
    """Strongest frequency (Hz) of the arcs one by one and with one phase, the number looked at, and the highest."""
    series = [(a.time[a.fitted], a.whitened[a.fitted, bench.component]) for a in bench.arcs]
    steps = [float(np.median(np.diff(t))) for t, _ in series]
    step = float(np.median(steps))
    length = max(float(t[-1] - t[0]) for t, _ in series)
    if step <= 0 or length < FEWEST * step:
        return None
    highest = 0.5 / step
    grid = np.arange(2.0 / length, highest, 0.25 / length)
    if len(grid) < 2:
        return None
    power = np.zeros(len(grid))
    for t, x in series:
        power += np.abs(_transform(t - t[0], x - x.mean(), grid)) ** 2 / len(t)
    coarse = float(grid[int(np.argmax(power))])
    near = coarse + np.linspace(-0.5, 0.5, 41) * 0.5 / length
    near = near[(near > 0) & (near <= highest)]
    power = np.zeros(len(near))
    for t, x in series:
        power += np.abs(_transform(t - t[0], x - x.mean(), near)) ** 2 / len(t)
    by_arc = float(near[int(np.argmax(power))])
    span = series[-1][0][-1] - series[0][0][0]
    fine = by_arc + np.arange(-0.5 / length, 0.5 / length, 0.125 / float(span))
    fine = fine[(fine > 0) & (fine <= highest)]
    whole = sum(_transform(t, x - x.mean(), fine) for t, x in series)
    together = float(fine[int(np.argmax(np.abs(whole)))])
    looks = int(highest * length) + int(float(span) / length)
    return by_arc, together, max(looks, 1), highest


def _transform(time: np.ndarray, values: np.ndarray, frequency: np.ndarray) -> np.ndarray:
    pieces = np.array_split(frequency, max(1, len(frequency) * len(time) // CHUNK))
    return np.concatenate([np.exp(-2j * np.pi * piece[:, None] * time) @ values for piece in pieces])


def _told(bench: _Bench, place: Place, fit: _Fit, refused: tuple[str, ...]) -> EmpiricalTerm:
    form, arcs, k = fit.form, bench.arcs, bench.component
    unit, noise = arcs[0].unit, float(arcs[0].noise[k])
    sigma = np.sqrt(np.diag(fit.covariance))
    per_arc = len(form.labels)
    parameters = []
    for j, (value, spread) in enumerate(zip(fit.size, sigma, strict=True)):
        label = form.labels[j % per_arc]
        name = label if form.shared else f"{arcs[j // per_arc].arc} {label}"
        parameters.append(EmpiricalParameter(name, float(value), float(spread), unit))
    amplitude, error = _amplitude(arcs, fit, per_arc)
    fitted = [a.fitted for a in arcs]
    changed = sum(float(np.sum((a.whitened - after)[a.fitted] ** 2)) for a, after in zip(arcs, fit.after, strict=True))
    felt = sum(float(np.sum(spread[a.fitted] ** 2)) for a, spread in zip(arcs, bench.spread, strict=True))
    rms = float(np.sqrt(changed / felt))

    def miss(values: Sequence[np.ndarray], masks: Sequence[np.ndarray]) -> float | None:
        chosen = np.concatenate([v[m, k] for v, m in zip(values, masks, strict=True)])
        return noise * float(np.sqrt(np.mean(chosen**2))) if len(chosen) else None

    before = [a.whitened for a in arcs]
    kept = [~m for m in fitted]
    first, second = miss(before, fitted), miss(fit.after, fitted)
    assert first is not None and second is not None
    third = miss(before, kept)
    fourth = miss(fit.after, kept) if fit.reaches else None
    sentence = _sentence(place, k, fit, unit, amplitude, error, rms, (first, second, third, fourth), noise)
    return EmpiricalTerm(place.channel, k, tuple(a.arc for a in arcs), form.name, form.period, unit, amplitude, error,
                         rms, fit.worth, tuple(parameters), noise, first, second, third, fourth, refused, sentence,
                         _samples(bench, fit.after))


def _samples(bench: _Bench, after: Sequence[np.ndarray]) -> np.ndarray:
    k, noise = bench.component, float(bench.arcs[0].noise[bench.component])
    return np.concatenate([np.column_stack([a.time, noise * a.whitened[:, k], noise * rest[:, k], a.fitted])
                           for a, rest in zip(bench.arcs, after, strict=True)])


def _amplitude(arcs: Sequence[ArcSeries], fit: _Fit, per_arc: int) -> tuple[float, float]:
    """Size of the term and its sigma."""
    size, covariance = fit.size.reshape(-1, per_arc), np.diag(fit.covariance).reshape(-1, per_arc)
    if fit.form.name == "smooth":
        curves = [np.where(a.fitted, np.abs(s), 0.0) for a, s in zip(arcs, fit.signal, strict=True)]
        largest = max(range(len(curves)), key=lambda i: float(curves[i].max()))
        functions = fit.form.functions[largest]
        top = int(np.argmax(curves[largest]))
        block = fit.covariance[largest * per_arc : (largest + 1) * per_arc, largest * per_arc : (largest + 1) * per_arc]
        # A direction that the fit absorbs carries no size: its infinite sigma says nothing about the curve.
        block = np.where(np.isfinite(block), block, 0.0)
        return float(np.abs(fit.signal[largest][top])), float(np.sqrt(functions[top] @ block @ functions[top]))
    first = slice(0, 1) if fit.form.name == "constant" else slice(0, 2)
    seen = np.isfinite(covariance[:, first]).all(axis=1)
    if not seen.any():
        return float(np.sqrt(np.mean(np.sum(size[:, first] ** 2, axis=1)))), float("inf")
    square = np.sum(size[seen][:, first] ** 2, axis=1)
    amplitude = float(np.sqrt(np.mean(square)))
    # Of a root mean square, from the sigmas of its members.
    spread = np.sqrt(np.sum(np.sum(size[seen][:, first] ** 2 * covariance[seen][:, first], axis=1)))
    return amplitude, float(spread / max(amplitude, 1e-300) / len(square))


def _sentence(place: Place, component: int, fit: _Fit, unit: str, amplitude: float, sigma: float, rms: float,
              misses: tuple[float, float, float | None, float | None], noise: float) -> str:
    which = {"doppler": "beam", "star_tracker": "axis", "gnss": "axis"}.get(place.channel, "component")
    shown, error, word = _readable(amplitude, sigma, unit)
    size, floor, _ = _readable(rms, noise, unit)
    form = _WORDS[fit.form.name]
    if fit.form.period is not None:
        form = form.replace("a periodic term", f"a term that repeats every {fit.form.period:.4g} s")
        harmonics = len(fit.form.labels) // 2
        form += f" ({harmonics} harmonics)" if harmonics > 1 else ""
    spread = f"{shown:.3g} +- {error:.2g} {word}" if np.isfinite(error) else f"{shown:.3g} {word} (not determined)"
    text = (f"EMPIRICAL: not a name: {place.channel.replace('_', ' ')}, {which} {component}: {form}, size {spread}, "
            f"{size:.3g} {word} RMS; the miss goes from {_readable(misses[0], 0, unit)[0]:.3g} to "
            f"{_readable(misses[1], 0, unit)[0]:.3g} {word} in the fitted samples")
    if misses[2] is not None and misses[3] is not None:
        text += (f" and from {_readable(misses[2], 0, unit)[0]:.3g} to {_readable(misses[3], 0, unit)[0]:.3g} {word} "
                 "in the held-out ones")
    elif misses[2] is not None:
        text += "; a curve of one arc cannot be carried on to its held-out end, so it is not proved there"
    return text + f", over a noise of {floor:.3g} {word}"
