"""The whole plan of a survey: scans of areas and single routes, joined by slews, over as many passes as it takes.

Every pass is a chain of pieces (scans, slews, and waits in which the attitude is fixed in the orbital frame) whose
attitude, rate and acceleration are continuous. Areas are scanned in the first pass in which anything of them can be;
what one pass does not finish, the next ones do. Single routes stand before or after everything else of their pass.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from estimator.models.errors import BoresightError, GeometryError, InfeasibleError
from guidance.coverage import Outline, covered_fraction, least_overlap, outline
from guidance.ground_geometry import (
    EQUATORIAL_RADIUS,
    EquidistantPlane,
    GroundLine,
    geodesic_inverse,
    wrapped,
)
from guidance.kinematics import Motion, conjugate, product, rodrigues_from_quaternion, sign_continuous
from guidance.orbit_propagation import (
    FORCE_MODEL,
    INERTIAL_FRAME,
    Arc,
    Orbit,
    Pass,
    orbit_of_request,
    passes_over,
)
from guidance.scan import Camera, Scan, make_scan, off_nadir_of_attitude
from guidance.slew_joining import Join, Joiner, end_of
from guidance.slew_request import Limits
from guidance.survey_planner import (
    MOST_SCANS,
    AreaPlan,
    PassPlanner,
    ScanCount,
    check_azimuth,
    counts,
    excess_of_scans,
    soonest,
)
from guidance.survey_request import AreaRequest, RouteRequest, SurveyRequest
from guidance.vector_spline import VectorSpline

Array = NDArray[np.float64]

HORIZON = 10 * 86400.0  # s after the epoch in which passes are looked for
BEFORE_EPOCH = 900.0  # s before the epoch at which a pass may have been at its closest
HALF_PASS = 900.0  # s of orbit on either side of the closest approach
WAIT_STEP = 5.0  # s, between the times tried for a route that cannot follow at once


@dataclass(frozen=True)
class Wait:
    """A time in which the attitude is fixed in the orbital frame.

    Attributes:
        start, stop: s from the epoch.
    """

    start: float
    stop: float
    reference: Array
    spline: VectorSpline

    @property
    def duration(self) -> float:
        """s."""
        return self.stop - self.start

    def motion(self, times: ArrayLike) -> Motion:
        """Attitude (inertial from body), rate, acceleration and jerk at times (s from the epoch)."""
        from guidance.kinematics import motion_from_rodrigues

        local = motion_from_rodrigues(*self.spline.derivatives(times))
        return replace(local, quaternion=product(self.reference, local.quaternion))


Piece = Scan | Join | Wait


@dataclass(frozen=True)
class PlannedScan:
    """A scan with its place in the request: the area's or route's index and name."""

    scan: Scan
    kind: str
    name: str
    index: int


@dataclass(frozen=True)
class PlannedPass:
    """One pass: its pieces in the order of time, without gaps, and its scans with their places in the request."""

    pieces: tuple[Piece, ...]
    scans: tuple[PlannedScan, ...]
    arc: Arc

    @property
    def start(self) -> float:
        """s from the epoch."""
        return self.pieces[0].start

    @property
    def stop(self) -> float:
        """s from the epoch."""
        return self.pieces[-1].stop

    def motion(self, times: ArrayLike) -> Motion:
        """Attitude (inertial from body, sign-continuous), rate, acceleration, jerk at times (n,) inside the pass."""
        times = np.asarray(times, float)
        starts = np.array([p.start for p in self.pieces[1:]])
        which = np.searchsorted(starts, times, side="right")
        parts = [np.empty((times.size, n)) for n in (4, 3, 3, 3)]
        for index in np.unique(which):
            chosen = which == index
            motion = self.pieces[index].motion(times[chosen])
            for part, values in zip(parts, (motion.quaternion, motion.rate, motion.acceleration, motion.jerk),
                                    strict=True):
                part[chosen] = values
        parts[0] = sign_continuous(parts[0] / np.linalg.norm(parts[0], axis=1, keepdims=True))
        return Motion(*parts)


@dataclass(frozen=True)
class PlannedArea:
    """An area: its plane, the passes' plans, and the estimates of the number of scans."""

    request: AreaRequest
    plane: EquidistantPlane
    plans: tuple[AreaPlan, ...]
    count: ScanCount

    @property
    def outlines(self) -> list[Outline]:
        """Footprints in the area's plane."""
        return [o for plan in self.plans for o in plan.outlines]

    @property
    def covered(self) -> float:
        """Share of the area that is covered."""
        return covered_fraction(self.outlines, self.request.length, self.request.width)

    @property
    def overlap(self) -> float | None:
        """Least overlap between neighbours, share of the wider one."""
        return least_overlap(self.outlines, self.request.length)


@dataclass(frozen=True)
class SurveyPlan:
    """The plan of a survey.

    Attributes:
        request: what was asked.
        orbit: propagated orbit.
        passes: in the order of time.
        areas: one for each area of the request.
        off_nadir: largest angle of the line of sight off the nadir over scans, slews and waits, rad.
        largest: largest rate, acceleration and jerk over everything (rad/s, rad/s2, rad/s3).
    """

    request: SurveyRequest
    orbit: Orbit
    camera: Camera
    passes: tuple[PlannedPass, ...]
    areas: tuple[PlannedArea, ...]
    off_nadir: float
    largest: tuple[float, float, float]

    @property
    def scans(self) -> list[PlannedScan]:
        """All scans in the order of time."""
        return [s for p in self.passes for s in p.scans]

    @property
    def joins(self) -> list[Join]:
        """All slews in the order of time."""
        return [q for p in self.passes for q in p.pieces if isinstance(q, Join)]

    @property
    def start(self) -> float:
        """s from the epoch."""
        return self.passes[0].start

    @property
    def stop(self) -> float:
        """s from the epoch."""
        return self.passes[-1].stop

    @property
    def area_duration(self) -> float | None:
        """From the first to the last scan of areas, s; None without areas."""
        found = [s.scan for s in self.scans if s.kind == "area"]
        return found[-1].stop - found[0].start if found else None

    def why(self) -> str:
        """The sentence of the answer."""
        slews = self.joins
        text = (f"{len(self.scans)} scans and {len(slews)} slews in {len(self.passes)} pass"
                f"{'es' if len(self.passes) > 1 else ''}, all limits hold")
        return "; ".join([text, *self.shortfalls()])

    def shortfalls(self) -> list[str]:
        """What the areas lack: less than 99 % covered, or less overlap than asked (nothing, for a good plan)."""
        found = []
        for area in self.areas:
            name = area.request.name
            if area.covered < 0.99:
                found.append(f"{name} is covered to {100 * area.covered:.2f} %, wanted 99 %")
            if area.overlap is not None and area.overlap < area.request.overlap - 1e-6:
                found.append(f"{name} has a least overlap of {100 * area.overlap:.2f} %, asked "
                             f"{100 * area.request.overlap:g} %")
        return found

    def answer(self) -> dict[str, Any]:
        """The machine-readable answer; times in s from the epoch, angles in degrees, lengths in km."""
        def point(p: tuple[float, float]) -> list[float]:
            return [math.degrees(p[0]), math.degrees(float(wrapped(p[1])))]

        covered = [(a.covered, a.request.length * a.request.width) for a in self.areas]
        overlaps = [a.overlap for a in self.areas if a.overlap is not None]
        scans = []
        for index, planned in enumerate(self.scans, 1):
            scan = planned.scan
            scans.append({
                "index": index, "kind": planned.kind, "name": planned.name,
                "direction": "forward" if scan.forward else "reverse", "image_motion": scan.kind_of_motion,
                "start_s": scan.start, "stop_s": scan.stop, "length_km": scan.length / 1e3,
                "width_km": scan.width / 1e3, "center": point(scan.center),
                "corners": [point(c) for c in scan.corners], "area_km2": footprint_area(scan) / 1e6,
                "reversal": "yaw" if scan.turned else "detector" if not scan.forward else None,
                "largest_off_nadir_deg": math.degrees(scan.largest_off_nadir()),
                "pass": next(i for i, p in enumerate(self.passes, 1) if planned in p.scans),
            })
        return {
            "status": "not_converged" if self.shortfalls() else "ok", "why": self.why(),
            "epoch": self.request.orbit.epoch.isoformat() + "Z", "scans": scans,
            "slews": [{"start_s": j.start, "duration_s": j.duration, "angle_deg": math.degrees(j.angle), "law": j.law}
                      for j in self.joins],
            "waits": [{"start_s": w.start, "duration_s": w.duration}
                      for p in self.passes for w in p.pieces if isinstance(w, Wait)],
            "covered_fraction": (sum(c * s for c, s in covered) / sum(s for _, s in covered)) if covered else None,
            "least_overlap_percent": 100 * min(overlaps) if overlaps else None,
            "largest_off_nadir_deg": math.degrees(self.off_nadir),
            "area_duration_s": self.area_duration, "duration_s": self.stop - self.start,
            "largest": {"rate_deg_s": math.degrees(self.largest[0]),
                        "acceleration_deg_s2": math.degrees(self.largest[1]),
                        "jerk_deg_s3": math.degrees(self.largest[2])},
            "passes": [{"start_s": p.start, "stop_s": p.stop, "scans": len(p.scans)} for p in self.passes],
            "number_of_scans": [{"area": a.request.name, "nadir_swath_km": a.count.nadir_swath / 1e3,
                                 "widest_swath_km": a.count.widest_swath / 1e3, "printed": a.count.printed,
                                 "corrected": a.count.corrected, "planned": len(a.outlines)} for a in self.areas],
            "frame": INERTIAL_FRAME, "force_model": FORCE_MODEL, "earth_orientation": self.orbit.earth.name,
        }


def footprint_area(scan: Scan) -> float:
    """Area (m2) of a scan's footprint, in the equidistant plane of its centre."""
    shape = outline(scan, EquidistantPlane(*scan.center, scan.line.azimuth)).polygon
    x, y = shape[:, 0], shape[:, 1]
    return abs(0.5 * float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))))


# ---------------------------------------------------------------------------------------------------------- planning


class Surveyor:
    """Plans a survey.

    Args:
        request: what is asked.
        optimal: slews by the optimal control problem; otherwise in closed form.
        progress: called with a sentence now and then.
    """

    def __init__(self, request: SurveyRequest, *, optimal: bool = True, progress: Callable[[str], None] | None = None):
        self.request = request
        self.orbit = orbit_of_request(request.orbit)
        self.camera = Camera(request.camera)
        limits = request.limits
        self.joiner = Joiner(Limits(limits.rate, limits.acceleration, limits.jerk), optimal=optimal)
        self.say = progress or (lambda _: None)

    # ----------------------------------------------------------------------------------------------------- passes

    def reach(self) -> float:
        """Ground distance (m) from the track at which the line of sight at the limit meets the ground."""
        request = self.request.orbit
        top = request.semi_major_axis * (1 + request.eccentricity) + 25e3
        sine = min(1.0, math.sin(self.request.limits.off_nadir) * top / (EQUATORIAL_RADIUS - 22e3))
        return (math.asin(sine) - self.request.limits.off_nadir) * EQUATORIAL_RADIUS

    def passes(self, latitude: float, longitude: float, reach: float) -> Iterator[Pass]:
        """Passes within ``reach`` (m) of a point, found day by day as they are asked for."""
        inclination = self.request.orbit.inclination
        highest = min(inclination, math.pi - inclination) + 0.005
        if abs(latitude) > highest + 1.01 * reach / EQUATORIAL_RADIUS:
            return
        start = -BEFORE_EPOCH
        stop = max(BEFORE_EPOCH, 1.2 * self.orbit.period)
        while start < HORIZON:
            yield from (p for p in passes_over(self.orbit, latitude, longitude, start - 40.0, stop + 40.0, reach)
                        if start <= p.time < stop)
            start, stop = stop, min(HORIZON, stop + 86400.0)
            if start >= HORIZON:
                return

    def never_visible(self, name: str, latitude: float, longitude: float, where: str) -> GeometryError:
        """The error for a target that no pass comes near to."""
        nearest: Pass | None = None
        for pass_ in passes_over(self.orbit, latitude, longitude, -BEFORE_EPOCH, 86400.0, 15e6):
            if nearest is None or pass_.distance < nearest.distance:
                nearest = pass_
        found = f"{nearest.distance / 1e3:.0f} km from the nearest ground track" if nearest else "no pass"
        return GeometryError(
            f"the target {name} is never visible within {math.degrees(self.request.limits.off_nadir):.1f} deg of the "
            f"nadir in {HORIZON / 86400:.0f} days", where=where, value=found, limit=f"{self.reach() / 1e3:.0f} km",
            remedy="choose a target nearer to the equator than the ground track's highest latitude, another orbit or a "
                   "wider off_nadir_deg")

    # ------------------------------------------------------------------------------------------------------ areas

    def plan(self) -> SurveyPlan:
        """The plan.

        Raises:
            GeometryError: a target is never visible.
            InfeasibleError: the request cannot be met; says which limit, and by how much.
        """
        by_pass: list[tuple[float, Arc, list[tuple[int, AreaPlan]]]] = []
        areas: dict[int, tuple[EquidistantPlane, list[AreaPlan]]] = {}
        order = self._order_of_areas()
        for index in order:
            areas[index] = self._plan_area(index, by_pass)
        by_pass.sort(key=lambda p: p[0])
        passes = self._chain_passes(by_pass)
        planned = []
        for index, area in enumerate(self.request.areas):
            plane, plans = areas[index]
            widths = [s.width for p in plans for s in p.scans]
            planned.append(PlannedArea(area, plane, tuple(plans), counts(area.width, min(widths), max(widths),
                                                                         area.overlap)))
        return self._checked(passes, tuple(planned))

    def _order_of_areas(self) -> list[int]:
        """Areas in the order in which the satellite first comes by."""
        times = []
        for index, area in enumerate(self.request.areas):
            reach = self.reach() + 0.5 * math.hypot(area.length, area.width)
            first = next(self.passes(*area.center, reach), None)
            if first is None:
                raise self.never_visible(area.name, *area.center, where=f"[[area]] {area.name}")
            times.append((first.time, index))
        return [i for _, i in sorted(times)]

    def _plan_area(self, index: int, by_pass: list[tuple[float, Arc, list[tuple[int, AreaPlan]]]],
                   ) -> tuple[EquidistantPlane, list[AreaPlan]]:
        area = self.request.areas[index]
        limits = self.request.limits
        quarter = 0.5 * math.pi * EQUATORIAL_RADIUS
        corner = math.hypot(area.length, area.width) / 2
        if corner > 0.7 * quarter:
            raise InfeasibleError(
                f"the area {area.name} is larger than any plan: it reaches {corner / 1e3:.0f} km from its centre, "
                f"and a plane map serves no farther than {0.7 * quarter / 1e3:.0f} km, exceeded by "
                f"{(corner - 0.7 * quarter) / 1e3:.0f} km", limit="size of the area", excess=corner - 0.7 * quarter)
        reach = self.reach() + 0.5 * math.hypot(area.length, area.width)
        plane: EquidistantPlane | None = None
        plans: list[AreaPlan] = []
        left: Outline | None = None
        refusal: InfeasibleError | None = None
        tried = refused = hopeless = 0
        for pass_ in self.passes(*area.center, reach):
            try:
                azimuth = check_azimuth(area, pass_)
            except InfeasibleError as error:
                if refusal is None or (error.excess or 0.0) < (refusal.excess or math.inf):
                    refusal = error
                refused += 1
                if refused >= 4 and not tried:
                    break
                continue
            if plane is None:
                plane = EquidistantPlane(*area.center, azimuth)
            elif abs(float(wrapped(pass_.azimuth - plane.azimuth))) > math.pi / 9:
                continue
            self.say(f"{area.name}: pass at {pass_.time:.0f} s, {pass_.distance / 1e3:.0f} km aside")
            shared = next((entry for entry in by_pass if abs(entry[0] - pass_.time) < 1200.0), None)
            arc = shared[1] if shared else self.orbit.arc(pass_.time - HALF_PASS, pass_.time + HALF_PASS)
            planner = PassPlanner(area, plane, arc, pass_.time, self.camera, limits, self.request.image_rate,
                                  self.joiner, left)
            if self._beside(planner, area):
                continue
            tried += 1
            if tried > 40:
                break
            done = sum(len(p.scans) for p in plans)
            plan, error_ = self._plan_pass(planner, area, done, shared[2][-1][1].stop if shared else None)
            if plan is None:
                refusal = error_ if refusal is None or not plans else refusal
                if not plans:
                    plane = None if area.azimuth is None else plane
                    # Another pass changes the angle off the nadir, and hardly the rates.
                    hopeless += error_.limit != "off-nadir angle"
                    if hopeless >= 3:
                        break
                continue
            plans.append(plan)
            if shared:
                shared[2].append((index, plan))
            else:
                by_pass.append((pass_.time, arc, [(index, plan)]))
            if plan.complete:
                return plane, plans
            left = plan.outlines[-1]
            if len(plans) >= 3 and self._out_of_reach(area, plans):
                break
        if not tried and refusal is None and plane is None:
            raise self.never_visible(area.name, *area.center, where=f"[[area]] {area.name}")
        if plans:
            edge = float(np.min(plans[-1].outlines[-1].upper[:, 1]))
            missing = area.width / 2 - edge
            raise InfeasibleError(
                f"the area {area.name} is larger than any plan of {HORIZON / 86400:.0f} days: "
                f"{sum(len(p.scans) for p in plans)} scans in the {len(plans)} passes of the first "
                f"{plans[-1].stop / 86400:.1f} days leave {missing / 1e3:.0f} km of its {area.width / 1e3:.0f} km of "
                f"width uncovered", limit="width of the area", excess=missing)
        if refusal is None:
            raise InfeasibleError(f"the area {area.name} is larger than any plan: no pass of "
                                  f"{HORIZON / 86400:.0f} days comes near its left edge", limit="width of the area")
        raise refusal

    def _beside(self, planner: PassPlanner, area: AreaRequest) -> bool:
        """Whether the first strip to scan lies too far aside of the pass's ground track."""
        swath = planner.swath(0.0, planner.closest)
        edge = -area.width / 2 if planner.left is None else float(np.min(planner.left.upper[:, 1]))
        latitude, longitude = planner.plane.to_ellipsoid(0.0, edge + 0.5 * swath)
        track = planner.arc.ground_track(np.linspace(planner.arc.start, planner.arc.stop, 181))
        return float(np.min(geodesic_inverse(latitude, longitude, track[0], track[1])[0])) > self.reach() + swath

    def _out_of_reach(self, area: AreaRequest, plans: list[AreaPlan]) -> bool:
        """Whether the progress so far would leave more than half of the rest uncovered at the end of the horizon."""
        edge = float(np.min(plans[-1].outlines[-1].upper[:, 1]))
        progress = (edge + area.width / 2) / max(plans[-1].stop - plans[0].start, 1.0)
        return progress * (HORIZON - plans[-1].stop) < 0.5 * (area.width / 2 - edge)

    def _plan_pass(self, planner: PassPlanner, area: AreaRequest, done: int, after: float | None,
                   ) -> tuple[AreaPlan | None, InfeasibleError]:
        """The scans of one pass: all that is left of the area if possible, otherwise as many as are feasible."""
        limits = self.request.limits
        failure = InfeasibleError(f"no scan of the area {area.name} is feasible", limit="off-nadir angle")

        def attempt(count: int, fill: bool) -> AreaPlan | None:
            nonlocal failure
            shift = 0.0
            for _ in range(6):
                try:
                    plan = planner.best(count, fill=fill, shift=shift)
                    if plan.feasible and (plan.complete or not fill):
                        plan = planner.finish(plan, fill=fill, shift=shift)
                except (InfeasibleError, GeometryError) as error:
                    failure = error if isinstance(error, InfeasibleError) else InfeasibleError(
                        str(error), limit="off-nadir angle")
                    return None
                if fill and not plan.complete:
                    return plan
                if not plan.feasible:
                    failure = infeasible(plan.excess, area.name, count)
                    return None
                worst = worst_off_nadir(plan.joins, planner.arc, self.camera)
                if worst > limits.off_nadir:
                    failure = infeasible({"off-nadir angle": (worst, limits.off_nadir)}, area.name, count)
                    return None
                if after is None or plan.start > after + 40.0:
                    return plan
                shift += after + 45.0 - plan.start
            return None

        half = area.width / 2
        edge = -half if planner.left is None else float(np.min(planner.left.upper[:, 1]))
        swath = planner.swath(0.0, planner.closest)
        if area.scans is not None:
            count = area.scans - done
            if count <= 0:
                return None, infeasible_count(area, done)
        else:
            count = max(1, math.ceil((half - edge) / (1.1 * swath * (1 - area.overlap))))
        most = self._most_scans(area, planner)
        if count <= most + 2:
            plan = attempt(count, True)
            if area.scans is None:
                for _ in range(MOST_SCANS):
                    if plan is None or plan.complete:
                        break
                    count += 1
                    plan = attempt(count, True)
                if plan is not None and plan.complete:
                    while count > 1:
                        fewer = attempt(count - 1, True)
                        if fewer is None or not fewer.complete:
                            break
                        plan, count = fewer, count - 1
            elif plan is not None and not plan.complete:
                gap = half - float(np.min(plan.outlines[-1].upper[:, 1]))
                raise InfeasibleError(
                    f"{area.scans} scans with {100 * area.overlap:g} % overlap leave {2 * gap / 1e3:.1f} km of the "
                    f"area's {area.width / 1e3:.1f} km of width uncovered; ask for more scans", limit="scans",
                    excess=2 * gap)
            if plan is not None and plan.complete:
                return plan, failure
        start = min(count - 1, most)
        for fewer_count in range(max(1, start), 0, -1):
            if fewer_count >= count and area.scans is None and count <= most + 2:
                continue
            plan = attempt(fewer_count, False)
            if plan is not None and plan.feasible:
                return replace(plan, complete=False), failure
        return None, failure

    def _most_scans(self, area: AreaRequest, planner: PassPlanner) -> int:
        """Rough number of scans that fit into the time in which the area is in the cone."""
        height = self.request.orbit.semi_major_axis - EQUATORIAL_RADIUS
        window = 2 * (self.reach() + 100e3) / 6500.0
        rate = self.request.image_rate * height
        scan = area.length / (1.3 * rate) + 2 * math.sqrt(
            math.radians(3.0) / self.request.limits.acceleration)
        del planner
        return max(1, min(MOST_SCANS, math.ceil(window / scan) + 1))

    # ------------------------------------------------------------------------------------------------------ chains

    def _chain_passes(self, by_pass: list[tuple[float, Arc, list[tuple[int, AreaPlan]]]]) -> list[PlannedPass]:
        """Pieces of every pass, with the single routes before the first and after the last area."""
        before = [(i, r) for i, r in enumerate(self.request.routes) if r.when == "before"]
        after = [(i, r) for i, r in enumerate(self.request.routes) if r.when == "after"]
        result = []
        if not by_pass:
            return self._routes_alone(before + after)
        for number, (_, arc, entries) in enumerate(by_pass):
            pieces: list[Piece] = []
            scans: list[PlannedScan] = []
            for index, plan in sorted(entries, key=lambda e: e[1].start):
                if pieces:
                    pieces.extend(self._transfer(pieces[-1], plan.scans[0], arc))
                for scan, join in itertools.zip_longest(plan.scans, plan.joins):
                    pieces.append(scan)
                    scans.append(PlannedScan(scan, "area", self.request.areas[index].name, index))
                    if join is not None:
                        pieces.append(join)
            if number == 0:
                for index, route in reversed(before):
                    pieces, scan = self._prepend(route, pieces, arc)
                    scans.insert(0, PlannedScan(scan, "route", route.name, index))
            if number == len(by_pass) - 1:
                for index, route in after:
                    pieces, scan = self._append(route, pieces, arc)
                    scans.append(PlannedScan(scan, "route", route.name, index))
            result.append(PlannedPass(tuple(pieces), tuple(scans), arc))
        return result

    def _routes_alone(self, routes: list[tuple[int, RouteRequest]]) -> list[PlannedPass]:
        """A survey of single routes: the first is centred on its closest approach, the others follow."""
        refusal: BoresightError | None = None
        first = routes[0][1]
        for pass_ in self.passes(*first.start, self.reach() + first.length):
            arc = self.orbit.arc(pass_.time - HALF_PASS, pass_.time + HALF_PASS)
            try:
                make = self._route(first, arc)
                scan = make(pass_.time)
                for _ in range(8):
                    middle = scan.middle
                    latitude, longitude = scan.center
                    times = np.linspace(-30, 30, 61) + middle
                    track = arc.ground_track(times)
                    near = times[np.argmin(geodesic_inverse(latitude, longitude, track[0], track[1])[0])]
                    scan = make(scan.start + float(near) - middle)
                    if abs(near - middle) < 0.5:
                        break
                excess = excess_of_scans([scan], self.request.limits, scan.largest_off_nadir())
                if excess:
                    raise infeasible(excess, first.name, 1)
                pieces: list[Piece] = [scan]
                scans = [PlannedScan(scan, "route", first.name, routes[0][0])]
                for index, route in routes[1:]:
                    pieces, scan = self._append(route, pieces, arc)
                    scans.append(PlannedScan(scan, "route", route.name, index))
                return [PlannedPass(tuple(pieces), tuple(scans), arc)]
            except BoresightError as error:
                refusal = refusal or error
        raise refusal or self.never_visible(first.name, *first.start, where=f"[[route]] {first.name}")

    def _route(self, route: RouteRequest, arc: Arc) -> Callable[[float], Scan]:
        """The scan of a route as a function of its start (s from the epoch)."""
        times = np.linspace(arc.start, arc.stop, 401)
        for _ in range(3):
            track = arc.ground_track(times)
            distance = geodesic_inverse(*route.start, track[0], track[1])[0]
            best = int(np.argmin(distance))
            step = times[1] - times[0]
            nearest, track_azimuth = float(times[best]), float(track[2][best])
            times = np.clip(np.linspace(nearest - step, nearest + step, 41), arc.start, arc.stop)
        azimuth = track_azimuth if route.azimuth is None else route.azimuth
        with_flight = abs(float(wrapped(azimuth - track_azimuth))) <= math.pi / 2
        if route.image_motion == "along_track" and not with_flight:
            raise InfeasibleError(f"the route {route.name} runs against the flight and cannot be scanned along the "
                                  "track", limit="azimuth")
        if with_flight:
            line, last = GroundLine(*route.start, azimuth), route.length
        else:
            line, last = GroundLine(*route.start, float(wrapped(azimuth + math.pi))), -route.length
        return lambda start: make_scan(arc, self.camera, line, 0.0, last, start, self.request.image_rate,
                                       kind_of_motion=route.image_motion)

    def _acceptable(self, scan: Scan) -> dict[str, tuple[float, float]]:
        return excess_of_scans([scan], self.request.limits, scan.largest_off_nadir())

    def _append(self, route: RouteRequest, pieces: list[Piece], arc: Arc) -> tuple[list[Piece], Scan]:
        """The chain with a route after it, as soon as possible."""
        make = self._route(route, arc)
        last = pieces[-1]
        refusal: BoresightError | None = None
        try:
            join, scan = soonest(self.joiner, last, make)  # type: ignore[arg-type]
            excess = self._acceptable(scan)
            worst = worst_off_nadir((join,), arc, self.camera)
            if worst > self.request.limits.off_nadir:
                excess.setdefault("off-nadir angle", (worst, self.request.limits.off_nadir))
            if not excess:
                return [*pieces, join, scan], scan
            refusal = infeasible(excess, route.name, 1)
            begin = join.stop
        except (GeometryError, InfeasibleError) as error:
            refusal, begin = error, last.stop + 20.0
        while begin < arc.stop - 60.0:
            begin += WAIT_STEP
            try:
                scan = make(begin)
                if not self._acceptable(scan):
                    return [*pieces, *self._transfer(last, scan, arc), scan], scan
            except (GeometryError, InfeasibleError):
                continue
        raise _for_route(route, refusal)

    def _prepend(self, route: RouteRequest, pieces: list[Piece], arc: Arc) -> tuple[list[Piece], Scan]:
        """The chain with a route before it, as late as possible."""
        make = self._route(route, arc)
        first = pieces[0]
        head = end_of(first.motion(np.array([first.start])))
        refusal: BoresightError | None = None
        length = 20.0
        begin = first.start - 12.0 - length
        history: list[tuple[float, float]] = []
        try:
            for _ in range(30):
                scan = make(begin)
                join = self.joiner.join(end_of(scan.motion(np.array([scan.stop]))), head, scan.stop)
                miss = join.stop - first.start
                if abs(miss) < 1e-6:
                    break
                history.append((begin, miss))
                slope = 1.0
                if len(history) > 1 and history[-1][0] != history[-2][0]:
                    slope = (history[-1][1] - history[-2][1]) / (history[-1][0] - history[-2][0])
                    slope = slope if 0.2 < slope < 5 else 1.0
                begin -= float(np.clip(miss / slope, -60, 60))
            else:
                raise InfeasibleError("no slew ends when the next scan begins", limit="rate, acceleration, jerk")
            excess = self._acceptable(scan)
            worst = worst_off_nadir((join,), arc, self.camera)
            if worst > self.request.limits.off_nadir:
                excess.setdefault("off-nadir angle", (worst, self.request.limits.off_nadir))
            if not excess:
                from guidance.survey_planner import _stretched

                return [scan, _stretched(join, first.start - scan.stop), *pieces], scan
            refusal = infeasible(excess, route.name, 1)
        except (GeometryError, InfeasibleError) as error:
            refusal = error
            begin = first.start - 12.0 - length
        while begin > arc.start + 5.0:
            begin -= WAIT_STEP
            try:
                scan = make(begin)
                if scan.stop < first.start - 5.0 and not self._acceptable(scan):
                    return [scan, *self._transfer(scan, first, arc), *pieces], scan
            except (GeometryError, InfeasibleError):
                continue
        raise _for_route(route, refusal)

    def _transfer(self, before: Piece, after: Piece, arc: Arc) -> list[Piece]:
        """Pieces that lead from one scan to another at a given later time: one smooth slew, or slew, wait, slew.

        Raises:
            InfeasibleError: the time between is too short.
        """
        end = end_of(before.motion(np.array([before.stop])))
        head = end_of(after.motion(np.array([after.start])))
        gap = after.start - before.stop
        limit = self.request.limits.off_nadir
        if gap < 60.0:
            join = self.joiner.join_in(end, head, before.stop, gap)
            if join is not None and worst_off_nadir((join,), arc, self.camera) <= limit:
                return [join]
        quickest = self.joiner.join(end, head, before.stop)
        if quickest.duration > gap:
            raise InfeasibleError(f"the slew between two scans takes {quickest.duration:.1f} s, there are {gap:.1f} s",
                                  limit="time between scans", excess=quickest.duration - gap)
        hold = _fixed_attitude(arc, head.quaternion, after.start)
        # Leave the hold so that the last slew ends with the next scan's start.
        leave = after.start - 15.0
        history: list[tuple[float, float]] = []
        last = None
        for _ in range(30):
            last = self.joiner.join(end_of(hold(leave - 1, leave).motion(np.array([leave]))), head, leave)
            miss = last.stop - after.start
            if abs(miss) < 1e-6:
                break
            history.append((leave, miss))
            slope = 1.0
            if len(history) > 1 and history[-1][0] != history[-2][0]:
                slope = (history[-1][1] - history[-2][1]) / (history[-1][0] - history[-2][0])
                slope = slope if 0.2 < slope < 5 else 1.0
            leave -= float(np.clip(miss / slope, -30, 30))
        assert last is not None
        if abs(last.stop - after.start) < 1e-6:
            from guidance.survey_planner import _stretched

            last = _stretched(last, after.start - last.start)
            arrive = before.stop + 15.0
            for _ in range(30):
                first = self.joiner.join(end, end_of(hold(arrive, arrive + 1).motion(np.array([arrive]))), before.stop)
                if abs(first.stop - arrive) < 1e-6:
                    break
                arrive = first.stop
            if abs(first.stop - arrive) < 1e-6 and arrive < leave - 0.5:
                first = _stretched(first, arrive - before.stop)
                if worst_off_nadir((first, last), arc, self.camera) <= limit:
                    return [first, hold(arrive, leave), last]
        for stretch in (self.joiner.join_in(end, head, before.stop, gap),):
            if stretch is not None and worst_off_nadir((stretch,), arc, self.camera) <= limit:
                return [stretch]
        raise InfeasibleError("no slew and wait between two scans keep the line of sight in the cone",
                              limit="off-nadir angle")

    # ------------------------------------------------------------------------------------------------------ checks

    def _checked(self, passes: list[PlannedPass], areas: tuple[PlannedArea, ...]) -> SurveyPlan:
        """The plan with its largest values, taken on a dense grid over all pieces."""
        largest = np.zeros(3)
        off_nadir = 0.0
        for planned in passes:
            for piece in planned.pieces:
                times = np.linspace(piece.start, piece.stop, max(50, int(20 * (piece.stop - piece.start))))
                motion = piece.motion(times)
                found = [float(np.max(np.linalg.norm(v, axis=-1)))
                         for v in (motion.rate, motion.acceleration, motion.jerk)]
                largest = np.maximum(largest, found)
                off_nadir = max(off_nadir, float(np.max(off_nadir_of_attitude(planned.arc, self.camera, times,
                                                                              motion.quaternion))))
        limits = self.request.limits
        for name, value, limit in zip(("rate", "acceleration", "jerk"), largest,
                                      (limits.rate, limits.acceleration, limits.jerk), strict=True):
            if value > limit * (1 + 1e-6):
                raise infeasible({name: (float(value), limit)}, "the plan", len(passes))
        if off_nadir > limits.off_nadir + 1e-9:
            raise infeasible({"off-nadir angle": (off_nadir, limits.off_nadir)}, "the plan", len(passes))
        return SurveyPlan(self.request, self.orbit, self.camera, tuple(passes), areas, off_nadir,
                          (float(largest[0]), float(largest[1]), float(largest[2])))


def _fixed_attitude(arc: Arc, quaternion: Array, moment: float) -> Callable[[float, float], Wait]:
    """Waits with the attitude fixed in the orbital frame, equal to ``quaternion`` at ``moment``."""
    body = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    orbital_from_body = arc.orbital_axes(np.array(moment)).T @ body

    def wait(start: float, stop: float) -> Wait:
        from guidance.scan import _Polynomial

        clock = _Polynomial(start, stop, int(min(80, 20 + (stop - start) / 20)))
        q = sign_continuous(Rotation.from_matrix(arc.orbital_axes(clock.nodes) @ orbital_from_body)
                            .as_quat(scalar_first=True))
        reference = q[len(q) // 2]
        coefficients = clock.fit(rodrigues_from_quaternion(product(conjugate(reference), q)))
        knots = np.linspace(start, stop, max(2, math.ceil((stop - start) / 10.0)) + 1)
        conditions = np.stack([clock.value(coefficients, knots, order) for order in range(4)], 1)
        return Wait(start, stop, reference, VectorSpline.through(knots, conditions))

    return wait


def worst_off_nadir(joins: tuple[Join, ...], arc: Arc, camera: Camera) -> float:
    """Largest angle (rad) of the line of sight off the nadir during slews."""
    worst = 0.0
    for join in joins:
        times = np.linspace(join.start, join.stop, 121)
        worst = max(worst, float(np.max(off_nadir_of_attitude(arc, camera, times, join.motion(times).quaternion))))
    return worst


_UNITS = {"rate": "deg/s", "acceleration": "deg/s2", "jerk": "deg/s3", "off-nadir angle": "deg"}


def infeasible(excess: dict[str, tuple[float, float]], name: str, count: int) -> InfeasibleError:
    """The error that says which limits are exceeded, and by how much."""
    parts = [f"the {limit} reaches {math.degrees(value):.4g} {_UNITS[limit]}, limit {math.degrees(bound):.4g} "
             f"{_UNITS[limit]}, exceeded by {math.degrees(value - bound):.3g} {_UNITS[limit]}"
             for limit, (value, bound) in excess.items()]
    worst = max(excess, key=lambda k: excess[k][0] / excess[k][1])
    return InfeasibleError(f"{name} with {count} scan{'s' if count != 1 else ''} in a pass: " + "; ".join(parts),
                           limit=worst, excess=excess[worst][0] - excess[worst][1])


def infeasible_count(area: AreaRequest, done: int) -> InfeasibleError:
    """The error for an area that the asked number of scans does not cover."""
    return InfeasibleError(f"{done} scans do not cover the area {area.name}; ask for more scans", limit="scans")


def _for_route(route: RouteRequest, refusal: BoresightError | None) -> InfeasibleError:
    excess = refusal.excess if isinstance(refusal, InfeasibleError) else None
    limit = refusal.limit if isinstance(refusal, InfeasibleError) else "off-nadir angle"
    return InfeasibleError(f"the route {route.name} cannot be scanned {route.when} the rest of its pass: {refusal}",
                           limit=limit, excess=excess)


def plan_survey(request: SurveyRequest, *, optimal: bool = True,
                progress: Callable[[str], None] | None = None) -> SurveyPlan:
    """Plan a survey; see :class:`Surveyor`."""
    return Surveyor(request, optimal=optimal, progress=progress).plan()


