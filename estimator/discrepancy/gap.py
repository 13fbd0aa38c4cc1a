"""Where model and data disagree: channel, arcs, time scale and size, with a test that holds for any sampling.

Three kinds of structure are looked for. Slow: the residuals of every arc and component are projected on a few smooth
functions of time (Legendre polynomials of the arc), with everything that the fit absorbs projected out of them first;
the sum of squares is chi-square without a gap. Fast: the sum of products of neighbouring samples of a component is
normal without a gap. Periodic: the periodograms of the arcs of a component, one by one and added up, are chi-square at
each frequency without a gap. None minds irregular sampling or gaps. A sum of squares that is too large
without any is noise above the declared one, and said as such.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import legvander

from estimator.chance import chi2_tail, normal_tail
from estimator.discrepancy.score import Piece, Stack
from estimator.problem import Problem
from estimator.residuals import KernelResidual, Linearization
from estimator.trajectory_residual import TrajectoryResidual

SMOOTH = 8  # Legendre polynomials per arc and component
LONGEST_PIECE = 2048  # samples of a stretch of positions in one periodogram
LEVEL = 0.002  # probability of a gap where there is none, over all places together
BETWEEN = "between arcs"  # how stretches of positions without a known attitude are called


@dataclass(frozen=True)
class Place:
    """One place of disagreement.

    Attributes:
        channel: kind of measurement.
        arcs: names of the arcs that show it.
        components: indices of the beams or axes that show it.
        time_scale: s, over which the disagreement changes.
        unit: of ``excess`` and ``floor``.
        excess: root mean square of the structure over those arcs.
        floor: root mean square of the noise there.
        p_value: over all places together.
        sentence: all this in words.
    """

    channel: str
    arcs: tuple[str, ...]
    components: tuple[int, ...]
    time_scale: float
    unit: str
    excess: float
    floor: float
    p_value: float
    sentence: str


@dataclass(frozen=True)
class Gap:
    """The verdict on the residuals of one fit.

    Attributes:
        places: structure that the model does not explain, largest p first.
        white: (residual, factor) where white noise exceeds the declared one.
        p_value: smallest over all tests, corrected for their number.
    """

    places: tuple[Place, ...]
    white: tuple[tuple[str, float], ...]
    p_value: float

    @property
    def present(self) -> bool:
        """Whether there is structure at the stated level."""
        return bool(self.places)


@dataclass
class _Cell:
    channel: str
    arc: str
    component: int
    samples: int
    start: float
    stop: float
    statistic: float
    degrees: int
    p_value: float
    smooth_power: float
    dominant: int
    floor: float
    time_scale: float | None = None
    tests: int = 1  # independent frequencies of which the most striking one is shown
    period: float | None = None  # s
    members: tuple[_Cell, ...] = ()  # the cells of a sum
    inner: np.ndarray | None = None  # (p, functions) products of the smooth functions with the fit's orthonormal rows
    gradient: np.ndarray | None = None  # (functions,) products with the residual, calibration projected out

    @property
    def fast(self) -> bool:
        """Whether it tells of structure faster than the smooth functions of an arc."""
        return self.time_scale is not None


def find_gap(problem: Problem, stacked: Stack, parts: Sequence[Linearization]) -> Gap:
    """Test the residuals of a fit for structure.

    Args:
        problem: the accepted problem.
        stacked: its rows at the fit.
        parts: its linearizations at the fit.
    """
    cells: list[_Cell] = []
    absorbed = stacked.carried(stacked.residual)
    for residual, part in zip(problem.residuals, parts, strict=True):
        if isinstance(residual, KernelResidual):
            cells += _kernel_cells(residual, part, stacked, absorbed)
        elif isinstance(residual, TrajectoryResidual):
            cells += _position_cells(residual, part)
        cells += _serial_cells(residual, part, stacked.scale[residual.name])
    cells += _together(cells)
    cells += _periodic_cells(problem, parts, stacked)
    # Half of the level belongs to the few slow tests, half to the many fast ones.
    tests = {fast: 2 * max(sum(c.tests for c in cells if c.fast is fast), 1) for fast in (False, True)}
    significant = [c for c in cells if c.p_value < LEVEL / tests[c.fast]]
    structured = {c.channel for c in significant}
    white = {name: s for name, s in stacked.scale.items() if s > 1}
    for residual, part in zip(problem.residuals, parts, strict=True):
        excess = _noise_excess(part, stacked.pieces[residual.name], len(problem.residuals))
        if excess > 1 and residual.channel not in structured:
            white[residual.name] = max(white.get(residual.name, 1.0), excess)
    places = []
    for channel in dict.fromkeys(c.channel for c in significant):
        mine = [c for c in significant if c.channel == channel]
        everything = [c for c in cells if c.channel == channel]
        unit = next(r.unit for r in problem.residuals if r.channel == channel)
        places.append(_place(channel, unit, mine, everything, tests))
    smallest = min((c.p_value * tests[c.fast] for c in cells), default=1.0)
    return Gap(tuple(sorted(places, key=lambda p: p.p_value)), tuple(white.items()), min(1.0, smallest))


def _together(cells: Sequence[_Cell]) -> list[_Cell]:
    """Slow structure of all arcs of a component, and of all components: weak in each, it may be plain in the sum.

    Positions inside the arcs, where the attitude is known, are one sum and those between them another.
    """
    found = []
    families: dict[tuple[str, bool], list[_Cell]] = {}
    for cell in cells:
        if not cell.fast:
            families.setdefault((cell.channel, cell.arc.startswith(BETWEEN)), []).append(cell)
    for (channel, _), mine in families.items():
        components = sorted({c.component for c in mine})
        if len(mine) < 2:
            continue
        whole = chi2_tail(*_sum(mine))
        for k in components:
            some = [c for c in mine if c.component == k]
            statistic, degrees = _sum(some)
            found.append(_Cell(channel, "", k, sum(c.samples for c in some), some[0].start, some[-1].stop, statistic,
                               degrees, float(min(chi2_tail(statistic, degrees), whole)),
                               sum(c.smooth_power for c in some), max(some, key=lambda c: c.smooth_power).dominant,
                               some[0].floor, tests=2, members=tuple(some)))
    return found


def _sum(cells: Sequence[_Cell]) -> tuple[float, int]:
    """Chi-square of cells together, which the calibration ties to each other."""
    tied = [c for c in cells if c.inner is not None]
    statistic, degrees = sum(c.statistic for c in cells if c.inner is None), sum(c.degrees for c in cells
                                                                                  if c.inner is None)
    if tied:
        square, free = _square(np.concatenate([c.inner for c in tied if c.inner is not None], axis=1),
                               np.concatenate([c.gradient for c in tied if c.gradient is not None]))
        statistic, degrees = statistic + square, degrees + free
    return statistic, max(degrees, 1)


def _kernel_cells(residual: KernelResidual, part: Linearization, stacked: Stack,
                  absorbed: np.ndarray) -> list[_Cell]:
    """Smooth functions in every arc and component; ``absorbed`` are the products of the basis with the residual."""
    cells = []
    piece = stacked.pieces[residual.name]
    width = part.whitened.shape[1]
    kept = part.weight > 0
    noise = np.sqrt(np.mean(residual.standard_deviation**2, axis=0))
    for label, name in enumerate(residual.arc_names):
        inside = np.flatnonzero((residual.arc == label) & kept)
        if len(inside) < 2 * SMOOTH:
            continue
        time = residual.time[inside]
        start, stop = float(time[0]), float(time[-1])
        phase = 2 * (time - start) / max(stop - start, 1e-9) - 1
        smooth = np.linalg.qr(legvander(phase, SMOOTH - 1))[0]
        for component in range(width):
            if below_noise(part.whitened[inside, component] / stacked.scale[residual.name]):
                continue
            at = inside * width + component
            inner = piece.inner.T @ (piece.span[at].T @ smooth)
            direct = smooth.T @ stacked.residual[piece.rows][at]
            gradient = direct - inner.T @ absorbed
            statistic, degrees = _square(inner, gradient)
            cells.append(_Cell(residual.channel, name, component, len(inside), start, stop, statistic, degrees,
                               float(chi2_tail(statistic, max(degrees, 1))), float(direct @ direct),
                               int(np.argmax(direct**2)), float(noise[component % len(noise)]),
                               inner=inner, gradient=gradient))
    return cells


def below_noise(whitened: np.ndarray) -> bool:
    """Whether residuals (n,) stay clearly below the declared noise, structure and all: the model explains them then."""
    return len(whitened) > 0 and float(np.mean(whitened**2)) < 1 - 2 * float(np.sqrt(2 / len(whitened)))


def _square(inner: np.ndarray, gradient: np.ndarray) -> tuple[float, int]:
    """Chi-square and its degrees of amounts of orthonormal functions E with products ``gradient`` after projection.

    The calibration's rows elsewhere matter too: the Gram matrix of what it leaves of E is I - (Q'E)'(Q'E), ``inner``
    being Q'E.
    """
    eigenvalues, vectors = np.linalg.eigh(np.eye(inner.shape[1]) - inner.T @ inner)
    good = eigenvalues > 1e-6
    return float(np.sum((vectors[:, good].T @ gradient) ** 2 / eigenvalues[good])), int(good.sum())


def _position_cells(residual: TrajectoryResidual, part: Linearization) -> list[_Cell]:
    """Stretches of the positions; what the trajectory absorbs there only makes the test more cautious."""
    cells = []
    used = residual.weights[:, 0] > 0
    time = residual.time[used]
    whitened = (part.residual / residual.standard_deviation)[used]
    marks = _marked(residual, used)
    for name, inside in marks:
        if len(inside) < 4 * SMOOTH:
            continue
        start, stop = float(time[inside[0]]), float(time[inside[-1]])
        phase = 2 * (time[inside] - start) / max(stop - start, 1e-9) - 1
        smooth = np.linalg.qr(legvander(phase, SMOOTH - 1))[0]
        for axis in range(3):
            if below_noise(whitened[inside, axis]):
                continue
            amounts = smooth.T @ whitened[inside, axis]
            statistic = float(amounts @ amounts)
            cells.append(_Cell("gnss", name, axis, len(inside), start, stop, statistic, SMOOTH,
                               float(chi2_tail(statistic, SMOOTH)), statistic, int(np.argmax(amounts**2)),
                               float(np.sqrt(np.mean(residual.standard_deviation[:, axis] ** 2)))))
    return cells


def _noise_excess(part: Linearization, piece: Piece, residuals: int) -> float:
    """Root mean square of the whitened residual where its sum of squares is improbably large, 1 else."""
    total = float(np.sum(part.weight[:, None] * part.whitened**2))
    degrees = part.measurements - float(np.sum(piece.inner**2))  # its share of the fit's directions
    if degrees < 1 or chi2_tail(total, degrees) * residuals > LEVEL:
        return 1.0
    return float(np.sqrt(total / degrees))


def _serial_cells(residual: object, part: Linearization, scale: float) -> list[_Cell]:
    """Products of neighbouring samples of each component, over all arcs together."""
    if isinstance(residual, KernelResidual):
        used = np.flatnonzero(part.weight > 0)
        order = used[np.lexsort((residual.time[used], residual.arc[used]))]
        series, time, arc = part.whitened[order] / scale, residual.time[order], residual.arc[order]
        floor = np.sqrt(np.mean(residual.standard_deviation**2, axis=0))
        label = residual.arc_names[0] if len(residual.arc_names) == 1 else "all arcs"
    elif isinstance(residual, TrajectoryResidual):
        used = np.flatnonzero(residual.weights[:, 0] > 0)
        series, time = (part.residual / residual.standard_deviation)[used], residual.time[used]
        arc = np.zeros(len(used), dtype=int)
        floor = np.sqrt(np.mean(residual.standard_deviation**2, axis=0))
        label = "all positions"
    else:
        return []
    if len(series) < 4 * SMOOTH:
        return []
    step = np.diff(time)
    pairs = (arc[1:] == arc[:-1]) & (step < 3.5 * np.median(step[step > 0]))
    count = int(pairs.sum())
    if count < 4 * SMOOTH:
        return []
    cells = []
    for component in range(series.shape[1]):
        x = series[:, component]
        if below_noise(x):
            continue
        spread = max(float(np.mean(x**2)), 1.0)  # what stays below the declared noise is no gap, however smooth
        product = float(np.sum(x[1:][pairs] * x[:-1][pairs]))
        z = product / (np.sqrt(count) * spread)
        cells.append(_Cell(residual.channel, label, component, count, float(time[0]), float(time[-1]), z * z, 1,
                           float(normal_tail(z)), max(product, 0.0), 1, float(floor[component % len(floor)]),
                           _correlation_time(x, float(np.median(step[pairs])))))
    return cells


def _series(problem: Problem, parts: Sequence[Linearization], stacked: Stack,
            ) -> Iterator[tuple[str, str, np.ndarray, np.ndarray, np.ndarray]]:
    """Channel, arc, times (n,), whitened residuals (n, m) and noise (m,) of every arc and stretch of positions."""
    for residual, part in zip(problem.residuals, parts, strict=True):
        if isinstance(residual, KernelResidual):
            noise = np.sqrt(np.mean(residual.standard_deviation**2, axis=0)) * np.ones(part.whitened.shape[1])
            whitened = part.whitened / stacked.scale[residual.name]
            for label, name in enumerate(residual.arc_names):
                inside = np.flatnonzero((residual.arc == label) & (part.weight > 0))
                inside = inside[np.argsort(residual.time[inside], kind="stable")]
                yield residual.channel, name, residual.time[inside], whitened[inside], noise
        elif isinstance(residual, TrajectoryResidual):
            used = residual.weights[:, 0] > 0
            noise = np.sqrt(np.mean(residual.standard_deviation**2, axis=0))
            whitened = (part.residual / residual.standard_deviation)[used]
            for name, inside in _marked(residual, used):
                for piece in np.array_split(inside, -(-len(inside) // LONGEST_PIECE)):
                    yield residual.channel, name, residual.time[used][piece], whitened[piece], noise


def _periodic_cells(problem: Problem, parts: Sequence[Linearization], stacked: Stack) -> list[_Cell]:
    """The most striking frequency of every arc and component, and of all arcs of a component together."""
    by_channel: dict[str, list[tuple[str, np.ndarray, np.ndarray, np.ndarray]]] = {}
    for channel, name, time, whitened, noise in _series(problem, parts, stacked):
        if len(time) >= 8 * SMOOTH and time[-1] > time[0]:
            by_channel.setdefault(channel, []).append((name, time, whitened, noise))
    cells = []
    for channel, arcs in by_channel.items():
        step = float(np.median([np.median(np.diff(time)) for _, time, _, _ in arcs]))
        length = max(float(time[-1] - time[0]) for _, time, _, _ in arcs)
        if step <= 0 or length < 4 * SMOOTH * step:
            continue
        # Slower than two periods in an arc is the matter of the smooth functions.
        bins = int(2 ** np.ceil(np.log2(2 * length / step + 2)))
        frequency = np.fft.rfftfreq(bins, step)
        seen = (frequency >= 2 / length) & (frequency <= 0.5 / step)
        frequency = frequency[seen]
        number = len(frequency)
        components = arcs[0][2].shape[1]
        power = np.zeros((len(arcs), components, number))  # each chi-square of two degrees without a gap
        for i, (_, time, whitened, _) in enumerate(arcs):
            place = np.rint((time - time[0]) / step).astype(int)
            for k in range(components):
                if below_noise(whitened[:, k]):
                    continue
                level = max(float(np.mean(whitened[:, k] ** 2)), 1.0)
                spread = np.bincount(place, whitened[:, k], minlength=bins)
                power[i, k] = 2 * np.abs(np.fft.rfft(spread)[seen]) ** 2 / (len(time) * level)
        samples = sum(len(time) for _, time, _, _ in arcs)
        everywhere = power.sum(axis=(0, 1))
        common = chi2_tail(everywhere, 2 * len(arcs) * components)
        for k in range(components):
            floor = float(arcs[0][3][k])
            for i, (name, time, _, _) in enumerate(arcs if len(arcs) > 1 else ()):
                top = int(np.argmax(power[i, k]))
                cells.append(_periodic_cell(channel, name, k, time, len(time), power[i, k, top], 2, floor,
                                            frequency[top], number))
            total = power[:, k].sum(axis=0)
            p_value = chi2_tail(total, 2 * len(arcs))
            top = int(np.argmin(np.minimum(p_value, common)))
            whole = np.array([arcs[0][1][0], arcs[-1][1][-1]])
            cell = _periodic_cell(channel, "all arcs" if len(arcs) > 1 else arcs[0][0], k, whole, samples, total[top],
                                  2 * len(arcs), floor, frequency[top], number)
            # Where all components together tell more, each shows what it has of it.
            cell.p_value = float(min(p_value[top], common[top]))
            cell.tests = 2 * number
            cells.append(cell)
    return cells


def _periodic_cell(channel: str, arc: str, component: int, time: np.ndarray, samples: int, power: float, degrees: int,
                   floor: float, frequency: float, tests: int) -> _Cell:
    return _Cell(channel, arc, component, samples, float(time[0]), float(time[-1]), float(power), degrees,
                 float(chi2_tail(power, degrees)), float(power), 1, floor, 0.5 / float(frequency), tests,
                 1.0 / float(frequency))


def _correlation_time(x: np.ndarray, step: float) -> float:
    """Lag (s) at which the autocorrelation has fallen to 1/e of its value at the first lag."""
    centred = x - x.mean()
    size = 1 << int(np.ceil(np.log2(2 * len(x))))
    spectrum = np.abs(np.fft.rfft(centred, size)) ** 2
    correlation = np.fft.irfft(spectrum, size)[: max(len(x) // 2, 3)]
    fallen = np.flatnonzero(correlation[1:] < correlation[1] / np.e)
    return float((fallen[0] + 1 if len(fallen) else len(correlation)) * step)


def _marked(residual: TrajectoryResidual, used: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """Stretches of the positions that are looked at: those with a known attitude where there are any, and the rest."""
    count = int(used.sum())
    inside = residual.effect_data.get("inside_arc")
    if inside is None or not np.any(inside):
        return [(f"stretch {i + 1}", piece) for i, piece in enumerate(np.array_split(np.arange(count), 24))]
    flag = np.asarray(inside)[used] > 0
    edges = np.flatnonzero(np.diff(flag.astype(int))) + 1
    return [(f"arc {i + 1}" if flag[piece[0]] else f"{BETWEEN} {i + 1}", piece)
            for i, piece in enumerate(np.split(np.arange(count), edges)) if len(piece)]


def _place(channel: str, unit: str, cells: list[_Cell], everything: list[_Cell],
           tests: Mapping[bool, int]) -> Place:
    p = min(1.0, min(c.p_value * tests[c.fast] for c in cells))
    # Slow structure says which arcs; periods, and products of neighbours over all arcs, speak where it finds none.
    slow = [c for c in cells if not c.fast and not c.members]
    if not slow:  # what only the sum over arcs shows is where most of it is
        slow = [m for c in cells for m in sorted(c.members, key=lambda m: m.degrees - m.smooth_power)[:4]
                if m.smooth_power > m.degrees]
    periodic = [c for c in cells if c.period is not None]
    if periodic:
        first = min(periodic, key=lambda c: c.p_value)
        periodic = [c for c in periodic if (c.arc == "all arcs") == (first.arc == "all arcs")]
    cells = slow or periodic or cells
    everything = [c for c in everything if not c.fast and not c.members] or everything
    arcs = tuple(dict.fromkeys(c.arc for c in cells))
    power: dict[int, float] = {}
    for c in cells:
        power[c.component] = power.get(c.component, 0.0) + max(c.smooth_power - c.degrees, 0.0)
    # Noise common to all components leaves a trace of one component's structure in the others.
    components = tuple(sorted(k for k, v in power.items() if v >= 0.5 * max(power.values())))
    cells = [c for c in cells if c.component in components]
    samples = sum(c.samples for c in cells)
    floor = float(np.sqrt(sum(c.samples * c.floor**2 for c in cells) / samples))
    excess = float(np.sqrt(sum(max(c.smooth_power - c.degrees, 0.0) * c.floor**2 for c in cells) / samples))
    dominant = int(np.bincount([c.dominant for c in cells]).argmax())
    length = float(np.median([c.stop - c.start for c in cells]))
    scale = length / dominant if dominant else max(length, float(cells[-1].stop - cells[0].start))
    serial = [c.time_scale for c in cells if c.time_scale is not None]
    if serial and len(serial) == len(cells):
        scale = float(np.median(serial))
    which = {"doppler": "beam", "star_tracker": "axis", "gnss": "axis"}.get(channel, "component")
    all_components = {c.component for c in everything}
    parts = "all " + ("beams" if which == "beam" else "axes") if set(components) == all_components else \
        f"{which} " + ", ".join(str(c) for c in components)
    all_arcs = {c.arc for c in everything}
    where = "every arc" if set(arcs) == all_arcs else ("" if serial else "arcs ") + ", ".join(arcs)
    periods = [c for c in cells if c.period is not None]
    shape = "constant within an arc" if dominant == 0 else f"changes within {scale:.3g} s"
    if periods and len(periods) == len(cells):
        strongest = min(periods, key=lambda c: c.p_value)
        scale = float(strongest.period or 0.0)
        shape = f"repeats every {scale:.3g} s"
    value, noise, shown = _readable(excess, floor, unit)
    size = f"{value:.3g} {shown} RMS over {noise:.3g} {shown}"
    sentence = f"{channel.replace('_', ' ')}, {parts}, {where}: {size}; {shape}"
    return Place(channel, arcs, components, scale, unit, excess, floor, p, sentence)


def _readable(excess: float, floor: float, unit: str) -> tuple[float, float, str]:
    if unit == "rad":
        factor = 180 / np.pi * 3600  # arcsec
        return excess * factor, floor * factor, "arcsec"
    return excess, floor, unit
