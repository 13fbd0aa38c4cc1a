"""What separates the tracking of a satellite that is kept on station from the model of its orbit.

Manoeuvres first (:mod:`problems.geo_orbit.manoeuvres`), because nothing of metres can be seen before them; then every
other effect of the library at the joint fit of one orbit, all manoeuvres and the calibration. Each effect is proved by
taking it away again, all others refitted: by how much the fitted data, and the passes that no fit has seen, miss the
orbit without it and with it. These refits are made to first order about the joint fit.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.stats import chi2

from estimator.models.earth_orientation import utc_text
from estimator.models.errors import InputError
from estimator.problem import Problem
from estimator.residuals import KernelResidual
from problems.geo_orbit.common_calibration import fitted_together
from problems.geo_orbit.effects import OrbitEffect, chosen, instances
from problems.geo_orbit.engine import Engine
from problems.geo_orbit.manoeuvres import (
    FAMILY,
    LEVEL,
    MONTHS,
    Fit,
    Found,
    Manoeuvre,
    Prior,
    Search,
    common_error,
    gauss_newton,
    neighbours,
)
from problems.geo_orbit.problem import OrbitModel, orbit_model, orbit_problem
from problems.geo_orbit.settings import OrbitSettings
from problems.geo_orbit.tracking import Tracking

Say = Callable[[str], None]

_PARAMETER = 3.986004418e14  # m3/s2 of the Earth
_SHORTEST_SPAN = 3.0  # revolutions that the search for manoeuvres asks for
_OFTEN = 6.0  # instants of measurement in a revolution that it asks for
_BLOCKS = 8  # held-out passes are so many to a revolution
_MOST_ARCS = 10
_MOST = 6  # effects beside calibration and manoeuvres
_NAMED = 1.3  # what is left over the noise of quiet data up to which nothing is left
_METRE = {"range": 1.0}  # m; nor below this
_SPREAD = 0.3  # sigma over size of a velocity step beyond which a direction of it is open
_SURE = 3.0  # sigmas
_NEEDED = 1.1  # growth of the sum of squares that tells that what was dropped was needed
_FITS = 64.0  # mean square over that of quiet data up to which a stretch counts as fitted
_COMMON = "the part of"
_WORST = 5  # places of what is left that are named
_UNDETERMINED = 0.5  # posterior over prior sigma beyond which the data say nothing of a number


def period_of(state: np.ndarray) -> float:
    """Period of the orbit of a state (6,), s; NaN where it is not closed."""
    r, v = float(np.linalg.norm(state[:3])), float(np.linalg.norm(state[3:]))
    a = 1 / (2 / r - v**2 / _PARAMETER)
    return float(2 * np.pi * np.sqrt(a**3 / _PARAMETER)) if a > 0 else float("nan")


def calibration(model: OrbitModel, without: Sequence[str] = ()) -> tuple[OrbitEffect, ...]:
    """Effects that the search for manoeuvres must not mistake for one: biases, scale, clock, sunlight in two parts.

    A clock that is wrong at all stations alike turns the orbit against Sun and Moon. Days of data do not show it,
    months do, and a fit that lacks it leaves a daily wave of metres that is another one at every station.
    """
    layout = model.layout
    offered = {e.name: e for e in instances(layout) if e.name not in without and e.family not in without}
    names = ["range-scale-error", "timetag-offset", "solar-radiation-pressure", "solar-radiation-pressure:oblique"]
    names.append("range-bias:each" if "range-bias:each" in offered else "range-bias")
    for station, kinds in layout.stations:
        if set(kinds) & {"azimuth_elevation", "direction_cosines"}:
            names.append(f"angle-bias:{station}")
        if "range_rate" in kinds:
            names.append(f"range-rate-bias:{station}")
    return tuple(offered[n] for n in dict.fromkeys(names) if n in offered)


_SLOW = ("timetag-offset",)  # what only a long orbit tells
# m, 1, s, rad, m/s
_WIDTHS = {"range-bias": 1e4, "range-scale-error": 2e-3, "timetag-offset": 100.0, "angle-bias": 0.01,
           "range-rate-bias": 1.0}


def _lasting(effects: Sequence[OrbitEffect], span: float, period: float) -> tuple[OrbitEffect, ...]:
    """Those of the calibration that data of a length (s) can tell."""
    return tuple(e for e in effects if e.name not in _SLOW or span > MONTHS * period)


def _priors(effects: Sequence[OrbitEffect], problem: Problem) -> tuple[Prior, ...]:
    found = []
    for e in effects:
        width = np.array([_WIDTHS.get(e.family, p.scale) for p in e.parameters])
        found.append(Prior.of(e.name, np.zeros(len(width)), width))
    for u in problem.unknowns:
        if u.name not in ("position", "velocity") and all(u.name != e.name for e in effects):
            found.append(Prior.of(u.name, problem.start[u.name], np.broadcast_to(u.scales, u.manifold.tangent)))
    return tuple(found)


@dataclass(frozen=True, eq=False)
class _Proof:
    """What is lost when an effect is taken away and all others are refitted to first order.

    Attributes:
        score: drop of the sum of squares over the measured noise.
        p_value: after the search, with errors that measurements share taken into account.
        fitted, held_out: root mean square (m or the channel's unit) by channel, without and with the effect.
        ratio: the same over the declared noise: fitted without, with; held out without, with.
        helps: whether held-out data, each over what is expected of it, are better with the effect.
    """

    score: float
    p_value: float
    fitted: dict[str, tuple[float, float]]
    held_out: dict[str, tuple[float, float]]
    ratio: tuple[float, float, float, float]
    helps: bool = False


@dataclass(frozen=True, eq=False)
class KeptEffect:
    """One effect in the model of a kept satellite.

    Attributes:
        name, group: as in the library; a manoeuvre has its number.
        parameters: value, sigma, unit by name.
        proof: what is lost without it.
        utc: time of a manoeuvre; "" for others.
        reference: where the formula comes from.
        open: the direction in which the data leave a manoeuvre open, in words; "" where there is none.
    """

    name: str
    group: tuple[str, ...]
    parameters: dict[str, dict[str, Any]]
    proof: _Proof
    utc: str
    reference: str
    open: str = ""


@dataclass(frozen=True, eq=False)
class KeptExplanation:
    """The answer for a kept satellite.

    Attributes:
        structure: of :func:`problems.geo_orbit.manoeuvres.common_error`; ratio: what is left over the declared noise.
        arcs: the answers of successive arcs, where one orbit does not fit all data; the calibration is the longest's.
        model: the data; found: the search; fit: the joint fit with every effect; plain: one orbit without any.
        effects: largest first.
        undetermined: numbers of the calibration that the data leave open, in words.
        rejected: names that helped somewhere and were not believed, with the reason; missed: samples in no arc.
        expected: by channel, how far the held-out data miss over what was to be expected of noise and covariance, RMS.
        rms: root mean square by channel of the fitted and the held-out data, before and after everything.
    """

    model: OrbitModel
    found: Found
    fit: Fit
    plain: Fit
    before: dict[str, tuple[float, float, str]]
    after: dict[str, tuple[float, float, str]]
    structure: float
    ratio: float
    effects: tuple[KeptEffect, ...]
    undetermined: tuple[str, ...]
    verdict: str
    why: str
    seconds: float
    arcs: tuple[KeptExplanation, ...] = ()
    rejected: tuple[str, ...] = ()
    missed: int = 0
    expected: dict[str, float] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """The machine-readable answer of ``boresight orbit explain``."""
        stations = [r.name for r in self.fit.problem.residuals]
        return {
            "verdict": self.verdict,
            "why": self.why,
            "where": [
                {
                    "channel": channel,
                    "arcs": stations,
                    "time_scale_s": self.found.search.period,
                    "unit": unit,
                    "excess": fitted,
                    "sentence": f"{channel}, every station: {fitted:.4g} {unit} RMS about one orbit without manoeuvres",
                }
                for channel, (fitted, _, unit) in self.before.items()
            ],
            "effects": [_entry(e) for e in self.effects],
            "next_measurement": self.next_measurement,
            "left": [
                {"channel": c, "rms": fitted, "held_out_rms": held, "held_out_over_expected": self.expected.get(c),
                 "unit": unit, "common_error": self.structure}
                for c, (fitted, held, unit) in self.after.items()
            ],
            "left_where": self.left_where(),
            "rejected": list(self.rejected),
            "undetermined": list(self.undetermined),
            "manoeuvres": sum(e.name.startswith(FAMILY) for e in self.effects),
            "spans": [[self._utc(p.found.low), self._utc(p.found.high)] for p in self.arcs],
            "arcs": [
                {
                    "from": self._utc(p.found.low),
                    "to": self._utc(p.found.high),
                    "manoeuvres": sum(e.name.startswith(FAMILY) for e in p.effects),
                    "measurements": p.fit.rows,
                    "left": {c: {"rms": a, "held_out_rms": b, "held_out_over_expected": p.expected.get(c), "unit": u}
                             for c, (a, b, u) in p.after.items()},
                }
                for p in self.arcs
            ],
            "measurements_in_no_arc": self.missed,
            "seconds": self.seconds,
        }

    def _utc(self, seconds: float) -> str:
        return utc_text(self.model.epoch + np.timedelta64(round(seconds * 1e6), "us"))

    def left_where(self) -> list[dict[str, Any]]:
        """Where what is left is far above the noise: runs of revolutions, the worst first, as in ``where``."""
        found: list[dict[str, Any]] = []
        for piece in self.arcs or (self,):
            found += [{**w, "from": self._utc(w["from"]), "to": self._utc(w["to"])} for w in _remains(piece)]
        found.sort(key=lambda w: float(w["excess"]), reverse=True)
        for w in found:
            w["sentence"] = (f"{w['channel']}, {w['from'][:16]} to {w['to'][:16]}: {w['excess']:.3g} {w['unit']} RMS, "
                             f"{100 * w['shared']:.0f} % of it the same at all stations, slower than "
                             f"{w['time_scale_s'] / 3600:.2g} h")
        return found[:_WORST]

    @property
    def next_measurement(self) -> str:
        """What would separate what these data cannot."""
        words = []
        if self.undetermined:
            words.append("ranges from a station on another continent, or angles, over one revolution, to separate "
                         + ", ".join(self.undetermined))
        open_ = [e for e in self.effects if e.open]
        if self.verdict != "named" or open_:
            times = ", ".join(e.utc[:16] for e in open_[:_WORST])
            words.append("ranges more often than the burns last, around their times"
                         + (f" (of these least is known of {times})" if times else ""))
        return "; ".join(words)

    def __str__(self) -> str:
        lines = [f"{self.verdict}: {self.why}", ""]
        lines += [f"where: {w['sentence']}" for w in self.as_dict()["where"]]
        header = f"{'effect':<36}{'time (UTC)':<22}{'size':>34}{'held out':>22}"
        lines += ["", header]
        for e in self.effects:
            size = ", ".join(f"{p['value']:.4g} +- {p['sigma']:.1g} {p['unit']}" for n, p in e.parameters.items()
                             if n != "time")
            held = "; ".join(f"{a:.4g} -> {b:.4g}" for a, b in e.proof.held_out.values())
            lines.append(f"{e.name:<36}{e.utc[:19]:<22}{size}   {held}")
            if e.open:
                lines.append(f"{'':<36}{e.open}")
        lines += ["", *(f"left in {c}: {a:.3g} {u} RMS, held out {b:.3g} {u}" for c, (a, b, u) in self.after.items())]
        lines += [f"left: {w['sentence']}" for w in self.left_where()]
        lines += [f"not believed: {w}" for w in self.rejected]
        if self.undetermined:
            lines.append("not determined by these data: " + ", ".join(self.undetermined))
        return "\n".join(lines)


def _entry(e: KeptEffect) -> dict[str, Any]:
    entry = {
        "name": e.name,
        "group": list(e.group),
        "parameters": e.parameters,
        "score": e.proof.score,
        "p_value_after_search": e.proof.p_value,
        "gap_before": e.proof.ratio[0],
        "gap_after": e.proof.ratio[1],
        "held_out_before": e.proof.ratio[2],
        "held_out_after": e.proof.ratio[3],
        "fitted": {c: {"before": a, "after": b} for c, (a, b) in e.proof.fitted.items()},
        "held_out": {c: {"before": a, "after": b} for c, (a, b) in e.proof.held_out.items()},
        "reference": e.reference,
    }
    if e.utc:
        entry["time_utc"] = e.utc
    if e.open:
        entry["undetermined"] = e.open
    return entry


@dataclass(frozen=True, eq=False)
class _Rows:
    """Rows of a fit over the declared noise, fitted ones and held-out ones, with their channels."""

    residual: np.ndarray
    jacobian: np.ndarray
    channel: np.ndarray
    sigma: np.ndarray


def _rows(fit: Fit, noise: dict[str, float], *, held_out: bool) -> _Rows:
    residuals = []
    for r in fit.problem.residuals:
        assert isinstance(r, KernelResidual)
        mask = np.ones(r.samples, dtype=bool) if r.accepted is None else np.array(r.accepted)
        residuals.append(replace(r, accepted=~mask if held_out else mask))
    again = gauss_newton(fit.problem.with_residuals(residuals), fit.values, (), noise, iterations=0)
    channel, sigma = [], []
    for r in residuals:
        kept = np.repeat(np.asarray(r.accepted), r.kernel.size)
        channel += [r.channel] * int(kept.sum())
        sigma.append(r.standard_deviation.ravel()[kept])
    return _Rows(again.residual, again.jacobian, np.array(channel), np.concatenate(sigma))


def _misfit(rows: _Rows, change: np.ndarray, noise: dict[str, float]) -> tuple[dict[str, float], float]:
    """RMS by channel in its unit, and over the declared noise in all, of rows moved by a step of the parameters."""
    factor = np.array([noise.get(c, 1.0) for c in rows.channel])
    whitened = (rows.residual + rows.jacobian @ change) * factor
    by_channel = {str(c): float(np.sqrt(np.mean((whitened * rows.sigma)[rows.channel == c] ** 2)))
                  for c in dict.fromkeys(rows.channel)}
    return by_channel, float(np.sqrt(np.mean(whitened**2))) if len(whitened) else 0.0


def explained_kept(model: OrbitModel, *, hold_out: float = 0.2, without: Sequence[str] = (),
                   say: Say | None = None) -> KeptExplanation | None:
    """Manoeuvres and other effects in the tracking of a kept satellite; None where there is no manoeuvre to find.

    Args:
        model: the prepared data with a state near the orbit.
        hold_out: fraction of the data that no fit sees, in whole passes of an eighth of a revolution.
        without: effects that are taken out of the library.
        say: called with what is being done.
    """
    began = time.perf_counter()
    say = say or (lambda text: None)
    state = np.concatenate([model.position, model.velocity])
    period = period_of(state)
    first, last = model.span
    instants = np.unique(np.concatenate([np.round(model.seconds(o.time)) for o in model.tracking.observations]))
    often = len(instants) / max((last - first) / period, 1.0) if np.isfinite(period) else 0.0
    if often < _OFTEN or last - first < _SHORTEST_SPAN * period or FAMILY in without:
        return None
    model = replace(model, finite_burns=True)
    every = calibration(model, without)
    arcs: list[tuple[OrbitModel, Found]] = []
    spans = [(first, last)]
    known: dict[str, float] = {}
    engine: Engine | None = None
    while spans and len(arcs) < _MOST_ARCS:
        low, high = spans.pop(0)
        if high - low < _SHORTEST_SPAN * period:
            continue
        part = _between(model, low, high)
        effects = _lasting(every, high - low, period)
        problem = _with_held_out(orbit_problem(part, [e.name for e in effects]), period, hold_out)
        search = Search(problem, _priors(effects, problem), period, say, known, engine=engine, slow=_SLOW)
        try:
            found = search.run(state, 0.0)
        except InputError:
            continue
        known = known or dict(found.noise)
        engine = search.engine or engine
        # What one orbit does not fit is looked at by itself.
        spans += [(low, found.low - 1.0), (found.high + 1.0, high)]
        if found.fit.square < _FITS * found.fit.degrees:
            arcs.append((_between(model, found.low, found.high), found))
    if not any(found.names for _, found in arcs):
        return None
    offers = [_further(part, found, _lasting(every, found.high - found.low, period), without, hold_out, say)
              for part, found in arcs]
    believed, rejected = consistent(offers, sorted((part.span for part, _ in arcs)))
    arcs, others = _together(arcs, every, believed, hold_out, say)
    pieces: list[KeptExplanation] = []
    for (part, found), known_of_others in zip(arcs, others, strict=True):
        # What the longest arc does not confirm is in none.
        own = _lasting(every, found.high - found.low, period)
        pieces.append(_concluded(part, found, own, believed, known_of_others, hold_out, say, first=not pieces))
        believed = tuple(n for n in believed if n in {u.name for u in pieces[0].fit.problem.unknowns})
    samples = sum(len(o.time) for o in model.tracking.observations)
    missed = samples - sum(len(o.time) for part, _ in arcs for o in part.tracking.observations)
    return _merged(model, pieces, rejected, missed, time.perf_counter() - began)


def _together(arcs: Sequence[tuple[OrbitModel, Found]], own: Sequence[OrbitEffect], further: Sequence[str],
              hold_out: float, say: Say) -> tuple[list[tuple[OrbitModel, Found]], list[list[Prior]]]:
    """Arcs, the longest first, fitted with one calibration, and what each knows of it from the others."""
    ordered = sorted(arcs, key=lambda item: -item[1].fit.rows)
    names = [e.name for e in own] + list(further)
    names += [u.name for u in ordered[0][1].fit.problem.unknowns
              if u.name not in ("position", "velocity", *names) and not u.name.startswith(FAMILY)]
    if len(ordered) == 1 or len({tuple(o.name for o in part.tracking.observations) for part, _ in ordered}) > 1:
        # Arcs without some of the stations have other unknowns.
        return ordered, [[] for _ in ordered]
    starts = [_start(part, found, _lasting(own, found.high - found.low, found.search.period), further, hold_out)
              for part, found in ordered]

    def again(i: int, fit: Fit, others: Sequence[Prior]) -> Fit:
        say(f"calibration common to {len(ordered)} arcs, arc {i + 1}")
        problem, _, priors = starts[i]
        return gauss_newton(problem, fit.values, [*priors, *others], ordered[i][1].noise, iterations=15, enough=1e-4)

    first = [gauss_newton(problem, point, priors, found.noise, iterations=0)
             for (problem, point, priors), (_, found) in zip(starts, ordered, strict=True)]
    fits, others = fitted_together(first, names, again)
    moved = [(part, replace(found, fit=fit, manoeuvres=tuple(Manoeuvre.of(fit.values[n]) for n in found.names)))
             for (part, found), fit in zip(ordered, fits, strict=True)]
    return moved, others


def _start(model: OrbitModel, found: Found, own: Sequence[OrbitEffect], further: Sequence[str], hold_out: float,
           ) -> tuple[Problem, dict[str, np.ndarray], list[Prior]]:
    """The joint problem of an arc with further effects, a point near its optimum, and what is assumed of sizes."""
    every = (*own, *chosen(model.layout, further))
    problem, point = _with_manoeuvres(model, found, [e.name for e in every], (), hold_out)
    priors = [p for p in found.search.priors if all(any(u.name == n for u in problem.unknowns) for n in p.names)]
    for e in every:
        if e not in own:
            # Its usual size is no bound: a clock that is a minute off is off by thousands of times that.
            widths = [max(10 * p.scale, *np.abs(p.plausible)) for p in e.parameters]
            priors.append(Prior.of(e.name, np.zeros(len(e.parameters)), np.array(widths)))
    for name, m in zip(found.names, found.manoeuvres, strict=True):
        priors.append(found.search.prior_of(name, m))
    return problem, point, priors


Offer = dict[str, tuple[np.ndarray, np.ndarray]]
"""Sizes and sigmas of the effects that an arc asks for beside manoeuvres and calibration, by name."""


def consistent(offers: Sequence[Offer], arcs: Sequence[tuple[float, float]]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names that successive arcs ask for alike, and a sentence for every other.

    A force or a clock that the model lacks is there in every arc and of one size. What one arc alone asks for, or two
    with different sizes, stands in for something else: a burn that was not found, sunlight on a shape that the model
    does not know.

    Args:
        offers: by arc.
        arcs: their spans, s; with one alone there is nothing to compare.
    """
    believed, rejected = [], []
    for name in dict.fromkeys(n for o in offers for n in o):
        found = [o[name] for o in offers if name in o]
        text = "; ".join(", ".join(f"{v:.3g} +- {s:.1g}" for v, s in zip(*f, strict=True)) for f in found)
        if len(arcs) > 1 and len(found) == 1:
            rejected.append(f"{name} helps in one arc of {len(arcs)} alone ({text}): burns that were not found or "
                            "sunlight on a shape that the model does not know, not this")
            continue
        alike = all(np.all(np.abs(a[0] - b[0]) < _SURE * np.hypot(a[1], b[1])) for a in found for b in found)
        if not alike:
            rejected.append(f"{name} has another size in every arc ({text}): burns not found or sunlight on a "
                            "shape that the model does not know, not this")
            continue
        believed.append(name)
    return tuple(believed), tuple(rejected)


def _between(model: OrbitModel, low: float, high: float) -> OrbitModel:
    """The model of the data between two times, s after the same epoch."""
    masks = {f"{o.name}/{o.kind}": (model.seconds(o.time) >= low) & (model.seconds(o.time) <= high)
             for o in model.tracking.observations}
    return model.thinned(masks)


def _merged(model: OrbitModel, pieces: Sequence[KeptExplanation], rejected: Sequence[str], missed: int,
            seconds: float) -> KeptExplanation:
    """One answer from those of successive arcs: all manoeuvres, the other effects of the longest arc."""
    longest = max(pieces, key=lambda p: p.fit.rows)
    moves = sorted((e for p in pieces for e in p.effects if e.name.startswith(FAMILY)), key=lambda e: e.utc)
    names = {id(e): f"{FAMILY}:{k + 1}" for k, e in enumerate(moves)}
    effects = [replace(e, name=names[id(e)], group=(names[id(e)],)) for e in moves]
    effects += [e for e in longest.effects if not e.name.startswith(FAMILY)]
    effects.sort(key=lambda e: -e.proof.score)
    rows = np.array([p.fit.rows for p in pieces], dtype=float)

    def pooled(tables: Sequence[dict[str, tuple[float, float, str]]]) -> dict[str, tuple[float, float, str]]:
        result = {}
        for c in dict.fromkeys(k for t in tables for k in t):
            w = np.array([n for n, t in zip(rows, tables, strict=True) if c in t])
            values = np.array([t[c][:2] for t in tables if c in t])
            known = np.where(np.isfinite(values), values, 0.0)
            weight = w[:, None] * np.isfinite(values)
            mean = np.sqrt(np.sum(weight * known**2, axis=0) / np.maximum(np.sum(weight, axis=0), 1e-300))
            result[c] = (float(mean[0]), float(mean[1]), next(t[c][2] for t in tables if c in t))
        return result

    before, after = pooled([p.before for p in pieces]), pooled([p.after for p in pieces])
    structure = float(np.sum(rows * [p.structure for p in pieces]) / rows.sum())
    ratio = float(np.sqrt(np.sum(rows * [p.ratio**2 for p in pieces]) / rows.sum()))
    noise = pooled([_noise(p.found, p.fit) for p in pieces])
    rejected = [*rejected, *dict.fromkeys(w for p in pieces for w in p.rejected)]
    expected = {c: float(np.sqrt(np.mean([p.expected[c] ** 2 for p in pieces for _ in range(p.fit.rows)
                                          if c in p.expected]))) for c in longest.expected}
    merged = replace(longest, model=model, expected=expected, before=before, after=after, structure=structure,
                     ratio=ratio, effects=tuple(effects), seconds=seconds, arcs=tuple(pieces), rejected=tuple(rejected),
                     missed=missed)
    verdict, why = _verdict(merged, {c: v[0] for c, v in noise.items()})
    return replace(merged, verdict=verdict, why=why)


def _noise(found: Found, fit: Fit) -> dict[str, tuple[float, float, str]]:
    """Noise of quiet data by channel, twice, and its unit."""
    answer = {}
    for r in fit.problem.residuals:
        assert isinstance(r, KernelResidual)
        size = found.noise.get(r.channel, 1.0) * float(np.median(r.standard_deviation))
        answer[r.channel] = (size, size, r.unit)
    return answer


def _remains(piece: KeptExplanation) -> list[dict[str, Any]]:
    """Runs of revolutions in which what is left is three times the noise or more, fitted and held-out data."""
    fit, period = piece.fit, piece.found.search.period
    found: list[dict[str, Any]] = []
    noise = _noise(piece.found, fit)
    for channel, (size, _, unit) in noise.items():
        rows = [(r.time, p.residual) for r, p in zip(fit.problem.residuals, fit.parts, strict=True)
                if isinstance(r, KernelResidual) and r.channel == channel]
        when = np.concatenate([np.repeat(t, v.shape[1]) for t, v in rows])
        value = np.concatenate([v.ravel() for _, v in rows])
        stations = [r.name for r in fit.problem.residuals if isinstance(r, KernelResidual) and r.channel == channel]
        turn = np.floor((when - when.min()) / period).astype(int)
        square, count = np.bincount(turn, value**2), np.maximum(np.bincount(turn), 1)
        loud = np.flatnonzero(np.sqrt(square / count) > max(_SURE * size, _METRE.get(channel, 0.0)))
        for run in np.split(loud, np.flatnonzero(np.diff(loud) > 1) + 1) if len(loud) else []:
            inside = (turn >= run[0]) & (turn <= run[-1])
            t, v = when[inside], value[inside]
            width = period / 48
            bins, index = np.unique(np.round(t / width), return_inverse=True)
            count_, total = np.bincount(index), np.bincount(index, v)
            mean, power = total / count_, float(np.mean(v**2))
            change = float(np.mean(np.diff(mean) ** 2)) if len(mean) > 1 else 0.0
            step = float(np.median(np.diff(bins))) * width if len(bins) > 1 else period
            # A wave of angular rate w that is sampled at steps dt changes by w dt of its size in a step.
            rate = float(np.sqrt(change / max(float(np.mean(mean**2)), 1e-300))) / step
            scale = min(1.0 / max(rate, 1e-300), float(np.ptp(t)) + step)
            pairs = float(np.sum(count_ * (count_ - 1)))
            alike = float(np.sum(total**2 - np.bincount(index, v**2))) / max(pairs, 1.0) / max(power, 1e-300)
            found.append({"channel": channel, "arcs": stations, "from": float(t.min()), "to": float(t.max()),
                          "unit": unit, "excess": float(np.sqrt(power)), "time_scale_s": scale,
                          "shared": min(max(alike, 0.0), 1.0)})
    return found


def _with_held_out(problem: Problem, period: float, hold_out: float) -> Problem:
    """The problem with whole passes kept from every fit, those of all stations at the same times."""
    every = max(2, round(1 / hold_out))
    residuals = []
    for r in problem.residuals:
        assert isinstance(r, KernelResidual)
        residuals.append(replace(r, accepted=np.floor(r.time / (period / _BLOCKS)).astype(int) % every != every // 2))
    return problem.with_residuals(residuals)


def _with_manoeuvres(model: OrbitModel, found: Found, effects: Sequence[str], candidates: Sequence[str],
                     hold_out: float) -> tuple[Problem, dict[str, np.ndarray]]:
    """The joint problem with the found manoeuvres and further effects, and a point near its optimum."""
    values = found.fit.values
    base = orbit_problem(model, effects, candidates=candidates)
    search = replace(found.search, problem=_with_held_out(base, found.search.period, hold_out))
    steps = dict(zip(found.names, found.manoeuvres, strict=True))
    first, last = model.span
    problem, _ = search.stretch(first, last, found.arc.start, steps, everything=True)
    point = {**problem.start, **{n: v for n, v in values.items() if n in problem.start}}
    return problem.freeing(*candidates), point


def _further(model: OrbitModel, found: Found, own: Sequence[OrbitEffect], without: Sequence[str], hold_out: float,
             say: Say) -> Offer:
    """Effects of the library that the joint fit still misses, best first: sizes and sigmas to first order."""
    fit, noise = found.fit, found.noise
    covered = {"range-bias", FAMILY, *(e.family for e in own if e.family in ("angle-bias", "range-rate-bias"))}
    offered = [e for e in instances(model.layout) if e.family not in covered and e not in own
               and e.name not in without and e.family not in without]
    if not offered:
        return {}
    say("scores of the library")
    names = [e.name for e in offered]
    problem, point = _with_manoeuvres(model, found, [e.name for e in own], names, hold_out)
    wide = gauss_newton(problem, point, found.search.priors, noise, iterations=0)
    ours = np.concatenate([np.arange(wide.jacobian.shape[1])[wide.columns(u.name)] for u in fit.unknowns])
    held = _rows(wide, noise, held_out=True)
    chosen_: list[str] = []
    columns = list(ours)
    level = max(1.0, fit.square / fit.degrees) * found.shared
    while len(chosen_) < _MOST:
        prior = np.vstack([wide.prior[:, columns], 1e-9 * np.eye(len(columns))])
        basis, upper = np.linalg.qr(np.vstack([wide.jacobian[:, columns], prior]))
        inner = basis[: wide.rows]
        off = np.concatenate([wide.off, np.zeros(len(columns))])
        everything = np.concatenate([wide.residual, off])
        left = (everything - basis @ (basis.T @ everything))[: wide.rows]
        best: tuple[float, str, list[int]] | None = None
        for e in offered:
            if e.name in chosen_:
                continue
            own_columns = list(np.arange(wide.jacobian.shape[1])[wide.columns(e.name)])
            block = wide.jacobian[:, own_columns]
            cross = inner.T @ block
            full = block.T @ block
            size = np.sqrt(np.maximum(np.diag(full), 1e-300))
            values, vectors = np.linalg.eigh((full - cross.T @ cross) / np.outer(size, size))
            seen = values > 1e-8
            if not seen.any():
                continue
            amounts = vectors[:, seen].T @ (block.T @ left / size)
            step = -(vectors[:, seen] @ (amounts / values[seen])) / size
            gain = float(np.sum(amounts**2 / values[seen]))
            if chi2.sf(gain / level, int(seen.sum())) * len(offered) > LEVEL:
                continue
            sizes = step * wide.scales[own_columns]
            if any(not p.plausible[0] <= v <= p.plausible[1] for p, v in zip(e.parameters, sizes, strict=True)):
                continue
            change = np.zeros(wide.jacobian.shape[1])
            change[own_columns] = step
            change[columns] = -np.linalg.solve(upper, basis.T @ (everything + np.concatenate(
                [block @ step, np.zeros(len(everything) - wide.rows)])))
            rest = np.zeros_like(change)
            rest[columns] = -np.linalg.solve(upper, basis.T @ everything)
            if held.residual.size and np.median(np.abs(held.residual + held.jacobian @ change)) > np.median(
                    np.abs(held.residual + held.jacobian @ rest)):
                continue
            if best is None or gain > best[0]:
                best = (gain, e.name, own_columns)
        if best is None:
            break
        chosen_.append(best[1])
        columns += best[2]
    if not chosen_:
        return {}
    upper = np.asarray(np.linalg.qr(np.vstack([wide.jacobian[:, columns], wide.prior[:, columns],
                                               1e-9 * np.eye(len(columns))]), mode="r"))
    everything = np.concatenate([wide.residual, wide.off])
    stacked = np.vstack([wide.jacobian[:, columns], wide.prior[:, columns]])
    inverse = np.linalg.inv(upper)
    step = -inverse @ (inverse.T @ (stacked.T @ everything)) * wide.scales[columns]
    sigma = np.sqrt(np.sum(inverse**2, axis=1) * level) * wide.scales[columns]
    place = {c: k for k, c in enumerate(columns)}
    answer: Offer = {}
    for name in chosen_:
        own_places = [place[c] for c in np.arange(wide.jacobian.shape[1])[wide.columns(name)]]
        answer[name] = (step[own_places], sigma[own_places])
    return answer


def _concluded(model: OrbitModel, found: Found, own: Sequence[OrbitEffect], further: Sequence[str],
               known: Sequence[Prior], hold_out: float, say: Say, *, first: bool = True) -> KeptExplanation:
    """The joint fit with the effects that were chosen, and the proof of each.

    What the held-out passes do not speak for leaves, and the rest is fitted once more. ``known`` is what other arcs
    tell of the calibration; of further effects the ``first`` arc, the longest, decides.
    """
    answer = _proved(model, found, own, further, known, hold_out, say)
    proved = {e.name for e in answer.effects if _held(e)}
    unproved = [n for n in further if n not in proved] if first else []
    weak = set()
    for e in answer.effects:
        if e.name.startswith(FAMILY) and (e.proof.p_value > LEVEL or (_nothing(e) and not _held(e))):
            weak.add(e.name)
    if not unproved and not weak:
        return answer
    kept = [(n, m) for k, (n, m) in enumerate(zip(found.names, found.manoeuvres, strict=True))
            if f"{FAMILY}:{k + 1}" not in weak]
    fewer = replace(found, names=tuple(n for n, _ in kept), manoeuvres=tuple(m for _, m in kept))
    again = _proved(model, fewer, own, [n for n in further if n not in unproved], known, hold_out, say)
    if weak and again.fit.square > _NEEDED * answer.fit.square:
        # Something was there after all; what it is these data do not tell.
        again = answer
        if unproved:
            again = _proved(model, found, own, [n for n in further if n not in unproved], known, hold_out, say)
    return replace(again, rejected=tuple(f"{n} makes the held-out passes no better" for n in unproved))


def _nothing(e: KeptEffect) -> bool:
    """Whether a manoeuvre is within three sigmas of zero in every direction."""
    sizes = [e.parameters[k] for k in ("radial", "along", "cross")]
    return all(abs(v["value"]) < _SURE * v["sigma"] for v in sizes)


def _held(e: KeptEffect) -> bool:
    """Whether the held-out data are better with an effect than without."""
    return e.proof.helps or any(b < a for a, b in e.proof.held_out.values())


def _proved(model: OrbitModel, found: Found, own: Sequence[OrbitEffect], further: Sequence[str],
            known: Sequence[Prior], hold_out: float, say: Say) -> KeptExplanation:
    every = (*own, *chosen(model.layout, further))
    say("joint fit with " + (", ".join(further) or "nothing further"))
    problem, point, priors = _start(model, found, own, further, hold_out)
    fit = gauss_newton(problem, point, [*priors, *known], found.noise, iterations=15, enough=1e-4)
    say("one orbit without manoeuvres")
    first, last = model.span
    bare = _with_held_out(orbit_problem(model, [e.name for e in own]), found.search.period, hold_out)
    plain_problem, _ = replace(found.search, problem=bare).stretch(first, last, found.arc.start, {}, everything=True)
    plain_problem = plain_problem.holding(*(e.name for e in own))
    start = {**plain_problem.start, **{n: fit.values[n] for n in ("position", "velocity")}}
    plain = gauss_newton(plain_problem, start, (), found.noise, iterations=8, enough=0.02)
    say("proof")
    seen, held = _rows(fit, found.noise, held_out=False), _rows(fit, found.noise, held_out=True)
    still = np.zeros(fit.jacobian.shape[1])
    after, ratio_after = _misfit(seen, still, found.noise)
    held_after, held_ratio = _misfit(held, still, found.noise)
    covariance = fit.covariance()
    # The sigmas that are reported include scatter above the measured noise and errors that measurements share, in quiet
    # data or in what is left here: slow errors of a model leave far less to learn than their number of rows.
    structure = common_error(fit)
    level = max(1.0, fit.square / fit.degrees) * max(found.shared, structure)
    spread = np.sqrt(np.diag(covariance) * level)
    places = (last - first) / found.search.period * 48
    spread_held = _spread(held, covariance / np.outer(fit.scales, fit.scales) * level)
    expected = {str(c): float(np.sqrt(np.mean((held.residual / spread_held)[held.channel == c] ** 2)))
                for c in dict.fromkeys(held.channel)}
    effects = []

    def proved(columns: list[int], fixed: list[int], values: np.ndarray, looks: float) -> _Proof:
        c = covariance
        if fixed:  # the time of a step that is not there means nothing
            c = c - c[:, fixed] @ np.linalg.solve(c[np.ix_(fixed, fixed)], c[fixed, :])
        pull = np.linalg.solve(c[np.ix_(columns, columns)], values)
        change = -(c[:, columns] @ pull) / fit.scales
        fitted, ratio = _misfit(seen, change, found.noise)
        held_out, held_before = _misfit(held, change, found.noise)
        score = float(values @ pull)
        p = float(min(1.0, looks * chi2.sf(score / level, len(columns))))
        return _Proof(score, p, {k: (v, after[k]) for k, v in fitted.items()},
                      {k: (v, held_after[k]) for k, v in held_out.items()},
                      (ratio, ratio_after, held_before, held_ratio),
                      # A few passes beside burns, predicted worst, must not decide for all others.
                      bool(np.sum(((held.residual + held.jacobian @ change) / spread_held) ** 2)
                           > np.sum((held.residual / spread_held) ** 2)))

    labels, units = ("time", "radial", "along", "cross", "duration"), ("s", "m/s", "m/s", "m/s", "s")
    steps = {n: Manoeuvre.of(fit.values[n]) for n in found.names}
    for members in _told_together(fit, steps, spread, found):
        first_columns = [fit.columns(n).start for n in members]
        values = np.concatenate([fit.values[n][1:4] for n in members])
        fixed = [c.start + k for c in map(fit.columns, members) for k in (0, 4)[: c.stop - c.start - 3]]
        velocity_columns = [c + k for c in first_columns for k in (1, 2, 3)]
        total = sum((steps[n].velocity for n in members), np.zeros(3))
        adding = np.tile(np.eye(3), len(members))
        block = adding @ covariance[np.ix_(velocity_columns, velocity_columns)] @ adding.T * level
        numbers: list[tuple[str, float, float, str]]
        if len(members) == 1:
            numbers = list(zip(labels, fit.values[members[0]], spread[fit.columns(members[0])], units, strict=False))
        else:
            when = np.array([steps[n].time for n in members])
            wide = float(max(np.ptp(when), min(spread[c] for c in first_columns)))
            numbers = [("time", float(when.mean()), wide, "s")]
            numbers += [(p, float(v), float(s), "m/s")
                        for p, v, s in zip(labels[1:4], total, np.sqrt(np.diag(block)), strict=True)]
        parameters: dict[str, dict[str, Any]] = {p: {"value": float(v), "sigma": float(s), "unit": u}
                                                 for p, v, s, u in numbers}
        instant = model.epoch + np.timedelta64(round(parameters["time"]["value"] * 1e6), "us")
        proof = proved(velocity_columns, fixed, values, places)
        name = f"{FAMILY}:{found.names.index(members[0]) + 1}"
        reference = "a burn of constant acceleration in orbital axes" if steps[members[0]].burning else (
            "a burn short against the orbit")
        if len(members) > 1:
            reference = f"{len(members)} burns that these data cannot tell apart: the sum of their velocities"
        effects.append(KeptEffect(name, (name,), parameters, proof, utc_text(instant), reference, _open(total, block)))
    undetermined = _undetermined(fit, every, found)
    together: tuple[str, ...] = ()
    biases = tuple(o.name for o in own if o.family == "range-bias")
    scales = tuple(o.name for o in own if o.family == "range-scale-error")
    if biases and scales and any(w.startswith(_COMMON) for w in undetermined):
        together = (*scales, *biases)
    for e in every:
        c = fit.columns(e.name)
        values = fit.values[e.name]
        parameters = {p.name: {"value": float(v), "sigma": float(s), "unit": p.unit}
                      for p, v, s in zip(e.parameters, values, spread[c], strict=True)}
        proof = proved(list(range(c.start, c.stop)), [], values, len(every))
        group: tuple[str, ...] = (e.name,)
        if e.name in together:
            # Neither means anything without the other: they are taken away at once.
            group = (e.name, *(n for n in together if n != e.name))
            columns = [k for n in together for k in range(fit.columns(n).start, fit.columns(n).stop)]
            proof = proved(columns, [], np.concatenate([np.atleast_1d(fit.values[n]) for n in together]), len(every))
        better = proof.helps or any(b < a for a, b in proof.held_out.values())
        if proof.p_value > LEVEL or not better:
            continue
        effects.append(KeptEffect(e.name, group, parameters, proof, "", e.reference))
    effects.sort(key=lambda e: -e.proof.score)
    unit_of = {r.channel: r.unit for r in fit.problem.residuals}
    before_seen = _misfit(_rows(plain, found.noise, held_out=False), np.zeros(plain.jacobian.shape[1]), found.noise)[0]
    before_held = _misfit(_rows(plain, found.noise, held_out=True), np.zeros(plain.jacobian.shape[1]), found.noise)[0]
    ends = {c: (v, held_after.get(c, float("nan")), unit_of[c]) for c, v in after.items()}
    begins = {c: (v, before_held.get(c, float("nan")), unit_of[c]) for c, v in before_seen.items()}
    return KeptExplanation(model, found, fit, plain, begins, ends, structure, ratio_after, tuple(effects), undetermined,
                           "unknown", "", 0.0, expected=expected)


def _spread(rows: _Rows, covariance: np.ndarray) -> np.ndarray:
    """Sigma (n,) of how far rows that were not fitted miss: their noise of one and the fit's covariance (scaled)."""
    return np.asarray(np.sqrt(1.0 + np.einsum("ij,jk,ik->i", rows.jacobian, covariance, rows.jacobian)))


def _told_together(fit: Fit, steps: dict[str, Manoeuvre], spread: np.ndarray, found: Found) -> list[list[str]]:
    """Manoeuvres by name, those together that the data cannot tell apart."""
    unsure = {n for n in steps if np.all(np.abs(fit.values[n][1:4])
                                         < _SURE * spread[fit.columns(n).start + 1 : fit.columns(n).start + 4])}
    pairs = {p for p in neighbours(steps, {n: float(spread[fit.columns(n).start]) for n in steps}, found.search.times)
             if unsure & set(p)}
    groups: list[list[str]] = []
    for n in sorted(steps, key=lambda n: steps[n].time):
        if groups and (groups[-1][-1], n) in pairs:
            groups[-1].append(n)
        else:
            groups.append([n])
    return groups


def _open(velocity: np.ndarray, covariance: np.ndarray) -> str:
    """The direction in which a velocity step (3,) with a covariance (3, 3) is open, in words."""
    values, vectors = np.linalg.eigh(covariance)
    sigma, axis = float(np.sqrt(max(values[-1], 0.0))), vectors[:, -1]
    if sigma < _SPREAD * float(np.linalg.norm(velocity)):
        return ""
    parts = [f"{x:+.2f} {n}" for x, n in zip(axis, ("radial", "along", "cross"), strict=True) if abs(x) > 0.1]
    return f"its velocity along {' '.join(parts)} is known to {1e3 * sigma:.3g} mm/s only"


def _undetermined(fit: Fit, effects: Sequence[OrbitEffect], found: Found) -> tuple[str, ...]:
    """Numbers of which the data say little more than was assumed of their size, in words."""
    words = []
    covariance = fit.covariance()
    for e in effects:
        c = fit.columns(e.name)
        width = np.array([_WIDTHS.get(e.family, 10 * p.scale) for p in e.parameters])
        block = covariance[c, c]
        mean_sigma = float(np.sqrt(block.mean()))
        if e.each and mean_sigma > 0.1 * width[0] / np.sqrt(len(width)):
            spread = block - block.mean(axis=0) - block.mean(axis=1)[:, None] + block.mean()
            words.append(
                f"{_COMMON} {e.family} that all stations share ({mean_sigma:.3g} m; their differences to "
                f"{np.sqrt(np.diag(spread)).max():.2g} m), against the scale of the ranges and the longitude"
            )
            continue
        for p, s, w in zip(e.parameters, np.sqrt(np.diag(block)), width, strict=True):
            if s > _UNDETERMINED * w:
                words.append(f"{e.name} {p.name}")
    return tuple(words)


def _verdict(answer: KeptExplanation, noise: dict[str, float]) -> tuple[str, str]:
    """The word and its sentence; ``noise`` is that of quiet data by channel."""
    effects, after = answer.effects, answer.after
    manoeuvres = sum(e.name.startswith(FAMILY) for e in effects)
    groups = dict.fromkeys(tuple(sorted(e.group)) for e in effects if not e.name.startswith(FAMILY))
    others = ", ".join(" or ".join(g) for g in groups)
    missing = f"{manoeuvres} manoeuvres" if manoeuvres > 1 else "one manoeuvre"
    unsure = sum(_nothing(e) for e in effects if e.name.startswith(FAMILY))
    missing += f" ({unsure} of them within three sigmas of zero)" if unsure else ""
    missing += f" and {others}" if others else ""
    over = answer.expected
    left = "; ".join(f"{a:.3g} {u} RMS in {c.replace('_', ' ')} ({b:.3g} {u} in data no fit has seen, "
                     f"{over.get(c, float('nan')):.2g} times what was to be expected there; noise of quiet data "
                     f"{noise[c]:.2g} {u})" for c, (a, b, u) in after.items())

    def too_much(c: str, fitted: float, held_out: float) -> bool:
        limit = max(_NAMED * noise[c], _METRE.get(c, 0.0))
        # A pass beside a burn is predicted worse than it is measured: what counts there is what was to be expected.
        return fitted > limit or (held_out > limit and not over.get(c, np.inf) < _NAMED)

    loud = any(too_much(c, a, b) for c, (a, b, _) in after.items())
    if loud or answer.missed:
        why = f"missing were {missing}; the library holds no explanation of the rest: {left}"
        if answer.missed:
            why += f"; {answer.missed} measurements lie in stretches too short or too disturbed for an orbit"
        places = answer.left_where()
        if places:
            why += f"; most in {places[0]['sentence']}"
        return "unknown", why
    tail = f"left is {left}"
    if answer.structure > _SURE:
        tail += ", but shared by stations or slow"
    if any(len(e.group) > 1 for e in effects):
        return "ambiguous", f"missing were {missing}, of which the data cannot tell apart those with an or; {tail}"
    return "named", f"missing were {missing}; {tail}"


def explained_tracking(tracking: Tracking, settings: OrbitSettings, *, hold_out: float = 0.2,
                       without: Sequence[str] = (), say: Say | None = None) -> KeptExplanation | None:
    """As :func:`explained_kept`, from the observations.

    Raises:
        InputError: data that cannot be used.
    """
    return explained_kept(orbit_model(tracking, settings), hold_out=hold_out, without=without, say=say)
