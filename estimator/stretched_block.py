"""Positions in several stretches far apart: a Fourier frame each, one linear block of all of them.

Days or years between acquisitions hold no position, and one frame over all of them would need a degree that grows with
the time between them. Here every stretch has its own frame and its own times, counted from its first sample, so that
years after the epoch cost no precision. :class:`StretchedBlock` has the interface of
:class:`estimator.linear_block.LinearBlock`; its whitened coordinates are those of the stretches one after the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from estimator.linear_block import DegreeChoice, LinearBlock, choose_degree, compress
from estimator.models.errors import RequestError, TooFewDataError
from estimator.models.fourier_trajectory import FourierFrame

SHORTEST_BREAK = 0.125
"""Fraction of an oscillation (an orbit) below which a gap in the samples never ends a stretch."""
SHORTEST_BREAK_STEPS = 20.0
"""Median steps below which a gap never ends a stretch."""
LONGEST_BRIDGE = 4.0
"""Oscillations (orbits) above which a gap always ends a stretch."""
LEAST_FILLED = 0.5
"""Part of a stretch that samples must fill; gaps in a better filled one are bridged."""
FEWEST_SAMPLES = 4
"""Samples that a stretch needs for a trajectory of its own."""


def stretches_of(time: np.ndarray, oscillation: float) -> tuple[slice, ...]:
    """Where increasing times fall apart into stretches with a trajectory each.

    A gap can end a stretch when it is longer than ``SHORTEST_BREAK`` oscillations and ``SHORTEST_BREAK_STEPS`` median
    steps. It does when it is longer than ``LONGEST_BRIDGE`` oscillations too, or when such gaps together take up more
    than half of the span: the longest is cut first, and each side is judged anew. An arc with a third of its samples
    missing in chunks stays one stretch; passes or acquisitions with long pauses fall apart.

    Args:
        time: (n,) s, increasing.
        oscillation: period of the motion, s (of the orbit).

    Returns:
        Slices of the samples, in order, that cover them all.

    Raises:
        RequestError: times that decrease, or a period that is not positive.
    """
    time = np.asarray(time, dtype=float)
    if not oscillation > 0:
        raise RequestError("the period of the motion is not positive", where="stretches_of", value=oscillation)
    step = np.diff(time)
    if step.size and step.min() < 0:
        raise RequestError("times of samples decrease", where="stretches_of", value=f"{step.min()} s",
                           remedy="sort the samples by time")
    if step.size == 0:
        return (slice(0, time.size),)
    shortest = max(SHORTEST_BREAK * oscillation, SHORTEST_BREAK_STEPS * float(np.median(step)))
    gaps = np.flatnonzero(step > shortest)
    longest = max(shortest, LONGEST_BRIDGE * oscillation)
    pending, found = [(0, time.size)], []
    while pending:
        first, last = pending.pop()
        inside = gaps[(gaps >= first) & (gaps < last - 1)]
        if inside.size:
            lengths = step[inside]
            worst = int(inside[np.argmax(lengths)])
            filled = 1.0 - float(lengths.sum()) / float(time[last - 1] - time[first])
            if lengths.max() > longest or filled < LEAST_FILLED:
                pending += [(worst + 1, last), (first, worst + 1)]
                continue
        found.append(slice(first, last))
    return tuple(found)


@dataclass(frozen=True)
class StretchedFrame:
    """The Fourier frames of several stretches.

    Attributes:
        frames: one frame a stretch, its times counted from the stretch's origin.
        starts, stops: (s,) s, first and last time of the data of each stretch; ``starts`` are the origins.
    """

    frames: tuple[FourierFrame, ...]
    starts: tuple[float, ...]
    stops: tuple[float, ...]

    def __post_init__(self) -> None:
        if not (len(self.frames) == len(self.starts) == len(self.stops) > 0):
            raise RequestError("a stretch has one frame, one start and one stop", where="StretchedFrame",
                               value=f"{len(self.frames)}, {len(self.starts)}, {len(self.stops)}")
        bounds = np.column_stack([self.starts, self.stops]).ravel()
        if not (np.diff(bounds) >= 0).all():
            raise RequestError("stretches overlap or are not in order of time", where="StretchedFrame",
                               value=", ".join(f"{a} to {b} s" for a, b in zip(self.starts, self.stops, strict=True)))

    @property
    def degree(self) -> int:
        """The largest degree of all stretches."""
        return max(f.degree for f in self.frames)

    @property
    def degrees(self) -> tuple[int, ...]:
        """Degree of each stretch."""
        return tuple(f.degree for f in self.frames)

    @property
    def size(self) -> int:
        """Number of coefficients of all stretches."""
        return sum(f.size for f in self.frames)

    @property
    def start(self) -> float:
        """First time of the data, s."""
        return self.starts[0]

    @property
    def stop(self) -> float:
        """Last time of the data, s."""
        return self.stops[-1]

    def stretch(self, time: np.ndarray) -> np.ndarray:
        """Index (m,) of the stretch that each time is in, or is nearest to."""
        time = np.atleast_1d(np.asarray(time, dtype=float))
        right = np.clip(np.searchsorted(self.starts, time, side="right"), 1, len(self.starts)) - 1
        after = np.minimum(right + 1, len(self.starts) - 1)
        starts, stops = np.array(self.starts), np.array(self.stops)
        return np.where((time > stops[right]) & (starts[after] - time < time - stops[right]), after, right)

    def inside(self, time: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """Whether each time (m,) lies in a stretch, or at most ``margin`` seconds outside of one."""
        return np.abs(np.asarray(time, dtype=float) - self.nearest(time)) <= margin

    def nearest(self, time: np.ndarray) -> np.ndarray:
        """The times (m,) themselves inside a stretch, and the nearest time of a stretch outside."""
        time = np.atleast_1d(np.asarray(time, dtype=float))
        index = self.stretch(time)
        return np.clip(time, np.array(self.starts)[index], np.array(self.stops)[index])

    def parts(self, time: np.ndarray) -> list[tuple[int, np.ndarray, np.ndarray]]:
        """For each stretch that any time belongs to: its index, the places (k,) of the times, and relative times."""
        time = np.atleast_1d(np.asarray(time, dtype=float))
        index = self.stretch(time)
        found = []
        for k in np.unique(index):
            places = np.flatnonzero(index == k)
            found.append((int(k), places, time[places] - self.starts[k]))
        return found


@dataclass(frozen=True)
class StretchedBlock:
    """Several compressed stretches as one linear block; see :class:`estimator.linear_block.LinearBlock`.

    Attributes:
        frame: the frames of the stretches.
        blocks: the compressed stretches.
        places: for each stretch, the indices of its samples among all.
    """

    frame: StretchedFrame
    blocks: tuple[LinearBlock, ...]
    places: tuple[np.ndarray, ...]

    @property
    def axes(self) -> int:
        """Number of axes d."""
        return int(self.blocks[0].coefficients.shape[1])

    @cached_property
    def coefficients(self) -> np.ndarray:
        """(size, d) coefficients of all stretches, one after the other."""
        return np.concatenate([b.coefficients for b in self.blocks])

    @cached_property
    def sum_of_squares(self) -> np.ndarray:
        """(d,) whitened residual sum of squares at the coefficients."""
        return np.sum([b.sum_of_squares for b in self.blocks], axis=0)

    @cached_property
    def degrees_of_freedom(self) -> np.ndarray:
        """(d,) samples of positive weight minus rank."""
        return np.sum([b.degrees_of_freedom for b in self.blocks], axis=0)

    @cached_property
    def ranks(self) -> np.ndarray:
        """(d,) number of determined directions on each axis."""
        return np.sum([b.ranks for b in self.blocks], axis=0)

    @property
    def rank(self) -> int:
        """The number of determined directions, the largest over the axes."""
        return int(self.ranks.max())

    def columns(self, axis: int) -> list[slice]:
        """For each stretch, its coordinates among those of all stretches on one axis."""
        ends = np.cumsum([0, *(int(b.ranks[axis]) for b in self.blocks)])
        return [slice(int(a), int(b)) for a, b in pairwise(ends)]

    def transform(self, axis: int) -> np.ndarray:
        """T (size, rank) of coefficients = c_0 + T zeta on one axis, block-diagonal."""
        from scipy.linalg import block_diag

        return np.asarray(block_diag(*(b.transform(axis) for b in self.blocks)))

    def values(self, time: np.ndarray, derivative: int = 0) -> np.ndarray:
        """The fit, or its derivative, (m, d); times in no stretch extrapolate the nearest one."""
        result = np.empty((np.atleast_1d(time).shape[0], self.axes))
        for k, places, relative in self.frame.parts(time):
            result[places] = self.blocks[k].values(relative, derivative)
        return result

    def sensitivity(self, time: np.ndarray, derivative: int, axis: int) -> np.ndarray:
        """Derivative (m, rank) of the fit with respect to zeta; zero along the coordinates of other stretches."""
        result = np.zeros((np.atleast_1d(time).shape[0], int(self.ranks[axis])))
        columns = self.columns(axis)
        for k, places, relative in self.frame.parts(time):
            result[places, columns[k]] = self.blocks[k].sensitivity(relative, derivative, axis)
        return result

    def standard_deviation(self, time: np.ndarray, derivative: int, axis: int) -> np.ndarray:
        """Standard deviation (m,) of the fit, or its derivative, on one axis."""
        result = np.empty(np.atleast_1d(time).shape[0])
        for k, places, relative in self.frame.parts(time):
            result[places] = self.blocks[k].standard_deviation(relative, derivative, axis)
        return result

    def project(self, samples: np.ndarray, axis: int) -> np.ndarray:
        """The part (rank, q) of extra columns (n, q) that the trajectories would take up."""
        samples = np.asarray(samples, dtype=float)
        return np.concatenate([b.project(samples[p], axis) for b, p in zip(self.blocks, self.places, strict=True)])

    def residuals(self) -> np.ndarray:
        """Measured minus fitted, not whitened, (n, d)."""
        result = np.empty((sum(p.size for p in self.places), self.axes))
        for block, places in zip(self.blocks, self.places, strict=True):
            result[places] = block.residuals()
        return result


def _places(frame: StretchedFrame, time: np.ndarray) -> list[np.ndarray]:
    """Samples of each stretch.

    Raises:
        RequestError: a sample in no stretch.
        TooFewDataError: a stretch without samples.
    """
    inside = frame.inside(time, 1e-9 * max(b - a for a, b in zip(frame.starts, frame.stops, strict=True)))
    if not inside.all():
        raise RequestError("a sample lies in no stretch of the frame", where="compress_stretches",
                           value=f"{time[int(np.argmin(inside))]} s",
                           limit=", ".join(f"{a} to {b} s" for a, b in zip(frame.starts, frame.stops, strict=True)))
    index = frame.stretch(time)
    places = [np.flatnonzero(index == k) for k in range(len(frame.frames))]
    empty = [k for k, p in enumerate(places) if p.size == 0]
    if empty:
        raise TooFewDataError("a stretch has no sample", where=f"compress_stretches: stretch {empty[0]}", value=0)
    return places


def compress_stretches(frame: StretchedFrame, time: np.ndarray, values: np.ndarray,
                       weights: np.ndarray) -> StretchedBlock:
    """Solve and compress every stretch; see :func:`estimator.linear_block.compress`.

    Args:
        frame: the frames of the stretches.
        time: (n,) s, in any order, each inside a stretch.
        values: (n, d) samples.
        weights: (n, d) 1/variance; zero for rejected samples.

    Raises:
        as :func:`estimator.linear_block.compress`; RequestError also for a sample in no stretch.
    """
    time, values, weights = (np.asarray(a, dtype=float) for a in (time, values, weights))
    places = _places(frame, time)
    blocks = tuple(compress(f, time[p] - start, values[p], weights[p])
                   for f, start, p in zip(frame.frames, frame.starts, places, strict=True))
    return StretchedBlock(frame, blocks, tuple(places))


def choose_degrees(time: np.ndarray, values: np.ndarray, standard_deviation: np.ndarray,
                   stretches: Sequence[slice]) -> tuple[StretchedFrame, tuple[DegreeChoice, ...]]:
    """The best frame of each stretch, each chosen by :func:`estimator.linear_block.choose_degree`, and the choices.

    Args:
        time: (n,) s, increasing.
        values: (n, d) samples.
        standard_deviation: (n, d) of the samples; infinite for rejected ones.
        stretches: from :func:`stretches_of`; each has at least ``FEWEST_SAMPLES`` samples.
    """
    deviation = np.broadcast_to(standard_deviation, values.shape)
    choices = tuple(choose_degree(time[s] - time[s.start], values[s], deviation[s]) for s in stretches)
    return stretched_frame(time, stretches, [c.frame for c in choices]), choices


def stretched_frame(time: np.ndarray, stretches: Sequence[slice],
                    frames: Sequence[FourierFrame] | int) -> StretchedFrame:
    """The frames of stretches of increasing times; a number stands for that degree on the data of every stretch."""
    starts = tuple(float(time[s.start]) for s in stretches)
    stops = tuple(float(time[s.stop - 1]) for s in stretches)
    if isinstance(frames, int):
        frames = [FourierFrame(0.0, b - a, frames) for a, b in zip(starts, stops, strict=True)]
    return StretchedFrame(tuple(frames), starts, stops)
