"""Scans of an area in one pass: how many, where they lie, when they are done, in which order and direction.

The area is a rectangle in the azimuthal equidistant plane of its centre; ``along`` runs with the scans in the sense of
flight, ``across`` to the right. Scans lie side by side; each is followed by its neighbour. Everything is found by
simulation on the rotating ellipsoid with the propagated orbit, as a fixed point of four relations:

- a scan begins when the slew from the one before ends;
- neighbours overlap by the asked share of the wider one, at the place where they overlap least;
- every scan is so long that its detector line passes the area's ends over the whole of its width;
- the largest pitch forward equals the largest pitch backward, which centres the plan on the closest approach.

Source: Somov, Butyrin, Makarov, section 2. The paper's estimate of the number of scans has the wrong sign before the
overlap; both the printed and the corrected value are reported, and neither decides: the simulated coverage does.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from estimator.models.errors import BoresightError, GeometryError, InfeasibleError
from guidance.coverage import Outline, outline
from guidance.ground_geometry import EquidistantPlane, GroundLine, geodesic_inverse, wrapped
from guidance.kinematics import Motion
from guidance.orbit_propagation import Arc, Pass
from guidance.scan import Camera, Scan, make_scan, pitch_of
from guidance.slew_joining import Join, Joiner, end_of
from guidance.survey_request import AreaRequest, LimitsRequest

Array = NDArray[np.float64]

AZIMUTH_LIMIT = math.pi / 9  # rad, of the scans from the ground track (Somov et al., section 2)
OVERLAP_GUARD = 1e-3  # added to the asked overlap (a share of the wider scan)
END_GUARD = 60.0  # m, by which a detector line passes the end of the area
END_TIME = 0.1  # s of scanning added at each end, so that a file with this step still shows the area covered
MOST_SCANS = 40  # in one pass
PITCH_RATE = 0.008  # rad/s, rough rate at which the pitch of a ground point falls: scales the centring step only


@dataclass(frozen=True)
class Pattern:
    """Order and directions of the scans of a pass.

    Attributes:
        from_left: the leftmost scan comes first.
        forward: direction of every scan in the order of time.
    """

    from_left: bool
    forward: tuple[bool, ...]

    def __str__(self) -> str:
        side = "left to right" if self.from_left else "right to left"
        return f"{side}, {''.join('+' if f else '-' for f in self.forward)}"


@dataclass
class Strip:
    """Where a scan lies in the plane: across of its line, and along of its two ends, m."""

    across: float
    near: float
    far: float


@dataclass(frozen=True)
class ScanCount:
    """The estimates of the number of scans (before rounding) and what they are made of, m."""

    nadir_swath: float
    widest_swath: float
    printed: float
    corrected: float


@dataclass(frozen=True)
class AreaPlan:
    """Scans of one pass over an area, in the order of time, with the slews between them.

    Attributes:
        pattern: order and directions.
        scans, joins: joins[i] leads from scans[i] to scans[i + 1].
        outlines: footprints in the plane, in rising order across.
        strips: in rising order across.
        complete: the area's right edge is reached.
        off_nadir: largest angle off the nadir during the scans, rad.
        excess: by how much limits are exceeded: name to (value, limit); empty for a good plan.
    """

    pattern: Pattern
    scans: tuple[Scan, ...]
    joins: tuple[Join, ...]
    outlines: tuple[Outline, ...]
    strips: tuple[Strip, ...]
    complete: bool
    off_nadir: float
    excess: dict[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def start(self) -> float:
        """s from the epoch."""
        return self.scans[0].start

    @property
    def stop(self) -> float:
        """s from the epoch."""
        return self.scans[-1].stop

    @property
    def duration(self) -> float:
        """s."""
        return self.stop - self.start

    @property
    def feasible(self) -> bool:
        """Whether all limits hold."""
        return not self.excess


class PassPlanner:
    """Plans scans of an area in one pass.

    Args:
        area: the request.
        plane: equidistant plane of the area's centre, ``along`` in the sense of flight.
        arc: the orbit around the pass.
        closest: time of the closest approach, s from the epoch.
        camera, limits, rate: from the request.
        joiner: makes slews.
        left: across (m) of the edge already covered, on the stations over the area's length; None for the area's own.
    """

    stations = 121

    def __init__(self, area: AreaRequest, plane: EquidistantPlane, arc: Arc, closest: float, camera: Camera,
                 limits: LimitsRequest, rate: float, joiner: Joiner, left: Outline | None = None):
        self.area, self.plane, self.arc, self.closest = area, plane, arc, closest
        self.camera, self.limits, self.rate, self.joiner, self.left = camera, limits, rate, joiner, left

    # -------------------------------------------------------------------------------------------- building blocks

    def line(self, strip: Strip) -> tuple[GroundLine, float]:
        """The geodesic between the two ends of a strip, and its length (m)."""
        latitude, longitude = self.plane.to_ellipsoid([strip.near, strip.far], [strip.across, strip.across])
        length, azimuth, _ = geodesic_inverse(latitude[0], longitude[0], latitude[1], longitude[1])
        return GroundLine(float(latitude[0]), float(longitude[0]), float(azimuth)), float(length)

    def scan(self, strip: Strip, start: float, forward: bool) -> Scan:
        """The scan of a strip begun at a time (s from the epoch)."""
        line, length = self.line(strip)
        return make_scan(self.arc, self.camera, line, 0.0 if forward else length, length if forward else 0.0, start,
                         self.rate, kind_of_motion=self.area.image_motion, turned=self.area.reversal == "yaw")

    def _needed_ends(self, shape: Outline, speed: float) -> tuple[float, float]:
        """How far (m) the near and the far end fall short of the area's ends, inside the area's width."""
        half = self.area.width / 2
        answers = []
        for end, sign in ((shape.near, 1.0), (shape.far, -1.0)):
            limits = np.clip([end[0, 1], end[-1, 1]], -half, half)
            across = np.linspace(limits[0], limits[1], 33)
            along = np.interp(across, end[:, 1], end[:, 0])
            answers.append(float(np.max(sign * along)) + self.area.length / 2 + END_GUARD + END_TIME * speed)
        return answers[0], answers[1]

    def swath(self, across: float, time: float) -> float:
        """Rough length (m) on the ground of the detector line when it looks at a point of the central line."""
        latitude, longitude = self.plane.to_ellipsoid(0.0, across)
        point, _ = GroundLine(float(latitude), float(longitude), 0.0).at(0.0)
        position, _, _ = self.arc.earth_fixed(np.array(time))
        sight = point - position
        distance = float(np.linalg.norm(sight))
        up = position / np.linalg.norm(position)
        side = np.cross(sight, self.arc.earth_fixed(np.array(time))[1])
        side = side / np.linalg.norm(side)
        tilt = math.asin(min(0.99, abs(float(side @ up))))
        return distance * self.camera.field / max(math.cos(tilt), 0.2) ** 2

    # ------------------------------------------------------------------------------------------------ fixed point

    def simulate(self, pattern: Pattern, strips: list[Strip], *, start: float | None = None, rounds: int = 14,
                 durations: list[float] | None = None, coarse: bool = True, fill: bool = True,
                 shift: float = 0.0) -> AreaPlan:
        """The plan of a given pattern, from a guess of the strips.

        Args:
            strips: in rising order across; changed into the answer.
            start: time of the first scan's start to begin with.
            durations: of the slews, to begin with.
            coarse: stop at a hundredth of the precision.
            fill: the strips are to cover all that is left of the area; otherwise they begin at its covered edge.
            shift: centre the plan this much later than the closest approach, s.
        """
        count = len(strips)
        gaps = list(durations) if durations else [self._first_gap()] * (count - 1)
        begin = start if start is not None else self.closest + shift - 0.5 * (count * 25.0 + sum(gaps))
        tolerance = 60.0 if coarse else 3.0  # m
        scans: list[Scan] = []
        shapes: list[Outline] = []
        complete = False
        for _ in range(rounds):
            ordered = strips if pattern.from_left else strips[::-1]
            scans, clock, worst_gap = [], begin, 0.0
            for index, (strip, forward) in enumerate(zip(ordered, pattern.forward, strict=True)):
                if index:
                    clock = scans[-1].stop + gaps[index - 1]
                scan = self.scan(strip, clock, forward)
                if index:
                    end, first = end_of(scans[-1].motion([scans[-1].stop])), end_of(scan.motion([scan.start]))
                    wanted = self.joiner.estimate(end, first)
                    if not math.isfinite(wanted):
                        raise InfeasibleError("no slew under the limits joins two scans", limit="rate, acceleration")
                    worst_gap = max(worst_gap, abs(wanted - gaps[index - 1]))
                    gaps[index - 1] = wanted
                scans.append(scan)
            shapes = [outline(s, self.plane) for s in (scans if pattern.from_left else scans[::-1])]
            placed = tuple(replace(s) for s in strips)
            change, complete = self._move(strips, shapes, _speeds(scans, pattern), fill)
            lag = self._lag(scans, shift)
            if change < tolerance and abs(lag) < (0.3 if coarse else 0.05) and worst_gap < (0.1 if coarse else 5e-3):
                break
            begin += lag
        else:
            if change > 2000.0:
                raise GeometryError("the scans of the area do not settle", where="survey planner",
                                    value=f"{change:.0f} m from round to round")
        off_nadir = max(s.largest_off_nadir() for s in scans)
        return AreaPlan(pattern, tuple(scans), (), tuple(shapes), placed, complete, off_nadir,
                        excess_of_scans(scans, self.limits, off_nadir))

    def _lag(self, scans: list[Scan] | tuple[Scan, ...], shift: float) -> float:
        """Seconds by which the scans are to be later, for equal pitches forward and backward ``shift`` s ago."""
        times = np.array([t for s in scans for t in (s.start, s.stop)])
        points = np.concatenate([s.line.at(np.array([s.first, s.last]))[0] for s in scans])
        pitch = pitch_of(self.arc, times - shift, points)
        return float(np.clip((pitch.max() + pitch.min()) / (2 * PITCH_RATE), -40, 40))

    def _first_gap(self) -> float:
        limits = self.limits
        return 2 * math.sqrt(math.radians(6.0) / limits.acceleration) + limits.acceleration / limits.jerk

    def _move(self, strips: list[Strip], shapes: list[Outline], speeds: list[float], fill: bool) -> tuple[float, bool]:
        """Move the strips towards the asked overlap and ends; the largest move (m) and whether the area is covered."""
        area, half = self.area, self.area.width / 2
        stations = np.linspace(-area.length / 2, area.length / 2, self.stations)
        # The long edges alone: where an end cuts a footprint is the business of _needed_ends.
        intervals = [edges_at(s, stations) for s in shapes]
        widths = [b - a for a, b in intervals]
        asked = area.overlap + OVERLAP_GUARD

        def surplus(first: int, share: float) -> float:
            """Length (m) by which the overlap of neighbours exceeds a share of the wider, at the least place."""
            widest = np.maximum(widths[first], widths[first + 1])
            return float(np.min(intervals[first][1] - intervals[first + 1][0] - share * widest))

        count = len(strips)
        spare = [surplus(i, asked) for i in range(count - 1)]
        if self.left is None:
            left_spare = -half - END_GUARD - float(np.max(intervals[0][0]))
        else:
            edge = edges_at(self.left, stations)
            widest = np.maximum(edge[1] - edge[0], widths[0])
            left_spare = float(np.min(edge[1] - intervals[0][0] - asked * widest))
        right_spare = float(np.min(intervals[-1][1])) - half - END_GUARD
        total = left_spare + sum(spare) + right_spare
        complete = total >= -1.0
        gaps = [0.0] * (count - 1)
        if complete and count > 1 and fill:
            mean = float(np.mean([w.mean() for w in widths]))
            room = total / (count - 1)
            most = math.inf if area.scans is not None else (max(0.10, area.overlap) - area.overlap) * mean
            gaps = [min(room, most)] * (count - 1)
        # Spare length left beside the neighbours goes to the area's two edges.
        rest = total - sum(gaps)
        move = left_spare - (rest / 2 if self.left is None and fill else 0.0)
        moves = []
        for index in range(count):
            moves.append(move)
            if index < count - 1:
                move += spare[index] - gaps[index]
        largest = 0.0
        for strip, shape, speed, step in zip(strips, shapes, speeds, moves, strict=True):
            # A positive step moves the strip to the right by the length that it has to spare on its left.
            strip.across += step
            near, far = self._needed_ends(shape, speed)
            strip.near -= near
            strip.far += far
            largest = max(largest, abs(step), abs(near), abs(far))
        return largest, complete

    # ------------------------------------------------------------------------------------------------- the search

    def guess(self, count: int, fill: bool) -> list[Strip]:
        """Strips to begin with."""
        area, half = self.area, self.area.width / 2
        swath = self.swath(0.0, self.closest)
        spacing = swath * (1 - area.overlap) * 1.08
        if self.left is None and fill:
            first = -spacing * (count - 1) / 2
        else:
            edge = -half if self.left is None else float(self.left.upper[:, 1].mean())
            first = edge + swath * (0.5 - area.overlap)
        return [Strip(first + i * spacing, -area.length / 2 - 500, area.length / 2 + 500) for i in range(count)]

    def patterns(self, count: int) -> list[Pattern]:
        """Orders and directions to try: to and fro, or all forward; from either side."""
        alternating = [tuple((i % 2 == 0) == first for i in range(count)) for first in (True, False)]
        directions = list(dict.fromkeys([*alternating, (True,) * count]))
        sides = (True, False) if count > 1 else (True,)
        return [Pattern(side, d) for side, d in itertools.product(sides, directions)]

    def best(self, count: int, *, fill: bool, shift: float = 0.0) -> AreaPlan:
        """The quickest feasible plan with a number of scans; the least infeasible one where none is feasible.

        All patterns are looked at roughly; the promising ones are followed until none of the rest can be quicker.

        Raises:
            InfeasibleError, GeometryError: no pattern could be simulated at all.
        """
        rough: list[AreaPlan] = []
        failure: BoresightError | None = None
        for pattern in self.patterns(count):
            strips = [replace(s) for s in rough[0].strips] if rough else self.guess(count, fill)
            if not pattern.from_left and rough and (
                    min(p.off_nadir for p in rough) > self.limits.off_nadir + math.radians(6.0)):
                break  # far too many scans: the other side will not help
            try:
                rough.append(self.simulate(pattern, strips, fill=fill, shift=shift, rounds=3 if rough else 20))
            except (InfeasibleError, GeometryError) as error:
                failure = error
        if not rough:
            assert failure is not None
            raise failure
        plans: list[AreaPlan] = []
        near = [p for p in rough if p.off_nadir < self.limits.off_nadir + math.radians(3.0)]
        if not near:
            return min(rough, key=lambda p: p.off_nadir)
        for plan in sorted(near, key=lambda p: p.stop):
            feasible = [p.stop for p in plans if p.feasible]
            if feasible and min(feasible) < plan.stop - 0.5:
                break
            gaps = [b.start - a.stop for a, b in itertools.pairwise(plan.scans)]
            try:
                plans.append(self.simulate(plan.pattern, [replace(s) for s in plan.strips], start=plan.start,
                                           durations=gaps, fill=fill, shift=shift))
            except (InfeasibleError, GeometryError) as error:
                failure = error
        if not plans:
            assert failure is not None
            raise failure
        feasible_plans = [p for p in plans if p.feasible]
        if feasible_plans:
            quickest = min(p.stop for p in feasible_plans)
            # A tie goes to the plan with fewer reverse scans, then to the smaller angle off the nadir.
            return min((p for p in feasible_plans if p.stop < quickest + 0.2),
                       key=lambda p: (p.pattern.forward.count(False), round(math.degrees(p.off_nadir), 1), p.stop))
        return min(plans, key=lambda p: max(value / limit for value, limit in p.excess.values()))

    def finish(self, plan: AreaPlan, *, fill: bool, shift: float = 0.0) -> AreaPlan:
        """The plan with converged strips and with its real slews between the scans.

        Raises:
            InfeasibleError: no slew under the limits joins two of the scans.
        """
        gaps = [b.start - a.stop for a, b in itertools.pairwise(plan.scans)]
        fine = self.simulate(plan.pattern, [replace(s) for s in plan.strips], start=plan.start, durations=gaps,
                             coarse=False, fill=fill, shift=shift)
        strips = [replace(s) for s in fine.strips]
        begin = fine.start
        guesses: list[float | Join] = [b.start - a.stop for a, b in itertools.pairwise(fine.scans)]
        for _ in range(8):
            placed = tuple(replace(s) for s in strips)
            scans, joins = self._with_slews(fine.pattern, strips, begin, guesses, 0.02)
            guesses = list(joins)
            shapes = [outline(s, self.plane) for s in (scans if fine.pattern.from_left else scans[::-1])]
            change, complete = self._move(strips, shapes, _speeds(scans, fine.pattern), fill)
            lag = self._lag(scans, shift)
            if change < 10.0 and abs(lag) < 0.1:
                break
            begin += lag
        scans, joins = self._with_slews(fine.pattern, list(placed), begin, guesses, 1e-6)
        shapes = [outline(s, self.plane) for s in (scans if fine.pattern.from_left else scans[::-1])]
        off_nadir = max(s.largest_off_nadir() for s in scans)
        return AreaPlan(fine.pattern, scans, joins, tuple(shapes), placed, complete, off_nadir,
                        excess_of_scans(scans, self.limits, off_nadir))

    def _with_slews(self, pattern: Pattern, strips: list[Strip], begin: float, guesses: Sequence[float | Join],
                    tolerance: float) -> tuple[tuple[Scan, ...], tuple[Join, ...]]:
        """Scans begun as soon as the slew from the one before allows, with those slews."""
        ordered = strips if pattern.from_left else strips[::-1]
        scans = [self.scan(ordered[0], begin, pattern.forward[0])]
        joins: list[Join] = []
        for strip, forward, guess in zip(ordered[1:], pattern.forward[1:], guesses, strict=True):

            def make(start: float, strip: Strip = strip, forward: bool = forward) -> Scan:
                return self.scan(strip, start, forward)

            join, scan = soonest(self.joiner, scans[-1], make, guess=guess, tolerance=tolerance)
            joins.append(join)
            scans.append(scan)
        return tuple(scans), tuple(joins)


def _speeds(scans: Sequence[Scan], pattern: Pattern) -> list[float]:
    """Ground speeds (m/s) of the scans in rising order across."""
    speeds = [s.length / s.duration for s in scans]
    return speeds if pattern.from_left else speeds[::-1]


def edges_at(shape: Outline, stations: Array) -> tuple[Array, Array]:
    """Across (m) of the two long edges of a footprint at stations along, held constant beyond their ends."""
    return (np.interp(stations, shape.lower[:, 0], shape.lower[:, 1]),
            np.interp(stations, shape.upper[:, 0], shape.upper[:, 1]))


def counts(width: float, narrowest: float, widest: float, overlap: float) -> ScanCount:
    """Number of scans by the paper's formula (Somov et al., section 2), printed and corrected.

    Printed ``2 b (1 - p / 50) / (s0 + sm)``: it falls with growing overlap. Corrected ``2 b / ((s0 + sm) (1 - p /
    100))``.

    Args:
        width: b, m.
        narrowest, widest: s0 and sm, m.
        overlap: p as a share.
    """
    return ScanCount(narrowest, widest, 2 * width * (1 - 2 * overlap) / (narrowest + widest),
                     2 * width / ((narrowest + widest) * (1 - overlap)))


def excess_of_scans(scans: Sequence[Scan], limits: LimitsRequest, off_nadir: float) -> dict[str, tuple[float, float]]:
    """Limits that scans exceed: name to (value, limit), SI and rad."""
    found: dict[str, tuple[float, float]] = {}
    for scan in scans:
        motion = scan.motion(np.linspace(scan.start, scan.stop, 41))
        for name, values, limit in (("rate", motion.rate, limits.rate),
                                    ("acceleration", motion.acceleration, limits.acceleration),
                                    ("jerk", motion.jerk, limits.jerk)):
            value = float(np.max(np.linalg.norm(values, axis=-1)))
            if value > limit * (1 - 1e-6) and value > found.get(name, (0.0, 0.0))[0]:
                found[name] = (value, limit)
    if off_nadir > limits.off_nadir - math.radians(0.005):
        found["off-nadir angle"] = (off_nadir, limits.off_nadir)
    return found


def soonest(joiner: Joiner, before: Scan, make: Callable[[float], Scan], *, guess: float | Join | None = None,
            tolerance: float = 1e-6) -> tuple[Join, Scan]:
    """The slew and the scan after it, begun as soon as the slew allows.

    The attitude at which the scan starts moves with its time, so that the slew's time depends on itself: secant steps
    on the gap less the slew's time.

    Args:
        joiner: makes slews.
        before: the scan that the slew leaves.
        make: the scan of a given start (s from the epoch).
        guess: gap to begin with, s, or the slew of nearly the same scans.
        tolerance: s; a microsecond or less for a plan to be flown.
    """
    end = end_of(before.motion([before.stop]))
    near = guess if isinstance(guess, Join) else None
    if guess is not None:
        gap = guess.duration if isinstance(guess, Join) else guess
    else:
        gap = 12.0
        for _ in range(4):
            scan = make(before.stop + gap)
            gap = joiner.estimate(end, end_of(scan.motion([scan.start])))
            if not math.isfinite(gap):
                raise InfeasibleError("no slew under the limits joins two scans", limit="rate, acceleration")
    history: list[tuple[float, float]] = []
    for _ in range(25):
        scan = make(before.stop + gap)
        join = near = joiner.join(end, end_of(scan.motion([scan.start])), before.stop, near)
        miss = join.duration - gap
        if abs(miss) < tolerance:
            return _stretched(join, gap), scan
        history.append((gap, miss))
        if len(history) > 1 and history[-1][1] != history[-2][1]:
            (g0, m0), (g1, m1) = history[-2:]
            step = -m1 * (g1 - g0) / (m1 - m0)
            gap += float(np.clip(step, -5, 5)) if abs(step) < 20 * abs(miss) + 1e-9 else miss
        else:
            gap += miss
        gap = max(gap, 1e-2)
    return _settled(joiner, end, before, make, history)


def _stretched(join: Join, gap: float) -> Join:
    """The slew over a time that differs from its own a little."""
    ratio = join.duration / gap
    law = join.at

    def at(times: Array) -> Motion:
        motion = law(np.asarray(times) * ratio)
        return replace(motion, rate=motion.rate * ratio, acceleration=motion.acceleration * ratio**2,
                       jerk=motion.jerk * ratio**3)

    return replace(join, duration=gap, at=at)


def _settled(joiner: Joiner, end: Motion, before: Scan, make: Callable[[float], Scan],
             history: list[tuple[float, float]]) -> tuple[Join, Scan]:
    """A slew of given time, where the least time jumps and the secant steps find no fixed point."""
    gap = max(g + m for g, m in history[-5:])
    for _ in range(40):
        scan = make(before.stop + gap)
        join = joiner.join_in(end, end_of(scan.motion([scan.start])), before.stop, gap)
        if join is not None:
            return join, scan
        gap *= 1.05
    raise InfeasibleError("no slew under the limits joins two scans", limit="rate, acceleration, jerk")


def check_azimuth(area: AreaRequest, pass_: Pass) -> float:
    """Azimuth (rad) of the scans in the sense of flight.

    Raises:
        InfeasibleError: the asked azimuth is more than 20 degrees off the ground track or its opposite.
    """
    if area.azimuth is None:
        return pass_.azimuth
    azimuth = area.azimuth
    if abs(float(wrapped(azimuth - pass_.azimuth))) > math.pi / 2:
        azimuth = float(wrapped(azimuth + math.pi))
    off = abs(float(wrapped(azimuth - pass_.azimuth)))
    if off > AZIMUTH_LIMIT:
        raise InfeasibleError(
            f"the scans' azimuth is {math.degrees(off):.2f} deg from the ground track "
            f"({math.degrees(pass_.azimuth):.2f} deg), limit {math.degrees(AZIMUTH_LIMIT):.0f} deg, exceeded by "
            f"{math.degrees(off - AZIMUTH_LIMIT):.2f} deg", limit="azimuth", excess=off - AZIMUTH_LIMIT)
    return azimuth
